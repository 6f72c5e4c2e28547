"""An algorithm ↔ a file: constructor arguments, counters, random states, weights and the optimisers' moments.

Not in the file: the replay (``save_replay_buffer``, or a run folder), the environment, and the episode that is open.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from typing import Any, TypeVar

import torch as th
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.common.utils import get_system_info
from stable_baselines3.common.vec_env import VecEnv, unwrap_vec_normalize

from sb3_dreamer_urlb.devices import chosen_device
from sb3_dreamer_urlb.snapshots import bounded_json, normalization, tensors, values
from sb3_dreamer_urlb.snapshots.archive import TENSORS, Archive, CallersError, Target, reading, writing
from sb3_dreamer_urlb.snapshots.model_data import FIELDS, blank, check_whose, describe, needed, restore_fields
from sb3_dreamer_urlb.snapshots.random_state import RandomStates
from sb3_dreamer_urlb.snapshots.saved_algorithm import SavedAlgorithm
from sb3_dreamer_urlb.spaces.comparing import check_same_spaces

Model = TypeVar("Model", bound=SavedAlgorithm)

KIND = "model"
MOMENTS = ("exp_avg", "exp_avg_sq")
#: what ``torch.compile`` puts before the names of what a module holds
COMPILED = "_orig_mod."


# -- saving ----------------------------------------------------------------------------------------------------------------


def save(
    model: SavedAlgorithm, target: Target, run: dict[str, Any] | None = None, instead: Mapping[str, Any] | None = None
) -> None:
    """Write a model; a path atomically.

    :param model: what to save
    :param target: path (``.zip`` is added where it has no suffix), or binary file object
    :param run: what a run folder adds, JSON
    :param instead: constructor arguments that the file holds in place of the model's
    :raises ValueError: if a weight is not finite, or the file could not be read again; the old file stays
    :raises OSError: naming the path; the old file stays
    """
    model.take_over_changes()
    statistics = model.known_statistics()
    mine, data = _all_tensors(model), describe(model, run)
    data["arguments"].update(values.encode(dict(instead or {})))
    content = tensors.pack({**mine, **statistics})
    _check_readable(model, data, tensors.table_of(mine))
    if run is None and (missing := needed(data)):
        warnings.warn(
            f"No file can hold this model's {', '.join(missing)}: load() will ask for it again, "
            f"load(..., custom_objects={{{missing[0]!r}: ...}})."
        )
    with writing(target, KIND) as writer:
        writer.add(TENSORS, content)
        writer.finish(data)


def _check_readable(model: SavedAlgorithm, data: dict[str, Any], found: tensors.Table) -> None:
    """Try on what is about to be written what :func:`load` will do with it.

    :param model: that is saved
    :param data: its JSON
    :param found: table of its tensors
    :raises ValueError: if it would be refused
    """
    own: dict[str, Any] = {**model.arguments(), "policy": model.policy_class}
    try:
        data = bounded_json.parse(bounded_json.dump(data))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            given = {name: own[name] for name in needed(data) if name in own}
            # Stable-Baselines3's constructor would print the device once more.
            quiet = {"verbose": 0} if data["arguments"].get("verbose") in (1, 2) else {}
            twin = blank(type(model), data, model.device, {**given, **quiet}, {})
            restore_fields(twin, data)
            twin._prepare()
            described = tensors.table_without_memory(twin._new_policy, found)
        tensors.compare(found, _with_moments(model, {f"policy.{name}": entry for name, entry in described.items()}, found))
    except (ValueError, TypeError, AttributeError, AssertionError, LookupError) as error:
        raise ValueError(f"The model is not saved, for its file would be refused: {error}") from error


def _all_tensors(model: SavedAlgorithm) -> dict[str, th.Tensor]:
    found = _named(model.policy)
    for name, adam in model.adams().items():
        for i, parameter in enumerate(_parameters(adam)):
            for key, value in adam.state.get(parameter, {}).items():
                found[f"{name}.{i}.{key}"] = value
    return found


def _parameters(adam: th.optim.Adam) -> list[th.nn.Parameter]:
    return [parameter for group in adam.param_groups for parameter in group["params"]]


def _named(policy: th.nn.Module) -> dict[str, th.Tensor]:
    return {f"policy.{name.replace(COMPILED, '')}": value for name, value in policy.state_dict().items()}


def _load_weights(policy: th.nn.Module, named: dict[str, th.Tensor]) -> None:
    """Undo :func:`_named`; names that are missing keep their values."""
    given = {name: f"policy.{name.replace(COMPILED, '')}" for name in policy.state_dict()}
    policy.load_state_dict({name: named[theirs] for name, theirs in given.items() if theirs in named}, strict=False)


# -- loading ---------------------------------------------------------------------------------------------------------------


def load(
    algorithm: type[Model],
    source: Target,
    env: GymEnv | str | None,
    device: th.device | str,
    custom_objects: dict[str, Any] | None,
    print_system_info: bool,
    kwargs: dict[str, Any],
    resume: bool = False,
) -> tuple[Model, dict[str, Any] | None, dict[str, th.Tensor]]:
    """Read a model.

    :param algorithm: class of the model
    :param source: path or binary file object
    :param env: environment to go on in
    :param device: where to put the networks
    :param custom_objects: replaces arguments; names that are none are ignored, as SB3 does
    :param print_system_info: print those of the file and of this machine
    :param kwargs: replaces arguments, too
    :param resume: restore the random states of an unseeded model, too
    :return: the model, what a run folder added, and the statistics of its VecNormalize
    :raises SnapshotError: naming the file and why it is refused
    :raises ValueError: or whatever else the constructor raises, if it is not the file but what was given that is wrong
    """
    if not isinstance(custom_objects, dict | None):
        raise TypeError(f"custom_objects must be a dictionary of arguments by name or None, got {custom_objects!r}.")
    device = chosen_device(device)
    wrapped = None if env is None else algorithm._wrap_env(env, kwargs.get("verbose", 0))  # type: ignore[arg-type] # ids, too
    with reading(source, KIND) as archive:
        if print_system_info:
            print("== CURRENT SYSTEM INFO ==")
            get_system_info()
            print("== SAVED MODEL SYSTEM INFO ==")
            print(archive.system_info)
        data = archive.data
        if set(data) != FIELDS:
            raise ValueError(f"it has other fields than it should: {sorted(set(data) ^ FIELDS)}")
        model = _prepared(algorithm, data, wrapped, device, custom_objects or {}, kwargs)
        states = None if data["random"] is None else RandomStates(data["random"])
        try:
            _build_checked(model, archive)
        except ValueError as error:
            raise _naming_who(error, algorithm, archive, device, custom_objects or {}, kwargs) from None
        loaded = tensors.unpack(archive, TENSORS)
        statistics = {name: loaded.pop(name) for name in list(loaded) if name.startswith(normalization.PREFIX)}
        _put(model, loaded)
        model.loaded_statistics = statistics
        # Runs that start from one unseeded model are meant to differ.
        if states is not None and (resume or model.seed is not None) and "seed" not in kwargs:
            states.apply(model)
        return model, data["run"], statistics


def _prepared(
    algorithm: type[Model],
    data: dict[str, Any],
    env: VecEnv | None,
    device: th.device,
    custom: dict[str, Any],
    kwargs: dict[str, Any],
) -> Model:
    """Everything but the networks.

    :raises CallersError: if the file alone would have been in order
    """

    def prepare(custom: dict[str, Any], kwargs: dict[str, Any], env: VecEnv | None = None) -> Model:
        model = blank(algorithm, data, device, custom, kwargs)
        restore_fields(model, data)
        if env is not None:
            check_same_spaces(env, model)
            model.env, model.n_envs = env, env.num_envs
            model._vec_normalize_env = unwrap_vec_normalize(env)
        model._prepare()
        return model

    try:
        return prepare(custom, kwargs, env)
    except Exception as error:
        if not custom and not kwargs and env is None:
            raise
        given = {**custom, **kwargs}
        try:
            prepare({name: given[name] for name in needed(data) if name in given}, {})
        except Exception:
            raise error from None
        raise CallersError(error) from None


def _build_checked(model: SavedAlgorithm, archive: Archive) -> None:
    """Build the networks only after the file's tensors turned out to be of just their sizes."""
    found, _ = normalization.split(tensors.read_table(archive, TENSORS))
    described = tensors.table_without_memory(model._new_policy, found)
    expected = {f"policy.{name}": entry for name, entry in described.items()}
    tensors.compare({name: entry for name, entry in found.items() if name.startswith("policy.")}, expected)
    model.set_random_seed(model.seed)
    model._build()
    tensors.compare(found, _with_moments(model, expected, found))


