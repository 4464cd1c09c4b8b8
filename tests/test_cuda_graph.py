"""The update as a CUDA graph: its book-keeping on any machine, its numbers where there is a GPU."""

import copy
import warnings

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from gymnasium import spaces
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.logger import Logger

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.options import cuda_graph, learner
from sb3_skillgraph.options.cuda_graph import WARM_UP, GraphedUpdate
from sb3_skillgraph.options.fast_update import FastUpdate
from sb3_skillgraph.options.learner import OptionDDPG, OptionTD3

needs_gpu = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")


def make(cls: type[TD3], device: str = "cpu", net_arch: tuple[int, ...] = (16, 16)) -> TD3:
    kwargs = {"learning_rate": 1e-3}
    if issubclass(cls, OptionDDPG | OptionTD3):
        kwargs = {"actor_learning_rate": 1e-3, "critic_learning_rate": 1e-3}
    model = cls(
        "MlpPolicy",
        None,  # type: ignore[arg-type]
        policy_kwargs={"net_arch": list(net_arch)},
        buffer_size=500,
        device=device,
        _init_setup_model=False,
        **kwargs,
    )
    model.observation_space = spaces.Box(-np.inf, np.inf, (6,), np.float32)
    model.action_space = spaces.Box(-1, 1, (2,), np.float32)
    model.n_envs = 1
    th.manual_seed(0)
    model._setup_model()
    model.set_logger(Logger(None, []))
    buffer, rng = model.replay_buffer, np.random.default_rng(0)
    assert buffer is not None
    buffer.observations[:] = rng.normal(size=buffer.observations.shape)
    buffer.next_observations[:] = rng.normal(size=buffer.next_observations.shape)
    buffer.actions[:] = rng.uniform(-1, 1, buffer.actions.shape)
    buffer.rewards[:] = rng.integers(-1, 1, buffer.rewards.shape)
    buffer.full = True
    return model


def train(model: TD3, steps: int, batch_size: int = 32, seed: int = 1) -> None:
    np.random.seed(seed)  # noqa: NPY002
    th.manual_seed(seed)
    model.train(steps, batch_size)


def distance(a: TD3, b: TD3) -> float:
    pairs = zip(a.policy.parameters(), b.policy.parameters(), strict=True)
    return max((p.cpu() - q.cpu()).abs().max().item() for p, q in pairs)


@pytest.fixture
def captures(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """On any machine: a capture that replays by doing it again, and all models as if on a GPU."""
    made: list[object] = []

    def capture(step: cuda_graph.Callable[[], cuda_graph.Losses]) -> cuda_graph.Callable[[], cuda_graph.Losses]:
        made.append(step)
        return step

    monkeypatch.setattr(cuda_graph, "capture", capture)
    monkeypatch.setattr(learner, "FastUpdate", lambda policy: GraphedUpdate(FastUpdate(policy)))
    return made


@pytest.mark.parametrize("cls", [OptionDDPG, OptionTD3])
def test_replays_what_the_update_does(cls: type[TD3], captures: list[object], monkeypatch: pytest.MonkeyPatch) -> None:
    graphed = make(cls)
    train(graphed, 40)
    assert isinstance(graphed._fast_update, GraphedUpdate)
    assert len(captures) == (1 if cls is OptionDDPG else 2)  # TD3: with and without the actor
    monkeypatch.setattr(learner, "FastUpdate", FastUpdate)
    eager = make(cls)
    train(eager, 40)
    assert isinstance(eager._fast_update, FastUpdate)
    assert distance(graphed, eager) == 0.0
    assert graphed.logger.name_to_value == eager.logger.name_to_value


def test_what_changes_is_captured_anew(captures: list[object], monkeypatch: pytest.MonkeyPatch) -> None:
    models = []
    for graphed in (True, False):
        if not graphed:
            monkeypatch.setattr(learner, "FastUpdate", FastUpdate)
        model = make(OptionDDPG)
        train(model, 10)
        train(model, 10, batch_size=48)
        assert isinstance(model, OptionDDPG)
        model.actor_learning_rate = 1e-4
        train(model, 10, batch_size=48)
        model.critic.optimizer.load_state_dict(copy.deepcopy(model.critic.optimizer.state_dict()))
        train(model, 10, batch_size=48)
        model.policy.load_state_dict(model.policy.state_dict())  # in place
        train(model, 10, batch_size=48)
        models.append(model)
    assert len(captures) == 4
    assert distance(*models) == 0.0


def test_without_graphs_it_warns_once_and_goes_on(captures: list[object], monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(step: object) -> None:
        raise RuntimeError("operation not permitted when stream is capturing")

    monkeypatch.setattr(cuda_graph, "capture", refuse)
    model = make(OptionDDPG)
    train(model, WARM_UP)
    with pytest.warns(UserWarning, match="without CUDA graphs, more slowly: operation not permitted") as caught:
        train(model, 10)
    assert len(caught) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        train(model, 10)
    assert model._n_updates == WARM_UP + 20


@needs_gpu
@pytest.mark.parametrize(("stock", "ours"), [(DDPG, OptionDDPG), (TD3, OptionTD3)])
def test_two_hundred_updates_are_sb3s_on_a_gpu(stock: type[TD3], ours: type[TD3]) -> None:
    a, b = make(stock, "cuda", (400, 300)), make(ours, "cuda", (400, 300))
    b.policy.load_state_dict(a.policy.state_dict())
    if ours is OptionTD3:  # the noise is drawn from another place of the generator's sequence
        a.target_policy_noise = b.target_policy_noise = 0.0
    for model in (a, b):
        train(model, 200, batch_size=256)
    assert isinstance(b._fast_update, GraphedUpdate)
    assert b._fast_update._captured
    assert distance(a, b) <= 1e-4


@needs_gpu
def test_an_agent_learns_on_a_gpu() -> None:
    agent = SkillGraphAgent("MultiInputPolicy", gym.make("SkillGraph/ToyMaze-v0"), seed=0, device="cuda", learning_starts=200)
    agent.learn(1_500)
    assert agent._n_updates == 650
