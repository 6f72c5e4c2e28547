"""Single steps out of the replay: stacks of frames and n-step returns, across ends of episodes."""

from __future__ import annotations

from collections import Counter, deque

import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.buffers import NStepReplayBuffer

from sb3_dreamer_urlb.replay import gathering
from sb3_dreamer_urlb.replay.n_step import NStepFrameReplayBuffer, steps_of
from sb3_dreamer_urlb.replay.windows import window

FRAME = spaces.Box(0, 255, (1, 2, 2), np.uint8)
ACTION = spaces.Box(-1, 1, (2,), np.float32)
#: (steps, whether it terminates) of each episode
EPISODES = st.lists(st.tuples(st.integers(1, 7), st.booleans()), min_size=1, max_size=4)


def frame(number):
    """The frame with this number."""
    return np.full(FRAME.shape, number, np.uint8)


def make(frame_stack=3, n_steps=3, gamma=0.5, space=FRAME, **kwargs):
    return NStepFrameReplayBuffer(
        200, space, ACTION, "cpu", frame_stack=frame_stack, n_steps=n_steps, gamma=gamma, seed=0, **kwargs
    )


def live(episodes):
    """Every step of such a life: observation, next one, action, reward, done, info."""
    number = 0
    for length, terminates in episodes:
        for t in range(length):
            done = t == length - 1
            info = {"TimeLimit.truncated": done and not terminates}
            yield frame(number), frame(number + 1), np.full((1, 2), number / 100, np.float32), float(number % 5), done, info
            number += 1
        number += 1


def fill(buffer, episodes):
    for obs, next_obs, action, reward, done, info in live(episodes):
        buffer.add(obs[None], next_obs[None], action, np.array([reward]), np.array([done]), [info])


def every_step(buffer):
    """All steps of the replay as one batch, in the order in which they were lived."""
    draws = []
    for index, episode in enumerate(buffer.episodes):
        for row in range(len(episode) - 1):
            pieces = window(index, len(episode), row, buffer.frame_stack - 1, buffer.n_steps)
            draws.append([(buffer.episodes[i], start, stop) for i, start, stop in pieces])
    columns = {name: th.from_numpy(rows) for name, rows in gathering.on_host(draws, buffer.batch_length).items()}
    return steps_of(columns, buffer.frame_stack, buffer.n_steps, buffer.gamma)


def numbers(observation):
    """Which frames the stacks hold."""
    return observation[:, :, 0, 0, 0].tolist()


def test_returns_by_hand():
    buffer = make(frame_stack=2, n_steps=3, gamma=0.5)
    # Frames 0 … 4 of an episode that is cut off, 5 … 7 of one that terminates; rewards 0 1 2 3, 0 1.
    fill(buffer, [(4, False), (2, True)])
    batch = every_step(buffer)
    assert batch.reward.tolist() == [0 + 0.5 * 1 + 0.25 * 2, 1 + 0.5 * 2 + 0.25 * 3, 2 + 0.5 * 3, 3, 0 + 0.5 * 1, 1]
    assert batch.discount.tolist() == [0.125, 0.125, 0.25, 0.5, 0, 0]
    assert numbers(batch.observation) == [[0, 0], [0, 1], [1, 2], [2, 3], [5, 5], [5, 6]]
    assert numbers(batch.next_observation) == [[2, 3], [3, 4], [3, 4], [3, 4], [6, 7], [6, 7]]
    assert th.allclose(batch.action[:, 0], th.tensor([0, 0.01, 0.02, 0.03, 0.05, 0.06]))


