"""What must hold of every agent, however little it has learned: one graph, whose plans are what happens (DESIGN)."""

import copy
import io
from collections.abc import Iterator
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3.common.env_util import make_vec_env

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.plan import Plan

TOY, U_MAZE, MEDIUM = "SkillGraph/ToyMaze-v0", "SkillGraph/PointMazeUMaze-v0", "SkillGraph/PointMazeMedium-v0"
SMALL: dict[str, Any] = dict(policy_kwargs=dict(net_arch=[16, 16]), batch_size=32, learning_starts=200, train_freq=1, seed=0)
#: Agents of every kind: barely trained, and trained; alone, and in four environments at once.
AGENTS = {
    "barely trained": (TOY, 300, 1),
    "barely trained in four": (TOY, 300, 4),
    "trained": (TOY, 3_000, 1),
    "trained in four": (TOY, 3_000, 4),
}
MUJOCO_AGENTS = {
    "U-maze, barely trained": (U_MAZE, 300, 1),
    "U-maze, trained in four": (U_MAZE, 3_000, 4),
    "Medium, trained": (MEDIUM, 2_000, 1),
}
MAX_STEPS = 80  # of an episode on the toy

th.set_num_threads(1)


def train(env_id: str, n_steps: int, n_envs: int, **kwargs: Any) -> SkillGraphAgent:
    agent = SkillGraphAgent(
        "MultiInputPolicy", make_vec_env(env_id, n_envs=n_envs, seed=0), **copy.deepcopy({**SMALL, **kwargs})
    )
    return agent.learn(n_steps, log_interval=None)


@pytest.fixture(scope="module")
def agents() -> dict[str, SkillGraphAgent]:
    return {name: train(*spec) for name, spec in AGENTS.items()}


@pytest.fixture(scope="module")
def mujoco_agents() -> dict[str, SkillGraphAgent]:
    return {name: train(*spec) for name, spec in MUJOCO_AGENTS.items()}


class Moment:
    """One step of an evaluation: what was seen, what was planned, and what was done."""

    def __init__(
        self, obs: dict[str, np.ndarray], state: Any, plan: Plan, action: np.ndarray, new_state: Any, option: str
    ) -> None:
        self.obs, self.state, self.plan, self.action, self.new_state, self.option = obs, state, plan, action, new_state, option


def episode(agent: SkillGraphAgent, env: gym.Env, seed: int) -> Iterator[Moment]:
    """Run a whole episode, planning at every step."""
    obs, _ = env.reset(seed=seed)
    state, over = None, False
    while not over:
        plan = agent.plan(obs, state=state)
        action, new_state = agent.predict(obs, state)
        assert new_state is not None
        (option,) = agent.running(new_state)
        yield Moment(obs, state, plan, action, new_state, option)
        state = new_state
        obs, _, terminated, truncated, _ = env.step(action)
        over = terminated or truncated


def check_plan(agent: SkillGraphAgent, moment: Moment, where: str) -> None:
    """A plan is a path of the graph, begins with the option that runs, and promises something."""
    path = moment.plan.path
    where = f"{where}: {moment.plan}, runs {moment.option}"
    assert moment.option, where
    assert path[0] == moment.option, where
    assert path[-2:] == ("direct", "goal"), where
    assert len(set(path)) == len(path), where
    graph = agent.graph
    for option, event in zip(path[:-2:2], path[1:-2:2], strict=True):
        assert option in graph.walk_ids, where
        assert graph.index(event) >= 0, where
    assert 0.0 < moment.plan.success_probability <= 1.0, where
    assert 0.0 <= moment.plan.expected_steps < np.inf, where
    assert moment.plan.status in ("in_graph", "in_initiation_set", "outside")


def check_episodes(agent: SkillGraphAgent, env_id: str, seeds: range, max_steps: int) -> int:
    """Run whole episodes; return in how many steps a plan was followed in which something had already failed."""
    env, after_failures = gym.make(env_id, max_steps=max_steps), 0
    for seed in seeds:
        for k, moment in enumerate(episode(agent, env, seed)):
            check_plan(agent, moment, f"episode {seed}, step {k}")
            after_failures += bool(moment.state is not None and (moment.state[-1][0] > 0).any() and not moment.state[-3].all())
        assert k + 1 == max_steps
    env.close()
    return after_failures


@pytest.mark.parametrize("name", AGENTS)
def test_the_plan_is_what_happens_at_every_step(agents: dict[str, SkillGraphAgent], name: str) -> None:
    assert check_episodes(agents[name], TOY, range(2), MAX_STEPS) > 0


@pytest.mark.mujoco
@pytest.mark.parametrize("name", MUJOCO_AGENTS)
def test_the_plan_is_what_happens_at_every_step_of_a_simulator(mujoco_agents: dict[str, SkillGraphAgent], name: str) -> None:
    check_episodes(mujoco_agents[name], MUJOCO_AGENTS[name][0], range(2), 100)


