"""Narrow obstacles that move against facets which are wider than they: points of theirs see these. Edges that move."""

import numpy as np
import pytest
from contact_runs import DEVICES

import warpfea as wf
from warpfea.simulation.checkpoint import save_checkpoint

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


TIGHT = wf.NewtonPCG(tol=1e-11)
WAY = np.array([0.3, 0.1, 0.43])


def struck(shape, integrator, rides, device="cpu", dtype="float64", **options):
    """Simulation of a plate and an obstacle that meet at -WAY, m/s: the obstacle moves, or the plate."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.box((0.2, 0.2, 0.02), cells=(2, 2, 1), element="T10")
    plate = b.add_solid(mesh, material=wf.SVK(E=1e8, nu=0.3, density=1000.0), name="plate")
    obstacle = b.add_collider(shape, path=None if rides else ([0, 1], [(0, 0, 0), tuple(WAY)]))
    if rides:
        b.set_initial(plate, velocity=tuple(-WAY))
    b.add_contact(plate.surface("z-"), obstacle, mu=0.3, name="pad", **options)
    sim = wf.Simulation(b.finalize(device=device, dtype=dtype), dt=4e-3, integrator=integrator, solver=TIGHT)
    sim.step(2)  # later steps under friction have several solutions, between which the solver's round-off chooses
    return sim


def check_alike(moving, resting, rel):
    """Forces, losses and the ledger of two runs in frames that move against each other."""
    records = [sim.contact_record("pad") for sim in (moving, resting)]
    force = records[1].force[0]
    assert (np.abs(force).max(axis=0) > 0.0).all()
    assert records[0].force[0] == pytest.approx(force, abs=rel * np.abs(force).max())
    assert records[0].friction.sum() == pytest.approx(records[1].friction.sum(), rel=10 * rel)
    work, impulse = records[0].collider_work.sum(), 4e-3 * force.sum(axis=0)
    assert work == pytest.approx(impulse @ WAY, rel=10 * rel)
    assert abs(moving.energies()["ledger_residual"][0]) < 10 * rel * work


@pytest.mark.parametrize("integrator", ["backward_euler", "energy_momentum"])
def test_a_moving_rail_strikes_as_one_at_rest_is_struck(integrator):
    """The same forces in both frames, and its work is that of its force."""
    check_alike(*(struck(SHAPES["rail"], integrator, rides) for rides in (False, True)), 1e-9)


@pytest.mark.parametrize("device", DEVICES)
def test_a_moving_rail_in_single_precision(device):
    moving, exact = (struck(SHAPES["rail"], "backward_euler", False, *more) for more in ((device, "float32"), ()))
    force = exact.contact_record("pad").force[0]
    assert moving.contact_record("pad").force[0] == pytest.approx(force, abs=1e-3 * np.abs(force).max())


@pytest.mark.parametrize("device", DEVICES)
def test_edges_of_a_moving_table_strike_as_those_of_one_at_rest(device):
    """`clipping=True`: a box wider than the facets, its edge within them."""
    box = wf.Box((0.158, 0.1, -GAP - 0.1), (0.2, 0.5, 0.2))
    both = [struck(box, "backward_euler", rides, device, clipping=True) for rides in (False, True)]
    assert np.abs(both[0].contact_record("pad edges").force).max() > 0.0
    check_alike(*both, 1e-9)


def test_a_table_that_rises_with_clipping_presses_uniformly():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.box((0.2, 0.2, 0.02), cells=(2, 2, 1), element="T10")
    plate = b.add_solid(mesh, material=wf.SVK(E=1e8, nu=0.0, density=1000.0), name="plate")
    b.clamp(plate.nodes(lambda X: X[:, 2] > 0.0199))
    box = b.add_collider(
        wf.Box((0.1, 0.1, -GAP - 0.1), (1.0, 1.0, 0.2)), path=([0, 1], [(0, 0, 0), (0, 0, GAP + 1e-5)])
    )
    b.add_contact(plate.surface("z-"), box, clipping=True, mu=0.3)
    result = wf.solve_static(b.finalize(device="cpu"), load_steps=2, tol=1e-12)
    pressure = result.field("contact_pressure", plate)[0]
    pressed = pressure[np.isclose(mesh.points[:, 2], 0.0)]
    assert pressed.min() > 3e4
    assert pressed == pytest.approx(np.full(pressed.shape, pressed.mean()), rel=1e-8)


def on_supports(path, shapes, device="cpu"):
    """Simulation of a plate of wide facets under gravity on balls that move."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    mesh = wf.mesh.box((0.2, 0.2, 0.02), cells=(2, 2, 1), origin=(-0.1, -0.1, 0), element="T10")
    plate = b.add_solid(mesh, material=wf.SVK(E=1e8, nu=0.3, density=1000.0), name="plate")
    for k, shape in enumerate(shapes):
        b.add_contact(plate.surface("z-"), b.add_collider(shape, path=path, name=f"ball {k}"), mu=0.5)
    sim = wf.Simulation(b.finalize(device=device), dt=1e-2, solver=TIGHT)
    return sim, plate


