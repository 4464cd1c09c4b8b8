"""What an agent could do, and what is known of it: what plans are made of."""

from typing import NamedTuple

import numpy as np

from sb3_skillgraph.edges import NOWHERE

#: What to count on for the success of options, in standard deviations above what is expected: while learning, so that what is
#: unknown is tried, and otherwise, so that it is not relied upon.
OPTIMISTIC, EXPECTED, PESSIMISTIC = 1.0, 0.0, -0.5
#: Runs that the model's guess counts for, beside those that there were.
GUESS_RUNS = 2.0


class Runs(NamedTuple):
    """The runs of the running episode, as indices; arrays of shape ``(n,)``.

    :param source: event that they began in
    :param target: event that the walk led to; the number of events for the walk to the goal
    :param success: whether they got there
    :param landing: event in which they ended
    :param number: how many there were of each
    """

    source: np.ndarray
    target: np.ndarray
    success: np.ndarray
    landing: np.ndarray
    number: np.ndarray


NO_RUNS = Runs(*np.zeros((5, 0), dtype=np.int64))


class Start(NamedTuple):
    """Where a plan begins.

    :param point: shape ``(goal_dim,)``
    :param event: index of the event that the next option is begun in; ``NOWHERE`` if in none
    :param towards: vertex that an option leads to which runs already; ``NOWHERE`` if none does
    """

    point: np.ndarray
    event: int
    towards: int = NOWHERE


class Choices(NamedTuple):
    """What can be done where, and what is known of it; one row for each.

    Vertices are numbered: the events by their indices, then the goal, then the start; ``NOWHERE`` is where one is lost.

    :param source: vertex where the option begins, shape ``(n,)``
    :param target: vertex where it leads
    :param guess: success rate of its kind
    :param successes: weight of its runs that succeeded
    :param failures: weight of those that failed
    :param steps: environment steps of a successful run
    :param failed_steps: of a failed one
    :param loss: share of the failures of its kind that end far away
    :param landing: vertices in which failed runs landed, shape ``(n, MAX_LANDINGS)``
    :param weight: weight of those, same shape
    """

    source: np.ndarray
    target: np.ndarray
    guess: np.ndarray
    successes: np.ndarray
    failures: np.ndarray
    steps: np.ndarray
    failed_steps: np.ndarray
    loss: np.ndarray
    landing: np.ndarray
    weight: np.ndarray

    def success(self, stance: float) -> np.ndarray:
        """Return the rate to count on: of the Beta distribution that guess and runs make, mean and deviation.

        :param stance: how many standard deviations to add to the mean
        """
        runs = GUESS_RUNS + self.successes + self.failures
        mean = (GUESS_RUNS * self.guess + self.successes) / runs
        return np.clip(mean + stance * np.sqrt(mean * (1.0 - mean) / (runs + 1.0)), 0.0, 1.0)

    def landings(self) -> tuple[np.ndarray, np.ndarray]:
        """Return where failures land: where they did, and, a failure's worth, as those of their kind do.

        :return: vertices, shape ``(n, m)``, and the shares of the failures, whose rows sum to 1
        """
        nowhere = np.full_like(self.source, NOWHERE)
        landing = np.concatenate([self.landing, np.stack([self.source, nowhere], axis=1)], axis=1)
        # Those of the kind end near where they began, or are lost.
        share = np.concatenate([self.weight, np.stack([1.0 - self.loss, self.loss], axis=1)], axis=1)
        return landing, share / share.sum(axis=1, keepdims=True)

    def outcomes(self, stance: float, for_good: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray]:
        """Return where runs end, and how likely each end is: the target first, then the landings of failures.

        :param stance: how many standard deviations above the mean the success is to be
        :param for_good: share of the failures of each, if it always fails, that are left out: they happen again and again
        :return: vertices and probabilities, both of shape ``(n, m + 1)``
        """
        success = self.success(stance)
        landing, share = self.landings()
        share = (1.0 - for_good * (1.0 - success))[:, None] * share
        probability = np.concatenate([success[:, None], (1.0 - success)[:, None] * share], axis=1)
        return np.concatenate([self.target[:, None], landing], axis=1), probability

    def take(self, rows: np.ndarray) -> "Choices":
        """Return a copy of some of the rows."""
        return Choices(*(column[rows] for column in self))

    @staticmethod
    def join(parts: list["Choices"]) -> "Choices":
        """Return the rows of all parts, one after the other."""
        return Choices(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))
