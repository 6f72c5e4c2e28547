"""Random shifts: whole pixels of the image with its edges repeated outwards, by every shift there is."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest
import torch as th
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from sb3_dreamer_urlb.drq_v2.augmentation import random_shift, shift


def by_hand(image, down, right, pad):
    """One image (C, height, width), padded by numpy and cut by slices."""
    padded = np.pad(image, ((0, 0), (pad, pad), (pad, pad)), mode="edge")
    return padded[:, down : down + image.shape[1], right : right + image.shape[2]]


@given(st.integers(1, 3), st.integers(5, 12), st.integers(5, 12), st.integers(0, 4), st.data())
def test_a_shift_is_a_crop(channels, height, width, pad, data):
    down, right = (data.draw(st.lists(st.integers(0, 2 * pad), min_size=3, max_size=3)) for _ in range(2))
    images = np.random.default_rng(height).integers(0, 256, (3, channels, height, width), np.uint8)
    found = shift(th.from_numpy(images), th.tensor(down), th.tensor(right), pad)
    expected = [by_hand(*its, pad) for its in zip(images, down, right, strict=True)]
    assert found.dtype == th.uint8
    assert np.array_equal(found.numpy(), np.stack(expected))


def test_it_is_what_bilinear_sampling_at_whole_pixels_gives():
    size, pad = 12, 4
    images = th.randint(0, 256, (4, 2, size, size), dtype=th.uint8)
    down, right = th.tensor([0, 3, 8, 4]), th.tensor([8, 1, 0, 4])
    padded = F.pad(images.float(), (pad,) * 4, mode="replicate")
    # Centres of the pixels that are cut out, in grid_sample's coordinates from -1 to 1.
    places = 2 * (th.arange(size) + 0.5) / (size + 2 * pad) - 1
    step = 2 / (size + 2 * pad)
    rows = (places + down[:, None] * step).view(4, size, 1).expand(4, size, size)
    columns = (places + right[:, None] * step).view(4, 1, size).expand(4, size, size)
    sampled = F.grid_sample(padded, th.stack([columns, rows], -1), align_corners=False)
    assert th.allclose(shift(images, down, right, pad).float(), sampled, atol=1e-2)


def test_every_shift_comes_as_often_as_any_other(seeded):
    # The pixel in the middle tells the shift.
    pixels = th.arange(81, dtype=th.uint8).view(1, 1, 9, 9).expand(20_000, 2, 9, 9)
    shifted = random_shift(pixels, pad=4)
    assert th.equal(shifted[:, 0], shifted[:, 1])
    counts = Counter(shifted[:, 0, 4, 4].tolist())
    assert sorted(counts) == list(range(81))
    assert all(abs(count - 20_000 / 81) < 90 for count in counts.values())


@pytest.mark.parametrize("dtype", [th.uint8, th.float32])
def test_no_padding_no_shift(dtype):
    images = th.randint(0, 256, (3, 2, 5, 5)).to(dtype)
    assert th.equal(random_shift(images, pad=0), images)
