"""Agents that can do nothing any more, as their environment tells in ``info["stuck"]``."""

import copy
import csv
import itertools
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from builders import World
from conftest import TOY, Recorder, check_store, differences, new_agent, state_of, without_clock
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_skillgraph import OptionEnv, OptionsEnv, SkillGraphAgent, rollouts
from sb3_skillgraph.baselines import CoveringOptions
from sb3_skillgraph.controller import FAILED, GLOBAL, ControllerState, Request
from sb3_skillgraph.evaluation import run_pair
from sb3_skillgraph.events import Event
from sb3_skillgraph.plotting import run_plan

PIT, DEPTH = np.array([0.0, 1.4]), 0.45  # beside the way from the toy maze's start


class Pit(gym.Wrapper):
    """Whoever falls into it stays there, until the reset."""

    center, depth = PIT, DEPTH

    def in_pit(self, observation: Any) -> bool:
        return bool(np.linalg.norm(observation["achieved_goal"] - self.center) < self.depth)

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(**kwargs)
        self.stuck = self.in_pit(observation)
        return observation, info

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, terminated, truncated, info = self.env.step(np.zeros(2) if self.stuck else action)
        self.stuck = self.in_pit(observation)
        return observation, reward, terminated, truncated, {**info, "stuck": self.stuck}


def pit_env(**kwargs: Any) -> gym.Env:
    return Recorder(Pit(gym.make(TOY, **kwargs)))


def pits(n_envs: int) -> VecEnv:
    return DummyVecEnv([lambda: Monitor(pit_env()) for _ in range(n_envs)])


def in_pit(points: np.ndarray) -> np.ndarray:
    return np.linalg.norm(points - PIT, axis=1) < DEPTH


@pytest.mark.parametrize("n_envs", [1, 2])
def test_the_episode_is_given_up(n_envs: int, tmp_path: Any) -> None:
    env = pits(n_envs)
    agent = new_agent(env)
    agent.set_logger(configure(str(tmp_path), ["csv"]))
    agent.learn(1000, log_interval=1_000)
    n_stuck = 0
    for i, inner in enumerate(env.envs):
        recorder = inner
        while not isinstance(recorder, Recorder):
            recorder = recorder.env
        check_store(agent, recorder.transitions, i)
        ends = np.array([step["next_achieved_goal"] for step in recorder.transitions])
        starts = np.array([step["achieved_goal"] for step in recorder.transitions])
        fallen = in_pit(ends)
        assert not in_pit(starts).any()  # nobody goes on from there
        n_stuck += int(fallen.sum())
        rows = np.arange(agent.store.total)[i::n_envs]
        np.testing.assert_array_equal(agent.store.stuck(rows), fallen)
        assert not (agent.store.terminated(rows) & ~fallen).any()
        later = agent.store.future(rows[np.flatnonzero(fallen)], 50, np.random.default_rng(0))
        np.testing.assert_array_equal(later, rows[np.flatnonzero(fallen)])  # no trajectory leads out of it
    assert n_stuck > 3
    assert agent.curriculum.n_stuck == n_stuck
    lengths = [info["l"] for info in agent.ep_info_buffer]
    assert len(lengths) == agent._episode_num  # SB3's statistics count them all
    assert sum(length < 100 for length in lengths) == n_stuck
    agent.dump_logs()
    agent.logger.close()
    with open(tmp_path / "progress.csv") as file:
        assert float(list(csv.DictReader(file))[-1]["skillgraph/stuck"]) == n_stuck
    assert agent._episode_num == agent.curriculum.n_episodes >= n_stuck


def test_where_a_run_began_is_not_to_blame(trained: SkillGraphAgent) -> None:
    option = next(option for option in trained.options if option.mature and option.success_rate() > 0.5)
    chain = trained.chaining.chain_of[option.id]

    def learned() -> Any:
        return copy.deepcopy((option.initiation.get_state(), dict(trained.graph.evidence), chain.options))

    before, rate, n_failures = learned(), option.success_rate(), chain.n_failures
    price = trained.graph.nx.edges[option.id, option.target]["weight"]
    for _ in range(3):
        trained.chaining.learn_stuck(option)
    assert differences(learned(), before) == []
    assert option.success_rate() < rate  # but it did fail, and plans that use it are dearer
    assert trained.graph.nx.edges[option.id, option.target]["weight"] > price
    assert list(option.record)[-3:] == [False] * 3
    assert chain.n_failures == n_failures + 3