def _naming_who(
    error: ValueError,
    algorithm: type[Model],
    archive: Archive,
    device: th.device,
    custom: dict[str, Any],
    kwargs: dict[str, Any],
) -> ValueError:
    """The error of networks that the file's tensors do not fit; it names the arguments of the caller's that make them so.

    :param error: of :func:`_build_checked`
    """
    given = {**custom, **kwargs}
    must = {name: given[name] for name in needed(archive.data) if name in given}

    def fits(names: Iterable[str]) -> bool:
        chosen = {name: given[name] for name in names}
        try:
            _build_checked(_prepared(algorithm, archive.data, None, device, must, chosen), archive)
        except Exception:
            return False
        return True

    free = sorted(set(given) & set(algorithm.argument_names()) - must.keys())
    if not free or not fits(()):
        return error
    blamed = [name for name in free if not fits([name])] or free
    shown = ", ".join(f"{name}={given[name]!r}" for name in blamed)
    return ValueError(f"its networks and optimisers were made with another {' and '.join(blamed)} than {shown}: {error}")


def _with_moments(model: SavedAlgorithm, weights: tensors.Table, found: tensors.Table) -> tensors.Table:
    """The table of a file with these weights; an optimiser has moments from its first update on."""
    expected = dict(weights)
    for name, adam in model.adams().items():
        if not any(key.startswith(f"{name}.") for key in found):
            continue
        for i, parameter in enumerate(_parameters(adam)):
            expected[f"{name}.{i}.step"] = ("F32", ())
            expected |= {f"{name}.{i}.{key}": (tensors.DTYPES[parameter.dtype], tuple(parameter.shape)) for key in MOMENTS}
    return expected


