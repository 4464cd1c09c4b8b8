"""One plan, and what happened when it was followed: which option took the agent where (section 3.3)."""

import itertools
from collections.abc import Iterator
from typing import NamedTuple

import gymnasium as gym
import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.envs import MazeGeometry
from sb3_skillgraph.evaluation import judge
from sb3_skillgraph.plan import Plan
from sb3_skillgraph.planning import DIRECT
from sb3_skillgraph.plotting import figures

_PALETTE = colormaps["tab20"].colors  # type: ignore[attr-defined]
_OPTION_COLORS = (*_PALETTE[::2], *_PALETTE[1::2])  # the strong ones first: as many as runs are named, all different
#: Runs of options that the legend names; more would not fit.
MAX_NAMED = 14


class Trajectory(NamedTuple):
    """One executed episode.

    :param points: where the agent was, shape ``(n_steps + 1, goal_dim)``
    :param options: id of the option that ran at each step
    :param goal: where it was to go, shape ``(goal_dim,)``
    :param success: whether it got there
    """

    points: np.ndarray
    options: list[str]
    goal: np.ndarray
    success: bool


class FollowedStep(NamedTuple):
    """A step of an agent on its way to a goal.

    :param point: where it led, shape ``(goal_dim,)``
    :param option: id of the option that ran
    :param over: whether the episode is over
    :param reached: whether the goal is reached
    """

    point: np.ndarray
    option: str
    over: bool
    reached: bool


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
    points = [np.array(observation["achieved_goal"], dtype=np.float64)]
    steps = list(follow(agent, env, observation))
    points += [step.point for step in steps]
    reached = steps[-1].reached if steps else True  # it was there from the beginning
    return Trajectory(np.stack(points), [step.option for step in steps], target, reached), plan


def follow(agent: SkillGraphAgent, env: gym.Env, observation: dict[str, np.ndarray]) -> Iterator[FollowedStep]:
    """Let an agent go to a goal, a step at a time, until it is there, the episode ends, or the agent is stuck.

    :param agent: the agent
    :param env: a goal environment whose episode has begun
    :param observation: what it showed then; its goal is pursued to the end
    :return: the steps; none if the agent is there from the beginning
    """
    goal = observation["desired_goal"]
    has_reached = judge(agent, env)
    state: tuple[np.ndarray, ...] | None = None
    over = has_reached(observation, {})
    while not over:
        action, state = agent.predict({**observation, "desired_goal": goal}, state=state, deterministic=True)
        assert state is not None
        observation, _, terminated, truncated, info = env.step(action)
        point = np.array(observation["achieved_goal"], dtype=np.float64)
        reached = has_reached({**observation, "desired_goal": goal}, info)
        over = reached or terminated or truncated or bool(info.get("stuck"))
        yield FollowedStep(point, agent.running(state)[0], over, reached)


def plot_plan(
    agent: SkillGraphAgent,
    geometry: MazeGeometry | None,
    trajectory: Trajectory,
    plan: Plan,
    ax: Axes | None = None,
) -> Axes:
    """
    Draw a plan (dashed) and the episode in which it was followed, coloured by the option that ran.

    :param agent: the agent
    :param geometry: the maze, for its walls; None for an environment without one
    :param trajectory: what happened
    :param plan: what was planned at its start
    :param ax: axes to draw on; None for a new figure
    :return: the axes
    """
    axes = figures.new_axes() if ax is None else ax
    figures.draw_floor(axes, geometry, np.vstack([trajectory.points, trajectory.goal]), 2 * figures.disc_radius(agent))
    draw_planned(axes, agent, geometry, trajectory, plan)
    _draw_runs(axes, agent, trajectory)
    start, goal = figures.project(np.stack([trajectory.points[0], trajectory.goal]))
    axes.plot(*start, "o", color=figures.START, markersize=10, markeredgecolor="white", zorder=figures.Z_LABEL, label="start")
    figures.draw_disc(
        axes, trajectory.goal, figures.disc_radius(agent), facecolor=figures.GOAL, alpha=0.2, zorder=figures.Z_REGION
    )
    axes.plot(*goal, "*", color=figures.GOAL, markersize=15, markeredgecolor="white", zorder=figures.Z_LABEL, label="goal")
    happened = "reached" if trajectory.success else "missed"
    axes.set_title(
        f"Promised: goal reached with probability {plan.success_probability:.0%}, in about {plan.expected_steps:.0f} steps\n"
        f"Happened: goal {happened} after {len(trajectory.options)} steps"
    )
    axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), fontsize=8, frameon=False)
    return axes


def draw_planned(
    axes: Axes, agent: SkillGraphAgent, geometry: MazeGeometry | None, trajectory: Trajectory, plan: Plan
) -> None:
    """Draw a plan from event to event.

    :param axes: where to draw
    :param agent: the agent
    :param geometry: the maze; None for an environment without one
    :param trajectory: its start and goal are those of the plan
    :param plan: the plan
    """
    events = {event.id: event for event in agent.events}
    planned = [events[id] for id in plan.path if id in events]
    stops = [trajectory.points[0], *(event.center for event in planned), trajectory.goal]
    axes.plot(
        *np.concatenate([figures.way(geometry, *ends) for ends in itertools.pairwise(stops)]).T,
        color=figures.PLAN,
        linestyle="--",
        linewidth=1.0,
        zorder=figures.Z_EVENT,
        label="the plan, from event to event",
    )
    for event in planned:
        figures.draw_disc(
            axes,
            event.center,
            figures.disc_radius(agent),
            facecolor="none",
            edgecolor=figures.PLAN,
            linewidth=0.7,
            alpha=0.5,
            zorder=figures.Z_EVENT,
        )
        x, y = figures.project(event.center[None])[0]
        axes.annotate(event.id, (float(x), float(y)), ha="center", va="center", fontsize=7, zorder=figures.Z_LABEL)


def _draw_runs(axes: Axes, agent: SkillGraphAgent, trajectory: Trajectory) -> None:
    """Draw one line for each run of an option, in the order of the runs."""
    points = figures.project(trajectory.points)
    changes = [i for i, (one, other) in enumerate(itertools.pairwise(trajectory.options), 1) if one != other]
    targets = {option.id: option.target for option in agent.options}
    for number, (begin, end) in enumerate(itertools.pairwise([0, *changes, len(trajectory.options)])):
        if begin == end:
            continue
        option = trajectory.options[begin]
        label = "walk to the goal itself" if option == DIRECT else f"{option} to {targets.get(option, '?')}"
        axes.plot(
            *points[begin : end + 1].T,
            color=_OPTION_COLORS[number % len(_OPTION_COLORS)],
            linewidth=2.5,
            zorder=figures.Z_LINK,
            label=label if number < MAX_NAMED else None,
        )
