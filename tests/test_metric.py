"""Metrics of goal space: what is near, what networks see, and that everything goes by them."""

import io
import math
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from builders import profile
from hypothesis import given
from hypothesis import strategies as st

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.envs.metrics import env_metric
from sb3_skillgraph.metric import (
    MISMATCH,
    Angle,
    Ball,
    Custom,
    Direction,
    Exact,
    Metric,
    Product,
    Rotation,
    Tilt,
    Within,
    as_metric,
    as_saved,
)

TOY = "SkillGraph/ToyMaze-v0"
MIXED = Product(Within((0, 1), 0.5), Angle((2,), 0.3), Exact((3,)))
HEADING = Product(Within((0, 1), 0.5), Direction((2, 3), 0.3))
METRICS = [Ball(0.45), as_metric([0.5, 2.0, np.inf, 0.1]), MIXED, HEADING, Product(Rotation((0, 1, 2, 3), 0.2))]


def numbers(n: int) -> Any:
    return st.lists(st.floats(-20.0, 20.0), min_size=n, max_size=n).map(np.array)


@pytest.mark.parametrize("metric", METRICS, ids=repr)
@profile(60)
@given(a=numbers(4), b=numbers(4), c=numbers(4))
def test_a_metric_is_one(metric: Metric, a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    ab, ba, bc, ac = (float(metric.distance(*pair)) for pair in ((a, b), (b, a), (b, c), (a, c)))
    assert metric.distance(a, a) == pytest.approx(0.0, abs=1e-6)
    assert ab == pytest.approx(ba, abs=1e-9)
    assert ac <= ab + bc + 1e-6
    assert metric.reached(a, b) == (ab <= metric.radius)


@pytest.mark.parametrize("metric", METRICS, ids=repr)
def test_many_points_are_measured_as_one_by_one(metric: Metric) -> None:
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(5, 4)), rng.normal(size=(3, 4))
    table = metric.distance(a[:, None], b)
    assert table.shape == (5, 3)
    np.testing.assert_allclose(table, [[metric.distance(x, y) for y in b] for x in a])
    seen = metric.embed(a.astype(np.float32))
    assert seen.dtype == np.float32
    np.testing.assert_allclose(seen, [metric.embed(x.astype(np.float32)) for x in a], rtol=1e-6)


@profile(60)
@given(angle=st.floats(-10.0, 10.0), off=st.floats(-math.pi, math.pi), turns=st.integers(-3, 3))
def test_an_angle_is_reached_within_its_radius_whatever_the_turns(angle: float, off: float, turns: int) -> None:
    metric = Product(Angle((0,), 0.3))
    reached = metric.reached(np.array([angle + off + 2.0 * math.pi * turns]), np.array([angle]))
    if abs(abs(off) - 0.3) > 1e-6:
        assert reached == (abs(off) < 0.3)


@profile(60)
@given(angle=st.floats(-10.0, 10.0), off=st.floats(-math.pi, math.pi), length=st.floats(0.1, 10.0))
def test_a_direction_is_reached_within_its_angle_whatever_its_length(angle: float, off: float, length: float) -> None:
    def heading(angle: float) -> np.ndarray:
        return np.array([1.0, 2.0, math.cos(angle), math.sin(angle)])

    aside = heading(angle + off) * [1.0, 1.0, length, length]
    if abs(abs(off) - 0.3) > 1e-6:
        assert HEADING.reached(aside, heading(angle)) == (abs(off) < 0.3)
    np.testing.assert_allclose(HEADING.nearest_goal(aside), heading(angle + off), atol=1e-9)
    assert as_metric(as_saved(HEADING)).reached(aside, heading(angle + off))


@profile(60)
@given(axis=numbers(3), angle=st.floats(0.0, math.pi), base=numbers(4), flip=st.booleans())
def test_a_rotation_is_reached_within_its_angle_and_so_is_its_negative(
    axis: np.ndarray, angle: float, base: np.ndarray, flip: bool
) -> None:
    if np.linalg.norm(axis) < 0.1 or np.linalg.norm(base) < 0.1:
        return
    base = base / np.linalg.norm(base)
    turn = np.array([math.cos(angle / 2.0), *(math.sin(angle / 2.0) * axis / np.linalg.norm(axis))])
    turned = quaternion_product(turn, base) * (-1.0 if flip else 1.0)
    metric = Product(Rotation((0, 1, 2, 3), 0.2))
    if abs(angle - 0.2) > 1e-5:
        assert metric.reached(turned, base) == (angle < 0.2)