@pytest.mark.parametrize("name", AGENTS)
@settings(derandomize=True, deadline=None, max_examples=40, database=None)
@given(point=st.tuples(*[st.floats(-4.0, 4.0)] * 2), goal=st.tuples(*[st.floats(-40.0, 40.0)] * 2))
def test_there_is_a_path_from_anywhere_to_anywhere(
    agents: dict[str, SkillGraphAgent], name: str, point: tuple[float, float], goal: tuple[float, float]
) -> None:
    agent = agents[name]
    obs = {"observation": np.array(point), "achieved_goal": np.array(point), "desired_goal": np.array(goal)}
    plan = agent.plan(obs)
    _, state = agent.predict(obs)
    assert state is not None
    assert plan.path[0] == agent.running(state)[0]
    assert plan.path[-2:] == ("direct", "goal")
    assert len(set(plan.path)) == len(plan.path)
    assert 0.0 < plan.success_probability <= 1.0
    assert 0.0 <= plan.expected_steps < np.inf
    assert str(plan)
    other = agent.plan({**obs, "desired_goal": np.zeros(2)}, goal=np.array(goal))
    assert other == plan


# -- the graph --------------------------------------------------------------------------------------------------------


def check_graph(agent: SkillGraphAgent) -> None:
    graph, edges = agent.graph, agent.graph.edges
    assert len(graph.events) > 1
    assert edges.size > 0
    assert (edges.forward + edges.backward > 0).all()
    assert (edges.source != edges.target).all()
    assert (edges.crossing_steps[edges.forward > 0] <= agent.graph.walk_steps).all()
    assert (edges.crossing_steps >= 1).all()
    for column in (edges.successes, edges.failures, edges.success_steps, edges.landing_weight):
        assert (np.isfinite(column) & (column >= 0)).all()
    assert (edges.landing_weight.sum(axis=1) <= edges.failures + 1e-6).all()
    assert [option.id for option in agent.options] == graph.walk_ids
    assert [option.target for option in agent.options] == [event.id for event in agent.events]
    walks = agent.parts.planner.choice_model.walks()
    for stance in (1.0, 0.0, -0.5):
        rates = walks.success(stance)
        assert ((rates >= 0) & (rates <= 1)).all()
    assert (np.isfinite(walks.steps) & (walks.steps >= 1)).all()


@pytest.mark.parametrize("name", AGENTS)
def test_edges_stand_for_crossings_in_one_direction_or_the_other(agents: dict[str, SkillGraphAgent], name: str) -> None:
    check_graph(agents[name])


@pytest.mark.mujoco
@pytest.mark.parametrize("name", MUJOCO_AGENTS)
def test_edges_of_a_simulator_stand_for_crossings(mujoco_agents: dict[str, SkillGraphAgent], name: str) -> None:
    check_graph(mujoco_agents[name])


@pytest.mark.parametrize("n_envs", [1, 4])
def test_the_same_seed_gives_the_same_graph(agents: dict[str, SkillGraphAgent], n_envs: int) -> None:
    name = "barely trained" if n_envs == 1 else "barely trained in four"
    again, other = train(*AGENTS[name]), train(*AGENTS[name], seed=1)
    np.testing.assert_equal(again.graph.get_state(), agents[name].graph.get_state())
    np.testing.assert_equal(again.parts.model.get_state(), agents[name].parts.model.get_state())
    assert not np.array_equal(other.graph.centers, again.graph.centers)


def test_a_graph_that_is_full_is_still_sound() -> None:
    agent = train(TOY, 1_500, 2, max_events=8)
    assert 1 < len(agent.graph.events) <= 8
    assert agent.graph.cover_radius > 1.5 * agent.event_radius
    check_graph(agent)
    env = gym.make(TOY, max_steps=40)
    for moment in episode(agent, env, 0):
        assert moment.plan.path[-1] == "goal"
        assert moment.option


# -- the memory -------------------------------------------------------------------------------------------------------


class Recorder(gym.Wrapper):
    """Notes every transition as the environment made it."""

    def __init__(self, env: gym.Env) -> None:
        super().__init__(env)
        self.transitions: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def reset(self, **kwargs: Any) -> tuple[Any, dict[str, Any]]:
        self.last, info = self.env.reset(**kwargs)
        return self.last, info

    def step(self, action: np.ndarray) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        before = self.last["achieved_goal"].copy()
        self.last, *rest = self.env.step(action)
        self.transitions.append((before, np.array(action), self.last["achieved_goal"].copy()))
        return (self.last, *rest)


