"""Options as actions: the lifted environment, and Q-learning on it. The options are those of deep covering options."""

import copy
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
import torch as th
from builders import make_factory, make_option
from conftest import TOY, new_agent
from gymnasium import spaces
from sb3_contrib import MaskablePPO
from stable_baselines3.common.buffers import ReplayBuffer
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from sb3_skillgraph import OptionsEnv, SkillGraphAgent, SMDPQLearning
from sb3_skillgraph.events import Event
from sb3_skillgraph.memory.store import TransitionStore
from sb3_skillgraph.metric import Ball
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.smdp import FlatPolicy, GraphPolicy

GAMMA = 0.9
RADIUS = 0.45


class Towards:
    """Stands in for a policy that has learned: it goes straight to where it is to go.

    It is shown the observation, the achieved goal and, in radii, the way to the goal.
    """

    def act(self, seen: np.ndarray) -> np.ndarray:
        return np.clip(seen[:, -2:] * RADIUS / 0.25, -1.0, 1.0)


CENTERS = {"e0": (-1.0, 1.0), "e1": (0.0, 1.0), "e2": (1.0, 1.0), "e3": (1.0, 0.0)}


@pytest.fixture(scope="module")
def walker() -> Option:
    """The option that walks to any goal."""
    return made("global", None, None)


@pytest.fixture(scope="module")
def options(walker: Option) -> list[Option]:
    """Options along the upper half of the maze, from each event to its neighbours."""
    events = {id: Event(id, np.array(center), RADIUS) for id, center in CENTERS.items()}
    pairs = [("e0", "e1"), ("e1", "e2"), ("e2", "e3"), ("e3", "e2"), ("e2", "e1"), ("e1", "e0")]
    return [made(f"o{i}", to, events[to], start=(CENTERS[begin], 0.5)) for i, (begin, to) in enumerate(pairs)]


def made(id: str, target: str | None, termination: Event | None, **kwargs: Any) -> Option:
    option = make_option(id, target, termination, **kwargs)
    own = make_factory(TransitionStore(10, 2, 2, 2), radius=RADIUS).make(id, target, termination)
    option.learner, option.metric = own.learner, Ball(RADIUS)  # with a replay, whose view tells what it sees
    option.actor = Towards()  # type: ignore[assignment]
    return option


def lifted(options: list[Option], walker: Option | None, **kwargs: Any) -> OptionsEnv:
    env = gym.make(TOY, terminate_on_success=True, max_steps=200)
    return OptionsEnv(env, options, **{"gamma": GAMMA, "global_option": walker, **kwargs})


def reset_somewhere(env: OptionsEnv, rng: np.random.Generator) -> dict[str, np.ndarray]:
    sample = env.get_wrapper_attr("sample_free")
    return env.reset(options={"start": sample(rng), "goal": sample(rng)})[0]


# -- the environment --------------------------------------------------------------------------------------------------


class Steps(gym.Wrapper):
    """Notes the rewards of the wrapped environment."""

    rewards: list[float]

    def step(self, action: Any) -> Any:
        result = self.env.step(action)
        self.rewards.append(float(result[1]) + 1.0)  # lest most of them be 0
        return (result[0], self.rewards[-1], *result[2:])


