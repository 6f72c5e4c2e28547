"""What every way to explore has in common, whatever the agent: it knows what it was made with, so that files can hold it."""

from __future__ import annotations

from typing import Any, ClassVar

from torch import nn

from sb3_dreamer_urlb.signatures import named_arguments


class ExplorationMethod(nn.Module):
    """Base of :class:`~sb3_dreamer_urlb.IntrinsicReward`, which reads a world model, and of
    :class:`~sb3_dreamer_urlb.intrinsic.transition_reward.TransitionReward`, which reads replayed steps.
    """

    #: what it makes its rewards of, for messages
    reads: ClassVar[str]
    #: False: nothing for an actor to learn, pre-training acts uniformly at random
    trains_actor: ClassVar[bool] = True
    #: False: something changes in Python from update to update, as a counter or a schedule, and a recorded update would not
    #: see it (graphs.py); updates then run eager on CUDA, too
    graph_safe: ClassVar[bool] = True

    #: what the constructor was called with, for files
    constructor_kwargs: dict[str, Any]

    def __new__(cls, *args: Any, **kwargs: Any) -> Any:
        self = super().__new__(cls)
        # A copy is made without arguments, and gets them with everything else.
        self.__dict__["constructor_kwargs"] = named_arguments(cls, args, kwargs)
        return self
