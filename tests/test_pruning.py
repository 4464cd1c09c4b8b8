"""Options that no plan uses are let go, and nothing else."""

import gymnasium as gym
import numpy as np
import pytest
from builders import World
from conftest import SMALL, TOY

from sb3_skillgraph import SkillGraphAgent
from sb3_skillgraph.chaining import SkillChain
from sb3_skillgraph.pruning import EVERY, Pruning


class Corridor(World):
    """Three events in a row, chains between neighbours and one from end to end that costs too much."""

    def __init__(self) -> None:
        super().__init__()
        self.at = [self.add_event(x, 0.0) for x in (0.0, 10.0, 20.0)]
        self.good = [self.chain(0, 1, 30), self.chain(1, 2, 30)]
        self.poor = self.chain(0, 2, 4, failures=8)
        for x in np.linspace(0.0, 3.0, 13):
            self.visited.record(0, int(10 * x), np.array([x, 0.0], dtype=np.float32))

    def chain(self, source: int, target: int, successes: int, failures: int = 0) -> SkillChain:
        chain = self.chaining.open_chain(self.at[source], self.at[target])
        root = self.chaining.options[chain.options[0]]
        start, end = self.at[source].center, self.at[target].center
        for _ in range(successes):
            self.chaining.learn_success(root, np.linspace(start, end, 15)[:-1], end)
        for _ in range(failures):
            self.chaining.learn_failure(root, start)
        chain.complete = True
        return chain


@pytest.fixture
def corridor() -> Corridor:
    return Corridor()


def test_used_are_the_options_on_cheapest_paths(corridor: Corridor) -> None:
    pruning = Pruning(corridor.chaining, corridor.visited, 20)
    assert corridor.poor.options[0] in corridor.graph.options
    assert pruning.used() == {chain.options[0] for chain in corridor.good}


def test_what_is_not_used_for_long_is_let_go(corridor: Corridor) -> None:
    pruning = Pruning(corridor.chaining, corridor.visited, 20)
    poor = corridor.poor.options[0]
    assert not pruning.due(EVERY - 1)
    assert pruning.due(EVERY)
    assert pruning.prune(10, ()) == []
    assert not pruning.due(19)
    assert pruning.prune(20, ()) == []
    before = corridor.graph.shortest_path(["e0"], "e2")
    assert pruning.prune(30, ()) == [corridor.poor]
    assert poor not in corridor.graph.nx
    assert poor not in corridor.chaining.options
    assert corridor.graph.shortest_path(["e0"], "e2") == before
    assert (corridor.poor.options, corridor.poor.open) == ([], False)
    assert pruning.prune(60, ()) == []


def test_what_is_running_practised_or_open_stays(corridor: Corridor) -> None:
    pruning = Pruning(corridor.chaining, corridor.visited, 20)
    pruning.prune(10, ())
    assert pruning.prune(40, {corridor.poor.options[0]}) == []
    assert pruning.prune(40, {corridor.poor.id}) == []
    corridor.poor.complete = corridor.poor.dropped = False
    assert pruning.prune(40, ()) == []
    corridor.poor.dropped = True  # given up as hopeless
    assert pruning.prune(40, ()) == [corridor.poor]


def test_a_chain_let_go_can_be_taken_up_again(corridor: Corridor) -> None:
    made = corridor.chaining.n_made
    corridor.chaining.remove([corridor.poor])
    again = corridor.chaining.open_chain(corridor.at[0], corridor.at[2])
    assert again is corridor.poor
    assert again.open
    assert again.options == [f"o{made + 1}"]  # no id is given twice


def test_never(corridor: Corridor) -> None:
    assert not Pruning(corridor.chaining, corridor.visited, None).due(10**6)


def test_an_agent_prunes_and_goes_on(tmp_path: object) -> None:
    agent = SkillGraphAgent("MultiInputPolicy", gym.make(TOY), **{**SMALL, "prune_after": 1, "salient_event_freq": 2})
    agent.learn(6000, log_interval=None)
    assert agent.chaining.n_made > len(agent.chaining.options) > 0
    assert set(agent.graph.options) <= set(agent.chaining.options)
    assert [option.id for option in agent.graph.option_bank.options] == list(agent.graph.options)
    running = agent._state
    agent.chaining.remove([chain for chain in agent.chaining.chains.values() if chain.options])
    observation, _ = gym.make(TOY).reset()
    agent.predict(observation, running)  # whatever option ran there: it is gone
    agent.predict(observation, running._replace(option=np.array([1])))
