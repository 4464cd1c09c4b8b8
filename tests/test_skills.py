"""A walk with a network of its own."""

from pathlib import Path
from typing import Literal

import gymnasium as gym
import numpy as np
import pytest
from conftest import TOY, differences, new_agent, new_vec_env, state_of, without_clock
from stable_baselines3 import DDPG

from sb3_skillgraph import OptionEnv, OptionsEnv, SkillGraphAgent
from sb3_skillgraph.learning.growth import ENOUGH_RUNS, FAILING, GAIN, GESTATION
from sb3_skillgraph.options.walk import Walk
from sb3_skillgraph.running import Run


def busiest(agent: SkillGraphAgent) -> int:
    """The event that most runs have led to."""
    edges = agent.graph.edges
    return int(np.bincount(edges.target, edges.successes, len(agent.events)).argmax())


def weights(option: object) -> np.ndarray:
    return option.learner.policy.actor.mu[0].weight.detach().numpy().copy()  # type: ignore[attr-defined]


def test_a_skill_begins_as_the_walk_and_learns_from_its_runs(trained: SkillGraphAgent) -> None:
    walk = trained.options[busiest(trained)]
    assert isinstance(walk, Walk)
    skill = walk.specialise()
    assert walk.specialise() is skill
    assert skill.id == walk.id
    after = next(option for option in trained.options if option.id == walk.id)
    assert after.learner is skill.learner is not trained.parts.walker.learner
    np.testing.assert_array_equal(weights(skill), weights(trained.parts.walker))
    for _ in range(10):  # how often it runs is for the plans to say
        trained.learn(3000, log_interval=None, reset_num_timesteps=False)
        own = skill.replay._readable()
        if len(own) > 64:
            break
    assert len(own) > 64
    assert 0 < skill.learner._n_updates <= len(own)
    np.testing.assert_array_equal(trained.parts.store.column("goal", own), np.float32([skill.subgoal] * len(own)))
    assert not np.array_equal(weights(skill), weights(trained.parts.walker))


def test_predict_runs_the_skill_in_place_of_the_walk(trained: SkillGraphAgent) -> None:
    event = busiest(trained)
    goal = trained.events[event].center.astype(np.float32)
    source = int(trained.graph.edges.source[trained.graph.edges.target == event][0])
    env = gym.make(TOY)
    observation, _ = env.reset(options={"start": trained.events[source].center, "goal": goal})
    before = trained.plan(observation).path
    for option in trained.options:
        skill = option.specialise()
        with np.errstate(all="ignore"):
            for parameter in skill.learner.policy.actor.parameters():
                parameter.data.zero_()
    assert trained.plan(observation).path == before, "a plan speaks of the same option"
    action, state = trained.predict(observation)
    assert trained.running(state) == [before[0]]  # type: ignore[arg-type]
    if before[0] != "direct":
        np.testing.assert_array_equal(action, np.zeros(2))
    # Whoever arrives by a skill is in the event that it leads to.
    runner, option = trained.parts.runner, trained.options[event]
    running = runner.act({k: v[None] for k, v in observation.items()}, goal[None], _fresh(trained))[1]
    running = running._replace(option=np.array([option.id]), aim=option.subgoal[None])
    ended, (run,) = runner.advance(running, np.float32([option.subgoal]))
    assert (run.success, run.landing, ended.arrived[0]) == (True, option.target, option.target)


def _fresh(agent: SkillGraphAgent) -> object:
    return agent._running_state(1, None)


@pytest.mark.usefixtures("one_thread")
def test_skills_are_saved_and_learning_goes_on_exactly(trained: SkillGraphAgent, tmp_path: Path) -> None:
    trained.options[busiest(trained)].specialise()
    trained.learn(600, log_interval=None, reset_num_timesteps=False)
    trained.save(tmp_path / "agent")
    trained.save_replay_buffer(tmp_path / "replay")
    twin = SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY))
    twin.load_replay_buffer(tmp_path / "replay")
    assert twin.parts.skills.keys() == trained.parts.skills.keys()
    for agent in (trained, twin):
        agent.learn(400, log_interval=None, reset_num_timesteps=False)
    assert differences(without_clock(state_of(trained)), without_clock(state_of(twin))) == []


