"""The skill graph on small cases with known answers; its invariants are in ``test_invariants.py``."""

import copy

import networkx as nx
import numpy as np
import pytest
from builders import PAPER_GRAPH, PLAIN_WEIGHTS, World, event, make_option, put_initiation

from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.options.option import Option

E0, E1 = event(0, 0.0, 0.0), event(1, 10.0, 0.0)


def two_events(**kwargs: object) -> SkillGraph:
    graph = SkillGraph(2, **{**PLAIN_WEIGHTS, **kwargs})  # type: ignore[arg-type]
    graph.add_event(E0)
    graph.add_event(E1)
    return graph


def leads_to_e1(**kwargs: object) -> Option:
    return make_option("o1", "e1", E1, **({"start": ((0.0, 0.0), 3.0)} | kwargs))  # type: ignore[arg-type]


def known_beside_e0() -> Option:
    """An option to e1 known to start beside e0 only."""
    option = leads_to_e1()
    for _ in range(3):
        option.succeeded(np.linspace([2.0, 0.0], [9.0, 0.0], 12), np.array([10.0, 0.0]))
    option.initiation.refit(force=True)
    return option


def ran(graph: SkillGraph, option: Option, success: bool, end: tuple[float, float] = (10.0, 0.0)) -> None:
    if success:
        option.succeeded(np.zeros((3, 2)), np.array(end))
    else:
        option.failed(np.zeros(2))
    graph.refresh(option, refitted=False)


def test_vertices_carry_their_items() -> None:
    graph = two_events()
    option = leads_to_e1()
    graph.add_option(option)
    assert list(graph.nx.nodes(data="item")) == [("e0", E0), ("e1", E1), ("o1", option)]


def test_no_id_twice_and_no_gestating_option() -> None:
    graph = two_events()
    with pytest.raises(ValueError, match="e0"):
        graph.add_event(event(0, 3.0, 3.0))
    with pytest.raises(ValueError, match="gestating"):
        graph.add_option(make_option("o1", "e1", E1))
    assert list(graph.nx.nodes) == ["e0", "e1"]


def test_in_the_paper_an_edge_appears_at_the_first_success_and_weighs_one_over_the_rate() -> None:
    graph = two_events(**PAPER_GRAPH)
    option = leads_to_e1()
    graph.add_option(option)
    assert not graph.nx.has_edge("o1", "e1")
    ran(graph, option, False)
    assert not graph.nx.has_edge("o1", "e1")
    ran(graph, option, True)
    assert graph.nx.edges["o1", "e1"]["weight"] == 2.0
    ran(graph, option, True)
    assert graph.nx.edges["o1", "e1"]["weight"] == 1.0 / (2.0 / 3.0)
    assert graph.nx.edges["o1", "e1"]["success_rate"] == 2.0 / 3.0
    for _ in range(30):
        ran(graph, option, False)
    assert not graph.nx.has_edge("o1", "e1")  # a rate of zero is no way at all


def test_by_default_rates_are_smoothed_and_failing_edges_lose_their_plan() -> None:
    graph = two_events()
    option = leads_to_e1()
    graph.add_option(option)
    assert graph.nx.edges["o1", "e1"]["weight"] == 2.0  # one of two pseudo-counts
    ran(graph, option, True)
    assert graph.nx.edges["o1", "e1"]["weight"] == pytest.approx(1.5)
    for _ in range(12):
        ran(graph, option, False)
    assert graph.shortest_path(["o1"], "e1") is None


def test_an_event_leads_into_an_option_at_no_cost_but_never_into_one_that_ends_there() -> None:
    graph = two_events()
    graph.add_option(leads_to_e1(start=((5.0, 0.0), 20.0), effects=[(10.0, 0.0)], record=[True]))
    edge = graph.nx.edges["e0", "o1"]
    assert (edge["weight"], edge["success_rate"]) == (0.0, 1.0)
    assert not graph.nx.has_edge("e1", "o1")
    assert not graph.nx.has_edge("o1", "o1")


@pytest.mark.parametrize(("containment", "outside", "joined"), [(1.0, 1, False), (0.9, 1, True), (0.9, 2, False)])
def test_an_event_leads_into_an_option_while_its_triggers_lie_inside(containment: float, outside: int, joined: bool) -> None:
    graph = two_events(containment=containment, evidence_edges=False)
    graph.add_option(leads_to_e1(start=((-0.5, 0.0), 1.0)))
    for _ in range(10):
        graph.triggered(E0, np.array([-0.9, 0.0]))
    assert graph.nx.has_edge("e0", "o1")
    for _ in range(outside):
        graph.triggered(E0, np.array([0.9, 0.0]))
    assert graph.nx.has_edge("e0", "o1") == joined


