"""`wf.study` and `warpfea study SCENE`: errors against motions that are known, orders, files, going on, refusals."""

import csv
import itertools
import json
import math
import shlex
import sys

import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea.builder.reference import read_reference, reference_of
from warpfea.cli import main
from warpfea.cli.parser import parse
from warpfea.simulation import integrators
from warpfea.studies.accuracy import Row, Study
from warpfea.studies.accuracy.measure import Outcome
from warpfea.studies.accuracy.motion import interpolant, observed
from warpfea.studies.accuracy.problems import find_problem, problem_names
from warpfea.studies.accuracy.report import with_orders
from warpfea.studies.accuracy.settings import make_axes, parse_over, product, split_methods

G, T = 9.81, 0.04
START = np.array([1.0, 0.5, 0.5])


def fallen(times):
    return START - np.outer(0.5 * G * times**2, (0.0, 0.0, 1.0))


@wp.func
def nan_later(t: wp.float64) -> wp.vec3d:  # Pa
    zero = wp.float64(0.0)
    return wp.vec3d(zero, zero, wp.where(t > wp.float64(0.013), zero / zero, zero))


def corners(sim):
    return sim.displacements(sim.model.bodies[0])[0, :4]


@wf.scene(dt=5e-3, t_end=T, tol=1e-10, reference={"face": fallen}, field=corners)
def falling(*, cells: int = 1, element: str = "T10", bad: bool = False, gravity: float = G) -> wf.ModelBuilder:
    """A box that falls."""
    b = wf.ModelBuilder(gravity=(0, 0, -gravity))
    mesh = wf.mesh.box((1, 1, 1), cells=(cells, 1, 1), element=element)
    box = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1000.0), name="box")
    if bad:
        b.add_traction(box.surface("z+"), nan_later)
    b.add_probe("face", box.surface("x+"))
    return b


FILE = """
import warpfea as wf

@wf.scene(dt=5e-3, t_end=0.04, tol=1e-10)
def falling(*, cells: int = 1) -> wf.ModelBuilder:
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    mesh = wf.mesh.box((1, 1, 1), cells=(cells, 1, 1))
    box = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
    b.add_probe("face", box.surface("x+"))
    return b
"""
BOTH = ["backward_euler", "bdf2"]
STEPS = [5e-3, 2.5e-3, 1.25e-3]


def run(scene=falling, **options):
    return wf.study(scene, **({"device": "cpu", "repeat": 1, "split": "none"} | options))


@pytest.fixture(scope="module")
def fall():
    return run(over={"dt": STEPS}, methods=BOTH, target=0.02, split="best")


# errors


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


def test_orders_are_observed(fall):
    assert "dt" not in fall[0].orders
    assert [row.orders["dt"] for row in fall[1:3]] == pytest.approx([1.0, 1.0], abs=0.1)
    assert [row.orders["dt"] for row in fall[4:]] == pytest.approx([2.0, 2.0], abs=0.15)
    fits = {fit["curve"]: fit for fit in fall.fits()}
    assert set(fits) == set(BOTH)
    assert fits["bdf2"]["order"] == pytest.approx(2.0, abs=0.1)
    assert fits["bdf2"]["rows"] == 3


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


def test_steps_that_adapt_stand_beside_fixed_ones(fall):
    """Rows made by hand: a curve of their own, the slope of true against asked error, and the command that runs one."""
    axes = make_axes(falling, {"dt": [1e-2, 5e-3], "error": [1e-2, 1e-3], "method": ["bdf2"]}, None)
    settings = product(fall[0].setting, axes)
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


# files


