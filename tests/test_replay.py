import copy
from typing import Any

import numpy as np
import pytest
import torch as th
from builders import make_factory, profile
from conftest import differences
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st
from stable_baselines3.common.buffers import NStepReplayBuffer, ReplayBuffer
from stable_baselines3.common.type_aliases import ReplayBufferSamples

from sb3_skillgraph.envs import ToyMazeEnv
from sb3_skillgraph.events import Event
from sb3_skillgraph.memory.replay import OptionReplay, OptionRule, draw
from sb3_skillgraph.memory.store import TransitionStore
from sb3_skillgraph.metric import Ball
from sb3_skillgraph.options.env import OptionEnv
from sb3_skillgraph.options.views import ScaledView, relative_view

CAPACITY = 12
DOOMED_STEPS = 50  # an OptionReplay's own
#: One step of all environments: who is done, and whether the store is cut afterwards.
Step = tuple[list[bool], bool]
steps = st.lists(
    st.tuples(
        st.lists(st.integers(0, 3).map(lambda k: k == 0), min_size=3, max_size=3),
        st.integers(0, 7).map(lambda k: k == 0),
    ),
    min_size=1,
    max_size=25,
)


class Written:
    """A store filled step by step, and beside it what went in: every row's trajectory, by env and count."""

    def __init__(self, n_envs: int, capacity: int = CAPACITY) -> None:
        self.store = TransitionStore(capacity, 3, 2, 1, n_envs)
        self.n_envs = n_envs
        self.trajectory: list[tuple[int, int]] = []
        self._count = [0] * n_envs

    def add(self, done: list[bool], cut: bool) -> np.ndarray:
        n, first = self.n_envs, self.store.total
        numbers = np.arange(first, first + n, dtype=np.float32)[:, None]
        ended = np.array(done[:n])
        rows = self.store.add(
            np.repeat(numbers, 3, axis=1),
            np.repeat(numbers, 2, axis=1),
            np.repeat(numbers + 0.5, 3, axis=1),
            np.repeat(numbers + 0.5, 2, axis=1),
            numbers,
            np.repeat(-numbers, 2, axis=1),
            ended & (first % 2 == 0),
            ended,
        )
        for env in range(n):
            self.trajectory.append((env, self._count[env]))
            self._count[env] += done[env]
        if cut:
            self.store.cut()
            self._count = [count + 1 for count in self._count]
        return rows


