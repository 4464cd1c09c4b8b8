"""Q-learning over options: SB3's DQN with each transition's own discount, among the options that can start (section 2.1)."""

from typing import Any, ClassVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.torch_layers import CombinedExtractor
from stable_baselines3.common.type_aliases import PyTorchObs, Schedule
from stable_baselines3.dqn.dqn import DQN
from stable_baselines3.dqn.policies import DQNPolicy, QNetwork

from sb3_skillgraph.smdp.options_env import MASK


class MaskedQNetwork(QNetwork):
    """A Q-network that gives masked actions a value of minus infinity, so that no maximum is ever theirs.

    As a target network it does so to all but the action that the network it follows would choose (double Q-learning, van
    Hasselt et al. 2016): the maximum of its values is then the value it gives to that network's choice.
    """

    _followed: tuple[QNetwork, ...] = ()

    def forward(self, obs: PyTorchObs) -> th.Tensor:
        """
        Predict the Q-values.

        :param obs: observation; a Dict's entry ``action_mask`` says what can be done
        :return: shape ``(batch, n_actions)``
        """
        values = super().forward(obs)
        if isinstance(obs, dict) and MASK in obs:
            values = values.masked_fill(obs[MASK] == 0, -th.inf)
        if self._followed:
            chosen = self._followed[0](obs).argmax(dim=1, keepdim=True)
            values = th.full_like(values, -th.inf).scatter(1, chosen, values.gather(1, chosen))
        return values

    def follow(self, network: QNetwork) -> None:
        """Become the target network of another.

        :param network: the network that learns
        """
        self._followed = (network,)  # in a tuple, it is no part of this module


class MaskedPolicy(DQNPolicy):
    """DQN's policy with masked Q-networks, which learn by double Q-learning."""

    q_net: MaskedQNetwork
    q_net_target: MaskedQNetwork

    def _build(self, lr_schedule: Schedule) -> None:
        super()._build(lr_schedule)
        self.q_net_target.follow(self.q_net)

    def make_q_net(self) -> MaskedQNetwork:
        """Make one network, with a features extractor of its own."""
        net_args = self._update_features_extractor(self.net_args, features_extractor=None)
        return MaskedQNetwork(**net_args).to(self.device)


class UnmaskedExtractor(CombinedExtractor):
    """
    SB3's extractor for Dict observations, blind to the mask.

    :param observation_space: Dict space
    :param kwargs: all other arguments of ``CombinedExtractor``
    """

    def __init__(self, observation_space: spaces.Dict, **kwargs: Any) -> None:
        seen = spaces.Dict({name: space for name, space in observation_space.spaces.items() if name != MASK})
        super().__init__(seen, **kwargs)


class MaskedMultiInputPolicy(MaskedPolicy):
    """
    DQN's policy for Dict observations, with masked Q-networks that do not see the mask otherwise.

    :param observation_space: Dict space
    :param action_space: Discrete space
    :param lr_schedule: learning rate schedule
    :param kwargs: all other arguments of SB3's ``MultiInputPolicy``
    """

    def __init__(
        self, observation_space: spaces.Space, action_space: spaces.Discrete, lr_schedule: Any, **kwargs: Any
    ) -> None:
        super().__init__(
            observation_space, action_space, lr_schedule, **{"features_extractor_class": UnmaskedExtractor, **kwargs}
        )


class SMDPReplayBuffer(ReplayBuffer):
    """SB3's replay buffer that keeps, too, what a transition's successor is discounted by: ``info["discount"]``."""

    def __init__(self, *args: Any, gamma: float, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.gamma = gamma
        self.discounts = np.full((self.buffer_size, self.n_envs), gamma, dtype=np.float32)

    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: list[dict[str, Any]]) -> None:
        """Store a transition, as SB3 does, and its discount."""
        self.discounts[self.pos] = [info.get("discount", self.gamma) for info in infos]
        super().add(obs, next_obs, action, reward, done, infos)

    def _get_samples(self, batch_inds: np.ndarray, env: Any = None) -> Any:
        # The environments are drawn inside: the same draw, made beforehand, tells which they will be.
        state = np.random.get_state()  # noqa: NPY002 - SB3 draws from the global generator
        env_inds = np.random.randint(0, high=self.n_envs, size=(len(batch_inds),))  # noqa: NPY002
        np.random.set_state(state)  # noqa: NPY002
        samples = super()._get_samples(batch_inds, env)
        following = samples.next_observations
        if isinstance(following, dict) and MASK in following:
            # Nothing may be left to do where an episode is over, and 0 times minus infinity is no number.
            following[MASK] = th.maximum(following[MASK], samples.dones.to(following[MASK].dtype))
        return samples._replace(discounts=self.to_torch(self.discounts[batch_inds, env_inds].reshape(-1, 1)))


