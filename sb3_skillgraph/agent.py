"""The agent: an SB3 off-policy algorithm that explores, learns to walk, and plans over what it has learned (section 3)."""

import copy
from collections.abc import Iterable, Sequence
from inspect import signature
from typing import Any, ClassVar, Literal, Self

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.utils import get_system_info
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.td3.policies import MultiInputPolicy

from sb3_skillgraph import persistence
from sb3_skillgraph.arguments import check_arguments, check_attributes
from sb3_skillgraph.events import Event
from sb3_skillgraph.goal_env import GoalSpec, as_batch, as_goal, check_finite, refuse_changed_goals, rows
from sb3_skillgraph.interrupts import Interrupts
from sb3_skillgraph.learning.episodes import Episodes
from sb3_skillgraph.learning.salience import Salience
from sb3_skillgraph.metric import Metric, MetricFunction
from sb3_skillgraph.options.learner import OptionDDPG
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.parameters import parameters, set_parameters
from sb3_skillgraph.options.views import View
from sb3_skillgraph.options.walk import Walks
from sb3_skillgraph.parts import Parts
from sb3_skillgraph.plan import Plan
from sb3_skillgraph.rules import PaperRules
from sb3_skillgraph.running import Run, RunnerState
from sb3_skillgraph.saving import PathOrFile, load_tree, save_tree
from sb3_skillgraph.schema import check_learned
from sb3_skillgraph.vec_env import LeanVecEnv


