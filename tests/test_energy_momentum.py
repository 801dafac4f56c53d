"""The integrator energy_momentum: its operator, conservation of energy and momenta, joints, loads, damping."""

import numpy as np
import pytest
import warp as wp
from validation.conservation import CASES, DT, MECHANISMS, RATE, Conserved, mechanism, tumble
from validation.mechanisms import swing

import warpfea as wf
from warpfea.solvers.matrix_assembly import MatrixAssembler

TIGHT = wf.NewtonPCG(tol=1e-12)
QUICK = (("T10", "svk"), ("T4", "neo_hookean"), ("3243 tied", "svk"))


def marked(cases):
    """Most of the time of the others goes into their kernels."""
    return [case if case in QUICK else pytest.param(*case, marks=pytest.mark.slow) for case in cases]


def simulate(model, dt=DT, solver=TIGHT, **options):
    return wf.Simulation(model, dt=dt, solver=solver, **{"integrator": "energy_momentum", **options})


# the operator


def residual_at(sim, v):
    """g of Eq. (17) at velocities v (slots, 3) in the attempt at hand."""
    w, residual = sim.stepper.work, sim.stepper.newton.residual
    w.v.assign(v[None])
    active = wp.ones(1, dtype=wp.int32, device="cpu")
    residual.evaluate(active)
    return w.g.numpy()[0].copy()


def errors_of_operator(family, law, operator, integrator="energy_momentum"):
    """|H p - dg/dv p| over |dg/dv p| without the mass, for steps of DT and DT / 4."""
    far = []
    for dt in (DT, DT / 4):
        solver = wf.NewtonPCG(operator=operator)
        sim = simulate(tumble(family, law), dt=dt, solver=solver, capture=False, integrator=integrator)
        sim.step(round(0.02 / dt))
        w, residual = sim.stepper.work, sim.stepper.newton.residual
        v = sim.state.velocity.numpy()[0]
        active = wp.ones(1, dtype=wp.int32, device="cpu")
        w.step.running.fill_(1)
        for kernel in (sim.stepper.kernels.begin_attempt,):
            wp.launch(kernel, 1, inputs=[w.step, w.newton], device="cpu")
        state = sim.state
        args = [w.step, sim.model.slot_table.is_position_array, sim.model.topology.free]
        args += [state.displacement, state.velocity, state.displacement, state.velocity, w.q_tilde, w.v_tilde, w.u, w.v]
        wp.launch(sim.stepper.kernels.predict, (1, sim.model.slots), inputs=args, device="cpu")
        p = np.random.default_rng(1).uniform(-1, 1, v.shape)
        h = 1e-4
        numeric = (residual_at(sim, v + h * p) - residual_at(sim, v - h * p)) / (2 * h)
        residual_at(sim, v)
        residual.assemble_matrix(active)
        w.p.assign(p[None])
        residual.product(w.p, w.Hp, active)
        H = w.Hp.numpy()[0]
        mass = (sim.model.mass_matrix() @ p.ravel()).reshape(p.shape) / dt
        far.append(np.linalg.norm(H - numeric) / np.linalg.norm(numeric - mass))
    return far


@pytest.mark.parametrize(
    ("family", "law"), marked([("T10", "svk"), ("T4", "svk"), ("3243 tied", "svk"), ("3443 tied", "svk")])
)
@pytest.mark.parametrize(
    "integrator", ["energy_momentum", pytest.param("energy_momentum(rho_inf=0.5)", marks=pytest.mark.slow)]
)
def test_the_operator_is_the_derivative(family, law, integrator):
    """B_mid^T D B_1 of stresses that are linear in E; 8934ce7 has B_mid on both sides, off by 0.1 here."""
    assert max(errors_of_operator(family, law, "elements", integrator)) < 1e-8


def test_the_operator_is_the_derivative_with_dissipation():
    assert max(errors_of_operator("T10", "svk", "elements", "energy_momentum(rho_inf=0.5)")) < 1e-8


