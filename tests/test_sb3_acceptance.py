"""SB3's own acceptance tests, re-expressed for SkillGraphAgent: it behaves as any SB3 algorithm does."""

import csv
import io
import warnings
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from conftest import (
    EAGER,
    POINT,
    TOY,
    Recorder,
    check_store,
    differences,
    in_new_process,
    new_agent,
    new_vec_env,
    state_in,
    state_of,
    without_clock,
)
from stable_baselines3 import TD3
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
    CheckpointCallback,
    EvalCallback,
    EveryNTimesteps,
    LogEveryNTimesteps,
    StopTrainingOnMaxEpisodes,
    StopTrainingOnNoModelImprovement,
    StopTrainingOnRewardThreshold,
)
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.evaluation import evaluate_policy
from stable_baselines3.common.logger import configure
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.type_aliases import TrainFreq, TrainFrequencyUnit
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecFrameStack

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.running import RunnerState


class Counting(BaseCallback):
    """Counts what is called, and looks at what a callback is shown; may stop."""

    def __init__(self, stop_at: int | None = None) -> None:
        super().__init__()
        self.stop_at = stop_at
        self.calls: list[str] = []

    def _on_training_start(self) -> None:
        assert {"total_timesteps", "tb_log_name"} <= set(self.locals)
        self.calls.append("training_start")

    def _on_rollout_start(self) -> None:
        self.calls.append("rollout_start")

    def _on_step(self) -> bool:
        assert {"new_obs", "dones", "rewards", "infos", "actions"} <= set(self.locals)
        assert len(self.locals["dones"]) == self.model.n_envs
        assert self.training_env is self.model.get_env()
        self.calls.append("step")
        return self.n_calls != self.stop_at

    def _on_rollout_end(self) -> None:
        self.calls.append("rollout_end")

    def _on_training_end(self) -> None:
        self.calls.append("training_end")


def one_observation(goal: tuple[float, float] = (1.0, 1.0)) -> dict[str, np.ndarray]:
    return {"observation": np.array([-1.0, 1.0]), "achieved_goal": np.array([-1.0, 1.0]), "desired_goal": np.array(goal)}


def batch(n: int) -> dict[str, np.ndarray]:
    points = np.random.default_rng(0).uniform(-1.5, 1.5, (2, n, 2))
    return {"observation": points[0], "achieved_goal": points[0], "desired_goal": points[1]}


# -- what any algorithm has -------------------------------------------------------------------------------------------


def test_is_an_off_policy_algorithm() -> None:
    agent = SkillGraphAgent("MultiInputPolicy", TOY, seed=0)
    assert isinstance(agent, OffPolicyAlgorithm)
    assert agent.learn(20) is agent
    assert agent.num_timesteps == 20
    assert isinstance(agent.get_env(), VecEnv)
    assert agent.get_vec_normalize_env() is None
    assert agent.policy is agent.parts.walker.learner.policy
    assert (agent.n_envs, agent.seed, agent.verbose) == (1, 0, 0)


def test_constructor_takes_sb3_arguments_in_sb3_order() -> None:
    def names(cls: type[BaseAlgorithm]) -> list[str]:
        return list(cls.__init__.__code__.co_varnames[1 : cls.__init__.__code__.co_argcount])

    gone = {"replay_buffer_class", "replay_buffer_kwargs", "optimize_memory_usage", "n_steps"}
    gone |= {"policy_delay", "target_policy_noise", "target_noise_clip"}
    assert names(SkillGraphAgent) == [name for name in names(TD3) if name not in gone]
    assert SkillGraphAgent.__init__.__code__.co_kwonlyargcount + len(names(SkillGraphAgent)) <= 32


@pytest.mark.parametrize("name", ["replay_buffer_class", "use_sde", "n_steps", "gestation_period", "anything"])
def test_unknown_arguments_are_type_errors(trained_files: tuple[Path, Path], name: str) -> None:
    with pytest.raises(TypeError, match=name):
        new_agent(**{name: None})
    with pytest.raises(TypeError, match=name):
        SkillGraphAgent.load(trained_files[0], **{name: None})
    SkillGraphAgent.load(trained_files[0], custom_objects={name: None})  # there SB3 leaves out what is not in the file


