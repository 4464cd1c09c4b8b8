"""
What one gradient step costs: ``OptionDDPG`` and ``OptionTD3`` against SB3's DDPG and TD3.

Both learn in one process on one thread and take turns, so that what else the machine does hits both alike; medians
are over the turns. Beside them the time that the update's matrix products alone take, each in the fastest layout
of torch's: no update without other arithmetic can be faster. On a GPU (``--device cuda``) there is no such column: there
an update costs what it takes to start its kernels.

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
from stable_baselines3 import DDPG, TD3
from stable_baselines3.common.logger import Logger

from sb3_skillgraph.options.learner import OptionDDPG, OptionTD3

SHAPES = {"point": (6, 2), "ant": (31, 8)}


@dataclasses.dataclass(frozen=True)
class Case:
    """
    One row of the table.

    :param algorithm: "DDPG" or "TD3"
    :param net_arch: units of the hidden layers of actor and critic
    :param batch_size: transitions in a minibatch
    :param shape: key of ``SHAPES``: sizes of observation and action
    :param min_speedup: what is asked of SB3's time over ours; None asks nothing
    :param max_over_gemm: what is asked of our time over that of the matrix products; None asks nothing
    """

    algorithm: str
    net_arch: tuple[int, ...]
    batch_size: int
    shape: str
    min_speedup: float | None = None
    max_over_gemm: float | None = None


CASES = [
    *(Case("DDPG", (400, 300), 64, shape, 2.0, 1.6) for shape in SHAPES),
    *(Case("DDPG", (400, 300), 256, shape, 2.0, 1.45) for shape in SHAPES),
    *(Case("TD3", (128, 128), 256, shape, 1.8) for shape in SHAPES),
    *(Case("DDPG", (256, 256), batch, "point") for batch in (64, 256)),
    *(Case("TD3", (256, 256), batch, "point") for batch in (64, 256)),
]
CUDA_CASES = [Case(algorithm, (400, 300), 256, shape, 1.5) for algorithm in ("DDPG", "TD3") for shape in SHAPES]


def build(cls: type[TD3], case: Case, device: str = "cpu") -> TD3:
    """
    :param cls: DDPG or TD3, SB3's or ours
    :param case: what to build it for
    :param device: torch device
    :return: a model without an environment, its buffer full of noise
    """
    n_obs, n_actions = SHAPES[case.shape]
    policy_kwargs = {"net_arch": list(case.net_arch)}
    # SB3 takes None for an environment and says otherwise.
    no_env: Any = None
    model = cls("MlpPolicy", no_env, policy_kwargs=policy_kwargs, buffer_size=10_000, device=device, _init_setup_model=False)
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


def products(case: Case) -> list[tuple[float, tuple[int, int, int]]]:
    """
    :param case: the networks and the minibatch
    :return: how often one update multiplies (m, k) by (k, n), as (times, (m, k, n)), none of them avoidable
    """
    n_obs, n_actions = SHAPES[case.shape]
    batch, (critics, delay) = case.batch_size, (1, 1) if case.algorithm == "DDPG" else (2, 2)
    result: list[tuple[float, tuple[int, int, int]]] = []
    for is_actor, sizes in (
        (True, (n_obs, *case.net_arch, n_actions)),
        (False, (n_obs + n_actions, *case.net_arch, 1)),
    ):
        for i, (fan_in, fan_out) in enumerate(itertools.pairwise(sizes)):
            forward, through = (batch, fan_in, fan_out), (batch, fan_out, fan_in)
            weights = (fan_out, batch, fan_in)
            if is_actor:
                # The target's actions at every update, the actor's own when it learns.
                result += [(1 + 1 / delay, forward), (1 / delay, weights)]
                result += [(1 / delay, through)] if i > 0 else []
            else:
                # Every critic and its target at every update; the first critic once more for the actor's loss.
                result += [(2 * critics + 1 / delay, forward), (critics, weights)]
                first = (batch, fan_out, n_actions)
                result += [(critics + 1 / delay, through)] if i > 0 else [(1 / delay, first)]
    return result


def fastest_product(shape: tuple[int, int, int], repeats: int) -> float:
    """
    :param shape: (m, k, n) of an (m, k) by (k, n) product
    :param repeats: number of timings of every way to do it
    :return: seconds that it takes, the median over the repeats of the fastest way
    """
    m, k, n = shape
    left, right, out = th.randn(m, k), th.randn(k, n), th.empty(m, n)
    columns, transposed = right.t().contiguous(), left.t().contiguous()
    ways: list[Callable[[], object]] = [
        lambda: th.mm(left, right, out=out),
        lambda: th.mm(left, columns.t(), out=out),
        lambda: th.mm(transposed.t(), right, out=out),
        lambda: th.mm(columns, left.t()),
    ]
    with th.inference_mode():
        return min(statistics.median(timed(way, repeats)) for way in ways)


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


def measure(case: Case, repeats: int, device: str) -> dict[str, float]:
    """
    :param case: what to measure
    :param repeats: number of turns
    :param device: torch device
    :return: milliseconds of ``sb3`` and ``ours`` and their ratio ``speedup`` (the median over turns); on a CPU
        ``gemm`` too, and the ratios ``over_gemm`` and ``ceiling`` (SB3's time over that of the products)
    """
    classes: dict[str, tuple[type[TD3], type[TD3]]] = {"DDPG": (DDPG, OptionDDPG), "TD3": (TD3, OptionTD3)}
    stock_class, our_class = classes[case.algorithm]
    stock, ours = build(stock_class, case, device), build(our_class, case, device)
    # An even number of updates a turn, for TD3 to teach its actor in half of them.
    turns = [[timed_updates(model, case.batch_size) for model in (stock, ours)] for _ in range(repeats + 3)][3:]
    sb3_ms, ours_ms = (1e3 * statistics.median(column) for column in zip(*turns, strict=True))
    row = {"sb3": sb3_ms, "ours": ours_ms, "speedup": statistics.median(a / b for a, b in turns)}
    if device == "cpu":
        gemm_ms = 1e3 * min(sum(times * fastest_product(shape, 20) for times, shape in products(case)) for _ in range(3))
        row |= {"gemm": gemm_ms, "over_gemm": ours_ms / gemm_ms, "ceiling": sb3_ms / gemm_ms}
    return row


def timed_updates(model: TD3, batch_size: int) -> float:
    """
    :param model: learns twice, one gradient step a call as after a single environment step
    :param batch_size: transitions in a minibatch
    :return: seconds of one call
    """
    start = time.perf_counter()
    model.train(1, batch_size)
    model.train(1, batch_size)
    return (time.perf_counter() - start) / 2


def verdict(case: Case, row: dict[str, float]) -> str:
    """
    :param case: what is asked
    :param row: what was measured
    :return: the bars that are missed, or "ok", or nothing where none is set
    """
    missed = []
    if case.min_speedup is not None and row["speedup"] < case.min_speedup:
        missed.append(f"speedup < {case.min_speedup}")
    if case.max_over_gemm is not None and row["over_gemm"] > case.max_over_gemm:
        missed.append(f"over GEMM > {case.max_over_gemm}")
    asked = case.min_speedup is not None or case.max_over_gemm is not None
    return ", ".join(missed) or ("ok" if asked else "")


def main() -> None:
    """Print the table, and write it where ``--out`` says."""
    parser = argparse.ArgumentParser(description="Time one gradient step against SB3's.")
    parser.add_argument("--repeats", type=int, default=100, help="turns of each model (two updates a turn)")
    parser.add_argument("--device", choices=["cpu", "cuda"], default="cpu", help="where the networks are")
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    on_cpu = arguments.device == "cpu"
    results = []
    print(
        f"{'case':<32}{'SB3 ms':>8}{'ours ms':>9}{'speedup':>9}"
        + (f"{'GEMM ms':>9}{'/GEMM':>7}{'ceiling':>9}" if on_cpu else "")
    )
    for case in CASES if on_cpu else CUDA_CASES:
        row = measure(case, arguments.repeats, arguments.device)
        name = f"{case.algorithm} {'-'.join(map(str, case.net_arch))} B={case.batch_size} {case.shape}"
        columns = f"{row['sb3']:8.2f}{row['ours']:9.2f}{row['speedup']:9.2f}"
        if on_cpu:
            columns += f"{row['gemm']:9.2f}{row['over_gemm']:7.2f}{row['ceiling']:9.2f}"
        print(f"{name:<32}{columns}  {verdict(case, row)}", flush=True)
        results.append({**dataclasses.asdict(case), **row})
    if on_cpu:
        ddpg = statistics.median(row["speedup"] for row in results if row["min_speedup"] == 2.0)
        print(f"median speedup of DDPG 400-300: {ddpg:.2f} (asked: 2.2)")
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        device = platform.processor() or platform.machine() if on_cpu else th.cuda.get_device_name()
        report = {"torch": th.__version__, "device": device, "cases": results}
        arguments.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