class SkillGraphAgent(OffPolicyAlgorithm):
    """
    Deep Skill Graphs (DSG): discovers events without reward, learns options that lead from one to another, arranges both
    in a graph and plans over it to goals never seen in training.

    Paper: Bagaria, Crowley, Lim, Konidaris, *Skill Discovery for Exploration and Planning using Deep Skill Graphs* (2020).
    Everything the agent can do is an option of one graph: most are *walks*, which share one goal-conditioned policy. A plan
    is a path of that graph, and :meth:`predict` runs the first option of what :meth:`plan` returns.

    :param policy: ``"MultiInputPolicy"`` (goal environments have Dict observations)
    :param env: a goal environment with Box actions, a VecEnv of such, or the id of one
    :param learning_rate: learning rate of actor and critic; ``option_kwargs`` can give the two apart
    :param buffer_size: transitions kept
    :param learning_starts: environment steps of random actions, without learning, at the start
    :param batch_size: transitions in a minibatch
    :param tau: soft update coefficient of the target networks
    :param gamma: discount factor
    :param train_freq: steps of every environment between updates
    :param gradient_steps: minibatch updates per ``train_freq`` steps, for each environment (with SB3's algorithms, for all
        together): so that several environments learn as much as one in as many steps
    :param action_noise: SB3 action noise, or the standard deviation of Gaussian noise, in units of the scaled action;
        None for none
    :param stats_window_size: episodes over which SB3's rollout statistics are averaged
    :param tensorboard_log: folder of the TensorBoard log
    :param policy_kwargs: keyword arguments of the walker's policy; ``net_arch`` is ``[128, 128]`` unless given
    :param verbose: 0 for silence, 1 for the progress table
    :param seed: seed of all generators
    :param device: torch device
    :param _init_setup_model: whether to build the networks at construction
    :param option_class: SB3 off-policy class of the walker, or its name: ``OptionDDPG``, ``OptionTD3``, ``DDPG``, ``TD3``,
        ``SAC``
    :param option_kwargs: further keyword arguments for it
    :param option_view: what a policy sees of (observation, achieved goal, goal): ``"relative"`` (all, and the goal
        relative to where the agent stands), ``"egocentric"`` (without absolute position), ``"body"`` (from a robot's body),
        ``"placed_body"`` (and where that is) or a function; None takes the one the environment names in its attribute
        ``option_view``, else ``"relative"``
    :param event_radius: how near to a goal is there: a radius in goal units, one for each dimension (infinite where it does
        not matter), a :class:`~sb3_skillgraph.metric.Metric` for angles, rotations and what has to match, or a function
        ``(a, b) -> distance`` in radii; None takes what the environment tells (``goal_metric``, ``success_radius``,
        ``distance_threshold``)
    :param max_events: events that the graph may have; where more are needed they come to lie further apart
    :param walk_steps: environment steps within which a trajectory that goes from one event to another makes an edge
    :param salience: how events to pursue are proposed: ``"frontier"`` (uniform points around what has been visited),
        ``"rrt"`` (uniform feasible states from the environment's ``sample_free``), ``"dco"`` (the two ends of a learned
        Fiedler vector) or an object with ``propose(rng)`` [3.2.1]
    :param exploration_steps: environment steps for which an exploration goes on without finding anything new
    :param explore_beyond: event radii that an exploration towards a point goes on past it
    :param hindsight: share of sampled transitions relabelled with a goal achieved later
    :param goal_tolerance: how near to its goal the walker must learn to come, in event radii, 1 at most
    :param shaping: reward for every event radius of distance gained, beside -1 a step; 0 for none [2.1]
    :param skills: when a walk gets a network of its own: ``"where_needed"``, where walks keep failing, ``"always"`` or
        ``"never"`` (:mod:`~sb3_skillgraph.learning.growth`); with ``**PAPER`` all options have one in any case [2.2]
    :param rules: the paper's rules in place of the graph of walks: with ``**PAPER`` the paper as written; None for the default
    :raises ValueError: if the environment is no goal environment with Box actions, or an argument is out of range
    """

    policy_aliases: ClassVar[dict[str, type[BasePolicy]]] = {"MultiInputPolicy": MultiInputPolicy}

    def __init__(
        self,
        policy: str | type[BasePolicy],
        env: GymEnv | str | None,
        learning_rate: float | Schedule = 1e-3,
        buffer_size: int = 1_000_000,
        learning_starts: int = 1_000,
        batch_size: int = 128,
        tau: float = 0.005,
        gamma: float = 0.98,
        train_freq: int | tuple[int, str] = 2,
        gradient_steps: int = 1,
        action_noise: ActionNoise | float | None = 0.1,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        *,
        option_class: type[OffPolicyAlgorithm] | str = OptionDDPG,
        option_kwargs: dict[str, Any] | None = None,
        option_view: str | View | None = None,
        event_radius: float | Sequence[float] | Metric | MetricFunction | None = None,
        max_events: int = 500,
        walk_steps: int = 40,
        salience: Literal["frontier", "rrt", "dco"] | Salience = "frontier",
        exploration_steps: int = 100,
        explore_beyond: float = 0.0,
        hindsight: float = 0.8,
        goal_tolerance: float = 0.5,
        shaping: float = 0.0,
        skills: Literal["where_needed", "always", "never"] = "never",
        rules: PaperRules | None = None,
    ) -> None:
        # The keyword arguments as given: what is saved, and what load() builds the agent from.
        self._arguments = {k: v for k, v in locals().items() if k not in ("self", "env", "_init_setup_model", "__class__")}
        is_class = isinstance(policy, type) and issubclass(policy, BasePolicy)
        if not is_class and policy not in self.policy_aliases:
            raise ValueError(f"Unknown policy {policy!r}: goal environments have Dict observations, use 'MultiInputPolicy'.")
        check_arguments(self._arguments)
        refuse_changed_goals(env)
        if env is not None and not isinstance(env, str):
            GoalSpec.of(env.observation_space, env.action_space)  # before SB3 asserts less clearly
        shared = signature(OffPolicyAlgorithm.__init__).parameters
        sb3s = {name: value for name, value in self._arguments.items() if name in shared}
        sb3s["action_noise"] = action_noise if isinstance(action_noise, ActionNoise) else None
        super().__init__(env=env, **sb3s, sde_support=False, support_multi_env=True)  # type: ignore[arg-type]
        self.rules = rules
        self._interrupts = Interrupts()
        self._env_snapshot: dict[str, Any] | None = None
        self._loaded: persistence.Loaded | None = None  # until it is put to use
        if _init_setup_model:
            self._setup_model()

    def __repr__(self) -> str:
        graph = self.graph if hasattr(self, "parts") else "not set up"
        return f"<SkillGraphAgent after {self.num_timesteps} steps: {graph}>"

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        wrapped = OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        if type(wrapped) is DummyVecEnv and wrapped is not env and isinstance(wrapped.observation_space, spaces.Dict):
            return LeanVecEnv(wrapped.envs)
        return wrapped

    def _setup_model(self) -> None:
        self._setup_lr_schedule()
        self.set_random_seed(self.seed)
        self._convert_train_freq()
        self._spec = GoalSpec.of(self.observation_space, self.action_space)
        if self.rules is None:
            self.parts: Any = Parts(self, self._spec, self._arguments)
        else:
            from sb3_skillgraph.paper.parts import PaperParts  # when it is used: networkx takes a while to import

            self.parts = PaperParts(self, self._spec, self._arguments)
        self.parts.heed_time_limit(self.env)
        # Under SB3's names as well: CheckpointCallback looks for the one, users for the other.
        self.replay_buffer = self.parts.store
        self.policy = self.parts.walker.learner.policy
        self.policy.predict = self._predict_by_policy  # type: ignore[method-assign]
        self.episodes = Episodes(self)

    def _predict_by_policy(self, observation: Any, *args: Any, **kwargs: Any) -> Any:
        """Act on the environment's observations where ``policy.predict`` is asked: the walker's policy sees others."""
        if isinstance(observation, dict):
            return self.predict(observation, *args, **kwargs)
        return type(self.policy).predict(self.policy, observation, *args, **kwargs)

    # -- what it knows ------------------------------------------------------------------------------------------------

    @property
    def graph(self) -> Any:
        """The skill graph, a :class:`~sb3_skillgraph.graph.SkillGraph`."""
        return self.parts.graph

    @property
    def events(self) -> list[Event]:
        """All events in the order of their discovery."""
        return list(self.graph.events)

    @property
    def options(self) -> Walks | list[Option]:
        """All options: the walks, one to each event, which share their SB3 model, ``option.learner``.

        With ``**PAPER`` they are skills, each with a model of its own.
        """
        return self.parts.options()

    @property
    def metric(self) -> Metric:
        """How near to a goal, or to the centre of an event, is there: what was given as ``event_radius``."""
        return self.graph.metric

    @property
    def event_radius(self) -> float:
        """Radius of the events, in the metric's unit: goal units, unless a goal has several."""
        return float(self.metric.radius)

    # -- learning -----------------------------------------------------------------------------------------------------

    def learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "SkillGraph",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> Self:
        """
        Explore and learn, without reward. The arguments are those of SB3's off-policy algorithms.

        With ``reset_num_timesteps=False`` it continues the last call: counters go on, and environments that can tell their
        state are put where they were.

        :return: the agent
        :raises ValueError: if an observation, or what the policy does, holds NaN or inf
        :raises RuntimeError: if an environment, or its worker process, cannot be reached any more
        """
        try:
            with self._interrupts.watched():
                return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)  # type: ignore[arg-type]
        except (EOFError, ConnectionError) as error:
            raise RuntimeError(
                f"The environment, or a worker process of it, cannot be reached any more ({error!r}). The agent can be saved, "
                "and learning goes on after set_env(another, force_reset=True)."
            ) from error

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        check_attributes(self)
        rollout = self.parts.rollout
        if not reset_num_timesteps:
            # A call may overshoot by part of a roll-out; two calls of N then still end where one of 2N does.
            chunk = self.train_freq.frequency if self.train_freq.unit.value == "step" else 0  # type: ignore[union-attr]
            total_timesteps -= max(0, min(self.num_timesteps - self._total_timesteps, self.n_envs * chunk))
        if rollout.pending is not None:  # the last call ended between a step and its storing: that step never was
            self.parts.rng.bit_generator.state = rollout.pending.rng_state
            self._last_obs = None
        resumed = not reset_num_timesteps and persistence.restore_env(self)
        self._env_snapshot, self._loaded = None, None
        goes_on = resumed or (not reset_num_timesteps and self._last_obs is not None)
        noise = copy.deepcopy(self.action_noise) if goes_on else None
        total, callback = super()._setup_learn(total_timesteps, callback, reset_num_timesteps, tb_log_name, progress_bar)
        if noise is not None:
            self.action_noise = noise  # SB3 resets it at every call
        if not goes_on:
            first, self._last_obs = self._last_obs, None
            assert isinstance(first, dict)
            check_finite(first, self.num_timesteps)
            self._last_obs = first
            rollout.begin_anew(rows(first, "achieved_goal"))
        return total, callback

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Let the running options act, with noise; nothing is kept until the step is stored."""
        assert isinstance(self._last_obs, dict)
        observation = {key: rows(self._last_obs, key) for key in ("observation", "achieved_goal")}
        with self._interrupts:
            scaled = self.parts.rollout.act(observation, self.num_timesteps < self.learning_starts, action_noise)
        return self.parts.unscale(scaled), scaled

    def _store_transition(
        self,
        replay_buffer: ReplayBuffer,
        buffer_action: np.ndarray,
        new_obs: np.ndarray | dict[str, np.ndarray],
        reward: np.ndarray,
        dones: np.ndarray,
        infos: list[dict[str, Any]],
    ) -> None:
        """Store the step once, and let everything learn from it."""
        assert isinstance(new_obs, dict)
        # An end for good is worth nothing more, a time limit ends only the episode, and who is stuck is given up here
        stuck = np.array([bool(info.get("stuck")) for info in infos])
        terminated = self.episodes.terminated(dones, infos)
        # A VecEnv shows how the next episode begins where one has ended: what is stored is what the step led to
        new_obs, reached = self.episodes.start_over(new_obs, dones, stuck, infos)
        # Nothing is stored of a step that cannot be learned from
        check_finite(new_obs, self.num_timesteps)
        if reached is not new_obs:
            check_finite(reached, self.num_timesteps)
        # Ctrl-C waits until all that learns from the step has done so
        with self._interrupts:
            observations = {key: rows(reached, key) for key in ("observation", "achieved_goal")}
            self.parts.rollout.observe(observations, terminated, dones, stuck)
            for i in np.flatnonzero(dones).tolist():
                self.parts.witness.begin(i, rows(new_obs, "achieved_goal")[i])
            self._last_obs = new_obs

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Do minibatch updates of the walker; with ``**PAPER``, of the options that run.

        :param gradient_steps: number of updates
        :param batch_size: transitions in a minibatch
        """
        if len(self.parts.store) < batch_size:
            return  # loaded without its replay buffer: first gather some experience
        if self.gradient_steps > 0:
            gradient_steps *= self.n_envs  # as many for a step, however many environments take it at once
        # The walker learns from everything, a skill as much as it has run
        for option, n_updates in self.parts.learners(gradient_steps):
            if n_updates > 0 and option.replay.size() >= batch_size:
                self._train(option.learner, n_updates, batch_size)
            if option is self.parts.walker:
                self.parts.average.follow(n_updates)  # what predict acts by
        self._n_updates += gradient_steps
        self.graph.now = float(self._n_updates)  # records age as the walker learns
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")

    def _train(self, learner: OffPolicyAlgorithm, gradient_steps: int, batch_size: int) -> None:
        learner._current_progress_remaining = self._current_progress_remaining
        own = self._arguments["option_kwargs"] or {}
        learner.gamma, learner.tau = own.get("gamma", self.gamma), own.get("tau", self.tau)  # may have been changed
        learner.train(gradient_steps, batch_size)
        for name, value in learner.logger.name_to_value.items():
            if name != "train/n_updates":
                self.logger.record(name, value)

    def dump_logs(self) -> None:
        """Write SB3's log entry, and the state of the graph under ``skillgraph/``."""
        for name, value in self.graph_summary().items():
            self.logger.record(f"skillgraph/{name}", value)
        super().dump_logs()

    def graph_summary(self) -> dict[str, float]:
        """Describe the graph in numbers.

        :return: what :meth:`SkillGraph.summary` returns, and ``stuck``, the episodes given up since the agent was stuck
        """
        return {**self.graph.summary(), "stuck": self.parts.rollout.n_stuck}

    # -- acting -------------------------------------------------------------------------------------------------------

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Act towards ``observation["desired_goal"]``: run the first option of what :meth:`plan` returns, and plan anew when it
        has ended.

        Pass the returned state back in, as with SB3's recurrent policies: it holds the running option and what has
        happened in the episode. Without it the agent plans at every step, and learns nothing from what has just failed.

        :param observation: one Dict observation, or a batch with a leading axis
        :param state: what the last call returned; see :class:`~sb3_skillgraph.running.RunnerState`
        :param episode_start: where an episode begins, and the state is forgotten; shape ``(n_envs,)``
        :param deterministic: not used: no noise is added either way
        :return: actions in the environment's own bounds, and the state
        :raises ValueError: if the observation does not fit the observation space
        """
        actions, new_state, _ = self.act(observation, state, episode_start)
        return actions, tuple(new_state)

    def act(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
    ) -> tuple[np.ndarray, RunnerState, list[Run]]:
        """
        Act as :meth:`predict` does, and tell which options have ended.

        :return: actions in the environment's own bounds, the state, and one run for each option that has ended
        """
        batch, vectorized = as_batch(observation, self.observation_space)
        running = self._running_state(len(batch["achieved_goal"]), state)
        if episode_start is not None and np.any(episode_start):
            running = running.begun_anew(np.asarray(episode_start, dtype=bool))
        # First end what has arrived or timed out, then begin the first option of a plan where none runs, and act
        running, runs = self.parts.runner.advance(running, batch["achieved_goal"])
        goals = batch["desired_goal"]
        scaled, running = self.parts.runner.act(batch, goals, running.pursuing(goals))
        actions = self.parts.unscale(scaled)
        return (actions if vectorized else actions[0]), running, runs

    def _running_state(self, n_envs: int, state: tuple[np.ndarray, ...] | None) -> RunnerState:
        if state is None:
            return RunnerState.fresh(n_envs, self._spec.goal_dim, self._spec.observation_dim)
        return RunnerState.returned(state, n_envs)

    def running(self, state: tuple[np.ndarray, ...]) -> list[str]:
        """
        Tell which options run.

        :param state: what :meth:`predict` returned
        :return: the option's id for each environment
        :raises ValueError: if it is no such state
        """
        return [str(option) for option in RunnerState.returned(state).option]

    def plan(
        self, obs: dict[str, np.ndarray], goal: np.ndarray | None = None, state: tuple[np.ndarray, ...] | None = None
    ) -> Plan:
        """
        Tell how the agent goes about a goal (section 3.3, Figure 2): what :meth:`predict` would do next, and what then.

        :param obs: one observation
        :param goal: the goal, shape ``(goal_dim,)``; by default ``obs["desired_goal"]``
        :param state: what the last :meth:`predict` returned; None at the start of an episode
        :return: which of the paper's three cases holds, the path, and what it promises
        :raises ValueError: if the goal is not a finite vector of goal space, or there are several environments

        >>> env = gym.make("SkillGraph/ToyMaze-v0")
        >>> agent = SkillGraphAgent("MultiInputPolicy", env, seed=0).learn(300)
        >>> observation, _ = env.reset(options={"start": [-1.0, 1.0], "goal": [1.0, 1.0]})
        >>> plan = agent.plan(observation)
        >>> plan.path[-1]
        'goal'
        >>> _, state = agent.predict(observation)
        >>> agent.running(state) == [plan.path[0]]
        True
        """
        batch, _ = as_batch(obs, self.observation_space)
        if len(batch["achieved_goal"]) != 1:
            raise ValueError(f"A plan is for one environment, not for {len(batch['achieved_goal'])}.")
        target = (batch["desired_goal"][0] if goal is None else as_goal(goal, self._spec.goal_dim)).astype(np.float32)
        running = self._running_state(1, state)
        running, _ = self.parts.runner.advance(running, batch["achieved_goal"])
        return self.parts.plan(running.pursuing(target[None]), batch["achieved_goal"][0], target)

    def adapt(
        self,
        goal: np.ndarray,
        *,
        start: np.ndarray | None = None,
        total_timesteps: int = 10_000,
        callback: MaybeCallback = None,
    ) -> Self:
        """
        Learn to reach a goal the graph does not reach yet (section 3.3, cases b and c).

        For ``total_timesteps`` the agent pursues nothing else. While it has not been there it looks for a way, from the event
        nearest to the goal and from others; whoever arrives goes elsewhere, to come back. With ``**PAPER`` a chain to the goal
        is learned from the nearest vertex, or one option from where another can start.

        :param goal: shape ``(goal_dim,)``
        :param start: where episodes begin meanwhile, for environments whose ``reset`` takes ``options={"start": ...}``
        :param total_timesteps: environment steps
        :param callback: SB3 callback(s)
        :return: the agent
        :raises ValueError: if the goal or the start is not a finite vector of goal space, or there are no steps
        """
        if total_timesteps < 1:
            raise ValueError(f"total_timesteps must be 1 at least, not {total_timesteps!r}.")
        target = as_goal(goal, self._spec.goal_dim)
        assert self.env is not None, "Give the agent an environment (set_env) before adapt."
        options = {} if start is None else {"start": as_goal(start, self._spec.goal_dim)}
        self._last_obs, self._env_snapshot = None, None
        try:
            self.parts.missions.pinned = target
            with self.episodes.starting_with(options):
                return self.learn(total_timesteps, callback, log_interval=None, reset_num_timesteps=False)
        finally:
            self.parts.missions.pinned = self._last_obs = None

    # -- saving and loading -------------------------------------------------------------------------------------------

    def get_parameters(self) -> dict[str, Any]:
        """Return the parameters of the walker's networks and optimisers: state dicts under SB3's names."""
        return parameters(self.parts.walker.learner)

    def set_parameters(
        self, load_path_or_dict: str | dict[str, Any], exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """
        Set the parameters of the walker's networks and optimisers; arguments as SB3 has them.

        :raises ValueError: if a name is unknown, or missing although ``exact_match``; if a file cannot be read
        :raises RuntimeError: if the tensors do not fit
        """
        learner = self.parts.walker.learner
        if isinstance(load_path_or_dict, dict):
            set_parameters(learner, load_path_or_dict, exact_match, device)
        else:
            persistence.load_parameters(learner, load_tree(load_path_or_dict, "agent"), exact_match, device)
        self.parts.average.restart()

    def save(self, path: PathOrFile, exclude: Iterable[str] | None = None, include: Iterable[str] | None = None) -> None:
        """
        Save everything but the replay buffer to one zip of JSON and ``.npy`` members; arguments as SB3 has them.

        The environments' states are saved too, if they can tell them (``get_state``), so that learning can go on
        exactly where it was. Constructor arguments that are excluded take their defaults when the file is loaded.

        :raises OSError: if the file cannot be written; an old file of that name is then untouched
        :raises ValueError: if an attribute holds what SB3 cannot use
        """
        check_attributes(self)
        tree = persistence.agent_tree(self, set(exclude or ()) - set(include or ()))
        check_learned(self, tree, None)  # what load would refuse is not written
        save_tree(path, "agent", tree, by_name=("arguments",))

    def save_replay_buffer(self, path: PathOrFile) -> None:
        """
        Save the filled rows of the replay buffer.

        :raises OSError: if the file cannot be written; an old file of that name is then untouched
        """
        save_tree(path, "replay_buffer", self.parts.get_experience())

    def load_replay_buffer(self, path: PathOrFile, truncate_last_traj: bool = True) -> None:
        """
        Load what :meth:`save_replay_buffer` saved. (Trajectories are kept apart whatever follows.)

        :raises ValueError: if the file is damaged or holds something else, or does not fit this agent
        """
        persistence.restore_experience(self.parts, load_tree(path, "replay_buffer"))

    @classmethod
    def load(
        cls,
        path: PathOrFile,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = False,
        **kwargs: Any,
    ) -> Self:
        """
        Load an agent; nothing in the file is ever executed. Arguments as SB3 has them.

        As SB3's ``load`` does, it seeds the generators of Python, NumPy and torch if the agent was made with a seed, and
        leaves them alone otherwise. ``learn(reset_num_timesteps=False)`` sets them to where they were at saving.

        :param custom_objects: arguments to use in place of the saved ones, as ``kwargs`` are; those of other algorithms are
            left out, as SB3 does
        :param force_reset: begin ``learn`` at a fresh episode even if the environments' states were saved (SB3's default
            is to do so; here learning goes on exactly where it was)
        :raises ValueError: if the file is damaged, of another schema or no agent at all; if the environment does not fit;
            if the agent was made with a function that must be given again
        :raises TypeError: if there is no such argument
        """
        if print_system_info:
            get_system_info()
        known = {name: value for name, value in (custom_objects or {}).items() if name in signature(cls).parameters}
        return persistence.load(cls, path, env, device, {**known, **kwargs}, force_reset)

    def copy(self, env: GymEnv) -> Self:
        """Return a copy with an environment of its own, replay buffer included; what it learns leaves this one as it is."""
        return persistence.copy(self, env)

    def set_env(self, env: GymEnv, force_reset: bool = True) -> None:
        """
        Give the agent another environment with the same spaces and the same number of copies.

        From now on plans are about its episodes.

        :param force_reset: whether ``learn`` begins at a fresh episode; False to go on where the saved environments were
        :raises ValueError: if the environment does not fit, or is normalised by VecNormalize
        """
        refuse_changed_goals(env)
        env = self._wrap_env(env, self.verbose)
        if env.num_envs != self.n_envs:
            raise ValueError(
                f"The number of environments must stay {self.n_envs} in set_env, not become {env.num_envs}: "
                "load(path, env=env) takes any number."
            )
        super().set_env(env, force_reset)
        self.parts.heed_time_limit(self.env)
        if force_reset:
            self._env_snapshot, self._loaded = None, None
