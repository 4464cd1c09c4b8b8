"""Bad input gets one clear error and loses nothing."""

import copy
import io
import json
import os
import pickle
import resource
import signal
import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import (
    TOY,
    Faulty,
    Recorder,
    check_store,
    differences,
    interrupt,
    new_agent,
    new_vec_env,
    put,
    state_in,
    state_of,
)
from fuzz import members, packed
from gymnasium import spaces
from sb3_contrib import QRDQN
from stable_baselines3 import DDPG, DQN
from stable_baselines3.common.noise import NormalActionNoise
from stable_baselines3.common.vec_env import DummyVecEnv, SubprocVecEnv, VecNormalize

from sb3_skillgraph import OptionEnv, SkillGraphAgent, saving
from sb3_skillgraph.events import Event
from sb3_skillgraph.saving import SCHEMA


def shown(arguments: dict[str, Any]) -> str:
    """Name a case; the same in every process, so that workers agree on what there is to test."""
    return ", ".join(f"{name}={'a function' if callable(value) else value}" for name, value in arguments.items())


class Spaces(gym.Env):
    """An environment that has spaces and nothing else."""

    success_radius = 0.5

    def __init__(self, action: spaces.Space | None = None, **entries: spaces.Space | None) -> None:
        point = spaces.Box(-1.0, 1.0, (2,))
        given = {"observation": point, "achieved_goal": point, "desired_goal": point, **entries}
        self.observation_space = spaces.Dict({key: space for key, space in given.items() if space is not None})
        self.action_space = action or spaces.Box(-1.0, 1.0, (2,))


class Named(NamedTuple):
    """A named tuple, which would come back as a plain one."""

    number: int


class Hidden(gym.Wrapper):
    """Hides attributes of an environment."""

    def __init__(self, env: gym.Env, *hidden: str) -> None:
        super().__init__(env)
        self.hidden = hidden

    def get_wrapper_attr(self, name: str) -> Any:
        if name in self.hidden:
            raise AttributeError(name)
        return super().get_wrapper_attr(name)

    def has_wrapper_attr(self, name: str) -> bool:
        return name not in self.hidden and super().has_wrapper_attr(name)


