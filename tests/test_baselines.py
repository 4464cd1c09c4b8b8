"""What the agent is compared with: goals as scheduled, covering options that lead to the ends."""

import copy
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from conftest import TOY, new_agent
from stable_baselines3 import DDPG, HerReplayBuffer
from stable_baselines3.common.buffers import DictReplayBuffer

from sb3_skillgraph import evaluate_pairs
from sb3_skillgraph.baselines import (
    CoveringOptions,
    GoalSchedule,
    HindsightRecipe,
    NewGoals,
    OptionTask,
    RandomWalk,
    ReplaySearch,
    StraightOn,
    make_her,
    make_uvfa,
)
from sb3_skillgraph.baselines.covering_replay import TERMINATION_SHARE, LowEnd
from sb3_skillgraph.memory.replay import OptionRule
from sb3_skillgraph.metric import Ball
from sb3_skillgraph.options.learner import OptionTD3

CORRIDOR = [[1] * 6, [1, "r", 0, 0, 0, 1], [1] * 6]
SHORT_CORRIDOR: dict[str, Any] = {"maze_map": CORRIDOR, "max_steps": 60}
SMALL_NETS: dict[str, Any] = dict(buffer_size=5_000, policy_kwargs={"net_arch": [32, 32]}, batch_size=64, learning_rate=2e-3)


def toy(**kwargs: object) -> gym.Env:
    return gym.make(TOY, **{"terminate_on_success": True, **kwargs})


def test_a_goal_is_kept_for_some_episodes() -> None:
    env = GoalSchedule(toy(), 3)
    goals = [tuple(env.reset(seed=0 if i == 0 else None)[0]["desired_goal"]) for i in range(7)]
    assert goals[0] == goals[1] == goals[2] != goals[3] == goals[4] == goals[5] != goals[6]
    once = env.reset(options={"goal": [1.0, 1.0]})[0]["desired_goal"]
    np.testing.assert_array_equal(once, [1.0, 1.0])
    assert tuple(env.reset()[0]["desired_goal"]) == goals[6]


def test_the_goal_conditioned_baselines_give_up_when_stuck() -> None:
    for make in (make_uvfa, make_her):
        (env,) = make(Sinks(toy()), seed=0, buffer_size=100).get_env().envs
        env.reset(options={"start": [-1.0, 1.0], "goal": [1.0, 1.0]})
        assert [env.step(np.zeros(2, dtype=np.float32))[2] for _ in range(3)] == [False, False, True]


def test_the_goal_conditioned_baselines_are_sb3s_own() -> None:
    uvfa, her = make_uvfa(toy(), seed=0, goal_freq=5, buffer_size=2_000), make_her(toy(), seed=0, batch_size=64)
    assert type(uvfa) is type(her) is DDPG
    assert isinstance(her.replay_buffer, HerReplayBuffer)
    assert her.batch_size == 64
    for model in (uvfa, her):
        model.learn(1_100)
        assert model._n_updates > 20


def test_hindsight_reaches_goals() -> None:
    env = AnyStart(toy(maze_map=CORRIDOR, max_steps=60))
    model = make_her(env, seed=0, learning_starts=200, train_freq=(1, "step"), **SMALL_NETS).learn(600)
    assert evaluate_pairs(model, TOY, env_kwargs=SHORT_CORRIDOR, n_pairs=40).success_rate >= 0.6  # a random walk: below 0.2


class Sinks(gym.Wrapper):
    """Says that the agent is stuck after three steps, wherever it stands."""

    def reset(self, **kwargs: Any) -> Any:
        self.n_steps = 0
        return self.env.reset(**kwargs)

    def step(self, action: np.ndarray) -> Any:
        *step, info = self.env.step(action)
        self.n_steps += 1
        return *step, {**info, "stuck": self.n_steps == 3}


def test_a_baseline_is_paid_as_options_are_paid() -> None:
    task = OptionTask(Sinks(toy()), OptionRule(Ball(0.45), gamma=0.9, shaping=0.9))  # for each radius: 2 for each cell
    goal = np.array([1.0, 1.0])
    before = task.reset(seed=0, options={"start": [-1.0, 1.0], "goal": goal})[0]["achieved_goal"]
    for n_steps in (1, 2, 3):
        observation, reward, terminated, _, info = task.step(np.array([0.5, 0.0], dtype=np.float32))
        after = observation["achieved_goal"]
        left, now = np.linalg.norm(before - goal), np.linalg.norm(after - goal)
        assert terminated == (n_steps == 3)
        expected = 2.0 * left - 10.0 if terminated else 2.0 * (left - 0.9 * now) - 1.0
        assert reward == pytest.approx(expected, rel=1e-5)
        imagined = task.compute_reward(np.stack([after] * 2), np.stack([after, goal]), np.array([info] * 2))
        assert imagined[1] == pytest.approx(reward)
        assert imagined[0] == pytest.approx(2.0 * np.linalg.norm(after - before) + (-10.0 if terminated else 0.0), abs=1e-4)
        before = after


