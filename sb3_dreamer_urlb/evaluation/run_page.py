"""One self-contained page of HTML a run: it opens offline and on a phone. Needs the extra ``plots``."""

from __future__ import annotations

import base64
import io
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from sb3_dreamer_urlb.evaluation.names import TASKS
from sb3_dreamer_urlb.evaluation.run_facts import AGENT, RunFacts, thinned
from sb3_dreamer_urlb.evaluation.run_logs import Series
from sb3_dreamer_urlb.evaluation.scores import ORACLE, normalized_score, published_returns
from sb3_dreamer_urlb.evaluation.style import COLORS, RC, check_matplotlib_installed, frames_label
from sb3_dreamer_urlb.version import how_to_install
from sb3_dreamer_urlb.words import mean_and_spread

TEMPLATES = Path(__file__).parent / "templates"
#: headings → beginnings of the tags below them; a tag stands below the first that fits
CHARTS: dict[str, tuple[str, ...]] = {
    "Return of the task": ("rollout/ep_rew_mean", "eval/mean_reward"),
    "Intrinsic reward": ("train/intrinsic", "train/reward_mean", "train/novelty"),
    "World model": ("train/image_loss", "train/vector_loss", "train/reward_loss", "train/kl", "train/discount_loss"),
    "Behaviour": ("train/actor", "train/critic", "train/value", "train/return", "train/entropy"),
}
FILMS = {
    AGENT: "The agent at work",
    "open_loop": "Open-loop prediction: truth, the model's prediction, and their difference. The model saw five observations, "
    "then only the actions.",
}


def run_page(facts: RunFacts, command: str | None = None) -> str:
    """The page of a run.

    :param facts: about it
    :param command: that repeats it; None writes what the folder tells, or the constructor's call
    :return: HTML
    :raises ImportError: if the extra ``plots`` is not installed
    """
    reward = facts.arguments.get("intrinsic_reward")
    return render(
        "run.html.j2",
        title=facts.folder.resolve().name + (f": {reward or 'no pre-training'}" if facts.data else ""),
        facts=facts,
        summary=_summary(facts),
        charts=_charts(facts.series, facts.switch, facts.action_repeat),
        whose=bool(facts.data),
        films={FILMS[kind]: _embedded(path.read_bytes(), "image/gif") for kind, path in facts.films.items()},
        evaluations=[_evaluation(row) for row in facts.rows],
        configuration=sorted(((name, _shown(value)) for name, value in facts.arguments.items()), key=lambda pair: pair[0]),
        spaces={name: _shown(facts.data[name]) for name in ("observation_space", "action_space") if name in facts.data},
        command=command or facts.command or _call(facts),
        warnings=facts.warnings(),
    )


def render(template: str, **values: Any) -> str:
    """Fill in a template of the package.

    :param template: its name
    :param values: that it shows; escaped
    :raises ImportError: if the extra ``plots`` is not installed
    """
    try:
        import jinja2
    except ImportError as error:
        raise ImportError(f"Pages need jinja2; {how_to_install('plots')}.") from error
    loader = jinja2.FileSystemLoader(TEMPLATES)
    environment = jinja2.Environment(loader=loader, autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True)
    return environment.get_template(template).render(**values)


def _summary(facts: RunFacts) -> list[tuple[str, str]]:
    counters = facts.counters
    pretrained = counters.get("pretrained_frames", 0)
    exploring = facts.data.get("phase") == "pretraining"
    lines = [
        ("Exploration", str(facts.arguments.get("intrinsic_reward") or "none")),
        ("Planner", str(facts.arguments.get("planner") or "none")),
        ("Size", str(facts.arguments.get("preset", "paper"))),
        ("Seed", str(facts.arguments.get("seed"))),
        ("Domain", str(facts.data.get("domain") or "not told by the environment")),
        ("Pre-training", frames_label(counters.get("phase_frames", 0) if exploring else pretrained) + " frames"),
        ("Fine-tuning", frames_label(0 if exploring else counters.get("phase_frames", 0)) + " frames"),
        ("Updates", str(counters.get("n_updates", 0))),
        ("Skipped updates", str(counters.get("skipped_updates", 0))),
        ("Faults of environments", str(counters.get("env_faults", 0))),
    ]
    return lines if facts.data else [("Snapshot", "none in the folder")]


def _evaluation(row: Any) -> dict[str, str]:
    task = f"{row.domain}-{row.task}"
    known = task in TASKS and row.is_of_the_benchmark
    return {
        "run": f"{row.method}, {row.seed}",
        "task": task,
        "frames": f"{frames_label(row.pretrain_frames)} + {frames_label(row.finetune_frames)}",
        "planner": row.planner,
        "return": mean_and_spread(row.return_mean, row.return_std, row.episodes),
        "episodes": str(row.episodes),
        "score": f"{100 * normalized_score(task, row.return_mean):.1f} %" if known else "–",
        "oracle": f"{ORACLE[task]:.0f}" if known else "–",
        "paper": f"{published_returns('ours')[task].mean:.0f}" if known else "–",
    }


