"""Testing a method: random pairs, an environment's own tasks, and what is learned at test time (section 4.2)."""

from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from stable_baselines3.common.type_aliases import PolicyPredictor

from sb3_skillgraph.evaluation import PairResult, PairsResult, evaluate_pairs, run_pair
from sb3_skillgraph.experiments.learner import Learner
from sb3_skillgraph.experiments.plan import RunSpec
from sb3_skillgraph.hyperparams import make_recommended

STRETCH = 1_000  # environment steps between tests at test time: an episode


class Test(NamedTuple):
    """What came of a test.

    :param pairs: random pairs of start and goal
    :param tasks: episodes of each of the environment's own tasks; empty without
    """

    pairs: PairsResult
    tasks: list[list[PairResult]]

    def as_plain(self) -> dict[str, Any]:
        """Return it as plain data."""
        tasks = {"tasks": [[_plain_pair(pair) for pair in task] for task in self.tasks]} if self.tasks else {}
        pairs = [_plain_pair(pair) for pair in self.pairs.pairs]
        return {"success_rate": self.pairs.success_rate, "interval": self.pairs.interval, "pairs": pairs, **tasks}

    @property
    def task_success_rate(self) -> float:
        """Share of the episodes of its own tasks that succeeded."""
        return float(np.mean([pair.success for task in self.tasks for pair in task]))


def _plain_pair(pair: PairResult) -> dict[str, Any]:
    promised = {"promised": round(pair.trace.promised, 4)} if pair.trace is not None else {}
    return {
        "start": pair.start.round(3).tolist(),
        "goal": pair.goal.round(3).tolist(),
        "path_length": round(pair.path_length, 3),
        "success": bool(pair.success),
        "steps": pair.steps,
        "nearest": round(pair.nearest, 4),
        "stuck": pair.stuck,
        **promised,
    }


def test_policy(policy: PolicyPredictor, spec: RunSpec, n_steps: int) -> Test:
    """Test what a run has learned.

    :param policy: what acts
    :param spec: the run
    :param n_steps: environment steps done; at the end more is tested
    """
    n_pairs = spec.final_pairs if n_steps >= spec.steps else spec.pairs
    env = make_recommended(spec.env_id, {**spec.env_kwargs, **spec.test_kwargs})
    try:
        pairs = evaluate_pairs(policy, env, n_pairs=n_pairs, seed=spec.seed + 1000)
        return Test(pairs, _run_tasks(policy, env, spec) if spec.task_episodes else [])
    finally:
        env.close()


def _run_tasks(policy: PolicyPredictor, env: gym.Env, spec: RunSpec) -> list[list[PairResult]]:
    """Do the tasks that the environment brings, start and goal drawn around theirs."""
    noise = env.get_wrapper_attr("task_noise")
    rng = np.random.default_rng(spec.seed)
    env.reset(seed=spec.seed)
    return [
        [
            run_pair(policy, env, start + rng.uniform(-noise, noise, 2), goal + rng.uniform(-noise, noise, 2), np.nan)
            for _ in range(spec.task_episodes)
        ]
        for start, goal in env.get_wrapper_attr("tasks")
    ]


def learn_at_test_time(learner: Learner, spec: RunSpec, result: PairsResult) -> list[list[bool]]:
    """Let copies go on learning with one pair each; return, pair by pair, what every test gave.

    :param learner: has learned
    :param spec: the run
    :param result: the pairs, as they were tested
    """
    env_kwargs = {"terminate_on_success": True, **spec.env_kwargs}
    curves = []
    for pair in result.pairs[: spec.test_pairs]:
        pinned = make_recommended(spec.env_id, env_kwargs)
        test = make_recommended(spec.env_id, {**env_kwargs, **spec.test_kwargs})
        test.reset(seed=spec.seed)
        practice = Pinned(pinned, pair.start, pair.goal)
        twins = learner.practise(practice, pair.start, pair.goal, [STRETCH] * spec.test_stretches)
        curves.append([run_pair(twin, test, pair.start, pair.goal, pair.path_length).success for twin in twins])
        pinned.close()
        test.close()
    return curves


class Pinned(gym.Wrapper):
    """Begins every episode at one start, with one goal.

    :param env: an environment whose ``reset`` takes both
    :param start: shape ``(goal_dim,)``
    :param goal: shape ``(goal_dim,)``
    """

    def __init__(self, env: gym.Env, start: np.ndarray, goal: np.ndarray) -> None:
        super().__init__(env)
        self.options = {"start": start, "goal": goal}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        :param seed: seeds the wrapped environment
        :param options: not used
        """
        return self.env.reset(seed=seed, options=self.options)
