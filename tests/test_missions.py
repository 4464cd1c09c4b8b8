"""What the agent is about while it learns, and the steps of learning that follow from it."""

import copy
from typing import Any

import numpy as np
import pytest

from sb3_skillgraph.choice_model import ChoiceModel
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.learning import missions as missions_module
from sb3_skillgraph.learning.growth import Growth
from sb3_skillgraph.learning.missions import (
    EVENTS_PER_PROPOSAL,
    LEAST_PROPOSALS,
    MANY_EVENTS,
    MAX_FAILURES,
    MOST_TOWARDS,
    Mission,
    Missions,
)
from sb3_skillgraph.learning.rollout import HOLD, Rollout
from sb3_skillgraph.learning.salience import MARGIN, FrontierSalience, RandomSalience, box_around
from sb3_skillgraph.learning.witness import Witness
from sb3_skillgraph.memory.store import TransitionStore
from sb3_skillgraph.planning import Planner
from sb3_skillgraph.runner import Runner
from sb3_skillgraph.running import Run
from sb3_skillgraph.walk_model import WalkModel

EXPLORATION, BEYOND = 7, 3.0


class Proposes:
    """Proposes the same points again and again."""

    def __init__(self, *points: tuple[float, float]) -> None:
        self.points = list(points)
        self.n_proposals = 0

    def propose(self, rng: np.random.Generator) -> np.ndarray | None:
        self.n_proposals += 1
        return np.array(self.points[self.n_proposals % len(self.points)]) if self.points else None


def line_graph(n_events: int, spacing: float = 4.0) -> SkillGraph:
    graph = SkillGraph(2, 1.0, 100)
    for i in range(n_events):
        graph.add_event(np.array([spacing * i, 0.0]), salient=False)
    return graph


def make_missions(graph: SkillGraph, *proposals: tuple[float, float], seed: int = 0) -> Missions:
    missions = Missions(graph, Proposes(*proposals), EXPLORATION, BEYOND, np.random.default_rng(seed))
    missions.cut(1)
    return missions


def pursue(missions: Missions, mission: Mission) -> Mission:
    missions.current[0] = mission
    return mission


def run_to(goal: np.ndarray, success: bool) -> Run:
    return Run(0, "e0", "direct", "goal" if success else "e0", success, 9, goal)


HERE, THERE = np.zeros(2), np.array([8.0, 0.0])

# -- missions ---------------------------------------------------------------------------------------------------------


def test_a_mission_to_an_event_is_over_on_arrival() -> None:
    missions = make_missions(line_graph(3))
    pursue(missions, Mission(THERE))
    assert not missions.observe(0, HERE, None, False)
    assert not missions.observe(0, np.array([6.9, 0.0]), None, False)
    assert missions.observe(0, np.array([7.1, 0.0]), None, False)
    assert missions.current == [None]


def test_an_exploration_begins_on_arrival_and_takes_its_steps() -> None:
    missions = make_missions(line_graph(3))
    mission = pursue(missions, Mission(THERE, EXPLORATION))
    assert not missions.observe(0, HERE, None, False)
    assert missions.observe(0, THERE, run_to(THERE, True), False)  # it does something else now
    assert mission.exploring
    assert mission.random_walk
    over = [missions.observe(0, THERE + k, None, False) for k in range(EXPLORATION)]
    assert over == [False] * (EXPLORATION - 1) + [True]
    assert missions.current == [None]


def test_an_exploration_towards_a_point_is_no_random_walk() -> None:
    missions = make_missions(line_graph(3))
    mission = pursue(missions, Mission(THERE, EXPLORATION, beyond=np.array([11.0, 0.0])))
    missions.observe(0, THERE, None, False)
    assert mission.exploring
    assert not mission.random_walk


def test_an_exploration_goes_on_while_it_finds_something() -> None:
    missions = make_missions(line_graph(3))
    mission = pursue(missions, Mission(THERE, EXPLORATION))
    missions.discovered(0)
    assert mission.explore_steps == EXPLORATION  # nothing has begun yet
    missions.observe(0, THERE, None, False)
    for _ in range(3):
        for _ in range(EXPLORATION - 1):
            assert not missions.observe(0, THERE, None, False)
        missions.discovered(0)
    assert missions.current == [mission]
    missions.current[0] = None
    missions.discovered(0)  # nobody explores


