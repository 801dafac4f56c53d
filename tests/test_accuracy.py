"""`wf.study`: errors against motions that are known, orders, failures, the problems."""

import csv
import itertools
import math
import pathlib
import shlex

import numpy as np
import pytest
from accuracy_runs import STEPS, G, T, falling, run

import warpfea as wf
from warpfea.builder.reference import make_reference
from warpfea.builder.scene import locate
from warpfea.cli.parser import parse
from warpfea.studies.accuracy import Row, Study
from warpfea.studies.accuracy.report import with_orders
from warpfea.studies.accuracy.settings import setting_product, sweep_axes

BOTH = ["backward_euler", "bdf2"]
PROBLEMS = pathlib.Path(__file__).parent / "validation" / "problems"


@pytest.fixture(scope="module")
def fall():
    return run(over={"dt": STEPS}, methods=BOTH, target=0.02, split="best")


# errors


@pytest.mark.slow
def test_errors_of_a_fall_are_those_of_the_scheme(fall):
    """Backward Euler falls g h t / 2 too far, and loses g^2 h t / 2 of energy per mass in t."""
    assert isinstance(fall[0], Row)
    for row in fall[:3]:
        h = row.setting.dt
        t = np.arange(h, T + h / 2, h)
        assert row.end == pytest.approx(h / T, rel=1e-8)
        assert row.l2 == pytest.approx(np.sqrt(np.mean((G * h * t / 2) ** 2)) / (G * T * T / 2), rel=1e-8)
        kinetic = 0.5 * G * G * T * T
        potential = G * G * T * (T + h) / 2
        assert row.energy == pytest.approx(0.5 * G * G * h * T / max(kinetic, potential), rel=1e-6)
        assert row.resolved
        assert row.own_error == 0.0
        assert row.probes["face"] == {"end": row.end, "l2": row.l2}


@pytest.mark.slow
def test_orders_are_observed(fall):
    assert "dt" not in fall[0].orders
    assert [row.orders["dt"] for row in fall[1:3]] == pytest.approx([1.0, 1.0], abs=0.1)
    assert [row.orders["dt"] for row in fall[4:]] == pytest.approx([2.0, 2.0], abs=0.15)
    fits = {fit["curve"]: fit for fit in fall.fits()}
    assert set(fits) == set(BOTH)
    assert fits["bdf2"]["order"] == pytest.approx(2.0, abs=0.1)
    assert fits["bdf2"]["rows"] == 3


@pytest.mark.slow
def test_a_row_tells_what_the_run_took(fall):
    for row in fall:
        assert (row.steps, row.repeats) == (round(T / row.setting.dt), 1)
        assert 0.0 < row.seconds_min <= row.seconds
        assert (row.newton, row.pcg) == (0, 0)  # the first iterate of a free fall is exact
        assert row.bytes > 1000
        assert row.unknowns == 81
        assert row.efficacy == pytest.approx(-math.log10(row.error * row.seconds))
    front = sorted((row.seconds, row.error) for row in fall if row.pareto)
    assert front
    assert all(a[1] > b[1] for a, b in itertools.pairwise(front))


@pytest.mark.slow
def test_the_target_is_answered_with_the_cheapest_row(fall):
    good = [row for row in fall if row.error <= 0.02]
    assert fall.answer.seconds == min(row.seconds for row in good)
    words = shlex.split(fall.command)
    assert words[:3] == ["warpfea", "run", "falling"]
    options = parse(words[1:])
    assert (options.integrator, options.dt) == (fall.answer.setting.method, fall.answer.setting.dt)
    assert f"cheapest that reaches 0.02: {fall.label(fall.answer)}" in fall.verdict()
    assert fall.command in fall.table()


def test_the_answer_is_run_again_with_other_steps():
    """Backward Euler falls too far by g h t / 2; steps are rounded to what divides the duration."""
    found = run(over={"dt": [5e-4, 2.5e-4]}, target=0.02, methods=["backward_euler"])
    answer = found.answer.setting
    assert [c.setting.dt for c in found.checks] == [T / round(T / (f * answer.dt)) for f in (0.9, 1.1)]
    for check in found.checks:
        assert check.setting.method == answer.method
        assert check.error == pytest.approx(found.answer.error * check.setting.dt / answer.dt, rel=0.02)
        assert f"dt={check.setting.dt:.12g}: error" in found.verdict()
    assert len(found.content(["study"])["checks"]) == 2
    assert run(over={"dt": [5e-3]}, target=1e-9).checks == []


