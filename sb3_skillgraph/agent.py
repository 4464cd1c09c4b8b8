"""The agent: an SB3 off-policy algorithm that discovers, plans, chains and learns (section 3, Figure 10)."""

import copy
import time
from typing import Any, ClassVar, Literal, NamedTuple, TypeVar

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.policies import BasePolicy
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, Schedule
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv
from stable_baselines3.td3.policies import MultiInputPolicy

from sb3_skillgraph.assembly import Assembly
from sb3_skillgraph.controller import GLOBAL, ControllerState, OptionOutcome, Request
from sb3_skillgraph.goal_env import GoalSpec, as_batch, as_goal, check_finite, refuse_vec_normalize, rows, with_terminal
from sb3_skillgraph.interrupts import Interrupts
from sb3_skillgraph.options.learner import OptionDDPG
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.views import View
from sb3_skillgraph.planner import Plan
from sb3_skillgraph.salience.proposals import Salience
from sb3_skillgraph.vec_env import LeanVecEnv

SelfSkillGraphAgent = TypeVar("SelfSkillGraphAgent", bound="SkillGraphAgent")


class SkillGraphAgent(Assembly):
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
        relative to where the agent stands), ``"egocentric"`` (without absolute position), ``"body"`` (from a robot's body)
        or a function; None takes the one the environment names in its attribute ``option_view``, else ``"relative"``
    :param option_timeout: environment steps an option may run [A.6]
    :param stall_steps: environment steps after which a run counts as failed that stands still; None for never
    :param event_radius: radius of salient events, in goal units; None takes the environment's ``success_radius`` or
        ``distance_threshold``
    :param gestation_period: successes after which an option is mature
    :param practice_runs: successful runs of its own that an option needs before its chain counts as complete
    :param warm_start: gestating options act with the global option's policy and copy it when they mature; False lets
        them learn from scratch
    :param global_update_fraction: share of the updates that goes to the global option; executed options share the rest
        (which the global option takes too while none of them is to be trained)
    :param saturation_penalty: weight, in the loss of ``OptionDDPG``'s and ``OptionTD3``'s actors, of the mean square of
        what their tanh is given: keeps them from getting stuck at the bounds of the actions
    :param shaping: reward for every event radius of distance gained, beside -1 a step; 0 for none [2.1]
    :param hindsight: share of sampled transitions relabelled with a goal achieved later
    :param goal_tolerance: how near the global option must come to a goal, and any option to one put in by hindsight, for
        it to learn that it has reached it; in event radii
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
    :param practise_prob: probability that a mission goes to an event that a path leads to
    :param practise: which one: ``"least_tried"`` (whose last step on the path has run least often) or ``"random"``
    :param max_tries: timed-out options after which a mission is given up
    :param max_failures: timed-out options in a row after which a chain is given up; None for never
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
    :param random_hold: a random action is held for up to so many steps
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

    # -- learning: SB3's hooks ----------------------------------------------------------------------------------------

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

    def _setup_learn(
        self,
        total_timesteps: int,
        callback: MaybeCallback = None,
        reset_num_timesteps: bool = True,
        tb_log_name: str = "run",
        progress_bar: bool = False,
    ) -> tuple[int, BaseCallback]:
        if not reset_num_timesteps:
            # A call may overshoot by part of a roll-out; two calls of N then still end where one of 2N does.
            total_timesteps -= max(0, min(self.num_timesteps - self._total_timesteps, self.n_envs * self._chunk()))
        if self._pending is not None:  # the last call ended between a step and its storing: that step never was
            self.rng.bit_generator.state = self._pending.rng_state
            self._last_obs = None
        resumed = not reset_num_timesteps and self._restore_env()
        self._env_snapshot = None
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
            self._begin_episodes()
            self.store.cut()
            self.visited.cut(self.n_envs)
            self.curriculum.cut(self.n_envs)
            self._assign_missions()
        return total, callback

    def _chunk(self) -> int:
        return self.train_freq.frequency if self.train_freq.unit.value == "step" else 0  # type: ignore[union-attr]

    def _assign_missions(self) -> None:
        assert isinstance(self._last_obs, dict)
        points = rows(self._last_obs, "achieved_goal")
        for i in range(self.n_envs):
            self.curriculum.assign(i, points[i], warm_up=self.num_timesteps < self.learning_starts)

    def _sample_action(
        self, learning_starts: int, action_noise: ActionNoise | None = None, n_envs: int = 1
    ) -> tuple[np.ndarray, np.ndarray]:
        """Let the running options act, with noise; nothing is kept until the step is stored."""
        assert isinstance(self._last_obs, dict)
        rng_state = self.rng.bit_generator.state
        observation = {key: rows(self._last_obs, key) for key in ("observation", "achieved_goal")}
        requests = [mission.request for mission in self.curriculum.missions]
        scaled, aims, state = self.controller.act(observation, self._state, requests)
        scaled, held, hold_left = self._explore(scaled, action_noise)
        self._pending = _Pending(observation, requests, scaled, aims, state, held, hold_left, rng_state)
        return self._factory.unscale(scaled).reshape((n_envs, *self._action_space().shape)), scaled

    def _explore(self, scaled: np.ndarray, action_noise: ActionNoise | None) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Add noise, or replace an action by a random one that is held for some steps."""
        if action_noise is not None:
            scaled = scaled + action_noise()
        elif self._exploration_noise:
            scaled = scaled + self.rng.normal(0.0, self._exploration_noise, scaled.shape)
        held, hold_left = self._held_actions, self._hold_left.copy()
        for i, mission in enumerate(self.curriculum.missions):
            if hold_left[i] == 0 and (mission.random_walk or self.rng.random() < self._random_action_prob / self._random_hold):
                held = held.copy()
                held[i] = self.rng.uniform(-1.0, 1.0, held[i].shape)
                hold_left[i] = self.rng.integers(1, 2 * self._random_hold)
            if hold_left[i] > 0:
                scaled[i] = held[i]
                hold_left[i] -= 1
        return np.minimum(np.maximum(scaled, -1.0), 1.0).astype(np.float32), held, hold_left

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
        stuck = np.array([bool(info.get("stuck")) for info in infos])
        new_obs = self._start_over(new_obs, dones, stuck, infos)
        reached = with_terminal(new_obs, dones, infos)
        check_finite(new_obs, self.num_timesteps)
        if reached is not new_obs:
            check_finite(reached, self.num_timesteps)
        with self._interrupts:
            self._learn_from_step(reached, dones, stuck, infos)
            self._last_obs = new_obs
            self._pending = None
            if self.pruning.due(self.curriculum.n_episodes):
                self._prune()
            self._assign_missions()

    def _prune(self) -> None:
        running = {f"o{index}" for index in self._state.option.tolist()}
        practised = {mission.chain for mission in self.curriculum.missions if mission.chain is not None}
        self.pruning.prune(self.curriculum.n_episodes, running | practised)
        self._executed = [index for index in self._executed if index == GLOBAL or f"o{index}" in self.chaining.options]

    def _start_over(
        self, new_obs: dict[str, np.ndarray], dones: np.ndarray, stuck: np.ndarray, infos: list[dict[str, Any]]
    ) -> dict[str, np.ndarray]:
        """Give up the episodes of agents that are stuck, and begin all where they are to begin while adapting."""
        assert self.env is not None
        given_up = stuck & ~dones
        resets = given_up | dones if self._reset_options else given_up  # the VecEnv's own resets know no options
        if not resets.any():
            return new_obs
        ended, new_obs = new_obs, {key: np.array(value) for key, value in new_obs.items()}
        for i in np.flatnonzero(resets).tolist():
            if given_up[i]:
                infos[i]["terminal_observation"] = {key: value[i] for key, value in ended.items()}
                self._count_episode(i, infos[i])
            observation, _ = self.env.env_method("reset", options=self._reset_options or None, indices=i)[0]
            for key in new_obs:
                new_obs[key][i] = observation[key]
        dones |= given_up  # in place: SB3 counts episodes by this array
        return new_obs

    def _count_episode(self, i: int, info: dict[str, Any]) -> None:
        """Let SB3's statistics know of an episode that is given up: its Monitor counts only those that end."""
        assert self.env is not None
        if self.env.env_is_wrapped(Monitor, indices=i)[0]:
            rewards = self.env.get_attr("rewards", indices=i)[0]
            seconds = time.time() - self.env.get_attr("t_start", indices=i)[0]
            info["episode"] = {"r": round(sum(rewards), 6), "l": len(rewards), "t": round(seconds, 6)}
            self._update_info_buffer([info], np.ones(1, dtype=bool))

    def _learn_from_step(
        self, reached: dict[str, np.ndarray], dones: np.ndarray, stuck: np.ndarray, infos: list[dict[str, Any]]
    ) -> None:
        step = self._pending
        assert step is not None
        before, points = step.observation["achieved_goal"], rows(reached, "achieved_goal")
        terminated = dones
        if dones.any():
            terminated = dones & ~np.array([info.get("TimeLimit.truncated", False) for info in infos])
        row = self.store.add(
            step.observation["observation"],
            before,
            rows(reached, "observation"),
            points,
            step.action,
            step.aims,
            terminated,
            dones,
            stuck,
        )
        self._held_actions, self._hold_left = step.held_actions, step.hold_left
        self._state, outcomes = self.controller.advance(step.state, points, step.requests, stuck)
        by_env = {outcome.env: outcome for outcome in outcomes}
        options = step.state.option.tolist()
        self._executed = sorted(set(options))
        over = [False] * self.n_envs
        for i, (index, done) in enumerate(zip(options, dones.tolist(), strict=True)):
            if index != GLOBAL:
                self.controller.option(index).replay.add_rows(row[i : i + 1])
            if stuck[i]:
                self.visited.end(i)  # no event is to lie where agents get stuck
            else:
                self.visited.record(i, self.num_timesteps, points[i], done)
            over[i] = self.curriculum.observe(i, before[i], points[i], by_env.get(i), done, bool(stuck[i]))
            if done:
                self._hold_left[i] = 0
        if any(over):
            self._state = self._state.begun_anew(np.array(over))

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """
        Spread minibatch updates over the global option and the options executed last.

        :param gradient_steps: number of updates over all networks
        :param batch_size: transitions in a minibatch
        """
        if len(self.store) < batch_size:
            return  # loaded without its replay buffer: first gather some experience
        executed = [self.controller.option(index) for index in self._executed if index != GLOBAL]
        trainable = [option for option in executed if option.mature or not self._arguments["warm_start"]]
        for _ in range(gradient_steps):
            learner = self._next_learner(trainable).learner
            learner._current_progress_remaining = self._current_progress_remaining
            learner.train(1, batch_size)
        self._n_updates += gradient_steps
        self.logger.record("train/n_updates", self._n_updates, exclude="tensorboard")
        for name, value in self.global_option.learner.logger.name_to_value.items():
            if name != "train/n_updates":
                self.logger.record(name, value)

    def _next_learner(self, trainable: list[Option]) -> Option:
        """Take turns: a share of the updates to the global option, the rest to what was executed."""
        self._credit += self._arguments["global_update_fraction"]
        if self._credit >= 1.0 or not trainable:
            self._credit -= min(self._credit, 1.0)
            return self.global_option
        return trainable[self._n_updates % len(trainable)]

    def dump_logs(self) -> None:
        """Write SB3's log entry, and the state of the graph under ``skillgraph/``."""
        for name, value in self.graph_summary().items():
            self.logger.record(f"skillgraph/{name}", value)
        self.logger.record("skillgraph/rejected_events", self.discovery.n_rejected)
        self.logger.record("skillgraph/stuck", self.curriculum.n_stuck)
        super().dump_logs()

    def graph_summary(self) -> dict[str, float]:
        """Describe the graph in numbers.

        :return: ``events``; ``options`` (mature) and ``edges``; ``joined_pairs``, the share of ordered event pairs
            joined by a path; ``coverage``, the share of visited states from which some vertex can be entered;
            ``success_rate``, the mean over the options
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
        Act towards ``observation["desired_goal"]``: over the graph where a path leads, straight on where none does.

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


class _Pending(NamedTuple):
    """A step between its taking and its storing."""

    observation: dict[str, np.ndarray]
    requests: list[Request]
    action: np.ndarray
    aims: np.ndarray
    state: ControllerState
    held_actions: np.ndarray
    hold_left: np.ndarray
    rng_state: Any


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
