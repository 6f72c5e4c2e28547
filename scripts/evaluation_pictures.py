"""Draws the pictures of docs/evaluation.md: python scripts/evaluation_pictures.py

Tables' figures come from made-up rows, and say so; the comparison from the episodes in results/evidence."""

from __future__ import annotations

import argparse
import csv
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
            shrink(path, out / path.name)


def shrink(path: Path, target: Path) -> None:
    """A page of pictures should load quickly."""
    Image.open(path).convert("RGB").quantize(256, dither=Image.Dither.NONE).save(target, optimize=True)


def draw_comparison(out: Path) -> None:
    """Runs of results/evidence as `compare` shows them.

    :param out: folder of the picture
    """
    with open(ROOT / "results" / "evidence" / "episodes.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    with tempfile.TemporaryDirectory() as folder:
        groups = {}
        for label, arm in (("LBS, actor kept", "lbs-kept"), ("from scratch", "scratch")):
            for run in sorted({row["run"] for row in rows if row["run"].startswith(f"run/{arm}/")}):
                path = Path(folder) / run
                path.mkdir(parents=True)
                with open(path / "progress.csv", "w", newline="") as file:
                    writer = csv.writer(file)
                    writer.writerow(["time/total_timesteps", "time/phase_frames", "rollout/ep_rew_mean"])
                    # Two frames make a step.
                    own = ((int(row["step"]), row["return"]) for row in rows if row["run"] == run)
                    writer.writerows((step, 2 * step, value) for step, value in own)
                groups.setdefault(label, []).append(str(path))
        page = Path(folder) / "comparison.html"
        main(["compare", *(f"{label}={','.join(paths)}" for label, paths in groups.items()), "--out", str(page)])
        shrink(page.with_suffix(".png"), out / "comparison.png")


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    draw(ROOT / "docs" / "images" / "evaluation")
    draw_comparison(ROOT / "docs" / "images" / "evaluation")