@pytest.mark.parametrize("n_envs", [1, 3])
def test_each_transition_is_in_the_store_once_and_in_order(n_envs: int) -> None:
    env = make_vec_env(TOY, n_envs=n_envs, seed=0, wrapper_class=Recorder)
    agent = SkillGraphAgent("MultiInputPolicy", env, **copy.deepcopy(SMALL)).learn(600, log_interval=None)
    agent.learn(90, log_interval=None, reset_num_timesteps=False)
    store = agent.parts.store
    assert len(store) == store.total == agent.num_timesteps >= 690
    for i in range(n_envs):
        transitions = env.env_method("get_wrapper_attr", "transitions", indices=i)[0]
        rows = np.arange(store.total)[i::n_envs]
        before, action, after = (np.array(column) for column in zip(*transitions, strict=True))
        np.testing.assert_allclose(store.column("achieved_goal", rows), before, atol=1e-6)
        np.testing.assert_allclose(store.column("next_achieved_goal", rows), after, atol=1e-6)
        np.testing.assert_allclose(agent.parts.unscale(store.column("action", rows)), action, atol=1e-6)


@pytest.mark.parametrize("name", AGENTS)
def test_the_store_holds_as_many_transitions_as_steps_were_taken(agents: dict[str, SkillGraphAgent], name: str) -> None:
    agent = agents[name]
    assert len(agent.parts.store) == agent.num_timesteps >= AGENTS[name][1]


@pytest.mark.parametrize("name", ["barely trained", "trained in four"])
def test_removing_the_trajectories_changes_no_action(agents: dict[str, SkillGraphAgent], name: str) -> None:
    agent, file = agents[name], io.BytesIO()
    agent.save(file)
    file.seek(0)
    loaded = SkillGraphAgent.load(file)
    assert len(loaded.parts.store) == 0
    known, saved = (either.parts.planner.choice_model.walks() for either in (loaded, agent))
    np.testing.assert_equal(tuple(known), tuple(saved))
    env = gym.make(TOY, max_steps=MAX_STEPS)
    state = None
    for moment in episode(agent, env, 0):
        plan = loaded.plan(moment.obs, state=state)
        action, state = loaded.predict(moment.obs, state)
        np.testing.assert_array_equal(action, moment.action)
        assert state is not None
        np.testing.assert_equal(tuple(state), tuple(moment.new_state))
        assert plan == moment.plan


# -- predict ----------------------------------------------------------------------------------------------------------


def generators(agent: SkillGraphAgent) -> list[Any]:
    return [agent.parts.rng.bit_generator.state, np.random.get_state(legacy=False), th.get_rng_state().numpy()]  # noqa: NPY002


def knowledge(agent: SkillGraphAgent) -> list[Any]:
    parts, learner = agent.parts, agent.parts.walker.learner
    networks = {name: tensor.numpy().copy() for name, tensor in learner.policy.state_dict().items()}
    rollout = parts.rollout.get_state()
    learned = [parts.graph.get_state(), parts.graph.version, parts.model.get_state(), rollout, parts.store.total, networks]
    return copy.deepcopy(learned)


@pytest.mark.parametrize("name", ["barely trained", "trained"])
def test_acting_and_planning_touch_no_generator_and_leave_everything_as_it_is(
    agents: dict[str, SkillGraphAgent], name: str
) -> None:
    agent, env = agents[name], gym.make(TOY, max_steps=40)
    before, known = copy.deepcopy(generators(agent)), knowledge(agent)
    for moment in episode(agent, env, 3):
        assert moment.option
    np.testing.assert_equal(generators(agent), before)
    np.testing.assert_equal(knowledge(agent), known)


def test_predict_is_a_function_of_observation_and_state(agents: dict[str, SkillGraphAgent]) -> None:
    agent, env = agents["trained"], gym.make(TOY, max_steps=40)
    moments = list(episode(agent, env, 5))
    for i in np.random.default_rng(0).permutation(len(moments)).tolist():
        moment = moments[i]
        kept = copy.deepcopy((moment.obs, moment.state))
        action, state = agent.predict(moment.obs, moment.state)
        np.testing.assert_array_equal(action, moment.action)
        np.testing.assert_equal(tuple(state or ()), tuple(moment.new_state))
        np.testing.assert_equal((moment.obs, moment.state), kept)
        assert agent.plan(moment.obs, state=moment.state) == moment.plan


def test_a_batch_acts_as_each_environment_does_alone(agents: dict[str, SkillGraphAgent]) -> None:
    agent = agents["trained"]
    envs = [gym.make(TOY, max_steps=200) for _ in range(3)]
    seen = [env.reset(seed=i)[0] for i, env in enumerate(envs)]
    together: Any = None
    alone: list[Any] = [None] * 3
    for k in range(50):
        batch = {key: np.stack([obs[key] for obs in seen]) for key in seen[0]}
        starts = np.array([k == 20, False, k == 33])
        actions, together = agent.predict(batch, together, episode_start=starts)
        for i, env in enumerate(envs):
            action, alone[i] = agent.predict(seen[i], alone[i], episode_start=starts[i : i + 1])
            np.testing.assert_allclose(actions[i], action, atol=1e-6)
            np.testing.assert_equal(tuple(column[0] for column in alone[i]), tuple(column[i] for column in together))
            seen[i] = env.step(action)[0]
        assert agent.running(together) == [agent.running(state)[0] for state in alone]
