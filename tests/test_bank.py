"""Many sets asked together answer as each of them would."""

import numpy as np
import pytest
from builders import event, make_option
from hypothesis import given, settings
from hypothesis import strategies as st

from sb3_skillgraph.events import EventBank
from sb3_skillgraph.options.bank import OptionBank
from sb3_skillgraph.options.initiation import InitiationSet
from sb3_skillgraph.options.option import Option

POINT = st.tuples(st.floats(-6, 6), st.floats(-6, 6))


def fitted(paths: list[np.ndarray], failures: list[tuple[float, float]]) -> Option:
    option = make_option("o", "e0", event(0, 0.0, 0.0))
    for path in paths:
        option.initiation.add_success(path)
    for failure in failures:
        option.initiation.add_failure(np.array(failure))
    option.initiation.refit(force=True)
    return option


@settings(max_examples=40, deadline=None)
@given(
    st.lists(
        st.tuples(st.lists(st.tuples(POINT, POINT), min_size=1, max_size=4), st.lists(POINT, max_size=4)),
        min_size=1,
        max_size=20,
    ),
    st.lists(POINT, min_size=1, max_size=30),
)
def test_the_bank_answers_as_each_set_would(
    sets: list[tuple[list[tuple[tuple[float, float], tuple[float, float]]], list[tuple[float, float]]]],
    points: list[tuple[float, float]],
) -> None:
    bank, options = OptionBank(2), []
    for i, (ways, failures) in enumerate(sets):
        option = fitted([np.linspace(start, end, 15) for start, end in ways], failures)
        option.id = f"o{i}"
        options.append(option)
        bank.put(option)
    asked = np.array(points)
    indices, inside = bank.startable(asked)
    assert inside.shape == (len(points), len(indices))
    answers = np.zeros((len(points), len(options)), dtype=bool)
    answers[:, indices] = inside
    for column, option in zip(answers.T, options, strict=True):
        np.testing.assert_array_equal(column, option.initiation.optimistic(asked))
        lower, upper = option.initiation.optimistic_boundaries[0].box()
        assert ((asked[column] >= lower) & (asked[column] <= upper)).all()


def test_what_changed_is_put_in_anew() -> None:
    bank = OptionBank(2)
    assert bank.startable(np.zeros((3, 2)))[1].shape == (3, 0)
    option = make_option("o1", "e0", event(0, 0.0, 0.0))
    bank.put(option)
    assert len(bank.startable(np.zeros((3, 2)))[0]) == 0  # no set yet
    option.initiation = InitiationSet(1.0)
    option.initiation.add_success(np.linspace([-1.0, 0.0], [1.0, 0.0], 9))
    option.initiation.refit(force=True)
    bank.put(option)
    assert bank.startable(np.zeros((3, 2)))[1].all()
    assert bank.options == [option]


def test_options_by_the_middle_of_their_effects() -> None:
    bank = OptionBank(2)
    for i in range(40):  # more than the bank has room for at first
        bank.put(make_option(f"o{i}", "e0", event(0, 0.0, 0.0), effects=[(i - 9, 0), (i, 1), (i, -1), (i + 9, 0), (i, 0)]))
    bank.put(make_option("o40", "e0", event(0, 0.0, 0.0)))  # without effects
    assert [option.id for option in bank.ending_in(np.array([2.5, -0.5]), np.array([5.0, 0.5]))] == ["o3", "o4", "o5"]


def test_events_together() -> None:
    bank = EventBank(2)
    events = [event(i, 2.0 * i, 0.0, radius=1.5) for i in range(20)]
    for one in events:
        bank.add(one)
    points = np.random.default_rng(0).uniform([-3, -2], [45, 2], (50, 2))
    assert bank.shares(points).tolist() == pytest.approx([one.contains(points).mean() for one in events])
    for point in points:
        assert bank.holding(point) == [one for one in events if one.holds(point)]
    bank.triggered(events[3], np.array([[30.0, 0.0], [31.0, 0.0], [-90.0, 0.0]]))
    assert bank.triggered_in(np.array([29.0, -1.0]), np.array([31.0, 1.0])) == [events[3], events[15]]
