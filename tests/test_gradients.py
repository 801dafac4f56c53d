"""wf.Adjoint: gradients of runs and equilibria against differences and closed forms."""

import floor_term
import numpy as np
import parameter_models as models
import pytest
import warp as wp
from gradient_models import LAW, SOLVER, TARGET, bar, best_differences, controls, linked, shifts

import warpfea as wf
from warpfea.terms.protocols import Differentiable

TOLERANCE = 1e-7
SVK, NEO, RIVLIN = (models.material(law) for law in (models.SVK, models.NEO, models.RIVLIN))
CASES = {
    "T4 20": (models.solid("T4"), SVK, 20),
    "T10 5": (models.solid(), NEO, 5),
    "3243 20": (models.beam(), SVK, 20),
    "3443 1": (models.shell(), SVK, 1),
    "3443 20": (models.shell(), SVK, 20),
    "T4 200": (models.solid("T4"), RIVLIN, 200),
    "T4 rate": (models.solid("T4"), models.material(form="rate"), 5),
}
FAST = ("T4 20", "T4 20 generalized_alpha", "T10 5", "3243 20", "T4 20 bdf2", "3243 20 bdf2", "T4 rate")
SCHEMES = {"T4 20": ("bdf2", "energy_momentum", "generalized_alpha"), "T4 rate": ("generalized_alpha",),
           "3243 20": ("bdf2", "energy_momentum(rho_inf=0.8)")}  # fmt: skip
CASES |= {f"{name} {scheme}": (*CASES[name], scheme) for name, schemes in SCHEMES.items() for scheme in schemes}
CASES = {name: case if len(case) == 4 else (*case, "backward_euler") for name, case in CASES.items()}
CASES = [pytest.param(*case, id=name, marks=[pytest.mark.slow] * (name not in FAST)) for name, case in CASES.items()]
BASE = {"E": 1e6, "nu": 0.3, "eta": 30.0, "density": 1100.0}
GRAVITY = np.array([0.0, 3.0, -9.81])
NAMES = [*(f"body.{name}" for name in BASE), "gravity", "initial.velocity", "initial.displacement"]


def start(m, scale):
    """A state with displacements and velocities, those of clamped nodes too, times `scale` (worlds, 2)."""
    rng, state = np.random.default_rng(1), m.state()
    for array, size, factor in zip((state.displacement, state.velocity), (1e-4, 1e-2), scale.T):
        direction = size * rng.standard_normal((m.slots, 3))
        array.assign(factor[:, None, None] * direction)
    return state


def body_run(add, law, steps, scheme, rows, worlds=slice(None)):
    """Tape of worlds whose parameters differ by `rows` from the base, those of a slice."""
    rows = rows[worlds]
    m = models.model(add, law, len(rows))
    m.many = False
    for k, (name, value) in enumerate(BASE.items()):
        m.set_parameter(f"body.{name}", value * (1.0 + rows[:, k]))
    m.set_gravity(GRAVITY * (1.0 + rows[:, 4:5]))
    sim = wf.Simulation(m, start(m, 1.0 + rows[:, 5:]), dt=2e-3, integrator=scheme, solver=SOLVER)
    tape = wf.Adjoint(sim, NAMES)
    tape.run(steps)
    loss = wf.loss.sum_of_squares(tape.probe("tip"), np.full((steps, 3), TARGET))
    return m, tape, loss, {name: array.numpy() for name, array in tape.backward(loss).items()}