def test_the_command_writes_table_csv_json_and_plot(tmp_path, capsys):
    pytest.importorskip("matplotlib")
    scene, out = tmp_path / "mine.py", tmp_path / "new"
    scene.write_text(FILE)
    words = ["study", str(scene), "--over", "dt=5e-3,2.5e-3", "--over", "cells=1,2", "--methods", "bdf2"]
    words += ["--reference", "run", "--finer", "cells=4", "--device", "cpu", "--repeat", "1", "--out", str(out)]
    assert main([*words, "--target", "0.1", "--split", "all"]) == 0
    printed, progress = capsys.readouterr()
    assert not progress  # stderr is no terminal
    content = json.loads((out / "falling.json").read_text())
    assert content["command"].startswith("warpfea study ")
    assert content["machine"]["cpu"]
    assert content["versions"]["warp"]
    assert content["over"] == {"dt": [5e-3, 2.5e-3], "cells": [1, 2], "method": ["bdf2"]}
    assert len(content["rows"]) == 4
    assert content["answer"]["command"].startswith(f"warpfea run {scene}")
    assert all(row["split"]["time"] > 0.0 for row in content["rows"])
    with open(out / "falling.csv", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [float(x["l2"]) for x in lines] == [row["l2"] for row in content["rows"]]
    assert [x["method"] for x in lines] == [row["setting"]["method"] for row in content["rows"]]
    assert (out / "falling.png").read_bytes().startswith(b"\x89PNG")
    for text in ("order dt", "order cells", "digits", "Pareto", "memory", "reference", "parts of the error", "target"):
        assert text in printed
    assert main([*words, "--target", "1e-9", "--split", "none"]) == 3
    assert "no setting was measured to reach 1e-09" in capsys.readouterr().out


def test_without_matplotlib_there_is_no_plot(tmp_path, monkeypatch):

    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    run(over={"dt": STEPS[:1]}, out=tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["falling.csv", "falling.json", "falling.points.jsonl"]


def test_a_stopped_study_goes_on(tmp_path, monkeypatch, capsys):
    """Ctrl-C in the third of four runs: two are kept, and only the other two are run when it is called again."""
    scene, out = tmp_path / "mine.py", tmp_path / "out"
    scene.write_text(FILE)
    module = sys.modules["warpfea.studies.accuracy.study"]
    measure, calls = module.run_once, []

    def counted(found, setting, **options):
        calls.append(setting.dt)
        if stop and len(calls) == 3:
            raise KeyboardInterrupt
        return measure(found, setting, **options)

    monkeypatch.setattr(module, "run_once", counted)
    known = tmp_path / "known.json"
    known.write_text(json.dumps({"t": [T], "probes": {"face": fallen(np.array([T])).tolist()}}))
    words = ["study", str(scene), "--over", "dt=5e-3,2.5e-3,1.25e-3,6.25e-4", "--reference", str(known), "--quiet"]
    words += ["--split", "none", "--repeat", "1", "--device", "cpu", "--out", str(out)]
    stop = True
    assert main(words) == 130
    points = out / "falling.points.jsonl"
    assert f"interrupted: {points} holds 2 finished runs" in capsys.readouterr().err
    assert len(points.read_text().splitlines()) == 2
    assert sorted(p.name for p in out.iterdir()) == ["falling.points.jsonl"]
    with open(points, "a") as file:
        file.write('{"key": "cut sh')
    stop = False
    calls.clear()
    assert main(words) == 0
    assert calls == [1.25e-3, 6.25e-4]
    rows = json.loads((out / "falling.json").read_text())["rows"]
    assert [row["end"] for row in rows] == pytest.approx([h / T for h in (5e-3, 2.5e-3, 1.25e-3, 6.25e-4)], rel=1e-6)
    calls.clear()
    assert main(words) == 0
    assert calls == []
    scene.write_text(FILE + "\n# changed\n")  # another version of the scene
    assert main(words) == 0
    assert len(calls) == 4
    assert "goes on" not in capsys.readouterr().err


def test_an_outcome_is_kept_with_all_digits():
    x = np.random.default_rng(0).normal(size=(5, 3))
    one = Outcome("done", "", {"steps": 5}, np.arange(5.0) / 3, {"p": (x, -x)}, {"p": x[0]}, x)
    two = Outcome.unpacked(json.loads(json.dumps(one.packed())))
    np.testing.assert_array_equal(two.times, one.times)
    np.testing.assert_array_equal(two.probes["p"][1], -x)
    np.testing.assert_array_equal(two.field, x)
    assert (two.status, two.numbers) == ("done", {"steps": 5})


# references


def test_references_of_files(tmp_path):
    times = np.array([0.0, 0.013, T])  # the second is no end of a step: runs are interpolated by cubics
    rows = [["t", "x", "y", "z"], *np.column_stack([times, fallen(times)]).tolist()]
    path = tmp_path / "tip.csv"
    path.write_text("\n".join(",".join(map(str, row)) for row in rows))
    h = 2.5e-3
    row = run(over={"dt": [h]}, reference=path)[0]
    assert row.end == pytest.approx(h / T, rel=1e-6)
    errors = np.array([h * 0.013 / T**2, h / T])
    weights = np.array([0.013, T - 0.013])
    assert row.l2 == pytest.approx(np.sqrt(weights @ errors**2 / T), rel=2e-2)
    path.write_text("t,x,y\n0,1,2\n")
    with pytest.raises(wf.ModelError, match=r"tip\.csv: is no reference \(KeyError: 'z'\); a \.csv needs"):
        read_reference(path, "tip")
    with pytest.raises(wf.ModelError, match="no such file"):
        read_reference(tmp_path / "none.csv", "tip")


def test_references_of_functions_get_the_parameters_that_they_name():
    def known(gravity, other=3.0):
        return {"face": lambda t: gravity * other}

    found = reference_of(known, {"gravity": 2.0, "cells": 1})
    assert found.probes["face"](0.0) == 6.0
    with pytest.raises(wf.ModelError, match="'gravity' is no parameter"):
        reference_of(known, {"cells": 1})

    def broken():
        return 1 / 0

    with pytest.raises(wf.ModelError, match=r"reference 'broken': ZeroDivisionError.*test_accuracy\.py:\d+"):
        reference_of(broken, {})


@pytest.mark.parametrize(
    ("reference", "named"),
    [
        ({"top": fallen}, "no probe 'top'"),
        ({"face": lambda t: t}, r"must give finite positions \(1000, 3\)"),
        ({"face": lambda t: 1 / 0}, "ZeroDivisionError"),
        ({"face": ([0.0, 0.02], [START, START])}, r"end at t = 0\.02 s"),
        ({"face": ([0.0, 0.0], [START, START])}, "must ascend"),
        ({"face": lambda t: np.tile(START, (len(t), 1))}, "do not move"),
        ({}, "names no probe"),
        ("reference.txt", r"neither a file \.csv or \.json"),
    ],
)
def test_bad_references_are_named(reference, named):
    with pytest.raises(wf.ModelError, match=named):
        run(over={"dt": [5e-3]}, reference=reference)


def test_cubics_between_steps_are_of_fourth_order():
    def error(n):
        t = np.linspace(0.0, 1.0, n + 1)
        x, v = np.sin(3 * t)[:, None] * [1, 2, 3], 3 * np.cos(3 * t)[:, None] * [1, 2, 3]
        at = np.linspace(0.0, 1.0, 777)
        return np.abs(interpolant(t, x, v)(at) - np.sin(3 * at)[:, None] * [1, 2, 3]).max()

    assert np.log2(error(20) / error(40)) == pytest.approx(4.0, abs=0.1)
    assert observed(4e-3, 1e-3, 2.0, 0.5, 6.0) == pytest.approx(2.0)
    assert observed(1e-3, 2e-3, 2.0, 0.5, 6.0) == 0.5


# what is asked


def test_methods_with_options():
    assert integrators.get("generalized_alpha(rho_inf=.5)").parameter == 0.5
    assert integrators.get(" bdf2 ").name == "bdf2"
    assert split_methods("bdf2,my_scheme(rho=.5, a=1),x") == ["bdf2", "my_scheme(rho=.5, a=1)", "x"]
    for text, named in (("generalized_alpha(tau=1)", "tau"), ("generalized_alpha(rho_inf)", "not a number"),
                        ("bdf2(rho=1)", "no option"), ("bdf3", "bdf2")):  # fmt: skip
        with pytest.raises(wf.ModelError, match=named):
            integrators.get(text)


def test_what_is_swept_is_sorted_out():
    axes = make_axes(falling, {"cells": [1, 2], "element": ["T4"], "gravity": [1.0], "dt": [1e-3]}, None)
    assert (axes.mesh, axes.choices, axes.physical) == (("cells",), ("element",), ("gravity",))
    assert axes.sizes == ["cells", "dt"]
    assert parse_over(falling, ["methods=bdf2", "bad=true,no"]) == {"method": ["bdf2"], "bad": [True, False]}
    from warpfea.scenes.spin import spin

    assert parse_over(spin, ["cells=6x2x1,3x1x1"]) == {"cells": [(6, 2, 1), (3, 1, 1)]}


@pytest.mark.parametrize(
    ("options", "named"),
    [
        ({"over": {"cell": [1]}}, r"can't sweep 'cell'.*did you mean 'cells'"),
        ({"over": {"dt": []}}, "at least one"),
        ({"over": {"dt": 1e-3}}, "list of values"),
        ({"over": {"dt": [1e-3, 1e-3]}}, "twice"),
        ({"over": {"dt": [-1e-3]}}, "positive"),
        ({"over": {"dt": [3e-3]}}, r"does not divide the end time 0\.04 s"),
        ({"over": {"solver": ["newton"]}}, "there are newton-pcg, jacobi, direct"),
        ({"over": {"dtype": ["float16"]}}, "float64, float32"),
        ({"methods": ["bdf3"]}, "bdf3"),
        ({"measure": "l3"}, "l2, end, energy, field"),
        ({"split": "some"}, "best, all, none"),
        ({"repeat": 0}, "repeat"),
        ({"target": -1.0}, "target"),
        ({"probes": ["tip"]}, "there are 'face'"),
        ({"parameters": {"cell": 1}}, "did you mean 'cells'"),
        ({"target": "1e-3"}, "target = '1e-3' must be a positive finite number"),
        ({"probes": []}, "are none; there are 'face'"),
        ({"finer": {"cell": 1}}, "did you mean 'cells'"),
        ({"finer": {"error": 0.5}}, "finer error = 0.5.*steps of one size.*give dt"),
        ({"finer": {"dt": None}}, "finer dt = None must be a positive finite number"),
        ({"mesh": ["element"]}, "no whole number"),
        ({"device": "tpu"}, "tpu"),
        ({"name": "a/b"}, "names of files"),
    ],
)
def test_bad_options_are_named(options, named):
    with pytest.raises(wf.ModelError, match=named):
        run(**options)


def test_a_scene_without_a_probe_is_refused():
    def empty():
        b = wf.ModelBuilder()
        b.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1.0))
        return b

    with pytest.raises(wf.ModelError, match="give dt and t_end"):
        run(empty)
    with pytest.raises(wf.ModelError, match=r"'empty' has no probe.*add_probe"):
        run(empty, dt=1e-3, t_end=1e-2)
    with pytest.raises(wf.ModelError, match="no field"):
        run(wf.scene(dt=1e-3, t_end=1e-2)(falling.function), measure="field")


