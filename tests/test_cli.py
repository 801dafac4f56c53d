"""The command line, called in this process: what it writes, its exit codes, its errors."""

from __future__ import annotations

import json
import os
import pathlib
import shutil
import signal
import subprocess
import sys

import mesh_writers as writers
import numpy as np
import pytest

import warpfea as wf
from warpfea.base.console import compile_bar
from warpfea.base.errors import UsageError
from warpfea.builder.scene import find
from warpfea.cli import main
from warpfea.cli.part import parse_material
from warpfea.cli.summary import KEYS
from warpfea.outputs.usd import validate_usd

HERE = pathlib.Path(__file__).resolve().parent
SHORT = ["run", "cantilever", "--device", "cpu", "--set", "cells=2", "--dt", "0.002", "--t-end", "0.01"]
SVK = "svk:E=1e7,nu=0.3,density=1000"

SCENES = """
import warpfea as wf

def bar(force):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(wf.mesh.box((1, .2, .2), cells=(2, 1, 1)), material=wf.SVK(E=1e7, nu=.3, density=1000))
    b.clamp(body.nodes("x-"))
    b.add_traction(body.surface("x+"), ([0, .01, .02], [(0, 0, 0), (0, 0, -100), (0, 0, -100 - force)]))
    b.add_probe("tip", body.surface("x+"))
    return b

@wf.scene(dt=2e-3, t_end=.02)
def good(*, force: float = 0.0) -> wf.ModelBuilder:
    '''A bar that is bent.'''
    return bar(force)

@wf.scene(dt=2e-3, t_end=.03)
def bursts() -> wf.ModelBuilder:
    '''A bar that is crushed by an absurd force.'''
    return bar(1e30)

@wf.scene(dt=2e-3, t_end=.02)
def broken(*, count: int = 0) -> wf.ModelBuilder:
    '''An error in the scene itself.'''
    return [bar(0.0)][1]

@wf.scene(dt=2e-3, t_end=.02)
def later() -> wf.ModelBuilder:
    '''Wants what this version lacks.'''
    b = wf.ModelBuilder()
    b.add_beam([(0, 0, 0), (1, 0, 0)])
    return b
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a mesh, a file of scenes, and things that are neither."""
    mesh = wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1))
    writers.write(writers.Parts.of(mesh), tmp_path / "part.msh", "msh22")
    (tmp_path / "mine.py").write_text(SCENES)
    (tmp_path / "empty.py").write_text("x = 1\n")
    (tmp_path / "bad.msh").write_text("no mesh at all\n")
    (tmp_path / "bad.npz").write_text("no checkpoint\n")
    (tmp_path / "bad.usdc").write_text("no stage\n")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def files(folder):
    return {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file() and "__pycache__" not in p.parts}


def run(capfd, *words):
    """Exit code, stdout and stderr of a command."""
    capfd.readouterr()
    code = main([str(word) for word in words])
    out, err = capfd.readouterr()
    return code, out, err


# running


def test_run_writes_every_output_and_says_so(folder, capfd):
    words = [*SHORT, "--usd", "a.usdc", "--vtu", "series", "--png", "a.png", "--gif", "a.gif", "--checkpoint", "a.npz"]
    before = files(folder)
    code, out, err = run(capfd, *words, "--json", "a.json", "--fps", "500")
    assert (code, err) == (0, "")
    for name in ("a.usdc", "a.png", "a.gif", "a.npz", "a.json", "series"):
        assert name in out
        assert (folder / name).exists()
    for word in ("cantilever", "cells=2", "done at t = 0.01 s", "5 steps", "probe tip"):
        assert word in out
    assert validate_usd("a.usdc") == []
    assert {n.rpartition(".")[2] for n in files(folder) - before} == {"usdc", "vtu", "pvd", "png", "gif", "npz", "json"}


def test_summary_has_the_fixed_keys(folder, capfd):
    code, _, _ = run(capfd, *SHORT, "--json", "a.json")
    assert code == 0
    summary = json.loads((folder / "a.json").read_text())
    assert tuple(summary) == KEYS
    assert summary["schema"] == 1
    assert summary["scene"] == "cantilever"
    assert summary["parameters"]["cells"] == 2
    assert summary["parameters"]["E"] == 7e8
    assert (summary["device"], summary["dtype"], summary["dt"]) == ("cpu", "float64", 0.002)
    assert summary["t_end"] == pytest.approx(0.01)
    assert (summary["steps"], summary["status"]) == (5, "done")
    assert 0 < summary["compile_s"] <= summary["wall_s"]
    assert summary["newton_iterations"] >= 5
    assert summary["pcg_iterations"] > 5
    assert 0 < summary["max_residual"] < 1e-7
    assert summary["violation"] == 0
    assert summary["energies"]["kinetic"] > 0
    assert abs(summary["energies"]["ledger_residual"]) < 1e-8
    assert summary["probes"]["tip"]["displacement"][2] < 0
    assert set(summary["probes"]["tip"]) == {"position", "displacement", "velocity"}
    assert "warp" in summary["versions"]
    assert {"contact", "driven nodes"} <= set(summary["left_out"])


def test_summary_equals_what_python_gives(folder, capfd):
    code, out, _ = run(capfd, *SHORT, "--json", "-")
    assert code == 0
    found = json.loads(out)["probes"]["tip"]
    sim = wf.Simulation(find("cantilever")(cells=2).finalize(device="cpu"), dt=0.002)
    sim.run(0.01)
    record = sim.probe("tip")
    for name, values in found.items():
        np.testing.assert_array_equal(values, getattr(record, name)[0, -1])