# -- construction -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("env", "message"),
    [
        (lambda: gym.make("Pendulum-v1"), "goal environment"),
        (lambda: Spaces(desired_goal=None), "desired_goal"),
        (lambda: Spaces(observation=spaces.Discrete(3)), "Box"),
        (lambda: Spaces(observation=spaces.Dict(x=spaces.Box(-1, 1))), ".*"),
        (lambda: Spaces(clock=spaces.Discrete(51)), "Box"),  # an entry nobody asked for, but that could not be saved
        (lambda: Spaces(desired_goal=spaces.Box(-1.0, 1.0, (3,))), "same length"),
        (lambda: Spaces(action=spaces.Discrete(4)), "continuous actions"),
        (lambda: Spaces(action=spaces.MultiBinary(2)), "continuous actions"),
        (lambda: Spaces(action=spaces.Box(-np.inf, np.inf, (2,))), "finite"),
        (lambda: Spaces(action=spaces.Box(-1, 1, (2,), np.int64)), "floating point"),
        (lambda: Spaces(action=spaces.Box(-1.0, 1.0, (0,))), "at least one"),
        (lambda: Spaces(**dict.fromkeys(("achieved_goal", "desired_goal"), spaces.Box(-1.0, 1.0, (0,)))), "at least 1"),
    ],
    ids=[
        *("flat", "no goal", "discrete", "nested", "extra", "lengths", "Discrete", "MultiBinary", "unbounded"),
        *("whole numbers", "no actions", "no goal numbers"),
    ],
)
def test_environment_that_does_not_fit(env: Callable[[], gym.Env], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SkillGraphAgent("MultiInputPolicy", env())


OUT_OF_RANGE: list[dict[str, Any]] = [
    dict(salience="curiosity"),
    dict(salience=None),
    dict(option_view="sideways"),
    dict(option_class="PPO"),
    dict(option_class=dict),
    dict(event_radius=0.0),
    dict(event_radius=-1.0),
    dict(event_radius=float("nan")),
    dict(event_radius="wide"),
    dict(event_radius=True),
    dict(event_radius=[0.3, -0.3]),
    dict(event_radius=[0.3, 0.3, 0.3]),
    dict(event_radius=[np.inf, np.inf]),
    dict(event_radius={"parts": []}),
    dict(goal_tolerance=0.0),
    dict(goal_tolerance=1.5),
    dict(learning_rate=-1.0),
    dict(learning_starts=-1),
    dict(buffer_size=0),
    dict(batch_size=0),
    dict(batch_size="many"),
    dict(batch_size=True),
    dict(tau=float("nan")),
    dict(tau=1.5),
    dict(gamma=1.01),
    dict(gradient_steps=-2),
    dict(action_noise=-0.1),
    dict(max_events=7),
    dict(walk_steps=0),
    dict(exploration_steps=0),
    dict(explore_beyond=-1.0),
    dict(skills="sometimes"),
    dict(skills=None),
    dict(hindsight=-0.1),
    dict(shaping=-1.0),
]


@pytest.mark.parametrize("arguments", OUT_OF_RANGE, ids=shown)
def test_refused_arguments(arguments: dict[str, Any]) -> None:
    name = next(iter(arguments))
    with pytest.raises(ValueError, match=name.replace("_", ".")):
        new_agent(**arguments)


@pytest.mark.parametrize(
    "arguments",
    [
        dict(batch_size=2.5),
        dict(buffer_size=1e3),
        dict(gradient_steps=1.5),
        dict(train_freq=0),
        dict(stats_window_size=-3),
        dict(shaping=float("inf")),
        dict(explore_beyond=float("inf")),
        dict(action_noise=[0.2, 0.2]),
        dict(action_noise=np.array(0.2)),
        dict(action_noise={"sigma": 0.2}),
        dict(action_noise=True),
        dict(learning_rate=True),
        dict(train_freq=True),
        dict(seed=True),
        dict(seed=1.5),
        dict(verbose=3.5),
        dict(option_kwargs=5),
        dict(option_kwargs=dict(learning_rate=1e-3)),
        dict(policy_kwargs=5),
        dict(train_freq=(2,)),
    ],
    ids=shown,
)
def test_refused_arguments_that_are_no_such_numbers(arguments: dict[str, Any]) -> None:
    name = next(iter(arguments))
    with pytest.raises(ValueError, match=name):
        new_agent(**arguments)


def test_noise_may_be_any_number() -> None:
    for noise in (0.2, np.float32(0.2), 1):
        assert new_agent(action_noise=noise).parts.rollout.noise_std == pytest.approx(float(noise))


@pytest.mark.parametrize("option_class", [DQN, QRDQN])
def test_classes_for_other_actions_are_refused(option_class: Any) -> None:
    with pytest.raises(ValueError, match=f"option_class {option_class.__name__} cannot be built for continuous actions"):
        new_agent(option_class=option_class)


@pytest.mark.parametrize(("name", "value"), [("action_noise", 0.3), ("train_freq", 4)])
def test_attributes_that_sb3_cannot_use(tmp_path: Path, name: str, value: Any) -> None:
    agent = new_agent().learn(60)
    setattr(agent, name, value)
    with pytest.raises(ValueError, match=f"agent.{name} must be SB3's"):
        agent.learn(10, reset_num_timesteps=False)
    with pytest.raises(ValueError, match=f"agent.{name} must be SB3's"):
        agent.save(tmp_path / "agent")
    assert not list(tmp_path.iterdir())


def test_a_device_that_there_is_not_is_no_fault_of_the_file(trained_files: tuple[Path, Path]) -> None:
    with pytest.raises(RuntimeError, match="gpuu"):
        SkillGraphAgent.load(trained_files[0], device="gpuu")


def test_states_that_are_none() -> None:
    agent = new_agent()
    observation, _ = gym.make(TOY).reset()
    for state in (None, 5, (1, 2)):
        with pytest.raises(ValueError, match="no state that predict has returned"):
            agent.running(state)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="no state that predict has returned"):
        agent.predict(observation, state=5)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="total_timesteps"):
        agent.adapt(np.zeros(2), total_timesteps=0)


def test_an_agent_that_is_not_set_up_says_so() -> None:
    agent = SkillGraphAgent("MultiInputPolicy", gym.make(TOY), _init_setup_model=False)
    assert repr(agent) == "<SkillGraphAgent after 0 steps: not set up>"


@pytest.mark.parametrize("policy", [5, None, dict])
def test_policies_that_are_none(policy: Any) -> None:
    with pytest.raises(ValueError, match=r"Unknown policy .*'MultiInputPolicy'"):
        SkillGraphAgent(policy, gym.make(TOY))


def test_policy_of_another_kind() -> None:
    with pytest.raises(ValueError, match="MlpPolicy"):
        SkillGraphAgent("MlpPolicy", gym.make(TOY))


def test_unknown_salience_names_the_known() -> None:
    with pytest.raises(ValueError, match=r"'curiosity'.*'frontier', 'rrt'"):
        new_agent(salience="curiosity")


def test_policy_for_flat_observations_names_the_right_one() -> None:
    with pytest.raises(ValueError, match=r"'MlpPolicy'.*'MultiInputPolicy'"):
        SkillGraphAgent("MlpPolicy", gym.make(TOY))


def test_rrt_without_an_oracle() -> None:
    with pytest.raises(ValueError, match=r"sample_free.*frontier"):
        new_agent(Hidden(gym.make(TOY), "sample_free"), salience="rrt")


def test_event_radius_that_cannot_be_known() -> None:
    env = Hidden(gym.make(TOY), "success_radius", "distance_threshold")
    with pytest.raises(ValueError, match="event_radius"):
        new_agent(env)
    assert new_agent(env, event_radius=0.3).event_radius == 0.3


