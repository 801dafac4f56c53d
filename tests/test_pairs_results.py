"""Results of balls and cylinders beside Hertz, and of a stack that rests."""

import pytest
from result_files import content_of


@pytest.fixture(scope="module")
def result():
    return content_of("contact_hertz_pairs_cpu.json", "python tests/contact_hertz_pairs.py", "cpu")


@pytest.mark.parametrize("stiffness", [None, 300.0])
@pytest.mark.parametrize(("part", "numbers"), [("balls", ("a_error", "p0_error", "approach_error")),
                                               ("cylinders", ("a_error", "p0_error"))])  # fmt: skip
def test_two_bodies_are_hertz(result, part, numbers, stiffness):
    """Meshes that do not match, of two moduli, by default and with the region's stiffness; the approach without what
    the contact's springs give."""
    coarse, fine = sorted(
        (row for row in result[part] if row["stiffness"] == stiffness), key=lambda row: row["unknowns"]
    )
    assert fine["cells_per_radius"][0] != fine["cells_per_radius"][1]
    assert fine["a_over_R"] <= 0.03
    assert fine["depth_over_a"] >= 25.0
    for name in numbers:
        assert abs(fine[name]) < 0.03
    assert fine["pressure_scatter"] < (0.04 if stiffness is None else coarse["pressure_scatter"])
    assert fine["newton"] <= 30 * fine["load_steps"]


def test_stacks_rest():
    result = content_of("contact_pairs_cpu.json", "warpfea study contact", "cpu")
    assert [(row["E"], row["top"]) for row in result["stack"]] == [(1e7, 1.0), (1e10, 1.0), (2e9, 1e3), (1e10, 1e3)]
    for row in result["stack"]:
        assert row["cubes"] == 10
        assert row["duration"] == 10.0
        assert row["creep"] < 1e-3
        assert row["force_error"] < 1e-5


def test_price_of_clipping():
    """Between bodies at most twice the points and the step; obstacles cost at most a quarter more iterations."""
    rows = content_of("contact_clipping_cpu.json", "python tests/contact_clipping_price.py", "cpu")["rows"]
    assert [row["clipping"] for row in rows] == [False, True] * 4
    for without, row in zip(rows[::2], rows[1::2]):
        assert (row["other"], row["unknowns"]) == (without["other"], without["unknowns"])
        most = {"points": 2.1, "ms_per_step": 2.0, "newton_per_step": 1.2, "pcg_per_step": 1.25}
        assert all(row[name] <= ratio * without[name] for name, ratio in most.items())