def test_uvfa_learns_where_chance_finds_goals() -> None:
    env = AnyStart(toy(maze_map=CORRIDOR))
    model = make_uvfa(env, seed=2, goal_freq=1, learning_starts=200, **SMALL_NETS).learn(2_000)
    assert evaluate_pairs(model, TOY, env_kwargs=SHORT_CORRIDOR, n_pairs=40).success_rate >= 0.35  # a random walk: below 0.2


def test_the_recipe_learns_without_a_graph() -> None:
    seen: list[int] = []
    recipe = HindsightRecipe(toy(), seed=0, learning_starts=300, batch_size=64).learn(3_000, seen.append)
    agent = recipe.agent
    assert seen == list(range(1, 3_001))
    assert agent.parts.store.total == 3_000
    assert agent.parts.walker.learner._n_updates == agent._n_updates == (3_000 - 300) // 2
    assert not agent.events and agent.graph.edges.size == 0
    assert isinstance(recipe.policy, StraightOn) and recipe.policy.agent is agent
    assert evaluate_pairs(recipe.policy, TOY, n_pairs=30, env_kwargs={"max_steps": 150}).success_rate >= 0.4


class Pits(gym.Wrapper):
    """Ends an episode for good after four steps, as a fall into a pit would: at no goal."""

    def reset(self, **kwargs: Any) -> Any:
        self.n_steps = 0
        return self.env.reset(**kwargs)

    def step(self, action: np.ndarray) -> Any:
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.n_steps += 1
        return observation, reward, terminated or self.n_steps == 4, truncated, info


def test_the_recipe_ends_episodes_at_goals_and_falls_but_knows_them_apart() -> None:
    store = HindsightRecipe(toy(), seed=0, learning_starts=10_000).learn(1_000).agent.parts.store
    last = np.flatnonzero(np.diff(store._trajectory[:1_000]))
    distance = np.linalg.norm(store.column("next_achieved_goal", last) - store.column("goal", last), axis=1)
    assert (distance <= 0.45).sum() >= 3
    assert not store.terminated(np.arange(1_000)).any(), "an end at the episode's own goal is no end for another"
    store = HindsightRecipe(Pits(toy()), seed=0, learning_starts=10_000).learn(40).agent.parts.store
    pits = np.flatnonzero(store.terminated(np.arange(40)))
    assert len(pits) >= 5
    assert not store.stuck(np.arange(40)).any()
    store = HindsightRecipe(Sinks(toy()), seed=0, learning_starts=10_000).learn(30).agent.parts.store
    falls = np.flatnonzero(store.stuck(np.arange(29)))
    assert len(falls) >= 5
    assert (np.diff(store._trajectory[:30])[falls] == 1).all()


def test_a_new_goal_is_pursued_where_the_last_one_was_reached_or_given_up() -> None:
    env = NewGoals(toy(terminate_on_success=False), n_steps=7)
    before, _ = env.reset(seed=0, options={"goal": [-1.0, 1.0]})
    np.testing.assert_array_equal(before["desired_goal"], [-1.0, 1.0])
    rng, steps, lengths, reached = np.random.default_rng(0), 0, [], 0
    for _ in range(300):
        after, _, terminated, truncated, _ = env.step(rng.uniform(-1.0, 1.0, 2).astype(np.float32))
        steps += 1
        there = np.linalg.norm(after["achieved_goal"] - before["desired_goal"]) <= 0.45
        changed = not np.array_equal(after["desired_goal"], before["desired_goal"])
        assert changed == (there or steps == 7)
        assert not terminated
        if changed:
            lengths.append(steps)
            reached, steps = reached + there, 0
        before = after
        if truncated:
            before, steps = env.reset()[0], 0
    assert max(lengths) == 7 and reached >= 3


