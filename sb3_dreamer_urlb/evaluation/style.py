"""How figures look: a column's font size, colours that everybody can tell apart, captions that stay with the picture."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sb3_dreamer_urlb.evaluation.aggregate import Estimate
from sb3_dreamer_urlb.snapshots.atomic import written_atomically
from sb3_dreamer_urlb.version import how_to_install

#: Okabe and Ito's colours, told apart by everybody, in the order of use
COLORS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000", "#999999", "#B2A200", "#7F3C8D")
HATCHES = ("", "//", "..", "xx", "\\\\", "++", "oo", "--", "**", "||")
STYLES = ("-", "--", "-.", ":")
MARKERS = "osD^vP*Xdh"
#: inches, of one and of two columns of a conference paper
COLUMN, PAGE = 3.35, 6.85
RC: dict[Any, Any] = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.grid.axis": "y",
    "grid.color": "#DDDDDD",
    "grid.linewidth": 0.6,
    "axes.axisbelow": True,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "lines.markersize": 4,
    "hatch.linewidth": 0.5,
    # Labels are people's own: a dollar is a dollar.
    "text.parse_math": False,
    # letters stay letters
    "pdf.fonttype": 42,
}
DPI = 200


def check_matplotlib_installed() -> None:
    """
    :raises ImportError: if it is not, naming the extra
    """
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise ImportError(f"Figures need matplotlib; {how_to_install('plots')}.") from error


@dataclass
class Picture:
    """A finished figure.

    :param name: of its files
    :param figure: of matplotlib
    :param caption: what is shown, with units and seeds
    """

    name: str
    figure: Any
    caption: str

    def write(self, folder: Path) -> list[Path]:
        """PDF and PNG.

        :param folder: that they are written to
        """
        import matplotlib.pyplot as plt

        paths = [folder / f"{self.name}.{suffix}" for suffix in ("pdf", "png")]
        for path in paths:
            with written_atomically(path) as file:
                self.figure.savefig(file, format=path.suffix[1:], dpi=DPI)
        plt.close(self.figure)
        return paths


def new_figure(panels: int, width: float = PAGE, height: float = 2.1) -> tuple[Any, list[Any]]:
    """A figure with panels side by side, to be finished with :func:`finish`.

    :param panels: how many
    :param width: inches
    :param height: inches, of the panels; caption and legend come below
    """
    import matplotlib

    matplotlib.use("Agg")
    matplotlib.rcParams.update(RC)
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(1, panels, figsize=(width, height), squeeze=False)
    return figure, list(axes[0])


def finish(name: str, figure: Any, caption: str, synthetic: bool, handles: Sequence[Any] = (), columns: int = 4) -> Picture:
    """Legend and caption below the panels, each in a place of its own.

    :param name: of the files
    :param figure: with its panels drawn
    :param caption: what is shown
    :param synthetic: mark every panel as made up
    :param handles: of the legend, none without
    :param columns: of the legend
    """
    width, height = figure.get_size_inches()
    lines = textwrap.wrap(caption, int(width * 19), break_on_hyphens=False)
    rows = math.ceil(len(handles) / columns) if handles else 0
    # As full as each other: matplotlib fills columns, and would leave the last ones short.
    columns = math.ceil(len(handles) / rows) if rows else columns
    below = 0.08 + 0.135 * len(lines) + (0.15 * rows + 0.1 if rows else 0.0)
    total = height + below
    figure.set_size_inches(width, total)
    figure.tight_layout(rect=(0, below / total, 1, 1), w_pad=0.8)
    if handles:
        top = (below - 0.02) / total
        figure.legend(handles=list(handles), loc="upper center", bbox_to_anchor=(0.5, top), ncol=columns, borderaxespad=0)
    figure.text(0.01, (0.06 + 0.135 * len(lines)) / total, "\n".join(lines), fontsize=7, va="top", linespacing=1.25)
    if synthetic:
        for axes in figure.axes:
            axes.text(0.5, 0.5, "SYNTHETIC\nROWS", transform=axes.transAxes, ha="center", va="center", fontsize=14,
                      color="#C00000", alpha=0.35, rotation=25, weight="bold", zorder=10)  # fmt: skip
    return Picture(name, figure, caption)


def bars(
    axes: Any, groups: Sequence[str], series: Mapping[str, Sequence[Estimate]], expected: Sequence[int], scale: float = 100
) -> list[Any]:
    """Bars side by side, with error bars. What is missing is a labelled gap; what is incomplete is pale and says so.

    :param axes: to draw in
    :param groups: labels below
    :param series: label → a number for each group
    :param expected: how many tasks a complete group has
    :param scale: numbers are multiplied by this
    :return: handles of a legend
    """
    from matplotlib.patches import Patch

    wide = 0.84 / max(1, len(series))
    handles, notes = [], []
    for i, (label, estimates) in enumerate(series.items()):
        color, hatch = COLORS[i % len(COLORS)], HATCHES[(i + i // len(COLORS)) % len(HATCHES)]
        handles.append(Patch(facecolor=color, hatch=hatch, edgecolor="white", label=label))
        for group, (estimate, tasks) in enumerate(zip(estimates, expected, strict=True)):
            x = group + (i - (len(series) - 1) / 2) * wide
            if math.isnan(estimate.value):
                axes.text(x, 0.02, "no runs", transform=axes.get_xaxis_transform(), rotation=90, ha="center", va="bottom",
                          fontsize=6, color="#777777")  # fmt: skip
                continue
            part = estimate.tasks < tasks
            axes.bar(
                x, scale * estimate.value, 0.92 * wide, color=color, hatch=hatch, edgecolor="white", alpha=0.45 if part else 1
            )
            if not math.isnan(estimate.error):
                around = [[scale * (estimate.value - estimate.low)], [scale * (estimate.high - estimate.value)]]
                axes.errorbar(x, scale * estimate.value, around, color="#333333", lw=0.9, capsize=1.5)
            if part:
                ends = (0.0, estimate.value, estimate.high)
                notes.append(
                    (x, scale * max(end for end in ends if not math.isnan(end)), f"{estimate.tasks} of {tasks} tasks")
                )
    axes.set_xticks(range(len(groups)), groups)
    axes.set_xlim(-0.5, len(groups) - 0.5)
    axes.set_ylim(bottom=min(0, axes.get_ylim()[0]))
    _write_above(axes, notes)
    axes.tick_params(axis="x", length=0)
    return handles


def _write_above(axes: Any, notes: Sequence[tuple[float, float, str]], size: float = 6) -> None:
    """Words on end above bars and their error bars, with room for them.

    :param axes: to write in
    :param notes: where on the x axis, above what height, the words
    :param size: of the letters, points
    """
    tall = axes.get_position().height * axes.figure.get_size_inches()[1]
    for x, height, text in notes:
        axes.annotate(text, (x, height), xytext=(0, 3), textcoords="offset points", rotation=90, ha="center", va="bottom",
                      fontsize=size)  # fmt: skip
        # A letter is about half as wide as it is high.
        share = min(0.8, (0.55 * size * len(text) + 6) / 72 / tall)
        low, high = axes.get_ylim()
        axes.set_ylim(top=max(high, (height - low * share) / (1 - share)))


def lines(
    axes: Any,
    series: Mapping[str, Mapping[int, Estimate]],
    places: Mapping[int, float],
    scale: float = 100,
    band: bool = False,
    first: int = 0,
) -> list[Any]:
    """Lines over frames with error bars or bands; a line is broken where a point is missing.

    :param axes: to draw in
    :param series: label → frames → a number
    :param places: frames → where on the x axis
    :param scale: numbers are multiplied by this
    :param band: shade the interval instead of bars
    :param first: colour of the first line
    :return: handles of a legend
    """
    handles = []
    for i, (label, points) in enumerate(series.items(), first):
        style = {"color": COLORS[i % len(COLORS)], "marker": MARKERS[i % len(MARKERS)], "label": label}
        x = np.array([places[frames] for frames in sorted(places)])
        found = [points.get(frames, Estimate(math.nan)) for frames in sorted(places)]
        y, low, high = (scale * np.array([getattr(one, name) for one in found]) for name in ("value", "low", "high"))
        if band:
            axes.fill_between(x, low, high, color=style["color"], alpha=0.2, lw=0)
            if len(x) > 15:
                style |= {"marker": "", "linestyle": STYLES[i % len(STYLES)]}
        else:
            shift = (i - (len(series) - 1) / 2) * 0.03 * (x[-1] - x[0] if len(x) > 1 else 1) / max(1, len(series) / 3)
            x = x + shift
            known = ~np.isnan(low)
            axes.errorbar(x[known], y[known], [y[known] - low[known], high[known] - y[known]], fmt="none",
                          ecolor=style["color"], lw=0.9, capsize=1.5)  # fmt: skip
        handles += axes.plot(x, y, **style)
    return handles


def frames_label(frames: int) -> str:
    """``100k``, ``2M``."""
    for size, unit in ((1_000_000, "M"), (1_000, "k")):
        if frames >= size:
            return f"{frames / size:g}{unit}"
    return str(frames)
