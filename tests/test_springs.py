"""Springs between points, about joints and under surfaces: closed forms, equations of motion, derivatives, energy,
momentum."""

import functools

import numpy as np
import pytest
import warp as wp
from scipy.integrate import solve_ivp
from spring_models import CENTRE, EXACT, HARD, SCHEMES, cube, hardening, linked, oscillator, polar_inertia

import warpfea as wf
from warpfea.model.springs import SampledForce
from warpfea.terms.springs import Springs

OMEGA = 17.0


def measured(b, hinge, dt, t_end, **options):
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, dt=dt, solver=EXACT, constraint_tol=1e-12, **options)
    sim.run(t_end)
    return (sim.joint_value(hinge)[0] if hinge else sim.probe("p").displacement[0, -1, 0]), sim


def linear_motion(w2, damping, load, t_end):
    """y of y'' + c y' + w2 y = load sin(OMEGA t), y(0) = 0, y'(0) = 1."""

    def rate(t, y):
        return [y[1], load * np.sin(OMEGA * t) - damping * y[1] - w2 * y[0]]

    return solve_ivp(rate, (0, t_end), [0.0, 1.0], rtol=1e-12, atol=1e-14).y[0, -1]


@pytest.mark.parametrize("forced", [False, True], ids=["free", "forced"])
@pytest.mark.parametrize("kind", ["length", "torsion", "foundation"])
def test_oscillators(kind, forced):
    """m y'' + c y' + k y = F sin(17 t), y'(0) = 1, by an integrator of ordinary differential equations; undamped free
    vibration has sin(w t)/w. Of second order, 1e-4 of the amplitude at h = 1e-3 s."""
    for damping in (0.0, 2.0):
        b, mass, k, load, hinge = oscillator(kind, damping, forced)
        t_end = 0.4
        exact = linear_motion(k / mass, damping, load / mass, t_end)
        if not damping and not forced:
            assert exact == pytest.approx(np.sin(np.sqrt(k / mass) * t_end) / np.sqrt(k / mass), abs=1e-10)
        runs = [measured(b, hinge, h, t_end, integrator="energy_momentum") for h in (2e-3, 1e-3)]
        errors = [abs(found - exact) for found, _ in runs]
        if kind == "foundation" and not damping:
            assert runs[1][1].spring_force("s")[0] == pytest.approx([-k * exact, 0, 0], rel=5e-2, abs=1e-6)
        assert errors[1] < 1e-4 * 0.1, errors
        assert errors[0] > 3.5 * errors[1], errors


def turning(scheme, dt, t_end, damping=0.0, **options):
    """A cube that circles a point of the ground on a spring, without torque on itself, and its spring's extension."""
    b, body = cube()
    b.add_spring((0.0, 0.05, 0.05), body.at(CENTRE + (0.0, 0.0, 0.0)), rest=0.03, stiffness=100.0, damping=damping)
    b.set_initial(body, velocity=(0.1, 1.0, 0.2))
    b.add_probe("p", body.at(CENTRE))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=dt, integrator=scheme, solver=EXACT, **options)
    sim.run(t_end)
    return sim


@functools.cache
def orbit(damping, t_end):
    """Position of the centre by Newton's second law of a point."""

    def rate(t, y):
        r, v = y[:3] - (0.0, 0.05, 0.05), y[3:]
        n = r / np.linalg.norm(r)
        return np.concatenate([v, -(100.0 * (np.linalg.norm(r) - 0.03) + damping * (v @ n)) * n])

    out = solve_ivp(rate, (0, t_end), [*CENTRE, 0.1, 1.0, 0.2], rtol=1e-12, atol=1e-14)
    return out.y[:3, -1]


