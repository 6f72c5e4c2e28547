"""Pictures of the demonstration: both agents' curves, and both at work."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from sb3_dreamer_urlb.evaluation.figures import write_gif
from sb3_dreamer_urlb.evaluation.films import text_line
from sb3_dreamer_urlb.evaluation.style import COLORS, MARKERS, frames_label, new_figure

#: frames a second of the walker's time, an agent step each
FPS = 20.0
#: episodes that a line averages over
WINDOW = 5


def curves(returns: Mapping[str, Sequence[float]], frames: int, random: float, title: str, path: Path) -> None:
    """Every training episode a point, and its moving mean a line.

    :param returns: agent → of its training episodes, in their order
    :param frames: of an episode
    :param random: mean return of random actions
    :param title: what was learnt
    :param path: of the PNG
    """
    import matplotlib.pyplot as plt

    figure, [axes] = new_figure(1, 5.2, 3.0)
    for i, (name, values) in enumerate(returns.items()):
        x, color = frames * np.arange(1, len(values) + 1), COLORS[(1, 0)[i % 2]]
        means = [np.mean(values[max(0, at - WINDOW + 1) : at + 1]) for at in range(len(values))]
        axes.plot(x, values, MARKERS[i], color=color, alpha=0.35, mew=0)
        axes.plot(x, means, color=color, lw=2, label=f"{name}: {np.mean(values) if len(values) else 0:.0f} on average")
    axes.axhline(random, color="#777777", ls=":", lw=1, label=f"random actions: {random:.0f}")
    axes.set(xlabel="environment frames of the task", ylabel="return of an episode", title=title, ylim=(0, None))
    axes.xaxis.set_major_formatter(lambda value, _: frames_label(round(value)))
    axes.legend(loc="upper left", fontsize=8)
    figure.tight_layout()
    figure.savefig(path, dpi=150)
    plt.close(figure)


def film(frames: Mapping[str, np.ndarray], path: Path) -> None:
    """Agents beside each other, each under its name.

    :param frames: agent → uint8 (n, height, width, 3), of one size
    :param path: of the GIF
    """
    length = min(map(len, frames.values()))
    panels = np.concatenate([each[:length] for each in frames.values()], 2)
    width = panels.shape[2] // len(frames)
    above = text_line(panels.shape[2], [(name, i * width) for i, name in enumerate(frames)])
    write_gif([np.concatenate([above, panel]) for panel in panels], path, FPS)
