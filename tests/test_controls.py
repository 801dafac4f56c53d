"""Controls: time laws whose values a caller writes between steps, in each world its own."""

import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea.terms.term import Term

H = 1.0 / 128.0  # exact in binary, so that the samples of a law are met exactly
JOINT_VALUES = np.array([0.25, 0.75, -0.5, 0.125])
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
RUBBER = wf.SVK(E=1e6, nu=0.3, density=1000.0)


def bar():
    b = wf.ModelBuilder()
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=RUBBER, name="bar")
    b.clamp(body.nodes("x-"))
    b.add_probe("tip", body.surface("x+"))
    return b, body


def steps_as_samples(values):
    """Samples that are constant over each step: value k from just after t = k H to (k + 1) H."""
    values = np.asarray(values, dtype=float)
    times, out = [0.0], [np.zeros_like(values[0])]
    for k, value in enumerate(values):
        times += [(k + 0.125) * H, (k + 1) * H]
        out += [value, value]
    return times, np.array(out)


def add_load(b, body, law):
    b.add_point_load(body.at((1, 0.1, 0.1)), law)


def add_pressure(b, body, law):
    b.add_pressure(body.surface("x+"), law)


def add_moving(b, body, law):
    b.drive(body.nodes("x+"), displacement=law)


def add_turning(b, body, law):
    b.drive(body.nodes("x+"), rotation=wf.Rotation((1, 0.1, 0.1), (1, 0, 0), law))


def add_rod(b, body, law):
    b.add_joint("translational", parent=wf.GROUND, child=body.surface("x+"), axis=(1, 0, 0), drive=law, name="rod")


KINDS = {
    "load": (add_load, 3, (10.0, 0.0, -20.0)),
    "pressure": (add_pressure, 1, 5e2),
    "displacement": (add_moving, 3, (1e-2, 0.0, 5e-3)),
    "rotation": (add_turning, 1, 0.1),
    "joint": (add_rod, 1, 1e-3),
}


def simulation(kind, law, worlds=1, dtype="float64", device="cpu", **options):
    b, body = bar()
    KINDS[kind][0](b, body, law)
    model = b.finalize(device=device, dtype=dtype, worlds=worlds)
    return wf.Simulation(model, dt=H, **options)


def paths(kind, worlds=4, steps=4):
    """(steps, worlds, size): no world is driven as another."""
    scale = np.atleast_1d(KINDS[kind][2])
    shape = JOINT_VALUES[:steps, None] * np.linspace(1.0, -0.5, worlds)
    return shape[:, :, None] * scale


def assert_worlds_equal_single_runs(kind, dtype="float64", **options):
    path = paths(kind)
    size = KINDS[kind][1]
    together = simulation(kind, wf.Control("c", size), worlds=4, dtype=dtype, **options)
    for values in path:
        together.controls["c"][:] = values
        together.step()
    for world in range(4):
        values = path[:, world] if size == 3 else path[:, world, 0]
        alone = simulation(kind, steps_as_samples(values), dtype=dtype, **options)
        alone.step(4)
        assert np.abs(alone.state.displacement.numpy()).max() > 1e-6
        for name in ("displacement", "velocity", "ledger", "time"):
            a, b = getattr(alone.state, name).numpy()[0], getattr(together.state, name).numpy()[world]
            assert np.array_equal(a, b), (kind, world, name)
        if kind == "joint":
            assert np.array_equal(alone.joint_force("rod")[0], together.joint_force("rod")[world])


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("device", DEVICES)
def test_worlds_driven_differently_equal_single_runs_bit_for_bit(device, kind):
    assert_worlds_equal_single_runs(kind, device=device)


@pytest.mark.parametrize("kind", ["displacement", "joint", "pressure"])
@pytest.mark.parametrize("device", DEVICES)
def test_worlds_equal_single_runs_in_bdf2(device, kind):
    assert_worlds_equal_single_runs(kind, integrator="bdf2", device=device)


@pytest.mark.parametrize("kind", ["rotation", "joint", "load"])
@pytest.mark.parametrize("device", DEVICES)
def test_worlds_equal_single_runs_in_float32(device, kind):
    assert_worlds_equal_single_runs(kind, dtype="float32", device=device)