def test_the_recipe_sees_no_end_where_its_goal_changes() -> None:
    env = NewGoals(toy(terminate_on_success=False), n_steps=20)
    store = HindsightRecipe(env, seed=0, learning_starts=10_000).learn(400).agent.parts.store
    goals = store.column("goal", np.arange(399))
    assert len(np.unique(goals, axis=0)) >= 20
    max_steps = int(env.get_wrapper_attr("max_steps"))
    assert np.flatnonzero(np.diff(store._trajectory[:400])).tolist() == list(range(max_steps - 1, 399, max_steps))
    assert not store.terminated(np.arange(400)).any()


def test_the_recipe_does_what_its_walker_does_where_there_is_no_noise() -> None:
    recipe = HindsightRecipe(toy(), seed=0, learning_starts=0, gradient_steps=0, action_noise=0.0)
    recipe.agent.parts.rollout.random_action_prob = 0.0
    recipe.learn(30)
    store, rows = recipe.agent.parts.store, np.arange(30)
    seen = {name: store.column(name, rows) for name in ("observation", "achieved_goal")}
    acted = recipe.policy.predict({**seen, "desired_goal": store.column("goal", rows)})[0]
    np.testing.assert_allclose(store.column("action", rows), acted, atol=1e-5)


def test_the_recipe_explores_under_the_noise_of_the_agent() -> None:
    recipe = HindsightRecipe(toy(), seed=0, learning_starts=100, gradient_steps=0, action_noise=0.2).learn(400)
    store, rows = recipe.agent.parts.store, np.arange(400)
    seen = {name: store.column(name, rows) for name in ("observation", "achieved_goal")}
    acted = recipe.policy.predict({**seen, "desired_goal": store.column("goal", rows)})[0]
    away = np.abs(store.column("action", rows) - acted).max(axis=1)
    assert np.median(away[:100]) > 0.5  # at first actions are random
    assert 0.05 < np.median(away[100:]) < 0.4
    assert (away[100:] > 0.7).mean() > 0.02  # and now and then later


def test_the_recipe_wants_updates_between_steps() -> None:
    with pytest.raises(ValueError, match="train_freq must be a number of steps"):
        HindsightRecipe(toy(), seed=0, train_freq=(1, "episode"))


def test_a_copy_of_the_recipe_leaves_the_recipe_alone() -> None:
    recipe = HindsightRecipe(toy(), seed=0, learning_starts=100, batch_size=16).learn(200)
    seen = toy().reset(seed=3)[0]
    before = recipe.policy.predict(seen)[0]
    twin = recipe.copy(toy())
    np.testing.assert_array_equal(twin.policy.predict(seen)[0], before)
    twin.learn(200)
    assert twin.agent.parts.store.total == 400
    assert recipe.agent.parts.store.total == 200
    assert not np.array_equal(twin.policy.predict(seen)[0], before)
    np.testing.assert_array_equal(recipe.policy.predict(seen)[0], before)


def test_straight_on_goes_where_the_walker_goes_whatever_the_graph_says(trained: Any) -> None:
    straight, rng = StraightOn(trained), np.random.default_rng(0)
    points, goals = (np.float32(rng.uniform(-1.5, 1.5, (8, 2))) for _ in range(2))
    batch = {"observation": points, "achieved_goal": points, "desired_goal": goals}
    actions, state = straight.predict(batch)
    assert state is None and actions.shape == (8, 2)
    np.testing.assert_array_equal(actions, trained.parts.walk(batch, goals))
    for i in range(8):
        one = straight.predict({key: value[i] for key, value in batch.items()})[0]
        np.testing.assert_allclose(one, actions[i], atol=1e-6)
    planned = np.stack([trained.predict({key: value[i] for key, value in batch.items()})[0] for i in range(8)])
    assert np.abs(planned - actions).max() > 0.1, "plans lead elsewhere at first"


def test_straight_on_knows_what_its_agent_learns() -> None:
    agent = new_agent(learning_starts=50)
    straight, seen = StraightOn(agent), toy().reset(seed=3)[0]
    before = straight.predict(seen)[0]
    agent.learn(150)
    assert not np.array_equal(straight.predict(seen)[0], before)


# -- search on the replay buffer --------------------------------------------------------------------------------------


def test_a_search_goes_from_state_to_state_to_the_goal(trained: Any) -> None:
    search = ReplaySearch(trained, 300, seed=0)
    here = {"observation": np.array([-1.0, -1.0], dtype=np.float32), "achieved_goal": np.array([-1.0, -1.0], dtype=np.float32)}
    far = np.array([1.0, 1.0], dtype=np.float32)
    way = search.plan(here["observation"], here["achieved_goal"], far)
    assert way, "one walk does not reach that far"
    places = [here["achieved_goal"], *search.places[way]]
    seen = [here["observation"], *search.observations[way]]
    legs = [search.steps(a, b, c)[0] for a, b, c in zip(seen, places, [*places[1:], far], strict=True)]
    assert max(legs) < trained.graph.walk_steps
    barred = np.array([[300, way[0]]])
    assert search.plan(here["observation"], here["achieved_goal"], far, barred) != way, "what was barred is planned around"