def test_the_operator_of_a_discrete_gradient_differs_by_the_strain_of_a_step():
    """Its derivative has the moduli half-way in the place of their mean: an error of the second order in the step."""
    far = errors_of_operator("T4", "neo_hookean", "elements")
    assert far[0] < 0.05
    assert far[0] > 3.0 * far[1]


@pytest.mark.parametrize(("family", "law"), marked([("T10", "svk"), ("3243 tied", "svk"), ("3443 tied", "svk")]))
def test_the_matrix_differs_from_the_derivative_by_the_turn_of_a_step(family, law):
    """H - dg/dv is B_mid^T D (B_mid - B_1)/2: it falls with the step at a fixed spin, and all else is exact."""
    far = errors_of_operator(family, law, "matrix")
    assert far[0] < 0.15
    assert 3.0 < far[0] / far[1] < 5.5


@pytest.mark.parametrize(("family", "law"), [("T10", "svk"), ("T4", "neo_hookean"), ("3243 tied", "svk")])
def test_columns_and_whole_elements_give_one_matrix(family, law):
    """The kernels of a GPU and those of the CPU, here both on the CPU."""
    sim = simulate(tumble(family, law), solver=wf.NewtonPCG(operator="matrix"), capture=False)
    sim.step(3)
    w, residual = sim.stepper.work, sim.stepper.newton.residual
    active = wp.ones(1, dtype=wp.int32, device="cpu")
    for projected in (False, True):
        made = []
        for whole in (False, True):
            matrix = MatrixAssembler(sim.model, w, sim.stepper.launch, residual.block_kernels, whole)
            values = matrix.allocate_values("test")
            matrix.assemble(w.stage, w.step.mass_factor, active, values, projected=projected)
            made.append(matrix.host_csr(values))
        assert abs(made[0] - made[1]).max() < 2e-14 * abs(made[0]).max()


# conservation


SVK = [case for case in CASES if case[1] == "svk"]


@pytest.mark.parametrize(("family", "law"), marked(CASES))
def test_free_bodies_keep_energy_and_momenta(family, law):
    """1 % of the way of tests/results/conservation_cpu.json, see test_conservation_results.py."""
    sim = simulate(tumble(family, law))
    watch = Conserved(sim)
    for _ in range(100):
        sim.step()
        watch.measure()
    bound = 1e-11 if law == "svk" else 1e-10
    assert watch.energy < bound
    assert watch.linear < bound
    assert watch.angular < bound
    assert watch.strain > 0.3
    assert watch.stretch > 0.08
    row = watch.row()
    assert row["integrator"] < 1e-13
    assert row["ledger_residual"] < bound


@pytest.mark.parametrize(("family", "law"), marked(SVK))
def test_a_step_takes_at_most_12_iterations(family, law):
    """Of a body that spins by a tenth of a radian a step, to a tolerance of 1e-12."""
    sim = simulate(tumble(family, law, stretch=0.0), dt=0.1 / RATE)
    assert max(int(sim.step().newton[0]) for _ in range(100)) <= 12


@pytest.mark.parametrize(
    "options",
    [{"operator": "elements", "preconditioner": "block-jacobi"}, {"operator": "matrix", "preconditioner": "two-level"},
     {"linear": "direct"}, {"operator": "elements", "preconditioner": "two-level"}],
)  # fmt: skip
@pytest.mark.parametrize(("family", "law"), marked([("T10", "svk"), ("T10", "mooney_rivlin"), ("3443 tied", "svk")]))
def test_every_way_to_solve_conserves(family, law, options):
    sim = simulate(tumble(family, law), solver=wf.NewtonPCG(tol=1e-12, **options))
    watch = Conserved(sim)
    for _ in range(20):
        sim.step()
        watch.measure()
    assert max(watch.energy, watch.linear, watch.angular) < 1e-12


@pytest.mark.parametrize("scheme", ["backward_euler", "bdf2"])
def test_others_do_not_conserve(scheme):
    """Sharpness of the bounds above."""
    sim = wf.Simulation(tumble("T10", "svk"), dt=DT, integrator=scheme, solver=TIGHT)
    watch = Conserved(sim)
    for _ in range(100):
        sim.step()
        watch.measure()
    assert watch.energy > 1e-2
    assert watch.angular > 1e-4


