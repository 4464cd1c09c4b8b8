"""The agent: an SB3 off-policy algorithm that discovers, plans, chains and learns (section 3, Figure 10)."""

from typing import Any, ClassVar, Literal, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.td3.policies import MultiInputPolicy

from sb3_skillgraph.controller import ControllerState, OptionOutcome, Request
from sb3_skillgraph.goal_env import GoalSpec, as_batch, as_goal, refuse_vec_normalize
from sb3_skillgraph.interrupts import Interrupts
from sb3_skillgraph.options.learner import OptionDDPG
from sb3_skillgraph.options.views import View
from sb3_skillgraph.planner import Plan
from sb3_skillgraph.rollouts import Rollouts
from sb3_skillgraph.salience.proposals import Salience
from sb3_skillgraph.vec_env import LeanVecEnv

SelfSkillGraphAgent = TypeVar("SelfSkillGraphAgent", bound="SkillGraphAgent")


class SkillGraphAgent(Rollouts):
    """
    Deep Skill Graphs (DSG): discovers salient events without reward, learns options that connect them, arranges both in
    a graph and plans over it to goals never seen in training.

    Paper: Bagaria, Crowley, Lim, Konidaris, *Skill Discovery for Exploration and Planning using Deep Skill Graphs* (2020).
    The defaults are what works best; ``SkillGraphAgent(..., **PAPER)`` is the paper as written.

    :param policy: ``"MultiInputPolicy"`` (goal environments have Dict observations)
    :param env: a goal environment with Box actions, a VecEnv of such, or the id of one
    :param learning_rate: learning rate of actor and critic; ``option_kwargs`` can give the two apart
    :param buffer_size: transitions kept in the store that all options share
    :param learning_starts: environment steps of random actions, without learning, at the start
    :param batch_size: transitions in a minibatch
    :param tau: soft update coefficient of the target networks
    :param gamma: discount factor
    :param train_freq: environment steps between updates
    :param gradient_steps: minibatch updates, over all networks together, per ``train_freq`` steps
    :param action_noise: SB3 action noise; by default Gaussian noise of ``exploration_noise``
    :param replay_buffer_class: refused: options learn from one shared store
    :param replay_buffer_kwargs: refused
    :param optimize_memory_usage: refused
    :param n_steps: refused unless 1
    :param stats_window_size: episodes over which SB3's rollout statistics are averaged
    :param tensorboard_log: folder of the TensorBoard log
    :param policy_kwargs: keyword arguments of every option's policy; ``net_arch`` is ``[128, 128]`` unless given
    :param verbose: 0 for silence, 1 for the progress table
    :param seed: seed of all generators
    :param device: torch device
    :param _init_setup_model: whether to build the networks at construction
    :param use_sde: refused
    :param option_class: SB3 off-policy class of the options' policies
    :param option_kwargs: further keyword arguments for it
    :param option_view: what a policy sees of (observation, achieved goal, goal): ``"relative"`` (all, and the goal
        relative to where the agent stands), ``"egocentric"`` (without absolute position), ``"body"`` (from a robot's body),
        ``"placed_body"`` (and where that is) or a function; None takes the one the environment names in its attribute
        ``option_view``, else ``"relative"``
    :param option_timeout: environment steps an option may run [A.6]
    :param stall_steps: environment steps after which a run counts as failed that stands still, and the next one begins with a
        random action; None for never
    :param event_radius: radius of salient events, in goal units; None takes the environment's ``success_radius`` or
        ``distance_threshold``
    :param gestation_period: successes after which an option is mature
    :param practice_runs: successful runs of its own that an option needs before its chain counts as complete
    :param warm_start: gestating options act with the global option's policy and copy it when they mature; False lets
        them learn from scratch
    :param global_update_fraction: share of the updates that goes to the global option; executed options share the rest
        (which the global option takes too while none of them is to be trained)
    :param saturation_penalty: weight, in the loss of ``OptionDDPG``'s and ``OptionTD3``'s actors, of the mean squared
        norm of what their tanh is given: keeps them from getting stuck at the bounds of the actions
    :param shaping: reward for every event radius of distance gained, beside -1 a step; 0 for none [2.1]
    :param hindsight: share of sampled transitions relabelled with a goal achieved later
    :param doomed_steps: environment steps before the agent got stuck in which none are relabelled
    :param goal_tolerance: how near the global option must come to a goal, and any option to one put in by hindsight, for
        it to learn that it has reached it; in event radii, 1 at most
    :param shared_experience: share of an option's batches drawn from all experience rather than its own runs
    :param salience: how events are proposed: ``"frontier"`` (visited states), ``"rrt"`` (uniform feasible states from
        the environment's ``sample_free``), ``"dco"`` (the two ends of a learned Fiedler vector) or an object with
        ``propose(rng)`` [3.2.1]
    :param salient_event_freq: K: episodes since the last accepted event after which new ones are sought [A.1.2]
    :param retry_after: R: episodes to wait after an attempt that yielded none [A.1.2]
    :param events_per_attempt: events sought per attempt [A.1.2: a pair]; None for 1, or 2 with ``"dco"``
    :param event_tries: proposals drawn per event until one is not redundant [A.1.1]
    :param event_reach: environment steps that a ``frontier`` event lies at most beyond the last event on its trajectory
    :param max_unconnected: no events are sought while the chains that join so many are still open; None for no limit
    :param target_choice: ``"nearest"`` (the open chain whose source is cheapest to reach, the way back included) or
        ``"uniform"`` (any event [3.2.2])
    :param explore_prob: probability that a mission explores: to the event nearest to a random point, and beyond
    :param exploration_steps: environment steps of such an exploration
    :param explore_beyond: event radii that an exploration towards a random point goes on past it; half of the explorations
        are random walks instead
    :param practise_prob: probability that a mission goes to an event that a path leads to
    :param practise: which one: ``"least_tried"`` (whose last step on the path has run least often) or ``"random"``
    :param max_tries: timed-out options after which a mission is given up
    :param max_failures: failed options in a row after which a chain is given up; None for never
    :param link_reach: a crossing between two events in at most so many steps opens a chain between them; 0 for never
    :param prune_after: episodes after which a chain is let go that no plan has used meanwhile; None for never
    :param off_policy_runs: whether any crossing between a chain's events counts for its gestating root
    :param containment: share of recent samples of an effect set that must lie in an initiation set for an edge; 1.0 is
        strict [3.2.6]
    :param evidence_edges: whether successful runs begun in an event make an edge too
    :param rate_prior: pseudo-counts of successes and of failures in success rates [A.2: none]
    :param min_success_rate: success rate below which an edge is dropped
    :param failure_cost: cost of a failed run in a plan, in successful ones [A.2: 1, which makes a weight 1 / success rate]
    :param nearest: vertex nearest to a goal: by ``"steps"`` along trajectories or ``"euclidean"`` distance [3.2.3]
    :param exploration_noise: standard deviation of Gaussian action noise, in units of the scaled action
    :param random_action_prob: probability of a uniformly random action
    :param random_hold: a random action is held for so many steps in the mean
    :raises ValueError: if the environment is no goal environment with Box actions, or an argument is refused
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
        action_noise: ActionNoise | None = None,
        replay_buffer_class: type[ReplayBuffer] | None = None,
        replay_buffer_kwargs: dict[str, Any] | None = None,
        optimize_memory_usage: bool = False,
        n_steps: int = 1,
        stats_window_size: int = 100,
        tensorboard_log: str | None = None,
        policy_kwargs: dict[str, Any] | None = None,
        verbose: int = 0,
        seed: int | None = None,
        device: th.device | str = "auto",
        _init_setup_model: bool = True,
        *,
        use_sde: bool = False,
        option_class: type[OffPolicyAlgorithm] = OptionDDPG,
        option_kwargs: dict[str, Any] | None = None,
        option_view: str | View | None = None,
        option_timeout: int = 200,
        stall_steps: int | None = 40,
        event_radius: float | None = None,
        gestation_period: int = 1,
        practice_runs: int = 2,
        warm_start: bool = True,
        global_update_fraction: float = 0.5,
        saturation_penalty: float = 1e-4,
        shaping: float = 0.0,
        hindsight: float = 0.8,
        doomed_steps: int = 50,
        goal_tolerance: float = 0.5,
        shared_experience: float = 0.5,
        salience: Literal["frontier", "rrt", "dco"] | Salience = "frontier",
        salient_event_freq: int = 30,
        retry_after: int = 1,
        events_per_attempt: int | None = None,
        event_tries: int = 20,
        event_reach: int = 60,
        max_unconnected: int | None = 5,
        target_choice: Literal["nearest", "uniform"] = "nearest",
        explore_prob: float = 0.2,
        exploration_steps: int = 100,
        explore_beyond: float = 0.0,
        practise_prob: float = 0.2,
        practise: Literal["least_tried", "random"] = "least_tried",
        max_tries: int = 3,
        max_failures: int | None = 12,
        link_reach: int = 100,
        prune_after: int | None = 50,
        off_policy_runs: bool = True,
        containment: float = 0.9,
        evidence_edges: bool = True,
        rate_prior: tuple[float, float] = (1.9, 0.1),
        min_success_rate: float = 0.3,
        failure_cost: float = 5.0,
        nearest: Literal["steps", "euclidean"] = "steps",
        exploration_noise: float = 0.1,
        random_action_prob: float = 0.1,
        random_hold: int = 10,
    ) -> None:
        # The keyword arguments as given: what is saved, and what load() builds the agent from.
        self._arguments = {k: v for k, v in locals().items() if k not in ("self", "env", "_init_setup_model", "__class__")}
        _refuse(replay_buffer_class, replay_buffer_kwargs, optimize_memory_usage, n_steps, use_sde)
        if isinstance(policy, str) and policy not in self.policy_aliases:
            raise ValueError(f"Unknown policy {policy!r}: goal environments have Dict observations, use 'MultiInputPolicy'.")
        refuse_vec_normalize(env)
        if env is not None and not isinstance(env, str):
            GoalSpec.of(env.observation_space, env.action_space)  # before SB3 asserts less clearly
        super().__init__(
            policy=policy,
            env=env,  # type: ignore[arg-type]
            learning_rate=learning_rate,
            buffer_size=buffer_size,
            learning_starts=learning_starts,
            batch_size=batch_size,
            tau=tau,
            gamma=gamma,
            train_freq=train_freq,
            gradient_steps=gradient_steps,
            action_noise=action_noise,
            policy_kwargs=policy_kwargs,
            stats_window_size=stats_window_size,
            tensorboard_log=tensorboard_log,
            verbose=verbose,
            device=device,
            seed=seed,
            sde_support=False,
            support_multi_env=True,
        )
        self._exploration_noise = exploration_noise
        self._random_action_prob = random_action_prob
        self._random_hold = random_hold
        self._reset_options: dict[str, Any] = {}  # while adapting: where episodes start
        self._interrupts = Interrupts()
        if self.env is not None:
            self._spec = GoalSpec.of(self.observation_space, self.action_space)
        if _init_setup_model:
            self._setup_model()

    @staticmethod
    def _wrap_env(env: GymEnv, verbose: int = 0, monitor_wrapper: bool = True) -> VecEnv:
        wrapped = OffPolicyAlgorithm._wrap_env(env, verbose, monitor_wrapper)
        if type(wrapped) is DummyVecEnv and wrapped is not env and isinstance(wrapped.observation_space, spaces.Dict):
            return LeanVecEnv(wrapped.envs)
        return wrapped

    # -- learning -----------------------------------------------------------------------------------------------------

    def learn(
        self: SelfSkillGraphAgent,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int | None = 4,
        tb_log_name: str = "SkillGraph",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfSkillGraphAgent:
        """
        Explore and learn, without reward, as any SB3 off-policy algorithm does with one.

        :param total_timesteps: environment steps, over all environments
        :param callback: SB3 callback(s), called at every step
        :param log_interval: episodes between log entries
        :param tb_log_name: name of the run for TensorBoard
        :param reset_num_timesteps: False continues the last call: counters go on, and environments that can tell their
            state are put where they were
        :param progress_bar: show a progress bar
        :return: the agent
        :raises ValueError: if an observation holds NaN or inf
        """
        with self._interrupts.watched():
            return super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)  # type: ignore[arg-type]

    def dump_logs(self) -> None:
        """Write SB3's log entry, and the state of the graph under ``skillgraph/``."""
        for name, value in self.graph_summary().items():
            self.logger.record(f"skillgraph/{name}", value)
        self.logger.record("skillgraph/rejected_events", self.discovery.n_rejected)
        super().dump_logs()

    def graph_summary(self) -> dict[str, float]:
        """Describe the graph in numbers.

        :return: ``events``; ``options`` (mature) and ``edges``; ``joined_pairs``, the share of ordered event pairs
            joined by a path; ``coverage``, the share of visited states from which some vertex can be entered;
            ``success_rate``, the mean over the options; ``stuck``, episodes given up since the agent was stuck
        """
        options = list(self.graph.options.values())
        rates = [option.success_rate(self.graph.rate_prior) for option in options]
        return {
            "events": len(self.graph.events),
            "options": len(options),
            "edges": self.graph.nx.number_of_edges(),
            "joined_pairs": self.graph.joined_pairs(),
            "coverage": self.planner.coverage(),
            "success_rate": float(np.mean(rates)) if rates else 0.0,
            "stuck": self.curriculum.n_stuck,
        }

    # -- acting -------------------------------------------------------------------------------------------------------

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...] | None]:
        """
        Act towards ``observation["desired_goal"]``: over the graph where a path leads, else along a way walked before.

        Pass the returned state back in, as with SB3's recurrent policies: it holds the running option. Without it an
        option is chosen anew at every step, which still makes progress but plans a thousand times.

        :param observation: one Dict observation, or a batch with a leading axis
        :param state: what the last call returned; arrays of shape ``(n_envs,)``
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
    ) -> tuple[np.ndarray, ControllerState, list[OptionOutcome]]:
        """
        Act as :meth:`predict` does, and tell which options have ended.

        :param observation: one Dict observation, or a batch with a leading axis
        :param state: what the last call returned; arrays of shape ``(n_envs,)``
        :param episode_start: where an episode begins, and the state is forgotten; shape ``(n_envs,)``
        :return: actions in the environment's own bounds, the state, and one outcome for each option that has ended
        :raises ValueError: if the observation does not fit the observation space
        """
        batch, vectorized = as_batch(observation, self.observation_space)
        n_envs = len(batch["achieved_goal"])
        running = ControllerState.fresh(n_envs) if state is None else ControllerState(*state)
        if episode_start is not None and np.any(episode_start):
            running = running.begun_anew(np.asarray(episode_start, dtype=bool))
        requests = [Request(goal) for goal in batch["desired_goal"]]
        running, outcomes = self.controller.advance(running, batch["achieved_goal"], requests)
        scaled, _, running = self.controller.act(batch, running, requests)
        actions = self._factory.unscale(scaled).reshape((n_envs, *self._action_space().shape))
        return (actions if vectorized else actions[0]), running, outcomes

    def plan(self, obs: dict[str, np.ndarray], goal: np.ndarray | None = None) -> Plan:
        """
        Tell how the agent would go about a goal (section 3.3, Figure 2).

        :param obs: one observation
        :param goal: the goal, shape ``(goal_dim,)``; by default ``obs["desired_goal"]``
        :return: which of the paper's three cases holds, and the path
        :raises ValueError: if the goal is not a finite vector of goal space
        """
        batch, _ = as_batch(obs, self.observation_space)
        target = batch["desired_goal"][0] if goal is None else as_goal(goal, self._spec.goal_dim)
        return self.planner.plan(batch["achieved_goal"][0], target, self.event_radius)

    def adapt(
        self: SelfSkillGraphAgent,
        goal: np.ndarray,
        *,
        start: np.ndarray | None = None,
        total_timesteps: int = 10_000,
        callback: MaybeCallback = None,
    ) -> SelfSkillGraphAgent:
        """
        Learn to reach a goal the graph does not reach yet (section 3.3, cases b and c).

        The goal becomes a salient event, joined to the vertex nearest to it by a chain whose options start from what
        is known already; for ``total_timesteps`` the agent pursues nothing else.

        :param goal: shape ``(goal_dim,)``
        :param start: where episodes begin meanwhile, for environments whose ``reset`` takes ``options={"start": ...}``
        :param total_timesteps: environment steps
        :param callback: SB3 callback(s)
        :return: the agent
        :raises ValueError: if the goal or the start is not a finite vector of goal space
        """
        target = as_goal(goal, self._spec.goal_dim)
        assert self.env is not None, "Give the agent an environment (set_env) before adapt."
        self._reset_options = {} if start is None else {"start": as_goal(start, self._spec.goal_dim)}
        self._last_obs, self._env_snapshot = None, None
        try:
            self.env.set_options(self._reset_options)
            self.curriculum.pin(target)
            return self.learn(total_timesteps, callback, log_interval=None, reset_num_timesteps=False)
        finally:
            self.curriculum.unpin()
            self.env.set_options()
            self._reset_options, self._last_obs = {}, None


def _refuse(
    replay_buffer_class: Any, replay_buffer_kwargs: Any, optimize_memory_usage: bool, n_steps: int, use_sde: bool
) -> None:
    reasons = {
        "replay_buffer_class": (replay_buffer_class is not None, "all options learn from views of one shared store"),
        "replay_buffer_kwargs": (bool(replay_buffer_kwargs), "all options learn from views of one shared store"),
        "optimize_memory_usage": (optimize_memory_usage, "the shared store is as small as it can be"),
        "n_steps": (n_steps != 1, "rewards are recomputed per option, one step at a time"),
        "use_sde": (use_sde, "options explore with action noise"),
    }
    for name, (given, reason) in reasons.items():
        if given:
            raise ValueError(f"SkillGraphAgent does not take {name}: {reason}.")
