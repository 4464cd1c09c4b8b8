"""The paper's skill graph: an edge where one set lies in another (sections 3.1, 3.2.6, A.2)."""

from collections import deque
from collections.abc import Iterable
from typing import Any

import networkx
import numpy as np

from sb3_skillgraph.events import Event
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.metric import Metric
from sb3_skillgraph.options.option import Option

#: Points kept of where an event was triggered.
TRIGGERS_LENGTH = 200


class PaperGraph(SkillGraph):
    """Salient events and mature options as vertices, joined by an edge where the one leads into the other.

    ============== ================================================ ====================================
    edge           exists while                                     weight
    ============== ================================================ ====================================
    option, option the effect set of the first lies in the          1 / success rate
                   initiation set of the second
    option, event  the effect set lies in the event                 1 / success rate
    event, option  all points at which the event was triggered lay  0: to be in the event is to be able
                   in the option's initiation set when it was       to start the option
                   looked at
    ============== ================================================ ====================================

    An edge out of an option goes as soon as one effect falls outside. Of those out of events the paper says no such thing, and
    they stay: a chain that is complete stays so (section A.3). There are no landmarks, no walks and no cover: a point that
    lies in no salient event belongs to none.

    :param goal_dim: dimension of goal space
    :param metric: of goal space: how near is inside an event
    :param walk_steps: environment steps that the pairs of states lie apart at most from which DCO learns
    """

    def __init__(self, goal_dim: int, metric: Metric | float, walk_steps: int = 40) -> None:
        super().__init__(goal_dim, metric, max_events=2**31, walk_steps=walk_steps)
        self.cover_radius = self.metric.radius
        self.options: dict[str, Option] = {}
        self.triggers: dict[str, deque[np.ndarray]] = {}
        self._digraph = networkx.DiGraph()

    def __repr__(self) -> str:
        n_edges = self._digraph.number_of_edges()
        return f"<PaperGraph of {len(self.events)} events, {len(self.options)} options and {n_edges} edges>"

    @property
    def nx(self) -> networkx.DiGraph:
        """The graph itself, numbers and strings only."""
        return self._digraph

    def add_event(self, center: np.ndarray, *, salient: bool = True) -> int:
        """Add a salient event.

        :param center: shape ``(goal_dim,)``
        :param salient: not used: all are
        :return: its index
        """
        i = super().add_event(center, salient=True)
        event = self.events[i]
        self._digraph.add_node(event.id, **event.as_vertex())
        self.triggers[event.id] = deque([event.center], maxlen=TRIGGERS_LENGTH)
        for option in self.options.values():
            self._event_option_edge(event.id, option)
            self._option_edge(option, event)
        return i

    def add_option(self, option: Option) -> None:
        """Add a mature option.

        :param option: the option; its edges come with :meth:`refresh`
        """
        self.options[option.id] = option
        self._n_changes += 1
        self._digraph.add_node(option.id, kind="option", target=option.target)

    # -- edges --------------------------------------------------------------------------------------------------------

    def triggered(self, event: str, point: np.ndarray) -> None:
        """An option has triggered an event: what is to start all over the event must start there, too.

        :param event: its id
        :param point: where, shape ``(goal_dim,)``
        """
        self.triggers[event].append(np.asarray(point, dtype=np.float64))

    def refresh(self, option: Option, refitted: bool) -> None:
        """Look again at the edges of an option after one of its runs.

        :param option: an option of the graph
        :param refitted: whether its initiation set has changed, so that the edges into it must be looked at too
        """
        for target in [*self._digraph.successors(option.id)]:
            self._digraph.remove_edge(option.id, target)
        for event in self.events:
            self._option_edge(option, event)
        for other in self.options.values():
            self._option_edge(option, other)
            if refitted:
                self._option_edge(other, option)
        if refitted:
            for event in self.events:
                self._event_option_edge(event.id, option)
        self._n_changes += 1

    def _option_edge(self, option: Option, target: Event | Option) -> None:
        """Join an option to an event or another option in which its effect set lies; part them where it does not."""
        if self._digraph.has_edge(option.id, target.id):
            self._digraph.remove_edge(option.id, target.id)
        holds = target.contains if isinstance(target, Event) else target.initiation.optimistic
        rate = option.success_rate
        if option is not target and rate > 0.0 and option.effects and holds(np.stack(option.effects)).all():
            self._digraph.add_edge(option.id, target.id, weight=1.0 / rate, success_rate=rate)

    def _event_option_edge(self, event: str, option: Option) -> None:
        startable = option.initiation.optimistic(np.stack(self.triggers[event])).all()
        if startable and option.target != event:  # an option does not start where it ends
            self._digraph.add_edge(event, option.id, weight=0.0, success_rate=1.0)

    # -- questions ----------------------------------------------------------------------------------------------------

    def events_at(self, point: np.ndarray) -> list[Event]:
        """Return the events that hold a point: they may overlap.

        :param point: shape ``(goal_dim,)``
        """
        return [event for event in self.events if event.holds(point)]

    def holding(self, point: np.ndarray) -> list[Option]:
        """Return the options of the graph whose initiation set holds a point.

        :param point: shape ``(goal_dim,)``
        """
        return [option for option in self.options.values() if option.initiation.optimistic(point[None])[0]]

    def ways_from(self, options: Iterable[str]) -> tuple[dict[str, float], dict[str, list[str]]]:
        """Find the cheapest ways from any of some options to all vertices that can be reached (Dijkstra, section 3.2.4).

        :param options: ids of options of the graph
        :return: by vertex, the sum of the weights on the way, and the way itself: an option comes first
        """
        sources = list(options)
        return networkx.multi_source_dijkstra(self._digraph, sources) if sources else ({}, {})

    def ways_past_no_event(self, event: str) -> dict[str, list[str]]:
        """Find the cheapest ways from an event to others that options alone make.

        :param event: its id
        :return: by the id of the other event, the way
        """
        graph = self._digraph
        by_options = networkx.subgraph_view(graph, filter_edge=lambda u, _: u == event or u in self.options)
        ways = networkx.single_source_dijkstra_path(by_options, event)
        return {target: way for target, way in ways.items() if target != event and target in self.triggers}

    def inside(self, goal: np.ndarray) -> list[str]:
        """Return the vertices at which a goal is reached: options whose effect set lies in it, events triggered in it.

        :param goal: its centre, shape ``(goal_dim,)``
        """
        # The first trigger of an event is its centre, where nobody need have been.
        sets: dict[str, Any] = {id: points for id, points in self.triggers.items() if len(points) > 1}
        sets.update((option.id, option.effects) for option in self.options.values() if option.effects)
        return [
            id for id, points in sets.items() if (self.metric.distance(np.stack(points), goal) <= self.metric.radius).all()
        ]

    def joined(self) -> set[str]:
        """Return the ids of the events that are in the graph: the first one, and those that a path leads to from there."""
        if not self.events:
            return set()
        first = self.events[0].id
        return {first, *(networkx.descendants(self._digraph, first) & self.triggers.keys())}

    def summary(self) -> dict[str, float]:
        """Describe the graph in numbers.

        :return: ``events``, ``salient_events``, ``joined_events`` among them, mature ``options`` and ``edges``, and the
            ``success_rate`` of all runs of those options
        """
        n_runs = sum(option.n_runs for option in self.options.values())
        return {
            "events": len(self.events),
            "salient_events": len(self.events),
            "joined_events": len(self.joined()),
            "options": len(self.options),
            "edges": self._digraph.number_of_edges(),
            "success_rate": sum(option.n_successes for option in self.options.values()) / max(n_runs, 1),
        }

    # -- saving -------------------------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Return events, what triggered them, which options are vertices, and the edges, all in their order."""
        return {
            "events": [event.center for event in self.events],
            "triggers": {id: np.stack(points) for id, points in self.triggers.items()},
            "options": list(self.options),
            "edges": [[u, v, dict(data)] for u, v, data in self._digraph.edges(data=True)],
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore the events of what :meth:`get_state` returned; options come with :meth:`set_options`."""
        for center in state["events"]:
            self.add_event(center)
        self.triggers = {id: deque(points, maxlen=TRIGGERS_LENGTH) for id, points in state["triggers"].items()}

    def set_options(self, state: dict[str, Any], options: dict[str, Option]) -> None:
        """Restore which options are vertices, and all edges.

        :param state: what :meth:`get_state` returned
        :param options: all options by id
        """
        for id in state["options"]:
            self.add_option(options[id])
        for source, target, data in state["edges"]:
            self._digraph.add_edge(source, target, **data)
