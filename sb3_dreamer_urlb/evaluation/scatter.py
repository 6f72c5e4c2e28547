"""Points with a linear fit, its interval, and Pearson's correlation."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np

from sb3_dreamer_urlb.evaluation.style import COLORS, COLUMN, MARKERS, Picture, finish, new_figure


def scatter(
    name: str, points: Mapping[str, Sequence[tuple[float, float]]], x: str, y: str, caption: str, synthetic: bool
) -> Picture:
    """Points by group, with a linear fit, its interval, Pearson's r and p.

    :param name: of the files
    :param points: group → (x, y)
    :param x: label
    :param y: label
    :param caption: what is shown; r, p and the number of points are added
    :param synthetic: mark as made up
    """
    figure, [axes] = new_figure(1, COLUMN * 1.3, 2.3)
    handles = []
    for i, (label, found) in enumerate(points.items()):
        xs, ys = zip(*found, strict=True)
        handles.append(axes.scatter(xs, ys, s=18, color=COLORS[i % 10], marker=MARKERS[i % 10], label=label, zorder=3))
    pooled = np.array([point for found in points.values() for point in found])
    r, p = correlation(pooled[:, 0], pooled[:, 1])
    fitted = len(pooled) > 2 and not math.isnan(r)
    if fitted:
        at = np.linspace(pooled[:, 0].min(), pooled[:, 0].max(), 50)
        middle, half = _fit(pooled[:, 0], pooled[:, 1], at)
        axes.plot(at, middle, color="#333333", lw=1.2)
        axes.fill_between(at, middle - half, middle + half, color="#333333", alpha=0.15, lw=0)
        axes.set_title(f"r = {_signed(r)}, p = {p:.2g}")
    axes.set(xlabel=x, ylabel=y)
    verdict = "too few for a correlation" if math.isnan(r) else f"Pearson's r = {_signed(r)}, p = {p:.2g}"
    line = " Line and band: linear fit and the 95 % interval of its mean." if fitted else ""
    text = f"{caption}{line} {len(pooled)} points: {verdict}."
    return finish(name, figure, text, synthetic, handles, 3)


def _signed(number: float) -> str:
    """With a minus sign, which is no hyphen."""
    return f"{number:.2f}".replace("-", "\N{MINUS SIGN}")


def correlation(x: Sequence[float] | np.ndarray, y: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Pearson's r and its two-sided p; NaN for fewer than three points or where one side does not vary."""
    from scipy import stats

    if len(x) < 3 or np.ptp(x) == 0 or np.ptp(y) == 0:
        return math.nan, math.nan
    found = stats.pearsonr(x, y)
    return float(found.statistic), float(found.pvalue)


def _fit(x: np.ndarray, y: np.ndarray, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Linear regression: its mean at some places, and half of its 95 % interval there."""
    from scipy import stats

    fit = stats.linregress(x, y)
    rest = y - fit.intercept - fit.slope * x
    sigma = math.sqrt(float(rest @ rest) / (len(x) - 2))
    spread = float(np.sum((x - x.mean()) ** 2))
    half = stats.t.ppf(0.975, len(x) - 2) * sigma * np.sqrt(1 / len(x) + (at - x.mean()) ** 2 / spread)
    return fit.intercept + fit.slope * at, half
