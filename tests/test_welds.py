"""Welds of beams, shells and solids."""

import numpy as np
import pytest
from constraint_models import LAW, box

import warpfea as wf


def test_beam_welded_to_a_solid_bends_as_one_beam():
    """A cantilever, half T10 solid and half 3243 beam, under a tip load: deflection of the whole as of one beam."""
    law = wf.SVK(E=1e9, nu=0.0, density=1.0)

    def tip(mixed):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        beam = b.add_beam(
            [(0.5 if mixed else 0.0, 0, 0), (1, 0, 0)], elements=4 if mixed else 8, section=wf.Rectangle(0.1, 0.1),
            normal=(0, 0, 1), material=law,
        )  # fmt: skip
        if mixed:
            solid = box(b, (0, -0.05, -0.05), (0.5, 0.05, 0.05), (8, 2, 2), law)
            b.clamp(solid.nodes("x-"))
            weld = b.weld(beam.start, solid.surface("x+"))
            assert len(weld.rows) == 9
        else:
            b.clamp(beam.start)
        b.add_point_load(beam.end, (0, 0, -10.0))
        b.add_probe("tip", beam.end)
        static = wf.solve_static(b.finalize(device="cpu"), load_steps=1)
        if mixed:
            force = static.simulation.joint_force(weld)[0]
            assert force == pytest.approx([0, 0, 10.0, 0, -5.0, 0], abs=0.02)
        return static.probe("tip").displacement[0, -1, 2]

    assert tip(True) == pytest.approx(tip(False), rel=0.01)


def test_a_weld_passes_tension_exactly():
    """Shell and beam welded to a solid of the same section under tension: uniform strain all through (nu = 0)."""
    law = wf.SVK(E=1e6, nu=0.0, density=1.0)
    for kind in ("shell", "beam"):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        solid = box(b, (0, 0, -0.05), (0.5, 0.4, 0.05), (2, 2, 1), law)
        b.clamp(solid.nodes("x-"))
        if kind == "shell":
            grid = wf.mesh.grid((0.5, 0.4), cells=(2, 2))
            other = b.add_shell(grid, thickness=0.1, material=law, transform=(np.eye(3), (0.5, 0, 0)))
            b.weld(other.edge("x-"), solid)
        else:
            other = b.add_beam(
                [(0.5, 0.2, 0), (1, 0.2, 0)], elements=2, section=wf.Rectangle(0.4, 0.1), normal=(0, 0, 1), material=law
            )
            b.weld(other.start, solid)
        end = other.surface("x+" if kind == "shell" else "end")
        b.add_traction(end, (100.0, 0, 0))
        b.add_probe("end", end)
        b.add_probe("middle", solid.surface("x+"))
        static = wf.solve_static(b.finalize(device="cpu"), load_steps=1, tol=1e-11)
        middle, far = (static.probe(name).displacement[0, -1] for name in ("middle", "end"))
        assert far == pytest.approx(2.0 * middle, abs=1e-3 * far[0])
        stretch = 1.0 + middle[0] / 0.5
        assert 0.5 * stretch * (stretch**2 - 1.0) * 1e6 == pytest.approx(100.0, rel=1e-3)


def test_a_weld_to_a_solid_is_stiff_in_turning():
    """A shell edge in a solid turns with it: the weld carries moment through its director."""
    law = wf.SVK(E=1e8, nu=0.0, density=1.0)
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    solid = box(b, (0, 0, -0.05), (0.2, 0.4, 0.05), (2, 2, 1), law)
    b.clamp(solid.nodes(lambda X: X[:, 0] > -1))
    plate = b.add_shell(
        wf.mesh.grid((0.5, 0.4), cells=(4, 2)), thickness=0.02, material=law, transform=(np.eye(3), (0.2, 0, 0))
    )
    b.weld(plate.edge("x-"), solid)
    b.add_traction(plate.surface("x+"), (0, 0, 100.0))
    b.add_probe("tip", plate.surface("x+"))
    model = b.finalize(device="cpu")
    tip = wf.solve_static(model, load_steps=1).probe("tip").displacement[0, -1, 2]
    EI = 1e8 * 0.4 * 0.02**3 / 12
    assert tip == pytest.approx(100.0 * 0.4 * 0.02 * 0.5**3 / (3 * EI), rel=0.02)


def test_welded_bodies_fall_as_one():
    b = wf.ModelBuilder(gravity=(0, 0, -10.0))
    solid = box(b, (0, -0.1, -0.1), (0.5, 0.1, 0.1))
    beam = b.add_beam(
        [(0.5, 0, 0), (1, 0, 0)], elements=2, section=wf.Rectangle(0.1, 0.1), normal=(0, 0, 1), material=LAW
    )
    b.weld(beam.start, solid)
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=0.01)
    sim.step(20)
    n = 20
    for body in (solid, beam):
        assert sim.displacements(body)[0] == pytest.approx(
            np.tile([0, 0, -10.0 * 1e-4 * n * (n + 1) / 2], (len(body.mesh.points), 1)), abs=1e-11
        )