def test_a_loose_tolerance_shows_as_unbalanced_work():
    sim = simulate(tumble("T10", "neo_hookean"), solver=wf.NewtonPCG(tol=1e-5))
    watch = Conserved(sim)
    for _ in range(50):
        sim.step()
        watch.measure()
    e = {name: values[0] for name, values in sim.energies().items()}
    assert watch.energy > 1e-9
    assert watch.row()["integrator"] < 1e-13
    assert abs(e["ledger_residual"] - e["unbalanced"]) < 1e-13 * e["kinetic"]


def test_halved_steps_conserve():
    """Steps that Newton's method is not given enough iterations for are halved."""
    sim = simulate(tumble("T10", "neo_hookean"), solver=wf.NewtonPCG(tol=1e-12, max_newton=3))
    watch, halvings = Conserved(sim), 0
    for _ in range(40):
        halvings += int(sim.step().halvings[0])
        watch.measure()
    assert halvings > 3
    assert max(watch.energy, watch.linear, watch.angular) < 1e-12


@pytest.mark.parametrize("scene", MECHANISMS)
def test_mechanisms_keep_energy(scene):
    sim = simulate(mechanism(scene), dt=MECHANISMS[scene][1], constraint_tol=1e-13)

    def total():
        e = {name: values[0] for name, values in sim.energies().items()}
        return e["kinetic"] + e["strain"] + e["potential"] - e.get("work_joints", 0.0), e["kinetic"] + e["strain"]

    first, error, size = total()[0], 0.0, 0.0
    for _ in range(50):
        sim.step()
        now, moving = total()
        error, size = max(error, abs(now - first)), max(size, moving)
    assert error < 1e-10 * size
    assert abs(sim.energies()["integrator"][0]) < 1e-13 * size