def test_a_search_reaches_most_of_what_its_agent_does(trained: Any) -> None:
    trained.learn(3000, reset_num_timesteps=False)
    search = ReplaySearch(trained, 300, seed=0)
    result = evaluate_pairs(search, TOY, n_pairs=20, seed=5)
    assert result.success_rate >= 0.7
    again = evaluate_pairs(search, TOY, n_pairs=20, seed=5)
    assert [pair.steps for pair in again.pairs] == [pair.steps for pair in result.pairs], "it keeps nothing between episodes"


def test_a_search_bars_a_leg_that_takes_too_long(trained: Any) -> None:
    search = ReplaySearch(trained, 300, seed=0)
    place = np.array([-1.0, -1.0], dtype=np.float32)
    seen = {"observation": place, "achieved_goal": place, "desired_goal": np.array([1.0, 1.0], dtype=np.float32)}
    state, barred = None, 0
    for _ in range(2 * trained.graph.walk_steps * 3):
        _, state = search.predict(seen, state)  # it stands before a wall: nothing it does moves it
        assert len(state[3]) >= barred
        barred = len(state[3])
    assert barred >= 2


def test_a_search_wants_a_replay_buffer(trained: Any) -> None:
    with pytest.raises(ValueError, match="states cannot be drawn from"):
        ReplaySearch(trained, 10**6)


