"""The agent tells early, once and with numbers, where the event radius does not fit what it moves."""

import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.learning.scale import LOOK_AT, tell_scale
from sb3_skillgraph.memory.store import TransitionStore
from sb3_skillgraph.metric import Ball

TOY = "SkillGraph/ToyMaze-v0"


def told(store: TransitionStore) -> list[str]:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        tell_scale(store, Ball(0.5))
    return [str(warning.message) for warning in caught]


def walked(step: float, length: int, n_envs: int = 2) -> TransitionStore:
    """What agents have seen that go along a line, episodes of ``length`` steps."""
    store, x, no = TransitionStore(2 * LOOK_AT, 1, 1, 1, n_envs), np.zeros((n_envs, 1)), np.zeros(n_envs, dtype=bool)
    for t in range(1, LOOK_AT // n_envs + 1):
        done = t % length == 0
        store.add(x, x, x + step, x + step, np.zeros_like(x), x, no, np.full(n_envs, done))
        x = np.zeros_like(x) if done else x + step
    return store


@pytest.mark.parametrize(
    ("step", "length", "messages"),
    [
        (0.1, 50, []),
        (0.001, 50, ["in the median (0.1 at most)"]),
        (1.5, 50, ["3.0 event radii long"]),
        (0.1, 4, ["0.8 event radii from its begin"]),
        (0.1, 10_000, []),
        (0.01, 1_000, []),
    ],
)
def test_what_is_told(step: float, length: int, messages: list[str]) -> None:
    texts = told(walked(step, length))
    assert len(texts) == len(messages)
    assert all(message in text for message, text in zip(messages, texts, strict=True))


class Pinned(gym.ObservationWrapper):
    """The achieved goal stays where it began."""

    def observation(self, observation: Any) -> Any:
        return {**observation, "achieved_goal": np.zeros(2)}


def learn(env: gym.Env, **kwargs: Any) -> list[str]:
    agent = SkillGraphAgent("MultiInputPolicy", env, learning_starts=10_000, seed=0, option_view="relative", **kwargs)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        agent.learn(2 * LOOK_AT)
    return [str(warning.message) for warning in caught if "event radii" in str(warning.message)]


def test_an_agent_whose_goal_hardly_moves_says_so_once() -> None:
    texts = learn(Pinned(gym.make(TOY)))
    assert len(texts) == 1
    assert "there is no graph to plan on" in texts[0]


def test_radii_that_fit_and_that_do_not() -> None:
    assert not learn(gym.make(TOY))
    assert "small for it" in learn(gym.make(TOY), event_radius=0.02)[0]
    assert (
        "large for this environment" in learn(gym.make(TOY, maze_map=[[1, 1, 1], [1, 0, 1], [1, 1, 1]]), event_radius=5.0)[0]
    )


def test_it_is_told_after_loading_too(tmp_path: Path) -> None:
    given: dict[str, Any] = dict(learning_starts=2 * LOOK_AT, option_view="relative", seed=0)
    agent = SkillGraphAgent("MultiInputPolicy", Pinned(gym.make(TOY)), **given).learn(100)
    agent.save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent", env=Pinned(gym.make(TOY)))
    with pytest.warns(UserWarning, match="hardly moves"):
        loaded.learn(LOOK_AT + 50, reset_num_timesteps=False)
    loaded.save(tmp_path / "agent")
    loaded.save_replay_buffer(tmp_path / "experience")
    again = SkillGraphAgent.load(tmp_path / "agent", env=Pinned(gym.make(TOY)))
    again.load_replay_buffer(tmp_path / "experience")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again.learn(100, reset_num_timesteps=False)
