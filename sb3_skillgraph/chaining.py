"""Deep skill chaining: options learned backwards from an event until one can start where it must (sections 2.2, 3.2.5)."""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from sb3_skillgraph.events import SalientEvent, TerminationSet
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.options.option import Option

MakeOption = Callable[[str, str, TerminationSet], Option]


@dataclass
class SkillChain:
    """Options that lead from one event to another, the last step first.

    :param id: its name
    :param source: id of the event it starts from
    :param target: id of the event it leads to
    :param options: ids of its options: the first (the root) ends in the target event, each next one in the initiation
        set of the one before
    :param joins: whether it is the chain that joins a new event to the graph
    :param complete: whether one of its options can be started from the source event and has shown often enough that it
        reaches its target
    :param n_failures: failed runs since the last success
    :param dropped: whether it has been given up as hopeless
    """

    id: str
    source: str
    target: str
    options: list[str] = field(default_factory=list)
    joins: bool = False
    complete: bool = False
    n_failures: int = 0
    dropped: bool = False

    @property
    def open(self) -> bool:
        """Whether there is still something to learn."""
        return not (self.complete or self.dropped)


class DeepSkillChaining:
    """Opens chains, lets their options gestate, and closes them.

    :param graph: the skill graph, which mature options join
    :param make_option: makes a gestating option of an id for a target id and a termination set
    :param on_maturity: called with an option the moment it matures (it then takes over the global policy)
    :param gestation_period: successes an option needs to mature
    :param practice_runs: successful runs of its own that an option needs before its chain is complete
    :param max_failures: failed runs in a row after which a chain is given up; None for never
    """

    def __init__(
        self,
        graph: SkillGraph,
        make_option: MakeOption,
        on_maturity: Callable[[Option], None],
        gestation_period: int,
        practice_runs: int,
        max_failures: int | None,
    ) -> None:
        self.graph = graph
        self.make_option = make_option
        self.on_maturity = on_maturity
        self.gestation_period = gestation_period
        self.practice_runs = practice_runs
        self.max_failures = max_failures
        self.chains: dict[str, SkillChain] = {}
        self.options: dict[str, Option] = {}
        self.chain_of: dict[str, SkillChain] = {}
        self.n_made = 0

    def open_chain(self, source: SalientEvent, target: SalientEvent, joins: bool = False) -> SkillChain:
        """Start (or take up again) the chain between two events.

        :param source: where it must be possible to start
        :param target: where it must lead
        :param joins: whether it is to join a new event to the graph
        :return: the chain
        """
        id = f"{source.id}>{target.id}"
        if id not in self.chains:
            self.chains[id] = SkillChain(id, source.id, target.id, joins=joins)
        chain = self.chains[id]
        if chain.dropped:
            chain.dropped, chain.n_failures = False, 0
        if not chain.options:
            self._grow(chain, target.id, target)
        return chain

    def remove(self, chains: Iterable[SkillChain]) -> list[str]:
        """Let go of the options of some chains; what is left of such a chain tells that it has been there.

        :param chains: chains without anything left to learn
        :return: the ids of the options
        """
        ids = [id for chain in chains for id in chain.options]
        in_graph = [id for id in ids if id in self.graph.options]
        if in_graph:
            self.graph.remove_options(in_graph)
        for id in ids:
            chain = self.chain_of.pop(id)
            chain.options, chain.complete, chain.dropped = [], False, True
            del self.options[id]
        return ids

    def _grow(self, chain: SkillChain, target: str, termination: TerminationSet) -> None:
        self.n_made += 1
        option = self.make_option(f"o{self.n_made}", target, termination)
        self.options[option.id] = option
        self.chain_of[option.id] = chain
        chain.options.append(option.id)

    def open_chains(self) -> list[SkillChain]:
        """Return the chains that still need practice."""
        return [chain for chain in self.chains.values() if chain.open]

    def admissible(self, chain: SkillChain, point: np.ndarray) -> Option:
        """Return the option to run on the way to a chain's target: the earliest one that can start (section 3.2.5).

        Earliest means nearest to the target. A gestating option may start anywhere: that is how it finds out where
        it should.

        :param chain: the chain
        :param point: where the agent stands, shape ``(goal_dim,)``
        """
        options = [self.options[id] for id in chain.options]
        for option in options:
            startable = not option.mature or bool(option.initiation.optimistic(point[None])[0])
            if startable and not option.terminates(point):
                return option
        return options[-1]

    def learn_success(self, option: Option, path: np.ndarray, end: np.ndarray, *, own: bool = True) -> None:
        """Let an option learn from a run that reached its termination set.

        :param option: the option
        :param path: the states of the run, its start first, shape ``(n, goal_dim)``
        :param end: the state it ended in, shape ``(goal_dim,)``
        :param own: whether the option itself was running
        """
        option.succeeded(path, end, own=own)
        self.chain_of[option.id].n_failures = 0
        self._learned(option, path[0], success=True)

    def learn_stuck(self, option: Option) -> None:
        """Let an option learn from a run in which the agent got stuck: it failed, but where it began is not to blame.

        :param option: the option
        """
        option.failed(None)
        self._count_failure(self.chain_of[option.id])
        if option.mature:
            self.graph.refresh(option, False)

    def learn_failure(self, option: Option, start: np.ndarray) -> None:
        """Let an option learn from a run that timed out.

        :param option: the option
        :param start: the state it began in, shape ``(goal_dim,)``
        """
        option.failed(start)
        self._count_failure(self.chain_of[option.id])
        self._learned(option, start, success=False)

    def _count_failure(self, chain: SkillChain) -> None:
        chain.n_failures += 1
        if self.max_failures is not None and chain.open and chain.n_failures >= self.max_failures:
            chain.dropped = True

    def _learned(self, option: Option, start: np.ndarray, success: bool) -> None:
        chain = self.chain_of[option.id]
        source = self.graph.events[chain.source]
        for event in self.graph.event_bank.holding(start):
            if event.id != option.target:
                self.graph.ran_from(event, option, success)
        refitted = option.initiation.refit(force=not option.mature)
        if option.mature:
            self.graph.refresh(option, refitted)
        elif option.n_successes >= self.gestation_period:
            option.mature = True
            self.graph.add_option(option)
            self.on_maturity(option)
        if option.mature:
            self._check(chain, source)

    def _check(self, chain: SkillChain, source: SalientEvent) -> None:
        """Close a chain whose last option can be started from the source, or grow it by a child that leads there."""
        last = self.options[chain.options[-1]]
        startable = [self.options[id] for id in chain.options if self.graph.nx.has_edge(source.id, id)]
        chain.complete = any(sum(option.record) >= self.practice_runs for option in startable)
        if startable or not last.mature:
            return
        tried = self.graph.evidence.get((source.id, last.id), ())
        if not tried or not self.graph.evidence_edges or (len(tried) >= self.gestation_period and sum(tried) * 2 < len(tried)):
            self._grow(chain, last.id, last)

    def unsettled(self) -> set[str]:
        """Return the ids of the events whose joining is still being practised."""
        return {chain.target for chain in self.chains.values() if chain.joins and chain.open}

    def get_state(self) -> dict[str, Any]:
        """Return chains and the order of the options as plain data."""
        chains = [vars(chain) for chain in self.chains.values()]
        return {"chains": chains, "options": list(self.options), "n_made": self.n_made}

    def set_state(self, state: dict[str, Any], options: dict[str, Option]) -> None:
        """Restore what :meth:`get_state` returned.

        :param state: the state
        :param options: the restored options by id
        """
        self.chains = {spec["id"]: SkillChain(**spec) for spec in state["chains"]}
        self.options = {id: options[id] for id in state["options"]}
        self.n_made = state["n_made"]
        self.chain_of = {id: chain for chain in self.chains.values() for id in chain.options}