@pytest.mark.parametrize("damping", [0.0, 5.0])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_turning_oscillators(scheme, damping):
    """The spring's length and its direction change; the order is that of the scheme, also of the damping."""
    errors = []
    for h in (2e-3, 1e-3):
        sim = turning(scheme, h, 0.4, damping)
        errors.append(np.linalg.norm(sim.probe("p").position[0, -1] - orbit(damping, 0.4)))
    order = 1 if scheme == "backward_euler" else 2
    assert errors[0] / errors[1] > 0.8 * 2**order, errors
    assert errors[1] < (1e-4 if order == 2 else 0.01), errors
    e = sim.energies()
    assert abs(e["ledger_residual"][0]) < 1e-9
    assert (e["spring_loss"][0] > 0.05) == (damping > 0)
    if scheme == "bdf2" and not damping:
        length = np.linalg.norm(sim.probe("p").position[0, -1] - (0.0, 0.05, 0.05))
        assert sim.spring_force("spring")[0] == pytest.approx(100.0 * (length - 0.03), rel=1e-9)
    if scheme == "energy_momentum":
        assert abs(e["integrator"][0]) < 1e-9
        (bars,) = [axis for axis in sim.plot().axes if axis.get_title() == "energies now"]
        shown = dict(
            zip([label.get_text() for label in bars.get_yticklabels()], [bar.get_width() for bar in bars.patches])
        )
        assert shown["springs"] == e["springs"][0]
        assert shown.get("spring loss", 0.0) == e["spring_loss"][0]