def test_learn_counts_steps_as_sb3_does() -> None:
    agent = new_agent(new_vec_env(n_envs=2)).learn(31)
    assert agent.num_timesteps == 32
    agent.learn(10)
    assert agent.num_timesteps == 10
    agent.learn(10, reset_num_timesteps=False)
    assert agent.num_timesteps == 20
    assert agent.parts.store.total == 52


# -- vectorised environments ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("monitored", [False, True])
@pytest.mark.parametrize("n_envs", [1, 2, 3])
def test_vectorised_environments(n_envs: int, monitored: bool) -> None:
    recorders = [Recorder(gym.make(TOY, max_steps=40)) for _ in range(n_envs)]
    envs = [Monitor(env) if monitored else env for env in recorders]
    agent = new_agent(DummyVecEnv([lambda env=env: env for env in envs])).learn(420)
    assert agent.num_timesteps == agent.parts.store.total == 420
    for i, recorder in enumerate(recorders):
        check_store(agent, recorder.transitions, i)
    assert agent._episode_num == n_envs * (420 // n_envs // 40)
    assert agent.predict(agent.env.reset())[0].shape == (n_envs, 2)


@pytest.mark.mujoco
def test_on_a_simulator(tmp_path: Path) -> None:
    agent = new_agent(new_vec_env(POINT, max_steps=100)).learn(400)
    assert agent.parts.store.total == 400
    agent.save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent")
    obs = agent.env.reset()
    np.testing.assert_array_equal(loaded.predict(obs)[0], agent.predict(obs)[0])
    assert evaluate_policy(agent, agent.env, n_eval_episodes=2)[0] >= 0.0


def test_set_env(trained: SkillGraphAgent) -> None:
    env = Recorder(gym.make(TOY))
    total, n_steps = trained.parts.store.total, trained.num_timesteps
    trained.learn(30, reset_num_timesteps=False)
    trained.set_env(env)
    trained.learn(30, reset_num_timesteps=False)
    assert trained.parts.store.total == total + 60
    assert trained.num_timesteps == n_steps + 60
    assert len(env.starts) == 1
    assert len(env.transitions) == 30


def test_set_env_with_another_number_of_environments(trained: SkillGraphAgent) -> None:
    with pytest.raises(ValueError, match="number of environments"):
        trained.set_env(new_vec_env(n_envs=2))


# -- predict ----------------------------------------------------------------------------------------------------------


def test_predict_one_observation_or_a_batch(trained: SkillGraphAgent) -> None:
    action, state = trained.predict(one_observation())
    assert action.shape == (2,)
    assert trained.action_space.contains(action)
    assert all(len(array) == 1 for array in state)
    actions, states = trained.predict(batch(7))
    assert actions.shape == (7, 2)
    assert all(len(array) == 7 for array in states)
    for i in range(7):
        single, one = trained.predict({key: value[i] for key, value in batch(7).items()})
        np.testing.assert_allclose(single, actions[i], atol=1e-6)
        assert trained.running(one) == [trained.running(states)[i]]


def test_predict_keeps_its_state_outside_and_forgets_it_at_an_episode_start(trained: SkillGraphAgent) -> None:
    observations = batch(5)
    first, state = trained.predict(observations)
    kept = tuple(array.copy() for array in state)
    start = np.zeros(5, dtype=bool)
    second, later = trained.predict(observations, state=state, episode_start=start)
    assert differences(kept, state) == []  # what was passed in is not written to
    assert [RunnerState(*each).elapsed.tolist() for each in (state, later)] == [[1.0] * 5, [2.0] * 5]
    again, fresh = trained.predict(observations, state=later, episode_start=~start)
    assert differences((first, kept), (again, fresh)) == []
    mixed = np.array([True, False, False, True, False])
    _, state = trained.predict(observations, state=later, episode_start=mixed)
    _, running = trained.predict(observations, state=later, episode_start=start)
    for got, new, old in zip(state, kept, running, strict=True):
        np.testing.assert_array_equal(got, np.where(mixed.reshape(-1, *[1] * (got.ndim - 1)), new, old))
    assert second.shape == first.shape


def test_predict_is_deterministic_and_changes_nothing(trained: SkillGraphAgent) -> None:
    before = state_of(trained)
    results = [trained.predict(batch(40), deterministic=flag) for flag in (True, False, True)]
    assert differences(results[0], results[1]) == []
    assert differences(results[0], results[2]) == []
    state = results[0][1]
    for _ in range(30):
        _, state = trained.predict(batch(40), state=state, episode_start=np.zeros(40, dtype=bool))
    assert differences(before, state_of(trained)) == []


@pytest.mark.parametrize("n_envs", [1, 2])
def test_evaluate_policy(trained: SkillGraphAgent, n_envs: int) -> None:
    before = state_of(trained)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        env = new_vec_env(n_envs=n_envs, terminate_on_success=True)
        rewards, lengths = evaluate_policy(trained, env, n_eval_episodes=20, return_episode_rewards=True)
    assert len(rewards) == len(lengths) == 20
    assert max(rewards) == 1.0
    assert differences(before, state_of(trained)) == []


# -- callbacks --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n_envs", [1, 2])
def test_callbacks_see_every_step(n_envs: int) -> None:
    callback = Counting()
    agent = new_agent(new_vec_env(n_envs=n_envs)).learn(260, callback=callback)
    assert callback.n_calls * n_envs == callback.num_timesteps == agent.num_timesteps == 260
    assert callback.calls.count("step") == 260 // n_envs
    assert callback.calls.count("rollout_start") == callback.calls.count("rollout_end") == 260 // n_envs
    assert (callback.calls[0], callback.calls[-1]) == ("training_start", "training_end")


@pytest.mark.parametrize("stop_at", [1, 40, 41, 263])
def test_a_callback_that_stops_leaves_no_trace_of_its_step(stop_at: int) -> None:
    env = Recorder(gym.make(TOY, max_steps=40))
    agent = new_agent(env)
    agent.learn(500, callback=Counting(stop_at))
    assert agent.num_timesteps == stop_at
    assert agent.parts.store.total == stop_at - 1
    stopped = env.transitions.pop()
    check_store(agent, env.transitions)
    # Apart from the counter and the environment, the agent is one that was told to learn a step less.
    ours = state_of(agent)["agent"]
    if stop_at > 1:
        theirs = state_of(new_agent(gym.make(TOY, max_steps=40)).learn(stop_at - 1))["agent"]
        for name in ("parameters", "graph", "model", "walker"):
            assert differences(theirs[name], ours[name]) == [], name
        assert differences(theirs["progress"]["rng"], ours["progress"]["rng"]) == []
    n_starts = len(env.starts)
    agent.learn(100, reset_num_timesteps=False)
    assert agent.num_timesteps == stop_at + 100
    np.testing.assert_array_equal(env.transitions[stop_at - 1]["achieved_goal"], env.starts[n_starts])
    assert not np.array_equal(stopped["next_achieved_goal"], env.starts[n_starts])
    check_store(agent, env.transitions)


def test_a_stopped_step_is_forgotten_by_the_generators_too() -> None:
    stopped, twin = (new_agent(gym.make(TOY, max_steps=40)) for _ in range(2))
    stopped.learn(500, callback=Counting(263))
    twin.learn(262)
    twin.set_env(twin.get_env())  # forces a fresh episode
    for agent in (stopped, twin):
        agent.learn(100, reset_num_timesteps=False)
    assert differences(state_of(twin)["replay"], state_of(stopped)["replay"]) == []


def test_the_stock_callbacks(tmp_path: Path) -> None:
    event_callback = Counting()
    eval_callback = EvalCallback(
        new_vec_env(n_envs=1, terminate_on_success=True),
        callback_on_new_best=StopTrainingOnRewardThreshold(reward_threshold=2.0),
        callback_after_eval=StopTrainingOnNoModelImprovement(max_no_improvement_evals=100),
        eval_freq=150,
        n_eval_episodes=2,
        best_model_save_path=str(tmp_path / "best"),
        log_path=str(tmp_path / "evaluations"),
        warn=False,
    )
    checkpoint = CheckpointCallback(150, str(tmp_path / "checkpoints"), "dsg", save_replay_buffer=True)
    every = EveryNTimesteps(n_steps=100, callback=event_callback)
    callback = CallbackList([eval_callback, checkpoint, every, LogEveryNTimesteps(120)])
    agent = new_agent(new_vec_env(n_envs=1)).learn(500, callback=callback, progress_bar=True)
    assert agent.num_timesteps == 500
    assert event_callback.n_calls == 5
    assert len(np.load(tmp_path / "evaluations" / "evaluations.npz")["successes"]) == 3
    SkillGraphAgent.load(tmp_path / "best" / "best_model")
    names = sorted(path.name for path in (tmp_path / "checkpoints").iterdir())
    assert names == sorted(
        name for n in (150, 300, 450) for name in (f"dsg_{n}_steps.zip", f"dsg_replay_buffer_{n}_steps.pkl")
    )
    resumed = SkillGraphAgent.load(tmp_path / "checkpoints" / "dsg_300_steps", env=gym.make(TOY))
    resumed.load_replay_buffer(tmp_path / "checkpoints" / "dsg_replay_buffer_300_steps.pkl")
    assert resumed.num_timesteps == 300
    assert resumed.parts.store.total == 299  # a checkpoint is taken between a step and its storing
    resumed.learn(100, reset_num_timesteps=False)
    assert resumed.num_timesteps == 400
    assert resumed.parts.store.total == 399


def test_stopping_on_episodes_and_on_reward() -> None:
    agent = new_agent(new_vec_env(n_envs=1, max_steps=30))
    agent.learn(1000, callback=StopTrainingOnMaxEpisodes(max_episodes=4))
    assert agent.num_timesteps == 120
    stop = StopTrainingOnRewardThreshold(reward_threshold=-1.0)
    eval_callback = EvalCallback(new_vec_env(n_envs=1), callback_on_new_best=stop, eval_freq=50, n_eval_episodes=1)
    agent.learn(1000, callback=eval_callback)
    assert agent.num_timesteps == 50


@pytest.mark.parametrize("n_envs", [1, 2])
def test_evaluation_in_the_middle_leaves_training_alone(tmp_path: Path, n_envs: int) -> None:
    expected = without_clock(state_of(new_agent(new_vec_env(n_envs=n_envs)).learn(600)))
    eval_env = new_vec_env(n_envs=n_envs)
    callback = CallbackList(
        [
            EvalCallback(eval_env, eval_freq=70, n_eval_episodes=2, best_model_save_path=str(tmp_path), verbose=0),
            CheckpointCallback(90, str(tmp_path), save_replay_buffer=True),
        ]
    )
    agent = new_agent(new_vec_env(n_envs=n_envs)).learn(600, callback=callback)
    assert differences(expected, without_clock(state_of(agent))) == []


# -- the same again ---------------------------------------------------------------------------------------------------

AGAIN = """
import sys
import torch
torch.set_num_threads(3)
import sb3_skillgraph
assert torch.get_num_threads() == 3, "importing the library must not set threads"
from conftest import new_agent
agent = new_agent().learn(600)
agent.save(sys.argv[1])
agent.save_replay_buffer(sys.argv[2])
"""


def test_the_same_seed_gives_the_same_agent(tmp_path: Path) -> None:
    first, second = (without_clock(state_of(new_agent().learn(600))) for _ in range(2))
    assert differences(first, second) == []
    in_new_process(AGAIN, tmp_path / "agent.zip", tmp_path / "replay.zip", hash_seed=77)
    assert differences(first, without_clock(state_in(tmp_path / "agent.zip", tmp_path / "replay.zip"))) == []
    assert len(first["agent"]["graph"]["edges"]["source"]) > 20
    other = without_clock(state_of(new_agent(seed=1).learn(600)))
    assert differences(first["agent"]["graph"], other["agent"]["graph"]) != []


def test_without_a_seed_agents_differ() -> None:
    first, second = (new_agent(seed=None) for _ in range(2))
    assert not np.array_equal(first.predict(one_observation())[0], second.predict(one_observation())[0])


# -- logging ----------------------------------------------------------------------------------------------------------

KEYS = {
    *("rollout/ep_rew_mean", "rollout/ep_len_mean", "rollout/success_rate"),
    *("train/actor_loss", "train/critic_loss", "train/learning_rate", "train/n_updates"),
    *("skillgraph/events", "skillgraph/salient_events", "skillgraph/edges", "skillgraph/tried_edges"),
    *("skillgraph/success_rate", "skillgraph/stuck"),
}
TABLE_KEYS = {"time/episodes", "time/fps", "time/time_elapsed", "time/total_timesteps"}


def test_csv_log(tmp_path: Path) -> None:
    agent = new_agent()
    agent.set_logger(configure(str(tmp_path), ["csv"]))
    agent.learn(2000, log_interval=2)
    agent.logger.close()
    with open(tmp_path / "progress.csv", newline="") as file:
        entries = list(csv.DictReader(file))
    assert set(entries[-1]) >= KEYS | TABLE_KEYS
    assert [int(entry["time/total_timesteps"]) for entry in entries] == list(range(200, 2001, 200))
    last = {key: float(value) for key, value in entries[-1].items()}
    assert last["skillgraph/events"] == len(agent.events)
    assert last["skillgraph/edges"] == agent.graph.edges.size > last["skillgraph/tried_edges"] > 0
    assert 0.0 < last["skillgraph/success_rate"] < 1.0
    assert last["rollout/ep_len_mean"] == 100
    assert last["train/n_updates"] == 1799  # an entry is written before the updates of its step


def test_tensorboard_log(tmp_path: Path) -> None:
    event_accumulator = pytest.importorskip("tensorboard.backend.event_processing.event_accumulator")
    agent = new_agent(tensorboard_log=str(tmp_path)).learn(300, log_interval=1)
    agent.learn(100, reset_num_timesteps=False)
    agent.learn(100, tb_log_name="other")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["SkillGraph_1", "other_1"]
    accumulator = event_accumulator.EventAccumulator(str(tmp_path / "SkillGraph_1"))
    accumulator.Reload()
    tags = set(accumulator.Tags()["scalars"])
    assert (KEYS - {"train/n_updates"}) <= tags
    assert [event.step for event in accumulator.Scalars("skillgraph/events")][:3] == [100, 200, 300]


def test_table_and_silence(capsys: pytest.CaptureFixture[str]) -> None:
    SkillGraphAgent("MultiInputPolicy", gym.make(TOY), **{**EAGER, "verbose": 0}).learn(250, log_interval=1)
    assert capsys.readouterr().out == ""
    SkillGraphAgent("MultiInputPolicy", gym.make(TOY), **{**EAGER, "verbose": 1}).learn(250, log_interval=1)
    table = capsys.readouterr().out
    assert "skillgraph/" in table
    assert "tried_edges" in table


def test_nothing_is_left_open(tmp_path: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error", ResourceWarning)
        agent = new_agent(tensorboard_log=str(tmp_path)).learn(120, log_interval=1)
        agent.logger.close()
        agent.env.close()
        del agent


def test_what_is_learned_is_no_secret(trained: SkillGraphAgent) -> None:
    """The attributes users are promised."""
    ids = [event.id for event in trained.events]
    assert [event.id for event in trained.graph.events] == ids == [f"e{i}" for i in range(len(ids))]
    assert [(option.id, option.target) for option in trained.options] == [(f"w{i}", id) for i, id in enumerate(ids)]
    for option, event in zip(trained.options, trained.events, strict=True):
        assert option.termination is event
        assert option.learner is trained.parts.walker.learner
        assert option.contains(event.center[None]).all()
    assert set(trained.graph.nx.nodes) == {*ids, *(option.id for option in trained.options)}
    for source, target, attributes in trained.graph.nx.edges(data=True):
        record = {"forward", "backward", "crossing_steps", "successes", "success_steps", "failures", "failure_steps"}
        assert set(attributes) == (record if source in ids else {"rate"})
        assert (source in ids) != (target in ids)
        assert all(value >= 0.0 for value in attributes.values())
    assert repr(trained) == f"<SkillGraphAgent after {trained.num_timesteps} steps: {trained.graph!r}>"
    event, walk = trained.events[1], trained.options[1]
    assert event.id in repr(event) and "within 0.45" in repr(event)
    assert repr(walk) == f"<walk {walk.id} to {event.id}>"


# -- habits -----------------------------------------------------------------------------------------------------------


def small(**kwargs: Any) -> SkillGraphAgent:
    nets = dict(policy_kwargs=dict(net_arch=[16, 16]), learning_starts=50, batch_size=16, seed=0)
    return SkillGraphAgent("MultiInputPolicy", gym.make(TOY), **{**nets, **kwargs})


@pytest.mark.parametrize("option_class", ["OptionDDPG", "OptionTD3", "TD3", "SAC"])
def test_a_learning_rate_may_follow_a_schedule(option_class: str) -> None:
    agent = small(learning_rate=lambda left: 1e-3 * left + 1e-5, option_class=option_class)
    agent.learn(200)
    optimizer = agent.parts.walker.learner.actor.optimizer
    assert optimizer.param_groups[0]["lr"] == pytest.approx(1e-5, abs=1.1e-5)
    assert agent.logger.name_to_value.get("train/learning_rate", 1e-5) < 3e-5


def test_the_policy_acts_on_what_the_environment_shows() -> None:
    agent = small().learn(100)
    observation = agent.get_env().reset()  # type: ignore[union-attr]
    np.testing.assert_array_equal(agent.policy.predict(observation)[0], agent.predict(observation)[0])
    seen = np.zeros((1, *agent.policy.observation_space.shape), dtype=np.float32)  # type: ignore[misc]
    assert agent.policy.predict(seen)[0].shape == (1, 2)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["TQC", "CrossQ"])
def test_sb3_contribs_off_policy_classes(name: str) -> None:
    contrib = pytest.importorskip("sb3_contrib")
    cls = getattr(contrib, name)
    agent = small(option_class=cls).learn(150)
    file = io.BytesIO()
    agent.save(file)
    with pytest.raises(ValueError, match=r"load\(\.\.\., option_class"):
        SkillGraphAgent.load(io.BytesIO(file.getvalue()))
    loaded = SkillGraphAgent.load(io.BytesIO(file.getvalue()), env=gym.make(TOY), option_class=cls)
    observation, _ = gym.make(TOY).reset(seed=0)
    np.testing.assert_array_equal(loaded.predict(observation)[0], agent.predict(observation)[0])


def test_stacked_goals_are_refused() -> None:
    with pytest.raises(ValueError, match="VecFrameStack is not supported"):
        SkillGraphAgent("MultiInputPolicy", VecFrameStack(make_vec_env(TOY), 2))


def test_attributes_changed_after_construction_count_and_are_saved() -> None:
    agent = small()
    agent.gamma, agent.tau, agent.batch_size = 0.9, 0.1, 8
    agent.train_freq = TrainFreq(4, TrainFrequencyUnit.STEP)
    agent.learn(100)
    learner = agent.parts.walker.learner
    assert (learner.gamma, learner.tau) == (0.9, 0.1)
    assert agent._n_updates == 13  # after steps 52, 56, ..., 100
    file = io.BytesIO()
    agent.save(file)
    loaded = SkillGraphAgent.load(io.BytesIO(file.getvalue()))
    assert (loaded.gamma, loaded.tau, loaded.batch_size, loaded.train_freq) == (0.9, 0.1, 8, agent.train_freq)
