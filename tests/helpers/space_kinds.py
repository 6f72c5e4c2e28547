"""One space of every kind that agents may see and act in."""

from __future__ import annotations

import numpy as np
from gymnasium import spaces

IMAGE = spaces.Box(0, 255, (16, 20, 3), np.uint8)
VECTOR = spaces.Box(-np.inf, np.inf, (5,), np.float64)
OBSERVATIONS = {
    "wide image": ("CnnPolicy", IMAGE, {}),
    "grey image": ("CnnPolicy", spaces.Box(0, 255, (36, 36, 1), np.uint8), {}),
    "channels first": ("CnnPolicy", spaces.Box(0, 255, (3, 32, 32), np.uint8), {}),
    "float image": ("CnnPolicy", spaces.Box(-1, 1, (3, 16, 16), np.float32), {"normalize_images": False}),
    "vector": ("MlpPolicy", VECTOR, {}),
    "one number": ("MlpPolicy", spaces.Box(-1, 1, (1,), np.float32), {}),
    "matrix": ("MlpPolicy", spaces.Box(-1, 1, (2, 3), np.float32), {}),
    "flattened image": ("MlpPolicy", spaces.Box(0, 255, (4, 4, 1), np.uint8), {}),
    "discrete": ("MlpPolicy", spaces.Discrete(4, start=-1), {}),
    "multi-discrete": ("MlpPolicy", spaces.MultiDiscrete([2, 3]), {}),
    "multi-binary": ("MlpPolicy", spaces.MultiBinary(3), {}),
    "dict": (
        "MultiInputPolicy",
        spaces.Dict({"camera": IMAGE, "joints.a": VECTOR, "mode": spaces.Discrete(3), "lamps": spaces.MultiBinary(2)}),
        {},
    ),
}
ACTIONS = {
    "discrete": spaces.Discrete(3),
    "from two": spaces.Discrete(3, start=2),
    "multi-discrete": spaces.MultiDiscrete([2, 4, 3]),
    "table": spaces.MultiDiscrete(np.array([[2, 3], [4, 2]])),
    "box": spaces.Box(-2, 5, (2, 3), np.float64),
    "whole numbers": spaces.Box(0, 10, (2,), np.int32),
}
