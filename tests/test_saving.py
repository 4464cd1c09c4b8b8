"""Saving and loading: SB3's signatures, and round trips that lose nothing."""

import io
import pathlib
import random
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import TOY, differences, new_agent, new_vec_env, state_in, state_of
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit
from stable_baselines3 import SAC
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise, VectorizedActionNoise
from stable_baselines3.common.utils import set_random_seed

from sb3_skillgraph import PAPER, SkillGraphAgent


def observations(n: int = 16) -> dict[str, np.ndarray]:
    points = np.random.default_rng(3).uniform(-1.5, 1.5, (2, n, 2))
    return {"observation": points[0], "achieved_goal": points[0], "desired_goal": points[1]}


def flat(parameters: Any) -> dict[str, Any]:
    """A nested dict of parameters as one level, without the tensors' ties to the agent."""
    if isinstance(parameters, dict):
        return {f"{k}.{name}": v for k, part in parameters.items() for name, v in flat(part).items()}
    return {"": parameters.detach().clone() if isinstance(parameters, th.Tensor) else parameters}


# -- save and load ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("as_path", [str, pathlib.Path])
@pytest.mark.parametrize("name", ["agent", "agent.zip", "best.model"])
def test_paths(trained: SkillGraphAgent, tmp_path: Path, as_path: Callable[[str], Any], name: str) -> None:
    path = as_path(str(tmp_path / "new" / name))
    trained.save(path)
    assert [file.name for file in (tmp_path / "new").iterdir()] == ["agent.zip" if name == "agent" else name]
    loaded = SkillGraphAgent.load(path)
    assert differences(trained.predict(observations()), loaded.predict(observations())) == []


def test_file_objects(trained: SkillGraphAgent, tmp_path: Path) -> None:
    expected = state_of(trained)
    with open(tmp_path / "agent", "wb") as file, open(tmp_path / "replay", "wb") as replay_file:
        trained.save(file)
        trained.save_replay_buffer(replay_file)
    with open(tmp_path / "agent", "rb") as file, open(tmp_path / "replay", "rb") as replay_file:
        loaded = SkillGraphAgent.load(file, env=gym.make(TOY))
        loaded.load_replay_buffer(replay_file)
        assert not file.closed
    assert differences(expected, state_of(loaded)) == []


def test_loading_gives_the_same_agent(trained: SkillGraphAgent, tmp_path: Path) -> None:
    trained.save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent")
    assert type(loaded) is SkillGraphAgent
    assert [option.id for option in loaded.options] == [option.id for option in trained.options]
    assert [event.id for event in loaded.events] == [event.id for event in trained.events]
    assert dict(loaded.graph.nx.nodes(data=True)) == dict(trained.graph.nx.nodes(data=True))
    assert sorted(loaded.graph.nx.edges(data=True)) == sorted(trained.graph.nx.edges(data=True))
    assert {option.learner for option in loaded.options} == {loaded.parts.walker.learner}
    for i in range(16):
        obs = {key: value[i] for key, value in observations().items()}
        assert loaded.plan(obs) == trained.plan(obs)


def test_saving_changes_nothing(trained: SkillGraphAgent, tmp_path: Path) -> None:
    before = state_of(trained)
    trained.save(tmp_path / "agent")
    trained.save_replay_buffer(tmp_path / "replay")
    assert differences(before, state_of(trained)) == []


def test_an_agent_that_never_learned(tmp_path: Path) -> None:
    agent = new_agent()
    agent.save(tmp_path / "agent")
    agent.save_replay_buffer(tmp_path / "replay")
    loaded = SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY))
    loaded.load_replay_buffer(tmp_path / "replay")
    assert differences(agent.predict(observations()), loaded.predict(observations())) == []
    assert loaded.learn(250).num_timesteps == 250


def test_loading_without_env_then_set_env(trained_files: tuple[Path, Path]) -> None:
    agent = SkillGraphAgent.load(trained_files[0])
    assert agent.get_env() is None
    agent.set_env(gym.make(TOY))
    n_steps = agent.num_timesteps
    agent.learn(100, reset_num_timesteps=False)
    assert agent.num_timesteps == n_steps + 100 >= 2100


