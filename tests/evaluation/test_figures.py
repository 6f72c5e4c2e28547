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
    assert "1 rows skipped:" in said.err and "mine + Dyna-MPC" in said.out
