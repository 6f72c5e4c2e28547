"""The page of a run and the comparison of runs: parsed always, opened in headless Chromium where it is installed."""

from __future__ import annotations

import csv
import os
import re
import shutil
import subprocess
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fake_envs import CounterEnv
from snapshot_files import change_data
from stable_baselines3.common.callbacks import EvalCallback
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor

from sb3_dreamer_urlb import DreamerV2, EvaluationCallback, PhaseSwitchCallback, RunCheckpointCallback
from sb3_dreamer_urlb.__main__ import main
from sb3_dreamer_urlb.cli.compare import _groups, compare_runs
from sb3_dreamer_urlb.evaluation.append import append_rows
from sb3_dreamer_urlb.evaluation.gifs import encode_gif
from sb3_dreamer_urlb.evaluation.run_facts import read_run, thinned
from sb3_dreamer_urlb.evaluation.run_logs import read_logs
from sb3_dreamer_urlb.evaluation.run_page import _summary

SECTIONS = ("summary", "warnings", "evaluation", "films", "curves", "repeat", "configuration", "environment", "versions")
WALKER = {"domain": "walker", "task": "run", "action_repeat": 2}


class Page(HTMLParser):
    """What a test asks of a page."""

    def __init__(self, text: str):
        super().__init__()
        self.ids: list[str] = []
        self.addresses: list[str] = []
        self.open: list[str] = []
        self.text = ""
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        self.ids += [values["id"]] if tag == "section" and values.get("id") else []
        self.addresses += [
            values[name] or "" for name in ("src", "href") if name in values and tag in ("img", "link", "script", "a")
        ]
        if tag in ("section", "table", "figure", "svg", "div", "body"):
            self.open.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if tag in ("section", "table", "figure", "svg", "div", "body"):
            assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        self.text += data


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a real, tiny run with both phases, logs, rows and films."""
    folder = tmp_path_factory.mktemp("runs") / "tiny"
    model = DreamerV2("CnnPolicy", CounterEnv(20, **WALKER), preset="tiny", seed=0, device="cpu", intrinsic_reward="lbs")
    model.set_logger(configure(str(folder), ["csv"]))
    evaluation = EvaluationCallback(CounterEnv(20, **WALKER), 40, 1, folder / "rows.csv")
    callbacks = [PhaseSwitchCallback(120), RunCheckpointCallback(folder), evaluation]
    model.learn(160, callback=callbacks, log_interval=1)
    frames = np.random.default_rng(0).integers(0, 256, (3, 8, 24, 3), np.uint8)
    for name in ("agent.gif", "open_loop_7.gif"):
        (folder / name).write_bytes(encode_gif(frames, 10))
    return folder


def test_the_page_has_all_its_parts_and_needs_no_network(run: Path) -> None:
    assert main(["report", str(run), "--command", "make <demo>"]) == 0
    text = (run / "report.html").read_text()
    page = Page(text)
    assert page.ids == list(SECTIONS) and not page.open
    assert len(page.addresses) == 2 and all(address.startswith("data:image/gif;base64,") for address in page.addresses)
    assert "http://" not in text.replace("http://www.w3.org", "") and "https://" not in text
    assert 'name="viewport"' in text and "viewBox" in text
    for part in (
        "lbs",
        "walker-run",
        "make <demo>",
        "fine-tuning",
        "train/kl",
        "rollout/ep_rew_mean",
        "batch_length",
        "724",
        "596",
    ):
        assert part in page.text, part
    assert "None: no update was skipped" in page.text
    facts = dict(_summary(read_run(run)))
    assert int(facts["Updates"]) > 0 and facts["Pre-training"] == "120 frames" and facts["Fine-tuning"] != "0 frames"


def test_the_switch_of_phases_is_known(run: Path) -> None:
    facts = read_run(run)
    assert facts.switch == facts.counters["pretrained_frames"] / 2 and 60 <= facts.switch <= 80
    facts.data = {}
    assert facts.switch is not None


def test_a_run_that_begins_with_a_snapshot_has_no_switch(tiny_model: Any, tmp_path: Path) -> None:
    """The pre-training was another run; the file of Stable-Baselines3's Monitor is no file of evaluations."""
    model = tiny_model(CounterEnv(20, **WALKER), intrinsic_reward="lbs").learn(40)
    model.fine_tune(keep_actor=False)
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(40, log_interval=1)
    model.save(tmp_path / "finetuned.zip")
    (tmp_path / "0.monitor.csv").write_text('#{"t_start": 0.0, "env_id": "None"}\nr,l,t\n1.0,20,0.1\n')
    facts = read_run(tmp_path)
    assert (facts.counters["pretrained_frames"], facts.counters["num_timesteps"], facts.switch) == (80, 40, None)
    assert facts.warnings() == []
    assert main(["report", str(tmp_path)]) == 0
    text = Page((tmp_path / "report.html").read_text()).text
    assert "model.fine_tune(keep_actor=False, keep_critic=False, keep_reward=False)" in text
    assert "a pre-training of 80 frames" in text and "PhaseSwitchCallback" not in text


