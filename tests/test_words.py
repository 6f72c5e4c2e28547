"""Numbers as sentences have them."""

import math

import pytest

from sb3_dreamer_urlb.words import counted, mean_and_spread


@pytest.mark.parametrize(("count", "said"), [(0, "0 episodes"), (1, "1 episode"), (2, "2 episodes")])
def test_one_is_singular(count, said):
    assert counted(count, "episode") == said


@pytest.mark.parametrize(
    ("mean", "std", "episodes", "said"),
    [(33.3, 4.4, 10, "33 ± 4"), (33.3, 0.0, 2, "33 ± 0"), (33.3, 0.0, 1, "33"), (33.3, math.nan, 10, "33")],
)
def test_a_single_episode_has_no_spread(mean, std, episodes, said):
    assert mean_and_spread(mean, std, episodes) == said
