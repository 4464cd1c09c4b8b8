"""``PAPER``: the paper as written, section by section; the names of the tests tell which."""

import copy
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from builders import disc, make_option
from conftest import TOY, differences, new_agent, new_vec_env, state_of, without_clock
from matplotlib import pyplot

from sb3_skillgraph import PAPER, PaperRules, SkillGraphAgent
from sb3_skillgraph.edges import NOWHERE
from sb3_skillgraph.events import Event
from sb3_skillgraph.experiments.training import train
from sb3_skillgraph.hyperparams import check_hyperparams
from sb3_skillgraph.learning.missions import Mission
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.paper.chaining import DeepSkillChaining, SkillChain
from sb3_skillgraph.paper.graph import PaperGraph
from sb3_skillgraph.paper.missions import PaperMissions
from sb3_skillgraph.paper.policy import PaperPolicy
from sb3_skillgraph.planning import DIRECT, GOAL, Planner
from sb3_skillgraph.plotting import event_links, plot_skill_graph
from sb3_skillgraph.running import RunnerState
from sb3_skillgraph.walk_model import WalkModel

RADIUS = 0.5
NEAR = np.array([0.1, 0.0])


def new_graph(*centers: tuple[float, float]) -> PaperGraph:
    graph = PaperGraph(2, RADIUS)
    for center in centers:
        graph.add_event(np.array(center))
    return graph


def new_option(
    graph: PaperGraph,
    id: str,
    target: str,
    start: tuple[tuple[float, float], float],
    *,
    parent: Option | None = None,
    effects: tuple[tuple[float, float], ...] = (),
    n_failures: int = 0,
) -> Option:
    """An option of the graph, with as many successful runs as effects."""
    termination = parent or graph.events[graph.index(target)]
    option = make_option(id, target, termination, start=start)
    option.effects.extend(np.array(effect) for effect in effects)
    option.n_successes, option.n_runs, option.n_steps = len(effects), len(effects) + n_failures, 10 * len(effects)
    graph.add_option(option)
    graph.refresh(option, refitted=True)
    return option


class Points:
    """A salience that proposes given points, one after the other."""

    def __init__(self, *points: tuple[float, float]) -> None:
        self.points = list(points)

    def propose(self, rng: np.random.Generator) -> np.ndarray | None:
        return np.array(self.points.pop(0)) if self.points else None


def new_chaining(graph: PaperGraph, gestation_period: int = 3) -> DeepSkillChaining:
    return DeepSkillChaining(graph, lambda id, target, termination: make_option(id, target, termination), gestation_period)


def new_missions(graph: PaperGraph, *points: tuple[float, float], **rules: Any) -> PaperMissions:
    missions = PaperMissions(graph, new_chaining(graph), Points(*points), PaperRules(**rules), 20, np.random.default_rng(0))
    missions.cut(1)
    return missions


def state() -> RunnerState:
    return RunnerState.fresh(1, 2, 2)


def run_along(chaining: DeepSkillChaining, option: Option, xs: list[float], end: float) -> None:
    """Let an option succeed: on its way along the x-axis it passed some places."""
    option.succeeded(np.array([[x, 0.0] for x in xs]), np.array([end, 0.0]), len(xs))
    chaining.learned(option)


# -- Table 1 ----------------------------------------------------------------------------------------------------------


def test_table_1_and_a_6_numbers() -> None:
    agent = new_agent(**{**PAPER, "learning_starts": 10})
    assert (agent.batch_size, agent.gamma, agent.tau) == (64, 0.99, 0.01)
    assert agent.buffer_size == 1_000_000
    missions = agent.parts.missions
    missions.salience = Points((1.0, -1.0))
    agent.learn(60)
    option = agent.options[0]
    assert isinstance(option, Option)
    layers = [module.out_features for module in option.learner.policy.actor.modules() if hasattr(module, "out_features")]
    assert layers == [400, 300, 2]
    for network, rate in ((option.learner.policy.actor, 1e-4), (option.learner.policy.critic, 1e-3)):
        assert {group["lr"] for group in network.optimizer.param_groups} == {rate}  # type: ignore[union-attr]
    assert (missions.rules.salient_event_freq, missions.rules.retry_after) == (30, 10)
    assert agent.parts.policy.timeout == 200


