"""The benchmarks run, at a size that says nothing about speed, and say what they measured, where, and against what."""

from __future__ import annotations

import importlib
import json
import math
import sys
from types import SimpleNamespace

import pytest
import torch as th
from places import ROOT

from sb3_dreamer_urlb import native
from sb3_dreamer_urlb.dreamer_v2.presets import PRESETS
from sb3_dreamer_urlb.envs import load_renderer
from sb3_dreamer_urlb.nn.dense import linear
from sb3_dreamer_urlb.planning.prepared.prepacked import PrepackedLinear

BENCHMARKS = ROOT / "benchmarks"
WHERE = {
    "device",
    "cores",
    "load",
    "threads",
    "clock",
    "python",
    "torch",
    "numpy",
    "stable-baselines3",
    "mujoco",
    "dm-control",
}


@pytest.fixture
def load(monkeypatch):
    """Import a benchmark."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module


@pytest.fixture
def run(load, monkeypatch, tmp_path, capsys):
    """Run a benchmark in this process: its table and its JSON object."""

    def run(name, *arguments):
        file = tmp_path / "result.json"
        product = load("common").Product
        monkeypatch.setattr(product, "SIZE", 64)
        monkeypatch.setattr(product, "TFLOP", 2 * 64**3 / 1e12)
        monkeypatch.setattr(sys, "argv", [name, "--quick", "--json", str(file), *map(str, arguments)])
        load(name).main()
        result = json.loads(file.read_text())
        assert result["benchmark"] == {"planner": "action"}.get(name, name)
        assert result.keys() >= WHERE
        return capsys.readouterr().out, result

    return run


def is_positive(numbers):
    return all(0 < number < math.inf for number in numbers)


@pytest.mark.parametrize("name", ["update", "planner", "planner_forms", "replay", "snapshot", "curves"])
def test_ratios_come_first(run, name, tmp_path):
    picture = tmp_path / "curves.png"
    table, result = run(name, "--precision", "float32", *(["--picture", picture] if name == "curves" else []))
    heading, *lines = table.splitlines()
    assert heading.startswith(result["benchmark"] + ": device ") and "threads" in heading
    ratios = result["ratios"]
    # At this size update has no floor: 2.4 TFLOP are the paper's.
    assert ratios.keys() <= result["seconds"].keys() and (ratios or name == "update")
    assert is_positive(ratios.values()) and all(is_positive(times) for times in result["seconds"].values())
    assert all(line.split()[1] == "×" for line in lines[: len(ratios)])
    if name == "curves":
        assert 1000 < picture.stat().st_size < 100_000


def test_update_has_its_floor_at_paper_size(run, load, monkeypatch):
    monkeypatch.setitem(PRESETS, "paper", PRESETS["tiny"])
    _, result = run("update", "--preset", "paper", "--precision", "float32", "--phases", "fine-tuning")
    measured, product = (min(result["seconds"][row]) for row in ("fine-tuning, float32", "product of 64³ in float32"))
    assert result["ratios"]["fine-tuning, float32"] == pytest.approx(measured / (product * 2.4 / (2 * 64**3 / 1e12)))


def test_every_store_is_measured_and_its_floor_moves_the_same_bytes(run, load):
    replay = load("replay")
    _, result = run("replay")
    for store in set(replay.STORES) - {"auto"}:
        assert f"sample, {store}" in result["ratios"] or any(note.startswith(f"{store} ") for note in result["notes"])
    assert {"sample, memory", "add, memory", "sample, lmdb", "add, lmdb"} <= result["ratios"].keys()
    rates, seconds = result["rates"]["sample, memory"], min(result["seconds"]["sample, memory"])
    assert rates["rows/s"] == pytest.approx(4 * 10 / seconds) and rates["batches/s"] == pytest.approx(1 / seconds)
    buffer = replay.SequenceReplayBuffer(
        100, replay.spaces.Box(0, 255, (3, 64, 64), "uint8"), replay.NoiseImages.action_space, "cpu", batch_length=10
    )
    replay.fill(buffer, replay.make_episode(30))()
    flat = replay.Flat(buffer.columns(), 100, th.device("cpu"))
    floor = sum(part.nbytes for part in flat.sample(4, 10))
    batch = buffer.sample(4)
    assert floor == sum(part.nbytes for part in (batch.observation, batch.action, batch.reward, batch.is_terminal))
    assert rates["MB/s"] * seconds * 1e6 == pytest.approx(floor)


def test_the_floor_of_adding_keeps_every_row(load):
    replay = load("replay")
    flat = replay.Flat({"reward": (th.float32, ())}, 4, th.device("cpu"))
    flat.add([{"reward": float(i)} for i in range(10, 16)])
    assert flat.columns["reward"].tolist() == [14, 15, 12, 13]


def test_points_of_a_curve_do_not_change_those_of_another(load):
    curves = load("curves")
    options = load("common").parser("").parse_args(["--quick", "--precision", "float32"])
    own = curves.Curves(options)
    samples = own.planner.policy.planner.config.n_samples
    own.work("planner samples", 2 * samples)()
    assert own.planner.policy.planner.config.n_samples == 2 * samples
    own.work("environments, planner", 2)()
    assert own.planner.policy.planner.config.n_samples == samples


def test_arithmetic_is_counted_whoever_computes_it(load, kernels_of_every_size):
    layer = th.nn.Linear(40, 50)

    def work():
        with native.using("native", "cpu"):
            return linear(th.ones(30, 40), layer.weight, layer.bias)

    prepacked = PrepackedLinear(layer.weight, layer.bias, th.float32)
    for its in (work, lambda: prepacked(th.ones(30, 40)), lambda: prepacked(th.ones(30, 40), th.ones(30, 50))):
        assert load("common").tflop(its) == 2 * 30 * 40 * 50 / 1e12


def test_the_floor_is_a_format_that_the_machine_multiplies(load, monkeypatch, capsys):
    common, device = load("common"), th.device("cpu")
    monkeypatch.setattr(common.Product, "SIZE", 64)
    for well, floor in ((True, "bfloat16"), (False, "float32")):
        monkeypatch.setattr(common, "multiplies_well", lambda dtype, device, well=well: well or dtype == th.float32)
        product = common.Product(th.bfloat16, device)
        assert product.name == f"product of 64³ in {floor}" and str(product().dtype) == f"torch.{floor}"
        assert common.parser("").parse_args([]).precision == ["float32", "bfloat16"][: 1 + well]


@pytest.mark.parametrize("has", [True, False])
def test_a_processor_is_asked_for_its_formats(load, monkeypatch, has):
    """And nothing is timed: what a busy machine takes says nothing about the processor."""
    common = load("common")
    monkeypatch.setattr(common, "cpu_multiplies_short", lambda: has)
    monkeypatch.setattr(common, "CLOCKS", {})
    formats = (th.float32, th.bfloat16, th.float16)
    assert [common.multiplies_well(dtype, th.device("cpu")) for dtype in formats] == [True, has, False]


def test_methods(run, load, monkeypatch):
    monkeypatch.setattr(load("methods"), "registered_intrinsic_rewards", lambda: dict.fromkeys(("icm", "lbs")))
    _, result = run("methods", "--precision", "float32")
    assert list(result["seconds"]) == ["lbs", "icm"] and all(is_positive(times) for times in result["seconds"].values())


def test_drq_v2(run):
    table, result = run("drq_v2", "--precision", "float32", "--phases", "task", "pre-training")
    assert table.startswith("drq_v2: device ")
    assert set(result["seconds"]) == {"task, float32", "pre-training, float32", "sampling"}
    assert all(is_positive(times) for times in result["seconds"].values())


def test_collect_compares_with_dm_control_alone_and_names_what_cannot_draw(run, load, tmp_path):
    picture = tmp_path / "collect.png"
    backend, kinds = load_renderer(), load("collect").KINDS[::2]  # SB3's own processes take long to start
    table, result = run("collect", "--backends", backend, "no-such", "--picture", picture, "--kinds", *kinds)
    rows = {f"walker, {backend}, 1 in {kind}" for kind in kinds}
    assert result["ratios"].keys() == rows and is_positive(result["ratios"].values())
    assert is_positive(rate["frames/s"] for rate in result["rates"].values())
    assert len(result["notes"]) == 1 and result["notes"][0].startswith("no-such cannot draw here: ")
    assert result["notes"][0] in table
    assert 1000 < picture.stat().st_size < 100_000


def test_a_window_spreads_the_reset_over_the_episode(load, monkeypatch):
    collect = load("collect")
    now = [0.0]
    monkeypatch.setattr(collect, "time", SimpleNamespace(perf_counter=lambda: now[0]))

    class Loop:
        num_envs, steps = 2, 0

        def reset(self):
            now[0] += 3

        def step(self):
            # The first one after a reset does not count.
            now[0] += 0.1 if self.steps else 7
            self.steps += 1

    loop = Loop()
    # 100 steps of two environments, two frames each.
    assert collect.measure(loop, 0.55, 100) == pytest.approx((3 + 100 * 0.1) / 400)
    assert loop.steps == 7


def test_end_to_end(run):
    table, result = run("end_to_end")
    phases = result["phases"]
    assert list(phases) == ["pre-training, walker, auto", "fine-tuning, walker, auto"]
    for row, phase in phases.items():
        assert f"{row}: " in table and is_positive([phase["ratio"], phase["frames/s"], phase["projected hours"]])
        assert sum(phase["shares"].values()) == pytest.approx(1)
        assert all(phase["shares"][part] > 0 for part in ("environment", "acting", "replay add", "replay sample", "update"))
        assert 0.1 < phase["GB before the first update"] <= phase["peak GB"] < phase["peak GB with a full replay"] < 10
    plans = [phase["shares"]["planning"] > 0 for phase in phases.values()]
    assert plans == [False, True]


def test_projection(load):
    end_to_end = load("end_to_end")
    window = {"environment": 5.0, "acting": 0.5, "planning": 10.0, "update": 2.0, "replay sample": 0.5, "replay add": 0.0}
    found = {
        "windows": [dict.fromkeys(window, 9.0), window],
        "floors": {"environment": [0.5, 0.4], "float32": [1.0], "bfloat16": [0.5]},
        "tflop": {"update": 0.5 * end_to_end.Product.TFLOP, "planning": end_to_end.Product.TFLOP},
        "reset": 3.0,
        "memory": {"before": 1e9, "peak": 2e9, "row": 1e4},
        "steps": 5,
        "products": {"update": "float32", "planning": "bfloat16"},
        "own": {"learning_starts": 2000, "planner_delay": 500, "buffer_size": 1000, "train_freq": 5},
    }
    result = end_to_end.summary("fine-tuning", found, 500)
    steps, updates, planned = 50_000, 9_600, 47_500
    seconds = steps * (1 + 0.1 + 3 / 500) + updates * 2.5 + planned * 2
    assert result["projected hours"] == pytest.approx(seconds / 3600)
    assert result["frames/s"] == pytest.approx(2 / (18 / 5)) and result["shares"]["planning"] == pytest.approx(10 / 18)
    assert result["ratios"] == pytest.approx({"environment": 1 / 0.4, "update": 0.4 / 0.1, "planning": 2 / 0.5})
    assert result["ratio"] == pytest.approx(3.6 / (0.4 + 0.1 + 0.5))
    assert result["peak GB with a full replay"] == pytest.approx(2 + 1000 * 1e4 / 1e9)
    # No planner while exploring.
    exploring = end_to_end.summary("pre-training", found, 500)["projected hours"]
    assert exploring == pytest.approx((1_000_000 * (1.1 + 3 / 500) + 199_600 * 2.5) / 3600)


def test_nested_parts_count_once(load, monkeypatch):
    stopwatch = load("stopwatch")
    now = [0.0]
    monkeypatch.setitem(stopwatch.CLOCKS, "test", lambda: now[0])
    watch = stopwatch.Stopwatch("test", th.device("cpu"))

    class Work:
        def inner(self):
            now[0] += 1

        def outer(self):
            now[0] += 2
            self.inner()
            now[0] += 4

    work = Work()
    watch.watch(work, "inner", "in")
    watch.watch(work, "outer", lambda: "out")
    work.outer()  # before the start: counts nowhere
    watch.start()
    work.outer()
    now[0] += 8
    assert watch.stop() == {"in": 1, "out": 6, stopwatch.OTHER: 8}
    work.outer()
    assert not watch.running and sum(watch.seconds.values()) == 15


def test_json_without_a_file_replaces_the_table(load, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["planner", "--quick", "--json", "--precision", "float32"])
    load("planner").main()
    assert json.loads(capsys.readouterr().out)["threads"] == th.get_num_threads()


def test_states(run, load):
    table, result = run("states")
    assert table.startswith("states: device ")
    assert list(result["seconds"]) == ["walker, pixels", "walker, state", "update, tiny", "action, tiny"]
    assert result["ratios"].keys() == {"walker, pixels"} and is_positive(result["ratios"].values())
    taken = result["fine_tuning"]["tiny"]
    assert taken["steps"] == 20 and is_positive(taken.values())
    assert result["notes"][1].startswith("tiny: 20 agent steps of it took") and result["notes"][0].endswith("(projected)")
    # S · (step + action) + U · update, of what the preset does in 50 000 agent steps
    model = load("states").DreamerV2("MlpPolicy", "Pendulum-v1", preset="tiny", device="cpu")
    step, act, update = (min(result["seconds"][row]) for row in ("walker, state", "action, tiny", "update, tiny"))
    updates = (50_000 - model.learning_starts) // model.train_freq.frequency
    assert taken["projected seconds"] == pytest.approx(50_000 * (step + act) + updates * update, rel=1e-3)


def test_settings_from_states(load, monkeypatch, tmp_path, capsys):
    """Runs that are missing are done once and kept; the table says what each scored at the end."""
    script = load("state_settings")
    monkeypatch.setattr(script, "FILE", tmp_path / "rows.csv")
    monkeypatch.setattr(script, "LAST", 1)
    monkeypatch.setattr(script, "SETTINGS", {"mine": ("tiny", {"train_freq": 50}), "other": ("tiny", {})})
    for _ in range(2):
        for settings in (["mine"], [script.RANDOM]):
            options = ["--steps", "1000", "--tasks", "walk", "--settings", *settings]
            monkeypatch.setattr(sys, "argv", ["state_settings", "run", *options])
            script.main()
    assert [row.setting for row in script.read()] == ["mine", script.RANDOM] and len(capsys.readouterr().out.splitlines()) == 2
    assert all(len(row.returns) == 2 and row.steps == 1000 and row.seconds > 0 for row in script.read())
    monkeypatch.setattr(sys, "argv", ["state_settings", "table"])
    script.main()
    line = capsys.readouterr().out.splitlines()[2]
    assert line.startswith(f"| mine | 1000 | {script.read()[0].returns[-1]:.0f} |  | ")