def test_vec_normalize(trained_files: tuple[Path, Path]) -> None:
    def normalized() -> VecNormalize:
        return VecNormalize(DummyVecEnv([lambda: gym.make(TOY)]), norm_obs_keys=["observation"])

    with pytest.raises(ValueError, match="VecNormalize"):
        new_agent(normalized())
    with pytest.raises(ValueError, match="VecNormalize"):
        new_agent().set_env(normalized())
    with pytest.raises(ValueError, match="VecNormalize"):
        SkillGraphAgent.load(trained_files[0], env=normalized())


def test_environment_of_another_shape(trained_files: tuple[Path, Path]) -> None:
    with pytest.raises(ValueError, match="spaces do not match"):
        SkillGraphAgent.load(trained_files[0], env=Spaces())
    with pytest.raises(ValueError, match="spaces do not match"):
        new_agent().set_env(Spaces())
    with pytest.raises(ValueError, match="number of environments must stay 1 in set_env, not become 2"):
        new_agent().set_env(new_vec_env(n_envs=2))


def test_option_env_needs_a_goal_environment() -> None:
    event = Event("e", np.zeros(2), 0.5)
    with pytest.raises(ValueError, match="goal environment"):
        OptionEnv(gym.make("Pendulum-v1"), event)
    with pytest.raises(ValueError, match="shape"):
        OptionEnv(gym.make(TOY), event, goal=np.zeros(3))


@pytest.mark.parametrize("where", ["start", "goal"])
@pytest.mark.parametrize("value", [[0.0, 0.0], [9.0, 0.0], [1.0], [1.0, 1.0, 1.0], [np.nan, 1.0], "here"])
def test_start_or_goal_that_is_no_place(where: str, value: Any) -> None:
    env = gym.make(TOY)
    env.reset()
    with pytest.raises(ValueError, match=f"'{where}'.*free space"):
        env.reset(options={where: value})


# -- predict ----------------------------------------------------------------------------------------------------------


def test_predict_before_anything_was_learned() -> None:
    agent = new_agent()
    obs, _ = agent.env.envs[0].reset()
    action, _ = agent.predict(obs)
    assert agent.action_space.contains(action)
    actions = [agent.predict({**obs, "desired_goal": np.array(goal)})[0] for goal in ([1.0, 1.0], [-1.0, -1.0])]
    assert not np.array_equal(*actions)  # the goal matters