def test_a_skill_that_is_younger_than_the_replay_buffer_has_no_rows_of_its_own(
    trained: SkillGraphAgent, tmp_path: Path
) -> None:
    trained.save_replay_buffer(tmp_path / "replay")
    trained.options[busiest(trained)].specialise()
    trained.save(tmp_path / "agent")
    twin = SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY))
    twin.load_replay_buffer(tmp_path / "replay")
    (skill,) = twin.parts.skills.values()
    assert len(skill.replay._readable()) == 0
    twin.learn(200, log_interval=None, reset_num_timesteps=False)
    # and one that has gone leaves none behind
    trained.save_replay_buffer(tmp_path / "replay")
    del twin.parts.skills[skill.id]
    twin.load_replay_buffer(tmp_path / "replay")


def test_a_skill_works_wherever_options_do(trained: SkillGraphAgent) -> None:
    skill = trained.options[busiest(trained)].specialise()
    DDPG("MlpPolicy", OptionEnv(gym.make(TOY), skill.termination), learning_starts=10).learn(20)  # type: ignore[arg-type]
    env = OptionsEnv(gym.make(TOY, max_steps=60), trained.options)
    observation, _ = env.reset(seed=0)
    for _ in range(5):
        observation, _, _, over, info = env.step(int(np.flatnonzero(observation["action_mask"])[0]))
        assert info["tau"] >= 1
        if over:
            break


def test_a_skill_goes_with_its_event(trained: SkillGraphAgent, tmp_path: Path) -> None:
    for option in trained.options:
        option.specialise()
    n_before = len(trained.parts.skills)
    trained.graph.max_events = len(trained.events)
    new = trained.parts.witness.add_event(np.array([9.0, 9.0]), salient=False)  # for which others have to be merged
    trained.save(tmp_path / "agent")
    loaded = SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY))
    assert loaded.parts.skills.keys() == set(loaded.graph.walk_ids) - {trained.graph.walk_ids[new]}
    assert len(loaded.parts.skills) < n_before
    loaded.learn(200, log_interval=None, reset_num_timesteps=False)


# -- growth -----------------------------------------------------------------------------------------------------------


class Trial:
    """A walk that runs many times, with skills where needed."""

    def __init__(self, agent: SkillGraphAgent) -> None:
        self.agent, self.walk = agent, agent.graph.walk_ids[busiest(agent)]
        self.growth = agent.parts.witness.growth
        self.growth.mode = "where_needed"

    def runs(self, n: int, n_successes: int) -> None:
        for i in range(n):
            self.growth.ended(Run(0, "", self.walk, "", i < n_successes, 10, np.zeros(2, np.float32)))

    @property
    def has_skill(self) -> bool:
        return self.walk in self.agent.parts.skills


def test_a_skill_begins_where_a_walk_keeps_failing_and_stays_if_it_is_better(trained: SkillGraphAgent) -> None:
    trial = Trial(trained)
    trial.runs(ENOUGH_RUNS, FAILING + 1)
    trial.runs(ENOUGH_RUNS, 0)
    assert not trial.has_skill, "first it succeeds more often than not, and then it is measured how often it does"
    trial.runs(ENOUGH_RUNS - 1, 7)
    assert not trial.has_skill
    trial.runs(1, 0)
    assert list(trained.parts.skills) == [trial.walk]
    skill = trained.parts.skills[trial.walk]
    trial.runs(GESTATION - ENOUGH_RUNS, 0)
    for _ in range(ENOUGH_RUNS):
        trial.runs(1, skill.n_successes < 7 + GAIN)
    assert (skill.n_runs, skill.n_successes) == (GESTATION, 7 + GAIN)
    trial.runs(2 * GESTATION, 0)
    assert trained.parts.skills[trial.walk] is skill, "it is on trial once only: nothing flaps"


def test_a_skill_that_is_no_better_goes_again_and_is_not_begun_soon(trained: SkillGraphAgent) -> None:
    trial = Trial(trained)
    trial.runs(ENOUGH_RUNS, FAILING)
    trial.runs(ENOUGH_RUNS, 7)
    assert trial.has_skill
    trial.runs(GESTATION - ENOUGH_RUNS, 40)  # what counts is how it ends
    trial.runs(ENOUGH_RUNS - 1, 7 + GAIN - 1)
    assert trial.has_skill
    trial.runs(1, 0)
    assert not trial.has_skill
    trial.runs(5 * ENOUGH_RUNS, 0)
    assert not trial.has_skill
    trained.graph.now *= 2
    trial.runs(2 * ENOUGH_RUNS, 0)
    assert trial.has_skill, "the walker has learned as much once more"


