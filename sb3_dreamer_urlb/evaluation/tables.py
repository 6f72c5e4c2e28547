"""Tables, for the terminal and as Markdown, CSV and LaTeX."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

from sb3_dreamer_urlb.evaluation.aggregate import Estimate
from sb3_dreamer_urlb.evaluation.rows import line_of
from sb3_dreamer_urlb.snapshots.atomic import written_atomically

MISSING = "–"
_LATEX = {"&": r"\&", "%": r"\%", "_": r"\_", "#": r"\#", "±": r"$\pm$", "–": "--", "→": r"$\to$", "≥": r"$\ge$"}


@dataclass
class Table:
    """A table.

    :param name: of its files
    :param caption: what the numbers are, with units and seeds
    :param columns: their names
    :param lines: of cells
    """

    name: str
    caption: str
    columns: Sequence[str]
    lines: list[list[str]] = field(default_factory=list)

    def text(self) -> str:
        """For a terminal."""
        lines = [list(self.columns), *self.lines]
        widths = [max(len(line[i]) for line in lines) for i in range(len(self.columns))]
        rows = [
            [cell.rjust(width) if i else cell.ljust(width) for i, (cell, width) in enumerate(zip(line, widths, strict=True))]
            for line in lines
        ]
        return "\n".join([self.caption, *("  ".join(row).rstrip() for row in rows)])

    def markdown(self) -> str:
        """For pages."""
        lines = [list(self.columns), ["---"] + ["---:"] * (len(self.columns) - 1), *self.lines]
        return "\n".join(["| " + " | ".join(line) + " |" for line in lines] + ["", self.caption, ""])

    def csv(self) -> str:
        """For programs."""
        return "".join(line_of(line) for line in [self.columns, *self.lines])

    def latex(self) -> str:
        """For papers; needs the package ``booktabs``."""
        body = [" & ".join(map(_latex, line)) + r" \\" for line in [self.columns, *self.lines]]
        return "\n".join(
            [r"\begin{table}", r"\centering", r"\begin{tabular}{l" + "r" * (len(self.columns) - 1) + "}", r"\toprule"]
            + [body[0], r"\midrule", *body[1:], r"\bottomrule", r"\end{tabular}"]
            + [rf"\caption{{{_latex(self.caption)}}}", rf"\label{{tab:{self.name}}}", r"\end{table}", ""]
        )

    def write(self, folder: Path) -> list[Path]:
        """All three files.

        :param folder: that they are written to
        """
        paths = []
        for suffix, content in (("md", self.markdown()), ("csv", self.csv()), ("tex", self.latex())):
            paths.append(folder / f"{self.name}.{suffix}")
            with written_atomically(paths[-1]) as file:
                file.write(content.encode())
        return paths


def _latex(text: str) -> str:
    return "".join(_LATEX.get(character, character) for character in text)


def percent(estimate: Estimate, digits: int = 1) -> str:
    """A score ± its standard error, in percent."""
    return with_error(estimate, 100.0, digits)


def with_error(estimate: Estimate, scale: float = 1.0, digits: int = 0) -> str:
    """A number ± its standard error.

    :param estimate: the number
    :param scale: both are multiplied by this
    :param digits: after the point
    """
    if math.isnan(estimate.value):
        return MISSING
    spread = "" if math.isnan(estimate.error) else f" ± {scale * estimate.error:.{digits}f}"
    return f"{scale * estimate.value:.{digits}f}{spread}"


def with_interval(estimate: Estimate) -> str:
    """A score and its interval, in percent."""
    if math.isnan(estimate.value):
        return MISSING
    ends = "" if math.isnan(estimate.low) else f" [{100 * estimate.low:.1f}, {100 * estimate.high:.1f}]"
    return f"{100 * estimate.value:.1f}{ends}"


def seeds(estimate: Estimate) -> str:
    """How many seeds a task has, ``3`` or ``1–3``."""
    low, high = estimate.seeds
    return MISSING if high == 0 else f"{low}" if low == high else f"{low}–{high}"
