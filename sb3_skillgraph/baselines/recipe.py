"""SB3's TD3 with HER on what an ant's options are given: so that the recipe is not mistaken for the graph."""

from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3 import TD3
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor

from sb3_skillgraph.baselines.goal_conditioned import OptionTask, gaussian, hindsight
from sb3_skillgraph.options.option import goal_rule
from sb3_skillgraph.options.views import ScaledView, as_view


class ViewExtractor(BaseFeaturesExtractor):
    """Shows a policy of SB3's what an option's policy sees.

    :param observation_space: of the goal environment
    :param view: name of the view
    :param radius: the unit of goal space
    """

    def __init__(self, observation_space: spaces.Dict, view: str, radius: float) -> None:
        self.view = ScaledView(as_view(view), radius)
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
    radius = float(env.get_wrapper_attr("success_radius"))
    settings: dict[str, Any] = dict(
        learning_rate=1e-3,
        batch_size=256,
        tau=0.005,
        gamma=0.99,
        train_freq=(1, "step"),
        gradient_steps=1,
        policy_kwargs={
            "net_arch": [128, 128],
            "features_extractor_class": ViewExtractor,
            "features_extractor_kwargs": {"view": env.get_wrapper_attr("option_view"), "radius": radius},
        },
    )
    settings.update(hindsight(env, 2_500) | kwargs)
    rule = goal_rule(radius, settings["gamma"], shaping / radius)
    return TD3("MultiInputPolicy", OptionTask(env, rule), action_noise=gaussian(env, 0.2), seed=seed, **settings)
