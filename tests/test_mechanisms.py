"""Joints against mechanisms computed without warpfea: the committed numbers, and small versions of them live.

`python -m tests.validation mechanisms` makes tests/results/mechanisms.json; what takes minutes is read from there, and
the part flexible_slider_crank, made at 51a4e5d and no longer kept.
"""

import itertools
import json
import pathlib

import pytest
from validation import mechanisms as report
from validation.table import Run

import warpfea as wf

QUICK = Run(quick=True)
HERE = pathlib.Path(__file__).resolve().parent


@pytest.fixture(scope="module")
def parts():
    content = json.loads((HERE / "results" / "mechanisms.json").read_text())
    assert set(content["parts"]) == {*report.TABLE.parts, "flexible_slider_crank"}
    for part in content["parts"].values():
        assert {"command", "commit", "machine", "versions", "rows"} <= set(part)
        assert "--quick" not in part["command"]
    return {name: part["rows"] for name, part in content["parts"].items()}


def select(rows, **values):
    found = [r for r in rows if all(r[k] == v for k, v in values.items())]
    assert found, values
    return found


# the bars


def check_rigid(rows):
    rigid = [r for r in rows if r["deformation"] < 1e-6]
    assert rigid
    for r in rigid:
        assert r["turns"] > 1.0
        assert max(r["slider_error"], r["pin_error"], r["off_line"]) < 1e-5
        assert r["violation_over_size"] <= 1e-8
    return rigid


def check_chain(rows):
    for r in rows:
        assert len(r["errors"]) == r["links"] == 10
        assert max(r["errors"]) == r["force_error"] < 1e-6, r
        assert r["moment_error"] < 1e-6


def check_drift(row, steps):
    assert row["unknowns"] <= 50
    assert row["steps"] == row["recorded"] == steps
    assert row["violation_max"] <= 1e-8
    assert row["gap_max"] <= 1e-8
    assert row["crossing"] <= 1e-8
    assert row["swing_last"] > 0.05  # m: it has not come to rest
    assert row["force_max"] > 1.0


def check_fall(rows):
    for r in rows:
        assert r["converged"], r
        assert r["error"] < 1e-10, r
        assert r["violation_over_size"] <= 1e-8
        if r["case"] == "fall" and not r["halvings"]:
            assert r["error"] < 1e-13
    for r in rows:
        if r["case"] == "beside an impact":
            assert r["halvings"] > 0
        if r.get("velocity_error") is not None:
            assert r["velocity_error"] < 1e-10
    for r in rows:
        if r.get("moment_balance") is not None:
            loose = "tol" in r["solver"] or r["solver"].get("multipliers") == "outer"
            assert r["moment_balance"] < (1e-5 if loose else 1e-9), r
    halved = [r for r in rows if r["case"] == "spin" and "max_newton" in r["solver"]]
    assert {r["integrator"] for r in halved} == {"backward_euler", "bdf2"}
    assert all(r["halvings"] > 0 for r in halved)


# the committed numbers


def test_rigid_slider_crank(parts):
    rows = parts["rigid_slider_crank"]
    assert len(check_rigid(rows)) >= 3
    # what is left is compliance: it falls with 1 / E
    series = [r["slider_error"] for r in rows if r["speed"] == 15.0 and r["dt"] == rows[0]["dt"]]
    assert len(series) == 5
    for a, b in itertools.pairwise(series):
        assert a / b == pytest.approx(10.0, rel=0.05)


def test_flexible_slider_crank_agrees_with_the_floating_frame(parts):
    rows = parts["flexible_slider_crank"]
    assert min(r["peak"] for r in rows) > 1.8e-3  # m, of 0.3 m
    for series in ("time", "mesh"):
        finest = select(rows, series=series)[-1]
        assert finest["from_model"] < 0.02, finest
        assert finest["limit_from_model"] < 0.02
        assert finest["slider_from_model"] < 1e-4
    # the shear and the rotary inertia that the reference neglects are most of what is left
    with_shear = select(rows, series="mesh", elements=8)[0]["from_model"]
    assert select(rows, series="shear")[0]["from_model"] < 0.6 * with_shear


def test_flexible_slider_crank_converges(parts):
    rows = parts["flexible_slider_crank"]
    for series, count in (("time", 7), ("mesh", 4)):
        found = select(rows, series=series)
        assert len(found) == count
        for name in ("from_limit", "slow_from_limit"):
            errors = [r[name] for r in found]
            assert all(b < a for a, b in itertools.pairwise(errors))
            assert errors[-1] < 5e-4
    for r in select(rows, series="time")[3:]:
        assert r["slow_order"] == pytest.approx(2.0, abs=0.2), r
    assert all(r["order"] > 2.5 for r in select(rows, series="mesh")[2:])