@pytest.mark.parametrize(("add", "law", "steps", "scheme"), CASES)
def test_gradients_of_a_body(add, law, steps, scheme):
    rows = shifts(len(BASE) + 3)
    m, tape, loss, g = body_run(add, law, steps, scheme, rows)
    state = start(m, np.ones((m.worlds, 2)))
    exact = [g[f"body.{name}"][0] * value for name, value in BASE.items()] + [g["gravity"][0] @ GRAVITY]
    exact += [np.sum(g[f"initial.{k}"][0] * getattr(state, k).numpy()[0]) for k in ("displacement", "velocity")]
    chosen = [k for k, value in enumerate(exact) if not (steps == 1 and k in (0, 1))]  # E and nu: of round-off's size
    errors = best_differences(loss.numpy(), exact)
    assert (errors[chosen] < TOLERANCE).all(), errors
    assert (tape.residual < 1e-10).all()
    _, _, _, alone = body_run(add, law, steps, scheme, rows, slice(7, 8))
    assert all(np.array_equal(alone[name][0], g[name][7]) for name in g)  # the bits of a run of its own


SLOW_SCHEMES = ("energy_momentum", "generalized_alpha")
LINKED = [("motor", "backward_euler"), ("motor", "bdf2"), ("loads", "backward_euler"), ("loads", "energy_momentum")]
LINKED += [("drives", "bdf2"), ("motor", "generalized_alpha"), ("loads", "generalized_alpha")]


@pytest.mark.parametrize(
    ("kind", "scheme"),
    [
        pytest.param(*case, marks=[pytest.mark.slow] * (case[0] == "drives" or case[1] in SLOW_SCHEMES))
        for case in LINKED
    ],
)
def test_gradients_of_joints_and_controls(kind, scheme):
    steps = 6
    given = controls(kind, steps)
    rng = np.random.default_rng(2)
    scales = {name: np.ptp(values) * rng.standard_normal(values.shape) for name, values in given.items()}
    rows = shifts(2 + len(given))
    m = linked(kind, len(rows))
    m.set_parameter("a.E", 1e6 * (1.0 + rows[:, 0]))
    m.set_parameter("b.density", 1000.0 * (1.0 + rows[:, 1]))
    sim = wf.Simulation(m, dt=2e-3, integrator=scheme, solver=SOLVER, constraint_tol=1e-12)
    tape = wf.Adjoint(sim, ["a.E", "b.density", *given])
    for step in range(steps):
        for k, (name, values) in enumerate(given.items()):
            sim.controls[name][:] = values[step] + rows[:, 2 + k : 3 + k] * scales[name][step]
        tape.run(1)
    loss = wf.loss.sum_of_squares(tape.probe("tip").displacement, np.full((1, steps, 3), TARGET))
    g = {name: array.numpy() for name, array in tape.backward(loss).items()}
    assert all(g[name].shape == (m.worlds, *values.shape) for name, values in given.items())
    exact = [1e6 * g["a.E"][0], 1000.0 * g["b.density"][0]]
    exact += [np.sum(g[name][0] * scales[name]) for name in given]
    errors = best_differences(loss.numpy(), exact)
    assert (errors < TOLERANCE).all(), errors


@pytest.mark.slow
def test_initial_accelerations_of_moving_joints():
    """Velocities that the joints correct, jerk, densities, displacements of slots that no joint ties; steps change."""
    rows, rng = shifts(4), np.random.default_rng(4)
    m = linked("motor", len(rows))
    m.set_parameter("a.E", 1e6 * (1.0 + rows[:, 0]))
    m.set_parameter("b.density", 1000.0 * (1.0 + rows[:, 1]))
    X = m.slot_table.reference + np.concatenate([np.tile(b.origin, (b.slot_count, 1)) for b in m.bodies])
    d = {"displacement": 1e-5 * rng.standard_normal((m.slots, 3))}
    d["displacement"][m.constraints.slot_host] = 0.0
    d["velocity"] = np.cross((0.3, 4.0, 0.2), X) + 0.02 * rng.standard_normal((m.slots, 3))
    state = m.state()
    for k, (name, values) in enumerate(d.items(), start=2):
        getattr(state, name).assign((1.0 + rows[:, k])[:, None, None] * values)
    sim = wf.Simulation(m, state, dt=2e-3, integrator="generalized_alpha", solver=SOLVER, constraint_tol=1e-13)
    tape = wf.Adjoint(sim, ["a.E", "b.density", *(f"initial.{name}" for name in d)])
    tape.run(3)
    sim.dt = 5e-4  # accelerations began with 2e-3
    tape.run(2)
    loss = wf.loss.sum_of_squares(tape.probe("tip").displacement, np.full((1, 5, 3), TARGET))
    g = {name: array.numpy() for name, array in tape.backward(loss).items()}
    exact = [1e6 * g["a.E"][0], 1000.0 * g["b.density"][0]]
    exact += [np.sum(g[f"initial.{name}"][0] * values) for name, values in d.items()]
    errors = best_differences(loss.numpy(), exact)
    assert (errors < TOLERANCE).all(), errors


