"""The agent learns: on the NumPy maze, its zero-shot success is far above what no learning gives."""

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from builders import make_option, profile
from conftest import SMALL, TOY, Recorder, check_store, differences, new_agent, new_vec_env
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3 import DDPG, SAC, TD3
from stable_baselines3.common.noise import NormalActionNoise, OrnsteinUhlenbeckActionNoise
from stable_baselines3.common.type_aliases import TrainFrequencyUnit
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_skillgraph import OptionEnv, SkillGraphAgent
from sb3_skillgraph.envs import MazeMap
from sb3_skillgraph.evaluation import evaluate_pairs, run_pair
from sb3_skillgraph.events import Event
from sb3_skillgraph.options.factory import copy_policy
from sb3_skillgraph.options.learner import OptionTD3
from sb3_skillgraph.options.views import egocentric_view

ZIGZAG: MazeMap = [[1] * 7, [1, "r", 0, 0, 0, 0, 1], [1, 1, 1, 1, 1, 0, 1], [1, 0, 0, 0, 0, 0, 1], [1] * 7]


class RandomWalk:
    def __init__(self) -> None:
        self.rng = np.random.default_rng(0)

    def predict(self, observation: Any, *_: Any, **__: Any) -> tuple[np.ndarray, None]:
        return self.rng.uniform(-1, 1, 2).astype(np.float32), None


def test_reaches_goals_it_never_trained_on() -> None:
    agent = SkillGraphAgent(
        "MultiInputPolicy", gym.make(TOY), **{**SMALL, "policy_kwargs": dict(net_arch=[32, 32]), "seed": 1}
    )
    untrained = evaluate_pairs(agent, TOY, n_pairs=40).success_rate
    random = evaluate_pairs(RandomWalk(), TOY, n_pairs=40).success_rate
    agent.learn(3500, log_interval=None)
    trained = evaluate_pairs(agent, TOY, n_pairs=40)
    assert trained.success_rate > max(untrained, random) + 0.2
    assert trained.success_rate > 0.6
    # The graph covers the maze, and its plans are worth what they promise.
    free = gym.make(TOY).unwrapped.geometry
    points = np.array([free.sample_free(np.random.default_rng(i)) for i in range(200)])
    covered = [agent.graph.distances(point).min() <= agent.graph.cover_radius for point in points]
    assert np.mean(covered) > 0.9
    assert agent.graph_summary()["tried_edges"] > 3
    promised = np.mean([promise for promise, _ in trained.promises])
    assert abs(promised - trained.success_rate) < 0.3


@pytest.mark.parametrize("explore_beyond", [0.0, 5.0])
def test_explorations_go_past_a_random_point(explore_beyond: float) -> None:
    agent = new_agent(explore_beyond=explore_beyond)
    walks, past = 0, []

    def note(*_: Any) -> bool:
        nonlocal walks
        (mission,) = agent.parts.missions.current
        if mission.beyond is None:
            walks += mission.explore_steps > 0
        elif not mission.exploring:  # later it goes on from wherever it is
            past.append(float(np.linalg.norm(mission.beyond - mission.goal)))
        return True

    agent.learn(1500, callback=note)
    reach = explore_beyond * agent.event_radius
    assert walks
    assert min(past) >= reach
    assert len(set(past)) > 2
    assert min(past) < reach + 1.0


def test_finds_a_way_to_a_region_that_training_never_reached() -> None:
    """A door opens after training: adaptation looks for a way to the goal behind it, and old goals stay reachable."""
    shut: MazeMap = [[1] * 6, [1, "r", 0, 1, 0, 1], [1, 0, 0, 1, 0, 1], [1, 0, 0, 1, 0, 1], [1] * 6]
    opened: MazeMap = [*shut[:3], [1, 0, 0, 0, 0, 1], shut[4]]  # who walks straight on stands at the wall beside the door
    # A seed whose walker does not slip through the door by luck before it adapts, whatever the processor's last digits
    arguments = {**SMALL, "policy_kwargs": dict(net_arch=[32, 32]), "learning_rate": 2e-3, "seed": 8}
    agent = SkillGraphAgent("MultiInputPolicy", gym.make(TOY, maze_map=shut), **arguments)
    agent.learn(2500, log_interval=None)
    assert agent.graph.centers[:, 0].max() < 0.5
    env = gym.make(TOY, maze_map=opened, terminate_on_success=True)
    old, new = np.array([-0.5, -1.0]), np.array([1.5, 1.0])
    before = success_rate(agent, env, new)
    assert before < 0.5
    agent.set_env(new_vec_env(TOY, 1, maze_map=opened))  # seeded
    agent.adapt(new, total_timesteps=5000)  # half of it is enough as a rule, whatever the processor's rounding
    assert success_rate(agent, env, new) > before + 0.4
    assert success_rate(agent, env, old) == 1.0


