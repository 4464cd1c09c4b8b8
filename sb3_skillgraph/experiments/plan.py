"""What is to be run: a YAML of methods, environments and seeds."""

import re
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import gymnasium as gym
import yaml

from sb3_skillgraph.envs import find
from sb3_skillgraph.experiments.learner import check_names
from sb3_skillgraph.experiments.learners import ALGORITHMS, RIVALS
from sb3_skillgraph.hyperparams import did_you_mean

_COMMON = ("check_every", "pairs", "final_pairs", "task_episodes", "test_pairs", "test_stretches")
_TOP = {"methods": dict, "environments": dict, "seeds": list, **dict.fromkeys(_COMMON, int)}
_METHOD = {"algorithm": str, "arguments": dict, "also": dict, "seeds": list}
_NEEDS_MAZE = ("recipe", "covering_options")
_ALSO = {"algorithm": str, "arguments": dict}
_ENVIRONMENT = {
    "id": str,
    "kwargs": dict,
    "test_kwargs": dict,
    "steps": int,
    "seeds": list,
    "methods": list,
    **dict.fromkeys(_COMMON, int),
}


@dataclass(frozen=True)
class RunSpec:
    """One run.

    :param method: its name in the plan
    :param environment: its name in the plan
    :param seed: of everything random; pairs are drawn with ``seed + 1000``
    :param algorithm: ``skill_graph``, ``uvfa``, ``her``, ``recipe``, ``covering_options`` or ``random_walk``
    :param env_id: id of a goal environment
    :param steps: environment steps
    :param check_every: steps between tests, after each of which a checkpoint is taken
    :param pairs: pairs of start and goal in these tests
    :param final_pairs: pairs in the last one
    :param task_episodes: episodes, in each test, of every task that the environment brings (OGBench's do)
    :param test_pairs: pairs with each of which, after that, a copy goes on learning (on ``SkillGraph/*`` mazes)
    :param test_stretches: for how many times 1000 steps, with a test after each
    :param arguments: of the algorithm
    :param env_kwargs: of the environment
    :param test_kwargs: of the environment in tests, where others are wanted
    :param also: other ways to act by what a skill graph has learned, tested at the end: name -> ``algorithm``
        (``straight_on``, ``replay_search``), ``arguments``
    """

    method: str
    environment: str
    seed: int
    algorithm: str
    env_id: str
    steps: int
    check_every: int = 10_000
    pairs: int = 20
    final_pairs: int = 100
    task_episodes: int = 0
    test_pairs: int = 0
    test_stretches: int = 5
    arguments: dict[str, Any] = field(default_factory=dict)
    env_kwargs: dict[str, Any] = field(default_factory=dict)
    test_kwargs: dict[str, Any] = field(default_factory=dict)
    also: dict[str, dict[str, Any]] = field(default_factory=dict)

    def folder(self, out: Path) -> Path:
        """Return where the run lies in the folder of all runs."""
        return out / self.environment / self.method / f"seed{self.seed}"

    def as_plain(self) -> dict[str, Any]:
        """Return it as plain data."""
        return asdict(self)


