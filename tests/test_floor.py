"""`StepReport.floor` in float32, beside the true error; tests/results/floor_cpu.json, made by
`python -m tests.validation floor`."""

import numpy as np
import pytest
from result_files import content_of
from validation.floor import CASES, SEED, draw, tried

GIVEN = tuple(draw(np.random.default_rng(0)))
WORST = (0, 20, 43, 51)
"""Rows whose errors were 9.4, 6.6, 10 and 9.2 times what was told on 8934ce7, up to 1.5 %."""
MOST = 3.0
WITHIN = 1e-3
"""Of steps that reach their tolerance, 1e-4 of the forces."""


def assert_honest(row):
    assert row["outcome"] in ("accepted", "refused"), row
    if row["outcome"] == "accepted":
        assert row["error"] <= (MOST * row["floor"] if row["floor"] else WITHIN), row


@pytest.fixture(scope="module")
def rows():
    content = content_of("floor_cpu.json")
    assert content["settings"]["seed"] == SEED
    return content["rows"]


def test_no_error_is_more_than_three_times_what_is_told(rows):
    """Fails on 8934ce7: six are 6 to 16 times."""
    rng = np.random.default_rng(SEED)
    for row in rows:
        assert {name: row[name] for name in GIVEN} == pytest.approx(draw(rng))
    stable = [row for row in rows if row["stable"] is True]
    assert len(stable) >= CASES == 117
    for row in stable:
        assert_honest(row)
    accepted = [row for row in stable if row["outcome"] == "accepted"]
    assert len(accepted) > 0.6 * len(stable)
    assert sum(row["floor"] > 0.0 for row in accepted) > 50
    assert {row["element"] for row in accepted} == {"T4", "T10", "H3843", "3243", "3443"}
    assert {row["motion"] for row in accepted} == {True, False}


@pytest.mark.parametrize("number", WORST)
def test_soft_directions_are_seen(rows, number):
    """Fails on 8934ce7, see `WORST`."""
    row = tried({name: rows[number][name] for name in GIVEN}, "cpu")
    assert row["stable"]
    assert_honest(row)


@pytest.mark.slow
def test_the_table_is_what_is_found(rows):
    """Other machines round otherwise: outcomes near the bound may differ, the promise not."""
    for row in [row for row in rows if row["stable"] is True][::4]:
        assert_honest(tried({name: row[name] for name in GIVEN}, "cpu"))


@pytest.mark.cuda
def test_soft_directions_are_seen_on_a_gpu(rows):
    for number in WORST:
        assert_honest(tried({name: rows[number][name] for name in GIVEN}, "cuda:0"))
