"""Draws the pictures of docs/evaluation.md from made-up rows, which they say: python scripts/evaluation_pictures.py"""

from __future__ import annotations

import sys
import tempfile
from pathlib import Path

from PIL import Image

from sb3_dreamer_urlb.__main__ import main
from sb3_dreamer_urlb.evaluation.append import append_rows

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "tests" / "helpers"))
METHODS = ("lbs", "plan2explore", "apt", "diayn", "random")
LBS = "method=lbs,planner=none,pretrain_frames=2M,keep_actor=task_aware,keep_critic=false,perturbation=,variant=,label=LBS"


def draw(out: Path) -> None:
    """
    :param out: folder of the pictures
    """
    from made_up_rows import made_up_rows

    with tempfile.TemporaryDirectory() as folder:
        rows, figures = Path(folder) / "rows.csv", Path(folder) / "figures"
        append_rows(rows, made_up_rows(3, METHODS))
        curves = ["--curves", LBS, "method=dreamer,perturbation=,label=no_pre-training"]
        main(["figures", str(rows), "--out", str(figures), "--repetitions", "200", *curves])
        for path in sorted(figures.glob("*.png")):
            # A page of them should load quickly.
            picture = Image.open(path).convert("RGB").quantize(256, dither=Image.Dither.NONE)
            picture.save(out / path.name, optimize=True)


if __name__ == "__main__":
    draw(ROOT / "docs" / "images" / "evaluation")
