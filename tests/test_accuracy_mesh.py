"""A target is met by the sum of the errors: in time, and of the mesh."""

import json

import pytest
from accuracy_runs import run

import warpfea as wf
from warpfea.cli import main
from warpfea.studies.accuracy.plot import AXIS_LABELS

SCENE = """
import warpfea as wf

@wf.scene(dt=1e-2, t_end=0.08, tol=1e-8)
def bending(*, cells: int = 2) -> wf.ModelBuilder:
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    mesh = wf.mesh.box((1, 0.2, 0.2), cells=(cells, 1, 1), element="T4")
    bar = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
    b.clamp(bar.nodes("x-"))
    b.add_probe("tip", bar.surface("x+"))
    return b
"""


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "bending.py"
    path.write_text(SCENE)
    return path


def test_a_target_is_met_by_the_sum_of_the_errors(scene, tmp_path, capsys):
    """In time the error is 0.0064, of two cells 0.05: on 8934ce7 0.05 was "reached", with exit code 0."""
    words = ["study", str(scene), "--over", "dt=5e-3", "--methods", "bdf2", "--repeat", "1", "--device", "cpu"]
    words += ["--no-progress", "--out", str(tmp_path)]
    for target, code, text in (
        (0.1, 0, "(in time; mesh error of 0.052 included)"),
        (0.055, 3, "reached in time; with mesh error 0.052 the sum 0.0586 misses 0.055: bdf2, dt=0.005"),
        (0.01, 3, "reached in time; mesh error 0.052 misses 0.01: bdf2, dt=0.005: error 0.00639 in "),
        (0.001, 3, "no setting was measured to reach 0.001; nearest: bdf2, dt=0.005: 0.00639"),
    ):
        assert main([*words, "--target", str(target)]) == code
        told = capsys.readouterr().out
        assert text in told
        assert "errors in time, over the largest travel" in told
        content = json.loads((tmp_path / "bending.json").read_text())
        assert (content["answer"] is None) == (code == 3)
    assert main([*words, "--target", "0.01", "--split", "none"]) == 0  # whoever asks for no estimate gets none
    assert "(in time; mesh error not estimated)" in capsys.readouterr().out


def test_axes_tell_which_error(scene):
    """On 8934ce7 all said "error (L2 over time) / largest travel"."""
    options = {"over": {"dt": [1e-2]}, "methods": ["bdf2"]}
    assert run(str(scene), **options).kind == "in time"
    assert run(str(scene), **(options | {"over": {"dt": [1e-2], "cells": [2]}})).kind == "in time and mesh"
    still = wf.Reference({"tip": ([0.0, 0.08], [[1.0, 0.1, 0.1], [1.0, 0.1, 0.0]])})
    known = run(str(scene), **options, reference=still)
    assert known.kind == "in time and mesh"
    assert AXIS_LABELS["l2"].format(known.kind) == "error in time and mesh (L2 over time) / largest travel"
