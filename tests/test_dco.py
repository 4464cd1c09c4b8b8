"""Deep covering options: the learned Fiedler vector against the exact one, and the events it proposes."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import TOY, differences, new_agent
from scipy.stats import spearmanr

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.learning import dco
from sb3_skillgraph.learning.dco import LEARN_EVERY, DCOSalience, FiedlerEmbedding
from sb3_skillgraph.memory.store import TransitionStore


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
    embedding = FiedlerEmbedding(cells[steps[:, 0]], cells[steps[:, 1]], rng)
    values = embedding(cells)
    assert values.shape == (len(cells),)
    assert abs(spearmanr(values, fiedler(neighbours)).statistic) >= 0.95
    assert abs(values.mean()) < 0.2
    assert 0.7 < values.std() < 1.2


def test_it_leaves_torchs_generator_alone_and_repeats_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(dco, "N_UPDATES", 20)
    cells, neighbours = grid(5, 3)
    steps = np.argwhere(neighbours)
    before = th.get_rng_state()
    fits = [FiedlerEmbedding(cells[steps[:, 0]], cells[steps[:, 1]], np.random.default_rng(3)) for _ in range(2)]
    assert th.equal(th.get_rng_state(), before)
    np.testing.assert_array_equal(fits[0](cells), fits[1](cells))


def corridor(n_steps: int) -> TransitionStore:
    """A random walk along a corridor from x = 0 to 10."""
    store, rng = TransitionStore(2 * n_steps, 2, 2, 1), np.random.default_rng(0)
    walk_along(store, n_steps, rng)
    return store


def walk_along(store: TransitionStore, n_steps: int, rng: np.random.Generator) -> None:
    x = 5.0
    for _ in range(n_steps):
        after = float(np.clip(x + rng.choice([-0.5, 0.5]), 0.0, 10.0))
        here, there = (np.array([[value, 0.0]], dtype=np.float32) for value in (x, after))
        no = np.zeros(1, dtype=bool)
        store.add(here, here, there, there, np.zeros((1, 1), np.float32), here, no, no)
        x = after


def test_it_proposes_the_two_ends_and_learns_anew_after_much_experience(monkeypatch: pytest.MonkeyPatch) -> None:
    store = corridor(3_000)
    salience, rng = DCOSalience(store, reach=20, n_pairs=2_000), np.random.default_rng(0)
    learned = []
    learn = dco.learn_fiedler
    monkeypatch.setattr(dco, "learn_fiedler", lambda *arguments: learned.append(store.total) or learn(*arguments))
    proposed = np.array([salience.propose(rng) for _ in range(30)])
    assert {tuple(point) for point in proposed} == {(0.0, 0.0), (10.0, 0.0)}
    assert (proposed[1:] != proposed[:-1]).any(axis=1).all()  # in turn
    walk_along(store, LEARN_EVERY - 1, rng)
    salience.propose(rng)
    assert learned == [3_000]
    walk_along(store, 1, rng)
    salience.propose(rng)
    assert learned == [3_000, 3_000 + LEARN_EVERY]
    # Another one that is given its state goes on like it.
    other = DCOSalience(store, reach=20, n_pairs=2_000)
    other.set_state(salience.get_state())
    for seed in range(5):
        points = [each.propose(np.random.default_rng(seed)) for each in (salience, other)]
        np.testing.assert_array_equal(*points)
    assert len(learned) == 2


def test_it_proposes_nothing_before_there_is_experience() -> None:
    rng = np.random.default_rng(0)
    assert DCOSalience(TransitionStore(10, 2, 2, 1), 20).propose(rng) is None


def test_an_agent_explores_from_the_ends_of_what_it_knows(tmp_path: Path) -> None:
    agent = new_agent(salience="dco")
    agent.learn(800)
    salience = agent.parts.missions.salience
    assert isinstance(salience, DCOSalience)
    ends = np.array(salience.get_state()["ends"])
    assert ends.shape == (2, 2)
    visited = agent.parts.store.column("achieved_goal", np.arange(agent.parts.store.total))
    assert (np.linalg.norm(visited[:, None] - ends, axis=2).min(axis=0) < 1e-9).all()
    # The maze is a corridor around a wall: from one end to the other is further than from either to the middle.
    assert np.linalg.norm(ends[0] - ends[1]) > 1.5
    agent.save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY)).parts.missions.salience
    assert isinstance(loaded, DCOSalience)
    assert differences(salience.get_state(), loaded.get_state()) == []
