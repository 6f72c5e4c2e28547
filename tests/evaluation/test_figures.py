"""Tables and figures from rows: what is drawn, what is left a gap, and what the command says."""

from __future__ import annotations

import csv
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from made_up_rows import made_up_rows
from PIL import Image

from sb3_dreamer_urlb.__main__ import main
from sb3_dreamer_urlb.evaluation import paper_figures, paper_tables
from sb3_dreamer_urlb.evaluation.aggregate import Estimate
from sb3_dreamer_urlb.evaluation.append import append_rows
from sb3_dreamer_urlb.evaluation.arms import Study
from sb3_dreamer_urlb.evaluation.curves import curve, learning_curves, selected
from sb3_dreamer_urlb.evaluation.rows import Row
from sb3_dreamer_urlb.evaluation.scatter import correlation
from sb3_dreamer_urlb.evaluation.scores import published_returns
from sb3_dreamer_urlb.evaluation.style import bars, frames_label, new_figure
from sb3_dreamer_urlb.evaluation.tables import Table

ROW = Row("lbs", "walker", "run", 0, 2_000_000, 100_000, True, False, "dyna_mpc", "paper", 596.0, 17.0, 10)


@pytest.fixture(scope="module")
def rows() -> list[Row]:
    return made_up_rows(2, ("lbs", "plan2explore", "random"))


def paper_s_rows() -> list[Row]:
    """LBS with task-aware fine-tuning and Dyna-MPC, as published, as if it were one seed."""
    tasks = {name: name.split("-") for name in published_returns("ours")}
    return [
        replace(ROW, domain=domain, task=task, keep_actor=domain != "jaco", return_mean=published_returns("ours")[name].mean)
        for name, (domain, task) in tasks.items()
    ]


def words(picture: Any) -> list[str]:
    return [text.get_text() for axes in picture.figure.axes for text in axes.texts]


def test_the_command_writes_the_paper_s_score(tmp_path: Path, capsys: Any) -> None:
    append_rows(tmp_path / "rows.csv", paper_s_rows())
    assert main(["figures", str(tmp_path / "rows.csv"), "--out", str(tmp_path / "out"), "--repetitions", "10"]) == 0
    out = capsys.readouterr().out
    line = next(line for line in out.splitlines() if line.startswith("LBS + Dyna-MPC"))
    assert "93.5" in line and "12 of 12" in line and "93.6 ± 0.8" in line
    with open(tmp_path / "out" / "summary.csv", newline="") as file:
        [written] = csv.DictReader(file)
    assert (
        written["overall"] == "93.5"
        and written["walker"] == f"{100 * (938 / 778 + 596 / 724 + 973 / 909 + 959 / 965) / 4:.1f}"
    )
    assert "93.5" in (tmp_path / "out" / "summary.md").read_text()
    tex = (tmp_path / "out" / "summary.tex").read_text()
    assert r"\toprule" in tex and r"1 seed" not in tex and r"\%" in tex and "±" not in tex
    for suffix in ("pdf", "png"):
        assert (tmp_path / "out" / f"benchmark.{suffix}").stat().st_size > 5000
    assert (tmp_path / "out" / "benchmark.pdf").read_bytes().startswith(b"%PDF")
    with Image.open(tmp_path / "out" / "benchmark.png") as picture:
        assert picture.width > 1000
    assert "1 seed a task" in (tmp_path / "out" / "captions.md").read_text()
    assert "No rows for: correlation, snapshots_by_category" in out


def test_every_figure_is_drawn_with_units_seeds_and_a_mark(rows: list[Row]) -> None:
    study = Study(rows)
    for draw in paper_figures.FIGURES:
        picture = paper_figures.profiles(study, 5) if draw is paper_figures.profiles else draw(study)
        assert picture is not None, draw.__name__
        assert "SYNTHETIC\nROWS" in words(picture)
        assert "seed" in picture.caption or "points" in picture.caption
        assert "%" in picture.caption or "nats" in picture.caption or "return" in picture.caption


