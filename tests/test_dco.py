"""Deep covering options: the learned Fiedler vector against the exact one, and the events it proposes."""

import numpy as np
import pytest
import torch as th
from conftest import new_agent
from scipy.stats import spearmanr

from sb3_skillgraph.memory.replay import TransitionStore
from sb3_skillgraph.learning.dco import DCOSalience, FiedlerEmbedding
from sb3_skillgraph.visited import VisitedStates


def grid(width: int, height: int, walls: set[tuple[int, int]] = frozenset()) -> tuple[np.ndarray, np.ndarray]:
    """Return the free cells of a grid, shape (n, 2), and which of them are neighbours, shape (n, n)."""
    cells = np.array([(x, y) for x in range(width) for y in range(height) if (x, y) not in walls], dtype=np.float32)
    return cells, np.abs(cells[:, None] - cells).sum(axis=2) == 1


def fiedler(neighbours: np.ndarray) -> np.ndarray:
    """Return the exact Fiedler vector."""
    laplacian = np.diag(neighbours.sum(axis=1)) - neighbours
    return np.linalg.eigh(laplacian)[1][:, 1]


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize(
    ("width", "height", "walls"),
    [(9, 4, set()), (4, 7, set()), (9, 5, {(x, 2) for x in range(8)})],
    ids=["wide", "high", "around a wall"],
)
def test_it_is_the_fiedler_vector(width: int, height: int, walls: set[tuple[int, int]], seed: int) -> None:
    rng = np.random.default_rng(seed)
    cells, neighbours = grid(width, height, walls)
    steps = np.argwhere(neighbours)[rng.integers(0, neighbours.sum(), 5_000)]
    embedding = FiedlerEmbedding().fit(cells[steps[:, 0]], cells[steps[:, 1]], rng)
    values = embedding(cells)
    assert values.shape == (len(cells),)
    assert abs(spearmanr(values, fiedler(neighbours)).statistic) >= 0.95
    assert abs(values.mean()) < 0.2
    assert 0.7 < values.std() < 1.2


def test_it_leaves_torchs_generator_alone_and_repeats_itself() -> None:
    cells, neighbours = grid(5, 3)
    steps = np.argwhere(neighbours)
    before = th.get_rng_state()
    fits = [
        FiedlerEmbedding(n_updates=20).fit(cells[steps[:, 0]], cells[steps[:, 1]], np.random.default_rng(3)) for _ in range(2)
    ]
    assert th.equal(th.get_rng_state(), before)
    np.testing.assert_array_equal(fits[0](cells), fits[1](cells))


def test_it_says_when_it_has_learned_nothing() -> None:
    with pytest.raises(ValueError, match="call fit first"):
        FiedlerEmbedding()(np.zeros((1, 2)))


def corridor(n_steps: int) -> tuple[TransitionStore, VisitedStates]:
    """A random walk along a corridor from x = 0 to 10."""
    store, visited, rng = TransitionStore(n_steps, 2, 2, 1), VisitedStates(2, 0.25), np.random.default_rng(0)
    x = 5.0
    for t in range(n_steps):
        after = float(np.clip(x + rng.choice([-0.5, 0.5]), 0.0, 10.0))
        here, there = (np.array([[value, 0.0]], dtype=np.float32) for value in (x, after))
        no = np.zeros(1, dtype=bool)
        store.add(here, here, there, there, np.zeros((1, 1), np.float32), here, no, no)
        visited.record(0, t, there[0], done=False)
        x = after
    return store, visited


def test_it_proposes_the_two_ends_and_waits_for_new_experience() -> None:
    store, visited = corridor(3_000)
    salience, rng = DCOSalience(store, visited, reach=20, n_pairs=2_000), np.random.default_rng(0)
    pair = [salience.propose(rng), salience.propose(rng)]
    assert salience.propose(rng) is None
    ends = sorted(float(center[0]) for center in pair if center is not None)
    assert len(ends) == 2
    assert ends[0] < 1.0
    assert ends[1] > 9.0
    store.add(*(store.column(name, np.array([0])) for name in ("observation", "achieved_goal")), *[np.zeros((1, 2))] * 2,
              np.zeros((1, 1)), np.zeros((1, 2)), np.zeros(1, bool), np.zeros(1, bool))  # fmt: skip
    assert salience.propose(rng) is not None


def test_it_proposes_nothing_before_there_is_experience() -> None:
    assert DCOSalience(TransitionStore(10, 2, 2, 1), VisitedStates(2, 0.25), 20).propose(np.random.default_rng(0)) is None


def test_an_agent_finds_events_in_pairs() -> None:
    agent = new_agent(salience="dco", retry_after=5)
    agent.learn(1_000)
    assert agent.discovery.events_per_attempt == 2
    assert len(agent.events) >= 3
    centers = np.array([event.center for event in agent.events])
    nearest = [np.linalg.norm(agent.visited.points - center, axis=1).min() for center in centers[1:]]
    assert max(nearest) < 1e-6  # all but the start lie on visited states
