"""
What grows with the graph, and how fast: synthetic graphs of 10 to 10 000 options in the plane.

Options start from sets of 50 support points, of which about five cover any point, and end in one of the events near by;
edges follow from the sets, through the code that makes them while learning. Only the networks are shared, as nothing here
asks what they have learned. Timed, as medians: one ``predict`` while an option runs; choosing an option on the way to a
goal, and ``plan``, each right after an outcome has changed the graph; recording an outcome (the refit of its set included)
and updating the edges. Exponents are the slopes of straight lines through the logarithms.

Run it with ``OMP_NUM_THREADS=1 python -m benchmarks.scaling --out benchmarks/results/scaling.json``.
"""

import argparse
import gc
import json
import resource
import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import torch as th
from stable_baselines3.td3.policies import TD3Policy

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.chaining import SkillChain
from sb3_skillgraph.controller import ControllerState, Request
from sb3_skillgraph.events import Event
from sb3_skillgraph.options.initiation import Boundary
from sb3_skillgraph.options.option import Option

RADIUS, SUPPORT, DEGREE, EVENTS_PER_OPTION = 0.45, 50, 5, 0.2
REACH = 3 * RADIUS  # an option leads to an event that is not further away
N_VISITED = 20_000
TIMES = ("predict_us", "choose_ms", "plan_ms", "record_ms")
BARS = {"choose_ms": {1_000: 5.0, 10_000: 50.0}, "plan_ms": {1_000: 5.0, 10_000: 50.0}}


class Plane:
    """
    An agent whose graph is filled with synthetic options.

    :param n_options: number of options
    :param seed: seed of where they are
    """

    def __init__(self, n_options: int, seed: int = 0) -> None:
        self.rng = np.random.default_rng(seed)
        env = gym.make("SkillGraph/PointMazeUMaze-v0")
        self.agent = SkillGraphAgent("MultiInputPolicy", env, seed=seed, buffer_size=100, device="cpu")
        # As many options as are to cover a point start within a set's radius of it.
        self.side = float(np.sqrt(n_options * np.pi * REACH**2 / DEGREE))
        for _ in range(max(int(n_options * EVENTS_PER_OPTION), 2)):
            self.agent.discovery.add(self.rng.uniform(0.0, self.side, 2))
        self.centers = np.stack([event.center for event in self.agent.events])
        for _ in range(n_options):
            self.add_option()
        self.wander()

    def add_option(self) -> None:
        """Add a mature option that leads from somewhere to one of the events near by, or to the nearest."""
        start = self.rng.uniform(0.0, self.side, 2)
        distances = np.linalg.norm(self.centers - start, axis=1)
        near = np.flatnonzero(distances < 2 * REACH)
        event = self.agent.events[int(self.rng.choice(near) if len(near) else distances.argmin())]
        chaining = self.agent.chaining
        option = Option(f"o{len(chaining.options) + 1}", event.id, event, self.agent.global_option.learner, RADIUS)
        self.lay_set(option, start)
        option.effects.extend(event.center + self.rng.normal(0.0, 0.1 * RADIUS, (10, 2)))
        option.record.extend(self.rng.random(20) < 0.9)
        option.n_runs, option.n_successes, option.mature = 20, sum(option.record), True
        chaining.options[option.id] = option
        chain = SkillChain(f"{event.id}>{option.id}", event.id, event.id, [option.id], complete=True)
        chaining.chains[chain.id] = chaining.chain_of[option.id] = chain
        self.agent.graph.add_option(option)

    def lay_set(self, option: Option, start: np.ndarray) -> None:
        """Put 50 support points around a start, and the boundary where they thin out."""
        angle, distance = self.rng.uniform(0, 2 * np.pi, SUPPORT), REACH * np.sqrt(self.rng.random(SUPPORT))
        points = start + np.stack([distance * np.cos(angle), distance * np.sin(angle)], axis=1)
        boundary = Boundary(points, np.full(SUPPORT, 1.0 / SUPPORT), -0.15, 4.0 / REACH**2)
        option.initiation.add_success(points)
        option.initiation.optimistic_boundaries = option.initiation.pessimistic_boundaries = [boundary]
        option.initiation.core = start

    def wander(self) -> None:
        """Fill the memory of visited states with straight walks from event to event."""
        visited, step = self.agent.visited, 0
        visited.set_events(self.centers, np.full(len(self.centers), RADIUS))
        while visited.size < N_VISITED:
            here = self.centers[self.rng.integers(len(self.centers))]
            there = here + self.rng.normal(0.0, 2 * REACH, 2)
            for share in np.linspace(0.0, 1.0, 40):
                step += 1
                visited.record(0, step, (here + share * (there - here)).astype(np.float32), share == 1.0)

    def point(self) -> np.ndarray:
        """Return a random point."""
        return self.rng.uniform(0.0, self.side, 2)

    def record(self) -> None:
        """Record a success, or now and then a failure, of a random option."""
        chaining, options = self.agent.chaining, list(self.agent.graph.options.values())
        option = options[self.rng.integers(len(options))]
        core = option.initiation.core
        assert core is not None and isinstance(option.termination, Event)
        start, end = core + self.rng.normal(0.0, 0.3 * RADIUS, 2), option.termination.center
        if self.rng.random() < 0.9:
            chaining.learn_success(option, np.linspace(start, end, 30), end)
        else:
            chaining.learn_failure(option, start)

    def predict_seconds(self, repeats: int) -> float:
        """
        :param repeats: number of calls
        :return: seconds of one ``predict`` while an option runs
        """
        agent = self.agent
        option = next(
            o for o in agent.graph.options.values() if o.initiation.core is not None and not o.terminates(o.initiation.core)
        )
        state = tuple(ControllerState.fresh(1)._replace(option=np.array([agent.controller.index(option)])))
        core = option.initiation.core
        assert core is not None
        observation = {"observation": np.zeros(4, dtype=np.float32), "achieved_goal": core, "desired_goal": self.point()}
        start = time.perf_counter()
        for _ in range(repeats):
            agent.predict(observation, state)
        return (time.perf_counter() - start) / repeats

    def measure(self, repeats: int) -> dict[str, float]:
        """
        :param repeats: number of timings of each
        :return: median milliseconds by name
        """
        agent = self.agent
        questions: dict[str, Callable[[], object]] = {
            "choose_ms": lambda: agent.controller.choose(self.point(), Request(self.point()), 0, ()),
            "plan_ms": lambda: agent.planner.plan(self.point(), self.point(), RADIUS),
            "record_ms": self.record,
        }
        seconds: dict[str, list[float]] = {name: [] for name in questions}
        for _ in range(repeats):
            for name, function in questions.items():
                self.record()  # so that nothing is remembered from the time before
                start = time.perf_counter()
                function()
                seconds[name].append(time.perf_counter() - start)
        return {name: 1e3 * statistics.median(times) for name, times in seconds.items()}


