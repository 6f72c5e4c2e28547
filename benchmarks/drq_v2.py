"""Seconds of one update of DrQ-v2, paper size unless told otherwise: batches of 256 stacks of three 84×84 frames."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from common import NoiseImages, fill_replay, interleaved, parser, report, set_threads

from sb3_dreamer_urlb import DrQv2
from sb3_dreamer_urlb.output_reader import ending_with_its_reader

PHASES = {"task": None, "pre-training": "disagreement"}
SIZE = 84


@ending_with_its_reader()
def main() -> None:
    """Time an update on a task and one of pre-training; sampling, which a thread may do meanwhile, is timed apart."""
    choice = parser(__doc__)
    choice.add_argument("--phases", nargs="+", default=["task"], choices=PHASES)
    choice.add_argument("--batch-size", type=int, help="steps a batch (default: the preset's, 256 at paper size)")
    options = choice.parse_args()
    set_threads(options)
    own = {} if options.batch_size is None else {"batch_size": options.batch_size}
    size = 16 if options.preset == "tiny" else SIZE
    work: dict[str, Callable[[], object]] = {}
    for precision in options.precision:
        for phase in options.phases:
            env = NoiseImages(size)
            model = DrQv2(
                "CnnPolicy", env, preset=options.preset, device=options.device, seed=0, buffer_size=1000, learning_starts=1000,
                precision=precision, compile=options.compile[0], intrinsic_reward=PHASES[phase], **own,
            )  # fmt: skip
            fill_replay(model, 300)
            model.learner.set_noise(0.2)
            batch = model.replay_buffer.sample(model.batch_size)
            work[f"{phase}, {precision}"] = partial(model.learner.update, batch)
            work.setdefault("sampling", partial(model.replay_buffer.sample, model.batch_size))
    report("drq_v2", interleaved(work, options, model.device), {}, options, model.device)


if __name__ == "__main__":
    main()
