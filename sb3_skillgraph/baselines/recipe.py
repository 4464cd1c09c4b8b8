"""Hindsight experience replay with all that the skill graph is given but the graph: so that neither passes for the other."""

import copy
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import TrainFrequencyUnit

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.baselines.straight_on import StraightOn
from sb3_skillgraph.goal_env import as_batch
from sb3_skillgraph.learning.missions import Mission
from sb3_skillgraph.memory.store import as_rows


class NewGoals(gym.Wrapper):
    """
    Gives a new goal where the agent stands: when it has reached one, and after so many steps at the latest.

    :param env: a goal environment with ``sample_free(rng)`` and ``success_radius`` whose episodes go on at the goal
    :param n_steps: for which a goal is pursued
    """

    def __init__(self, env: gym.Env, n_steps: int) -> None:
        super().__init__(env)
        self.n_steps = n_steps
        self._radius = float(env.get_wrapper_attr("success_radius"))
        self._goal = np.zeros(0)
        self._steps = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode with the wrapped environment's goal.

        :param seed: seeds the wrapped environment
        :param options: those of the wrapped environment
        """
        observation, info = self.env.reset(seed=seed, options=options)
        self._goal, self._steps = observation["desired_goal"], 0
        return observation, info

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step.

        :param action: action of the wrapped environment
        :return: observation, which holds the next goal, reward, terminated, truncated and info
        """
        observation, *rest = self.env.step(action)
        self._steps += 1
        distance = np.linalg.norm(observation["achieved_goal"] - self._goal)
        if distance <= self._radius or self._steps >= self.n_steps:
            self._goal, self._steps = self.get_wrapper_attr("sample_free")(self.np_random), 0
        return {**observation, "desired_goal": self._goal}, *rest  # type: ignore[return-value]


class HindsightRecipe:
    """
    The walker of a skill graph, learned by itself: TD3 or DDPG with hindsight.

    It sees, is paid and learns from minibatches (no goal is put in shortly before a fall) as the walker of a
    :class:`~sb3_skillgraph.SkillGraphAgent` with the same arguments, under the same noise. Goals are the environment's
    (with :class:`NewGoals`, new ones as soon as one is reached), and there are no events and no plans.

    :param env: a goal environment; where its episodes end at the goal, with ``info["is_success"]``: without it an end at
        the goal counts as one for every other goal, too
    :param seed: of everything random
    :param kwargs: further arguments of :class:`~sb3_skillgraph.SkillGraphAgent`; those of the graph have no effect
    :raises ValueError: if updates are to follow episodes instead of steps
    """

    def __init__(self, env: gym.Env, *, seed: int | None = None, **kwargs: Any) -> None:
        self.env = env
        self.agent = SkillGraphAgent(**{"policy": "MultiInputPolicy", **kwargs}, env=env, seed=seed)
        self.policy = StraightOn(self.agent)
        self.agent.set_logger(Logger(folder=None, output_formats=[]))
        if self.agent.train_freq.unit != TrainFrequencyUnit.STEP:  # type: ignore[union-attr]
            raise ValueError(f"train_freq must be a number of steps, not {self.agent.train_freq}.")

    def learn(self, total_timesteps: int, on_step: Callable[[int], None] | None = None) -> "HindsightRecipe":
        """Learn.

        :param total_timesteps: environment steps
        :param on_step: called after every environment step with their number
        :return: itself
        """
        agent, store = self.agent, self.agent.parts.store
        every: int = agent.train_freq.frequency  # type: ignore[union-attr]
        n_updates = agent.gradient_steps if agent.gradient_steps >= 0 else every
        store.cut()
        observation, _ = self.env.reset(seed=agent.seed if store.total == 0 else None)
        begins = True
        for _ in range(total_timesteps):
            scaled = self._explore(observation, begins)
            after, _, terminated, truncated, info = self.env.step(agent.parts.unscale(scaled[None])[0])
            stuck = bool(info.get("stuck"))
            over = terminated or truncated or stuck
            # An episode that ends at its own goal would have gone on for any other.
            ends = dict(terminated=terminated and not info.get("is_success"), done=over, stuck=stuck)
            store.add(**as_rows(observation, scaled, after), **{name: np.array([end]) for name, end in ends.items()})
            begins = over or not np.array_equal(observation["desired_goal"], after["desired_goal"])
            observation = self.env.reset()[0] if over else after
            if store.total > agent.learning_starts and store.total % every == 0:
                agent.train(n_updates, agent.batch_size)
            if on_step is not None:
                on_step(store.total)
        return self

    def _explore(self, observation: dict[str, np.ndarray], begins: bool) -> np.ndarray:
        """Return an action in [-1, 1], shape ``(action_dim,)``: a random one at first, then the policy's with noise."""
        agent, rollout = self.agent, self.agent.parts.rollout
        if begins:  # the way to a goal
            rollout.hold_left[:] = 0
        batch, _ = as_batch(observation, agent.observation_space)
        scaled = agent.parts.walker.actor.act(
            agent.parts.runner.view(batch["observation"], batch["achieved_goal"], batch["desired_goal"])
        )
        warm_up = agent.parts.store.total < agent.learning_starts
        mission = Mission(batch["desired_goal"][0], exploring=warm_up)
        explored, rollout.held, rollout.hold_left = rollout.with_noise(scaled, [mission], agent.action_noise)
        return explored[0]

    def copy(self, env: gym.Env) -> "HindsightRecipe":
        """Return a copy that knows the same.

        :param env: the environment that it goes on in
        """
        twin = copy.copy(self)
        twin.env, twin.agent = env, self.agent.copy(env)
        twin.policy = StraightOn(twin.agent)
        twin.agent.set_logger(self.agent.logger)
        return twin