def success_rate(agent: SkillGraphAgent, env: gym.Env, goal: np.ndarray) -> float:
    """From every cell of the left room of the maze with the door."""
    env.reset(seed=0)
    starts = [np.array([x, y]) for x in (-1.5, -0.5) for y in (-1.0, 0.0, 1.0)]
    return float(np.mean([run_pair(agent, env, start, goal, np.nan).success for start in starts]))


@pytest.mark.parametrize(
    ("option_class", "extra"),
    [(TD3, {}), (SAC, {}), (OptionTD3, {}), (DDPG, dict(learning_rate=lambda left: 1e-3 * left))],
    ids=["TD3", "SAC", "OptionTD3", "DDPG with a schedule"],
)
def test_other_option_classes_learn(option_class: type, extra: dict[str, Any]) -> None:
    agent = new_agent(option_class=option_class, learning_starts=100, **extra)
    before = {name: value.clone() for name, value in agent.policy.state_dict().items()}
    agent.learn(500)
    assert isinstance(agent.parts.walker.learner, option_class)
    assert all(option.learner is agent.parts.walker.learner for option in agent.options)
    after = agent.policy.state_dict()
    assert any(not th.equal(before[name], after[name]) for name in before if "actor" in name)
    assert all(th.isfinite(value).all() for value in after.values())


def actions_with(noise: Any, n_envs: int = 1) -> np.ndarray:
    """What an agent does that acts on without learning, and without random actions once the first walks are over."""
    agent = new_agent(new_vec_env(n_envs=n_envs), action_noise=noise, learning_starts=0, gradient_steps=0)
    agent.parts.rollout.random_action_prob = 0.0
    agent.learn(260)
    return agent.parts.store.get_state()["columns"]["action"]


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("noise_class", [NormalActionNoise, OrnsteinUhlenbeckActionNoise])
def test_action_noise_is_what_explores(noise_class: type, n_envs: int) -> None:
    strong, none = (actions_with(noise_class(np.zeros(2), sigma * np.ones(2)), n_envs) for sigma in (0.5, 0.0))
    assert not np.array_equal(strong, none)
    assert np.abs(strong).max() <= 1.0
    assert len(strong) == 260


def test_action_noise_may_be_a_number() -> None:
    strong, weak, none = (actions_with(deviation) for deviation in (0.5, 0.1, 0.0))
    assert not np.array_equal(strong, weak)
    assert not np.array_equal(weak, none)
    np.testing.assert_array_equal(actions_with(0.5), strong)


@pytest.mark.parametrize(
    "arguments",
    [
        dict(train_freq=(1, "episode"), gradient_steps=-1),
        dict(train_freq=8, gradient_steps=8),
        dict(gradient_steps=0),
        dict(hindsight=0.0),
        dict(hindsight=1.0, shaping=1.0, goal_tolerance=1.0),
        dict(salience="rrt", explore_beyond=3.0),
        dict(max_events=8, walk_steps=5),
        dict(buffer_size=100),
        dict(option_view="egocentric", event_radius=0.3),
        dict(exploration_steps=1),
        dict(skills="always"),
        dict(skills="where_needed"),
    ],
    ids=lambda arguments: next(iter(arguments)),
)
def test_arguments_work_together(arguments: dict[str, Any]) -> None:
    agent = new_agent(learning_starts=100, **arguments).learn(450)
    assert agent.num_timesteps >= 450
    assert agent.parts.store.total == agent.num_timesteps
    per_step = agent.train_freq.unit == TrainFrequencyUnit.STEP
    n_expected = 0 if agent.gradient_steps == 0 else agent.num_timesteps - 100
    assert abs(agent._n_updates - n_expected) <= (8 if per_step else 100)
    assert len(agent.events) <= agent.graph.max_events


def test_salience_may_be_an_object() -> None:
    corners = [[-1.0, -1.0], [1.0, 1.0], [1.0, -1.0]]

    class Corners:
        def propose(self, rng: np.random.Generator) -> np.ndarray:
            return np.array(corners)[rng.integers(3)]

    agent, aims = new_agent(salience=Corners()), set()

    def note(*_: Any) -> bool:
        (mission,) = agent.parts.missions.current
        if mission.beyond is not None:
            aims.add(tuple(mission.beyond))
        return True

    agent.learn(1500, callback=note)
    assert aims <= {tuple(corner) for corner in corners}
    assert len(aims) > 1
    for event in agent.events:
        assert not event.salient or np.linalg.norm(event.center - corners, axis=1).min() <= agent.event_radius


