"""Narrow obstacles that move against facets which are wider than they: seen between the points of any rule."""

import numpy as np
import pytest

import warpfea as wf

PLACE, SPEED, GAP = (0.058, 0.044), 0.5, 2e-3
SHAPES = {
    "peg": wf.Cylinder((*PLACE, -0.2), (*PLACE, -GAP), 0.005),
    "rail": wf.Box((PLACE[0], 0.1, -GAP - 0.005), (0.01, 0.3, 0.01)),
    "tip": wf.Box((*PLACE, -GAP - 0.05), (0.01, 0.01, 0.1)),
    "ball": wf.Sphere((*PLACE, -GAP - 0.01), 0.01),
    "capsule": wf.Capsule((PLACE[0], -0.1, -GAP - 0.005), (PLACE[0], 0.3, -GAP - 0.005), 0.005),
}


@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize(
    "element", ["T10", *(pytest.param(x, marks=pytest.mark.slow) for x in ("T4", "H3843", "shell"))]
)
def test_a_narrow_obstacle_lifts_a_plate_of_wide_facets(element, shape):
    """From below at 0.5 m/s, off the middle: the plate takes up its impulse and stays above it."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=1e8, nu=0.3, density=1000.0)
    if element == "shell":
        mesh = wf.mesh.grid((0.2, 0.2), cells=(2, 2), origin=(0, 0, 0.01))
        plate = pressed = b.add_shell(mesh, thickness=0.02, material=law, name="plate")
    else:
        mesh = wf.mesh.box((0.2, 0.2, 0.02), cells=(2, 2, 1), element=element)
        plate = b.add_solid(mesh, material=law, name="plate")
        pressed = plate.surface("z-")
    path = ([0, 1], [(0, 0, 0), (0, 0, SPEED)])
    pad = b.add_contact(pressed, b.add_collider(SHAPES[shape], path=path, name=shape))
    model = b.finalize(device="cpu")
    h, steps = 4e-3, 20
    sim = wf.Simulation(model, dt=h, solver=wf.NewtonPCG(tol=1e-9))
    sim.step(steps)
    up = np.zeros((model.slots, 3))
    up[model.bodies[0].slot_kind == 0, 2] = 1.0
    weights = model.mass_matrix() @ up.ravel()
    gained = weights @ sim.state.velocity.numpy()[0].ravel()
    impulse = h * sim.contact_record(pad).force[0, :, 2].sum()
    assert impulse > 0.1 * SPEED * (weights @ up.ravel())
    assert gained == pytest.approx(impulse, rel=1e-6)
    x = sim.positions(plate)[0]
    a, *slopes = np.linalg.lstsq(np.column_stack([np.ones(len(x)), x[:, :2]]), x[:, 2], rcond=None)[0]
    assert a + slopes @ np.array(PLACE) - 0.01 > SPEED * h * steps - GAP - 2e-3
