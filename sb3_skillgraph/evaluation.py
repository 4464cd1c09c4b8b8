"""From anywhere to anywhere: the success rate over random pairs of start and goal (section 4.2)."""

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from scipy.stats import binomtest

from sb3_skillgraph.envs import MazeGeometry


class Predictor(Protocol):
    """Anything that acts as SB3's models do."""

    def predict(
        self,
        observation: Any,
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """Return actions and the state to pass back in."""


class PairResult(NamedTuple):
    """What became of one pair.

    :param start: shape ``(goal_dim,)``
    :param goal: shape ``(goal_dim,)``
    :param path_length: length of the shortest free path, in cells
    :param success: whether the goal was reached
    :param steps: environment steps until then, or until the end of the episode
    :param status: which of the paper's cases the goal was to the agent's graph; None for agents that do not plan
    """

    start: np.ndarray
    goal: np.ndarray
    path_length: float
    success: bool
    steps: int
    status: str | None


@dataclass(frozen=True)
class PairsResult:
    """The outcome of :func:`evaluate_pairs`.

    :param pairs: one result per pair
    """

    pairs: list[PairResult]

    @property
    def success_rate(self) -> float:
        """Share of the pairs whose goal was reached."""
        return float(np.mean([pair.success for pair in self.pairs]))

    @property
    def interval(self) -> tuple[float, float]:
        """95 % confidence interval of the success rate (Wilson)."""
        n_successes = sum(pair.success for pair in self.pairs)
        interval = binomtest(n_successes, len(self.pairs)).proportion_ci(0.95, method="wilson")
        return float(interval.low), float(interval.high)


def sample_pairs(
    geometry: MazeGeometry, margin: float, n_pairs: int, seed: int, min_cells: float = 2.0
) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Draw starts and goals uniformly over the free area, redrawn until their shortest free path is long enough.

    :param geometry: the maze
    :param margin: distance kept from walls, in world units
    :param n_pairs: how many
    :param seed: seed
    :param min_cells: shortest path at least, in cells
    :return: start, goal, and path length in cells
    :raises ValueError: if no such pairs are found, the maze being too small
    """
    rng = np.random.default_rng(seed)
    pairs: list[tuple[np.ndarray, np.ndarray, float]] = []
    for _ in range(1000 * n_pairs):
        if len(pairs) == n_pairs:
            return pairs
        start, goal = geometry.sample_free(rng, margin), geometry.sample_free(rng, margin)
        cells = geometry.shortest_path_length(start, goal) / geometry.cell_size
        if min_cells <= cells < np.inf:
            pairs.append((start, goal, cells))
    if len(pairs) == n_pairs:
        return pairs
    raise ValueError(f"The maze is too small: no {n_pairs} pairs of points {min_cells} cells apart were found.")


def evaluate_pairs(
    agent: Predictor,
    env_id: str,
    *,
    env_kwargs: dict[str, Any] | None = None,
    n_pairs: int = 100,
    seed: int = 0,
    adapt_timesteps: int = 0,
) -> PairsResult:
    """Measure how often an agent gets from a random start to a random goal.

    The agent is the same for every pair: acting changes nothing in it, and adaptation works on a copy. For each pair
    the environment is reset to its start; the pair succeeds if the agent comes within the success radius at any step of
    the episode (1000 steps on ``SkillGraph/*`` mazes).

    :param agent: anything with SB3's ``predict``
    :param env_id: id of a ``SkillGraph/*`` environment
    :param env_kwargs: keyword arguments for it, such as ``maze_map`` or ``success_radius``
    :param n_pairs: number of pairs
    :param seed: seed of the pairs, and of the environment
    :param adapt_timesteps: environment steps that a copy of the agent learns with each goal before it is tested
    :return: success rate, interval and every pair
    :raises ValueError: if the environment has no maze geometry to draw pairs from
    """
    if not env_id.startswith("SkillGraph/"):
        raise ValueError(f"evaluate_pairs draws its pairs from a maze: it needs a SkillGraph/* environment, not {env_id!r}.")
    env = gym.make(env_id, **{"terminate_on_success": True, **(env_kwargs or {})})
    try:
        drawn = sample_pairs(env.get_wrapper_attr("geometry"), env.get_wrapper_attr("body_radius"), n_pairs, seed)
        env.reset(seed=seed)
        results = []
        for start, goal, cells in drawn:
            tested: Any = agent
            if adapt_timesteps:
                tested = tested.copy(gym.make(env_id, **(env_kwargs or {})))
                tested.adapt(goal, start=start, total_timesteps=adapt_timesteps)
            results.append(_run_pair(tested, env, start, goal, cells))
            if tested is not agent:
                tested.get_env().close()
        return PairsResult(results)
    finally:
        env.close()


def _run_pair(agent: Predictor, env: gym.Env, start: np.ndarray, goal: np.ndarray, cells: float) -> PairResult:
    observation, info = env.reset(options={"start": start, "goal": goal})
    status = agent.plan(observation).status if hasattr(agent, "plan") else None
    state: tuple[np.ndarray, ...] | None = None
    episode_start = np.ones(1, dtype=bool)
    steps, over = 0, bool(info["is_success"])
    while not over:
        action, state = agent.predict(observation, state=state, episode_start=episode_start, deterministic=True)
        episode_start = np.zeros(1, dtype=bool)
        observation, _, terminated, truncated, info = env.step(action)
        steps += 1
        over = terminated or truncated
    return PairResult(start, goal, cells, bool(info["is_success"]), steps, status)
