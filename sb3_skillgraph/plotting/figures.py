"""What all figures share: axes, walls, the first two dimensions of goal space, saving."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, Rectangle

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.envs import MazeGeometry

# Colours that remain apart for the colour-blind; every figure means the same thing by them.
WALL, REGION, VISITED, EFFECT, EVENT = "#757575", "#9ecae1", "#969696", "#e6550d", "#111111"
START, GOAL, PLAN = "#2ca02c", "#d62728", "#111111"

#: Drawing order, from the floor up.
Z_REGION, Z_VISITED, Z_WALL, Z_EFFECT, Z_LINK, Z_EVENT, Z_LABEL = range(1, 8)


def new_axes() -> Axes:
    """Make a figure of its own with one pair of axes, and room for a legend."""
    figure = Figure(figsize=(8.5, 7.5), layout="constrained")
    return figure.add_subplot()


def project(points: np.ndarray) -> np.ndarray:
    """Keep the first two dimensions of goal space.

    :param points: shape ``(n, goal_dim)``
    :return: shape ``(n, 2)``; a second dimension of zeros if goal space has one only
    """
    points = np.asarray(points, dtype=np.float64)
    if points.shape[1] == 1:
        return np.column_stack([points, np.zeros(len(points))])
    return points[:, :2]


def draw_floor(axes: Axes, geometry: MazeGeometry | None, points: np.ndarray, margin: float) -> None:
    """Draw the walls, choose the visible rectangle and name the axes.

    :param axes: where to draw
    :param geometry: the maze; None for an environment without one
    :param points: states that must be visible, shape ``(n, goal_dim)``
    :param margin: space around them when there is no maze, in goal units
    """
    goal_dim = points.shape[1]
    if geometry is not None:
        # The edges cover the hairlines that would show between neighbouring cells.
        walls = [Rectangle((x, y), width, height) for x, y, width, height in geometry.walls()]
        axes.add_collection(PatchCollection(walls, facecolor=WALL, edgecolor=WALL, linewidth=0.5, zorder=Z_WALL))
        left, right, bottom, top = geometry.extent
    else:
        flat = project(points)
        low, high = flat.min(axis=0) - margin, flat.max(axis=0) + margin
        (left, bottom), (right, top) = low, high
    axes.set_xlim(left, right)
    axes.set_ylim(bottom, top)
    axes.set_aspect("equal")
    note = "" if goal_dim <= 2 else f" (of {goal_dim} goal dimensions)"
    axes.set_xlabel("x" if geometry is not None else f"goal[0]{note}")
    axes.set_ylabel("y" if geometry is not None else f"goal[1]{note}")
    if goal_dim == 1:  # drawn along a line
        axes.set_ylabel("")
        axes.set_yticks([])


def way(geometry: MazeGeometry | None, begin: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Return the line that stands for a walk: around the corners of a maze, straight elsewhere.

    :param geometry: the maze; None for an environment without one
    :param begin: shape ``(goal_dim,)``
    :param end: shape ``(goal_dim,)``
    :return: shape ``(n, 2)``
    """
    ends = project(np.stack([begin, end]))
    path = None if geometry is None else geometry.shortest_path(*ends)
    return ends if path is None else path


def disc_radius(agent: SkillGraphAgent) -> float:
    """Return the radius of the discs that stand for goals and events in a picture, in goal units.

    :param agent: whose events they are
    """
    return float(agent.metric.reach(agent.graph.goal_dim)[:2].max())


def draw_disc(axes: Axes, center: np.ndarray, radius: float, **style: Any) -> Circle:
    """Draw the ball of a salient event or a goal.

    :param axes: where to draw
    :param center: shape ``(goal_dim,)``
    :param radius: radius, in goal units
    :param style: matplotlib's patch properties
    :return: the patch
    """
    x, y = project(center[None])[0]
    disc = Circle((float(x), float(y)), radius, **style)
    axes.add_patch(disc)
    return disc


def save_figure(axes: Axes, path: str | Path) -> None:
    """Write the figure that some axes belong to.

    :param axes: axes of the figure
    :param path: file; its ending tells the format
    :raises ValueError: if it has none, or one that is not known
    """
    path = Path(path)
    if not path.suffix:
        raise ValueError(f"{path} has no ending that tells what picture to make: .png, .svg or .pdf.")
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.savefig(path, dpi=150, bbox_inches="tight")
