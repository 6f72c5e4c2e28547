"""Rows of evaluations: the form, what is skipped, refused and reported, and writers that share a file."""

from __future__ import annotations

import math
import multiprocessing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from sb3_dreamer_urlb.envs.naming import columns_of_id
from sb3_dreamer_urlb.evaluation import names, rows
from sb3_dreamer_urlb.evaluation.append import RowsDisagree, append_row, append_rows
from sb3_dreamer_urlb.evaluation.rows import REQUIRED, Row, read_rows
from sb3_dreamer_urlb.intrinsic.registry import registered_intrinsic_rewards

ROW = Row("lbs", "walker", "run", 0, 2_000_000, 100_000, True, False, "dyna_mpc", "paper", 596.25, 17.5, 10, 81.0)
HEADER = (
    "method,domain,task,seed,pretrain_frames,finetune_frames,keep_actor,keep_critic,planner,preset,"
    "return_mean,return_std,episodes,seconds"
)
LINE = "lbs,walker,run,{seed},2000000,100000,true,false,dyna_mpc,paper,{value},17.5,10,81"


def written(path: Path, *lines: str) -> Path:
    path.write_text("\n".join([HEADER, *lines]) + "\n")
    return path


def test_the_columns_are_the_agreed_ones(tmp_path: Path) -> None:
    assert ",".join(REQUIRED) == HEADER
    assert append_row(tmp_path / "rows.csv", ROW)
    assert (tmp_path / "rows.csv").read_text().splitlines()[0] == HEADER + ",written"


def test_every_method_of_the_package_is_known() -> None:
    # Other tests may have registered methods of their own.
    ours = {name for name, kind in registered_intrinsic_rewards().items() if kind.__module__.startswith("sb3_dreamer_urlb.")}
    assert ours and ours <= set(names.METHODS)


TEXT = st.text(st.characters(blacklist_characters="\r\n\0", blacklist_categories=["Cs"]), min_size=1, max_size=8).filter(
    lambda text: "�" not in text
)
ROWS = st.builds(
    Row,
    st.sampled_from(sorted(names.METHODS)),
    *(st.just("walker"), st.sampled_from(["run", "flip"]), st.integers(0, 5)),
    *(st.integers(0, 10**7), st.integers(0, 10**7)),
    *(st.sampled_from([None, True, False]), st.sampled_from([None, True, False])),
    *(st.sampled_from(["none", "dyna_mpc"]), st.sampled_from(["paper", "small"])),
    *(st.floats(-1e6, 1e6), st.floats(0, 1e6) | st.just(math.nan), st.integers(1, 100), st.just(1.5)),
    further=st.dictionaries(st.sampled_from(["arm", "observation", "run_folder"]), TEXT),
)


@given(found=st.lists(ROWS, max_size=6, unique_by=lambda row: row.key))
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_what_is_written_one_by_one_is_read(found: list[Row], tmp_path_factory: pytest.TempPathFactory) -> None:
    path = tmp_path_factory.mktemp("rows") / "rows.csv"
    for row in found:
        assert append_row(path, row)
        assert not append_row(path, row)
    if not found:
        return
    read = read_rows(path)
    assert read.report() == ""
    assert [row.key for row in read.rows] == [row.key for row in found]
    for row, other in zip(read.rows, found, strict=True):
        assert row.agrees(other) and row.further.get("run_folder") == other.further.get("run_folder")