@pytest.mark.parametrize("kind", ["DIST", "spherical", "cylindrical", "universal", "fixed"])
def test_constraints_between_free_bodies_keep_momenta(kind):
    """Forces of joints are equal and opposite, and act in one line."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=1e6, nu=0.3, density=1000.0)
    section = wf.Rectangle(0.05, 0.05)
    first, second = (
        b.add_beam([(k, 0, 0), (k + 1.0, 0, 0)], elements=2, section=section, normal=(0, 0, 1), material=law)
        for k in range(2)
    )
    for body, sign in ((first, 1.0), (second, -1.0)):
        b.set_initial(body, velocity=lambda X, s=sign: np.cross((1.0, 6.0 * s, 4.0), X - (1.0, 0, 0)))
    if kind == "DIST":
        b.add_constraint("DIST", points=(first.start, second.end))
    else:
        axis = {} if kind in ("spherical", "fixed") else {"axis": (1, 0, 0)}
        b.add_joint(kind, parent=first.end, child=second.start, **axis)
    model = b.finalize(device="cpu")
    sim = simulate(model, dt=2e-3, constraint_tol=1e-13)
    mass = model.mass_matrix()[::3, ::3]
    reference = np.concatenate([body.reference + (body.slot_kind == 0)[:, None] * body.origin for body in model.bodies])
    kind_of = np.concatenate([body.slot_kind for body in model.bodies])

    def momenta():
        u, v = (array.numpy()[0] for array in (sim.state.displacement, sim.state.velocity))
        p = mass @ v
        e = sim.energies()
        return p[kind_of == 0].sum(axis=0), np.cross(reference + u, p).sum(axis=0), e["kinetic"][0] + e["strain"][0]

    before = momenta()
    sim.step(100)
    after = momenta()
    size = np.linalg.norm(before[1])
    assert np.linalg.norm(after[0] - before[0]) < 1e-11 * size
    assert np.linalg.norm(after[1] - before[1]) < 1e-11 * size
    assert abs(after[2] - before[2]) < 1e-10 * before[2]


@pytest.mark.parametrize("halved", [False, True], ids=["uniform", "halved"])
def test_second_order_with_joints(halved):
    """Two soft beams on a ball joint and a hinge swing: the end against a run of an eighth of the step.

    Why steps in halves stand for refused ones: test_a_refused_step_equals_two_of_half_the_size.
    """
    ends = []
    for dt in (2e-3, 1e-3, 1.25e-4):
        sim, _ = swing("cpu")
        sim = simulate(sim.model, dt=dt, constraint_tol=1e-12)
        for k in range(round(0.08 / dt)):
            parts = 2 if halved and k % 2 and dt > 5e-4 else 1
            sim.dt = dt / parts
            sim.step(parts)
        ends.append(np.concatenate([sim.probe("tip").position[0, -1], sim.probe("tip").velocity[0, -1] / 10.0]))
    error = [np.linalg.norm(end - ends[-1]) for end in ends[:2]]
    assert np.log2(error[0] / error[1]) == pytest.approx(2.0, abs=0.1)


@wp.func
def spun_up(t: wp.float64) -> wp.float64:
    return wp.float64(300.0) * t * t * t


def test_second_order_with_a_driven_hinge():
    """A soft beam is turned from rest by 17 degrees: all slots at the end against a run of an eighth of the step."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law, section = wf.SVK(E=1e6, nu=0.3, density=1000.0), wf.Rectangle(0.1, 0.1)
    beam = b.add_beam([(0, 0, 0), (1, 0, 0)], elements=2, section=section, normal=(0, 0, 1), material=law)
    b.add_joint("revolute", parent=wf.GROUND, child=beam.start, axis=(0, 0, 1), drive=spun_up)
    model, ends = b.finalize(device="cpu"), []
    for steps in (32, 64, 512):
        sim = simulate(model, dt=0.1 / steps, constraint_tol=1e-13, ledger=False)
        sim.step(steps)
        ends.append(sim.state.displacement.numpy()[0])
    error = [np.linalg.norm(end - ends[-1]) for end in ends[:2]]
    assert np.log2(error[0] / error[1]) == pytest.approx(2.0, abs=0.1)


# loads, damping


@wp.func
def push(t: wp.float64):
    return wp.vec3d(wp.float64(0.0), wp.float64(3e4) * wp.sin(wp.float64(40.0) * t), wp.float64(0.0))


def test_loads_act_in_the_middle_of_a_step():
    """The impulse of a traction over time is the sum of its values half-way, and gravity's that of the weight."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
    b.add_traction(body.surface("x+"), push)
    model = b.finalize(device="cpu")
    sim = simulate(model, dt=5e-3)
    sim.step(20)
    p = (model.mass_matrix() @ sim.state.velocity.numpy()[0].ravel()).reshape(-1, 3).sum(axis=0)
    middle = 5e-3 * (np.arange(20) + 0.5)
    expected = [0.0, 0.04 * 5e-3 * np.sum(3e4 * np.sin(40.0 * middle)), -9.81 * 40.0 * 0.1]
    np.testing.assert_allclose(p, expected, rtol=1e-10, atol=1e-9)
    e = {name: values[0] for name, values in sim.energies().items()}
    assert abs(e["kinetic"] + e["strain"] + e["potential"] - e["work_loads"]) < 1e-10 * e["kinetic"]


@pytest.mark.parametrize("form", ["incremental", "rate"])
def test_damping_dissipates_and_leaves_momenta(form):
    """Both forms of Kelvin-Voigt damping are (E1 - E0)/h: what is lost is in the ledger, and momenta stay."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    kelvin = wf.KelvinVoigt(300.0, 200.0, form=form)
    law = wf.NeoHookean(mu=4e5, k=1e6, density=1000.0, damping=kelvin)
    body = b.add_solid(wf.mesh.box((1, 0.3, 0.2), cells=(3, 1, 1)), material=law)
    b.set_initial(body, velocity=lambda X: np.cross((3.0, 6.0, 12.0), X - (0.5, 0.15, 0.1)) + X * (8.0, 0.0, -4.0))
    sim = simulate(b.finalize(device="cpu"))
    watch, lost = Conserved(sim), []
    for _ in range(60):
        sim.step()
        watch.measure()
        lost.append(sim.energies()["viscous"][0])
    e = {name: values[0] for name, values in sim.energies().items()}
    assert min(np.diff(lost)) > 0.0
    assert e["viscous"] > 0.1 * watch.first[0]
    assert abs(e["kinetic"] + e["strain"] + e["viscous"] - watch.first[0]) < 1e-11 * watch.first[0]
    assert max(watch.linear, watch.angular) < 1e-12
    assert abs(e["integrator"]) < 1e-13 * watch.first[0]


