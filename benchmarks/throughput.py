"""
What one environment step of ``learn()`` costs: ``SkillGraphAgent`` against SB3's DDPG.

Both learn in one process on one thread, on environments of their own, with the same networks, the same minibatch and
one update per environment step: after every step, or eight of them after every eighth. They take turns, after a warm-up
in which both learn and the agent finds the events of its graph, so that what else the machine does hits both alike.
Medians are over the turns. The breakdown: *simulation* is the environment's
``step`` as ``gym.make`` returns it, *update* is ``train`` (sampling included), *rest* is all else: roll-out loop,
plans, the ends of options, the graph, the store.

Run it with ``OMP_NUM_THREADS=1 python -m benchmarks.throughput --out benchmarks/results/throughput.json``.
"""

import argparse
import json
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import torch as th
from stable_baselines3 import DDPG
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from sb3_skillgraph import SkillGraphAgent

ENVS = {"point": "SkillGraph/PointMazeMedium-v0", "ant": "SkillGraph/AntUMaze-v0"}
RANDOM_STEPS = 1_000  # at the start, without learning
PARTS = ("simulation", "update", "rest")


class Case(NamedTuple):
    """One row of the table; ``min_speedup`` is what is asked, None asks nothing."""

    env: str
    net_arch: tuple[int, ...]
    batch_size: int
    train_freq: int
    min_speedup: float | None = None


CASES = [
    Case("point", (128, 128), 128, 1, 2.6),
    Case("ant", (128, 128), 128, 1, 1.8),
    Case("point", (400, 300), 64, 1, 2.2),
    Case("ant", (400, 300), 64, 1, 1.6),
    Case("point", (128, 128), 128, 8),
]


class Stopwatch:
    """
    Learns for some steps and tells where the time went.

    :param model: the algorithm
    :param env: what it learns from
    """

    def __init__(self, model: OffPolicyAlgorithm, env: gym.Env) -> None:
        self.model = model
        self.seconds = dict.fromkeys(PARTS, 0.0)
        env.step = self._timed("simulation", env.step)  # type: ignore[method-assign]
        model.train = self._timed("update", model.train)  # type: ignore[method-assign]

    def _timed(self, part: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def timed(*args: Any, **kwargs: Any) -> Any:
            start = time.perf_counter()
            result = function(*args, **kwargs)
            self.seconds[part] += time.perf_counter() - start
            return result

        return timed

    def learn(self, n_steps: int) -> dict[str, float]:
        """
        :param n_steps: environment steps
        :return: milliseconds per step by part, and their sum as ``total``
        """
        self.seconds.update(dict.fromkeys(PARTS, 0.0))
        start = time.perf_counter()
        self.model.learn(n_steps, reset_num_timesteps=False, log_interval=10**9)
        total = time.perf_counter() - start
        self.seconds["rest"] = total - self.seconds["simulation"] - self.seconds["update"]
        return {part: 1e3 * seconds / n_steps for part, seconds in (*self.seconds.items(), ("total", total))}


def build(case: Case, warm_up: int) -> tuple[Stopwatch, Stopwatch]:
    """
    :param case: what to measure
    :param warm_up: environment steps of both before anything is measured
    :return: SB3's DDPG and our agent, both past their warm-up
    """
    common: dict[str, Any] = dict(
        seed=0,
        batch_size=case.batch_size,
        train_freq=case.train_freq,
        gradient_steps=case.train_freq,
        learning_starts=min(RANDOM_STEPS, warm_up),
        policy_kwargs={"net_arch": list(case.net_arch)},
        device="cpu",
    )
    envs = [gym.make(ENVS[case.env]) for _ in range(2)]
    stock = DDPG("MultiInputPolicy", envs[0], buffer_size=100_000, **common)
    agent = SkillGraphAgent("MultiInputPolicy", envs[1], buffer_size=100_000, **common)
    for model in (stock, agent):
        model.learn(warm_up, log_interval=10**9)
    return Stopwatch(stock, envs[0]), Stopwatch(agent, envs[1])


def measure(case: Case, warm_up: int, n_steps: int, n_turns: int) -> dict[str, Any]:
    """
    :param case: what to measure
    :param warm_up: environment steps of both before anything is measured
    :param n_steps: environment steps a turn
    :param n_turns: number of turns
    :return: ``sb3`` and ``ours`` (milliseconds per step by part), ``speedup`` (the median over turns of SB3's time over
        ours), ``steps_per_second`` of both, ``events`` and ``edges`` of the graph at the end
    """
    stock, ours = build(case, warm_up)
    turns = [[watch.learn(n_steps) for watch in (stock, ours)] for _ in range(n_turns + 1)][1:]
    parts = (*PARTS, "total")
    sb3_ms, ours_ms = ({part: round(statistics.median(turn[i][part] for turn in turns), 4) for part in parts} for i in (0, 1))
    agent = ours.model
    assert isinstance(agent, SkillGraphAgent)
    return {
        "sb3": sb3_ms,
        "ours": ours_ms,
        "speedup": round(statistics.median(a["total"] / b["total"] for a, b in turns), 3),
        "steps_per_second": {"sb3": round(1e3 / sb3_ms["total"]), "ours": round(1e3 / ours_ms["total"])},
        "events": len(agent.events),
        "edges": agent.graph.edges.size,
    }


def verdict(case: Case, row: dict[str, Any]) -> str:
    """
    :param case: what is asked
    :param row: what was measured
    :return: the bar that is missed, or "ok", or nothing where none is set
    """
    if case.min_speedup is None:
        return ""
    return f"speedup < {case.min_speedup}" if row["speedup"] < case.min_speedup else "ok"


def main() -> None:
    """Print the table, and write it where ``--out`` says."""
    parser = argparse.ArgumentParser(description="Time learn() against SB3's.")
    parser.add_argument("--warm-up", type=int, default=5_000, help="environment steps before the first turn")
    parser.add_argument("--steps", type=int, default=256, help="environment steps a turn")
    parser.add_argument("--turns", type=int, default=20, help="turns of each")
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    results = []
    print("milliseconds per environment step: simulation + update + rest = total")
    print(f"{'case':<34}{'SB3':>34}{'ours':>34}{'speedup':>9}")
    for case in CASES:
        row = measure(case, arguments.warm_up, arguments.steps, arguments.turns)
        name = f"{case.env} {'-'.join(map(str, case.net_arch))} B={case.batch_size} every {case.train_freq}"
        columns = [
            " + ".join(f"{times[part]:.2f}" for part in PARTS) + f" = {times['total']:.2f}"
            for times in (row["sb3"], row["ours"])
        ]
        print(f"{name:<34}{columns[0]:>34}{columns[1]:>34}{row['speedup']:9.2f}  {verdict(case, row)}", flush=True)
        results.append({**case._asdict(), **row})
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        arguments.out.write_text(json.dumps({"torch": th.__version__, "cases": results}, indent=1) + "\n")


if __name__ == "__main__":
    main()