@given(EPISODES, st.integers(1, 4), st.integers(1, 5), st.sampled_from([1.0, 0.99, 0.5]))
def test_it_agrees_with_sb3s_n_step_buffer(episodes, frame_stack, n_steps, gamma):
    ours = make(frame_stack, n_steps, gamma)
    fill(ours, episodes)
    stacks = spaces.Box(0, 255, (frame_stack, *FRAME.shape), np.uint8)
    theirs = NStepReplayBuffer(64, stacks, ACTION, "cpu", n_steps=n_steps, gamma=gamma)
    begins = True
    for obs, next_obs, action, reward, done, info in live(episodes):
        if begins:
            stack = deque([obs] * frame_stack, maxlen=frame_stack)
        before = np.stack(stack)
        stack.append(next_obs)
        theirs.add(before[None], np.stack(stack)[None], action, np.array([reward]), np.array([done]), [info])
        begins = done
    expected = theirs._get_samples(np.arange(theirs.pos))
    found = every_step(ours)
    assert th.equal(found.observation, expected.observations)
    assert th.equal(found.next_observation, expected.next_observations)
    assert th.equal(found.action, expected.actions)
    assert th.allclose(found.reward, expected.rewards[:, 0])
    assert th.allclose(found.discount, (expected.discounts * (1 - expected.dones))[:, 0])


@pytest.mark.parametrize("store", ["memory", "device"])
def test_every_step_is_drawn_as_often_as_any_other(store):
    buffer = make(store=store)
    fill(buffer, [(1, True), (6, False), (3, True)])
    drawn = buffer.sample(8000)
    counts = Counter(drawn.observation[:, -1, 0, 0, 0].tolist())
    assert sorted(counts) == [0, 2, 3, 4, 5, 6, 7, 9, 10, 11]
    assert all(abs(count - 800) < 120 for count in counts.values())
    assert drawn.observation.dtype == th.uint8


def test_frames_are_stored_once():
    buffer = make()
    fill(buffer, [(9, False)])
    assert buffer.episodes[0].rows(0, 10)["observation"].nbytes == 10 * 4


def test_open_episodes_are_not_drawn_beside_finished_ones():
    buffer = make()
    assert not buffer.can_sample()
    with pytest.raises(ValueError, match="No step was made yet"):
        buffer.sample(2)
    fill(buffer, [(3, False)])
    buffer.add(frame(99)[None], frame(99)[None], np.zeros((1, 2), np.float32), np.zeros(1), np.array([False]), [{}])
    assert buffer.sample(50).next_observation.max() < 99


def test_dicts_and_vectors_are_stacked_too():
    vector = spaces.Box(-1, 1, (3,), np.float32)
    space = spaces.Dict({"image": FRAME, "vector": vector})
    buffer = make(space=space)
    for t in range(5):
        now, then = ({"image": frame(i)[None], "vector": np.full((1, 3), i / 10, np.float32)} for i in (t, t + 1))
        buffer.add(now, then, np.zeros((1, 2), np.float32), np.zeros(1), np.array([t == 4]), [{}])
    batch = buffer.sample(4)
    assert batch.observation["image"].shape == (4, 3, 1, 2, 2)
    assert th.allclose(batch.observation["vector"][..., 0] * 10, batch.observation["image"][..., 0, 0, 0].float())


@pytest.mark.parametrize("store", ["memory", "device"])
@given(length=st.integers(1, 7))
def test_while_no_episode_is_finished_the_open_one_is_drawn_as_if_it_ended_there(store, length):
    open_, ended = make(store=store), make(store=store)
    fill(ended, [(length, False)])
    steps = list(live([(length, False)]))
    for obs, next_obs, action, reward, _, _ in steps:
        open_.add(obs[None], next_obs[None], action, np.array([reward]), np.array([False]), [{}])
    assert not open_.episodes and len(ended.episodes) == 1
    mine, its = (vars(buffer.sample(20)) for buffer in (open_, ended))
    assert all(th.equal(mine[name], its[name]) for name in its)


def test_what_was_fetched_ahead_is_dropped_when_an_open_episode_grew():
    fetched, plain = make(prefetch=True), make()
    for number, (obs, next_obs, action, reward, _, _) in enumerate(live([(9, False)])):
        for buffer in (fetched, plain):
            buffer.add(obs[None], next_obs[None], action, np.array([reward]), np.array([False]), [{}])
        if number % 2:
            assert th.equal(fetched.sample(6).observation, plain.sample(6).observation)
            fetched.prefetch(6)
    fetched.close()
