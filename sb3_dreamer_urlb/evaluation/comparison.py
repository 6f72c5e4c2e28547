"""Runs, or groups of seeds, side by side."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from sb3_dreamer_urlb.evaluation.aggregate import Estimate, standard_error
from sb3_dreamer_urlb.evaluation.run_facts import RunFacts
from sb3_dreamer_urlb.evaluation.style import COLUMN, Picture, finish, frames_label, lines, new_figure
from sb3_dreamer_urlb.evaluation.tables import Table, with_error
from sb3_dreamer_urlb.unknown_names import did_you_mean

POINTS = 100
#: arguments in which the runs of one setting may differ
OF_ONE_SETTING = {"seed", "tensorboard_log", "verbose"}
#: tags of logs, in words
IN_WORDS = {"eval/mean_reward": "return of evaluations", "rollout/ep_rew_mean": "return of training episodes"}


def compare(
    groups: Mapping[str, Sequence[RunFacts]], tag: str | None, tags: Sequence[str]
) -> tuple[Picture, Table, list[dict[str, str]]]:
    """Curves, last values and settings of groups of runs.

    :param groups: label → its runs
    :param tag: of the log; None takes the first of ``tags`` that all runs have
    :param tags: to choose from
    :return: picture, table, and for each group its label, runs and the settings that not all groups share
    :raises ValueError: if no such log is there in all runs
    """
    runs = [(label, run) for label, members in groups.items() for run in members]
    wanted = [tag] if tag else list(tags)
    shared = [name for name in wanted if all(run.series.get(name) for _, run in runs)]
    if not shared:
        raise ValueError(_no_such_log(wanted, [run for _, run in runs]))
    name = shared[0]
    unknown = [str(run.folder) for _, run in runs if run.action_repeat is None]
    if unknown and len(unknown) < len(runs):
        raise ValueError(
            f"How many environment frames a step has is known of some runs only, not of {', '.join(unknown)}, whose snapshots "
            "cannot be read: their curves cannot stand over the same frames."
        )
    unit = "agent steps" if unknown else "environment frames"
    figure, [axes] = new_figure(1, COLUMN * 1.4, 2.3)
    curves = {label: _mean_curve(members, name) for label, members in groups.items()}
    # Where all have been: longer runs may have learnt more by their own end.
    end = min(max(points) for points in curves.values())
    common = end >= max(min(points) for points in curves.values())
    where = (
        f"at {frames_label(end)} {unit}, which all have come to" if common else "at the end of each, for no frames are common"
    )
    table = Table("comparison", f"{name} {where}: mean ± standard error of the seeds.", ["", name, unit.split()[-1], "seeds"])
    handles = []
    for i, (label, members) in enumerate(groups.items()):
        points = curves[label]
        handles += lines(axes, {label: points}, {at: float(at) for at in points}, 1, band=True, first=i)
        for run in members:
            if run.switch is not None:
                axes.axvline(run.switch * (run.action_repeat or 1), color="#999999", ls=":", lw=0.8, zorder=1)
        last = end if common else max(points)
        value = _mean_at(_frames_and_values(members, name), last)
        table.lines.append([label, with_error(value, digits=1), frames_label(last), str(len(members))])
    what = IN_WORDS.get(name, name)
    axes.set(xlabel=unit, ylabel=what)
    axes.xaxis.set_major_formatter(lambda value, _: frames_label(round(value)))
    counts = ", ".join(f"{label}: {len(members)}" for label, members in groups.items())
    switched = " Dotted: fine-tuning begins." if any(run.switch is not None for _, run in runs) else ""
    one = " One seed has no band." if any(len(members) == 1 for members in groups.values()) else ""
    caption = (
        f"{what[0].upper()}{what[1:]} ({name}) over {unit}; bands: mean ± standard error of the seeds "
        f"({counts}).{one}{switched}"
    )
    return finish("comparison", figure, caption, False, handles, 2), table, _settings(groups)


def _no_such_log(wanted: Sequence[str], runs: Sequence[RunFacts]) -> str:
    """
    :param wanted: tags, of which one would have been enough
    :param runs: which do not share any
    :return: what to tell
    """
    lacking = [str(run.folder) for run in runs if not any(run.series.get(name) for name in wanted)]
    shared = sorted(set.intersection(*(set(run.series) for run in runs)))
    there_are = (
        f"--tag takes what all of them log: {', '.join(shared)}.{did_you_mean(wanted, shared)}"
        if shared
        else (
            "A run logs with tensorboard_log=... (--tensorboard-log of the zoo, whose folder is to be named then), "
            "and what it logs has its name in --tag."
        )
    )
    return f"Not all runs have a log of {' or '.join(wanted)}: {', '.join(lacking) or 'each has another'}. {there_are}"


def _mean_curve(members: Sequence[RunFacts], name: str) -> dict[int, Estimate]:
    """Over the frames that all runs of a group have come to."""
    curves = _frames_and_values(members, name)
    begin, end = max(curve[0, 0] for curve in curves), min(curve[-1, 0] for curve in curves)
    if begin > end:
        raise ValueError(f"{', '.join(str(run.folder) for run in members)} have no frames in common.")
    return {int(at): _mean_at(curves, at) for at in np.unique(np.linspace(begin, end, POINTS).round())}


def _frames_and_values(members: Sequence[RunFacts], name: str) -> list[np.ndarray]:
    return [np.array(run.series[name], float) * (run.action_repeat or 1, 1) for run in members]


def _mean_at(curves: Sequence[np.ndarray], frames: float) -> Estimate:
    """Mean of runs ± its standard error.

    :param curves: frames and value of each run, (n, 2)
    :param frames: where; between two points of a run on the line through them
    """
    values = [float(np.interp(frames, curve[:, 0], curve[:, 1])) for curve in curves]
    mean, error = float(np.mean(values)), standard_error(values)
    return Estimate(mean, mean - error, mean + error, 1, (len(curves), len(curves)))


def mixtures(groups: Mapping[str, Sequence[RunFacts]]) -> list[str]:
    """Groups whose runs are no seeds of one setting, each in a line: what they differ in, or a seed that is there twice.

    :param groups: label → its runs
    """
    found = []
    for label, members in groups.items():
        known = [run for run in members if run.data]
        facts = [{**run.arguments, "domain": run.data.get("domain"), "task": run.data.get("learnt_task")} for run in known]
        names = sorted({name for one in facts for name in one} - OF_ONE_SETTING)
        values = {name: list(dict.fromkeys(str(one.get(name)) for one in facts)) for name in names}
        differ = [f"{name}={' / '.join(shown)}" for name, shown in values.items() if len(shown) > 1]
        seeds = [one.get("seed") for one in facts if one.get("seed") is not None]
        twice = dict.fromkeys(str(seed) for seed in seeds if seeds.count(seed) > 1)
        differ += [f"seed {', '.join(twice)} more than once"] * bool(twice)
        found += [f"{label}: {'; '.join(differ)}"] * bool(differ)
    return found


def _settings(groups: Mapping[str, Sequence[RunFacts]]) -> list[dict[str, str]]:
    names = sorted({name for members in groups.values() for run in members for name in run.arguments} - OF_ONE_SETTING)
    values = {name: {repr(run.arguments.get(name)) for members in groups.values() for run in members} for name in names}
    differ = [name for name in names if len(values[name]) > 1]
    rows = []
    for label, members in groups.items():
        own = {name: sorted({repr(run.arguments.get(name)) for run in members}) for name in differ}
        settings = "; ".join(f"{name}={' / '.join(shown)}" for name, shown in own.items()) or "the same settings"
        rows.append({"label": label, "runs": ", ".join(str(run.folder) for run in members), "settings": settings})
    return rows
