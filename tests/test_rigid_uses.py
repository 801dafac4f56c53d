"""Rigid parts as a flexible body is used: loads, drives, files, outputs, reset; what a fast spin loses."""

from typing import Any

import numpy as np
import pytest
from test_rigid import rigid_body_motion, rotation

import warpfea as wf
from warpfea.builder.scene import find

TIGHT = {"solver": wf.NewtonPCG(tol=1e-12), "constraint_tol": 1e-12}
SIZE = np.array([0.1, 0.2, 0.3])


def box(**options: Any) -> tuple[wf.ModelBuilder, Any]:
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    return b, b.add_rigid(wf.Box((0, 0, 0), tuple(SIZE)), mass=2.0, name="part", **options)


def test_pressure_on_a_side_and_a_moment() -> None:
    """From rest a part moves by p A/m across its side; a moment about a principal axis turns it by M/I."""
    b, part = box()
    b.add_pressure(part.surface("x+"), 50.0)
    b.add_moment(part.at((0.02, 0.03, 0.1)), (0.3, 0.0, 0.0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, **TIGHT)
    sim.step(20)
    travel = 50.0 * SIZE[1] * SIZE[2] / 2.0 * 1e-6 * 210.0  # backward Euler: h^2 n (n + 1) / 2
    assert sim.pose(part)[0][0] == pytest.approx([-travel, 0.0, 0.0], abs=1e-10 * travel)
    inertia = 2.0 / 12.0 * (SIZE[1] ** 2 + SIZE[2] ** 2)
    assert sim.angular_velocity(part)[0] == pytest.approx([0.3 / inertia * 0.02, 0.0, 0.0], rel=1e-5, abs=1e-10)


def test_a_part_that_is_driven() -> None:
    """Nodes of a side on a path carry all of it, beside one that is free."""
    b, part = box()
    b.add_rigid(wf.Box((1, 0, 0), tuple(SIZE)), mass=1.0)
    b.drive(part.nodes("x+"), displacement=([0.0, 1.0], [(0, 0, 0), (0.3, 0, -0.1)]))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-2, **TIGHT)
    sim.step(50)
    assert sim.pose(part)[0][0] == pytest.approx([0.15, 0.0, -0.05], abs=1e-12)
    assert sim.pose(part)[1][0] == pytest.approx([0.0, 0.0, 0.0, 1.0], abs=1e-12)


def test_an_actuator_between_two_free_parts_keeps_momentum() -> None:
    """Torque of a motor and its reaction: linear and angular momentum of both stay 0."""
    b, first = box()
    second = b.add_rigid(wf.Box((0.3, 0, 0), (0.4, 0.1, 0.1)), mass=1.0, name="second")
    joint = b.add_joint("revolute", parent=first.at((0.1, 0, 0)), child=second.at((0.1, 0, 0)), axis=(0, 0.6, 0.8))
    b.add_actuator(joint, ([0.0, 0.1], [0.5, 2.0]))
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=2e-3, integrator="energy_momentum", **TIGHT)
    sim.step(50)
    assert sim.joint_rate(joint)[0] > 5.0
    table = model.slot_table
    origin = np.concatenate([np.tile(body.origin, (body.slot_count, 1)) for body in model.bodies])
    x = table.reference + origin + sim.state.displacement.numpy()[0]
    p = model.masses.world_matrix(0) @ sim.state.velocity.numpy()[0]
    size = np.abs(p).sum()
    assert np.abs(p.sum(axis=0)).max() < 1e-12 * size
    assert np.abs(np.cross(x, p).sum(axis=0)).max() < 1e-11 * size


