"""A few hundred damaged and hostile files; ``python -m tests.fuzz --n 5000`` tries thousands."""

import pytest
from fuzz import run

#: Mutations of each kind; another stretch of their numbers than the one that was mended first.
N = {"agent": 150, "replay": 50, "parameters": 50}


@pytest.mark.parametrize("kind", N)
def test_damaged_files_are_refused_or_work(kind: str) -> None:
    counts, failures = run(kind, list(range(100_000, 100_000 + N[kind])), learn_steps=40)
    assert not failures, "\n".join(failures)
    assert counts["refused"] > 0.3 * N[kind]
    assert counts["works"] > 0.03 * N[kind]