@pytest.mark.parametrize("name", ["salient_event_freq", "retry_after", "gestation_period", "timeout"])
@pytest.mark.parametrize("value", [0, 1.5, True, "3"])
def test_rules_that_are_no_numbers_are_refused(name: str, value: Any) -> None:
    with pytest.raises(ValueError, match=f"{name} must be a whole number"):
        PaperRules(**{name: value})


# -- 3.1 and 3.2.6: the graph -----------------------------------------------------------------------------------------


def test_3_2_6_an_option_leads_to_another_while_all_its_effects_lie_in_that_ones_initiation_set() -> None:
    graph = new_graph((0.0, 0.0), (5.0, 0.0))
    first = new_option(graph, "o0", "e0", ((-3.0, 0.0), 1.0), effects=((0.0, 0.0), (0.1, 0.0)))
    second = new_option(graph, "o1", "e1", ((0.0, 0.0), 1.0))
    assert graph.nx.has_edge("o0", "o1")
    first.succeeded(np.array([[-3.0, 0.0]]), np.array([0.0, 0.2]), 5)
    graph.refresh(first, refitted=False)
    assert graph.nx.has_edge("o0", "o1")
    first.succeeded(np.array([[-3.0, 0.0]]), np.array([0.4, 1.5]), 5)  # one effect outside is enough
    graph.refresh(first, refitted=False)
    assert not graph.nx.has_edge("o0", "o1")
    second.initiation.optimistic_boundaries = [disc((0.0, 0.0), 3.0)]  # and back, when the set has grown
    graph.refresh(second, refitted=True)
    assert graph.nx.has_edge("o0", "o1")


def test_3_2_6_an_option_leads_to_an_event_that_holds_all_its_effects() -> None:
    graph = new_graph((0.0, 0.0), (0.3, 0.0))
    option = new_option(graph, "o0", "e0", ((-3.0, 0.0), 1.0), effects=((0.0, 0.0),))
    assert graph.nx.has_edge("o0", "e0")
    assert graph.nx.has_edge("o0", "e1")
    option.succeeded(np.array([[-3.0, 0.0]]), np.array([-0.4, 0.0]), 5)
    graph.refresh(option, refitted=False)
    assert graph.nx.has_edge("o0", "e0")
    assert not graph.nx.has_edge("o0", "e1")


def test_3_2_6_an_event_leads_to_an_option_that_can_start_wherever_it_was_triggered() -> None:
    graph = new_graph((0.0, 0.0), (5.0, 0.0))
    new_option(graph, "o0", "e1", ((0.0, 0.0), 0.3))
    assert graph.nx.has_edge("e0", "o0")
    graph.triggered("e0", np.array([0.4, 0.0]))
    new_option(graph, "o1", "e1", ((0.0, 0.0), 0.3))
    assert not graph.nx.has_edge("e0", "o1")
    assert graph.nx.has_edge("e0", "o0"), "what was complete stays so"
    new_option(graph, "o2", "e0", ((0.0, 0.0), 3.0))
    assert not graph.nx.has_edge("e0", "o2"), "an option does not start where it ends"
    assert sorted(rebuilt(graph).nx.edges) == sorted(graph.nx.edges)


def test_a_2_weights() -> None:
    graph = new_graph((0.0, 0.0), (5.0, 0.0))
    option = new_option(graph, "o0", "e1", ((0.0, 0.0), 1.0), effects=((5.0, 0.0),) * 3, n_failures=1)
    assert graph.nx.edges["e0", "o0"]["weight"] == 0.0
    assert graph.nx.edges["o0", "e1"] == {"weight": pytest.approx(4 / 3), "success_rate": 0.75}
    option.failed(np.zeros(2), 200)
    graph.refresh(option, refitted=False)
    assert graph.nx.edges["o0", "e1"]["weight"] == pytest.approx(5 / 3)