def quaternion_product(p: np.ndarray, q: np.ndarray) -> np.ndarray:
    w, v = p[0] * q[0] - p[1:] @ q[1:], p[0] * q[1:] + q[0] * p[1:] + np.cross(p[1:], q[1:])
    return np.array([w, *v])


def test_every_part_has_to_be_reached_and_what_belongs_to_none_does_not_matter() -> None:
    goal = np.array([1.0, 2.0, 3.0, 1.0])
    for off, reached in (
        ([0.3, 0.39, 0.29, 0.0], True),
        ([0.3, 0.41, 0.0, 0.0], False),  # 0.508 away
        ([0.0, 0.0, 0.31, 0.0], False),
        ([0.0, 0.0, 0.0, 1.0], False),
        ([0.0, 0.0, 2.0 * math.pi, 0.4], True),
    ):
        assert MIXED.reached(goal + off, goal) == reached
    loose = as_metric([0.5, np.inf, 0.1])
    assert loose.reached(np.array([0.4, 99.0, 0.05]), np.zeros(3))
    assert not loose.reached(np.array([0.4, 0.0, 0.15]), np.zeros(3))


def test_what_has_to_match_keeps_goals_apart_but_is_no_way_to_go() -> None:
    here, there = np.array([0.0, 0.0, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 1.0])
    assert MIXED.travel(here, there) == pytest.approx(2.0)
    assert MIXED.distance(here, there) == pytest.approx(2.0 + MISMATCH)


def test_made_up_points_become_goals() -> None:
    metric = Product(Within((0,), 0.5), Angle((1,), 0.3), Exact((2,)), Rotation((3, 4, 5, 6), 0.2))
    goal = metric.nearest_goal(np.array([0.3, 4.0, 0.7, 2.0, 0.0, 0.0, 0.0]))
    np.testing.assert_allclose(goal, [0.3, 4.0 - 2.0 * math.pi, 1.0, 1.0, 0.0, 0.0, 0.0])
    begin, point = np.zeros(3), np.array([1.0, 0.2, 1.0])
    beyond = Product(Within((0,), 0.5), Angle((1,), 0.3), Exact((2,))).beyond(begin, point, 4.0)
    np.testing.assert_allclose(beyond, [3.0, 0.6, 1.0])  # two radii to the point, four more


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (0.0, "positive number"),
        ("wide", "positive number"),
        ([np.inf, np.inf], "at most once"),
        ([0.3, np.nan], "positive number"),
    ],
)
def test_what_is_no_metric(given: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        as_metric(given)


def test_parts_that_do_not_fit() -> None:
    with pytest.raises(ValueError, match="at most once"):
        Product(Within((0, 1), 0.5), Exact((1,)))
    with pytest.raises(ValueError, match="4 numbers"):
        Rotation((0, 1, 2), 0.1)
    for parts in ((0.1,), ([Within((0,), 0.1)],), (Within((), 0.1),)):
        with pytest.raises(ValueError, match="made of parts"):
            Product(*parts)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="integer"):
        Within((0.5,), 0.1)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="dimension 3"):
        MIXED.check(3)


# -- what an environment tells -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("id", ["HandManipulateBlock-v1", "HandManipulateBlockRotateXYZ-v1"])
def test_poses_of_a_hand_are_reached_where_the_environment_says_so(id: str) -> None:
    import gymnasium_robotics

    gym.register_envs(gymnasium_robotics)
    env = gym.make(id)
    metric = env_metric(lambda name: getattr(env.unwrapped, name, None), 7)
    assert isinstance(metric, Product)
    rng, agreed, reached = np.random.default_rng(0), [], []
    for _ in range(1_000):
        goal = rng.normal(size=7)
        goal[3:] /= np.linalg.norm(goal[3:])
        axis = rng.normal(size=3)
        angle = 0.1 * rng.uniform(0.9, 1.1)
        turn = np.array([math.cos(angle / 2.0), *(math.sin(angle / 2.0) * axis / np.linalg.norm(axis))])
        offset = rng.normal(size=3)
        offset *= 0.01 * rng.uniform(0.9, 1.1) / np.linalg.norm(offset)
        point = np.concatenate([goal[:3] + offset, quaternion_product(turn, goal[3:])])
        theirs = bool(env.unwrapped._is_success(point, goal))  # type: ignore[attr-defined]
        agreed.append(theirs == metric.reached(point, goal))
        reached.append(theirs)
    env.close()
    assert all(agreed)
    assert 200 < sum(reached) < 800