def test_one_action_is_one_run_of_an_option(options: list[Option], walker: Option) -> None:
    steps = Steps(gym.make(TOY, max_steps=150))
    env = OptionsEnv(steps, options, gamma=GAMMA, global_option=walker)
    assert env.action_space == spaces.Discrete(64)
    rng, ran, n_successes = np.random.default_rng(0), set(), 0
    for _ in range(15):
        observation, over = reset_somewhere(env, rng), False
        while not over:
            assert observation in env.observation_space
            mask = env.action_masks()
            np.testing.assert_array_equal(mask, observation["action_mask"])
            action = int(rng.choice(np.flatnonzero(mask)))
            start, steps.rewards = observation["achieved_goal"], []
            observation, reward, terminated, truncated, info = env.step(action)
            over = terminated or truncated
            assert info["tau"] == len(steps.rewards) >= 1
            assert info["discount"] == pytest.approx(GAMMA ** info["tau"])
            assert reward == pytest.approx(sum(GAMMA**t * r for t, r in enumerate(steps.rewards)))
            ran.add(info["option"])
            if action < len(env.options):
                option = env.options[action]
                assert info["option"] == option.id
                assert option.initiation.optimistic(start[None])[0]
                assert info["tau"] <= env.timeout
                assert info["option_success"] == option.terminates(observation["achieved_goal"])
                n_successes += info["option_success"]
    assert {"global", "primitive 0", "primitive 4"} <= ran
    assert {option.id for option in options} <= ran
    assert n_successes > 10


def test_what_cannot_run_is_masked(options: list[Option], walker: Option) -> None:
    event = Event("e0", np.array([1.0, 1.0]), 0.45)
    some = [
        make_option("o1", "e0", event, start=((-1.0, 1.0), 0.5)),
        make_option("o2", "e0", event),  # gestates
        make_option("o3", "e0", event, start=((1.0, 1.0), 0.5)),  # ends where it starts
    ]
    env = OptionsEnv(gym.make(TOY), some, global_option=walker, max_options=16)
    with pytest.raises(ValueError, match="Call reset"):
        env.action_masks()
    always = np.arange(16) >= 10
    env.reset(options={"start": [-1.0, 1.0]})
    np.testing.assert_array_equal(env.action_masks(), always | (np.arange(16) == 0))
    env.reset(options={"start": [1.0, 1.0]})
    np.testing.assert_array_equal(env.action_masks(), always)
    with pytest.raises(ValueError, match="Action 1 cannot be taken here"):
        env.step(1)
    some.append(make_option("o4", "e0", event, start=((1.0, -1.0), 0.5)))  # born meanwhile
    env.reset(options={"start": [1.0, -1.0]})
    assert env.action_masks()[3]
    assert env.index("o4") == 3
    with pytest.raises(KeyError):
        env.index("o5")


def test_primitive_actions(options: list[Option], walker: Option) -> None:
    env = lifted(options, walker)
    assert len(env.primitives) == 5  # both directions of both axes, and standing still
    start = np.array([-1.0, 1.0])
    for i, move in enumerate([(1, 0), (0, 1), (-1, 0), (0, -1), (0, 0)]):
        env.reset(options={"start": start, "goal": [1.0, -1.0]})
        observation, _, _, _, info = env.step(env.first_fixed + 1 + i)
        np.testing.assert_allclose(observation["achieved_goal"] - start, 0.25 * np.array(move))
        assert (info["option"], info["tau"]) == (f"primitive {i}", 1)
    own = lifted(options, walker, primitives=np.array([[0.5, -0.5]]), max_options=len(options) + 2)
    own.reset(options={"start": start})
    np.testing.assert_allclose(own.step(own.max_options - 1)[0]["achieved_goal"] - start, [0.125, -0.125])


def test_one_step_of_the_global_policy_where_actions_have_many_dimensions(options: list[Option], walker: Option) -> None:
    class Legs(gym.ActionWrapper):
        """Eight numbers, the first two of which move."""

        action_space = spaces.Box(-1.0, 1.0, (8,), np.float32)

        def action(self, action: np.ndarray) -> np.ndarray:
            return action[:2]

    class Eastward:
        def act(self, seen: np.ndarray) -> np.ndarray:
            return np.tile([1.0, 0, 0, 0, 0, 0, 0, 0], (len(seen), 1))

    walker = make_option("global", None, None)
    walker.actor = Eastward()  # type: ignore[assignment]
    env = OptionsEnv(Legs(gym.make(TOY)), [], global_option=walker, max_options=8)
    assert len(env.primitives) == 1
    env.reset(options={"start": [-1.0, 1.0]})
    observation, _, _, _, info = env.step(7)
    np.testing.assert_allclose(observation["achieved_goal"], [-0.75, 1.0])
    assert info["tau"] == 1