def test_json_on_stdout_is_all_there_is(folder, capfd):
    code, out, err = run(capfd, *SHORT, "--json", "-")
    assert (code, err) == (0, "")
    assert json.loads(out)["status"] == "done"


def test_quiet_prints_nothing(folder, capfd):
    assert run(capfd, *SHORT, "--quiet") == (0, "", "")


def test_a_users_file_runs_with_parameters(folder, capfd):
    code, out, _ = run(capfd, "run", "mine.py:good", "--set", "force=50", "--device", "cpu", "--json", "-")
    summary = json.loads(out)
    assert (code, summary["scene"], summary["parameters"]) == (0, "mine.py:good", {"force": 50.0})
    assert summary["steps"] == 10


def test_a_mesh_runs_with_loads_from_the_command_line(folder, capfd):
    words = ["--material", SVK, "--clamp", "x-", "--traction", "x+:0,0,-100", "--gravity", "-1,0,0", "--dt", "2e-3"]
    code, out, err = run(capfd, "run", "part.msh", *words, "--t-end", "0.01", "--device", "cpu", "--json", "-")
    assert (code, err) == (0, "")
    summary = json.loads(out)
    assert summary["parameters"]["material"] == [SVK]
    assert summary["parameters"]["gravity"] == [-1, 0, 0]
    u = summary["probes"]["x+"]["displacement"]
    assert u[2] < 0
    assert u[0] < 0


def test_a_mesh_takes_materials_by_group_scale_and_axis(folder, capfd):
    words = ["--material", f"body={SVK}", "--scale", "1e-3", "--up-axis", "Y", "--clamp", "x-", "--clamp", "x+"]
    code, out, _ = run(capfd, "info", "part.msh", *words, "--device", "cpu", "--json", "-")
    info = json.loads(out)
    assert code == 0
    assert info["mass"] == pytest.approx(1000 * 0.04e-9)
    assert info["parameters"]["gravity"] == [0, -9.81, 0]
    assert info["bodies"][0]["materials"] == ["SVK (body)"]


def test_an_unclamped_mesh_warns_and_falls(folder, capfd):
    code, out, err = run(
        capfd, "run", "part.msh", "--material", SVK, "--dt", "2e-3", "--t-end", "0.01", "--device", "cpu", "--json", "-"
    )
    assert code == 0
    assert "warning: no --clamp" in err
    assert "part" in err
    v = json.loads(out)["probes"]["all"]["velocity"]
    np.testing.assert_allclose(v, [0, 0, -0.0981], atol=1e-12)


def test_a_run_resumes_from_its_checkpoint_bit_for_bit(folder, capfd):
    words = [*SHORT[:-2], "--integrator", "bdf2", "--quiet"]
    assert run(capfd, *words, "--t-end", "0.012", "--json", "whole.json")[0] == 0
    assert run(capfd, *words, "--t-end", "0.006", "--checkpoint", "c.npz")[0] == 0
    rest = ["run", "cantilever", "--device", "cpu", "--set", "cells=2", "--t-end", "0.012", "--quiet"]
    assert run(capfd, *rest, "--resume", "c.npz", "--checkpoint", "c.npz", "--json", "rest.json")[0] == 0
    whole, rest = (json.loads((folder / f"{name}.json").read_text()) for name in ("whole", "rest"))
    for key in KEYS:
        if key not in ("wall_s", "compile_s"):
            assert rest[key] == whole[key], key


def test_the_summary_tells_size_and_mass(folder, capfd):
    code, out, _ = run(capfd, *SHORT, "--json", "a.json")
    assert code == 0
    (line,) = [line for line in out.splitlines() if line.startswith("size")]
    summary = json.loads((folder / "a.json").read_text())
    low, high = np.array(summary["bounding_box"])
    assert line.split(None, 1)[1].startswith(" x ".join(f"{side:.4g}" for side in high - low) + " m, ")
    assert f"{summary['mass']:.4g} kg" in line
    assert summary["mass"] > 0
    assert (summary["analysis"], summary["load"]) == ("dynamic", None)


def test_a_mesh_in_mm_warns(folder, capfd):
    words = ["info", "part.msh", "--material", "svk:E=2e11,nu=0.3,density=7850", "--clamp", "x-", "--device", "cpu"]
    assert run(capfd, *words)[2] == ""
    code, out, err = run(capfd, *words, "--scale", "1000")
    assert code == 0
    assert "weighs 3.14e+11 kg" in err
    assert "part.msh" in err
    assert "scale=1e-3" in err
    assert "1000 x 200 x 200 m" in out


# statics

STATIC = ["run", "part.msh", "--static", "--clamp", "x-", "--traction", "x+:0,0,-100", "--device", "cpu"]
LIGHT = ["--material", "svk:E=1e7,nu=0.3", "--gravity", "0,0,0"]


