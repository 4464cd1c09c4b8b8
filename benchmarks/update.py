"""
What one update costs: ``OptionDDPG`` and ``OptionTD3``, compiled and in torch, against SB3's DDPG and TD3.

All learn in one process on one thread and take turns, so that what else the machine does hits all alike; medians are
over the turns. *Fresh* models have just been built, their buffer full of noise. *Aged* ones go on from the walker that
SB3 has trained in 5000 steps of a ``SkillGraphAgent`` on PointMaze, their buffer full of its minibatches: many units have
died, and Adam's moments of dead units have decayed into denormal numbers, which many processors are slow at.

Beside them, and in turn with them, the matrix products that the kernel's update cannot do without: a plain call of the same
BLAS each, the weights where they are; and, where it is installed (``pip install '.[peers]'``), the update of SBX, which is
SB3 in JAX, on fresh models: compiled, too, and on the one core that the process is bound to. On a GPU (``--device cuda``),
where there is no kernel, only SB3's and torch's updates are compared, fresh.

Run it with ``OMP_NUM_THREADS=1 python -m benchmarks.update --out benchmarks/results/update.json``.
"""

import argparse
import copy
import dataclasses
import importlib
import importlib.util
import json
import os
import platform
import statistics
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from numba import njit
from numba.typed import List
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.logger import Logger
from torch import nn

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.options.kernel import multiply
from sb3_skillgraph.options.learner import OptionDDPG, OptionTD3

ENV = "SkillGraph/PointMazeMedium-v0"
SIZES = 4, 2  # of its view of a goal, and of its actions
AGE = 5_000  # environment steps of an aged model, an update after each but for the first thousand
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
OVER_PRODUCTS = 1.3, 1.6  # aim and floor of the kernel's time over that of its products
COLUMNS = "sb3", "sbx", "reference", "kernel", "products", "speedup", "over"
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
        # A copy each: an optimiser takes the very tensors that it is given.
        model.actor.optimizer.load_state_dict(copy.deepcopy(old.actor.optimizer.state_dict()))
        model.critic.optimizer.load_state_dict(copy.deepcopy(old.critic.optimizer.state_dict()))
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


@njit
def layer_by_layer(weights: list[np.ndarray], inputs: np.ndarray) -> list[np.ndarray]:
    """Multiply on the way forward: return what every layer is given, and last what the network returns."""
    values = [inputs]
    for weight in weights:
        values.append(multiply(values[-1], weight, False, True))
    return values


@njit
def back(weights: list[np.ndarray], values: list[np.ndarray], learns: bool, to_inputs: bool) -> None:
    """Multiply on the way back, for the gradients of the weights if they learn, and on to the inputs if it is asked."""
    gradient = values[-1]
    for layer in range(len(weights) - 1, -1, -1):
        if learns:
            multiply(gradient, values[layer], True, False)
        if layer > 0 or to_inputs:
            gradient = multiply(gradient, weights[layer], False, False)


@njit
def products(
    actor: list[list[np.ndarray]],
    critics: list[list[list[np.ndarray]]],
    seen: np.ndarray,
    valued: np.ndarray,
    with_actor: bool,
) -> None:
    """
    Multiply as one update has to, and do nothing else.

    :param actor: weights (out, in) of the layers of the actor and of its target
    :param critics: of each critic, likewise
    :param seen: what actors are given, (batch, observation)
    :param valued: what critics are given, (batch, observation + action)
    :param with_actor: whether the actor learns, too
    """
    layer_by_layer(actor[1], seen)
    for critic in critics:
        layer_by_layer(critic[1], valued)
    for critic in critics:
        back(critic[0], layer_by_layer(critic[0], valued), True, False)
    if with_actor:
        values = layer_by_layer(actor[0], seen)
        back(critics[0][0], layer_by_layer(critics[0][0], valued), False, True)
        back(actor[0], values, True, False)


def weights(network: nn.Module) -> list[np.ndarray]:
    """
    :param network: an actor's or a critic's
    :return: the weights of its layers, where they are
    """
    return List([module.weight.detach().numpy() for module in network.children() if isinstance(module, nn.Linear)])


