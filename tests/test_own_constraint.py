"""A kind of constraint of one's own, in this file alone: a rope of fixed length from P over a pulley R to Q."""

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.terms.constraint_formulas import Formula
from warpfea.kernels.terms.constraints import DOT

import warpfea as wf
from warpfea.builder.joints import CONSTRAINT_KINDS, ConstraintKind
from warpfea.model.joints import ConstraintRow, constant_vector

G, MASSES = 9.81, (3.0, 1.0)


@wp.func
def rope_length(a: wp.vec3d, b: wp.vec3d, a2: wp.vec3d) -> wp.float64:
    return wp.length(a) + wp.length(b)


@wp.func
def rope_directions(a: wp.vec3d, b: wp.vec3d, a2: wp.vec3d) -> wp.mat33d:
    return wp.matrix_from_rows(wp.normalize(a), wp.normalize(b), wp.vec3d())


@wp.func
def turn(a: wp.vec3d, da: wp.vec3d) -> wp.vec3d:
    """Change of the unit vector along a."""
    n = wp.normalize(a)
    return (da - wp.dot(n, da) * n) / wp.length(a)


@wp.func
def rope_turns(a: wp.vec3d, b: wp.vec3d, a2: wp.vec3d, da: wp.vec3d, db: wp.vec3d, da2: wp.vec3d) -> wp.mat33d:
    return wp.matrix_from_rows(turn(a, da), turn(b, db), wp.vec3d())


ROPE = Formula("rope", rope_length, rope_directions, rope_turns)


def rope_rows(at):
    """|P - R| + |Q - R| = the value, by default that of the reference."""
    P, R, Q = at.x
    a, b = P - R, Q - R
    length = float(np.linalg.norm(a.value) + np.linalg.norm(b.value))
    return [ConstraintRow(ROPE, a, b, **at.right_side(length))]


@pytest.fixture(autouse=True)
def rope_kind(monkeypatch):
    monkeypatch.setitem(CONSTRAINT_KINDS, "ROPE", ConstraintKind(3, rope_rows))