def test_an_option_that_never_succeeded_leads_nowhere() -> None:
    graph = new_graph((0.0, 0.0), (5.0, 0.0))
    new_option(graph, "o0", "e1", ((0.0, 0.0), 1.0), n_failures=3)
    assert list(graph.nx.successors("o0")) == []


# -- 3.2.1, A.1: salient events ---------------------------------------------------------------------------------------


def test_a_1_1_redundant_events_are_rejected() -> None:
    graph = new_graph((0.0, 0.0), (5.0, 0.0))
    new_option(graph, "o0", "e1", ((2.0, 0.0), 1.0))
    missions = new_missions(graph)
    assert missions.is_redundant(np.array([0.4, 0.0])), "it lies in an event"
    assert missions.is_redundant(np.array([2.5, 0.0])), "an option can start there"
    assert not missions.is_redundant(np.array([0.6, 0.0]))


def test_a_1_2_when_new_events_are_looked_for() -> None:
    # At once, in pairs; then not before the last one is in the graph or K episodes have passed.
    graph = new_graph((0.0, 0.0))
    missions = new_missions(graph, (3.0, 0.0), (-3.0, 0.0), (0.0, 3.0), (0.0, -3.0), salient_event_freq=30, retry_after=10)
    missions.prepare()
    assert len(graph.events) == 3
    missions.n_episodes = 29
    missions.prepare()
    assert len(graph.events) == 3
    missions.n_episodes = 30
    missions.prepare()
    assert len(graph.events) == 5
    assert missions.newest == "e4"
    # The newest is in the graph: again at once. Both are rejected: not before R episodes have passed.
    new_option(graph, "o9", "e4", ((0.0, 0.0), 0.4), effects=((0.0, -3.0),))
    assert "e4" in graph.joined()
    missions.salience = Points((3.1, 0.0), (-3.1, 0.0), (6.0, 0.0))  # type: ignore[assignment]
    missions.prepare()
    assert (len(graph.events), missions.last_rejected) == (5, 30)
    missions.n_episodes = 39
    missions.prepare()
    assert len(graph.events) == 5
    missions.n_episodes = 40
    missions.prepare()
    assert (len(graph.events), missions.last_rejected) == (6, None)


# -- 3.2.2 to 3.2.5: targets, the nearest vertex, planning, chaining --------------------------------------------------


def test_3_2_2_every_event_is_as_likely_a_target() -> None:
    graph = new_graph((0.0, 0.0), (3.0, 0.0), (0.0, 3.0), (3.0, 3.0))
    missions = new_missions(graph)
    for event in graph.events[1:]:
        missions.chaining.open_chain(graph.events[0], event)
    targets = [tuple(missions._choose(np.zeros(2)).goal) for _ in range(300)]
    counts = [targets.count(tuple(event.center)) for event in graph.events]
    assert counts[0] == 0, "the agent stands in it"
    assert min(counts[1:]) > 75
    targets = [tuple(missions._choose(np.array([9.0, 9.0])).goal) for _ in range(50)]
    assert tuple(graph.events[0].center) not in targets, "no chain leads back to the start yet"


def test_3_2_2_a_reached_target_is_followed_by_another() -> None:
    missions = new_missions(new_graph((0.0, 0.0), (3.0, 0.0)))
    missions.current = [Mission(np.array([3.0, 0.0]))]
    assert not missions.observe(0, np.array([2.0, 0.0]), None, False)
    assert missions.observe(0, np.array([2.6, 0.0]), None, False)
    assert missions.current == [None]


def test_3_2_3_a_new_event_is_joined_from_the_nearest_event_of_the_graph() -> None:
    graph = new_graph((0.0, 0.0), (3.0, 0.0), (4.0, 0.0))
    new_option(graph, "o0", "e1", ((0.0, 0.0), 0.4), effects=((3.0, 0.0),))  # e2, nearer, is not in the graph
    missions = new_missions(graph, (5.0, 0.0))
    missions._attempt()
    assert [(chain.source, chain.target) for chain in missions.chaining.chains] == [("e1", "e3")]