def test_driven_nodes_and_joints_are_where_the_control_says():
    b, body = bar()
    b.drive(body.nodes("x+"), displacement=wf.Control("jaw", 3))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=H)
    for value in ((0.01, 0.0, 0.0), (0.01, 0.02, 0.0), (-0.01, 0.0, 0.003)):
        sim.controls["jaw"][:] = value
        sim.step()
        assert sim.displacements(body)[0, body.nodes("x+").indices] == pytest.approx(
            np.tile(value, (len(body.nodes("x+")), 1)), abs=1e-15
        )
    rod = simulation("joint", wf.Control("c"))
    rod.controls["c"][:] = 2e-3
    rod.step(2)
    assert rod.joint_value("rod")[0] == pytest.approx(2e-3, abs=1e-8)
    rod.controls["c"][:] = 1e-3  # acts in the next step; until then results are those of the last
    assert rod.violation("rod")[0] <= 1e-8 * rod.model.size
    assert rod.joint_value("rod")[0] == pytest.approx(2e-3, abs=1e-8)
    rod.step()
    assert rod.joint_value("rod")[0] == pytest.approx(1e-3, abs=1e-8)


def test_a_motor_counts_its_turns():
    b = wf.ModelBuilder()
    arm = b.add_beam([(0, 0, 0), (0.3, 0, 0)], elements=1, section=wf.Rectangle(0.02, 0.02), normal=(0, 0, 1),
                     material=wf.SVK(E=2e9, nu=0.3, density=1100.0))  # fmt: skip
    b.add_joint("revolute", parent=wf.GROUND, child=arm.start, axis=(0, 1, 0), drive=wf.Control("motor"), name="motor")
    sim = wf.Simulation(b.finalize(device="cpu", worlds=2), dt=5e-2)
    for angle in 0.5 * np.arange(1, 16):
        sim.controls["motor"][:, 0] = (angle, -angle)
        assert sim.step().converged.all()
    assert sim.joint_value("motor") == pytest.approx([7.5, -7.5], abs=1e-7)


def test_one_control_may_drive_several_things():
    b, body = bar()
    other = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=RUBBER, transform=(np.eye(3), (0, 1, 0)))
    b.clamp(other.nodes("x-"))
    grip = wf.Control("grip", 3)
    for one in (body, other):
        b.drive(one.nodes("x+"), displacement=wf.Control("grip", 3))
        b.add_traction(one.surface("z+"), grip)
    model = b.finalize(device="cpu")
    assert model.terms.time_laws.count == 1
    sim = wf.Simulation(model, dt=H)
    sim.controls["grip"][:] = (0.01, 0.0, 0.02)
    sim.step(2)
    assert np.abs(sim.displacements(body) - sim.displacements(other)).max() < 1e-12
    assert np.abs(sim.displacements(body)).max() > 0.01


def test_statics_take_a_control_as_a_constant():
    for kind in ("load", "pressure", "displacement"):
        add, size, value = KINDS[kind]
        results = []
        for law in (value, wf.Control("c", size)):
            b, body = bar()
            add(b, body, law)
            model = b.finalize(device="cpu")
            state = model.state()
            if isinstance(law, wf.Control):
                state.control_c.assign(np.atleast_2d(value))
            r = wf.solve_static(model, load_steps=2, state=state)
            results.append((r.displacements(body), r.probe("tip").displacement))
        for a, c in zip(*results):
            assert np.array_equal(a, c)


def test_statics_do_not_ramp_the_length_of_a_rod():
    lengths = {}
    for law in (0.48, wf.Control("length", initial=0.48)):
        b, body = bar()
        b.add_joint("distance", parent=wf.GROUND, child=body.at((1, 0.1, 0.1)), anchor=(1.5, 0.1, 0.1), drive=law,
                    name="rod")  # fmt: skip
        r = wf.solve_static(b.finalize(device="cpu"), load_steps=2)
        lengths[type(law)] = r.displacements(body), r.simulation.joint_value("rod")[0]
    (a, first), (c, second) = lengths.values()
    assert np.array_equal(a, c)
    assert first == second == pytest.approx(0.48, abs=1e-7)


def test_a_dynamic_run_goes_on_with_the_controls_of_an_equilibrium():
    b, body = bar()
    add_load(b, body, wf.Control("force", 3, initial=(0, 0, -5.0)))
    model = b.finalize(device="cpu")
    static = wf.solve_static(model, load_steps=1, tol=1e-10)
    sim = wf.Simulation(model, static.state, dt=H)
    rest = static.displacements(body)
    sim.step(3)
    assert np.abs(sim.displacements(body) - rest).max() < 1e-7 * np.abs(rest).max()


