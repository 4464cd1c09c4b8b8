"""Memory of one shared store: many options over a million ant transitions.

    python -m benchmarks.memory --out benchmarks/results/memory.json

The store is filled, every option learns from rows of it, and the growth of the resident set is compared with what as many
SB3 replay buffers of the same transitions would take (computed from their array sizes; they would not fit here).
"""

import argparse
import json
import pathlib
import resource
import shlex
import sys
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces

from sb3_skillgraph import __version__
from sb3_skillgraph.events import Event
from sb3_skillgraph.options.factory import OptionFactory
from sb3_skillgraph.options.learner import OptionDDPG
from sb3_skillgraph.options.views import ScaledView, relative_view
from sb3_skillgraph.memory.replay import TransitionStore

OBSERVATION_DIM, GOAL_DIM, ACTION_DIM = 27, 2, 8


def resident_gigabytes() -> float:
    """Return the largest resident set this process has had so far, in GB (1e9 bytes; Linux counts it in KiB)."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024 / 1e9


def fill(store: TransitionStore, n_transitions: int, rng: np.random.Generator) -> None:
    """Write random transitions in episodes of 1000 steps."""
    for step in range(n_transitions):
        o, g = rng.standard_normal((2, 1, OBSERVATION_DIM)), rng.standard_normal((3, 1, GOAL_DIM))
        action, done = rng.uniform(-1, 1, (1, ACTION_DIM)), np.array([step % 1000 == 999])
        store.add(o[0], g[0], o[1], g[1], action, g[2], np.zeros(1, dtype=bool), done)


def measure(n_options: int, n_transitions: int) -> dict[str, Any]:
    """Fill a store, let options learn from it, and measure."""
    rng = np.random.default_rng(0)
    before = resident_gigabytes()
    store = TransitionStore(n_transitions, OBSERVATION_DIM, GOAL_DIM, ACTION_DIM)
    fill(store, n_transitions, rng)
    after_store = resident_gigabytes()
    action_space = spaces.Box(-1.0, 1.0, (ACTION_DIM,), np.float32)
    view = ScaledView(relative_view, 0.45)
    kwargs = {"policy_kwargs": {"net_arch": [128, 128]}}
    replay = {"hindsight": 0.8, "shared": 0.5, "horizon": 200}
    factory = OptionFactory(OptionDDPG, kwargs, store, view, action_space, 0.45, 0.2, rng, replay, th.device("cpu"))
    options = []
    for i in range(n_options):
        option = factory.make(f"o{i + 1}", "e0", Event("e0", np.zeros(GOAL_DIM), 0.45))
        option.replay.add_rows(np.sort(rng.choice(n_transitions, min(100_000, n_transitions), replace=False)))
        option.learner.train(1, 128)
        options.append(option)
    after = resident_gigabytes()
    sb3_row = 4 * (2 * (OBSERVATION_DIM + 2 * GOAL_DIM) + ACTION_DIM + 3)  # float32, two observations with their goals
    return {
        "options": n_options,
        "transitions": n_transitions,
        "store_gb": round(after_store - before, 3),
        "options_gb": round(after - after_store, 3),
        "total_gb": round(after - before, 3),
        "bytes_per_transition": round((after_store - before) * 1e9 / n_transitions, 1),
        "megabytes_per_option": round((after - after_store) * 1e3 / n_options, 2),
        "sb3_buffers_gb": round(n_options * n_transitions * sb3_row / 1e9, 2),
    }


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--options", type=int, default=40)
    parser.add_argument("--transitions", type=int, default=1_000_000)
    parser.add_argument("--out", type=pathlib.Path, required=True)
    args = parser.parse_args()
    th.set_num_threads(1)
    command = "python -m benchmarks.memory " + shlex.join(sys.argv[1:])
    document = {"command": command, "version": __version__, **measure(args.options, args.transitions)}
    args.out.parent.mkdir(parents=True, exist_ok=True)
    args.out.write_text(json.dumps(document, indent=1) + "\n")
    print(json.dumps(document, indent=1))


if __name__ == "__main__":
    main()
