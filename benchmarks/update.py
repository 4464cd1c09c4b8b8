"""
What one update costs: ``OptionDDPG`` and ``OptionTD3``, compiled and in torch, against SB3's DDPG and TD3.

All learn in one process on one thread and take turns, so that what else the machine does hits all alike; medians are
over the turns. *Fresh* models have just been built, their buffer full of noise. *Aged* ones go on from the walker that
SB3 has trained in 5000 steps of a ``SkillGraphAgent`` on PointMaze, their buffer full of its minibatches: many units have
died, and Adam's moments of dead units have decayed into denormal numbers, which many processors are slow at.

Beside them the time that the update's matrix products alone take, the weights where they are, over and over: by torch's
BLAS, which is the kernel's and SB3's, and by SciPy's, which is what compiled code would multiply by otherwise. No update,
which samples a minibatch as well, can be faster than the former. On a GPU (``--device cuda``), where there is no kernel,
only SB3's and torch's updates are compared, fresh.

Run it with ``OMP_NUM_THREADS=1 python -m benchmarks.update --out benchmarks/results/update.json``.
"""

import argparse
import dataclasses
import itertools
import json
import platform
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numba import njit
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.options.learner import OptionDDPG, OptionTD3

ENV = "SkillGraph/PointMazeMedium-v0"
SIZES = 4, 2  # of its view of a goal, and of its actions
AGE = 5_000  # environment steps of an aged model, with as many updates
BUFFER = 10_000  # transitions
CLASSES: dict[str, tuple[type[TD3], type[OptionDDPG | OptionTD3]]] = {"DDPG": (DDPG, OptionDDPG), "TD3": (TD3, OptionTD3)}


@dataclasses.dataclass(frozen=True)
class Case:
    """
    One row of the table.

    :param algorithm: "DDPG" or "TD3"
    :param net_arch: units of the hidden layers of actor and critic
    :param batch_size: transitions in a minibatch
    :param aim: what SB3's time over the kernel's should be on fresh models; None asks nothing
    :param floor: what it must be
    """

    algorithm: str
    net_arch: tuple[int, ...]
    batch_size: int
    aim: float | None = None
    floor: float | None = None


CASES = [
    Case("DDPG", (400, 300), 64, 3.3, 2.4),
    Case("DDPG", (400, 300), 256, 2.1, 1.6),
    Case("DDPG", (256, 256), 64, 4.0, 2.8),
    Case("TD3", (128, 128), 256, 4.0, 2.8),
    Case("DDPG", (128, 128), 128),
]
OVER_PRODUCTS = 1.3, 1.6  # aim and floor of the kernel's time over that of the products by its own BLAS
BLAS = "torch", "scipy"  # whose products are timed beside it
COLUMNS = ("sb3", "reference", "kernel", "speedup", *(f"{what}_{blas}" for blas in BLAS for what in ("products", "over")))
AGEING = 1.1  # what an aged model's time may be over a fresh one's


def build(cls: type[TD3], case: Case, device: str = "cpu") -> TD3:
    """
    :param cls: DDPG or TD3, SB3's or ours
    :param case: what to build it for
    :param device: torch device
    :return: a model without an environment, its buffer full of noise
    """
    n_obs, n_actions = SIZES
    policy_kwargs = {"net_arch": list(case.net_arch)}
    # SB3 takes None for an environment and says otherwise.
    no_env: Any = None
    model = cls("MlpPolicy", no_env, policy_kwargs=policy_kwargs, buffer_size=BUFFER, device=device, _init_setup_model=False)
    model.observation_space = spaces.Box(-np.inf, np.inf, (n_obs,), np.float32)
    model.action_space = spaces.Box(-1, 1, (n_actions,), np.float32)
    model.n_envs = 1
    th.manual_seed(0)
    model._setup_model()
    model.set_logger(Logger(folder=None, output_formats=[]))
    buffer, rng = model.replay_buffer, np.random.default_rng(0)
    assert buffer is not None
    buffer.observations[:] = rng.normal(size=buffer.observations.shape)
    buffer.next_observations[:] = rng.normal(size=buffer.next_observations.shape)
    buffer.actions[:] = rng.uniform(-1, 1, buffer.actions.shape)
    buffer.rewards[:] = rng.integers(-1, 1, buffer.rewards.shape)
    buffer.full = True
    return model


def walker(case: Case) -> TD3:
    """
    :param case: what to train
    :return: the learner of an agent after ``AGE`` steps
    """
    agent = SkillGraphAgent(
        "MultiInputPolicy",
        ENV,
        policy_kwargs={"net_arch": list(case.net_arch)},
        batch_size=case.batch_size,
        option_class=CLASSES[case.algorithm][0],  # SB3's: ours keeps no denormal numbers
        train_freq=1,
        seed=0,
        device="cpu",
    )
    agent.learn(AGE)
    learner = agent.parts.walker.learner
    assert isinstance(learner, TD3)
    return learner


