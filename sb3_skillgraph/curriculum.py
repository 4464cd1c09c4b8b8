"""What the agent does while it learns: which target to pursue, and what each run teaches (sections 3.2.1-3.2.7)."""

import math
from dataclasses import asdict
from typing import Any

import numpy as np

from sb3_skillgraph.chaining import DeepSkillChaining, SkillChain
from sb3_skillgraph.controller import GLOBAL, OptionOutcome
from sb3_skillgraph.events import SalientEvent
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.missions import Mission, Strategy
from sb3_skillgraph.planner import GraphPlanner
from sb3_skillgraph.salience.discovery import EventDiscovery
from sb3_skillgraph.visited import VisitedStates

N_EXPLORED = 10  # candidates for an exploration
LOOK_FOR_A_WAY = 0.75  # share of explorations among the missions to a goal that nothing ever came near
JOINED_ALREADY = 3.0  # option runs the agent goes further to practise a chain that joins a new event


class Curriculum:
    """Gives every environment its missions, and turns outcomes into knowledge.

    :param graph: the skill graph
    :param chaining: the chains and their options
    :param planner: finds ways over the graph
    :param visited: the agent's trajectories
    :param discovery: adds salient events
    :param strategy: how targets are chosen
    :param timeout: environment steps an option may run
    :param rng: random generator
    :param n_envs: number of environments
    """

    def __init__(
        self,
        graph: SkillGraph,
        chaining: DeepSkillChaining,
        planner: GraphPlanner,
        visited: VisitedStates,
        discovery: EventDiscovery,
        strategy: Strategy,
        timeout: int,
        rng: np.random.Generator,
        n_envs: int,
    ) -> None:
        self.graph = graph
        self.chaining = chaining
        self.planner = planner
        self.visited = visited
        self.discovery = discovery
        self.strategy = strategy
        self.timeout = timeout
        self.rng = rng
        self._missions: list[Mission | None] = [None] * n_envs
        self.n_episodes = 0
        self.n_stuck = 0
        self.pinned: str | None = None  # target of few-shot adaptation
        self._pinned_goal: np.ndarray | None = None  # the same, before it is an event
        self._paths: list[list[np.ndarray]] = [[] for _ in range(n_envs)]  # of the running option
        self._since_event: list[list[np.ndarray]] = [[] for _ in range(n_envs)]  # since the last event was left
        self._last_event: list[str | None] = [None] * n_envs

    # -- one step -----------------------------------------------------------------------------------------------------

    @property
    def missions(self) -> list[Mission]:
        """What each environment's agent is about."""
        return [mission for mission in self._missions if mission is not None]

    def assign(self, env: int, point: np.ndarray, warm_up: bool = False) -> None:
        """Give an environment a mission if it has none, and note whether it stands where its chain begins.

        :param env: which environment
        :param point: where its agent stands, shape ``(goal_dim,)``
        :param warm_up: whether there is nothing but random walks yet
        """
        mission = self._missions[env]
        if mission is None:
            if not self.graph.events:
                self._begin(point)
            if self._pinned_goal is not None:
                self.pinned = self._pinned_event(self._pinned_goal).id
                self._pinned_goal = None
            mission = self._missions[env] = self._random_walk() if warm_up else self._choose(point)
        if mission.chain is not None and not mission.left_graph:
            source = self.graph.events[self.chaining.chains[mission.chain].source]
            mission.left_graph = source.holds(point)

    def cut(self, n_envs: int) -> None:
        """Forget what every environment was in the middle of: they have been reset.

        :param n_envs: number of environments from now on
        """
        self._missions = [None] * n_envs
        self._paths = [[] for _ in range(n_envs)]
        self._since_event = [[] for _ in range(n_envs)]
        self._last_event = [None] * n_envs

    def pin(self, goal: np.ndarray) -> None:
        """Pursue one goal and nothing else, until :meth:`unpin` (section 3.3); it becomes an event with the next mission.

        :param goal: shape ``(goal_dim,)``
        """
        self._pinned_goal = goal

    def unpin(self) -> None:
        """Pursue what the agent pursues by itself again."""
        self.pinned, self._pinned_goal = None, None

    def _pinned_event(self, goal: np.ndarray) -> SalientEvent:
        event = self.planner.event_at(goal)
        if event is None or np.linalg.norm(event.center - goal) > 0.5 * event.radius:
            event = self.discovery.add(goal)
            self._join(event)
        return event

    def _begin(self, point: np.ndarray) -> None:
        """The first event is where the agent starts (section 3.2.7 calls it beta_0)."""
        event = self.discovery.add(point)
        self.discovery.newest = event.id
        self._events_changed()

    def _events_changed(self) -> None:
        events = list(self.graph.events.values())
        self.visited.set_events(np.stack([e.center for e in events]), np.array([e.radius for e in events]))

    def observe(
        self,
        env: int,
        before: np.ndarray,
        after: np.ndarray,
        outcome: OptionOutcome | None,
        done: bool,
        stuck: bool = False,
    ) -> bool:
        """Learn from one environment step.

        :param env: which environment
        :param before: where its agent stood, shape ``(goal_dim,)``
        :param after: where it stands now (the last state of the episode, if it ended), as :class:`VisitedStates` has it
        :param outcome: what became of the option it ran, if that ended
        :param done: whether the episode ended
        :param stuck: whether it was given up since the agent got stuck
        :return: whether the running option must be cut short, since the mission has changed
        """
        self._paths[env].append(before)
        if not stuck:
            self._track_events(env, before, after)
        mission = self._missions[env]
        assert mission is not None
        if outcome is not None:
            self._learn(env, outcome, after, stuck)
            mission.n_failures += not outcome.success
        was_exploring = mission.exploring
        over = self._mission_over(mission, after)
        if over or done:
            self._missions[env] = None
        if outcome is not None or over or done:
            self._paths[env] = []
        if done:
            self.n_episodes += 1
            self.n_stuck += stuck
            self._since_event[env], self._last_event[env] = [], None
        return over or done or mission.exploring != was_exploring

    def _learn(self, env: int, outcome: OptionOutcome, end: np.ndarray, stuck: bool) -> None:
        if outcome.option == GLOBAL:
            return
        option = self.chaining.options[f"o{outcome.option}"]
        path = np.stack(self._paths[env])
        if stuck:
            self.chaining.learn_stuck(option)
        elif outcome.success:
            self.chaining.learn_success(option, path, end)
        else:
            self.chaining.learn_failure(option, path[0])

    def _mission_over(self, mission: Mission, point: np.ndarray) -> bool:
        """Whether a mission has ended; an exploration begins on arrival, and ends after its steps."""
        if mission.exploring:
            mission.explore_steps -= 1
            return mission.explore_steps <= 0
        if math.dist(point.tolist(), mission.goal.tolist()) > self.discovery.radius:
            return mission.n_failures >= self.strategy.max_tries
        mission.exploring = mission.explore_steps > 0
        return not mission.exploring

    # -- events passed ------------------------------------------------------------------------------------------------

    def _track_events(self, env: int, before: np.ndarray, after: np.ndarray) -> None:
        """Note which events a trajectory passes: every crossing shows a way, whatever option was running."""
        if not self._since_event[env] and self._last_event[env] is None:
            here = self.planner.event_at(before)
            self._last_event[env] = None if here is None else here.id
        if len(self._since_event[env]) > self.timeout:
            self._since_event[env], self._last_event[env] = [], None
        self._since_event[env].append(before)
        index = self.visited.event(env)
        if index < 0:
            return
        event, previous = self.graph.events[f"e{index}"], self._last_event[env]
        if event.id != previous:
            self.graph.triggered(event, after)
            if previous is not None:
                self._crossed(env, self.graph.events[previous], event, after)
        self._last_event[env], self._since_event[env] = event.id, []

    def _crossed(self, env: int, source: SalientEvent, target: SalientEvent, end: np.ndarray) -> None:
        path = np.stack(self._since_event[env])
        chain = self.chaining.chains.get(f"{source.id}>{target.id}")
        if (chain is None or not chain.options) and len(path) <= self.strategy.link_reach:
            known = self.graph.shortest_path([source.id], target.id)
            # A way by way of others is a detour, unless a chain for it has been there and been let go.
            if known is None or (chain is None and len(known.vertices) > 3):
                chain = self.chaining.open_chain(source, target)
        if chain is not None and chain.options and self.strategy.off_policy_runs:
            self._credit(chain, path, end)

    def _credit(self, chain: SkillChain, path: np.ndarray, end: np.ndarray) -> None:
        """Show a chain's gestating root a way that something else took."""
        root = self.chaining.options[chain.options[0]]
        if not root.mature:
            self.chaining.learn_success(root, path, end, own=False)

    # -- choosing a mission -------------------------------------------------------------------------------------------

    def _choose(self, point: np.ndarray) -> Mission:
        if self.pinned is not None:
            return self._adapt(point, self.graph.events[self.pinned])
        if self.discovery.due(self.n_episodes, self.graph.events.keys() - self.chaining.unsettled()):
            for event in self.discovery.attempt(self.n_episodes, self.rng):
                self._join(event)
        if self.strategy.target_choice == "uniform":
            return self._uniform(point)
        draw = self.rng.random()
        if draw < self.strategy.explore_prob:
            return self._explore()
        if draw < self.strategy.explore_prob + self.strategy.practise_prob:
            practised = self._to_practise(point)
            if practised is not None:
                return self._mission(practised, None)
        chain = self._nearest_chain(point)
        return self._explore() if chain is None else self._mission(self.graph.events[chain.target], chain)

    def _to_practise(self, point: np.ndarray) -> SalientEvent | None:
        """Choose an event that a path leads to: any, or one whose last step has been tried least."""
        if self.strategy.practise == "random":
            connected = self.graph.reachable("e0")
            return self.graph.events[connected[self.rng.integers(len(connected))]] if len(connected) > 1 else None
        ways = self.graph.ways_from(self.graph.useful(point))
        tries = {
            id: len(self.graph.options[ways.path(id)[-2]].record)
            for id, event in self.graph.events.items()
            if id in ways and not event.holds(point)
        }
        if not tries:
            return None
        fewest = min(tries.values())
        candidates = [id for id, n in tries.items() if n == fewest]
        return self.graph.events[candidates[self.rng.integers(len(candidates))]]

    def _join(self, event: SalientEvent) -> None:
        """Open the chains that are to join a new event to the graph, there and back (sections 3.2.5, 3.2.7, A.3)."""
        self._events_changed()
        source = next((v for v, _ in self.planner.vertices_near(event.center) if v.id != event.id), None)
        if source is None:
            source = self.graph.events["e0"]
        chain = self.chaining.open_chain(source, event, joins=True)
        if self.strategy.off_policy_runs:
            path = self.visited.path_from(int(source.id[1:]), event.center, 0.5 * event.radius)
            if len(path):
                self._credit(chain, path, event.center)
        if self.strategy.target_choice == "nearest":
            self.chaining.open_chain(event, source)

    def _mission(self, event: SalientEvent, chain: SkillChain | None) -> Mission:
        return Mission(event.center, event.id, None if chain is None else chain.id)

    def _to_event(self, point: np.ndarray, event: SalientEvent) -> Mission:
        """Pursue an event: over the graph if a path leads there, else by the chain from the vertex nearest to it."""
        if event.holds(point):
            return self._explore()
        if self.planner.path_to(point, event.id) is not None:
            return self._mission(event, None)
        chains = [c for c in self.chaining.chains.values() if c.target == event.id and c.open]
        return self._mission(event, chains[0] if chains else None)

    def _adapt(self, point: np.ndarray, event: SalientEvent) -> Mission:
        """Pursue the event that few-shot adaptation is for; look for a way to it while none is known (section 3.3)."""
        unseen = len(self.visited.near(event.center, event.radius, exact=True)) == 0
        if unseen and self.rng.random() < LOOK_FOR_A_WAY:
            return self._explore(event.center)
        return self._to_event(point, event)

    def _uniform(self, point: np.ndarray) -> Mission:
        """Any event, each as likely (section 3.2.2); backward chains open when forward ones are complete (A.3)."""
        for chain in list(self.chaining.chains.values()):
            if chain.complete:
                self.chaining.open_chain(self.graph.events[chain.target], self.graph.events[chain.source])
        events = [event for event in self.graph.events.values() if not event.holds(point)]
        if not events:
            return self._explore()
        return self._to_event(point, events[self.rng.integers(len(events))])

    def _nearest_chain(self, point: np.ndarray) -> SkillChain | None:
        """Return the open chain that is cheapest to practise from here; those that join new events come first."""

        def cost(chain: SkillChain) -> tuple[float, int]:
            source = self.graph.events[chain.source]
            travel = 0.0
            if not source.holds(point):
                path = self.planner.path_to(point, chain.source)
                travel = math.inf if path is None else path.cost
            return travel + (0.0 if chain.joins else JOINED_ALREADY), chain.n_failures

        events = self.graph.events
        chains = [c for c in self.chaining.open_chains() if not events[c.target].holds(point)]
        return min(chains, key=cost, default=None)

    def _random_walk(self) -> Mission:
        return Mission(self.graph.events["e0"].center, explore_steps=self.strategy.exploration_steps, exploring=True)

    def _explore(self, towards: np.ndarray | None = None) -> Mission:
        """Return to where the agent has rarely been, and go on from there: at random, or past a random point.

        Of some visited states, drawn as an RRT draws them (section 2.4: those nearest to uniform random points), it is
        the one with the fewest visits around it.

        :param towards: a point that the random points are to surround as well, shape ``(goal_dim,)``
        """
        if self.visited.size < 2:
            return self._random_walk()
        steps = self.strategy.exploration_steps
        points, radius = self.visited.points, self.discovery.radius
        corners = [points.min(axis=0), points.max(axis=0), *([] if towards is None else [towards])]
        lower, upper = np.min(corners, axis=0) - radius, np.max(corners, axis=0) + radius
        samples = self.rng.uniform(lower, upper, (N_EXPLORED, points.shape[1]))
        nearest = [points[self.visited.near(sample, 0.0)[0]] for sample in samples]
        rarest = int(np.argmin([len(self.visited.near(point, radius)) for point in nearest]))
        goal, beyond = nearest[rarest].astype(np.float64), None
        if self.rng.random() < 0.5:
            way = samples[rarest] - goal
            beyond = samples[rarest] + self.strategy.explore_beyond * radius * way / max(float(np.linalg.norm(way)), 1e-9)
        return Mission(goal, explore_steps=steps, beyond=beyond)

    # -- saving -------------------------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Return missions, paths and counters as plain data."""
        return {
            "missions": [None if mission is None else asdict(mission) for mission in self._missions],
            "n_episodes": self.n_episodes,
            "n_stuck": self.n_stuck,
            "pinned": self.pinned,
            "paths": self._paths,
            "since_event": self._since_event,
            "last_event": self._last_event,
        }

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self._missions = [None if spec is None else Mission(**spec) for spec in state["missions"]]
        self.n_episodes, self.n_stuck, self.pinned = state["n_episodes"], state["n_stuck"], state["pinned"]
        self._paths, self._since_event = state["paths"], state["since_event"]
        self._last_event = state["last_event"]
        if self.graph.events:
            self._events_changed()