def test_double_pendulum(parts):
    rows = parts["double_pendulum"]
    time, stiffness = select(rows, series="time"), select(rows, series="stiffness")
    for r in (time[-1], *select(rows, series="low"), *select(rows, series="solid")):
        assert max(r["elbow_error"], r["tip_error"]) < 1e-4, r
        assert r["steps"] * r["dt"] == pytest.approx(2.0)
    for r in time[1:]:
        assert r["order"] == pytest.approx(2.0, abs=0.15)
    errors = [r["tip_error"] for r in stiffness]
    assert len(errors) == 3
    assert all(b < 0.3 * a for a, b in itertools.pairwise(errors))


def test_hanging_chain(parts):
    rows = parts["hanging_chain"]
    check_chain(rows)
    assert {(r["way"], r["element"]) for r in rows} == {(w, e) for w in ("static", "dynamic") for e in ("3243", "T10")}
    assert {r["joints"] for r in rows} >= {"fixed", "spherical", "revolute", "universal"}


def test_no_drift(parts):
    (row,) = parts["no_drift"]
    check_drift(row, 100_000)
    # no trend: what drifts with the number of steps would be 19 times as large in the last tenth as in the first
    assert len(row["mean_by_tenths"]) == len(row["max_by_tenths"]) == 10
    assert max(row["mean_by_tenths"][5:]) < 4.0 * max(row["mean_by_tenths"][:5])
    assert row["gap_last"] < 4.0 * row["gap_first"]


def test_free_fall(parts):
    rows = parts["free_fall"]
    check_fall(rows)
    for tie in report.TIES:
        for integrator in ("backward_euler", "bdf2"):
            found = select(rows, case="fall", joint=tie, integrator=integrator)
            assert {r["solver"].get("multipliers", "newton") for r in found} == {"newton", "outer"}
            assert {r["solver"].get("penalty", 0.0) for r in found} == {0.0, 1.0, 1e4}
            select(rows, case="spin", joint=tie, integrator=integrator)
            select(rows, case="beside an impact", joint=tie, integrator=integrator)


def test_angular_momentum_of_a_tied_pair_is_that_of_one_body(parts):
    welded = select(parts["free_fall"], case="welded")
    for joint in ("weld", "fixed", "revolute", "spherical"):
        found = select(welded, joint=joint)
        assert [r["E"] for r in found] == sorted(r["E"] for r in found)
        assert found[0]["from_one_body"] < 1e-6
        assert found[-1]["from_one_body"] < 1e-9
        assert 0.8 < found[-1]["kept"] < 0.95  # backward Euler does lose some


# live, on small cases


def test_rigid_slider_crank_live():
    check_rigid(report.rigid_slider_crank(QUICK))


def test_double_pendulum_live():
    (row,) = report.double_pendulum(QUICK)
    assert max(row["elbow_error"], row["tip_error"]) < 1e-4


def test_hanging_chain_live():
    check_chain(report.hanging_chain(QUICK))


def test_no_drift_live_and_resumed(tmp_path):
    """1000 steps; and the same again from a checkpoint after 500: bit for bit, with all that was recorded."""
    again_quick = Run(quick=True, out=tmp_path / "mechanisms.json")
    path = again_quick.checkpoint("no_drift")
    whole, joints = report.swing("cpu")
    whole.run(0.5, outputs=[wf.Checkpoint(path)], progress=False)
    whole.run(1.0, progress=False)
    again, same = report.swing("cpu")
    again.resume(path)
    assert again.steps == 500
    again.run(1.0, progress=False)
    assert again.steps == whole.steps == 1000
    for name, values in whole.state.numpy().items():
        assert again.state.numpy()[name].tobytes() == values.tobytes(), name
    for a, b in zip(joints, same):
        first, second = whole.joint_record(a), again.joint_record(b)
        for column in ("time", "force", "moment", "violation"):
            assert getattr(first, column).tobytes() == getattr(second, column).tobytes()
    assert again.probe("tip").position.tobytes() == whole.probe("tip").position.tobytes()
    (row,) = report.no_drift(again_quick)  # the table goes on from a checkpoint, too
    assert row["resumed_at"] == 500
    assert not path.exists()
    check_drift(row, 1000)
    assert row["violation_max"] == max(whole.joint_record(j).violation.max() for j in joints) / whole.model.size


@pytest.mark.slow
def test_free_fall_live():
    rows = list(report.free_fall(QUICK))
    assert len(rows) > 50
    check_fall(rows)


@pytest.mark.parametrize("penalty", [100.0, 1e4])
def test_classical_multipliers_of_a_stiff_pair(penalty):
    """A pair at E = 2 GPa that falls without any force in it, with the classical augmented Lagrangian."""
    row = report.fall_of_a_pair("cpu", 2e9, "revolute", "T10", "backward_euler", report.OUTER | {"penalty": penalty})
    assert row["converged"], row["why"]
    assert row["error"] < 1e-10