def _put(model: SavedAlgorithm, loaded: dict[str, th.Tensor]) -> None:
    """Copy tensors of a checked table into the model."""
    for name, value in loaded.items():
        if name.endswith((".step", ".exp_avg_sq")) and not name.startswith("policy.") and bool((value < 0).any()):
            raise ValueError(f"the tensor {name!r} holds negative values")
    _load_weights(model.policy, loaded)
    for name, adam in model.adams().items():
        state = {
            i: {key: loaded[f"{name}.{i}.{key}"] for key in ("step", *MOMENTS)}
            for i in range(len(_parameters(adam)))
            if f"{name}.{i}.step" in loaded
        }
        # The settings stay the arguments'.
        adam.load_state_dict({"state": state, "param_groups": adam.state_dict()["param_groups"]})


def set_parameters(model: SavedAlgorithm, source: Target, exact_match: bool) -> None:
    """Take weights and moments over from a file.

    :param model: changed in place; as a whole, or not at all
    :param source: path or binary file object
    :param exact_match: False takes only the weights that both have
    :raises SnapshotError: naming the file and why it is refused
    """
    with reading(source, KIND) as archive:
        own = tensors.table_of(_named(model.policy))
        found, _ = normalization.split(tensors.read_table(archive, TENSORS))
        if exact_match:
            check_whose(type(model), archive.data)
            tensors.compare(found, _with_moments(model, own, found))
            loaded = tensors.unpack(archive, TENSORS)
            _put(model, {name: loaded[name] for name in found})
            return
        common = own.keys() & found.keys()
        tensors.compare({name: found[name] for name in common}, {name: own[name] for name in common})
        loaded = tensors.unpack(archive, TENSORS)
        _load_weights(model.policy, {name: loaded[name] for name in common})
