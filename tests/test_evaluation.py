"""Random pairs of start and goal, plans for goals never seen, and few-shot adaptation."""

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import POINT, TOY, Recorder, check_store, differences, new_agent, new_vec_env, state_of

import sb3_skillgraph
from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.controller import GLOBAL, OptionOutcome
from sb3_skillgraph.envs import U_MAZE, MazeGeometry, MazeMap
from sb3_skillgraph.evaluation import PairResult, PairsResult, SkillTrace, evaluate_pairs
from sb3_skillgraph.events import Event

CORRIDOR: MazeMap = [[1] * 9, [1, "r", 0, 0, 0, 0, 0, 0, 1], [1] * 9]


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


def test_pairs_depend_on_the_seed_alone(trained: SkillGraphAgent) -> None:
    ours = evaluate_pairs(trained, TOY, n_pairs=20, seed=1)
    assert differences(endpoints(ours), endpoints(evaluate_pairs(RandomWalk(), TOY, n_pairs=20, seed=1))) == []
    assert differences(endpoints(ours), endpoints(evaluate_pairs(trained, TOY, n_pairs=20, seed=2))) != []
    again = evaluate_pairs(trained, TOY, n_pairs=20, seed=1)
    assert differences([tuple(pair) for pair in ours.pairs], [tuple(pair) for pair in again.pairs]) == []


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


def test_traces_tell_how_the_options_did(trained: SkillGraphAgent) -> None:
    result = evaluate_pairs(trained, TOY, n_pairs=30, seed=1)
    assert len(result.traces) == 30
    for pair, trace in zip(result.pairs, result.traces, strict=True):
        assert 0 <= trace.n_successes <= trace.n_runs
        assert 0 <= trace.planned_steps <= pair.steps
        assert trace.predicted is None or 0.0 < trace.predicted <= 1.0
        assert trace.followed is not None
        if trace.n_successes == trace.n_runs and pair.success:
            assert trace.followed
    assert 0.0 < result.planned_share < 1.0
    assert 0.0 < result.option_success_rate <= 1.0
    assert sum(one.n_plans for one in result.calibration()) == sum(trace.predicted is not None for trace in result.traces)
    trained.planning = False
    straight = evaluate_pairs(trained, TOY, n_pairs=5, seed=1)
    trained.planning = True
    assert (straight.planned_share, straight.calibration()) == (0.0, [])
    assert np.isnan(straight.option_success_rate)
    assert evaluate_pairs(RandomWalk(), TOY, n_pairs=2).traces == []


def test_calibration_bins() -> None:
    plans = [(0.1, False), (0.19, True), (0.2, True), (0.99, True), (1.0, False), (None, True)]
    zeros = np.zeros(2)
    pairs = [PairResult(zeros, zeros, 3.0, True, 9, "in_graph", SkillTrace(p, followed)) for p, followed in plans]
    bins = PairsResult(pairs).calibration()
    assert [(one.low, one.n_plans) for one in bins] == [(0.0, 2), (0.2, 1), (0.8, 2)]
    assert [one.predicted for one in bins] == pytest.approx([0.145, 0.2, 0.995])
    assert [one.observed for one in bins] == [0.5, 1.0, 0.5]


def test_a_plan_is_not_followed_once_an_option_has_failed() -> None:
    trace = SkillTrace(0.9)
    trace.count([OptionOutcome(0, GLOBAL, -1, False, 100), OptionOutcome(0, 3, -1, True, 20)])
    assert (trace.followed, trace.n_runs, trace.n_successes) == (None, 1, 1)
    trace.count([OptionOutcome(0, 4, -1, False, 200), OptionOutcome(0, 3, -1, True, 20)])
    assert (trace.followed, trace.n_runs, trace.n_successes) == (False, 3, 2)


