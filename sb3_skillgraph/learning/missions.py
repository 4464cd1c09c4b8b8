"""What the agent is about while it learns: where to go, and to explore from there (sections 3.2.2, 3.2.4)."""

from abc import ABC, abstractmethod
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from sb3_skillgraph.edges import NOWHERE
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.learning.salience import Salience, box_around
from sb3_skillgraph.running import Run

#: Failed runs after which a mission is given up.
MAX_FAILURES = 3
#: Share of the missions that explore; the others travel to any event. Fewer explorations make a worse walker.
EXPLORE = 0.9
#: Proposals of which an exploration takes the one whose nearest event has been visited least: at least, and one for so many
#: events, so that in a large graph, too, one of them lies where it ends, and not only behind some wall within it.
LEAST_PROPOSALS, EVENTS_PER_PROPOSAL = 3, 20
#: Share of the explorations that go on towards the proposed point, in a graph of so few events, and of so many or more. The
#: others walk at random, which finds what is near and teaches a walker much, but comes to nothing new in a large graph.
LEAST_TOWARDS, MOST_TOWARDS, FEW_EVENTS, MANY_EVENTS = 0.5, 0.8, 50, 100
#: Share of the explorations that begin further away where nearer ones have found nothing: of a graph of twice MANY_EVENTS; in
#: one of MANY_EVENTS, where all is near, none. The others begin in the event nearest to the point. With all of them ways to
#: travel were shorter, and what trains the walker is travelling.
FROM_FURTHER = 0.5
#: Share of the missions that look for a way to a goal which adaptation is for, while nobody has been there, rather than go
#: straight there; of those the share that sets out from the event nearest to it: often, but what lies nearest may be the far
#: side of a wall.
LOOK_FOR_A_WAY, FROM_NEAREST = 0.8, 0.3
#: Points of the box that are drawn to find one where nobody has been: where 10 % of it is unknown one of 20 lies there.
N_DRAWN = 20
#: Share of the missions without noise: noise makes its own luck, and only runs without it go into records.
CLEAN = 0.5


@dataclass
class Mission:
    """What one environment's agent is about.

    :param goal: where it travels over the graph, shape ``(goal_dim,)``
    :param explore_steps: environment steps to explore on arrival
    :param beyond: the point to explore towards; None for a random walk
    :param begins_in: id of the event that the exploration is to begin in; empty for anywhere
    :param exploring: whether exploration has begun
    :param n_failures: failed runs on the way
    :param clean: whether the policy acts without noise, as it does in ``predict``, so that runs tell what it can do
    """

    goal: np.ndarray
    explore_steps: int = 0
    beyond: np.ndarray | None = None
    begins_in: str = ""
    exploring: bool = False
    n_failures: int = 0
    clean: bool = False

    @property
    def random_walk(self) -> bool:
        """Whether actions are to be random now."""
        return self.exploring and self.beyond is None


class Agenda(ABC):
    """What every environment's agent is about; how that is chosen, and when it is over, is for its subclasses to say.

    :param graph: the skill graph
    :param salience: proposes salient events
    :param exploration_steps: environment steps of an exploration
    :param rng: random generator
    """

    def __init__(self, graph: SkillGraph, salience: Salience, exploration_steps: int, rng: np.random.Generator) -> None:
        self.graph = graph
        self.salience = salience
        self.exploration_steps = exploration_steps
        self.rng = rng
        self.pinned: np.ndarray | None = None  # the goal that adaptation is for
        self.current: list[Mission | None] = []

    def cut(self, n_envs: int) -> None:
        """Forget what the environments were in the middle of."""
        self.current = [None] * n_envs

    def of(self, env: int, point: np.ndarray, warm_up: bool) -> Mission:
        """Return an environment's mission; a new one where the last is over.

        :param env: which environment
        :param point: where the agent stands, shape ``(goal_dim,)``
        :param warm_up: whether to walk at random, whatever there is to do
        """
        mission = self.current[env]
        if mission is None:
            mission = self._random_walk(point) if warm_up else self._choose(point)
            self.current[env] = mission
        return mission

    @abstractmethod
    def observe(self, env: int, point: np.ndarray, run: Run | None, done: bool) -> bool:
        """Learn that a step was taken.

        :param env: which environment
        :param point: where the agent has got to, shape ``(goal_dim,)``
        :param run: the run that has ended with it
        :param done: whether the episode is over
        :return: whether the agent is to do something else now
        """

    def discovered(self, env: int) -> None:  # noqa: B027
        """The agent has come where it has never been."""

    @abstractmethod
    def _choose(self, point: np.ndarray) -> Mission: ...

    def _random_walk(self, point: np.ndarray) -> Mission:
        return Mission(point.astype(np.float64), explore_steps=self.exploration_steps, exploring=True)

    # -- saving -------------------------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Return the missions as plain data."""
        return {"current": [None if mission is None else asdict(mission) for mission in self.current]}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self.current = [None if spec is None else Mission(**spec) for spec in state["current"]]


