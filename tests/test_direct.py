"""Linear systems by a sparse factorisation: the same motions and equilibria as by conjugate gradients."""

import numpy as np
import pytest
import warp as wp

import warpfea as wf

LAW = {"E": 1e6, "nu": 0.3, "density": 1000.0}


def solver(linear, tol=1e-11, **options):
    return wf.NewtonPCG(linear=linear, tol=tol, max_pcg=20000, **options)


def bar(form=None, dtype="float64", worlds=1):
    """A bar of T10 that swings, damped in a form."""
    damping = wf.KelvinVoigt(50.0, 75.0, form=form) if form else None
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(3, 1, 1)), material=wf.SVK(**LAW, damping=damping), name="bar")
    b.clamp(body.nodes("x-"))
    b.set_initial(body, velocity=lambda X: np.outer(X[:, 0], (0, 0, 1.0)))
    return b.finalize(device="cpu", dtype=dtype, worlds=worlds)


def plate():
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    body = b.add_shell(wf.mesh.grid((2, 1), cells=(4, 2)), thickness=0.05, material=wf.SVK(**LAW))
    b.clamp(body.edge("x-"))
    return b.finalize(device="cpu")


def mechanism():
    """Beam, solid and shell with a hinge that is driven, a rod between points, pressure and a moment."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    law = wf.SVK(**LAW)
    beam = b.add_beam(
        [(0, 0, 0), (1, 0, 0)], elements=2, section=wf.Rectangle(0.1, 0.1), normal=(0, 0, 1), material=law, name="beam"
    )
    box = b.add_solid(wf.mesh.box((0.6, 0.2, 0.2), cells=(2, 1, 1), origin=(1, -0.1, -0.1)), material=law, name="box")
    shell = b.add_shell(wf.mesh.grid((0.6, 0.2), cells=(2, 1), origin=(1, -0.1, -0.6)), thickness=0.05, material=law)
    turn = ([0.0, 1.0], [0.0, 10.0])
    b.add_joint("revolute", parent=wf.GROUND, child=beam.start, axis=(0, 1, 0), drive=turn, name="motor")
    b.add_joint("spherical", parent=beam.end, child=box.surface("x-"), name="ball")
    b.add_joint("distance", parent=box.at((1.3, 0, 0)), child=shell.at((1.3, 0, -0.6)), name="rod")
    b.add_pressure(box.surface("z+"), 2e4)
    b.add_moment(beam.end, (0, 20.0, 5.0))
    return b.finalize(device="cpu")


def motion(model, linear, steps=4, dt=2e-3, **options):
    sim = wf.Simulation(model, dt=dt, solver=solver(linear, **options))
    sim.step(steps)
    return sim


MODELS = {
    "T10": bar,
    "3443": plate,
    "joints and follower loads": mechanism,
    **{f"{form} damping": lambda form=form: bar(form) for form in ("incremental", "rate", "explicit")},
}


@pytest.mark.parametrize("name", MODELS)
def test_motion_is_that_of_conjugate_gradients(name, data):
    model = MODELS[name]()
    expected, sim = (motion(model, linear) for linear in ("pcg", "direct"))
    assert data.error(sim.state.velocity.numpy(), expected.state.velocity.numpy()) < 1e-9
    assert data.error(sim.state.displacement.numpy(), expected.state.displacement.numpy()) < 1e-9
    assert sim.totals["pcg"][0] <= 2 * sim.totals["newton"][0]


@pytest.mark.parametrize("operator", ["elements", "matrix"])
def test_all_of_H_is_factorised(operator):
    """H v by the factorised matrix and by the operator of conjugate gradients."""
    sim = motion(mechanism(), "direct", operator=operator)
    model, newton, work = sim.model, sim.stepper.newton, sim.stepper.work
    active = wp.ones(1, dtype=wp.int32, device="cpu")
    work.newton.active.fill_(1)
    work.newton.iterations.zero_()
    newton.residual.evaluate(active)
    newton.residual.assemble_matrix(active)
    newton.direct._assemble(active, newton.direct.matrix, projected=False)
    matrix = newton.direct.assembler.host_csr(newton.direct.matrix)
    v = np.random.default_rng(0).normal(size=(model.slots, 3)) * model.slot_table.free
    work.p.assign(v[None])
    newton.residual.product(work.p, work.Hp, active)
    expected = work.Hp.numpy().ravel()
    parts = [
        abs(work.multipliers.trial_multiplier.numpy()).max(),
        abs(newton.ctx.scratch["followers"][0].columns.numpy()).max(),
    ]
    assert min(parts) > 0.0
    assert np.abs(matrix @ v.ravel() - expected).max() < 1e-12 * np.abs(expected).max()
    assert abs(matrix - matrix.T).max() < 1e-12 * abs(matrix).max()


def test_worlds_have_their_own_factors(data):
    model = bar(worlds=2)
    model.set_gravity([(0, 0, -9.81), (0, 5.0, 0)])
    expected, sim = (motion(model, linear) for linear in ("pcg", "direct"))
    got = sim.state.displacement.numpy()
    assert data.error(got, expected.state.displacement.numpy()) < 1e-9
    assert data.error(got[0], got[1]) > 0.01


def test_float32(data):
    model = bar(dtype="float32")
    expected, sim = (motion(model, linear, tol=1e-5) for linear in ("pcg", "direct"))
    assert data.error(sim.state.displacement.numpy(), expected.state.displacement.numpy()) < 1e-4


def test_statics_of_a_slender_beam(data):
    """L/h = 1000: the deflection to 1e-9, the arithmetic leaving 1e-16 (L/h)^2."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=2e11, nu=0.3, density=7800.0)
    beam = b.add_beam(
        [(0, 0, 0), (10, 0, 0)], elements=4, section=wf.Rectangle(0.01, 0.01), normal=(0, 0, 1), material=law
    )
    b.clamp(beam.start)
    b.add_point_load(beam.end, (0, 0, -0.1))
    model = b.finalize(device="cpu")
    expected, got = (
        wf.solve_static(model, load_steps=1, solver=solver(linear, max_newton=200)) for linear in ("pcg", "direct")
    )
    assert data.error(got.displacements(beam), expected.displacements(beam)) < 1e-9