def atwood(sway=0.0, value=None, dtype="float64"):
    """Two stiff cubes on one rope over a pulley at (0, 0, 1): 0.5 m and 1 m below it, `sway` aside."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    cubes = []
    for mass, x, z in zip(MASSES, (-sway, sway), (0.5, 0.0)):
        mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), origin=(x - 0.05, -0.05, z - 0.1))
        damping = wf.KelvinVoigt(eta=2e4, lambda_v=2e4)  # of the vibrations after the release
        cubes.append(b.add_solid(mesh, material=wf.SVK(E=1e8, nu=0.3, density=mass / 1e-3, damping=damping)))
    tops = [cube.surface("z+") for cube in cubes]
    rope = b.add_constraint("ROPE", points=(tops[0], (0.0, 0.0, 1.0), tops[1]), value=value)
    return b.finalize(device="cpu", dtype=dtype), cubes, rope


def moved(model, size=0.05):
    state = model.state()
    rng = np.random.default_rng(3)
    state.displacement.assign(rng.normal(scale=size, size=(model.worlds, model.slots, 3)))
    return state


def test_value_and_right_side():
    model, cubes, _ = atwood(sway=0.2)
    value, _, target = model.terms.constraints.values(moved(model, 0.0))
    assert abs(value[0, 0]) < 1e-15
    assert target[0, 0] == pytest.approx(np.hypot(0.2, 0.5) + np.hypot(0.2, 1.0), rel=1e-14)
    longer, _, target = atwood(value=1.6)[0].terms.constraints.values(moved(model, 0.0))
    assert (longer[0, 0], target[0, 0]) == pytest.approx((-0.1, 1.6), rel=1e-12)


def test_jacobian_and_curvature_are_differences():
    model, _, _ = atwood(sway=0.2)
    state = moved(model)
    u = state.displacement.numpy().copy()
    d = np.random.default_rng(4).normal(size=u.shape)
    J = model.terms.constraints.jacobian(state, 0)
    curvature = model.terms.constraints.curvature(state, np.ones(1), d[0])[0]
    values, rows = [], []
    for sign in (1.0, -1.0):
        state.displacement.assign(u + sign * 1e-6 * d)
        values.append(model.terms.constraints.values(state)[0][0, 0])
        rows.append(model.terms.constraints.jacobian(state, 0).toarray().ravel())
    slope = (values[0] - values[1]) / 2e-6
    assert abs(slope) > 0.1
    assert J @ d.ravel() == pytest.approx(slope, rel=1e-8)
    change = (rows[0] - rows[1]) / 2e-6
    assert np.abs(change).max() > 0.1
    assert np.abs(curvature.ravel() - change).max() < 1e-7 * np.abs(change).max()


@pytest.mark.parametrize(
    ("integrator", "solver", "dtype"),
    [
        ("bdf2", wf.NewtonPCG(), "float64"),
        ("bdf2", wf.NewtonPCG(linear="direct"), "float64"),
        ("bdf2", wf.NewtonPCG(multipliers="outer", penalty=100.0), "float64"),
        ("bdf2", wf.NewtonPCG(preconditioner="block-jacobi"), "float32"),
        ("energy_momentum", wf.NewtonPCG(), "float64"),
        ("generalized_alpha", wf.NewtonPCG(), "float64"),
    ],
)
def test_atwood_machine(integrator, solver, dtype):
    """Acceleration g (m1 - m2) / (m1 + m2), pull 2 m1 m2 g / (m1 + m2) on the last point."""
    model, cubes, rope = atwood(dtype=dtype)
    sim = wf.Simulation(model, dt=1e-3, integrator=integrator, solver=solver)
    sim.step(50)
    m1, m2 = MASSES
    fall = 0.5 * G * (m1 - m2) / (m1 + m2) * 0.05**2
    travel = [sim.displacements(cube)[0, :, 2].mean() for cube in cubes]
    np.testing.assert_allclose(travel, (-fall, fall), rtol=1e-3)
    pull = sim.joint_record(rope).force[0, :, 2] / (2.0 * m1 * m2 * G / (m1 + m2))
    assert pull[5] == pytest.approx(1.0, rel=2e-2)
    if dtype == "float64":
        assert pull[-1] == pytest.approx(1.0, rel=1e-3)


def test_a_swinging_rope_keeps_length_and_energy():
    """Rope directions turn: the curvature of the formula counts."""
    model, cubes, rope = atwood(sway=0.3)
    sim = wf.Simulation(model, dt=2e-3, integrator="generalized_alpha", solver=wf.NewtonPCG(tol=1e-10))
    sim.step(20)
    assert sim.violation(rope)[0] < 1e-10
    assert np.abs(sim.displacements(cubes[0])[0, :, 0]).max() > 1e-3
    energies = {name: values[0] for name, values in sim.energies().items()}
    assert abs(energies["ledger_residual"]) < 1e-8
    assert sim.totals["newton"][0] < 4 * 20


def test_the_matrix_is_that_of_the_products():
    """H v by the matrix of the direct solver and by the operator of conjugate gradients."""
    sim = wf.Simulation(atwood(sway=0.3)[0], dt=1e-3, solver=wf.NewtonPCG(linear="direct", tol=1e-10))
    sim.step(3)
    newton, work = sim.stepper.newton, sim.stepper.work
    active = wp.ones(1, dtype=wp.int32, device="cpu")
    newton.residual.evaluate(active)
    newton.direct._assemble(active, newton.direct.matrix, projected=False)
    v = np.random.default_rng(0).normal(size=work.p.numpy().shape)
    work.p.assign(v)
    work.newton.active.fill_(1)
    newton.residual.product(work.p, work.Hp, active)
    expected = work.Hp.numpy().ravel()
    product = newton.direct.assembler.host_csr(newton.direct.matrix) @ v.ravel()
    assert abs(work.multipliers.curvature.numpy()).max() * work.multipliers.trial_multiplier.numpy().max() > 1.0
    assert np.abs(product - expected).max() < 1e-12 * np.abs(expected).max()


UP = constant_vector((0.0, 0.0, 1.0))


def kind_of(*row):
    return ConstraintKind(2, lambda at: [ConstraintRow(row[0], at.x[1] - at.x[0], *row[1:])])


SPOILT = {
    "a row": (
        ConstraintKind(2, lambda at: ConstraintRow(DOT, at.x[0], UP)),
        "its rows are ConstraintRow.*expected a list",
    ),
    "no rows": (ConstraintKind(2, lambda at: []), r"its rows are \[\]; expected a list of one ConstraintRow or more"),
    "other rows": (ConstraintKind(2, lambda at: [1.0]), r"its rows are \[1.0\]; expected a list"),
    "an array": (kind_of(DOT, np.ones(3)), r"vector b of row 0 is array.*expected a Vector.*constant_vector"),
    "a third array": (kind_of(DOT, UP, 1.0, np.ones(3)), r"vector a2 of row 0 is array.*expected a Vector"),
    "a text": (kind_of("DOT", UP), "row 0 has kind 'DOT'; expected DOT, DISTANCE, ANGLE or a Formula"),
    "a device function": (kind_of(rope_length, UP), "row 0 has kind .*rope_length.*; expected DOT"),
    "an unknown number": (kind_of(17, UP), "row 0 has kind 17; expected DOT"),
    "nan": (
        kind_of(DOT, constant_vector((0, 0, np.nan))),
        r"vector b of row 0 is \[ *0. +0. +nan\]; expected three finite",
    ),
    "two numbers": (kind_of(DOT, constant_vector((0, 1))), r"vector b of row 0 is .*; expected three finite numbers"),
    "a bare function": (rope_rows, r"CONSTRAINT_KINDS\['OWN'\] is <function rope_rows.*, no ConstraintKind; write"),
}


@pytest.mark.parametrize("case", SPOILT)
def test_a_kind_that_does_not_fit_is_refused(case, monkeypatch):
    kind, message = SPOILT[case]
    monkeypatch.setitem(CONSTRAINT_KINDS, "OWN", kind)
    b = wf.ModelBuilder()
    cube = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=wf.SVK(E=1e8, nu=0.3, density=1000.0))
    with pytest.raises(wf.ModelError, match=rf"constraint 'OWN_1' \(OWN\): .*{message}"):
        b.add_constraint("OWN", points=((0.0, 0.0, 1.0), cube.at((0, 0, 0))))


@wp.func
def single_precision(a: wp.vec3d, b: wp.vec3d, a2: wp.vec3d) -> wp.float64:
    return 2.0 * wp.length(a)


def test_a_corrected_formula_compiles(monkeypatch):
    """Kernels that do not compile are not in the way of those of a later formula of that name."""

    def model(value):
        b = wf.ModelBuilder()
        mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1))
        cube = b.add_solid(mesh, material=wf.SVK(E=1e8, nu=0.3, density=1000.0))
        formula = Formula("own", value, rope_directions, rope_turns)
        monkeypatch.setitem(CONSTRAINT_KINDS, "OWN", kind_of(formula, UP))
        b.add_constraint("OWN", points=((0.0, 0.0, 1.0), cube.at((0, 0, 0))))
        return b.finalize(device="cpu")

    def value(model):
        return model.terms.constraints.values(model.state())[0][0, 0]

    with pytest.raises(RuntimeError, match="single_precision"):
        value(model(single_precision))
    assert value(model(rope_length)) == pytest.approx(2.0, rel=1e-12)  # |(0, 0, -1)| + |(0, 0, 1)|


def test_two_formulas_of_one_name_are_refused(monkeypatch):
    b = wf.ModelBuilder()
    other = Formula("rope", rope_length, rope_directions, None)
    cube = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=wf.SVK(E=1e8, nu=0.3, density=1000.0))
    for formula in (ROPE, other):
        kind = ConstraintKind(2, lambda at, formula=formula: [ConstraintRow(formula, at.x[0], at.x[1])])
        monkeypatch.setitem(CONSTRAINT_KINDS, f"own {formula is ROPE}", kind)
        b.add_constraint(f"own {formula is ROPE}", points=(cube.at((0, 0, 0)), (0.0, 0.0, 1.0)))
    with pytest.raises(wf.ModelError, match="two formulas of constraints have one name among rope, rope"):
        b.finalize(device="cpu")
