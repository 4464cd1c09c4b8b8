"""The parts of an agent, and how they are put together (Figure 10)."""

from functools import partial
from typing import Any, ClassVar

import numpy as np
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import VecEnv

from sb3_skillgraph.arguments import HORIZON, find_salience, goal_metric, option_class, option_kwargs
from sb3_skillgraph.checking import array
from sb3_skillgraph.envs.wrappers import told_limit
from sb3_skillgraph.goal_env import GoalSpec, env_attribute, find_view
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.learning.growth import Growth, Skills
from sb3_skillgraph.learning.missions import Agenda, Missions
from sb3_skillgraph.learning.rollout import Rollout
from sb3_skillgraph.learning.witness import Witness
from sb3_skillgraph.memory.store import TransitionStore
from sb3_skillgraph.options.average import AveragedPolicy
from sb3_skillgraph.options.factory import OptionFactory
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.views import ScaledView
from sb3_skillgraph.options.walk import Walk, Walks
from sb3_skillgraph.plan import Plan, describe
from sb3_skillgraph.planning import Planner
from sb3_skillgraph.runner import Runner
from sb3_skillgraph.running import RunnerState
from sb3_skillgraph.walk_model import WalkModel

#: Steps ahead from which hindsight draws achieved goals.
HINDSIGHT_STEPS = 200