def line() -> tuple[PaperGraph, DeepSkillChaining, PaperPolicy]:
    """Events at 0, 3 and 6 on the x-axis, and options from each to the next, but for a bad one from 0 to 3."""
    graph = new_graph((0.0, 0.0), (3.0, 0.0), (6.0, 0.0), (9.0, 0.0))
    chaining = new_chaining(graph)
    for id, target, start, end, n_failures in (
        ("o0", "e1", 0.0, 3.0, 9),
        ("o1", "e1", 0.0, 3.0, 0),
        ("o2", "e2", 3.0, 6.0, 0),
    ):
        chaining.options[id] = new_option(
            graph, id, target, ((start, 0.0), 0.6), effects=((end, 0.0),) * 3, n_failures=n_failures
        )
    return graph, chaining, PaperPolicy(graph, chaining, 200, Planner(graph, WalkModel(), 1_000))


def test_3_2_4_the_first_option_of_the_cheapest_path_runs() -> None:
    graph, _, policy = line()
    goal = graph.events[2].center
    graph.triggered("e2", goal)
    chosen = policy.choose(state(), 0, NEAR, goal, 0.0)
    assert (chosen.option, chosen.event, chosen.timeout) == ("o1", "e0", 200)
    np.testing.assert_array_equal(chosen.aim, graph.events[1].center)
    plan = policy.plan(state(), NEAR, goal)
    assert plan.path in (("o1", "e1", "o2", "e2", GOAL), ("o1", "o2", "e2", GOAL))
    assert (plan.status, plan.success_probability, plan.expected_steps) == ("in_graph", 1.0, 20.0)
    assert policy.choose(state(), 0, np.array([3.2, 0.0]), goal, 0.0).option == "o2", "planned anew where it has landed"


def test_3_2_5_from_the_nearest_vertex_the_chain_of_the_target_goes_on() -> None:
    graph, chaining, policy = line()
    target = graph.events[3]
    chain = chaining.open_chain(graph.events[2], target)
    goal = target.center
    assert policy.choose(state(), 0, NEAR, goal, 0.0).option == "o1", "first over the graph to the nearest vertex"
    assert policy.plan(state(), NEAR, goal).path[-1] == "e2"
    at_nearest = policy.choose(state(), 0, np.array([6.0, 0.1]), goal, 0.0)
    assert (at_nearest.option, at_nearest.event) == (chain.options[0], "e2")
    left = state().copy()
    left.run_event[0, 0], left.run_option[0, 0] = "e2", chain.options[0]
    assert policy.choose(left, 0, NEAR, goal, 0.0).option == chain.options[0], "it does not go back into the graph"
    assert policy.plan(left, NEAR, goal).path == ()


def test_3_2_5_chains_grow_backwards_until_an_option_starts_at_the_source() -> None:
    graph = new_graph((0.0, 0.0), (6.0, 0.0))
    chaining = new_chaining(graph)
    chain = chaining.open_chain(*graph.events)
    root = chaining.options[chain.options[0]]
    assert chaining.admissible(chain, np.zeros(2)) is root, "a gestating option may start anywhere"
    for n in range(3):
        assert not root.mature
        assert len(chain.options) == 1
        run_along(chaining, root, [3.0 + 0.1 * n, 4.0, 5.0], 6.0)
    assert root.mature
    assert "o0" in graph.options
    child = chaining.options[chain.options[1]]
    assert (child.target, child.termination) == ("o0", root)
    assert chaining.admissible(chain, np.zeros(2)) is child
    assert chaining.admissible(chain, np.array([4.0, 0.0])) is root, "the earliest one that can start"
    core = root.initiation.core
    assert core is not None
    assert child.terminates(core)
    assert root.initiation.optimistic(core[None])[0], "a child ends where its parent can start"
    np.testing.assert_array_equal(child.subgoal, core)
    for n in range(3):
        run_along(chaining, child, [0.1 * n, -0.3, 0.3, 1.0, 2.0], float(core[0]))
    assert graph.nx.has_edge("e0", child.id)
    assert graph.nx.has_edge(child.id, "o0")
    assert chain.complete
    assert len(chain.options) == 2
    assert graph.joined() == {"e0", "e1"}
    graph.triggered("e0", np.array([0.0, 0.49]))
    for _ in range(9):
        child.failed(np.array([0.2, 0.0]), 200)
        chaining.learned(child)
    assert chain.complete
    assert len(chain.options) == 2