def test_loading_does_not_need_the_replay_buffer(trained_files: tuple[Path, Path]) -> None:
    agent = SkillGraphAgent.load(trained_files[0], env=gym.make(TOY))
    agent.learn(300, reset_num_timesteps=False)
    assert agent.parts.store.total == 300


def test_learning_on_without_the_counters(trained_files: tuple[Path, Path]) -> None:
    agent = SkillGraphAgent.load(trained_files[0], env=gym.make(TOY)).learn(50)
    assert agent.num_timesteps == 50


def test_loading_draws_from_no_generator_it_does_not_restore(trained_files: tuple[Path, Path]) -> None:
    first, second = (SkillGraphAgent.load(trained_files[0], env=gym.make(TOY)) for _ in range(2))
    assert differences(state_of(first), state_of(second)) == []


@pytest.mark.parametrize("seed", [None, 3])
def test_loading_does_to_the_generators_what_sb3_does(tmp_path: Path, seed: int | None) -> None:
    def drawn() -> tuple[float, ...]:
        return random.random(), np.random.random(), float(th.rand(1))  # noqa: NPY002

    def expected(draw: int) -> tuple[float, ...]:
        set_random_seed(draw)
        return drawn()

    agent = new_agent(seed=seed).learn(30)
    agent.save(tmp_path / "agent")
    at_saving = [drawn() for _ in range(2)]
    set_random_seed(8)
    loaded = SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY))
    assert drawn() == expected(8 if seed is None else seed)
    loaded.learn(0, reset_num_timesteps=False)
    assert [drawn() for _ in range(2)] == at_saving


# -- arguments --------------------------------------------------------------------------------------------------------


def test_excluded_arguments_take_their_defaults(tmp_path: Path) -> None:
    agent = new_agent(walk_steps=33, gamma=0.5)
    agent.save(tmp_path / "without", exclude=["walk_steps", "gamma"], include=["gamma"])
    loaded = SkillGraphAgent.load(tmp_path / "without")
    assert (loaded.graph.walk_steps, loaded.gamma) == (40, 0.5)


@pytest.mark.parametrize("how", ["custom_objects", "kwargs"])
def test_arguments_given_at_loading_win(trained_files: tuple[Path, Path], how: str) -> None:
    changes = dict(learning_rate=7e-5, walk_steps=44)
    arguments: dict[str, Any] = {"custom_objects": changes} if how == "custom_objects" else changes
    agent = SkillGraphAgent.load(trained_files[0], **arguments)
    assert agent.graph.walk_steps == 44
    assert agent.learning_rate == 7e-5
    assert agent.parts.walker.learner.actor_learning_rate == 7e-5


def test_attributes_that_were_set_are_saved(trained: SkillGraphAgent, tmp_path: Path) -> None:
    changes = dict(batch_size=64, gradient_steps=3, learning_starts=77, learning_rate=1e-5, verbose=1)
    for name, value in changes.items():
        setattr(trained, name, value)
    trained.save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent")
    assert {name: getattr(loaded, name) for name in changes} == changes


def test_noise_that_was_taken_away_stays_away(tmp_path: Path) -> None:
    agent = new_agent(action_noise=NormalActionNoise(np.zeros(2), np.ones(2)))
    agent.action_noise = None
    agent.save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent")
    assert loaded.action_noise is None and loaded.parts.rollout.noise_std == 0.0


@pytest.mark.parametrize("given", ["OptionTD3", "SAC", "DDPG"])
def test_an_option_class_given_by_its_name_is_saved(tmp_path: Path, given: str) -> None:
    agent = new_agent(option_class=given)
    assert type(agent.parts.walker.learner).__name__ == given
    agent.save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent")
    assert type(loaded.parts.walker.learner) is type(agent.parts.walker.learner)
    assert differences(agent.predict(observations()), loaded.predict(observations())) == []


def test_what_was_read_off_the_environment_is_saved(tmp_path: Path) -> None:
    new_agent(gym.make(TOY, success_radius=0.3, max_steps=60)).save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent")
    assert (loaded.event_radius, loaded.parts.planner.horizon, loaded.parts.view_name) == (0.3, 60, "relative")


