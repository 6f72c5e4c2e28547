"""Random shifts (DrQ-v2): the augmentation that lets a critic learn from pixels."""

from __future__ import annotations

import torch as th

#: pixels by which the edges are repeated outwards
PAD = 4


def random_shift(images: th.Tensor, pad: int = PAD) -> th.Tensor:
    """Repeat the edges ``pad`` pixels outwards, and cut the old size out at a place of its own for each image.

    Offsets are integers, so the bilinear sampling of the authors' code picks whole pixels: here they are picked at once.

    :param images: of any dtype, (B, C, height, width)
    :param pad: largest shift in pixels; 0 leaves the images as they are
    :return: likewise, each image shifted by up to ``pad`` pixels, all of its channels alike
    """
    if pad == 0:
        return images
    offsets = th.randint(0, 2 * pad + 1, (2, len(images)), device=images.device)
    return shift(images, offsets[0], offsets[1], pad)


def shift(images: th.Tensor, down: th.Tensor, right: th.Tensor, pad: int) -> th.Tensor:
    """Cut each image out of its padded self.

    :param images: (B, C, height, width)
    :param down: first row that is cut out of each padded image, 0 to 2 · pad, int64 (B,)
    :param right: first column, likewise
    :param pad: pixels by which the edges were repeated
    """
    count, channels, height, width = images.shape
    rows = (th.arange(height, device=images.device) + down[:, None] - pad).clamp_(0, height - 1)
    columns = (th.arange(width, device=images.device) + right[:, None] - pad).clamp_(0, width - 1)
    picked = images.gather(2, rows.view(count, 1, height, 1).expand(count, channels, height, width))
    return picked.gather(3, columns.view(count, 1, 1, width).expand(count, channels, height, width))