def test_a_row_is_written_once_whoever_says_it_again(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    later = replace(ROW, seconds=2.0, further={"run_folder": "elsewhere", "versions": "torch 3"})
    assert append_rows(path, [ROW, ROW, later]) == 1
    before = path.read_bytes()
    assert append_rows(path, [later, replace(ROW, method="LBS")]) == 0
    assert path.read_bytes() == before


def test_another_result_of_the_same_run_is_not_written(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    append_row(path, ROW)
    before = path.read_bytes()
    with pytest.raises(RowsDisagree, match=r"another result of the same run: 596.25 of 10 episodes, now .*return 600"):
        append_rows(path, [replace(ROW, seed=9), replace(ROW, return_mean=600.0)])
    assert path.read_bytes() == before
    assert append_row(path, replace(ROW, return_mean=600.0, further={"arm": "b"}))


def _append_many(path: str, process: int) -> None:
    for seed in range(15):
        # Each seed by two processes; one of three brings a column of its own.
        further = {f"column_{process}": "x"} if seed % 3 == 0 else {}
        append_row(path, replace(ROW, seed=100 * (process // 2) + seed, further=further))


def test_several_processes_write_whole_rows(tmp_path: Path) -> None:
    path = str(tmp_path / "rows.csv")
    context = multiprocessing.get_context("forkserver")
    processes = [context.Process(target=_append_many, args=(path, number)) for number in range(4)]
    for process in processes:
        process.start()
    for process in processes:
        process.join()
    read = read_rows(path)
    assert read.report() == ""
    # Per pair of processes: 10 shared rows, and 5 with its own column from each.
    assert len(read.rows) == 2 * (10 + 5 + 5)


def test_new_columns_widen_the_file_and_leave_what_cannot_be_read(tmp_path: Path) -> None:
    path = written(tmp_path / "rows.csv", LINE.format(seed=0, value=1), "lbs,walker,ru")
    append_row(path, replace(ROW, seed=1, further={"observation": "state"}))
    assert path.read_text().splitlines()[0] == HEADER + ",observation,written"
    read = read_rows(path)
    assert [row.seed for row in read.rows] == [0, 1] and read.rows[1]["observation"] == "state"
    assert read.rows[0]["observation"] == ""
    assert read.skipped == [f"{path}, line 3: half-written: 3 of 16 fields"]


def test_a_line_without_an_end_does_not_swallow_the_next(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    append_row(path, ROW)
    path.write_bytes(path.read_bytes()[:-4])  # killed within the last field
    append_row(path, replace(ROW, seed=1))
    read = read_rows(path)
    assert [row.seed for row in read.rows] == [1]
    assert len(read.skipped) == 1 and "line 2" in read.skipped[0] and "cut off" in read.skipped[0]


@pytest.mark.parametrize("cut", range(1, 60, 7))
def test_a_row_cut_anywhere_is_skipped_and_named(cut: int, tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    append_rows(path, [ROW, replace(ROW, seed=1)])
    path.write_bytes(path.read_bytes()[:-cut] if cut > 1 else path.read_bytes()[:-2])
    read = read_rows(path)
    assert [row.seed for row in read.rows] == [0] and len(read.skipped) == 1
    assert read.report().startswith("1 row skipped:") and "line 3" in read.report()


@pytest.mark.parametrize(
    ("line", "reason"),
    [
        (LINE.format(seed="x", value=1), "seed='x'"),
        (LINE.format(seed=-1, value=1), "seed='-1'"),
        (LINE.format(seed=0, value="nan"), "return_mean='nan'"),
        (LINE.format(seed=0, value="inf"), "return_mean='inf'"),
        (LINE.format(seed=0, value="12 points"), "return_mean='12 points'"),
        (LINE.format(seed=0, value=1) + ",more", "15 of 14 fields"),
        (LINE.format(seed=0, value='"1'), "half-written"),
        (LINE.format(seed=0, value=1).replace("true", "maybe"), "keep_actor='maybe'"),
        (LINE.format(seed=0, value=1).replace("2000000", "lots"), "pretrain_frames='lots'"),
        (LINE.format(seed=0, value=1).replace("2000000", "-5"), "pretrain_frames='-5'"),
        (LINE.format(seed=0, value=1).replace(",10,", ",0,"), "episodes='0'"),
        (LINE.format(seed="9" * 400, value=1), "seed='999"),
        (LINE.format(seed="1_0", value=1), "seed='1_0'"),
        (LINE.format(seed="\u0663", value=1), "seed="),
        (LINE.format(seed=0, value="1_000"), "return_mean='1_000'"),
        (LINE.format(seed=0, value="1e308"), "return_mean='1e308'"),
        (LINE.format(seed=0, value=1).replace(",10,", "," + "9" * 400 + ","), "episodes='999"),
        (LINE.format(seed=0, value=1).replace("2000000", "9" * 400), "pretrain_frames='999"),
        (LINE.format(seed=0, value=1).replace("2000000", "1e300"), "pretrain_frames='1e300'"),
        (LINE.format(seed=0, value=1).replace("17.5", "-3"), "return_std='-3'"),
        (LINE.format(seed=0, value=1).replace(",81", ",-81"), "seconds='-81'"),
    ],
)
def test_an_unreadable_row_is_skipped_and_named(line: str, reason: str, tmp_path: Path) -> None:
    read = read_rows(written(tmp_path / "rows.csv", LINE.format(seed=5, value=3), line, LINE.format(seed=6, value=4)))
    assert [row.seed for row in read.rows] == [5, 6]
    assert len(read.skipped) == 1 and "line 3" in read.skipped[0] and reason in read.skipped[0]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("lbs", "lsb", "unknown method 'lsb'; known are aps, apt"),
        ("run", "rnu", "unknown task 'walker-rnu'; known are walker-stand"),
        ("2000000", "1000000 steps", "unknown unit 'steps'"),
        ("2000000", "20 episodes", "unknown unit 'episodes'"),
    ],
)
def test_unknown_things_are_refused(old: str, new: str, message: str, tmp_path: Path) -> None:
    path = written(tmp_path / "rows.csv", LINE.format(seed=0, value=1).replace(old, new))
    with pytest.raises(names.UnknownName, match=f"rows.csv, line 2: .*{message}"):
        read_rows(path)
    if "unit" not in message:
        assert len(read_rows(path, methods=["lsb"], tasks=["walker-rnu"]).rows) == 1


def test_a_column_of_units_is_heeded(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_text(f"{HEADER},unit\n{LINE.format(seed=0, value=1)},steps\n")
    with pytest.raises(names.UnknownName, match="unknown unit 'steps' of frames"):
        read_rows(path)


@pytest.mark.parametrize("text", ["2000000", "2e6", "2M", "2000k", "2m", "2000000 frames", "2.0M frames", " 2000000.0 "])
def test_frames_as_people_write_them(text: str) -> None:
    assert rows.frames("pretrain_frames", text) == 2_000_000


def test_somebody_elses_file(tmp_path: Path) -> None:
    path = tmp_path / "theirs.csv"
    cells: dict[str, Any] = dict(zip(HEADER.split(","), LINE.format(seed=0, value=7).split(","), strict=True))
    cells.update(method="P2E", planner="", keep_actor="", return_std="", seconds="")
    order = sorted(cells)
    path.write_bytes(b"\xef\xbb\xbf" + "\r\n".join([",".join(order), ",".join(cells[name] for name in order)]).encode())
    [row] = read_rows(path).rows
    assert (row.method, row.planner, row.keep_actor, row.return_mean) == ("plan2explore", "none", None, 7)
    assert math.isnan(row.return_std) and math.isnan(row.seconds)


def test_rows_that_disagree_are_reported_and_copies_count_once(tmp_path: Path) -> None:
    same = LINE.format(seed=0, value=1)
    path = written(tmp_path / "rows.csv", same, same, LINE.format(seed=0, value=2), LINE.format(seed=1, value=3))
    read = read_rows(path)
    assert read.duplicates == 1 and [row.return_mean for row in read.rows] == [2, 3]
    assert len(read.disagreements) == 1
    assert "line 2 has return 1" in read.report() and "line 4 has 2 for domain=walker" in read.report()


def test_a_file_without_the_columns_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_text("method,domain\nlbs,walker\n")
    for act in (lambda: read_rows(path), lambda: append_row(path, ROW)):
        with pytest.raises(ValueError, match=r"rows.csv lacks the columns task, seed"):
            act()
    assert path.read_text() == "method,domain\nlbs,walker\n"
    path.write_text("")
    with pytest.raises(ValueError, match="lacks the columns"):
        read_rows(path)


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_lines_may_end_as_on_any_machine(end: str, tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_bytes(end.join([HEADER, LINE.format(seed=0, value=1), LINE.format(seed=1, value=2), ""]).encode())
    assert append_row(path, replace(ROW, seed=2))
    read = read_rows(path)
    assert [row.seed for row in read.rows] == [0, 1, 2] and read.report() == ""


@pytest.mark.parametrize("seed", [2**53 + 1, 2**64 - 1])
def test_large_seeds_are_told_apart(seed: int, tmp_path: Path) -> None:
    assert append_rows(tmp_path / "rows.csv", [replace(ROW, seed=seed), replace(ROW, seed=seed - 1, return_mean=1.0)]) == 2
    assert [row.seed for row in read_rows(tmp_path / "rows.csv").rows] == [seed, seed - 1]


def test_the_same_run_in_another_spelling_is_the_same_run(tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    line = LINE.format(seed=0, value=1)
    odd = LINE.format(seed=0, value=2).replace("lbs", "LBS").replace("dyna_mpc", "Dyna_MPC").replace("true", "True")
    path.write_text(f"{HEADER},observation,known_reward\n{line},state,\n{odd},State,False\n")
    read = read_rows(path)
    assert len(read.disagreements) == 1 and [row.return_mean for row in read.rows] == [2]
    known = [replace(ROW, further={"known_reward": text}).key for text in ("true", "True", "1", " yes")]
    assert len(set(known)) == 1 and known[0] != ROW.key == replace(ROW, further={"known_reward": "no"}).key


@pytest.mark.parametrize(("column", "text"), [("known_reward", "perhaps"), ("ldd", "much"), ("intrinsic_reward", "inf")])
def test_further_columns_that_mean_something_are_checked(column: str, text: str, tmp_path: Path) -> None:
    path = tmp_path / "rows.csv"
    path.write_text(f"{HEADER},{column}\n{LINE.format(seed=0, value=1)},{text}\n")
    read = read_rows(path)
    assert read.rows == [] and f"{column}='{text}'" in read.report()


@pytest.mark.parametrize(
    ("row", "message"),
    [
        (replace(ROW, return_mean=math.nan), "return_mean"),
        (replace(ROW, episodes=0), "episodes"),
        (replace(ROW, further={"a b": "1"}), "'a b'"),
        (replace(ROW, further={"arm": "two\nlines"}), "one line"),
        (replace(ROW, further={"seed": "1"}), "seed"),
    ],
)
def test_what_cannot_be_read_is_not_written(row: Row, message: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=message):
        append_row(tmp_path / "rows.csv", row)
    assert not (tmp_path / "rows.csv").exists()


@pytest.mark.parametrize(
    ("env_id", "columns"),
    [
        ("urlb/walker-run-v0", {"domain": "walker", "task": "run"}),
        ("rwrl/quadruped-walk-hard-v0", {"domain": "quadruped", "task": "walk", "perturbation": "hard"}),
        ("urlb/jaco-reach_top_left-sparse-v0", {"domain": "jaco", "task": "reach_top_left", "variant": "sparse"}),
        ("Pendulum-v1", {"domain": "gymnasium", "task": "Pendulum"}),
    ],
)
def test_what_an_id_says(env_id: str, columns: dict[str, str]) -> None:
    assert columns_of_id(env_id) == columns


def test_rows_behind_a_link_are_one_file(tmp_path: Path) -> None:
    real, link = tmp_path / "shared" / "rows.csv", tmp_path / "rows.csv"
    real.parent.mkdir()
    link.symlink_to(real)
    append_row(link, ROW)
    append_row(real, replace(ROW, seed=ROW.seed + 1, further={"arm": "wider"}))  # a further column writes the file anew
    append_row(link, replace(ROW, seed=ROW.seed + 2, further={"arm": "b", "machine": "c"}))
    assert link.is_symlink() and len(read_rows(real).rows) == 3
    assert [path.name for path in tmp_path.glob(".*lock")] == []