def test_by_default_rates_begin_high_and_failures_are_dear() -> None:
    graph = SkillGraph(2)
    graph.add_event(E0)
    graph.add_event(E1)
    graph.add_option(make_option("o1", "e1", E1, start=((0.0, 0.0), 2.0)))
    assert graph.nx.edges["o1", "e1"]["success_rate"] == pytest.approx(0.95)
    assert graph.nx.edges["o1", "e1"]["weight"] == pytest.approx(1 + 5 / 19)  # a nineteenth of a failure before a success
    for _ in range(4):
        ran(graph, graph.options["o1"], False)
    assert graph.nx.edges["o1", "e1"]["success_rate"] == pytest.approx(1.9 / 6)
    ran(graph, graph.options["o1"], False)
    assert not graph.nx.has_edge("o1", "e1")


def test_an_option_leads_into_another_while_its_effects_lie_inside() -> None:
    graph = two_events(**PAPER_GRAPH)
    first = leads_to_e1(effects=[(10.0, 0.0)] * 9, record=[True] * 9 + [False])
    second = make_option("o2", "e0", E0, start=((10.0, 0.0), 0.5), record=[True])
    graph.add_option(first)
    graph.add_option(second)
    assert graph.nx.edges["o1", "o2"]["weight"] == 1.0 / 0.9
    ran(graph, first, True, end=(10.7, 0.0))
    assert not graph.nx.has_edge("o1", "o2")  # section 3.2.6: one sample outside deletes the edge
    put_initiation(second.initiation, (10.0, 0.0), 1.5)
    graph.refresh(second, refitted=True)
    assert graph.nx.has_edge("o1", "o2")


def test_shares_of_effects_count_against_the_rate() -> None:
    graph = two_events(rate_prior=(0.0, 0.0))
    first = leads_to_e1(effects=[(10.0, 0.0)] * 19 + [(10.7, 0.0)], record=[True] * 10)
    graph.add_option(make_option("o2", "e0", E0, start=((10.0, 0.0), 0.5), record=[True]))
    graph.add_option(first)
    assert graph.nx.edges["o1", "o2"]["weight"] == pytest.approx(1 / 0.95)


def test_an_option_leads_to_another_event_that_holds_its_effects() -> None:
    graph = two_events(rate_prior=(0.0, 0.0))
    graph.add_event(event(2, 10.5, 0.0))
    option = leads_to_e1(effects=[(10.2, 0.0)] * 4, record=[True, False])
    graph.add_option(option)
    assert graph.nx.edges["o1", "e2"]["weight"] == 2.0
    ran(graph, option, True, end=(9.1, 0.0))
    assert not graph.nx.has_edge("o1", "e2")
    assert graph.nx.has_edge("o1", "e1")


def test_strict_containment_holds_between_an_option_and_the_one_it_chains_to() -> None:
    """Section 3.2.6: once a parent's set has shrunk away from where its child ends, the edge is deleted."""
    graph = two_events(**PAPER_GRAPH)
    parent = make_option("o1", "e1", E1, start=((8.0, 0.0), 2.0), effects=[(10.0, 0.0)], record=[True])
    child = make_option("o2", "o1", parent, start=((0.0, 0.0), 3.0), effects=[(7.5, 0.0)], record=[True])
    graph.add_option(parent)
    graph.add_option(child)
    assert graph.nx.has_edge("o2", "o1")
    put_initiation(parent.initiation, (9.5, 0.0), 0.5)
    graph.refresh(parent, refitted=True)
    graph.refresh(child, refitted=False)
    assert not graph.nx.has_edge("o2", "o1")


def test_evidence_makes_an_edge_where_containment_does_not() -> None:
    """Runs from one side of an event that succeed put the whole event into the set: it is contained from then on."""
    for evidence_edges in (True, False):
        graph = two_events(evidence_edges=evidence_edges)
        for x in (-0.9, 0.9):
            graph.triggered(E0, np.array([x, 0.0]))
        option = known_beside_e0()
        graph.add_option(option)
        assert not graph.nx.has_edge("e0", "o1")
        graph.ran_from(E0, option, True)
        graph.refresh(option, refitted=True)
        assert graph.nx.has_edge("e0", "o1") == evidence_edges
        assert option.initiation.optimistic(E0.outline()).all() == evidence_edges
    assert not option.initiation.optimistic(np.array([[-8.0, 0.0]]))[0]  # and no more than that


def test_an_edge_from_evidence_weighs_nothing_and_its_rate_is_the_share_inside() -> None:
    graph = two_events()
    option = known_beside_e0()
    graph.add_option(option)
    graph.ran_from(E0, option, True)
    graph.refresh(option, refitted=True)
    assert graph.nx.edges["e0", "o1"]["weight"] == 0.0
    assert graph.nx.edges["e0", "o1"]["success_rate"] == 1.0


