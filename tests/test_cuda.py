"""Agents on a GPU learn by torch's update, and are saved there and loaded on a CPU (tried where there is one)."""

from pathlib import Path

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import TOY, new_agent

from sb3_skillgraph import PAPER, SkillGraphAgent
from sb3_skillgraph.baselines import ReplaySearch
from sb3_skillgraph.checking import tensor

on_a_gpu = pytest.mark.skipif(not th.cuda.is_available(), reason="there is no GPU")


@on_a_gpu
def test_it_learns_there_and_goes_on_elsewhere(tmp_path: Path) -> None:
    agent = new_agent(device="cuda", skills="always").learn(800, log_interval=None)
    assert agent.parts.walker.learner.update_path == "reference"
    assert agent.policy.device.type == "cuda"
    assert agent.parts.skills
    agent.save(tmp_path / "agent")
    agent.save_replay_buffer(tmp_path / "replay")
    observation, _ = gym.make(TOY).reset(seed=0)
    for device in ("cpu", "cuda"):
        loaded = SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY), device=device)
        loaded.load_replay_buffer(tmp_path / "replay")
        assert loaded.plan(observation) == agent.plan(observation)
        np.testing.assert_allclose(loaded.predict(observation)[0], agent.predict(observation)[0], atol=1e-4)
        assert loaded.learn(200, reset_num_timesteps=False).num_timesteps == 1000


@on_a_gpu
def test_the_papers_options_and_the_search_do_too(tmp_path: Path) -> None:
    paper = new_agent(device="cuda", **PAPER).learn(800, log_interval=None)
    paper.save(tmp_path / "agent")
    SkillGraphAgent.load(tmp_path / "agent", device="cpu")
    agent = new_agent(device="cuda").learn(600, log_interval=None)
    observation, _ = gym.make(TOY).reset(seed=0)
    assert ReplaySearch(agent, 50).predict(observation)[0].shape == (2,)


def test_what_learns_is_checked_like_what_is_saved() -> None:
    tensor((2,), -1.0, 1.0)(th.nn.Parameter(th.ones(2)), "it")
    with pytest.raises(ValueError, match="it must be"):
        tensor((2,), -1.0, 1.0)(th.nn.Parameter(2.0 * th.ones(2)), "it")
