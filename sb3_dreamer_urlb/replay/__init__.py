"""Replay of episodes."""

from sb3_dreamer_urlb.replay.sequence_buffer import SequenceReplayBuffer

__all__ = ["SequenceReplayBuffer"]
