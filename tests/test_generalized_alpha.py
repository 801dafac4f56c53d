"""Generalized-alpha: its coefficients, dissipation, orders with joints and changing steps, start, refusals."""

import numpy as np
import pytest
import scipy.linalg
import warp as wp
from pairwise import covering

import warpfea as wf
from warpfea.simulation import integrators
from warpfea.simulation.consistent_initial_conditions import constraint_rates
from warpfea.simulation.discontinuities import jumps, kinks

RADII = (0.0, 0.5, 0.8, 1.0)
EXACT = wf.NewtonPCG(tol=1e-12)


def amplification(rho, omega, h):
    """(q, v, a) of q'' = -omega^2 q one step later, from the equations of Arnold and Bruels themselves."""
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


def small_bar():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    bar = b.add_solid(wf.mesh.box((1, 0.3, 0.3), cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
    b.clamp(bar.nodes("x-"))
    return b


@pytest.fixture(scope="module")
def mode():
    """A clamped bar, the first mode of its tangent at rest, and its frequency."""
    model = small_bar().finalize(device="cpu")
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
@pytest.mark.parametrize("turn", [0.3, 1.0, 8.0])
def test_a_step_damps_a_mode_as_theory_says(mode, rho, turn):
    """The amplification matrix, measured by three steps, and its spectral radius; turn = omega h."""
    model, shape, M, omega = mode
    h, small = turn / omega, 1e-7 / np.abs(mode[1]).max()
    solver = wf.NewtonPCG(tol=1e-12, force_tol=1e-16)  # with rho 0 some columns are zero
    measured = []
    for k, size in enumerate((1.0, omega, omega**2)):  # of q, v, a
        sim = wf.Simulation(model, dt=h, integrator=wf.GeneralizedAlpha(rho_inf=rho), solver=solver)
        sim.stepper.initial_conditions.prepare(h)
        arrays = (sim.state.displacement, sim.state.velocity, sim.state.algorithmic_acceleration)
        arrays[k].assign((small * size * shape)[None])
        sim.state.acceleration.assign((-(omega**2) * small * shape)[None] if k == 0 else np.zeros((1, *shape.shape)))
        sim.step()
        assert sim.stepper.initial_conditions.count == 1
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


# steps that change


def steps_of(kind, count, end):
    """(count,) steps, s, that change by up to 1.5 each way about their mean, up to `end`."""
    if kind == "random":
        parts = np.tile(np.exp(np.random.default_rng(1).uniform(-1.0, 1.0, 20) * np.log(1.5)), count // 20)
    else:
        parts = np.where(np.arange(count) % 2 == 0, *kind)
    return end * parts / parts.sum()


def errors_of_changing_steps(start, exact, kind, counts, end, rho):
    """Largest error at the ends of steps; `start()` gives model and state, `exact(time)` displacements (slots, 3)."""
    out = []
    for count in counts:
        model, state = start()
        steps = steps_of(kind, count, end)
        solver = wf.NewtonPCG(tol=1e-12) if model.dtype == "float64" else wf.NewtonPCG(tol=1e-6)
        scheme = wf.GeneralizedAlpha(rho_inf=rho)
        sim = wf.Simulation(model, state, dt=steps[0], integrator=scheme, solver=solver, ledger=False)
        worst = 0.0
        for h in steps:
            sim.dt = h
            sim.step()
            worst = max(worst, float(np.abs(sim.state.displacement.numpy()[0] - exact(sim.time[0])).max()))
        out.append(worst)
    return np.array(out)


CHANGES = {"0.67/1.5": (1.0 / 1.5, 1.5), "0.6/1.4": (0.6, 1.4), "0.4/1.6": (0.4, 1.6), "random": "random"}


@pytest.mark.parametrize(("rho", "change", "dtype"), covering([0.0, 0.8], CHANGES, ["float64", "float32"]))
def test_order_of_a_mode_where_steps_change(mode, rho, change, dtype):
    """A small free vibration against its cosine, and the errors of equal steps of the same number.

    Fails on 8934ce7: ratios of 2.7 (0.6/1.4) and 2.0 (0.4/1.6) at rho_inf = 0, and 3.4 at 0.8 (0.4/1.6).
    """
    model, shape, _, omega = mode
    if dtype == "float32":
        model = small_bar().finalize(device="cpu", dtype=dtype)
    u = 1e-4 * shape / np.abs(shape).max()

    def start():
        state = model.state()
        state.displacement.assign(u[None].astype(dtype))
        return model, state

    found = errors_of_changing_steps(
        start, lambda t: np.cos(omega * t) * u, CHANGES[change], (60, 120), 12.0 / omega, rho
    )
    assert found[0] / found[1] > 3.6
    equal = errors_of_changing_steps(start, lambda t: np.cos(omega * t) * u, (1.0, 1.0), (120,), 12.0 / omega, rho)
    assert found[1] < 2.2 * equal[0]


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("change", ["0.4/1.6", "random"])
def test_order_of_a_pendulum_where_steps_change(change, device):
    """A soft link that falls and turns on its hinge by 0.6 rad: its tip against the limit of equal steps.

    Fails on 8934ce7: a ratio of 2.0 with 0.4/1.6.
    """

    def tip(kind, count, dtype="float64"):
        b, bodies, anchor = links(1)
        model = b.finalize(device=device, dtype=dtype)
        steps = steps_of(kind, count, 0.12)
        tol = {"float64": 1e-10, "float32": 1e-6}[dtype]
        sim = wf.Simulation(
            model, turning(model, bodies, anchor, 5.0), dt=steps[0], integrator=wf.GeneralizedAlpha(rho_inf=0.0),
            solver=wf.NewtonPCG(tol=tol), ledger=False,
        )  # fmt: skip
        for h in steps:
            sim.dt = h
            sim.step()
        return sim.probe("tip").position[0, -1]

    fine = [tip((1.0, 1.0), n) for n in (300, 600)]
    limit = (4.0 * fine[1] - fine[0]) / 3.0
    for dtype in ("float64", "float32"):
        errors = [np.linalg.norm(tip(CHANGES[change], n, dtype) - limit) for n in (60, 120)]
        assert errors[0] / errors[1] > 3.6, (dtype, errors)


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
    """Observed orders of the largest errors of q, v, and the reaction after ten steps; of the limit of finer steps."""
    fine, finer = (series(make, h / n, rho) for n in (4, 8))
    limit = [(4.0 * b[1::2] - a) / 3.0 for a, b in zip(fine, finer)]
    errors = []
    for n in (1, 2):
        every = 4 // n
        found = series(make, h / n, rho, halved=halved)
        off = [np.linalg.norm(a - b[every - 1 :: every], axis=1) for a, b in zip(found, limit)]
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


@pytest.mark.parametrize(("make", "rho", "halved"), covering([double_pendulum, driven_link], [0.5, 0.8], [False, True]))
def test_order_with_joints(make, rho, halved):
    assert orders(make, rho, halved)[:2] == pytest.approx([2.0, 2.0], abs=0.1)


@pytest.mark.parametrize("make", [double_pendulum, driven_link])
def test_reactions_are_of_the_second_order(make):
    assert orders(make, 0.8, h=4e-4)[2] == pytest.approx(2.0, abs=0.1)


# the start


def test_rates_of_constraints_equal_differences():
    """Rates of all kinds of rows, with a law that moves, against differences of the rows' own values."""
    b, bodies, anchor = links(2, drive=swing)
    b.add_constraint("DIST", points=(bodies[0].at((0.1, 0, 0.01)), bodies[1].at((0.3, -0.02, 0.03))), value=0.2)
    model = b.finalize(device="cpu")
    tables, random = model.constraints, np.random.default_rng(1)
    u, v = 1e-2 * random.standard_normal((2, model.slots, 3))
    state, t, s = model.state(), 0.013, 1e-4

    def value(when):
        state.displacement.assign((u + (when - t) * v)[None])
        state.time.fill_(when)
        return model.constraint_values(state)[0]

    def law(when):
        return np.array([0.25 * np.sin(20 * when) + 20 * when**2 + 800 * when**3, 0, 0])[None]

    laws = [law(t), (law(t + s) - law(t - s)) / (2 * s), (law(t + s) - 2 * law(t) + law(t - s)) / s**2]
    gradients, first, second = constraint_rates(tables, u, v, np.array(laws))
    c = [value(t + k * s) for k in (-1, 0, 1)]
    assert np.abs(first - (c[2] - c[0]) / (2 * s)).max() < 1e-6 * np.abs(first).max()
    assert np.abs(second - (c[2] - 2 * c[1] + c[0]) / s**2).max() < 1e-5 * np.abs(second).max()
    value(t)
    assert np.abs(tables.expand(gradients) - model.terms.constraints.jacobian(state, 0)).max() < 1e-12


def test_the_start_is_in_equilibrium_and_obeys_the_joints():
    """w_0 by the matrices of the model alone: M w + J^T m = f - f_int, J w = -c''."""
    model, state = double_pendulum()
    before = state.velocity.numpy().copy()
    sim = wf.Simulation(model, state, dt=1e-4, integrator="generalized_alpha")
    sim.stepper.initial_conditions.prepare(sim.dt)
    assert np.abs(state.velocity.numpy() - before).max() < 1e-5  # of h^2 w', and the velocities were consistent
    w = state.acceleration.numpy()[0].ravel()
    J = model.terms.constraints.jacobian(model.state(), 0).toarray()
    gravity = np.tile([0, 0, -9.81], model.slots)
    force = model.mass_matrix() @ (gravity - w)  # that the constraints must carry
    carried = np.linalg.lstsq(J.T, force, rcond=1e-11)[0]
    assert np.abs(J.T @ carried - force).max() < 1e-12 * np.abs(force).max()
    _, _, second = constraint_rates(model.constraints, np.zeros((model.slots, 3)), before[0], np.zeros((3, 1, 3)))
    assert np.abs(J @ w + second).max() < 1e-12 * np.abs(w).max()


def test_an_equilibrium_stays():
    """From statics nothing accelerates, also where contact carries the body."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    cube = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
    b.add_contact(cube, b.add_collider(wf.HalfSpace((0, 0, 1), 0.0)), mu=0.5)
    model = b.finalize(device="cpu")
    start = wf.solve_static(model, stabilise=True, tol=1e-12)
    rest = start.displacements(cube)[0]
    sim = wf.Simulation(model, start.state, dt=1e-3, integrator="generalized_alpha", solver=EXACT)
    sim.step(20)
    assert np.abs(sim.state.acceleration.numpy()).max() < 1e-4
    assert np.abs(sim.displacements(cube)[0] - rest).max() < 1e-9


def test_velocities_that_joints_forbid_are_taken_in_the_first_step():
    """A link at rest whose hinge begins to turn: an impulse, which the ledger books."""
    b, bodies, _ = links(1, gravity=(0, 0, 0), drive=([0.0, 1.0], [0.0, 3.0]))
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=1e-4, integrator="generalized_alpha", solver=EXACT)
    sim.stepper.initial_conditions.prepare(sim.dt)
    still, laws = np.zeros((model.slots, 3)), np.zeros((3, 1, 3))
    laws[1, 0, 0] = 3.0
    rates = constraint_rates(model.constraints, still, sim.state.velocity.numpy()[0], laws)[1]
    assert np.abs(rates).max() < 1e-7  # of h^2 w'; the hinge turns at 3 rad/s
    e = {name: value[0] for name, value in sim.energies().items()}
    assert e["kinetic"] > 0.0
    assert e["integrator"] == pytest.approx(-e["kinetic"], rel=1e-12)
    sim.step(3)
    e = {name: value[0] for name, value in sim.energies().items()}
    assert abs(e["ledger_residual"]) < 1e-9 * e["kinetic"]


def test_a_state_that_another_scheme_advanced_begins_anew():
    """Accelerations belong to the state that they were made with, whatever other schemes keep in it."""
    model, state = double_pendulum()
    for scheme, steps in (("generalized_alpha", 3), ("bdf2", 2)):
        wf.Simulation(model, state, dt=1e-3, integrator=scheme).step(steps)
    fresh = model.state()
    for name in ("displacement", "velocity", "time"):
        getattr(fresh, name).assign(getattr(state, name))
    found = []
    for start in (state, fresh):
        sim = wf.Simulation(model, start, dt=1e-3, integrator="generalized_alpha", solver=EXACT)
        sim.step(2)
        assert sim.stepper.initial_conditions.count == 1
        found.append(sim.state.displacement.numpy())
    assert np.abs(found[0] - found[1]).max() < 1e-12 * np.abs(found[0]).max()


# kinks


def test_kinks_of_a_law():
    smooth = np.linspace(0, 1, 60)
    laws = {
        "ramp": wf.laws.time_law(([0.0, 0.5, 1.0], [0.0, 1.0, 1.0]), "x", scalar=True),
        "jump": wf.laws.time_law(([0.0, 0.5, 0.5 + 1e-9, 1.0], [0.0, 0.0, 1.0, 1.0]), "x", scalar=True),
        "sine": wf.laws.time_law((smooth, np.sin(6 * smooth)), "x", scalar=True),
        "constant": wf.laws.time_law(2.0, "x", scalar=True),
    }
    assert kinks(laws["ramp"], 1e-3).tolist() == [0.0, 0.5]
    assert jumps(laws["ramp"], 1e-3).size == 0
    assert jumps(laws["jump"], 1e-3).tolist() == [[0.5, 0.5 + 1e-9]]
    assert kinks(laws["jump"], 1e-3).size == 0
    assert set(kinks(laws["sine"], 1e-3)) <= {0.0, 1.0}
    assert kinks(laws["constant"], 1e-3).size == jumps(laws["constant"], 1e-3).size == 0


JUMP = 0.004


def pulled(load):
    """A clamped bar whose end is pulled by a load that jumps, or whose root is driven with a speed that jumps."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    bar = b.add_solid(wf.mesh.box((0.2, 0.05, 0.05), cells=(2, 1, 1)), material=wf.SVK(E=1e4, nu=0.3, density=1000.0))
    if load:
        b.clamp(bar.nodes("x-"))
        law = ([0, JUMP, JUMP + 1e-9, 1], [(0, 0, 0), (0, 0, 0), (200, 0, 50), (200, 0, 50)])
        b.add_traction(bar.surface("x+"), law)
    else:
        b.drive(bar.nodes("x-"), displacement=([0, JUMP, 1], [(0, 0, 0), (1e-3, 0, 0), (1e-3, 0, 0)]))
    b.add_probe("tip", bar.surface("x+"))
    b.add_probe("root", bar.surface("x-"))
    return b.finalize(device="cpu")


@pytest.mark.parametrize("load", [True, False], ids=["load", "drive"])
def test_order_across_a_kink(load):
    model, ends = pulled(load), []
    for h in (2e-4, 1e-4, 1.25e-5):
        sim = wf.Simulation(model, dt=h, integrator="generalized_alpha", solver=EXACT)
        sim.step(round(3 * JUMP / h))
        assert sim.stepper.initial_conditions.count == 2
        ends.append(np.concatenate([sim.probe("tip").displacement[0, -1], 1e-2 * sim.probe("tip").velocity[0, -1]]))
        if not load:  # exactly as driven, without an oscillation
            k = round(JUMP / h)
            speed = sim.probe("root").velocity[0, :, 0]
            assert np.abs(speed[:k] - 0.25).max() < 1e-9
            assert np.abs(speed[k:]).max() < 1e-9
        e = {name: value[0] for name, value in sim.energies().items()}
        assert abs(e["ledger_residual"] - e["unbalanced"]) < 1e-12 * (e["kinetic"] + e["strain"])
    errors = [np.linalg.norm(end - ends[2]) for end in ends[:2]]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2.0, abs=0.1)


# damping


@pytest.mark.parametrize("form", ["incremental", "rate"])
def test_order_with_damping(form):
    def make():
        b, bodies, anchor = links(1, damping=wf.KelvinVoigt(20.0, 30.0, form=form))
        model = b.finalize(device="cpu")
        return model, turning(model, bodies, anchor, 5.0)

    assert orders(make, 0.8, halved=True)[:2] == pytest.approx([2.0, 2.0], abs=0.1)


# worlds, checkpoints, precision, solvers


def mechanism(worlds=1, dtype="float64", E=1e4):
    b, _, _ = links(2, E=E, drive=([0.0, 0.01, 0.05], [0.0, 0.05, 0.05]))
    return b.finalize(device="cpu", worlds=worlds, dtype=dtype)


def bits(sim, world=0):
    return {name: values[world].tobytes() for name, values in sim.state.numpy().items() if name != "status"}


def test_worlds_resume_and_reset_to_the_bit(tmp_path):
    """Across a kink of the drive, with a world that begins anew in between."""
    model = mechanism(worlds=2)
    model.set_gravity([(0, 0, -9.81), (3.0, 0, 0)])
    sim = wf.Simulation(model, dt=1e-3, integrator="generalized_alpha")
    sim.step(5)
    sim.reset([False, True])
    sim.step(3)
    sim.run(sim.time.min() + 1e-3, outputs=[wf.Checkpoint(tmp_path / "c.npz")])
    again = wf.Simulation(model, dt=1e-3, integrator="generalized_alpha")
    again.resume(tmp_path / "c.npz")
    for s in (sim, again):
        s.step(4)
    for world, steps in ((0, 12), (1, 8)):  # world 0 is past the end of the run, and waits
        assert bits(sim, world) == bits(again, world)
        single = mechanism()
        single.set_gravity([(0, 0, -9.81), (3.0, 0, 0)][world])
        alone = wf.Simulation(single, dt=1e-3, integrator="generalized_alpha")
        alone.step(steps)
        assert bits(sim, world) == bits(alone), world


def test_a_checkpoint_of_another_radius_is_refused(tmp_path):
    sim = wf.Simulation(mechanism(), dt=1e-3, integrator="generalized_alpha")
    sim.run(1e-3, outputs=[wf.Checkpoint(tmp_path / "c.npz")])
    other = wf.Simulation(mechanism(), dt=1e-3, integrator=wf.GeneralizedAlpha(rho_inf=0.5))
    with pytest.raises(wf.CheckpointError, match=r"rho_inf=0.2.*rho_inf=0.5"):
        other.resume(tmp_path / "c.npz")


@pytest.mark.parametrize(
    "options", [{"dtype": "float32"}, {"solver": "outer"}, {"solver": "jacobi"}, {"solver": "direct"}]
)
def test_other_solvers_and_precisions_agree(options):
    found = []
    solvers = {
        "outer": wf.NewtonPCG(multipliers="outer"),
        "jacobi": wf.Jacobi(iterations=60, tol=1e-8),
        "direct": wf.NewtonPCG(linear="direct"),
    }
    for given in ({}, options):
        model = mechanism(dtype=given.get("dtype", "float64"))
        sim = wf.Simulation(model, dt=1e-3, integrator="generalized_alpha", solver=solvers.get(given.get("solver")))
        sim.step(20)
        found.append(sim.probe("tip").displacement[0])
    assert np.abs(found[1] - found[0]).max() < 2e-3 * np.abs(found[0]).max()


# words


@pytest.mark.parametrize("rho", [-0.1, 1.1, float("nan"), float("inf"), "0.8", True, None])
def test_a_bad_radius_is_refused(rho):
    with pytest.raises(wf.ModelError, match=r"rho_inf.*between 0 and 1"):
        wf.GeneralizedAlpha(rho_inf=rho)


def test_the_undamped_scheme_is_refused_with_joints_and_drives():
    b, _, _ = links(1)
    with pytest.raises(wf.ModelError, match=r"rho_inf = 1.*joint 'pivot'.*rho_inf < 1"):
        wf.Simulation(b.finalize(device="cpu"), dt=1e-3, integrator=wf.GeneralizedAlpha(rho_inf=1.0))
    with pytest.raises(wf.ModelError, match=r"rho_inf = 1.*a drive"):
        wf.Simulation(pulled(False), dt=1e-3, integrator="generalized_alpha(rho_inf=1)")
    wf.Simulation(pulled(True), dt=1e-3, integrator="generalized_alpha(rho_inf=1)").step()


def test_integrators_by_their_words():
    assert integrators.get("generalized_alpha").rho_inf == 0.2
    assert integrators.get(" generalized_alpha ( rho_inf = 0.25 )").label == "generalized_alpha(rho_inf=0.25)"
    assert integrators.get("bdf2()") is integrators.get("bdf2")
    scheme = wf.GeneralizedAlpha(rho_inf=0.3)
    assert integrators.get(scheme) is scheme
    for rho in (0.3, 1.0 / 3.0, 0.0):
        assert integrators.get(wf.GeneralizedAlpha(rho_inf=rho).label).rho_inf == rho  # to the last digit
    for text, words in (
        ("generalised_alpha", "did you mean 'generalized_alpha'"),
        ("generalized_alpha(rho_in=0.5)", "did you mean 'rho_inf'"),
        ("generalized_alpha(0.5)", "no option '0.5'"),
        ("generalized_alpha(rho_inf=half)", "rho_inf=half is not a number"),
        ("generalized_alpha(rho_inf=2)", "between 0 and 1"),
        ("bdf2(rho_inf=0.5)", "it has none"),
        ("static", "unknown"),
    ):
        with pytest.raises(wf.ModelError) as found:
            integrators.get(text)
        assert words in str(found.value)
