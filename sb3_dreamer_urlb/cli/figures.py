"""Turn rows of evaluations into the paper's tables and figures.

Tables go to the terminal and into the folder as Markdown, CSV and LaTeX, figures into it as PDF and PNG. What has no rows is
left out and named; what has some is drawn with labelled gaps.
"""

from __future__ import annotations

import argparse
import sys
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sb3_dreamer_urlb.command_parser import a_path, at_least
from sb3_dreamer_urlb.folders import made_folder
from sb3_dreamer_urlb.snapshots.atomic import written_atomically

if TYPE_CHECKING:
    from sb3_dreamer_urlb.evaluation.arms import Study
    from sb3_dreamer_urlb.evaluation.rows import Row
    from sb3_dreamer_urlb.evaluation.style import Picture
    from sb3_dreamer_urlb.evaluation.tables import Table

TABLES = ("summary", "raw_scores", "improvement", "correlation")
#: repetitions of the bootstrap that an interval needs
FEW = 100
HELP = "turn rows of evaluations into the paper's tables and figures"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of this command
    """
    parser.add_argument("rows", type=a_path, nargs="+", metavar="ROWS.csv", help="what evaluate and EvaluationCallback wrote")
    parser.add_argument("--out", type=a_path, required=True, help="folder, made if it is not there")
    parser.add_argument("--finetune-frames", help="budget of fine-tuning, such as 100k (default: 100k, or what was reached)")
    parser.add_argument("--pretrain-frames", help="length of the pre-training (default: 2M, or the longest there is)")
    choices = ("dreamer_2m", "urlb_expert")
    parser.add_argument(
        "--normalizer", choices=choices, default=choices[0], help="what scores are shares of (default: %(default)s)"
    )
    parser.add_argument("--where", nargs="+", metavar="COLUMN=VALUE", help="use only rows with these values")
    parser.add_argument(
        "--curves", action="append", nargs="+", metavar="ARM", help="learning curves of arms such as method=lbs,planner=none"
    )
    parser.add_argument("--also-method", nargs="+", default=[], help="methods from outside the package")
    parser.add_argument("--also-task", nargs="+", default=[], help="tasks from outside the benchmark, <domain>-<task>")
    parser.add_argument("--repetitions", type=at_least(1), default=2000, help="of the bootstrap (default: %(default)s)")


def run(options: dict[str, Any]) -> int:
    """
    :param options: of the command line
    :return: exit status
    :raises ValueError: for rows about unknown things, or none
    :raises ImportError: if the extra ``plots`` is not installed
    """
    from sb3_dreamer_urlb.evaluation.aggregate import LATE, NEAR, check_rliable_installed
    from sb3_dreamer_urlb.evaluation.arms import Study
    from sb3_dreamer_urlb.evaluation.curves import selected
    from sb3_dreamer_urlb.evaluation.names import UnknownName, counted
    from sb3_dreamer_urlb.evaluation.rows import frames, read_rows
    from sb3_dreamer_urlb.evaluation.style import check_matplotlib_installed
    from sb3_dreamer_urlb.number_checks import check_integer

    check_matplotlib_installed()
    check_rliable_installed()
    if options["out"].exists() and not options["out"].is_dir():
        raise ValueError(f"--out {options['out']} is a file: give a folder.")
    try:
        read = read_rows(*options["rows"], methods=options["also_method"], tasks=options["also_task"])
    except UnknownName as error:
        raise ValueError(f"{error}{_way_out(str(error))}") from error
    if read.report():
        print(read.report(), file=sys.stderr)
    rows: list[Row] = read.rows
    if "where" in options:
        rows = list(selected(rows, " ".join(options["where"])).rows)
    if not rows:
        raise ValueError(f"{', '.join(map(str, options['rows']))}: no rows.")
    budgets = {}
    for name in ("finetune", "pretrain"):
        if (text := options.get(f"{name}_frames")) is not None:
            budgets[name] = frames(f"--{name}-frames", text)
            check_integer(f"--{name}-frames", budgets[name], 1)
    study = Study(rows, **budgets, normalizer=options["normalizer"])
    if options["repetitions"] < FEW:
        print(f"--repetitions {options['repetitions']}: intervals of fewer than {FEW} are accidental.", file=sys.stderr)
    for warning in study.mixtures():
        print(f"These are averaged: {warning}", file=sys.stderr)
    if study.unfinished:
        runs = counted(len(study.unfinished), "run has", "runs have")
        where = f"from {NEAR:.0%} before {study.finetune} frames to {LATE:.0%} past them"
        print(f"{runs} no evaluation {where}, left out:", file=sys.stderr)
        for row in study.unfinished:
            print(f"  {row}", file=sys.stderr)
    made_folder("--out", options["out"])
    tables, pictures, missing = _made(study, options)
    _say_what_is_shown_nowhere(study)
    written = _write(tables, pictures, missing, options["out"])
    _name_older_files(options["out"], written)
    return 0


def _way_out(message: str) -> str:
    for word in ("method", "task"):
        if f"unknown {word}" in message:
            return f"; --also-{word} NAME lets others in"
    return ""


def _say_what_is_shown_nowhere(study: Study) -> None:
    """Rows that fit no arm, by what they are: somebody may have meant them for one."""
    from sb3_dreamer_urlb.evaluation.names import counted

    kinds = Counter(", ".join(f"{name}={text}" for name, text in row.setting("seed", "task")) for row in study.left_out())
    if kinds:
        rows = counted(sum(kinds.values()), "row fits", "rows fit")
        print(f"{rows} no table or figure and are shown nowhere (--curves shows any):", file=sys.stderr)
        for kind, number in kinds.most_common():
            print(f"  {number} with {kind}", file=sys.stderr)


def _name_older_files(out: Path, written: set[str]) -> None:
    """Results of other rows in the same folder would be taken for these."""
    from sb3_dreamer_urlb.evaluation.paper_figures import FIGURES

    ours = {*TABLES, *(draw.__name__ for draw in FIGURES)}
    old = sorted(
        path.name
        for path in out.iterdir()
        if path.suffix in (".pdf", ".png", ".md", ".csv", ".tex")
        and (path.stem in ours or path.stem.startswith("learning_curves"))
        and path.name not in written
    )
    if old:
        print(f"Older files in {out} that these rows did not make: {', '.join(old)}.", file=sys.stderr)


def _made(study: Study, options: dict[str, Any]) -> tuple[list[Table], list[Picture], list[str]]:
    from sb3_dreamer_urlb.evaluation import paper_tables
    from sb3_dreamer_urlb.evaluation.curves import learning_curves, selected
    from sb3_dreamer_urlb.evaluation.paper_figures import FIGURES, profiles

    repetitions = options["repetitions"]
    tables = [paper_tables.summary(study, repetitions), paper_tables.raw_scores(study)]
    missing = []
    if len(study.approaches()) > 1:
        tables.append(paper_tables.improvement(study, repetitions))
    correlation = paper_tables.reward_correlation(study)
    if correlation is None:
        missing.append("correlation")
    else:
        tables.append(correlation)
    pictures = []
    for draw in FIGURES:
        picture = profiles(study, repetitions) if draw is profiles else draw(study)
        if picture is None:
            missing.append(draw.__name__)
        else:
            pictures.append(picture)
    for i, texts in enumerate(options.get("curves", ())):
        arms = [selected(study.rows, text) for text in texts]
        study.show(arms)
        name = "learning_curves" + (f"_{i + 1}" if i else "")
        pictures.append(learning_curves(arms, study.normalizer, study.synthetic, name))
    return tables, pictures, missing


def _write(tables: list[Table], pictures: list[Picture], missing: list[str], out: Path) -> set[str]:
    """The names of the files."""
    written = {"captions.md"}
    for table in tables:
        written.update(path.name for path in table.write(out))
        print(f"{table.text()}\n")
    captions = []
    for picture in pictures:
        written.update(path.name for path in picture.write(out))
        captions.append(f"**{picture.name}**: {picture.caption}\n")
    with written_atomically(out / "captions.md") as file:
        file.write("\n".join(captions).encode())
    print(f"In {out}: {', '.join([*(table.name for table in tables), *(picture.name for picture in pictures)])}.")
    if missing:
        print(f"No rows for: {', '.join(missing)}.")
    return written
