"""The mean of a policy over the last of its training: what predict acts by, and learning does not."""

import io
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from builders import make_factory

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.memory.store import TransitionStore
from sb3_skillgraph.options import average
from sb3_skillgraph.options.average import SHARE, AveragedPolicy

TOY = "SkillGraph/ToyMaze-v0"


def weights(policy: AveragedPolicy) -> np.ndarray:
    return np.concatenate([array.ravel() for array in policy.get_state().values()])


def made(n_updates: int) -> AveragedPolicy:
    learner = make_factory(TransitionStore(10, 2, 2, 2)).make("walker", None, None).learner
    learner._n_updates = n_updates
    policy = AveragedPolicy(learner)
    with th.no_grad():
        for parameter in policy._now.parameters():
            parameter.add_(1.0)
    return policy


@pytest.mark.parametrize("n_updates", [0, 5_000, average.YOUNG])
def test_who_is_young_acts_as_it_is(n_updates: int) -> None:
    policy = made(n_updates)
    before = weights(policy)
    policy.follow(1)
    np.testing.assert_allclose(weights(policy) - before, 1.0, rtol=1e-5)


@pytest.mark.parametrize("pieces", [(100,), (50, 50), (1,) * 100])
def test_later_the_mean_follows_slowly_however_updates_are_counted(pieces: tuple[int, ...]) -> None:
    policy = made(average.YOUNG + 40_000)
    before = weights(policy)
    for n_updates in pieces:
        policy.follow(n_updates)
    window = SHARE * 40_000
    np.testing.assert_allclose(weights(policy) - before, 1.0 - (1.0 - 1.0 / window) ** 100, rtol=1e-3)


@pytest.fixture
def agent(monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.setattr(average, "YOUNG", 0)
    monkeypatch.setattr(average, "SHARE", 0.5)
    small = dict(policy_kwargs=dict(net_arch=[16, 16]), learning_starts=50, batch_size=16)
    return SkillGraphAgent("MultiInputPolicy", gym.make(TOY), seed=0, **small).learn(300)


def test_predict_acts_by_the_mean_and_learning_does_not(agent: Any) -> None:
    parts = agent.parts
    assert parts.runner.actor is parts.average.actor
    assert parts.rollout.runner.actor is parts.runner.second is parts.walker.actor
    assert parts.rollout.runner.second is None
    now = np.concatenate([p.detach().numpy().ravel() for p in parts.walker.learner.actor.parameters()])
    assert np.abs(weights(parts.average) - now).max() > 1e-3


def test_the_mean_is_saved_and_goes_on(agent: Any) -> None:
    file = io.BytesIO()
    agent.save(file)
    experience = io.BytesIO()
    agent.save_replay_buffer(experience)
    loaded: Any = SkillGraphAgent.load(io.BytesIO(file.getvalue()), env=gym.make(TOY))
    loaded.load_replay_buffer(io.BytesIO(experience.getvalue()))
    np.testing.assert_array_equal(weights(loaded.parts.average), weights(agent.parts.average))
    for each in (agent, loaded):
        each.learn(60, reset_num_timesteps=False)
    np.testing.assert_array_equal(weights(loaded.parts.average), weights(agent.parts.average))


def test_other_parameters_are_acted_by_at_once(agent: Any) -> None:
    other = SkillGraphAgent("MultiInputPolicy", gym.make(TOY), seed=7, policy_kwargs=dict(net_arch=[16, 16]))
    agent.set_parameters(other.get_parameters())
    np.testing.assert_array_equal(weights(agent.parts.average), weights(other.parts.average))
