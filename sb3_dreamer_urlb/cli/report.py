"""Write one self-contained HTML page about a run: configuration, curves, films, evaluations beside the paper's, warnings."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from sb3_dreamer_urlb.command_parser import a_path
from sb3_dreamer_urlb.folders import check_file

HELP = "write one HTML page about a run"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: of this command
    """
    parser.add_argument("run", type=a_path, help="folder of a run, of the demo, or any with a snapshot or logs in it")
    parser.add_argument("--out", type=a_path, help="page (default: report.html in the folder)")
    parser.add_argument("--rows", type=a_path, nargs="+", default=[], help="evaluations beside those in the folder")
    parser.add_argument(
        "--command", dest="repeat", help="what repeats the run (default: the zoo's command, or the constructor's call)"
    )


def run(options: dict[str, Any]) -> int:
    """
    :param options: of the command line
    :return: exit status
    :raises FileNotFoundError: if there is no run in the folder
    :raises ImportError: if the extra ``plots`` is not installed
    """
    print(f"Wrote {write_report(options['run'], options.get('out'), options['rows'], options.get('repeat'))}.")
    return 0


def write_report(folder: Path, out: Path | None = None, rows: list[Path] | None = None, command: str | None = None) -> Path:
    """Write the page of a run.

    :param folder: of the run
    :param out: page, ``report.html`` in the folder if None
    :param rows: evaluations beside those in the folder
    :param command: that repeats the run
    :return: the page
    """
    from sb3_dreamer_urlb.evaluation.run_facts import read_run
    from sb3_dreamer_urlb.evaluation.run_page import run_page
    from sb3_dreamer_urlb.snapshots.atomic import written_atomically

    if out is not None:
        check_file("--out", out)
    out = out or folder / "report.html"
    page = run_page(read_run(folder, rows), command)
    with written_atomically(out) as file:
        file.write(page.encode())
    return out