class Parts:
    """What a :class:`~sb3_skillgraph.SkillGraphAgent` is made of; each part knows those above it only.

    :param agent: gives environment, spaces, SB3's arguments and device
    :param spec: lengths of observation, goal and action
    :param arguments: the agent's keyword arguments
    """

    #: Further arguments of the options' replay buffers.
    replay_kwargs: ClassVar[dict[str, Any]] = {}

    missions: Agenda
    skills: Any  # :class:`Skills`; with ``**PAPER`` the options of its chains

    def __init__(self, agent: OffPolicyAlgorithm, spec: GoalSpec, arguments: dict[str, Any]) -> None:
        self.rng = np.random.default_rng(agent.seed)
        self.metric = goal_metric(arguments["event_radius"], agent.env, spec.goal_dim)
        self.view_name, function = find_view(arguments["option_view"], agent.env, spec, self.metric)
        self.view = ScaledView(function, self.metric)
        self.store = TransitionStore(agent.buffer_size, spec.observation_dim, spec.goal_dim, spec.action_dim, agent.n_envs)
        self.factory = OptionFactory(
            option_class(arguments["option_class"]),
            option_kwargs(agent, arguments),
            self.store,
            self.view,
            agent.action_space,  # type: ignore[arg-type]  # a box
            arguments["goal_tolerance"],
            self.rng,
            {"hindsight": arguments["hindsight"], "horizon": HINDSIGHT_STEPS, **self.replay_kwargs},
            agent.device,
            arguments["shaping"],
        )
        self.walker = self.factory.make("walker", None, None)
        self.average = AveragedPolicy(self.walker.learner)  # what predict acts by
        learning = self._build(agent, spec, arguments)
        noise = arguments["action_noise"]
        deviation = 0.0 if noise is None or isinstance(noise, ActionNoise) else float(noise)
        self.rollout = Rollout(learning, self.missions, self.witness, self.store, deviation, self.rng)

    def _build(self, agent: OffPolicyAlgorithm, spec: GoalSpec, arguments: dict[str, Any]) -> Runner:
        """Build what differs with the rules, and return what runs options while learning."""
        self.graph = SkillGraph(spec.goal_dim, self.metric, arguments["max_events"], arguments["walk_steps"])
        self.model = WalkModel(self.metric.n_matched)
        self.planner = Planner(self.graph, self.model, HORIZON)
        self.skills = Skills(self.graph, self.factory, self.walker)
        second = self.walker.actor
        self.runner = Runner(self.graph, self.planner, self.average.actor, self.view, self.skills, second=second)
        self.missions = Missions(
            self.graph,
            find_salience(arguments, self.graph, self.store, agent),
            arguments["exploration_steps"],
            arguments["explore_beyond"],
            self.rng,
        )
        growth = Growth(arguments["skills"], self.graph, self.skills)
        self.witness = Witness(self.graph, self.planner.choice_model, agent.n_envs, growth)
        # Who learns acts by the policy as it is.
        return Runner(self.graph, self.planner, self.walker.actor, self.view, self.skills)

    def heed_time_limit(self, env: VecEnv | None) -> None:
        """Make plans for the episodes of an environment: as long as it tells, else as those that it cuts while learning.

        :param env: the environment; None if there is none
        """
        limit = None if env is None else told_limit(partial(env_attribute, env))
        self.rollout.is_told_limit = limit is not None
        if limit is not None:
            self.planner.horizon = limit

    def options(self) -> Any:
        """Return all options: the walks, one to each event, which share their SB3 model."""
        graph, walker = self.graph, self.walker
        learners = [self.skills.get(id, walker).learner for id in graph.walk_ids]
        known = zip(graph.walk_ids, graph.events, learners, strict=True)
        return Walks((Walk(*each, self.witness.growth.specialise) for each in known), self.runner)

    def plan(self, state: RunnerState, point: np.ndarray, goal: np.ndarray) -> Plan:
        """Tell how the agent goes about a goal.

        :param state: of one environment, advanced to this step
        :param point: where the agent stands, shape ``(goal_dim,)``
        :param goal: shape ``(goal_dim,)``
        """
        return describe(self.runner, state, point, goal)

    def learners(self, n_updates: int) -> list[tuple[Option, int]]:
        """Return the options whose networks learn now, each with its number of updates: of a skill as many as it has run.

        :param n_updates: how many there are to be, if an option has run all the time
        """
        rollout, skills = self.rollout, self.runner.skills
        earned = [(skills[id], round(n_updates * n / rollout.n_steps)) for id, n in rollout.ran.items() if id in skills]
        rollout.ran, rollout.n_steps = {}, 0
        return [(self.walker, n_updates), *earned]

    def get_state(self) -> dict[str, Any]:
        """Return what has been learned beside the walker's networks, as plain data."""
        skills = [skill.get_state() for skill in self.skills.values()]
        average, model = self.average.get_state(), self.model.get_state()
        return {"graph": self.graph.get_state(), "model": model, "average": average, "skills": skills}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self.graph.set_state(state["graph"])
        self.model.set_state(state["model"])
        self.average.set_state(state["average"])
        for spec in state["skills"]:
            self.skills.make(spec["record"]["id"]).set_state(spec)

    def get_experience(self) -> dict[str, Any]:
        """Return what goes with the replay buffer, as plain data: the transitions, and which of them are which skill's own."""
        rows = {id: skill.replay.get_state()["rows"] for id, skill in self.runner.skills.items()}
        return {**self.store.get_state(), "rows": rows}

    def set_experience(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_experience` returned.

        :raises ValueError: if it does not fit
        """
        transitions = dict(state)
        rows = transitions.pop("rows", {})
        for id, own in rows.items():
            array((None,), "i", 0, transitions["total"] - 1)(own, f"The rows of option {id}")
            if (np.diff(own) <= 0).any():
                raise ValueError(f"The rows of option {id} in the file are in no order.")
        self.store.set_state(transitions)  # which checks the rest before it writes anything
        for id, skill in self.runner.skills.items():
            skill.replay.set_state({"rows": rows.get(id, ())})  # none of a skill that was begun later

    def unscale(self, scaled: np.ndarray) -> np.ndarray:
        """Turn actions in [-1, 1], shape ``(n, action_dim)``, into the environment's own, shape ``(n, *action_shape)``."""
        return self.factory.unscale(scaled).reshape(len(scaled), *self.factory.action_space.shape)

    def walk(self, observation: dict[str, np.ndarray], goals: np.ndarray, failed: bool = False) -> np.ndarray:
        """Return what the walker does.

        :param observation: ``observation`` and ``achieved_goal``, shapes ``(n, dim)``
        :param goals: where it is to go, shape ``(n, goal_dim)``
        :param failed: whether the walk before this one failed
        :return: actions in the environment's own bounds, shape ``(n, *action_shape)``
        """
        seen = self.runner.view(observation["observation"], observation["achieved_goal"], goals)
        return self.unscale(self.runner.walk(seen, np.full(len(seen), failed)))
