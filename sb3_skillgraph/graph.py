"""The skill graph: events, the options that lead from one to another, and the record of their runs (section 3.1)."""

from typing import TYPE_CHECKING, Any

import numpy as np

from sb3_skillgraph.digraph import as_digraph
from sb3_skillgraph.edges import NOWHERE, RECORD, Edges, land
from sb3_skillgraph.events import Event
from sb3_skillgraph.metric import MISMATCH, Metric, as_metric

if TYPE_CHECKING:
    import networkx

#: Landmarks lie at least so many event radii apart: 1.5 to 3 make the same agent, fewer make plans cheaper.
SPACING = 1.5
#: Edges out of an event, at most (a few more until they are next looked through); a plan looks at all of them.
MAX_DEGREE = 32
#: Half of its training ago the walker was another one: what ran then counts half as much, to this power.
AGING = 1.0
#: Updates of the walker before which runs do not age: all of its training so far would be "half of it ago".
YOUNG = 500.0
#: Trajectories that the mean of their steps is taken over: it follows a walker that gets faster.
RECENT = 10.0
#: By how much the cover's radius grows when there are too many events.
GROWTH = 1.25


class SkillGraph:
    """Events and walks as vertices, and what is known of how to get from one to another.

    An event is the vertex ``e7``; the walk to it, an option that every agent has as soon as it has the event, is ``w7``.

    :param goal_dim: dimension of goal space
    :param metric: how near is inside an event; a number is a radius, in goal units
    :param max_events: how many there may be; when there are more the cover grows coarser
    :param walk_steps: environment steps within which a trajectory that goes from one event to another makes an edge
    """

    def __init__(self, goal_dim: int, metric: Metric | float, max_events: int, walk_steps: int = 40) -> None:
        self.goal_dim = goal_dim
        self.metric = as_metric(metric)
        self.max_events = max_events
        self.walk_steps = walk_steps
        self.cover_radius = SPACING * self.metric.radius
        self.events: list[Event] = []
        self.edges = Edges()
        self.now = 0.0  # updates of the walker so far: the clock by which records age
        self._n_changes = 0
        self.centers = np.zeros((0, goal_dim))  # of the events
        self.visits: np.ndarray = np.zeros(0)  # of each event
        self.barren: np.ndarray = np.zeros(0)  # explorations from each event, since one found something
        self.walk_ids: list[str] = []  # of the walks to the events, in their order
        self._index: dict[str, int] = {}  # of events, by their ids and by those of the walks to them
        self.n_made = 0  # events so far, those that were merged included
        self._nx: tuple[Any, networkx.DiGraph] | None = None

    def __repr__(self) -> str:
        return f"<SkillGraph of {len(self.events)} events and {self.edges.size} edges>"

    @property
    def version(self) -> tuple[int, float]:
        """Rises with every change, and as time goes on."""
        return self._n_changes, self.now

    # -- events -------------------------------------------------------------------------------------------------------

    def index(self, id: str) -> int:
        """Return the index of an event, or of the event that a walk leads to; ``NOWHERE`` for an id of neither."""
        return self._index.get(id, NOWHERE)

    def id(self, index: int) -> str:
        """Return the id of an event, an empty string for ``NOWHERE``."""
        return "" if index == NOWHERE else self.events[index].id

    def locate(self, point: np.ndarray) -> int:
        """Return the index of the event that a point belongs to: the nearest, if it lies within the cover's radius.

        :param point: shape ``(goal_dim,)``
        :return: the index; ``NOWHERE`` if there is none so near
        """
        if not self.events:
            return NOWHERE
        distances = self.distances(point)
        nearest = int(distances.argmin())
        return nearest if distances[nearest] <= self.cover_radius else NOWHERE

    def distances(self, point: np.ndarray) -> np.ndarray:
        """Return how far the events are from a point, shape ``(n_events,)``, in the metric's unit."""
        return self.metric.distance(self.centers, point)

    def add_event(self, center: np.ndarray, *, salient: bool) -> int:
        """Add an event; whoever adds sees to it that there is room (see :meth:`coarsen`).

        :param center: shape ``(goal_dim,)``
        :param salient: whether it is a target of its own, or a landmark
        :return: its index
        """
        i = len(self.events)
        event = Event(f"e{self.n_made}", np.array(center, dtype=np.float64), self.metric, salient)
        self.events.append(event)
        self.walk_ids.append(f"w{self.n_made}")
        self.centers = np.concatenate([self.centers, event.center[None]])
        self.visits, self.barren = np.append(self.visits, 0.0), np.append(self.barren, 0.0)
        self._index[event.id] = self._index[self.walk_ids[i]] = i
        self.n_made += 1
        self._n_changes += 1
        return i

    def coarsen(self) -> np.ndarray:
        """Merge events that lie close together, salient ones last; their records become one.

        :return: the new index of every old event
        :raises ValueError: if only what has to match tells events apart
        """
        if self.cover_radius * GROWTH >= MISMATCH and self.metric.n_matched:
            raise ValueError(
                f"What has to match (Exact) takes more values than max_events={self.max_events} events can stand for: more "
                "events are needed, or what takes so many values must be measured (Within)."
            )
        self.cover_radius *= GROWTH
        # Salient events first, then old ones: each stays unless one that stays lies too near
        order = sorted(range(len(self.events)), key=lambda i: (not self.events[i].salient, i))
        kept: list[int] = []
        for i in order:
            near = self.metric.distance(self.centers[kept], self.centers[i]) < self.cover_radius
            if not near.any():
                kept.append(i)
        kept.sort()
        new_index = self.metric.distance(self.centers[:, None], self.centers[kept]).argmin(axis=1)
        self._rename(kept, new_index)
        return new_index

    def _rename(self, kept: list[int], new_index: np.ndarray) -> None:
        old_edges = self.edges
        self.events = [self.events[i] for i in kept]
        self.walk_ids = [self.walk_ids[i] for i in kept]
        self._index = self._build_index()
        self.centers = self.centers[kept]
        self.visits, self.barren = (np.bincount(new_index, counts) for counts in (self.visits, self.barren))
        self.edges = Edges()
        for row in range(old_edges.size):
            source, target = int(new_index[old_edges.source[row]]), int(new_index[old_edges.target[row]])
            if source != target:
                self._pour(old_edges, row, source, target, new_index)
        let_go = ((int(new_index[source]), int(new_index[target])) for source, target in old_edges.let_go)
        self.edges.let_go = {(source, target) for source, target in let_go if source != target}
        self._n_changes += 1

    def _build_index(self) -> dict[str, int]:
        by_event = {event.id: i for i, event in enumerate(self.events)}
        return {**by_event, **{walk: i for i, walk in enumerate(self.walk_ids)}}

    def _pour(self, old: Edges, row: int, source: int, target: int, new_index: np.ndarray) -> None:
        """Add the record of an old edge to the one that takes its place."""
        edges, new = self.edges, self._current_row(source, target)
        weight = self._aging(old.updated[row])
        n_old, n_new = old.forward[row] + old.backward[row], edges.forward[new] + edges.backward[new]
        steps = n_old * old.crossing_steps[row] + n_new * edges.crossing_steps[new]
        edges.crossing_steps[new] = steps / max(n_old + n_new, 1.0)
        edges.forward[new] += old.forward[row]
        edges.backward[new] += old.backward[row]
        for name in RECORD:
            getattr(edges, name)[new] += weight * getattr(old, name)[row]
        for landing, share in zip(old.landing[row].tolist(), old.landing_weight[row].tolist(), strict=True):
            if share > 0.0:
                landed = int(new_index[landing]) if landing != NOWHERE else NOWHERE
                land(edges.landing[new], edges.landing_weight[new], landed, weight * share)

    # -- what trajectories and runs teach -----------------------------------------------------------------------------

    def crossed(self, source: int, target: int, steps: float) -> None:
        """A trajectory went from one event to another: it can be done, and back perhaps.

        :param source: index of the event it came from
        :param target: index of the event it came to
        :param steps: environment steps in between
        """
        edges = self.edges
        # Most ways can be gone back: a guess, which the model of walks has learned how much to trust
        there, back = edges.add(source, target, self.now), edges.add(target, source, self.now)
        if edges.forward[there] == 0:
            edges.crossing_steps[there] = steps
        edges.forward[there] += 1
        # A running mean that follows the walker as it learns
        edges.crossing_steps[there] += (steps - edges.crossing_steps[there]) / min(edges.forward[there], RECENT)
        if edges.forward[back] == 0:
            edges.crossing_steps[back] = edges.crossing_steps[there]
        edges.backward[back] += 1
        self._n_changes += 1

    def explored(self, event: str, found: bool) -> None:
        """An exploration has begun in an event, or has found something.

        :param event: its id; one that has been forgotten since, or none, changes nothing
        :param found: which of the two
        """
        index = self.index(event)
        if index != NOWHERE:
            self.barren[index] = 0.0 if found else self.barren[index] + 1.0

    def ran(self, source: int, target: int, success: bool, landing: int, steps: int) -> None:
        """A run of a walk has ended: the only thing that changes rates.

        :param source: index of the event it began in
        :param target: index of the event it was to lead to
        :param success: whether it did
        :param landing: index of the event in which it ended, ``NOWHERE`` if in none
        :param steps: environment steps it took
        """
        row, edges = self._current_row(source, target), self.edges
        if success:
            edges.successes[row] += 1.0
            edges.success_steps[row] += steps
        else:
            edges.failures[row] += 1.0
            edges.failure_steps[row] += steps
            land(edges.landing[row], edges.landing_weight[row], landing, 1.0)
        self._n_changes += 1

    def _current_row(self, source: int, target: int) -> int:
        """Return the row of an edge, its weights as of now."""
        row, edges = self.edges.add(source, target, self.now), self.edges
        weight = self._aging(edges.updated[row])
        for name in (*RECORD, "landing_weight"):
            getattr(edges, name)[row] *= weight
        edges.updated[row] = self.now
        return row

    def _aging(self, updated: Any) -> Any:
        return ((updated + YOUNG) / (self.now + YOUNG)) ** AGING

    def aging(self) -> np.ndarray:
        """Return by how much the weights of each edge have aged since they were updated, shape ``(n_edges,)``."""
        return self._aging(self.edges.updated)

    def bound_degree(self, worth: np.ndarray) -> None:
        """Let go of the edges of each event that are worth least, where it has too many.

        :param worth: of every edge, shape ``(n_edges,)``
        """
        source = self.edges.source
        order = np.lexsort((-worth, source))  # by source, those of most worth first; of equals the oldest
        ordered = source[order]
        first = np.searchsorted(ordered, ordered)  # where the edges of the same source begin
        rank = np.arange(len(order)) - first
        if (rank >= MAX_DEGREE).any():
            self.edges.keep(np.sort(order[rank < MAX_DEGREE]))
            self._n_changes += 1

    # -- looking at it ------------------------------------------------------------------------------------------------

    @property
    def nx(self) -> "networkx.DiGraph":
        """The graph as networkx has it, numbers and strings only: a copy to look at, made when asked for.

        See :func:`~sb3_skillgraph.digraph.as_digraph`.

        >>> graph = SkillGraph(goal_dim=2, metric=0.5, max_events=100)
        >>> home, door = (graph.add_event(np.array(center), salient=False) for center in ([0.0, 0.0], [1.0, 0.0]))
        >>> graph.ran(home, door, True, door, 12.0)
        >>> list(graph.nx.edges)
        [('e0', 'w1'), ('w1', 'e1')]
        """
        if self._nx is None or self._nx[0] != self.version:
            self._nx = (self.version, as_digraph(self.events, self.walk_ids, self.edges))
        return self._nx[1]

    def summary(self) -> dict[str, float]:
        """Describe the graph in numbers.

        :return: ``events``, ``salient_events`` among them and ``edges``; ``tried_edges``, of which a run is known, and the
            ``success_rate`` of those runs
        """
        runs = self.edges.successes + self.edges.failures
        return {
            "events": len(self.events),
            "salient_events": sum(event.salient for event in self.events),
            "edges": self.edges.size,
            "tried_edges": int(np.count_nonzero(runs)),
            "success_rate": float(self.edges.successes.sum() / max(runs.sum(), 1e-9)),
        }

    # -- saving -------------------------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Return the graph as plain data."""
        return {
            "events": [event.get_state() for event in self.events],
            "walks": list(self.walk_ids),
            "edges": self.edges.get_state(),
            "visits": self.visits.copy(),
            "barren": self.barren.copy(),
            "cover_radius": self.cover_radius,
            "now": self.now,
            "n_made": self.n_made,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self.events = [Event(**spec, metric=self.metric) for spec in state["events"]]
        self.centers = np.reshape([event.center for event in self.events], (-1, self.goal_dim))
        self.walk_ids = list(state["walks"])
        self._index = self._build_index()
        self.visits, self.barren = np.array(state["visits"]), np.array(state["barren"])
        self.edges.set_state(state["edges"])
        self.cover_radius, self.now, self.n_made = state["cover_radius"], state["now"], state["n_made"]
        self._n_changes += 1