def test_who_cannot_travel_explores_where_it_is() -> None:
    missions = make_missions(line_graph(3))
    mission = pursue(missions, Mission(THERE, beyond=np.array([11.0, 0.0])))
    for _ in range(MAX_FAILURES - 1):
        assert not missions.observe(0, HERE, run_to(THERE, False), False)
    assert not missions.observe(0, HERE, run_to(THERE, True), False)  # successes on the way do not count
    assert missions.observe(0, HERE, run_to(THERE, False), False)
    assert mission.random_walk
    assert mission.explore_steps == EXPLORATION
    over = [missions.observe(0, HERE, None, False) for _ in range(EXPLORATION)]
    assert over == [False] * (EXPLORATION - 1) + [True]


def test_who_arrives_with_the_last_failure_has_arrived() -> None:
    missions = make_missions(line_graph(3))
    pursue(missions, Mission(THERE, n_failures=MAX_FAILURES - 1))
    assert missions.observe(0, THERE, run_to(THERE, False), False)
    assert missions.current == [None]


@pytest.mark.parametrize("exploring", [False, True])
def test_a_mission_ends_with_its_episode(exploring: bool) -> None:
    missions = make_missions(line_graph(3))
    pursue(missions, Mission(THERE, EXPLORATION, exploring=exploring))
    assert missions.observe(0, HERE, None, True)
    assert missions.current == [None]


def test_a_mission_lasts_until_it_is_over() -> None:
    missions = make_missions(line_graph(3), (5.0, 5.0))
    mission = missions.of(0, HERE, False)
    assert missions.of(0, THERE, False) is mission
    assert missions.of(0, THERE, True) is mission
    missions.observe(0, HERE, None, True)
    assert missions.of(0, HERE, False) is not mission


def test_warming_up_is_walking_at_random_whatever_there_is_to_do() -> None:
    missions = make_missions(line_graph(3), (5.0, 5.0))
    missions.pinned = THERE
    for _ in range(20):
        mission = missions.of(0, HERE, True)
        assert mission.random_walk
        assert not mission.clean
        assert mission.explore_steps == EXPLORATION
        missions.current[0] = None
    assert missions.salience.n_proposals == 0  # type: ignore[attr-defined]


def drawn(missions: Missions, n: int, point: np.ndarray = HERE) -> list[Mission]:
    found = []
    for _ in range(n):
        found.append(missions.of(0, point, False))
        missions.current[0] = None
    return found


def test_missions_explore_from_the_event_nearest_to_a_proposal_towards_it_or_at_random() -> None:
    graph = line_graph(4)
    found = drawn(make_missions(graph, (9.0, 2.0)), 300)
    explorations = [mission for mission in found if mission.explore_steps]
    travels = [mission for mission in found if not mission.explore_steps]
    assert 0.8 < len(explorations) / len(found) < 0.97
    assert {tuple(mission.goal) for mission in explorations} == {(8.0, 0.0)}
    assert {tuple(mission.goal) for mission in travels} == {tuple(center) for center in graph.centers}
    towards = [mission.beyond for mission in explorations if mission.beyond is not None]
    assert 0.35 < len(towards) / len(explorations) < 0.65
    way = np.array([1.0, 2.0])
    for beyond in towards:
        np.testing.assert_allclose(beyond, np.array([9.0, 2.0]) + BEYOND * way / np.linalg.norm(way))
    assert not any(mission.exploring for mission in found)
    assert 0.3 < np.mean([mission.clean for mission in found]) < 0.7


def test_in_a_large_graph_explorations_are_chosen_among_more_proposals_and_walk_at_random_less() -> None:
    graph = line_graph(100)
    missions = make_missions(graph, *((4.0 * i, 2.0) for i in range(100)))
    explorations = [mission for mission in drawn(missions, 400) if mission.explore_steps]
    n = len(graph.events) // EVENTS_PER_PROPOSAL
    assert n > LEAST_PROPOSALS
    assert missions.salience.n_proposals == n * len(explorations)  # type: ignore[attr-defined]
    towards = [mission for mission in explorations if mission.beyond is not None]
    assert len(towards) / len(explorations) == pytest.approx(MOST_TOWARDS, abs=0.07)


