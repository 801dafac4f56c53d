"""Loops of learning: steps that read nothing back, and worlds that differ."""

import numpy as np
import pytest
import warp as wp
from loop_models import DEVICES, DT, QUIET, arms, bent, cubes, flags, same, stacks, values

import warpfea as wf

# steps that read nothing back


def leaves(target, source):
    """True if a copy leaves the device."""
    return source.device.is_cuda and not target.device.is_cuda


@pytest.fixture
def silent():
    """Refuse every reading of a device array and every allocation while it is entered."""

    class Silent:
        def __enter__(self):
            self.patch = pytest.MonkeyPatch()

            def refuse(*_, **__):
                raise AssertionError("an array was read back or allocated")

            for name in ("numpy", "list", "to"):
                self.patch.setattr(wp.array, name, refuse)
            copy = wp.copy
            self.patch.setattr(
                wp, "copy", lambda to, of, *a, **k: (refuse if leaves(to, of) else copy)(to, of, *a, **k)
            )
            for device in wp.get_devices():
                self.patch.setattr(type(device.get_allocator()), "allocate", refuse)

        def __exit__(self, *_):
            self.patch.undo()

    return Silent()


def test_the_guard_sees_readings_and_allocations(silent):
    array = wp.zeros(3, device="cpu")
    with silent, pytest.raises(AssertionError, match="read back"):
        array.numpy()
    with silent, pytest.raises(AssertionError, match="read back"):
        array.to("cpu")
    with silent, pytest.raises(AssertionError, match="allocated"):
        wp.zeros(3, device="cpu")


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("build", [cubes, arms])
def test_a_thousand_steps_read_and_allocate_nothing(build, device, silent):
    sim = wf.Simulation(build(2, device=device), dt=DT, **QUIET)
    names = ["probe.top.position", "contact.pad.force"] if build is cubes else ["joint.motor.angle", "time"]
    observed = sim.observe(*names)
    mask, graph = flags(1, of=2, device=device), sim.stepper.graph
    sim.step()
    sim.reset(mask)  # makes the state that worlds go back to
    masks = (mask, flags(1, of=2, dtype=wp.bool, device=device))
    with silent:
        for k in range(10):
            sim.step(100)
            observed.update()
            sim.reset(masks[k % 2])
        last = sim.step()
    assert sim.stepper.graph is graph
    assert last.converged.all()
    assert sim.steps == 1002
    assert last.time == pytest.approx([1002 * DT, DT])


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize(
    ("integrator", "dtype"),
    [("backward_euler", "float64"), ("bdf2", "float64"), ("energy_momentum", "float64"), ("backward_euler", "float32")],
)
@pytest.mark.parametrize(
    ("build", "solver"), [(stacks, None), (arms, "jacobi"), (bent, wf.NewtonPCG(preconditioner="two-level"))]
)
def test_steps_of_every_kind_read_and_allocate_nothing(build, solver, integrator, dtype, device, silent):
    if solver == "jacobi" and integrator == "energy_momentum":
        pytest.skip("refused")
    options = {"integrator": integrator, "solver": solver, "ledger": build is not arms}
    sim = wf.Simulation(build(2, dtype, device), dt=[DT, 0.5 * DT], t_end=10 * DT, **(QUIET | options))
    mask = flags(1, of=2, device=device)
    sim.step(2)
    sim.reset(mask)
    with silent:
        sim.step(8)
        sim.reset(mask)
        sim.reset(sim.state.status)
        sim.step()
    assert sim.status.tolist() == [0, 0]


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_steps_that_are_not_read_are_the_same(dtype):
    model = cubes(2, dtype)
    loud = wf.Simulation(model, dt=DT, on_failure="freeze", ledger=False)
    quiet = wf.Simulation(model, dt=DT, **QUIET)
    assert (loud.asynchronous, quiet.asynchronous) == (False, True)
    loud.step(30)
    for count in (1, 9, 20):
        report = quiet.step(count)
    for world in range(2):
        assert same(values(loud, world), values(quiet, world))
    assert np.array_equal(report.newton, loud.last.newton)
    assert np.array_equal(report.time, loud.last.time)
    for name in loud.totals:
        assert np.array_equal(quiet.totals[name], loud.totals[name])
    for name in ("max_residual", "max_floor", "max_violation", "min_J", "steps"):
        assert getattr(quiet, name) == getattr(loud, name)
    assert np.array_equal(quiet.probe("top").position[:, -1], loud.probe("top").position[:, -1])
    assert np.array_equal(quiet.contact_force("pad"), loud.contact_force("pad"))


