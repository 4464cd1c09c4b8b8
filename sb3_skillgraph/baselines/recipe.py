"""Hindsight experience replay with all that the skill graph is given but the graph: so that neither passes for the other."""

import copy
from collections.abc import Callable
from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.type_aliases import TrainFrequencyUnit

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.replay import as_rows


class HindsightRecipe:
    """
    The global option of a skill graph, learned by itself: TD3 or DDPG with hindsight, and a new goal every episode.

    It sees, is paid and learns from minibatches (no goal is put in shortly before a fall) as the options of a
    :class:`~sb3_skillgraph.SkillGraphAgent` with the same arguments, under the same noise, and all of that agent's updates go
    to it. Goals are the environment's, and there are no events, no plans and no ways remembered.

    :param env: a goal environment whose episodes end at the goal, with ``info["is_success"]``: without it an end at the
        goal counts as one for every other goal, too
    :param seed: of everything random
    :param kwargs: further arguments of :class:`~sb3_skillgraph.SkillGraphAgent`; those of the graph have no effect
    :raises ValueError: if updates are to follow episodes instead of steps
    """

    def __init__(self, env: gym.Env, *, seed: int | None = None, **kwargs: Any) -> None:
        self.env = env
        self.agent = SkillGraphAgent(**{"policy": "MultiInputPolicy", **kwargs}, env=env, seed=seed)
        self.agent.planning = False
        self.agent.set_logger(Logger(folder=None, output_formats=[]))
        if self.agent.train_freq.unit != TrainFrequencyUnit.STEP:  # type: ignore[union-attr]
            raise ValueError(f"train_freq must be a number of steps, not {self.agent.train_freq}.")

    def learn(self, total_timesteps: int, on_step: Callable[[int], None] | None = None) -> "HindsightRecipe":
        """Learn.

        :param total_timesteps: environment steps
        :param on_step: called after every environment step with their number
        :return: itself
        """
        agent, store, policy = self.agent, self.agent.store, self.agent.global_option.learner.policy
        every: int = agent.train_freq.frequency  # type: ignore[union-attr]
        n_updates = agent.gradient_steps if agent.gradient_steps >= 0 else every
        store.cut()
        agent._hold_left[:] = 0
        observation, _ = self.env.reset(seed=agent.seed if store.total == 0 else None)
        for _ in range(total_timesteps):
            scaled = self._explore(observation)
            after, _, terminated, truncated, info = self.env.step(policy.unscale_action(scaled))
            stuck = bool(info.get("stuck"))
            over = terminated or truncated or stuck
            # An episode that ends at its own goal would have gone on for any other.
            ends = dict(terminated=terminated and not info.get("is_success"), done=over, stuck=stuck)
            store.add(**as_rows(observation, scaled, after), **{name: np.array([end]) for name, end in ends.items()})
            observation = after
            if over:
                observation, _ = self.env.reset()
                agent._hold_left[:] = 0
            if store.total > agent.learning_starts and store.total % every == 0:
                agent.train(n_updates, agent.batch_size)
            if on_step is not None:
                on_step(store.total)
        return self

    def _explore(self, observation: dict[str, np.ndarray]) -> np.ndarray:
        """Return an action in [-1, 1], shape ``(action_dim,)``: a random one at first, then the policy's with noise."""
        agent = self.agent
        scaled = agent.global_option.learner.policy.scale_action(agent.predict(observation)[0])
        warm_up = agent.store.total < agent.learning_starts
        scaled = scaled.reshape(1, -1)
        explored, agent._held_actions, agent._hold_left = agent._explore(scaled, [warm_up], agent.action_noise)
        return explored.reshape(agent.action_space.shape)

    def copy(self, env: gym.Env) -> "HindsightRecipe":
        """Return a copy that knows the same.

        :param env: the environment that it goes on in
        """
        twin = copy.copy(self)
        twin.env, twin.agent = env, self.agent.copy(env)
        twin.agent.planning = False
        twin.agent.set_logger(self.agent.logger)
        return twin