def test_3_2_5_a_chain_is_complete_where_any_event_of_the_graph_can_start_it() -> None:
    graph = new_graph((0.0, 0.0), (3.0, 0.0), (6.0, 0.0))
    new_option(graph, "x0", "e1", ((0.0, 0.0), 0.4), effects=((3.0, 0.0),))
    chaining = new_chaining(graph)
    chain = chaining.open_chain(graph.events[0], graph.events[2])
    root = chaining.options[chain.options[0]]
    for n in range(3):
        run_along(chaining, root, [2.7 + 0.1 * n, 3.3, 4.0, 5.0], 6.0)
    assert graph.nx.has_edge("e1", root.id)
    assert chain.complete
    assert len(chain.options) == 1
    back = chaining.open_chain(graph.events[2], graph.events[0], back=True)
    assert not back.complete


def test_failures_shrink_where_an_option_starts() -> None:
    graph = new_graph((0.0, 0.0), (6.0, 0.0))
    chaining = new_chaining(graph)
    root = chaining.options[chaining.open_chain(*graph.events).options[0]]
    for _ in range(3):
        run_along(chaining, root, [1.0, 2.0, 3.0, 4.0, 5.0], 6.0)
    assert root.initiation.optimistic(np.array([[1.0, 0.0]]))[0]
    for _ in range(8):
        root.failed(np.array([1.0, 0.0]), 200)
        chaining.learned(root)
    assert not root.initiation.optimistic(np.array([[1.0, 0.0]]))[0]
    assert root.success_rate == pytest.approx(3 / 11)
    assert repr(root) == "<option o0 to e1: 3 of 11 runs succeeded>"
    before = len(root.initiation.failures)
    root.failed(None, 5)  # stuck: where it began is not to blame
    chaining.learned(root)
    assert len(root.initiation.failures) == before
    assert root.n_runs == 12


# -- 3.2.7, A.3: backward options -------------------------------------------------------------------------------------


def test_a_3_the_way_back_is_learned_once_the_way_there_is_complete() -> None:
    graph = new_graph((0.0, 0.0), (6.0, 0.0))
    missions = new_missions(graph)
    missions.last_rejected = 0
    chain = missions.chaining.open_chain(*graph.events)
    missions.prepare()
    assert len(missions.chaining.chains) == 1
    chain.complete = True
    missions.prepare()
    missions.prepare()
    assert [(c.source, c.target, c.back) for c in missions.chaining.chains] == [("e0", "e1", False), ("e1", "e0", True)]


# -- 3.3: goals that were never seen ----------------------------------------------------------------------------------


def test_3_3_a_a_goal_that_holds_an_effect_set_is_planned_to() -> None:
    _, _, policy = line()
    plan = policy.plan(state(), NEAR, np.array([6.3, 0.0]))
    assert plan.status == "in_graph"
    assert plan.path[0] == policy.choose(state(), 0, NEAR, np.array([6.3, 0.0]), 0.0).option == "o1"
    assert plan.path[-2:] in (("e2", GOAL), ("o2", GOAL))
    assert "go there by way of o1" in str(plan)


