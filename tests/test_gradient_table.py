"""The table of gradients, `results/gradients_cpu.json`, and one row of it."""

import itertools

import gradient_table as table
import numpy as np
import pytest
from result_files import content_of

MUST, AIM = 1e-7, 1e-8


@pytest.fixture(scope="module")
def found():
    return content_of("gradients_cpu.json", "python tests/gradient_table.py", "cpu")


def test_all_rows_agree_with_differences(found):
    """Of the errors nine in ten meet the aim."""
    cases = [(r["parameters"], r["element"], r["law"], r["integrator"], r["steps"]) for r in found["rows"]]
    assert cases == table.cases()
    errors = np.array([error for row in found["rows"] for error in row["errors"].values()])
    assert (errors < MUST).all()
    assert (errors < AIM).mean() > 0.9
    assert max(row["residual"] for row in found["rows"]) < 1e-10


def test_the_table_has_every_pair():
    """But those of drives that are left out."""
    axes = (table.KINDS, table.ELEMENTS, tuple(table.LAWS), table.SCHEMES, table.STEPS)
    for i, j in itertools.combinations(range(5), 2):
        pairs = {(case[i], case[j]) for case in table.cases()}
        missing = {*itertools.product(axes[i], axes[j])} - pairs
        assert all((i, j) == (0, 3) and table.left_out(*pair) for pair in missing), missing


def test_remainders_of_scenes_are_of_second_order(found):
    assert [row["scene"] for row in found["taylor"]] == list(table.SCENES)
    for row in found["taylor"]:
        ratios = np.array(row["remainders"][:-1]) / row["remainders"][1:]
        assert ratios == pytest.approx(4.0, rel=0.1), row
        assert row["remainders"][-1] < 0.1 * row["change"]


def test_a_long_run(found):
    """Its gradient grows, and is right."""
    assert found["long"]["steps"] == 1000
    assert found["long"]["error"] < MUST
    assert found["long"]["growth"] > 10.0


def test_a_row_again():
    row = table.row("force", "T4", "SVK", "generalized_alpha", 3, (1e-2, 1e-3))
    assert row["errors"]["force"] < AIM
    assert row["growth"] > 0.0