def test_restarted_accelerations():
    """A drive with a kink within a step: velocities jump and accelerations restart at its end."""
    rows, scale = shifts(3), np.array([1e6, 1000.0])
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    box = b.add_solid(wf.mesh.box((0.1, 0.02, 0.02), cells=(2, 1, 1), element="T4"), material=LAW, name="box")
    b.drive(box.nodes("x-"), displacement=([0, 3e-3, 1], [(0, 0, 0), (0, 0, 0), (0, 0, 1.0)]))
    b.add_probe("tip", box.surface("x+"))
    m = b.finalize(device="cpu", worlds=len(rows), many=False)
    for name, value, of in zip(("box.E", "box.density"), scale, rows.T):
        m.set_parameter(name, value * (1.0 + of))
    m.set_gravity(GRAVITY * (1.0 + rows[:, 2:]))
    sim = wf.Simulation(m, dt=2e-3, integrator="generalized_alpha", solver=SOLVER)
    tape = wf.Adjoint(sim, ["box.E", "box.density", "gravity"])
    tape.run(4)
    assert list(tape.restarts) == [0, 2]
    assert tape.probe("tip").velocity.numpy() == pytest.approx(sim.probe("tip").velocity, rel=1e-12, abs=1e-15)
    loss = wf.loss.sum_of_squares(tape.probe("tip").velocity, np.full((4, 3), TARGET))
    g = {name: array.numpy()[0] for name, array in tape.backward(loss).items()}
    exact = [*(scale * (g["box.E"], g["box.density"])), g["gravity"] @ GRAVITY]
    errors = best_differences(loss.numpy(), exact)
    assert (errors < TOLERANCE).all(), errors


FORWARD = [("followers", "backward_euler"), ("drives", "bdf2"), ("loads", "energy_momentum")]


@pytest.mark.parametrize(
    ("kind", "scheme"), [pytest.param(*case, marks=[pytest.mark.slow] * (case[1] != "bdf2")) for case in FORWARD]
)
def test_forward_sensitivities_are_the_transpose(kind, scheme):
    """<w, J v> = <J^T w, v>; J v beside differences along v."""
    steps, rng, law = 5, np.random.default_rng(5), models.material(form="rate" if kind == "drives" else "incremental")
    given = controls(kind, steps)
    given.pop("turn", None)
    given.pop("rod", None)
    names = ["a.E", "b.eta", "b.density", "gravity", "initial.velocity", "initial.displacement", *given]
    for tol, most in ((1e-14, 1e-12), (1e-10, 1e-8)):
        m = linked(kind, 2, law=law)
        sim = wf.Simulation(m, dt=2e-3, integrator=scheme, solver=SOLVER, constraint_tol=1e-12)
        tape = wf.Adjoint(sim, names, tol=tol)
        for step in range(steps):
            for name, values in given.items():
                sim.controls[name][:] = values[step]
            tape.run(1)
        p = tape.probe("tip")
        bars = [rng.standard_normal(array.shape) for array in p.arrays]
        for array, values in zip(p.arrays, bars):
            array.grad.assign(values)
        g = {name: array.numpy().copy() for name, array in tape.backward().items()}
        v = {name: rng.standard_normal(g[name].shape) / np.abs(g[name]).max() for name in g}
        change = tape.forward(v)["tip"]
        left = sum(np.sum(w * array.numpy(), axis=(1, 2)) for w, array in zip(bars, change.arrays))
        right = sum(np.sum((g[name] * v[name]).reshape(2, -1), axis=1) for name in g)
        size = sum(np.sum(np.abs(g[name] * v[name]).reshape(2, -1), axis=1) for name in g)
        assert (np.abs(left - right) < most * size).all(), (left, right, size)
        assert (np.abs(right) > 1e-3 * size).all()
    with pytest.raises(wf.ModelError, match=r"'box.E' is none of the tape's"):
        tape.forward({"box.E": 1.0})
    for change, match in (({"gravity": [1.0, 2.0]}, r"shape \(2,\), not \(2, 3\)"), ({"a.E": np.nan}, "finite")):
        with pytest.raises(wf.ModelError, match=match):
            tape.forward(change)