def test_the_global_option_walks_to_the_goal(options: list[Option], walker: Option) -> None:
    env = lifted(options, walker)
    env.reset(options={"start": [-1.0, 1.0], "goal": [-1.0, 1.0 - 0.3]})
    _, reward, terminated, _, info = env.step(env.first_fixed)
    assert terminated
    assert info["option_success"]
    assert (info["tau"], reward) == (1, 1.0)


def test_what_it_refuses(options: list[Option], walker: Option) -> None:
    with pytest.raises(ValueError, match="needs a goal environment"):
        OptionsEnv(gym.make("CartPole-v1"), options)
    with pytest.raises(ValueError, match="neither primitive actions nor a global option"):
        OptionsEnv(gym.make(TOY), [], primitives=np.zeros((0, 2)))
    event = Event("e0", np.zeros(2), 0.45)
    many = [make_option(f"o{i}", "e0", event) for i in range(11)]
    with pytest.raises(ValueError, match=r"11 options and 6 actions .* max_options=16: give max_options=32"):
        OptionsEnv(gym.make(TOY), many, global_option=walker, max_options=16)
    with pytest.raises(ValueError, match="There is no global option"):
        OptionsEnv(gym.make(TOY), many).global_action  # noqa: B018


def test_the_global_option_may_be_missing(options: list[Option]) -> None:
    without = OptionsEnv(gym.make(TOY), list(options))
    without.reset(options={"start": [-1.0, 1.0], "goal": [-1.0, 0.7]})
    assert without.action_masks()[-5:].all()
    assert without.first_fixed == 59


def test_options_bring_along_what_their_policies_see(options: list[Option], walker: Option) -> None:
    """An option's action may be another one in another environment; what it does is the same."""
    whole, part = lifted(options, walker), lifted(options[2:], walker)
    for env in (whole, part):
        env.reset(seed=0, options={"start": options[2].initiation.core, "goal": [-1.0, -1.0]})
    there, here = whole.step(whole.index("o2")), part.step(0)
    assert there[-1]["option"] == here[-1]["option"] == "o2"
    assert there[-1]["option_success"] and there[-1]["tau"] > 1
    np.testing.assert_array_equal(there[0]["achieved_goal"], here[0]["achieved_goal"])
    with pytest.raises(ValueError, match="cannot be taken"):
        part.step(-1)


def test_monitor_counts_decisions_and_seeds_repeat(options: list[Option], walker: Option) -> None:
    def play(seed: int) -> list[Any]:
        env, rng = Monitor(lifted(options, walker)), np.random.default_rng(seed)
        observation, _ = env.reset(seed=seed)
        path, over, info = [observation["achieved_goal"].tolist()], False, {}
        while not over:
            action = int(rng.choice(np.flatnonzero(observation["action_mask"])))
            observation, _, terminated, truncated, info = env.step(action)
            path.append(observation["achieved_goal"].tolist())
            over = terminated or truncated
        assert info["episode"]["l"] == len(path) - 1
        return path

    assert play(1) == play(1) != play(2)


# -- high levels ------------------------------------------------------------------------------------------------------


def test_the_options_of_an_agent_are_actions(trained: SkillGraphAgent) -> None:
    env = OptionsEnv(gym.make(TOY, terminate_on_success=True, max_steps=200), trained.options, gamma=GAMMA)
    rng, ran = np.random.default_rng(0), set()
    for _ in range(5):
        observation, over = reset_somewhere(env, rng), False
        while not over:
            action = int(rng.choice(np.flatnonzero(observation["action_mask"])))
            observation, _, terminated, truncated, info = env.step(action)
            ran.add(info["option"])
            over = terminated or truncated
    assert ran & {option.id for option in trained.options}