class Missions(Agenda):
    """Chooses missions, and tells when they are over.

    :param graph: the skill graph
    :param salience: proposes salient events
    :param exploration_steps: environment steps of an exploration
    :param explore_beyond: event radii that an exploration towards a point goes on past it
    :param rng: random generator
    """

    def __init__(
        self,
        graph: SkillGraph,
        salience: Salience,
        exploration_steps: int,
        explore_beyond: float,
        rng: np.random.Generator,
    ) -> None:
        super().__init__(graph, salience, exploration_steps, rng)
        self.explore_beyond = explore_beyond

    def observe(self, env: int, point: np.ndarray, run: Run | None, done: bool) -> bool:
        """Learn that a step was taken: the mission may be over, or its exploration begin, or turn to another point."""
        mission = self.current[env]
        assert mission is not None
        was_exploring = mission.exploring
        if run is not None and mission.exploring and mission.beyond is not None:
            # Whether it has arrived or stands before a wall, from here it goes on towards another point
            proposal = self.salience.propose(self.rng)
            beyond = self.graph.metric.beyond
            mission.beyond = None if proposal is None else beyond(point, proposal, self.explore_beyond)
        elif run is not None:
            # Failed runs on the way are counted: who cannot get there does something else
            mission.n_failures += not run.success
        over = self._over(mission, point)
        if over or done:
            self.current[env] = None
        return over or done or mission.exploring != was_exploring

    def discovered(self, env: int) -> None:
        """The agent has come where it has never been: an exploration goes on while it finds something."""
        mission = self.current[env]
        if mission is not None and mission.exploring:
            mission.explore_steps = self.exploration_steps
            self.graph.explored(mission.begins_in, found=True)

    def _over(self, mission: Mission, point: np.ndarray) -> bool:
        """Whether a mission is over; an exploration begins on arrival, and ends after its steps."""
        if mission.exploring:
            mission.explore_steps -= 1
            return mission.explore_steps <= 0
        arrived = self.graph.metric.reached(point, mission.goal)
        if not arrived and mission.n_failures >= MAX_FAILURES:
            # Who cannot travel yet explores where it is: standing before a wall teaches nothing.
            mission.beyond, mission.explore_steps, arrived = None, self.exploration_steps, True
        mission.exploring = arrived and mission.explore_steps > 0
        if mission.exploring:
            self.graph.explored(mission.begins_in, found=False)
        return arrived and not mission.exploring

    # -- choosing -----------------------------------------------------------------------------------------------------

    def _choose(self, point: np.ndarray) -> Mission:
        mission = self._pick(point)
        mission.clean = not mission.random_walk and bool(self.rng.random() < CLEAN)
        return mission

    def _pick(self, point: np.ndarray) -> Mission:
        if self.pinned is not None:
            return self._adapt(point, self.pinned)
        if self.rng.random() < EXPLORE:
            return self._explore(point)
        return self._travel()

    def _travel(self) -> Mission:
        """Go to any event."""
        return Mission(self.graph.centers[self.rng.integers(len(self.graph.events))].copy())

    def _explore(self, point: np.ndarray) -> Mission:
        """Go to an event near a proposed point, and on towards it or at random.

        Of some proposals it is the one whose event has been visited least.
        """
        # Travel to where the graph ends before a proposed point, and explore from there
        n = max(LEAST_PROPOSALS, len(self.graph.events) // EVENTS_PER_PROPOSAL)
        proposals = [self.salience.propose(self.rng) for _ in range(n)]
        points = [proposal for proposal in proposals if proposal is not None]
        if not points:
            return self._random_walk(point)
        # Of several, the one that lies where the agent has been least: there is most to find
        chance = float(self.rng.random())
        departures = self._departures(points, chance)
        rarest = int(np.argmin(self.graph.visits[departures]))
        return self._beyond(departures[rarest], points[rarest], chance)

    def _departures(self, points: list[np.ndarray], chance: float) -> list[int]:
        """Return the event to explore from, towards each of some points.

        It is the nearest one; but where explorations have kept finding nothing a wall may stand between the two, and the way
        may begin further away: for some they count as distance, by the root of their number.
        """
        n_events = len(self.graph.events)
        weight = np.ones(n_events)
        if chance < np.interp(n_events, (MANY_EVENTS, 2 * MANY_EVENTS), (0.0, FROM_FURTHER)):
            weight = np.sqrt(1.0 + self.graph.barren)
        return [int((weight * self.graph.distances(point)).argmin()) for point in points]

    def _beyond(self, event: int, point: np.ndarray, chance: float) -> Mission:
        """Explore from an event, towards a point if chance wants it so, else at random."""
        goal, begins_in = self.graph.centers[event].copy(), self.graph.id(event)
        if chance >= np.interp(len(self.graph.events), (FEW_EVENTS, MANY_EVENTS), (LEAST_TOWARDS, MOST_TOWARDS)):
            return Mission(goal, self.exploration_steps, None, begins_in)
        beyond = self.graph.metric.beyond(goal, point, self.explore_beyond)
        return Mission(goal, self.exploration_steps, beyond, begins_in)

    def _adapt(self, point: np.ndarray, goal: np.ndarray) -> Mission:
        """Pursue the goal that adaptation is for; look for a way to it while nobody has been there (section 3.3)."""
        if self.graph.metric.reached(point, goal):
            return self._travel()  # to come back from somewhere else
        if self.graph.locate(goal) == NOWHERE and self.rng.random() < LOOK_FOR_A_WAY:
            return self._look_for(goal)
        return Mission(goal.copy())

    def _look_for(self, goal: np.ndarray) -> Mission:
        """Go to an event near the goal, or near any other place that nobody knows, and on from there."""
        place = goal
        if self.rng.random() >= FROM_NEAREST:
            box = box_around(np.concatenate([self.graph.centers, goal[None]]), self.graph.metric)
            points = self.rng.uniform(*box, (N_DRAWN, self.graph.goal_dim))
            place = next((point for point in points if self.graph.locate(point) == NOWHERE), goal)
        chance = float(self.rng.random())
        return self._beyond(self._departures([place], chance)[0], place, chance)
