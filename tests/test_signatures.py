"""Keywords that a constructor does not have."""

from __future__ import annotations

import copy
import inspect
import pickle

import pytest
from stable_baselines3.common.callbacks import BaseCallback, EvalCallback

import sb3_dreamer_urlb
from sb3_dreamer_urlb import DreamerV2, EvaluationCallback, PhaseSwitchCallback
from sb3_dreamer_urlb.signatures import check_keywords, named_parameters
from sb3_dreamer_urlb.unknown_names import UnknownNameError
from sb3_dreamer_urlb.zoo.callbacks import RunSnapshotCallback

CALLBACKS = [
    *(getattr(sb3_dreamer_urlb, name) for name in sb3_dreamer_urlb.__all__ if "Callback" in name),
    RunSnapshotCallback,
]


@pytest.mark.parametrize("kind", CALLBACKS)
def test_every_callback_proposes_what_is_near_to_any_of_its_arguments(kind):
    assert issubclass(kind, BaseCallback) and len(CALLBACKS) >= 7
    assert list(inspect.signature(kind).parameters) == list(inspect.signature(kind.__init__).parameters)[1:]
    for name in named_parameters(kind):
        with pytest.raises(
            UnknownNameError, match=rf"Unknown arguments \['{name}x'\] for {kind.__name__}; .* mean .*'{name}'"
        ):
            kind(**{f"{name}x": 1})


def test_of_parts_too_and_as_pythons_own_error():
    with pytest.raises(TypeError, match=r"Did you mean 'pretrain_frames'\?"):
        PhaseSwitchCallback(frames=10)
    assert "callback_after_eval" in named_parameters(EvaluationCallback)  # handed on to EvalCallback


def test_callbacks_are_copied_and_pickled_as_ever():
    callback = PhaseSwitchCallback(10)
    for again in (copy.deepcopy(callback), pickle.loads(pickle.dumps(callback))):
        assert again.pretrain_frames == 10


def test_who_takes_any_keyword_is_asked_itself():
    class Own(PhaseSwitchCallback):
        def __init__(self, **kwargs):
            self.mine = kwargs.pop("mine")
            super().__init__(**kwargs)

    assert Own(mine=3, pretrain_frames=10).mine == 3
    with pytest.raises(TypeError, match="unexpected keyword argument 'frames'"):
        Own(mine=3, frames=10)
    check_keywords(EvalCallback, ["eval_freq"], ["eval_env"])
    with pytest.raises(UnknownNameError, match="for EvalCallback"):
        check_keywords(EvalCallback, ["eval_env"], ["eval_env"])


@pytest.mark.parametrize(("method", "near"), [("fine_tune", "keep_actor"), ("learn", "callback"), ("learn", "log_interval")])
def test_methods_propose_what_is_near(method, near):
    model = DreamerV2("MlpPolicy", "CartPole-v1", preset="tiny", device="cpu")
    said = rf"DreamerV2.{method}: got an unexpected keyword argument '{near}x'. Did you mean '{near}'"
    with pytest.raises(UnknownNameError, match=said):
        getattr(model, method)(**{f"{near}x": 1})
    assert near in inspect.signature(getattr(model, method)).parameters