class SMDPDictReplayBuffer(SMDPReplayBuffer, DictReplayBuffer):
    """SB3's replay buffer for Dict observations with a discount for each transition."""


class SMDPQLearning(DQN):
    """
    SMDP Q-learning (Bradtke & Duff 1995) by SB3's DQN: what follows an option that took tau steps is discounted by
    ``gamma ** tau``, and only options that can start are explored, chosen and bootstrapped from. The network that learns
    chooses what is bootstrapped from, the target network tells its value (double Q-learning).

    Made for :class:`~sb3_skillgraph.OptionsEnv`; it learns on any environment with Discrete actions. ``info["discount"]``
    is each transition's discount (``gamma`` where there is none) and a Dict observation's ``action_mask`` its mask. Goals
    are part of the observation.

    Decisions are fewer than environment steps: by default there is an update after each, and a new target network after
    every 500.

    :param policy: ``MultiInputPolicy``, ``MlpPolicy`` or a policy class
    :param env: the environment (if registered in Gym, can be str)
    :param kwargs: all other arguments of ``stable_baselines3.DQN`` but ``replay_buffer_class``
    :raises ValueError: if ``n_steps`` is not 1, or a ``replay_buffer_class`` is given
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {
        "MlpPolicy": MaskedPolicy,
        "MultiInputPolicy": MaskedMultiInputPolicy,
    }

    def __init__(self, policy: str | type[DQNPolicy], env: Any, **kwargs: Any) -> None:
        if kwargs.get("n_steps", 1) != 1:
            raise ValueError("SMDPQLearning takes one option at a time: n_steps must be 1.")
        if kwargs.get("replay_buffer_class") is not None:
            raise ValueError("SMDPQLearning takes no replay_buffer_class: its own keeps the discounts.")
        super().__init__(policy, env, **{"train_freq": 1, "target_update_interval": 500, **kwargs})

    def _setup_model(self) -> None:
        of_dict = isinstance(self.observation_space, spaces.Dict)
        self.replay_buffer_class = SMDPDictReplayBuffer if of_dict else SMDPReplayBuffer
        self.replay_buffer_kwargs = {**self.replay_buffer_kwargs, "gamma": self.gamma}
        super()._setup_model()

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Choose options, at times at random among those that can start.

        :param observation: one observation or a batch
        :param state: not used
        :param episode_start: not used
        :param deterministic: never at random
        :return: the actions and the state
        """
        if deterministic or np.random.rand() >= self.exploration_rate:  # noqa: NPY002 - as SB3 draws
            return self.policy.predict(observation, state, episode_start, deterministic)
        return self._random_actions(observation), state

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        if self.num_timesteps >= learning_starts:
            return super()._sample_action(learning_starts, action_noise, n_envs)
        assert self._last_obs is not None
        actions = self._random_actions(self._last_obs)
        return actions, actions

    def _random_actions(self, observation: np.ndarray | dict[str, np.ndarray]) -> np.ndarray:
        assert isinstance(self.action_space, spaces.Discrete)
        if isinstance(observation, dict) and MASK in observation:
            mask = np.asarray(observation[MASK])
        else:
            batched = self.policy.is_vectorized_observation(observation)
            first = next(iter(observation.values())) if isinstance(observation, dict) else observation
            mask = np.ones((len(first), self.action_space.n) if batched else int(self.action_space.n))
        if not np.atleast_2d(mask).any(axis=1).all():
            raise ValueError("The action mask of an observation is all zero: there must always be something that can be done.")
        chosen = [np.random.choice(np.flatnonzero(row)) for row in np.atleast_2d(mask)]  # noqa: NPY002
        return np.array(chosen) if mask.ndim == 2 else np.array(chosen[0])