def test_of_several_proposals_the_one_that_was_visited_least_is_taken() -> None:
    graph = line_graph(4)
    graph.visits[:4] = [9.0, 5.0, 7.0, 1.0]
    found = drawn(make_missions(graph, (0.0, 1.0), (4.0, 1.0), (8.0, 1.0)), 100)
    assert {tuple(mission.goal) for mission in found if mission.explore_steps} == {(4.0, 0.0)}


def departures(n_events: int) -> tuple[Missions, list[int]]:
    """Where explorations begin of a point beside the first event, one after another, of which none finds anything."""
    missions = make_missions(line_graph(n_events), (0.0, 3.0))
    events = []
    for _ in range(20):
        missions.cut(1)
        mission = next(mission for mission in drawn(missions, 100) if mission.explore_steps)
        events.append(missions.graph.index(mission.begins_in))
        missions.current[0] = mission
        missions.observe(0, mission.goal, None, False)  # it arrives
        assert mission.exploring
    return missions, events


def test_in_a_large_graph_explorations_that_keep_finding_nothing_begin_further_away() -> None:
    """What lies beyond a wall is explored from its other side in the end, and from where something was found again."""
    missions, events = departures(2 * MANY_EVENTS)
    assert events[0] == 0
    assert set(events) == {0, 1, 2}
    assert events.count(0) > events.count(1) > events.count(2)
    missions.discovered(0)
    assert missions.graph.barren[events[-1]] == 0.0


def test_in_a_small_graph_explorations_begin_in_the_nearest_event() -> None:
    assert set(departures(MANY_EVENTS)[1]) == {0}


