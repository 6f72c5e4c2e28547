"""rl_zoo3's ``push_to_hub`` and ``load_from_hub`` for our algorithms, with the arguments that they have there.

rl_zoo3's own push does not start with the present sb3-team-hf-integration. And what rl_zoo3 reads from a
run's folder it reads with loaders that run code: here nothing of a downloaded repository reaches them unchecked.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import warnings
import zipfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import yaml

from sb3_dreamer_urlb.command_parser import CommandParser, at_least
from sb3_dreamer_urlb.folders import made_folder
from sb3_dreamer_urlb.hub.package import STATISTICS, load_from_hub, name_of_model, package_to_hub
from sb3_dreamer_urlb.hub.privacy import as_plain, plain_for_everybody
from sb3_dreamer_urlb.snapshots.vec_normalize import load_vec_normalize
from sb3_dreamer_urlb.zoo.algorithms import ALGORITHMS
from sb3_dreamer_urlb.zoo.found_runs import finding

CONFIG, ARGUMENTS, ENV_KWARGS, METRICS = "config.yml", "args.yml", "env_kwargs.yml", "train_eval_metrics.zip"
#: of the command line that trained; the rest names things of that machine
SHARED_ARGUMENTS = ("algo", "env", "env_kwargs", "seed", "n_timesteps")
MAX_YAML = 64 << 10


def push(argv: Sequence[str], prog: str) -> str:
    """``push_to_hub``: evaluate a run's model, film it, and put it into a repository with its card and configuration.

    :param argv: arguments
    :param prog: name of the command
    :return: where to look at it
    """
    from rl_zoo3.utils import StoreDict, create_test_env, get_model_path, get_saved_hyperparams

    parser = _parser(prog, "Put a trained model on the Hugging Face Hub, or into a folder.")
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--load-best", action="store_true", help="the best model of the evaluations")
    which.add_argument("--load-checkpoint", type=at_least(0), help="a checkpoint, by its number of steps")
    which.add_argument("--load-last-checkpoint", action="store_true")
    parser.add_argument("-m", "--commit-message", help="(default: names the algorithm)")
    parser.add_argument("-n", "--n-timesteps", type=at_least(1), default=500, help="agent steps of the film (default: 500)")
    parser.add_argument("--no-render", action="store_true", help="no film")
    parser.add_argument("--n-eval-episodes", type=at_least(1), default=10)
    parser.add_argument("--stochastic", action="store_true", help="evaluate with exploration")
    parser.add_argument("--deterministic", action="store_true", help="the default")
    parser.add_argument("--seed", type=at_least(0), default=0, help="of the evaluation's environment")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--private", action="store_true", help="make the repository private where it has to be made")
    parser.add_argument("--env-kwargs", nargs="+", action=StoreDict, help="further arguments of the environment")
    options = parser.parse_args(argv)

    env_name = options.env.replace("/", "-")
    _, model_path, log_path = finding(get_model_path)(
        options.exp_id, options.folder, options.algo, _zoo_name(options.env),
        options.load_best, options.load_checkpoint, options.load_last_checkpoint,
    )  # fmt: skip
    run = Path(log_path) / env_name
    hyperparameters, stats_path = get_saved_hyperparams(str(run), test_mode=True)
    saved = _saved_arguments(run)
    env_kwargs = {**(saved.get("env_kwargs") or {}), **(options.env_kwargs or {})}
    env = create_test_env(
        options.env,
        stats_path=stats_path,
        seed=options.seed,
        should_render=False,
        hyperparams={**hyperparameters},
        env_kwargs=env_kwargs if options.no_render else {"render_mode": "rgb_array", **env_kwargs},
    )
    model = ALGORITHMS[options.algo].kind.load(model_path, device=options.device)
    try:
        with tempfile.TemporaryDirectory() as folder:
            return package_to_hub(
                model,
                _repo_id(options),
                env,
                options.n_eval_episodes,
                deterministic=not options.stochastic,
                command=_command(run),
                env_id=options.env,
                model_name=name_of_model(options.env, options.algo),
                video_length=0 if options.no_render else options.n_timesteps,
                commit_message=options.commit_message,
                private=options.private or None,
                progress_bar=True,
                extra_files=_zoo_files(run, saved, env_kwargs, Path(folder)),
            )
    finally:
        env.close()


def load(argv: Sequence[str], prog: str) -> str:
    """``load_from_hub``: fetch a model into rl_zoo3's folder of runs, for ``enjoy``, ``record_video`` and ``train -i``.

    :param argv: arguments
    :param prog: name of the command
    :return: the run's folder
    :raises ValueError: if there is such a run already, or the configuration could run code
    """
    from rl_zoo3 import get_latest_run_id

    parser = _parser(prog, "Fetch a model from the Hugging Face Hub, or from a folder, into a folder of runs.")
    parser.add_argument("--force", action="store_true", help="overwrite the run --exp-id")
    parser.add_argument("--revision", help="branch, tag or commit")
    options = parser.parse_args(argv)

    repo_id, env_name = _repo_id(options), options.env.replace("/", "-")
    runs = Path(options.folder) / options.algo
    number = options.exp_id or get_latest_run_id(str(runs), _zoo_name(options.env)) + 1
    target = runs / f"{env_name}_{number}" if number > 0 else runs
    if target.is_dir() and not options.force:
        raise ValueError(f"The folder {target} exists: --force overwrites it, --exp-id 0 makes a new one.")

    def fetch(name: str) -> str:
        return load_from_hub(repo_id, name, options.revision)

    model = fetch(f"{name_of_model(options.env, options.algo)}.zip")
    ALGORITHMS[options.algo].kind.load(model, device="cpu")  # refuses what is no model of ours, before anything is written
    config = harmless_config(_read_yaml(fetch(CONFIG)))
    env_kwargs = _read_yaml(fetch(ENV_KWARGS))
    statistics = None
    with suppress(FileNotFoundError):
        statistics = fetch(STATISTICS)
    if bool(config.get("normalize")) != (statistics is not None):
        raise ValueError(f"{repo_id}: normalize is {config.get('normalize')!r}, but there is a {STATISTICS}, or none.")
    if target.is_dir() and number > 0:
        shutil.rmtree(target)
    settings = made_folder("a folder of --folder", target / env_name)
    shutil.copyfile(model, target / f"{env_name}.zip")
    (settings / CONFIG).write_text(yaml.safe_dump(config))
    (settings / ARGUMENTS).write_text(yaml.safe_dump({"env": options.env, "env_kwargs": env_kwargs}))
    if statistics is not None:
        _pickle_statistics(options.env, env_kwargs, statistics, settings / "vecnormalize.pkl")
    return str(target)


def harmless_config(config: dict[str, Any]) -> dict[str, Any]:
    """What rl_zoo3 needs to play with a model, of a stranger's configuration.

    Hyperparameters are in the model's own file, so the only others are the environment's.

    :param config: ``config.yml``
    :return: ``normalize`` and ``frame_stack``
    :raises ValueError: for wrappers, which rl_zoo3 would import by name
    """
    wrappers = [name for name in ("env_wrapper", "vec_env_wrapper") if config.get(name)]
    if wrappers:
        raise ValueError(
            f"{CONFIG} names code to run: {wrappers[0]}={config[wrappers[0]]!r}. Wrap the environment yourself, and use "
            "load(load_from_hub(...), env=env) of the algorithm."
        )
    stack = config.get("frame_stack", 0)
    if type(stack) is not int or stack < 0:
        raise ValueError(f"{CONFIG}: frame_stack is {stack!r}.")
    # rl_zoo3 evaluates a text; the settings are in the statistics, anyway.
    return {"normalize": bool(config.get("normalize")), **({"frame_stack": stack} if stack else {})}


def _parser(prog: str, description: str) -> argparse.ArgumentParser:
    parser = CommandParser(prog=prog, description=description)
    parser.add_argument("--env", required=True, help="id of the environment")
    parser.add_argument("-f", "--folder", required=True, help="of the runs")
    parser.add_argument("--algo", default="dreamerv2", choices=sorted(ALGORITHMS))
    parser.add_argument("-orga", "--organization", required=True, help="user or organisation; or a folder: ./path, /path")
    parser.add_argument("-name", "--repo-name", help="of the repository (default: the algorithm and the environment)")
    parser.add_argument("--exp-id", type=at_least(0), default=0, help="number of the run (0: the latest, or a new one)")
    parser.add_argument("--verbose", type=at_least(0), default=1, help="accepted as in rl_zoo3")
    return parser


def _repo_id(options: argparse.Namespace) -> str:
    return f"{options.organization.rstrip('/')}/{options.repo_name or name_of_model(options.env, options.algo)}"


def _zoo_name(env_id: str) -> Any:
    from huggingface_sb3 import EnvironmentName

    return EnvironmentName(env_id)


def _command(run: Path) -> str | None:
    path = run / "command.txt"
    return path.read_text().strip() if path.is_file() else None


def _saved_arguments(run: Path) -> dict[str, Any]:
    """Of the command line that trained. The file is the user's own, and rl_zoo3 writes it with Python's types."""
    path = run / ARGUMENTS
    return dict(yaml.load(path.read_text(), Loader=yaml.UnsafeLoader)) if path.is_file() else {}


def _zoo_files(run: Path, saved: dict[str, Any], env_kwargs: dict[str, Any], folder: Path) -> dict[str, Path]:
    """What ``load_from_hub`` looks for, here as in rl_zoo3; as YAML that needs no Python types."""
    config = dict(yaml.load((run / CONFIG).read_text(), Loader=yaml.UnsafeLoader))
    shared = {name: saved[name] for name in SHARED_ARGUMENTS if name in saved}
    for name, content in ((CONFIG, config), (ARGUMENTS, shared)):
        (folder / name).write_text(yaml.safe_dump(plain_for_everybody(content)))
    # The environment is made from these again: a folder that others have, too, must still be named in full.
    needed = as_plain(env_kwargs)
    if needed != plain_for_everybody(env_kwargs):
        warnings.warn(f"{ENV_KWARGS} names folders, for the environment is made with them: {needed}. Others need them, too.")
    (folder / ENV_KWARGS).write_text(yaml.safe_dump(needed))
    with zipfile.ZipFile(folder / METRICS, "w") as archive:
        for path in (run.parent / "evaluations.npz", *sorted(run.parent.glob("*.csv"))):
            if path.is_file():
                archive.write(path, path.name)
    return {name: folder / name for name in (CONFIG, ARGUMENTS, ENV_KWARGS, METRICS)}


def _read_yaml(path: str) -> dict[str, Any]:
    """
    :raises ValueError: for anything but plain values by name
    """
    if Path(path).stat().st_size > MAX_YAML:
        raise ValueError(f"{path} has more than {MAX_YAML} bytes.")
    try:
        content = yaml.safe_load(Path(path).read_text())
    except (yaml.YAMLError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path} is refused: {error}") from error
    if not isinstance(content, dict) or not all(isinstance(key, str) for key in content):
        raise ValueError(f"{path} is refused: it holds no values by name.")
    return content


def _pickle_statistics(env_id: str, env_kwargs: dict[str, Any], statistics: str, path: Path) -> None:
    """In the form that rl_zoo3 reads; this pickle is made here, from numbers."""
    from rl_zoo3.utils import create_test_env

    env = create_test_env(env_id, should_render=False, hyperparams={}, env_kwargs=env_kwargs)
    try:
        load_vec_normalize(statistics, env).save(str(path))
    finally:
        env.close()