@pytest.mark.parametrize(
    ("obs", "message"),
    [
        (np.zeros(2), "Dict observation"),
        ({"observation": np.zeros(2), "achieved_goal": np.zeros(2)}, "Dict observation"),
        ({"observation": np.zeros(3), "achieved_goal": np.zeros(2), "desired_goal": np.zeros(2)}, "'observation'"),
        ({"observation": np.zeros(2), "achieved_goal": np.zeros(2), "desired_goal": np.zeros((1, 2))}, "'desired_goal'"),
        ({"observation": np.zeros((1, 2)), "achieved_goal": np.zeros((1, 2)), "desired_goal": np.zeros(2)}, "'desired_g"),
    ],
)
def test_observation_of_the_wrong_kind(obs: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        new_agent().predict(obs)


@pytest.mark.parametrize("goal", [[1.0], [1.0, np.nan], [[1.0, 1.0]], [1.0, 1.0, 1.0], "there", None])
def test_goal_that_is_no_point(goal: Any) -> None:
    env = Recorder(gym.make(TOY))
    agent = new_agent(env)
    obs, _ = env.reset(seed=0)
    if goal is not None:  # plan then takes the one that is observed
        with pytest.raises(ValueError, match="A goal must be a finite vector"):
            agent.plan(obs, goal=goal)
        with pytest.raises(ValueError, match="A goal must be a finite vector"):
            agent.adapt(np.zeros(2), start=goal)
    with pytest.raises(ValueError, match="A goal must be a finite vector"):
        agent.adapt(goal)
    assert agent.num_timesteps == len(env.transitions) == 0
    # Nothing of it is left: the agent learns as ever.
    assert agent.learn(50).num_timesteps == 50
    assert agent.parts.missions.pinned is None
    assert agent.episodes.reset_options == {}


# -- observations that are no numbers ---------------------------------------------------------------------------------


def check_goes_on(agent: SkillGraphAgent, recorders: list[Recorder], reset_num_timesteps: bool) -> None:
    """After trouble, an agent can be saved, loaded, and can learn on, and its memory holds what truly happened."""
    agent.save(file := io.BytesIO())
    agent.save_replay_buffer(replay_file := io.BytesIO())
    loaded = SkillGraphAgent.load(file, env=new_vec_env(n_envs=agent.n_envs))
    loaded.load_replay_buffer(replay_file)
    for each in (loaded, agent):
        total, n_steps = each.parts.store.total, each.num_timesteps * (not reset_num_timesteps)
        each.learn(120, reset_num_timesteps=reset_num_timesteps)
        assert each.parts.store.total - total == each.num_timesteps - n_steps == 120
        for name, column in each.parts.store.get_state()["columns"].items():
            assert np.isfinite(column).all(), name
        assert np.isfinite(np.concatenate([p.detach().ravel() for p in each.policy.parameters()])).all()
    for i, recorder in enumerate(recorders):
        check_store(agent, recorder.transitions, i)


def faulty_envs(n_envs: int, at: int, fault: Callable, **kwargs: Any) -> tuple[DummyVecEnv, list[Recorder]]:
    """Environments of which the last is faulty; what recorders see is what goes on behind the fault."""
    recorders = [Recorder(gym.make(TOY, max_steps=60)) for _ in range(n_envs)]
    envs: list[gym.Env] = [*recorders]
    envs[-1] = Faulty(recorders[-1], at, fault, **kwargs)
    return DummyVecEnv([lambda env=env: env for env in envs]), recorders


@pytest.mark.filterwarnings("ignore:overflow")
@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("reset_num_timesteps", [True, False])
@pytest.mark.parametrize(
    ("key", "value", "at"), [("observation", np.nan, 25), ("achieved_goal", np.inf, 60), ("desired_goal", 1e300, 120)]
)
def test_no_number_in_a_step(key: str, value: float, at: int, n_envs: int, reset_num_timesteps: bool) -> None:
    # Steps 60 and 120 end episodes: there it is the terminal observation.
    env, recorders = faulty_envs(n_envs, at, put(key, value))
    agent = new_agent(env)
    with pytest.raises(ValueError, match=f"'{key}' of environment {n_envs - 1} .* step {at * n_envs}"):
        agent.learn(300)
    assert agent.parts.store.total == (at - 1) * n_envs
    for recorder in recorders:
        del recorder.transitions[-1]  # the step that was refused
    check_goes_on(agent, recorders, reset_num_timesteps)


@pytest.mark.parametrize("reset_num_timesteps", [True, False])
@pytest.mark.parametrize("n_envs", [1, 2])
def test_no_number_at_the_first_reset(n_envs: int, reset_num_timesteps: bool) -> None:
    env, recorders = faulty_envs(n_envs, 1, put("observation", np.nan), on_reset=True)
    agent = new_agent(env)
    with pytest.raises(ValueError, match=f"'observation' of environment {n_envs - 1} .* step 0"):
        agent.learn(300)
    assert agent.parts.store.total == 0
    check_goes_on(agent, recorders, reset_num_timesteps)


def test_no_number_at_a_later_reset() -> None:
    env, recorders = faulty_envs(1, 2, put("achieved_goal", -np.inf), on_reset=True)
    agent = new_agent(env)
    with pytest.raises(ValueError, match=r"'achieved_goal' of environment 0 .* step 60"):
        agent.learn(300)
    del recorders[0].transitions[-1]
    check_goes_on(agent, recorders, False)


# -- damaged and foreign files ----------------------------------------------------------------------------------------


class Bomb:
    """Leaves a trace when it is unpickled."""

    def __init__(self, trace: Path) -> None:
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return os.mkdir, (str(self.trace),)


def with_member(path: Path, name: str, content: bytes) -> bytes:
    """A saved file with one member replaced or added."""
    return packed({**members(path.read_bytes()), name: content})


def as_npy(array: np.ndarray) -> bytes:
    file = io.BytesIO()
    np.save(file, array, allow_pickle=True)
    return file.getvalue()


def refused(agent: SkillGraphAgent, content: bytes, folder: Path, match: str = "Cannot load") -> None:
    """No way of loading takes the file, as a path of any ending or as an object; and the agent stays as it was."""
    path = folder / "bad.zip"
    path.write_bytes(content)
    (folder / "bad.pkl").write_bytes(content)
    before = state_of(agent)
    for given in (path, str(folder / "bad.pkl"), io.BytesIO(content)):
        for load in (SkillGraphAgent.load, agent.set_parameters, agent.load_replay_buffer):
            with pytest.raises(ValueError, match=match):
                load(given)
    assert differences(before, state_of(agent)) == []


@pytest.mark.parametrize("which", [0, 1], ids=["agent", "replay"])
@pytest.mark.parametrize("part", [0.0, 0.001, 0.3, 0.9, 0.999])
def test_truncated(
    trained: SkillGraphAgent, trained_files: tuple[Path, Path], tmp_path: Path, which: int, part: float
) -> None:
    content = trained_files[which].read_bytes()
    refused(trained, content[: int(part * len(content))], tmp_path)


def test_flipped_bits(trained: SkillGraphAgent, trained_files: tuple[Path, Path]) -> None:
    expected, before = state_in(*trained_files), state_of(trained)
    rng = np.random.default_rng(0)
    n_refused = 0
    for which, load in ((0, SkillGraphAgent.load), (0, trained.set_parameters), (1, trained.load_replay_buffer)):
        content = trained_files[which].read_bytes()
        ends = [*range(0, 60, 7), *range(len(content) - 400, len(content), 29)]
        for position in [*ends, *rng.integers(0, len(content), 8)]:
            flipped = bytearray(content)
            flipped[position] ^= 1 << int(rng.integers(8))
            try:
                loaded = load(io.BytesIO(flipped))
            except ValueError:
                n_refused += 1
                continue
            # A date or a flag of the zip: nothing that counts.
            if loaded is not None:
                assert differences(expected["agent"], state_of(loaded)["agent"]) == [], position
        assert differences(before["replay"], state_of(trained)["replay"]) == []
        assert differences(before["agent"]["parameters"], state_of(trained)["agent"]["parameters"]) == []
    assert n_refused > 50


def test_files_of_another_kind(trained: SkillGraphAgent, trained_files: tuple[Path, Path], tmp_path: Path) -> None:
    DDPG("MlpPolicy", "Pendulum-v1", policy_kwargs=dict(net_arch=[4])).save(tmp_path / "ddpg.zip")
    refused(trained, (tmp_path / "ddpg.zip").read_bytes(), tmp_path)
    refused(trained, b"PK\x03\x04 and so on", tmp_path)
    refused(trained, b"some text", tmp_path)
    with pytest.raises(ValueError, match="'replay_buffer', not a 'agent'"):
        SkillGraphAgent.load(trained_files[1])
    with pytest.raises(ValueError, match="'replay_buffer', not a 'agent'"):
        trained.set_parameters(trained_files[1])
    with pytest.raises(ValueError, match="'agent', not a 'replay_buffer'"):
        trained.load_replay_buffer(trained_files[0])


@pytest.mark.parametrize(("later", "message"), [(1, "newer than .* upgrade"), (-1, "reads schema .* only: .* or train anew")])
def test_another_schema(
    trained: SkillGraphAgent, trained_files: tuple[Path, Path], tmp_path: Path, later: int, message: str
) -> None:
    with zipfile.ZipFile(trained_files[0]) as archive:
        document = archive.read("agent.json").replace(b'"schema": %d' % SCHEMA, b'"schema": %d' % (SCHEMA + later))
    refused(trained, with_member(trained_files[0], "agent.json", document), tmp_path, message)


def document_of(path: Path) -> dict[str, Any]:
    with zipfile.ZipFile(path) as archive:
        return json.loads(archive.read("agent.json"))


def with_document(path: Path, document: Any) -> io.BytesIO:
    return io.BytesIO(with_member(path, "agent.json", json.dumps(document).encode()))


def places(tree: Any, depth: int = 4) -> list[tuple[Any, ...]]:
    """Ways to the entries of a document, the first two of a list."""
    entries = tree.items() if isinstance(tree, dict) else enumerate(tree[:2]) if isinstance(tree, list) else ()
    below = [(key, *rest) for key, entry in entries for rest in (places(entry, depth - 1) if depth else [()])]
    return [(), *below]


WRONG: list[Any] = [None, 5, "x", [], {}, 1e30, True, {"__array__": ["<f8", 0, [3]]}, {"__callable__": "os.system"}]


def wrong_documents(path: Path, n: int) -> Iterator[tuple[tuple[Any, ...], Any, io.BytesIO]]:
    """Files that are whole, but hold something else in one place."""
    rng, document = np.random.default_rng(0), document_of(path)
    ways = [way for way in places(document) if way]
    for i in rng.permutation(len(ways) * len(WRONG))[:n]:
        way, value = ways[i // len(WRONG)], WRONG[i % len(WRONG)]
        changed = copy.deepcopy(document)
        entry = changed
        for key in way[:-1]:
            entry = entry[key]
        entry[way[-1]] = value
        yield way, value, with_document(path, changed)


@pytest.mark.parametrize("what", ["agent", "parameters", "replay"])
def test_whole_files_that_hold_something_else(trained: SkillGraphAgent, trained_files: tuple[Path, Path], what: str) -> None:
    load = {"agent": SkillGraphAgent.load, "parameters": trained.set_parameters, "replay": trained.load_replay_buffer}[what]
    errors = []
    for way, value, file in wrong_documents(trained_files[what == "replay"], 200):
        try:
            load(file)
        except ValueError:
            pass
        except Exception as error:
            errors.append((way, value, error))
    assert errors == []


def test_a_replay_buffer_that_is_refused_leaves_the_old_one(
    trained: SkillGraphAgent, trained_files: tuple[Path, Path], tmp_path: Path
) -> None:
    document = document_of(trained_files[1])
    del document["tree"]["n_trajectories"]
    trained.learn(20, reset_num_timesteps=False)
    before = state_of(trained)
    with pytest.raises((ValueError, KeyError), match="n_trajectories"):
        trained.load_replay_buffer(with_document(trained_files[1], document))
    assert differences(before, state_of(trained)) == []


def test_a_file_beyond_the_limit(
    trained: SkillGraphAgent, trained_files: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(saving, "MAX_BYTES", 10_000)
    with pytest.raises(ValueError, match="MAX_BYTES"):
        SkillGraphAgent.load(trained_files[0])
    with pytest.raises(ValueError, match="MAX_BYTES"):
        trained.load_replay_buffer(trained_files[1])


def test_negative_records_are_refused(trained_files: tuple[Path, Path], tmp_path: Path) -> None:
    tree = saving.load_tree(trained_files[0], "agent")
    columns = {name: column for name, column in tree["graph"]["edges"].items() if column.dtype.kind == "f"}
    assert {"successes", "failures", "crossing_steps", "landing_weight"} <= columns.keys()
    for name, column in columns.items():
        wrong = {**tree["graph"]["edges"], name: column - 1e6}
        saving.save_tree(tmp_path / "wrong", "agent", {**tree, "graph": {**tree["graph"], "edges": wrong}})
        with pytest.raises(ValueError, match=f"graph/edges/{name}"):
            SkillGraphAgent.load(tmp_path / "wrong")


def test_files_that_promise_more_than_they_hold(trained_files: tuple[Path, Path]) -> None:
    for way, value in [
        (("arguments", "buffer_size"), 10**15),
        (("arguments", "policy_kwargs"), {"net_arch": [12_000, 12_000]}),
        (("n_envs",), 5_000),
    ]:
        document = document_of(trained_files[0])
        place = document["tree"]
        for key in way[:-1]:
            place = place[key]
        place[way[-1]] = value
        with pytest.raises(ValueError):
            SkillGraphAgent.load(with_document(trained_files[0], document))


@pytest.mark.parametrize("name", ["policy_kwargs", "option_kwargs"])
def test_a_class_that_is_stored_by_its_name_must_be_given_again(tmp_path: Path, name: str) -> None:
    made = {"policy_kwargs": dict(net_arch=[8], activation_fn=th.nn.Hardswish)}
    arguments = made if name == "policy_kwargs" else {"option_kwargs": made}
    new_agent(**arguments).save(tmp_path / "agent")
    assert isinstance(SkillGraphAgent.load(tmp_path / "agent", **arguments), SkillGraphAgent)
    with pytest.raises(ValueError, match=name):
        SkillGraphAgent.load(tmp_path / "agent")


def test_missing_file(trained: SkillGraphAgent, tmp_path: Path) -> None:
    for load in (SkillGraphAgent.load, trained.set_parameters, trained.load_replay_buffer):
        with pytest.raises(FileNotFoundError, match="nothing_here"):
            load(tmp_path / "nothing_here")


def test_pickles_are_never_run(trained: SkillGraphAgent, trained_files: tuple[Path, Path], tmp_path: Path) -> None:
    trace = tmp_path / "trace"
    bomb = pickle.dumps(Bomb(trace))
    array = np.empty(1, dtype=object)
    array[0] = Bomb(trace)
    refused(trained, bomb, tmp_path)
    refused(trained, as_npy(array), tmp_path)
    for path in trained_files:
        refused(trained, with_member(path, "agent.json", bomb), tmp_path)
        refused(trained, with_member(path, "arrays/f4.npy", as_npy(array)), tmp_path)
        refused(trained, with_member(path, "arrays/f4.npy", bomb), tmp_path)
    for name in ("data", "policy.pth", "extra.pkl"):
        SkillGraphAgent.load(io.BytesIO(with_member(trained_files[0], name, bomb)))
    assert not trace.exists()
    pickle.loads(bomb)
    assert trace.exists()  # the bomb works


# -- no room to save --------------------------------------------------------------------------------------------------


def save_both(agent: SkillGraphAgent, folder: Path) -> None:
    agent.save(folder / "agent.zip")
    agent.save_replay_buffer(folder / "replay.zip")


def files_in(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def check_old_files_stay(agent: SkillGraphAgent, folder: Path, error: type[BaseException] = OSError) -> None:
    before, state = files_in(folder), state_of(agent)
    assert len(before) == 2
    for save, name in ((agent.save, "agent.zip"), (agent.save_replay_buffer, "replay.zip")):
        with pytest.raises(error):
            save(folder / name)
    assert files_in(folder) == before
    assert differences(state, state_of(agent)) == []


def test_old_file_stays_if_renaming_fails(trained: SkillGraphAgent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    save_both(trained, tmp_path)

    def fail(*_: Any, **__: Any) -> None:
        raise OSError("no")

    monkeypatch.setattr(os, "replace", fail)
    check_old_files_stay(trained, tmp_path)


@pytest.mark.parametrize("limit", [0, 5000])
def test_old_file_stays_if_the_disk_is_full(trained: SkillGraphAgent, tmp_path: Path, limit: int) -> None:
    save_both(trained, tmp_path)
    trained.learn(50, reset_num_timesteps=False)
    before, limits = files_in(tmp_path), resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, limits[1]))
    try:
        for save, name in ((trained.save, "agent.zip"), (trained.save_replay_buffer, "replay.zip")):
            with pytest.raises(OSError, match="too large"):
                save(tmp_path / name)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert files_in(tmp_path) == before
    save_both(trained, tmp_path)
    assert files_in(tmp_path) != before


def test_old_file_stays_if_saving_is_interrupted(
    trained: SkillGraphAgent, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    save_both(trained, tmp_path)

    def fail(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "fsync", fail)
    check_old_files_stay(trained, tmp_path, KeyboardInterrupt)


def test_folder_that_cannot_be_made(trained: SkillGraphAgent, tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="file"):
        trained.save(tmp_path / "file" / "agent.zip")


# -- what could not be read again is not written ------------------------------------------------------------------------


class OwnNoise(NormalActionNoise):
    """A user's own class, of the name of which no file knows anything."""


class Telling(gym.Wrapper):
    """Tells a state of its own.

    :param state: what it tells, or an error that it raises
    """

    def __init__(self, state: Any) -> None:
        super().__init__(gym.make(TOY))
        self.state = state

    def get_state(self) -> Any:
        if isinstance(self.state, Exception):
            raise self.state
        return self.state

    def set_state(self, state: Any) -> None:
        self.state = state


@pytest.mark.parametrize("n_envs", [1, 2])
def test_noise_of_a_class_of_ones_own_must_be_given_again(tmp_path: Path, n_envs: int) -> None:
    noise = OwnNoise(np.zeros(2), 0.1 * np.ones(2))
    new_agent(new_vec_env(n_envs=n_envs), action_noise=noise).learn(20).save(tmp_path / "agent")
    with pytest.raises(ValueError, match=r"load\(..., action_noise=...\)"):
        SkillGraphAgent.load(tmp_path / "agent")
    SkillGraphAgent.load(tmp_path / "agent", env=new_vec_env(n_envs=n_envs), action_noise=noise).learn(20)


STATES = [
    (RuntimeError("the simulator is gone"), "the simulator is gone"),
    ({"random": b"bytes"}, "its state/states/0/random cannot be saved: a bytes has no encoding"),
    ({"seen": {1, 2}}, "seen cannot be saved: a set"),
    ({"when": np.datetime64("2020-01-01")}, "when cannot be saved"),
    ({"rows": np.zeros(2, [("x", "f4")])}, "rows cannot be saved: an array of"),
    ({"best": np.inf}, "best must be finite"),
    ({"named": Named(1)}, "named cannot be saved: a Named"),
    ({"masked": np.ma.masked_array([1.0], [True])}, "masked cannot be saved: a MaskedArray"),
]


@pytest.mark.parametrize(("state", "message"), STATES, ids=[message[:20] for _, message in STATES])
def test_a_state_that_cannot_be_saved_is_left_out(tmp_path: Path, state: Any, message: str) -> None:
    agent = new_agent(Telling(state)).learn(30)
    with pytest.warns(UserWarning, match="The environment cannot tell its state.*" + message):
        agent.save(tmp_path / "agent")
    assert SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY)).learn(30, reset_num_timesteps=False).num_timesteps == 60


def test_arrays_of_another_byte_order_come_back(tmp_path: Path) -> None:
    state = {"big": np.array([1.0, 2.0], ">f8"), "little": np.array([3.0], "<f8"), "words": np.array(["a", "bc"])}
    agent = new_agent(Telling(state)).learn(30)
    agent.save(tmp_path / "agent")
    env = Telling(copy.deepcopy(state))
    loaded = SkillGraphAgent.load(tmp_path / "agent", env=env)
    env.state = {}
    loaded.learn(30, reset_num_timesteps=False)
    assert differences(state, env.state) == []


def test_an_observation_space_of_another_byte_order(tmp_path: Path) -> None:
    class Big(gym.ObservationWrapper):
        def __init__(self) -> None:
            super().__init__(gym.make(TOY))
            entries = self.env.observation_space.spaces.items()  # type: ignore[attr-defined]
            boxes = {
                key: spaces.Box(box.low.astype(">f4"), box.high.astype(">f4"), dtype=np.dtype(">f4")) for key, box in entries
            }
            self.observation_space = spaces.Dict(boxes)

        def observation(self, observation: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
            return {key: value.astype(">f4") for key, value in observation.items()}

    agent = new_agent(Big()).learn(250)
    agent.save(tmp_path / "agent")
    assert SkillGraphAgent.load(tmp_path / "agent", env=Big()).learn(20, reset_num_timesteps=False).num_timesteps == 270


def test_parameters_that_are_no_numbers_are_called_so(tmp_path: Path) -> None:
    agent = new_agent().learn(250)
    with th.no_grad():
        next(agent.policy.actor.parameters())[0, 0] = float("nan")
    agent.set_parameters(agent.get_parameters())
    for act in (lambda: agent.predict(agent.env.reset()), lambda: agent.learn(50, reset_num_timesteps=False)):
        with pytest.raises(ValueError, match="policy's parameters hold NaN"):
            act()
    with pytest.raises(ValueError, match="parameters/"):
        agent.save(tmp_path / "agent")
    assert not list(tmp_path.iterdir())


# -- environments that do something else than they say ----------------------------------------------------------------


@pytest.mark.parametrize("on_reset", [False, True])
@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.zeros(5), "has a 'observation' of shape"),
        (np.zeros(1), "has a 'observation' of shape"),
        (None, "has a 'observation' of shape"),
        (np.array(["a", "b"]), "no such 'observation' as its space says"),
        ("gone", "no such 'observation' as its space says: KeyError"),
        (np.full(2, 1e20), "number beyond 1e.15"),
    ],
    ids=["too long", "too short", "None", "text", "gone", "huge"],
)
def test_an_observation_that_is_not_what_its_space_says(value: Any, message: str, on_reset: bool) -> None:
    def fault(observation: dict[str, Any]) -> None:
        observation["observation"] = value
        if isinstance(value, str):
            del observation["observation"]

    agent = new_agent(Faulty(gym.make(TOY, max_steps=20), at=2 if on_reset else 25, fault=fault, on_reset=on_reset))
    with pytest.raises(ValueError, match=message):
        agent.learn(50)
    agent.save(io.BytesIO())
    assert agent.learn(50, reset_num_timesteps=False).num_timesteps > 50