def test_without_rows_nothing_is_drawn() -> None:
    study = Study([replace(ROW, pretrain_frames=0, method="drqv2", keep_actor=None, keep_critic=None, planner="none")])
    drawn = {draw.__name__ for draw in paper_figures.FIGURES if draw(study) is not None}
    assert drawn == {"benchmark", "profiles"}
    assert paper_tables.reward_correlation(study) is None


def test_missing_runs_are_labelled_gaps() -> None:
    _, [axes] = new_figure(1)
    series = {
        "a": [Estimate(0.5, 0.4, 0.6, 4, (3, 3)), Estimate(math.nan)],
        "b": [Estimate(0.2, tasks=3), Estimate(0.3, tasks=4)],
    }
    bars(axes, ["x", "y"], series, [4, 4])
    assert sorted(text.get_text().strip() for text in axes.texts) == ["3 of 4 tasks", "no runs"]
    # As many bars as there are numbers.
    assert sorted(round(bar.get_height(), 6) for bar in axes.patches) == [20, 30, 50]


@pytest.mark.parametrize("high", [0.05, 0.5, 1.0])
def test_words_stand_above_the_error_bar_and_below_the_edge(high: float) -> None:
    figure, [axes] = new_figure(1)
    bars(axes, ["x"], {"a": [Estimate(high / 2, 0, high, 3, (3, 3))], "b": [Estimate(0.7, 0.6, 0.8, 4, (3, 3))]}, [4])
    figure.canvas.draw()
    [words] = [text for text in axes.texts if "of" in text.get_text()]
    box, edge = words.get_window_extent(), axes.get_window_extent()
    assert box.y0 > axes.transData.transform((0, 100 * high))[1] and box.y1 <= edge.y1 + 1


def test_lines_are_broken_where_a_snapshot_is_missing(rows: list[Row]) -> None:
    some = [row for row in rows if (row.method, row.pretrain_frames) != ("lbs", 500_000)]
    picture = paper_figures.snapshots_by_method(Study(some))
    assert picture is not None
    [line] = [line for line in picture.figure.axes[0].lines if line.get_label() == "LBS"]
    assert [math.isnan(y) for y in line.get_ydata()] == [False, True, False, False]


def test_unfinished_runs_are_left_out() -> None:
    study = Study([*paper_s_rows(), replace(ROW, seed=1, finetune_frames=50_000, return_mean=1.0)])
    assert [row.seed for row in study.unfinished] == [1]
    assert paper_tables.summary(study, 0).lines[0][5:] == ["93.5", "12 of 12", "1", "93.6 ± 0.8"]


def test_task_aware_rows_are_told_from_others() -> None:
    jaco = {"domain": "jaco", "task": "reach_top_left", "planner": "none"}
    kept, dropped = (replace(ROW, **jaco, keep_actor=keep) for keep in (True, False))
    labels = {arm.label: len(arm.rows) for arm in Study([kept, dropped, ROW]).approaches()}
    assert labels == {"LBS": 1, "LBS + task-aware FT": 1, "LBS + Dyna-MPC": 1}


def test_what_would_be_averaged_is_said(tmp_path: Path, capsys: Any) -> None:
    append_rows(tmp_path / "rows.csv", [ROW, replace(ROW, seed=1, preset="small")])
    assert Study([ROW, replace(ROW, preset="small")]).mixtures() == [
        "lbs: preset is 'paper', 'small'; --where preset=... keeps one of them"
    ]


def test_a_table_in_every_form() -> None:
    table = Table("t", "In %.", ["a_b", "x"], [["c", "1.0 ± 0.1"]])
    assert table.text() == "In %.\na_b          x\nc    1.0 ± 0.1"
    assert table.csv() == "a_b,x\nc,1.0 ± 0.1\n"
    assert "| c | 1.0 ± 0.1 |" in table.markdown()
    assert r"a\_b & x \\" in table.latex() and r"c & 1.0 $\pm$ 0.1 \\" in table.latex() and r"In \%." in table.latex()