def test_the_graph_plans_on_it(trained: SkillGraphAgent) -> None:
    """``GraphPolicy`` runs on an ``OptionsEnv`` the options that ``predict`` would run."""
    base = gym.make(TOY, terminate_on_success=True, max_steps=200)
    env, rng = OptionsEnv(gym.make(TOY, terminate_on_success=True, max_steps=200), trained.options), np.random.default_rng(0)
    policy = GraphPolicy(trained, env)
    for _ in range(5):
        where = {name: env.get_wrapper_attr("sample_free")(rng) for name in ("start", "goal")}
        lifted_observation, _ = env.reset(options=where)
        observation, _ = base.reset(options=where)
        over, state, flat_state = False, None, None
        while not over:
            action, state = policy.predict(lifted_observation, state)
            _, first = trained.predict(observation, flat_state)
            lifted_observation, _, terminated, truncated, info = env.step(action)
            assert trained.running(first) == [info["option"]]
            for _ in range(info["tau"]):
                move, flat_state = trained.predict(observation, flat_state)
                observation = base.step(move)[0]
            over = terminated or truncated
            np.testing.assert_array_equal(observation["achieved_goal"], lifted_observation["achieved_goal"])


def test_walks_keep_their_actions_when_events_are_merged(trained: SkillGraphAgent) -> None:
    env = OptionsEnv(gym.make(TOY), trained.options)
    before = [env.index(option.id) for option in trained.options]
    assert before == list(range(len(before)))
    assert env.max_options == 2 * trained.graph.max_events + 6  # the walk straight to the goal, and five primitives
    kept = {option.id: env.index(option.id) for option in trained.options}
    trained.graph.coarsen()
    new = trained.graph.add_event(np.array([5.0, 5.0]), salient=True)
    env.reset(seed=0, options={"start": [-1.0, 1.0], "goal": [1.0, -1.0]})
    assert all(env.index(option.id) == kept.get(option.id, len(before)) for option in trained.options)
    assert env.index(trained.graph.walk_ids[new]) == len(before)
    gone = [action for id, action in kept.items() if trained.graph.index(id) < 0]
    assert gone
    assert not env.action_masks()[gone].any()
    with pytest.raises(KeyError):
        env.index("w999")


def test_a_walk_can_be_taken_where_the_graph_has_an_edge_to_it(trained: SkillGraphAgent) -> None:
    env, graph = OptionsEnv(gym.make(TOY), trained.options), trained.graph
    for i, event in enumerate(trained.events):
        env.reset(options={"start": event.center, "goal": [1.0, -1.0]})
        there = {graph.walk_ids[target] for target in graph.edges.target[graph.edges.source == i].tolist()}
        assert there == {trained.options[action].id for action in np.flatnonzero(env.action_masks()[: len(trained.events)])}
        assert env.action_masks()[env.first_fixed :].all()


def test_a_stuck_walk_ends_the_episode(trained: SkillGraphAgent) -> None:
    class Trap(gym.Wrapper):
        """Catches at once."""

        def step(self, action: Any) -> Any:
            return (*self.env.step(action)[:-1], {"stuck": True, "is_success": False})

    env = OptionsEnv(Trap(gym.make(TOY)), trained.options, gamma=GAMMA)
    for action in (env.global_action, env.first_fixed + 1):
        env.reset(options={"start": [-1.0, 1.0], "goal": [1.0, -1.0]})
        _, _, terminated, _, info = env.step(action)
        assert terminated
        assert not info["option_success"]
        assert info["tau"] == 1


def test_walks_and_other_options_do_not_mix(trained: SkillGraphAgent, options: list[Option], walker: Option) -> None:
    for arguments in (([*trained.options, options[0]], None), (trained.options, walker), (trained.options[:2], None)):
        with pytest.raises(ValueError, match="go with no other options"):
            OptionsEnv(gym.make(TOY), arguments[0], global_option=arguments[1])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="not this agent's walks"):
        GraphPolicy(trained, lifted(options, walker))