def test_an_option_that_hardly_ends_otherwise_is_planned_with_no_more(trained: SkillGraphAgent) -> None:
    option = next(option for option in trained.options if option.mature and option.success_rate() > 0.5)
    graph, initiation = trained.graph, copy.deepcopy(option.initiation.get_state())
    while option.success_rate(graph.rate_prior) >= graph.min_success_rate:
        assert graph.nx.has_edge(option.id, option.target)
        trained.chaining.learn_stuck(option)
    assert graph.nx.out_degree(option.id) == 0
    assert differences(option.initiation.get_state(), initiation) == []


def test_nothing_is_learned_of_ways_into_the_pit() -> None:
    agent = new_agent(pit_env()).learn(1500, log_interval=None)
    assert agent.curriculum.n_stuck > 3
    assert any(option.mature for option in agent.options)
    assert not in_pit(agent.visited.points).any()  # where events are put
    assert not in_pit(np.array([event.center for event in agent.events])).any()
    for option in agent.options:
        for points in (*option.initiation.successes, np.array(option.effects).reshape(-1, 2)):
            assert not in_pit(np.asarray(points)).any()


@pytest.mark.parametrize("option", [1, GLOBAL])
def test_being_stuck_ends_an_option_as_failed_even_where_it_leads(option: int) -> None:
    world = World()
    world.line()
    goal = world.graph.events["e1"].center
    request = [Request(goal, event="e1")]
    running = ControllerState.fresh(1)._replace(option=np.array([option]), steps=np.array([3]))
    for point in (goal[None] - 5.0, goal[None]):
        state, outcomes = world.controller.advance(running, point, request, np.array([True]))
        assert outcomes == [(0, option, -1, False, 3)]
        assert state.option.tolist() == [FAILED]


def test_learning_resumes_exactly(tmp_path: Any) -> None:
    whole = new_agent(pit_env()).learn(1200, log_interval=None)
    half = new_agent(pit_env()).learn(600, log_interval=None)
    assert 0 < half.curriculum.n_stuck < whole.curriculum.n_stuck
    half.save(tmp_path / "agent.zip")
    half.save_replay_buffer(tmp_path / "replay.zip")
    resumed = SkillGraphAgent.load(tmp_path / "agent.zip", env=half.get_env())
    resumed.load_replay_buffer(tmp_path / "replay.zip")
    resumed.learn(600, reset_num_timesteps=False, log_interval=None)
    assert differences(without_clock(state_of(resumed)), without_clock(state_of(whole))) == []


class Deadly(Pit):
    """The episode ends in the pit, and nothing else tells why."""

    told: dict[str, bool]

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, _, truncated, _ = super().step(action)
        return observation, reward, self.stuck, truncated, dict(self.told)


@pytest.mark.parametrize("told", [{}, {"stuck": False, "is_success": False}, {"stuck": True}, {"is_success": True}])
def test_an_end_that_is_not_explained(told: dict[str, bool]) -> None:
    env = Deadly(gym.make(TOY))
    env.told = told
    agent = new_agent(env)
    rollouts._warn_of_ends.cache_clear()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        agent.learn(1000, log_interval=None)
    assert agent.store.terminated(np.arange(1000)).sum() > 1
    texts = [str(each.message) for each in caught if "TellStuck" in str(each.message)]
    assert len(texts) == (not any(told.values()))  # once, however often it happens


def test_adaptation_starts_over_where_it_is_told_to() -> None:
    env = pit_env()
    agent = new_agent(env).learn(300, log_interval=None)
    before, given_up = len(env.starts), agent.curriculum.n_stuck
    start = PIT - [DEPTH + 0.02, 0.0]
    agent.adapt(PIT, start=start, total_timesteps=400)
    assert agent.curriculum.n_stuck > given_up
    begun = np.array(env.starts[before:])
    exact = np.all(np.abs(begun - start) < 1e-6, axis=1)
    assert exact.sum() >= agent.curriculum.n_stuck - given_up


def test_covering_options_start_over_too() -> None:
    env = pit_env(terminate_on_success=True)
    learner = CoveringOptions(env, n_options=1, option_updates=20, reach=10, seed=0).learn(1500)
    rows = np.arange(learner.store.total)
    fallen = in_pit(learner.store.column("next_achieved_goal", rows))
    assert fallen.sum() > 1
    np.testing.assert_array_equal(learner.store.stuck(rows), fallen)
    assert not in_pit(learner.store.column("achieved_goal", rows)).any()
    later = learner.store.future(rows[fallen], 50, np.random.default_rng(0))
    np.testing.assert_array_equal(later, rows[fallen])  # no trajectory leads out of it


