"""Contact by multipliers beside the penalty: the result of `python tests/contact_multipliers.py`."""

import pytest
from contact_multipliers import inf_sup, statics
from result_files import content_of

CONTENT = content_of("contact_multipliers_cpu.json", "python tests/contact_multipliers.py", "cpu")
ELEMENTS = ("T4", "T10", "H3843")


def constants(element, kind, sides=False):
    """Inf-sup constants over the meshes, from the coarsest."""
    chosen = {"element": element, "multipliers": kind, "sides": sides}
    rows = [row for row in CONTENT["inf_sup"] if chosen.items() <= row.items()]
    assert [row["cells"] for row in rows] == [2, 4, 8]
    return [row["inf_sup"] for row in rows]


def row_of(problem, element, kind, stiffness=1.0, solves=1, loose=1e-3, during=False):
    """The row of a way to solve a static problem."""
    chosen = {"problem": problem, "element": element, "multipliers": kind, "stiffness": stiffness, "solves": solves,
              "loose": loose, "during": during}  # fmt: skip
    (row,) = (row for row in CONTENT["statics"] if chosen.items() <= row.items())
    return row


@pytest.mark.parametrize("element", ELEMENTS)
def test_hats_are_bounded_and_points_are_not(element):
    values = constants(element, "hats")
    assert min(values) > 0.3
    assert values[2] > 0.95 * values[1]
    assert max(constants(element, "points")) < 1e-6


def test_constants_for_each_facet_fall_with_the_mesh():
    assert max(constants("T4", "facets")) < 1e-6
    for element in ("T10", "H3843"):
        first, second, third = constants(element, "facets")
        assert second < 0.6 * first
        assert third < 0.6 * second


def test_hats_of_clamped_borders_have_to_change():
    assert max(constants("T4", "hats", sides=True) + constants("H3843", "hats", sides=True)) < 1e-6
    assert 0.05 < min(constants("T10", "hats", sides=True)) < max(constants("T10", "hats", sides=True)) < 0.1


def test_constants_are_those_of_this_code():
    known = [row for row in CONTENT["inf_sup"] if row["element"] == "T4" and row["cells"] == 2 and not row["sides"]]
    for row, now in zip(known, inf_sup("T4", 2, False), strict=True):
        assert now["inf_sup"] == pytest.approx(row["inf_sup"], rel=1e-6, abs=1e-6)
        assert (now["count"], now["rank"]) == (row["count"], row["rank"])


@pytest.mark.parametrize(("problem", "element"), [("floor", "T10"), ("hertz", "T10"), ("hertz", "T4")])
def test_cost_of_one_update_on_hats(problem, element):
    """At most a tenth where solves before the last one end at 1e-3, a fifth where all of them end at 1e-8."""
    penalty, hats = (row_of(problem, element, kind) for kind in ("none", "hats"))
    assert penalty["newton"] < hats["newton"] <= 1.05 * penalty["newton"]
    assert penalty["pcg"] < hats["pcg"] <= 1.1 * penalty["pcg"]
    assert hats["weighted"] < 0.3 * penalty["weighted"]
    tight = row_of(problem, element, "none", solves=0, loose=1e-8), row_of(problem, element, "hats", loose=1e-8)
    for count, most in (("newton", 1.15), ("pcg", 1.2)):
        assert tight[0][count] < tight[1][count] <= most * tight[0][count]


def test_an_update_is_that_of_this_code():
    known, now = row_of("floor", "T10", "hats"), statics("floor", "T10", "hats")
    assert now["force"] == pytest.approx(known["force"], rel=1e-6)
    assert now["weighted"] == pytest.approx(known["weighted"], rel=0.05)
    assert abs(now["newton"] - known["newton"]) <= 4


def test_on_a_flat_floor_stiffness_does_as_much():
    penalty, stiff, hats = (row_of("floor", "T10", *way) for way in (("none",), ("none", 1e3), ("hats",)))
    assert hats["deepest"] < 0.01 * penalty["deepest"]
    assert stiff["deepest"] < 0.2 * hats["deepest"]
    assert stiff["newton"] <= hats["newton"]
    assert stiff["pcg"] <= 1.05 * hats["pcg"]


def test_hertz_by_hats_is_that_of_three_times_the_stiffness_with_even_pressure():
    default, three, hats = (row_of("hertz", "T10", *way) for way in (("none",), ("none", 3.0), ("hats",)))
    rigid = row_of("hertz", "T10", "none", 1e3)["force"]
    off = [1.0 - row["force"] / rigid for row in (default, three, hats)]
    assert 0.014 < off[0] < 0.018
    assert 0.0 < off[2] < 1.1 * off[1] < 0.4 * off[0]
    assert three["deepest"] < hats["deepest"] < 0.5 * default["deepest"]
    assert hats["pressure_error"] < default["pressure_error"] < three["pressure_error"]
    assert hats["pcg"] < three["pcg"]
    assert row_of("hertz", "T10", "hats", solves=4)["deepest"] > 0.4 * default["deepest"]  # between corners, for ever


def test_points_constrain_too_much():
    """Peaks and errors of the pressure grow with each update, as with the stiffness."""
    for element in ("T4", "T10"):
        rows = [row_of("hertz", element, "none")] + [row_of("hertz", element, "points", solves=n) for n in (1, 2, 4)]
        errors = [row["pressure_error"] for row in rows]
        assert errors == sorted(errors)
        assert errors[-1] > 2.0 * errors[0]
        assert row_of("hertz", element, "none", 1e3)["pressure_error"] > errors[-1]
        hats = [row_of("hertz", element, "hats", solves=n)["pressure_error"] for n in (1, 2, 4)]
        assert max(hats) < errors[0]
    default, rigid = (row_of("hertz", "T4", "none", stiffness)["peak_over_hertz"] for stiffness in (1.0, 1e3))
    assert rigid > 5.0 * default


def test_a_falling_block_rests_without_depth_but_rebounds_more():
    runs = {(row["integrator"], row["dt"]) for row in CONTENT["drop"]}
    assert len(runs) == 4
    for run in runs:
        chosen = [row for row in CONTENT["drop"] if (row["integrator"], row["dt"]) == run]
        rows = {(row["multipliers"], row["stiffness"]): row for row in chosen}
        default, stiff = rows["none", 1.0], rows["none", 10.0]
        for kind in ("points", "hats"):
            row = rows[kind, 1.0]
            assert row["deepest_at_rest"] < 0.2 * default["deepest_at_rest"]
            assert row["rebound"] > 1.05 * default["rebound"]
            assert row["deepest"] > 2.0 * stiff["deepest"]
        assert stiff["rebound"] < 1.05 * default["rebound"]