def multiplier(model: TD3, batch_size: int) -> Callable[[], None]:
    """
    :param model: whose networks are multiplied with
    :param batch_size: transitions in a minibatch
    :return: what does the products of two updates
    """
    n_obs, n_actions = SIZES
    rng = np.random.default_rng(0)
    seen, valued = (rng.normal(size=(batch_size, size)).astype(np.float32) for size in (n_obs, n_obs + n_actions))
    actor = List([weights(network) for network in (model.actor.mu, model.actor_target.mu)])
    pairs = zip(model.critic.q_networks, model.critic_target.q_networks, strict=True)
    critics = List([List([weights(network) for network in pair]) for pair in pairs])

    def multiply_twice() -> None:
        products(actor, critics, seen, valued, True)
        products(actor, critics, seen, valued, model.policy_delay == 1)

    return multiply_twice


def measure(case: Case, ages: dict[str, dict[str, TD3]], repeats: int) -> dict[str, dict[str, float]]:
    """
    :param case: what the models are built for
    :param ages: for each age the models; all learn twice a turn, one gradient step a call as after a single environment
        step: an even number, for TD3 to teach its actor in half of them. If there is a kernel, its products have a turn,
        too, with networks that no other has just brought into the cache
    :param repeats: number of turns
    :return: for each age the median milliseconds of an update of each model and of the products; "speedup" and "over", the
        medians over turns of SB3's time over the last model's and of the kernel's over that of its products
    """
    twice: dict[str, dict[str, Callable[[], None]]] = {}
    for age, models in ages.items():
        twice[age] = {name: partial(update_twice, model, case.batch_size) for name, model in models.items()}
        if "kernel" in models:
            twice[age]["products"] = multiplier(build(CLASSES[case.algorithm][1], case), case.batch_size)
    turns: dict[str, list[dict[str, float]]] = {age: [] for age in ages}
    for _ in range(repeats + 3):
        for age, functions in twice.items():
            turns[age].append({name: timed(function) / 2 for name, function in functions.items()})
    rows = {}
    for age, models in ages.items():
        counted = turns[age][3:]
        rows[age] = {name: 1e3 * statistics.median(turn[name] for turn in counted) for name in twice[age]}
        ours = list(models)[-1]
        rows[age]["speedup"] = statistics.median(turn["sb3"] / turn[ours] for turn in counted)
        if "kernel" in models:
            rows[age]["over"] = statistics.median(turn["kernel"] / turn["products"] for turn in counted)
    return rows


def update_twice(model: TD3, batch_size: int) -> None:
    """
    :param model: learns twice
    :param batch_size: transitions in a minibatch
    """
    model.train(1, batch_size)
    model.train(1, batch_size)


def timed(function: Callable[[], object]) -> float:
    """
    :param function: what to time
    :return: seconds it took
    """
    start = time.perf_counter()
    function()
    return time.perf_counter() - start


def peers(case: Case) -> dict[str, TD3]:
    """
    :param case: what to build it for
    :return: SBX's model, where SBX is installed
    """
    if importlib.util.find_spec("sbx") is None:
        return {}
    # JAX takes as many threads as there are cores for the process, and it looks when it is imported.
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    return {"sbx": build(getattr(importlib.import_module("sbx"), case.algorithm), case)}


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
    if fresh["over"] > aim:
        missed.append("products below the " + ("floor" if fresh["over"] > floor else "aim"))
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
    print(f"{'case':<24}{'age':<7}" + "".join(f"{name:>11}" for name in COLUMNS))
    for case in CASES:
        name = f"{case.algorithm} {'-'.join(map(str, case.net_arch))} B={case.batch_size}"
        ages = {"fresh": contenders(case, arguments.device)}
        if on_cpu:
            ages["fresh"] = {**peers(case), **ages["fresh"]}
            ages["aged"] = contenders(case, arguments.device)
            old = walker(case)
            grow_old(list(ages["aged"].values()), old)
        rows = measure(case, ages, arguments.repeats)
        if on_cpu:
            rows["aged"]["denormals"] = denormals(old)
        for age, row in rows.items():
            columns = "".join(f"{row.get(key, float('nan')):11.2f}" for key in COLUMNS)
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