def test_without_proposals_the_agent_walks_at_random(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(missions_module, "EXPLORE", 1.0)
    assert all(mission.random_walk and not mission.clean for mission in drawn(make_missions(line_graph(2)), 20))


def test_a_goal_where_one_has_been_is_pursued_and_nothing_else() -> None:
    missions = make_missions(line_graph(3), (5.0, 5.0))
    missions.pinned = np.array([8.5, 0.5])
    for mission in drawn(missions, 40):
        assert mission.goal.tolist() == [8.5, 0.5]
        assert mission.explore_steps == 0
    assert missions.salience.n_proposals == 0  # type: ignore[attr-defined]


def test_a_way_is_looked_for_to_a_goal_where_nobody_has_been() -> None:
    missions = make_missions(line_graph(3))
    missions.pinned = np.array([12.0, 3.0])
    found = drawn(missions, 200)
    looking = [mission for mission in found if mission.goal.tolist() != [12.0, 3.0]]
    assert 130 < len(looking) < 185
    assert all(mission.explore_steps == EXPLORATION for mission in looking)
    assert {mission.beyond is None for mission in looking} == {True, False}
    # Some set out from the event that is nearest, and some from elsewhere: the way may begin there.
    nearest = [mission for mission in looking if mission.goal.tolist() == [8.0, 0.0]]
    assert 0.2 < len(nearest) / len(looking) < 0.8
    assert {tuple(mission.goal) for mission in looking} == {tuple(center) for center in missions.graph.centers}


def test_who_has_reached_the_goal_that_is_adapted_to_goes_elsewhere_to_come_back() -> None:
    missions = make_missions(line_graph(3))
    missions.pinned = HERE.astype(np.float64)
    goals = {tuple(mission.goal) for mission in drawn(missions, 50)}
    assert goals == {tuple(center) for center in missions.graph.centers}


@pytest.mark.parametrize("arrived", [True, False])
def test_who_has_explored_as_far_as_a_point_or_a_wall_goes_on_towards_another(arrived: bool) -> None:
    missions = make_missions(line_graph(3), (9.0, 2.0), (0.0, 5.0))
    mission = pursue(missions, Mission(HERE, explore_steps=EXPLORATION, beyond=THERE, exploring=True))
    assert not missions.observe(0, HERE, None, False)
    np.testing.assert_array_equal(mission.beyond, THERE)
    assert not missions.observe(0, HERE, run_to(THERE, arrived), False)
    np.testing.assert_allclose(mission.beyond, [0.0, 5.0 + BEYOND])
    assert (mission.exploring, mission.explore_steps, mission.n_failures) == (True, EXPLORATION - 2, 0)


def test_a_random_walk_stays_one_when_its_option_ends() -> None:
    missions = make_missions(line_graph(3), (9.0, 2.0))
    mission = pursue(missions, Mission(HERE, explore_steps=EXPLORATION, exploring=True))
    missions.observe(0, HERE, run_to(HERE, True), False)
    assert mission.random_walk


def test_restored_missions_go_on() -> None:
    missions = make_missions(line_graph(3), (9.0, 2.0))
    missions.pinned = np.array([12.0, 3.0])
    missions.of(0, HERE, False)
    restored = make_missions(line_graph(3), (9.0, 2.0))
    restored.set_state(copy.deepcopy(missions.get_state()))
    np.testing.assert_equal(restored.get_state(), missions.get_state())
    for both in (missions, restored):
        both.observe(0, HERE, run_to(THERE, False), False)
    np.testing.assert_equal(restored.get_state(), missions.get_state())


# -- salience ---------------------------------------------------------------------------------------------------------


def test_the_frontier_lies_in_the_box_around_what_was_visited_and_a_little_beyond() -> None:
    graph, rng = line_graph(3), np.random.default_rng(0)
    salience = FrontierSalience(graph)
    points = np.array([salience.propose(rng) for _ in range(500)])
    lower, upper = box_around(graph.centers, graph.metric)
    assert lower.tolist() == [-MARGIN, -MARGIN]
    assert upper.tolist() == [8.0 + MARGIN, MARGIN]
    assert ((points >= lower) & (points <= upper)).all()
    np.testing.assert_allclose(points.min(axis=0), lower, atol=0.2)
    np.testing.assert_allclose(points.max(axis=0), upper, atol=0.2)


def test_there_is_no_frontier_before_anything_was_visited() -> None:
    assert FrontierSalience(SkillGraph(2, 1.0, 10)).propose(np.random.default_rng(0)) is None


def test_an_oracle_proposes_what_it_draws() -> None:
    salience = RandomSalience(lambda rng: rng.uniform(3.0, 4.0, 2).astype(np.float32))
    point = salience.propose(np.random.default_rng(0))
    assert point is not None
    assert point.dtype == np.float64
    assert ((point >= 3.0) & (point < 4.0)).all()


# -- the steps of learning --------------------------------------------------------------------------------------------

STEP, NOISE = 0.5, 0.1


class Straight:
    """A policy that goes straight to its aim; what it sees is the way there."""

    def act(self, views: np.ndarray) -> np.ndarray:
        return np.clip(views, -1.0, 1.0)


class Learning:
    """Points that move in the plane as a rollout says; ``y`` tells the environments apart."""

    def __init__(self, n_envs: int = 1, *proposals: tuple[float, float], seed: int = 0, random_actions: float = 0.0) -> None:
        self.rng = np.random.default_rng(seed)
        graph, model = SkillGraph(2, 1.0, 100), WalkModel()
        planner = Planner(graph, model, 1_000)
        runner = Runner(graph, planner, Straight(), lambda observation, points, aims: (aims - points) / STEP)  # type: ignore[arg-type]
        missions = Missions(graph, Proposes(*proposals), EXPLORATION, BEYOND, self.rng)
        witness = Witness(graph, ChoiceModel(graph, model), n_envs, Growth("never", graph, {}))  # type: ignore[arg-type]
        self.store = TransitionStore(10_000, 2, 2, 2, n_envs)
        self.rollout = Rollout(runner, missions, witness, self.store, noise_std=NOISE, rng=self.rng)
        self.rollout.random_action_prob = random_actions
        self.graph, self.missions = graph, missions
        self.points = np.array([[0.0, 40.0 * i] for i in range(n_envs)])
        self.rollout.begin_anew(self.points)
        self.actions: list[np.ndarray] = []

    def seen(self) -> dict[str, np.ndarray]:
        return {"observation": self.points, "achieved_goal": self.points}

    def step(self, *, warm_up: bool = False, done: bool = False, stuck: bool = False) -> None:
        action = self.rollout.act(self.seen(), warm_up, None)
        self.actions.append(action)
        self.points = self.points + STEP * action
        n = len(self.points)
        self.rollout.observe(self.seen(), np.zeros(n, dtype=bool), np.full(n, done), np.full(n, stuck))
        if done:
            for i, point in enumerate(self.points):
                self.rollout.witness.begin(i, point)


def test_every_step_is_stored_once_and_in_order() -> None:
    learning = Learning(2, (6.0, 1.0))
    points, reached = [], []
    for k in range(60):
        points.append(learning.points)
        learning.step(done=k % 20 == 19)
        reached.append(learning.points)
    assert len(learning.store) == learning.store.total == 120
    stored = {name: learning.store.column(name, np.arange(120)) for name in ("achieved_goal", "next_achieved_goal", "action")}
    np.testing.assert_allclose(stored["achieved_goal"], np.concatenate(points), atol=1e-5)
    np.testing.assert_allclose(stored["next_achieved_goal"], np.concatenate(reached), atol=1e-5)
    np.testing.assert_allclose(stored["action"], np.concatenate(learning.actions), atol=1e-6)


def test_nothing_is_learned_from_a_step_that_was_not_taken() -> None:
    learning = Learning(1, (6.0, 1.0))
    learning.step()
    state = copy.deepcopy({**learning.rollout.get_state(), "missions": None})
    graph = copy.deepcopy(learning.graph.get_state())
    learning.rollout.act(learning.seen(), False, None)
    np.testing.assert_equal({**learning.rollout.get_state(), "missions": None}, state)
    np.testing.assert_equal(learning.graph.get_state(), graph)
    assert learning.store.total == 1
    assert learning.rollout.pending is not None


def test_a_clean_mission_acts_as_the_policy_does_and_others_with_noise() -> None:
    for clean in (True, False):
        learning = Learning(1, random_actions=0.0)
        differences = []
        for _ in range(60):
            learning.missions.current[0] = Mission(np.array([50.0, 1.0]), clean=clean)
            learning.step()
            step = learning.store.total - 1
            aim, point = (learning.store.column(name, np.array([step]))[0] for name in ("goal", "achieved_goal"))
            differences.append(learning.actions[-1][0] - np.clip((aim - point) / STEP, -1.0, 1.0))
        spread = float(np.std(differences))
        assert spread == pytest.approx(0.0, abs=1e-6) if clean else 0.3 * NOISE < spread < 1.2 * NOISE


def test_random_actions_are_held_for_some_steps() -> None:
    learning = Learning()
    for _ in range(400):
        learning.step(warm_up=True)
    actions = np.concatenate(learning.actions)
    changes = 1 + np.count_nonzero(np.any(actions[1:] != actions[:-1], axis=1))
    assert 0.5 < 400 / changes / HOLD < 2.0
    assert actions.min() < -0.8
    assert actions.max() > 0.8


def test_the_given_noise_is_added() -> None:
    class Constant:
        def __call__(self) -> np.ndarray:
            return np.array([[-0.25, 0.5]])

    learning = Learning()
    learning.missions.current[0] = Mission(np.array([50.0, 0.0]))
    scaled = learning.rollout.act(learning.seen(), False, Constant())  # type: ignore[arg-type]
    np.testing.assert_allclose(scaled, [[0.75, 0.5]])


def test_explorations_make_landmarks_and_edges() -> None:
    learning = Learning(2, (6.0, 1.0), (-6.0, -1.0))
    for k in range(400):
        learning.step(done=k % 50 == 49)
    graph = learning.graph
    assert len(graph.events) > 4
    assert graph.edges.size > 4
    assert (graph.edges.forward + graph.edges.backward > 0).all()
    # 40 steps lead 20 units away, and an event's points lie within 1.5 of its centre.
    far = np.abs(graph.centers[graph.edges.source, 1] - graph.centers[graph.edges.target, 1]) > 20.0 + 2 * 1.5
    assert not far.any()  # environments, and episodes, are apart


def test_only_runs_without_noise_are_recorded() -> None:
    runs = {}
    for clean in (False, True):
        learning = Learning(1, (6.0, 1.0))
        for x in np.arange(0.0, 20.0, 0.5):  # somebody shows the way
            learning.rollout.witness.step(0, np.array([x, 0.0]))
        learning.rollout.witness.begin(0, learning.points[0])
        for _ in range(200):
            if learning.missions.current[0] is None:
                learning.missions.current[0] = Mission(learning.graph.centers[learning.rng.integers(5)].copy(), clean=clean)
            learning.step()
        edges = learning.graph.edges
        runs[clean] = float((edges.successes + edges.failures).sum()) + learning.rollout.witness._n_samples
    assert runs[False] == 0.0
    assert runs[True] > 5.0


def test_no_landmark_lies_where_agents_get_stuck() -> None:
    learning = Learning()
    learning.missions.current[0] = Mission(np.array([50.0, 0.0]), clean=True)
    for _ in range(2):
        learning.step()
    learning.points = np.array([[9.0, 0.0]])
    learning.step(stuck=True)
    assert learning.rollout.n_stuck == 1
    assert len(learning.graph.events) == 1
    learning.step()
    assert len(learning.graph.events) == 2


def test_a_proposed_point_that_is_reached_becomes_a_salient_event() -> None:
    learning = Learning()
    # It is reached a step before the next landmark would lie there.
    mission = Mission(np.zeros(2), 60, np.array([2.4, 0.0]), clean=True)
    learning.missions.current[0] = mission
    for _ in range(12):
        learning.step()
        if learning.missions.current[0] is not mission:
            break
    salient = [event for event in learning.graph.events if event.salient]
    assert len(salient) == 1
    assert np.linalg.norm(salient[0].center - [2.4, 0.0]) <= 1.0


def test_a_new_mission_forgets_what_happened_on_the_last() -> None:
    learning = Learning()
    learning.missions.current[0] = Mission(np.array([50.0, 0.0]), clean=True)
    for _ in range(3):
        learning.step()
    assert learning.rollout.state.elapsed[0] == 3
    learning.missions.current[0] = Mission(learning.points[0] + [0.2, 0.0], clean=True)
    learning.step()
    state = learning.rollout.state
    assert (state.elapsed[0], state.option[0], state.run_count.sum()) == (4, "", 0)
    assert state.pace.any()  # but not how it moves: the episode goes on
    learning.missions.current[0] = Mission(np.array([50.0, 0.0]), clean=True)
    learning.step(done=True)
    assert (learning.rollout.state.elapsed[0], learning.rollout.state.pace.any()) == (0, False)


@pytest.mark.parametrize("same_envs", [True, False])
def test_a_restored_rollout_goes_on_where_it_was_or_begins_anew(same_envs: bool) -> None:
    learning, other = (Learning(2, (6.0, 1.0), random_actions=0.5) for _ in range(2))
    for _ in range(37):
        learning.step()
    saved: dict[str, Any] = copy.deepcopy(learning.rollout.get_state())
    other.graph.set_state(copy.deepcopy(learning.graph.get_state()))
    other.rollout.set_state(saved, same_envs)
    if not same_envs:
        assert other.rollout.state.elapsed.tolist() == [0.0, 0.0]
        assert other.missions.current == [None, None]
        return
    other.rng.bit_generator.state = learning.rng.bit_generator.state
    other.missions.salience.n_proposals = learning.missions.salience.n_proposals  # type: ignore[attr-defined]
    other.points = learning.points
    for _ in range(40):
        learning.step()
        other.step()
        np.testing.assert_array_equal(learning.actions[-1], other.actions[-1])
    np.testing.assert_equal(other.graph.get_state(), learning.graph.get_state())
    np.testing.assert_equal(other.rollout.get_state(), learning.rollout.get_state())
