"""Learners on made-up experience, SB3's own and ours, for the tests of the update."""

from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_skillgraph.options.learner import OptionDDPG, OptionTD3

ACTOR_LR, CRITIC_LR = 3e-4, 2e-3


def fill(buffer: ReplayBuffer, seed: int = 0) -> None:
    rng = np.random.default_rng(seed)
    buffer.observations[:] = rng.normal(size=buffer.observations.shape)
    buffer.next_observations[:] = rng.normal(size=buffer.next_observations.shape)
    buffer.actions[:] = rng.uniform(-1, 1, buffer.actions.shape)
    buffer.rewards[:] = rng.normal(size=buffer.rewards.shape)
    buffer.dones[:] = rng.random(buffer.dones.shape) < 0.1
    buffer.full = True


def make(
    cls: type[OffPolicyAlgorithm],
    net_arch: Any,
    n_obs: int = 6,
    n_act: int = 2,
    obs_shape: tuple[int, ...] | None = None,
    policy_kwargs: dict[str, Any] | None = None,
    seed: int = 0,
    **kwargs: Any,
) -> Any:
    if issubclass(cls, OptionDDPG | OptionTD3):
        kwargs = {"actor_learning_rate": ACTOR_LR, "critic_learning_rate": CRITIC_LR, **kwargs}
    policy_kwargs = {"net_arch": net_arch, **(policy_kwargs or {})}
    model: Any = cls("MlpPolicy", None, policy_kwargs=policy_kwargs, buffer_size=500, _init_setup_model=False, **kwargs)  # type: ignore[call-arg]
    model.observation_space = spaces.Box(-np.inf, np.inf, obs_shape or (n_obs,), np.float32)
    model.action_space = spaces.Box(-1, 1, (n_act,), np.float32)
    model.n_envs = 1
    th.manual_seed(seed)
    model._setup_model()
    model.set_logger(Logger(None, []))
    fill(model.replay_buffer)
    return model


def train(model: Any, steps: int, batch_size: int = 32, seed: int = 1) -> None:
    np.random.seed(seed)  # noqa: NPY002
    th.manual_seed(seed)
    model.train(steps, batch_size)


def distance(a: Any, b: Any) -> float:
    """Return the largest difference between two learners' parameters."""
    pairs = zip(a.policy.parameters(), b.policy.parameters(), strict=True)
    return max((p.cpu() - q.cpu()).abs().max().item() for p, q in pairs)


def by_torch(model: Any) -> Any:
    """Have a model of ours take the reference update, and return it."""
    model._why_reference = lambda: "it is asked for"
    return model


def same(a: Any, b: Any) -> bool:
    """Tell whether two learners' parameters and moments are the same to the bit."""
    return distance(a, b) == 0 and all(
        th.equal(s[key], t[key])
        for x, y in ((a.actor, b.actor), (a.critic, b.critic))
        for s, t in zip(x.optimizer.state.values(), y.optimizer.state.values(), strict=True)
        for key in ("step", "exp_avg", "exp_avg_sq")
    )
