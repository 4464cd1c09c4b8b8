"""What learns an option's policy: SB3's DDPG and TD3 with one learning rate each for actor and critic, and fast."""

import functools
import importlib.util
import math
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

import torch as th
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, PyTorchObs, ReplayBufferSamples, Schedule
from stable_baselines3.common.utils import polyak_update, update_learning_rate
from stable_baselines3.ddpg.ddpg import DDPG
from stable_baselines3.td3.policies import TD3Policy
from stable_baselines3.td3.td3 import TD3
from torch import nn
from torch.nn import functional as F

from sb3_skillgraph.memory.replay import draw
from sb3_skillgraph.options.compiled_update import CompiledUpdate, why_not


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
    Two learning rates, a penalty and a fast ``train`` for SB3's DDPG and TD3, mixed in before either.

    The update is written twice: in torch, to be read and for any network, and compiled, for plain networks on a CPU
    where numba is installed (:mod:`sb3_skillgraph.options.compiled_update`). Both give the same numbers but for the last
    digits.

    :param policy: the policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: the environment to learn from (if registered in Gym, can be str; None builds no environment)
    :param actor_learning_rate: Adam's learning rate for the actor, or a schedule of it
    :param critic_learning_rate: Adam's learning rate for the critics, likewise
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
        actor_learning_rate: float | Schedule = 1e-4,
        critic_learning_rate: float | Schedule = 1e-3,
        saturation_penalty: float = 0.0,
        **kwargs: Any,
    ) -> None:
        self.actor_learning_rate = actor_learning_rate
        self.critic_learning_rate = critic_learning_rate
        self.saturation_penalty = saturation_penalty
        self._compiled: CompiledUpdate | None = None
        super().__init__(policy, env, learning_rate=critic_learning_rate, **kwargs)  # type: ignore[arg-type]

    def _setup_model(self) -> None:
        super()._setup_model()
        self._set_learning_rates()

    def _set_learning_rates(self) -> None:
        for optimizer, learning_rate in (
            (self.actor.optimizer, self.actor_learning_rate),
            (self.critic.optimizer, self.critic_learning_rate),
        ):
            rate = learning_rate(self._current_progress_remaining) if callable(learning_rate) else learning_rate
            update_learning_rate(optimizer, rate)

    def _update_learning_rate(self, optimizers: list[th.optim.Optimizer] | th.optim.Optimizer) -> None:
        self._set_learning_rates()
        self.logger.record("train/learning_rate", self.critic.optimizer.param_groups[0]["lr"])

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Update critics and actor on minibatches of the replay buffer, as SB3 does.

        :param gradient_steps: number of updates
        :param batch_size: transitions in a minibatch
        """
        self._update_learning_rate([self.actor.optimizer, self.critic.optimizer])
        compiled = self._compiled_update()
        if compiled is None:
            # Switch to train mode (this affects batch norm / dropout)
            self.policy.set_training_mode(True)
        assert self.replay_buffer is not None
        actor_losses, critic_losses = [], []
        with flushed_denormals():
            for _ in range(gradient_steps):
                self._n_updates += 1
                # The actor, and all targets with it, move less often than the critics
                with_actor = self._n_updates % self.policy_delay == 0
                if compiled is None:
                    replay_data = self.replay_buffer.sample(batch_size, env=self._vec_normalize_env)
                    critic_loss, actor_loss = self._update_by_torch(replay_data, with_actor)
                else:
                    data = draw(self.replay_buffer, batch_size, self._vec_normalize_env)
                    critic_loss, actor_loss = compiled.update(data, self, self.saturation_penalty, with_actor)
                critic_losses.append(critic_loss)
                if with_actor:
                    actor_losses.append(actor_loss)

        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, losses in (("train/actor_loss", actor_losses), ("train/critic_loss", critic_losses)):
            if losses:
                self.logger.record(name, sum(losses) / len(losses))

    def _update_by_torch(self, replay_data: ReplayBufferSamples, with_actor: bool) -> tuple[float, float]:
        """
        Do one update, of any network on any device: what the compiled update is held to.

        :param replay_data: a minibatch
        :param with_actor: whether the actor learns too, and all targets move
        :return: the critics' loss and the actor's (NaN without the actor)
        """
        # For n-step replay, the discount is that of all the steps
        discounts = replay_data.discounts if replay_data.discounts is not None else self.gamma

        with th.no_grad():
            # Select next actions by the target actor and add clipped noise
            noise = replay_data.actions.clone().normal_(0, self.target_policy_noise)
            noise = noise.clamp(-self.target_noise_clip, self.target_noise_clip)
            next_actions = (self.actor_target(replay_data.next_observations) + noise).clamp(-1, 1)
            # Compute the next Q-values: min over all target critics
            next_q_values = th.cat(self.critic_target(replay_data.next_observations, next_actions), dim=1)
            next_q_values, _ = th.min(next_q_values, dim=1, keepdim=True)
            target_q_values = replay_data.rewards + (1 - replay_data.dones) * discounts * next_q_values

        # Move all critics towards the same values
        current_q_values = self.critic(replay_data.observations, replay_data.actions)
        critic_loss = sum(F.mse_loss(current_q, target_q_values) for current_q in current_q_values)
        assert isinstance(critic_loss, th.Tensor)
        self.critic.optimizer.zero_grad()
        critic_loss.backward()
        self.critic.optimizer.step()
        if not with_actor:
            return critic_loss.item(), math.nan

        # Move the actor to where the first critic values its actions more
        actions, penalty = self._actions_and_penalty(replay_data.observations)
        actor_loss = -self.critic.q1_forward(replay_data.observations, actions).mean() + penalty
        self.actor.optimizer.zero_grad()
        actor_loss.backward()
        self.actor.optimizer.step()

        # Let the target networks follow
        polyak_update(self.critic.parameters(), self.critic_target.parameters(), self.tau)
        polyak_update(self.actor.parameters(), self.actor_target.parameters(), self.tau)
        # Copy running stats, see SB3's GH issue #996
        polyak_update(self.critic_batch_norm_stats, self.critic_batch_norm_stats_target, 1.0)
        polyak_update(self.actor_batch_norm_stats, self.actor_batch_norm_stats_target, 1.0)
        return critic_loss.item(), actor_loss.item()

    def _actions_and_penalty(self, observations: PyTorchObs) -> tuple[th.Tensor, th.Tensor | float]:
        """
        Act, and say what the loss is charged for actions that the tanh saturates.

        :param observations: of ``batch`` transitions
        :return: actions (batch, action) and the penalty ()
        """
        if self.saturation_penalty == 0:
            return self.actor(observations), 0.0
        if not (isinstance(self.actor.mu, nn.Sequential) and isinstance(self.actor.mu[-1], nn.Tanh)):
            raise ValueError("A saturation_penalty needs an actor whose last module, actor.mu[-1], is a Tanh.")
        features = self.actor.extract_features(observations, self.actor.features_extractor)
        before_tanh = self.actor.mu[:-1](features)
        return before_tanh.tanh(), self.saturation_penalty * before_tanh.pow(2).sum(dim=1).mean()

    @property
    def update_path(self) -> str:
        """What updates the networks: the compiled ``"kernel"``, or ``"reference"``, torch."""
        return "kernel" if self._why_reference() is None else "reference"

    def _why_reference(self) -> str | None:
        """Return why there is no compiled update; None where there is one."""
        if importlib.util.find_spec("numba") is None:
            return 'there is no numba (pip install "sb3_skillgraph[fast]")'
        return why_not(self.policy)

    def _compiled_update(self) -> CompiledUpdate | None:
        if self._compiled is not None and self._compiled.is_of(self.policy):
            return self._compiled
        reason = self._why_reference()
        if reason is not None:
            _warn_once(reason)
        self._compiled = CompiledUpdate(self.policy) if reason is None else None
        return self._compiled

    def __getstate__(self) -> dict[str, Any]:
        # The arrays of a copy would part from its networks
        return {**self.__dict__, "_compiled": None}

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "_compiled"]


class OptionDDPG(OptionLearner, DDPG):
    """
    Deep Deterministic Policy Gradient for one option, with the paper's two learning rates (Table 1).

    The numbers of ``stable_baselines3.DDPG`` (unless given a penalty), sooner where the networks are plain: then they differ
    in the last digits (``benchmarks/update.py``).

    :param policy: the policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: the environment to learn from (if registered in Gym, can be str; None builds no environment)
    :param actor_learning_rate: Adam's learning rate for the actor, or a schedule of it
    :param critic_learning_rate: Adam's learning rate for the critics, likewise
    :param saturation_penalty: weight, in the actor's loss, of the mean squared norm of what its tanh is given: an actor
        that an untrained critic has driven to the bounds of the actions finds its way back; 0 is SB3's loss
    :param kwargs: all other arguments of ``stable_baselines3.DDPG`` except ``learning_rate``
    """


class OptionTD3(OptionLearner, TD3):
    """
    Twin Delayed DDPG for one option, with one learning rate for the actor and one for the critics.

    The numbers of ``stable_baselines3.TD3`` (unless given a penalty), sooner where the networks are plain: then they differ
    in the last digits (``benchmarks/update.py``).

    :param policy: the policy model to use (MlpPolicy, CnnPolicy, ...)
    :param env: the environment to learn from (if registered in Gym, can be str; None builds no environment)
    :param actor_learning_rate: Adam's learning rate for the actor, or a schedule of it
    :param critic_learning_rate: Adam's learning rate for the critics, likewise
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
    flushed_before = sys.float_info.min * 0.5 == 0.0  # torch has no way to ask
    th.set_flush_denormal(True)
    try:
        yield
    finally:
        th.set_flush_denormal(flushed_before)


@functools.cache
def _warn_once(reason: str) -> None:
    warnings.warn(f"Options learn by torch's own, slower update: {reason}.", stacklevel=4)
