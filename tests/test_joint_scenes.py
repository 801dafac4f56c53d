"""Scenes of mechanisms: they build, run and hold their joints; the command line tells of joints."""

from __future__ import annotations

import json
import math
import pathlib
import re

import numpy as np
import pytest
from cli_runs import run
from scene_runs import scene_simulation

import warpfea as wf
from warpfea.builder.scene import find
from warpfea.cli.summary import MAX_ROWS, SUMMARY_KEYS

ROOT = pathlib.Path(__file__).resolve().parent.parent
SMALL = {
    "chain": {"links": 6},
    "double_pendulum": {"cells": 2},
    "four_bar": {"elements": 2},
    "hung_plate": {"cells": 2},
    "slider_crank": {"elements": 2},
}
STEEL = {"E": 2e11, "density": 7870.0, "slider_mass": 0.0755}


def simulate(name, steps=0, **parameters):
    """A scene at its own settings after some steps, each within the tolerance of its constraints."""
    sim = scene_simulation(name, **parameters)
    for _ in range(steps):
        report = sim.step()
        assert report.converged.all()
        assert report.halvings[0] == 0
        assert report.violation[0] <= 1e-8 * sim.model.size
    return sim


def joint_of(sim, name):
    return next(joint for joint in sim.model.constraints.joints if joint.name == name)


@pytest.mark.parametrize("name", SMALL)
def test_scenes_run_a_few_steps_on_coarse_meshes(name):
    sim = simulate(name, steps=4, **SMALL[name])
    for joint in sim.model.constraints.joints:
        assert sim.violation(joint)[0] <= 1e-8 * sim.model.size
        assert np.isfinite(sim.joint_force(joint)).all()
    e = sim.energies()
    assert abs(e["ledger_residual"][0]) < 1e-3 * max(abs(e["kinetic"][0]), e["strain"][0])


# what mechanics says


@pytest.mark.parametrize("material", [{}, STEEL])
def test_slider_crank_starts_with_the_velocities_of_the_mechanism(material):
    """m v^2 / 6 of the rod's end, rho A crank^3 speed^2 / 6 of the crank, and nothing of the slider."""
    side, speed, crank, rod = 0.008, 150.0, 0.15, 0.30
    sim = simulate("slider_crank", steps=2, **material)
    density = material.get("density", 1200.0)
    rigid = density * side**2 * (speed * crank) ** 2 * (rod + 4.0 * crank) / 6.0
    assert sim.energies()["kinetic"][0] == pytest.approx(rigid, rel=0.02)
    assert sim.joint_value(joint_of(sim, "motor"))[0] == pytest.approx(2 * 2e-4 * speed, abs=1e-7)


def test_slider_crank_of_steel_moves_as_a_rigid_one():
    crank, rod, angle = 0.15, 0.30, 150.0 * 60 * 2e-4
    sim = simulate("slider_crank", steps=60, elements=4, **STEEL)
    slider = crank * math.cos(angle) + math.sqrt(rod**2 - (crank * math.sin(angle)) ** 2)
    assert sim.probe("slider").position[0, -1, 0] == pytest.approx(slider, abs=2e-3 * rod)
    middle = sim.probe("middle of rod").position[0, -1]
    pin = crank * np.array([math.cos(angle), 0.0, math.sin(angle)])
    assert np.linalg.norm(middle - 0.5 * (pin + [slider, 0, 0])) < 0.03 * rod
    assert abs(middle[1]) < 1e-6


def test_four_bar_closes_or_says_why_not():
    sim = simulate("four_bar", steps=3, elements=2, start=0.3)
    coupler = sim.model.bodies[1]
    x = sim.positions(coupler)[0]
    assert np.linalg.norm(x[-1] - x[0]) == pytest.approx(0.40, rel=1e-3)
    with pytest.raises(wf.ModelError, match=r"do not close at start = 0 rad"):
        find("four_bar")(start=0.0, ground=0.9)


def test_chain_begins_under_the_pull_of_its_weight():
    sim = simulate("chain", steps=3, links=6)
    pull = 1000.0 * 1000.0 * 0.05 * 0.025**2 * 9.81 * math.cos(1.0)
    force = sim.joint_record(joint_of(sim, "shackle")).force[0]
    np.testing.assert_allclose(np.linalg.norm(force, axis=1), pull, rtol=0.15)
    assert force[-1] @ [-math.sin(1.0), 0.0, math.cos(1.0)] > 0.99 * np.linalg.norm(force[-1])


@pytest.mark.parametrize(("joint", "rows"), [("revolute", 5), ("spherical", 3)])
def test_chain_takes_either_joint(joint, rows):
    model = find("chain")(links=3, joint=joint).finalize(device="cpu")
    assert [len(j.rows) for j in model.constraints.joints] == [rows] * 3 + [3]


def test_hung_plate_pulls_evenly_on_its_rods():
    sim = simulate("hung_plate", steps=5, cells=4)
    forces = np.array([sim.joint_force(joint_of(sim, f"rod {k}"))[0, :3] for k in (1, 2, 3, 4)])
    pulls = np.linalg.norm(forces, axis=1)
    np.testing.assert_allclose(pulls, pulls.mean(), rtol=1e-2)
    assert (forces[:, 2] > 0.0).all()
    t = sim.time[0]
    assert sim.joint_value(joint_of(sim, "hub"))[0] == pytest.approx(
        0.5 * (1.0 - math.cos(2.0 * math.pi * t)), abs=1e-4
    )


