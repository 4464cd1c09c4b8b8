"""rl-baselines3-zoo with the algorithm ``dsg`` (extra ``zoo``).

    python -m sb3_skillgraph.zoo train --algo dsg --env SkillGraph/PointMazeMedium-v0 -tb logs/tb
    python -m sb3_skillgraph.zoo enjoy --algo dsg --env SkillGraph/PointMazeMedium-v0 --no-render
    python -m sb3_skillgraph.zoo record_video --algo dsg --env SkillGraph/PointMazeMedium-v0 -f logs
    python -m sb3_skillgraph.zoo train --algo dsg --env SkillGraph/ToyMaze-v0 -optimize --n-trials 20

Everything else is the zoo's: ``-i`` trains an agent further. Hyperparameters are those of
``hyperparams/skillgraph.yml``, unless ``--conf-file`` names others.
"""

import fnmatch
import runpy
import sys
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import gymnasium_robotics
import rl_zoo3
import yaml
from rl_zoo3.enjoy import enjoy
from rl_zoo3.hyperparams_opt import HYPERPARAMS_CONVERTER, HYPERPARAMS_SAMPLER
from rl_zoo3.train import train

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.hyperparams import FILE

if TYPE_CHECKING:
    import optuna

ALGO = "dsg"
SCRIPTS: dict[str, Callable[[], Any]] = {
    "train": train,
    "enjoy": enjoy,
    "record_video": lambda: runpy.run_module("rl_zoo3.record_video", run_name="__main__"),
}


def read_hyperparams() -> dict[str, dict[str, Any]]:
    """Return what is recommended, as the zoo wants it: every entry whole, ``default`` for all other environments."""
    document = yaml.safe_load(FILE.read_text(encoding="utf-8"))
    defaults = document.pop("defaults")
    # Of names with a star the zoo knows nothing.
    gym.register_envs(gymnasium_robotics)
    fitting = {entry: fnmatch.filter(gym.registry, entry) or [entry] for entry in document}
    return {"default": defaults, **{id: {**defaults, **document[entry]} for entry, ids in fitting.items() for id in ids}}


#: The zoo reads a module's attribute of this name.
hyperparams = read_hyperparams()


def sample(trial: "optuna.Trial", n_actions: int, n_envs: int, additional_args: dict[str, Any]) -> dict[str, Any]:
    """Draw hyperparameters.

    :param trial: Optuna's
    :param n_actions: not used
    :param n_envs: not used
    :param additional_args: not used
    :return: what has been drawn
    """
    return {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True),
        "gamma": trial.suggest_categorical("gamma", [0.95, 0.98, 0.99]),
        "batch_size": trial.suggest_categorical("batch_size", [64, 128, 256]),
        "gradient_steps": trial.suggest_int("gradient_steps", 1, 4),
        "action_noise": trial.suggest_float("action_noise", 0.05, 0.4),
        "goal_tolerance": trial.suggest_float("goal_tolerance", 0.25, 1.0),
        "hindsight": trial.suggest_float("hindsight", 0.5, 1.0),
        "shaping": trial.suggest_categorical("shaping", [0.0, 1.0]),
        "explore_beyond": trial.suggest_float("explore_beyond", 0.0, 5.0),
        "exploration_steps": trial.suggest_int("exploration_steps", 50, 200),
    }


def convert(sampled: dict[str, Any]) -> dict[str, Any]:
    """Return the arguments that were drawn: they are the agent's already.

    :param sampled: what :func:`sample` has drawn
    """
    return sampled


def register() -> None:
    """Make the algorithm known to the zoo."""
    rl_zoo3.ALGOS[ALGO] = SkillGraphAgent
    HYPERPARAMS_SAMPLER[ALGO] = sample
    converters: dict[str, Any] = HYPERPARAMS_CONVERTER
    converters[ALGO] = convert
    hyperparams.update(read_hyperparams())  # the zoo takes them apart


def main() -> None:
    """Run a script of the zoo."""
    if len(sys.argv) < 2 or sys.argv[1] not in SCRIPTS:
        sys.exit(f"{__doc__}\nThe scripts are {', '.join(SCRIPTS)}.")
    register()
    script = sys.argv.pop(1)
    if script == "train":
        sys.argv[1:1] = ["--conf-file", "sb3_skillgraph.zoo"]  # in front: of two the last counts
    SCRIPTS[script]()


if __name__ == "__main__":
    main()
