"""The command line, called in this process: what it writes, its exit codes, its errors."""

from __future__ import annotations

import importlib.util
import json
import os
import pathlib
import signal
import subprocess
import sys

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


def load_writers():
    spec = importlib.util.spec_from_file_location("mesh_writers", HERE / "mesh_writers.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working folder with a mesh, a file of scenes, and things that are neither."""
    writers = load_writers()
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


def test_the_bar_of_the_compilation_goes_to_stderr(capfd):
    ready = []
    model = find("cantilever")(cells=2).finalize(device="cpu")
    wf.Simulation(model, dt=1e-3, on_compile=lambda *news: ready.append(news))
    done, total, names = zip(*ready)
    assert done == tuple(range(1, total[0] + 1))
    assert "warpfea.kernels.common.reduce" in names
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
    "later command": (["study", "hook"], ["study", "not part of this version"]),
    "later command with options": (["sweep", "--set", "E=1"], ["sweep", "not part of this version"]),
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


def test_an_unreadable_stage_exits_4(folder, capfd):
    code, _, err = run(capfd, "render", "bad.usdc", "-o", "o.png")
    assert code == 4
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