def test_a_state_without_the_controls_gets_their_initial_values():
    start = simulation("load", (0.0, 0.0, 0.0)).state
    b, body = bar()
    add_load(b, body, wf.Control("c", 3, initial=(0, 0, -5.0)))
    sim = wf.Simulation(b.finalize(device="cpu"), start, dt=H)
    assert np.array_equal(sim.controls["c"], [(0, 0, -5)])
    assert sim.state is start
    sim.step()
    assert sim.probe("tip").displacement[0, -1, 2] < 0.0


def test_reset_goes_back_to_the_initial_value_in_the_chosen_worlds():
    sim = simulation("load", wf.Control("c", 3, initial=(1.0, 2.0, 3.0)), worlds=3)
    assert np.array_equal(sim.controls["c"], np.tile((1.0, 2.0, 3.0), (3, 1)))
    sim.controls["c"][:] = 7.0
    sim.step()
    sim.reset([True, False, True])
    assert np.array_equal(sim.controls["c"], [(1, 2, 3), (7, 7, 7), (1, 2, 3)])
    again = simulation("load", wf.Control("c", 3, initial=(1.0, 2.0, 3.0)), worlds=3)
    sim.step()
    again.step()
    assert np.array_equal(sim.state.displacement.numpy()[0], again.state.displacement.numpy()[0])


def test_reset_of_a_driven_joint():
    sim = simulation("joint", wf.Control("c"), worlds=2)
    sim.controls["c"][:] = 1e-3
    sim.step(2)
    sim.reset([True, False])
    assert np.array_equal(sim.controls["c"], [[0.0], [1e-3]])
    assert sim.step().converged.all()
    assert sim.joint_value("rod") == pytest.approx([0.0, 1e-3], abs=1e-8)


@pytest.mark.parametrize("device", DEVICES)
def test_a_checkpoint_holds_controls(tmp_path, device):
    def run(sim, values):
        for value in values:
            sim.controls["c"][:, 0] = (value, -value)
            sim.step()

    path = 1e-3 * np.array([0.5, 1.0, 1.0, 0.3])
    whole = simulation("joint", wf.Control("c"), worlds=2, device=device)
    run(whole, path)
    whole.step(2)
    part = simulation("joint", wf.Control("c"), worlds=2, device=device)
    run(part, path)
    part.run(t_end=5 * H, outputs=[wf.Checkpoint(tmp_path / "c.npz")])
    rest = simulation("joint", wf.Control("c"), worlds=2, device=device)
    rest.resume(tmp_path / "c.npz")
    assert np.array_equal(rest.controls["c"], [[path[-1]], [-path[-1]]])
    rest.step()
    for name in whole.state.names:
        assert np.array_equal(getattr(whole.state, name).numpy(), getattr(rest.state, name).numpy(), equal_nan=True)

    for law in (0.0, wf.Control("d"), wf.Control("c", initial=1e-3)):
        b, body = bar()
        add_rod(b, body, law)
        model = b.finalize(device=device, worlds=2)
        assert model.fingerprint() != whole.model.fingerprint()
    with pytest.raises(wf.CheckpointError, match="another model"):
        simulation("joint", 0.0, worlds=2, device=device).resume(tmp_path / "c.npz")


def test_a_refused_step_keeps_what_was_written():
    b, body = bar()
    b.drive(body.nodes("x+"), displacement=wf.Control("jaw", 3))
    sim = wf.Simulation(b.finalize(device="cpu", worlds=2), dt=H, solver=wf.NewtonPCG(max_halvings=2))
    sim.controls["jaw"][:] = [(0.01, 0, 0), (-1.5, 0, 0)]  # the second turns the bar inside out
    report = sim.step()
    assert list(report.status) == [0, 1]
    assert np.array_equal(sim.controls["jaw"], [(0.01, 0, 0), (-1.5, 0, 0)])
    assert not sim.displacements(body)[1].any()


def count_calls(patch, calls, names):
    """Append a count of the calls of methods of Warp's arrays, by name."""
    counts = dict.fromkeys(names, 0)
    calls.append(counts)

    def counting(name, plain):
        def counted(*args, **options):
            counts[name] += 1
            return plain(*args, **options)

        return counted

    for name in names:
        patch.setattr(wp.array, name, counting(name, getattr(wp.array, name)))


