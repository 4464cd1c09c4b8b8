"""The skill graph: a thin layer over one ``networkx.DiGraph`` (sections 3.1, 3.2.6, A.2)."""

import functools
import itertools
import math
import operator
from collections import deque
from collections.abc import Callable, Collection, Sequence
from typing import Any, NamedTuple

import networkx as nx
import numpy as np

from sb3_skillgraph.events import EventBank, SalientEvent
from sb3_skillgraph.options.bank import OptionBank
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.routes import Routes, Tree

TRIGGERS_LENGTH = 50
CACHED_TREES = 64  # while nothing changes, many plans begin at the same options


class GraphPath(NamedTuple):
    """A way through the graph: the ids of its vertices, the sum of its edges' weights, the product of their rates."""

    vertices: tuple[str, ...]
    cost: float
    success_probability: float


class SkillGraph:
    """Events and mature options as vertices; an edge where one leads into the other.

    ============== ================================================ ==========================================
    edge           exists while                                     weight
    ============== ================================================ ==========================================
    option, target the option has a success rate (it ends there)    runs it takes to succeed, on average: one
    option, event  its effect set lies in the event                 success and, ``failure_cost`` each, the
    option, option the effect set of the first lies in the          failures before it; the success rate is
                   initiation set of the second                     taken times the share of effects inside
    event, option  the event's trigger points lie in the option's   0 (to be in the event is to be able to
                   initiation set                                   start the option)
    ============== ================================================ ==========================================

    *Lies in* means that at least a share ``containment`` of the recent samples do. Every edge carries ``weight`` and
    ``success_rate``; every vertex carries its ``item``.

    :param goal_dim: dimension of goal space
    :param containment: share of samples that must lie inside; 1.0 is the paper's strict rule
    :param rate_prior: pseudo-counts of successes and of failures in every success rate; zeros give the paper's fraction
    :param evidence_edges: whether runs begun in an event and mostly successful put the event into the option's
        initiation set, which makes an event-option edge
    :param min_success_rate: edges whose rate falls below it are dropped, so that no plan uses them
    :param failure_cost: what a failed run costs, in successful ones; with 1 a weight is the paper's 1 / success rate
    """

    def __init__(
        self,
        goal_dim: int,
        containment: float = 0.9,
        rate_prior: tuple[float, float] = (1.9, 0.1),
        evidence_edges: bool = True,
        min_success_rate: float = 0.3,
        failure_cost: float = 5.0,
    ) -> None:
        self.nx = nx.DiGraph()
        self.goal_dim = goal_dim
        self.containment = containment
        self.rate_prior = rate_prior
        self.evidence_edges = evidence_edges
        self.min_success_rate = min_success_rate
        self.failure_cost = failure_cost
        self.events: dict[str, SalientEvent] = {}
        self.options: dict[str, Option] = {}
        self.triggers: dict[str, deque[np.ndarray]] = {}
        # (event, option) -> recent outcomes of the option's runs that began in the event
        self.evidence: dict[tuple[str, str], deque[bool]] = {}
        self.version = 0
        self.event_bank, self.option_bank = EventBank(goal_dim), OptionBank(goal_dim)
        self._routes = Routes()
        self._trees: dict[tuple[Any, ...], Tree] = {}

    # -- vertices -----------------------------------------------------------------------------------------------------

    def add_event(self, event: SalientEvent) -> None:
        """Add a salient event as a vertex.

        :raises ValueError: if a vertex of that id exists
        """
        self._add_vertex(event.id, event)
        self.events[event.id] = event
        self.event_bank.add(event)
        self.triggers[event.id] = deque([event.center], maxlen=TRIGGERS_LENGTH)

    def add_option(self, option: Option) -> None:
        """Add a mature option as a vertex, with the edges that follow from its sets.

        :raises ValueError: if the option is not mature, or a vertex of that id exists
        """
        if not option.mature:
            raise ValueError(f"Option {option.id!r} is still gestating; only mature options belong in the graph.")
        self._add_vertex(option.id, option)
        self.options[option.id] = option
        self.refresh(option, refitted=True)

    def _add_vertex(self, id: str, item: SalientEvent | Option) -> None:
        if id in self.nx:
            raise ValueError(f"The graph already has a vertex {id!r}.")
        self.nx.add_node(id, item=item)
        self._routes.add_vertex(id)
        self._changed()

    def remove_options(self, ids: Collection[str]) -> None:
        """Take options out of the graph, with all their edges.

        :param ids: their ids
        """
        self.nx.remove_nodes_from(ids)
        for id in ids:
            del self.options[id]
        self.evidence = {key: value for key, value in self.evidence.items() if key[1] in self.nx}
        self._index()
        self._changed()

    def _index(self) -> None:
        """Build anew what answers questions fast."""
        goal_dim = self.goal_dim
        self.event_bank, self.option_bank, self._routes = EventBank(goal_dim), OptionBank(goal_dim), Routes()
        for event in self.events.values():
            self.event_bank.add(event)
            self.event_bank.triggered(event, np.stack(self.triggers[event.id]))
        for option in self.options.values():
            self.option_bank.put(option)
        for id in self.nx:
            self._routes.add_vertex(id)
        for source, target, weight in self.nx.edges(data="weight"):
            self._routes.set_edge(source, target, weight)

    def _changed(self) -> None:
        self.version += 1
        self._trees.clear()

    # -- what runs teach ----------------------------------------------------------------------------------------------

    def triggered(self, event: SalientEvent, point: np.ndarray) -> None:
        """Remember where an event was triggered; edges out of it must hold there too (section 3.2.6).

        :param event: the event
        :param point: shape ``(goal_dim,)``
        """
        triggers = self.triggers[event.id]
        triggers.append(np.asarray(point, dtype=np.float64))
        points = np.stack(triggers)
        self.event_bank.triggered(event, points)
        shares = self._startable_shares(points)
        for id in sorted({*shares, *self.nx.successors(event.id)}):
            self._event_option_edge(event.id, id, shares.get(id, 0.0))

    def _startable_shares(self, points: np.ndarray) -> dict[str, float]:
        """Return by option from which share of some points it can start, where that suffices for an edge."""
        indices, inside = self.option_bank.startable(points)
        shares = zip(indices.tolist(), inside.mean(axis=0).tolist(), strict=True)
        return {self.option_bank.options[i].id: share for i, share in shares if share >= self.containment}

    def ran_from(self, event: SalientEvent, option: Option, success: bool) -> None:
        """Remember the outcome of a run that began in an event.

        While such runs mostly succeed the whole event counts as a place to start the option from, and its initiation
        set is to hold it.
        """
        outcomes = self.evidence.setdefault((event.id, option.id), deque(maxlen=10))
        outcomes.append(success)
        if self.evidence_edges:
            proven = (sum(outcomes) + 1.0) / (len(outcomes) + 2.0) >= 0.5
            changed = option.initiation.set_region(event.id, event.outline() if proven else None)
            if changed and option.initiation.refit(force=True) and option.id in self.options:
                self.refresh(option, refitted=True)

    def refresh(self, option: Option, refitted: bool) -> None:
        """Bring the edges of one option up to date after one of its runs.

        :param option: a mature option of the graph
        :param refitted: whether its initiation set was fitted anew, so that the edges into it must be looked at too
        """
        self.option_bank.put(option)
        if refitted:
            self._edges_into(option)
        self._edges_out_of(option)

    def _edges_out_of(self, option: Option) -> None:
        rate = option.success_rate(self.rate_prior)
        assert option.target is not None, "The global option is no vertex."
        rates = {option.target: rate}
        if option.effects:
            effects = np.stack(option.effects)
            parent = self.options.get(option.target)
            if self.containment == 1.0 and parent is not None and not parent.initiation.optimistic(effects).all():
                del rates[option.target]  # to the letter of the paper; else a chain keeps the edge it was built on
            shares = self._startable_shares(effects)
            in_events = self.event_bank.shares(effects)
            for i in np.flatnonzero(in_events >= self.containment):
                shares[self.event_bank.events[i].id] = float(in_events[i])
            rates.update((id, rate * share) for id, share in shares.items() if id not in (option.id, option.target))
        for id in [*self.nx.successors(option.id)]:
            if id not in rates:
                self._set_edge(option.id, id, 0.0)
        for target, value in rates.items():
            if target in self.nx:
                self._set_edge(option.id, target, value)

    def _edges_into(self, option: Option) -> None:
        initiation = option.initiation
        box = self._middles(*initiation.optimistic_boundaries[0].box())
        events = {event.id for event in self.event_bank.triggered_in(*box)}
        others = {other.id for other in self.option_bank.ending_in(*box)}
        before = set(self.nx.predecessors(option.id))
        for id in sorted(events | (before & self.events.keys())):
            self._event_option_edge(id, option.id, float(initiation.optimistic(np.stack(self.triggers[id])).mean()))
        for id in sorted((others | (before & self.options.keys())) - {option.id}):
            other = self.options[id]
            if other.effects and (other.target != option.id or self.containment == 1.0):
                share = float(initiation.optimistic(np.stack(other.effects)).mean())
                rate = other.success_rate(self.rate_prior) * share if share >= self.containment else 0.0
                self._set_edge(other.id, option.id, rate)

    def _middles(self, lower: np.ndarray, upper: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the box in which the middle of points lies that lie in a box, as far as an edge asks for."""
        if self.containment > 0.5:
            return lower, upper
        return np.full_like(lower, -np.inf), np.full_like(upper, np.inf)

    def _event_option_edge(self, event_id: str, option_id: str, share: float) -> None:
        rate = share if share >= self.containment else 0.0
        if self.options[option_id].target == event_id:
            return  # an option does not start where it ends
        self._set_edge(event_id, option_id, rate, weight=0.0)

    def _set_edge(self, source: str, target: str, rate: float, weight: float | None = None) -> None:
        """Set, change or (rate too low) delete an edge."""
        if rate <= 0.0 or rate < self.min_success_rate:
            if self.nx.has_edge(source, target):
                self.nx.remove_edge(source, target)
                self._routes.remove_edge(source, target)
                self._changed()
            return
        weight = 1.0 + self.failure_cost * (1.0 / rate - 1.0) if weight is None else weight
        known = self.nx.get_edge_data(source, target)
        if known is None or known["success_rate"] != rate:
            self.nx.add_edge(source, target, weight=weight, success_rate=rate)
            self._routes.set_edge(source, target, weight)
            self._changed()

    # -- questions ----------------------------------------------------------------------------------------------------

    def startable(self, point: np.ndarray) -> list[str]:
        """Return the ids of the options whose initiation set contains a point.

        :param point: shape ``(goal_dim,)``
        """
        indices, _ = self.option_bank.startable(np.asarray(point)[None])
        return [self.option_bank.options[i].id for i in indices]

    def useful(self, point: np.ndarray) -> list[str]:
        """Return the ids of the options that can start at a point and do not end there at once.

        :param point: shape ``(goal_dim,)``
        """
        return [id for id in self.startable(point) if not self.options[id].terminates(np.asarray(point))]

    def ending_in(self, region: SalientEvent) -> list[Option]:
        """Return the options whose effect set lies in a region."""
        candidates = self.option_bank.ending_in(*self._middles(region.center - region.radius, region.center + region.radius))
        return [o for o in candidates if region.contains(np.stack(o.effects)).mean() >= self.containment]

    def ways_from(self, sources: Sequence[str], avoid: Collection[str] = ()) -> Tree:
        """Return the cheapest ways from any of some vertices to all others (cached until the graph changes).

        :param sources: ids of vertices
        :param avoid: ids of vertices that no way may lead through
        """
        key = (tuple(sources), tuple(avoid))
        return self._tree(key, lambda: self._routes.ways_from(sources, avoid))

    def ways_to(self, target: str) -> Tree:
        """Return the cheapest ways from all vertices to one (cached until the graph changes)."""
        return self._tree((target,), lambda: self._routes.ways_to(target))

    def _tree(self, key: tuple[Any, ...], grow: Callable[[], Tree]) -> Tree:
        if key not in self._trees:
            if len(self._trees) >= CACHED_TREES:
                self._trees.clear()
            self._trees[key] = grow()
        return self._trees[key]

    def shortest_path(self, sources: Sequence[str], target: str) -> GraphPath | None:
        """Find the cheapest path from any of some vertices to another (section 3.2.4).

        :param sources: ids of vertices
        :param target: id of a vertex
        :return: the path, source and target included; None if there is none
        """
        return self.path_on(self.ways_from(sources), target)

    def path_on(self, tree: Tree, target: str) -> GraphPath | None:
        """Return the path to a vertex on a tree of :meth:`ways_from`; None if there is none."""
        if target not in tree:
            return None
        vertices = tuple(tree.path(target))
        return GraphPath(vertices, tree.cost(target), self.success_probability(vertices))

    def success_probability(self, vertices: Sequence[str]) -> float:
        """Return the product of the success rates along a path."""
        return math.prod(self.nx.edges[edge]["success_rate"] for edge in itertools.pairwise(vertices))

    def reachable(self, source: str) -> list[str]:
        """Return the ids of the events that a path leads to from a vertex, itself included if it is one."""
        tree = self.ways_from([source])
        return [id for id in self.events if id in tree]

    def joined_pairs(self) -> float:
        """Return the share of ordered pairs of events that are joined by a path (0 with fewer than two events)."""
        n = len(self.events)
        if n < 2:
            return 0.0
        components = nx.condensation(self.nx)
        bit = {id: 1 << i for i, id in enumerate(self.events)}
        # The events that can be reached from each strongly connected component, as bits of an integer.
        reached: dict[int, int] = {}
        for component in reversed(list(nx.topological_sort(components))):
            own = sum(bit.get(id, 0) for id in components.nodes[component]["members"])
            reached[component] = functools.reduce(operator.or_, (reached[c] for c in components.successors(component)), own)
        of = components.graph["mapping"]
        return sum(reached[of[event]].bit_count() - 1 for event in self.events) / (n * (n - 1))

    # -- saving -------------------------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Return events, edges and evidence as plain data; options are saved by their owner."""
        return {
            "events": [event.get_state() for event in self.events.values()],
            "options": list(self.options),
            "nodes": list(self.nx.nodes),
            "version": self.version,
            "edges": [[u, v, d] for u, v, d in self.nx.edges(data=True)],
            "triggers": {id: list(points) for id, points in self.triggers.items()},
            "evidence": [[event, option, list(record)] for (event, option), record in self.evidence.items()],
        }

    def set_state(self, state: dict[str, Any], options: dict[str, Option]) -> None:
        """Restore what :meth:`get_state` returned.

        :param state: the state
        :param options: the restored options by id
        """
        self.nx.clear()
        self.events = {spec["id"]: SalientEvent(**spec) for spec in state["events"]}
        self.options = {id: options[id] for id in state["options"]}
        for id in state["nodes"]:
            self.nx.add_node(id, item=self.events.get(id) or self.options[id])
        for source, target, attributes in state["edges"]:
            self.nx.add_edge(source, target, **attributes)
        self.triggers = {id: deque(points, maxlen=TRIGGERS_LENGTH) for id, points in state["triggers"].items()}
        self.evidence = {(event, option): deque(r, maxlen=10) for event, option, r in state["evidence"]}
        self.version = state["version"]
        self._index()
        self._trees.clear()
