"""Growth: options get networks of their own where walks fail (sections 2.2, 3.2.5)."""

from collections import deque
from typing import Any, Literal

from sb3_skillgraph.edges import NOWHERE
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.options.factory import OptionFactory, copy_policy
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.running import Run

#: Runs that tell how good an option is now: the last so many.
RECENT = 20
#: A walk fails if it does so in this share of its recent runs.
FAILING = 0.5
#: Runs for which a skill learns before it is asked what it is good for: the paper's options are mature sooner, but there
#: nothing else could take their place.
GESTATION = 60
#: By so much must it succeed more often than the walk did: half of what twenty runs can err by.
GAIN = 0.1


class Skills(dict[str, Option]):
    """The options that have a network of their own, by the ids of the walks in whose place they run.

    :param graph: the skill graph
    :param factory: makes options
    :param walker: the option that walks to any goal
    """

    def __init__(self, graph: SkillGraph, factory: OptionFactory, walker: Option) -> None:
        super().__init__()
        self.graph = graph
        self.factory = factory
        self.walker = walker

    def make(self, walk: str) -> Option:
        """Put a new skill in the place of a walk.

        :param walk: its id
        """
        event = self.graph.events[self.graph.index(walk)]
        skill = self[walk] = self.factory.make(walk, event.id, event)
        skill.mature = True
        return skill

    def specialise(self, walk: str) -> Option:
        """Put a skill in the place of a walk that begins as a copy of it (see :meth:`Walk.specialise`).

        :param walk: its id
        """
        if walk not in self:
            copy_policy(self.walker, self.make(walk))
        return self[walk]


class Growth:
    """Begins a skill where a walk keeps failing, and drops it again if it is no better.

    The graph does the chaining: where a skill ends, in an event, other options begin.

    :param mode: ``"where_needed"``, ``"always"`` (whenever a walk has run), or ``"never"``
    :param graph: the skill graph
    :param skills: the skills
    """

    def __init__(self, mode: Literal["where_needed", "always", "never"], graph: SkillGraph, skills: Skills) -> None:
        self.mode = mode
        self.graph = graph
        self.skills = skills
        self._recent: dict[str, deque[bool]] = {}  # whether runs succeeded
        self._before: dict[str, float] = {}  # the success rate of walks in whose place there is a skill on trial
        self._again: dict[str, float] = {}  # the updates of the walker before which there is not to be another

    def ended(self, run: Run) -> None:
        """A run has ended.

        :param run: what became of it
        """
        if self.mode == "never" or self.graph.index(run.option) == NOWHERE:
            return
        if self.mode == "always":
            self.skills.specialise(run.option)
            return
        recent = self._recent.setdefault(run.option, deque(maxlen=RECENT))
        recent.append(run.success)
        skill = self.skills.get(run.option)
        if skill is not None:
            skill.n_runs += 1
            skill.n_successes += run.success
        if len(recent) == RECENT:
            self._judge(run.option, skill, sum(recent) / RECENT)

    def _judge(self, walk: str, skill: Option | None, rate: float) -> None:
        """Begin a skill, or drop it.

        :param walk: id of the option
        :param skill: the skill in its place, if there is one
        :param rate: share of its recent runs that succeeded
        """
        # A walk that keeps failing gets a network of its own
        if skill is None and rate <= 1.0 - FAILING and self.graph.now >= self._again.get(walk, 0.0):
            self.skills.specialise(walk)
            self._before[walk] = rate
            self._recent[walk].clear()
        # A skill that is no better than the walk was goes again, until the walker has learned as much once more
        elif skill is not None and walk in self._before and skill.n_runs >= GESTATION:
            gain = rate - self._before.pop(walk)
            if gain < GAIN:
                del self.skills[walk]
                self._again[walk] = 2.0 * self.graph.now
                self._recent[walk].clear()

    def get_state(self) -> dict[str, Any]:
        """Return everything as plain data; nothing of events that are gone."""
        recent = {walk: list(runs) for walk, runs in self._recent.items()}
        kept = {"recent": recent, "before": self._before, "again": self._again}
        return {name: {k: v for k, v in of.items() if self.graph.index(k) != NOWHERE} for name, of in kept.items()}  # type: ignore[attr-defined]

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self._recent = {walk: deque(runs, maxlen=RECENT) for walk, runs in state["recent"].items()}
        self._before, self._again = dict(state["before"]), dict(state["again"])
