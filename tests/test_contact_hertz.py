"""The result of `python -m tests.validation contact`, and a coarse run: Hertz, Mindlin, an elastic ball's rebound."""

import pytest
from result_files import content_of
from validation.contact import hertz_case, rebound_case

MOST_NEWTON = 50
"""Iterations of a load step in which points begin to slip."""


@pytest.mark.parametrize("nu", [0.3, 0.45])
def test_pressure_is_hertz_with_the_stiffness_of_the_region(nu):
    """Times 300: held."""
    rows = content_of("contact_hertz_region_cpu.json", device="cpu")["hertz"]
    row = max((row for row in rows if row["nu"] == nu), key=lambda row: row["unknowns"])
    assert row["stiffness"] == 300.0
    assert 0.0 < row["penalty_share"] < 0.01
    assert abs(row["a_error"]) < 0.03
    assert abs(row["p0_error"]) < 0.03


def test_slip_is_mindlin_with_the_stiffness_of_the_region():
    (row,) = content_of("contact_hertz_region_cpu.json", device="cpu")["mindlin"]
    for name in ("slope_ratio_error", "full_slip_first_error", "full_slip_fitted_error"):
        assert abs(row[name]) < 0.05


@pytest.fixture(scope="module")
def result():
    content = content_of("contact_hertz_cpu.json", "python -m tests.validation contact", "cpu")
    assert content["settings"]["block"]["contact_radius"] <= 0.03 * content["settings"]["block"]["sphere_radius"]
    return content


def finest(rows):
    return max(rows, key=lambda row: row["unknowns"])


@pytest.mark.parametrize("nu", [0.3, 0.45])
def test_pressure_is_hertz(result, nu):
    rows = [row for row in result["hertz"] if row["nu"] == nu]
    row = finest(rows)
    assert len(rows) >= 2
    assert row["depth_over_a"] >= 40.0
    assert row["a_over_R"] <= 0.03
    assert row["stiffness"] is None  # that of the elements, by default
    assert 0.0 < row["penalty_share"] < 0.02
    assert abs(row["a_error"]) < 0.03
    assert abs(row["p0_error"]) < 0.03
    assert row["newton"] <= 30 * row["load_steps"]


def test_tangential_stiffness_and_full_slip_are_mindlin(result):
    """Stiffnesses are off by the mesh's error: between the even zone and 60 radii, five or eight layers of elements."""
    coarse, row = result["mindlin"]
    assert row["unknowns"] > 2 * coarse["unknowns"]
    assert row["nu"] == 0.45
    assert row["depth_over_a"] >= 40.0
    assert row["first_share"] < 0.05
    assert row["stiffness"] is None
    names = ("slope_ratio", "normal_stiffness", "tangential_stiffness", "full_slip_first", "full_slip_fitted")
    for name in names:
        assert abs(row[f"{name}_error"]) < 0.03
        assert abs(row[f"{name}_error"]) < abs(coarse[f"{name}_error"])
    assert row["halvings"] == 0
    assert row["newton_most"] <= MOST_NEWTON


def test_rebound_of_a_ball_does_not_depend_on_step_and_mesh(result):
    coarse, fine = sorted(result["rebound"], key=lambda row: row["unknowns"])
    assert fine["cells"] == 2 * coarse["cells"]
    assert fine["dt"] == pytest.approx(0.25 * coarse["dt"])
    assert coarse["restitution"] == pytest.approx(fine["restitution"], rel=0.02)
    assert coarse["duration"] == pytest.approx(fine["duration"], rel=0.02)
    for row in (coarse, fine):
        assert abs(row["ledger_residual"]) < 1e-6
        assert row["halvings"] == 0
        assert row["newton_most"] <= 30


@pytest.mark.parametrize(("stiffness", "share"), [(None, 0.03), (300.0, 0.01)])
def test_coarse_block_is_near_hertz(stiffness, share):
    row = hertz_case(0.3, inner=4, outer=4, load_steps=2, stiffness=stiffness)
    assert row["penalty_share"] < share
    assert abs(row["a_error"]) < 0.05
    assert abs(row["p0_error"]) < 0.05


def test_coarse_ball_comes_back():
    row = rebound_case(cells=4, steps=25)
    assert 0.95 < row["restitution"] < 1.0
    assert row["duration_over_hertz"] == pytest.approx(1.0, abs=0.1)
    assert abs(row["ledger_residual"]) < 1e-6