def grow_old(models: list[TD3], old: TD3) -> None:
    """
    Give models the networks and the moments of an old one, and minibatches of it for a buffer.

    :param models: with networks of the same layers
    :param old: the one that has learned
    """
    assert old.replay_buffer is not None
    samples = [old.replay_buffer.sample(BUFFER // 10) for _ in range(10)]
    for model in models:
        model.policy.load_state_dict(old.policy.state_dict())
        model.actor.optimizer.load_state_dict(old.actor.optimizer.state_dict())
        model.critic.optimizer.load_state_dict(old.critic.optimizer.state_dict())
        model.gamma = old.gamma
        buffer = model.replay_buffer
        assert isinstance(buffer, ReplayBuffer)
        for name in ("observations", "next_observations", "actions", "rewards", "dones"):
            column = getattr(buffer, name)
            column[:] = th.cat([getattr(sample, name) for sample in samples]).numpy().reshape(column.shape)


def denormals(model: TD3) -> float:
    """
    :param model: one that has learned
    :return: the share of Adam's first moments that are denormal numbers
    """
    states = [*model.actor.optimizer.state.values(), *model.critic.optimizer.state.values()]
    moments = th.cat([state["exp_avg"].flatten().abs() for state in states])
    return ((moments > 0) & (moments < th.finfo(th.float32).tiny)).float().mean().item()


def products(case: Case) -> list[tuple[float, str, tuple[int, int]]]:
    """
    :param case: the networks and the minibatch
    :return: how often one update needs which product of which layer, none of them avoidable, as (times, "forward",
        "weights" or "inputs", (in, out)); the last two are the gradients of a layer's weights and of its inputs
    """
    n_obs, n_actions = SIZES
    critics, delay = (1, 1) if case.algorithm == "DDPG" else (2, 2)
    result: list[tuple[float, str, tuple[int, int]]] = []
    for layer in itertools.pairwise((n_obs, *case.net_arch, n_actions)):
        # The target's actions at every update, the actor's own when it learns.
        result += [(1 + 1 / delay, "forward", layer), (1 / delay, "weights", layer)]
        result += [(1 / delay, "inputs", layer)] if layer[0] != n_obs else []
    for layer in itertools.pairwise((n_obs + n_actions, *case.net_arch, 1)):
        # Every critic and its target at every update; the first critic once more for the actor's loss.
        result += [(2 * critics + 1 / delay, "forward", layer), (critics, "weights", layer)]
        result += [(critics + 1 / delay if layer[0] != n_obs + n_actions else 1 / delay, "inputs", layer)]
    return result


@njit
def multiply(left: np.ndarray, right: np.ndarray, out: np.ndarray) -> None:
    """Multiply as compiled code does by itself, (m, k) by (k, n), into (m, n)."""
    np.dot(left, right, out)


def multiplier(blas: str, left: np.ndarray, right: np.ndarray, out: np.ndarray) -> Callable[[], object]:
    """
    :param blas: one of ``BLAS``
    :param left: (m, k)
    :param right: (k, n)
    :param out: (m, n)
    :return: what multiplies them when it is called
    """
    if blas == "scipy":
        return lambda: multiply(left, right, out)
    factors, result = [th.from_numpy(left), th.from_numpy(right)], th.from_numpy(out)
    return lambda: th.mm(*factors, out=result)


def product_seconds(blas: str, kind: str, batch_size: int, layer: tuple[int, int], repeats: int) -> float:
    """
    :param blas: one of ``BLAS``
    :param kind: see ``products``
    :param batch_size: transitions in a minibatch
    :param layer: numbers in and out
    :param repeats: number of timings
    :return: the median of the seconds that it takes
    """
    fan_in, fan_out = layer
    rng = np.random.default_rng(0)
    weight, inputs, gradient = (
        rng.normal(size=shape).astype(np.float32) for shape in ((fan_out, fan_in), (batch_size, fan_in), (batch_size, fan_out))
    )
    left, right = {"forward": (inputs, weight.T), "weights": (gradient.T, inputs), "inputs": (gradient, weight)}[kind]
    out = np.empty((left.shape[0], right.shape[1]), np.float32)
    return statistics.median(timed(multiplier(blas, left, right, out), repeats))


def timed(function: Callable[[], object], repeats: int) -> list[float]:
    """
    :param function: what to time
    :param repeats: how often
    :return: seconds of every call after the first three
    """
    seconds = []
    for i in range(repeats + 3):
        start = time.perf_counter()
        function()
        if i >= 3:
            seconds.append(time.perf_counter() - start)
    return seconds


def measure(ages: dict[str, dict[str, TD3]], batch_size: int, repeats: int) -> dict[str, dict[str, float]]:
    """
    :param ages: for each age the models; all learn twice a turn, one gradient step a call as after a single environment
        step: an even number, for TD3 to teach its actor in half of them
    :param batch_size: transitions in a minibatch
    :param repeats: number of turns
    :return: for each age the median milliseconds of an update of each model, and "speedup", the median over turns of the
        first model's over the last's
    """
    turns: dict[str, list[list[float]]] = {age: [] for age in ages}
    for _ in range(repeats + 3):
        for age, models in ages.items():
            turns[age].append([timed_updates(model, batch_size) for model in models.values()])
    rows = {}
    for age, models in ages.items():
        counted = turns[age][3:]
        columns = zip(*counted, strict=True)
        rows[age] = {name: 1e3 * statistics.median(column) for name, column in zip(models, columns, strict=True)}
        rows[age]["speedup"] = statistics.median(turn[0] / turn[-1] for turn in counted)
    return rows


def timed_updates(model: TD3, batch_size: int) -> float:
    """
    :param model: learns twice
    :param batch_size: transitions in a minibatch
    :return: seconds of one update
    """
    start = time.perf_counter()
    model.train(1, batch_size)
    model.train(1, batch_size)
    return (time.perf_counter() - start) / 2


def contenders(case: Case, device: str) -> dict[str, TD3]:
    """
    :param case: what to build them for
    :param device: torch device
    :return: SB3's model, ours updated by torch and, on a CPU, ours updated by the kernel
    """
    stock, ours = CLASSES[case.algorithm]
    reference = build(ours, case, device)
    # The same class without a kernel.
    reference.__dict__["_compiled_update"] = lambda: None
    models = {"sb3": build(stock, case, device), "reference": reference}
    return {**models, "kernel": build(ours, case)} if device == "cpu" else models


def verdict(case: Case, fresh: dict[str, float], aged: dict[str, float]) -> str:
    """
    :param case: what is asked
    :param fresh: what was measured of fresh models
    :param aged: and of aged ones
    :return: the bars that are missed, or "ok", or nothing where none is set
    """
    if case.aim is None or case.floor is None:
        return ""
    missed = []
    if fresh["speedup"] < case.aim:
        missed.append("speedup below the " + ("floor" if fresh["speedup"] < case.floor else "aim"))
    aim, floor = OVER_PRODUCTS
    if fresh["over_torch"] > aim:
        missed.append("products below the " + ("floor" if fresh["over_torch"] > floor else "aim"))
    if aged["kernel"] > AGEING * fresh["kernel"]:
        missed.append("slower with age")
    return ", ".join(missed) or "ok"


def main() -> None:
    """Print the table, and write it where ``--out`` says."""
    parser = argparse.ArgumentParser(description="Time one update against SB3's.")
    parser.add_argument("--repeats", type=int, default=100, help="turns of each model (two updates a turn)")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu", help="where the networks are")
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    on_cpu = arguments.device == "cpu"
    results = []
    print(f"{'case':<24}{'age':<7}" + "".join(f"{name:>{len(name) + 2}}" for name in COLUMNS))
    for case in CASES:
        name = f"{case.algorithm} {'-'.join(map(str, case.net_arch))} B={case.batch_size}"
        ages = {"fresh": contenders(case, arguments.device)}
        if on_cpu:
            ages["aged"] = contenders(case, arguments.device)
            old = walker(case)
            grow_old(list(ages["aged"].values()), old)
        rows = measure(ages, case.batch_size, arguments.repeats)
        if on_cpu:
            rows["aged"]["denormals"] = denormals(old)
        for age, row in rows.items():
            for blas in BLAS if on_cpu else ():
                each = (n * product_seconds(blas, kind, case.batch_size, layer, 20) for n, kind, layer in products(case))
                row[f"products_{blas}"] = 1e3 * sum(each)
                row[f"over_{blas}"] = row["kernel"] / row[f"products_{blas}"]
            columns = "".join(f"{row.get(key, float('nan')):{len(key) + 2}.2f}" for key in COLUMNS)
            print(f"{name:<24}{age:<7}{columns}", flush=True)
        if on_cpu:
            print(f"{'':<24}{verdict(case, rows['fresh'], rows['aged'])}", flush=True)
        results.append({**dataclasses.asdict(case), **rows})
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        device = platform.processor() or platform.machine() if on_cpu else th.cuda.get_device_name()
        report = {"torch": th.__version__, "device": device, "cases": results}
        arguments.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
