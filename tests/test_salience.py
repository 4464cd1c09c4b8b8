"""Where explorations are to lead: proposals of points of goal space."""

import numpy as np
import pytest
from builders import profile
from hypothesis import given
from hypothesis import strategies as st

from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.learning.salience import MARGIN, MARGIN_SHARE, FrontierSalience, RandomSalience, box_around
from sb3_skillgraph.metric import Ball

RADIUS = 0.5


def graph_of(*centers: tuple[float, ...]) -> SkillGraph:
    graph = SkillGraph(len(centers[0]) if centers else 2, RADIUS, max_events=500)
    for center in centers:
        graph.add_event(np.array(center), salient=False)
    return graph


@given(st.integers(0, 1000), st.integers(1, 4), st.integers(1, 20))
@profile(25)
def test_frontier_proposes_points_in_the_box_around_what_was_visited(seed: int, goal_dim: int, n_events: int) -> None:
    rng = np.random.default_rng(seed)
    centers = rng.normal(0.0, 5.0, (n_events, goal_dim))
    salience = FrontierSalience(graph_of(*map(tuple, centers)))
    lower, upper = box_around(centers, Ball(RADIUS))
    for low, high, least, most in zip(lower, upper, centers.min(axis=0), centers.max(axis=0), strict=True):
        margin = max(MARGIN * RADIUS, MARGIN_SHARE * (most - least))
        assert (low, high) == (pytest.approx(least - margin), pytest.approx(most + margin))
    for _ in range(20):
        proposed = salience.propose(rng)
        assert proposed is not None
        assert proposed.shape == (goal_dim,)
        assert (lower <= proposed).all()
        assert (proposed <= upper).all()


def test_frontier_reaches_all_of_the_box_and_grows_with_the_graph() -> None:
    graph, rng = graph_of((0.0, 0.0), (20.0, 0.0)), np.random.default_rng(0)
    salience = FrontierSalience(graph)

    def extent() -> list[float]:
        points = np.array([salience.propose(rng) for _ in range(500)])
        return [*points.min(axis=0), *points.max(axis=0)]

    assert extent() == pytest.approx([-2.0, -1.0, 22.0, 1.0], abs=0.3)
    graph.add_event(np.array([0.0, 10.0]), salient=True)
    assert extent() == pytest.approx([-2.0, -1.0, 22.0, 11.0], abs=0.3)


def test_frontier_proposes_nothing_before_anything_was_visited() -> None:
    assert FrontierSalience(graph_of()).propose(np.random.default_rng(0)) is None


def test_proposals_are_those_of_the_generator() -> None:
    salience = FrontierSalience(graph_of((0.0, 0.0)))
    first, again, other = (salience.propose(np.random.default_rng(seed)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)


def test_rrt_asks_the_oracle() -> None:
    asked = []

    def sample_free(rng: np.random.Generator) -> np.ndarray:
        asked.append(rng)
        return np.array([7, 8], dtype=np.float32)

    rng = np.random.default_rng(0)
    proposed = RandomSalience(sample_free).propose(rng)
    assert asked == [rng]
    assert proposed is not None
    assert proposed.dtype == np.float64
    assert proposed.tolist() == [7.0, 8.0]