@pytest.mark.slow
def test_a_column_beyond_its_critical_load(data, monkeypatch):
    """The positive matrix replaces an indefinite H, whose inverse may lead uphill."""
    from warpfea.solvers.direct import DirectSolver

    uphill = []
    retreat = DirectSolver._factorise_projected
    monkeypatch.setattr(
        DirectSolver, "_factorise_projected", lambda self, world: (uphill.append(world), retreat(self, world))
    )
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    column = b.add_beam(
        [(0, 0, 0), (0, 0, 1)], elements=6, section=wf.Rectangle(0.1, 0.1), normal=(1, 0, 0),
        material=wf.SVK(E=1e9, nu=0.3, density=1000.0),
    )  # fmt: skip
    b.clamp(column.start)
    critical = 1e9 * 0.1**4 / 12.0 * np.pi**2 / 4.0  # Euler's
    b.add_point_load(column.end, (0.003 * critical, 0, -1.3 * critical))
    model = b.finalize(device="cpu")
    expected, got = (
        wf.solve_static(model, load_steps=1, solver=solver(linear, max_newton=100)) for linear in ("pcg", "direct")
    )
    bent = expected.displacements(column)
    assert bent[0, -1, 0] > 0.5
    assert data.error(got.displacements(column), bent) < 1e-8
    assert uphill


def test_a_singular_matrix_is_named(monkeypatch):
    """Statics of what no support holds is refused before; here the factorisation itself gives up."""
    from warpfea.solvers import factor

    def refuse(*_, **__):
        raise RuntimeError("Factor is exactly singular")

    model = bar()
    sim = wf.Simulation(model, dt=1e-3, solver=solver("direct", max_halvings=1))
    monkeypatch.setattr(factor.spla, "splu", refuse)
    with pytest.raises(wf.ConvergenceError, match="singular tangent matrix"):
        sim.step()
    monkeypatch.undo()
    assert sim.step().converged.all()


@pytest.mark.parametrize("options", [{"linear": "cholesky"}, {"linear": "direct", "preconditioner": "two-level"}])
def test_bad_options_are_refused(options):
    with pytest.raises(wf.ModelError, match=repr(list(options.values())[-1])):
        wf.NewtonPCG(**options)


def test_a_gpu_without_cudss_solves_on_the_host_and_says_so():
    from types import SimpleNamespace

    from warpfea.model.assembly import slot_graph
    from warpfea.solvers.factor import SuperLU, make_factors

    model = bar()
    like = SimpleNamespace(
        device=SimpleNamespace(is_cuda=True),
        slot_table=model.slot_table,
        cache={},
        slots=model.slots,
        dtype=model.dtype,
    )
    with pytest.warns(UserWarning, match=r"warpfea\[cudss\]"):
        assert isinstance(make_factors(like, slot_graph(model.blocks, model.slots)), SuperLU)
