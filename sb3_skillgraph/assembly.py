"""The parts of the agent, and how they are put together (Figure 10)."""

from typing import Any

import numpy as np
from gymnasium import spaces
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_skillgraph.chaining import DeepSkillChaining
from sb3_skillgraph.controller import Controller, ControllerState
from sb3_skillgraph.curriculum import Curriculum
from sb3_skillgraph.events import SalientEvent
from sb3_skillgraph.goal_env import GoalSpec, Oracle, env_attribute, find_view
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.missions import Strategy
from sb3_skillgraph.options.factory import OptionFactory, copy_policy
from sb3_skillgraph.options.learner import OptionLearner
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.views import ScaledView
from sb3_skillgraph.persistence import Persistence
from sb3_skillgraph.planner import GraphPlanner
from sb3_skillgraph.pruning import Pruning
from sb3_skillgraph.replay import TransitionStore
from sb3_skillgraph.salience.dco import DCOSalience
from sb3_skillgraph.salience.discovery import EventDiscovery
from sb3_skillgraph.salience.proposals import FrontierSalience, RandomSalience, Salience
from sb3_skillgraph.visited import VisitedStates

NET_ARCH = [128, 128]  # of every network: each option has a small job


class Assembly(Persistence):
    """Builds the parts of a :class:`~sb3_skillgraph.SkillGraphAgent` from its arguments; it is part of it."""

    _spec: GoalSpec

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self._convert_train_freq()
        args = self._arguments
        spec = self._spec = GoalSpec.of(self.observation_space, self.action_space)
        self.rng = np.random.default_rng(self.seed)
        self.event_radius = self._event_radius()
        if not 0 < args["goal_tolerance"] <= 1:
            raise ValueError(f"goal_tolerance must lie in (0, 1], not {args['goal_tolerance']!r}: it is a share of a radius.")
        self._view_name, function = find_view(args["option_view"], self.env, spec)
        self.view = ScaledView(function, self.event_radius)
        self.store = TransitionStore(
            self.buffer_size, spec.observation_dim, spec.goal_dim, spec.action_dim, n_envs=self.n_envs
        )
        # Under SB3's name as well: CheckpointCallback looks for it. Options learn from views of it.
        self.replay_buffer = self.store  # type: ignore[assignment]
        self._factory = OptionFactory(
            args["option_class"],
            self._option_kwargs(),
            self.store,
            self.view,
            self._action_space(),
            self.event_radius,
            args["goal_tolerance"] * self.event_radius,
            self.rng,
            self._replay_kwargs(),
            self.device,
            args["shaping"],
        )
        self.global_option = self._factory.make("global", None, None)
        self.policy = self.global_option.learner.policy
        self._build_skills()
        self._build_curriculum()
        self._begin_episodes()

    def _action_space(self) -> spaces.Box:
        assert isinstance(self.action_space, spaces.Box)
        return self.action_space

    def _event_radius(self) -> float:
        radius = self._arguments["event_radius"]
        for name in ("success_radius", "distance_threshold"):
            if radius is None and self.env is not None:
                radius = env_attribute(self.env, name)
        if radius is None:
            raise ValueError(
                "event_radius is required: the environment has neither a success_radius nor a distance_threshold to take "
                "it from. Give the distance, in goal units, within which a goal counts as reached."
            )
        if not float(radius) > 0:
            raise ValueError(f"event_radius must be positive, not {radius!r}.")
        return float(radius)

    def _option_kwargs(self) -> dict[str, Any]:
        option_class: type[OffPolicyAlgorithm] = self._arguments["option_class"]
        kwargs: dict[str, Any] = dict(
            gamma=self.gamma, tau=self.tau, policy_kwargs={"net_arch": NET_ARCH, **self.policy_kwargs}
        )
        if issubclass(option_class, OptionLearner):
            if callable(self.learning_rate):
                raise ValueError(
                    f"{option_class.__name__} takes constant learning rates; for a schedule use option_class=TD3 or SAC."
                )
            kwargs.update(actor_learning_rate=self.learning_rate, critic_learning_rate=self.learning_rate)
            kwargs.update(saturation_penalty=self._arguments["saturation_penalty"])
        else:
            kwargs.update(learning_rate=self.learning_rate)
        return {**kwargs, **(self._arguments["option_kwargs"] or {})}

    def _replay_kwargs(self) -> dict[str, Any]:
        args = self._arguments
        shares = dict(hindsight=args["hindsight"], shared=args["shared_experience"])
        return {**shares, "horizon": args["option_timeout"], "doomed_steps": args["doomed_steps"]}

    def _build_skills(self) -> None:
        args = self._arguments
        edges = ("containment", "rate_prior", "evidence_edges", "min_success_rate", "failure_cost")
        self.graph = SkillGraph(self._spec.goal_dim, **{name: args[name] for name in edges})
        self.visited = VisitedStates(self._spec.goal_dim, 0.25 * self.event_radius, self.n_envs)
        self.planner = GraphPlanner(self.graph, self.visited, self.event_radius, args["event_reach"], args["nearest"])
        self.chaining = DeepSkillChaining(
            self.graph,
            self._factory.make,
            self._matured,
            args["gestation_period"],
            args["practice_runs"],
            args["max_failures"],
        )
        self.controller = Controller(
            self.global_option,
            self.chaining,
            self.planner,
            self.view,
            self.event_radius,
            args["goal_tolerance"] * self.event_radius,
            args["option_timeout"],
            args["warm_start"],
            args["stall_steps"],
        )

    def _build_curriculum(self) -> None:
        args = self._arguments
        self.discovery = EventDiscovery(
            self.graph,
            self._salience(),
            self.event_radius,
            args["salient_event_freq"],
            args["retry_after"],
            self._events_per_attempt(),
            args["event_tries"],
            args["max_unconnected"],
        )
        self.pruning = Pruning(self.chaining, self.visited, args["prune_after"])
        strategy = Strategy(**{name: args[name] for name in Strategy._fields})
        self.curriculum = Curriculum(
            self.graph,
            self.chaining,
            self.planner,
            self.visited,
            self.discovery,
            strategy,
            args["option_timeout"],
            self.rng,
            self.n_envs,
        )

    def _events_per_attempt(self) -> int:
        given = self._arguments["events_per_attempt"]
        if given is not None:
            return int(given)
        return 2 if self._arguments["salience"] == "dco" else 1

    def _salience(self) -> Salience:
        salience = self._arguments["salience"]
        if salience == "frontier":
            return FrontierSalience(self.visited, 2.0 * self.event_radius, self._arguments["event_reach"])
        if salience == "dco":
            return DCOSalience(self.store, self.visited, self._arguments["event_reach"])
        if salience == "rrt":
            return RandomSalience(Oracle(self.get_env))
        if not hasattr(salience, "propose"):
            raise ValueError(
                f"Unknown salience {salience!r}: use 'frontier', 'rrt', 'dco' or an object with a method propose(rng) that "
                "returns a point of goal space."
            )
        return salience

    def _matured(self, option: Option) -> None:
        if self._arguments["warm_start"]:
            copy_policy(self.global_option, option)

    def _begin_episodes(self) -> None:
        """Forget what the environments were in the middle of."""
        self._state = ControllerState.fresh(self.n_envs)
        self._held_actions = np.zeros((self.n_envs, self._spec.action_dim), dtype=np.float32)
        self._hold_left = np.zeros(self.n_envs, dtype=np.int64)
        self._pending = None
        self._executed = []
        self._credit = 0.0

    @property
    def events(self) -> list[SalientEvent]:
        """All salient events in the order of their discovery."""
        return list(self.graph.events.values())

    @property
    def planning(self) -> bool:
        """Whether ``predict`` plans over the graph; if not, the global option walks straight to every goal."""
        return self.controller.planning

    @planning.setter
    def planning(self, planning: bool) -> None:
        self.controller.planning = planning