@pytest.mark.parametrize("given", [{}, PAPER])
def test_plans_are_about_the_episodes_of_the_environment_given(tmp_path: Path, given: dict[str, Any]) -> None:
    new_agent(gym.make(TOY, max_steps=60), **given).save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY, max_steps=90))
    assert loaded.parts.planner.horizon == 90
    loaded.set_env(gym.make(TOY, max_steps=120))
    assert loaded.parts.planner.horizon == 120


def double_view(observation: np.ndarray, achieved_goal: np.ndarray, goal: np.ndarray) -> np.ndarray:
    return np.concatenate([observation, achieved_goal, goal], axis=1)


def test_a_function_must_be_given_again(tmp_path: Path) -> None:
    agent = new_agent(option_view=double_view).learn(250)
    agent.save(tmp_path / "agent")
    with pytest.raises(ValueError, match="option_view=double_view"):
        SkillGraphAgent.load(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent", option_view=double_view)
    assert differences(agent.predict(observations()), loaded.predict(observations())) == []


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("noise_class", [NormalActionNoise, OrnsteinUhlenbeckActionNoise])
def test_noise_is_saved(tmp_path: Path, noise_class: type, n_envs: int) -> None:
    agent = new_agent(new_vec_env(n_envs=n_envs), action_noise=noise_class(np.zeros(2), 0.3 * np.ones(2))).learn(20)
    agent.save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent", env=new_vec_env(n_envs=n_envs)).learn(20)
    noise = loaded.action_noise.base_noise if isinstance(loaded.action_noise, VectorizedActionNoise) else loaded.action_noise
    assert type(noise) is noise_class


def test_networks_of_other_shapes_are_saved(tmp_path: Path) -> None:
    policy_kwargs = dict(net_arch=dict(pi=[8], qf=[12, 4]), activation_fn=th.nn.Tanh, optimizer_kwargs=dict(eps=1e-5))
    agent = new_agent(policy_kwargs=policy_kwargs, option_class=SAC, option_kwargs=dict(ent_coef=0.1)).learn(250)
    agent.save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent")
    assert isinstance(loaded.parts.walker.learner, SAC)
    assert differences(agent.predict(observations()), loaded.predict(observations())) == []


def test_arguments_are_left_as_they_were_given() -> None:
    policy_kwargs = dict(net_arch=[8])
    agent = SkillGraphAgent("MultiInputPolicy", gym.make(TOY), policy_kwargs=policy_kwargs, option_class=SAC)
    assert agent.parts.walker.learner.policy.net_arch == [8]
    assert policy_kwargs == dict(net_arch=[8])


# -- parameters -------------------------------------------------------------------------------------------------------


def test_parameters_round_trip(trained: SkillGraphAgent) -> None:
    expected = flat(trained.get_parameters())
    given = {
        name: {key: value.clone() + 1.0 if isinstance(value, th.Tensor) else value for key, value in state.items()}
        for name, state in trained.get_parameters().items()
    }
    before, _ = trained.predict(observations())
    original = SkillGraphAgent.load(as_file(trained)).get_parameters()
    trained.set_parameters(given)
    assert not np.array_equal(before, trained.predict(observations())[0])
    trained.set_parameters(original)
    assert differences(expected, flat(trained.get_parameters())) == []
    assert np.array_equal(before, trained.predict(observations())[0])


def as_file(agent: SkillGraphAgent) -> io.BytesIO:
    file = io.BytesIO()
    agent.save(file)
    return file


def test_parameters_have_sb3_names(trained: SkillGraphAgent) -> None:
    assert set(trained.get_parameters()) == {"policy", "actor.optimizer", "critic.optimizer"}
    assert {"policy", "ent_coef_optimizer"} <= set(new_agent(option_class=SAC).get_parameters())


def test_parameters_from_a_file(trained: SkillGraphAgent, trained_files: tuple[Path, Path]) -> None:
    expected = flat(trained.get_parameters())
    trained.learn(5, reset_num_timesteps=False)
    assert differences(expected, flat(trained.get_parameters())) != []
    trained.set_parameters(str(trained_files[0]))
    assert differences(expected, flat(trained.get_parameters())) == []
    fresh = new_agent(seed=5)
    fresh.set_parameters(trained_files[0])  # whatever its graph
    assert differences(expected, flat(fresh.get_parameters())) == []


def test_wrong_parameters_are_refused(trained: SkillGraphAgent, trained_files: tuple[Path, Path]) -> None:
    parameters = SkillGraphAgent.load(trained_files[0]).get_parameters()
    policy = dict(parameters["policy"])
    with pytest.raises(ValueError, match="nonsense"):
        trained.set_parameters({"nonsense": policy}, exact_match=False)
    with pytest.raises(ValueError, match="optimizer"):
        trained.set_parameters({"policy": policy})
    policy.pop(next(iter(policy)))
    with pytest.raises(RuntimeError, match="Missing key"):
        trained.set_parameters({**parameters, "policy": policy})
    trained.set_parameters({"policy": policy}, exact_match=False)


# -- replay buffer ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["replay", "replay.pkl", "replay.zip"])
def test_replay_buffer_round_trip(trained: SkillGraphAgent, tmp_path: Path, name: str) -> None:
    expected = state_of(trained)
    trained.save_replay_buffer(str(tmp_path / name))
    trained.learn(100, reset_num_timesteps=False)
    trained.load_replay_buffer(tmp_path / name)
    assert differences(expected["replay"], state_of(trained)["replay"]) == []


def test_only_filled_rows_are_saved(tmp_path: Path) -> None:
    agent = new_agent(buffer_size=10**6).learn(100)
    agent.save_replay_buffer(tmp_path / "replay.zip")
    assert (tmp_path / "replay.zip").stat().st_size < 30_000


def test_a_full_buffer_is_saved_and_goes_on(tmp_path: Path) -> None:
    agent = new_agent(buffer_size=150).learn(420)
    agent.save(tmp_path / "agent")
    agent.save_replay_buffer(tmp_path / "replay")
    expected = state_of(agent.learn(301, reset_num_timesteps=False))
    loaded = SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY))
    loaded.load_replay_buffer(tmp_path / "replay")
    loaded.learn(301, reset_num_timesteps=False)
    assert differences(expected["replay"], state_of(loaded)["replay"]) == []


