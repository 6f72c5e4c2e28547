"""Draw the tasks for docs/tasks.md, one picture with a label each.

    python scripts/task_pictures.py docs/images/tasks.png

Each is shown after a second of random actions from seed 0, as people see it, not as the agent does.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import gymnasium
import numpy as np
from PIL import Image, ImageDraw

from sb3_dreamer_urlb.cli.tasks import tasks

SIZE, COLUMNS, LABEL = 160, 6, 14  # pixels, pictures a row, pixels


def picture(name: str) -> Image.Image:
    """One task.

    :param name: its id
    """
    env = gymnasium.make(name, observation="state", render_mode="rgb_array", render_size=SIZE)
    env.reset(seed=0)
    env.action_space.seed(0)
    for _ in range(20):
        env.step(env.action_space.sample())
    frame = np.asarray(env.render())
    env.close()
    labelled = Image.new("RGB", (SIZE, SIZE + LABEL), "white")
    labelled.paste(Image.fromarray(frame), (0, LABEL))
    short = name.removesuffix("-v0").replace("urlb/", "").replace("jaco-reach_", "jaco ")
    ImageDraw.Draw(labelled).text((2, 1), short, fill="black")
    return labelled


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("out", type=Path)
    out = parser.parse_args().out
    pictures = [picture(task.id) for task in tasks()]
    rows = -(-len(pictures) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * SIZE, rows * (SIZE + LABEL)), "white")
    for place, one in enumerate(pictures):
        sheet.paste(one, (place % COLUMNS * SIZE, place // COLUMNS * (SIZE + LABEL)))
    sheet.quantize(128).save(out, optimize=True)


if __name__ == "__main__":
    main()
