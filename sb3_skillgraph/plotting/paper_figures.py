"""The paper's figures from arrays: growth, exploration, learning curves, and what is missed."""

from collections.abc import Collection, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import EngFormatter

from sb3_skillgraph.envs import MazeGeometry
from sb3_skillgraph.plotting import figures

_MAX_DOTS = 6_000


class Curve(NamedTuple):
    """Success against steps, with an interval; arrays of shape ``(n,)``."""

    steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray


class GraphSnapshot(NamedTuple):
    """A skill graph at one moment.

    :param steps: environment steps so far
    :param centers: of the events, shape ``(n, goal_dim)``
    :param links: pairs of events that options join, as rows of ``centers``
    """

    steps: int
    centers: np.ndarray
    links: list[tuple[int, int]]


def new_panels(n_panels: int, n_rows: int = 1) -> list[Axes]:
    """Make a figure of panels side by side.

    :param n_panels: number of panels in all
    :param n_rows: rows of them
    """
    n_columns = -(-n_panels // n_rows)
    figure = Figure(figsize=(4.2 * n_columns, 4.3 * n_rows), layout="constrained")
    panels = np.atleast_1d(figure.subplots(n_rows, n_columns)).ravel().tolist()
    for spare in panels[n_panels:]:
        spare.set_axis_off()
    return panels[:n_panels]


def thinned(points: np.ndarray) -> np.ndarray:
    """Keep as many points as a picture can show.

    :param points: shape ``(n, goal_dim)``
    """
    return points[:: max(1, -(-len(points) // _MAX_DOTS))]


def plot_frontier(
    axes: Axes, points: np.ndarray, values: np.ndarray, ends: np.ndarray, geometry: MazeGeometry | None, title: str
) -> None:
    """Colour what was visited by the Fiedler embedding, and mark its two ends (Figure 3).

    :param axes: where to draw
    :param points: visited states, shape ``(n, goal_dim)``
    :param values: the embedding there, shape ``(n,)``
    :param ends: where it is largest and smallest, shape ``(2, goal_dim)``
    :param geometry: the maze
    :param title: of the panel
    """
    figures.draw_floor(axes, geometry, points, 1.0)
    x, y = figures.project(points).T
    axes.scatter(x, y, c=values, s=3, cmap="Blues", vmin=values.min() - 0.4 * np.ptp(values), zorder=figures.Z_VISITED)
    axes.plot(*figures.project(ends).T, "o", color=figures.EVENT, markersize=8, zorder=figures.Z_EVENT)
    axes.set_title(title)


def plot_visits(axes: Axes, points: np.ndarray, geometry: MazeGeometry | None, title: str) -> None:
    """Draw visited states, later ones darker (Figure 4).

    :param axes: where to draw
    :param points: in order of time, shape ``(n, goal_dim)``
    :param geometry: the maze
    :param title: of the panel
    """
    figures.draw_floor(axes, geometry, points, 1.0)
    shown = figures.project(thinned(points))
    colours = colormaps["viridis_r"](np.linspace(0.0, 1.0, len(shown)))
    axes.scatter(shown[:, 0], shown[:, 1], c=colours, s=3, zorder=figures.Z_VISITED)
    axes.set_title(title)


def plot_curves(
    axes: Axes, curves: Mapping[str, Curve], methods: Sequence[str], title: str, x_label: str = "environment steps"
) -> None:
    """Draw success against steps for several methods (Figure 5).

    :param axes: where to draw
    :param curves: by method
    :param methods: all there are, on other panels, too: each has its colour and dashes
    :param title: of the panel
    :param x_label: what the steps are
    """
    styles = _styles(methods)
    for name, curve in curves.items():
        axes.plot(curve.steps, curve.mean, label=name, **styles[name])
        axes.fill_between(curve.steps, curve.low, curve.high, color=styles[name]["color"], alpha=0.15, linewidth=0)
    axes.set(title=title, xlabel=x_label, ylabel="success rate (interquartile mean)", ylim=(-0.02, 1.02))
    axes.xaxis.set_major_formatter(EngFormatter(sep=""))
    axes.grid(alpha=0.3)


def add_legend(axes: Axes, methods: Sequence[str], shown: Collection[str]) -> None:
    """Name the curves, beside a panel.

    :param axes: the panel
    :param methods: all there are
    :param shown: those that some panel has a curve of
    """
    handles = [Line2D([], [], label=name, **style) for name, style in _styles(methods).items() if name in shown]
    axes.legend(handles=handles, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5), frameon=False)


def _styles(methods: Sequence[str]) -> dict[str, dict[str, Any]]:
    """Later lines lie on top of earlier ones, which show through their gaps where they coincide."""
    colours = colormaps["tab10" if len(methods) <= 10 else "tab20"]
    dashes = ["-", (0, (6, 3)), (0, (3, 5)), (0, (1, 5))]
    return {
        name: dict(color=colours(i % colours.N), linestyle=dashes[i % len(dashes)], linewidth=2, marker="o", markersize=3)
        for i, name in enumerate(methods)
    }


def plot_growth(axes: Axes, snapshot: GraphSnapshot, geometry: MazeGeometry | None, name: str) -> None:
    """Draw events and what joins them at one moment (Figure 6).

    :param axes: where to draw
    :param snapshot: the graph then
    :param geometry: the maze
    :param name: of the run
    """
    figures.draw_floor(axes, geometry, snapshot.centers, 1.0)
    centers = figures.project(snapshot.centers)
    for source, target in snapshot.links:
        axes.plot(*centers[[source, target]].T, color="#3182bd", linewidth=1.0, zorder=figures.Z_LINK)
    axes.plot(*centers.T, "o", color=figures.EVENT, markersize=5, zorder=figures.Z_EVENT)
    n_joined = len({frozenset(link) for link in snapshot.links})
    axes.set_title(f"{name}, {snapshot.steps:,} steps:\n{len(centers)} events, {n_joined} joined pairs")


def plot_missed(
    axes: Axes, visited: np.ndarray, events: np.ndarray, missed: np.ndarray, geometry: MazeGeometry | None, title: str
) -> None:
    """Draw what was visited, the events, and goals that were missed (Figure 9).

    :param axes: where to draw
    :param visited: shape ``(n, goal_dim)``
    :param events: centres, shape ``(m, goal_dim)``
    :param missed: goals not reached, shape ``(k, goal_dim)``
    :param geometry: the maze
    :param title: of the panel
    """
    figures.draw_floor(axes, geometry, visited, 1.0)
    axes.plot(*figures.project(thinned(visited)).T, ".", color=figures.VISITED, markersize=2, zorder=figures.Z_VISITED)
    axes.plot(
        *figures.project(events).T, "o", color=figures.EVENT, markersize=6, label="salient event", zorder=figures.Z_EVENT
    )
    if len(missed):
        axes.plot(*figures.project(missed).T, "x", color="#d7301f", label="goal missed", zorder=figures.Z_LABEL)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.12), ncols=2, fontsize=8, frameon=False)
    axes.set_title(title)
