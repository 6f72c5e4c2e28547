"""Draw the method as a picture: python scripts/draw_method.py writes docs/images/method.svg, with nothing but Python."""

from __future__ import annotations

import argparse
from pathlib import Path

TARGET = Path(__file__).resolve().parent.parent / "docs" / "images" / "method.svg"
WIDTH, HEIGHT = 920, 330
# One card with its own ground, so that it is legible on light and on dark pages.
GROUND, INK, SOFT = "#f6f8fa", "#1f2328", "#57606a"
ENV, MODEL, DRIVE, ACT = "#d8e2ec", "#cfe8d5", "#fde3b3", "#d9d4f2"


def box(x: int, y: int, width: int, height: int, fill: str, *lines: str) -> str:
    """A rounded box; its first line is bold."""
    parts = [f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="8" fill="{fill}" stroke="{SOFT}"/>']
    top = y + height / 2 - 9 * (len(lines) - 1) + 5
    for number, line in enumerate(lines):
        style = 'font-weight="bold"' if number == 0 else 'font-size="13"'
        parts.append(f'<text x="{x + width / 2:g}" y="{top + 18 * number:g}" text-anchor="middle" {style}>{line}</text>')
    return "\n".join(parts)


def arrow(x1: int, y1: int, x2: int, y2: int, label: str = "", dx: int = 0, dy: int = -7) -> str:
    """An arrow with a label at its middle."""
    line = f'<path d="M{x1} {y1} L{x2} {y2}" stroke="{INK}" stroke-width="1.6" marker-end="url(#head)"/>'
    if not label:
        return line
    x, y = (x1 + x2) / 2 + dx, (y1 + y2) / 2 + dy
    return f'{line}\n<text x="{x:g}" y="{y:g}" text-anchor="middle" font-size="12" fill="{SOFT}">{label}</text>'


def title(x: int, text: str, below: str) -> str:
    """A phase's heading."""
    return (
        f'<text x="{x}" y="36" font-size="18" font-weight="bold">{text}</text>\n'
        f'<text x="{x}" y="56" font-size="13" fill="{SOFT}">{below}</text>'
    )


def draw() -> str:
    """The whole picture as SVG."""
    parts = [
        title(24, "1  Pre-training", "2M frames without rewards, once a domain"),
        box(24, 84, 150, 64, ENV, "Environment", "pixels"),
        box(280, 84, 150, 64, MODEL, "World model", "predicts pixels"),
        box(280, 216, 150, 64, DRIVE, "Surprise (LBS)", "intrinsic reward"),
        box(24, 216, 150, 64, ACT, "Actor, critic", "learn in dreams"),
        arrow(174, 116, 278, 116, "replay"),
        arrow(355, 148, 355, 214, "posterior", 33, 4),
        arrow(280, 248, 176, 248, "reward"),
        arrow(99, 216, 99, 150, "actions", 28, 4),
        arrow(280, 140, 176, 224, "dreams", -20, -10),
        f'<path d="M460 24 L460 {HEIGHT - 24}" stroke="{SOFT}" stroke-dasharray="4 5"/>',
        arrow(430, 100, 500, 100),
        f'<text x="465" y="90" text-anchor="middle" font-size="12" fill="{SOFT}">kept</text>',
        title(490, "2  Fine-tuning", "100k frames of one task; the actor is kept where rewards are dense"),
        box(502, 84, 150, 64, MODEL, "World model", "learns the reward, too"),
        box(746, 84, 150, 64, ENV, "Environment", "pixels and rewards"),
        box(502, 216, 150, 64, ACT, "Actor, critic", "learn in dreams"),
        box(746, 216, 150, 64, DRIVE, "Dyna-MPC", "plans in the model"),
        arrow(746, 116, 654, 116, "replay"),
        arrow(577, 148, 577, 214, "dreams", 28, 4),
        arrow(652, 248, 744, 248, "proposals"),
        arrow(652, 140, 748, 222, "imagination", 34, -8),
        arrow(821, 216, 821, 150, "actions", 28, 4),
    ]
    marker = (
        '<marker id="head" viewBox="0 0 8 8" refX="7" refY="4" markerWidth="7" markerHeight="7" orient="auto">'
        f'<path d="M0 0 L8 4 L0 8 z" fill="{INK}"/></marker>'
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="The two phases"\n'
        f'     font-family="Helvetica, Arial, sans-serif" font-size="15" fill="{INK}">\n'
        f"<defs>{marker}</defs>\n"
        f'<rect width="{WIDTH}" height="{HEIGHT}" rx="12" fill="{GROUND}"/>\n' + "\n".join(parts) + "\n</svg>\n"
    )


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    TARGET.write_text(draw())
