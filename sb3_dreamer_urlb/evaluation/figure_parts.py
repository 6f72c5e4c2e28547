"""What the paper's figures share: domains, the words of their captions, bars by domain."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence

from sb3_dreamer_urlb.envs.registration import URLB_TASKS
from sb3_dreamer_urlb.evaluation.aggregate import Estimate, mean_and_error, of_domain
from sb3_dreamer_urlb.evaluation.arms import Arm, Study
from sb3_dreamer_urlb.evaluation.rows import Row
from sb3_dreamer_urlb.evaluation.scores import DREAMER_2M, URLB_EXPERT
from sb3_dreamer_urlb.evaluation.style import COLUMN, PAGE, Picture, bars, finish, frames_label, new_figure
from sb3_dreamer_urlb.words import counted

OVERALL = "overall"
DOMAINS: dict[str, str | None] = {OVERALL: None, **{domain: domain for domain in URLB_TASKS}}
TASKS_OF = {OVERALL: 12, **dict.fromkeys(URLB_TASKS, 4)}
REFERENCE_NAMES = {DREAMER_2M: "Dreamer@2M", URLB_EXPERT: "the URLB expert"}


def normalized(study: Study) -> str:
    return f"Normalised score in % of {REFERENCE_NAMES[study.normalizer]}"


def seeds(arms: Sequence[Arm]) -> str:
    """How many seeds a method has of a task, over all arms; of exactly the rows that a figure shows."""
    numbers = [count for arm in arms for count in Counter((row.method, row.domain, row.task) for row in arm.rows).values()]
    if not numbers:
        return "no runs"
    low, high = min(numbers), max(numbers)
    return f"{counted(low, 'seed')} a task" if low == high else f"{low} to {high} seeds a task"


def unscored(arms: Sequence[Arm]) -> str:
    """What a caption of scores says about the tasks that have none."""
    names = sorted({task for arm in arms for task in arm.unscored_tasks()})
    return f" Left out, as no reference score is known: {', '.join(names)}." if names else ""


def after(study: Study, pretrain: bool = True) -> str:
    before = f"{frames_label(study.pretrain)} frames of pre-training and " if pretrain and study.pretrain else ""
    return f"after {before}{frames_label(study.finetune)} frames of fine-tuning"


def by_domain(study: Study, arm: Arm) -> list[Estimate]:
    scores = arm.scores(study.normalizer)
    return [mean_and_error(of_domain(scores, domain)) for domain in DOMAINS.values()]


def is_method(name: str) -> Callable[[Row], bool]:
    return lambda row: row.method == name


def split_by(arms: Sequence[Arm], column: str) -> list[Arm]:
    values = {row[column] for arm in arms for row in arm.rows}
    parts = [Arm(arm.label, tuple(row for row in arm.rows if row[column] == value)) for arm in arms for value in values]
    return [part for part in parts if part.rows]


def domain_bars(study: Study, name: str, arms: Sequence[Arm], title: str, caption: str, width: float = PAGE) -> Picture | None:
    without = unscored(arms)
    arms = [arm.scored() for arm in arms]
    if not any(arm.rows for arm in arms):
        return None
    study.show(arms)
    figure, [axes] = new_figure(1, width)
    series = {arm.label: by_domain(study, arm) for arm in arms}
    handles = bars(axes, list(DOMAINS), series, list(TASKS_OF.values()))
    axes.set(ylabel="normalised score (%)", title=title)
    text = f"{caption} {normalized(study)}, mean over tasks ± standard error; {seeds(arms)}.{without}"
    return finish(name, figure, text, study.synthetic, handles, 4 if width > COLUMN else 2)
