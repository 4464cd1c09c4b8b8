"""Goal-conditioned reinforcement learning without a hierarchy, by SB3's own classes (sections 4.2.1, A.5)."""

from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import DDPG, HerReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise

#: What the agent's own options learn with, for the sake of comparison; the discount is the paper's.
SETTINGS: dict[str, Any] = dict(
    learning_rate=1e-3,
    learning_starts=1_000,
    batch_size=128,
    tau=0.005,
    gamma=0.99,
    train_freq=(2, "step"),
    gradient_steps=1,
    policy_kwargs={"net_arch": [128, 128]},
)


class GoalSchedule(gym.Wrapper):
    """
    Keeps a goal for some episodes; the paper's baseline draws a new one every 30.

    :param env: an environment whose ``reset`` takes ``options={"goal": ...}`` and draws one itself otherwise
    :param n_episodes: episodes per goal
    """

    def __init__(self, env: gym.Env, n_episodes: int) -> None:
        super().__init__(env)
        self.n_episodes = n_episodes
        self._episode = 0
        self._goal: np.ndarray | None = None

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        :param seed: seeds the wrapped environment
        :param options: those of the wrapped environment; a goal given here counts for this episode only
        :return: observation and info
        """
        keep = self._episode % self.n_episodes != 0 and self._goal is not None
        given = {"goal": self._goal, **(options or {})} if keep else options
        observation, info = self.env.reset(seed=seed, options=given)
        if not keep:
            self._goal = np.array(observation["desired_goal"])
        self._episode += 1
        return observation, info


def make_uvfa(env: gym.Env, *, seed: int | None = None, goal_freq: int = 30, **kwargs: Any) -> DDPG:
    """Build the paper's baseline: DDPG that is given the goal, a new one every 30 episodes, paid on reaching it (A.5).

    :param env: a goal environment whose episodes end, and are paid, at the goal
    :param seed: of everything random
    :param goal_freq: episodes per goal
    :param kwargs: arguments of ``stable_baselines3.DDPG`` that differ from ``SETTINGS``
    """
    return _ddpg(GoalSchedule(env, goal_freq), seed, kwargs)


def make_her(env: gym.Env, *, seed: int | None = None, **kwargs: Any) -> DDPG:
    """Build DDPG with hindsight experience replay (Andrychowicz et al. 2017): a new goal every episode.

    :param env: a goal environment whose episodes end, and are paid, at the goal
    :param seed: of everything random
    :param kwargs: arguments of ``stable_baselines3.DDPG`` that differ from ``SETTINGS``
    """
    hindsight = dict(replay_buffer_class=HerReplayBuffer, replay_buffer_kwargs={"n_sampled_goal": 4})
    # HER samples complete episodes only, so that the first one must be over before learning starts.
    first_episode = int(env.get_wrapper_attr("max_steps")) if env.has_wrapper_attr("max_steps") else 1_000
    return _ddpg(env, seed, {**hindsight, "learning_starts": max(1_000, first_episode + 1), **kwargs})


def _ddpg(env: gym.Env, seed: int | None, kwargs: dict[str, Any]) -> DDPG:
    assert env.action_space.shape is not None
    noise = NormalActionNoise(np.zeros(env.action_space.shape), np.full(env.action_space.shape, 0.1))
    return DDPG("MultiInputPolicy", env, action_noise=noise, seed=seed, **{**SETTINGS, **kwargs})
