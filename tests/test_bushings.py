"""Bushings: closed forms of one turn and of small ones, energy, the largest turn, bad input."""

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq
from scipy.spatial.transform import Rotation
from spring_models import EXACT, TILTED, cube, sway

import warpfea as wf

STIFFNESS = np.array([1e4, 2e4, 3e4, 30.0, 40.0, 50.0])


def mounted(axes=None, swapped=False, **options):
    """A rigid cube of 1 kg on a bushing to the ground at its centre."""
    b = wf.ModelBuilder(gravity=options.pop("gravity", (0, 0, 0)))
    part = b.add_rigid(wf.Box((0, 0, 0), (0.1, 0.1, 0.1)), density=1000.0, name="part")
    ends = [part.at((0, 0, 0)), wf.GROUND]
    b.add_bushing(*ends[:: -1 if swapped else 1], **{"stiffness": STIFFNESS, "axes": axes, "name": "mount"} | options)
    return b, part


def turn_of(sim, part):
    return Rotation.from_quat(sim.pose(part)[1][0]).as_rotvec()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_one_turn(axis):
    """A dead force on an arm of 1 m: k t = F cos t, up to 1.25 rad, from either side."""
    lever, force = TILTED[axis - 2], 200.0 * TILTED[axis - 1]
    stiffness = np.concatenate([np.full(3, 1e7), STIFFNESS[3:]])
    found = []
    for swapped in (False, True):
        b, part = mounted(TILTED, swapped, stiffness=stiffness)
        b.add_point_load(part.at(lever), force)
        static = wf.solve_static(b.finalize(device="cpu"), load_steps=4, tol=1e-10)
        found.append(turn_of(static.simulation, part))
    exact = brentq(lambda t: STIFFNESS[3 + axis] * t - 200.0 * np.cos(t), 0.0, 1.5)
    assert np.abs(found[0] - exact * TILTED[axis]).max() < 1e-5
    assert np.abs(found[1] - found[0]).max() < 1e-10


def test_small_motion_and_frequencies():
    """Six oscillators of a cube on its axes, damped: by the tangent matrices of `wf.modes`."""
    b, part = mounted()
    modes = wf.modes(b.finalize(device="cpu"), count=6)
    inertia = np.concatenate([np.full(3, part.mass), np.diag(part.inertia)])
    assert np.ravel(modes.frequencies) == pytest.approx(np.sort(np.sqrt(STIFFNESS / inertia)) / (2 * np.pi), rel=1e-6)


def test_oscillators():
    """m x'' + c x' + k x = m 2 sin(17 t) along an axis, J y'' + d y' + w^2 J y = 0 about it, up to 0.7 rad: undamped
    and damped by values per world, of second order, 1e-4 of the amplitudes at h = 2.5e-4 s; its force."""
    J, w, t_end = 1.0 / 600.0, 40.0, 0.1
    damping = np.zeros((2, 6))
    damping[1] = 3.0, 3.0, 3.0, *3 * [0.1 * w * J]

    def rate(t, q, c, d):
        return [q[1], 2 * np.sin(17 * t) - c * q[1] - w**2 * q[0], q[3], -d / J * q[3] - w**2 * q[2]]

    exact = np.array([solve_ivp(rate, (0, t_end), [0, 1, 0, 28], args=(c[0], c[3]), rtol=1e-11, atol=1e-13).y[:, -1]
                      for c in damping])  # fmt: skip
    errors = []
    for h in (5e-4, 2.5e-4):
        b, part = mounted(gravity=sway, damping=1.0, stiffness=(w**2, w**2, w**2, *3 * [J * w**2]))
        b.set_initial(part, velocity=(1, 0, 0), angular_velocity=(28, 0, 0))
        model = b.finalize(device="cpu", worlds=2)
        model.set_parameter("mount.damping", damping)
        sim = wf.Simulation(model, dt=h, integrator="energy_momentum", solver=EXACT)
        sim.run(t_end)
        place, quaternion = sim.pose(part)
        found = np.column_stack([place[:, 0], Rotation.from_quat(quaternion).as_rotvec()[:, 0]])
        errors.append(np.abs(found - exact[:, ::2]))
    assert (errors[1] < 1e-4 * np.array([0.025, 0.7])).all(), errors
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)
    wrench = sim.spring_force("mount")  # on the ground, the second end
    assert wrench[0] == pytest.approx([w**2 * found[0, 0], 0, 0, J * w**2 * found[0, 1], 0, 0], rel=2e-2, abs=1e-9)
    assert wrench[1, 0] == pytest.approx(w**2 * exact[1, 0] + 3 * exact[1, 1], rel=2e-2)
    assert wrench[1, 3] == pytest.approx(w**2 * J * exact[1, 2] + damping[1, 3] * exact[1, 3], rel=2e-2)


