"""Disagreement (Pathak et al., 2019) for agents without a world model, as in the benchmark (URLB, Laskin et al., 2021).

The same mathematics as Plan2Explore, on replayed steps in place of imagined ones.
"""

from __future__ import annotations

import torch as th

from sb3_dreamer_urlb.intrinsic.ensemble import Ensemble, check_ensemble_size
from sb3_dreamer_urlb.intrinsic.transition_reward import EncodedSteps, EncoderSizes, TransitionReward
from sb3_dreamer_urlb.types import Metrics


class Disagreement(TransitionReward):
    """r = Var_k[f_k(e, a)]: the disagreement of models that predict the next encoding. It is not normalised.

    :param ensemble_size: number of models
    :param trains_encoder: the models' loss trains the encoder, on whose encodings actor and critic then learn; False leaves
        the encoder to the critic's loss
    :raises ValueError: for fewer than two models, or if ``trains_encoder`` is neither True nor False
    """

    def __init__(self, ensemble_size: int = 5, trains_encoder: bool = True):
        super().__init__()
        check_ensemble_size(ensemble_size)
        if not isinstance(trains_encoder, bool):
            raise ValueError(f"trains_encoder must be True or False, got {trains_encoder!r}.")
        self.ensemble_size = ensemble_size
        self.trains_encoder = trains_encoder

    def build(self, sizes: EncoderSizes) -> None:
        self.models = Ensemble([sizes.encoding + sizes.action, sizes.hidden, sizes.encoding], self.ensemble_size)

    def loss(self, steps: EncodedSteps) -> tuple[th.Tensor, Metrics]:
        """Distance (not squared) between predicted and next encoding, averaged over steps and models."""
        return self.models.loss(_inputs(steps), steps.next_encoding), {}

    def reward(self, steps: EncodedSteps) -> th.Tensor:
        """Unbiased variance over the models, averaged over the encoding's dimensions, float (B,)."""
        return self.models.disagreement(_inputs(steps))


def _inputs(steps: EncodedSteps) -> th.Tensor:
    return th.cat([steps.encoding, steps.action], -1)