def test_statics_from_the_command_line(folder, capfd):
    outputs = ["--png", "a.png", "--usd", "a.usdc", "--vtu", "series", "--gif", "a.gif", "--json", "a.json"]
    code, out, err = run(capfd, *STATIC, *LIGHT, "--load-steps", "4", *outputs)
    assert (code, err) == (0, "")
    for words in ("done, static, at 100 % of the load, 4 load steps", "no density", "probe x+", "a.png"):
        assert words in out
    summary = json.loads((folder / "a.json").read_text())
    assert tuple(summary) == KEYS
    assert (summary["analysis"], summary["load"], summary["steps"], summary["status"]) == ("static", 1.0, 4, "done")
    assert summary["dt"] is summary["t_end"] is summary["mass"] is None
    assert set(summary["energies"]) == {"strain"}
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid("part.msh", material=wf.SVK(E=1e7, nu=0.3))
    b.clamp(body.nodes("x-"))
    b.add_traction(body.surface("x+"), (0, 0, -100))
    b.add_probe("x+", body.surface("x+"))
    static = wf.solve_static(b.finalize(device="cpu"), load_steps=4)
    np.testing.assert_array_equal(summary["probes"]["x+"]["displacement"], static.probe("x+").displacement[0, -1])
    assert summary["energies"]["strain"] > 0
    assert validate_usd("a.usdc") == []
    assert (folder / "series" / "series.pvd").read_text().count("<DataSet") == 5
    code, _, _ = run(capfd, "render", "a.usdc", "-o", "b.png")
    assert code == 0


def test_statics_of_a_scene_has_ten_load_steps(folder, capfd):
    code, out, _ = run(capfd, "run", "mine.py:good", "--static", "--device", "cpu", "--json", "-")
    assert code == 0
    assert json.loads(out)["steps"] == 10


def test_statics_holds_what_rests_on_contact_with_stabilise(folder, capfd):
    command = ["run", "belt", "--static", "--load-steps", "2", "--device", "cpu", "--json", "-"]
    code, _, err = run(capfd, *command)
    assert code == 2
    assert "6 rigid motions free" in err
    code, out, _ = run(capfd, *command, "--stabilise")
    summary = json.loads(out)
    (contact,) = summary["contacts"].values()
    assert (code, summary["load"]) == (0, 1.0)
    np.testing.assert_allclose(contact["force"][2], 9.81 * summary["mass"], rtol=1e-6)


def test_statics_takes_the_whole_load_at_once_with_auto(folder, capfd):
    code, out, _ = run(capfd, *STATIC, *LIGHT, "--load-steps", "auto", "--json", "-")
    summary = json.loads(out)
    assert (code, summary["steps"], summary["load"]) == (0, 1, 1.0)
    code, _, err = run(capfd, *STATIC, *LIGHT, "--load-steps", "some")
    assert code == 2
    assert "'some' is neither a positive whole number nor auto" in err


CRUSHED = ["run", "part.msh", "--material", "svk:E=10,nu=0.3,density=1000", "--gravity", "-300,0,0", "--clamp", "x-"]
CRUSHED += ["--device", "cpu", "--dt", "2e-3", "--t-end", "0.1"]


def test_inversion_is_refused_or_told(folder, capfd):
    code, out, err = run(capfd, *CRUSHED, "--json", "a.json")
    assert code == 3
    assert "an element turned inside out (J <= 0)" in err
    assert json.loads((folder / "a.json").read_text())["min_J"] > 0
    assert "WARNING" not in out
    code, out, _ = run(capfd, *CRUSHED, "--inversion", "report", "--json", "a.json")
    assert code == 0
    assert json.loads((folder / "a.json").read_text())["min_J"] <= 0
    assert "an element turned inside out: J = -" in out
    code, _, err = run(capfd, *CRUSHED, "--inversion", "maybe")
    assert code == 2
    assert "--inversion" in err


def test_steps_that_rounding_ends_are_told(folder, capfd):
    words = [*STATIC[:4], "x-", "--traction", "x+:0,0,-1", *STATIC[-2:], *LIGHT, "--dtype", "float32", "--tol", "1e-7"]
    code, out, _ = run(capfd, *words, "--json", "a.json")
    summary = json.loads((folder / "a.json").read_text())
    assert code == 0
    assert 0 < summary["floored_steps"] <= summary["steps"] == 10
    assert 0 < summary["max_floor"] < 2e-3
    assert f"{summary['floored_steps']} of 10 steps end where rounding stops the residual" in out


def test_statics_that_fails_exits_3(folder, capfd):
    code, out, err = run(capfd, "run", "mine.py:bursts", "--static", "--device", "cpu", "--json", "a.json")
    assert code == 3
    assert err.startswith("warpfea: error: load step from ")
    assert "not converged, static" in out
    assert json.loads((folder / "a.json").read_text())["load"] < 1.0


def test_density_is_asked_for_where_it_counts(folder, capfd):
    for words in (["run", *STATIC[1:2], *STATIC[3:], *LIGHT], [*STATIC, *LIGHT[:2]]):
        code, _, err = run(capfd, *words)
        assert code == 2
        assert "'part': the material SVK has no density" in err


# other commands


def test_scenes_lists_and_describes(folder, capfd):
    code, out, _ = run(capfd, "scenes")
    assert code == 0
    for name in ("cantilever", "hook", "twist"):
        assert f"\n{name}" in out
    code, out, _ = run(capfd, "scenes", "twist")
    assert code == 0
    assert "--set turns" in out
    assert "of the driven end" in out
    code, out, _ = run(capfd, "scenes", "mine.py")
    assert code == 0
    assert "An error in the scene itself." in out
    assert "--set force" in run(capfd, "scenes", "mine.py:good")[1]


