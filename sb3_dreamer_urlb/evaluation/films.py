"""Films for people: enlarged, and labelled with what each panel is and which step it shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

#: side that a panel has at least; pixels of the label's line
LEAST_SIDE, LINE = 192, 16


def truth_model_error(truth: np.ndarray, model: np.ndarray) -> np.ndarray:
    """Three pictures side by side: truth, model, and their difference around grey, uint8 (n, height, 3·width, C)."""
    error = (truth.astype(np.int16) - model.astype(np.int16)) // 2 + 128
    return np.concatenate([truth, model, error.astype(np.uint8)], 2)


def enlarged(frames: np.ndarray, side: int) -> np.ndarray:
    """Each pixel several times, so that ``side`` pixels become :data:`LEAST_SIDE` or more."""
    scale = max(1, -(-LEAST_SIDE // side))
    return frames.repeat(scale, 1).repeat(scale, 2)


def labelled_agent(frames: np.ndarray, start: int = 0) -> np.ndarray:
    """An agent at work, enlarged by whole pixels, with what it is above and the step below.

    :param frames: uint8 (n, height, width, 3)
    :param start: step of the first frame
    :return: uint8 (n, …, …, 3)
    """
    frames = enlarged(frames, frames.shape[2])
    above = text_line(frames.shape[2], [("agent", 0)])
    below = [text_line(frames.shape[2], [(f"step {start + i}", 0)]) for i in range(len(frames))]
    return np.stack([np.concatenate([above, frame, line]) for frame, line in zip(frames, below, strict=True)])


def labelled_open_loop(truth: np.ndarray, model: np.ndarray, context: int, start: int = 0) -> np.ndarray:
    """Truth, model and error, enlarged by whole pixels, with the panels' names above and the step below.

    :param truth: uint8 (n, height, width, C)
    :param model: likewise: what it inferred from what it saw, then what it predicted
    :param context: frames that it saw
    :param start: step of the first frame
    :return: uint8 (n, …, …, C)
    """
    panels = enlarged(truth_model_error(truth, model), truth.shape[2])
    width = panels.shape[2] // 3
    names = [("truth", 0), ("model", width), ("error", 2 * width)]
    frames = []
    for i, panel in enumerate(panels):
        told = "seen" if i < context else f"predicted {i - context + 1} ahead, from the actions alone"
        above = text_line(panel.shape[1], names)
        below = text_line(panel.shape[1], [(f"step {start + i}: {told}", 0)])
        frames.append(np.concatenate([above, panel, below]))
    return np.stack(frames)


def text_line(width: int, texts: Sequence[tuple[str, int]]) -> np.ndarray:
    """A line of white text on black.

    :param width: in pixels
    :param texts: each with where it begins
    :return: uint8 (LINE, width, 3)
    :raises ImportError: if pillow is not installed
    """
    from PIL import Image, ImageDraw

    line = Image.new("RGB", (width, LINE))
    draw = ImageDraw.Draw(line)
    for text, left in texts:
        draw.text((left + 4, 2), text, fill="white")
    return np.asarray(line)