def test_a_torsion_spring_counts_turns():
    """Wound up by 3.2 turns and back: sin(w t)/w, with the angle far beyond a half turn."""
    b, body = cube()
    hinge = b.add_joint("revolute", parent=wf.GROUND, child=body.surface("z-"), anchor=CENTRE, axis=(0, 0, 1))
    inertia = polar_inertia(body, CENTRE)
    b.add_torsion_spring(hinge, stiffness=inertia, name="s")
    b.set_initial(body, angular_velocity=(0, 0, 20.0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=5e-3, integrator="energy_momentum", solver=EXACT)
    sim.step(314)  # the largest angle is 20 rad
    stored = 0.5 * inertia * 20.0**2
    assert sim.state.spring_angle.numpy()[0, 0] == pytest.approx(20.0 * np.sin(1.57), rel=1e-4)
    assert sim.energies()["springs"][0] == pytest.approx(stored, rel=1e-4)
    sim.step(314)
    assert abs(sim.state.spring_angle.numpy()[0, 0] - 20.0 * np.sin(3.14)) < 2e-3 * 20.0
    assert abs(sim.energies()["integrator"][0]) < 1e-9 * stored


def poised(scheme="backward_euler", seed=1, **options):
    """A simulation at a random iterate of a step from a random state; its term and flags."""
    model, _ = linked()
    sim = wf.Simulation(model, dt=1e-2, integrator=scheme, **options)
    rng = np.random.default_rng(seed)
    ctx, term = sim.stepper.ctx, model.terms.find(Springs)
    w, shape = sim.stepper.work, (1, model.slots, 3)
    ctx.state.displacement.assign(rng.normal(scale=2e-2, size=shape))
    ctx.state.velocity.assign(rng.normal(scale=1.0, size=shape))
    w.u.assign(ctx.state.displacement.numpy() + rng.normal(scale=1e-2, size=shape))
    w.q_tilde.assign(rng.normal(scale=2e-2, size=shape))
    w.step.dq_dv.fill_(5e-3 if scheme == "energy_momentum" else 1e-2)
    w.step.h.fill_(1e-2)
    w.step.a0.fill_(4.0 / 3.0)
    w.step.a1.fill_(1.0 / 3.0)
    active = wp.ones(1, dtype=wp.int32, device="cpu")
    term.begin(ctx, active)
    return sim, term, active


def forces(sim, term, active, u):
    """Nodal forces (slots, 3) and the sum of the potential's rows at u."""
    ctx = sim.stepper.ctx
    ctx.work.u.assign(u[None])
    term.force(ctx, active)
    out = np.zeros((sim.model.slots, 3))
    np.add.at(out, term.entry_slot, ctx.work.pool_force.numpy()[0, term.offset :][: len(term.entry_slot)])
    return out, ctx.work.rows_of(term).numpy()[0].sum()


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_forces_are_derivatives_of_the_potential(seed):
    sim, term, active = poised(seed=seed)
    u = sim.stepper.work.u.numpy()[0].copy()
    d = np.random.default_rng(seed + 10).normal(size=u.shape)
    f, _ = forces(sim, term, active, u)
    values = [forces(sim, term, active, u + s * 1e-4 * d)[1] for s in (-2, -1, 1, 2)]
    slope = (values[0] - 8.0 * values[1] + 8.0 * values[2] - values[3]) / 12e-4
    assert (f * d).sum() == pytest.approx(slope, abs=1e-8 * np.abs(f * d).sum())


@pytest.mark.parametrize("scheme", ["backward_euler", "energy_momentum"])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_products_are_derivatives_of_the_forces(scheme, seed):
    """Exact tangents, of the discrete gradients, too; symmetric where there is a potential."""
    sim, term, active = poised(scheme, seed)
    w, ctx = sim.stepper.work, sim.stepper.ctx
    u = w.u.numpy()[0].copy()
    rng = np.random.default_rng(seed + 10)
    d, other = rng.normal(size=(2, *u.shape))
    near = [forces(sim, term, active, u + s * 1e-4 * d)[0] for s in (-2, -1, 1, 2)]
    expected = (near[0] - 8.0 * near[1] + 8.0 * near[2] - near[3]) / 12e-4
    forces(sim, term, active, u)
    products = []
    for direction in (d, other):
        w.p.assign(direction[None])
        term.product(ctx, w.p, active)
        product = np.zeros_like(u)
        np.add.at(product, term.entry_slot, w.pool_product.numpy()[0, term.offset :][: len(term.entry_slot)])
        products.append(product)
    assert np.abs(products[0] - expected).max() < 1e-8 * np.abs(expected).max()
    if scheme == "backward_euler":
        assert (products[0] * other).sum() == pytest.approx((products[1] * d).sum(), rel=1e-12)


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_the_discrete_gradient_does_the_work_of_the_energies(seed):
    """Also over a turn, without moment: f.(u - u_n) = W(u) - W(u_n) + loss."""
    sim, term, active = poised("energy_momentum", seed)
    ctx, w = sim.stepper.ctx, sim.stepper.work
    u, start = w.u.numpy()[0].copy(), ctx.state.displacement.numpy()[0]
    before = term.stored_energy(ctx)["springs"][0]
    f, _ = forces(sim, term, active, u)
    rows = term.energy_increments(ctx, active).numpy().sum(axis=(1, 2))
    work = (f * (u - start)).sum()
    assert work == pytest.approx(rows[0] - before + rows[1], rel=1e-9)  # up to the quadrature of `hardening`


@pytest.mark.parametrize("scheme", ["backward_euler", "energy_momentum"])
def test_nothing_changes_when_both_ends_turn(scheme):
    """Forces between bodies turn with them, the foundation apart, and have neither resultant nor moment."""
    from scipy.spatial.transform import Rotation

    model, _ = linked(law="no foundation")
    sim = wf.Simulation(model, dt=1e-2, integrator=scheme)
    term, ctx, w = model.terms.find(Springs), sim.stepper.ctx, sim.stepper.work
    active = wp.ones(1, dtype=wp.int32, device="cpu")
    rng = np.random.default_rng(4)
    origin = np.concatenate([np.tile(body.origin, (body.slot_count, 1)) for body in model.bodies])
    E = model.slot_table.reference + origin * model.slot_table.is_position[:, None]
    u0, u1 = rng.normal(scale=2e-2, size=(2, *E.shape))
    own = [k for k, spring in enumerate(term.springs) if spring.name != "own"]  # that to the ground
    chosen = np.isin(term.entry_item, own)
    Q = Rotation.from_rotvec([0.5, -1.1, 2.0]).as_matrix()
    found = []
    for turn in (np.eye(3), Q):
        a, b = ((E + u) @ turn.T - E for u in (u0, u1))
        ctx.state.displacement.assign(a[None])
        w.q_tilde.assign(a[None])
        w.step.dq_dv.fill_(5e-3)
        w.step.h.fill_(1e-2)
        w.step.a0.fill_(1.0)
        w.step.a1.fill_(0.0)
        term.begin(ctx, active)
        w.u.assign(b[None])
        term.force(ctx, active)
        f = np.zeros_like(E)
        np.add.at(f, term.entry_slot[chosen], w.pool_force.numpy()[0, term.offset :][: len(chosen)][chosen])
        found.append(f)
        x = E + (0.5 * (a + b) if scheme == "energy_momentum" else b)
        size = np.abs(f).max()
        assert np.abs(f[model.slot_table.kind == 0].sum(axis=0)).max() < 1e-12 * size
        assert np.abs(np.cross(x, f).sum(axis=0)).max() < 1e-12 * size
    assert np.abs(found[1] - found[0] @ Q.T).max() < 1e-12 * np.abs(found[0]).max()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_two_bodies_keep_their_momentum(scheme):
    """At the default tolerance: solves are corrected along the translation of both."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    bodies = [
        b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), origin=(0.3 * k, 0, 0)), material=HARD, name=f"c{k}")
        for k in range(2)
    ]
    b.add_spring(bodies[0].at((0.1, 0.02, 0.05)), bodies[1].at((0.3, 0.1, 0.1)), stiffness=300.0, damping=1.0, rest=0.1)
    b.set_initial(bodies[0], velocity=(1.0, 2.0, 0.5))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, integrator=scheme)
    mass = sim.model.masses.lumped[0]
    before = mass @ sim.state.velocity.numpy()[0]
    for _ in range(40):
        sim.step()
        assert np.abs(mass @ sim.state.velocity.numpy()[0] - before).max() < 1e-12 * np.abs(before).max()
    assert np.abs(sim.velocities(bodies[1])).max() > 0.1


def test_preload_and_statics():
    """A weight between two preloaded springs: (k1 + k2) u = k1 r1 - k2 r2 - m g; the force of samples and of a
    function at rest; springs alone hold the cube."""
    b, body = cube(gravity=(0, 0, -9.81))
    corners = [(x, y) for x in (0.0, 0.1) for y in (0.0, 0.1)]
    for x, y in corners:
        b.add_spring(body.at((x, y, 0.1)), (x, y, 1.1), stiffness=250.0, rest=0.9)
        b.add_spring(body.at((x, y, 0.0)), (x, y, -1.0), stiffness=100.0, rest=0.95)
    for x, y, dx, dy in ((0, 0, -1, 0), (0.1, 0, 0, -1), (0.1, 0.1, 1, 0)):
        b.add_spring(body.at((x, y, 0.05)), (x + dx, y + dy, 0.05), stiffness=1e-3)
    b.add_probe("p", body.at(CENTRE))
    static = wf.solve_static(b.finalize(device="cpu"), load_steps=1, tol=1e-12, unstable="ignore")
    mass, up, down = 1.0, 4 * 250.0, 4 * 100.0
    expected = (up * 0.1 - down * 0.05 - mass * 9.81) / (up + down)
    assert static.probe("p").displacement[0, -1, 2] == pytest.approx(expected, rel=1e-5)


def test_the_static_check_sees_springs():
    b, body = cube()
    b.add_spring((-1, 0.05, 0.05), body.at(CENTRE), stiffness=1.0)
    with pytest.raises(wf.ModelError, match="5 unconstrained"):
        wf.solve_static(b.finalize(device="cpu"))


def test_negative_energy_of_a_function_is_no_growth():
    """A preloaded function's energy is 0 in the reference and falls from there: what the monitor compares the errors of
    the integrator with is as large as for the spring of the same force."""

    @wp.func
    def tension(y: wp.float64, rate: wp.float64) -> wp.float64:
        return wp.float64(100.0) * (y - wp.float64(0.6))

    shares = []
    for options in ({"law": tension}, {"stiffness": 100.0, "rest": 0.6}):
        b, body = cube()
        b.add_spring((1.0, 0.05, 0.05), body.at(CENTRE), **options)
        sim = wf.Simulation(b.finalize(device="cpu"), dt=5e-3, integrator="bdf2")
        sim.step(100)
        shares.append(sim.state.energy_growth.numpy()[0, 0])
    assert abs(shares[1]) > 1e-9
    assert abs(shares[0]) < 3.0 * abs(shares[1]), shares


def test_sampled_forces():
    """Through all samples, monotone between, with the slope's integral as energy, linear beyond."""
    y, f = [0.0, 1.0, 1.5, 4.0], [-1.0, 0.0, 5.0, 5.0]
    law = SampledForce.from_samples(y, f, "s")

    def value(at, terms):
        k = max(0, np.searchsorted(law.knots, at, side="right") - 1) if at >= 0 else 0
        return sum(c * (at - law.knots[k]) ** j for j, c in enumerate(terms(k)))

    def force(at):
        return value(at, lambda k: law.coefficients[k])

    def energy(at):
        return value(at, lambda k: [law.energy[k], *(law.coefficients[k] / np.arange(1, 5))])

    np.testing.assert_allclose([force(x) for x in y], f, atol=1e-14)
    grid = np.linspace(-1.0, 5.0, 601)
    assert np.diff([force(x) for x in grid]).min() > -1e-13
    slopes = [(energy(x + 1e-6) - energy(x - 1e-6)) / 2e-6 for x in grid]
    np.testing.assert_allclose(slopes, [force(x) for x in grid], atol=1e-8)
    within = [energy(x) for x in grid if 0.0 <= x <= 4.0]
    assert min(within) == pytest.approx(0.0, abs=1e-12)
    assert force(-2.0) == pytest.approx(-3.0)
    assert force(9.0) == pytest.approx(5.0)


def test_laws_agree_with_the_linear_one():
    """Samples of a straight line are the spring of that stiffness; so is a function."""

    @wp.func
    def line(y: wp.float64, rate: wp.float64) -> wp.float64:
        return wp.float64(100.0) * (y - wp.float64(0.03)) + wp.float64(5.0) * rate

    found = []
    for law in (None, ([0.01, 0.03, 0.2], [-2.0, 0.0, 17.0]), line):
        b, body = cube()
        options = {"stiffness": 100.0, "rest": 0.03} if law is None else {"law": law}
        damping = 0.0 if law is line else 5.0
        b.add_spring((0.0, 0.05, 0.05), body.at(CENTRE), damping=damping, **options)
        b.set_initial(body, velocity=(0.1, 1.0, 0.2))
        for scheme in ("bdf2", "energy_momentum"):
            sim = wf.Simulation(b.finalize(device="cpu"), dt=5e-3, integrator=scheme, solver=EXACT)
            sim.step(40)
            assert abs(sim.energies()["ledger_residual"][0]) < 1e-9
            found.append(sim.state.displacement.numpy())
    for k in range(2):
        for other in found[2 + k :: 2]:
            assert np.abs(other - found[k]).max() < 1e-9 * np.abs(found[k]).max()


def test_bad_input_is_named():
    b, body = cube()
    point = body.at(CENTRE)
    hinge = b.add_joint("spherical", parent=wf.GROUND, child=body.surface("z-"))
    bad = [
        (lambda: b.add_spring(point, CENTRE, stiffness=1.0), "coincide"),
        (lambda: b.add_spring((0, 0, 0), (1, 0, 0), stiffness=1.0), "neither of its points"),
        (lambda: b.add_spring(wf.GROUND, point, stiffness=1.0), "give a point"),
        (lambda: b.add_spring((0, 0, 0), point), r"either stiffness or law \(a damper alone has stiffness=0\)"),
        (lambda: b.add_spring((0, 0, 0), point, stiffness=-1.0), "stiffness = -1.0"),
        (lambda: b.add_spring((0, 0, 0), point, stiffness=1.0, rest=-1.0), "rest = -1.0"),
        (lambda: b.add_spring((0, 0, 0), point, law=([1, 0], [0, 1])), "lengths rising"),
        (lambda: b.add_spring((0, 0, 0), point, law=3), "must be"),
        (lambda: b.add_spring((0, 0, 0), point, law=hardening, rest=0.1), "no rest"),
        (lambda: b.add_torsion_spring(hinge, stiffness=1.0), "no angle"),
        (lambda: b.add_torsion_spring(3, stiffness=1.0), "no joint of this builder"),
        (lambda: b.add_foundation(body.nodes("z-"), stiffness=1.0), "surface"),
        (lambda: b.add_point_mass(point, 0.0), "both 0"),
        (lambda: b.add_point_mass(point, -1.0), "mass = -1.0"),
        (lambda: b.add_point_mass(body.nodes([0]), 1.0, inertia=1.0), "does not determine"),
    ]
    for call, text in bad:
        with pytest.raises(wf.ModelError, match=text):
            call()
    b.add_spring((0, 0, 0), point, stiffness=1.0, name="s")
    with pytest.raises(wf.ModelError, match="used twice"):
        b.add_spring((0, 0, 0), point, stiffness=1.0, name="s")
