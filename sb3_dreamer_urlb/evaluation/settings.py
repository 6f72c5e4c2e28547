"""What a run's hyperparameters have otherwise than their preset: the column of a row that tells two such runs apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from sb3_dreamer_urlb.algorithm.assignable_arguments import same
from sb3_dreamer_urlb.algorithm.presets import MERGED, find_preset

#: arguments that other columns tell, that change nothing of what is learnt, or that an environment decides
NO_SETTINGS = frozenset(
    ("intrinsic_reward", "planner", "preset", "seed")
    + ("compile", "overlap", "precision", "stats_window_size", "tensorboard_log", "verbose")
    + ("discount_head", "replay_buffer_kwargs.map_size", "replay_buffer_kwargs.path", "replay_buffer_kwargs.prefetch")
    + ("replay_buffer_kwargs.store",)
)


def settings_of(model: Any) -> dict[str, Any]:
    """The hyperparameters that are otherwise than those of the preset, by name; entries of dictionaries as ``name.entry``.

    :param model: of this package; nothing is known of others
    """
    presets: Mapping[str, dict[str, Any]] | None = getattr(type(model), "presets", None)
    if presets is None:
        return {}
    preset = find_preset(dict(presets), model.preset)
    parameters = type(model).argument_parameters()
    found: dict[str, Any] = {}
    for name, value in model.arguments().items():
        usual = preset.get(name, parameters[name].default)
        for path, one, other in _entries(name, value, usual):
            # None leaves it to the preset.
            if one is not None and path not in NO_SETTINGS and not same(one, other):
                found[path] = one
    return dict(sorted(found.items()))


def _entries(name: str, value: Any, usual: Any) -> Iterator[tuple[str, Any, Any]]:
    if name == "train_freq":
        # As it was written, with its unit only where that is no step.
        frequency, unit = value
        value = frequency if unit.value == "step" else (frequency, unit.value)
    if name not in MERGED:
        yield name, value, usual
        return
    value, usual = value or {}, usual or {}
    for entry in {**usual, **value}:
        yield f"{name}.{entry}", value.get(entry), usual.get(entry)


def as_text(settings: Mapping[str, Any]) -> str:
    """``batch_size:5;policy_kwargs.net_arch:64/64``: no space and no comma, which conditions on rows have between them.

    :param settings: of :func:`settings_of`
    """
    return ";".join(f"{name}:{_value(value)}" for name, value in settings.items())


def _value(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "/".join(map(_value, value))
    if isinstance(value, dict):
        return "/".join(f"{name}:{_value(one)}" for name, one in sorted(value.items()))
    return str(value) if isinstance(value, str | int | float | bool | None) else type(value).__name__