def test_3_3_b_a_goal_in_an_initiation_set_gets_an_option_with_that_set() -> None:
    graph, chaining, policy = line()
    goal = np.array([3.0, 0.55])  # in o2's initiation set, in no event
    assert policy.plan(state(), NEAR, goal).status == "in_initiation_set"
    missions = PaperMissions(graph, chaining, Points(), PaperRules(), 20, np.random.default_rng(0))
    missions.cut(1)
    missions.pinned = goal
    missions.prepare()
    np.testing.assert_array_equal(missions._choose(NEAR).goal, goal)
    event = graph.events[-1]
    root = chaining.options[chaining.leading_to(event.id)[0].options[0]]
    assert root.mature
    assert differences(root.initiation.get_state(), chaining.options["o2"].initiation.get_state()) == []
    # The planner leads to where it can start, and there it runs.
    assert policy.choose(state(), 0, NEAR, goal, 0.0).option == "o1"
    assert policy.choose(state(), 0, np.array([3.2, -0.1]), goal, 0.0).option == root.id
    missions.prepare()
    assert len(graph.events) == 5, "once"
    plan = policy.plan(state(), NEAR, goal)
    assert (plan.status, plan.success_probability) == ("in_initiation_set", 0.0)
    assert sorted(graph.nx.edges) == sorted(rebuilt(graph).nx.edges)


def test_3_3_c_a_goal_outside_is_approached_by_the_nearest_vertex() -> None:
    graph, _, policy = line()
    goal = np.array([6.0, 4.0])
    plan = policy.plan(state(), NEAR, goal)
    assert (plan.status, plan.path[0], plan.path[-1]) == ("outside", "o1", "e2")
    assert (plan.success_probability, plan.expected_steps) == (0.0, 1_000.0)
    assert "go near it" in str(plan)
    there = np.array([6.0, 0.0])
    assert policy.plan(state(), there, goal).path == ()
    assert "the policy over options goes there" in str(policy.plan(state(), there, goal))
    del graph


# -- A.6: outside the graph -------------------------------------------------------------------------------------------


def test_a_6_outside_the_graph_the_policy_over_options_decides() -> None:
    graph, chaining, policy = line()
    far = np.array([-4.0, -4.0])
    assert policy.plan(state(), far, graph.events[2].center).path == ()
    chain = chaining.open_chain(graph.events[0], graph.events[2])
    assert policy.choose(state(), 0, far, graph.events[2].center, 0.0).option == chain.options[0]
    empty = PaperPolicy(new_graph(), new_chaining(new_graph()), 200, policy.planner)
    assert empty.choose(state(), 0, far, NEAR, 0.0).option == DIRECT, "before there is any option"


def rebuilt(graph: PaperGraph) -> PaperGraph:
    """The graph as it is made from what is saved."""
    other = PaperGraph(2, RADIUS)
    other.set_state(graph.get_state())
    other.set_options(graph.get_state(), graph.options)
    return other


def test_events_may_overlap() -> None:
    graph = new_graph((0.0, 0.0), (2.4, 0.0), (3.0, 0.0))
    chaining = new_chaining(graph)
    chaining.options["o0"] = new_option(graph, "o0", "e1", ((0.0, 0.0), 0.6), effects=((2.4, 0.0),))
    chaining.options["o1"] = new_option(graph, "o1", "e2", ((2.4, 0.0), 0.4), effects=((3.0, 0.0),))
    policy = PaperPolicy(graph, chaining, 200, Planner(graph, WalkModel(), 1_000))
    there, goal = np.array([2.55, 0.0]), np.array([9.0, 0.0])
    assert [event.id for event in graph.events_at(there)] == ["e1", "e2"]
    assert policy.choose(state(), 0, there, goal, 0.0).event == "e2", "of the events that hold it the one nearest to the goal"
    assert policy.plan(state(), there, goal).path == (), "it is at the nearest vertex"


def test_what_a_way_is_worth() -> None:
    _, chaining, policy = line()
    option = chaining.options["o1"]
    assert policy.worth(["o1", "e1"], 1_000.0) == (10.0, pytest.approx(1.0))
    option.n_runs, option.n_steps = 6, 60  # every other run succeeds, each takes 10 steps
    steps, probability = policy.worth(["o1"], 20.0)
    assert steps == 20.0
    assert probability == pytest.approx(0.75)
    option.n_successes = 0
    assert policy.worth(["o1"], 1_000.0) == (1_000.0, 0.0)