@pytest.mark.parametrize(
    ("words", "code", "named"),
    [
        (["cantilver"], 2, "did you mean 'cantilever'"),
        (["cantilever", "--over", "dt"], 2, "NAME=V1,V2"),
        (["cantilever", "--over", "dt=fast"], 2, "'fast'"),
        (["cantilever", "--over", "cells=1", "--over", "cells=2"], 2, "given twice"),
        (["cantilever", "--targt", "1"], 2, "--targt"),
        (["none.py"], 2, "no such file"),
        (["part.stl"], 2, "part.stl"),
        (["cantilever", "--out", "no/such/folder"], 4, "no/such/folder"),
    ],
)
def test_bad_usage(words, code, named, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(["study", *words]) == code
    assert named in capsys.readouterr().err


def test_help_teaches(capsys):
    assert main(["study", "cantilever", "--help"]) == 0
    text = capsys.readouterr().out
    for part in ("--over", "--methods", "--target", "reference", "Pareto", "goes on", "exit codes"):
        assert part in text
    assert main(["study", "--help"]) == 0
    assert "SCENE" in capsys.readouterr().out


# the problems


@pytest.mark.parametrize("name", problem_names())
def test_problems_are_described_and_their_motions_begin_where_the_probes_are(name):
    scene = find_problem(name)
    assert scene.description.endswith(".")
    assert all(p.doc and not p.required for p in scene.parameters.values())
    assert scene.t_end / scene.dt == pytest.approx(round(scene.t_end / scene.dt), abs=1e-9)
    model = scene.build(scene.resolve({})).finalize(device="cpu")
    reference = reference_of(scene.reference, scene.resolve({}))
    if reference is None:
        return
    probes = {p.name: p for p in model.probes}
    for key, motion in reference.probes.items():
        first = motion(np.array([1e-6]))[0] if callable(motion) else np.asarray(motion[1])[0]
        np.testing.assert_allclose(first, probes[key].X, atol=1e-4)