def test_info_tells_features_and_costs(folder, capfd):
    words = ["info", "cantilever", "--set", "cells=2", "--device", "cpu"]
    code, out, err = run(capfd, *words)
    assert (code, err) == (0, "")
    for word in (
        "12 T10 elements",
        "left out",
        "contact",
        "bytes per unknown",
        "launches",
        "matrix_product",
        "operator matrix, preconditioner banded",
    ):
        assert word.replace("bytes", "B") in out
    code, out, _ = run(capfd, *words, "--json", "-")
    info = json.loads(out)
    assert code == 0
    assert info["launches"] > 20
    assert "gravity" in info["features"]
    assert any(k.endswith("matrix_product") for k in info["kernels"])
    assert info["bytes_per_unknown"] > 100


def test_info_shows_the_groups_of_a_mesh_without_a_material(folder, capfd):
    code, out, err = run(capfd, "info", "part.msh")
    assert (code, err) == (0, "")
    for words in (
        "12 tetra10",
        "1 x 0.2 x 0.2 m, volume 0.04 m^3",
        "body (12 elements)",
        "x- (2 faces)",
        "x- (9 nodes)",
    ):
        assert words in out
    code, out, _ = run(capfd, "info", "part.msh", "--scale", "1e-3", "--json", "-")
    assert code == 0
    mesh = json.loads(out)["mesh"]
    assert mesh["element_groups"] == {"body": 12}
    assert mesh["surface_groups"]["x-"] == 2
    assert mesh["node_groups"]["x-"] == 9
    np.testing.assert_allclose(mesh["bounding_box"], [[0, 0, 0], [1e-3, 2e-4, 2e-4]], atol=1e-18)
    code, out, _ = run(capfd, "info", "part.msh", "--material", SVK, "--clamp", "x-", "--device", "cpu")
    assert code == 0
    for words in ("x- (2 faces)", "launches", "40 kg"):
        assert words in out


def test_info_of_surface_groups_only_and_of_a_shell(folder, capfd):
    box = wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1))
    parts = writers.Parts.of(box)
    writers.write(parts, folder / "part.msh", "msh22")
    text = (folder / "part.msh").read_text()
    assert '"body"' in text
    lines = text.splitlines()
    tag = next(line.split()[1] for line in lines if line.endswith('"body"'))
    bare = [line for line in lines if not line.endswith('"body"')]
    for k, line in enumerate(bare):  # tetrahedra without a tag
        words = line.split()
        if len(words) > 10 and words[1] == "11" and words[3] == tag:
            bare[k] = " ".join([*words[:3], "0", *words[4:]])
    start = bare.index("$PhysicalNames")
    bare[start + 1] = str(int(bare[start + 1]) - 1)
    (folder / "bare.msh").write_text("\n".join(bare) + "\n")
    code, out, _ = run(capfd, "info", "bare.msh")
    assert code == 0
    assert "element groups  none" in out
    assert "x- (2 faces)" in out
    code, _, err = run(capfd, "run", "bare.msh", "--clamp", "x-")
    assert code == 2
    assert "element groups found: none (its surface groups: x-" in err
    assert "Physical Volume" in err
    code, _, err = run(capfd, "run", "bare.msh", "--material", f"body={SVK}")
    assert code == 2
    assert "the volume has no group" in err


def test_pictures_take_field_view_and_range(folder, capfd, monkeypatch):
    from warpfea.outputs import reel

    shown = []
    label = reel.label

    def note(image, time, bar):
        shown.append(bar)
        return label(image, time, bar)

    monkeypatch.setattr(reel, "label", note)
    look = ["--field", "displacement", "--range", "-1e-3,2e-3", "--view", "-60,10", "--quiet"]
    assert run(capfd, *SHORT, "--png", "a.png", "--gif", "a.gif", "--usd", "a.usdc", *look)[0] == 0
    assert {(bar[0], bar[1], bar[2]) for bar in shown} == {(-1e-3, 2e-3, "displacement")}
    shown.clear()
    render = ["render", "a.usdc", "-o", "b.png", "--quiet"]
    assert run(capfd, *render)[0] == 0
    assert shown[-1][:3] == (-1e-3, 2e-3, "displacement")
    assert run(capfd, *render, "--field", "von_mises", "--range", "0,5")[0] == 0
    assert shown[-1][:3] == (0.0, 5.0, "von Mises stress")
    assert run(capfd, *render, "--field", "none")[0] == 0
    assert shown[-1] is None
    assert run(capfd, *SHORT, "--png", "c.png", "--field", "none", "--quiet")[0] == 0
    assert shown[-1] is None
    first, second = ((folder / name).read_bytes() for name in ("a.png", "b.png"))
    assert first != second
    code, _, err = run(capfd, *render, "--field", "vonmises")
    assert code == 2
    assert "did you mean 'von_mises'" in err


def test_render_draws_a_usd_file(folder, capfd):
    assert run(capfd, *SHORT, "--usd", "a.usdc", "--quiet")[0] == 0
    code, out, _ = run(capfd, "render", "a.usdc", "-o", "b.png", "--size", "200x100", "--view", "-60,20")
    assert (code, out) == (0, "wrote b.png\n")
    from PIL import Image

    assert Image.open("b.png").size == (200, 100)