@given(st.integers(1, 3), steps)
@profile(60)
def test_rows_keep_their_numbers_until_overwritten(n_envs: int, sequence: list[Step]) -> None:
    written = Written(n_envs)
    store = written.store
    for done, cut in sequence:
        rows = written.add(done, cut)
        np.testing.assert_array_equal(rows, np.arange(store.total - n_envs, store.total))
        assert len(store) == min(store.total, CAPACITY)
        assert store.oldest == store.total - len(store)
        readable = np.arange(store.oldest, store.total)
        np.testing.assert_array_equal(store.column("action", readable)[:, 0], readable)
        np.testing.assert_array_equal(store.column("observation", readable)[:, 2], readable)
        np.testing.assert_array_equal(store.column("next_achieved_goal", readable)[:, 1], readable + 0.5)
        np.testing.assert_array_equal(store.column("goal", readable)[:, 0], -readable)
    expected = [sequence[row // n_envs][0][row % n_envs] and row // n_envs * n_envs % 2 == 0 for row in readable]
    assert store.terminated(readable).tolist() == expected


@given(st.integers(1, 3), steps, st.integers(1, 6))
@profile(80)
def test_future_stays_on_the_trajectory(n_envs: int, sequence: list[Step], horizon: int) -> None:
    written = Written(n_envs)
    rng = np.random.default_rng(0)
    for done, cut in sequence:
        written.add(done, cut)
    store = written.store
    rows = np.arange(store.oldest, store.total)
    for _ in range(8):
        for row, later in zip(rows, store.future(rows, horizon, rng), strict=True):
            assert row <= later < store.total
            assert (later - row) % n_envs == 0
            assert (later - row) // n_envs < horizon
            assert written.trajectory[later] == written.trajectory[row]


@pytest.mark.parametrize("horizon", [1, 3, 100])
def test_future_reaches_everything_within_the_horizon(horizon: int) -> None:
    written = Written(2, capacity=40)
    for t in range(10):
        written.add([t == 6, t == 3, False], False)
    rng = np.random.default_rng(0)
    row = np.full(400, 4)  # step 2 of env 0, whose episode ends at step 6
    assert set(written.store.future(row, horizon, rng)) == set(range(4, 4 + 2 * min(horizon, 5), 2))


def test_after_a_cut_trajectories_do_not_mix() -> None:
    written = Written(2, capacity=40)
    for t in range(6):
        written.add([False] * 3, t == 2)
    rng = np.random.default_rng(0)
    early, late = np.arange(6), np.arange(6, 12)
    for _ in range(50):
        assert written.store.future(early, 100, rng).max() < 6
        assert written.store.future(late, 100, rng).max() >= 6


@given(st.integers(1, 3), steps, steps)
@profile(40)
def test_store_state_round_trip(n_envs: int, before: list[Step], after: list[Step]) -> None:
    written = Written(n_envs)
    for done, cut in before:
        written.add(done, cut)
    restored = Written(n_envs)
    restored.store.set_state(copy.deepcopy(written.store.get_state()))
    restored._count = [*written._count]
    for done, cut in after:
        written.add(done, cut)
        restored.add(done, cut)
    rows = np.arange(written.store.oldest, written.store.total)
    assert (restored.store.oldest, restored.store.total) == (written.store.oldest, written.store.total)
    for name in ("observation", "achieved_goal", "next_observation", "next_achieved_goal", "action", "goal"):
        np.testing.assert_array_equal(restored.store.column(name, rows), written.store.column(name, rows))
    np.testing.assert_array_equal(restored.store.terminated(rows), written.store.terminated(rows))
    draws = [w.store.future(rows, 10, np.random.default_rng(0)) for w in (written, restored)]
    np.testing.assert_array_equal(draws[0], draws[1])


@pytest.mark.parametrize(
    ("other", "named"),
    [
        (TransitionStore(24, 3, 2, 1, 2), "capacity"),
        (TransitionStore(12, 3, 2, 1, 1), "n_envs"),
        (TransitionStore(12, 4, 2, 1, 2), "observation"),
        (TransitionStore(12, 3, 3, 1, 2), "achieved_goal"),
    ],
)
def test_state_of_another_shape_is_refused(other: TransitionStore, named: str) -> None:
    with pytest.raises(ValueError, match=named):
        other.set_state(TransitionStore(12, 3, 2, 1, 2).get_state())


# -- an option's view -------------------------------------------------------------------------------------------------

RADIUS = 2.0
BALL = Ball(RADIUS)
EVENT = Event("e0", np.array([3.0, 3.0]), 3.0)
OBSERVATION_DIM = 1


def raw_view(observation: np.ndarray, achieved_goal: np.ndarray, goal: np.ndarray) -> np.ndarray:
    return np.concatenate([observation, achieved_goal, goal], axis=1).astype(np.float32)


class SpyStore(TransitionStore):
    """A store that objects to reading what has been overwritten or not yet written."""

    def column(self, name: str, rows: np.ndarray) -> np.ndarray:
        assert ((rows >= self.oldest) & (rows < self.total)).all()
        return super().column(name, rows)


def walked_store(
    capacity: int = 400, n_steps: int = 60, n_envs: int = 2, seed: int = 0, gets_stuck: bool = True
) -> TransitionStore:
    """Random walks; the action tells the row, the pursued goal is one that nothing ever achieves."""
    rng = np.random.default_rng(seed)
    store = SpyStore(capacity, OBSERVATION_DIM, 2, 1, n_envs)
    point = np.zeros((n_envs, 2))
    for t in range(n_steps):
        following = point + rng.normal(0.3, 1.5, point.shape)
        done = rng.random(n_envs) < 0.1
        number = np.arange(store.total, store.total + n_envs, dtype=np.float32)[:, None]
        terminated, stuck = done & (t % 3 > 0), done & (t % 3 == 2) & gets_stuck
        store.add(number, point, number, following, number, np.full((n_envs, 2), 1e4), terminated, done, stuck)
        point = np.where(done[:, None], 0.0, following)
    return store


def make_replay(store: TransitionStore, rule: OptionRule, **kwargs: Any) -> OptionReplay:
    return OptionReplay(
        store,
        raw_view,
        rule,
        spaces.Box(-np.inf, np.inf, (OBSERVATION_DIM + 4,), np.float32),
        spaces.Box(-1.0, 1.0, (1,), np.float32),
        np.random.default_rng(1),
        device="cpu",
        **kwargs,
    )


def check_relabelling(store: TransitionStore, samples: ReplayBufferSamples, *, n_ending_in_event: int) -> np.ndarray:
    """Recompute every sampled transition by hand.

    :param n_ending_in_event: how many, the first ones, end in the event unless their goal was imagined
    :return: which of those that do not soon get stuck were imagined
    """
    seen, following = samples.observations.numpy(), samples.next_observations.numpy()
    rows = samples.actions.numpy()[:, 0].astype(int)
    goals = seen[:, -2:]
    imagined = goals[:, 0] != 1e4
    np.testing.assert_array_equal(following[:, -2:], goals)
    for i, row in enumerate(rows):
        number = np.array([row])
        np.testing.assert_array_equal(seen[i, :-2], np.r_[row, store.column("achieved_goal", number)[0]])
        end = store.column("next_achieved_goal", number)[0]
        np.testing.assert_array_equal(following[i, :-2], np.r_[row, end])
        if imagined[i] or i >= n_ending_in_event:
            reached = np.linalg.norm(end - goals[i]) <= RADIUS
        else:
            reached = np.linalg.norm(end - EVENT.center) <= EVENT.metric.radius
        stuck = store.stuck(number)[0]
        assert samples.rewards[i, 0] == pytest.approx(-100.0 if stuck else 0.0 if reached else -1.0)
        assert samples.dones[i, 0] == float(reached or stuck or store.terminated(number)[0])
    achieved = {tuple(point) for point in store.column("next_achieved_goal", np.arange(store.oldest, store.total))}
    assert {tuple(goal) for goal in goals[imagined]} <= achieved
    doomed = np.isin(rows, soon_stuck(store))
    assert not imagined[doomed].any()
    return imagined[~doomed]


def soon_stuck(store: TransitionStore) -> list[int]:
    """Rows from which the agent gets stuck within ``DOOMED_STEPS`` steps, found by walking on from each."""
    found = []
    ends = store.get_state()["last_row"]
    trajectory = store.get_state()["trajectory"]
    for row in range(store.oldest, store.total):
        end = int(ends[trajectory[row - store.oldest]])
        if store.stuck(np.array([end]))[0] and end < row + DOOMED_STEPS * store.n_envs:
            found.append(row)
    return found


@pytest.mark.parametrize(("hindsight", "shared"), [(0.0, 0.0), (0.8, 0.0), (0.8, 0.5), (1.0, 0.0), (0.0, 1.0)])
def test_reward_and_end_follow_the_rule(hindsight: float, shared: float) -> None:
    store = walked_store()
    replay = make_replay(store, OptionRule(BALL, termination=EVENT), hindsight=hindsight, shared=shared)
    replay.add_rows(np.arange(10, 50))
    imagined = check_relabelling(store, replay.sample(300), n_ending_in_event=300 - int(300 * shared))
    expected = shared + (1.0 - shared) * hindsight
    assert abs(imagined.mean() - expected) <= (0.06 if 0 < hindsight < 1 and shared < 1 else 0.0)


def test_the_global_options_rule_is_the_distance_to_its_goal() -> None:
    store = walked_store()
    replay = make_replay(store, OptionRule(BALL), hindsight=0.6)
    samples = replay.sample(1500)
    imagined = check_relabelling(store, samples, n_ending_in_event=0)
    assert abs(imagined.mean() - 0.6) < 0.06
    assert set(samples.actions.numpy()[:, 0].astype(int)) == set(range(120))
    assert replay.size() == 120


@pytest.mark.parametrize("n_envs", [1, 2])
@pytest.mark.parametrize("doomed_steps", [0, 20, 50])
def test_no_goal_is_put_in_shortly_before_the_agent_gets_stuck(n_envs: int, doomed_steps: int) -> None:
    """It would have been achieved, so that the way there would look safe."""
    n_steps = 80
    store = SpyStore(3 * n_steps * n_envs // 2, OBSERVATION_DIM, 2, 1, n_envs)
    for t in range(2 * n_steps):  # walks that get stuck, half of the first overwritten; then walks that do not
        number = np.arange(t * n_envs, (t + 1) * n_envs, dtype=np.float32)[:, None]
        last = np.full(n_envs, t % n_steps == n_steps - 1)
        point, pursued = number.repeat(2, 1), np.full((n_envs, 2), 1e4)
        store.add(number, point, number, point, number, pursued, last, last, last & (t < n_steps))
    replay = make_replay(store, OptionRule(BALL), hindsight=1.0, doomed_steps=doomed_steps)
    samples = replay.sample(8000)
    kept = {int(row) for row, seen in zip(samples.actions[:, 0], samples.observations, strict=True) if seen[-1] == 1e4}
    assert kept == set(range(n_envs * (n_steps - min(doomed_steps, n_steps // 2)), n_envs * n_steps))


def test_both_outcomes_occur_in_the_walks() -> None:
    """The relabelling tests above see successes, failures and ends of both kinds."""
    store = walked_store()
    replay = make_replay(store, OptionRule(BALL, termination=EVENT), hindsight=0.0, shared=0.0)
    replay.add_rows(np.arange(0, 120))
    samples = replay.sample(1500)
    reached, done = samples.rewards.numpy() == 0.0, samples.dones.numpy() == 1.0
    outcomes = {(bool(r), bool(d)) for r, d in zip(reached, done, strict=True)}
    assert outcomes == {(False, False), (True, True), (False, True)}


@pytest.mark.parametrize("gamma", [0.9, 0.99])
@pytest.mark.parametrize("ending", ["reached", "stuck", "terminated", "going on"])
def test_shaping_changes_a_return_by_where_it_begins_alone(ending: str, gamma: float) -> None:
    """Whatever way is taken: so no policy is better or worse for it."""
    goal, n = np.array([3.0, -1.0]), 12
    plain, shaped = OptionRule(BALL, gamma=gamma), OptionRule(BALL, gamma=gamma, shaping=2.0)
    for seed in range(3):
        points = np.concatenate([np.zeros((1, 2)), np.random.default_rng(seed).normal(size=(n, 2))])
        last = np.arange(n) == n - 1
        flags = (last & (ending == "reached"), last & (ending != "going on"), last & (ending == "stuck"))
        step = (*flags, points[:-1], points[1:], np.tile(goal, (n, 1)))
        extra = (gamma ** np.arange(n)) @ (shaped.reward(*step) - plain.reward(*step))
        left = gamma**n * np.linalg.norm(points[-1] - goal) if ending == "going on" else 0.0
        assert extra + left == pytest.approx(np.linalg.norm(goal), rel=1e-4)  # 2 for a radius of 2


def test_getting_stuck_costs_what_standing_there_forever_would() -> None:
    points, yes = np.zeros((1, 2)), np.ones(1, dtype=bool)
    for gamma in (0.9, 0.99):
        reward = OptionRule(BALL, gamma=gamma).reward(~yes, yes, yes, points, points, points + 5.0)
        assert reward == pytest.approx(-sum(gamma**t for t in range(10_000)), rel=1e-4)
    assert np.isfinite(OptionRule(BALL, gamma=1.0).reward(~yes, yes, yes, points, points, points)).all()


@pytest.mark.parametrize("shared", [0.0, 0.25, 1.0])
def test_a_share_of_every_batch_comes_from_the_whole_store(shared: float) -> None:
    store = walked_store(gets_stuck=False)
    replay = make_replay(store, OptionRule(BALL, termination=EVENT), hindsight=0.0, shared=shared)
    replay.add_rows(np.array([3, 7, 11]))
    samples = replay.sample(200)
    own = samples.observations.numpy()[:, -1] == 1e4  # own rows keep their goal here, shared ones never do
    assert own.sum() == 200 - 200 * shared
    rows = samples.actions.numpy()[:, 0].astype(int)
    assert set(rows[own]) == (set() if shared == 1.0 else {3, 7, 11})
    assert shared == 0.0 or len(set(rows[~own])) > 20


def test_without_rows_of_its_own_an_option_learns_from_the_whole_store_in_hindsight() -> None:
    store = walked_store()
    replay = make_replay(store, OptionRule(BALL, termination=EVENT), hindsight=0.0, shared=0.5)
    assert replay.size() == 0
    assert check_relabelling(store, replay.sample(100), n_ending_in_event=0).all()


@given(st.lists(st.integers(1, 9), min_size=2, max_size=12), st.booleans())
@profile(30)
def test_a_view_never_reads_an_overwritten_row(turns: list[int], everything: bool) -> None:
    store = SpyStore(20, OBSERVATION_DIM, 2, 1, 1)
    replay = make_replay(store, OptionRule(BALL, termination=None if everything else EVENT))
    for k, n in enumerate(turns):
        for _ in range(n):
            number = np.full((1, 1), store.total, dtype=np.float32)
            point = np.full((1, 2), store.total, dtype=np.float32)
            no = np.zeros(1, dtype=bool)
            row = store.add(number, point, number, point, number, np.full((1, 2), 1e4), no, no)
            if k % 2 == 0:
                replay.add_rows(row)
        samples = replay.sample(16)
        rows = samples.actions.numpy()[:, 0].astype(int)
        assert ((rows >= store.oldest) & (rows < store.total)).all()
        np.testing.assert_array_equal(samples.observations.numpy()[:, 1], rows)
        assert replay.size() <= len(store)


def test_own_rows_are_kept_as_long_as_the_store_keeps_them() -> None:
    store = walked_store(capacity=60, n_steps=0)
    replay = make_replay(store, OptionRule(BALL, termination=EVENT), hindsight=0.0, shared=0.0)
    restored = make_replay(store, OptionRule(BALL, termination=EVENT), hindsight=0.0, shared=0.0)
    point, no = np.zeros((2, 2)), np.zeros(2, dtype=bool)
    for t in range(1_000):
        rows = store.add(point[:, :OBSERVATION_DIM], point, point[:, :OBSERVATION_DIM], point, point[:, :1], point, no, no)
        replay.add_rows(rows[:1])
        restored.add_rows(rows[:1])
        if t == 500:  # what was overwritten before tells nothing of what is kept later
            restored.set_state(restored.get_state())
        assert replay.size() == restored.size() == min(t + 1, 30)
    assert len(replay._rows) < 200
    np.testing.assert_array_equal(replay.get_state()["rows"], np.arange(1_940, 2_000, 2))
    np.testing.assert_array_equal(restored.get_state()["rows"], np.arange(1_940, 2_000, 2))


def test_replay_state_round_trip() -> None:
    store = walked_store(capacity=60, n_steps=100)
    replay = make_replay(store, OptionRule(BALL, termination=EVENT))
    replay.add_rows(np.arange(100, 180))
    restored = make_replay(store, OptionRule(BALL, termination=EVENT))
    restored.set_state(copy.deepcopy(replay.get_state()))
    assert restored.size() == replay.size() == 40  # rows 140 to 179 can still be read
    for one, other in zip(replay.sample(64), restored.sample(64), strict=True):
        assert (one is None and other is None) or th.equal(one, other)


def test_option_env_and_view_agree_on_the_same_transitions() -> None:
    env = ToyMazeEnv([[1] * 5, *[[1, 0, 0, 0, 1]] * 3, [1] * 5], terminate_on_success=True)
    event = Event("e0", np.array([1.0, 0.0]), 0.45)
    option_env = OptionEnv(env, event, timeout=15)
    rng = np.random.default_rng(0)
    store = TransitionStore(3000, 2, 2, 2)
    stepped = []
    for _ in range(60):
        option_env.reset(options={"start": np.zeros(2), "goal": np.array([0.0, 1.0])})
        raw = env._observe()
        for _ in range(15):
            action = rng.uniform(-0.7, 1, 2).astype(np.float32)
            following, reward, terminated, truncated, info = option_env.step(action)
            inner = env._observe()
            env_ended = bool(terminated and not info["is_success"])
            before, after = [raw["achieved_goal"][None]] * 2, [inner["achieved_goal"][None]] * 2
            store.add(*before, *after, action[None], event.center[None], np.array([env_ended]), np.array([env_ended]))
            stepped.append((action, following, reward, terminated))
            assert not (terminated and truncated)
            raw = inner
            if terminated or truncated:
                break
    rewards = [reward for _, _, reward, _ in stepped]
    assert {0.0, -1.0} == set(rewards)
    assert any(terminated and reward == -1.0 for _, _, reward, terminated in stepped)  # the environment ended it
    factory = make_factory(store, radius=event.metric.radius, hindsight=0.0, shared=0.0)
    replay = factory.make("o1", event.id, event).replay
    assert isinstance(replay.view, ScaledView)
    assert replay.view.function is relative_view
    replay.add_rows(np.arange(store.total))
    samples = replay.sample(3000)
    row_of = {tuple(action): row for row, (action, *_) in enumerate(stepped)}
    seen = set()
    for i, action in enumerate(samples.actions.numpy()):
        row = row_of[tuple(action)]
        seen.add(row)
        _, following, reward, terminated = stepped[row]
        assert samples.rewards[i, 0] == reward
        assert bool(samples.dones[i, 0]) == terminated
        np.testing.assert_allclose(samples.next_observations[i], following, atol=1e-5)
    assert {row for row, reward in enumerate(rewards) if reward == 0.0} & seen


@pytest.mark.parametrize("n_steps", [7, 70], ids=["filling", "full"])
@pytest.mark.parametrize("n_envs", [1, 3])
@pytest.mark.parametrize("kind", ["plain", "thrifty", "n steps", "option"])
def test_what_is_drawn_as_arrays_is_what_sample_returns(kind: str, n_envs: int, n_steps: int) -> None:
    buffer: ReplayBuffer
    if kind == "option":
        buffer = make_replay(walked_store(n_steps=n_steps, n_envs=n_envs), OptionRule(BALL))
    else:
        rng, thrifty = np.random.default_rng(0), kind == "thrifty"
        spec = 60, spaces.Box(-1, 1, (2, 2)), spaces.Box(-1, 1, (3,)), "cpu", n_envs, thrifty
        if kind == "n steps":
            buffer = NStepReplayBuffer(*spec, n_steps=3)
        else:
            buffer = ReplayBuffer(*spec, handle_timeout_termination=not thrifty)
        for _ in range(n_steps):
            seen, following = rng.normal(size=(2, n_envs, 2, 2))
            action, reward, done = rng.normal(size=(n_envs, 3)), rng.normal(size=n_envs), rng.random(n_envs) < 0.3
            buffer.add(seen, following, action, reward, done, [{"TimeLimit.truncated": bool(i % 2)} for i in range(n_envs)])
    twin = copy.deepcopy(buffer)
    before = np.random.get_state()  # noqa: NPY002
    samples = buffer.sample(20)
    after = np.random.get_state()  # noqa: NPY002
    np.random.set_state(before)  # noqa: NPY002
    arrays = draw(twin, 20, None)
    for ours, theirs in zip(arrays, samples, strict=True):
        assert (ours is None) == (theirs is None)
        if ours is not None and theirs is not None:
            np.testing.assert_array_equal(ours, theirs.numpy())
    assert differences(after, np.random.get_state()) == []  # noqa: NPY002