@pytest.mark.cuda
def test_gradients_on_a_gpu():
    """Those of the CPU, in worlds with motors of their own."""
    found = []
    for device in ("cpu", "cuda:0"):
        sim = wf.Simulation(linked("motor", 3, device), dt=2e-3, solver=SOLVER, constraint_tol=1e-12)
        tape = wf.Adjoint(sim, ["a.E", "b.density", "gravity", "motor", "initial.velocity"])
        for step in range(6):
            sim.controls["motor"][:] = 0.05 * step * np.arange(1, 4)
            tape.run(1)
        loss = wf.loss.sum_of_squares(tape.probe("tip"), np.full((6, 3), TARGET))
        found.append({name: array.numpy() for name, array in tape.backward(loss).items()})
    for name, values in found[0].items():
        assert found[1][name] == pytest.approx(values, rel=1e-7, abs=1e-8 * np.abs(values).max()), name


def falling():
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    box = b.add_solid(wf.mesh.box((0.1, 0.02, 0.02), cells=(2, 1, 1), element="T4"), material=LAW, name="box")
    b.add_probe("tip", box.surface("x+"))
    return b.finalize(device="cpu")


@pytest.mark.slow
def test_free_fall_with_steps_of_their_own_sizes():
    adaptive = wf.Simulation(falling(), dt="auto", error=1e-4, interval=4e-3, solver=SOLVER)
    parts = wf.Adjoint(adaptive, ["gravity"])
    parts.run(3)
    h = np.array([part["dt"].numpy()[0] for part in parts.kept[:-1]])
    assert len(h) > 3
    assert h.sum() == pytest.approx(adaptive.time[0], rel=1e-13)
    parts.probe("tip").displacement.grad.assign([[[0, 0, 0], [0, 0, 0], [0, 0, 1.0]]])
    assert parts.backward()["gravity"].numpy()[0, 2] == pytest.approx(h @ np.cumsum(h), rel=1e-12)


def test_free_fall():
    """d(x)/d(g, v0, q0) of the scheme, with two sizes of steps: x = q0 + sum h (v0 + g t)."""
    sim = wf.Simulation(falling(), dt=2e-3, solver=SOLVER)
    tape = wf.Adjoint(sim, ["gravity", "initial.velocity", "initial.displacement", "box.density"])
    tape.run(10)
    sim.dt = 1e-3
    tape.run(15)
    h = np.repeat([2e-3, 1e-3], [10, 15])
    n, t = len(h), np.cumsum(h)
    p = tape.probe("tip")
    assert p.displacement.numpy() == pytest.approx(sim.probe("tip").displacement, rel=1e-13)
    assert p.position.numpy() == pytest.approx(sim.probe("tip").position, rel=1e-13)
    grad = np.zeros((1, n, 3))
    grad[0, -1, 2] = 1.0
    p.position.grad.assign(grad)
    g = {name: array.numpy() for name, array in tape.backward().items()}
    assert g["gravity"][0] == pytest.approx([0, 0, h @ t], rel=1e-12, abs=1e-15)
    assert g["initial.velocity"][0].sum(axis=0) == pytest.approx([0, 0, t[-1]], rel=1e-12, abs=1e-13)
    assert g["initial.displacement"][0].sum(axis=0) == pytest.approx([0, 0, 1], rel=1e-12, abs=1e-12)
    assert g["box.density"] == pytest.approx(0.0, abs=1e-15)
    velocity = np.zeros((1, n, 3))
    velocity[0, -1, 2] = 1.0
    p.position.grad.zero_()
    p.velocity.grad.assign(velocity)
    assert tape.backward()["gravity"].numpy()[0, 2] == pytest.approx(t[-1], rel=1e-12)