def test_option_env_ends_and_is_reset() -> None:
    base = pit_env()
    env = OptionEnv(base, Event("far", np.array([1.0, 1.0]), 0.2))
    env.reset(seed=0, options={"start": PIT - [DEPTH + 0.1, 0.0]})
    over = False
    while not over:
        _, reward, over, truncated, info = env.step(np.array([1.0, 0.0], dtype=np.float32))
    assert (reward, truncated, info["is_success"]) == (pytest.approx(-100.0), False, False)
    n_starts = len(base.starts)
    env.reset()
    assert len(base.starts) == n_starts + 1


def test_options_env_ends_its_episode(trained: SkillGraphAgent) -> None:
    env = OptionsEnv(pit_env(), trained.options, gamma=0.9)
    env.reset(seed=0, options={"start": PIT - [DEPTH + 0.1, 0.0]})
    over = False
    while not over:
        mask = env.action_masks()
        assert mask[-5]
        _, _, over, truncated, info = env.step(env.max_options - 5)  # along x
    assert info["stuck"]
    assert not truncated


class Up:
    """Walks up, into the pit if it begins below."""

    def predict(self, observation: Any, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        return np.array([0.0, 1.0], dtype=np.float32), None


def test_a_picture_ends_where_the_agent_is_stuck(trained: SkillGraphAgent) -> None:
    env = Pit(gym.make(TOY))
    trajectory, _ = run_plan(trained, env, PIT - [DEPTH + 0.05, 0.0], np.array([1.0, 1.4]))  # straight through it
    assert in_pit(trajectory.points[-1:]).all()
    assert not in_pit(trajectory.points[:-1]).any()
    assert not trajectory.success


def where_options_run(agent: SkillGraphAgent, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Where an agent goes from a start to a goal while options of its graph are running, shape (n, 2)."""
    env = gym.make(TOY, terminate_on_success=True)
    observation, _ = env.reset(options={"start": start, "goal": goal})
    state, over, points = None, False, []
    while not over:
        action, state, _ = agent.act(observation, state)
        observation, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated
        if state.option[0] != GLOBAL:
            points.append(observation["achieved_goal"])
    return np.array(points).reshape(-1, 2)


def test_a_fall_is_a_failure_of_the_option_that_ran(trained: SkillGraphAgent) -> None:
    centers = [event.center for event in trained.events]
    ways = [(a, b, where_options_run(trained, a, b)) for a, b in itertools.permutations(centers, 2)]
    start, goal, way = max(ways, key=lambda each: len(each[2]))
    assert len(way) > 5
    env = Pit(gym.make(TOY, terminate_on_success=True))
    env.center, env.depth = way[len(way) // 2], 0.01  # on the way of an option
    pair = run_pair(trained, env, start, goal, np.nan)
    assert pair.stuck and pair.trace is not None and pair.trace.planned_steps
    assert pair.trace.n_runs > pair.trace.n_successes
    assert not pair.trace.followed


def test_getting_stuck_on_the_last_step_of_an_episode() -> None:
    agent = new_agent(pit_env(max_steps=4)).learn(1000, log_interval=None)
    store, rows = agent.store, np.arange(1000)
    fallen = in_pit(store.column("next_achieved_goal", rows))
    trajectory = store.get_state()["trajectory"][:1000]
    assert (np.bincount(trajectory)[trajectory[fallen]] == 4).any()  # it falls, and its time is up
    np.testing.assert_array_equal(store.stuck(rows), fallen)
    assert agent.curriculum.n_stuck == fallen.sum()
    samples = agent.global_option.replay.sample(1000)
    assert (samples.dones[samples.rewards < -50.0] == 1.0).all()


@pytest.mark.parametrize(("x", "stuck"), [(0.0, True), (-1.2, False)])
def test_a_test_ends_where_the_agent_is_stuck(x: float, stuck: bool) -> None:
    env = Pit(gym.make(TOY, terminate_on_success=True, max_steps=30))
    pair = run_pair(Up(), env, np.array([x, 0.6]), np.array([1.0, -1.0]), np.nan)
    assert (pair.success, pair.stuck, pair.steps < 30) == (False, stuck, stuck)
    assert pair.nearest == pytest.approx(np.hypot(x - 1.0, 1.6))
