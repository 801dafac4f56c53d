"""The way of one step through the files of warpfea, from `Simulation.step` to its last kernel, kernels and base/ left
out."""

import pathlib
import sys

import pytest

import warpfea as wf
from warpfea.builder.scene import find

ROOT = pathlib.Path(wf.__file__).parent


def stays(name):
    """Files in the order of a step, launched anew, one entry for each stay; a function counts at its first call."""
    scene = find(name)
    options = {"dt": scene.dt, "integrator": scene.integrator, "solver": wf.NewtonPCG(tol=scene.tol)}
    sim = wf.Simulation(scene().finalize(device="cpu"), **options)
    sim.stepper.graph = None
    seen, way = set(), []

    def trace(frame, event, _):
        code, path = frame.f_code, pathlib.Path(frame.f_code.co_filename)
        if event != "call" or code in seen or ROOT not in path.parents or code.co_name.startswith("<"):
            return
        seen.add(code)
        file = path.relative_to(ROOT).as_posix()
        if not file.startswith(("base/", "kernels/")) and [file] != way[-1:]:
            way.append(file)

    sys.setprofile(trace)
    try:
        sim.step()
    finally:
        sys.setprofile(None)
    return way


MOST = {"hook": 38, "slider_crank": 54, "block_stack": 68, "bouncing_ball": 47}
"""At abb108a it was 76, 85, 101, 71."""


@pytest.mark.parametrize(("name", "most"), MOST.items())
def test_a_step_changes_its_file_seldom(name, most):
    way = stays(name)
    assert way[0] == "simulation/simulation.py"
    assert len(way) <= most, way
