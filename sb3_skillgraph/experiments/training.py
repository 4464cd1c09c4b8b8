"""One agent trained in a folder of its own, with checkpoints to go on from."""

import json
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

from filelock import Timeout
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import HumanOutputFormat, Logger, TensorBoardOutputFormat, configure

from sb3_skillgraph.agent import SkillGraphAgent
from sb3_skillgraph.callbacks import SkillGraphProgressBarCallback
from sb3_skillgraph.experiments.console import UserError, for_people, versions
from sb3_skillgraph.experiments.run_folder import (
    AGENT,
    CONFIG,
    DONE,
    EXPERIENCE,
    PROGRESS,
    STEPS,
    checkpoints,
    claimed,
    discard_all,
    load_agent,
    load_newest,
    read_progress,
    run_config,
    save_agent,
    stops,
    take_checkpoint,
)
from sb3_skillgraph.files import replaced, write_text
from sb3_skillgraph.hyperparams import make_recommended
from sb3_skillgraph.persistence import kept_by_name
from sb3_skillgraph.plotting import snapshot
from sb3_skillgraph.rules import PaperRules

CHECKPOINT_EVERY = 10_000  # environment steps
STOP_EVERY = 500  # environment steps, after which a run can be stopped: Ctrl-C waits for them
N_LOOKS = 10  # at the graph: what is seen of it is kept, and told where nobody looks at a bar


def train(
    env_id: str,
    env_kwargs: dict[str, Any],
    arguments: dict[str, Any],
    steps: int,
    seed: int,
    out: Path,
    n_envs: int = 1,
    device: str = "auto",
    verbose: bool = False,
    tensorboard: bool = False,
) -> SkillGraphAgent:
    """Train an agent, from the last checkpoint in the folder if there is one; that comes to the same as in one go.

    A run that was broken off before its first checkpoint begins anew; one that is finished is trained further.

    :param env_id: id of the environment
    :param env_kwargs: its keyword arguments
    :param arguments: of :class:`~sb3_skillgraph.SkillGraphAgent`
    :param steps: environment steps in all
    :param seed: of everything random
    :param out: receives ``agent.zip`` and ``experience.zip`` (when interrupted, too), ``progress.csv``, ``config.json``,
        ``graph_N.json`` (what is seen of the graph after N steps),
        until the end the newest checkpoints, and then ``done.json``
    :param n_envs: copies of the environment
    :param device: torch device
    :param verbose: whether to print SB3's table as well as the progress bar
    :param tensorboard: whether to write a log for TensorBoard, too
    :return: the agent
    :raises UserError: if an argument is refused, another command is at work in the folder, or it holds something else
    """
    config = dict(env=env_id, env_kwargs=env_kwargs, steps=steps, seed=seed, n_envs=n_envs, arguments=arguments)
    with for_people():
        if _holds_a_run(out):
            _check_config(out, config)  # before what was given is looked at by itself
        env = make_vec_env(lambda: make_recommended(env_id, env_kwargs), n_envs)
    try:
        with for_people():  # who mistypes something leaves no folder
            agent = SkillGraphAgent(env=env, seed=seed, **{"device": device, **arguments})
        with _claimed(out):
            with for_people():
                _check_folder(out, config)
                begin, loaded = load_newest(out, lambda folder: load_agent(folder, env, device, **kept_by_name(arguments)))
                rows = read_progress(checkpoints(out)[begin]) if loaded is not None else []
            (out / DONE).unlink(missing_ok=True)
            if loaded is None:  # what is seen of another graph, of a run of which nothing came
                for path in out.glob("graph_*.json"):
                    path.unlink()
            else:
                fresh = "" if env.has_attr("get_state") else f", at a fresh episode: {env_id} cannot tell its state"
                print(f"going on after {begin} steps{fresh}")
                agent = loaded
            write_json(out / CONFIG, {**config, "versions": versions()})
            agent.set_logger(_logger(out, rows, verbose, tensorboard))
            elapsed = float(rows[-1].get("time/time_elapsed") or 0.0) if rows else 0.0
            _learn(agent, begin, steps, out, elapsed)
            return agent
    finally:
        env.close()


@contextmanager
def _claimed(out: Path) -> Iterator[None]:
    try:
        with claimed(out):
            yield
    except Timeout as error:
        raise UserError(f"another command is at work in {out}.") from error


def _holds_a_run(out: Path) -> bool:
    """Tell whether there is a run in a folder of which something came."""
    return (out / CONFIG).exists() and (bool(checkpoints(out)) or (out / AGENT).exists())


def _check_folder(out: Path, config: dict[str, Any]) -> None:
    """Refuse a folder that holds something else; let what is finished go on."""
    if not (out / CONFIG).exists() and (out / AGENT).exists():
        raise UserError(f"{out} holds an agent already; give another folder with --out, or remove it.")
    if not _holds_a_run(out):
        return
    done = _check_config(out, config)
    if not (out / DONE).exists() or not (out / AGENT).exists():
        return
    discard_all(out)
    if config["steps"] <= done:
        raise UserError(
            f"{out} holds an agent already, of {done} steps: give more --steps to train it further, another folder with "
            "--out, or remove it."
        )
    take_checkpoint(out, done, lambda folder: _copy(out, folder, AGENT, EXPERIENCE, PROGRESS))


def _copy(out: Path, folder: Path, *names: str) -> None:
    for name in names:
        with (out / name).open("rb") as source, replaced(folder / name) as file:
            shutil.copyfileobj(source, file)