@pytest.mark.parametrize(("kwargs", "n_envs"), [(dict(buffer_size=500), 1), (dict(), 2)])
def test_replay_buffer_of_another_size_is_refused(
    trained_files: tuple[Path, Path], kwargs: dict[str, Any], n_envs: int
) -> None:
    agent = new_agent(new_vec_env(n_envs=n_envs), **kwargs).learn(100)
    before = state_of(agent)
    with pytest.raises(ValueError, match="buffer_size" if kwargs else "n_envs"):
        agent.load_replay_buffer(trained_files[1])
    assert differences(before, state_of(agent)) == []


def test_nothing_is_left_open(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", ResourceWarning)
        agent = new_agent().learn(100)
        agent.save(tmp_path / "agent")
        agent.save_replay_buffer(tmp_path / "replay")
        loaded = SkillGraphAgent.load(tmp_path / "agent")
        loaded.load_replay_buffer(tmp_path / "replay")
        loaded.set_parameters(tmp_path / "agent")
        del agent, loaded


def test_what_is_in_a_file_is_all_there(trained_files: tuple[Path, Path]) -> None:
    state = state_in(*trained_files)
    assert set(state["agent"]["parameters"]) >= {"policy", "actor.optimizer", "critic.optimizer"}
    assert len(state["replay"]["columns"]["action"]) == state["agent"]["progress"]["counters"]["num_timesteps"] >= 2000


class Untold(gym.Env):
    """A point in a square; episodes have so many steps, and nothing says so."""

    distance_threshold = 0.3

    def __init__(self, length: int = 30) -> None:
        self.length = length
        box = spaces.Box(-3.0, 3.0, (2,), np.float32)
        self.observation_space = spaces.Dict({"observation": box, "achieved_goal": box, "desired_goal": box})
        self.action_space = spaces.Box(-1.0, 1.0, (2,), np.float32)

    def reset(self, **kwargs: Any) -> Any:
        super().reset(**kwargs)
        self.n_steps = 0
        self.point, self.goal = self.np_random.uniform(-3, 3, (2, 2)).astype(np.float32)
        return self._seen(), {}

    def step(self, action: np.ndarray) -> Any:
        self.n_steps += 1
        self.point = np.clip(self.point + 0.1 * action, -3.0, 3.0).astype(np.float32)
        return self._seen(), 0.0, False, self.n_steps >= self.length, {}

    def _seen(self) -> dict[str, np.ndarray]:
        return {"observation": self.point, "achieved_goal": self.point, "desired_goal": self.goal}


def test_how_long_episodes_are_is_learned_where_the_environment_does_not_tell(tmp_path: Path) -> None:
    agent = new_agent(Untold())
    assert agent.parts.planner.horizon == 1_000
    agent.learn(100).save(tmp_path / "agent")
    for env in (None, Untold()):
        assert SkillGraphAgent.load(tmp_path / "agent", env=env).parts.planner.horizon == 30
    assert SkillGraphAgent.load(tmp_path / "agent", env=TimeLimit(Untold(), 20)).parts.planner.horizon == 20
    # Shorter ones, too, where another environment is given
    assert SkillGraphAgent.load(tmp_path / "agent", env=Untold(12)).learn(40).parts.planner.horizon == 12
    agent.set_env(Untold(10))
    assert agent.learn(40, reset_num_timesteps=False).parts.planner.horizon == 10


class Trail(gym.Wrapper):
    """Remembers where it has been, in its state: an array that grows."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.trail: list[np.ndarray] = []

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        self.trail.append(result[0]["achieved_goal"])
        return result

    def get_state(self) -> dict[str, Any]:
        return {**self.env.get_wrapper_attr("get_state")(), "trail": np.array(self.trail).reshape(-1, 2)}

    def set_state(self, state: dict[str, Any]) -> None:
        self.trail = list(state["trail"])
        self.env.get_wrapper_attr("set_state")({name: value for name, value in state.items() if name != "trail"})


def test_an_environments_state_may_grow(tmp_path: Path) -> None:
    agent = new_agent(Trail(gym.make(TOY))).learn(120)
    agent.save(tmp_path / "agent")
    for force_reset in (True, False):
        loaded = SkillGraphAgent.load(tmp_path / "agent", env=Trail(gym.make(TOY)), force_reset=force_reset)
        loaded.load_replay_buffer(saved_replay(agent, tmp_path))
        loaded.learn(10, reset_num_timesteps=False)
        (trail,) = loaded.get_env().get_attr("trail")
        assert len(trail) == 10 + (0 if force_reset else 120)
    assert agent.copy(Trail(gym.make(TOY))).num_timesteps == 120


def saved_replay(agent: SkillGraphAgent, folder: Path) -> Path:
    agent.save_replay_buffer(folder / "replay")
    return folder / "replay"


def test_what_was_saved_while_adapting_does_not_go_on_adapting(tmp_path: Path) -> None:
    agent = new_agent(seed=0).learn(300)
    goal = np.array([1.0, -1.0])

    def save(locals_: dict[str, Any], _: Any) -> bool:
        if agent.num_timesteps == 350:
            assert agent.parts.missions.pinned is not None
            agent.save(tmp_path / "agent")
        return True

    agent.adapt(goal, total_timesteps=100, callback=save)
    assert SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY)).parts.missions.pinned is None


def test_a_copy_leaves_the_process_as_it_was() -> None:
    agent = new_agent(seed=0, option_kwargs={"actor_learning_rate": lambda progress: 1e-3}).learn(150)
    before = (random.getstate(), np.random.get_state(), th.get_rng_state())  # noqa: NPY002
    agent.copy(gym.make(TOY))
    assert differences(before, (random.getstate(), np.random.get_state(), th.get_rng_state())) == []  # noqa: NPY002
