"""Generalized-alpha: its coefficients, dissipation, orders with joints and changing steps, start, books and refusals."""

import numpy as np
import pytest
import scipy.linalg
import warp as wp

import warpfea as wf
from warpfea.simulation import integrators
from warpfea.simulation.kinks import jumps, kinks
from warpfea.simulation.opening import constraint_rates

RADII = (0.0, 0.5, 0.8, 1.0)
EXACT = wf.NewtonPCG(tol=1e-12)


def amplification(rho, omega, h):
    """(q, v, a) of an oscillator q'' = -omega^2 q one step later, from the equations of Arnold and Bruels themselves."""
    am, af = (2 * rho - 1) / (rho + 1), rho / (rho + 1)
    gamma = 0.5 - am + af
    beta = 0.25 * (gamma + 0.5) ** 2
    # unknowns q1, v1, a1 with w = -omega^2 q
    left = np.array([[1, 0, -(h**2) * beta], [0, 1, -h * gamma], [(1 - af) * omega**2, 0, 1 - am]])
    right = np.array([[1, h, h**2 * (0.5 - beta)], [0, 1, h * (1 - gamma)], [-af * omega**2, 0, -am]])
    return np.linalg.solve(left, right)


def test_theory_has_the_radius_at_infinity():
    for rho in RADII:
        radius = np.abs(np.linalg.eigvals(amplification(rho, 1.0, 1e5))).max()
        assert radius == pytest.approx(rho, abs=0.02 if rho == 0.0 else 1e-3)


# a linear mode of a bar


