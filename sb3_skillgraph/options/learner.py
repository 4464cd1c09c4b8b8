"""What learns an option's policy: SB3's DDPG and TD3 with one learning rate each for actor and critic, and fast."""

import functools
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv
from stable_baselines3.ddpg.ddpg import DDPG
from stable_baselines3.td3.policies import TD3Policy
from stable_baselines3.td3.td3 import TD3

from sb3_skillgraph.options.fast_update import FastUpdate, StepSettings, why_not


class OptionPolicy(TD3Policy):
    """SB3's actor-critic of plain layers, which does not walk through all its modules when its mode stays as it is."""

    def set_training_mode(self, mode: bool) -> None:
        """
        Put the networks in training or evaluation mode.

        :param mode: True for training
        """
        if mode != self.training:
            super().set_training_mode(mode)


class OptionLearner(TD3):
    """
    Two learning rates and a fast ``train`` for SB3's DDPG and TD3, mixed in before either.

    :param policy: the policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: the environment to learn from (if registered in Gym, can be str; None builds no environment)
    :param actor_learning_rate: Adam's learning rate for the actor
    :param critic_learning_rate: Adam's learning rate for the critics
    :param saturation_penalty: weight, in the actor's loss, of the mean squared norm of what its tanh is given: an actor
        that an untrained critic has driven to the bounds of the actions finds its way back; 0 is SB3's loss
    :param kwargs: all other arguments of the SB3 class except ``learning_rate``, which these two replace
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {**TD3.policy_aliases, "MlpPolicy": OptionPolicy}

    def __init__(
        self,
        policy: str | type[TD3Policy],
        env: GymEnv | str | None,
        *,
        actor_learning_rate: float = 1e-4,
        critic_learning_rate: float = 1e-3,
        saturation_penalty: float = 0.0,
        **kwargs: Any,
    ) -> None:
        self.actor_learning_rate = actor_learning_rate
        self.critic_learning_rate = critic_learning_rate
        self.saturation_penalty = saturation_penalty
        self._fast_update: FastUpdate | None = None
        super().__init__(policy, env, learning_rate=critic_learning_rate, **kwargs)  # type: ignore[arg-type]

    def _setup_model(self) -> None:
        super()._setup_model()
        self._set_learning_rates()

    def _set_learning_rates(self) -> None:
        for optimizer, learning_rate in (
            (self.actor.optimizer, self.actor_learning_rate),
            (self.critic.optimizer, self.critic_learning_rate),
        ):
            for group in optimizer.param_groups:
                group["lr"] = learning_rate

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        self.logger.record("train/learning_rate", self.critic_learning_rate)
        self._set_learning_rates()

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Do gradient steps on minibatches of the replay buffer, as SB3 does them.

        :param gradient_steps: number of updates
        :param batch_size: transitions in a minibatch
        """
        with flushed_denormals():
            self._train(gradient_steps, batch_size)

    def _train(self, gradient_steps: int, batch_size: int) -> None:
        fast = self._find_fast_update()
        if fast is None:
            super().train(gradient_steps, batch_size)
            return
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        actor_losses, critic_losses = self._gradient_steps(fast, gradient_steps, batch_size)
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, losses in (("train/actor_loss", actor_losses), ("train/critic_loss", critic_losses)):
            if losses:
                self.logger.record(name, sum(loss.item() for loss in losses) / len(losses))

    def _gradient_steps(
        self, fast: FastUpdate, gradient_steps: int, batch_size: int
    ) -> tuple[list[th.Tensor], list[th.Tensor]]:
        assert self.replay_buffer is not None
        settings = StepSettings(
            self.gamma, self.tau, self.target_policy_noise, self.target_noise_clip, self.saturation_penalty
        )
        actor_losses, critic_losses = [], []
        for _ in range(gradient_steps):
            self._n_updates += 1
            data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
            critic_loss, actor_loss = fast.step(data, settings, self._n_updates % self.policy_delay == 0)
            critic_losses.append(critic_loss)
            if actor_loss is not None:
                actor_losses.append(actor_loss)
        return actor_losses, critic_losses

    def _find_fast_update(self) -> FastUpdate | None:
        if self._fast_update is not None and self._fast_update.policy is self.policy:
            self._fast_update.follow()
            return self._fast_update
        reason = why_not(self.policy)
        if reason is not None:
            _warn_once(reason, bool(self.saturation_penalty))
            return None
        self._fast_update = FastUpdate(self.policy)
        return self._fast_update

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_fast_update"]


class OptionDDPG(OptionLearner, DDPG):
    """
    Deep Deterministic Policy Gradient for one option, with the paper's two learning rates (Table 1).

    The same numbers as ``stable_baselines3.DDPG`` (unless given a penalty), sooner where the networks are plain
    (``benchmarks/update.py``).

    :param policy: the policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: the environment to learn from (if registered in Gym, can be str; None builds no environment)
    :param actor_learning_rate: Adam's learning rate for the actor
    :param critic_learning_rate: Adam's learning rate for the critics
    :param saturation_penalty: weight, in the actor's loss, of the mean squared norm of what its tanh is given: an actor
        that an untrained critic has driven to the bounds of the actions finds its way back; 0 is SB3's loss
    :param kwargs: all other arguments of ``stable_baselines3.DDPG`` except ``learning_rate``
    """


class OptionTD3(OptionLearner, TD3):
    """
    Twin Delayed DDPG for one option, with one learning rate for the actor and one for the critics.

    The same numbers as ``stable_baselines3.TD3`` (unless given a penalty), sooner where the networks are plain
    (``benchmarks/update.py``).

    :param policy: the policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: the environment to learn from (if registered in Gym, can be str; None builds no environment)
    :param actor_learning_rate: Adam's learning rate for the actor
    :param critic_learning_rate: Adam's learning rate for the critics
    :param saturation_penalty: weight, in the actor's loss, of the mean squared norm of what its tanh is given: an actor
        that an untrained critic has driven to the bounds of the actions finds its way back; 0 is SB3's loss
    :param kwargs: all other arguments of ``stable_baselines3.TD3`` except ``learning_rate``
    """


@contextmanager
def flushed_denormals() -> Iterator[None]:
    """Take denormal numbers for zero in a block, as the processor's flags may do already.

    Once units have died, Adam's moments of their weights decay into denormals and stay there, which costs up to half of a
    real run, and changes no parameter.
    """
    smallest = th.finfo(th.float32).tiny
    flushed_before = float(th.tensor(smallest) * 0.5) == 0.0  # torch has no other way to ask
    th.set_flush_denormal(True)
    try:
        yield
    finally:
        th.set_flush_denormal(flushed_before)


@functools.cache
def _warn_once(reason: str, penalised: bool) -> None:
    update = "SB3's own, slower update, which has no saturation_penalty" if penalised else "SB3's own, slower update"
    warnings.warn(f"Options train with {update}: {reason}.", stacklevel=4)
