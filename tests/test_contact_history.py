"""State of contact beside the bodies: overlaps, colliders of a resumed state, deepest points; explicit contact."""

from __future__ import annotations

import numpy as np
import pytest

import warpfea as wf
from warpfea.simulation.checkpoint import save_checkpoint

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
DTYPES = ["float64", "float32"]
FLOOR = wf.HalfSpace((0, 0, 1), 0.0)


def resting(shape=FLOOR, *, path=None, worlds=1, dtype="float64", device="cpu", initial=None, velocity=None,
            **options):  # fmt: skip
    """A cube of 0.1 m and 1 kg on an obstacle: cube, model."""
    b = wf.ModelBuilder()
    material = wf.SVK(E=1e6, nu=0.3, density=1000)
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1))
    cube = b.add_solid(mesh, material=material, initial=initial, name="cube")
    if velocity is not None:
        b.set_initial(cube, velocity=velocity, angular_velocity=(0, 3, 5))
    floor = b.add_collider(shape, path=path, name="floor")
    b.add_contact(cube, floor, **({"mu": 0.5, "restitution": 0.5, "name": "pad"} | options))
    return cube, b.finalize(device=device, worlds=worlds, dtype=dtype)


def test_a_reset_leaves_overlaps_of_other_worlds():
    _, model = resting(wf.HalfSpace((0, 0, 1), 0.01), worlds=2, overlap="offset", overlap_time=1.0)
    sim = wf.Simulation(model, dt=1e-3)
    sim.step(3)
    before = sim.state.contact_overlap.numpy()
    sim.reset([True, False])
    np.testing.assert_array_equal(sim.state.contact_overlap.numpy(), before)
    assert sim.state.contact_overlap_time.numpy().tolist() == [0.0, 0.0]


def test_an_overlap_that_has_decayed_in_statics_stays_so():
    cube, model = resting(wf.HalfSpace((0, 0, 1), 0.001), overlap="offset", overlap_time=0.5)
    static = wf.solve_static(model, load_steps=4, stabilise=True)
    assert model.contact_force(static.state)[0].sum(axis=0)[2] == pytest.approx(9.81, rel=1e-8)
    sim = wf.Simulation(model, static.state, dt=1e-3)
    sim.step(3)
    assert sim.contact_record("pad").force[0, :, 2] == pytest.approx(9.81, rel=1e-6)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("device", DEVICES)
def test_a_control_written_before_a_checkpoint_moves_the_collider_after_it(tmp_path, device, dtype):
    model = resting(path=wf.Control("jaw", 3), device=device, dtype=dtype)[1]
    runs = [wf.Simulation(model, dt=1e-3) for _ in range(2)]
    runs[0].step(5)
    runs[0].controls["jaw"][:] = (0, 0, 1e-4)
    save_checkpoint(runs[0], tmp_path / "c.npz")
    runs[1].resume(tmp_path / "c.npz")
    for sim in runs:
        sim.step(3)
    np.testing.assert_array_equal(*(sim.state.displacement.numpy() for sim in runs))
    assert runs[0].contact_record("pad").collider_work.sum() > 0.0


def test_explicit_contact_acts_at_its_deepest_point_at_a_state():
    forces = []
    for treatment in ("explicit", "implicit"):
        options = {"model": "sphere", "radius": 0.05, "law": "paper", "mu": 0.0, "treatment": treatment}
        cube, model = resting(**options)
        state = model.state()
        u = state.displacement.numpy()
        u[0, :, 2] -= 0.005 * cube.reference[:, :2].sum(axis=1)
        state.displacement.assign(u)
        forces.append(model.contact_force(state))
    assert np.abs(forces[1]).max() > 1.0
    np.testing.assert_array_equal(*forces)


def test_nothing_passes_a_thin_plate_by_an_explicit_force():
    plate = wf.Box((0.05, 0.05, -0.06), (0.5, 0.5, 0.02))
    _, model = resting(plate, velocity=(0, 0, -100.0), law="paper", treatment="explicit")
    with pytest.raises(wf.PenetrationError):
        wf.Simulation(model, dt=1e-2).step(3)


def test_explicit_contact_is_no_statics():
    _, model = resting(law="paper", treatment="explicit")
    with pytest.raises(wf.ModelError, match="explicit"):
        wf.solve_static(model, stabilise=True)


@pytest.mark.parametrize("dtype", DTYPES)
def test_touch_within_rounding_is_no_overlap(dtype):
    """0.7 m are 1.2e-8 m less in single precision."""
    _, model = resting(wf.HalfSpace((0, 0, 1), 0.7), dtype=dtype, initial=lambda X: X + (0.0, 0.0, 0.7))
    assert wf.Simulation(model, dt=1e-3).step().converged.all()


