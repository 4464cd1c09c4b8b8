"""One plan as it was executed: which option took the agent where (section 3.3)."""

import itertools
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.controller import GLOBAL
from sb3_skillgraph.envs import MazeGeometry
from sb3_skillgraph.planner import Plan
from sb3_skillgraph.plotting import figures

_OPTION_COLORS = colormaps["tab10"].colors  # type: ignore[attr-defined]
_GLOBAL_COLOR, _GOAL_COLOR, _START_COLOR = "#7f7f7f", "#d62728", "#2ca02c"


class Trajectory(NamedTuple):
    """One executed episode.

    :param points: where the agent was, shape ``(n_steps + 1, goal_dim)``
    :param options: index of the option that ran at each step, shape ``(n_steps,)``; 0 is the global option, k is ``ok``
    :param goal: where it was to go, shape ``(goal_dim,)``
    :param success: whether it got there
    """

    points: np.ndarray
    options: np.ndarray
    goal: np.ndarray
    success: bool


def run_plan(
    agent: SkillGraphAgent, env: gym.Env, start: np.ndarray | None = None, goal: np.ndarray | None = None
) -> tuple[Trajectory, Plan]:
    """
    Plan, and execute one episode, until the goal is reached, the episode ends, or the agent is stuck.

    :param agent: the agent
    :param env: a goal environment; start and goal need one whose ``reset`` takes them as ``options``
    :param start: where to start, shape ``(goal_dim,)``; None for the environment's own start
    :param goal: where to go, shape ``(goal_dim,)``; None for the environment's own goal
    :return: what happened, and the plan made at the start
    """
    given = {name: point for name, point in (("start", start), ("goal", goal)) if point is not None}
    observation, _ = env.reset(options=given or None)
    plan = agent.plan(observation)
    target = np.array(observation["desired_goal"], dtype=np.float64)
    points, options = [np.array(observation["achieved_goal"], dtype=np.float64)], []
    state: tuple[np.ndarray, ...] | None = None
    reached = over = bool(np.linalg.norm(points[0] - target) <= agent.event_radius)
    while not over:
        action, state = agent.predict(observation, state=state, deterministic=True)
        assert state is not None
        options.append(int(state[0][0]))
        observation, _, terminated, truncated, info = env.step(action)
        points.append(np.array(observation["achieved_goal"], dtype=np.float64))
        reached = bool(np.linalg.norm(points[-1] - target) <= agent.event_radius)
        over = reached or terminated or truncated or bool(info.get("stuck"))
    return Trajectory(np.stack(points), np.array(options, dtype=np.int64), target, reached), plan


def plot_plan(
    agent: SkillGraphAgent,
    geometry: MazeGeometry | None,
    trajectory: Trajectory,
    plan: Plan,
    ax: Axes | None = None,
) -> Axes:
    """
    Draw an executed episode, coloured by the option that ran, over the events of the plan made at its start.

    :param agent: the agent
    :param geometry: the maze, for its walls; None for an environment without one
    :param trajectory: what happened
    :param plan: what was planned
    :param ax: axes to draw on; None for a new figure
    :return: the axes
    """
    axes = figures.new_axes() if ax is None else ax
    figures.draw_floor(axes, geometry, np.vstack([trajectory.points, trajectory.goal]), 2 * agent.event_radius)
    _draw_planned(axes, agent, plan)
    _draw_runs(axes, agent, trajectory)
    start, goal = figures.project(np.stack([trajectory.points[0], trajectory.goal]))
    axes.plot(*start, "o", color=_START_COLOR, markersize=10, markeredgecolor="white", zorder=figures.Z_LABEL, label="start")
    figures.draw_disc(axes, trajectory.goal, agent.event_radius, facecolor=_GOAL_COLOR, alpha=0.2, zorder=figures.Z_REGION)
    axes.plot(*goal, "*", color=_GOAL_COLOR, markersize=15, markeredgecolor="white", zorder=figures.Z_LABEL, label="goal")
    n_steps = len(trajectory.options)
    axes.set_title(f"Goal {'reached' if trajectory.success else 'missed'} after {n_steps} steps\n{_describe(plan)}")
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=8, frameon=False)
    return axes


def _describe(plan: Plan) -> str:
    case = {"in_graph": "in the graph", "in_initiation_set": "in an initiation set", "outside": "outside the graph"}
    straight = "straight to the goal" if np.isfinite(plan.cost) else "none, no path leads there yet"
    way = " > ".join(plan.path) or straight
    return f"goal {case[plan.status]}; plan: {way}"


def _draw_planned(axes: Axes, agent: SkillGraphAgent, plan: Plan) -> None:
    """Mark the events of the plan; its options show where they run."""
    planned = [agent.graph.events[id] for id in plan.path if id in agent.graph.events]
    for i, event in enumerate(planned):
        figures.draw_disc(
            axes,
            event.center,
            event.radius,
            facecolor="none",
            edgecolor=figures.EVENT,
            linestyle="--",
            zorder=figures.Z_EVENT,
            label="planned event" if i == 0 else None,
        )
        x, y = figures.project(event.center[None])[0]
        axes.annotate(event.id, (float(x), float(y) + event.radius), ha="center", va="bottom", fontsize=8, zorder=7)


def _draw_runs(axes: Axes, agent: SkillGraphAgent, trajectory: Trajectory) -> None:
    """Draw one line per run of an option; an option that runs again keeps its colour."""
    points = figures.project(trajectory.points)
    changes = np.flatnonzero(np.diff(trajectory.options)) + 1
    bounds = [0, *changes.tolist(), len(trajectory.options)]
    style: dict[str, Any]
    colors: dict[int, tuple[float, float, float]] = {}
    shown = set()
    for begin, end in itertools.pairwise(bounds):
        if begin == end:
            continue
        index = int(trajectory.options[begin])
        if index == GLOBAL:
            label, style = "global option", dict(color=_GLOBAL_COLOR, linestyle=":", linewidth=2.5)
        else:
            color = colors.setdefault(index, _OPTION_COLORS[len(colors) % len(_OPTION_COLORS)])
            target = agent.controller.option(index).target
            label, style = f"option o{index} (to {target})", dict(color=color, linewidth=2.5)
        axes.plot(*points[begin : end + 1].T, **style, zorder=figures.Z_LINK, label=None if index in shown else label)
        shown.add(index)
