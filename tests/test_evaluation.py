"""Random pairs of start and goal, plans for goals never seen, and few-shot adaptation."""

import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import POINT, TOY, Recorder, check_store, differences, new_agent, new_vec_env, state_of

import sb3_skillgraph
from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.baselines import StraightOn
from sb3_skillgraph.calibration import brier_score
from sb3_skillgraph.envs import U_MAZE, MazeGeometry, MazeMap, find, geometry_of
from sb3_skillgraph.evaluation import NoPairsError, PairResult, PairsResult, SkillTrace, evaluate_pairs, run_pair
from sb3_skillgraph.hyperparams import make_recommended
from sb3_skillgraph.planning import DIRECT, GOAL
from sb3_skillgraph.plotting import run_plan
from sb3_skillgraph.running import RunnerState

CORRIDOR: MazeMap = [[1] * 9, [1, "r", 0, 0, 0, 0, 0, 0, 1], [1] * 9]
STATUSES = {"in_graph", "in_initiation_set", "outside"}


class RandomWalk:
    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)

    def predict(self, observation: Any, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        return self.rng.uniform(-1, 1, 2).astype(np.float32), None


def endpoints(result: PairsResult) -> list[Any]:
    return [(pair.start, pair.goal, pair.path_length) for pair in result.pairs]


def observation(x: float, y: float, goal: tuple[float, float] = (0.0, 0.0)) -> dict[str, np.ndarray]:
    return {"observation": np.array([x, y]), "achieved_goal": np.array([x, y]), "desired_goal": np.array(goal)}


# -- evaluate_pairs ---------------------------------------------------------------------------------------------------


def test_is_offered_by_the_package() -> None:
    assert sb3_skillgraph.evaluate_pairs is evaluate_pairs


def as_plain(result: PairsResult) -> list[Any]:
    return [(*pair._replace(trace=None), None if pair.trace is None else vars(pair.trace)) for pair in result.pairs]


def test_pairs_depend_on_the_seed_alone(trained: SkillGraphAgent) -> None:
    ours = evaluate_pairs(trained, TOY, n_pairs=10, seed=1)
    assert differences(endpoints(ours), endpoints(evaluate_pairs(RandomWalk(), TOY, n_pairs=10, seed=1))) == []
    assert differences(endpoints(ours), endpoints(evaluate_pairs(RandomWalk(), TOY, n_pairs=10, seed=2))) != []
    assert differences(as_plain(ours), as_plain(evaluate_pairs(trained, TOY, n_pairs=10, seed=1))) == []


def test_pairs_are_free_and_far_apart() -> None:
    result = evaluate_pairs(RandomWalk(), TOY, n_pairs=60, env_kwargs=dict(max_steps=1))
    geometry = MazeGeometry(U_MAZE)
    assert len(result.pairs) == 60
    for pair in result.pairs:
        assert geometry.is_free(np.stack([pair.start, pair.goal])).all()
        assert pair.path_length >= 2.0
        assert pair.path_length == pytest.approx(geometry.shortest_path_length(pair.start, pair.goal))
    cells = {tuple(np.floor(point).astype(int)) for pair in result.pairs for point in (pair.start, pair.goal)}
    assert len(cells) >= 7  # all over the maze


def test_a_trained_agent_gets_to_most_goals_a_random_walk_to_few(trained: SkillGraphAgent) -> None:
    trained.learn(3000, reset_num_timesteps=False)
    kwargs: dict[str, Any] = dict(n_pairs=30, seed=1, env_kwargs=dict(max_steps=100))
    agents, chance = evaluate_pairs(trained, TOY, **kwargs), evaluate_pairs(RandomWalk(), TOY, **kwargs)
    assert agents.success_rate >= 0.7
    assert chance.success_rate <= 0.3


class Named:
    """A predictor that takes what SB3's ``evaluate_policy`` hands it, by name."""

    def predict(self, observation: Any, state: Any = None, **kwargs: Any) -> tuple[np.ndarray, Any]:
        assert kwargs.keys() == {"episode_start", "deterministic"}
        return np.zeros(2, dtype=np.float32), state


def test_predictors_are_asked_by_name() -> None:
    named: Any = Named()
    assert evaluate_pairs(named, TOY, n_pairs=2, env_kwargs=dict(max_steps=5)).success_rate <= 1.0


def test_traces_tell_how_the_options_did(trained: SkillGraphAgent) -> None:
    result = evaluate_pairs(trained, TOY, n_pairs=20, seed=1)
    assert len(result.traces) == len(result.promises) == 20
    for pair, trace in zip(result.pairs, result.traces, strict=True):
        plan = trained.plan(observation(*pair.start, goal=tuple(pair.goal)))
        assert (trace.promised, trace.expected_steps) == (plan.success_probability, plan.expected_steps)
        assert pair.status == plan.status
        assert 0.0 < trace.promised <= 1.0
        assert 0 <= trace.n_successes <= trace.n_runs <= pair.steps
        assert 0 <= trace.direct_steps <= pair.steps
    n_runs, n_successes = (sum(getattr(trace, name) for trace in result.traces) for name in ("n_runs", "n_successes"))
    assert result.option_success_rate == pytest.approx(n_successes / n_runs)
    assert n_successes > 20
    assert 0 < sum(trace.direct_steps for trace in result.traces) < sum(pair.steps for pair in result.pairs)
    assert sum(one.n_plans for one in result.calibration()) == 20


def test_what_does_not_plan_leaves_no_traces(trained: SkillGraphAgent) -> None:
    for agent in (RandomWalk(), StraightOn(trained)):
        result = evaluate_pairs(agent, TOY, n_pairs=2)
        assert (result.traces, result.promises, result.calibration()) == ([], [], [])
        assert np.isnan(result.option_success_rate)
        assert {pair.status for pair in result.pairs} == {None}


def test_watching_an_agent_changes_nothing_in_what_it_does(trained: SkillGraphAgent) -> None:
    class Unwatched:
        """Is no agent to evaluate_pairs, but acts as one."""

        predict = trained.predict

    watched, unwatched = (evaluate_pairs(agent, TOY, n_pairs=6, seed=3) for agent in (trained, Unwatched()))
    assert [(pair.success, pair.steps, pair.nearest) for pair in watched.pairs] == [
        (pair.success, pair.steps, pair.nearest) for pair in unwatched.pairs
    ]


def test_runs_are_counted_when_they_end(trained: SkillGraphAgent) -> None:
    """The trace of a pair is that of the runs which ``act`` tells of."""
    trained.learn(3000, reset_num_timesteps=False)
    env = gym.make(TOY, terminate_on_success=True)
    start, goal = np.array([-1.0, 1.0]), np.array([-1.0, -1.0])
    pair = run_pair(trained, env, start, goal, 4.0)
    seen, _ = env.reset(options={"start": start, "goal": goal})
    state, ended, direct = None, [], 0
    for _ in range(pair.steps):
        action, state, runs = trained.act(seen, state)
        ended += runs
        direct += trained.running(state) == [DIRECT]
        seen = env.step(action)[0]
    assert pair.trace is not None
    # The run that reaches the goal ends with the episode.
    assert (pair.trace.n_runs, pair.trace.direct_steps) == (len(ended) + pair.success, direct)
    assert pair.trace.n_successes == sum(run.success for run in ended) + pair.success >= 1


def test_calibration_bins() -> None:
    plans = [(0.1, False), (0.19, True), (0.2, True), (0.99, True), (1.0, False)]
    zeros = np.zeros(2)
    pairs = [PairResult(zeros, zeros, 3.0, success, 9, "in_graph", SkillTrace(p, 9.0)) for p, success in plans]
    result = PairsResult([*pairs, PairResult(zeros, zeros, 3.0, True, 9, None)])
    assert result.promises == plans
    bins = result.calibration()
    assert [(one.low, one.n_plans) for one in bins] == [(0.0, 2), (0.2, 1), (0.8, 2)]
    assert [one.promised for one in bins] == pytest.approx([0.145, 0.2, 0.995])
    assert [one.observed for one in bins] == [0.5, 1.0, 0.5]
    assert brier_score(plans) == pytest.approx(np.mean([0.01, 0.81**2, 0.64, 0.0001, 1.0]))


def test_success_is_reaching_the_goal_at_any_step() -> None:
    class Right:
        def predict(self, observation: Any, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
            return np.array([1.0, 0.0], dtype=np.float32), None

    result = evaluate_pairs(Right(), TOY, n_pairs=40, env_kwargs=dict(maze_map=CORRIDOR, max_steps=50))
    for pair in result.pairs:
        if abs(pair.goal[1] - pair.start[1]) < 0.45:
            assert pair.success == bool(pair.goal[0] > pair.start[0])
        assert pair.success == (pair.nearest <= 0.45)
        if pair.success:
            assert (pair.path_length - 0.45) / 0.25 - 1 <= pair.steps <= 50
        else:
            assert pair.steps == 50
        assert pair.status is None
    assert result.success_rate == pytest.approx(np.mean([pair.success for pair in result.pairs]))
    assert 0.0 < result.success_rate < 1.0


def test_interval_contains_the_rate() -> None:
    zeros = np.zeros(2)
    for n_successes in (0, 3, 10):
        result = PairsResult([PairResult(zeros, zeros, 3.0, i < n_successes, 9, None) for i in range(10)])
        low, high = result.interval
        assert 0.0 <= low <= result.success_rate == n_successes / 10 <= high <= 1.0
        assert 0.2 < high - low < 0.8


def test_agent_is_left_as_it_was(trained: SkillGraphAgent) -> None:
    before = state_of(trained)
    result = evaluate_pairs(trained, TOY, n_pairs=5)
    assert differences(before, state_of(trained)) == []
    assert {pair.status for pair in result.pairs} <= STATUSES


def test_environment_arguments_reach_it() -> None:
    result = evaluate_pairs(RandomWalk(), TOY, n_pairs=5, env_kwargs=dict(maze_map=CORRIDOR, max_steps=7))
    assert all(MazeGeometry(CORRIDOR).is_free(pair.goal[None])[0] for pair in result.pairs)
    assert max(pair.steps for pair in result.pairs) <= 7


def test_an_environment_that_is_given_is_used_and_stays_open(trained: SkillGraphAgent) -> None:
    env = Recorder(gym.make(TOY, max_steps=30))
    result = evaluate_pairs(trained, env, n_pairs=3, seed=4)
    assert len(env.transitions) == sum(pair.steps for pair in result.pairs) > 0
    assert differences(endpoints(result), endpoints(evaluate_pairs(RandomWalk(), TOY, n_pairs=3, seed=4))) == []
    env.reset()


def test_an_agent_that_is_stuck_is_given_up() -> None:
    class Sinks(gym.Wrapper):
        """Says that the agent is stuck after three steps."""

        def reset(self, **kwargs: Any) -> Any:
            self.n_steps = 0
            return self.env.reset(**kwargs)

        def step(self, action: np.ndarray) -> Any:
            *step, info = self.env.step(action)
            self.n_steps += 1
            return *step, {**info, "stuck": self.n_steps == 3}

    result = evaluate_pairs(new_agent(), Sinks(gym.make(TOY)), n_pairs=3)
    assert [(pair.stuck, pair.success, pair.steps) for pair in result.pairs] == [(True, False, 3)] * 3


class Bare(gym.Env):
    """The toy maze as a stranger might write it: no walls to draw from, no radius, nothing in its info."""

    def __init__(self) -> None:
        self.inner = gym.make(TOY, max_steps=40)
        self.observation_space, self.action_space = self.inner.observation_space, self.inner.action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        assert options is None
        return self.inner.reset(seed=seed)[0], {}

    def step(self, action: Any) -> Any:
        return (*self.inner.step(action)[:-1], {})


def test_environments_without_walls_draw_starts_and_goals_themselves(trained: SkillGraphAgent) -> None:
    result = evaluate_pairs(trained, Bare(), n_pairs=8)
    assert len({tuple(pair.goal) for pair in result.pairs}) == 8
    for pair in result.pairs:
        assert pair.success == (pair.nearest <= trained.event_radius)
        assert np.isnan(pair.path_length)
    assert any(pair.success for pair in result.pairs)
    with pytest.raises(ValueError, match="does not tell when a goal is reached"):
        evaluate_pairs(RandomWalk(), Bare(), n_pairs=1)
    assert evaluate_pairs(StraightOn(trained), Bare(), n_pairs=2).pairs  # the agent's radius is that of its walker
    with pytest.raises(NoPairsError, match="To adapt, the environment must take"):
        gym.register("Bare-v0", Bare)
        evaluate_pairs(trained, "Bare-v0", n_pairs=1, adapt_timesteps=10)


class TellsInSteps(Bare):
    """It says where the goal is reached, but with a step only, as many environments do."""

    def step(self, action: Any) -> Any:
        *step, info = self.inner.step(action)
        return *step, {"is_success": info["is_success"]}


def test_an_environment_may_tell_success_with_its_steps_only() -> None:
    pairs = evaluate_pairs(RandomWalk(), TellsInSteps(), n_pairs=8).pairs
    assert 0 < sum(pair.success for pair in pairs) < 8
    assert all(pair.steps for pair in pairs)


def test_a_task_may_know_the_radius() -> None:
    class Tasked(Bare):
        task = SimpleNamespace(distance_threshold=0.3)

    agent = new_agent(Tasked())
    assert agent.event_radius == 0.3
    result = evaluate_pairs(RandomWalk(), Tasked(), n_pairs=5)
    assert all(pair.success == (pair.nearest <= 0.3) for pair in result.pairs)


@pytest.mark.mujoco
def test_mazes_of_gymnasium_robotics_as_they_come() -> None:
    find("PointMaze_UMaze-v3")
    env = gym.make("PointMaze_UMaze-v3")
    agent = new_agent(env)
    assert agent.event_radius == 0.45
    assert agent.parts.planner.horizon == 300
    geometry = geometry_of(env)
    assert geometry is not None
    result = evaluate_pairs(agent, "PointMaze_UMaze-v3", n_pairs=3)
    for pair in result.pairs:
        assert geometry.is_free([pair.start, pair.goal]).all()
    assert geometry_of(gym.make("CartPole-v1")) is None


@pytest.mark.mujoco
@pytest.mark.parametrize("env_id", ["AntMaze_UMaze-v5", "pointmaze-medium-v0", "FrankaKitchen-v1"])
def test_an_id_gets_the_wrapper_that_is_recommended(env_id: str) -> None:
    pytest.importorskip("ogbench")
    find(env_id)
    agent = new_agent(make_recommended(env_id, {}))
    (pair,) = evaluate_pairs(agent, env_id, n_pairs=1).pairs
    assert pair.steps <= agent.parts.planner.horizon


def test_bad_arguments() -> None:
    with pytest.raises(ValueError, match=r"needs a goal environment"):
        evaluate_pairs(RandomWalk(), "Pendulum-v1")
    with pytest.raises(ValueError, match=r"goal environments .*Pendulum.* is none"):
        evaluate_pairs(RandomWalk(), gym.make("Pendulum-v1"))
    with pytest.raises(ValueError, match="too small"):
        evaluate_pairs(RandomWalk(), TOY, n_pairs=1, env_kwargs=dict(maze_map=[[1, 1, 1], [1, "r", 1], [1, 1, 1]]))


@pytest.mark.mujoco
def test_on_a_simulator() -> None:
    agent = new_agent(gym.make(POINT))
    result = evaluate_pairs(agent, POINT, n_pairs=2, env_kwargs=dict(max_steps=20))
    assert all(pair.path_length >= 2.0 and pair.steps <= 20 for pair in result.pairs)


def without_shared_generators(state: dict[str, Any]) -> dict[str, Any]:
    state["agent"]["progress"].pop("global_generators")
    return state


@pytest.mark.parametrize("verbose", [0, 1])
def test_adaptation_works_on_a_copy(trained: SkillGraphAgent, verbose: int) -> None:
    trained.verbose = verbose
    trained.learn(20, reset_num_timesteps=False)
    before = state_of(trained)
    result = evaluate_pairs(trained, TOY, n_pairs=2, adapt_timesteps=60)
    assert len(result.pairs) == 2
    assert differences(without_shared_generators(before), without_shared_generators(state_of(trained))) == []


def deep_copy(agent: SkillGraphAgent) -> SkillGraphAgent:
    return copy.deepcopy(agent)


def own_copy(agent: SkillGraphAgent) -> SkillGraphAgent:
    return agent.copy(gym.make(TOY))


@pytest.mark.parametrize("make_copy", [deep_copy, own_copy])
def test_a_copy_is_an_agent_of_its_own(trained: SkillGraphAgent, make_copy: Any) -> None:
    trained.learn(20, reset_num_timesteps=False)
    before = without_shared_generators(state_of(trained))
    copied = make_copy(trained)
    after = without_shared_generators(state_of(copied))
    assert differences(before["agent"]["graph"], after["agent"]["graph"]) == []
    assert differences(before["agent"]["parameters"], after["agent"]["parameters"]) == []
    assert differences(before["replay"], after["replay"]) == []
    copied.learn(200, reset_num_timesteps=False)
    assert copied.num_timesteps == trained.num_timesteps + 200
    assert differences(before, without_shared_generators(state_of(trained))) == []


# -- plan -------------------------------------------------------------------------------------------------------------


def test_plan_of_an_agent_that_knows_nothing() -> None:
    plan = new_agent().plan(observation(-1.0, 1.0))
    assert (plan.status, plan.path) == ("outside", (DIRECT, GOAL))
    assert 0.0 < plan.success_probability <= 1.0


def test_plan_tells_the_three_cases(trained: SkillGraphAgent) -> None:
    start = trained.events[0].center
    for event in trained.events[::2]:
        assert trained.plan(observation(*start), goal=event.center).status == "in_graph"
    grid = np.stack(np.meshgrid(np.linspace(-2.2, 2.2, 9), np.linspace(-2.2, 2.2, 9)), axis=-1).reshape(-1, 2)
    nearest = [min(float(np.linalg.norm(event.center - point)) for event in trained.events) for point in grid]
    seen = set()
    for point, distance in zip(grid, nearest, strict=True):
        status = trained.plan(observation(*start), goal=point).status
        seen.add(status)
        if abs(distance - trained.event_radius) > 1e-6 and abs(distance - trained.graph.cover_radius) > 1e-6:
            inside, near = distance < trained.event_radius, distance < trained.graph.cover_radius
            assert status == ("in_graph" if inside else "in_initiation_set" if near else "outside")
    assert seen == STATUSES
    assert trained.plan(observation(*start), goal=np.array([50.0, 50.0])).status == "outside"


def test_plan_is_a_path_of_the_graph(trained: SkillGraphAgent) -> None:
    """Options and what they lead to in turn; from one event to the next there are edges."""
    edges, lengths = trained.graph.nx.edges, []
    walks = {option.id: option.target for option in trained.options}
    for source in trained.events[::3]:
        for target in trained.events[::3]:
            plan = trained.plan(observation(*source.center, goal=tuple(target.center)))
            assert plan.path[-1] == GOAL
            for option, landing in zip(plan.path[:-2:2], plan.path[1:-2:2], strict=True):
                assert landing == walks[option] or (option, landing) in edges  # the likeliest landing may be another
            assert all(pair in edges for pair in zip(plan.path[1:-3:2], plan.path[2:-2:2], strict=True))
            assert len(set(plan.path)) == len(plan.path), "no cycles"
            assert 0.0 < plan.success_probability <= 1.0
            assert np.isfinite(plan.expected_steps) and plan.expected_steps >= 0.0
            lengths.append(len(plan.path))
    assert max(lengths) >= 6, "at least two walks before the last"


def test_predict_runs_the_first_option_of_the_plan(trained: SkillGraphAgent) -> None:
    for event in trained.events[::2]:
        seen = observation(-1.0, 1.0, goal=tuple(event.center))
        _, state = trained.predict(seen)
        assert state is not None
        assert trained.running(state) == [trained.plan(seen).path[0]]


def test_plan_takes_its_goal_from_the_observation(trained: SkillGraphAgent) -> None:
    goal = tuple(trained.events[-1].center)
    start = trained.events[0].center
    assert trained.plan(observation(*start, goal=goal)) == trained.plan(observation(*start), goal=np.array(goal))


@pytest.mark.parametrize("goal", [[1.0], [1.0, 1.0, 1.0], [[1.0, 1.0]], [np.nan, 0.0], [np.inf, 0.0], 1.0, "here"])
def test_no_plan_for_what_is_no_goal(trained: SkillGraphAgent, goal: Any) -> None:
    with pytest.raises(ValueError, match=r"shape \(2,\)"):
        trained.plan(observation(0.0, 1.0), goal=goal)
    with pytest.raises(ValueError, match=r"shape \(2,\)"):
        trained.adapt(goal)
    with pytest.raises(ValueError, match=r"shape \(2,\)"):
        trained.adapt(np.zeros(2), start=goal)


# -- adapt ------------------------------------------------------------------------------------------------------------


def test_adapt_pursues_the_goal_and_comes_back_to_it(trained: SkillGraphAgent) -> None:
    goal = max((event.center for event in trained.events), key=lambda c: float(np.linalg.norm(c - trained.events[0].center)))
    goal, n_steps = goal + 0.1, trained.num_timesteps
    pursued: list[np.ndarray] = []

    def note(*_: Any) -> bool:
        pursued.extend(mission.goal for mission in trained.parts.missions.current if mission is not None)
        return True

    trained.adapt(goal, total_timesteps=120, callback=note)
    assert trained.num_timesteps == n_steps + 120
    assert len(pursued) > 60
    to_goal = np.array([np.allclose(one, goal, atol=1e-6) for one in pursued])
    assert to_goal[0] and to_goal.mean() > 0.1
    # Whoever is there goes to another event, to come back.
    centers = trained.graph.centers
    assert all(np.linalg.norm(centers - one, axis=1).min() < 1e-6 for one in np.array(pursued)[~to_goal])
    assert trained.parts.missions.pinned is None
    pursued.clear()
    trained.learn(200, callback=note, reset_num_timesteps=False)
    assert not all(np.allclose(one, goal, atol=1e-6) for one in pursued)


def test_adapt_looks_for_a_way_from_the_event_nearest_to_an_unknown_goal(trained: SkillGraphAgent) -> None:
    goal = np.array([4.0, 1.0])  # outside of the maze
    nearest = min(trained.events, key=lambda event: float(np.linalg.norm(event.center - goal)))
    pursued = set()

    def note(*_: Any) -> bool:
        pursued.update(tuple(mission.goal) for mission in trained.parts.missions.current if mission is not None)
        return True

    trained.adapt(goal, total_timesteps=1000, callback=note)
    assert tuple(goal) in pursued
    assert tuple(nearest.center) in pursued


def test_adapt_begins_every_episode_at_the_start(trained_files: tuple[Path, Path]) -> None:
    env = Recorder(gym.make(TOY, max_steps=40))
    agent = SkillGraphAgent.load(trained_files[0], env=env)
    start = np.array([1.0, -1.0])
    agent.adapt(np.array([-1.0, -1.0]), start=start, total_timesteps=100)
    for first in (0, 40, 80):
        np.testing.assert_array_equal(env.transitions[first]["achieved_goal"], start)
    check_store(agent, env.transitions)
    agent.learn(100, reset_num_timesteps=False)
    assert not any(np.allclose(step["achieved_goal"], start, atol=0.01) for step in env.transitions[100:])


def test_adapt_with_two_environments() -> None:
    agent = new_agent(new_vec_env()).learn(300)
    assert agent.adapt(np.array([-1.0, -1.0]), start=np.array([1.0, 0.0]), total_timesteps=100).num_timesteps == 400


def test_adapt_before_learning() -> None:
    agent = new_agent().adapt(np.array([1.0, 1.0]), total_timesteps=300)
    assert agent.graph.edges.size > 0
    start = np.array([[-1.0, 1.0]])  # of the maze
    assert any(np.linalg.norm(event.center - start) < 0.5 for event in agent.events)


def test_adapt_needs_an_environment(trained_files: tuple[Path, Path]) -> None:
    with pytest.raises((AssertionError, ValueError), match="set_env"):
        SkillGraphAgent.load(trained_files[0]).adapt(np.zeros(2))


def test_adapt_from_inside_a_wall(trained: SkillGraphAgent) -> None:
    trained.learn(10, reset_num_timesteps=False)  # Gymnasium's own checker does not survive a first reset that raises
    with pytest.raises(ValueError, match="free space"):
        trained.adapt(np.array([-1.0, -1.0]), start=np.array([0.0, 0.0]), total_timesteps=50)
    n_steps = trained.num_timesteps
    assert trained.learn(150, reset_num_timesteps=False).num_timesteps == n_steps + 150


def test_plans_are_about_the_episodes_of_the_test(trained: SkillGraphAgent) -> None:
    trained.learn(3000, reset_num_timesteps=False)  # who has hardly been trained promises too little
    env = gym.make(TOY, max_steps=40)
    before = trained.parts.planner.horizon
    result = evaluate_pairs(trained, env, n_pairs=20)
    assert trained.parts.planner.horizon == before
    longer = evaluate_pairs(trained, gym.make(TOY, max_steps=400), n_pairs=20)
    promised, promised_longer = (np.mean([trace.promised for trace in each.traces]) for each in (result, longer))
    assert promised < promised_longer
    assert abs(promised - result.success_rate) < 0.25 and abs(promised_longer - longer.success_rate) < 0.25


# -- plans, as an episode goes on -------------------------------------------------------------------------------------


def test_a_plan_promises_the_same_before_and_after_its_option_begins(trained: SkillGraphAgent) -> None:
    env = gym.make(TOY, max_steps=60)
    trained.set_env(gym.make(TOY, max_steps=60))
    n_begun = 0
    for seed in range(10):
        seen, _ = env.reset(seed=seed)
        state: Any = None
        while not trained.metric.reached(seen["achieved_goal"], seen["desired_goal"]):
            promised = trained.plan(seen, state=state)
            action, state = trained.predict(seen, state=state)
            arrived = trained.metric.reached(seen["achieved_goal"], RunnerState(*state).aim[0])  # and ends with this step
            if RunnerState(*state).steps[0] == 1 and not arrived:  # it has just begun
                n_begun += 1
                plan = trained.plan(seen, state=state)
                assert plan.path == promised.path
                assert plan.success_probability == pytest.approx(promised.success_probability)
            if RunnerState(*state).elapsed[0] == 60:
                break
            seen, *_ = env.step(action)
    assert n_begun > 10


def test_the_steps_that_a_plan_expects_are_those_from_here(trained: SkillGraphAgent) -> None:
    seen = observation(-1.0, 1.0, goal=(-1.0, -1.0))
    before = trained.plan(seen).expected_steps
    _, state = trained.predict(seen)
    expected = [before]
    for _ in range(3):
        expected.append(trained.plan(seen, state=state).expected_steps)
        _, state = trained.predict(seen, state=state)
    assert np.diff(expected) == pytest.approx(-1.0, abs=0.2)


def test_another_goal_in_the_episode_is_pursued_at_once(trained: SkillGraphAgent) -> None:
    start = observation(-1.0, 1.0, goal=(-0.9, 1.0))
    _, state = trained.predict(start)
    elsewhere = {**start, "desired_goal": np.array([-1.0, -1.0])}
    plan = trained.plan(elsewhere, state=state)
    assert plan.path == trained.plan(elsewhere).path
    _, state = trained.predict(elsewhere, state=state)
    assert trained.running(state) == [plan.path[0]]
    again = {**start, "desired_goal": np.array([-0.95, 1.0])}
    _, state = trained.predict(again, state=state)
    assert trained.running(state) == [DIRECT]
    assert RunnerState(*state).aim[0] == pytest.approx([-0.95, 1.0])
    assert RunnerState(*state).elapsed[0] == 3


def test_testing_in_the_agents_own_environment_leaves_no_false_transition() -> None:
    env = gym.make(TOY)
    agent = new_agent(env, seed=0).learn(200)
    evaluate_pairs(agent, env, n_pairs=2)
    agent.learn(50, reset_num_timesteps=False)
    store = agent.parts.store
    rows = np.arange(store.total)
    moved = store.column("next_achieved_goal", rows) - store.column("achieved_goal", rows)
    assert np.abs(moved).max() < 0.3


def test_an_agent_of_several_environments_is_tested_with_adaptation() -> None:
    agent = new_agent(new_vec_env(n_envs=2), seed=0).learn(300)
    assert len(evaluate_pairs(agent, TOY, n_pairs=1, adapt_timesteps=50).pairs) == 1


def test_what_is_reached_is_for_the_environment_to_say(trained: SkillGraphAgent) -> None:
    env = gym.make(TOY, success_radius=0.05)
    start, goal = np.array([-1.0, 1.0]), np.array([-1.0, 0.8])
    trajectory, _ = run_plan(trained, env, start, goal)
    assert trained.metric.reached(start, goal)
    assert len(trajectory.options) > 0
    assert trajectory.success == (np.linalg.norm(trajectory.points[-1] - goal) <= 0.05)
