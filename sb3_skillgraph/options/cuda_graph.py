"""The fast update as a CUDA graph: on a GPU, starting a hundred small kernels costs more than running them."""

import functools
import warnings
from collections.abc import Callable
from typing import Any, NamedTuple

import torch as th
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_skillgraph.options.fast_update import FastUpdate, StepSettings

WARM_UP = 3  # gradient steps before the capture, in which libraries take the memory they need
MAX_CAPTURES = 4  # of one network: with and without the actor, before and after a change

Losses = tuple[th.Tensor, th.Tensor | None]


@functools.cache
def _pool() -> Any:
    """Return the memory that all graphs share: they never run at the same time, and their results are copied at once."""
    return th.cuda.graph_pool_handle()


def capture(step: Callable[[], Losses]) -> Callable[[], Losses]:
    """
    Record the kernels of a gradient step.

    :param step: does it, reading and writing the same memory at every call
    :return: does the same by replaying the record
    """
    graph = th.cuda.CUDAGraph()
    with th.cuda.graph(graph, pool=_pool()):
        losses = step()

    def replay() -> Losses:
        graph.replay()
        critic_loss, actor_loss = losses
        return critic_loss.clone(), None if actor_loss is None else actor_loss.clone()

    return replay


class _Captured(NamedTuple):
    inputs: ReplayBufferSamples
    replay: Callable[[], Losses]


class GraphedUpdate:
    """
    A ``FastUpdate`` whose gradient steps are captured once and replayed from then on.

    A capture knows addresses and constants only: another minibatch size, learning rate or state of Adam makes a new one.

    :param fast: the update, its networks on a GPU
    """

    def __init__(self, fast: FastUpdate) -> None:
        self.fast = fast
        self.policy = fast.policy
        self._captured: dict[Any, _Captured] = {}
        self._n_eager: dict[Any, int] = {}
        self._works = True

    def __reduce__(self) -> tuple[type["GraphedUpdate"], tuple[FastUpdate]]:
        return GraphedUpdate, (self.fast,)

    def follow(self) -> None:
        """Use what was loaded into the optimisers since the last gradient step."""
        self.fast.follow()

    def step(self, data: ReplayBufferSamples, settings: StepSettings, with_actor: bool) -> Losses:
        """
        One gradient step.

        :param data: a minibatch of ``batch`` transitions
        :param settings: what else it depends on
        :param with_actor: whether the actor learns too, and all targets move
        :return: the critics' loss and the actor's, each (), None without the actor
        """
        key = (with_actor, settings, tuple(None if x is None else tuple(x.shape) for x in data), self.fast.constants())
        captured = self._captured.get(key)
        if captured is None and self._works and self._n_eager.get(key, 0) >= WARM_UP:
            captured = self._capture(key, data, settings, with_actor)
        if captured is None:
            self._n_eager[key] = self._n_eager.get(key, 0) + 1
            return self.fast.step(data, settings, with_actor)
        for mine, given in zip(captured.inputs, data, strict=True):
            if mine is not None and given is not None:  # minibatches may have discounts of their own
                mine.copy_(given)
        return captured.replay()

    def _capture(self, key: Any, data: ReplayBufferSamples, settings: StepSettings, with_actor: bool) -> _Captured | None:
        inputs = data._replace(**{name: x.clone() for name, x in data._asdict().items() if x is not None})
        try:
            replay = capture(lambda: self.fast.step(inputs, settings, with_actor))
        except RuntimeError as error:
            warnings.warn(f"Options train without CUDA graphs, more slowly: {error}", stacklevel=4)
            self._works = False
            return None
        if len(self._captured) >= MAX_CAPTURES:
            self._captured.clear()
        self._captured[key] = _Captured(inputs, replay)
        return self._captured[key]
