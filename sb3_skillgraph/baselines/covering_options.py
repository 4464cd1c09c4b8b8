"""Deep covering options: skills to the ends of the explored space, composed by SMDP Q-learning (sections 2.3, 4, A.5)."""

import copy
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.utils import LinearSchedule, polyak_update

from sb3_skillgraph.baselines.covering_replay import CoveringReplay, Everywhere, LowEnd
from sb3_skillgraph.baselines.goal_conditioned import GoalSchedule
from sb3_skillgraph.goal_env import GoalSpec
from sb3_skillgraph.learning.dco import learn_fiedler
from sb3_skillgraph.memory.store import TransitionStore, as_rows
from sb3_skillgraph.metric import Ball
from sb3_skillgraph.options.factory import OptionFactory, copy_policy
from sb3_skillgraph.options.learner import OptionDDPG, OptionTD3
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.options.views import ScaledView, as_view
from sb3_skillgraph.smdp import FlatPolicy, OptionsEnv, SMDPQLearning
from sb3_skillgraph.smdp.options_env import MOST_AXES


class CoveringOptions:
    """
    The paper's hierarchical baseline: a fixed number of covering options and primitive actions, chosen among by SMDP
    Q-learning for a goal that is given (section 4, A.5).

    Every 30 episodes (more often if there are fewer, so that half of the steps are left when all options are there) an
    option is learned by DDPG on all experience, in turns to the one and to the other end of an embedding of all
    experience, a new one for every pair; from then on it is among the actions of Q-learning.

    :param env: a goal environment whose episodes end, and are paid, at the goal, with ``info["is_success"]``: without it an
        end at the goal counts as a dead end
    :param n_options: number of options; the paper tries 3, 4, 5 and 10
    :param option_freq: episodes between options
    :param goal_freq: episodes per goal
    :param option_updates: gradient steps when an option is made; later they train in turns
    :param reach: steps that the pairs of states lie at most apart that an embedding is learned from
    :param train_freq: environment steps after which there is training
    :param gradient_steps: gradient steps then
    :param batch_size: transitions in a minibatch
    :param gamma: discount factor per environment step
    :param exploration_noise: standard deviation of the noise on options' scaled actions while learning
    :param option_class: SB3 class of the options' policies: ``OptionDDPG`` or ``OptionTD3``
    :param saturation_penalty: see :class:`~sb3_skillgraph.options.learner.OptionLearner`
    :param shaping: reward of the global option for every success radius of distance gained
    :param seed: of everything random

    Where actions have more than two dimensions a primitive action is one step of a global option (section 4), which learns
    from all experience in hindsight, with half of the gradient steps; it can be run to the goal as well.
    """

    def __init__(
        self,
        env: gym.Env,
        *,
        n_options: int = 5,
        option_freq: int = 30,
        goal_freq: int = 1,
        option_updates: int = 5_000,
        reach: int = 60,
        train_freq: int = 2,
        gradient_steps: int = 1,
        batch_size: int = 128,
        gamma: float = 0.99,
        exploration_noise: float = 0.1,
        option_class: type[OptionDDPG] | type[OptionTD3] = OptionDDPG,
        saturation_penalty: float = 1e-4,
        shaping: float = 0.0,
        seed: int = 0,
    ) -> None:
        assert isinstance(env.action_space, spaces.Box)
        self._arguments = {k: v for k, v in locals().items() if k not in ("self", "env")}
        self.n_options = n_options
        self.option_freq = option_freq
        self.option_updates = option_updates
        self.reach = reach
        self.train_freq = train_freq
        self.gradient_steps = gradient_steps
        self.batch_size = batch_size
        self.exploration_noise = exploration_noise
        self.rng = np.random.default_rng(seed)
        self.num_timesteps = 0
        self.options: list[Option] = []
        spec = GoalSpec.of(env.observation_space, env.action_space)
        self.store = TransitionStore(1_000_000, spec.observation_dim, spec.goal_dim, spec.action_dim)
        metric = Ball(env.get_wrapper_attr("success_radius"))
        view = ScaledView(as_view(env.get_wrapper_attr("option_view")), metric)
        kwargs = dict(
            gamma=gamma,
            actor_learning_rate=1e-3,
            critic_learning_rate=1e-3,
            saturation_penalty=saturation_penalty,
            policy_kwargs={"net_arch": [128, 128]},
        )
        self._factory = OptionFactory(
            option_class, kwargs, self.store, view, env.action_space, 1.0, self.rng, {}, th.device("cpu"), shaping
        )
        self.global_option = self._factory.make("global", None, None) if spec.action_dim > MOST_AXES else None
        self.env = OptionsEnv(
            _Recorder(GoalSchedule(env, goal_freq), self),
            self.options,
            global_option=self.global_option,
            max_options=n_options + 8,
            gamma=gamma,
        )
        self.model = _QLearning(
            "MultiInputPolicy",
            Monitor(self.env),
            learning_rate=1e-4,  # with 1e-3, or a target that follows faster, values grow far beyond what can be earned
            learning_starts=100,
            batch_size=batch_size,
            tau=1e-3,
            gamma=gamma,
            target_update_interval=sys.maxsize,  # after every update instead
            exploration_fraction=0.75,
            exploration_final_eps=0.1,
            policy_kwargs={"net_arch": [128, 128]},
            seed=seed,
        )
        self.model.budget = _Budget(self)
        self._policy = FlatPolicy(self.model, self.env)
        self._next_option = option_freq
        self._n_episodes = 0
        self._on_step: Callable[[int], None] | None = None

    def learn(self, total_timesteps: int, on_step: Callable[[int], None] | None = None) -> "CoveringOptions":
        """Learn.

        :param total_timesteps: environment steps, not decisions
        :param on_step: called after every environment step with their number
        :return: itself
        """
        self._on_step = on_step
        self.model._last_obs = None  # SB3 forgets the last step when it is told to stop; so the environment is reset
        self.store.cut()
        episodes = total_timesteps // int(self.env.get_wrapper_attr("max_steps"))
        self._next_option = self.option_freq = max(1, min(self.option_freq, episodes // (2 * self.n_options)))
        self.model.budget.start, self.model.budget.total = self.num_timesteps, total_timesteps
        self.model.learn(total_timesteps, self.model.budget, log_interval=1_000_000, reset_num_timesteps=False)
        return self

    def copy(self, env: gym.Env) -> "CoveringOptions":
        """Return a copy that knows the same and explores no more than at the end of learning.

        :param env: the environment that it goes on in
        """
        twin = CoveringOptions(env, **self._arguments)
        twin.store.set_state(self.store.get_state())
        twin.store.cut()
        for option in self.options:
            assert isinstance(option.replay, CoveringReplay)
            twin.options.append(twin._option(option.id, option.replay.end, option.replay.scale))
            copy_policy(option, twin.options[-1])
        if self.global_option is not None and twin.global_option is not None:
            copy_policy(self.global_option, twin.global_option)
        twin.model.set_parameters(copy.deepcopy(self.model.get_parameters()))  # type: ignore[arg-type]
        twin.model.replay_buffer = copy.deepcopy(self.model.replay_buffer)
        twin.model.num_timesteps = self.model.num_timesteps
        least = twin.model.exploration_final_eps
        twin.model.exploration_schedule = LinearSchedule(least, least, 1.0)
        return twin

    def save(self, folder: Path) -> None:
        """Save Q-learning as ``q_learning.zip``, an SB3 model, and the options' policies as ``c0.zip``, ``c1.zip``, ...

        :param folder: where to, an existing folder
        """
        self.model.save(folder / "q_learning.zip")
        for option in self.options:
            option.learner.policy.save(str(folder / f"{option.id}.zip"))

    def predict(
        self,
        observation: np.ndarray | dict[str, np.ndarray],
        state: tuple[np.ndarray, ...] | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        """
        Act towards the observation's goal.

        :param observation: one observation
        :param state: what the last call returned
        :param episode_start: where an episode begins, and the state is forgotten
        :param deterministic: whether Q-learning chooses greedily
        :return: the action, and the state
        """
        return self._policy.predict(observation, state, episode_start, deterministic)

    def after_step(self, transition: dict[str, np.ndarray], terminated: bool, done: bool, stuck: bool) -> None:
        """Learn from one environment step.

        :param transition: columns of the store, each of shape ``(1, dim)``
        :param terminated: whether the environment ended for good, but not at the goal
        :param done: whether the episode ended
        :param stuck: whether it was given up since the agent was stuck
        """
        ends = dict(terminated=np.array([terminated]), done=np.array([done]), stuck=np.array([stuck]))
        self.store.add(**transition, **ends)
        self.num_timesteps += 1
        if self.num_timesteps % self.train_freq == 0 and len(self.store) >= self.batch_size:
            option = self._next_learner(self.num_timesteps // self.train_freq)
            if option is not None:
                option.learner.train(self.gradient_steps, self.batch_size)
        self._n_episodes += done
        if done and self._n_episodes >= self._next_option and len(self.options) < self.n_options:
            self._next_option = self._n_episodes + self.option_freq
            self.options.append(self._make_option())
        if self._on_step is not None:
            self._on_step(self.num_timesteps)

    def _next_learner(self, turn: int) -> Option | None:
        """Take turns; a global option takes every other one, as much as a skill graph's has at the least."""
        if self.global_option is not None:
            turn, rest = divmod(turn, 2)
            if rest or not self.options:
                return self.global_option
        return self.options[turn % len(self.options)] if self.options else None

    def _make_option(self) -> Option:
        if len(self.options) % 2:
            other = self.options[-1].termination
            assert isinstance(other, LowEnd)
            embedding, sign = other.embedding, -other.sign
        else:
            embedding, sign = learn_fiedler(self.store, self.reach, 20_000, self.rng), 1.0
        rows = self.rng.integers(self.store.oldest, self.store.total, 20_000)
        end = LowEnd(embedding, sign, self.store.column("achieved_goal", rows))
        before, after = (end.values(self.store.column(name, rows)) for name in ("achieved_goal", "next_achieved_goal"))
        scale = float(np.quantile(np.abs(before - after), 0.95)) or 1.0
        option = self._option(f"c{len(self.options)}", end, scale)
        for _ in range(self.option_updates):
            option.learner.train(1, self.batch_size)
        return option

    def _option(self, id: str, end: LowEnd, scale: float) -> Option:
        option = self._factory.make(id, "low end", end)
        plain, factory = option.replay, self._factory
        option.learner.replay_buffer = covering = CoveringReplay(
            self.store, plain.view, plain.rule._replace(shaping=0.0), factory.observation_space, factory.action_space, self.rng
        )
        covering.end, covering.scale = end, scale
        option.initiation = Everywhere(option.metric.radius)
        option.mature = True
        return option


class _Recorder(gym.Wrapper):
    """Adds noise to what options do, and shows every step to the learner."""

    def __init__(self, env: gym.Env, learner: CoveringOptions) -> None:
        super().__init__(env)
        self.learner = learner
        self._last: dict[str, np.ndarray] = {}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        self._last, info = self.env.reset(seed=seed, options=options)
        return self._last, info

    def step(self, action: np.ndarray) -> Any:
        space = self.env.action_space
        assert isinstance(space, spaces.Box)
        half = 0.5 * (space.high - space.low)
        action = action + self.learner.rng.normal(0.0, self.learner.exploration_noise, action.shape) * half
        action = np.clip(action, space.low, space.high).astype(space.dtype)
        observation, reward, terminated, truncated, info = self.env.step(action)
        transition = as_rows(self._last, (action - space.low) / half - 1.0, observation)
        self._last = observation
        stuck = bool(info.get("stuck"))  # OptionsEnv gives the episode up
        # An episode that ends at its own goal would have gone on for any other.
        dead_end = terminated and not info.get("is_success")
        self.learner.after_step(transition, dead_end, terminated or truncated or stuck, stuck)
        # Steps are environment steps: an option that runs when they are spent is cut off.
        return observation, reward, terminated, truncated or self.learner.model.budget.share_left <= 0.0, info


class _Budget(BaseCallback):
    """Tells environment steps where SB3 counts decisions, and ends learning after so many."""

    start, total = 0, 1

    def __init__(self, learner: CoveringOptions) -> None:
        super().__init__()
        self.learner = learner

    @property
    def share_left(self) -> float:
        return max(0.0, 1.0 - (self.learner.num_timesteps - self.start) / self.total)

    @property
    def updates_due(self) -> int:
        return self.learner.num_timesteps // self.learner.train_freq * self.learner.gradient_steps

    def _on_step(self) -> bool:
        return self.share_left > 0.0


class _QLearning(SMDPQLearning):
    """Counts environment steps, not decisions: of exploration, updates and the target network, which follows softly."""

    budget: _Budget

    def train(self, gradient_steps: int, batch_size: int = 100) -> None:
        """Learn as often as is due after the environment steps of the last decision.

        :param gradient_steps: not used
        :param batch_size: transitions in a minibatch
        """
        for _ in range(self.budget.updates_due - self._n_updates):
            super().train(1, batch_size)
            polyak_update(self.q_net.parameters(), self.q_net_target.parameters(), self.tau)

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), "budget"]

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        self._current_progress_remaining = self.budget.share_left
