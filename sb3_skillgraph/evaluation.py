"""From anywhere to anywhere: the success rate over random pairs of start and goal (section 4.2)."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import gymnasium as gym
import numpy as np
from scipy.stats import binomtest

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.controller import GLOBAL, OptionOutcome
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


class NoPairsError(ValueError):
    """There is nothing to draw pairs of start and goal from."""


class PairResult(NamedTuple):
    """What became of one pair.

    :param start: shape ``(goal_dim,)``
    :param goal: shape ``(goal_dim,)``
    :param path_length: length of the shortest free path, in cells
    :param success: whether the goal was reached
    :param steps: environment steps until then, or until the end of the episode
    :param status: which of the paper's cases the goal was to the agent's graph; None for agents that do not plan
    :param trace: how the agent's options did on the way; None for agents without a skill graph
    :param nearest: least distance from the goal on the way, in world units
    :param stuck: whether the agent got stuck, as its environment tells in ``info["stuck"]``, which ends the episode
    """

    start: np.ndarray
    goal: np.ndarray
    path_length: float
    success: bool
    steps: int
    status: str | None
    trace: "SkillTrace | None" = None
    nearest: float = np.inf
    stuck: bool = False


class CalibrationBin(NamedTuple):
    """Plans of about the same predicted success.

    :param low: where the bin begins
    :param n_plans: number of plans in it
    :param predicted: their mean predicted success
    :param observed: share of them that were followed to their end without a failure
    """

    low: float
    n_plans: int
    predicted: float
    observed: float


@dataclass
class SkillTrace:
    """How the options of a skill graph did on the way to one goal.

    :param predicted: success probability of the plan at the start; None if it named no option to run
    :param followed: whether the plan's last vertex, or the goal, was reached before any planned option failed
    :param planned_steps: environment steps under options of the graph rather than the global option
    :param n_runs: runs of such options that ended on the way
    :param n_successes: how many of them reached their termination set
    """

    predicted: float | None
    followed: bool | None = None
    planned_steps: int = 0
    n_runs: int = 0
    n_successes: int = 0

    def count(self, outcomes: Sequence[OptionOutcome]) -> None:
        """Count the planned options that have ended."""
        for outcome in outcomes:
            if outcome.option != GLOBAL:
                self.n_runs += 1
                self.n_successes += outcome.success
                if self.followed is None and not outcome.success:
                    self.followed = False


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

    @property
    def traces(self) -> list[SkillTrace]:
        """How the options did, pair by pair; empty for agents without a skill graph."""
        return [pair.trace for pair in self.pairs if pair.trace is not None]

    @property
    def planned_share(self) -> float:
        """Share of all environment steps that options of the graph took."""
        return sum(trace.planned_steps for trace in self.traces) / max(sum(pair.steps for pair in self.pairs), 1)

    @property
    def option_success_rate(self) -> float:
        """Share of the runs of planned options that succeeded (NaN without any)."""
        n_runs = sum(trace.n_runs for trace in self.traces)
        return sum(trace.n_successes for trace in self.traces) / n_runs if n_runs else float("nan")

    def calibration(self, n_bins: int = 5) -> list[CalibrationBin]:
        """Compare what plans promised with what became of them.

        :param n_bins: number of equally wide bins of the predicted success
        :return: the bins that hold plans, lowest first
        """
        plans = [(t.predicted, bool(t.followed)) for t in self.traces if t.predicted is not None]
        bins = []
        for low in np.arange(n_bins) / n_bins:
            inside = [plan for plan in plans if low <= plan[0] < low + 1 / n_bins or (plan[0] == 1.0 == low + 1 / n_bins)]
            if inside:
                predicted, followed = np.mean(inside, axis=0).tolist()
                bins.append(CalibrationBin(float(low), len(inside), predicted, followed))
        return bins


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
    :raises NoPairsError: if no such pairs are found, the maze being too small
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
    raise NoPairsError(f"The maze is too small: no {n_pairs} pairs of points {min_cells} cells apart were found.")


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
    :raises NoPairsError: if the environment has no maze geometry to draw pairs from, or one that is too small
    """
    if not env_id.startswith("SkillGraph/"):
        raise NoPairsError(f"Pairs are drawn from the walls of a maze: that needs a SkillGraph/* environment, not {env_id!r}.")
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
            results.append(run_pair(tested, env, start, goal, cells))
            if tested is not agent:
                tested.get_env().close()
        return PairsResult(results)
    finally:
        env.close()


def run_pair(agent: Predictor, env: gym.Env, start: np.ndarray | None, goal: np.ndarray, cells: float) -> PairResult:
    """Let an agent go from a start to a goal.

    :param agent: anything with SB3's ``predict``
    :param env: a ``SkillGraph/*`` environment that ends its episode on success
    :param start: shape ``(goal_dim,)``; None for where the environment puts the agent
    :param goal: shape ``(goal_dim,)``
    :param cells: length of the shortest free path, in cells
    :return: what became of it
    """
    observation, info = env.reset(options={"start": start, "goal": goal})
    start = observation["achieved_goal"] if start is None else start
    watch = _Watch(agent, observation) if isinstance(agent, SkillGraphAgent) else None
    state: tuple[np.ndarray, ...] | None = None
    episode_start = np.ones(1, dtype=bool)
    steps, nearest = 0, _distance(observation)
    stuck, over = False, bool(info["is_success"])
    while not over:
        if watch is not None:
            action, state = watch.act(observation, state)
        else:
            action, state = agent.predict(observation, state=state, episode_start=episode_start, deterministic=True)
        episode_start = np.zeros(1, dtype=bool)
        observation, _, terminated, truncated, info = env.step(action)
        steps += 1
        nearest = min(nearest, _distance(observation))
        stuck = bool(info.get("stuck"))
        over = terminated or truncated or stuck
    success = bool(info["is_success"])
    status, trace = (watch.plan.status, watch.ended(success, stuck)) if watch is not None else (None, None)
    return PairResult(start, goal, cells, success, steps, status, trace, nearest, stuck)


def _distance(observation: Any) -> float:
    return float(np.linalg.norm(observation["achieved_goal"] - observation["desired_goal"]))


class _Watch:
    """Does what an agent's ``predict`` does, with an eye on its options."""

    def __init__(self, agent: SkillGraphAgent, observation: Any) -> None:
        self.agent = agent
        self.plan = agent.plan(observation)
        runs_options = agent.planning and any(vertex in agent.graph.options for vertex in self.plan.path)
        self.trace = SkillTrace(self.plan.success_probability if runs_options else None)
        self.end = agent.graph.events[self.plan.path[-1]] if self.plan.path else None
        self.planned = False  # whether an option of the graph is running

    def act(self, observation: Any, state: tuple[np.ndarray, ...] | None) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        action, new_state, outcomes = self.agent.act(observation, state)
        self.trace.count(outcomes)
        if self.end is not None and self.trace.followed is None and self.end.holds(np.asarray(observation["achieved_goal"])):
            self.trace.followed = True
        self.planned = bool(new_state.option[0] != GLOBAL)
        self.trace.planned_steps += self.planned
        return action, new_state

    def ended(self, success: bool, stuck: bool) -> SkillTrace:
        self.trace.n_runs += stuck and self.planned  # a run that getting stuck has ended
        if self.trace.followed is None:
            self.trace.followed = success
        return self.trace
