"""wf.Adjoint: what is refused, steps that are halved, worlds that fail, models without gradients, names of loads."""

from types import SimpleNamespace

import numpy as np
import parameter_models as models
import pytest
import warp as wp
from gradient_models import LAW, SOLVER, TARGET, bar, best_differences, linked, shifts

import warpfea as wf
from warpfea.simulation.adjoint import check_simulation, check_terms
from warpfea.simulation.integrators import INTEGRATORS

TOLERANCE = 1e-7
GRAVITY = np.array([0.0, 3.0, -9.81])


def test_terms_and_schemes_without_an_adjoint_are_refused_by_name():
    ctx = SimpleNamespace(inertia=True)
    damped = bar(law=models.material(form="explicit"))
    with pytest.raises(wf.ModelError, match="damping of the form 'explicit'"):
        check_terms(damped, ctx)
    check_terms(damped, SimpleNamespace(inertia=False))  # no rates in statics
    fixed = SimpleNamespace(step_size_control=None)
    sim = {"integrator": INTEGRATORS["backward_euler"], "stepper": fixed, "t_end": None}
    sim |= {"model": SimpleNamespace(dtype="float64")}
    check_simulation(SimpleNamespace(**sim), False)
    tables = SimpleNamespace(formulas=["gear"], has_velocity_rows=False)
    terms = SimpleNamespace(having=lambda protocol: [SimpleNamespace(tables=tables)])
    formula = SimpleNamespace(dtype="float64", terms=terms)
    for change, match in {
        "no adjoint with formulas": {"integrator": INTEGRATORS["generalized_alpha"], "model": formula},
        "result of solve_static": {"integrator": INTEGRATORS["static"]},
        "float32": {"model": SimpleNamespace(dtype="float32")},
    }.items():
        with pytest.raises(wf.ModelError, match=change):
            check_simulation(SimpleNamespace(**(sim | match)), False)


def test_misuse_is_refused():
    m = bar()
    sim = wf.Simulation(m, dt=1e-3)
    with pytest.raises(wf.ModelError, match=r"'box.F' has no derivative; .*box.E"):
        wf.Adjoint(sim, "box.F")
    tape = wf.Adjoint(sim, "gravity")
    with pytest.raises(wf.ModelError, match="no step"):
        tape.backward()
    tape.run(2)
    with pytest.raises(wf.ModelError, match="no probe was taken"):
        tape.backward()
    loss = wf.loss.sum_of_squares(tape.probe("tip"), np.zeros((2, 3)))
    tape.run(1)
    with pytest.raises(wf.ModelError, match="no probe was taken since the last step"):
        tape.backward(loss)
    tape.probe("tip")
    with pytest.raises(wf.ModelError, match="not of this tape's probes"):
        tape.backward(loss)
    sim.state.velocity.fill_(0.1)
    with pytest.raises(wf.ModelError, match="the state was set"):
        tape.run(1)
    other = wf.Adjoint(wf.Simulation(m, dt=1e-3), "gravity")
    other.run(3)
    with pytest.raises(wf.ModelError, match="not of this tape's probes"):
        tape.backward(wf.loss.sum_of_squares(other.probe("tip"), np.zeros((3, 3))))
    for loss in (3.0, np.zeros(1), wp.zeros(1)):
        with pytest.raises(wf.ModelError, match=r"a loss is one of wf\.loss"):
            tape.backward(loss)
    tape.probe("tip").velocity.grad.fill_(np.nan)
    with pytest.raises(wf.ConvergenceError, match="not finite"):
        tape.backward()
    for change, match in (
        ({"sim": m}, "got Model"), ({"with_respect_to": []}, "no parameter"), ({"tol": 0}, "tol = 0 must"),
        ({"budget": -1}, "budget = -1 must"), ({"with_respect_to": "mesh.x"}, "did you mean 'mesh.X'"),
    ):  # fmt: skip
        with pytest.raises(wf.ModelError, match=match):
            wf.Adjoint(**({"sim": sim, "with_respect_to": "gravity"} | change))
    for steps in (0, -1, 2.5):
        with pytest.raises(wf.ModelError, match="whole number"):
            tape.run(steps)
    with pytest.raises(wf.ModelError, match="got str"):
        wf.loss.sum_of_squares("tip", np.zeros((3, 3)))
    with pytest.raises(wf.ModelError, match="shape"):
        wf.loss.sum_of_squares(tape.probe("tip"), np.zeros((2, 3)))
    with pytest.raises(wf.ModelError, match="there are: 'tip'"):
        tape.probe("tap")
    with pytest.raises(wf.CapacityError, match=r"3 steps of .* of 1.0 kB; with budget="):
        wf.Adjoint(sim, "gravity", budget=1000).run(3)
    with pytest.raises(wf.ModelError, match="folder"):
        wf.Adjoint(sim, "gravity", folder="no such folder")
    m.set_gravity((0, 0, 1.0))
    with pytest.raises(wf.ModelError, match="parameters were set"):
        tape.backward()
    sim.reset()
    tape.run(1)
    assert tape.steps == 1


