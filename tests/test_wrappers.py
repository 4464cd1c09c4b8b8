"""An environment of one's own, made fit by wrappers."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.wrappers import TransformAction

import sb3_skillgraph.envs.mujoco_mazes  # noqa: F401 (imports gymnasium-robotics, which registers its ants)
from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.envs import HoldAction, TellStuck, on_its_back
from sb3_skillgraph.hyperparams import load_hyperparams


class Counter(gym.Env):
    """Pays 1, 2, 3, ...; its episodes end for good at the fourth step, or are cut at the sixth."""

    observation_space = gym.spaces.Box(0, 10, (1,))
    action_space = gym.spaces.Box(-1, 1, (1,))

    def __init__(self, ends: int = 4, stuck_at: int = 99) -> None:
        self.ends, self.stuck_at, self.n_steps = ends, stuck_at, 0

    def step(self, action: np.ndarray) -> Any:
        self.n_steps += 1
        info = {"action": action, "stuck": self.n_steps == self.stuck_at}
        return np.array([self.n_steps]), float(self.n_steps), self.n_steps == self.ends, self.n_steps == 6, info


@pytest.mark.parametrize(
    ("kwargs", "expected"),
    [
        ({"ends": 99}, [(3, 6.0, False, False), (6, 15.0, False, True)]),
        ({"ends": 4}, [(3, 6.0, False, False), (4, 4.0, True, False)]),
        ({"stuck_at": 2}, [(2, 3.0, False, False)]),
    ],
    ids=["cut", "ended", "stuck"],
)
def test_an_action_is_held_until_the_episode_is_over(kwargs: dict[str, int], expected: list[Any]) -> None:
    env = HoldAction(Counter(**kwargs), 3)
    for step, *rest in expected:
        observation, *outcome, info = env.step(np.array([0.5]))
        assert (observation.tolist(), outcome) == ([step], rest)
        assert info["action"].tolist() == [0.5]


@pytest.mark.parametrize("n_steps", [0, 2.0, "2"])
def test_an_action_is_held_for_a_step_at_least(n_steps: Any) -> None:
    with pytest.raises(ValueError, match=f"n_steps must be a whole number of steps, at least 1, not {n_steps!r}"):
        HoldAction(Counter(), n_steps)


def test_what_an_environment_tells_of_being_stuck_stays() -> None:
    env = TellStuck(Counter(stuck_at=2), lambda observation: bool(observation[0] == 3))
    assert [env.step(np.zeros(1))[-1]["stuck"] for _ in range(4)] == [False, True, True, False]


@pytest.fixture
def robotics_ant() -> Iterator[gym.Env]:
    """gymnasium-robotics' ant with a fifth of its torque and twice its control period."""
    env: gym.Env = gym.make("AntMaze_UMaze-v5", include_cfrc_ext_in_observation=False)
    env = TransformAction(env, lambda action: 0.2 * action, env.action_space)
    env = HoldAction(TellStuck(env, on_its_back), 2)
    yield env
    env.close()


@pytest.mark.mujoco
def test_an_ant_tells_when_it_is_on_its_back(robotics_ant: gym.Env) -> None:
    robotics_ant.reset(seed=0)
    idle = np.zeros(8, dtype=np.float32)
    assert robotics_ant.step(idle)[-1]["stuck"] is False
    body: Any = robotics_ant.unwrapped
    body.ant_env.data.qpos[3:7] = [0.0, 1.0, 0.0, 0.0]
    assert robotics_ant.step(idle)[-1]["stuck"] is True


@pytest.mark.mujoco
def test_somebody_elses_ant_learns_with_the_shipped_settings(robotics_ant: gym.Env) -> None:
    settings = {**load_hyperparams("SkillGraph/AntUMaze-v0"), "learning_starts": 50, "batch_size": 16, "option_view": "body"}
    del settings["n_timesteps"]
    agent = SkillGraphAgent(env=robotics_ant, event_radius=0.45, seed=0, **settings).learn(120)
    assert agent.parts.store.total == 120
    assert agent.parts.walker.learner._n_updates > 0


@pytest.mark.mujoco
def test_a_body_view_refuses_contact_forces() -> None:
    env = gym.make("AntMaze_UMaze-v5")
    for view in ("body", "placed_body"):
        with pytest.raises(ValueError, match=r"a body with 47 joints, but actions have 8: .*include_cfrc_ext_in_observation"):
            SkillGraphAgent("MultiInputPolicy", env, event_radius=0.45, option_view=view)
    env.close()
