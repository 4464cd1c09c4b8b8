"""The parts of an agent that does as the paper does, and how they are put together (Figure 10)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_skillgraph.arguments import HORIZON, find_salience
from sb3_skillgraph.edges import NOWHERE
from sb3_skillgraph.goal_env import GoalSpec
from sb3_skillgraph.metric import Ball
from sb3_skillgraph.options.average import AveragedPolicy
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.parameters import set_skill_state, skill_state
from sb3_skillgraph.paper.chaining import DeepSkillChaining
from sb3_skillgraph.paper.graph import PaperGraph
from sb3_skillgraph.paper.missions import PaperMissions
from sb3_skillgraph.paper.policy import PaperPolicy
from sb3_skillgraph.paper.witness import PaperWitness
from sb3_skillgraph.parts import Common, Parts
from sb3_skillgraph.plan import Plan
from sb3_skillgraph.planning import Planner
from sb3_skillgraph.runner import Runner
from sb3_skillgraph.running import RunnerState
from sb3_skillgraph.walk_model import WalkModel


@dataclass
class PaperParts(Parts):
    """What a :class:`~sb3_skillgraph.SkillGraphAgent` is made of with ``**PAPER``.

    The walker is there, since every SB3 algorithm has a policy, but it does not learn, and acts only where there is no option.
    """

    chaining: DeepSkillChaining
    policy: PaperPolicy

    @classmethod
    def build(cls, agent: OffPolicyAlgorithm, spec: GoalSpec, arguments: dict[str, Any]) -> "PaperParts":
        """Put an agent together.

        :param agent: gives environment, spaces, SB3's arguments and device
        :param spec: lengths of observation, goal and action
        :param arguments: the agent's keyword arguments
        """
        common = Common.build(agent, spec, arguments, {"shared": 0.0})  # options learn from their own experience
        rng, view_name, view, store, factory, walker, metric = common
        if not isinstance(metric, Ball):
            raise ValueError(f"With rules={arguments['rules']!r} events are balls: event_radius must be a number.")
        rules = arguments["rules"]
        graph = PaperGraph(spec.goal_dim, metric, arguments["walk_steps"])
        chaining = DeepSkillChaining(graph, factory.make, rules.gestation_period)
        model = WalkModel()
        planner = Planner(graph, model, HORIZON)  # never asked: the rules choose
        policy = PaperPolicy(graph, chaining, rules.timeout, planner)
        runner = Runner(graph, planner, walker.actor, view, chaining.options, policy)
        salience = find_salience(arguments, graph, store, agent, relearn=1)
        missions = PaperMissions(graph, chaining, salience, rules, arguments["exploration_steps"], rng)
        witness: Any = PaperWitness(graph, chaining, missions, agent.n_envs)
        rollout = common.rollout(runner, missions, witness, arguments)
        known = (rng, view_name, factory, store, walker, graph, model, planner, runner, missions, witness, rollout)
        return cls(*known, chaining.options, AveragedPolicy(walker.learner), chaining, policy)

    def learned(self, n_updates: int) -> None:
        """Options act by their policies as they are."""

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
        return self._having_run(n_updates)

    def get_state(self) -> dict[str, Any]:
        """Return what has been learned, the options' networks too, as plain data."""
        options = [skill_state(option) for option in self.chaining.options.values()]
        return {"graph": self.graph.get_state(), "chaining": self.chaining.get_state(), "options": options}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        graph: Any = self.graph
        graph.set_state(state["graph"])
        options: dict[str, Option] = {}
        for spec in state["options"]:  # an option's parent was made before it
            record = spec["record"]
            event = graph.index(record["target"])
            termination = graph.events[event] if event != NOWHERE else options[record["target"]]
            option = self.factory.make(record["id"], record["target"], termination)
            set_skill_state(option, spec, self.factory.device)
            options[option.id] = option
        self.chaining.set_state(state["chaining"], list(options.values()))
        graph.set_options(state["graph"], options)