def test_double_pendulum_turns_about_its_hinges():
    sim = simulate("double_pendulum", steps=8, cells=2)
    pivot, elbow = (joint_of(sim, name) for name in ("pivot", "elbow"))
    assert sim.joint_value(pivot)[0] < -0.01
    assert 0.0 < abs(sim.joint_value(elbow)[0]) < 0.1
    force = sim.joint_force(pivot)[0]
    assert 0.0 < force[2] < sim.model.info()["mass"] * 9.81
    assert abs(force[4]) < 1e-3 * 0.4 * force[2]  # about its own axis a hinge gives way


# the command line

CONFLICT = """
import warpfea as wf

@wf.scene(dt=1e-3, t_end=.01)
def torn() -> wf.ModelBuilder:
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(wf.mesh.box((1, .2, .2), cells=(1, 1, 1)), material=wf.SVK(E=1e7, nu=.3, density=1000))
    b.clamp(body.nodes("x-"))
    tip = body.at((1, .1, .1))
    b.add_constraint("DIST", points=(tip, (2, .1, .1)), name="rod A")
    b.add_constraint("DIST", points=(tip, (3, .1, .1)), value=([0, .01], [2.0, 2.2]), name="rod B")
    return b
"""


def crank(*words):
    return "slider_crank", "--set", "elements=2", "--device", "cpu", *words


def test_summary_has_a_row_for_each_joint(capfd, tmp_path):
    target = tmp_path / "s.json"
    code, out, err = run(capfd, "run", *crank("--t-end", "6e-4", "--json", target))
    assert (code, err) == (0, "")
    sim = simulate("slider_crank", steps=3, elements=2)
    for joint in sim.model.constraints.joints:
        (line,) = [line for line in out.splitlines() if line.startswith(f"joint {joint.name} ")]
        assert f"  {joint.kind}, violation " in line
        force, moment = (float(word) for word in re.search(r"force (\S+) N, moment (\S+) N m$", line).groups())
        values = sim.joint_force(joint)[0]
        assert force == pytest.approx(np.linalg.norm(values[:3]), rel=1e-3)
        assert moment == pytest.approx(np.linalg.norm(values[3:]), rel=1e-3)
    summary = json.loads(target.read_text())
    assert tuple(summary) == SUMMARY_KEYS
    assert summary["violation"] == sim.max_violation > 0.0
    assert f"violation up to {summary['violation']:.2g} m" in out


def test_summary_lists_the_worst_of_many_joints(capfd):
    links = ("--set", f"links={MAX_ROWS}", "--device", "cpu")
    code, out, _ = run(capfd, "run", "chain", *links, "--t-end", "0.02")
    assert code == 0
    rows = [line for line in out.splitlines() if line.startswith("joint ")]
    assert 1 < len(rows) < MAX_ROWS
    values = [float(re.search(r"violation (\S+) m", line)[1]) for line in rows]
    assert values == sorted(values, reverse=True)
    assert f"{MAX_ROWS + 1} joints; largest violations shown" in out
    code, out, _ = run(capfd, "info", "chain", *links)
    assert code == 0
    assert "12 revolute (60 equations), 1 spherical (3 equations)" in out
    assert "12 bodies" in out
    assert "body weight" in out


def test_info_lists_joints(capfd):
    code, out, _ = run(capfd, "info", *crank())
    assert code == 0
    assert re.search(r"\njoint motor +revolute, 6 equations, the ground and nodes 'start' of body 'crank'\n", out)
    assert re.search(r"\njoint guide +translational, 5 equations, the ground and surface 'z-' of body 'slider'\n", out)
    code, out, _ = run(capfd, "info", *crank("--json", "-"))
    joints = json.loads(out)["joints"]
    assert [j["name"] for j in joints] == ["motor", "crank pin", "slider pin", "guide"]


def test_a_run_with_joints_resumes_bit_for_bit(capfd, tmp_path):
    whole, rest, saved = tmp_path / "whole.json", tmp_path / "rest.json", tmp_path / "c.npz"
    assert run(capfd, "run", *crank("--t-end", "8e-4", "--json", whole, "--quiet"))[0] == 0
    assert run(capfd, "run", *crank("--t-end", "4e-4", "--checkpoint", saved, "--quiet"))[0] == 0
    assert run(capfd, "run", *crank("--t-end", "8e-4", "--resume", saved, "--json", rest, "--quiet"))[0] == 0
    a, b = (json.loads(path.read_text()) for path in (whole, rest))
    for key in SUMMARY_KEYS:
        if not key.endswith("_s"):  # times
            assert a[key] == b[key], key


def test_constraints_that_conflict_exit_3_and_are_named(capfd, tmp_path):
    file = tmp_path / "torn.py"
    file.write_text(CONFLICT)
    code, out, err = run(capfd, "run", file, "--device", "cpu", "--json", tmp_path / "s.json")
    assert code == 3
    assert "rod A" in err
    assert "rod B" in err
    assert "joint rod A" in out
    assert json.loads((tmp_path / "s.json").read_text())["status"] == "not converged"