def test_bench_measures_time_and_error(folder, capfd):
    words = ["bench", "--unknowns", "300", "--dtype", "float64", "--steps", "3", "--repeat", "1", "--device", "cpu"]
    code, out, err = run(capfd, *words, "--out", "bench.json")
    assert (code, err) == (0, "")
    assert "ms/step" in out
    content = json.loads((folder / "bench.json").read_text())
    assert content["command"] == f"warpfea {' '.join(words)} --out bench.json"
    assert {"machine", "versions", "settings", "rows", "commit", "schema"} <= set(content)
    (row,) = content["rows"]
    assert row["unknowns"] == 270
    assert row["tip"] > 0
    assert row["tip_error"] < 1e-6
    assert row["residual"] < 1e-7
    assert row["ms_per_step"] > 0
    assert row["linear"] == "pcg"


@pytest.mark.parametrize("command", [[], ["run"], ["scenes"], ["info"], ["render"], ["bench"]])
def test_help_teaches(capfd, command):
    code, out, err = run(capfd, *command, "--help")
    assert (code, err) == (0, "")
    assert "usage: warpfea" in out
    if command in ([], ["run"], ["render"], ["bench"]):
        assert "examples:" in out
    if command in (["run"], ["render"]):
        assert "contact_pressure, gap" in " ".join(out.split())


def test_the_bar_of_the_compilation_goes_to_stderr(capfd):
    ready = []
    model = find("cantilever")(cells=2).finalize(device="cpu")
    wf.Simulation(model, dt=1e-3, on_compile=lambda *news: ready.append(news))
    done, total, names = zip(*ready)
    assert done == tuple(range(1, total[0] + 1))
    assert "warpfea.kernels.reduce" in names
    capfd.readouterr()
    with compile_bar(True) as update:
        for news in ready:
            update(*news)
    out, err = capfd.readouterr()
    assert out == ""
    assert "compiling kernels" in err
    with compile_bar(None) as update:  # not a terminal
        update(*ready[0])
    assert capfd.readouterr() == ("", "")


def test_version(capfd):
    assert run(capfd, "--version")[:2] == (0, f"warpfea {wf.__version__}\n")


