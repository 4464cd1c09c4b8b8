"""Acting without torch: one observation through a small network costs torch more in calls than in arithmetic."""

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.torch_layers import FlattenExtractor
from stable_baselines3.sac.policies import Actor as SACActor
from stable_baselines3.td3.policies import Actor
from torch import nn


class NumpyActor:
    """
    The deterministic actor of an SB3 policy, evaluated by NumPy on the memory of torch's own weights.

    It follows training with no copy. Actors it cannot read (other layers, other features, weights on a GPU) are
    evaluated by torch instead, so that it stands in for any actor of TD3, DDPG or SAC.

    :param actor: ``model.policy.actor``
    """

    def __init__(self, actor: BasePolicy) -> None:
        self.actor = actor
        self._parameters = list(actor.parameters())
        self._view()

    def act(self, observations: np.ndarray) -> np.ndarray:
        """
        :param observations: (n, d) float32, or (n, *shape of the observation space)
        :return: (n, a) float32 actions in [-1, 1], as the network gives them
        :raises ValueError: if it gives NaN
        """
        actions = self._act(observations)
        if np.isnan(actions).any():
            raise ValueError(
                "The policy's parameters hold NaN or inf: learning has diverged (a smaller learning_rate may help), or they "
                "were set so."
            )
        return actions

    def _act(self, observations: np.ndarray) -> np.ndarray:
        if [parameter.data_ptr() for parameter in self._parameters] != self._addresses:
            self._view()
        if not self._layers:
            with th.no_grad():
                actions = self.actor._predict(th.as_tensor(observations, device=self.actor.device), deterministic=True)
            return actions.cpu().numpy()
        values = observations.reshape(len(observations), -1).astype(np.float32, copy=False)
        for i, (weight, bias) in enumerate(self._layers):
            if i > 0:
                np.maximum(values, 0, out=values)
            values = np.dot(values, weight)
            values += bias
        return np.tanh(values, out=values)

    def __reduce__(self) -> tuple[type["NumpyActor"], tuple[BasePolicy]]:
        # An array's copy would part from the weights: a copy or a pickle views those of its own actor.
        return NumpyActor, (self.actor,)

    def _view(self) -> None:
        # Moving a module or giving it other data leaves the old memory behind; the addresses tell.
        self._addresses = [parameter.data_ptr() for parameter in self._parameters]
        self._layers = [
            (linear.weight.detach().numpy().T, linear.bias.detach().numpy()) for linear in plain_linears(self.actor)
        ]


def is_vector_space(space: spaces.Space) -> bool:
    """
    :param space: an observation space
    :return: whether SB3 hands observations of it to a network as they are, flattened
    """
    return isinstance(space, spaces.Box) and len(space.shape) > 0 and not is_image_space(space)


def is_plain(network: nn.Module, squashed: bool = False) -> bool:
    """
    :param network: any module
    :param squashed: whether a Tanh must follow the last layer
    :return: whether it is Linear layers with biases, float32 and contiguous, and a ReLU between one and the next
    """
    if type(network) is not nn.Sequential:
        return False
    modules = list(network)
    if squashed and (not modules or type(modules.pop()) is not nn.Tanh):
        return False
    linears, relus = modules[::2], modules[1::2]
    return (
        len(modules) % 2 == 1
        and all(type(module) is nn.ReLU for module in relus)
        and all(type(module) is nn.Linear and module.bias is not None for module in linears)
        and all(parameter.dtype == th.float32 and parameter.is_contiguous() for parameter in network.parameters())
    )


def plain_linears(actor: BasePolicy) -> list[nn.Linear]:
    """
    :param actor: of TD3, DDPG or SAC
    :return: the linear layers, first to last, that its deterministic action is made of with ReLUs between and a Tanh last;
        none if it is made of anything else, or not on a CPU
    """
    if type(actor.features_extractor) is not FlattenExtractor or not is_vector_space(actor.observation_space):
        return []
    if actor.device.type != "cpu":
        return []
    if type(actor) is SACActor:
        # SAC's deterministic action is the Tanh of its mean, a layer of its own on top of the shared ones.
        network = nn.Sequential(*actor.latent_pi, actor.mu, nn.Tanh())
    elif type(actor) is Actor:
        network = actor.mu
    else:
        return []
    if not is_plain(network, squashed=True):
        return []
    return [module for module in network if isinstance(module, nn.Linear)]
