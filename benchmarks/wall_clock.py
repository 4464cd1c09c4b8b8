"""How many seconds of training bring an agent to success on 0.95 of random pairs, and DDPG with hindsight beside it.

    OMP_NUM_THREADS=1 python -m benchmarks.wall_clock --tasks umaze medium hard --out benchmarks/results/wall_clock.json

An agent learns a stretch at a time on one thread and is tested after each; it is there with the first of two tests in a row
that reach 0.95. The clock runs while it is built and while it learns, not while it is tested; each agent compiles its update
anew. Then SB3's DDPG with hindsight experience replay learns for as many seconds and is tested on the same pairs.
"""

import argparse
import json
import multiprocessing
import os
import pathlib
import shlex
import sys
import tempfile
import time
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import PolicyPredictor

from benchmarks.few_shot import success
from sb3_skillgraph import SkillGraphAgent, __version__
from sb3_skillgraph.baselines import make_her
from sb3_skillgraph.evaluation import sample_pairs
from sb3_skillgraph.hyperparams import load_hyperparams

ENOUGH = 0.95


class Task(NamedTuple):
    """What is learned.

    :param env: id of the environment
    :param stretch: environment steps between two tests
    :param most: environment steps after which the agent is given up
    """

    env: str
    stretch: int
    most: int


TASKS = {
    "umaze": Task("SkillGraph/PointMazeUMaze-v0", 1_000, 20_000),
    "medium": Task("SkillGraph/PointMazeMedium-v0", 2_000, 60_000),
    "hard": Task("SkillGraph/PointMazeHard-v0", 5_000, 120_000),
    "giant": Task("SkillGraph/OGBenchPointGiant-v0", 10_000, 300_000),
    "ant": Task("SkillGraph/AntUMaze-v0", 10_000, 150_000),
}


class StopAt(BaseCallback):
    """Stops learning when the time is up.

    :param seconds: how long to learn
    """

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.end = time.perf_counter() + seconds

    def _on_step(self) -> bool:
        return time.perf_counter() < self.end


def tested(agent: PolicyPredictor, env: gym.Env, pairs: list[tuple[np.ndarray, np.ndarray]]) -> float:
    """Return an agent's success on pairs of start and goal; chance, where an environment has any, is the same each time."""
    env.reset(seed=0)
    return success(agent, env, pairs)


def learn(task: Task, seed: int, pairs: list[tuple[np.ndarray, np.ndarray]], env: gym.Env) -> dict[str, Any]:
    """Let an agent learn until it is there.

    :param task: what to learn
    :param seed: of the agent
    :param pairs: what it is tested on
    :param env: where it is tested
    :return: ``seconds`` until it was there (None if it never was) and ``curve``: steps, seconds and success of each test
    """
    settings = load_hyperparams(task.env)
    settings.pop("n_timesteps")
    begin = time.perf_counter()
    agent = SkillGraphAgent(env=gym.make(task.env), seed=seed, **settings)
    seconds = time.perf_counter() - begin
    curve: list[tuple[int, float, float]] = []
    for n_steps in range(task.stretch, task.most + 1, task.stretch):
        begin = time.perf_counter()
        agent.learn(n_steps - agent.num_timesteps, reset_num_timesteps=False, log_interval=None)
        seconds += time.perf_counter() - begin
        curve.append((n_steps, round(seconds, 1), tested(agent, env, pairs)))
        if len(curve) > 1 and min(curve[-1][2], curve[-2][2]) >= ENOUGH:
            return {"seconds": curve[-2][1], "steps": curve[-2][0], "curve": curve}
    return {"seconds": None, "steps": None, "curve": curve}


def hindsight(task: Task, seed: int, seconds: float) -> BaseAlgorithm:
    """Return DDPG with hindsight that has learned for some seconds, on the same networks and minibatches."""
    settings = load_hyperparams(task.env)
    same = {name: settings[name] for name in ("batch_size", "learning_rate", "gamma", "policy_kwargs") if name in settings}
    model = make_her(gym.make(task.env, terminate_on_success=True), seed=seed, **same)
    return model.learn(10**9, callback=StopAt(seconds), log_interval=10**9)


def run_seed(name: str, seed: int, n_pairs: int, cache: str) -> dict[str, Any]:
    """Let an agent learn until it is there, and DDPG with hindsight for as long.

    :param name: key of ``TASKS``
    :param seed: of both; pairs are drawn with ``seed + 1000``
    :param n_pairs: pairs that they are tested on
    :param cache: folder for what is compiled
    """
    os.environ["NUMBA_CACHE_DIR"] = cache
    th.set_num_threads(1)
    task = TASKS[name]
    env = gym.make(task.env)
    drawn = sample_pairs(env.get_wrapper_attr("geometry"), env.get_wrapper_attr("body_radius"), n_pairs, seed + 1000)
    pairs = [(start, goal) for start, goal, _ in drawn]
    run = {"seed": seed, **learn(task, seed, pairs, env)}
    if run["seconds"] is not None:
        run["her"] = tested(hindsight(task, seed, run["seconds"]), env, pairs)
    return run


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tasks", choices=TASKS, nargs="+", default=list(TASKS))
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--pairs", type=int, default=50)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    args = parser.parse_args()
    command = "python -m benchmarks.wall_clock " + shlex.join(sys.argv[1:])
    document: dict[str, Any] = {"command": command, "version": __version__}
    for name in args.tasks:
        runs = []
        for seed in args.seeds:
            # In a process of its own, with an empty cache: each agent compiles its update.
            with tempfile.TemporaryDirectory() as cache, multiprocessing.get_context("spawn").Pool(1) as pool:
                run = pool.apply(run_seed, (name, seed, args.pairs, cache))
            runs.append(run)
            print(json.dumps({"task": name, **{key: value for key, value in run.items() if key != "curve"}}), flush=True)
            document[name] = runs
            args.out.parent.mkdir(parents=True, exist_ok=True)
            args.out.write_text(json.dumps(document) + "\n")


if __name__ == "__main__":
    main()