def test_warnings_stand_on_the_page(run: Path, tmp_path: Path) -> None:
    facts = read_run(run)
    facts.data["counters"] = {**facts.counters, "skipped_updates": 3, "env_faults": 2}
    facts.series["train/kl"] = [(0, 1.0), (1, float("nan"))]
    assert [line.split(":")[0].split(" ")[0] for line in facts.warnings()] == ["3", "2", "Logged"]
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    (copy / "snapshot.zip").write_bytes(b"broken")
    (copy / "rows.csv").write_text((copy / "rows.csv").read_text() + "lbs,wal\n")
    assert main(["report", str(copy)]) == 0
    text = Page((copy / "report.html").read_text()).text
    assert "snapshot.zip" in text and "1 row skipped" in text


@pytest.mark.skipif(shutil.which("chromium") is None, reason="the same page is parsed above; this opens it, too")
def test_chromium_opens_the_page(run: Path, tmp_path: Path) -> None:
    main(["report", str(run)])
    flags = ["--headless", "--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]
    flags += ["--disable-component-update", "--disable-sync", f"--user-data-dir={tmp_path / 'profile'}"]
    address = (run / "report.html").resolve().as_uri()
    seen = subprocess.run(
        ["chromium", *flags, "--dump-dom", address], capture_output=True, text=True, timeout=200, check=True,
        env={**os.environ, "HOME": str(tmp_path)},
    )  # fmt: skip
    assert all(f'id="{name}"' in seen.stdout for name in SECTIONS)
    picture = tmp_path / "page.png"
    subprocess.run(
        ["chromium", *flags, "--window-size=390,844", f"--screenshot={picture}", address], capture_output=True, timeout=200,
        check=True, env={**os.environ, "HOME": str(tmp_path)},
    )  # fmt: skip
    assert picture.stat().st_size > 10_000


def test_runs_side_by_side(run: Path, tmp_path: Path, capsys: Any) -> None:
    other = tmp_path / "other"
    shutil.copytree(run, other)
    out = tmp_path / "compare.html"
    assert main(["compare", f"two seeds={run},{other}", str(run), "--out", str(out)]) == 0
    page = Page(out.read_text())
    assert page.ids == ["curves", "returns", "groups"] and page.addresses[0].startswith("data:image/png;base64,")
    assert "two seeds" in page.text and "the same settings" in page.text
    assert (tmp_path / "compare.pdf").stat().st_size > 3000
    assert "two seeds" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("folders", "labels"),
    [
        (["lbs/seed0", "icm/seed0"], ["lbs/seed0", "icm/seed0"]),
        (["lbs/seed0", "icm/seed1"], ["seed0", "seed1"]),
        (["seed0=lbs/seed1", "icm/seed0"], ["seed0", "icm/seed0"]),
        (["a/b/run", "c/b/run", "run=lbs/seed0"], ["a/b/run", "c/b/run", "run"]),
        (["lr=0.1,x/run"], ["run"]),
        (["two=lbs/seed0,lbs/seed1", "two=icm/seed0"], ["two"]),
    ],
)
def test_folders_are_groups_of_their_own(
    folders: list[str], labels: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    for folder in ("lbs/seed0", "icm/seed0", "icm/seed1", "a/b/run", "c/b/run", "lr=0.1,x/run"):
        (tmp_path / folder).mkdir(parents=True)
    groups = _groups(folders)
    assert list(groups) == labels
    assert sum(map(len, groups.values())) == sum(1 + text.count(",") * ("=" in text[:5]) for text in folders) - (
        1 if folders == ["lr=0.1,x/run"] else 0
    )


def test_who_averages_what_is_no_seed_of_one_setting_is_told(run: Path, tmp_path: Path, capsys: Any) -> None:
    other = tmp_path / "other"
    shutil.copytree(run, other)
    assert main(["compare", f"both={run},{other}", "--out", str(tmp_path / "c.html")]) == 0
    assert "These are averaged: both: seed 0 more than once" in capsys.readouterr().err
    change_data(other / "snapshot.zip", other / "snapshot.zip", lambda data: data["arguments"].update(batch_size=77, seed=1))
    assert main(["compare", f"both={run},{other}", "--out", str(tmp_path / "c.html")]) == 0
    assert re.search(r"These are averaged: both: batch_size=\d+ / 77\n", capsys.readouterr().err)
    assert main(["compare", str(run), str(other), "--out", str(tmp_path / "c.html")]) == 0
    assert "averaged" not in capsys.readouterr().err


@pytest.mark.parametrize(
    ("command", "message"),
    [
        (["compare", "a,b", "--out", "page.html"], "several runs are a group, which needs a label"),
        (["compare", "here", "there/../here", "--out", "page.html"], "there/../here: given more than once"),
        (["report", "nowhere"], "nowhere is no folder of a run"),
        (["report", "."], "holds neither a snapshot nor logs"),
        (["compare", "nowhere", "--out", "page.html"], "nowhere is no folder of a run"),
    ],
)
def test_bad_input(command: list[str], message: str, tmp_path: Path, capsys: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(command) == 2
    assert message in capsys.readouterr().err


def test_a_folder_of_runs_is_no_run(run: Path, tmp_path: Path, capsys: Any) -> None:
    for name in ("one", "two"):
        shutil.copytree(run, tmp_path / name)
    assert main(["report", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "holds several runs" in said and "one" in said and "two" in said
    # A run's own log counts, whatever lies below it; so do the folders that a logger numbers.
    shutil.copy(run / "progress.csv", tmp_path)
    assert len(read_run(tmp_path).series["train/kl"]) == len(read_run(run).series["train/kl"])
    both, [head, *lines] = tmp_path / "both", (run / "progress.csv").read_text().splitlines(keepends=True)
    for number, part in ((1, lines[:3]), (2, lines[3:])):
        (both / f"DreamerV2_{number}").mkdir(parents=True)
        (both / f"DreamerV2_{number}" / "progress.csv").write_text("".join([head, *part]))
    assert read_run(both).series["train/kl"] == read_run(run).series["train/kl"]


def test_a_run_without_a_readable_snapshot(run: Path, tmp_path: Path) -> None:
    """How many frames a step has is read from the log, or said to be unknown; the damage is named once."""
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    (copy / "snapshot.zip").write_bytes(b"broken")
    facts = read_run(copy)
    assert facts.action_repeat == 2 and sum("snapshot.zip" in note for note in facts.notes) == 1
    with open(copy / "progress.csv", newline="") as file:
        lines = [{name: text for name, text in line.items() if name != "time/phase_frames"} for line in csv.DictReader(file)]
    with open(copy / "progress.csv", "w", newline="") as file:
        writer = csv.DictWriter(file, lines[0])
        writer.writeheader()
        writer.writerows(lines)
    assert read_run(copy).action_repeat is None
    assert main(["report", str(copy)]) == 0
    text = Page((copy / "report.html").read_text()).text
    assert "is unknown" in text and "no update was skipped" not in text and "Unknown: no snapshot" in text
    assert "agent steps" in text and "environment frames" not in text.replace("no environment", "") and "unknown" in text
    with pytest.raises(ValueError, match="cannot stand over the same frames"):
        compare_runs({"a": [run], "b": [copy]}, tmp_path / "page.html")


def test_rows_of_other_runs_are_not_shown_as_this_one_s(run: Path, tmp_path: Path) -> None:
    [row] = [row for row in read_run(run).rows if row.finetune_frames][:1]
    others = [
        replace(row, seed=row.seed + 1), replace(row, method="icm"), replace(row, domain="jaco"), replace(row, preset="paper"),
        replace(row, pretrain_frames=1), replace(row, finetune_frames=10**6), replace(row, keep_actor=not row.keep_actor),
    ]  # fmt: skip
    append_rows(tmp_path / "rows.csv", others)
    facts = read_run(run, [tmp_path / "rows.csv"])
    assert [one.key for one in facts.rows] == [one.key for one in read_run(run).rows] and facts.rows
    assert any("7 rows are about other runs" in note for note in facts.notes)
    # Without a snapshot nobody knows: the page shows whose they are.
    (tmp_path / "progress.csv").write_bytes((run / "progress.csv").read_bytes())
    assert main(["report", str(tmp_path)]) == 0
    text = Page((tmp_path / "report.html").read_text()).text
    assert "Method, seed" in text and "other runs' maybe among them" in text and "icm, 0" in text


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("monitor.csv", bytes(range(256)), "monitor.csv is damaged: it is no log"),
        ("0.monitor.csv", b'#{"t_start": 0}\nr,l,t\n1,2,3\n1,x,3\n', "0.monitor.csv is damaged: 1 line"),
        ("progress.csv", b'a,b\n1,x\n"2\n', "progress.csv is damaged: 2 lines"),
        ("progress.csv", b"", "progress.csv is damaged: it is empty"),
        ("progress.csv", b"time/total_timesteps,b\n1,\0\n2,3,4\n", "progress.csv is damaged: 1 line"),
        ("snapshot.vec_normalize.json", b"{", "snapshot.vec_normalize.json is damaged"),
        ("snapshot.vec_normalize.json", b"[]", "snapshot.vec_normalize.json is damaged"),
    ],
)
def test_damaged_files_are_named(run: Path, tmp_path: Path, name: str, content: bytes, said: str) -> None:
    copy = tmp_path / "copy"
    shutil.copytree(run, copy)
    (copy / name).write_bytes(content)
    assert any(said in note for note in read_run(copy).warnings())
    assert read_run(run).warnings() == []


def test_labels_are_no_formulas(run: Path, tmp_path: Path) -> None:
    assert main(["compare", f"ü$_$={run}", "--out", str(tmp_path / "page.html")]) == 0


def test_runs_that_share_no_log(run: Path, tmp_path: Path, capsys: Any) -> None:
    assert main(["compare", str(run), "--tag", "train/none", "--out", str(tmp_path / "page.html")]) == 2
    assert "Not all runs have a log of train/none" in capsys.readouterr().err


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder as rl_zoo3 has it, a log of Stable-Baselines3's logger beside."""
    folder = tmp_path_factory.mktemp("logs") / "walker_1"
    env = Monitor(CounterEnv(7, **WALKER), str(folder / "0"))
    model = DreamerV2("CnnPolicy", env, preset="tiny", seed=0, device="cpu", stats_window_size=3)
    model.set_logger(configure(str(folder), ["csv"]))
    evaluation = EvalCallback(
        Monitor(CounterEnv(9, **WALKER)), eval_freq=20, n_eval_episodes=1, log_path=str(folder), verbose=0
    )
    model.learn(160, callback=evaluation, log_interval=1)
    for name in ("old.zip", "walker.zip"):
        model.save(folder / name)
    (folder / "walker").mkdir()
    (folder / "walker" / "command.txt").write_text("/home/of/somebody/python -m rl_zoo3.train --algo dreamerv2")
    return folder


def test_what_monitor_and_evaluations_keep_is_what_the_logger_had(kept: Path, tmp_path: Path) -> None:
    logged = read_run(kept).series
    shutil.copytree(kept, tmp_path / "run", ignore=shutil.ignore_patterns("progress.csv"))
    facts = read_run(tmp_path / "run")
    assert set(facts.series) == {"rollout/ep_rew_mean", "eval/mean_reward"}
    for tag, points in facts.series.items():
        theirs = dict(logged[tag])
        assert len(points) >= 8 and dict(points) == pytest.approx({step: theirs[step] for step, _ in points}, rel=1e-5)
    assert facts.command == "python -m rl_zoo3.train --algo dreamerv2"
    assert any("Of 2 models in the folder the newest is shown, walker.zip" in note for note in facts.notes)
    assert main(["report", str(tmp_path / "run")]) == 0
    page = (tmp_path / "run" / "report.html").read_text()
    assert page.count("<svg") == 2 and "rl_zoo3.train" in page and "/home/of" not in page


def test_a_pre_training_elsewhere_comes_before_its_fine_tuning(tmp_path: Path) -> None:
    for folder, begin, lengths in ((tmp_path / "pretraining", 100.0, (50, 50)), (tmp_path, 200.0, (40, 10))):
        folder.mkdir(exist_ok=True)
        lines = [f"{length / 10},{length},{second}.5" for second, length in enumerate(lengths)]
        (folder / "0.monitor.csv").write_text("\n".join([f'#{{"t_start": {begin}}}', "r,l,t", *lines, "broken,,"]))
    found = read_logs(tmp_path, switch=120, window=100).series["rollout/ep_rew_mean"]
    assert found == [(50, 5), (100, 5), (160, 4), (170, 2.5)]


def test_one_line_of_a_log_is_a_point(tmp_path: Path) -> None:
    (tmp_path / "progress.csv").write_text("time/total_timesteps,rollout/ep_rew_mean\n100,3.5\n")
    assert main(["report", str(tmp_path)]) == 0
    assert (tmp_path / "report.html").read_text().count("<svg") == 1


def test_unknown_tags_are_answered_with_those_there_are(run: Path, tmp_path: Path, capsys: Any) -> None:
    assert main(["compare", str(run), "--tag", "train/imageloss", "--out", str(tmp_path / "c.html")]) != 0
    said = capsys.readouterr().err
    assert "rollout/ep_rew_mean" in said and "Did you mean 'train/image_loss' or" in said


def test_groups_are_compared_where_all_have_come_to(tmp_path: Path) -> None:
    for name, values in {"short": {100: 1, 200: 3}, "long": {50: 0, 150: 10, 250: 20, 900: 70}, "late": {901: 5}}.items():
        (tmp_path / name).mkdir()
        lines = ["time/total_timesteps,rollout/ep_rew_mean", *(f"{step},{value}" for step, value in values.items())]
        (tmp_path / name / "progress.csv").write_text("\n".join(lines))
    paths = {name: [tmp_path / name] for name in ("short", "long", "late")}
    table, _ = compare_runs({name: paths[name] for name in ("short", "long")}, tmp_path / "c.html")
    assert [line[1:3] for line in table.lines] == [["3.0", "200"], ["15.0", "200"]] and "at 200 agent steps" in table.caption
    table, _ = compare_runs({name: paths[name] for name in ("long", "late")}, tmp_path / "c.html")
    assert [line[1:3] for line in table.lines] == [["70.0", "900"], ["5.0", "901"]] and "no frames are common" in table.caption


@pytest.mark.parametrize("content", [b"", b"PK\3\4 broken", b"no zip"])
def test_damaged_evaluations_are_named(run: Path, tmp_path: Path, content: bytes) -> None:
    shutil.copytree(run, tmp_path / "run", ignore=shutil.ignore_patterns("progress.csv"))
    (tmp_path / "run" / "evaluations.npz").write_bytes(content)
    assert any("evaluations.npz is damaged" in note for note in read_run(tmp_path / "run").warnings())


def test_long_lines_are_thinned() -> None:
    points = [(float(i), float(i)) for i in range(5000)]
    assert len(thinned(points)) == 400 and thinned(points)[0] == points[0] and thinned(points)[-1] == points[-1]


def test_the_last_checkpoint_comes_before_the_best_model_and_rows_count_once(run: Path, tmp_path: Path) -> None:
    """A run of rl_zoo3's has the first in a folder of its own; ``evaluate`` plays that one, too."""
    (tmp_path / "checkpoint").mkdir()
    for name in ("best_model.zip", "checkpoint/snapshot.zip"):
        (tmp_path / name).write_bytes((run / "snapshot.zip").read_bytes())
    (tmp_path / "rows.csv").write_bytes((run / "rows.csv").read_bytes())
    once = read_run(tmp_path)
    assert once.snapshot == tmp_path / "checkpoint/snapshot.zip" and once.rows
    twice = read_run(tmp_path, [tmp_path / "checkpoint/../rows.csv"])
    assert [row.key for row in twice.rows] == [row.key for row in once.rows]


def test_logs_are_read_in_the_order_of_steps(tmp_path: Path) -> None:
    parts = {"log_1": [100, 200, 300, 400], "log_2": [300, 400, 500], "log_10": [600, 500, 700]}
    for name, steps in parts.items():
        (tmp_path / name).mkdir()
        lines = ["time/total_timesteps,rollout/ep_rew_mean", *(f"{step},{step + len(name)}" for step in steps)]
        (tmp_path / name / "progress.csv").write_text("\n".join(lines) + "\n")
    # Where a run went through some steps again, what came later counts.
    late = {**dict.fromkeys((100, 200), 5), **dict.fromkeys((300, 400), 5), **dict.fromkeys((500, 600, 700), 6)}
    expected = [(float(step), float(step + extra)) for step, extra in late.items()]
    assert read_logs(tmp_path, None, 100).series["rollout/ep_rew_mean"] == expected


def test_why_nothing_can_be_read_is_told(tmp_path: Path, capsys: Any) -> None:
    (tmp_path / "snapshot.zip").write_bytes(b"broken")
    assert main(["report", str(tmp_path)]) == 2
    assert "snapshot.zip" in (said := capsys.readouterr().err) and "is refused" in said