def test_friction_on_a_ball_takes_few_iterations():
    """Its plane turns as the body moves; it is held with the cap, or else steps stall (235 iterations)."""
    ball = wf.Sphere((0.05, 0.05, -0.2), 0.199)
    sim = wf.Simulation(resting(ball, velocity=(1.0, 0.2, -0.3))[1], dt=1e-3)
    reports = [sim.step() for _ in range(30)]
    assert max(int(r.newton[0]) for r in reports) <= 12
    assert not any(r.halvings.any() for r in reports)


@pytest.mark.parametrize("E", [1e6, 1e8])
def test_a_step_that_leads_deep_into_the_floor_is_left_in_few_iterations(E):
    """A cube on its corner hits the floor: where the force grows with the square of the depth each full step halves the
    depth, and a step takes 11 or 12 iterations."""
    axes = np.array([[1, -1, 0], [1, 1, -2], [2**0.5] * 3]) / np.array([[2], [6], [6]]) ** 0.5
    b = wf.ModelBuilder()
    material = wf.NeoHookean.from_E_nu(E=E, nu=0.3, density=1000.0)
    mesh = wf.mesh.box((0.1,) * 3, cells=(2,) * 3, element="T4").transformed(transform=(axes, (0.0, 0.0, 1e-3)))
    cube = b.add_solid(mesh, material=material)
    b.set_initial(cube, velocity=(0.0, 0.0, -0.5))
    b.add_contact(cube, b.add_collider(FLOOR), mu=0.3)
    sim = wf.Simulation(b.finalize(), dt=1e-2)
    assert max(int(sim.step().newton[0]) for _ in range(40)) <= 8


def test_models_with_other_axes_of_rotation_differ():
    axes = ((0, 0, 1), (0, 1, 0))
    models = [resting(path=wf.Rotation(anchor=(0, 0, 0), axis=a, angle=1.0))[1] for a in axes]
    assert models[0].fingerprint() != models[1].fingerprint()


def test_a_control_that_is_written_nowhere_is_unchanged():
    sim = wf.Simulation(resting(path=wf.Control("jaw", 3), worlds=2)[1], dt=1e-3)
    sim.controls["jaw"][np.zeros(2, dtype=bool)] = np.nan
    assert not sim.controls["jaw"].numpy().any()


@pytest.mark.parametrize("treatment", ["implicit", "explicit"])
@pytest.mark.parametrize("tangent", [0.35, 0.6])
def test_static_friction_of_the_papers_law(treatment, tangent):
    angle = np.arctan(tangent)
    end = (9.81 * np.sin(angle), 0, -9.81 * np.cos(angle))
    start = (0.0, 0.0, end[2])
    b = wf.ModelBuilder(gravity=([0, 0.02, 0.03], [start, start, end]))
    material = wf.SVK(E=1e6, nu=0.3, density=1000)
    plate = b.add_solid(wf.mesh.box((0.2, 0.2, 0.02), cells=(1, 1, 1)), material=material, name="plate")
    b.add_contact(plate.surface("z-"), b.add_collider(FLOOR), law="paper", treatment=treatment, mu=0.25, mu_static=0.5,
                  restitution=0.1)  # fmt: skip
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-4)
    sim.step(700)
    gone = 0.5 * 9.81 * (np.sin(angle) - 0.25 * np.cos(angle)) * 0.04**2
    moved = sim.displacements(plate)[0, :, 0].mean()
    assert moved < 0.02 * gone if tangent < 0.5 else moved == pytest.approx(gone, rel=0.3)


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("device", DEVICES)
def test_jaws_closed_by_controls_in_four_worlds_equal_single_runs(device, dtype):
    h, steps = 1.0 / 1024.0, 6
    path = np.linspace(0.0, 3e-4, steps)[:, None] * np.array([1.0, 0.5, -0.5, 2.0])
    together = wf.Simulation(resting(path=wf.Control("jaw", 3), worlds=4, device=device, dtype=dtype)[1], dt=h)
    launches = together.stepper.launch.launches
    for values in path:
        together.controls["jaw"][:] = np.stack([0 * values, 0 * values, values], axis=1)
        together.step()
    assert together.stepper.launch.launches == launches
    for world in range(4):
        times, places = [0.0], [(0.0, 0.0, 0.0)]
        for k, value in enumerate(path[:, world]):
            times += [(k + 0.125) * h, (k + 1) * h]
            places += [(0.0, 0.0, value)] * 2
        alone = wf.Simulation(resting(path=(times, places), device=device, dtype=dtype)[1], dt=h)
        alone.step(steps)
        for name in ("displacement", "velocity", "ledger", "contact_spring", "contact_position"):
            a, b = getattr(alone.state, name).numpy()[0], getattr(together.state, name).numpy()[world]
            np.testing.assert_array_equal(a, b, err_msg=name)
    assert together.contact_record("pad").normal_force.max() > 1.0
