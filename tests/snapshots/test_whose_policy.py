"""A policy's file that is read with another class of the same algorithm."""

from __future__ import annotations

import pytest
from fake_envs import CounterEnv
from gymnasium import spaces

from sb3_dreamer_urlb import DreamerV2, DrQv2, SnapshotError
from sb3_dreamer_urlb.dreamer_v2 import policies as dreamer
from sb3_dreamer_urlb.drq_v2 import policies as drq

VECTOR = spaces.Box(-1, 1, (3,), float)
OBSERVATIONS = {
    "CnnPolicy": None,
    "MlpPolicy": VECTOR,
    "MultiInputPolicy": spaces.Dict({"a": VECTOR, "b": VECTOR}),
}


@pytest.mark.parametrize(("algorithm", "module"), [(DreamerV2, dreamer), (DrQv2, drq)])
@pytest.mark.parametrize("name", OBSERVATIONS)
def test_the_class_that_reads_it_is_named(tmp_path, algorithm, module, name):
    names = [other for other in OBSERVATIONS if hasattr(module, other)]
    if name not in names:
        pytest.skip("DrQv2 has no policy for several observations")
    space = OBSERVATIONS[name]
    env = CounterEnv() if space is None else CounterEnv(observation_space=space)
    algorithm(name, env, preset="tiny", device="cpu").policy.save(tmp_path / "policy")
    own = getattr(module, name)
    assert type(own.load(tmp_path / "policy", device="cpu")) is own
    for other in set(names) - {name}:
        reader = rf"it is one of {module.__name__}\.{own.__qualname__}, whose load\(\) reads it"
        with pytest.raises(SnapshotError, match=reader):
            getattr(module, other).load(tmp_path / "policy", device="cpu")
