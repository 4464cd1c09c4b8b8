"""What the agent does at every environment step: SB3's hooks for roll-outs and training (section 3, Figure 10)."""

import copy
import functools
import time
import warnings
from collections.abc import Sequence
from itertools import compress
from typing import Any, NamedTuple

import numpy as np
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.type_aliases import MaybeCallback

from sb3_skillgraph.assembly import Assembly
from sb3_skillgraph.controller import GLOBAL, ControllerState, Request
from sb3_skillgraph.goal_env import check_finite, rows, with_terminal
from sb3_skillgraph.interrupts import Interrupts
from sb3_skillgraph.options.option import Option

#: What an environment may tell in ``info`` where it ends an episode, by the names in use.
EXPLAINED = ("stuck", "success", "is_success")


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


class Rollouts(Assembly):
    """Acts and learns, one environment step at a time; it is part of a :class:`~sb3_skillgraph.SkillGraphAgent`."""

    _exploration_noise: float
    _random_action_prob: float
    _random_hold: int
    _reset_options: dict[str, Any]
    _interrupts: Interrupts

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
        random_walks = [mission.random_walk for mission in self.curriculum.missions]
        scaled, held, hold_left = self._explore(scaled, random_walks, action_noise)
        self._pending = _Pending(observation, requests, scaled, aims, state, held, hold_left, rng_state)
        return self._factory.unscale(scaled).reshape((n_envs, *self._action_space().shape)), scaled

    def _explore(
        self, scaled: np.ndarray, random_walks: Sequence[bool], action_noise: ActionNoise | None = None
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Add noise, or replace an action by a random one that is held for some steps."""
        if action_noise is not None:
            scaled = scaled + action_noise()
        elif self._exploration_noise:
            scaled = scaled + self.rng.normal(0.0, self._exploration_noise, scaled.shape)
        held, hold_left = self._held_actions, self._hold_left.copy()
        for i, random_walk in enumerate(random_walks):
            if hold_left[i] == 0 and (random_walk or self.rng.random() < self._random_action_prob / self._random_hold):
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
            if any(not any(info.get(why) for why in EXPLAINED) for info in compress(infos, terminated)):
                _warn_of_ends()
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


@functools.cache
def _warn_of_ends() -> None:
    warnings.warn(
        "The environment ended an episode (terminated) without telling success or, in info['stuck'], that the agent can do "
        "nothing any more. An end as such costs options nothing, so that they learn to seek it: where it is a failure, let "
        "the environment tell, for example with TellStuck.",
        stacklevel=4,
    )
