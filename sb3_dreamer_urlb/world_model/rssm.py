"""The recurrent state-space model: prior p(z_t | z_{t-1}, a_{t-1}) and posterior q(z_t | z_{t-1}, a_{t-1}, e_t)."""

from __future__ import annotations

import torch as th
import torch.nn.functional as F
from torch import nn

from sb3_dreamer_urlb.nn import distributions
from sb3_dreamer_urlb.nn.activation import elu_
from sb3_dreamer_urlb.nn.dense import linear, linear_elu
from sb3_dreamer_urlb.nn.precision import full
from sb3_dreamer_urlb.types import LatentState
from sb3_dreamer_urlb.world_model.gru import recur


class RSSM(nn.Module):
    """Discrete latent dynamics (paper §2 "World models", docs/algorithm.md, "World model").

    :param action_size: A
    :param embed_size: E
    :param deter_size: D, the GRU's state
    :param hidden_size: width of the layers around the GRU
    :param stoch_variables: S categoricals
    :param stoch_classes: K classes each
    """

    def __init__(
        self, action_size: int, embed_size: int, deter_size: int, hidden_size: int, stoch_variables: int, stoch_classes: int
    ):
        super().__init__()
        self.deter_size = deter_size
        self.logits_shape = (stoch_variables, stoch_classes)
        self.stoch_size = stoch_variables * stoch_classes
        self.input = nn.Linear(self.stoch_size + action_size, hidden_size)
        self.gru = nn.Linear(hidden_size + deter_size, 3 * deter_size)
        self.gru_norm = nn.LayerNorm(3 * deter_size)
        self.prior_hidden = nn.Linear(deter_size, hidden_size)
        self.prior_logits = nn.Linear(hidden_size, self.stoch_size)
        self.post_hidden = nn.Linear(deter_size + embed_size, hidden_size)
        self.post_logits = nn.Linear(hidden_size, self.stoch_size)

    def initial(self, n: int) -> LatentState:
        """The zero state that every episode starts from.

        :param n: number of states
        """
        like = self.input.weight
        return LatentState(like.new_zeros(n, self.stoch_size), like.new_zeros(n, self.deter_size))

    # -- the two steps ------------------------------------------------------------------------------------------------

    def prior_step(self, state: LatentState, action: th.Tensor, generator: th.Generator | None = None) -> LatentState:
        """Imagine the next state.

        :param state: z_{t-1}, (n, …)
        :param action: a_{t-1}, float (n, A)
        :param generator: source of randomness
        :return: a sample of z_t, (n, …), its stochastic part in the format of products
        """
        deter = self._recur(state, self._action_part(action))
        return LatentState(self._sample(self._prior_logits(deter), generator), deter)

    def predict_logits(self, state: LatentState, action: th.Tensor) -> th.Tensor:
        """The prior of the next state, p(z_t | z_{t-1}, a_{t-1}), itself.

        :param state: z_{t-1}, (n, …)
        :param action: a_{t-1}, float (n, A)
        :return: logits, float (n, S, K)
        """
        return self._prior(self._recur(state, self._action_part(action)))

    def planning_step(
        self, state: LatentState, action: th.Tensor, stoch_rows: th.Tensor, generator: th.Generator | None = None
    ) -> LatentState:
        """:meth:`prior_step` without gradients, faster: S ones select S rows of the input layer, so no product is needed.

        :param state: z_{t-1}, (n, …); with its ``classes`` if an earlier call gave it
        :param action: a_{t-1}, float (n, A)
        :param stoch_rows: what :meth:`stoch_rows` gives for the current weights
        :param generator: source of randomness
        :return: a sample of z_t with its classes, (n, …)
        """
        stoch_part = None if state.classes is None else F.embedding_bag(state.classes, stoch_rows, mode="sum")
        deter = self._recur(state, self._action_part(action), stoch_part)
        probs = self._prior(deter).softmax(-1)
        classes = distributions.draw_classes(probs, generator)
        first = th.arange(0, self.stoch_size, self.logits_shape[1], device=classes.device)
        return LatentState(distributions.one_hot_like(probs, classes).flatten(-2), deter, classes + first)

    def stoch_rows(self) -> th.Tensor:
        """The input layer's weights of the stochastic state, one row a class, float (S·K, hidden)."""
        return self.input.weight[:, : self.stoch_size].T.contiguous()

    def posterior_step(
        self,
        state: LatentState,
        action: th.Tensor,
        embed: th.Tensor,
        is_first: th.Tensor,
        generator: th.Generator | None = None,
    ) -> LatentState:
        """Infer the current state from the observation; used for acting.

        :param state: z_{t-1}, (n, …)
        :param action: a_{t-1}, float (n, A)
        :param embed: e_t, float (n, E)
        :param is_first: bool (n,), true where an episode begins: state and action are zeroed there
        :param generator: source of randomness
        """
        logits, deter = self.posterior(state, action, embed, is_first)
        return LatentState(self._sample(logits, generator), deter)

    def posterior(
        self, state: LatentState, action: th.Tensor, embed: th.Tensor, is_first: th.Tensor
    ) -> tuple[th.Tensor, th.Tensor]:
        """What :meth:`posterior_step` draws from, whose parameters it takes.

        :return: posterior logits, float (n, S, K), and the next deterministic state, float (n, D)
        """
        keep = (~is_first).to(embed.dtype).unsqueeze(-1)
        deter = self._recur(state.masked(keep), self._action_part(action * keep))
        deter_weight = self.post_hidden.weight[:, : self.deter_size]
        return self._posterior(deter, self._embed_part(embed), deter_weight), deter

    def observe(self, embed: th.Tensor, action: th.Tensor, is_first: th.Tensor) -> tuple[LatentState, th.Tensor, th.Tensor]:
        """Infer the states of replayed sequences.

        Whatever does not depend on the recurrence is one product over all steps: the action part of the input layer,
        the embedding part of the posterior, and all prior logits. In the loop stay the input layer, GRU and posterior.

        :param embed: float (B, T, E)
        :param action: float (B, T, A), the action that led to each step
        :param is_first: bool (B, T)
        :return: posterior states (B, T, …), posterior logits and prior logits, float (B, T, S, K)
        """
        keep = (~is_first).to(embed.dtype).unsqueeze(-1)
        action_parts = self._action_part(action * keep).unbind(1)
        embed_parts = self._embed_part(embed).unbind(1)
        # Cut out once, so that the gradients of all steps are added up before they are put back into the whole.
        stoch_weight, deter_weight = self.input.weight[:, : self.stoch_size], self.post_hidden.weight[:, : self.deter_size]
        state = self.initial(embed.shape[0])
        stochs, deters, logits = [], [], []
        for action_part, embed_part, keep_t in zip(action_parts, embed_parts, keep.unbind(1), strict=True):
            state = state.masked(keep_t)
            deter = self._recur(state, action_part, F.linear(state.stoch, stoch_weight))
            post_logits = self._posterior(deter, embed_part, deter_weight)
            state = LatentState(self._sample(post_logits), deter)
            stochs.append(state.stoch)
            deters.append(deter)
            logits.append(post_logits)
        deter = th.stack(deters, 1)
        return LatentState(th.stack(stochs, 1), deter), th.stack(logits, 1), self._prior(deter)

    # -- their pieces -------------------------------------------------------------------------------------------------

    def _action_part(self, action: th.Tensor) -> th.Tensor:
        return F.linear(action, self.input.weight[:, self.stoch_size :], self.input.bias)

    def _embed_part(self, embed: th.Tensor) -> th.Tensor:
        return linear(embed, self.post_hidden.weight[:, self.deter_size :], self.post_hidden.bias)

    def _recur(self, state: LatentState, action_part: th.Tensor, stoch_part: th.Tensor | None = None) -> th.Tensor:
        if stoch_part is None:
            stoch_part = linear(state.stoch, self.input.weight[:, : self.stoch_size], None)
        x = elu_(stoch_part + action_part)
        gates = linear(th.cat([x, state.deter], -1), self.gru.weight, self.gru.bias)
        return recur(gates, self.gru_norm, state.deter)

    def _prior(self, deter: th.Tensor) -> th.Tensor:
        return full(self._prior_logits(deter))

    def _prior_logits(self, deter: th.Tensor) -> th.Tensor:
        hidden = linear_elu(deter, self.prior_hidden.weight, self.prior_hidden.bias)
        return linear(hidden, self.prior_logits.weight, self.prior_logits.bias).view(deter.shape[:-1] + self.logits_shape)

    def _posterior(self, deter: th.Tensor, embed_part: th.Tensor, deter_weight: th.Tensor) -> th.Tensor:
        hidden = elu_(F.linear(deter, deter_weight) + embed_part)
        return full(self.post_logits(hidden)).view(deter.shape[:-1] + self.logits_shape)

    @staticmethod
    def _sample(logits: th.Tensor, generator: th.Generator | None = None) -> th.Tensor:
        return distributions.sample_one_hot(logits, generator).flatten(-2)