def halving(rows, worlds=slice(None)):
    """Tape of worlds that halve their steps, for lack of iterations; all but the last."""
    m = models.model(models.solid("T4"), models.material(), len(rows[worlds]))
    m.many = False
    m.set_parameter("body.E", 1e6 * (1.0 + rows[worlds, 0]))
    m.set_gravity(10.0 * GRAVITY * (1.0 + rows[worlds, 1:2]))
    solver = wf.NewtonPCG(tol=1e-12, max_newton=1)
    sim = wf.Simulation(m, dt=2e-2, solver=solver)
    tape = wf.Adjoint(sim, ["body.E", "gravity"])
    tape.run(4)
    loss = wf.loss.sum_of_squares(tape.probe("tip"), np.full((4, 3), TARGET))
    return tape, loss, {name: array.numpy() for name, array in tape.backward(loss).items()}


def test_halved_steps_are_differentiated_part_by_part():
    rows = np.concatenate([shifts(2), [[0.0, -0.99]]])
    tape, loss, g = halving(rows)
    assert len(tape.kept) - 1 > tape.steps
    took = np.array([part["status"].numpy() == 0 for part in tape.kept[:-1]])
    assert took.sum(axis=0)[-1] == tape.steps < took.sum(axis=0)[0]
    exact = [1e6 * g["body.E"][0], g["gravity"][0] @ (10.0 * GRAVITY)]
    errors = best_differences(loss.numpy()[:-1], exact)
    assert (errors < TOLERANCE).all(), errors
    for world in (0, len(rows) - 1):
        _, _, alone = halving(rows, slice(world, world + 1))
        assert all(np.array_equal(alone[name][0], g[name][world]) for name in g)


def test_worlds_end_at_their_own_times():
    """The last step of all but one world is a half; their probes stay, and so do their derivatives."""
    rows = np.concatenate([shifts(1), [[0.0]]])
    m = linked("motor", len(rows))
    m.set_gravity(GRAVITY * (1.0 + rows))
    ends = np.where(np.arange(len(rows)) < len(rows) - 1, 5e-3, 1.0)
    sim = wf.Simulation(m, dt=2e-3, t_end=ends, solver=SOLVER, constraint_tol=1e-12)
    tape = wf.Adjoint(sim, ["gravity"])
    tape.run(4)
    assert sim.time[-2:] == pytest.approx([5e-3, 8e-3], rel=1e-12)
    loss = wf.loss.sum_of_squares(tape.probe("tip").displacement, np.full((1, 4, 3), TARGET))
    exact = [tape.backward(loss)["gravity"].numpy()[0] @ GRAVITY]
    errors = best_differences(loss.numpy()[:-1], exact)
    assert (errors < TOLERANCE).all(), errors


def test_failed_worlds():
    """A world that fails in a step, and one that is frozen, have NaN; the other has the bits of a run alone."""
    found = []
    for gravity in ([-9.81, -9.81, -1e7], [-9.81]):
        m = linked("motor", len(gravity))
        m.set_gravity(np.outer(gravity, [0, 0, 1.0]))
        sim = wf.Simulation(m, dt=2e-3, on_failure="freeze")
        tape = wf.Adjoint(sim, ["a.E", "motor"])
        tape.run(2)
        sim.freeze([1] if len(gravity) > 1 else [])
        loss = wf.loss.sum_of_squares(tape.probe("tip"), np.full((2, 3), TARGET))
        found.append({name: array.numpy() for name, array in tape.backward(loss).items()})
        assert (sim.time > 0.0).tolist() == [True, True, False][: len(gravity)]
    for name, values in found[0].items():
        assert np.array_equal(values[0], found[1][name][0])
        assert np.isfinite(values[0]).all()
        assert np.isnan(values[1:]).all()