def test_success_is_reaching_the_goal_at_any_step() -> None:
    class Right:
        def predict(self, observation: Any, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
            return np.array([1.0, 0.0], dtype=np.float32), None

    result = evaluate_pairs(Right(), TOY, n_pairs=40, env_kwargs=dict(maze_map=CORRIDOR, max_steps=50))
    reachable = [bool(pair.goal[0] > pair.start[0]) for pair in result.pairs]
    near = [abs(pair.goal[1] - pair.start[1]) < 0.45 for pair in result.pairs]
    for pair, right, level in zip(result.pairs, reachable, near, strict=True):
        if level:
            assert pair.success == right
        if pair.success:
            assert pair.steps <= 50
            assert pair.steps >= (pair.path_length - 0.45) / 0.25 - 1
        else:
            assert pair.steps == 50
        assert pair.status is None
    assert result.success_rate == pytest.approx(np.mean([pair.success for pair in result.pairs]))
    assert 0.0 < result.success_rate < 1.0


def test_interval_contains_the_rate(trained: SkillGraphAgent) -> None:
    pair = evaluate_pairs(trained, TOY, n_pairs=1).pairs[0]
    for n_successes in (0, 3, 10):
        result = PairsResult([pair._replace(success=i < n_successes) for i in range(10)])
        low, high = result.interval
        assert 0.0 <= low <= result.success_rate <= high <= 1.0
        assert 0.2 < high - low < 0.8


def test_agent_is_left_as_it_was(trained: SkillGraphAgent) -> None:
    before = state_of(trained)
    result = evaluate_pairs(trained, TOY, n_pairs=5)
    assert differences(before, state_of(trained)) == []
    assert {pair.status for pair in result.pairs} <= {"in_graph", "in_initiation_set", "outside"}


def test_environment_arguments_reach_it() -> None:
    result = evaluate_pairs(RandomWalk(), TOY, n_pairs=5, env_kwargs=dict(maze_map=CORRIDOR, max_steps=7))
    assert all(MazeGeometry(CORRIDOR).is_free(pair.goal[None])[0] for pair in result.pairs)
    assert max(pair.steps for pair in result.pairs) <= 7


def test_bad_arguments() -> None:
    with pytest.raises(ValueError, match="needs a SkillGraph/\\* environment, not 'Pendulum-v1'"):
        evaluate_pairs(RandomWalk(), "Pendulum-v1")
    with pytest.raises(ValueError, match="too small"):
        evaluate_pairs(RandomWalk(), TOY, n_pairs=2, env_kwargs=dict(maze_map=[[1, 1, 1], [1, "r", 1], [1, 1, 1]]))


@pytest.mark.mujoco
def test_on_a_simulator() -> None:
    agent = new_agent(gym.make(POINT))
    result = evaluate_pairs(agent, POINT, n_pairs=2, env_kwargs=dict(max_steps=20))
    assert all(pair.path_length >= 2.0 and pair.steps <= 20 for pair in result.pairs)


@pytest.mark.parametrize("verbose", [0, 1])
def test_adaptation_works_on_a_copy(trained: SkillGraphAgent, verbose: int) -> None:
    trained.verbose = verbose
    trained.learn(20, reset_num_timesteps=False)
    before = state_of(trained)
    result = evaluate_pairs(trained, TOY, n_pairs=2, adapt_timesteps=60)
    assert len(result.pairs) == 2
    assert differences(without_shared_generators(before), without_shared_generators(state_of(trained))) == []


def without_shared_generators(state: dict[str, Any]) -> dict[str, Any]:
    state["agent"]["progress"].pop("global_generators")
    return state


def test_a_copy_is_an_agent_of_its_own(trained: SkillGraphAgent) -> None:
    before = without_shared_generators(state_of(trained))
    copied = copy.deepcopy(trained)
    copied.learn(200, reset_num_timesteps=False)
    assert differences(before, without_shared_generators(state_of(trained))) == []
    trained.learn(200, reset_num_timesteps=False)
    ours, theirs = state_of(trained)["agent"], state_of(copied)["agent"]
    assert differences(ours["graph"], theirs["graph"]) == []
    assert differences(ours["parameters"], theirs["parameters"]) == []


# -- plan -------------------------------------------------------------------------------------------------------------


def test_plan_of_an_agent_that_knows_nothing() -> None:
    plan = new_agent().plan(observation(-1.0, 1.0))
    assert (plan.status, plan.path, plan.cost, plan.success_probability) == ("outside", (), float("inf"), 0.0)


def test_plan_tells_the_three_cases(trained: SkillGraphAgent) -> None:
    events = {event.id: event for event in trained.events}
    start = events["e0"].center
    for event in events.values():
        assert trained.plan(observation(*start), goal=event.center).status == "in_graph"
    grid = np.stack(np.meshgrid(np.linspace(-1.5, 1.5, 25), np.linspace(-1.5, 1.5, 25)), axis=-1).reshape(-1, 2)
    plans = [(point, trained.plan(observation(*start), goal=point)) for point in grid]
    for point, plan in plans:
        region = Event("goal", point, trained.event_radius)
        if any(region.contains(event.center[None])[0] for event in events.values()):
            assert plan.status == "in_graph"
        elif plan.status != "in_graph":
            can_start = any(o.mature and o.initiation.optimistic(point[None])[0] for o in trained.options)
            assert plan.status == ("in_initiation_set" if can_start else "outside")
    assert trained.plan(observation(*start), goal=np.array([50.0, 50.0])).status == "outside"
    assert "in_initiation_set" in {plan.status for _, plan in plans}


@pytest.mark.parametrize("retracing", [True, False])
def test_plan_is_a_path_of_the_graph(trained: SkillGraphAgent, monkeypatch: pytest.MonkeyPatch, retracing: bool) -> None:
    if not retracing:  # too dear, so that plans lead through the graph
        monkeypatch.setattr("sb3_skillgraph.planner.RETRACING", 1e9)
    edges = trained.graph.nx.edges
    lengths = []
    sources = [*(event.center for event in trained.events), *trained.visited.points[::20]]
    for source in sources:
        for target in trained.events:
            plan = trained.plan(observation(*source, goal=tuple(target.center)))
            pairs = list(zip(plan.path[:-1], plan.path[1:], strict=True))
            assert all(pair in edges for pair in pairs)
            if pairs:
                assert plan.cost == pytest.approx(sum(edges[pair]["weight"] for pair in pairs))
                assert plan.success_probability == pytest.approx(np.prod([edges[pair]["success_rate"] for pair in pairs]))
                first = trained.graph.nx.nodes[plan.path[0]]["item"]
                assert first.initiation.optimistic(np.asarray(source)[None])[0]
            lengths.append(len(pairs))
    assert max(lengths) >= (1 if retracing else 2)


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


def test_adapt_makes_the_goal_an_event_and_pursues_it(trained: SkillGraphAgent) -> None:
    points = trained.visited.points.astype(np.float64)
    goal = points[np.linalg.norm(points - trained.events[0].center, axis=1).argmax()]
    n_events, n_steps = len(trained.events), trained.num_timesteps
    pursued: list[np.ndarray] = []

    def note(*_: Any) -> bool:
        pursued.extend(mission.goal for mission in trained.curriculum.missions)
        return True

    trained.adapt(goal, total_timesteps=120, callback=note)
    assert trained.num_timesteps == n_steps + 120
    assert len(trained.events) in (n_events, n_events + 1)  # none is added where one is already
    event = min(trained.events, key=lambda event: float(np.linalg.norm(event.center - goal)))
    assert event.contains(goal[None])[0]
    if len(trained.events) > n_events:
        assert any(chain.target == event.id for chain in trained.chaining.chains.values())
    np.testing.assert_allclose(pursued[0], event.center)  # once there, the agent looks around
    trained.learn(60, reset_num_timesteps=False)
    assert trained.curriculum.pinned is None


def test_adapt_begins_every_episode_at_the_start(trained_files: Any) -> None:
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
    assert all(chain.source != chain.target for chain in agent.chaining.chains.values())
    start = np.array([[-1.0, 1.0]])  # of the maze
    assert any(np.linalg.norm(event.center - start) < 0.5 for event in agent.events)


def test_adapt_needs_an_environment(trained_files: Any) -> None:
    with pytest.raises((AssertionError, ValueError), match="set_env"):
        SkillGraphAgent.load(trained_files[0]).adapt(np.zeros(2))


def test_adapt_from_inside_a_wall(trained: SkillGraphAgent) -> None:
    trained.learn(10, reset_num_timesteps=False)  # Gymnasium's own checker does not survive a first reset that raises
    with pytest.raises(ValueError, match="free space"):
        trained.adapt(np.array([-1.0, -1.0]), start=np.array([0.0, 0.0]), total_timesteps=50)
    n_steps = trained.num_timesteps
    assert trained.learn(150, reset_num_timesteps=False).num_timesteps == n_steps + 150
