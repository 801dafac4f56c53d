"""The command line, called in this process: errors and their exit codes, interrupts."""

from __future__ import annotations

import json
import os
import pathlib
import shutil
import signal

import numpy as np
import pytest
from cli_runs import SHORT, SVK, files, run, working_folder

import warpfea as wf
from warpfea.cli import main
from warpfea.outputs.usd import validate_usd


@pytest.fixture
def folder(tmp_path, monkeypatch):
    return working_folder(tmp_path, monkeypatch)


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
    "shape without mesh": (["info", "bracket.off"], [".off", ".msh"]),
    "missing shape": (["info", "bracket.step"], ["bracket.step: no such file"]),
    "unknown format": (["run", "part.nas", *OUT], ["part.nas: unsupported file type .nas", ".msh"]),
    "info of a missing mesh": (["info", "none.msh"], ["none.msh"]),
    "load steps of a motion": ([*SHORT, "--load-steps", "3"], ["--load-steps is for --static"]),
    "springs of a motion": ([*SHORT, "--stabilise"], ["--stabilise is for --static"]),
    "stability of a motion": ([*SHORT, "--unstable", "refuse"], ["--unstable is for --static"]),
    "static with dt": (["run", "cantilever", "--static", "--dt", "1e-3"], ["--dt is for a motion"]),
    "static with a checkpoint": (["run", "cantilever", "--static", "--checkpoint", "o.npz"], ["--checkpoint is for"]),
    "static with jacobi": (["run", "cantilever", "--static", "--solver", "jacobi"], ["--solver jacobi"]),
    "static of what falls": (
        ["run", "part.msh", "--static", "--material", SVK, "--device", "cpu"],
        ["unconstrained rigid-body modes"],
    ),
    "field without picture": ([*SHORT, "--field", "displacement"], ["--field is for pictures"]),
    "view without picture": ([*SHORT, "--usd", "o.usdc", "--view", "1,2"], ["--view is for pictures"]),
    "range that falls": ([*SHORT, "--png", "o.png", "--range", "2,1"], ["--range", "'2,1'"]),
    "abbreviated option": (["run", "hook", "--devic", "cpu"], ["--devic"]),
    "unknown scene": (["run", "derrick", *OUT], ["'derrick'", "cantilever", "hook", "twist"]),
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
    "no such study": (["study", "hok"], ["'hok'", "identify", "did you mean 'hook'"]),
    "option of another command": (["sweep", "--set", "E=1"], ["--set", "warpfea sweep --help"]),
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

    summary_text = command.summary_text

    def late(*args):
        signal.raise_signal(signal.SIGINT)
        return summary_text(*args)

    monkeypatch.setattr(command, "summary_text", late)
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


@pytest.mark.parametrize("kind", ["gif", "html"])
def test_a_file_is_not_overwritten_by_its_second_half(folder, capfd, kind):
    name, option = f"o.{kind}", f"--{kind}"
    assert run(capfd, *SHORT, "--checkpoint", "c.npz", "--quiet", option, name)[0] == 0
    before = (folder / name).read_bytes()
    rest = [*SHORT[:-1], "0.014", "--resume", "c.npz", "--quiet"]
    code, _, err = run(capfd, *rest, option, name)
    assert code == 2
    assert name in err
    assert "another name" in err
    assert (folder / name).read_bytes() == before
    assert run(capfd, *rest, option, f"rest.{kind}")[0] == 0


@pytest.mark.skipif(not pathlib.Path("/proc").is_dir(), reason="no folder that takes no files")
def test_a_folder_that_takes_no_files_is_named(folder, capfd, monkeypatch):
    monkeypatch.setattr(wf.Simulation, "__init__", lambda *_, **__: pytest.fail("a simulation was made"))
    code, out, err = run(capfd, *SHORT, "--usd", "/proc/o.usdc")
    assert (code, out) == (4, "")
    assert err.startswith("warpfea: error: /proc/o.usdc: cannot write to folder /proc ")
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