@pytest.mark.slow
def test_a_row_tells_the_energy_ledger(fall):
    """Of the energy exchanged: what falls is potential and becomes kinetic, less what backward Euler takes."""
    for row in fall:
        ledger = row.ledger
        assert ledger["potential"] == pytest.approx(-1.0, abs=1e-9)
        assert ledger["kinetic"] + ledger["integrator"] == pytest.approx(1.0, abs=1e-6)


def test_refusals_for_one_reason_are_told_once(tmp_path):
    found = run(over={"dt": STEPS[:2], "error": [1e-2, 1e-3]}, methods=["energy_momentum"])
    refused = [line for line in found.omissions() if "no estimate" in line]
    assert len(refused) == 1
    assert "error=0.01; energy_momentum, error=0.001: refused" in refused[0]
    assert [r.status for r in found] == ["done", "done", "refused", "refused"]


@pytest.mark.slow
def test_parts_of_the_error(fall):
    """In a fall all is time: for backward Euler the difference of steps gives it exactly, for BDF2 nearly."""
    (row,) = [r for r in fall if r.split is not None]
    assert row is fall.answer
    assert row.split["time"] == pytest.approx(row.l2, rel=0.15)
    assert row.split["space"] < 1e-9
    assert row.split["algebra"] < 1e-9
    assert row.split["rounding"] < 1e-13


def test_a_finer_run_estimates_its_own_error():
    found = run(over={"dt": STEPS}, methods=BOTH, reference="run")
    known = run(over={"dt": STEPS}, methods=BOTH)
    (reference,) = found.references
    assert "bdf2, dt = 0.0001563 s" in reference["about"]
    exact = run(over={"dt": [STEPS[-1] / 8]}, methods=["bdf2"], tol=1e-10)[0]
    assert 0.5 * exact.l2 < reference["own_error"]["l2"] < 2.0 * exact.l2
    for a, b in zip(found, known):
        assert a.l2 == pytest.approx(b.l2, rel=0.03)
        assert a.resolved
    coarse = run(over={"dt": STEPS}, methods=["bdf2"], reference="run", finer={"dt": STEPS[-1] / 2})
    assert [row.resolved for row in coarse] == [True, True, False]
    assert "dt" not in coarse[2].orders
    assert "not resolved" in coarse.table()
    assert "not resolved" in coarse.omissions()[0]
    # what is as near as that to the reference is not claimed
    assert run(over={"dt": STEPS}, methods=["bdf2"], reference="run", finer={"dt": STEPS[-1] / 2},
               target=1.01 * coarse[2].error).answer is None  # fmt: skip


def test_a_mesh_is_judged_by_finer_meshes():
    """A cantilever's tip in space: the reference has twice the cells, and three meshes tell how good it is."""
    from warpfea.scenes.cantilever import cantilever

    found = run(cantilever, over={"cells": [1, 2, 4]}, dt=5e-3, t_end=0.02, finer={"dt": 5e-3, "cells": 8})
    assert found.references[0]["runs"]["space"]["l2"]["order"] > 1.0
    errors = [row.error for row in found]
    assert errors[0] > errors[1] > errors[2]
    assert found[1].orders.keys() <= {"cells"}


def test_the_field_and_the_energy_can_count():
    found = run(over={"dt": STEPS[:2]}, measure="energy")
    assert [row.error for row in found] == [row.energy for row in found]
    found = run(over={"dt": STEPS[:2]}, measure="field", reference="run")
    assert [row.error for row in found] == [row.field for row in found]
    assert found[0].field == pytest.approx(STEPS[0] / T, rel=0.01)


def test_a_parameter_of_the_problem_has_references_of_its_own():
    found = run(over={"gravity": [G, 2 * G], "dt": STEPS[:2]}, reference="run")
    assert [ref["values"] for ref in found.references] == [{"gravity": G}, {"gravity": 2 * G}]
    assert found.references[1]["travel"] == pytest.approx(2 * found.references[0]["travel"], rel=1e-3)
    assert found[0].error == pytest.approx(found[2].error, rel=1e-3)


