"""What runs teach, by the paper: where options can start and where they end (sections 2.2, 3.2.6)."""

from typing import Any

import numpy as np

from sb3_skillgraph.paper.chaining import DeepSkillChaining
from sb3_skillgraph.paper.graph import PaperGraph
from sb3_skillgraph.paper.missions import PaperMissions
from sb3_skillgraph.running import Run


class PaperWitness:
    """Follows the running options, and lets them learn when they end.

    :param graph: the skill graph
    :param chaining: the chains and their options
    :param missions: what the agent is about
    :param n_envs: number of environments
    """

    def __init__(self, graph: PaperGraph, chaining: DeepSkillChaining, missions: PaperMissions, n_envs: int) -> None:
        self.graph = graph
        self.chaining = chaining
        self.missions = missions
        self.cut(n_envs)

    def cut(self, n_envs: int) -> None:
        """Forget what the environments were in the middle of.

        :param n_envs: number of environments from now on
        """
        self._paths: list[list[np.ndarray]] = [[] for _ in range(n_envs)]

    def begin(self, env: int, point: np.ndarray) -> None:
        """An episode begins; where the very first does lies the first event, beta_0 of section 3.2.7.

        :param env: which environment
        :param point: where, shape ``(goal_dim,)``
        """
        if not self.graph.events:
            self.graph.add_event(point)
        if self.missions.pinned is not None:
            self.missions.prepare()

    def began(self, env: int, point: np.ndarray) -> None:
        """A run begins.

        :param env: which environment
        :param point: where, shape ``(goal_dim,)``
        """
        self._paths[env] = [point]

    def step(self, env: int, point: np.ndarray) -> bool:
        """A run goes on.

        :param env: which environment
        :param point: where it has got to, shape ``(goal_dim,)``
        :return: False: nothing is made of new places
        """
        self._paths[env].append(point)
        return False

    def ended(self, run: Run, *, clean: bool) -> None:
        """A run has ended.

        :param run: what became of it
        :param clean: not used: noise or not, it counts
        """
        option = self.chaining.options.get(run.option)
        if option is None:
            return
        *path, end = self._paths[run.env]
        for event in self.graph.events_at(end) if not run.stuck else ():
            self.graph.triggered(event.id, end)
        if run.success:
            option.succeeded(np.stack(path), end, run.steps)
        else:
            option.failed(None if run.stuck else path[0], run.steps)
        self.chaining.learned(option)

    # -- saving -------------------------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Return the running options' ways as plain data."""
        return {"paths": self._paths}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self._paths = state["paths"]
