"""SB3's TD3 with HER on what an ant's options are given: so that the recipe is not mistaken for the graph."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3, HerReplayBuffer
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_skillgraph.baselines.goal_conditioned import OptionTask
from sb3_skillgraph.options.option import goal_rule
from sb3_skillgraph.options.views import VIEWS, ScaledView


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