def test_equilibrium():
    """A cantilever of small deflection: it is proportional to load / E."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    beam = b.add_beam([(0, 0, 0), (0.1, 0, 0)], elements=3, section=wf.Rectangle(0.01, 0.02), normal=(0, 0, 1),
                      material=LAW, name="beam")  # fmt: skip
    b.clamp(beam.start, slots="all")
    b.add_point_load(beam.end, force=wf.Control("P", 3, initial=(0, 0, 1e-5)))
    b.add_probe("tip", beam.end)
    result = wf.solve_static(b.finalize(device="cpu", worlds=2), load_steps=1, tol=1e-12)
    tape = wf.Adjoint(result, ["beam.E", "P"])
    p = tape.probe("tip")
    tip = p.displacement.numpy()[:, 0, 2]
    assert tip == pytest.approx(result.probe("tip").displacement[:, -1, 2], rel=1e-13)
    p.displacement.grad.assign(np.array([[[0, 0, 1.0]], [[0, 0, 2.0]]]))
    g = tape.backward()
    assert g["beam.E"].numpy() == pytest.approx(-tip / 1e6 * [1, 2], rel=1e-6)
    assert g["P"].numpy()[:, 2] == pytest.approx(tip / 1e-5 * [1, 2], rel=1e-6)
    assert g["P"].shape == (2, 3)
    with pytest.raises(wf.ModelError, match="no steps"):
        tape.run(1)


def test_frequency_by_the_modulus():
    """d ln f / d ln E = 1/2 by `wf.modes`."""
    factors, found = 1.0 + 1e-2 * np.array([-2.0, -1.0, 1.0, 2.0]), []
    for factor in factors:
        m = bar(lambda b, box: b.clamp(box.nodes("x-")), law=wf.SVK(E=1e6 * factor, nu=0.3, density=1000.0))
        found.append(np.log(wf.modes(m, count=2).frequencies))
    rate = np.array([1.0, -8.0, 8.0, -1.0]) @ np.array(found) / 12e-2
    assert rate == pytest.approx(0.5, rel=1e-6)


@wp.kernel
def swirl_force(scale: wp.float64, x: wp.array2d[wp.vec3d], active: wp.array[wp.int32], out: wp.array2d[wp.vec3d]):
    """scale (z x x) of all slots."""
    world, slot = wp.tid()
    if active[world] != 0:
        out[world, slot] = scale * wp.cross(wp.vec3d(0.0, 0.0, 1.0), x[world, slot])


class Swirl(Differentiable):
    """Forces across the displacements, with a skew tangent that H leaves out."""

    name = "swirl"
    potential = False
    stiffness = 40.0

    def build(self, laws):
        self.connectivity = [np.arange(self.model.slots)[:, None]]

    def modules(self, ctx):
        return {swirl_force.module}

    def force(self, ctx, active):
        args = [self.stiffness, ctx.work.u, active, ctx.work.nonpotential_contribution]
        ctx.launch(swirl_force, (self.model.worlds, self.model.slots), args)

    def exact_product(self, ctx, p, active, *, transposed, start=False):
        args = [-self.stiffness if transposed else self.stiffness, p, active, ctx.work.nonpotential_tangent]
        ctx.launch(swirl_force, (self.model.worlds, self.model.slots), args)

    def is_symmetric(self, ctx):
        return False


class SmoothFloor(floor_term.Floor, Differentiable):
    """Without slip: a linear spring under the nodes that stay in contact."""


def resting(term, worlds=1, **options):
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element="T4")
    box = b.add_solid(mesh, transform=(np.eye(3), (0, 0, -0.01)), material=LAW, name="box")
    b.add_probe("top", box.surface("z+"))
    b.add_term(lambda m: term(m, kt=0.0))
    m = b.finalize(device="cpu", worlds=worlds)
    return m, wf.Simulation(m, dt=1e-3, solver=SOLVER, **options)


def test_a_term_says_whether_it_is_differentiable():
    _, sim = resting(floor_term.Floor)
    with pytest.raises(wf.ModelError, match="'floor' has no adjoint"):
        wf.Adjoint(sim, "gravity")
    rows = shifts(1)
    m, sim = resting(SmoothFloor, len(rows))
    check_gravity(m, sim, rows, 5)


def check_gravity(m, sim, rows, steps):
    m.set_gravity(GRAVITY * [0, 0, 1] * (1.0 + rows))
    tape = wf.Adjoint(sim, "gravity")
    tape.run(steps)
    loss = wf.loss.sum_of_squares(tape.probe("top"), np.full((steps, 3), TARGET))
    exact = [tape.backward(loss)["gravity"].numpy()[0, 2] * GRAVITY[2]]
    errors = best_differences(loss.numpy(), exact)
    assert (errors < TOLERANCE).all(), errors
    assert (tape.residual < 1e-10).all()
    return tape


@wp.func
def whirl(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """A field across and along the position, that grows with it."""
    return wp.float64(900.0) * wp.vec3d(x[1] + x[2] * x[2], wp.sin(x[0]), wp.float64(2.0) * t - x[1] * x[2])


@pytest.mark.parametrize("scheme", ["bdf2", pytest.param("energy_momentum", marks=pytest.mark.slow)])
def test_a_field_of_forces(scheme):
    rows = shifts(1)
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    box = b.add_solid(wf.mesh.box((0.1, 0.02, 0.02), cells=(2, 1, 1), element="T4"), material=LAW, name="box")
    b.clamp(box.nodes("x-"))
    b.add_body_force(whirl)
    b.add_probe("top", box.surface("x+"))
    m = b.finalize(device="cpu", worlds=len(rows), many=False)
    sim = wf.Simulation(m, dt=2e-3, integrator=scheme, solver=SOLVER)
    tape = check_gravity(m, sim, rows, 10)
    change = tape.forward({"gravity": [0.0, 0.0, 1.0]})["top"].displacement.numpy()[0]
    bars = tape.probe("top").displacement.grad.numpy()[0]
    assert np.sum(bars * change) == pytest.approx(tape.backward()["gravity"].numpy()[0, 2], rel=1e-8)


def test_an_unsymmetric_term_is_solved_with_its_transpose():
    rows = shifts(1)
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    box = b.add_solid(wf.mesh.box((0.1, 0.02, 0.02), cells=(3, 1, 1), element="T4"), material=LAW, name="box")
    b.clamp(box.nodes("x-"))
    b.add_probe("top", box.surface("x+"))
    b.add_term(Swirl)
    m = b.finalize(device="cpu", worlds=len(rows))
    check_gravity(m, wf.Simulation(m, dt=2e-3, solver=SOLVER), rows, 10)


def test_density_under_gravity_over_time():
    """Statics: the deflection, proportional to the load, depends on density / E alone."""

    def hang(b, box):
        b.clamp(box.nodes("x-"))

    m = bar(hang, law=wf.SVK(E=1e9, nu=0.3, density=1000.0), gravity=([0, 1], [(0, 0, 0), (0, 0, -0.1)]))
    tape = wf.Adjoint(wf.solve_static(m, load_steps=2, tol=1e-12), ["box.E", "box.density"])
    g = tape.backward(wf.loss.sum_of_squares(tape.probe("tip"), np.full((1, 3), TARGET)))
    assert g["box.density"].numpy() * 1000.0 == pytest.approx(-g["box.E"].numpy() * 1e9, rel=1e-6)