def test_a_new_agents_walks_come_with_time() -> None:
    agent = new_agent()
    env = OptionsEnv(gym.make(TOY), agent.options)
    env.reset(seed=0)
    assert env.action_masks().sum() == 6
    agent.learn(400, log_interval=None)
    env.reset(seed=0)
    assert env.index(agent.options[-1].id) == len(agent.events) - 1


def test_one_step_of_the_walk_is_one_step_and_leaves_no_record(trained: SkillGraphAgent) -> None:
    env = OptionsEnv(gym.make(TOY), trained.options)
    env.primitives[-1] = None  # as where actions have many dimensions
    env.reset(options={"start": [-1.0, 1.0], "goal": [1.0, -1.0]})
    for n in range(1, 4):
        assert env.step(env.max_options - 1)[-1]["tau"] == 1
        assert (env.actions.state.option[0], env.actions.state.elapsed[0]) == ("", n)
    assert not env.actions.state.run_option.any()


def test_graph_policy_is_evaluated_as_any_policy(trained: SkillGraphAgent) -> None:
    env = Monitor(OptionsEnv(gym.make(TOY, terminate_on_success=True, max_steps=200), trained.options))
    policy: Any = GraphPolicy(trained, env.env)  # type: ignore[arg-type]
    assert evaluate_policy(policy, env, n_eval_episodes=3)[0] > 0.0


def test_a_flat_policy_over_walks_keeps_all_in_its_state(trained: SkillGraphAgent) -> None:
    env = OptionsEnv(gym.make(TOY), trained.options)
    flat, toy = FlatPolicy(Turns(), env), gym.make(TOY)
    episodes = [toy.reset(options={"start": start, "goal": [1.0, -1.0]})[0] for start in ([-1.0, 1.0], [1.0, 1.0])]
    first = flat.predict(episodes[0])[1]
    alone = flat.predict(episodes[0], first)[0]
    flat.predict(episodes[1])  # another episode in between
    np.testing.assert_array_equal(flat.predict(episodes[0], first)[0], alone)


class Turns:
    """A high level that takes what can be done in turns, and remembers in its state how often it has chosen."""

    def predict(
        self, observation: Any, state: Any = None, episode_start: Any = None, deterministic: bool = False
    ) -> tuple[np.ndarray, tuple[np.ndarray, ...]]:
        n_chosen = 0 if state is None else int(state[0][0])
        allowed = np.flatnonzero(observation["action_mask"])
        return allowed[7 * n_chosen % len(allowed)], (np.array([n_chosen + 1]),)


def test_a_flat_policy_does_one_step_at_a_time_what_the_options_environment_does(
    options: list[Option], walker: Option
) -> None:
    env, base = lifted(options, walker), gym.make(TOY, terminate_on_success=True, max_steps=200)
    policy = Turns()
    flat, rng, ran = FlatPolicy(policy, env), np.random.default_rng(3), set()
    for _ in range(5):
        where = {name: env.get_wrapper_attr("sample_free")(rng) for name in ("start", "goal")}
        observation, _ = env.reset(options=where)
        n_steps, over, state = 0, False, None
        while not over:
            action, state = policy.predict(observation, state)
            observation, _, terminated, truncated, info = env.step(action)
            ran.add(info["option"])
            n_steps, over = n_steps + info["tau"], terminated or truncated
        plain, _ = base.reset(options=where)
        over, flat_state = False, None
        for _ in range(n_steps):
            assert not over
            move, flat_state = flat.predict(plain, flat_state)
            plain, _, terminated, truncated, _ = base.step(move)
            over = terminated or truncated
        assert over
        np.testing.assert_array_equal(plain["achieved_goal"], observation["achieved_goal"])
    assert len(ran) > 6


