"""The skill graph: a thin layer over one ``networkx.DiGraph`` (sections 3.1, 3.2.6, A.2)."""

import itertools
from collections import deque
from collections.abc import Collection, Iterable, Sequence
from typing import Any, NamedTuple

import networkx as nx
import numpy as np

from sb3_skillgraph.events import SalientEvent
from sb3_skillgraph.options.initiation import InitiationBank
from sb3_skillgraph.options.option import Option

TRIGGERS_LENGTH = 50


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
    option, target the option has a success rate (it ends there)    1 / success rate
    option, event  its effect set lies in the event                 1 / success rate
    option, option the effect set of the first lies in the          1 / (success rate times the share of
                   initiation set of the second                     effects inside)
    event, option  the event's trigger points lie in the option's   0 (to be in the event is to be able to
                   initiation set                                   start the option)
    ============== ================================================ ==========================================

    *Lies in* means that at least a share ``containment`` of the recent samples do. Every edge carries ``weight`` and
    ``success_rate``; every vertex carries its ``item``.

    :param containment: share of samples that must lie inside; 1.0 is the paper's strict rule
    :param rate_prior: pseudo-counts of a success and a failure in every success rate; 0 is the paper's plain fraction
    :param evidence_edges: whether runs begun in an event and mostly successful put the event into the option's
        initiation set, which makes an event-option edge
    :param min_success_rate: edges whose rate falls below it are dropped, so that no plan uses them
    """

    def __init__(
        self,
        containment: float = 0.9,
        rate_prior: float = 1.0,
        evidence_edges: bool = True,
        min_success_rate: float = 0.2,
    ) -> None:
        self.nx = nx.DiGraph()
        self.containment = containment
        self.rate_prior = rate_prior
        self.evidence_edges = evidence_edges
        self.min_success_rate = min_success_rate
        self.events: dict[str, SalientEvent] = {}
        self.options: dict[str, Option] = {}
        self.triggers: dict[str, deque[np.ndarray]] = {}
        # (event, option) -> recent outcomes of the option's runs that began in the event
        self.evidence: dict[tuple[str, str], deque[bool]] = {}
        self.version = 0
        self._bank: tuple[InitiationBank, tuple[str, ...]] | None = None
        self._costs: dict[str, tuple[dict[str, float], dict[str, list[str]]]] = {}

    # -- vertices -----------------------------------------------------------------------------------------------------

    def add_event(self, event: SalientEvent) -> None:
        """Add a salient event as a vertex.

        :raises ValueError: if a vertex of that id exists
        """
        self._add_vertex(event.id, event)
        self.events[event.id] = event
        self.triggers[event.id] = deque([event.center], maxlen=TRIGGERS_LENGTH)

    def add_option(self, option: Option) -> None:
        """Add a mature option as a vertex, with the edges that follow from its sets.

        :raises ValueError: if the option is not mature, or a vertex of that id exists
        """
        if not option.mature:
            raise ValueError(f"Option {option.id!r} is still gestating; only mature options belong in the graph.")
        self._add_vertex(option.id, option)
        self.options[option.id] = option
        self._bank = None
        self.refresh(option, refitted=True)

    def _add_vertex(self, id: str, item: SalientEvent | Option) -> None:
        if id in self.nx:
            raise ValueError(f"The graph already has a vertex {id!r}.")
        self.nx.add_node(id, item=item)
        self._changed()

    def remove_option(self, option: Option) -> None:
        """Take an option out of the graph, with all its edges."""
        self.nx.remove_node(option.id)
        del self.options[option.id]
        self.evidence = {key: value for key, value in self.evidence.items() if key[1] != option.id}
        self._bank = None
        self._changed()

    def _changed(self) -> None:
        self.version += 1
        self._costs.clear()

    # -- what runs teach ----------------------------------------------------------------------------------------------

    def triggered(self, event: SalientEvent, point: np.ndarray) -> None:
        """Remember where an event was triggered; edges out of it must hold there too (section 3.2.6).

        :param event: the event
        :param point: shape ``(goal_dim,)``
        """
        self.triggers[event.id].append(np.asarray(point, dtype=np.float64))
        members, ids = self.bank()
        inside = members.contains(np.stack(self.triggers[event.id])).mean(axis=0)
        for share, option_id in zip(inside, ids, strict=True):
            self._event_option_edge(event.id, option_id, float(share))

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
        if refitted:
            self._bank = None
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
            members, ids = self.bank()
            for share, id in zip(members.contains(effects).mean(axis=0), ids, strict=True):
                if share >= self.containment and id not in (option.id, option.target):
                    rates[id] = rate * float(share)
            for event in self.events.values():
                share = float(event.contains(effects).mean())
                if share >= self.containment and event.id != option.target:
                    rates[event.id] = rate * share
        for id in [*self.nx.successors(option.id)]:
            if id not in rates:
                self._set_edge(option.id, id, 0.0)
        for target, value in rates.items():
            if target in self.nx:
                self._set_edge(option.id, target, value)

    def _edges_into(self, option: Option) -> None:
        initiation = option.initiation
        for event_id, points in self.triggers.items():
            self._event_option_edge(event_id, option.id, float(initiation.optimistic(np.stack(points)).mean()))
        for other in self.options.values():
            if other.effects and other is not option and (other.target != option.id or self.containment == 1.0):
                share = float(initiation.optimistic(np.stack(other.effects)).mean())
                rate = other.success_rate(self.rate_prior) * share if share >= self.containment else 0.0
                self._set_edge(other.id, option.id, rate)

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
                self._changed()
            return
        weight = 1.0 / rate if weight is None else weight
        if not self.nx.has_edge(source, target):
            self.nx.add_edge(source, target, weight=weight, success_rate=rate, since=self.version)
            self._changed()
        elif self.nx.edges[source, target]["success_rate"] != rate:
            self.nx.edges[source, target].update(weight=weight, success_rate=rate)
            self._changed()

    # -- questions ----------------------------------------------------------------------------------------------------

    def bank(self) -> tuple[InitiationBank, tuple[str, ...]]:
        """Return the optimistic initiation sets of all options in the graph, and the options' ids in its order."""
        if self._bank is None:
            self._bank = InitiationBank([o.initiation for o in self.options.values()]), tuple(self.options)
        return self._bank

    def startable(self, point: np.ndarray) -> list[str]:
        """Return the ids of the options whose initiation set contains a point.

        :param point: shape ``(goal_dim,)``
        """
        members, ids = self.bank()
        return [ids[i] for i in np.flatnonzero(members.contains(np.asarray(point)[None])[0])]

    def useful(self, point: np.ndarray) -> list[str]:
        """Return the ids of the options that can start at a point and do not end there at once.

        :param point: shape ``(goal_dim,)``
        """
        return [id for id in self.startable(point) if not self.options[id].terminates(np.asarray(point))]

    def costs_to(self, target: str) -> dict[str, float]:
        """Return the cost of the cheapest path from every vertex that has one to ``target`` (cached)."""
        return self._tree(target)[0]

    def _tree(self, target: str) -> tuple[dict[str, float], dict[str, list[str]]]:
        if target not in self._costs:
            reverse = self.nx.reverse(copy=False)
            self._costs[target] = nx.single_source_dijkstra(reverse, target, weight="weight")
        return self._costs[target]

    def shortest_path(self, sources: Iterable[str], target: str) -> GraphPath | None:
        """Find the cheapest path from any of some vertices to another (section 3.2.4).

        :param sources: ids of vertices
        :param target: id of a vertex
        :return: the path, source and target included; None if there is none
        """
        if target not in self.nx:
            return None
        costs, paths = self._tree(target)
        reachable = [source for source in sources if source in costs]
        if not reachable:
            return None
        best = min(reachable, key=lambda source: (costs[source], len(paths[source])))
        vertices = tuple(reversed(paths[best]))
        return GraphPath(vertices, float(costs[best]), self.success_probability(vertices))

    def paths_from(self, sources: Sequence[str], avoid: Collection[str] = ()) -> tuple[dict[str, float], dict[str, list[str]]]:
        """Return cost and path of the cheapest way from any of some vertices to every vertex that has one.

        :param sources: ids of vertices
        :param avoid: ids of vertices that no way may lead through
        """
        sources = [id for id in dict.fromkeys(sources) if id not in avoid]
        if not sources:
            return {}, {}
        graph = nx.restricted_view(self.nx, [id for id in avoid if id in self.nx], []) if avoid else self.nx
        costs, paths = nx.multi_source_dijkstra(graph, sources, weight="weight")
        return costs, paths

    def success_probability(self, vertices: Sequence[str]) -> float:
        """Return the product of the success rates along a path."""
        rates = [self.nx.edges[edge]["success_rate"] for edge in itertools.pairwise(vertices)]
        return float(np.prod(rates))

    def joined_pairs(self) -> float:
        """Return the share of ordered pairs of events that are joined by a path (0 with fewer than two events)."""
        n = len(self.events)
        if n < 2:
            return 0.0
        joined = sum(len(nx.descendants(self.nx, event) & self.events.keys()) for event in self.events)
        return joined / (n * (n - 1))

    # -- saving -------------------------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Return events, edges and evidence as plain data; options are saved by their owner."""
        return {
            "events": [event.get_state() for event in self.events.values()],
            "options": list(self.options),
            "nodes": list(self.nx.nodes),
            "version": self.version,
            # In the order of their making: ties between equally cheap paths then fall as before.
            "edges": sorted(([u, v, d] for u, v, d in self.nx.edges(data=True)), key=lambda edge: edge[2]["since"]),
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
        self._bank = None
        self._costs.clear()
