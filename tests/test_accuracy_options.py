"""`wf.study` and `warpfea study SCENE`: files, references, what may be asked, refusals."""

import csv
import json
import sys

import numpy as np
import pytest
from accuracy_runs import START, STEPS, T, fallen, falling, run

import warpfea as wf
from warpfea.builder.reference import make_reference, read_reference
from warpfea.cli import main
from warpfea.simulation import integrators
from warpfea.studies.accuracy.measure import Outcome
from warpfea.studies.accuracy.motion import interpolant, observed_order
from warpfea.studies.accuracy.settings import parse_over, split_methods, sweep_axes

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
    two = Outcome.from_dict(json.loads(json.dumps(one.to_dict())))
    np.testing.assert_array_equal(two.times, one.times)
    np.testing.assert_array_equal(two.probes["p"][1], -x)
    np.testing.assert_array_equal(two.field, x)
    assert (two.status, two.cost) == ("done", {"steps": 5})


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

    found = make_reference(known, {"gravity": 2.0, "cells": 1})
    assert found.probes["face"](0.0) == 6.0
    with pytest.raises(wf.ModelError, match="'gravity' is no parameter"):
        make_reference(known, {"cells": 1})

    def broken():
        return 1 / 0

    with pytest.raises(wf.ModelError, match=r"reference 'broken': ZeroDivisionError.*test_accuracy_options\.py:\d+"):
        make_reference(broken, {})


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
    assert observed_order(4e-3, 1e-3, 2.0, 0.5, 6.0) == pytest.approx(2.0)
    assert observed_order(1e-3, 2e-3, 2.0, 0.5, 6.0) == 0.5


# what is asked


def test_methods_with_options():
    assert integrators.find_integrator("generalized_alpha(rho_inf=.5)").parameter == 0.5
    assert integrators.find_integrator(" bdf2 ").name == "bdf2"
    assert split_methods("bdf2,my_scheme(rho=.5, a=1),x") == ["bdf2", "my_scheme(rho=.5, a=1)", "x"]
    for text, named in (("generalized_alpha(tau=1)", "tau"), ("generalized_alpha(rho_inf)", "not a number"),
                        ("bdf2(rho=1)", "no option"), ("bdf3", "bdf2")):  # fmt: skip
        with pytest.raises(wf.ModelError, match=named):
            integrators.find_integrator(text)


def test_what_is_swept_is_sorted_out():
    axes = sweep_axes(falling, {"cells": [1, 2], "element": ["T4"], "gravity": [1.0], "dt": [1e-3]}, None)
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


def test_a_moved_keyword_names_its_field():
    with pytest.raises(wf.ModelError, match=r"^repeat is a field of StudyOptions: study\(..., options=wf\."):
        wf.study(falling, repeat=3)
    text = r"target, out are fields of StudyOptions: .*wf.StudyOptions\(target=0\.1, out='d'\)\)$"
    with pytest.raises(wf.ModelError, match=text):
        wf.study(falling, target=0.1, out="d")


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
