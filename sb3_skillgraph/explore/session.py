"""One visitor of an agent: a start, a goal, the plan, and what happens when it is followed."""

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.events import Event
from sb3_skillgraph.plan import Plan, next_best
from sb3_skillgraph.plotting.plan import follow
from sb3_skillgraph.plotting.skill_graph import EventLink


class Progress(NamedTuple):
    """Where a run stands.

    :param points: where the agent has been, shape ``(n + 1, goal_dim)``
    :param options: ids of the options that ran, ``n`` of them
    :param over: whether the episode is over
    :param success: whether the goal is reached
    """

    points: np.ndarray
    options: list[str]
    over: bool
    success: bool

    @property
    def outcome(self) -> str:
        """What has happened, in words, when it is over."""
        return f"goal {'reached' if self.success else 'missed'} after {len(self.options)} steps"


class Session:
    """Plans and goes from one place to another; a visitor each has one, with an environment of its own.

    :param agent: the agent; it is looked at only
    :param env: the environment
    :param seed: of the environment
    """

    def __init__(self, agent: SkillGraphAgent, env: gym.Env, seed: int = 0) -> None:
        self.agent = agent
        self.env = env
        self.seed = seed
        observation, _ = env.reset(seed=seed)
        self.start = np.array(observation["achieved_goal"], dtype=np.float64)
        self.goal = np.array(observation["desired_goal"], dtype=np.float64)
        self._observation: dict[str, np.ndarray] = observation

    def place(self, what: str, dims: tuple[int, int], point: np.ndarray) -> None:
        """Choose a start or a goal.

        :param what: ``"start"`` or ``"goal"``
        :param dims: the two dimensions of a goal that are given
        :param point: their values, shape ``(2,)``
        :raises ValueError: if it is no place to be, or the environment begins where it likes
        """
        wanted = {"start": self.start.copy(), "goal": self.goal.copy()}
        wanted[what][list(dims)] = point
        self._observation = self._begin(**wanted)
        self.start, self.goal = wanted["start"], wanted["goal"]

    def _begin(self, start: np.ndarray, goal: np.ndarray) -> dict[str, np.ndarray]:
        """Begin an episode; where the environment draws its goals itself it is told another one all the same."""
        # With a seed, so that it begins in the same place again where it draws that, too.
        try:
            observation, _ = self.env.reset(seed=self.seed, options={"start": start, "goal": goal})
        except TypeError:  # it takes no options
            observation, _ = self.env.reset(seed=self.seed)
        begun = np.asarray(observation["achieved_goal"], dtype=np.float64)
        if not self.agent.metric.reached(begun, start):
            raise ValueError(f"this environment begins where it likes: at {begun.round(2).tolist()}.")
        space: Any = self.agent.observation_space
        told = goal.astype(space["desired_goal"].dtype)
        return {**observation, "desired_goal": told}

    def plan(self) -> Plan:
        """Return the plan that is followed."""
        return self.agent.plan(self._observation)

    def next_best(self) -> Plan | None:
        """Return the best plan that begins otherwise; None if there is none, or the paper's rules make the plans."""
        if self.agent.rules is not None:
            return None
        return next_best(self.agent.parts.runner, self._observation["achieved_goal"], self._observation["desired_goal"])

    def go(self) -> Iterator[Progress]:
        """Follow the plan in the environment, a step at a time."""
        self._observation = self._begin(self.start, self.goal)
        points, options = [np.array(self._observation["achieved_goal"], dtype=np.float64)], []
        for step in follow(self.agent, self.env, self._observation):
            points.append(step.point)
            options.append(step.option)
            yield Progress(np.stack(points), options, step.over, step.reached)

    def close(self) -> None:
        """Let go of the environment."""
        self.env.close()


def promised(plan: Plan) -> str:
    """Say what a plan promises."""
    return f"probability {plan.success_probability:.0%}, about {plan.expected_steps:.0f} steps"


def record_of(agent: SkillGraphAgent, event: Event, links: Sequence[EventLink]) -> dict[str, Any]:
    """Return what is known of an event, of the options that lead to it, and of those that begin there.

    :param agent: the agent
    :param event: one of its events
    :param links: all of the agent's links
    :return: ``id``, ``kind``, ``center``; ``reached_by``: in words, the options that lead to it and the events in which they
        can begin; ``rows``: of each option that begins there its id, where it leads, runs that succeeded and failed, what is
        expected of it, and where its runs landed
    """
    graph = agent.graph.nx
    leading = [id for id, vertex in graph.nodes(data=True) if vertex.get("target") == event.id]
    reached_by = "; ".join(f"{id} can begin in {', '.join(graph.predecessors(id)) or 'no event yet'}" for id in leading)
    expected = {link.target: link for link in links if link.source == event.id}
    rows = []
    for option in graph.successors(event.id):
        target = graph.nodes[option].get("target")
        link = expected.get(target)
        record = graph.edges[event.id, option]
        landed = sorted(((_rate(graph.edges[option, end]), end) for end in graph.successors(option)), reverse=True)[:3]
        rows.append(
            {
                "option": option,
                "to": target,
                "succeeded": round(record["successes"], 1) if "successes" in record else "-",
                "failed": round(record["failures"], 1) if "failures" in record else "-",
                "expected": "-" if link is None else f"{link.success_probability:.0%}",
                "steps": "-" if link is None else round(link.steps),
                "lands in": ", ".join(f"{end} {rate:.0%}" for rate, end in landed),
            }
        )
    kind = "salient event" if event.salient else "landmark"
    center = np.round(event.center, 3).tolist()
    return {"id": event.id, "kind": kind, "center": center, "reached_by": reached_by, "rows": rows}


def _rate(landing: dict[str, Any]) -> float:
    """Return the share of an option's runs that landed somewhere; by the paper's rules, of those that succeeded."""
    return float(landing.get("rate", landing.get("success_rate", 0.0)))