def test_another_maze_and_another_range_of_actions() -> None:
    env = Recorder(gym.wrappers.RescaleAction(gym.make(TOY, maze_map=ZIGZAG), np.float32(2.0), np.float32(6.0)))
    agent = new_agent(env).learn(600)
    actions = np.array([step["action"] for step in env.transitions])
    assert actions.min() >= 2.0
    assert actions.max() <= 6.0
    assert actions.max() - actions.min() > 3.0
    check_store(agent, env.transitions)
    obs, _ = env.reset()
    assert agent.action_space.contains(agent.predict(obs)[0])


class Space(gym.Env):
    """A goal of three dimensions, an observation of two by three, and perhaps an entry that nobody asked for."""

    distance_threshold = 0.3

    def __init__(self, extra: bool = False) -> None:
        point = spaces.Box(-np.inf, np.inf, (3,), np.float64)
        observation = spaces.Box(-np.inf, np.inf, (2, 3), np.float64)
        entries = dict(observation=observation, achieved_goal=point, desired_goal=point)
        self.observation_space = spaces.Dict(
            {**entries, **({"clock": spaces.Box(0.0, 51.0, (1,), np.float32)} if extra else {})}
        )
        self.action_space = spaces.Box(-1.0, 1.0, (3, 1), np.float32)

    def _observe(self) -> dict[str, Any]:
        state = np.stack([self.position, self.velocity])
        entries = dict(
            observation=state,
            achieved_goal=self.position.copy(),
            desired_goal=self.goal,
            clock=np.full(1, self.clock, np.float32),
        )
        return {key: entries[key] for key in self.observation_space.spaces}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.position, self.velocity, self.clock = np.zeros(3), np.zeros(3), 0
        self.goal = self.np_random.uniform(-1, 1, 3)
        return self._observe(), {}

    def step(self, action: np.ndarray) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.velocity = 0.2 * np.asarray(action, dtype=np.float64).ravel()
        self.position = np.clip(self.position + self.velocity, -1.0, 1.0)
        self.clock += 1
        return self._observe(), 0.0, False, self.clock == 50, {}


@pytest.mark.parametrize("extra", [False, True])
def test_goals_of_three_dimensions(tmp_path: Any, extra: bool) -> None:
    env = Space(extra)
    agent = new_agent(env).learn(600)
    assert agent.event_radius == 0.3
    assert all(event.center.shape == (3,) for event in agent.events)
    assert len(agent.options) > 3
    agent.save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent", env=Space(extra))
    obs, _ = env.reset()
    action, _ = loaded.predict(obs)
    assert action.shape == (3, 1)
    assert np.array_equal(action, agent.predict(obs)[0])
    assert loaded.learn(100, reset_num_timesteps=False).num_timesteps == 700


# -- every transition is in the store exactly once --------------------------------------------------------------------


@profile(8)
@given(
    n_envs=st.integers(1, 3),
    calls=st.lists(st.tuples(st.integers(1, 70), st.booleans(), st.integers(1, 90)), min_size=1, max_size=4),
    max_steps=st.integers(5, 40),
)
def test_every_transition_is_in_the_store_once(n_envs: int, calls: list[tuple[int, bool, int]], max_steps: int) -> None:
    recorders = [Recorder(gym.make(TOY, max_steps=max_steps)) for _ in range(n_envs)]
    agent = new_agent(DummyVecEnv([lambda env=env: env for env in recorders]), learning_starts=30)
    for n_steps, reset_num_timesteps, stop_at in calls:
        counter = iter(range(1, 1000))
        stopped = False

        def callback(*_: Any, counter: Any = counter, stop_at: int = stop_at) -> bool:
            nonlocal stopped
            stopped = next(counter) == stop_at
            return not stopped

        n_before = agent.parts.store.total
        agent.learn(n_steps, callback=callback, reset_num_timesteps=reset_num_timesteps)
        if stopped:
            for recorder in recorders:
                del recorder.transitions[-1]
        assert stopped or agent.parts.store.total > n_before or not reset_num_timesteps
        for i, recorder in enumerate(recorders):
            check_store(agent, recorder.transitions, i)


# -- OptionEnv --------------------------------------------------------------------------------------------------------


def option_env(**kwargs: Any) -> tuple[OptionEnv, Recorder]:
    base = Recorder(gym.make(TOY, max_steps=50))
    return OptionEnv(base, Event("east", np.array([1.0, 1.0]), 0.45), **kwargs), base


def test_option_env_is_a_wrapper_with_a_flat_space() -> None:
    env, base = option_env()
    assert isinstance(env, gym.Wrapper)
    assert env.observation_space.shape == (6,)
    assert env.observation_space.dtype == np.float32
    obs, info = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    assert info["can_start"]
    assert env.unwrapped is base.unwrapped


