"""The parts of an agent that does as the paper does, and how they are put together (Figure 10)."""

from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_skillgraph.arguments import HORIZON, find_salience
from sb3_skillgraph.edges import NOWHERE
from sb3_skillgraph.goal_env import GoalSpec
from sb3_skillgraph.metric import Ball
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.paper.chaining import DeepSkillChaining
from sb3_skillgraph.paper.graph import PaperGraph
from sb3_skillgraph.paper.missions import PaperMissions
from sb3_skillgraph.paper.policy import PaperPolicy
from sb3_skillgraph.paper.witness import PaperWitness
from sb3_skillgraph.parts import Parts
from sb3_skillgraph.plan import Plan
from sb3_skillgraph.planning import Planner
from sb3_skillgraph.runner import Runner
from sb3_skillgraph.running import RunnerState
from sb3_skillgraph.walk_model import WalkModel


class PaperParts(Parts):
    """What a :class:`~sb3_skillgraph.SkillGraphAgent` is made of with ``**PAPER``.

    The walker is there, since every SB3 algorithm has a policy, but it does not learn, and acts only where there is no option.
    Options act by their policies as they are.
    """

    replay_kwargs: ClassVar[dict[str, Any]] = {"shared": 0.0}  # options learn from their own experience

    def _build(self, agent: OffPolicyAlgorithm, spec: GoalSpec, arguments: dict[str, Any]) -> Runner:
        rules, metric = arguments["rules"], self.metric
        if not isinstance(metric, Ball):
            raise ValueError(f"With rules={rules!r} events are balls: event_radius must be a number.")
        graph = PaperGraph(spec.goal_dim, metric, arguments["walk_steps"])
        self.chaining = DeepSkillChaining(graph, self.factory.make, rules.gestation_period)
        self.graph, self.model, self.skills = graph, WalkModel(), self.chaining.options
        self.planner = Planner(graph, self.model, HORIZON)  # never asked: the rules choose
        self.policy = PaperPolicy(graph, self.chaining, rules.timeout, self.planner)
        self.runner = Runner(graph, self.planner, self.walker.actor, self.view, self.skills, self.policy.choose)
        salience = find_salience(arguments, graph, self.store, agent, relearn=1)
        missions = PaperMissions(graph, self.chaining, salience, rules, arguments["exploration_steps"], self.rng)
        witness: Any = PaperWitness(graph, self.chaining, missions, agent.n_envs)
        self.missions, self.witness = missions, witness
        return self.runner

    def options(self) -> list[Any]:
        """Return all options, gestating ones too, in the order of their making."""
        return list(self.chaining.options.values())

    def plan(self, state: RunnerState, point: np.ndarray, goal: np.ndarray) -> Plan:
        """Tell how the agent goes about a goal.

        :param state: of one environment, advanced to this step
        :param point: where the agent stands, shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        """
        return self.policy.plan(state, point, goal)

    def learners(self, n_updates: int) -> list[tuple[Option, int]]:
        """Return the options that have run since there was training, each with as many updates as it has run.

        :param n_updates: how many there are to be, if an option has run all the time
        """
        return super().learners(n_updates)[1:]  # the walker does not learn

    def get_state(self) -> dict[str, Any]:
        """Return what has been learned, the options' networks too, as plain data."""
        options = [option.get_state() for option in self.chaining.options.values()]
        return {"graph": self.graph.get_state(), "chaining": self.chaining.get_state(), "options": options}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        graph: Any = self.graph
        graph.set_state(state["graph"])
        options = self.chaining.options
        for spec in state["options"]:  # an option's parent was made before it
            record = spec["record"]
            event = graph.index(record["target"])
            termination = graph.events[event] if event != NOWHERE else options[record["target"]]
            options[record["id"]] = self.factory.make(record["id"], record["target"], termination)
            options[record["id"]].set_state(spec)
        self.chaining.set_state(state["chaining"])
        graph.set_options(state["graph"], options)
