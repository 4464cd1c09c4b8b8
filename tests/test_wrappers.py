"""An environment of one's own, made fit by wrappers."""

from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import TOY
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit, TransformAction

import sb3_skillgraph.envs.mujoco_mazes  # noqa: F401 (imports gymnasium-robotics, which registers its ants)
from sb3_skillgraph import SkillGraphAgent, evaluate_pairs
from sb3_skillgraph.envs import AntRecipe, FlattenGoals, HoldAction, Parking, PursueGoals, TellStuck, on_its_back
from sb3_skillgraph.envs.metrics import metric_of
from sb3_skillgraph.envs.wrappers import time_limit
from sb3_skillgraph.hyperparams import load_hyperparams, make_recommended, recommended_wrapper
from sb3_skillgraph.metric import Ball, as_saved


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


@pytest.mark.parametrize(("limit", "n_steps", "steps"), [(7, 1, 7), (7, 2, 4), (8, 2, 4), (None, 2, None)])
def test_held_actions_make_episodes_of_fewer_steps(limit: int | None, n_steps: int, steps: int | None) -> None:
    env: Any = Counter(ends=99) if limit is None else TimeLimit(Counter(ends=99), limit)
    held = HoldAction(HoldAction(env, 1), n_steps)
    assert time_limit(held) == steps
    assert time_limit(TimeLimit(held, 2)) == 2


def test_an_agent_plans_for_episodes_as_long_as_they_are() -> None:
    held = HoldAction(gym.make(TOY, max_steps=50), 3)
    for env, horizon in ((held, 17), (TimeLimit(held, 9), 9)):
        assert SkillGraphAgent("MultiInputPolicy", env).parts.planner.horizon == horizon


def test_an_environment_with_wrappers_is_made_again_from_its_spec() -> None:
    gym.register("Line-v0", entry_point=Line)
    env = PursueGoals(gym.make("Line-v0"), lambda o: o, lambda rng: rng.uniform(-4.0, 4.0, 1), 0.4)
    env = TellStuck(HoldAction(env, 3), lambda observation: bool(observation["achieved_goal"][0] > 4.0))
    assert env.spec is not None
    again = gym.make(env.spec)
    outcomes = []
    for each in (env, again):
        each.reset(seed=0)
        outcomes.append([each.step(np.ones(1)) for _ in range(4)])
    for (shown, *outcome, info), (shown_again, *outcome_again, info_again) in zip(*outcomes, strict=True):
        np.testing.assert_equal(shown_again, shown)
        assert (outcome_again, info_again) == (outcome, info)
    assert [info["stuck"] for *_, info in outcomes[0]] == [False, False, True, True]


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
def test_the_recipe_for_ants_is_taken_by_name(robotics_ant: gym.Env) -> None:
    env = make_recommended("AntMaze_UMaze-v5", {})
    assert isinstance(env, AntRecipe) and env.spec is not None
    settings = load_hyperparams("AntMaze_UMaze-v5")
    assert settings == load_hyperparams("SkillGraph/AntUMaze-v0") and "env_wrapper" not in settings
    assert settings == load_hyperparams("AntMaze_Large_Diverse_GR-v4") == load_hyperparams("any_package:AntMaze_Own-v7")
    assert recommended_wrapper("PointMaze_UMaze-v3") is None
    # It is what the wrappers make of it one by one.
    action = np.linspace(-1.0, 1.0, 8, dtype=np.float32)
    for each in (env, robotics_ant, gym.make(env.spec)):
        each.reset(seed=3)
    steps = [each.step(action) for each in (env, robotics_ant)]
    for key in ("observation", "achieved_goal", "desired_goal"):
        np.testing.assert_array_equal(steps[0][0][key], steps[1][0][key])
    assert steps[0][1:4] == steps[1][1:4] and steps[0][4]["stuck"] is False
    assert env.observation_space["observation"].shape == (27,)
    settings |= {"learning_starts": 50, "batch_size": 16}
    del settings["n_timesteps"]
    agent = SkillGraphAgent(env=env, seed=0, **settings).learn(120)  # radius and view are found
    assert agent.metric == Ball(0.45) and agent.parts.view_name == "placed_body"
    with pytest.raises(ValueError, match="AntRecipe is for gymnasium-robotics' AntMaze"):
        AntRecipe(gym.make(TOY))


