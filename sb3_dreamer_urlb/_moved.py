"""What lay elsewhere in version 0.1, modules and names: old names work until version 0.3, with a DeprecationWarning."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Sequence
from importlib import import_module
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any

ROOT = "sb3_dreamer_urlb"
#: old name → new name, both below the package
MOVED = {
    "acting": "algorithm.phased",
    "actions": "spaces.actions",
    "activation": "nn.activation",
    "arguments": "dreamer_v2.arguments",
    "choices": "spaces.choices",
    "demo": "cli.demo_pixels",
    "dense": "nn.dense",
    "distributions": "nn.distributions",
    "env_steps": "envs.env_steps",
    "errors": "spaces.errors",
    "evaluation.history": "runs.evaluation_history",
    "graphs": "learning.graphs",
    "last_state": "runs.last_state",
    "learner": "learning.learner",
    "memory": "learning.memory",
    "methods_tour": "cli.methods_tour",
    "nets": "nn.nets",
    "numerical_faults": "learning.numerical_faults",
    "observation_checks": "spaces.observation_checks",
    "optim": "learning.optim",
    "planning.chain": "planning.prepared.chain",
    "planning.native_parts": "planning.prepared.native_parts",
    "planning.prepacked": "planning.prepared.prepacked",
    "planning.prepared_parts": "planning.prepared.parts",
    "policies": "dreamer_v2.policies",
    "precision": "nn.precision",
    "presets": "dreamer_v2.presets",
    "run_checkpoints": "callbacks.checkpoint",
    "run_folder": "runs.run_folder",
    "saving": "algorithm.saving",
    "snapshots.convert": "cli.convert",
    "training_loop": "algorithm.training_loop",
    "videos": "callbacks.videos",
    "world_model.observations": "spaces.observations",
}
#: module that is where it was → name that left it → where it is now
MOVED_NAMES = {
    "phases": {
        **dict.fromkeys(("PhaseSwitchCallback", "FineTuneCallback"), "callbacks.phase_switch"),
        **dict.fromkeys(("SnapshotCallback", "SNAPSHOT_FRAMES"), "callbacks.snapshot"),
        **dict.fromkeys(("TRANSFER", "transfer"), "dreamer_v2.kept_parts"),
        **dict.fromkeys(("SPARSE_DOMAINS", "keeps_actor"), "transfer_rule"),
    },
}


class _OldNames(MetaPathFinder, Loader):
    """Finds a module under its old name and fills it with the new one's content."""

    def find_spec(self, fullname: str, path: Sequence[str] | None, target: ModuleType | None = None) -> ModuleSpec | None:
        """Of a module that moved; None for all others."""
        return ModuleSpec(fullname, self) if fullname.removeprefix(f"{ROOT}.") in MOVED else None

    def exec_module(self, module: ModuleType) -> None:
        """Fill it."""
        new = f"{ROOT}.{MOVED[module.__name__.removeprefix(f'{ROOT}.')]}"
        warnings.warn(f"{module.__name__} is now {new}; the old name ends with version 0.3.", DeprecationWarning, stacklevel=2)
        content = vars(import_module(new))
        vars(module).update({name: value for name, value in content.items() if not name.startswith("__")})


def keep_old_names() -> None:
    """Let imports of old names succeed; may be called again."""
    if not any(isinstance(finder, _OldNames) for finder in sys.meta_path):
        sys.meta_path.append(_OldNames())


def names_that_moved(module: str) -> Callable[[str], Any]:
    """The ``__getattr__`` of a module that some names have left.

    :param module: of ``MOVED_NAMES``
    """

    def found(name: str) -> Any:
        old = f"{ROOT}.{module}"
        if name not in MOVED_NAMES[module]:
            raise AttributeError(f"module {old!r} has no attribute {name!r}")
        new = f"{ROOT}.{MOVED_NAMES[module][name]}"
        told = f"{old}.{name} is now {new}.{name}; the old name ends with version 0.3."
        warnings.warn(told, DeprecationWarning, stacklevel=2)
        return getattr(import_module(new), name)

    return found
