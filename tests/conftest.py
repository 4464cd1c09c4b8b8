"""What several test modules share: small agents on the NumPy maze, environments that misbehave, comparing states."""

import copy
import io
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

os.environ.setdefault("OMP_NUM_THREADS", "1")

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.noise import ActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.saving import load_tree

th.set_num_threads(1)

TOY, POINT = "SkillGraph/ToyMaze-v0", "SkillGraph/PointMazeUMaze-v0"
#: Small networks and batches, an update at every step: a thousand steps take a second.
SMALL: dict[str, Any] = dict(policy_kwargs=dict(net_arch=[16, 16]), batch_size=32, learning_starts=200, train_freq=1, seed=0)
#: Explorations are short and steps of learning long: two thousand steps give a graph whose walks have been run, with success
#: and without.
EAGER: dict[str, Any] = dict(SMALL, exploration_steps=20, learning_rate=3e-3)


@pytest.fixture(autouse=True, scope="session")
def ctrl_c_is_heard() -> None:
    """A shell lets what it starts in the background ignore it; the tests press it themselves."""
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


def new_agent(env: gym.Env | VecEnv | str = TOY, **kwargs: Any) -> SkillGraphAgent:
    return SkillGraphAgent("MultiInputPolicy", env, **copy.deepcopy({**EAGER, **kwargs}))


def new_vec_env(env_id: str = TOY, n_envs: int = 2, vec_env_cls: type[VecEnv] = DummyVecEnv, **kwargs: Any) -> VecEnv:
    # The module is named for the sake of worker processes, which must import it to know the environment.
    return make_vec_env(f"sb3_skillgraph:{env_id}", n_envs=n_envs, seed=0, vec_env_cls=vec_env_cls, env_kwargs=kwargs)