@pytest.mark.mujoco
def test_a_body_view_refuses_contact_forces() -> None:
    env = gym.make("AntMaze_UMaze-v5")
    for view in ("body", "placed_body"):
        with pytest.raises(ValueError, match=r"a body with 47 joints, but actions have 8: .*include_cfrc_ext_in_observation"):
            SkillGraphAgent("MultiInputPolicy", env, event_radius=0.45, option_view=view)
    env.close()


# -- goals ------------------------------------------------------------------------------------------------------------


class Kitchen(gym.Env):
    """Goals in a dictionary of two entries, as gymnasium-robotics' kitchen has them; the action moves both."""

    goals = gym.spaces.Dict(kettle=gym.spaces.Box(-9, 9, (2,)), lamp=gym.spaces.Box(-9, 9, (1,)))
    observation_space = gym.spaces.Dict(observation=gym.spaces.Box(-9, 9, (1,)), achieved_goal=goals, desired_goal=goals)
    action_space = gym.spaces.Box(-1, 1, (3,))

    def _shown(self) -> Any:
        achieved = {"kettle": self.at[:2].copy(), "lamp": self.at[2:].copy()}
        wanted = {"kettle": np.array([1.0, 2.0], np.float32), "lamp": np.array([3.0], np.float32)}
        return {"observation": np.zeros(1, np.float32), "achieved_goal": achieved, "desired_goal": wanted}

    def reset(self, **kwargs: Any) -> Any:
        super().reset(seed=kwargs.get("seed"))
        self.at, self.n_steps = np.zeros(3, np.float32), 0
        return self._shown(), {}

    def step(self, action: Any) -> Any:
        self.at = np.clip(self.at + action, -5, 5).astype(np.float32)
        self.n_steps += 1
        return self._shown(), 0.0, False, self.n_steps >= 50, {}


def test_nested_goals_are_flattened_with_a_radius_for_each_entry() -> None:
    env = FlattenGoals(Kitchen(), {"kettle": 0.5, "lamp": 0.1})
    observation, _ = env.reset(seed=0)
    assert env.observation_space.contains(observation)
    np.testing.assert_array_equal(observation["desired_goal"], [1.0, 2.0, 3.0])
    near = observation["desired_goal"] + np.array([0.3, 0.3, 0.05])
    assert env.goal_metric.reached(near, observation["desired_goal"])
    assert not env.goal_metric.reached(near + np.array([0.0, 0.0, 0.1]), observation["desired_goal"])
    agent = SkillGraphAgent("MultiInputPolicy", env, learning_starts=100, policy_kwargs=dict(net_arch=[8]), seed=0).learn(300)
    assert len(agent.events) > 3
    assert as_saved(agent.metric) == as_saved(env.goal_metric)


@pytest.mark.mujoco
def test_the_kitchen_has_flat_goals_by_name() -> None:
    env = make_recommended("FrankaKitchen-v1", {})
    assert isinstance(env, FlattenGoals) and env.spec is not None
    assert "env_wrapper" not in load_hyperparams("FrankaKitchen-v1")
    tasks = env.unwrapped.goal  # type: ignore[attr-defined]
    assert env.observation_space["desired_goal"].shape == (sum(len(goal) for goal in tasks.values()),)
    observation, _ = env.reset(seed=0)
    reached = observation["desired_goal"].copy()
    assert env.goal_metric.reached(reached, observation["desired_goal"])
    reached[0] += 0.31
    assert not env.goal_metric.reached(reached, observation["desired_goal"])
    gym.make(env.spec).close()


class Car(gym.Env):
    """highway-env's parking-v0, as far as it can be told from outside: it crashes at its second step."""

    def __init__(self) -> None:
        self.config = {"duration": 100, "policy_frequency": 5}
        space = spaces.Box(-np.inf, np.inf, (6,), np.float64)
        self.observation_space = spaces.Dict(observation=space, achieved_goal=space, desired_goal=space)
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def _seen(self) -> dict[str, np.ndarray]:
        return dict.fromkeys(("observation", "achieved_goal", "desired_goal"), np.array([0.1, 0.1, 0.0, 0.0, 0.0, 1.0]))

    def reset(self, **kwargs: Any) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
        super().reset(seed=kwargs.get("seed"))
        self.n_steps = 0
        return self._seen(), {}

    def step(self, action: np.ndarray) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        self.n_steps += 1
        crashed = self.n_steps == 2
        return self._seen(), 0.0, crashed, False, {"crashed": crashed, "is_success": np.False_}


def test_only_parking_is_parking() -> None:
    with pytest.raises(ValueError, match="highway-env's parking-v0"):
        Parking(gym.make(TOY))


