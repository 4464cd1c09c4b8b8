"""A million steps of the toy environment: whether an agent slows down, or takes more and more memory.

    OMP_NUM_THREADS=1 python -m benchmarks.soak --out benchmarks/results/soak.json

For every tenth of the steps: steps a second of processor time (what else the machine does is left out), and the memory that
the process holds at the end. The replay buffer is full after the first fifth.
"""

import argparse
import json
import resource
import shlex
import sys
import time
from pathlib import Path

import gymnasium as gym
import torch as th

from sb3_skillgraph import SkillGraphAgent, __version__

TOY = "SkillGraph/ToyMaze-v0"
N_TENTHS, BUFFER_SHARE = 10, 5


def resident() -> float:
    """Return the memory that this process holds, in MB."""
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * resource.getpagesize() / 1e6


def main() -> None:
    """Learn for long, and write what every tenth took."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    th.set_num_threads(1)
    agent = SkillGraphAgent("MultiInputPolicy", gym.make(TOY), seed=args.seed, buffer_size=args.steps // BUFFER_SHARE)
    tenths = []
    for _ in range(N_TENTHS):
        begin = time.process_time()
        agent.learn(args.steps // N_TENTHS, log_interval=None, reset_num_timesteps=False)
        seconds = time.process_time() - begin
        tenth = {
            "steps": agent.num_timesteps,
            "steps_a_second": round(args.steps / N_TENTHS / seconds, 1),
            "resident_mb": round(resident(), 1),
            "events": len(agent.events),
            "edges": agent.graph.edges.size,
        }
        print(json.dumps(tenth), flush=True)
        tenths.append(tenth)
    full = tenths[N_TENTHS // BUFFER_SHARE - 1]
    document = {
        "command": "python -m benchmarks.soak " + shlex.join(sys.argv[1:]),
        "version": __version__,
        "last_over_second": round(tenths[-1]["steps_a_second"] / tenths[1]["steps_a_second"], 3),
        "memory_since_full": round(tenths[-1]["resident_mb"] / full["resident_mb"], 3),
        "tenths": tenths,
    }
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(document, indent=1) + "\n")
    print(json.dumps({name: value for name, value in document.items() if name != "tenths"}))


if __name__ == "__main__":
    main()