# -- the agent --------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module", autouse=True)
def restless() -> Iterator[None]:
    """Half of the steps are random, in loaded agents as well."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sb3_skillgraph.learning.rollout.RANDOM_ACTION_PROB", 0.5)
        yield


def small(**kwargs: Any) -> SkillGraphAgent:
    """An agent that does as the paper does, with small networks and many events."""
    settings = {**PAPER, "rules": PaperRules(salient_event_freq=2, retry_after=1, timeout=30)}
    easy = dict(policy_kwargs=dict(net_arch=[16, 16]), learning_starts=0, event_radius=0.6)
    return new_agent(**{**settings, **easy, **kwargs})


@pytest.fixture(scope="module")
def learned() -> SkillGraphAgent:
    agent = small()
    agent.learn(4_000, log_interval=None)
    return agent


def test_every_option_has_a_network_of_its_own_and_learns_from_its_own_runs(learned: SkillGraphAgent) -> None:
    options = learned.options
    assert len(options) > 3
    assert len({id(option.learner) for option in options}) == len(options)
    owned: list[int] = []
    for option in options:
        assert isinstance(option, Option)
        assert option.replay.shared == option.replay.hindsight == 0.0
        owned += option.replay._readable().tolist()
    assert len(owned) == len(set(owned)) <= learned.parts.store.total
    assert learned.graph.summary()["options"] > 0
    for chain in learned.parts.chaining.chains:
        assert isinstance(chain, SkillChain)
        first, *rest = (learned.parts.chaining.options[id] for id in chain.options)
        assert first.target == chain.target
        assert [option.target for option in rest] == chain.options[:-1]
    assert learned.graph.locate(np.array([50.0, 50.0])) == NOWHERE


def test_what_plan_says_predict_does(learned: SkillGraphAgent) -> None:
    env = gym.make(TOY, max_steps=100)
    n_planned = 0
    for seed in range(6):
        observation, _ = env.reset(seed=seed)
        if seed % 2:
            goal = learned.events[seed % len(learned.events)].center.astype(np.float32)
            observation, _ = env.reset(seed=seed, options={"start": learned.events[0].center, "goal": goal})
        memory = None
        for _ in range(60):
            plan = learned.plan(observation, state=memory)
            action, memory = learned.predict(observation, memory)
            if plan.path:
                assert plan.path[0] == learned.running(memory)[0]
                n_planned += 1
            assert 0.0 <= plan.success_probability <= 1.0
            observation, *_ = env.step(action)
    assert n_planned > 0


def test_options_of_a_deep_copy_lead_to_those_of_the_copy(learned: SkillGraphAgent) -> None:
    twin = copy.deepcopy(learned)
    options = twin.parts.skills
    child = next(option for option in options.values() if option.target in options)
    options[child.target].initiation.core = np.array([9.0, 9.0])
    assert (child.replay.aim() == 9.0).all()
    assert (learned.parts.skills[child.id].replay.aim() < 9.0).all()


@pytest.mark.parametrize("buffer_size", [10_000, 100])
def test_it_is_saved_and_goes_on_exactly(tmp_path: Path, buffer_size: int) -> None:
    whole, first = (small(env=gym.make(TOY), buffer_size=buffer_size) for _ in range(2))
    whole.learn(900, log_interval=None)
    first.learn(600, log_interval=None)
    first.save(tmp_path / "agent")
    first.save_replay_buffer(tmp_path / "replay")
    second = SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY))
    second.load_replay_buffer(tmp_path / "replay")
    assert second.rules == first.rules
    assert len(second.options) == len(first.options) > 0
    assert sorted(second.graph.nx.edges) == sorted(first.graph.nx.edges)
    second.learn(300, log_interval=None, reset_num_timesteps=False)
    assert differences(without_clock(state_of(whole)), without_clock(state_of(second))) == []


def test_without_its_replay_buffer_it_learns_on(tmp_path: Path) -> None:
    small().learn(500, log_interval=None).save(tmp_path / "agent")
    agent = SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY))
    assert all(len(option.replay._readable()) == 0 for option in agent.options)  # type: ignore[union-attr]
    agent.learn(200, log_interval=None, reset_num_timesteps=False)
    assert agent.num_timesteps == 700


def test_it_learns_in_several_environments_and_adapts() -> None:
    agent = small(env=new_vec_env(n_envs=2)).learn(600, log_interval=None)
    goal = np.array([1.0, -1.0])
    agent.adapt(goal, total_timesteps=300)
    assert any(np.array_equal(event.center, goal) for event in agent.events)


def test_options_learn_as_often_as_they_run() -> None:
    for train_freq, n_envs in (((1, "episode"), 1), (5, 1), (1, 4)):
        env: Any = new_vec_env(n_envs=n_envs) if n_envs > 1 else TOY
        agent = small(env=env, train_freq=train_freq, gradient_steps=-1 if train_freq == (1, "episode") else 1)
        agent.learn(1_600, log_interval=None)
        updates = {option.id: option.learner._n_updates for option in agent.options}
        rows = {option.id: len(option.replay._readable()) for option in agent.options}  # type: ignore[union-attr]
        per_step = 1.0 if train_freq != 5 else 0.2
        assert sum(rows.values()) > 500
        for id, n in updates.items():
            assert n <= per_step * rows[id] + 20
            assert n >= per_step * (rows[id] - 64) - 60
    assert not agent.parts.rollout.ran


def test_counters_outlive_a_fresh_start(tmp_path: Path) -> None:
    agent = small().learn(900, log_interval=None)
    agent.save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY), force_reset=True)
    for name in ("n_episodes", "last_accepted", "last_rejected", "newest"):
        assert getattr(loaded.parts.missions, name) == getattr(agent.parts.missions, name)
    assert agent.parts.missions.n_episodes > 0


def test_rows_that_are_none_are_refused(tmp_path: Path) -> None:
    agent = small().learn(500, log_interval=None)
    experience = agent.parts.get_experience()
    id = next(id for id, rows in experience["rows"].items() if len(rows) > 1)
    for rows in ([5, 4], [-1, 3], [0, 10**6], [[1, 2]]):
        with pytest.raises(ValueError, match=f"rows of option {id}"):
            agent.parts.set_experience({**experience, "rows": {**experience["rows"], id: np.array(rows)}})
    with pytest.raises(ValueError, match="rules must be PaperRules"):
        new_agent(rules="paper")


def test_dsg_dco() -> None:
    agent = small(salience="dco").learn(1_500, log_interval=None)
    assert len(agent.events) >= 2


def test_its_graph_is_plain_networkx(learned: SkillGraphAgent) -> None:
    kinds = {data["kind"] for _, data in learned.graph.nx.nodes(data=True)}
    assert kinds == {"event", "option"}
    for *_, data in learned.graph.nx.edges(data=True):
        assert data.keys() == {"weight", "success_rate"}
    assert isinstance(learned.events[0], Event)


def test_it_is_drawn_and_compared(learned: SkillGraphAgent, tmp_path: Path) -> None:
    assert line()[2].links_from("e0")[0] == ("e0", "e1", 1.0, 10.0)
    assert all(0.0 < link.success_probability <= 1.0 and link.steps > 0.0 for link in event_links(learned))
    assert "salient" in plot_skill_graph(learned).get_title()
    pyplot.close("all")
    arguments = check_hyperparams({"rules": "paper", "salience": "dco", "batch_size": 32}, "here")
    assert (arguments["rules"], arguments["salience"], arguments["tau"]) == (PaperRules(), "dco", 0.01)
    assert arguments["batch_size"] == 32
    with pytest.raises(ValueError, match="unknown rules 'papers'"):
        check_hyperparams({"rules": "papers"}, "here")
    train(TOY, {}, {**arguments, "policy": "MultiInputPolicy", "policy_kwargs": {"net_arch": [8]}}, 60, 0, tmp_path)
    assert json.loads((tmp_path / "config.json").read_text())["arguments"]["rules"]["timeout"] == 200