class AnyStart(gym.Wrapper):
    """Begins episodes anywhere, so that chance alone explores the corridor."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        self.env.reset(seed=seed)
        start = self.get_wrapper_attr("sample_free")(self.get_wrapper_attr("np_random"))
        return self.env.reset(options={"start": start, **(options or {})})


STEPS = 2_500


@pytest.fixture(scope="module")
def covering() -> CoveringOptions:
    env = AnyStart(toy(maze_map=CORRIDOR))
    return CoveringOptions(env, n_options=2, option_updates=1_000, reach=10, batch_size=64, seed=0).learn(STEPS)


def test_covering_options_end_where_the_embedding_is_lowest(covering: CoveringOptions) -> None:
    assert [option.id for option in covering.options] == ["c0", "c1"]
    for option in covering.options:
        end = option.termination
        assert isinstance(end, LowEnd)
        rows = np.arange(covering.store.total)
        points = covering.store.column("achieved_goal", rows)
        assert end.holds(end.center)
        assert 0.0 < end.contains(points).mean() < 6 * TERMINATION_SHARE
        assert option.initiation.optimistic(points).all()


def test_a_covering_option_gets_there(covering: CoveringOptions) -> None:
    options, maze = covering.env, toy(maze_map=CORRIDOR)
    hits, ends = [], []
    for action, option in enumerate(covering.options):
        ends.append(float(option.subgoal[0]))
        for x in (-1.5, -0.5, 0.5, 1.5):
            observation, _ = maze.reset(options={"start": [x, 0.0], "goal": [0.0, 0.4]})
            run = options.begin(observation, action)
            for _ in range(40):
                observation = maze.step(options.act(run, observation))[0]
                if options.outcome(run, observation, 1):
                    break
            hits.append(bool(options.outcome(run, observation, 1)))
    assert min(ends) < -1.3
    assert max(ends) > 1.3
    assert np.mean(hits) >= 0.6


def test_a_goal_is_no_dead_end_for_covering_options_but_a_pit_is(covering: CoveringOptions) -> None:
    assert not covering.store.terminated(np.arange(covering.store.total)).any()
    learner = CoveringOptions(Pits(toy()), n_options=1, option_updates=5, reach=3, seed=0).learn(200)
    store, replay = learner.store, learner.options[0].learner.replay_buffer
    rows = copy.deepcopy(replay.rng).integers(0, store.total, 400)
    pits = store.terminated(rows)
    covered = learner.options[0].termination.contains(store.column("next_achieved_goal", rows))
    assert (pits & ~covered).sum() >= 5
    np.testing.assert_array_equal(replay.sample(400).dones[:, 0] == 1.0, pits | covered)


def test_steps_are_the_environments_and_decisions_fewer(covering: CoveringOptions) -> None:
    assert STEPS <= covering.num_timesteps < STEPS + covering.env.timeout
    assert covering.store.total == covering.num_timesteps
    assert covering.model.num_timesteps < covering.num_timesteps
    assert covering.model.exploration_rate == pytest.approx(0.1)
    assert covering.model._n_updates == pytest.approx(covering.num_timesteps / covering.train_freq, abs=covering.env.timeout)


def test_covering_options_reach_goals(covering: CoveringOptions) -> None:
    walk = RandomWalk(covering.env.unwrapped.action_space, seed=0)
    assert evaluate_pairs(walk, TOY, env_kwargs=SHORT_CORRIDOR, n_pairs=40).success_rate < 0.2
    assert evaluate_pairs(covering, TOY, env_kwargs=SHORT_CORRIDOR, n_pairs=40).success_rate >= 0.5


def test_an_ants_primitive_action_is_a_step_of_a_global_option() -> None:
    env = gym.make("SkillGraph/AntUMaze-v0", terminate_on_success=True, max_steps=100)
    untrained = CoveringOptions(env, n_options=2, option_updates=5, option_class=OptionTD3, shaping=1.0, batch_size=32, seed=0)
    before = copy.deepcopy(untrained.global_option.learner.policy.state_dict())
    learner = untrained.learn(700)
    assert [option.id for option in learner.options] == ["c0", "c1"]
    assert isinstance(learner.options[0].learner, OptionTD3)
    after = learner.global_option.learner.policy.state_dict()
    assert any(not th.equal(before[name], after[name]) for name in after)
    observation, _ = env.reset(seed=1)
    learner.env.reset(seed=1)
    assert learner.env.action_masks()[-2:].all()  # the global option, and a step of it
    step = learner.env.begin(observation, learner.env.action_space.n - 1)
    assert (step.option, step.timeout) == (learner.global_option, 1)
    twin = learner.copy(env)
    actions = [agent.predict(observation, deterministic=True)[0] for agent in (learner, twin)]
    np.testing.assert_array_equal(*actions)


def test_a_global_option_takes_half_of_the_updates_of_covering_options() -> None:
    env = gym.make("SkillGraph/AntUMaze-v0", terminate_on_success=True)
    learner = CoveringOptions(env, n_options=3, seed=0)
    assert learner._next_learner(0) is learner._next_learner(1) is learner.global_option
    learner.options.extend(learner._option(f"c{i}", learner.env, 1.0) for i in range(3))  # type: ignore[arg-type]
    took = [learner._next_learner(turn) for turn in range(60)]
    assert took.count(learner.global_option) == 30
    assert [took.count(option) for option in learner.options] == [10, 10, 10]


def test_covering_options_learn_on_from_where_the_environment_stands(covering: CoveringOptions) -> None:
    twin = covering.copy(AnyStart(toy(maze_map=CORRIDOR)))
    buffer, n_compared = twin.model.replay_buffer, 0
    assert isinstance(buffer, DictReplayBuffer)
    for _ in range(4):
        stored, steps = buffer.pos, twin.store.total
        twin.learn(40)
        if buffer.pos > stored:  # the first decision of this learning, and its first step
            begun = twin.store.column("achieved_goal", np.array([steps]))
            np.testing.assert_allclose(buffer.observations["achieved_goal"][stored], begun, atol=1e-6)
            n_compared += 1
    assert n_compared >= 2


def test_a_copy_of_covering_options_leaves_them_alone(covering: CoveringOptions) -> None:
    def known(learner: CoveringOptions) -> Any:
        parameters = learner.model.get_parameters()
        return parameters["policy"], parameters["policy.optimizer"]["state"]

    before = copy.deepcopy(known(covering))
    twin = covering.copy(AnyStart(toy(maze_map=CORRIDOR)))
    twin.learn(40)
    th.testing.assert_close(known(covering), before, rtol=0.0, atol=0.0)
    for was, now in zip(before, known(twin), strict=True):
        with pytest.raises(AssertionError):
            th.testing.assert_close(now, was, rtol=0.0, atol=0.0)


def test_learning_on_begins_a_new_trajectory() -> None:
    learner = CoveringOptions(toy(), n_options=1, option_updates=1, reach=10, seed=0).learn(150).learn(150)
    store, rows = learner.store, np.arange(299)
    trajectory = store.get_state()["trajectory"]
    same = trajectory[1:] == trajectory[:-1]
    assert not same[149]
    np.testing.assert_array_equal(
        store.column("achieved_goal", rows[same] + 1), store.column("next_achieved_goal", rows[same])
    )
