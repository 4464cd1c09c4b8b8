"""Search on the replay buffer (Eysenbach et al., 2019) with a skill graph's own walker: the graph's strongest rival."""

import math
from typing import NamedTuple

import numpy as np
import torch as th
from scipy.sparse import csr_array
from scipy.sparse.csgraph import dijkstra

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.walk_model import timeout

#: Least of what a value may be above its limit, where no number of steps can be told any more.
LEAST = 1e-6


class SearchState(NamedTuple):
    """What a search passes from step to step, as plain arrays.

    :param waypoints: stored states that are left on the way, by number, shape ``(n,)``; the goal comes after them
    :param begin: where the leg that is walked began: number of a stored state, ``n_states`` for the place it was planned
        from; shape ``()``
    :param left: environment steps that the leg may still take, shape ``()``
    :param barred: begin and end of legs that took too long in this episode, ``n_states + 1`` for the goal; shape ``(m, 2)``
    """

    waypoints: np.ndarray
    begin: np.ndarray
    left: np.ndarray
    barred: np.ndarray


class ReplaySearch:
    """
    Plans by Dijkstra over states drawn from an agent's replay buffer, and walks from one to the next.

    Two states are joined if the walker's critic takes the way between them for shorter than ``walk_steps``. A leg that takes
    more than the time a walk may take is barred for the rest of the episode, and planned around (a deterministic search
    would repeat it for ever). There are no events, no records and no edges from evidence: distances are what the critic says.

    :param agent: trained, with its replay buffer; point mazes and arms, one environment at a time
    :param n_states: how many states are drawn
    :param seed: of that draw
    :raises ValueError: if there are fewer states
    """

    def __init__(self, agent: SkillGraphAgent, n_states: int = 1_000, seed: int = 0) -> None:
        store = agent.parts.store
        if n_states > len(store):
            raise ValueError(f"{n_states} states cannot be drawn from {len(store)}; does the agent have its replay buffer?")
        rng = np.random.default_rng(seed)
        rows = np.sort(rng.choice(np.arange(store.oldest, store.total), n_states, replace=False))
        self.agent = agent
        self.n_states = n_states
        self.observations = store.column("observation", rows)
        self.places = store.column("achieved_goal", rows)
        between = np.stack([self.steps(*here, self.places) for here in zip(self.observations, self.places, strict=True)])
        np.fill_diagonal(between, np.inf)
        # Searches go back from the goal: row j holds the states from which one walks to state j.
        self._arrivals = csr_array(np.where(agent.graph.walk_steps > between.T, np.maximum(between.T, LEAST), 0.0))

    def steps(self, observation: np.ndarray, place: np.ndarray, goal: np.ndarray) -> np.ndarray:
        """Return how many steps the walker's critic expects a way to take, shape ``(n,)``.

        :param observation: shape ``(observation_dim,)`` or ``(n, observation_dim)``
        :param place: where that was, shape ``(goal_dim,)`` or ``(n, goal_dim)``
        :param goal: shape ``(goal_dim,)`` or ``(n, goal_dim)``
        """
        parts, gamma = self.agent.parts, self.agent.gamma
        n = max(len(np.atleast_2d(place)), len(np.atleast_2d(goal)))
        whole = [np.broadcast_to(array, (n, array.shape[-1])) for array in (observation, place, goal)]
        seen = parts.runner.view(*whole)
        actions = parts.runner.actor.act(seen)
        with th.no_grad():
            critic = parts.walker.learner.critic
            given = (th.as_tensor(array, dtype=th.float32, device=critic.device) for array in (seen, actions))
            values = th.cat(critic(*given), dim=1)
        value = values.min(dim=1).values.cpu().numpy() - parts.factory.shaping * self.agent.metric.travel(whole[1], whole[2])
        # A walk of n steps is paid -1 each: -(1 - gamma^n) / (1 - gamma).
        return np.asarray(np.log(np.clip(1.0 + (1.0 - gamma) * value, LEAST, 1.0)) / math.log(gamma))

    def plan(
        self, observation: np.ndarray, place: np.ndarray, goal: np.ndarray, barred: np.ndarray | None = None
    ) -> list[int]:
        """Return the stored states on the shortest way, by number; none where it is straight on, or no way leads there.

        :param observation: shape ``(observation_dim,)``
        :param place: where the agent stands, shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        :param barred: legs not to take, shape ``(m, 2)``
        """
        end, far = self.n_states + 1, self.agent.graph.walk_steps
        away = self.steps(observation, place, np.vstack([self.places, goal]))
        home = np.maximum(self.steps(self.observations, self.places, goal), LEAST)
        away[away >= far], home[home >= far] = np.inf, np.inf
        arrivals = self._arrivals
        for begin, until in [] if barred is None else barred.tolist():
            if begin == self.n_states:  # a leg from where it was planned
                away[min(until, self.n_states)] = np.inf
            elif until == end:
                home[begin] = np.inf
            else:
                arrivals = arrivals.copy() if arrivals is self._arrivals else arrivals
                arrivals[until, begin] = np.inf
        cost, following = self._back_from_goal(arrivals, home)
        # Straight on is a way, too.
        total = away + np.append(cost, 0.0)
        way = [int(total.argmin())]
        if total[way[0]] == np.inf:
            return []
        while way[-1] < self.n_states:
            way.append(int(following[way[-1]]))
        return way[:-1]

    def _back_from_goal(self, arrivals: csr_array, home: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return of every state the steps to the goal, and the state that comes next, ``n_states`` for the goal."""
        last = np.flatnonzero(home < np.inf)
        pointers = np.append(arrivals.indptr, arrivals.indptr[-1] + len(last))
        columns, weights = np.append(arrivals.indices, last), np.append(arrivals.data, home[last])
        n = self.n_states + 1
        cost, following = dijkstra(
            csr_array((weights, columns, pointers), shape=(n, n)), indices=n - 1, return_predecessors=True
        )
        return cost[:-1], following[:-1]

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = True,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """
        Walk towards the next state on the way to ``observation["desired_goal"]``.

        :param observation: one Dict observation
        :param state: what the last call returned; None at the beginning of an episode
        :param episode_start: not used
        :param deterministic: not used: there is no noise
        :return: an action in the environment's own bounds, and the state to pass back in
        """
        assert isinstance(observation, dict)
        if state is None:
            now = self._begin(observation, np.empty((0, 2), dtype=int))
        else:
            now = self._go_on(observation, SearchState(*state))
        seen = {key: observation[key][None] for key in ("observation", "achieved_goal")}
        failed = len(now.barred) > 0 and now.begin == self.n_states  # the leg before this one took too long
        action = self.agent.parts.walk(seen, self._target(observation, now.waypoints)[None], bool(failed))[0]
        return action, tuple(now._replace(left=now.left - 1))

    def _begin(self, observation: dict[str, np.ndarray], barred: np.ndarray) -> SearchState:
        """Plan from here."""
        here = (observation["observation"], observation["achieved_goal"], observation["desired_goal"])
        return self._walk(observation, self.n_states, np.array(self.plan(*here, barred), dtype=int), barred)

    def _target(self, observation: dict[str, np.ndarray], waypoints: np.ndarray) -> np.ndarray:
        """Return where a leg leads: the next of the stored states, else the goal."""
        return np.asarray(self.places[waypoints[0]] if len(waypoints) else observation["desired_goal"])

    def _walk(self, observation: dict[str, np.ndarray], begin: int, waypoints: np.ndarray, barred: np.ndarray) -> SearchState:
        """Begin a leg."""
        target = self._target(observation, waypoints)
        expected = self.steps(observation["observation"], observation["achieved_goal"], target)[0]
        left = int(timeout(min(expected, self.agent.graph.walk_steps)))
        return SearchState(waypoints, np.array(begin), np.array(left), barred)

    def _go_on(self, observation: dict[str, np.ndarray], state: SearchState) -> SearchState:
        """Take the next leg after an arrival, and plan anew where a leg took too long."""
        if len(state.waypoints) and self.agent.metric.reached(observation["achieved_goal"], self.places[state.waypoints[0]]):
            return self._walk(observation, int(state.waypoints[0]), state.waypoints[1:], state.barred)
        if state.left <= 0:
            end = state.waypoints[0] if len(state.waypoints) else self.n_states + 1
            return self._begin(observation, np.vstack([state.barred, [state.begin, end]]))
        return state
