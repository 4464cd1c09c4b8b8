"""From anywhere to anywhere: the success rate over random pairs of start and goal (section 4.2)."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.type_aliases import PolicyPredictor
from tqdm import tqdm

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.calibration import CalibrationBin, calibration
from sb3_skillgraph.envs import MazeGeometry, find
from sb3_skillgraph.envs.metrics import metric_of
from sb3_skillgraph.envs.wrappers import time_limit
from sb3_skillgraph.hyperparams import make_recommended
from sb3_skillgraph.planning import DIRECT

#: Length of the shortest free path between start and goal, in cells, at least.
MIN_CELLS = 2.0


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
    :param trace: what the plan at the start promised, and how options did; None for agents without a skill graph
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


@dataclass
class SkillTrace:
    """How the options of a skill graph did on the way to one goal.

    :param promised: success probability of the plan at the start
    :param expected_steps: environment steps that it expected
    :param n_runs: runs of options that ended on the way
    :param n_successes: how many of them reached their termination set
    :param direct_steps: environment steps under the walk to the goal itself
    """

    promised: float
    expected_steps: float
    n_runs: int = 0
    n_successes: int = 0
    direct_steps: int = 0


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
        from scipy.stats import binomtest  # when it is used: it takes half a second to import

        n_successes = sum(pair.success for pair in self.pairs)
        interval = binomtest(n_successes, len(self.pairs)).proportion_ci(0.95, method="wilson")
        return float(interval.low), float(interval.high)

    @property
    def traces(self) -> list[SkillTrace]:
        """What plans promised and options did, pair by pair; empty for agents without a skill graph."""
        return [pair.trace for pair in self.pairs if pair.trace is not None]

    @property
    def option_success_rate(self) -> float:
        """Share of the runs of options that succeeded (NaN without any)."""
        n_runs = sum(trace.n_runs for trace in self.traces)
        return sum(trace.n_successes for trace in self.traces) / n_runs if n_runs else float("nan")

    @property
    def promises(self) -> list[tuple[float, bool]]:
        """What the plan of each pair promised, and whether the goal was reached; empty without a skill graph."""
        return [(pair.trace.promised, pair.success) for pair in self.pairs if pair.trace is not None]

    def calibration(self, n_bins: int = 5) -> list[CalibrationBin]:
        """Compare what plans promised with what happened.

        :param n_bins: number of equally wide bins of the promised success
        :return: the bins that hold plans, lowest first
        """
        return calibration(self.promises, n_bins)


def sample_pairs(geometry: MazeGeometry, margin: float, n_pairs: int, seed: int) -> list[tuple[np.ndarray, np.ndarray, float]]:
    """Draw starts and goals uniformly over the free area, redrawn until their shortest free path is long enough.

    :param geometry: the maze
    :param margin: distance kept from walls, in world units
    :param n_pairs: how many
    :param seed: seed
    :return: start, goal, and path length in cells
    :raises NoPairsError: if no such pairs are found, the maze being too small
    """
    rng = np.random.default_rng(seed)
    pairs: list[tuple[np.ndarray, np.ndarray, float]] = []
    for _ in range(1000 * n_pairs):
        start, goal = geometry.sample_free(rng, margin), geometry.sample_free(rng, margin)
        cells = geometry.shortest_path_length(start, goal) / geometry.cell_size
        if MIN_CELLS <= cells < np.inf:
            pairs.append((start, goal, cells))
        if len(pairs) == n_pairs:
            return pairs
    raise NoPairsError(f"The maze is too small: no {n_pairs} pairs of points {MIN_CELLS} cells apart were found.")


def evaluate_pairs(
    agent: PolicyPredictor,
    env: gym.Env | str,
    *,
    env_kwargs: dict[str, Any] | None = None,
    n_pairs: int = 100,
    seed: int = 0,
    adapt_timesteps: int = 0,
    progress_bar: bool = False,
) -> PairsResult:
    """Measure how often an agent gets from a random start to a random goal.

    The agent is the same for every pair: acting changes nothing in it, and adaptation works on a copy. For each pair
    the environment is reset to its start; the pair succeeds if the goal is reached at any step of the episode (1000 steps on
    ``SkillGraph/*`` mazes). Other environments, and ``SkillGraph/PointKeyDoor-v0``, draw start and goal themselves, at each
    reset; reached is what they call so in
    ``info["is_success"]`` or ``info["success"]``, else to be within their radius, or the agent's ``event_radius``.

    :param agent: anything with SB3's ``predict``
    :param env: a goal environment, or the id of one, which gets the wrapper that is recommended for it
    :param env_kwargs: keyword arguments for an id, such as ``maze_map`` or ``success_radius``
    :param n_pairs: number of pairs
    :param seed: seed of the pairs, and of the environment
    :param adapt_timesteps: environment steps that a copy of the agent learns with each goal before it is tested
    :param progress_bar: whether to show how far it is
    :return: success rate, interval and every pair
    :raises ValueError: if it is no goal environment, or does not tell when a goal is reached
    :raises NoPairsError: if it is a maze that is too small, or adaptation is asked for where start and goal cannot be given

    >>> from sb3_skillgraph.baselines import RandomWalk
    >>> env = gym.make("SkillGraph/ToyMaze-v0", max_steps=50)
    >>> result = evaluate_pairs(RandomWalk(env.action_space, seed=0), env, n_pairs=5)
    >>> len(result.pairs), 0.0 <= result.success_rate <= 1.0
    (5, True)
    """
    if not isinstance(n_pairs, int) or n_pairs < 1:
        raise ValueError(f"n_pairs must be a whole number, 1 at least, not {n_pairs!r}.")
    if isinstance(env, str):
        find(env)
    made = make_recommended(env, env_kwargs or {}) if isinstance(env, str) else env
    try:
        drawn: Sequence[tuple[np.ndarray | None, np.ndarray | None, float]] = [(None, None, np.nan)] * n_pairs
        if made.has_wrapper_attr("geometry") and not made.has_wrapper_attr("goal_metric"):
            drawn = sample_pairs(made.get_wrapper_attr("geometry"), made.get_wrapper_attr("body_radius"), n_pairs, seed)
        elif adapt_timesteps:
            raise NoPairsError("To adapt, the environment must take start and goal at reset, as SkillGraph/* do.")
        made.reset(seed=seed)
        results = []
        for start, goal, cells in tqdm(drawn, unit="pair", disable=not progress_bar):
            tested: Any = agent
            if adapt_timesteps:
                assert made.spec is not None, "To adapt, give the environment's id, or make it by gym.make."
                tested = tested.copy(make_vec_env(partial(gym.make, made.spec), tested.n_envs))
                tested.adapt(goal, start=start, total_timesteps=adapt_timesteps)
            results.append(run_pair(tested, made, start, goal, cells))
            if tested is not agent:
                tested.get_env().close()
        return PairsResult(results)
    finally:
        if isinstance(env, str):
            made.close()
        elif isinstance(agent, SkillGraphAgent) and _learns_in(agent, made):
            agent._last_obs = None  # the environment is no longer where learning has left it


def run_pair(
    agent: PolicyPredictor, env: gym.Env, start: np.ndarray | None, goal: np.ndarray | None, cells: float
) -> PairResult:
    """Let an agent go from a start to a goal; the episode ends there.

    :param agent: anything with SB3's ``predict``
    :param env: a goal environment; start and goal can be given to ``SkillGraph/*`` ones
    :param start: shape ``(goal_dim,)``; None for where the environment puts the agent
    :param goal: shape ``(goal_dim,)``; None for what the environment draws
    :param cells: length of the shortest free path, in cells
    :return: what became of it
    """
    with _planning_for(agent, env):
        has_reached = judge(agent, env)
        observation, info = env.reset(options=None if goal is None else {"start": start, "goal": goal})
        start = np.array(observation["achieved_goal"]) if start is None else start
        goal = np.array(observation["desired_goal"]) if goal is None else goal
        plan = agent.plan(observation) if isinstance(agent, SkillGraphAgent) else None
        trace = None if plan is None else SkillTrace(plan.success_probability, plan.expected_steps)
        state: tuple[np.ndarray, ...] | None = None
        episode_start = np.ones(1, dtype=bool)
        steps, nearest = 0, _distance(observation)
        stuck, success = False, has_reached(observation, info, begins=True)
        over = success
        while not over:
            if isinstance(agent, SkillGraphAgent) and trace is not None:
                # As predict does, with an eye on its options
                action, state, runs = agent.act(observation, state)
                trace.n_runs += len(runs)
                trace.n_successes += sum(run.success for run in runs)
                trace.direct_steps += int(state.option[0] == DIRECT)
            else:
                action, state = agent.predict(observation, state=state, episode_start=episode_start, deterministic=True)
            episode_start = np.zeros(1, dtype=bool)
            observation, _, terminated, truncated, info = env.step(action)
            steps += 1
            nearest = min(nearest, _distance(observation))
            stuck, success = bool(info.get("stuck")), has_reached(observation, info)
            over = success or terminated or truncated or stuck
        if trace is not None and success and steps > 0:
            # The run that has reached the goal, with which the episode ended
            trace.n_runs += 1
            trace.n_successes += 1
        status = None if plan is None else plan.status
        return PairResult(start, goal, cells, success, steps, status, trace, nearest, stuck)


def _learns_in(agent: SkillGraphAgent, env: gym.Env) -> bool:
    """Tell whether an environment is one of an agent's own."""
    return any(own.unwrapped is env.unwrapped for own in getattr(agent.get_env(), "envs", ()))


@contextmanager
def _planning_for(agent: PolicyPredictor, env: gym.Env) -> Iterator[None]:
    """Let an agent plan for the episodes of an environment: they may be longer than those that it has learned in."""
    limit = time_limit(env)
    if not isinstance(agent, SkillGraphAgent) or limit is None:
        yield
        return
    planner = agent.parts.planner
    own, planner.horizon = planner.horizon, limit
    try:
        yield
    finally:
        planner.horizon = own


def judge(agent: PolicyPredictor, env: gym.Env) -> Callable[..., bool]:
    """Return what tells from an observation and an info whether the goal is reached, as an environment sees it.

    A third argument says that the episode has just begun.

    :param agent: its metric counts where the environment says nothing
    :param env: a goal environment
    """
    metric = metric_of(env)
    if metric is None:
        metric = getattr(agent, "metric", None)

    def has_reached(observation: Any, info: dict[str, Any], begins: bool = False) -> bool:
        for name in ("is_success", "success"):
            if name in info:
                return bool(info[name])
        if metric is None:
            if begins:
                return False  # many tell it with a step only
            raise ValueError(f"{env} does not tell when a goal is reached: it has no radius, and says nothing in its info.")
        return metric.reached(observation["achieved_goal"], observation["desired_goal"])

    return has_reached


def _distance(observation: Any) -> float:
    return float(np.linalg.norm(observation["achieved_goal"] - observation["desired_goal"]))