@pytest.fixture(scope="module")
def mode():
    """A clamped bar, the first mode of its tangent at rest, and its frequency."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    bar = b.add_solid(wf.mesh.box((1, 0.3, 0.3), cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
    b.clamp(bar.nodes("x-"))
    model = b.finalize(device="cpu")
    K, M = model.tangent_matrix(model.state()).toarray(), model.mass_matrix().toarray()
    free = model.free_slots.ravel()
    values, vectors = scipy.linalg.eigh(K[np.ix_(free, free)], M[np.ix_(free, free)])
    shape = np.zeros(len(free))
    shape[free] = vectors[:, 0]
    return model, shape.reshape(-1, 3), M, float(np.sqrt(values[0]))


def modal(sim, shape, M):
    """q, v and a along the mode."""
    arrays = (sim.state.displacement, sim.state.velocity, sim.state.algorithmic_acceleration)
    return np.array([shape.ravel() @ (M @ a.numpy()[0].ravel()) for a in arrays])


@pytest.mark.parametrize("rho", RADII)
@pytest.mark.parametrize("turn", [0.3, 1.0, 30.0])
def test_a_step_damps_a_mode_as_theory_says(mode, rho, turn):
    """The amplification matrix, measured by three steps, and its spectral radius; turn = omega h."""
    model, shape, M, omega = mode
    h, small = turn / omega, 1e-7 / np.abs(mode[1]).max()
    solver = wf.NewtonPCG(tol=1e-12, force_tol=1e-16)  # with rho 0 some columns are zero
    measured = []
    for k, size in enumerate((1.0, omega, omega**2)):  # of q, v, a
        sim = wf.Simulation(model, dt=h, integrator=wf.GeneralizedAlpha(rho_inf=rho), solver=solver)
        sim.stepper.opening.prepare(h)
        arrays = (sim.state.displacement, sim.state.velocity, sim.state.algorithmic_acceleration)
        arrays[k].assign((small * size * shape)[None])
        sim.state.acceleration.assign((-(omega**2) * small * shape)[None] if k == 0 else np.zeros((1, *shape.shape)))
        sim.step()
        assert sim.stepper.opening.count == 1
        measured.append(modal(sim, shape, M) / (small * size))
    A, scale = amplification(rho, omega, h), np.array([1.0, omega, omega**2])
    B = A * scale[None, :] / scale[:, None]
    found = (np.array(measured).T * scale[None, :]) / scale[:, None]
    assert np.abs(found - B).max() < 1e-5 * np.abs(B).max()
    lost, wanted = (1.0 - np.abs(np.linalg.eigvals(X)).max() for X in (found, B))
    assert lost == pytest.approx(wanted, rel=0.01, abs=1e-6 if rho == 1.0 else 0.0)


@pytest.mark.parametrize("rho", RADII)
def test_a_free_vibration_decays_as_theory_says(mode, rho):
    """Energy lost over many steps, by the ledger: 1 % of theory; with rho 1 none."""
    model, shape, M, omega = mode
    h, steps = 0.6 / omega, 120
    state = model.state()
    state.displacement.assign((1e-6 * shape / np.abs(shape).max())[None])
    sim = wf.Simulation(model, state, dt=h, integrator=wf.GeneralizedAlpha(rho_inf=rho), solver=EXACT)
    x = []
    for _ in range(steps):
        sim.step()
        x.append(modal(sim, shape, M))
    values, vectors = np.linalg.eig(amplification(rho, omega, h))
    main = np.argmax(np.abs(values) + 1e-9 * np.isreal(values) * -1)
    part = np.abs(np.linalg.inv(vectors)[main] @ np.array(x).T)  # of the main pair
    rate = (part[-1] / part[20]) ** (1.0 / (steps - 21))
    assert 1.0 - rate == pytest.approx(1.0 - np.abs(values[main]), rel=0.01, abs=1e-9)
    e = {name: value[0] for name, value in sim.energies().items()}
    start = 0.5 * (1e-6 / np.abs(shape).max() * omega) ** 2
    assert e["kinetic"] + e["strain"] + e["integrator"] == pytest.approx(start, rel=1e-6)
    assert e["integrator"] > -1e-6 * start
    if rho == 1.0:
        assert abs(e["integrator"]) < 2.0 * 0.6**2 * start  # it bounds the energy, which oscillates


# free fall


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("rho", RADII)
def test_free_fall_is_exact(rho, dtype):
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    bar = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(2, 1, 1)), material=wf.SVK(E=1e7, nu=0.3, density=1000.0))
    b.set_initial(bar, velocity=(1, 0, 2))
    scheme = wf.GeneralizedAlpha(rho_inf=rho)
    sim = wf.Simulation(b.finalize(device="cpu", dtype=dtype), dt=0.01, integrator=scheme)
    sim.step(50)
    t, bound = 0.5, {"float64": 1e-14, "float32": 4e-6}[dtype]
    assert np.abs(sim.displacements(bar)[0] - (t, 0, 2 * t - 0.5 * 9.81 * t**2)).max() < bound
    assert np.abs(sim.velocities(bar)[0] - (1, 0, 2 - 9.81 * t)).max() < 4 * bound


# joints


def links(count, gravity=(0, 0, -9.81), E=1e4, drive=None, damping=None):
    """Soft T10 links on hinges along y, and what makes their initial velocities those of a turn."""
    b = wf.ModelBuilder(gravity=gravity)
    law = wf.SVK(E=E, nu=0.3, density=1000.0, damping=damping)
    bodies = [
        b.add_solid(wf.mesh.box((0.2, 0.05, 0.05), cells=(2, 1, 1), origin=(0.2 * k, -0.05 * k, 0)), material=law)
        for k in range(count)
    ]
    anchor = np.array([0.025, 0, 0.025])
    hold = bodies[0].nodes(lambda X: X[:, 0] < 0.051)
    b.add_joint("revolute", parent=wf.GROUND, child=hold, anchor=anchor, axis=(0, 1, 0), drive=drive, name="pivot")
    if count > 1:
        ends = bodies[0].nodes(lambda X: X[:, 0] > 0.149), bodies[1].nodes(lambda X: X[:, 0] < 0.251)
        b.add_joint("revolute", parent=ends[0], child=ends[1], anchor=(0.2, 0, 0.025), axis=(0, 1, 0), name="elbow")
    b.add_probe("tip", bodies[-1].surface("x+"))
    return b, bodies, anchor


def turning(model, bodies, anchor, omega):
    """A state in which the bodies turn about y."""
    state = model.state()
    v = state.velocity.numpy()
    for body in bodies:
        X = body.reference + body.origin
        v[0, body.slot_offset : body.slot_offset + len(X)] = np.cross([0, omega, 0], X - anchor)
    state.velocity.assign(v)
    return state


@wp.func
def swing(t: wp.float64) -> wp.float64:
    return wp.float64(0.25) * wp.sin(wp.float64(20.0) * t) + wp.float64(20.0) * t * t + wp.float64(800.0) * t * t * t


def series(make, h, rho, end=0.016, halved=False):
    """Times, and displacement, velocity and reaction over time; `halved`: every third step is made in two halves."""
    model, state = make()
    sim = wf.Simulation(model, state, dt=h, integrator=wf.GeneralizedAlpha(rho_inf=rho), solver=EXACT)
    keep = []
    for k in range(round(end / h)):
        if halved and k % 3 == 1:
            sim.dt = h / 2
            sim.step(2)
            sim.dt = h
        else:
            sim.step()
        keep.append(len(sim.probe("tip").time) - 1)
    e = sim.energies()
    assert abs(e["ledger_residual"] - e["unbalanced"]) < 1e-12 * abs(e["strain"] + e["kinetic"])
    probe, joint = sim.probe("tip"), sim.joint_record("pivot")
    return [x[0][keep] for x in (probe.displacement, probe.velocity, joint.force)]


def orders(make, rho, halved=False, h=2e-4):
    """Observed orders of the largest errors of q, v, and the reaction after ten steps."""
    fine = series(make, h / 8, rho)
    errors = []
    for n in (1, 2):
        every = 8 // n
        found = series(make, h / n, rho, halved=halved)
        off = [np.linalg.norm(a - b[every - 1 :: every], axis=1) for a, b in zip(found, fine)]
        errors.append([off[0].max(), off[1].max(), off[2][9:].max()])
    return np.log2(np.array(errors[0]) / errors[1])


def double_pendulum():
    b, bodies, anchor = links(2)
    model = b.finalize(device="cpu")
    return model, turning(model, bodies, anchor, 5.0)


def driven_link():
    b, bodies, anchor = links(1, drive=swing)
    model = b.finalize(device="cpu")
    return model, turning(model, bodies, anchor, 5.0)


@pytest.mark.parametrize("halved", [False, True], ids=["uniform", "halved"])
@pytest.mark.parametrize("rho", [0.5, 0.8])
@pytest.mark.parametrize("make", [double_pendulum, driven_link])
def test_order_with_joints(make, rho, halved):
    assert orders(make, rho, halved)[:2] == pytest.approx([2.0, 2.0], abs=0.1)


@pytest.mark.parametrize("make", [double_pendulum, driven_link])
def test_reactions_are_of_the_second_order(make):
    assert orders(make, 0.8, h=4e-4)[2] == pytest.approx(2.0, abs=0.1)