def test_a_part_from_a_file_its_outputs_and_reset(tmp_path: Any) -> None:
    """A box from an .stl file has the moments of the box; inside out it is refused by name. Its surface in .vtu and
    .usdc files moves as the part, and a world that is reset begins again, bit for bit."""
    corners, triangles = wf.Box((0, 0, 0), tuple(SIZE)).mesh()
    for name, order in (("box", [0, 1, 2]), ("inverted", [0, 2, 1])):
        rows = [f"solid {name}"]
        for triangle in triangles:
            rows += ["facet normal 0 0 0", "outer loop"]
            rows += [f"vertex {x:.17g} {y:.17g} {z:.17g}" for x, y, z in corners[triangle[order]]]
            rows += ["endloop", "endfacet"]
        (tmp_path / f"{name}.stl").write_text("\n".join([*rows, f"endsolid {name}\n"]))
    with pytest.raises(wf.ModelError, match="inside out"):
        wf.ModelBuilder().add_rigid(wf.TriMesh(tmp_path / "inverted.stl"), mass=2.0)
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    part = b.add_rigid(wf.TriMesh(tmp_path / "box.stl"), mass=2.0, name="part")
    assert part.inertia == pytest.approx(box()[1].inertia, abs=1e-8)
    b.set_initial(part, angular_velocity=(1.0, 2.0, 3.0))
    sim = wf.Simulation(b.finalize(device="cpu", worlds=2), dt=5e-3)
    sim.run(0.05, outputs=[wf.VTUWriter(tmp_path / "vtu"), wf.USDWriter(tmp_path / "part.usdc", fps=100.0)])
    places, quaternions = sim.pose(part)
    saved = wf.read_results(tmp_path / "vtu").positions("part")[-1]
    assert saved == pytest.approx(sim.positions(part), abs=1e-6)
    usd = pytest.importorskip("pxr.UsdGeom")
    from pxr import Usd

    stage = Usd.Stage.Open(str(tmp_path / "part.usdc"))
    meshes = [usd.Mesh(prim) for prim in stage.Traverse() if prim.IsA(usd.Mesh)]
    end = stage.GetEndTimeCode()
    matrix = np.array(meshes[0].ComputeLocalToWorldTransform(end))
    for point in np.array(meshes[0].GetPointsAttr().Get(end)) @ matrix[:3, :3] + matrix[3, :3]:
        assert np.linalg.norm(saved[0] - point, axis=1).min() < 1e-6
    sim.reset([True, False])
    assert sim.pose(part)[0] == pytest.approx(np.array([(0, 0, 0), places[1]]), abs=1e-12)
    sim.step(10)
    for now, then in zip(sim.pose(part), (places, quaternions)):
        np.testing.assert_array_equal(now[0], then[0])


def test_the_scene_of_a_top_turns_as_its_equation_says() -> None:
    model = find("top")().finalize(device="cpu")
    part = model.bodies[0]
    about_tip = part.inertia + part.mass * (part.com @ part.com * np.eye(3) - np.outer(part.com, part.com))
    assert np.abs(about_tip - np.diag(np.diag(about_tip))).max() < 1e-9
    tilt = 0.35
    A0 = np.array([[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]])

    def weight(A: np.ndarray) -> np.ndarray:
        return np.cross(part.com, part.mass * A.T @ (0, 0, -9.81))

    exact, _ = rigid_body_motion(np.diag(about_tip), A0, np.array([0, 0, 150.0]), weight, np.array([0.0, 0.05]))
    errors = []
    for h in (5e-4, 2.5e-4):
        sim = wf.Simulation(model, dt=h, integrator="energy_momentum", **TIGHT)
        sim.run(0.05)
        errors.append(np.abs(rotation(sim, part)[:, 2] - exact[-1][:, 2]).max())
    assert errors[1] < 1e-4
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)


def test_steps_in_flight_that_round_off_ends_say_so() -> None:
    """Of a slow spin forces are below the round-off of positions: what is left of them changes no position."""
    b, part = box()
    b.set_initial(part, velocity=(1.0, 0.0, 0.0), angular_velocity=(1e-3, 2e-3, 1e-3))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-2, integrator="bdf2")
    reports = [sim.step() for _ in range(20)]
    beyond = [r for r in reports if r.residual[0] > 1e-8]
    assert len(beyond) > 10
    floors = [r.floor[0] for r in beyond]
    assert 0.0 < min(floors) < 1e-15
    assert max(floors) < 1e-4
    assert sum(int(r.newton[0]) for r in reports) < 60


SPIN_LOSSES = {"backward_euler": 1e-2, "bdf2": 0.5e-4, "generalized_alpha": 0.3e-4}
"""Share of the rate that a step of 0.1 rad loses."""


@pytest.mark.parametrize("scheme", SPIN_LOSSES)
def test_what_a_spin_loses_is_told(scheme: str) -> None:
    """In a step of t rad t^2 of its rate, t^4 / 2 and t^4 / 3; the ledger has it as integrator."""
    b, part = box()
    b.set_initial(part, angular_velocity=(0.0, 0.0, 1.0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=0.1, integrator=scheme, **TIGHT)
    kinetic = [sim.energies()["kinetic"][0]]
    for _ in range(2):
        sim.step(6)
        kinetic.append(sim.energies()["kinetic"][0])
    assert 1.0 - (kinetic[2] / kinetic[1]) ** (0.5 / 6) == pytest.approx(SPIN_LOSSES[scheme], rel=0.25)
    assert sim.energies()["integrator"][0] == pytest.approx(kinetic[0] - kinetic[2], rel=1e-6)