def test_correlation_by_hand() -> None:
    r, p = correlation([1, 2, 3, 4], [4, 3, 2, 1])
    assert r == pytest.approx(-1) and p == pytest.approx(0, abs=1e-6)
    assert all(math.isnan(value) for value in correlation([1, 2], [1, 2]))
    assert all(math.isnan(value) for value in correlation([1, 1, 1], [1, 2, 3]))


def test_learning_curves_of_two_arms(rows: list[Row]) -> None:
    texts = (
        "method=lbs,planner=none,pretrain_frames=2M,keep_actor=task_aware,keep_critic=false,label=with_LBS",
        "method=dreamer",
    )
    arms = [selected(rows, text) for text in texts]
    plain = [tuple(row for row in arm.rows if not (row["variant"] or row["perturbation"])) for arm in arms]
    picture = learning_curves([replace(arm, rows=own) for arm, own in zip(arms, plain, strict=True)], synthetic=True)
    assert [line.get_label() for line in picture.figure.axes[0].lines] == ["with LBS", "method=dreamer"]
    two = [replace(ROW, seed=0, return_mean=362.0), replace(ROW, seed=1, return_mean=724.0)]
    one = selected(two, "method=lbs")
    point = curve(one, "dreamer_2m")[100_000]
    assert (point.value, point.error) == (pytest.approx(0.75), pytest.approx(0.25))


def test_a_curve_follows_the_rule_of_the_paper_or_one_setting() -> None:
    jaco = {"domain": "jaco", "task": "reach_top_left"}
    both = [replace(ROW, **where, keep_actor=keep) for where in ({}, jaco) for keep in (True, False)]
    with pytest.raises(ValueError, match="'method=lbs' holds runs that differ in keep_actor"):
        learning_curves([selected(both, "method=lbs")])
    arm = selected(both, "method=lbs,keep_actor=task_aware")
    assert {row.domain: row.keep_actor for row in arm.rows} == {"walker": True, "jaco": False}
    assert "% of Dreamer@2M" in learning_curves([arm]).caption


