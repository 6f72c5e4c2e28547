"""Seconds per update, paper size unless told otherwise (batch 50×50, H = 15): ``python benchmarks/update.py``."""

from __future__ import annotations

from collections.abc import Callable

from common import make_model, parser, report, seconds

from sb3_dreamer_urlb.learner import Learner
from sb3_dreamer_urlb.types import Posterior, SequenceBatch


def world_model_pass(learner: Learner, batch: SequenceBatch) -> Callable[[], Posterior]:
    """The world model's part of an update: infer, loss, step."""

    def work() -> Posterior:
        model = learner.agent.world_model
        image = model.preprocess(batch.observation)
        posterior = model.observe(image, batch.action, batch.is_first)
        learner._update_world_model(posterior, image, batch)
        return posterior

    return work


def main() -> None:
    """Time a pre-training update (LBS) and a fine-tuning update, whole and in parts, interleaved."""
    options = parser(__doc__).parse_args()
    learners = {
        "pre-training (LBS)": make_model(options, intrinsic_reward="lbs"),
        "fine-tuning": make_model(options),
    }
    rows: dict[str, list[float]] = {}
    batches = {}
    for name, model in learners.items():
        model.learn(max(2 * model.batch_length, 200))  # two finished episodes; no update yet
        batches[name] = model.replay_buffer.sample(model.batch_size)
    for _ in range(options.repeat):
        for name, model in learners.items():
            learner, batch, device = model.learner, batches[name], model.device
            model_pass = world_model_pass(learner, batch)
            posterior = model_pass()
            work = {
                name: lambda learner=learner, batch=batch: learner.update(batch),
                f"{name}, world model": lambda model_pass=model_pass: model_pass(),
                f"{name}, behaviour": lambda learner=learner, state=posterior.state: learner._update_behavior(state.detach()),
            }
            for row, part in work.items():
                rows.setdefault(row, []).extend(seconds(part, 1, device))
    report("update", rows, options, device)


if __name__ == "__main__":
    main()