@pytest.mark.parametrize("device", DEVICES)
def test_a_plate_turns_with_the_balls_that_it_lies_on(device, tmp_path):
    """Without slip, so by the angle of the path; a run goes on from a checkpoint."""
    turns = 2 * np.pi / 3 * np.arange(3)
    balls = [wf.Sphere((0.053 * np.cos(a), 0.053 * np.sin(a), -0.008), 0.008) for a in turns + 0.2]
    times = np.linspace(0.0, 0.3, 31)
    path = wf.Rotation(anchor=(0, 0, 0), axis=(0, 0, 1), angle=(times, 5.0 * np.maximum(times - 0.1, 0.0) ** 2))
    sim, plate = on_supports(path, balls, device)
    sim.step(20)
    save_checkpoint(sim, tmp_path / "half.npz")
    sim.step(10)
    X = plate.reference[plate.slot_kind == 0]
    x = X + sim.state.displacement.numpy()[0][plate.slots[plate.slot_kind == 0]]
    angle = np.angle(((x[:, :2] @ (1, 1j)) * np.conj(X[:, :2] @ (1, 1j))).sum())
    assert angle == pytest.approx(0.2, rel=1e-3)
    slips = [sim.contact_record(c.name).slip.sum() for c in sim.model.description.contacts]
    assert max(slips) < 1e-4
    energies = sim.energies()
    assert energies["collider_work"][0] > 0.0
    assert abs(energies["ledger_residual"][0]) < 1e-8 * energies["collider_work"][0]
    again, _ = on_supports(path, balls, device)
    again.resume(tmp_path / "half.npz")
    again.step(10)
    np.testing.assert_array_equal(again.state.displacement.numpy(), sim.state.displacement.numpy())


def test_a_peg_presses_a_beam_in_statics():
    """Cantilever of wide facets: 3 E I d/a^3, of which the contact yields a part."""
    E, side, a, d = 1e9, 0.02, 0.7, 5e-3
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    section = wf.Rectangle(side, side)
    material = wf.SVK(E=E, nu=0.0, density=1000.0)
    beam = b.add_beam([(0, 0, 0), (1, 0, 0)], elements=4, section=section, normal=(0, 0, 1), material=material)
    b.clamp(beam.start)
    peg = wf.Cylinder((a, -0.1, -0.5 * side - 0.005), (a, 0.1, -0.5 * side - 0.005), 0.005)
    b.add_contact(beam, b.add_collider(peg, path=([0, 1], [(0, 0, 0), (0, 0, d)])), name="peg")
    result = wf.solve_static(b.finalize(device="cpu"), load_steps=4)
    expected = 3.0 * E * side**4 / 12.0 * d / a**3
    assert result.contact_force("peg")[0, 2] == pytest.approx(expected, rel=2e-2)
