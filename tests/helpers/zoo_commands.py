"""Commands of the zoo on cheap models and environments."""

from __future__ import annotations

from pathlib import Path

from places import ROOT

from sb3_dreamer_urlb import DreamerV2

CONFIGS = ROOT / "zoo_configs"
STAND, FLIP = "urlb/walker-stand-v0", "urlb/walker-flip-v0"
#: a cheap walker under the ids of the benchmark; episodes are short enough to be learnt from at once
CHEAP = {"length": 20, "action_repeat": 2, "domain": "walker"}
TINY = [
    "preset:'tiny'",
    "callback:[{'sb3_dreamer_urlb.zoo.callbacks.RunSnapshotCallback': dict(frames=[40, 80])},"
    "{'sb3_dreamer_urlb.PhaseSwitchCallback': dict(pretrain_frames=80)}]",
]
TRAIN = ["train", "--algo", "dreamerv2", "--seed", "1", "--device", "cpu", "--verbose", "0"]


def train(zoo, env: str = STAND, steps: int = 60, config: str = "lbs", *more: str, params: list[str] | None = None) -> Path:
    """Train a tiny agent; gives the run's folder."""
    options = ["--env", env, "-n", str(steps), "-conf", str(CONFIGS / f"{config}.yml"), "--eval-freq", "-1", *more]
    zoo(*TRAIN, *options, *(["-params", *params] if params else []))
    return latest_run(env)


def latest_run(env: str, logs: Path = Path("logs")) -> Path:
    return max((logs / "dreamerv2").glob(f"{env.replace('/', '-')}_*"), key=lambda path: int(path.name.split("_")[-1]))


def model_in(folder: Path, env: str = STAND) -> DreamerV2:
    return DreamerV2.load(folder / f"{env.replace('/', '-')}.zip", device="cpu")
