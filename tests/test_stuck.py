"""Agents that can do nothing any more, as their environment tells in ``info["stuck"]``."""

import csv
import itertools
import warnings
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import TOY, Recorder, check_store, differences, new_agent, state_of, without_clock
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_skillgraph import OptionEnv, SkillGraphAgent
from sb3_skillgraph.baselines import CoveringOptions
from sb3_skillgraph.evaluation import run_pair
from sb3_skillgraph.events import Event
from sb3_skillgraph.learning import episodes
from sb3_skillgraph.planning import DIRECT
from sb3_skillgraph.plotting import run_plan
from sb3_skillgraph.running import Run, RunnerState

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
        rows = np.arange(agent.parts.store.total)[i::n_envs]
        np.testing.assert_array_equal(agent.parts.store.stuck(rows), fallen)
        assert not (agent.parts.store.terminated(rows) & ~fallen).any()
        later = agent.parts.store.future(rows[np.flatnonzero(fallen)], 50, np.random.default_rng(0))
        np.testing.assert_array_equal(later, rows[np.flatnonzero(fallen)])  # no trajectory leads out of it
    assert n_stuck > 3
    assert agent.parts.rollout.n_stuck == n_stuck
    lengths = [info["l"] for info in agent.ep_info_buffer]
    assert len(lengths) == agent._episode_num  # SB3's statistics count them all
    assert sum(length < 100 for length in lengths) == n_stuck
    agent.dump_logs()
    agent.logger.close()
    with open(tmp_path / "progress.csv") as file:
        assert float(list(csv.DictReader(file))[-1]["skillgraph/stuck"]) == n_stuck


def test_no_event_lies_in_the_pit_and_runs_into_it_land_nowhere(monkeypatch: pytest.MonkeyPatch) -> None:
    agent = new_agent(pit_env())
    runs: list[tuple[Run, bool, bool]] = []
    runner = agent.parts.rollout.runner
    advance, graph = runner.advance, agent.graph

    def noted(state: RunnerState, points: np.ndarray, stuck: Any = None) -> Any:
        state, ended = advance(state, points, stuck)
        for run in ended:
            near = np.linalg.norm(graph.centers - points[run.env], axis=1).min() <= graph.cover_radius
            runs.append((run, bool(in_pit(points)[run.env]), bool(near)))
        return state, ended

    monkeypatch.setattr(runner, "advance", noted)
    agent.learn(2500, log_interval=None)
    assert agent.parts.rollout.n_stuck > 3
    assert not in_pit(agent.graph.centers).any()
    lost = [run for run, fell, _ in runs if fell]
    assert len(lost) > 3
    assert {(run.success, run.landing) for run in lost} == {(False, "")}
    failed = [(run.landing != "", near) for run, fell, near in runs if not fell and not run.success]
    assert all(landed == near for landed, near in failed) and (True, True) in failed


@pytest.mark.parametrize("option", ["w1", DIRECT])
def test_being_stuck_ends_an_option_as_failed_even_where_it_leads(trained: SkillGraphAgent, option: str) -> None:
    goal = trained.events[1].center
    running = RunnerState.fresh(1, 2, 2)._replace(
        option=np.array([option]), began=np.array(["e0"]), aim=goal[None], steps=np.full(1, 3), timeout=np.full(1, 50)
    )
    for point in (goal[None] + 0.7, goal[None]):
        state, runs = trained.parts.runner.advance(running, point, [True])
        assert [run[:6] for run in map(as_tuple, runs)] == [(0, "e0", option, "", False, 3)]
        assert (state.option.tolist(), state.arrived.tolist()) == ([""], [""])
        assert state.run_landing[0, 0] == ""
    assert trained.parts.runner.advance(running, goal[None])[1][0].success


def as_tuple(run: Run) -> tuple[Any, ...]:
    return tuple(vars(run).values())


def test_learning_resumes_exactly(tmp_path: Any) -> None:
    whole = new_agent(pit_env()).learn(500, log_interval=None)
    half = new_agent(pit_env()).learn(120, log_interval=None)
    assert 0 < half.parts.rollout.n_stuck < whole.parts.rollout.n_stuck
    half.save(tmp_path / "agent.zip")
    half.save_replay_buffer(tmp_path / "replay.zip")
    resumed = SkillGraphAgent.load(tmp_path / "agent.zip", env=half.get_env())
    resumed.load_replay_buffer(tmp_path / "replay.zip")
    resumed.learn(380, reset_num_timesteps=False, log_interval=None)
    assert differences(without_clock(state_of(resumed)), without_clock(state_of(whole))) == []