def test_the_module_runs_as_a_program():
    done = subprocess.run(
        [sys.executable, "-m", "warpfea", "run", "crane"], cwd=HERE.parent, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("warpfea: error: there is no scene 'crane'")


# errors

MESH = ["run", "part.msh"]
CLAMPED = [*MESH, "--material", SVK, "--clamp", "x-"]
OUT = ["--usd", "o.usdc", "--json", "o.json", "--checkpoint", "o.npz"]

BAD = {
    "no command": ([], ["give a command"]),
    "unknown command": (["fly"], ["fly"]),
    "no scene": (["run"], ["SCENE"]),
    "unknown option": ([*SHORT, "--colour", "red"], ["--colour"]),
    "misspelt option": ([*SHORT, "--chekpoint", "o.npz"], ["--chekpoint", "did you mean '--checkpoint'"]),
    "misspelt command": (["rnu", "hook"], ["'rnu'", "did you mean 'run'"]),
    "misspelt scene": (["run", "cantilver", *OUT], ["did you mean 'cantilever'"]),
    "misspelt scene in file": (["run", "mine.py:goood", *OUT], ["did you mean 'good'"]),
    "misspelt parameter": ([*SHORT, "--set", "lenght=1", *OUT], ["did you mean 'length'"]),
    "misspelt field": ([*SHORT, "--png", "o.png", "--field", "von_misses"], ["did you mean 'von_mises'"]),
    "misspelt law": ([*MESH, "--material", "neohookean:mu=1,k=1,density=1", *OUT], ["did you mean 'neo_hookean'"]),
    "misspelt constant": ([*MESH, "--material", "svk:E=1e7,nu=0.3,densty=1", *OUT], ["did you mean 'density'"]),
    "surface without volume": (["run", "bracket.stl", *OUT], ["bracket.stl", ".msh (Gmsh", ".vtu", ".inp", "Gmsh for"]),
    "shape without mesh": (["info", "bracket.step"], [".step", ".msh"]),
    "unknown format": (["run", "part.nas", *OUT], ["part.nas: .nas is not a format", ".msh"]),
    "info of a missing mesh": (["info", "none.msh"], ["none.msh"]),
    "load steps of a motion": ([*SHORT, "--load-steps", "3"], ["--load-steps is for --static"]),
    "springs of a motion": ([*SHORT, "--stabilise"], ["--stabilise is for --static"]),
    "static with dt": (["run", "cantilever", "--static", "--dt", "1e-3"], ["--dt is for a motion"]),
    "static with a checkpoint": (["run", "cantilever", "--static", "--checkpoint", "o.npz"], ["--checkpoint is for"]),
    "static with jacobi": (["run", "cantilever", "--static", "--solver", "jacobi"], ["--solver jacobi"]),
    "static of what falls": (["run", "part.msh", "--static", "--material", SVK, "--device", "cpu"], ["not supported"]),
    "field without picture": ([*SHORT, "--field", "displacement"], ["--field is for pictures"]),
    "view without picture": ([*SHORT, "--usd", "o.usdc", "--view", "1,2"], ["--view is for pictures"]),
    "range that falls": ([*SHORT, "--png", "o.png", "--range", "2,1"], ["--range", "'2,1'"]),
    "abbreviated option": (["run", "hook", "--devic", "cpu"], ["--devic"]),
    "unknown scene": (["run", "crane", *OUT], ["'crane'", "cantilever", "hook", "twist"]),
    "missing file": (["run", "none.py", *OUT], ["none.py", "no such file"]),
    "no scene in file": (["run", "empty.py", *OUT], ["empty.py", "no scene"]),
    "several scenes": (["run", "mine.py", *OUT], ["mine.py", "good", "bursts"]),
    "unknown scene in file": (["run", "mine.py:best", *OUT], ["'best'", "good"]),
    "error in scene": (["run", "mine.py:broken", *OUT], ["'broken'", "IndexError", "mine.py:"]),
    "later feature": (["run", "mine.py:later", *OUT], ["add_beam"]),
    "unknown parameter": ([*SHORT, "--set", "wide=1", *OUT], ["'wide'", "length", "cells"]),
    "bad value": ([*SHORT, "--set", "E=stiff", *OUT], ["E", "'stiff'"]),
    "bad physics": ([*SHORT, "--set", "nu=0.5", *OUT], ["nu", "0.5"]),
    "bad element": ([*SHORT, "--set", "element=T7", *OUT], ["T7"]),
    "no equals": ([*SHORT, "--set", "E", *OUT], ["--set E"]),
    "dt zero": ([*SHORT, "--dt", "0", *OUT], ["--dt", "'0'"]),
    "dt text": ([*SHORT, "--dt", "fast", *OUT], ["--dt", "'fast'"]),
    "t-end negative": ([*SHORT, "--t-end=-1", *OUT], ["--t-end", "'-1'"]),
    "unknown integrator": ([*SHORT, "--integrator", "rk4", *OUT], ["'rk4'", "backward_euler"]),
    "tol too large": ([*SHORT, "--tol", "2", *OUT], ["tol", "2"]),
    "unknown device": ([*SHORT, "--device", "cuda:77", *OUT], ["cuda:77", "cpu"]),
    "unknown dtype": ([*SHORT, "--dtype", "float16", *OUT], ["float16", "float64"]),
    "usd suffix": ([*SHORT, "--usd", "o.txt"], ["--usd", "o.txt", ".usdc"]),
    "png suffix": ([*SHORT, "--usd", "o.usdc", "--png", "o.jpg"], ["--png", "o.jpg"]),
    "json suffix": ([*SHORT, "--json", "o.txt"], ["--json", "o.txt"]),
    "checkpoint suffix": ([*SHORT, "--checkpoint", "o.ckpt"], ["--checkpoint", "o.ckpt"]),
    "every zero": ([*SHORT, "--checkpoint", "o.npz", "--every", "0"], ["--every"]),
    "missing checkpoint": ([*SHORT, "--resume", "none.npz", *OUT], ["none.npz", "no such checkpoint"]),
    "bad checkpoint": ([*SHORT, "--resume", "bad.npz", *OUT], ["bad.npz", "readable"]),
    "missing mesh": (["run", "none.msh", "--material", SVK, *OUT], ["none.msh"]),
    "bad mesh": (["run", "bad.msh", "--material", SVK, *OUT], ["bad.msh"]),
    "no material": ([*MESH, "--clamp", "x-", *OUT], ["no material", "body (12 elements)"]),
    "unknown law": ([*MESH, "--material", "steel:E=1", *OUT], ["steel:E=1", "svk", "neo_hookean"]),
    "incomplete law": ([*MESH, "--material", "svk:E=1e7,nu=0.3", *OUT], ["density"]),
    "unknown constant": ([*MESH, "--material", SVK + ",G=1", *OUT], ["G"]),
    "bad constant": ([*MESH, "--material", "svk:E=x,nu=0.3,density=1", *OUT], ["E = 'x'"]),
    "bad law value": ([*MESH, "--material", "svk:E=-1,nu=0.3,density=1", *OUT], ["E = -1"]),
    "law twice": ([*CLAMPED, "--material", SVK, *OUT], ["--material"]),
    "unknown group": ([*MESH, "--material", f"arm={SVK}", *OUT], ["'arm'", "body"]),
    "unknown clamp": ([*MESH, "--material", SVK, "--clamp", "base", *OUT], ["'base'", "x-"]),
    "unknown surface": ([*CLAMPED, "--traction", "tip:0,0,1", *OUT], ["'tip'", "x+"]),
    "bad traction": ([*CLAMPED, "--traction", "x+:0,0", *OUT], ["x+:0,0", "3"]),
    "no traction group": ([*CLAMPED, "--traction", "0,0,1", *OUT], ["GROUP:x,y,z"]),
    "bad pressure": ([*CLAMPED, "--pressure", "x+:nan", *OUT], ["x+:nan"]),
    "bad gravity": ([*CLAMPED, "--gravity", "down", *OUT], ["--gravity", "'down'"]),
    "bad scale": ([*CLAMPED, "--scale", "0", *OUT], ["--scale"]),
    "unknown rule": ([*CLAMPED, "--quadrature", "tet9", *OUT], ["tet9", "tet4"]),
    "set on a mesh": ([*CLAMPED, "--set", "E=1", *OUT], ["--set E=1"]),
    "clamp on a scene": ([*SHORT, "--clamp", "x-", *OUT], ["--clamp"]),
    "render without target": (["render", "bad.usdc"], ["--output"]),
    "render a missing file": (["render", "none.usdc", "-o", "o.png"], ["none.usdc"]),
    "render to a wrong suffix": (["render", "bad.usdc", "-o", "o.mp4"], ["o.mp4", ".png"]),
    "render a wrong size": (["render", "bad.usdc", "-o", "o.png", "--size", "big"], ["--size", "'big'"]),
    "bench too small": (["bench", "--unknowns", "10"], ["--unknowns 10", "270"]),
    "bench text": (["bench", "--unknowns", "many"], ["--unknowns", "'many'"]),
    "no such study": (["study", "hok"], ["'hok'", "ancf-tets", "did you mean 'hook'"]),
    "later command": (["sweep", "--set", "E=1"], ["sweep", "not part of this version"]),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_usage_exits_2_names_it_and_leaves_nothing(folder, capfd, case):
    words, named = BAD[case]
    before = files(folder)
    code, _, err = run(capfd, *words)
    assert code == 2, err
    lines = [line for line in err.splitlines() if not line.startswith("warpfea: warning: no --clamp")]
    assert len(lines) == 1, err
    assert lines[0].startswith("warpfea: error: ")
    for word in named:
        assert word in err
    assert files(folder) == before


@pytest.mark.parametrize(
    ("option", "target"),
    [
        ("--usd", "no/o.usdc"),
        ("--vtu", "no/series"),
        ("--vtu", "mine.py"),
        ("--json", "no/o.json"),
        ("--gif", "no/o.gif"),
    ],
)
def test_targets_that_cannot_be_written_exit_4_before_the_run(folder, capfd, option, target, monkeypatch):
    monkeypatch.setattr(wf.Simulation, "__init__", lambda *_, **__: pytest.fail("a simulation was made"))
    before = files(folder)
    code, out, err = run(capfd, *SHORT, "--checkpoint", "o.npz", option, target)
    assert (code, out) == (4, "")
    assert err.startswith("warpfea: error: ")
    assert target in err
    assert files(folder) == before


def test_an_unreadable_stage_exits_2(folder, capfd):
    code, _, err = run(capfd, "render", "bad.usdc", "-o", "o.png")
    assert code == 2
    assert "bad.usdc" in err
    assert not (folder / "o.png").exists()


def test_an_output_that_fails_in_the_run_exits_4(folder, capfd, monkeypatch):
    def fail(*_, **__):
        raise OSError("no space left")

    monkeypatch.setattr(np, "savez", fail)
    before = files(folder)
    code, out, err = run(capfd, *SHORT, "--checkpoint", "o.npz", "--every", "2", "--json", "o.json")
    assert code == 4
    assert "o.npz" in err
    assert "no space left" in err
    assert "output failed" in out
    assert json.loads((folder / "o.json").read_text())["status"] == "output failed"
    assert files(folder) == before | {"o.json"}


def test_not_converged_exits_3_with_valid_files(folder, capfd):
    code, out, err = run(capfd, "run", "mine.py:bursts", "--device", "cpu", *OUT, "--tol", "1e-6")
    assert code == 3
    assert err.startswith("warpfea: error: step from t = ")
    assert "element" in err
    assert "not converged" in out
    summary = json.loads((folder / "o.json").read_text())
    assert summary["status"] == "not converged"
    assert 0 < summary["steps"] < 15
    assert summary["t_end"] == pytest.approx(summary["steps"] * 2e-3)
    assert validate_usd("o.usdc") == []
    code, _, err = run(capfd, "run", "mine.py:bursts", "--device", "cpu", "--resume", "o.npz", "--tol", "1e-6")
    assert code == 3


def test_ctrl_c_exits_130_with_valid_files(folder, capfd, monkeypatch):
    step = wf.Simulation.step

    def interrupted(self, count=1):
        if self.steps == 2:
            signal.raise_signal(signal.SIGINT)
        return step(self, count)

    monkeypatch.setattr(wf.Simulation, "step", interrupted)
    code, out, err = run(capfd, *SHORT, *OUT)
    assert (code, err) == (130, "warpfea: interrupted\n")
    assert "interrupted" in out
    summary = json.loads((folder / "o.json").read_text())
    assert (summary["status"], summary["steps"]) == ("interrupted", 3)
    assert validate_usd("o.usdc") == []
    monkeypatch.setattr(wf.Simulation, "step", step)
    code, out, _ = run(capfd, *SHORT, "--resume", "o.npz", "--json", "-")
    assert (code, json.loads(out)["steps"]) == (0, 5)
    assert not [name for name in os.listdir(folder) if ".part" in name]


@pytest.mark.parametrize("when", ["step", "close"])
def test_ctrl_c_after_the_last_step_is_too_late_to_interrupt(folder, capfd, monkeypatch, when):
    if when == "step":
        step = wf.Simulation.step

        def interrupted(self, count=1):
            if self.steps == 4:
                signal.raise_signal(signal.SIGINT)
            return step(self, count)

        monkeypatch.setattr(wf.Simulation, "step", interrupted)
    else:
        close = wf.USDWriter.close

        def closed(self, sim):
            signal.raise_signal(signal.SIGINT)
            close(self, sim)

        monkeypatch.setattr(wf.USDWriter, "close", closed)
    code, out, err = run(capfd, *SHORT, *OUT)
    assert (code, err) == (0, "")
    assert "done at t = 0.01 s, 5 steps" in out
    assert json.loads((folder / "o.json").read_text())["status"] == "done"
    assert validate_usd("o.usdc") == []


def test_ctrl_c_during_the_report_does_not_take_it_away(folder, capfd, monkeypatch):
    from warpfea.cli import run as command

    human = command.human

    def late(*args):
        signal.raise_signal(signal.SIGINT)
        return human(*args)

    monkeypatch.setattr(command, "human", late)
    code, out, err = run(capfd, *SHORT)
    assert (code, err) == (0, "")
    assert "done at t = 0.01 s" in out


def test_a_resumed_run_goes_on_with_its_animation(folder, capfd):
    words = [*SHORT[:-2], "--quiet", "--fps", "500", "--vtu", "series"]
    assert run(capfd, *words, "--t-end", "0.012", "--usd", "whole.usdc")[0] == 0
    whole = (folder / "series" / "series.pvd").read_text()
    shutil.rmtree(folder / "series")
    assert run(capfd, *words, "--t-end", "0.006", "--usd", "o.usdc", "--checkpoint", "c.npz")[0] == 0
    rest = [*words, "--t-end", "0.012", "--resume", "c.npz"]
    assert run(capfd, *rest, "--usd", "o.usdc")[0] == 0
    assert validate_usd("o.usdc") == []
    from pxr import Usd

    for name in ("whole.usdc", "o.usdc"):
        stage = Usd.Stage.Open(name)
        assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0.0, 6.0)
        assert stage.GetDefaultPrim().GetCustomDataByKey("warpfea")["frames"] == 7
    assert (folder / "series" / "series.pvd").read_text() == whole
    # the file goes beyond the checkpoint now
    before = (folder / "o.usdc").read_bytes()
    code, _, err = run(capfd, *rest, "--usd", "o.usdc")
    assert code == 4
    assert "o.usdc: can't go on with this file" in err
    assert (folder / "o.usdc").read_bytes() == before


def test_a_gif_is_not_overwritten_by_its_second_half(folder, capfd):
    assert run(capfd, *SHORT, "--checkpoint", "c.npz", "--quiet", "--gif", "o.gif")[0] == 0
    before = (folder / "o.gif").read_bytes()
    rest = [*SHORT[:-1], "0.014", "--resume", "c.npz", "--quiet"]
    code, _, err = run(capfd, *rest, "--gif", "o.gif")
    assert code == 2
    assert "o.gif" in err
    assert "another name" in err
    assert (folder / "o.gif").read_bytes() == before
    assert run(capfd, *rest, "--gif", "rest.gif")[0] == 0


@pytest.mark.skipif(not pathlib.Path("/proc").is_dir(), reason="no folder that takes no files")
def test_a_folder_that_takes_no_files_is_named(folder, capfd, monkeypatch):
    monkeypatch.setattr(wf.Simulation, "__init__", lambda *_, **__: pytest.fail("a simulation was made"))
    code, out, err = run(capfd, *SHORT, "--usd", "/proc/o.usdc")
    assert (code, out) == (4, "")
    assert err.startswith("warpfea: error: /proc/o.usdc: the folder /proc ")
    assert "pxr" not in err


def test_resuming_a_finished_run_is_refused(folder, capfd):
    assert run(capfd, *SHORT, "--checkpoint", "o.npz", "--quiet")[0] == 0
    code, _, err = run(capfd, *SHORT, "--resume", "o.npz")
    assert code == 2
    assert "t = 0.01 s already" in err


def test_a_checkpoint_of_another_model_exits_2(folder, capfd):
    assert run(capfd, *SHORT, "--checkpoint", "o.npz", "--quiet")[0] == 0
    code, _, err = run(capfd, *SHORT, "--set", "E=8e8", "--t-end", "0.02", "--resume", "o.npz")
    assert code == 2
    assert "another model" in err


def test_a_defect_exits_1_and_debug_shows_where(folder, capfd, monkeypatch):
    def fail(*_, **__):
        raise RuntimeError("this must not happen")

    monkeypatch.setattr(wf.Simulation, "run", fail)
    code, _, err = run(capfd, *SHORT)
    assert code == 1
    assert err == "warpfea: error: RuntimeError: this must not happen (a defect; --debug shows where)\n"
    with pytest.raises(RuntimeError):
        main([*SHORT, "--debug"])


# materials


@pytest.mark.parametrize(
    ("text", "group", "law", "values"),
    [
        ("svk:E=1e7,nu=0.3,density=1000", "", wf.SVK, {"E": 1e7, "nu": 0.3, "density": 1000.0}),
        ("my arm=svk:E=1e7, nu=0.3, density=1", "my arm", wf.SVK, {"density": 1.0}),
        ("a=b=neo_hookean:mu=1e5,k=1e6,density=2", "a=b", wf.NeoHookean, {"mu": 1e5, "k": 1e6}),
        ("neo_hookean:E=3e5,nu=0.25,density=2", "", wf.NeoHookean, {"mu": 1.2e5, "k": 2e5}),
        ("mooney_rivlin:mu10=1,mu01=2,k=3,density=4", "", wf.MooneyRivlin, {"mu10": 1.0, "mu01": 2.0, "k": 3.0}),
        ("mooney_rivlin:E=3e5,nu=0.25,density=2,ratio=0.5", "", wf.MooneyRivlin, {"mu10": 3e4, "mu01": 3e4}),
    ],
)
def test_materials_are_read(text, group, law, values):
    found, material = parse_material(text)
    assert found == group
    assert isinstance(material, law)
    assert material.damping is None
    for name, value in values.items():
        assert getattr(material, name) == pytest.approx(value, rel=1e-12)


def test_damping_is_read():
    _, material = parse_material(SVK + ",eta=5,lambda_v=6,form=rate")
    assert material.damping == wf.KelvinVoigt(eta=5.0, lambda_v=6.0, form="rate")
    for bad in (",lambda_v=6", ",eta=1,form=odd", ",eta=-1"):
        with pytest.raises(UsageError):
            parse_material(SVK + bad)
