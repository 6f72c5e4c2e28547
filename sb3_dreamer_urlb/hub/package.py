"""Putting a trained model into a repository with everything that makes it useful to others, and getting it back."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import tempfile
import warnings
from collections.abc import Collection, Mapping
from dataclasses import asdict
from datetime import datetime, timezone
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize
from tqdm import tqdm

from sb3_dreamer_urlb.envs.facts import env_attribute
from sb3_dreamer_urlb.envs.wrappers import can_be_put_around, put_around
from sb3_dreamer_urlb.evaluation import recording
from sb3_dreamer_urlb.hub import model_card as cards
from sb3_dreamer_urlb.hub.algorithms import algorithm_of
from sb3_dreamer_urlb.hub.facts import facts_about
from sb3_dreamer_urlb.hub.repositories import CONFIG, MISSING_HUB, RepoId, check_filename, open_repository
from sb3_dreamer_urlb.number_checks import check_integer, plain
from sb3_dreamer_urlb.snapshots import bounded_json
from sb3_dreamer_urlb.snapshots import model as model_snapshot
from sb3_dreamer_urlb.snapshots.vec_normalize import save_vec_normalize

if TYPE_CHECKING:
    from sb3_dreamer_urlb.algorithm.agent_algorithm import AgentAlgorithm

CARD, RESULTS, FILM, STATISTICS = "README.md", "results.json", "replay.mp4", "vec_normalize.json"
MAX_CONFIG = 1 << 20


def package_to_hub(
    model: AgentAlgorithm,
    repo_id: RepoId,
    eval_env: GymEnv | str | None = None,
    n_eval_episodes: int = 10,
    deterministic: bool = True,
    command: str | None = None,
    env_id: str | None = None,
    model_name: str | None = None,
    video_length: int = 500,
    commit_message: str | None = None,
    token: str | None = None,
    private: bool | None = None,
    extra_files: Mapping[str, str | os.PathLike[str]] | None = None,
    progress_bar: bool = False,
) -> str:
    """Evaluate a model, film it, describe it, and put all of it into a repository.

    The repository gets ``<model_name>.zip`` (its own ``save``), ``README.md`` (the model card), ``config.json``,
    ``results.json``, ``replay.mp4``, and ``vec_normalize.json`` where observations are normalised. The model there logs
    nowhere, and keeps its replay in memory: the folders are yours. Nothing is uploaded if any of it fails, but a film:
    without pictures there is none, and a warning says so.

    :param model: trained, a :class:`~sb3_dreamer_urlb.DreamerV2` or a :class:`~sb3_dreamer_urlb.DrQv2`
    :param repo_id: ``"user/name"`` on the Hub; a folder as a ``Path``, ``"./path"``, ``"/path"`` or ``"file:///path"``
    :param eval_env: to evaluate in: a VecEnv of one environment, used as it is, an environment or its id; None makes one
        like the model's own
    :param n_eval_episodes: how many
    :param deterministic: evaluate without exploration
    :param command: that made the model, for the card; keep secrets out of it
    :param env_id: name of the environment; None asks ``eval_env``
    :param model_name: None for ``dreamerv2-<env_id>`` or ``drq_v2-<env_id>``, as rl_zoo3 names it
    :param video_length: agent steps of the film at most, 0 for none
    :param commit_message: on the Hub; None names the algorithm
    :param token: of the Hub; None takes the one of ``hf auth login``, or ``HF_TOKEN``
    :param private: whether a repository that is made on the Hub is private
    :param extra_files: further files, by their names in the repository
    :param progress_bar: show how many episodes of the evaluation are played
    :return: where to look at it
    :raises ValueError: for arguments that make no sense, an environment that does not fit, weights that are not finite; what
        only the caller can give, and has not, is named all at once
    :raises ImportError: if the extra ``hub`` is not installed
    """
    algorithm = algorithm_of(model)
    n_eval_episodes, video_length = plain((n_eval_episodes, video_length))
    check_integer("n_eval_episodes", n_eval_episodes, 1)
    check_integer("video_length", video_length, 0)
    check_installed(film=video_length > 0)
    repository = open_repository(repo_id, token, private=private)
    _check_given(model, eval_env, env_id, extra_files or {})
    env = recording.env_to_play_in(model, eval_env, argument="eval_env")
    try:
        recording.copy_statistics(model, env)
        env_id = env_id or _id_of(env)
        model_file = check_filename(f"{model_name or name_of_model(env_id, algorithm.zoo)}.zip")
        _check_extra_files(extra_files or {}, {CARD, CONFIG, RESULTS, FILM, STATISTICS, model_file})
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            _save_for_everybody(model, folder / model_file)
            evaluation = _evaluate(model, env, n_eval_episodes, deterministic, progress_bar)
            filmed = video_length > 0 and _film(model, env, video_length, deterministic, folder / FILM)
            normalizer = unwrap_vec_normalize(env)
            if normalizer is not None:
                save_vec_normalize(normalizer, folder / STATISTICS)
            facts = facts_about(model, env_id, command, env)
            card = cards.model_card(model, facts, evaluation, repository.shown, normalizer is not None, filmed)
            (folder / CARD).write_text(card)
            (folder / CONFIG).write_text(json.dumps(cards.config(facts, model_file), indent=1))
            (folder / RESULTS).write_text(json.dumps(asdict(evaluation), indent=1))
            for name, path in (extra_files or {}).items():
                target = folder / check_filename(name)
                target.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, target)
            return repository.upload(folder, commit_message or f"Add a {algorithm.name} model")
    finally:
        if eval_env is None or isinstance(eval_env, str):
            env.close()


def push_to_hub(
    repo_id: RepoId,
    filename: str | os.PathLike[str],
    commit_message: str = "Add a file",
    token: str | None = None,
    private: bool | None = None,
) -> str:
    """Put one file into a repository: a snapshot of the pre-training, say. There is no card; see :func:`package_to_hub`.

    :param repo_id: see :func:`package_to_hub`
    :param filename: on this machine; the repository has it under its last part
    :param commit_message: on the Hub
    :param token: of the Hub
    :param private: whether a repository that is made on the Hub is private
    :return: where to look at it
    :raises FileNotFoundError: if there is no such file
    """
    source = Path(filename)
    with tempfile.TemporaryDirectory() as folder:
        shutil.copyfile(source, Path(folder) / source.name)
        return open_repository(repo_id, token, private=private).upload(Path(folder), commit_message)


def load_from_hub(repo_id: RepoId, filename: str | None = None, revision: str | None = None, token: str | None = None) -> str:
    """Fetch a file: ``DreamerV2.load(load_from_hub("user/name"), env=env)``, or ``DrQv2.load``, as the card says.

    Fetching runs no code from the file, and neither does ``load``, whoever made it.

    :param repo_id: see :func:`package_to_hub`
    :param filename: in the repository; None for the model that :func:`package_to_hub` put there
    :param revision: branch, tag or commit on the Hub
    :param token: of the Hub, for private repositories
    :return: where the file is on this machine
    :raises FileNotFoundError: if there is no such folder, or no such file in the repository
    :raises ValueError: if the repository does not say which file is the model
    """
    repository = open_repository(repo_id, token, revision)
    if filename is None:
        path = repository.download(CONFIG)
        config = bounded_json.parse(path.read_bytes()) if path.stat().st_size <= MAX_CONFIG else None
        filename = config.get("model") if isinstance(config, dict) else None
        if not isinstance(filename, str):
            raise ValueError(f"{CONFIG} in {repository.name} does not say which file is the model: give filename.")
    return str(repository.download(check_filename(filename)))


def name_of_model(env_id: str, algo: str) -> str:
    """As rl_zoo3 calls models: the slash of an id becomes a dash.

    :param env_id: of the environment
    :param algo: what stands behind ``--algo``
    """
    return f"{algo}-{env_id.replace('/', '-')}"


def check_installed(film: bool) -> None:
    """
    :param film: a film is wanted
    :raises ImportError: if something of the extra ``hub`` is not installed, saying how to install it
    """
    needed = ("huggingface_hub", *(("imageio_ffmpeg",) if film else ()))
    if any(importlib.util.find_spec(name) is None for name in needed):
        raise ImportError(MISSING_HUB)


def _check_given(
    model: AgentAlgorithm,
    eval_env: GymEnv | str | None,
    env_id: str | None,
    extra_files: Mapping[str, str | os.PathLike[str]],
) -> None:
    """
    :raises ValueError: naming everything that is missing
    """
    missing = []
    own = model.get_env()
    if eval_env is None and (own is None or _spec_of(own) is None):
        missing.append("eval_env, an environment to evaluate in (the model has none that could be made again by its id)")
    elif eval_env is None and own is not None and not can_be_put_around(own):
        names = ", ".join(each.kind.rpartition(".")[2] for each in put_around(own))
        missing.append(
            f"eval_env, an environment to evaluate in (the model's has wrappers that are vectorised or did not record their "
            f"arguments, {names}: the return without them would be another environment's)"
        )
    if (
        env_id is None
        and not isinstance(eval_env, str)
        and _spec_of(eval_env if eval_env is not None else model.get_env()) is None
    ):
        missing.append("env_id, the environment's name for the card (it has no registered id: give env_id)")
    missing += [
        f"the extra file {name!r}: there is no {path}" for name, path in extra_files.items() if not Path(path).is_file()
    ]
    if missing:
        raise ValueError(f"package_to_hub needs {'; and '.join(missing)}.")


def _check_extra_files(extra_files: Mapping[str, str | os.PathLike[str]], own: Collection[str]) -> None:
    """
    :raises ValueError: for files that would take the place of the repository's own
    """
    if taken := sorted({os.path.normpath(name) for name in extra_files} & set(own)):
        raise ValueError(f"extra_files must leave {', '.join(sorted(own))} to package_to_hub, got {', '.join(taken)}.")


def _save_for_everybody(model: AgentAlgorithm, path: Path) -> None:
    """A snapshot without the folders in which the model logs and keeps its replay, which others do not have."""
    kept = {name: value for name, value in model.replay_buffer_kwargs.items() if name not in ("path", "map_size")}
    if "path" in model.replay_buffer_kwargs:
        kept.pop("store", None)
    model_snapshot.save(model, path, instead={"tensorboard_log": None, "replay_buffer_kwargs": kept})


def _spec_of(env: GymEnv | None) -> Any:
    return env_attribute(env, "spec", None) if isinstance(env, VecEnv) else getattr(env, "spec", None)


def _id_of(env: VecEnv) -> str:
    spec = env_attribute(env, "spec", None)
    if spec is None:
        raise ValueError("The environment has no registered id: give env_id, for the model card.")
    return str(spec.id)


def _evaluate(
    model: AgentAlgorithm, env: VecEnv, episodes: int, deterministic: bool, progress_bar: bool = False
) -> cards.Evaluation:
    with tqdm(total=episodes, desc="Evaluating", unit="episode", disable=not progress_bar) as bar:

        def played(places: dict[str, Any], _: dict[str, Any]) -> None:
            bar.update(int(sum(places["episode_counts"])) - bar.n)

        mean, std = evaluate_policy(model, env, n_eval_episodes=episodes, deterministic=deterministic, callback=played)
        bar.update(episodes - bar.n)
    assert isinstance(mean, float)
    now = datetime.now(timezone.utc).isoformat(timespec="seconds")
    return cards.Evaluation(float(mean), float(np.mean(std)), episodes, deterministic, now)


def _film(model: AgentAlgorithm, env: VecEnv, video_length: int, deterministic: bool, path: Path) -> bool:
    try:
        played = recording.record(model, env, video_length, deterministic)
    except ValueError as error:
        warnings.warn(f"There will be no {path.name}. {error}")
        return False
    write_mp4(played.frames, path, played.fps)
    return True


def write_mp4(frames: list[np.ndarray], path: Path, fps: float) -> None:
    """Write a film that browsers play (H.264).

    :param frames: uint8 (height, width, 3) each
    :param path: of the .mp4
    :param fps: frames a second
    """
    import imageio.v2

    height, width = (side - side % 2 for side in frames[0].shape[:2])  # H.264 has no odd sides
    options: dict[str, Any] = {"fps": fps, "codec": "libx264", "macro_block_size": 2}
    imageio.v2.mimwrite(path, [frame[:height, :width] for frame in frames], **options)