@pytest.mark.slow
def test_steps_that_adapt_stand_beside_fixed_ones(fall):
    """Rows made by hand: a curve of their own, the slope of true against asked error, and the command that runs one."""
    axes = sweep_axes(falling, {"dt": [1e-2, 5e-3], "error": [1e-2, 1e-3], "method": ["bdf2"]}, None)
    settings = setting_product(fall[0].setting, axes)
    assert [(s.dt, s.error) for s in settings] == [(1e-2, None), (5e-3, None), (None, 1e-2), (None, 1e-3)]
    errors = [4e-2, 1e-2, 2e-2, 2e-3]
    rows = [Row(s, {"dt": s.dt, "error": s.error, "method": s.method}, "done", error=e, resolved=True, seconds=1.0)
            for s, e in zip(settings, errors)]  # fmt: skip
    found = Study("falling", "falling", with_orders(rows, axes), axes, "l2", None, [], {}, None, None)
    assert list(found.curves()) == ["bdf2", "bdf2 steps=adaptive"]
    assert [(f["size"], round(f["order"], 6)) for f in found.fits()] == [("dt", 2.0), ("error", 1.0)]
    assert found[3].orders == pytest.approx({"error": 1.0})
    assert "--dt auto --error 0.001" in settings[3].command("falling", falling)


def test_repeats_give_minimum_and_median():
    row = run(over={"dt": STEPS[:1]}, repeat=3)[0]
    assert row.repeats == 3
    assert row.seconds_min <= row.seconds


# failures and omissions


def test_failures_and_refusals_are_rows(tmp_path):
    found = run(over={"bad": [False, True]}, methods=["bdf2"], out=tmp_path)
    good, bad = found
    assert (good.status, bad.status) == ("done", "failed")
    assert "not finite" in bad.why
    assert bad.error is None
    assert bad.seconds > 0.0
    assert "FAILED" in found.table()
    assert "bad=true: failed" in found.omissions()[0]
    found = run(over={"element": ["T10", "T7"]})
    assert [row.status for row in found] == ["done", "refused"]
    assert "T7" in found[1].why
    with pytest.raises(wf.Error, match="T7"):
        run(over={"element": ["T7", "T8"]})


def test_a_run_that_takes_too_long_is_given_up():
    found = run(over={"dt": [STEPS[0]]}, limit=1e-9)
    assert found[0].status == "too long"
    assert found[0].error is None
    assert "no setting was measured" in Study(*[getattr(found, f) for f in (
        "name", "what", "rows", "axes", "measure")], 1e-3, *[getattr(found, f) for f in (
            "references", "settings", "answer", "command")]).verdict()  # fmt: skip


def test_a_step_that_adapts_tells_its_substeps_and_what_was_asked(tmp_path):
    found = run(over={"error": [1e-1, 1e-3]}, methods=["backward_euler"], out=tmp_path)
    assert found[1].steps > found[0].steps > 64  # of 64 intervals
    with open(tmp_path / "falling.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [float(line["asked error"]) for line in lines] == [1e-1, 1e-3]
    assert [float(line["error"]) for line in lines] == [row.error for row in found]


def test_integrators_may_be_given_as_they_are_made():
    found = run(over={"dt": STEPS[:2]}, methods=["bdf2", wf.GeneralizedAlpha(rho_inf=0.5)])
    assert [row.setting.method for row in found] == 2 * ["bdf2"] + 2 * ["generalized_alpha(rho_inf=0.5)"]


def test_errors_of_rounding_have_no_order():
    """The mid-point scheme is exact in a fall."""
    found = run(over={"dt": STEPS[:2]}, methods=["energy_momentum"], target=1e-3)
    assert all(row.error < 1e-13 and not row.resolved and not row.orders for row in found)
    assert found.fits() == []
    assert found.answer is not None


# the problems


@pytest.mark.parametrize("name", sorted(path.stem for path in PROBLEMS.glob("[!_]*.py")))
def test_problems_are_described_and_their_motions_begin_where_the_probes_are(name):
    scene = locate(str(PROBLEMS / f"{name}.py"))
    assert scene.description.endswith(".")
    assert all(p.doc and not p.required for p in scene.parameters.values())
    assert scene.t_end / scene.dt == pytest.approx(round(scene.t_end / scene.dt), abs=1e-9)
    model = scene.build(scene.resolve({})).finalize(device="cpu")
    reference = make_reference(scene.reference, scene.resolve({}))
    if reference is None:
        return
    probes = {p.name: p for p in model.description.probes}
    for key, motion in reference.probes.items():
        first = motion(np.array([1e-6]))[0] if callable(motion) else np.asarray(motion[1])[0]
        np.testing.assert_allclose(first, probes[key].X, atol=1e-4)