def load_plan(path: Path) -> list[RunSpec]:
    """Read a plan.

    :param path: YAML file: ``methods`` (name -> ``algorithm``, ``arguments``, ``also``, ``seeds``), ``environments`` (name ->
        ``id``, ``kwargs``, ``test_kwargs``, ``steps``, ``seeds``, ``methods``), ``seeds`` (all where not given), and
        ``check_every``, ``pairs``, ``final_pairs``, ``task_episodes``, ``test_pairs``, ``test_stretches`` for all
        environments or for one
    :return: one spec for each run, seed by seed, so that the first results compare all methods
    :raises ValueError: if the file says anything else, or too little
    """
    try:
        document = yaml.safe_load(path.read_text(encoding="utf-8"))
    except yaml.YAMLError as error:
        raise ValueError(f"{path} is no valid YAML: {' '.join(str(error).split())}") from error
    top = _checked(document, _TOP, str(path), required=("methods", "environments", "seeds"))
    methods = {
        _name(name, path): _checked(value, _METHOD, f"{path}, method {name!r}", required=("algorithm",))
        for name, value in top["methods"].items()
    }
    for name, method in methods.items():
        if method["algorithm"] not in ALGORITHMS:
            hint = did_you_mean(method["algorithm"], ALGORITHMS)
            raise ValueError(f"{path}, method {name!r}: unknown algorithm {method['algorithm']!r}{hint}.")
        ALGORITHMS[method["algorithm"]].check_arguments(method.get("arguments", {}), f"{path}, method {name!r}")
        _check_also(method, f"{path}, method {name!r}")
        _seeds(method.get("seeds", []), f"{path}, method {name!r}")
    environments = {
        _name(name, path): _checked(value, _ENVIRONMENT, f"{path}, environment {name!r}", required=("id", "steps"))
        for name, value in top["environments"].items()
    }
    specs = []
    for label, env in environments.items():
        _check_id(env["id"], f"{path}, environment {label!r}")
        unknown = [name for name in env.get("methods", ()) if name not in methods]
        if unknown:
            raise ValueError(
                f"{path}, environment {label!r}: unknown method {unknown[0]!r}{did_you_mean(str(unknown[0]), methods)}."
            )
        specs += [
            RunSpec(
                name,
                label,
                seed,
                methods[name]["algorithm"],
                env["id"],
                env["steps"],
                arguments=methods[name].get("arguments", {}),
                also=methods[name].get("also", {}),
                env_kwargs=env.get("kwargs", {}),
                test_kwargs=env.get("test_kwargs", {}),
                **{name: given[name] for given in (top, env) for name in _COMMON if name in given},
            )
            for seed in _seeds(env.get("seeds", top["seeds"]), f"{path}, environment {label!r}")
            for name in env.get("methods", methods)
            if seed in methods[name].get("seeds", [seed])
        ]
    for spec in specs:
        _check_task(spec, path)
    return specs


def _check_task(spec: RunSpec, path: Path) -> None:
    """Refuse what needs a maze of ours, where start and goal can be given, on any other environment."""
    if spec.env_id.startswith("SkillGraph/"):
        return
    asked = f"the algorithm {spec.algorithm!r}" if spec.algorithm in _NEEDS_MAZE else "test_pairs" if spec.test_pairs else ""
    if asked:
        where = f"{path}, environment {spec.environment!r}"
        raise ValueError(f"{where}: {asked} is for SkillGraph/* mazes, not for {spec.env_id}.")


def _check_also(method: dict[str, Any], where: str) -> None:
    """Check in which other ways a method is to act."""
    for name, value in method.get("also", {}).items():
        rival = _checked(value, _ALSO, f"{where}, {name!r}", required=("algorithm",))
        if method["algorithm"] != "skill_graph":
            raise ValueError(f"{where}: only what a skill_graph has learned can act in other ways, too.")
        if rival["algorithm"] not in RIVALS:
            hint = did_you_mean(rival["algorithm"], RIVALS)
            raise ValueError(f"{where}, {name!r}: unknown algorithm {rival['algorithm']!r}{hint}.")
        check_names(rival.get("arguments", {}), f"{where}, {name!r}", RIVALS[rival["algorithm"]])


def _name(name: Any, path: Path) -> str:
    """Check what a folder is to be called."""
    if not isinstance(name, str) or not re.fullmatch(r"\w[\w.+-]*", name):
        raise ValueError(
            f"{path}: {name!r} is no name for a method or an environment: a folder is called so, by letters, digits and "
            ". + - _ (in quotes where YAML takes it for something else)."
        )
    return name


def _seeds(seeds: list[Any], where: str) -> list[int]:
    for seed in seeds:
        if type(seed) is not int or seed < 0:
            raise ValueError(f"{where}: a seed must be a whole number, 0 or more, not {seed!r}.")
    if len(set(seeds)) < len(seeds):
        raise ValueError(f"{where}: a seed stands twice in {seeds}.")
    return seeds


def _check_id(id: str, where: str) -> None:
    try:
        find(id)
    except (gym.error.Error, ImportError) as error:
        raise ValueError(f"{where}: {error}") from error


def _checked(value: Any, keys: Mapping[str, type], where: str, required: tuple[str, ...]) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{where}: a mapping is wanted, not {value!r}.")
    for name, item in value.items():
        if name not in keys:
            raise ValueError(f"{where}: unknown entry {name!r}{did_you_mean(str(name), keys)}.")
        if not isinstance(item, keys[name]) or (isinstance(item, int) and item < 1):
            kind = {dict: "a mapping", list: "a list", int: "a positive number", str: "a name"}[keys[name]]
            raise ValueError(f"{where}: {name} must be {kind}, not {item!r}.")
    missing = [name for name in required if not value.get(name)]
    if missing:
        raise ValueError(f"{where}: {missing[0]} is missing.")
    return value