def _call(facts: RunFacts) -> str:
    if not facts.data:
        return "# Unknown: no snapshot says what the run was."
    arguments = ", ".join(f"{name}={value!r}" for name, value in sorted(facts.arguments.items()) if value is not None)
    frames = facts.counters.get("pretrained_frames", 0)
    if facts.begins_with_fine_tuning:
        kept = ", ".join(f"keep_{name}={value}" for name, value in (facts.data.get("kept") or {}).items())
        steps = facts.counters.get("num_timesteps", 0)
        return (
            f"model = DreamerV2.load(SNAPSHOT, env=env)  # of a pre-training of {frames} frames\n"
            f"model.fine_tune({kept})\nmodel.learn({steps}, reset_num_timesteps=True)"
        )
    # No file knows the environments.
    switch = f", callback=PhaseSwitchCallback({frames}))  # with env=..., if the task was learnt in another" if frames else ")"
    steps = facts.counters.get("num_timesteps", 0)
    return f"model = DreamerV2({facts.data.get('policy')!r}, env, {arguments})\nmodel.learn({steps}{switch}"


def _shown(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, default=str)


# -- pictures inside the page ------------------------------------------------------------------------------------------


def _charts(series: Mapping[str, Series], switch: float | None, repeat: int | None) -> dict[str, list[str]]:
    charts: dict[str, list[str]] = {}
    for heading, beginnings in CHARTS.items():
        tags = [tag for tag in series if tag.startswith(beginnings)]
        if tags:
            charts[heading] = [chart({tag: series[tag]}, tag, switch, repeat) for tag in sorted(tags)]
    return charts


def chart(series: Mapping[str, Series], title: str, switch: float | None = None, repeat: int | None = 1) -> str:
    """Lines over environment frames as SVG, to stand in a page.

    :param series: label → (agent steps, value)
    :param title: above it
    :param switch: agent steps at which the phase changes, marked
    :param repeat: frames an agent step; None, if nobody knows, draws over agent steps
    """
    unit, repeat = ("agent steps", 1) if repeat is None else ("environment frames", repeat)
    check_matplotlib_installed()
    from matplotlib import rc_context
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    with rc_context({**RC, "svg.fonttype": "none", "font.size": 10, "axes.titlesize": 10, "svg.hashsalt": title}):
        figure = Figure(figsize=(3.8, 2.1), layout="constrained")
        FigureCanvasSVG(figure)
        axes = figure.add_subplot()
        for i, (label, points) in enumerate(series.items()):
            x, y = zip(*thinned(points), strict=True)
            marker = "o" if len(x) < 30 else ""
            axes.plot([repeat * step for step in x], y, color=COLORS[i % len(COLORS)], marker=marker, ms=3, label=label)
        if switch is not None:
            axes.axvline(repeat * switch, color="#D55E00", ls="--", lw=1)
            low, high = axes.get_xlim()
            late = repeat * switch > low + 0.65 * (high - low)
            where, side = ((-3, -9), "right") if late else ((3, -9), "left")
            axes.annotate("fine-tuning", (repeat * switch, 1), xycoords=("data", "axes fraction"), xytext=where,
                          textcoords="offset points", ha=side, color="#D55E00", fontsize=8)  # fmt: skip
        axes.set(title=title, xlabel=unit)
        axes.xaxis.set_major_formatter(lambda value, _: frames_label(round(value)))
        if len(series) > 1:
            axes.legend()
        buffer = io.StringIO()
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    svg = buffer.getvalue()
    # Without prologue, metadata and fixed size: as wide as the page.
    svg = re.sub(r"<metadata>.*?</metadata>", "", svg[svg.index("<svg") :], flags=re.DOTALL)
    head, rest = svg.split(">", 1)
    return re.sub(r' (width|height)="[^"]*"', "", head) + ">" + rest


def _embedded(content: bytes, kind: str) -> str:
    return f"data:{kind};base64,{base64.b64encode(content).decode()}"


def embedded_png(path: Path) -> str:
    """A picture as an address that needs no file."""
    return _embedded(path.read_bytes(), "image/png")


def compare_page(title: str, picture: str, caption: str, groups: Sequence[Mapping[str, str]], table: Any) -> str:
    """A page that lays groups of runs side by side.

    :param title: of the page
    :param picture: address of the curves
    :param caption: of the picture
    :param groups: label, runs, settings that differ
    :param table: last returns
    """
    return render("compare.html.j2", title=title, picture=picture, caption=caption, groups=groups, table=table)