def test_a_worker_that_has_died_is_called_so(tmp_path: Path) -> None:
    env = new_vec_env(vec_env_cls=SubprocVecEnv)
    agent = new_agent(env).learn(40)
    env.processes[0].kill()  # type: ignore[attr-defined]
    env.processes[0].join()  # type: ignore[attr-defined]
    with pytest.warns(UserWarning, match="cannot tell its state"):
        agent.save(tmp_path / "agent")
    with pytest.raises(RuntimeError, match="worker process of it, cannot be reached"):
        agent.learn(20, reset_num_timesteps=False)
    agent.save(tmp_path / "agent")
    agent.save_replay_buffer(tmp_path / "replay")
    agent.set_env(new_vec_env(), force_reset=True)
    assert agent.learn(20, reset_num_timesteps=False).num_timesteps >= 60
    env.processes[1].kill()  # type: ignore[attr-defined]


def test_a_reward_without_bounds_does_not_matter(tmp_path: Path) -> None:
    agent = new_agent(gym.wrappers.TransformReward(gym.make(TOY, max_steps=10), lambda _: -np.inf)).learn(50)
    agent.save(tmp_path / "agent")
    SkillGraphAgent.load(tmp_path / "agent")


# -- Ctrl-C -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("at", [1, 90, 120])
def test_interrupt_in_an_environment(n_envs: int, at: int) -> None:
    env, recorders = faulty_envs(n_envs, at, interrupt)
    agent = new_agent(env)
    with pytest.raises(KeyboardInterrupt):
        agent.learn(300)
    assert agent.parts.store.total == agent.num_timesteps == (at - 1) * n_envs
    for recorder in recorders:
        del recorder.transitions[at - 1 :]
    check_goes_on(agent, recorders, False)