def resident_bytes() -> int:
    """Return the resident set of this process now."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize()


def network_bytes(agent: SkillGraphAgent) -> int:
    """Return what one option's networks, their targets and Adam's two moments take, once trained."""
    policy = agent.global_option.learner.policy
    assert isinstance(policy, TD3Policy)
    learned = [*policy.actor.parameters(), *policy.critic.parameters()]
    return 4 * (sum(p.numel() for p in policy.parameters()) + 2 * sum(p.numel() for p in learned))


def transition_bytes(agent: SkillGraphAgent) -> float:
    """Return what one transition takes in the store."""
    store = agent.store
    arrays = [value for value in vars(store).values() if isinstance(value, np.ndarray) and len(value) == store.capacity]
    return sum(array.nbytes for array in arrays) / store.capacity


def exponent(sizes: list[int], times: list[float]) -> float:
    """Return the slope of the line through the logarithms."""
    return float(np.polyfit(np.log(sizes), np.log(times), 1)[0])


def main() -> None:
    """Print the table, and write it where ``--out`` says."""
    parser = argparse.ArgumentParser(description="Time what grows with the number of options.")
    parser.add_argument("--sizes", type=int, nargs="+", default=[10, 100, 1_000, 10_000], help="numbers of options")
    parser.add_argument("--repeats", type=int, default=100, help="timings of each question")
    parser.add_argument("--out", type=Path, help="JSON file for the results")
    arguments = parser.parse_args()
    th.set_num_threads(1)
    rows: list[dict[str, Any]] = []
    planes: list[Plane] = []
    print(f"{'options':>8}{'edges':>8}{'degree':>8}" + "".join(f"{name:>12}" for name in TIMES) + f"{'graph kB/option':>17}")
    for size in arguments.sizes:
        gc.collect()
        before = resident_bytes()
        plane = Plane(size)
        graph = plane.agent.graph
        n_edges = graph.nx.number_of_edges()
        degree = sum(graph.nx.out_degree(id) for id in graph.options) / size
        row = {"options": size, "events": len(graph.events), "edges": n_edges, "out_degree": round(degree, 2)}
        row["graph_bytes_per_option"] = round((resident_bytes() - before) / size)
        row |= {name: round(value, 4) for name, value in plane.measure(arguments.repeats).items()}
        rows.append(row)
        planes.append(plane)
    # All sizes take turns: what else the machine does hits them alike.
    turns = [[plane.predict_seconds(20) for plane in planes] for _ in range(arguments.repeats)]
    for row, column in zip(rows, zip(*turns, strict=True), strict=True):
        row["predict_us"] = round(1e6 * statistics.median(column), 2)
        missed = [f"{n} > {bars[row['options']]}" for n, bars in BARS.items() if row[n] > bars.get(row["options"], np.inf)]
        print(
            f"{row['options']:>8}{row['edges']:>8}{row['out_degree']:>8.1f}"
            + "".join(f"{row[name]:>12.3f}" for name in TIMES)
            + f"{row['graph_bytes_per_option'] / 1e3:>17.1f}  {', '.join(missed)}"
        )
    exponents = {name: round(exponent(arguments.sizes, [row[name] for row in rows]), 2) for name in TIMES}
    print("growth exponents:", ", ".join(f"{name} {value}" for name, value in exponents.items()))
    growth = round(statistics.median(turn[-1] / turn[0] for turn in turns), 3)
    print(f"predict while an option runs, largest graph over smallest: {growth} (asked: at most 1.2)")
    sizes = {
        "network_bytes_per_option": network_bytes(planes[0].agent),
        "bytes_per_transition": transition_bytes(planes[0].agent),
    }
    print(", ".join(f"{name}: {value:.0f}" for name, value in sizes.items()))
    if arguments.out is not None:
        arguments.out.parent.mkdir(parents=True, exist_ok=True)
        results = {"rows": rows, "exponents": exponents, "predict_growth": growth, **sizes}
        arguments.out.write_text(json.dumps(results, indent=1) + "\n")


if __name__ == "__main__":
    main()