def test_damped_turn():
    """theta'' + 2 z w theta' + w^2 theta = 0 about one axis, of 2.5 rad at first, of second order."""
    J, w, z = 1.0 / 600.0, 40.0, 0.05
    errors = []
    for h in (4e-3, 2e-3):
        b, part = mounted(stiffness=(1e3, 1e3, 1e3, *3 * [J * w**2]), damping=(0, 0, 0, *3 * [2 * z * w * J]))
        b.set_initial(part, angular_velocity=(0, 0, 100.0))
        sim = wf.Simulation(b.finalize(device="cpu"), dt=h, integrator="energy_momentum", solver=EXACT)
        sim.run(0.12)
        s = w * np.sqrt(1 - z**2)
        errors.append(turn_of(sim, part)[2] - 100.0 / s * np.exp(-z * w * 0.12) * np.sin(s * 0.12))
    assert abs(errors[1]) < 2e-2
    assert errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)


def test_energy_and_momentum_of_two_parts():
    """Free parts that tumble on a bushing keep all three, without loss; each world its own."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    parts = [b.add_rigid(wf.Box((0.1 * k, 0, 0), (0.1, 0.1, 0.1)), density=1000.0, name=f"p{k}") for k in range(2)]
    b.add_bushing(*(part.at((0.05, 0, 0)) for part in parts), stiffness=0.1 * STIFFNESS, axes=TILTED)
    b.set_initial(parts[0], velocity=(0.1, 0.2, 0.3), angular_velocity=(1, 5, 10))
    model = b.finalize(device="cpu", worlds=2)
    sim = wf.Simulation(model, dt=2e-3, integrator="energy_momentum", solver=EXACT, constraint_tol=1e-12)
    sim.state.velocity.assign(sim.state.velocity.numpy() * np.array([1.0, -0.5])[:, None, None])
    M, reference = model.mass_matrix(), model.slot_table.reference + np.repeat([p.origin for p in parts], 4, axis=0)

    def kept():
        """Kinetic energy, momentum, angular momentum of the worlds."""
        u, v = sim.state.displacement.numpy(), sim.state.velocity.numpy()
        p = [(M @ row.ravel()).reshape(-1, 3) for row in v]
        return [np.array(q) for q in zip(*((0.5 * np.sum(a * c), a.sum(0), np.cross(reference + x, a).sum(0))
                                           for a, c, x in zip(p, v, u)))]  # fmt: skip

    first = kept()
    sim.step(60)
    stored, last = sim.energies()["springs"], kept()
    assert (stored > 3e-3 * first[0]).all()
    assert last[0] + stored == pytest.approx(first[0], rel=1e-10)
    for before, after in zip(first[1:], last[1:]):
        assert np.linalg.norm(before, axis=1).min() > 5e-3
        assert np.abs(after - before).max() < 1e-12 * np.abs(before).max()


def test_values_of_worlds_whose_first_ones_cancel():
    """10 + 20 = 30 about the axes: one of its springs has nothing to do until a world has other values."""
    b, _ = mounted(stiffness=(1e4, 1e4, 1e4, 10, 20, 30), damping=(0, 0, 0, 1, 2, 3))
    model = b.finalize(device="cpu", worlds=2)
    model.set_parameter("mount.stiffness", [(1e4, 1e4, 1e4, 10, 20, 30), (1e4, 1e4, 1e4, 50, 50, 50)])
    model.set_parameter("mount.damping", (0, 0, 0, 1, 1, 1))
    for world, values in enumerate(((10, 20, 30), (50, 50, 50))):
        expected = np.sort([1e4, 1e4, 1e4, *(600.0 * value for value in values)])
        found = wf.modes(model, count=6, world=world)
        assert found.eigenvalues == pytest.approx(expected, rel=1e-6)
    J, w = 1.0 / 600.0, np.sqrt(3e4)  # dampers of 1 about all axes
    assert found.damping_ratios == pytest.approx([0, 0, 0, *3 * [1.0 / (2.0 * w * J)]], abs=1e-6)


def test_the_largest_turn():
    b, part = mounted(stiffness=(1e4, 1e4, 1e4, 0.01, 0.01, 0.01))
    b.set_initial(part, angular_velocity=(0, 0, 30.0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3, integrator="energy_momentum")
    with pytest.raises(wf.ConvergenceError, match=r"bushing 'mount' is turned by 1\d\d degrees.* 170 degrees"):
        sim.run(0.3)


def test_bad_input():
    b, body = cube()
    P, line = body.at((0.05, 0.05, 0.05)), wf.ModelBuilder()
    beam = line.add_beam([(0, 0, 0), (1, 0, 0)], elements=1, section=wf.Circle(0.1), normal=(0, 0, 1),
                         material=wf.SVK(E=1e9, nu=0.3))  # fmt: skip
    for make, message in (
        (lambda: b.add_bushing(P, P, stiffness=1.0), "same place"),
        (lambda: b.add_bushing(wf.GROUND, (0, 0, 0), stiffness=1.0), "neither of its ends"),
        (lambda: b.add_bushing(P, wf.GROUND, stiffness=(1, 2, 3)), "six values"),
        (lambda: b.add_bushing(P, wf.GROUND, stiffness=-1.0), "0 or more"),
        (lambda: b.add_bushing(P, wf.GROUND, stiffness=0.0), "all 0"),
        (lambda: b.add_bushing(P, wf.GROUND, stiffness=1.0, axes=2 * np.eye(3)), "orthonormal"),
    ):
        with pytest.raises(wf.ModelError, match=message):
            make()
    b.add_bushing(P, wf.GROUND, stiffness=(1, 2, 3, 4, 5, 6), name="m")
    model = b.finalize(device="cpu", worlds=2)
    for name, value, message in (
        ("stiffness", 1.0, r"shape \(\), expected \(6,\) or \(2, 6\)"),
        ("stiffness", [1, 2, 3, 4, 5, -6], "six values, 0 or more"),
        ("damping", [0, 0, 0, 1, 0, 0], "0 along and about axes that the bushing was added without"),
    ):
        with pytest.raises(wf.ModelError, match=message):
            model.set_parameter(f"m.{name}", value)
    with pytest.raises(NotImplementedError, match="weld a rigid part"):
        line.add_bushing(beam.end, wf.GROUND, stiffness=1.0)


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_both_devices_agree(dtype):
    """A cube that tumbles on a damped bushing of stiffness per world, in two worlds: its place, turn and wrench."""
    b, part = mounted(TILTED, stiffness=(400, 500, 600, 1, 2, 3), damping=(1, 1, 1, 1e-3, 1e-3, 1e-3))
    b.set_initial(part, velocity=(1, 0.5, 0), angular_velocity=(3, 5, 2))
    found = []
    for device, precision in (("cpu", "float64"), ("cuda:0", dtype)):
        model = b.finalize(device=device, dtype=precision, worlds=2)
        model.set_parameter("mount.stiffness", [(400, 500, 600, 1, 2, 3), (300, 200, 100, 3, 2, 1)])
        solver = EXACT if precision == "float64" else None
        sim = wf.Simulation(model, dt=2e-3, integrator="energy_momentum", solver=solver)
        sim.step(40)
        found.append([*sim.pose(part), sim.spring_force("mount")])
    for here, there in zip(*found):
        assert np.abs(there - here).max() < (1e-9 if dtype == "float64" else 1e-4) * np.abs(here).max()