def test_interrupt_in_a_callback() -> None:
    env = Recorder(gym.make(TOY))
    agent = new_agent(env)

    def callback(variables: dict[str, Any], _: dict[str, Any]) -> bool:
        if agent.num_timesteps == 250:
            raise KeyboardInterrupt
        return True

    with pytest.raises(KeyboardInterrupt):
        agent.learn(300, callback=callback)
    assert agent.parts.store.total == 249
    del env.transitions[-1]
    check_goes_on(agent, [env], False)


def test_interrupt_in_an_update(monkeypatch: pytest.MonkeyPatch) -> None:
    env = Recorder(gym.make(TOY))
    agent = new_agent(env)
    replay, minibatch = agent.parts.walker.replay, agent.parts.walker.replay.minibatch

    def interrupted(*arguments: Any, **kwargs: Any) -> Any:
        if agent.num_timesteps == 260:
            raise KeyboardInterrupt
        return minibatch(*arguments, **kwargs)

    with monkeypatch.context() as patch:
        patch.setattr(replay, "minibatch", interrupted)
        with pytest.raises(KeyboardInterrupt):
            agent.learn(400)
    assert agent.parts.store.total == agent.num_timesteps == 260
    check_goes_on(agent, [env], False)


@pytest.mark.parametrize("where", ["store.add", "witness.step", "runner.advance", "missions.observe", "witness.begin"])
def test_ctrl_c_while_a_step_is_being_stored(where: str, monkeypatch: pytest.MonkeyPatch) -> None:
    env = Recorder(gym.make(TOY, max_steps=60))
    agent = new_agent(env, learning_starts=1000)  # updates are no part of storing
    part, name = where.split(".")
    owner = agent.parts.rollout.runner if part == "runner" else getattr(agent.parts, part)
    method = getattr(owner, name)

    def pressed(*arguments: Any, **kwargs: Any) -> Any:
        if agent.num_timesteps == 240:  # at the end of an episode
            signal.raise_signal(signal.SIGINT)
        return method(*arguments, **kwargs)

    handler = signal.getsignal(signal.SIGINT)
    with monkeypatch.context() as patch:
        patch.setattr(owner, name, pressed)
        with pytest.raises(KeyboardInterrupt):
            agent.learn(300)
    assert signal.getsignal(signal.SIGINT) is handler
    assert agent.parts.store.total == agent.num_timesteps == 240
    check_store(agent, env.transitions)
    # Nothing was half done: the agent stands where one does that was stopped after that step.
    ours = state_of(agent)
    twin = state_of(new_agent(gym.make(TOY, max_steps=60), learning_starts=1000).learn(240))
    assert differences(twin["replay"], ours["replay"]) == []
    for name in ("graph", "model", "walker", "parameters"):
        assert differences(twin["agent"][name], ours["agent"][name]) == []
    assert differences(twin["agent"]["progress"]["rollout"], ours["agent"]["progress"]["rollout"]) == []
    assert differences(twin["agent"]["progress"]["rng"], ours["agent"]["progress"]["rng"]) == []
    check_goes_on(agent, [env], False)