class Deadly(Pit):
    """The episode ends in the pit, and nothing else tells why."""

    told: dict[str, bool]

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, reward, _, truncated, _ = super().step(action)
        return observation, reward, self.stuck, truncated, dict(self.told) if self.stuck else {}


@pytest.mark.parametrize("told", [{}, {"stuck": False, "is_success": False}, {"stuck": True}, {"is_success": True}])
def test_an_end_that_is_not_explained(told: dict[str, bool]) -> None:
    env = Deadly(gym.make(TOY))
    env.told = told
    agent = new_agent(env)
    episodes._warn_of_ends.cache_clear()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        agent.learn(1000, log_interval=None)
    assert agent.parts.store.terminated(np.arange(1000)).sum() > 1
    texts = [str(each.message) for each in caught if "TellStuck" in str(each.message)]
    assert len(texts) == (not any(told.values()))  # once, however often it happens


def test_adaptation_starts_over_where_it_is_told_to() -> None:
    env = pit_env()
    agent = new_agent(env).learn(300, log_interval=None)
    before, given_up = len(env.starts), agent.parts.rollout.n_stuck
    start = PIT - [DEPTH + 0.02, 0.0]
    agent.adapt(PIT, start=start, total_timesteps=2000)
    assert agent.parts.rollout.n_stuck > given_up
    begun = np.array(env.starts[before:])
    exact = np.all(np.abs(begun - start) < 1e-6, axis=1)
    assert exact.sum() >= agent.parts.rollout.n_stuck - given_up


def test_covering_options_start_over_too() -> None:
    env = pit_env(terminate_on_success=True)
    learner = CoveringOptions(env, n_options=1, option_updates=20, reach=10, seed=0).learn(700)
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


def way_of(agent: SkillGraphAgent, start: np.ndarray, goal: np.ndarray) -> np.ndarray:
    """Where an agent goes from a start to a goal, shape (n, 2)."""
    return run_plan(agent, gym.make(TOY, terminate_on_success=True), start, goal)[0].points


def test_a_fall_is_a_failure_of_the_option_that_ran(trained: SkillGraphAgent) -> None:
    centers = [event.center for event in trained.events[:6]]
    start, goal = max(itertools.permutations(centers, 2), key=lambda pair: len(way_of(trained, *pair)))
    way = way_of(trained, start, goal)
    assert len(way) > 5
    env = Pit(gym.make(TOY, terminate_on_success=True))
    env.center, env.depth = way[len(way) // 2], 0.01
    first = int(np.flatnonzero(np.linalg.norm(way - env.center, axis=1) <= env.depth)[0])
    pair = run_pair(trained, env, start, goal, np.nan)
    assert pair.stuck
    assert not pair.success
    assert pair.steps == first


def test_getting_stuck_on_the_last_step_of_an_episode() -> None:
    agent = new_agent(pit_env(max_steps=4)).learn(1000, log_interval=None)
    store, rows = agent.parts.store, np.arange(1000)
    fallen = in_pit(store.column("next_achieved_goal", rows))
    trajectory = store.get_state()["trajectory"][:1000]
    assert (np.bincount(trajectory)[trajectory[fallen]] == 4).any()  # it falls, and its time is up
    np.testing.assert_array_equal(store.stuck(rows), fallen)
    assert agent.parts.rollout.n_stuck == fallen.sum()
    samples = agent.parts.walker.replay.sample(1000)
    assert (samples.dones[samples.rewards < -50.0] == 1.0).all()


@pytest.mark.parametrize(("x", "stuck"), [(0.0, True), (-1.2, False)])
def test_a_test_ends_where_the_agent_is_stuck(x: float, stuck: bool) -> None:
    env = Pit(gym.make(TOY, terminate_on_success=True, max_steps=30))
    pair = run_pair(Up(), env, np.array([x, 0.6]), np.array([1.0, -1.0]), np.nan)
    assert (pair.success, pair.stuck, pair.steps < 30) == (False, stuck, stuck)
    assert pair.nearest == pytest.approx(np.hypot(x - 1.0, 1.6))
