"""The methods that are compared, each behind the same few calls."""

import io
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import PolicyPredictor

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.baselines import (
    CoveringOptions,
    HindsightRecipe,
    NewGoals,
    OptionTask,
    RandomWalk,
    ReplaySearch,
    StraightOn,
    make_her,
    make_uvfa,
)
from sb3_skillgraph.experiments.learner import Check, Learner, check_names
from sb3_skillgraph.experiments.run_folder import AGENT, load_agent, save_agent, stops
from sb3_skillgraph.hyperparams import check_hyperparams, load_hyperparams, make_recommended
from sb3_skillgraph.options.learner import OptionDDPG, OptionTD3
from sb3_skillgraph.plotting import snapshot

GOAL_STEPS = 200  # for which the recipe pursues a goal, as long as an option may run
_COVERING_CLASSES = {"OptionDDPG": OptionDDPG, "OptionTD3": OptionTD3}


def _recommended(env_id: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """Return arguments of a skill graph: what is recommended for an environment, but for what is given."""
    recommended = {**load_hyperparams(env_id), **check_hyperparams(arguments, "arguments")}
    del recommended["n_timesteps"]
    return recommended


class SkillGraphLearner(Learner):
    """Deep Skill Graphs; episodes do not end at goals, and there is no reward."""

    resumable = True

    def __init__(self, env_id: str, env_kwargs: dict[str, Any], seed: int, arguments: dict[str, Any]) -> None:
        self.env = make_recommended(env_id, env_kwargs)
        self.agent = SkillGraphAgent(env=self.env, seed=seed, **self.resolve(env_id, arguments))

    @classmethod
    def check_arguments(cls, arguments: dict[str, Any], where: str) -> None:
        """They are those of the agent."""
        check_hyperparams(arguments, where)

    @classmethod
    def resolve(cls, env_id: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Fill in what is recommended."""
        return _recommended(env_id, arguments)

    @property
    def policy(self) -> PolicyPredictor:  # type: ignore[override]
        """What is tested."""
        return self.agent

    def learn(self, begin: int, end: int, every: int, check: Check) -> None:
        """Learn from check to check: between two calls of ``learn`` an agent can be saved exactly."""
        for target in stops(begin, end, every):
            self.agent.learn(target - begin, log_interval=None, reset_num_timesteps=False)
            begin = target
            check(target)

    def save(self, folder: Path) -> None:
        """Save the agent and its experience."""
        save_agent(self.agent, folder)

    def load(self, folder: Path) -> None:
        """Load both."""
        self.agent = load_agent(folder, self.env)

    def practise(self, env: gym.Env, start: np.ndarray, goal: np.ndarray, stretches: list[int]) -> Iterator[PolicyPredictor]:
        """Adapt a copy; its episodes do not end at the goal."""
        twin = self.agent.copy(gym.make(self.env.spec))  # type: ignore[arg-type]
        yield twin
        for n_steps in stretches:
            twin.adapt(goal, start=start, total_timesteps=n_steps)
            yield twin

    def rival(self, algorithm: str, arguments: dict[str, Any] | None = None) -> PolicyPredictor:
        """Let the same walker go by something else than the graph."""
        return RIVALS[algorithm](self.agent, **(arguments or {}))

    def summary(self) -> dict[str, float]:
        """Describe the graph, and count how often the agent got stuck."""
        return {f"skillgraph/{name}": value for name, value in self.agent.graph_summary().items()}

    def snapshot(self) -> dict[str, Any]:
        """Return events and what joins them."""
        return snapshot(self.agent)


def _checking(every: int, end: int, check: Check) -> Check:
    """Return what checks every so often, but not at the end, when it is called after every step."""

    def on_step(n_steps: int) -> None:
        if n_steps % every == 0 and n_steps < end:
            check(n_steps)

    return on_step


class _Checks(BaseCallback):
    def __init__(self, checking: Check) -> None:
        super().__init__()
        self.checking = checking

    def _on_step(self) -> bool:
        self.checking(self.num_timesteps)
        return True


def _ending_at_goals(env_id: str, env_kwargs: dict[str, Any]) -> gym.Env:
    """Make an environment whose episodes end at goals; other people's are taken as they come."""
    ours = {"terminate_on_success": True} if env_id.startswith("SkillGraph/") else {}
    return make_recommended(env_id, {**ours, **env_kwargs})


class GoalConditionedLearner(Learner):
    """SB3's DDPG (which is a TD3 to SB3) that is told the goal, with hindsight or without."""

    make: Callable[..., TD3]

    def __init__(self, env_id: str, env_kwargs: dict[str, Any], seed: int, arguments: dict[str, Any]) -> None:
        self.policy: TD3 = type(self).make(_ending_at_goals(env_id, env_kwargs), seed=seed, **arguments)

    @classmethod
    def check_arguments(cls, arguments: dict[str, Any], where: str) -> None:
        """They are those of DDPG, and the baseline's own."""
        check_names(arguments, where, cls.make, DDPG)

    def learn(self, begin: int, end: int, every: int, check: Check) -> None:
        """Learn in one go."""
        self.policy.learn(end, callback=_Checks(_checking(every, end, check)), log_interval=1_000_000)
        check(end)

    def save(self, folder: Path) -> None:
        """Save the model."""
        self.policy.save(folder / "model.zip")

    def practise(self, env: gym.Env, start: np.ndarray, goal: np.ndarray, stretches: list[int]) -> Iterator[PolicyPredictor]:
        """Let a copy go on learning."""
        model, experience = io.BytesIO(), io.BytesIO()
        self.policy.save(model)
        self.policy.save_replay_buffer(experience)
        model.seek(0)
        experience.seek(0)
        twin = type(self.policy).load(model, env=env)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the running episode is cut is meant
            twin.load_replay_buffer(experience)
        yield twin
        for n_steps in stretches:
            twin.learn(n_steps, log_interval=1_000_000, reset_num_timesteps=False)
            yield twin


class UVFALearner(GoalConditionedLearner):
    """A new goal every 30 episodes."""

    make = staticmethod(make_uvfa)


class HERLearner(GoalConditionedLearner):
    """A new goal every episode, and in hindsight."""

    make = staticmethod(make_her)

    def practise(self, env: gym.Env, start: np.ndarray, goal: np.ndarray, stretches: list[int]) -> Iterator[PolicyPredictor]:
        """Let a copy go on learning, paid as before."""
        rule = self.policy.get_env().get_attr("rule")[0]  # type: ignore[union-attr]
        yield from super().practise(OptionTask(env, rule), start, goal, stretches)


class RecipeLearner(Learner):
    """The skill graph's walker, learned by itself."""

    def __init__(self, env_id: str, env_kwargs: dict[str, Any], seed: int, arguments: dict[str, Any]) -> None:
        env = NewGoals(make_recommended(env_id, env_kwargs), GOAL_STEPS)
        self.recipe = HindsightRecipe(env, seed=seed, **self.resolve(env_id, arguments))
        self.policy = self.recipe.policy

    @classmethod
    def check_arguments(cls, arguments: dict[str, Any], where: str) -> None:
        """They are those of the agent."""
        check_hyperparams(arguments, where)

    @classmethod
    def resolve(cls, env_id: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Fill in what is recommended."""
        return _recommended(env_id, arguments)

    def learn(self, begin: int, end: int, every: int, check: Check) -> None:
        """Learn in one go."""
        self.recipe.learn(end, _checking(every, end, check))
        check(end)

    def save(self, folder: Path) -> None:
        """Save the agent."""
        self.recipe.agent.save(folder / AGENT)

    def practise(self, env: gym.Env, start: np.ndarray, goal: np.ndarray, stretches: list[int]) -> Iterator[PolicyPredictor]:
        """Let a copy go on learning."""
        twin = self.recipe.copy(env)
        yield twin.policy
        for n_steps in stretches:
            twin.learn(n_steps)
            yield twin.policy


class CoveringOptionsLearner(Learner):
    """Deep covering options under SMDP Q-learning, tested with the exploration it ends learning with.

    A choice that leads nowhere would otherwise be repeated until the episode is over.
    """

    def __init__(self, env_id: str, env_kwargs: dict[str, Any], seed: int, arguments: dict[str, Any]) -> None:
        env = _ending_at_goals(env_id, env_kwargs)
        name = arguments.get("option_class", "OptionDDPG")
        if name not in _COVERING_CLASSES:
            raise ValueError(f"option_class is {' or '.join(_COVERING_CLASSES)} for covering options, not {name!r}.")
        given = {**arguments, "option_class": _COVERING_CLASSES[name]}
        self.learner = CoveringOptions(env, seed=seed, **given)
        self.policy = _Exploring(self.learner)

    @classmethod
    def check_arguments(cls, arguments: dict[str, Any], where: str) -> None:
        """They are those of the class."""
        check_names(arguments, where, CoveringOptions)

    def learn(self, begin: int, end: int, every: int, check: Check) -> None:
        """Learn in one go."""
        self.learner.learn(end, _checking(every, end, check))
        check(end)

    def save(self, folder: Path) -> None:
        """Save what chooses, and the options' policies."""
        self.learner.save(folder)

    def practise(self, env: gym.Env, start: np.ndarray, goal: np.ndarray, stretches: list[int]) -> Iterator[PolicyPredictor]:
        """Let a copy go on learning."""
        twin = self.learner.copy(env)
        yield _Exploring(twin)
        for n_steps in stretches:
            twin.learn(n_steps)
            yield _Exploring(twin)


class _Exploring:
    def __init__(self, learner: CoveringOptions) -> None:
        self.learner = learner

    def predict(self, *args: Any, **kwargs: Any) -> Any:
        model = self.learner.model
        rate, model.exploration_rate = model.exploration_rate, model.exploration_final_eps
        try:
            return self.learner.predict(*args, **{**kwargs, "deterministic": False})
        finally:
            model.exploration_rate = rate  # for what it learns from later


class RandomWalkLearner(Learner):
    """Learns nothing; the least to beat."""

    def __init__(self, env_id: str, env_kwargs: dict[str, Any], seed: int, arguments: dict[str, Any]) -> None:
        env = make_recommended(env_id, env_kwargs)
        assert isinstance(env.action_space, spaces.Box)
        self.policy = RandomWalk(env.action_space, seed, **arguments)
        env.close()

    @classmethod
    def check_arguments(cls, arguments: dict[str, Any], where: str) -> None:
        """There are none."""
        check_names(arguments, where)

    def learn(self, begin: int, end: int, every: int, check: Check) -> None:
        """Only be tested."""
        check(end)

    def save(self, folder: Path) -> None:
        """There is nothing to save."""

    def practise(self, env: gym.Env, start: np.ndarray, goal: np.ndarray, stretches: list[int]) -> Iterator[PolicyPredictor]:
        """Only be tested."""
        yield self.policy
        for _ in stretches:
            yield self.policy


#: Other ways to act by what a skill graph has learned.
RIVALS: dict[str, Callable[..., PolicyPredictor]] = {"straight_on": StraightOn, "replay_search": ReplaySearch}

ALGORITHMS: dict[str, type[Learner]] = {
    "skill_graph": SkillGraphLearner,
    "uvfa": UVFALearner,
    "her": HERLearner,
    "recipe": RecipeLearner,
    "covering_options": CoveringOptionsLearner,
    "random_walk": RandomWalkLearner,
}