def test_a_report_reads_until_the_next_step():
    sim = wf.Simulation(cubes(), dt=DT, **QUIET)
    first = sim.step()
    kept = sim.step()
    assert kept.time == pytest.approx(2 * DT)
    sim.step()
    assert kept.time == pytest.approx(2 * DT)
    with pytest.raises(wf.ModelError, match=r"report of step 1 is no longer available \(simulation at step 3\)"):
        _ = first.time
    assert "step 1" in repr(first)


# what differs


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_worlds_of_every_kind_equal_their_own_runs(dtype, device):
    """Other constants of material and contact, one that diverges, one that is given NaN, one at its end, one reset."""
    E, mu, ends = np.array([1e5, 2e5, 1e5, 1e5, 3e5, 1e5]), np.array([0.3, 0.0, 0.5, 0.3, 0.3, 0.1]), np.full(6, 1.0)
    ends[3] = 0.03

    def start(model, worlds):
        model.set_parameter("cube.E", E[worlds])
        model.set_parameter("pad.mu", mu[worlds])
        state = model.state()
        v = state.velocity.numpy()
        for row, world in enumerate(worlds):
            v[row] += (0.2 * world, 0.0, 0.0)
            v[row, ::2] += (0.0, 0.0, 1e7 if world == 1 else 0.0)
            v[row] *= np.nan if world == 2 else 1.0
        state.velocity.assign(v)
        return wf.Simulation(model, state, dt=DT, t_end=ends[worlds], solver=wf.NewtonPCG(max_halvings=2), **QUIET)

    everyone = np.arange(6)
    sim = start(cubes(6, dtype, device), everyone)
    graph = sim.stepper.graph
    sim.step(10)
    back = sim.state.copy()
    sim.step(15)
    sim.reset(flags(4, of=6, device=device), back)
    sim.step(15)
    assert sim.stepper.graph is graph
    assert sim.status.tolist() == [0, 1, 1, 2, 0, 0]
    for world in everyone:
        alone = start(cubes(1, dtype, device), np.array([world]))
        alone.step(25 if world == 4 else 40)
        assert same(values(sim, world), values(alone)), world
    assert np.isfinite(sim.state.displacement.numpy()[[0, 1, 3, 4, 5]]).all()


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_worlds_on_joints_with_controls_and_steps_of_their_own(dtype):
    """Another step and rate of the drive in each, one that is given NaN, one reset."""
    steps, rates = np.array([1e-3, 2e-3, 2e-3, 1.5e-3]), np.array([2.0, -1.0, np.nan, 0.5])

    def run(worlds, count, reset_at=-1):
        sim = wf.Simulation(arms(len(worlds), dtype), dt=steps[worlds], **QUIET)
        taken = np.zeros(len(worlds))
        for k in range(count):
            if k == reset_at:
                sim.reset(flags(3))
                taken[3] = 0
            taken += 1
            angle = (steps * rates)[worlds] * taken
            sim.controls["motor"].assign(wp.array(angle[:, None], dtype=wp.float64, device="cpu"))
            sim.step()
        return sim

    sim = run(np.arange(4), 30, reset_at=12)
    assert sim.status.tolist() == [0, 0, 1, 0]
    for world in range(4):
        assert same(values(sim, world), values(run(np.array([world]), 18 if world == 3 else 30))), world


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"dt": [1e-3, 2e-3, 3e-3]}, "or 2 of them, one of each world"),
        ({"dt": np.array([1e-3, np.nan])}, "dt = nan of world 1 must be a positive finite time"),
        ({"dt": [1e-3, -1.0]}, "dt = -1.0 of world 1"),
        ({"dt": None}, "dt = None must be"),
        ({"dt": True}, "dt = True must be"),
        ({"dt": [[1e-3], [1e-3, 2]]}, "one of each world"),
        ({"dt": wp.zeros(2, dtype=wp.float32, device="cpu")}, r"must be a Warp array float64\(2,\)"),
        ({"dt": 1e-3, "t_end": [1.0]}, "t_end = .* 2 of them"),
        ({"dt": 1e-3, "t_end": np.inf}, "t_end = inf must be a finite time"),
        ({"dt": [1e-3, 2e-3], "integrator": "generalized_alpha(rho_inf=0.8)"}, "takes one step for all worlds"),
        ({"dt": "auto", "error": 1e-4, "t_end": 1.0}, "needs a fixed dt"),
    ],
)
def test_times_are_checked(options, text):
    with pytest.raises(wf.ModelError, match=text):
        wf.Simulation(cubes(2), **(QUIET | options))