@pytest.mark.parametrize(
    ("text", "message"), [("methd=lbs", "expected COLUMN=VALUE"), ("method=icm", "No row has 'method=icm'")]
)
def test_an_arm_that_does_not_exist(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        selected([ROW], text)


@pytest.mark.parametrize(
    ("frames", "label"), [(0, "0"), (100, "100"), (20_000, "20k"), (2_000_000, "2M"), (2_500_000, "2.5M")]
)
def test_labels_of_frames(frames: int, label: str) -> None:
    assert frames_label(frames) == label


def test_bad_input_of_the_command(tmp_path: Path, capsys: Any) -> None:
    path = tmp_path / "rows.csv"
    out = ["--out", str(tmp_path / "out")]
    assert main(["figures", str(path), *out]) == 2
    assert "rows.csv" in capsys.readouterr().err
    append_rows(path, [replace(ROW, method="mine")])
    assert main(["figures", str(path), *out]) == 2
    assert "unknown method 'mine'" in capsys.readouterr().err
    assert main(["figures", str(path), *out, "--finetune-frames", "100 steps", "--also-method", "mine"]) == 2
    assert "unknown unit 'steps'" in capsys.readouterr().err
    path.write_text(path.read_text() + "lbs,wal\n")
    assert main(["figures", str(path), *out, "--also-method", "mine", "--repetitions", "5"]) == 0
    said = capsys.readouterr()
    assert "1 row skipped:" in said.err and "mine + Dyna-MPC" in said.out


# -- rows of other runs ----------------------------------------------------------------------------------------------------

SHOT = replace(ROW, planner="mppi_zero_shot", keep_actor=False, further={"known_reward": "true"})


def zero_shot_pair(shot: float, tuned: float, **changes: Any) -> list[Row]:
    further = {**SHOT.further, **changes.pop("further", {})}
    return [
        replace(SHOT, finetune_frames=0, return_mean=shot, **changes, further={**further, "adaptation": "zero_shot"}),
        replace(SHOT, return_mean=tuned, **changes, further={**further, "adaptation": "fine_tuned", "ldd": "0.2"}),
    ]


#: what makes other runs of a run, for each kind of column
OTHERS: list[dict[str, Any]] = [
    {"pretrain_frames": 100_000},
    {"preset": "small"},
    {"further": {"observation": "state"}},
    {"further": {"perturbation": "easy"}},
    {"further": {"environment": '{"time_limit": 5}'}},
    {"further": {"variant": "sparse"}},
    {"further": {"arm": "mine"}},
    {"further": {"anything": "else"}},
]


@pytest.mark.parametrize("other", OTHERS[3:6], ids=str)
def test_a_changed_task_is_no_run_of_the_benchmark(other: dict[str, Any]) -> None:
    alien = replace(ROW, seed=9, **other)
    study = Study([ROW, alien])
    arm = study.arm("all")
    assert arm.rows == (ROW,)
    study.show([arm])
    assert study.left_out() == [alien]


@pytest.mark.parametrize("other", OTHERS, ids=str)
def test_the_discrepancy_pairs_runs_with_themselves_only(other: dict[str, Any], monkeypatch: pytest.MonkeyPatch) -> None:
    points: list[Any] = []
    monkeypatch.setattr(paper_figures, "scatter", lambda name, found, *rest: points.extend(found.get("walker", ())))
    [mine, *_], alien = zero_shot_pair(400.0, 800.0), zero_shot_pair(100.0, 500.0, **other)
    tuned = zero_shot_pair(400.0, 800.0)[1]
    for rows in ([mine, tuned, alien[0]], [alien[0], tuned, mine]):
        points.clear()
        paper_figures.discrepancy(Study(rows))
        assert points == [(0.2, 0.5)]
    points.clear()
    paper_figures.discrepancy(Study([tuned, alien[0]]))
    assert points == []


def test_only_what_planned_alone_is_a_point_of_the_discrepancy(monkeypatch: pytest.MonkeyPatch) -> None:
    points: list[Any] = []
    monkeypatch.setattr(paper_figures, "scatter", lambda name, found, *rest: points.extend(found["walker"]))
    acted = [replace(ROW, planner=planner, further={"ldd": "0.9"}) for planner in ("none", "dyna_mpc")]
    paper_figures.discrepancy(Study([*zero_shot_pair(400.0, 800.0), *acted]))
    assert points == [(0.2, 0.5)]


@pytest.mark.parametrize("other", [*OTHERS[:1], *OTHERS[3:6]], ids=str)
def test_the_bars_of_zero_shot_are_of_one_length_and_the_task_itself(
    other: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(paper_figures, "domain_bars", lambda study, name, arms, *rest: seen.extend(arms))
    paper_figures.zero_shot(Study([*zero_shot_pair(400.0, 800.0), *zero_shot_pair(100.0, 500.0, **other)]))
    assert [[row.return_mean for row in arm.rows] for arm in seen] == [[], [400.0], [800.0]]


def test_jaco_is_compared_with_the_target_that_can_be_known(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(paper_figures, "domain_bars", lambda study, name, arms, *rest: seen.extend(arms))
    jaco = {"domain": "jaco", "task": "reach_top_left", "further": {"variant": "fixed"}}
    alone = replace(
        ROW, method="dreamer", pretrain_frames=0, keep_actor=None, keep_critic=None, planner="none", return_mean=1.0
    )
    moving = replace(alone, domain="jaco", task="reach_top_left", return_mean=3.0)
    rows = [*zero_shot_pair(1.0, 2.0, **jaco), alone, moving, replace(moving, return_mean=4.0, further={"variant": "fixed"})]
    paper_figures.zero_shot(Study(rows))
    assert [[row.return_mean for row in arm.rows] for arm in seen] == [[1.0, 4.0], [1.0], [2.0]]


def test_a_known_reward_is_compared_with_the_same_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[Any] = []
    monkeypatch.setattr(paper_figures, "domain_bars", lambda study, name, arms, *rest: seen.extend(arms))
    plain = replace(ROW, planner="none", return_mean=1.0)
    known = replace(plain, return_mean=2.0, further={"known_reward": "True"})
    rows = [known, plain, replace(plain, preset="small", return_mean=9.0), *zero_shot_pair(400.0, 800.0)]
    paper_figures.known_reward(Study(rows))
    assert [[row.return_mean for row in arm.rows] for arm in seen] == [[1.0], [2.0]]


def test_captions_count_what_is_shown_and_name_the_rest() -> None:
    others = [replace(ROW, domain="finger", task="spin", seed=seed) for seed in range(5)]
    study = Study([*paper_s_rows(), *others])
    for picture in (paper_figures.benchmark(study), paper_figures.profiles(study, 5)):
        assert picture is not None
        assert "1 seed a task" in picture.caption
        assert "no reference score is known: finger-spin" in picture.caption
    assert paper_figures.benchmark(Study(others)) is None


def test_profiles_say_how_many_tasks_are_behind() -> None:
    picture = paper_figures.profiles(Study([ROW, replace(ROW, seed=1)]), 5)
    assert [line.get_label() for line in picture.figure.axes[0].lines] == ["LBS + Dyna-MPC (1 of 12 tasks)"]  # type: ignore[union-attr]


def test_longer_pre_training_is_of_the_full_method(rows: list[Row]) -> None:
    picture = paper_figures.longer_pretraining(Study(rows))
    assert picture is not None and "with Dyna-MPC" in picture.caption
    axes = picture.figure.axes[0]
    # 4M was never run: a tick and a gap, as far apart as frames are.
    assert [text.get_text() for text in axes.get_xticklabels()] == ["1M", "2M", "3M", "4M", "5M"]
    assert list(axes.get_xticks()) == [1, 2, 3, 4, 5] and "no runs" in words(picture)
    line = next(line for line in axes.lines if line.get_label() == "LBS")
    assert [math.isnan(y) for y in line.get_ydata()] == [False, False, False, True, False]
    assert paper_figures.longer_pretraining(Study([row for row in rows if row.planner == "none"])) is None


@pytest.mark.parametrize("name", ["finetune", "pretrain"])
def test_a_budget_of_nothing_is_refused(name: str, tmp_path: Path, capsys: Any) -> None:
    append_rows(tmp_path / "rows.csv", [ROW])
    assert main(["figures", str(tmp_path / "rows.csv"), "--out", str(tmp_path / "out"), f"--{name}-frames", "0"]) == 2
    assert f"--{name}-frames must be an integer of at least 1" in capsys.readouterr().err
    with pytest.raises(ValueError, match="at least 1, got 0"):
        Study([ROW], **{name: 0})


def test_the_command_names_what_it_shows_nowhere_and_what_lay_there_before(tmp_path: Path, capsys: Any) -> None:
    odd = replace(ROW, keep_critic=True)
    append_rows(tmp_path / "rows.csv", [ROW, odd])
    out = tmp_path / "out"
    out.mkdir()
    for name in ("perturbed.png", "learning_curves_2.pdf", "mine.png"):
        (out / name).write_bytes(b"")
    assert main(["figures", str(tmp_path / "rows.csv"), "--out", str(out), "--repetitions", "5"]) == 0
    said = capsys.readouterr().err
    assert "1 row fits no table or figure" in said and "1 with domain=walker" in said and "keep_critic=true" in said
    assert "that these rows did not make: learning_curves_2.pdf, perturbed.png." in said
    append_rows(tmp_path / "others.csv", [replace(ROW, domain="finger", task="spin")])
    assert main(["figures", str(tmp_path / "others.csv"), "--out", str(out)]) == 2
    assert "--also-task NAME lets others in" in capsys.readouterr().err
    assert main(["figures", str(tmp_path / "rows.csv"), "--out", str(tmp_path / "rows.csv")]) == 2
    assert "is a file: give a folder" in capsys.readouterr().err
