"""Growth: options get networks of their own where walks fail (sections 2.2, 3.2.5)."""

from typing import Any, Literal

from sb3_skillgraph.edges import NOWHERE
from sb3_skillgraph.graph import SkillGraph
from sb3_skillgraph.options.factory import OptionFactory, copy_policy
from sb3_skillgraph.options.option import Option
from sb3_skillgraph.running import Run

#: Runs that tell how good an option is, with noise or without: few are without.
ENOUGH_RUNS = 20
#: A walk fails that has reached its event in no more of so many runs.
FAILING = 10
#: Runs for which a skill learns before it is asked what it is good for.
GESTATION = 60
#: So many more runs must succeed than did before: of skills that are as good as the walk an eighth will seem so much better.
GAIN = 4


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
        :raises ValueError: if there is no such walk
        """
        index = self.graph.index(walk)
        if index == NOWHERE:
            raise ValueError(f"There is no walk {walk!r} in the graph (any more).")
        skill = self[walk] = self.factory.make(walk, self.graph.events[index].id, self.graph.events[index])
        skill.mature = True
        return skill

    def specialise(self, walk: str) -> Option:
        """Put a skill in the place of a walk that begins as a copy of it.

        :param walk: its id
        :raises ValueError: if there is no such walk
        """
        if walk not in self:
            copy_policy(self.walker, self.make(walk))
        return self[walk]


class Growth:
    """Begins a skill where a walk keeps failing, and drops it again if it is no better.

    The graph does the chaining: where a skill ends, in an event, other options begin. The walk's edges keep their records,
    which age as the skill learns.

    :param mode: ``"where_needed"``, ``"always"`` (whenever a walk has run), or ``"never"``
    :param graph: the skill graph
    :param skills: the skills
    """

    def __init__(self, mode: Literal["where_needed", "always", "never"], graph: SkillGraph, skills: Skills) -> None:
        self.mode = mode
        self.graph = graph
        self.skills = skills
        self._runs: dict[str, list[bool]] = {}  # which runs succeeded, since the option was last judged
        self._suspects: set[str] = set()  # the walks that have failed, of which is measured how often they do
        self._before: dict[str, int] = {}  # successes of the walks in whose place there is a skill on trial
        self._again: dict[str, float] = {}  # the updates of the walker before which there is not to be another

    def specialise(self, walk: str) -> Option:
        """Give a walk a network of its own for good (see :meth:`Walk.specialise`).

        :param walk: its id
        :raises ValueError: if there is no such walk
        """
        # No trial any more
        self._before.pop(walk, None)
        self._runs.pop(walk, None)
        return self.skills.specialise(walk)

    def ended(self, run: Run) -> None:
        """A run has ended.

        :param run: what became of it
        """
        walk = run.option
        if self.graph.index(walk) == NOWHERE:
            return
        if walk in self.skills:
            self.skills[walk].n_runs += 1
            self.skills[walk].n_successes += run.success
        if self.mode == "always":
            self.skills.specialise(walk)
        if self.mode == "where_needed":
            runs = self._runs.setdefault(walk, [])
            runs.append(run.success)
            if len(runs) >= (GESTATION if walk in self._before else ENOUGH_RUNS):
                self._judge(walk, sum(runs[-ENOUGH_RUNS:]))
                runs.clear()

    def _judge(self, walk: str, n_successes: int) -> None:
        """Begin a skill, or drop it.

        :param walk: id of the option
        :param n_successes: of its last runs
        """
        # A skill that is no better than the walk was goes again, until the walker has learned as much once more
        if walk in self._before:
            if n_successes < self._before.pop(walk) + GAIN:
                self.skills.pop(walk, None)
                self._again[walk] = 2.0 * self.graph.now
        elif walk in self.skills:
            return
        # A walk that has failed is measured anew: the runs that made it a suspect were unlucky ones, too
        elif walk in self._suspects:
            self._suspects.remove(walk)
            if n_successes + GAIN <= ENOUGH_RUNS:
                self._before[walk] = n_successes
                self.skills.specialise(walk)
        elif n_successes <= FAILING and self.graph.now >= self._again.get(walk, 0.0):
            self._suspects.add(walk)

    def merged(self) -> None:
        """Forget options to events that are gone, after others were merged."""
        for known in (self.skills, self._runs, self._before, self._again):
            for walk in [walk for walk in known if self.graph.index(walk) == NOWHERE]:
                del known[walk]
        self._suspects = {walk for walk in self._suspects if self.graph.index(walk) != NOWHERE}

    def get_state(self) -> dict[str, Any]:
        """Return everything as plain data."""
        runs = {walk: list(successes) for walk, successes in self._runs.items()}
        return {"runs": runs, "suspects": sorted(self._suspects), "before": dict(self._before), "again": dict(self._again)}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what :meth:`get_state` returned."""
        self._runs = {walk: list(successes) for walk, successes in state["runs"].items()}
        self._suspects = set(state["suspects"])
        self._before, self._again = dict(state["before"]), dict(state["again"])