def test_evidence_holds_at_once_for_every_question() -> None:
    """Edges, plans and the batched sets follow the option's own set as soon as the run has been told of."""
    graph = two_events()
    option = known_beside_e0()
    graph.add_option(option)
    side = np.array([-0.6, 0.0])
    assert graph.startable(side) == []
    graph.ran_from(E0, option, True)
    graph.refresh(option, refitted=False)
    assert option.initiation.optimistic(side[None])[0]
    assert graph.startable(side) == ["o1"]
    assert graph.shortest_path(["e0"], "e1") is not None
    for _ in range(3):
        option.failed(side)
        graph.ran_from(E0, option, False)
        graph.refresh(option, refitted=False)
    assert not option.initiation.optimistic(side[None])[0]
    assert graph.startable(side) == []
    assert graph.shortest_path(["e0"], "e1") is None


def test_evidence_counts_while_runs_mostly_succeed() -> None:
    graph = two_events()
    option = known_beside_e0()
    graph.add_option(option)
    for success, held in ((False, False), (True, True), (False, False), (True, True), (True, True), (False, True)):
        graph.ran_from(E0, option, success)
        assert (list(option.initiation.regions) == ["e0"]) == held
    assert list(graph.evidence["e0", "o1"]) == [False, True, False, True, True, False]
    for _ in range(20):  # only recent runs count
        graph.ran_from(E0, option, False)
    for _ in range(5):
        graph.ran_from(E0, option, True)
    assert list(option.initiation.regions) == ["e0"]


@pytest.mark.parametrize("refitted", [True, False])
def test_evidence_that_turns_takes_its_edge_away(refitted: bool) -> None:
    """At once, not only when the option's set is next fitted."""
    graph = two_events()
    option = known_beside_e0()
    graph.ran_from(E0, option, True)
    graph.add_option(option)
    assert graph.nx.has_edge("e0", "o1")
    for _ in range(3):
        graph.ran_from(E0, option, False)
        graph.refresh(option, refitted)
    assert not graph.nx.has_edge("e0", "o1")


def test_the_paper_knows_no_evidence() -> None:
    graph = two_events(**PAPER_GRAPH)
    option = known_beside_e0()
    for _ in range(5):
        graph.ran_from(E0, option, True)
    assert option.initiation.regions == {}
    graph.add_option(option)
    assert not graph.nx.has_edge("e0", "o1")


def test_the_cheapest_path_and_its_success_probability() -> None:
    graph = two_events(**PAPER_GRAPH)
    graph.add_event(event(2, 20.0, 0.0))
    graph.add_option(make_option("o1", "e1", E1, start=((0.0, 0.0), 2.0), effects=[(10, 0)], record=[True, True]))
    graph.add_option(make_option("o2", "e2", event(2, 20.0, 0.0), start=((10.0, 0.0), 2.0), record=[True, False]))
    graph.add_option(make_option("o3", "e2", event(2, 20.0, 0.0), start=((0.0, 0.0), 2.0), record=[True] + [False] * 3))
    path = graph.shortest_path(["e0"], "e2")  # 1 + 2 by way of e1, 4 straight
    assert path is not None
    assert path.vertices[:2] == ("e0", "o1")
    assert path.cost == 3.0
    assert path.success_probability == 0.5
    straight = graph.shortest_path(["o3"], "e2")
    assert straight == (("o3", "e2"), 4.0, 0.25)
    both = graph.shortest_path(["o3", "o1"], "e2")
    assert both is not None
    assert both.vertices[0] == "o1"
    assert graph.shortest_path(["e2"], "e0") is None
    assert graph.shortest_path([], "e2") is None
    assert graph.shortest_path(["e0"], "e9") is None
    assert graph.shortest_path(["e0"], "e0") == (("e0",), 0.0, 1.0)


