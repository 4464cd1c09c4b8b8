"""What is seen of an agent, as SVG: the maze, its events and walks, a plan, a trace (the paper's Figures 2 and 4)."""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.envs import MazeGeometry
from sb3_skillgraph.events import Event
from sb3_skillgraph.plotting import event_links, near_links
from sb3_skillgraph.plotting.figures import EFFECT, EVENT, GOAL, PLAN, START, WALL, disc_radius, way
from sb3_skillgraph.plotting.skill_graph import SURE, EventLink, link_color

#: Pixels of the longer side.
SIDE = 720
#: Pixels by which a click may miss an event.
CLICK_RADIUS = 14
#: Colours of the runs of an episode, one after the other; apart for the colour-blind (Tol's bright scheme).
_RUNS = ("#4477aa", "#ee6677", "#228833", "#ccbb44", "#66ccee", "#aa3377")


class Frame(NamedTuple):
    """Which part of goal space is seen.

    :param dims: the two dimensions of a goal that are shown
    :param low: their least values
    :param high: their greatest values
    """

    dims: tuple[int, int]
    low: np.ndarray
    high: np.ndarray

    @classmethod
    def of(cls, agent: SkillGraphAgent, geometry: MazeGeometry | None, dims: tuple[int, int] = (0, 1)) -> "Frame":
        """Frame a maze, or all events.

        :param agent: the agent
        :param geometry: its maze; None for an environment without one
        :param dims: the two dimensions of a goal to be shown; twice the same if it has one only
        """
        if geometry is not None and dims == (0, 1):
            left, right, bottom, top = geometry.extent
            low, high = np.array([left, bottom]), np.array([right, top])
        else:
            centers = agent.graph.centers if len(agent.events) else np.zeros((1, agent.graph.goal_dim))
            shown, margin = centers[:, dims], 2.0 * max(disc_radius(agent), 1e-3)
            low, high = shown.min(axis=0) - margin, shown.max(axis=0) + margin
        if agent.graph.goal_dim > 2:  # a square, whichever dimensions are chosen
            middle, half = (low + high) / 2.0, (high - low).max() / 2.0
            low, high = middle - half, middle + half
        return cls(dims, low, high)

    @property
    def scale(self) -> float:
        """Pixels of a goal unit."""
        return float(SIDE / (self.high - self.low).max())

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, in pixels."""
        width, height = np.round(self.scale * (self.high - self.low)).astype(int).tolist()
        return width, height

    def pixels(self, points: np.ndarray) -> np.ndarray:
        """Return where points of the two dimensions are seen, shape ``(n, 2)``."""
        return np.column_stack([points[:, 0] - self.low[0], self.high[1] - points[:, 1]]) * self.scale

    def at(self, x: float, y: float) -> np.ndarray:
        """Return the point of the two dimensions that is seen at a pixel."""
        return np.array([self.low[0] + x / self.scale, self.high[1] - y / self.scale])


class Scene:
    """Draws an agent.

    :param agent: the agent
    :param geometry: its maze; None for an environment without one
    :param dims: the two dimensions of a goal that are shown
    """

    def __init__(self, agent: SkillGraphAgent, geometry: MazeGeometry | None, dims: tuple[int, int] = (0, 1)) -> None:
        self.agent = agent
        self.frame = Frame.of(agent, geometry, dims)
        self.geometry = geometry if dims == (0, 1) else None
        self.radius = disc_radius(agent) * self.frame.scale
        self.centers = {event.id: event.center for event in agent.events}
        self.links = sorted(event_links(agent), key=lambda link: link.success_probability)  # the surest on top

    def floor(self) -> str:
        """Draw the walls."""
        width, height = self.frame.size
        parts = [f'<rect width="{width}" height="{height}" fill="white"/><g fill="{WALL}" shape-rendering="crispEdges">']
        for x, y, w, h in self.geometry.walls() if self.geometry is not None else ():
            (left, top), (right, bottom) = self.frame.pixels(np.array([[x, y + h], [x + w, y]])).tolist()
            size = f'width="{right - left:.1f}" height="{bottom - top:.1f}"'
            parts.append(f'<rect x="{left:.1f}" y="{top:.1f}" {size}/>')
        return "".join([*parts, "</g>"])

    def graph(self) -> str:
        """Draw the events, and of each the shortest few walks, by the success that is expected of them."""
        lines = [self._link(link, 1.4) for link in near_links(self.links)]
        return "".join([*lines, *(self.event(event) for event in self.agent.events)])

    def growing(self, centers: Sequence[Sequence[float]], links: Sequence[tuple[int, int]]) -> str:
        """Draw a graph of an earlier time, from a snapshot of it.

        :param centers: of its events
        :param links: pairs of their numbers
        """
        points = np.array(centers, dtype=np.float64).reshape(-1, self.agent.graph.goal_dim)
        lines = [self.line(way(self.geometry, *self._ends(points[u], points[v])), "#7a0177", 1.2) for u, v in links]
        dots = [self._dot(point, EVENT, 3.0) for point in points]
        return "".join([*lines, *dots])

    def event(self, event: Event) -> str:
        """Draw an event."""
        color, size = (EFFECT, 6.0) if event.salient else (EVENT, 3.5)
        return self._dot(event.center, color, size, f' id="{event.id}"')

    def selected(self, event: Event) -> str:
        """Draw an event's ball, and all walks that begin in it, by what is expected of them."""
        sure = [link for link in self.links if link.source == event.id and link.success_probability >= SURE]
        lines = [self._link(link, 3.0) for link in sure]
        return "".join([*lines, self.disc(event.center, EFFECT)])

    def ends(self, start: np.ndarray, goal: np.ndarray) -> str:
        """Draw start and goal, shapes ``(goal_dim,)``."""
        return self._dot(start, START, 8.0) + self.disc(goal, GOAL) + self._dot(goal, GOAL, 7.0)

    def plan(self, start: np.ndarray, goal: np.ndarray, path: Sequence[str], dashes: str = "7 5") -> str:
        """Draw a plan, from event to event.

        :param start: shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        :param path: the plan's
        :param dashes: how it is dashed
        """
        stops = [start, *(self.centers[id] for id in path if id in self.centers), goal]
        legs = [way(self.geometry, *self._ends(*leg)) for leg in itertools.pairwise(stops)]
        return self.line(np.concatenate(legs), PLAN, 2.5, f' stroke-dasharray="{dashes}"')

    def trace(self, points: np.ndarray, options: Sequence[str]) -> str:
        """Draw where an agent has been, a colour for each run, and where it is.

        :param points: shape ``(n + 1, goal_dim)``
        :param options: ids of the options that ran, ``n`` of them
        """
        begins = [i for i in range(len(options)) if i == 0 or options[i] != options[i - 1]]
        shown = points[:, self.frame.dims]
        lines = [
            self.line(shown[begin : end + 1], _RUNS[k % len(_RUNS)], 3.5)
            for k, (begin, end) in enumerate(zip(begins, [*begins[1:], len(options)], strict=True))
        ]
        return "".join([*lines, self._dot(points[-1], "#ffffff", 7.0, f' stroke="{EVENT}" stroke-width="3"')])

    def document(self, *layers: str) -> str:
        """Return a whole picture of layers."""
        width, height = self.frame.size
        return (
            f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}">'
            f"{''.join(layers)}</svg>"
        )

    def event_at(self, x: float, y: float) -> Event | None:
        """Return the event that is seen at a pixel; None if there is none near it."""
        if not self.agent.events:
            return None
        away = np.linalg.norm(self.frame.pixels(self.agent.graph.centers[:, self.frame.dims]) - [x, y], axis=1)
        nearest = int(away.argmin())
        return self.agent.events[nearest] if away[nearest] <= CLICK_RADIUS else None

    def _ends(self, begin: np.ndarray, end: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        dims = list(self.frame.dims)
        return begin[dims], end[dims]

    def _link(self, link: EventLink, width: float) -> str:
        ends = self._ends(self.centers[link.source], self.centers[link.target])
        return self.line(way(self.geometry, *ends), link_color(link.success_probability), width)

    def line(self, points: np.ndarray, color: str, width: float, more: str = "") -> str:
        """Draw a line through points of the two dimensions, shape ``(n, 2)``."""
        text = " ".join(f"{x:.1f},{y:.1f}" for x, y in self.frame.pixels(points).tolist())
        return f'<polyline points="{text}" fill="none" stroke="{color}" stroke-width="{width}"{more}/>'

    def disc(self, center: np.ndarray, color: str) -> str:
        """Draw the ball around a point, shape ``(goal_dim,)``."""
        x, y = self.frame.pixels(center[None, self.frame.dims])[0].tolist()
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{self.radius:.1f}" fill="{color}" fill-opacity="0.2" stroke="{color}"/>'

    def _dot(self, point: np.ndarray, color: str, size: float, more: str = "") -> str:
        x, y = self.frame.pixels(np.asarray(point)[None, self.frame.dims])[0].tolist()
        more = more if "stroke" in more else f'{more} stroke="white"'
        return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{size}" fill="{color}"{more}/>'
