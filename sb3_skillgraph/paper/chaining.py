"""Deep skill chaining: options learned backwards from an event until one can start where it must (sections 2.2, 3.2.5)."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from sb3_skillgraph.events import Event, TerminationSet
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.paper.graph import PaperGraph

MakeOption = Callable[[str, str, TerminationSet], Option]


@dataclass
class SkillChain:
    """Options that lead from one event to another, the last step first.

    :param source: id of the event where it must be possible to start
    :param target: id of the event it leads to
    :param back: whether it is the way back from an event that another chain has joined to the graph (section 3.2.7)
    :param options: ids of its options: the first (the root) ends in the target event, each next one in the initiation set
        of the one before
    :param complete: whether an option of it can be started all over the source event (section A.3); of a chain that joins an
        event to the graph, all over any event of the graph
    """

    source: str
    target: str
    back: bool = False
    options: list[str] = field(default_factory=list)
    complete: bool = False


class DeepSkillChaining:
    """Opens chains, lets their options gestate, and grows them until they are complete.

    :param graph: the skill graph, which mature options join
    :param make_option: makes a gestating option of an id for a target id and a termination set
    :param gestation_period: successes an option needs to mature
    """

    def __init__(self, graph: PaperGraph, make_option: MakeOption, gestation_period: int) -> None:
        self.graph = graph
        self.make_option = make_option
        self.gestation_period = gestation_period
        self.chains: list[SkillChain] = []
        self.options: dict[str, Option] = {}  # gestating ones too

    def open_chain(self, source: Event, target: Event, *, back: bool = False) -> SkillChain:
        """Begin the chain between two events, unless there is one.

        :param source: where it must be possible to start
        :param target: where it must lead
        :param back: whether it is a way back
        """
        for chain in self.chains:
            if (chain.source, chain.target) == (source.id, target.id):
                return chain
        chain = SkillChain(source.id, target.id, back)
        self._grow(chain, target.id, target)
        self.chains.append(chain)
        return chain

    def _grow(self, chain: SkillChain, target: str, termination: TerminationSet) -> None:
        option = self.make_option(f"o{len(self.options)}", target, termination)
        self.options[option.id] = option
        chain.options.append(option.id)

    def leading_to(self, event: str) -> list[SkillChain]:
        """Return the chains that lead to an event, those with something left to learn first.

        :param event: its id
        """
        return sorted((chain for chain in self.chains if chain.target == event), key=lambda chain: chain.complete)

    def admissible(self, chain: SkillChain, point: np.ndarray) -> Option | None:
        """Return the earliest option of a chain, counted from its target, that can start at a point.

        :param chain: the chain
        :param point: where the agent stands, shape ``(goal_dim,)``
        """
        return next((self.options[id] for id in chain.options if self.options[id].can_start(point)), None)

    # -- what runs teach ----------------------------------------------------------------------------------------------

    def learned(self, option: Option) -> None:
        """Fit where an option can start that has run, let it mature, and see what the chains still need."""
        refitted = option.initiation.refit(force=not option.mature)
        if not option.mature:
            if option.n_successes < self.gestation_period:
                return
            option.mature = True
            self.graph.add_option(option)
        self.graph.refresh(option, refitted)
        joined = self.graph.joined()
        for chain in self.chains:
            self._check(chain, joined)

    def _check(self, chain: SkillChain, joined: set[str]) -> None:
        """Tell whether a chain can be started where it must; if not, it grows by a child once its last option is mature."""
        sources = {chain.source} if chain.back else {chain.source, *joined} - {chain.target}
        chain.complete = any(self.graph.nx.has_edge(source, id) for source in sources for id in chain.options)
        last = self.options[chain.options[-1]]
        if last.mature and not chain.complete:
            self._grow(chain, last.id, last)

    def begin_inside(self, chain: SkillChain, option: Option) -> None:
        """Let a new chain's root start where another option can: it only has the last stretch to learn (section 3.3, b).

        :param chain: the chain
        :param option: the option whose initiation set holds the chain's target
        """
        root = self.options[chain.options[0]]
        root.initiation.set_state(option.initiation.get_state())
        root.mature = True
        self.graph.add_option(root)
        self.graph.refresh(root, refitted=True)

    # -- saving -------------------------------------------------------------------------------------------------------

    def get_state(self) -> dict[str, Any]:
        """Return the chains as plain data; options are saved by their owner."""
        return {"chains": [asdict(chain) for chain in self.chains]}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self.chains = [SkillChain(**spec) for spec in state["chains"]]