def test_how_a_pen_lies_is_reached_where_its_environment_says_so() -> None:
    import gymnasium_robotics

    gym.register_envs(gymnasium_robotics)
    env = gym.make("HandManipulatePen-v1")
    metric = env_metric(lambda name: getattr(env.unwrapped, name, None), 7)
    assert isinstance(metric, Product) and isinstance(metric.parts[1], Tilt)
    rng, agreed, reached = np.random.default_rng(0), [], []
    for _ in range(1_000):
        goal = rng.normal(size=7)
        goal[3:] /= np.linalg.norm(goal[3:])
        axis, angle, spin = rng.normal(size=3), 0.1 * rng.uniform(0.9, 1.1), 0.5 * rng.uniform(0.0, 2.0 * np.pi)
        turn = np.array([math.cos(angle / 2.0), *(math.sin(angle / 2.0) * axis / np.linalg.norm(axis))])
        about_itself = np.array([math.cos(spin), 0.0, 0.0, math.sin(spin)])
        rotation = quaternion_product(quaternion_product(turn, goal[3:]), about_itself)
        point = np.concatenate([goal[:3], rotation])
        # Theirs takes a quaternion and its negative for two rotations
        negative = np.concatenate([goal[:3], -goal[3:]])
        theirs = any(env.unwrapped._is_success(point, same) for same in (goal, negative))  # type: ignore[attr-defined]
        agreed.append(theirs == metric.reached(point, goal))
        reached.append(theirs)
    env.close()
    assert all(agreed)
    assert 200 < sum(reached) < 950


def test_a_task_is_asked_last_since_it_may_not_leave_its_process() -> None:
    told = {"success_radius": 0.3}

    def get(name: str) -> Any:
        assert name not in ("task", "maze")
        return told.get(name)

    assert env_metric(get, 2) == Ball(0.3)


# -- agents -----------------------------------------------------------------------------------------------------------


