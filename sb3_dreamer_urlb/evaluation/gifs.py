"""Animations as bytes, for files and for TensorBoard."""

from __future__ import annotations

import io
from collections.abc import Sequence

import numpy as np

from sb3_dreamer_urlb.number_checks import check_integer, is_finite_number

#: viewers show anything shorter than two hundredths of a second at their own, slower speed
LEAST_MILLISECONDS = 20


def encode_gif(frames: Sequence[np.ndarray] | np.ndarray, fps: float, scale: int = 1) -> bytes:
    """An animation that repeats for ever.

    :param frames: uint8 (height, width, 3) each, at least one
    :param fps: frames a second
    :param scale: enlarge each pixel this many times
    :raises ImportError: if pillow is not installed
    :raises ValueError: without frames, or for a rate or a scale that are not positive
    """
    from PIL import Image

    if len(frames) == 0:
        raise ValueError("An animation needs at least one frame, got none.")
    if not is_finite_number(fps) or fps <= 0:
        raise ValueError(f"fps must be a positive number, got {fps!r}.")
    check_integer("scale", scale, 1)
    images = [Image.fromarray(np.ascontiguousarray(frame)) for frame in frames]
    size = (images[0].width * scale, images[0].height * scale)
    images = [image.resize(size, Image.Resampling.NEAREST) for image in images]
    buffer = io.BytesIO()
    duration = max(LEAST_MILLISECONDS, round(1000 / fps))
    images[0].save(buffer, "GIF", save_all=True, append_images=images[1:], duration=duration, loop=0)
    return buffer.getvalue()