@pytest.mark.parametrize("device", DEVICES)
def test_a_step_is_the_same_recorded_graph_and_reads_nothing_more(monkeypatch, device):
    sims = {law: simulation("pressure", law, device=device) for law in (wf.Control("c"), 0.0)}
    calls = []
    for law, sim in sims.items():
        stepper = sim.stepper
        sim.step()
        before = stepper.graph, stepper.launch.launches, stepper.work.time_law_values.ptr
        with monkeypatch.context() as m:
            count_calls(m, calls, ("numpy", "assign", "__init__"))
            sim.step()
        if isinstance(law, wf.Control):
            sim.controls["c"][:] = 300.0
            sim.step()
        assert stepper.graph is not None
        assert before == (stepper.graph, stepper.launch.launches, stepper.work.time_law_values.ptr)
    with_control, without = calls
    assert with_control == without
    assert np.abs(next(iter(sims.values())).state.displacement.numpy()).max() > 1e-7


def test_a_scene_without_controls_has_nothing_of_them():
    with_it, bare = (simulation("pressure", law) for law in (wf.Control("c"), 1.0))
    assert "controls" in with_it.model.info()["features"]
    assert "controls" in bare.model.info()["left_out"]
    assert not any(name.startswith(("state.control_", "backup.control_")) for name in bare.bytes())
    assert "state.control_c" in with_it.bytes()
    assert not any("evaluate_control" in kernel for kernel in bare.stepper.launch.kernels)
    assert any("evaluate_control" in kernel for kernel in with_it.stepper.launch.kernels)
    assert not any(".controls_" in module.name for module in bare.stepper.modules())
    assert len(bare.controls) == 0
    # one launch more, and the copies of its values that halved steps want
    assert with_it.stepper.launch.launches <= bare.stepper.launch.launches + 3


def test_ways_to_write():
    sim = simulation("load", wf.Control("c", 3), worlds=3)
    value = sim.controls["c"]
    assert list(sim.controls) == ["c"]
    assert value.shape == (3, 3)
    value[:] = (1, 2, 3)
    value[[False, True, False]] = 0.0
    value[2, 0] = 9
    expected = [(1, 2, 3), (0, 0, 0), (9, 2, 3)]
    assert np.array_equal(value, expected)
    assert np.array_equal(value[1:], expected[1:])
    assert np.array_equal(value.numpy(), expected)
    with pytest.raises(ValueError, match="read-only"):
        value[0][1] = 5.0
    value.assign(wp.array(np.arange(9.0).reshape(3, 3), dtype=wp.float64, device="cpu"))
    assert np.array_equal(sim.state.control_c.numpy(), np.arange(9.0).reshape(3, 3))
    sim.controls["c"] = np.ones((3, 3))
    assert value.array.numpy().min() == 1.0
    assert np.array_equal(np.from_dlpack(value), np.ones((3, 3)))
    assert repr(sim.controls).startswith("Controls(ControlValue('c', [[1.0")
    scalar = simulation("pressure", wf.Control("c"), worlds=3).controls["c"]
    scalar[:] = [1, 2, 3]
    scalar[[True, False, True]] = [4, 6]
    assert np.array_equal(scalar, [[4], [2], [6]])


def test_torch_shares_the_memory():
    torch = pytest.importorskip("torch")
    sim = simulation("load", wf.Control("c", 3), worlds=2)
    tensor = wp.to_torch(sim.controls["c"].array)
    tensor[1, 2] = -4.0
    assert sim.controls["c"][1, 2] == -4.0
    torch.from_dlpack(sim.controls["c"])[0, 0] = 2.0
    assert sim.controls["c"][0, 0] == 2.0
    sim.controls["c"].assign(torch.ones((2, 3)))
    assert sim.controls["c"].numpy().min() == 1.0


def declared(*laws):
    b, body = bar()
    for law in laws:
        add_load(b, body, law)
    return b.finalize(device="cpu")


def written(key, values, size=3):
    kind = "load" if size == 3 else "pressure"
    simulation(kind, wf.Control("jaw", size), worlds=2).controls["jaw"][key] = values