def test_paths_from_several_vertices() -> None:
    graph = two_events(**PAPER_GRAPH)
    e2 = event(2, 20.0, 0.0)
    graph.add_event(e2)
    graph.add_option(make_option("o1", "e1", E1, start=((0.0, 0.0), 2.0), effects=[(10, 0)], record=[True, True]))
    graph.add_option(make_option("o2", "e2", e2, start=((10.0, 0.0), 2.0), record=[True, False]))
    graph.add_option(make_option("o3", "e2", e2, start=((0.0, 0.0), 2.0), record=[True] + [False] * 3))
    tree = graph.ways_from(["o1", "o3"])
    assert {id: tree.cost(id) for id in graph.nx if id in tree} == {"o1": 0.0, "o3": 0.0, "e1": 1.0, "o2": 1.0, "e2": 3.0}
    assert tree.path("e2") == ["o1", "o2", "e2"]
    assert "e9" not in tree
    assert graph.ways_from(["o1", "o3"]) is tree  # nothing has changed
    around = graph.ways_from(["o1", "o3"], avoid=["o2", "o9"])
    assert {id: around.cost(id) for id in graph.nx if id in around} == {"o1": 0.0, "o3": 0.0, "e1": 1.0, "e2": 4.0}
    assert around.path("e2") == ["o3", "e2"]
    for nowhere in (graph.ways_from(["o1"], avoid=["o1"]), graph.ways_from([])):
        assert not [id for id in graph.nx if id in nowhere]
    back = graph.ways_to("e2")
    assert {id: back.cost(id) for id in graph.nx if id in back} == {
        "o1": 3.0,
        "o2": 2.0,
        "o3": 4.0,
        "e1": 2.0,
        "e2": 0.0,
        "e0": 3.0,
    }
    assert back.path("e0") == ["e0", "o1", "o2", "e2"]
    assert graph.nx.has_edge("o1", "o2")  # asking has changed nothing
    assert graph.shortest_path(["o1"], "e2") is not None
    assert graph.reachable("e0") == ["e0", "e1", "e2"]
    assert graph.reachable("e2") == ["e2"]


def test_equally_cheap_ways_are_told_apart_by_the_graph_alone() -> None:
    """The answer depends on the vertices' order, not on that of the edges' making or on how strings hash."""
    ways = set()
    for order in (range(1, 10), range(9, 0, -1)):
        graph = two_events()
        for k in range(1, 10):
            graph.add_option(make_option(f"o{k}", "e1", E1, start=((0.0, 0.0), 2.0), effects=[(10, 0)]))
        for k in order:
            graph.options[f"o{k}"].record.append(True)
            graph.refresh(graph.options[f"o{k}"], refitted=False)
        ways.add(tuple(graph.ways_from(["o3", "o1", "o2"]).path("e1")))
    assert len(ways) == 1


def test_useful_are_the_startable_options_that_do_not_end_at_once() -> None:
    graph = two_events()
    graph.add_option(leads_to_e1(start=((5.0, 0.0), 9.0)))
    graph.add_option(make_option("o2", "e0", E0, start=((5.0, 0.0), 9.0)))
    assert [graph.useful(np.array([x, 0.0])) for x in (0.0, 5.0, 10.0, 50.0)] == [["o1"], ["o1", "o2"], ["o2"], []]
    assert graph.startable(np.zeros(2)) == ["o1", "o2"]


def test_startable_are_the_options_whose_set_contains_the_point() -> None:
    graph = two_events()
    assert graph.startable(np.zeros(2)) == []
    graph.add_option(leads_to_e1())
    graph.add_option(make_option("o2", "e0", E0, start=((4.0, 0.0), 2.0)))
    assert graph.startable(np.array([0.0, 0.0])) == ["o1"]
    assert graph.startable(np.array([2.5, 0.0])) == ["o1", "o2"]
    assert graph.startable(np.array([50.0, 0.0])) == []


def test_joined_pairs() -> None:
    world = World()
    assert world.graph.joined_pairs() == 0.0
    world.line()
    assert world.graph.joined_pairs() == 1.0
    world.graph.remove_options(["o4"])  # back from e1 to e0
    assert world.graph.joined_pairs() == pytest.approx(4 / 6)


def test_a_removed_option_leaves_nothing_behind() -> None:
    world = World()
    world.line()
    option = world.graph.options["o1"]
    world.graph.ran_from(world.graph.events["e0"], option, True)
    assert world.planner.path_to(np.zeros(2), "e1") is not None
    world.graph.remove_options([option.id])
    assert "o1" not in world.graph.nx
    assert world.graph.startable(np.zeros(2)) == []
    assert world.planner.path_to(np.zeros(2), "e1") is None
    assert not any(key[1] == "o1" for key in world.graph.evidence)
    world.graph.add_option(option)
    assert world.planner.path_to(np.zeros(2), "e1") is not None


def test_state_round_trip_keeps_how_ties_fall() -> None:
    graph = two_events()
    for k in (5, 3, 8):  # three equally good ways
        graph.add_option(make_option(f"o{k}", "e1", E1, start=((0.0, 0.0), 2.0), effects=[(10, 0)], record=[True]))
    ran(graph, graph.options["o5"], False)
    for _ in range(30):
        ran(graph, graph.options["o5"], False)
    for _ in range(30):
        ran(graph, graph.options["o5"], True)  # its edge is now the youngest
    restored = SkillGraph(2, **PLAIN_WEIGHTS)
    restored.set_state(copy.deepcopy(graph.get_state()), graph.options)
    assert restored.shortest_path(["e0"], "e1") == graph.shortest_path(["e0"], "e1")
    assert nx.utils.graphs_equal(restored.nx.subgraph(graph.options), graph.nx.subgraph(graph.options))
