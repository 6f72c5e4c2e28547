"""Learning curves of any arms, with intervals."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from sb3_dreamer_urlb.evaluation.aggregate import Estimate, mean_and_error
from sb3_dreamer_urlb.evaluation.arms import Arm
from sb3_dreamer_urlb.evaluation.figure_parts import REFERENCE_NAMES
from sb3_dreamer_urlb.evaluation.names import ALIASES, TASKS
from sb3_dreamer_urlb.evaluation.row import FALSE, NONE, TRUE
from sb3_dreamer_urlb.evaluation.rows import REQUIRED, Row, frames, texts
from sb3_dreamer_urlb.evaluation.scores import DREAMER_2M
from sb3_dreamer_urlb.evaluation.style import COLUMN, PAGE, Picture, finish, frames_label, lines, new_figure
from sb3_dreamer_urlb.transfer_rule import keeps_actor

PANELS = 4
#: value of ``keep_actor`` in a condition
TASK_AWARE = "task_aware"


def selected(rows: Iterable[Row], text: str) -> Arm:
    """The rows that somebody asks for.

    :param rows: to choose from
    :param text: such as ``"method=lbs planner=none"``, with ``label=...`` (underscores are spaces) to name it; commas or
        spaces between the conditions. ``keep_actor=task_aware``: as the paper's rule has it for each domain
    :raises ValueError: for a condition that cannot be read, a column that no row has, or no rows
    """
    rows = list(rows)
    known = {*REQUIRED, *(name for row in rows for name in row.further)}
    if not text.strip():
        raise ValueError("Expected COLUMN=VALUE, got no condition at all.")
    label = text
    conditions: dict[str, str] = {}
    for part in text.replace(",", " ").split():
        name, equals, value = part.partition("=")
        if not equals or (name not in known and name != "label"):
            raise ValueError(f"{text!r}: expected COLUMN=VALUE with a column of {', '.join(sorted(known))}, got {part!r}.")
        if name == "label":
            label = value.replace("_", " ")
        elif conditions.setdefault(name, _as_written(name, value)) != _as_written(name, value):
            raise ValueError(f"{text!r}: {name} is given twice, and no row has two of it.")
    rule = conditions.get("keep_actor") == TASK_AWARE
    if rule:
        del conditions["keep_actor"]
    found = tuple(
        row
        for row in rows
        if all(texts(row).get(name, "") == value for name, value in conditions.items())
        and (not rule or row.keep_actor in (None, keeps_actor(row.domain)))
    )
    if not found:
        raise ValueError(f"No row has {text!r}.")
    return Arm(label, found)


def _as_written(name: str, value: str) -> str:
    if name in ("pretrain_frames", "finetune_frames"):
        return str(frames(name, value))
    if name == "method":
        return ALIASES.get(value.lower(), value.lower())
    if name in ("keep_actor", "keep_critic") and value.lower() in (*TRUE, *FALSE):
        return "" if value.lower() in (NONE, "") else str(value.lower() in TRUE).lower()
    if name in ("seed", "episodes") and value.isdecimal():
        return str(int(value))
    return value.lower() if name in ("domain", "task", "keep_actor", "keep_critic", "planner") else value


def curve(arm: Arm, normalizer: str | None) -> dict[int, Estimate]:
    """Mean over tasks ± standard error of the seeds, by frames of fine-tuning.

    :param arm: with all evaluations of its runs
    :param normalizer: of scores, None for returns
    """
    points = sorted({row.finetune_frames for row in arm.rows})
    found = {
        at: mean_and_error(Arm("", tuple(row for row in arm.rows if row.finetune_frames == at)).scores(normalizer))
        for at in points
    }
    # A mean over other tasks than before would be a jump that no agent made.
    tasks = max((one.tasks for one in found.values()), default=0)
    return {at: one for at, one in found.items() if one.tasks == tasks}


def learning_curves(
    arms: Sequence[Arm], normalizer: str = DREAMER_2M, synthetic: bool = False, name: str = "learning_curves"
) -> Picture:
    """Curves of arms side by side: their mean where all tasks have a reference, and every task by itself if they are few.

    :param arms: with all evaluations of their runs
    :param normalizer: of scores
    :param synthetic: mark as made up
    :param name: of the files
    :raises ValueError: if an arm holds runs that differ in more than seed and task: they would be averaged
    """
    for arm in arms:
        _check_one_row_a_run(arm)
    tasks = sorted({f"{row.domain}-{row.task}" for arm in arms for row in arm.rows})
    scored = all(task in TASKS for task in tasks)
    panels: list[tuple[str, str | None]] = [("mean of the tasks", None)] if scored and len(tasks) > 1 else []
    if len(tasks) + len(panels) <= PANELS:
        panels += [(task.replace("-", " ", 1), task) for task in tasks]
    figure, axes = new_figure(len(panels), PAGE if len(panels) > 1 else COLUMN * 1.3)
    handles: list[Any] = []
    for one, (title, task) in zip(axes, panels, strict=True):
        parts = {arm.label: _of_task(arm, task) for arm in arms}
        series = {label: curve(part, normalizer if scored else None) for label, part in parts.items()}
        drawn = _drawn(one, series, 100 if scored else 1)
        handles = handles or drawn
        one.set(title=title, xlabel="fine-tuning frames", ylabel="normalised score (%)" if scored else "return")
        one.xaxis.set_major_formatter(lambda value, _: frames_label(round(value)))
    numbers = [len(values) for arm in arms for values in _seeds_by_task(arm).values()]
    seeds = f"{min(numbers)} seeds" if min(numbers) == max(numbers) else f"{min(numbers)} to {max(numbers)} seeds"
    unit = f"Normalised score in % of {REFERENCE_NAMES[normalizer]}" if scored else "Undiscounted return"
    caption = f"Evaluations while fine-tuning. {unit}; bands: mean ± standard error of {seeds} a task."
    return finish(name, figure, caption, synthetic, handles, 3 if len(panels) > 1 else 2)


def _check_one_row_a_run(arm: Arm) -> None:
    seen: dict[tuple[Any, ...], Row] = {}
    for row in arm.rows:
        other = seen.setdefault((row.domain, row.task, row.seed, row.finetune_frames), row)
        if other is not row:
            one, two = dict(row.key), dict(other.key)
            columns = ", ".join(name for name in sorted({*one, *two}) if one.get(name) != two.get(name))
            raise ValueError(
                f"{arm.label!r} holds runs that differ in {columns} and would be averaged: choose one of them by COLUMN=VALUE."
            )


def _drawn(axes: Any, series: Mapping[str, Mapping[int, Estimate]], scale: float) -> list[Any]:
    # Each over its own frames: another arm's evaluations are no gaps of this one.
    return [
        lines(axes, {label: points}, {at: float(at) for at in points}, scale, band=True, first=i)[0]
        for i, (label, points) in enumerate(series.items())
        if points
    ]


def _of_task(arm: Arm, task: str | None) -> Arm:
    return Arm(arm.label, tuple(row for row in arm.rows if task in (None, f"{row.domain}-{row.task}")))


def _seeds_by_task(arm: Arm) -> dict[str, set[int]]:
    seeds: dict[str, set[int]] = {}
    for row in arm.rows:
        seeds.setdefault(f"{row.domain}-{row.task}", set()).add(row.seed)
    return seeds