ERRORS = {
    "no name": (lambda: wf.Control(""), "needs a name"),
    "size": (lambda: wf.Control("jaw", 2), r"'jaw': size = 2 must be 1 .* or 3"),
    "initial": (lambda: wf.Control("jaw", 1, initial=(1, 2)), "'jaw': initial"),
    "initial nan": (lambda: wf.Control("jaw", 3, initial=np.nan), "'jaw': initial"),
    "scalar for a vector": (lambda: simulation("load", wf.Control("jaw")), "point load.*'jaw' has size 1.*a vector"),
    "vector for a scalar": (lambda: simulation("joint", wf.Control("jaw", 3)), "'rod'.*'jaw' has size 3.*a scalar"),
    "vector for an angle": (lambda: simulation("rotation", wf.Control("jaw", 3)), "angle.*'jaw' has size 3"),
    "another size": (
        lambda: declared(wf.Control("jaw", 3), (0, 0, 1)) and pressed_too(), "two controls have the name 'jaw'"),
    "another initial": (
        lambda: declared(wf.Control("jaw", 3), wf.Control("jaw", 3, initial=1.0)), "two controls have the name 'jaw'"),
    "two on one component": (
        lambda: twice(wf.Control("jaw", 3), wf.Control("claw", 3)), "two supports prescribe component x"),
    "rod of no length": (lambda: rod(wf.Control("jaw")), "'jaw' begins at 0 m"),
    "unknown": (
        lambda: simulation("load", wf.Control("jaw", 3)).controls["jwa"], "'jwa'.*it has: 'jaw'; did you mean 'jaw'"),
    "shape": (lambda: written(slice(None), np.zeros((2, 2))), r"'jaw' has values \(2, 3\)"),
    "mask": (lambda: written(np.array([True, False, True]), 1.0), r"'jaw' has values \(2, 3\)"),
    "text": (lambda: written(0, "much"), "'jaw'"),
    "nan": (lambda: written(slice(None), [(0, 1, 2), (0, 0, np.nan)]), "'jaw': nan of world 1, component 2"),
    "nan of a number": (lambda: written(1, np.inf, size=1), "'jaw': inf of world 1 is not finite"),
    "single precision": (
        lambda: simulation("load", wf.Control("jaw", 3)).controls["jaw"].assign(wp.zeros((1, 3), dtype=wp.float32)),
        r"'jaw' takes a Warp array float64\(1, 3\), got float32"),
}  # fmt: skip


def pressed_too():
    b, body = bar()
    add_load(b, body, wf.Control("jaw", 3))
    add_pressure(b, body, wf.Control("jaw", 1))
    b.finalize(device="cpu")


def twice(*laws):
    b, body = bar()
    for law in laws:
        add_moving(b, body, law)
    return b.finalize(device="cpu")


def rod(law):
    b, body = bar()
    b.add_joint("distance", parent=wf.GROUND, child=body.at((1, 0.1, 0.1)), anchor=(1.5, 0.1, 0.1), drive=law)


@pytest.mark.parametrize("case", ERRORS, ids=[c.replace(" ", "-") for c in ERRORS])
def test_errors(case):
    action, text = ERRORS[case]
    with pytest.raises(wf.ModelError, match=text):
        action()


def test_nothing_is_written_where_a_value_is_refused():
    value = simulation("load", wf.Control("jaw", 3), worlds=2).controls["jaw"]
    with pytest.raises(wf.ModelError):
        value[:] = [(1, 1, 1), (np.nan, 1, 1)]
    assert not value.numpy().any()


def test_a_term_may_not_take_the_array_of_a_control():
    class Watch(Term):
        name = "watch"

        def register(self, at):
            at.state.register("control_jaw", wp.float64, (3,))

    b, body = bar()
    add_load(b, body, wf.Control("jaw", 3))
    b.add_term(Watch)
    with pytest.raises(wf.ModelError, match="'watch': the state's array 'control_jaw' is that of the state itself"):
        wf.Simulation(b.finalize(device="cpu"), dt=H)


def test_equal_controls_may_meet_on_a_component():
    model = twice(wf.Control("jaw", 3), wf.Control("jaw", 3))
    assert list(model.terms.time_laws.controls) == ["jaw"]


def test_an_open_joint_is_told_at_the_start():
    with pytest.raises(wf.ConstraintError, match="start its drive at the present value"):
        simulation("joint", wf.Control("c", initial=0.01))