class Taxicab(Ball):
    """A user's own metric."""

    def distance(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.abs(a - b).sum(axis=-1)

    def reached(self, point: np.ndarray, goal: np.ndarray) -> bool:
        return bool(self.distance(point, goal) <= self.radius)


class Loose(Within):
    """A user's own part of one."""


@pytest.mark.parametrize("metric", [Taxicab(0.45), Product(Loose((0, 1), 0.45))], ids=["metric", "part"])
def test_a_metric_of_ones_own_class_is_asked_for_again(metric: Metric) -> None:
    env = gym.make(TOY)
    agent = SkillGraphAgent("MultiInputPolicy", env, event_radius=metric, policy_kwargs=dict(net_arch=[16, 16]), seed=0)
    file = io.BytesIO()
    agent.save(file)
    with pytest.raises(ValueError, match=r"event_radius=.* again"):
        SkillGraphAgent.load(io.BytesIO(file.getvalue()), env=env)
    loaded = SkillGraphAgent.load(io.BytesIO(file.getvalue()), env=env, event_radius=metric)
    assert loaded.metric is metric
    assert agent.copy(gym.make(TOY)).metric is metric


@pytest.mark.parametrize(
    ("radius", "message"),
    [
        ([0.3], "1 radii for goals that have 2"),
        ([0.3, 0.3, 0.3], "3 radii for goals that have 2"),
        (lambda a, b: np.linalg.norm(a - b), r"shape \(3, 2, 2\) it returned shape \(\)"),
        ({"parts": [{"kind": "Withn", "dims": [0, 1], "radius": 0.3}]}, "not 'Withn'"),
        ({"parts": [{"kind": "Within", "dims": [0, 1]}]}, "Within cannot be made"),
        (lambda a, b: np.nan * (a - b).sum(axis=-1), "finite distances, 0 or more"),
        (lambda a, b: -np.linalg.norm(a - b, axis=-1), "finite distances, 0 or more"),
        (1e-300, "positive number"),
    ],
    ids=["few", "many", "one for all", "kind", "radius", "nan", "negative", "nothing"],
)
def test_what_is_no_metric_of_these_goals(radius: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SkillGraphAgent("MultiInputPolicy", gym.make(TOY), event_radius=radius)


def test_functions_that_ask_for_points_of_their_kind_are_metrics() -> None:
    def turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return 2.0 * np.arccos(np.abs((a * b).sum(axis=-1))) / 0.1  # of unit quaternions

    def heading(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        a, b = a / np.linalg.norm(a, axis=-1, keepdims=True), b / np.linalg.norm(b, axis=-1, keepdims=True)
        return np.linalg.norm(a - b, axis=-1) / 0.2

    for function, goal_dim in ((turn, 4), (heading, 2)):
        as_metric(function).check(goal_dim)


def test_networks_see_goals_of_a_users_own_metric_in_its_units() -> None:
    metric = as_metric(lambda a, b: np.abs(a - b) @ np.array([1 / 0.0144, 1 / 40.0, 0.0]))
    units = metric.reach(3)
    for i, radius in enumerate((0.0144, 40.0)):
        assert radius < units[i] <= 2.0 * radius
    assert units[2] == 0.0  # it does not matter
    np.testing.assert_allclose(metric.embed(np.array([[0.0288, -80.0, 3.0]]))[0, :2], [0.0288 / units[0], -80.0 / units[1]])
    assert metric.embed(np.array([3.0, 3.0, 3.0]))[2] == 0.0
    near = as_metric(lambda a, b: np.minimum(np.abs(a - b)[..., 0], 0.9))  # never missed, and yet looked at
    assert near.reach(1) == 1.0


class WithHeading(gym.ObservationWrapper):
    """Goals get an angle, which the first action turns by, and a number that does not matter."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        box = gym.spaces.Box(-np.inf, np.inf, (4,), np.float64)
        self.observation_space = gym.spaces.Dict(
            observation=env.observation_space["observation"], achieved_goal=box, desired_goal=box
        )
        self.heading, self.wanted, self.steps = 0.0, 0.0, 0

    def reset(self, **kwargs: Any) -> Any:
        observation, _ = self.env.reset(**kwargs)
        self.heading, self.wanted = self.np_random.uniform(-np.pi, np.pi, 2)
        return self.observation(observation), {}

    def step(self, action: Any) -> Any:
        self.heading = (self.heading + 0.3 * float(action[0]) + np.pi) % (2.0 * np.pi) - np.pi
        observation, reward, terminated, truncated, _ = super().step(action)
        return observation, reward, terminated, truncated, {}

    def observation(self, observation: Any) -> Any:
        self.steps += 1
        achieved = np.array([*observation["achieved_goal"], self.heading, self.steps])
        desired = np.array([*observation["desired_goal"], self.wanted, 0.0])
        return {**observation, "achieved_goal": achieved, "desired_goal": desired}


@pytest.mark.parametrize(
    "metric",
    [Product(Within((0, 1), 0.45), Angle((2,), 0.5)), [0.45, 0.45, 0.5, np.inf], lambda a, b: np.abs(a - b)[..., 0] / 0.4],
    ids=["parts", "radii", "function"],
)
def test_an_agent_learns_saves_and_plans_with_any_metric(metric: Any) -> None:
    env = WithHeading(gym.make(TOY))
    nets = dict(policy_kwargs=dict(net_arch=[16, 16]), learning_starts=100, batch_size=16)
    agent = SkillGraphAgent(
        "MultiInputPolicy", env, event_radius=metric, option_view="relative", seed=0, max_events=60, **nets
    )
    agent.learn(600)
    assert len(agent.events) > 1
    centers = agent.graph.centers
    apart = agent.metric.distance(centers[:, None], centers) + 10.0 * np.eye(len(centers))
    assert apart.min() >= agent.metric.radius
    file = io.BytesIO()
    agent.save(file)
    given = {"event_radius": metric} if callable(metric) else {}
    if given:
        with pytest.raises(ValueError, match=r"event_radius=.* again"):
            SkillGraphAgent.load(io.BytesIO(file.getvalue()), env=env)
    loaded = SkillGraphAgent.load(io.BytesIO(file.getvalue()), env=env, **given)
    assert isinstance(loaded.metric, Custom if given else Product)
    observation, _ = env.reset(seed=1)
    assert loaded.plan(observation) == agent.plan(observation)
    np.testing.assert_array_equal(loaded.predict(observation)[0], agent.predict(observation)[0])


def test_the_paper_has_balls() -> None:
    from sb3_skillgraph import PAPER

    with pytest.raises(ValueError, match="must be a number"):
        SkillGraphAgent("MultiInputPolicy", gym.make(TOY), event_radius=[0.45, 0.45], **PAPER)
