"""A model that random interleavings learn with, and how much it has learnt: what such tests share."""

from __future__ import annotations

import io

from hypothesis.stateful import RuleBasedStateMachine

from sb3_dreamer_urlb import DreamerV2


class LearningMachine(RuleBasedStateMachine):
    """Whoever extends it sets ``model`` and ``learnt``, steps of learning that the replay must hold, in its first rule."""

    def learn(self, steps, callback=None, **kwargs):
        """As the model's, also where a callback or an environment raises."""
        model, before = self.model, self.model.num_timesteps
        try:
            model.learn(steps, callback=callback, **kwargs)
        finally:
            # learn() may begin counting anew.
            self.learnt += model.num_timesteps - (0 if kwargs.get("reset_num_timesteps") else before)

    def go_through_files(self, env, force_reset):
        """The model becomes what its files hold, in another environment or the same."""
        model, replay = io.BytesIO(), io.BytesIO()
        self.model.save(model)
        self.model.save_replay_buffer(replay)
        model.seek(0), replay.seek(0)
        self.model = DreamerV2.load(model, env, device="cpu", force_reset=force_reset)
        self.model.load_replay_buffer(replay)
