"""Which networks of SB3 are plain enough to be written out, layer by layer, without torch's modules."""

import torch as th
from gymnasium import spaces
from stable_baselines3.common.preprocessing import is_image_space
from torch import nn


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
    :return: whether it is float32 Linear layers with biases and a ReLU between one and the next
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
        and all(parameter.dtype == th.float32 for parameter in network.parameters())
    )


def linears(network: nn.Module) -> list[nn.Linear]:
    """
    :param network: one that ``is_plain``
    :return: its linear layers, first to last
    """
    return [module for module in network.children() if isinstance(module, nn.Linear)]