def _learn(agent: SkillGraphAgent, begin: int, steps: int, out: Path, elapsed: float) -> None:
    bar = SkillGraphProgressBarCallback(steps) if sys.stdout.isatty() else None
    callbacks = CallbackList([Clock(elapsed), *([bar] if bar is not None else [])])
    try:
        with _stopped_politely() as is_asked_to_stop:
            for target in stops(begin, steps, min(STOP_EVERY, CHECKPOINT_EVERY)):
                # By what was asked for: a call of several environments may overshoot, and the next makes up for it; one that
                # ends with an episode overshoots by more than the agent knows of.
                by_episodes = agent.train_freq.unit.value == "episode"  # type: ignore[union-attr]
                n_steps = max(target - agent.num_timesteps, 0) if by_episodes else target - begin
                agent.learn(n_steps, callback=callbacks, reset_num_timesteps=False)
                if target * N_LOOKS // steps > begin * N_LOOKS // steps:
                    write_text(out / f"graph_{target}.json", json.dumps({"steps": target, **snapshot(agent)}) + "\n")
                    if bar is None:
                        _print_line(agent, steps)
                begin = target
                if target < steps and (target % CHECKPOINT_EVERY == 0 or is_asked_to_stop()):
                    take_checkpoint(out, target, lambda folder: _save(agent, out, folder))
                if target < steps and is_asked_to_stop():
                    raise KeyboardInterrupt
    finally:
        if bar is not None:
            bar.close()
        agent.logger.close()
        if agent.num_timesteps > 0:
            save_agent(agent, out)
            print(f"{agent.num_timesteps} steps; the agent is in {out / AGENT}, its log in {out / PROGRESS}")
        if agent.num_timesteps < steps:
            print(f"the same command goes on after {max(checkpoints(out), default=0)} steps")
    write_json(out / DONE, {"steps": agent.num_timesteps})
    discard_all(out)


def _save(agent: SkillGraphAgent, out: Path, folder: Path) -> None:
    """Save what a run goes on from; its log, too, which is begun anew then."""
    save_agent(agent, folder)
    if (out / PROGRESS).exists():
        _copy(out, folder, PROGRESS)


class Clock(BaseCallback):
    """Counts time and steps from the beginning of a run, however many calls of ``learn`` it takes.

    :param elapsed: seconds that were spent before
    """

    def __init__(self, elapsed: float) -> None:
        super().__init__()
        self.began = time.time_ns() - int(elapsed * 1e9)

    def _on_training_start(self) -> None:
        self.model.start_time, self.model._num_timesteps_at_start = self.began, 0

    def _on_step(self) -> bool:
        return True


@contextmanager
def _stopped_politely() -> Iterator[Callable[[], bool]]:
    """Wait with Ctrl-C, or what a cluster sends before it kills, until it is asked for; a second one interrupts at once."""
    asked: list[int] = []

    def ask(number: int, frame: Any) -> None:
        if asked:
            raise KeyboardInterrupt
        asked.append(number)
        print("stopping soon, so that the same command can go on from here; Ctrl-C again stops at once", flush=True)

    signals = (signal.SIGINT, signal.SIGTERM)
    try:
        before = [signal.signal(number, ask) for number in signals]
    except ValueError:  # not in the main thread, where nobody presses Ctrl-C
        yield lambda: False
        return
    try:
        yield lambda: bool(asked)
    finally:
        for number, handler in zip(signals, before, strict=True):
            signal.signal(number, handler)


def _print_line(agent: SkillGraphAgent, steps: int) -> None:
    summary = agent.graph_summary()
    counts = f"{summary['events']} events, {summary['edges']} edges, success {summary['success_rate']:.2f}"
    print(f"{agent.num_timesteps} of {steps} steps: {counts}", flush=True)


def _logger(out: Path, rows: list[dict[str, Any]], verbose: bool, tensorboard: bool) -> Logger:
    """Return a logger whose file begins with the rows of the steps that are done."""
    logger = configure(str(out), ["csv"])
    for row in rows:
        for name, value in row.items():
            if value != "":
                logger.record(name, float(value) if set(str(value)) - set("-0123456789") else int(value))
        logger.dump(row[STEPS])
    if verbose:
        logger.output_formats.append(HumanOutputFormat(sys.stdout))
    if tensorboard:
        logger.output_formats.append(TensorBoardOutputFormat(str(out)))
    return logger


def _check_config(out: Path, config: dict[str, Any]) -> int:
    """Refuse a run with other settings than before, but for more steps; return how many there were to be."""
    before = run_config(out)
    before.pop("versions", None)
    asked = json.loads(_as_json(config))
    done, more = before.pop("steps"), asked.pop("steps")
    if before != asked or more < done:
        raise UserError(
            f"{out} holds a run with other settings, see its {CONFIG}: give the same ones, and as many steps or more, to go "
            "on with it, or another folder with --out."
        )
    return done


def write_json(path: Path, document: dict[str, Any]) -> None:
    """Write a document into a folder that need not be there yet.

    :param path: the file
    :param document: plain data; classes, such as ``option_class``, are written by their names
    """
    write_text(path, _as_json(document) + "\n")


def _as_json(document: dict[str, Any]) -> str:
    return json.dumps(document, indent=2, default=plain)


def plain(item: Any) -> Any:
    """Return a value of a configuration as JSON can have it: of a class its name, of rules their numbers.

    :param item: the value
    """
    return asdict(item) if isinstance(item, PaperRules) else item.__name__