def test_a_walk_that_hardly_fails_any_more_stays(trained: SkillGraphAgent) -> None:
    trial = Trial(trained)
    trial.runs(ENOUGH_RUNS, 0)
    trial.runs(ENOUGH_RUNS, ENOUGH_RUNS - GAIN + 1)
    assert not trial.has_skill, "no skill could be seen to be better"


def test_what_is_made_by_hand_is_not_on_trial(trained: SkillGraphAgent) -> None:
    trial = Trial(trained)
    trial.runs(3 * ENOUGH_RUNS - 5, 0)
    assert trial.has_skill
    skill = trained.options[busiest(trained)].specialise()
    trial.runs(3 * GESTATION, 0)
    assert trained.parts.skills[trial.walk] is skill
    assert len(trial.growth.get_state()["runs"].get(trial.walk, [])) < ENOUGH_RUNS, "nothing grows"


def test_nothing_grows_by_default(trained: SkillGraphAgent) -> None:
    trial = Trial(trained)
    trial.growth.mode = new_agent().parts.witness.growth.mode
    trial.runs(5 * ENOUGH_RUNS, 0)
    assert trial.growth.mode == "never"
    assert not trial.has_skill


def test_a_walk_to_an_event_that_is_gone_gets_none(trained: SkillGraphAgent) -> None:
    walks = list(trained.options)
    trained.graph.coarsen()
    gone = next(walk for walk in walks if walk.id not in trained.graph.walk_ids)
    with pytest.raises(ValueError, match=f"no walk '{gone.id}'"):
        gone.specialise()


@pytest.mark.parametrize("skills", ["where_needed", "always"])
def test_skills_go_with_their_events_while_learning(skills: Literal["where_needed", "always"]) -> None:
    agent = new_agent(new_vec_env(n_envs=2), skills=skills, max_events=10, learning_starts=100)
    growth = agent.parts.witness.growth
    for _ in range(8):
        agent.learn(200, log_interval=None, reset_num_timesteps=False)
        if skills == "where_needed":
            growth.skills.specialise(agent.graph.walk_ids[-1])
        state = growth.get_state()
        known = {*agent.parts.skills, *state["runs"], *state["suspects"], *state["before"], *state["again"]}
        assert known <= set(agent.graph.walk_ids)
    assert agent.graph.n_made > 10, "events were merged"
    assert agent.parts.skills


def test_a_skill_is_a_copy_of_everything_that_the_walker_has_learned(trained_sac: SkillGraphAgent) -> None:
    walker, skill = trained_sac.parts.walker.learner, trained_sac.options[0].specialise().learner
    assert skill.log_ent_coef.item() == walker.log_ent_coef.item() != 0.0  # type: ignore[attr-defined]


@pytest.fixture(scope="module")
def trained_sac() -> SkillGraphAgent:
    return new_agent(option_class="SAC", learning_starts=100).learn(300)


@pytest.mark.usefixtures("one_thread")
@pytest.mark.parametrize("skills", ["where_needed", "always"])
def test_growth_is_saved_and_goes_on_exactly(skills: Literal["where_needed", "always"], tmp_path: Path) -> None:
    agent = SkillGraphAgent("MultiInputPolicy", gym.make(TOY), seed=0, skills=skills, learning_starts=200)
    agent.learn(3000, log_interval=None)
    trial = Trial(agent)
    trial.growth.mode = skills
    if skills == "where_needed":  # a skill soon to be judged, and a walk that is measured
        trial.growth._runs.pop(trial.walk)
        trial.runs(2 * ENOUGH_RUNS + GESTATION - 1, 0)
        trial.growth._suspects.add(agent.graph.walk_ids[0])
        trial.growth._again[agent.graph.walk_ids[0]] = 1e6
    else:  # whichever has run
        trial.walk = next(iter(agent.parts.skills))
    assert trial.has_skill
    agent.save(tmp_path / "agent")
    agent.save_replay_buffer(tmp_path / "replay")
    twin = SkillGraphAgent.load(tmp_path / "agent", env=gym.make(TOY))
    twin.load_replay_buffer(tmp_path / "replay")
    assert twin.parts.witness.growth.get_state() == trial.growth.get_state()
    for _ in range(5):
        for each in (agent, twin):
            each.learn(1500, log_interval=None, reset_num_timesteps=False)
        assert differences(without_clock(state_of(agent)), without_clock(state_of(twin))) == []
        if trial.has_skill == (skills == "always"):
            break
    assert trial.has_skill == (skills == "always"), "the judgement has come"
