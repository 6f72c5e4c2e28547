"""The authors' numbers, and that the comparison with them can fail."""

from __future__ import annotations

import golden
import numpy as np
import pytest
from golden import FILES, OTHERS, golden_path


@pytest.fixture
def changed(tmp_path):
    """A function that copies a golden file with one array changed, and gives the copy's path."""

    def change(key, function, name=FILES[1]):
        with np.load(golden_path(name)) as archive:
            data = {entry: archive[entry] for entry in archive.files}
        data[key] = function(data[key].copy())
        path = tmp_path / "changed.npz"
        np.savez(path, **data)
        return str(path)

    return change


def _nudge(array):
    array.flat[0] += 0.1
    return array


def _nan(array):
    array.flat[0] = np.nan
    return array


@pytest.mark.parametrize("name", FILES + OTHERS)
def test_equals_the_authors_implementation(name):
    worst = golden.check(golden_path(name))
    assert worst.passed(), dict(worst.errors)
    assert {"forward", "imagination", "losses", "weights"} | ({"planner"} if name in FILES else set()) <= set(worst.errors)


@pytest.mark.parametrize("change", [_nudge, _nan])
@pytest.mark.parametrize("key", ["init.rssm.gru.weight", "forward.deter", "plan1.mean"])
def test_a_changed_number_is_noticed(changed, key, change):
    assert not golden.check(changed(key, change)).passed()


def test_nan_among_the_last_weights_is_noticed(changed):
    with np.load(golden_path(FILES[1])) as archive:
        key = [name for name in archive.files if ".weights." in name][-1]
    assert golden.check(changed(key, _nan)).errors["weights"] == float("inf")


def test_a_wrong_shape_or_a_missing_weight_is_refused(changed):
    with pytest.raises(ValueError, match="shape"):
        golden.check(changed("forward.deter", lambda array: array[..., :-1]))
    case = golden.Case(golden_path(FILES[1]))
    case.data.pop("init.actor.out.bias")
    with pytest.raises(ValueError, match="actor"):
        case._load_weights()


def test_exit_status(changed, capsys):
    good, bad = golden_path(FILES[0]), changed("init.critic.out.bias", _nudge)
    assert golden.main([good]) == 0
    assert golden.main([bad, good]) == 1
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == ["ok", "FAIL", "ok"]
    assert golden.main([]) == 2
