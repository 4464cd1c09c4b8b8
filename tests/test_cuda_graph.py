"""The update as a CUDA graph: its book-keeping on any machine, its numbers where there is a GPU."""

import copy
import warnings

import gymnasium as gym
import pytest
import torch as th
from learners import distance, make, train
from stable_baselines3 import DDPG, TD3

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.options import cuda_graph, learner
from sb3_skillgraph.options.cuda_graph import WARM_UP, GraphedUpdate
from sb3_skillgraph.options.fast_update import FastUpdate
from sb3_skillgraph.options.learner import OptionDDPG, OptionTD3

needs_gpu = pytest.mark.skipif(not th.cuda.is_available(), reason="needs a GPU")


NET = [16, 16]
RATE = 1e-3  # of both networks, as SB3 has it


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
    graphed = make(cls, NET)
    train(graphed, 40)
    assert isinstance(graphed._fast_update, GraphedUpdate)
    assert len(captures) == (1 if cls is OptionDDPG else 2)  # TD3: with and without the actor
    monkeypatch.setattr(learner, "FastUpdate", FastUpdate)
    eager = make(cls, NET)
    train(eager, 40)
    assert isinstance(eager._fast_update, FastUpdate)
    assert distance(graphed, eager) == 0.0
    assert graphed.logger.name_to_value == eager.logger.name_to_value


def test_what_changes_is_captured_anew(captures: list[object], monkeypatch: pytest.MonkeyPatch) -> None:
    models = []
    for graphed in (True, False):
        if not graphed:
            monkeypatch.setattr(learner, "FastUpdate", FastUpdate)
        model = make(OptionDDPG, NET)
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
    model = make(OptionDDPG, NET)
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
    a = make(stock, [400, 300], learning_rate=RATE, device="cuda")
    b = make(ours, [400, 300], actor_learning_rate=RATE, critic_learning_rate=RATE, device="cuda")
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