def test_forms_of_damping_that_mean_the_same_agree():
    ends = []
    for form in ("incremental", "rate"):
        b = wf.ModelBuilder()
        law = wf.SVK(E=1e6, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(300.0, 200.0, form=form))
        body = b.add_solid(wf.mesh.box((1, 0.3, 0.2), cells=(3, 1, 1)), material=law)
        b.clamp(body.nodes("x-"))
        sim = simulate(b.finalize(device="cpu"), solver=wf.NewtonPCG(tol=1e-12, preconditioner="block-jacobi"))
        sim.step(10)
        ends.append(sim.state.displacement.numpy())
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-12)


@pytest.mark.parametrize("load", ["pressure", "moment"])
def test_followers_act_on_the_middle_of_a_step(load):
    """A pressure on the whole surface has no resultant, a moment alone no force: momenta stay, work is booked."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=1e6, nu=0.3, density=1000.0)
    body = b.add_solid(wf.mesh.box((1, 0.3, 0.2), cells=(3, 1, 1)), material=law)
    if load == "pressure":
        for side in ("x-", "x+", "y-", "y+", "z-", "z+"):
            b.add_pressure(body.surface(side), 2e4)
    else:
        b.add_moment(body.at((0.9, 0.15, 0.1)), (0.0, 0.0, 300.0))
    b.set_initial(body, velocity=lambda X: np.cross((3.0, 6.0, 12.0), X - (0.5, 0.15, 0.1)) + (1.0, 0.5, 0.2))
    sim = simulate(b.finalize(device="cpu"))
    watch = Conserved(sim)
    for _ in range(30):
        sim.step()
        watch.measure()
    e = {name: values[0] for name, values in sim.energies().items()}
    assert watch.linear < 1e-12
    if load == "pressure":
        assert watch.angular < 1e-12
    assert abs(e["work_fields"]) > 1e-3 * watch.first[0]
    assert abs(e["kinetic"] + e["strain"] - e["work_fields"] - watch.first[0]) < 1e-11 * watch.first[0]
    assert abs(e["integrator"]) < 1e-13 * watch.first[0]


# precision, worlds, what is refused


@pytest.mark.slow
@pytest.mark.parametrize(("family", "law"), [("T10", "svk"), ("T10", "mooney_rivlin"), ("3243 tied", "svk")])
def test_single_precision_runs(family, law):
    sim = simulate(tumble(family, law, dtype="float32"), solver=wf.NewtonPCG())
    watch = Conserved(sim)
    for _ in range(100):
        sim.step()
        watch.measure()
    assert max(watch.energy, watch.linear, watch.angular) < 1e-4


def test_worlds_equal_single_runs():
    one, many = (simulate(tumble("3443 tied", "svk", worlds=n)) for n in (1, 3))
    one.step(10)
    many.step(10)
    for name, values in many.state.numpy().items():
        for world in range(3):
            np.testing.assert_array_equal(values[world], one.state.numpy()[name][0], err_msg=name)


def test_jacobi_is_refused_by_name():
    with pytest.raises(wf.ModelError, match=r"energy_momentum.*NewtonPCG"):
        wf.Simulation(tumble("T4", "svk"), dt=DT, integrator="energy_momentum", solver=wf.Jacobi())