def test_a_flat_policy_forgets_where_an_episode_begins(options: list[Option], walker: Option) -> None:
    env = lifted(options, walker)
    flat = FlatPolicy(Turns(), env)
    observation, _ = env.reset(options={"start": [-1.0, 1.0], "goal": [1.0, -1.0]})
    plain = {key: value for key, value in observation.items() if key != "action_mask"}
    _, state = flat.predict(plain)
    _, later = flat.predict(plain, state)
    _, anew = flat.predict(plain, later, np.array([True]))
    assert [int(each[1][0]) for each in (state, later, anew)] == [1, 2, 1]
    assert state[0].item().id == anew[0].item().id


class SmallSMDP(gym.Env):
    """Four states in a row, the last one the end: walk on in 1 step, or leap over one in 5; resting pays a little.

    Leaping cannot be done from the state before the end.
    """

    WALK, LEAP, REST = range(3)

    def __init__(self) -> None:
        self.observation_space = spaces.Dict(
            {"observation": spaces.Box(0.0, 1.0, (4,), np.float32), "action_mask": spaces.MultiBinary(3)}
        )
        self.action_space = spaces.Discrete(3)
        self.state = 0

    @classmethod
    def model(cls, state: int, action: int) -> tuple[int, float, int]:
        """Return the next state, the reward and how long it takes."""
        after = {cls.WALK: state + 1, cls.LEAP: state + 2, cls.REST: state}[action]
        reward = {cls.WALK: -1.0, cls.LEAP: -0.5, cls.REST: 0.05}[action] + 3.0 * (after == 3)
        return after, reward, {cls.WALK: 1, cls.LEAP: 5, cls.REST: 2}[action]

    def see(self) -> dict[str, np.ndarray]:
        mask = np.array([self.state < 3, self.state < 2, self.state < 3], dtype=np.int8)  # nothing where it is over
        return {"observation": np.eye(4, dtype=np.float32)[self.state], "action_mask": mask}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[dict[str, np.ndarray], Any]:
        super().reset(seed=seed)
        self.state = int(self.np_random.integers(3))
        return self.see(), {}

    def step(self, action: Any) -> tuple[dict[str, np.ndarray], float, bool, bool, dict[str, Any]]:
        assert self.see()["action_mask"][int(action)], "a masked action was taken"
        self.state, reward, tau = self.model(self.state, int(action))
        return self.see(), reward, self.state == 3, False, {"tau": tau, "discount": GAMMA**tau}


def exact() -> np.ndarray:
    """Return the optimal values of the small SMDP, shape (3, 3); minus infinity where an action is masked."""
    q = np.zeros((4, 3))
    for _ in range(500):
        values = np.append(np.where(np.arange(3)[:, None] + np.array([0, 1, 0]) < 3, q[:3], -np.inf).max(axis=1), 0.0)
        for state in range(3):
            for action in range(3):
                if action != SmallSMDP.LEAP or state < 2:
                    after, reward, tau = SmallSMDP.model(state, action)
                    q[state, action] = reward + GAMMA**tau * values[after]
    q[2, SmallSMDP.LEAP] = -np.inf
    return q[:3]


@pytest.mark.parametrize("n_envs", [1, 2])
def test_q_learning_finds_the_values_of_a_small_smdp(n_envs: int) -> None:
    env = DummyVecEnv([SmallSMDP for _ in range(n_envs)])
    model = SMDPQLearning(
        "MultiInputPolicy",
        env,
        learning_rate=lambda left: 0.05 * left,
        learning_starts=100,
        train_freq=1,
        batch_size=64,
        gamma=GAMMA,
        target_update_interval=20,
        exploration_initial_eps=1.0,
        exploration_final_eps=1.0,
        policy_kwargs={"net_arch": []},  # linear in a one-hot state: a table
        seed=0,
    ).learn(2_500 * n_envs)
    states = {"observation": np.eye(4, dtype=np.float32)[:3], "action_mask": np.array([[1, 1, 1], [1, 1, 1], [1, 0, 1]])}
    with th.no_grad():
        values = model.q_net({key: th.as_tensor(value) for key, value in states.items()}).numpy()
    np.testing.assert_allclose(values, exact(), atol=0.02)
    actions, _ = model.predict(states, deterministic=True)
    assert actions.tolist() == exact().argmax(axis=1).tolist()