def test_option_env_shows_what_it_is_told_to() -> None:
    assert option_env(option_view="egocentric")[0].view.function is egocentric_view
    with pytest.raises(ValueError, match="Unknown option_view 'nose'"):
        option_env(option_view="nose")


def test_option_env_pays_and_ends_by_the_option() -> None:
    env, _ = option_env()
    env.reset(seed=0)
    rewards, over = [], False
    while not over:
        _, reward, terminated, truncated, info = env.step(np.array([1.0, 0.0], dtype=np.float32))
        rewards.append(reward)
        over = terminated or truncated
    assert terminated
    assert not truncated
    assert info["is_success"]
    assert rewards == [-1.0] * (len(rewards) - 1) + [0.0]
    assert 4 <= len(rewards) <= 8  # two cells, less the radius, a quarter cell a step


def test_option_env_goes_on_where_the_last_run_ended() -> None:
    env, base = option_env(timeout=5)
    env.reset(seed=0)
    still = np.array([-0.01, 0.0], dtype=np.float32)
    for run in range(10):
        for step in range(5):
            obs, reward, terminated, truncated, _ = env.step(still)
            assert (reward, terminated, truncated) == (-1.0, False, step == 4)
        n_resets = 1 + (run == 9)  # after 50 steps the episode of the maze is over
        again, _ = env.reset()
        assert len(base.starts) == n_resets
        assert np.array_equal(obs, again) == (run < 9)
    env.reset(seed=1)
    assert len(base.starts) == 3
    env.reset(options={"start": [1.0, -1.0]})
    assert len(base.starts) == 4
    np.testing.assert_array_equal(base.starts[-1], [1.0, -1.0])


@pytest.mark.parametrize("option_class", [OptionTD3, SAC])
def test_an_option_that_copies_another_goes_on_learning_like_it(option_class: Any) -> None:
    agent = new_agent(option_class=option_class).learn(800)
    source = agent.parts.walker
    assert source.learner.actor.optimizer.state_dict()["state"]
    twins = [agent.parts.factory.make(id, None, None) for id in ("one", "two")]
    for twin in twins:
        copy_policy(source, twin)
    before = [copy.deepcopy(learner.get_parameters()) for learner in (source.learner, twins[1].learner)]
    assert differences(*before) == []
    observation = source.replay.sample(1).observations.numpy()
    np.testing.assert_array_equal(source.actor.act(observation), twins[0].actor.act(observation))
    steps = twins[0].learner.actor.optimizer.state_dict()["state"][0]["step"].item()
    twins[0].learner.train(4, 64)
    assert twins[0].learner.actor.optimizer.state_dict()["state"][0]["step"].item() > steps
    # Nothing is shared: the source and the other copy are as they were.
    assert differences([source.learner.get_parameters(), twins[1].learner.get_parameters()], before) == []


def test_option_env_is_truncated_with_its_environment() -> None:
    env, _ = option_env(timeout=200)
    env.reset(seed=0)
    ends = [env.step(np.zeros(2, dtype=np.float32))[2:4] for _ in range(50)]
    assert ends == [(False, False)] * 49 + [(False, True)]


def test_option_env_leads_into_the_initiation_set_of_an_option() -> None:
    parent = make_option("o1", "e0", Event("e0", np.array([1.0, 1.0]), 0.45), start=((-0.5, 1.0), 0.4))
    env = OptionEnv(gym.make(TOY), parent, initiation=parent.initiation)
    _, info = env.reset(options={"start": parent.initiation.core})
    assert info["can_start"]
    _, reward, terminated, _, info = env.step(np.zeros(2, dtype=np.float32))
    assert (reward, terminated, info["is_success"]) == (0.0, True, True)
    _, info = env.reset(options={"start": np.array([1.0, 0.0])})
    assert not info["can_start"]
    assert env.step(np.zeros(2, dtype=np.float32))[1:3] == (-1.0, False)


def test_option_env_takes_a_walk(trained: SkillGraphAgent) -> None:
    walk = trained.options[0]
    env = OptionEnv(gym.make(TOY), walk)
    obs, _ = env.reset(options={"start": walk.subgoal})
    action, _ = walk.learner.predict(obs, deterministic=True)
    assert env.step(action)[2]


def test_sb3_learns_on_option_env() -> None:
    env, base = option_env()
    model = DDPG("MlpPolicy", env, seed=0, learning_starts=300, policy_kwargs=dict(net_arch=[32, 32]), batch_size=64)
    model.learn(1500)
    assert 10 <= len(base.starts) <= 32
    obs, _ = env.reset(seed=5)
    for _ in range(20):
        obs, _, terminated, _, _ = env.step(model.predict(obs, deterministic=True)[0])
        if terminated:
            break
    assert terminated
