"""Films of a run while it learns: the agent at work, and what its world model thinks will happen."""

from __future__ import annotations

import os
import warnings
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import TensorBoardOutputFormat
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv

from sb3_dreamer_urlb.evaluation import recording
from sb3_dreamer_urlb.evaluation.films import labelled_agent, labelled_open_loop
from sb3_dreamer_urlb.evaluation.gifs import encode_gif
from sb3_dreamer_urlb.evaluation.open_loop import has_image, pictures_in, predict_open_loop
from sb3_dreamer_urlb.folders import check_folder, made_folder
from sb3_dreamer_urlb.number_checks import check_integer
from sb3_dreamer_urlb.signatures import WithKnownKeywords

if TYPE_CHECKING:
    from torch.utils.tensorboard.writer import SummaryWriter

    from sb3_dreamer_urlb.dreamer_v2 import DreamerV2

AGENT, OPEN_LOOP = "video/agent", "video/open_loop"
#: faster animations than this leave frames out
MAX_FPS = 25


class VideoCallback(WithKnownKeywords, BaseCallback):
    """Films for TensorBoard's *Images* tab, every so many steps: ``video/agent`` and ``video/open_loop``.

    ``video/agent`` is the beginning of an episode in an environment of its own, with the planner if it is on.
    ``video/open_loop`` is a part of the same episode in three panels: truth, model, error. The model sees the first
    ``context`` observations, then only the actions. Vectors have no open-loop film; of a Dict, the first image is shown.
    Both are enlarged and labelled.

    Learning is not touched: training's random draws and environments stay as they are without this callback. A ``learn``
    with neither TensorBoard nor ``folder`` films nothing, with a warning.

    Films are GIFs, written past SB3's ``Video``: torch hands that to moviepy, and with moviepy 2 an empty image arrives
    (pytorch issue 147317).

    :param env: to play in: a VecEnv of one environment, used as it is, an environment or its id; None makes one of the
        same id as the training environment (the one of the present phase, if ``PhaseSwitchCallback`` changes it)
    :param video_freq: agent steps between two films
    :param video_length: agent steps of a film of the agent, at most
    :param context: observations that the model sees
    :param horizon: observations that it predicts
    :param open_loop_start: first observation of the episode that the model sees
    :param deterministic: act without exploration
    :param folder: for GIF files, ``agent_<steps>.gif`` and ``open_loop_<steps>.gif``; None writes none
    :param verbose: 1 prints each film
    :raises ValueError: for numbers that are not positive; and, when ``learn`` begins, if nothing can be filmed
    """

    def __init__(
        self,
        env: GymEnv | str | None = None,
        video_freq: int = 50_000,
        video_length: int = 200,
        context: int = 5,
        horizon: int = 45,
        open_loop_start: int = 0,
        deterministic: bool = True,
        folder: str | os.PathLike[str] | None = None,
        verbose: int = 0,
    ):
        super().__init__(verbose)
        self.env = env
        self.video_freq = video_freq
        self.video_length = video_length
        self.context = context
        self.horizon = horizon
        self.open_loop_start = open_loop_start
        self.deterministic = deterministic
        if folder is not None:
            check_folder("folder", folder)
        self.folder = None if folder is None else Path(folder)
        for name in ("video_freq", "video_length", "context", "horizon"):
            check_integer(name, getattr(self, name), 1)
        check_integer("open_loop_start", open_loop_start, 0)
        self.active = False
        self.last_filmed = 0
        self._stage: VecEnv | None = None
        self._stage_of: VecEnv | None = None

    @property
    def _dreamer(self) -> DreamerV2:
        return self.model  # type: ignore[return-value]

    def _on_training_start(self) -> None:
        self.active = self.folder is not None or bool(self._writers())
        if not self.active:
            warnings.warn(
                "VideoCallback films nothing, as it has nowhere to put films: give DreamerV2(tensorboard_log=...), or "
                "VideoCallback(folder=...)."
            )
            return
        # Now, not after the first 50 000 steps.
        recording.check_drawn(self._dreamer, self._env())
        self.last_filmed = self.num_timesteps

    def _on_step(self) -> bool:
        if self.active and self.num_timesteps - self.last_filmed >= self.video_freq:
            self.last_filmed = self.num_timesteps
            self.film()
        return True

    def _on_training_end(self) -> None:
        self._leave_stage()

    def film(self) -> None:
        """Film now."""
        model = self._dreamer
        devices = [model.device] if model.device.type == "cuda" else []
        with th.random.fork_rng(devices):
            played = recording.record(model, self._env(), self.video_length, self.deterministic)
            self._put(AGENT, list(labelled_agent(np.stack(played.frames))), played.fps)
            kind = model.policy.observations
            dreams = hasattr(model.policy.agent, "world_model")
            if not dreams or not has_image(kind) or len(played.actions) < self.open_loop_start + self.context:
                return
            truth, predicted = predict_open_loop(
                model.policy, played.observations, played.actions, self.open_loop_start, self.context, self.horizon
            )
        its_truth, its_model = (pictures_in(kind, part) for part in (truth, predicted))
        panels = labelled_open_loop(its_truth, its_model, self.context, self.open_loop_start)
        self._put(OPEN_LOOP, list(panels), played.fps)

    def _env(self) -> VecEnv:
        """The stage; made again where the training environment is another than it was made for."""
        training = self._dreamer.get_env()
        if self._stage is None or (self.env is None and training is not self._stage_of):
            self._leave_stage()
            self._stage, self._stage_of = recording.env_to_play_in(self._dreamer, self.env), training
        return self._stage

    def _leave_stage(self) -> None:
        # The caller's environment is the caller's to close.
        if self._stage is not None and (self.env is None or isinstance(self.env, str)):
            self._stage.close()
        self._stage = self._stage_of = None

    def _writers(self) -> list[SummaryWriter]:
        return [output.writer for output in self.logger.output_formats if isinstance(output, TensorBoardOutputFormat)]

    def _put(self, tag: str, frames: list[np.ndarray], fps: float) -> None:
        skip = -(-int(np.ceil(fps)) // MAX_FPS)
        frames, fps = frames[::skip], fps / skip
        film = encode_gif(frames, fps)
        for writer in self._writers():
            add_gif(writer, tag, film, frames[0].shape, self.num_timesteps)
        if self.folder is not None:
            path = made_folder("folder", self.folder) / f"{tag.split('/')[1]}_{self.num_timesteps}.gif"
            path.write_bytes(film)
            if self.verbose >= 1:
                print(f"Filmed {path}")


def add_gif(writer: SummaryWriter, tag: str, gif: bytes, shape: tuple[int, ...], step: int) -> None:
    """Put an animation among TensorBoard's images.

    :param writer: of the log
    :param tag: its name there
    :param gif: encoded
    :param shape: of a frame, (height, width, 3)
    :param step: agent steps
    """
    from tensorboard.compat.proto.summary_pb2 import Summary

    height, width, channels = shape
    image = Summary.Image(height=height, width=width, colorspace=channels, encoded_image_string=gif)
    assert writer.file_writer is not None
    writer.file_writer.add_summary(Summary(value=[Summary.Value(tag=tag, image=image)]), step)
    writer.flush()
