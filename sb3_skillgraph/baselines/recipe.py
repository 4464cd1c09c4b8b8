"""SB3's TD3 with HER on what the skill graph's own options are given: so that the recipe is not mistaken for the graph."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3, HerReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_skillgraph.options.option import goal_rule
from sb3_skillgraph.options.views import VIEWS, ScaledView
from sb3_skillgraph.replay import OptionRule


class OptionTask(gym.Wrapper):
    """
    A goal environment that pays as options are paid: -1 a step, 0 at the goal, and for getting stuck, which ends the
    episode, what standing there forever would.

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
        reward = float(self.compute_reward(self._last["achieved_goal"], self._last["desired_goal"], info))
        return self._last, reward, terminated or info["stuck"], truncated, info

    def compute_reward(self, achieved_goal: np.ndarray, desired_goal: np.ndarray, info: Any) -> np.ndarray:
        """Return the reward of having come to a position when a goal was wanted; for relabelling.

        :param achieved_goal: positions reached, shape ``(2,)`` or ``(n, 2)``
        :param desired_goal: goals, same shape
        :param info: what :meth:`step` returned, or an array of such
        :return: shape ``()`` or ``(n,)``
        """
        after, goal = np.atleast_2d(achieved_goal), np.atleast_2d(desired_goal)
        infos = [info] if isinstance(info, dict) else info
        before, stuck = np.stack([each["before"] for each in infos]), np.array([each["stuck"] for each in infos])
        reached = self.rule.reached(after, goal, np.ones(len(after), dtype=bool))
        reward = self.rule.reward(reached, reached | stuck, stuck, before, after, goal)
        return reward if np.ndim(achieved_goal) > 1 else reward[0]


class ViewExtractor(BaseFeaturesExtractor):
    """Shows a policy of SB3's what an option's policy sees.

    :param observation_space: of the goal environment
    :param view: name of the view
    :param radius: the unit of goal space
    """

    def __init__(self, observation_space: spaces.Dict, view: str, radius: float) -> None:
        self.view = ScaledView(VIEWS[view], radius)
        dims = [int(np.prod(observation_space[key].shape)) for key in ("observation", "achieved_goal")]  # type: ignore[arg-type]
        super().__init__(observation_space, self.view.dim(*dims))

    def forward(self, observations: dict[str, th.Tensor]) -> th.Tensor:
        """Return what is seen, shape ``(n, features_dim)``.

        :param observations: batches by name
        """
        parts = [observations[key].cpu().numpy() for key in ("observation", "achieved_goal", "desired_goal")]
        return th.from_numpy(self.view(*parts)).to(observations["observation"].device)


def make_recipe(env: gym.Env, *, seed: int | None = None, shaping: float = 0.0, **kwargs: Any) -> TD3:
    """Build TD3 with hindsight experience replay that sees, is paid and explores as the ant's options do.

    :param env: a goal environment whose episodes end at the goal
    :param seed: of everything random
    :param shaping: reward for every success radius of distance gained
    :param kwargs: arguments of ``stable_baselines3.TD3`` that differ from those below
    """
    assert env.action_space.shape is not None
    noise = NormalActionNoise(np.zeros(env.action_space.shape), np.full(env.action_space.shape, 0.2))
    radius = float(env.get_wrapper_attr("success_radius"))
    settings: dict[str, Any] = dict(
        learning_rate=1e-3,
        learning_starts=max(2_500, int(env.get_wrapper_attr("max_steps")) + 1),
        batch_size=256,
        tau=0.005,
        gamma=0.99,
        train_freq=(1, "step"),
        gradient_steps=1,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "copy_info_dict": True},
        policy_kwargs={
            "net_arch": [128, 128],
            "features_extractor_class": ViewExtractor,
            "features_extractor_kwargs": {"view": env.get_wrapper_attr("option_view"), "radius": radius},
        },
    )
    settings.update(kwargs)
    rule = goal_rule(radius, settings["gamma"], shaping / radius)
    return TD3("MultiInputPolicy", OptionTask(env, rule), action_noise=noise, seed=seed, **settings)