def test_the_target_network_values_what_the_other_chooses() -> None:
    policy = SMDPQLearning("MultiInputPolicy", SmallSMDP(), seed=0, policy_kwargs={"net_arch": []}).policy
    with th.no_grad():
        for network, weights in ((policy.q_net, [[1.0, 2.0, 3.0]]), (policy.q_net_target, [[30.0, 20.0, 10.0]])):
            network.q_net[0].weight.copy_(th.tensor(weights).T.expand(3, 4))
            network.q_net[0].bias.zero_()
        masks = th.tensor([[1, 1, 1], [1, 1, 0], [1, 0, 0]])
        values = policy.q_net_target({"observation": th.eye(4)[:3], "action_mask": masks}).max(dim=1).values
    assert values.tolist() == [10.0, 20.0, 30.0]
    assert not any("followed" in name for name in policy.state_dict())


def test_q_learning_learns_on_options_and_is_saved(options: list[Option], walker: Option, tmp_path: Path) -> None:
    env = Monitor(lifted(options, walker))
    model = SMDPQLearning("MultiInputPolicy", env, learning_starts=50, train_freq=1, gamma=GAMMA, seed=0).learn(300)
    assert model._n_updates > 200
    assert (model.replay_buffer.discounts[:300] < GAMMA + 1e-6).all()  # type: ignore[union-attr]
    assert len(np.unique(model.replay_buffer.discounts[:300])) > 2  # type: ignore[union-attr]
    evaluate_policy(model, env, n_eval_episodes=3)
    model.save(tmp_path / "q")
    loaded = SMDPQLearning.load(tmp_path / "q", env=env)
    observation = env.reset(seed=0)[0]
    assert loaded.predict(observation, deterministic=True)[0] == model.predict(observation, deterministic=True)[0]
    loaded.learn(60, reset_num_timesteps=False)


def test_q_learning_without_masks_and_what_it_refuses() -> None:
    model = SMDPQLearning("MlpPolicy", "CartPole-v1", learning_starts=50, seed=0).learn(120)
    assert (model.replay_buffer.discounts == np.float32(model.gamma)).all()  # type: ignore[union-attr]
    with pytest.raises(ValueError, match="n_steps must be 1"):
        SMDPQLearning("MlpPolicy", "CartPole-v1", n_steps=3)
    with pytest.raises(ValueError, match="takes no replay_buffer_class"):
        SMDPQLearning("MlpPolicy", "CartPole-v1", replay_buffer_class=ReplayBuffer)


@pytest.mark.parametrize("of_an_agent", [False, True])
def test_maskable_ppo_trains_on_it(of_an_agent: bool, trained: SkillGraphAgent, options: list[Option], walker: Option) -> None:
    toy = gym.make(TOY, terminate_on_success=True, max_steps=200)
    env = Monitor(OptionsEnv(toy, trained.options, gamma=GAMMA) if of_an_agent else lifted(options, walker))
    model = MaskablePPO("MultiInputPolicy", env, n_steps=64, batch_size=32, n_epochs=2, seed=0)
    before = copy.deepcopy(model.policy.state_dict())
    model.learn(128)
    assert any(not th.equal(before[name], value) for name, value in model.policy.state_dict().items())
    observation, _ = env.reset(seed=0)
    action, _ = model.predict(observation, action_masks=env.get_wrapper_attr("action_masks")())
    assert observation["action_mask"][int(action)]
