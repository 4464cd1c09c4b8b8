"""Goal-conditioned reinforcement learning without a hierarchy, by SB3's own classes (sections 4.2.1, A.5)."""

from typing import Any

import gymnasium as gym
import numpy as np
from stable_baselines3 import DDPG, HerReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise

from sb3_skillgraph.envs.metrics import metric_of
from sb3_skillgraph.memory.replay import OptionRule

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


class EndWhenStuck(gym.Wrapper):
    """Ends the episode of an agent that can do nothing any more, as the skill graph gives it up.

    :param env: an environment that may tell so in ``info["stuck"]``
    """

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take a step.

        :param action: action of the wrapped environment
        :return: observation, reward, terminated, truncated and info
        """
        observation, reward, terminated, truncated, info = self.env.step(action)
        return observation, reward, terminated or bool(info.get("stuck")), truncated, info


class OptionTask(gym.Wrapper):
    """
    A goal environment that pays as options are paid: -1 a step, 0 at the goal, and for getting stuck, which ends the
    episode, what standing there forever would.

    SB3's hindsight relabels rewards but not ends. Paid like this, what follows a goal that was put in is worth 0, as
    after an end; paid 1 at the goal, it would be worth as much as reaching it again and again.

    :param env: a goal environment whose episodes end at the goal
    :param rule: what is paid
    """

    def __init__(self, env: gym.Env, rule: OptionRule) -> None:
        super().__init__(env)
        self.rule = rule
        self._last: dict[str, np.ndarray] = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Begin an episode.

        :param seed: seeds the wrapped environment
        :param options: those of the wrapped environment
        :return: observation and info
        """
        self._last, info = self.env.reset(seed=seed, options=options)
        return self._last, info

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Take a step.

        :param action: action of the wrapped environment
        :return: observation, reward, terminated, truncated, and info, which holds what hindsight must know
        """
        before = self._last["achieved_goal"]
        self._last, _, terminated, truncated, info = self.env.step(action)
        info = {**info, "before": before, "stuck": bool(info.get("stuck"))}
        after, goal = (self._last[key][None] for key in ("achieved_goal", "desired_goal"))
        reached, stuck = self.rule.reached(after, goal, np.ones(1, dtype=bool)), np.array([info["stuck"]])
        over = np.array([terminated or info["stuck"]])
        reward = float(self.rule.reward(reached, over, stuck, before[None], after, goal)[0])
        return self._last, reward, bool(over[0]), truncated, info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """Return the reward of having come to a position when a goal was wanted; for relabelling, which ends nothing.

        :param achieved_goal: positions reached, shape ``(2,)`` or ``(n, 2)``
        :param desired_goal: goals, same shape
        :param info: what :meth:`step` returned, or an array of such
        :return: shape ``()`` or ``(n,)``
        """
        after, goal = np.atleast_2d(achieved_goal), np.atleast_2d(desired_goal)
        infos = [info] if isinstance(info, dict) else info
        before, stuck = np.stack([each["before"] for each in infos]), np.array([each["stuck"] for each in infos])
        reached = self.rule.reached(after, goal, np.ones(len(after), dtype=bool))
        reward = self.rule.reward(reached, stuck, stuck, before, after, goal)
        return reward if np.ndim(achieved_goal) > 1 else reward[0]


def make_uvfa(env: gym.Env, *, seed: int | None = None, goal_freq: int = 30, **kwargs: Any) -> DDPG:
    """Build the paper's baseline: DDPG that is given the goal, a new one every 30 episodes, paid on reaching it (A.5).

    :param env: a goal environment whose episodes end, and are paid, at the goal
    :param seed: of everything random
    :param goal_freq: episodes per goal
    :param kwargs: arguments of ``stable_baselines3.DDPG`` that differ from ``SETTINGS``
    """
    return _ddpg(GoalSchedule(EndWhenStuck(env), goal_freq), seed, kwargs)


def make_her(env: gym.Env, *, seed: int | None = None, **kwargs: Any) -> DDPG:
    """Build DDPG with hindsight experience replay (Andrychowicz et al. 2017): a new goal every episode, -1 a step.

    :param env: a goal environment whose episodes end at the goal; one without ``terminate_on_success`` is taken as it comes,
        with its own reward
    :param seed: of everything random
    :param kwargs: arguments of ``stable_baselines3.DDPG`` that differ from ``SETTINGS``
    """
    if env.has_wrapper_attr("terminate_on_success"):
        metric = metric_of(env)
        assert metric is not None  # it tells by what it ends
        env = OptionTask(env, OptionRule(metric))
    # HER samples complete episodes only, so that the first one must be over before learning starts.
    limit = env.spec.max_episode_steps if env.spec is not None else None
    first_episode = int(env.get_wrapper_attr("max_steps")) if env.has_wrapper_attr("max_steps") else limit or 1_000
    hindsight = dict(
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "copy_info_dict": True},
        learning_starts=max(1_000, first_episode + 1),
    )
    return _ddpg(env, seed, {**hindsight, **kwargs})


def _ddpg(env: gym.Env, seed: int | None, kwargs: dict[str, Any]) -> DDPG:
    assert env.action_space.shape is not None
    noise = NormalActionNoise(np.zeros(env.action_space.shape), np.full(env.action_space.shape, 0.1))
    return DDPG("MultiInputPolicy", env, action_noise=noise, seed=seed, **{**SETTINGS, **kwargs})