def test_a_crashed_car_is_stuck() -> None:
    env = Parking(Car())
    assert env.max_steps == 500  # 100 seconds
    env.reset(seed=0)
    assert env.step(np.zeros(2, dtype=np.float32))[4]["stuck"] is False
    assert env.step(np.zeros(2, dtype=np.float32))[4]["stuck"] is True


def test_a_car_that_counts_as_parked_is_so_by_its_environments_rule() -> None:
    rng = np.random.default_rng(0)
    metric, goal = metric_of(Parking(Car())), np.array([0.1, 0.14, 0.0, 0.0, 0.0, 1.0])
    assert metric is not None
    turns = rng.uniform(-0.4, 0.4, 2_000)
    cars = goal + np.stack([*rng.uniform(-0.02, 0.02, (4, 2_000)), np.sin(turns), np.cos(turns) - 1.0], axis=1)
    parked = np.abs(cars - goal) @ np.array([1.0, 0.3, 0.0, 0.0, 0.02, 0.02]) < 0.12**2  # highway-env's, by default
    counts = metric.distance(cars, goal) <= metric.radius
    assert counts.sum() > 50 and parked[counts].mean() > 0.95
    assert not metric.reached(goal * [1.0, 1.0, 0.0, 0.0, 1.0, -1.0], goal), "it stands the other way round"


def test_only_nested_goals_are_flattened() -> None:
    with pytest.raises(ValueError, match="Dicts of Boxes"):
        FlattenGoals(gym.make("SkillGraph/ToyMaze-v0"), 0.1)


class Line(gym.Env):
    """A number that the action moves."""

    observation_space = gym.spaces.Box(-9, 9, (1,), np.float64)
    action_space = gym.spaces.Box(-1, 1, (1,))

    def reset(self, **kwargs: Any) -> Any:
        super().reset(seed=kwargs.get("seed"))
        self.x, self.n_steps = 0.0, 0
        return np.array([self.x]), {}

    def step(self, action: Any) -> Any:
        self.x = float(np.clip(self.x + 0.5 * action[0], -5, 5))
        self.n_steps += 1
        return np.array([self.x]), -7.0, False, self.n_steps >= 40, {"lap": 3}


def pursuing(**kwargs: Any) -> PursueGoals:
    given = dict(achieved_goal=lambda o: o**2 / 5.0, sample_goal=lambda rng: rng.uniform(0.0, 5.0, 1), radius=0.4)
    return PursueGoals(Line(), **{**given, **kwargs})


def test_two_functions_make_a_goal_environment_of_any() -> None:
    from stable_baselines3.common.env_checker import check_env

    env = pursuing()
    check_env(env)
    observation, info = env.reset(seed=1, options={"goal": [0.1]})
    assert observation["desired_goal"] == [0.1]
    assert info["is_success"]
    again, _ = env.reset(seed=1)
    other, _ = env.reset()
    assert again["desired_goal"] == env.reset(seed=1)[0]["desired_goal"] != other["desired_goal"]
    env.reset(options={"goal": [0.8]})
    rewards = []
    for _ in range(6):
        observation, reward, _, _, info = env.step(np.ones(1))
        assert info["lap"] == 3
        assert reward == env.compute_reward(observation["achieved_goal"], observation["desired_goal"], info)
        rewards.append(reward)
    assert rewards == [0.0, 0.0, 1.0, 1.0, 0.0, 0.0]  # 0.05, 0.2, 0.45, 0.8, 1.25, 1.8


def test_an_agent_learns_to_pursue_the_goals() -> None:
    env = pursuing(achieved_goal=lambda o: o, sample_goal=lambda rng: rng.uniform(-4.0, 4.0, 1))
    nets = dict(policy_kwargs=dict(net_arch=[32, 32]), batch_size=32)
    agent = SkillGraphAgent("MultiInputPolicy", env, learning_starts=300, seed=0, **nets).learn(4_000)
    assert evaluate_pairs(agent, env, n_pairs=20).success_rate >= 0.8


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (dict(sample_goal=lambda rng: np.zeros(2)), r"shape \(1,\) and sampled ones \(2,\)"),
        (dict(achieved_goal=lambda o: o[0]), "both must be"),
        (dict(radius=[0.1, 0.1]), "2 radii for goals that have 1"),
        (dict(radius=-1.0), "positive"),
    ],
)
def test_functions_that_do_not_fit(arguments: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        pursuing(**arguments)