class Recorder(gym.Wrapper):
    """Notes every transition as the environment made it."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.transitions: list[dict[str, np.ndarray]] = []
        self.starts: list[np.ndarray] = []

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self._last, info = self.env.reset(**kwargs)
        self.starts.append(self._last["achieved_goal"].copy())
        return self._last, info

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        before = self._last
        self._last, reward, terminated, truncated, info = self.env.step(action)
        self.transitions.append(
            {
                "observation": before["observation"].copy(),
                "achieved_goal": before["achieved_goal"].copy(),
                "next_observation": self._last["observation"].copy(),
                "next_achieved_goal": self._last["achieved_goal"].copy(),
                "action": np.array(action),
            }
        )
        return self._last, reward, terminated, truncated, info


class Faulty(gym.Wrapper):
    """Does something once, at a given step or reset, to the observation or instead of the step.

    :param at: number of the step since construction (from 1), or of the reset (from 1) if ``on_reset``
    :param fault: called with the observation; may change it or raise
    """

    def __init__(self, env: gym.Env, at: int, fault: Callable[[dict[str, Any]], None], on_reset: bool = False) -> None:
        super().__init__(env)
        self.at, self.fault, self.on_reset = at, fault, on_reset
        self.n_steps = self.n_resets = 0

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        observation, info = self.env.reset(**kwargs)
        self.n_resets += 1
        if self.on_reset and self.n_resets == self.at:
            self.fault(observation)
        return observation, info

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        observation, *rest = self.env.step(action)
        self.n_steps += 1
        if not self.on_reset and self.n_steps == self.at:
            self.fault(observation)
        return (observation, *rest)


def put(key: str, value: float) -> Callable[[dict[str, Any]], None]:
    """A fault: one number of an observation is replaced."""

    def fault(observation: dict[str, Any]) -> None:
        observation[key] = observation[key].copy()
        observation[key][0] = value

    return fault


def interrupt(_: dict[str, Any]) -> None:
    """A fault: Ctrl-C."""
    raise KeyboardInterrupt


# -- comparing --------------------------------------------------------------------------------------------------------


def differences(a: Any, b: Any, where: str = "") -> list[str]:
    """Where two trees of plain data differ, bit for bit."""
    if type(a) is not type(b):
        return [f"{where}: {type(a).__name__} and {type(b).__name__}"]
    if isinstance(a, dict):
        if list(a) != list(b):
            return [f"{where}: keys {list(a)} and {list(b)}"]
        return [line for key in a for line in differences(a[key], b[key], f"{where}.{key}")]
    if isinstance(a, list | tuple):
        if len(a) != len(b):
            return [f"{where}: lengths {len(a)} and {len(b)}"]
        return [line for i, pair in enumerate(zip(a, b, strict=True)) for line in differences(*pair, f"{where}[{i}]")]
    if isinstance(a, np.ndarray | th.Tensor):
        x, y = np.asarray(a), np.asarray(b)
        same = x.dtype == y.dtype and x.shape == y.shape and x.tobytes() == y.tobytes()
    elif isinstance(a, float):
        same = a == b or (a != a and b != b)
    elif isinstance(a, ActionNoise):
        return differences(vars(a), vars(b), where)
    else:
        same = a == b
    return [] if same else [f"{where}: {a!r} and {b!r}"[:200]]


def state_of(agent: SkillGraphAgent) -> dict[str, Any]:
    """All that an agent would save, with its replay buffer; the generators that SB3 shares among all agents included."""
    files = io.BytesIO(), io.BytesIO()
    agent.save(files[0])
    agent.save_replay_buffer(files[1])
    return state_in(*files)


def state_in(agent_file: Any, replay_file: Any) -> dict[str, Any]:
    return {"agent": load_tree(agent_file, "agent"), "replay": load_tree(replay_file, "replay_buffer")}


def without_clock(state: dict[str, Any]) -> dict[str, Any]:
    """A state without what depends on the time of day, or on how learning was cut into calls."""
    progress = state["agent"]["progress"]
    for name in ("_total_timesteps", "_num_timesteps_at_start"):
        progress["counters"].pop(name)
    progress.pop("current_progress_remaining")
    for info in progress["ep_info_buffer"]:
        info.pop("t")
    return state


def check_store(agent: SkillGraphAgent, transitions: list[dict[str, np.ndarray]], env: int = 0) -> None:
    """Every transition of one environment is in the store, once, and in order."""
    store = agent.parts.store
    rows = np.arange(store.oldest, store.total)[env :: agent.n_envs]
    assert len(rows) == len(transitions)
    if not transitions:
        return
    for name in ("observation", "achieved_goal", "next_observation", "next_achieved_goal"):
        expected = np.array([step[name] for step in transitions], dtype=np.float32)
        np.testing.assert_array_equal(store.column(name, rows), expected, err_msg=name)
    actions = np.array([step["action"] for step in transitions])
    scaled = agent.parts.unscale(store.column("action", rows))
    np.testing.assert_allclose(scaled, actions, atol=1e-6)


def in_new_process(code: str, *arguments: object, hash_seed: int = 1) -> None:
    """Run a program that can import this module; fails with what it printed."""
    search = os.pathsep.join([str(Path(__file__).parent), *sys.path])
    environment = {**os.environ, "PYTHONPATH": search, "PYTHONHASHSEED": str(hash_seed)}
    command = [sys.executable, "-c", code, *map(str, arguments)]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stdout + done.stderr


def rich(agent: SkillGraphAgent) -> bool:
    """Whether an agent's graph has events of both kinds, and edges of which runs are known, good and bad."""
    edges, salient = agent.graph.edges, [event.salient for event in agent.events]
    n_good, n_bad = np.count_nonzero(edges.successes), np.count_nonzero(edges.failures)
    return len(salient) > 12 and 0 < sum(salient) < len(salient) and n_good >= 5 and n_bad >= 1


# -- fixtures ---------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="session")
def trained_files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """An agent that finds its way in the maze, with a graph worth the name, and its replay buffer, as files."""
    folder = tmp_path_factory.mktemp("trained")
    for seed in range(5):  # whether a point that was proposed lies between landmarks is a matter of chance
        agent = new_agent(seed=seed).learn(2000, log_interval=None)
        while not rich(agent) and agent.num_timesteps < 4000:
            agent.learn(100, log_interval=None, reset_num_timesteps=False)
        if rich(agent):
            break
    assert rich(agent), agent.graph_summary()
    agent.save(folder / "agent.zip")
    agent.save_replay_buffer(folder / "replay.zip")
    return folder / "agent.zip", folder / "replay.zip"


@pytest.fixture
def trained(trained_files: tuple[Path, Path]) -> Iterator[SkillGraphAgent]:
    """That agent, to be changed at will."""
    env = gym.make(TOY)
    agent = SkillGraphAgent.load(trained_files[0], env=env)
    agent.load_replay_buffer(trained_files[1])
    yield agent
    env.close()


@pytest.fixture
def one_thread() -> Iterator[None]:
    """Torch on one thread, whatever it had: sums then come out the same to the bit."""
    threads = th.get_num_threads()
    th.set_num_threads(1)
    yield
    th.set_num_threads(threads)