def test_a_run_without_gradients_has_nothing_of_them():
    m = models.model(models.solid("T4"), models.material())
    sim = wf.Simulation(m, dt=2e-3)
    sim.step(2)
    names = {*sim.stepper.launch.modules, *(module.name for module in sim.stepper.modules()), *sim.bytes()}
    assert not any("adjoint" in name or "history_gradient" in name for name in names)
    before = [array.numpy().tobytes() for array in (sim.state.displacement, sim.state.velocity)]
    other = wf.Simulation(m, dt=2e-3)
    tape = wf.Adjoint(other, "body.E")
    tape.run(2)
    tape.backward(wf.loss.sum_of_squares(tape.probe("tip"), np.zeros((2, 3))))
    assert before == [array.numpy().tobytes() for array in (other.state.displacement, other.state.velocity)]
    assert "adjoint w" in tape.stepper.work.bytes
    assert isinstance(tape.probe("tip").velocity.grad, wp.array)
    graph = tape._graph  # one for all steps
    again = [tape.backward()["body.E"].numpy() for _ in range(2)]
    assert np.array_equal(*again)
    assert tape._graph is graph
    tape.growth = np.array([1e8])
    with pytest.warns(wf.ModelWarning, match=r"the gradient grows by 1e\+08 over 2 steps"):
        tape._check_result()


@wp.kernel(module="unique")
def add_cubes(values: wp.array3d(dtype=wp.float64), loss: wp.array(dtype=wp.float64)):
    world, step, i = wp.tid()
    wp.atomic_add(loss, world, values[world, step, i] ** wp.float64(3.0))


def test_a_loss_by_a_kernel():
    """Its derivatives come by Warp's tape; of the velocities here."""
    tape = wf.Adjoint(wf.Simulation(linked("motor", 3), dt=2e-3), ["gravity", "motor"])
    tape.run(2)
    v, loss = tape.probe("tip").velocity, wp.zeros(3, dtype=wp.float64, device="cpu", requires_grad=True)
    with wp.Tape() as recorded:
        wp.launch(add_cubes, v.shape, [v, loss], device="cpu")
    recorded.backward(grads={loss: wp.ones(3, dtype=wp.float64, device="cpu")})
    found = [array.numpy() for array in tape.backward().values()]
    v.grad.assign(3.0 * v.numpy() ** 2)
    for values, array in zip(found, tape.backward().values()):
        assert np.abs(values).max() > 0.0
        assert values == pytest.approx(array.numpy(), rel=1e-12)


def test_loads_and_drives_by_name():
    """Of constants and samples it is the sum of those of a control of the same values over the steps."""
    sizes, steps = {"t": 3, "P": 3, "p": 1, "m": 3, "d": 3}, 3

    def gradients(value):
        b = wf.ModelBuilder(gravity=(0, 0, -9.81))
        box = b.add_solid(wf.mesh.box((0.1, 0.02, 0.02), cells=(2, 1, 1), element="T4"), material=LAW, name="box")
        b.drive(box.nodes("x-"), displacement=value("d", (0, 0, 0)), name="d")
        b.add_traction(box.surface("x+"), value("t", (0, 10.0, 30.0)), name="t")
        b.add_point_load(box.at((0.1, 0.02, 0.02)), value("P", (0, 0, -0.01)), name="P")
        b.add_pressure(box.surface("z+"), value("p", 20.0), name="p")
        b.add_moment(box.at((0.05, 0.01, 0.01)), value("m", (0, 1e-4, 0)), name="m")
        b.add_probe("tip", box.surface("x+"))
        tape = wf.Adjoint(wf.Simulation(b.finalize(device="cpu"), dt=2e-3, solver=SOLVER), list(sizes))
        tape.run(steps)
        g = tape.backward(wf.loss.sum_of_squares(tape.probe("tip"), np.full((steps, 3), TARGET)))
        return {name: array.numpy()[0] for name, array in g.items()}

    named = gradients(lambda name, value: ([0.0, 1.0], [value, value]) if name == "t" else value)
    controlled = gradients(lambda name, value: wf.Control(name, sizes[name], value))
    for name, size in sizes.items():
        assert named[name].shape == (3,) * (size == 3)
        assert np.abs(named[name]).max() > 0.0
        expected = controlled[name].sum(axis=0)
        assert named[name] == pytest.approx(expected if size == 3 else expected[0], rel=1e-9, abs=1e-20), name
