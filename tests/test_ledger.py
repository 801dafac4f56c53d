"""The energy ledger: every column against its own definition, and the sum against h g.v."""

import numpy as np
import pytest
from pairwise import covering

import warpfea as wf

COLUMNS = ("kinetic", "strain", "potential", "viscous", "integrator", "work_loads", "work_supports", "work_fields")


def scene(damping="incremental", pressure=True, law="svk"):
    kelvin = wf.KelvinVoigt(200.0, 300.0, form=damping) if damping else None
    b = wf.ModelBuilder()
    material = wf.SVK(E=1e6, nu=0.3, density=1000.0, damping=kelvin)
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(4, 1, 1)), material=material)
    b.drive(body.nodes("x-"), displacement=([0, 0.1, 0.2], [(0, 0, 0), (0.02, 0, 0.05), (0, 0.01, 0)]))
    b.add_traction(body.surface("x+"), ([0, 0.1], [(0, 0, 0), (300.0, 200.0, -900.0)]))
    if pressure:
        b.add_pressure(body.surface("z+"), 400.0)
    return b, body


def totals(e, flip=None):
    sign = {name: (-1.0 if name == flip else 1.0) for name in COLUMNS}
    gain = sum(sign[n] * e[n] for n in ("kinetic", "strain", "potential", "viscous", "integrator"))
    return gain - sum(sign[n] * e[n] for n in ("work_loads", "work_supports", "work_fields"))


@pytest.mark.parametrize(
    ("damping", "integrator"),
    covering(
        [None, "incremental", "rate", "explicit"],
        ["backward_euler", "energy_momentum", "bdf2", "generalized_alpha"],
        strength=1,
    ),
)
def test_ledger_residual_is_the_unbalanced_work(damping, integrator):
    b, body = scene(damping)
    model = b.finalize(device="cpu")
    conserves = integrator == "energy_momentum"
    # the explicit form feeds modes that a step does not resolve, and nothing else damps them there
    dt = 2e-4 if conserves and damping == "explicit" else 4e-3
    sim = wf.Simulation(model, dt=dt, integrator=integrator, solver=wf.NewtonPCG(tol=1e-4))
    start = {k: v.copy() for k, v in sim.energies().items()}
    sim.step(30)
    e = {k: v[0] - start[k][0] for k, v in sim.energies().items()}
    size = max(abs(e[name]) for name in COLUMNS)
    assert abs(e["unbalanced"]) > 1e-13 * size  # a loose tolerance leaves something to find
    assert abs(e["ledger_residual"] - e["unbalanced"]) < 1e-12 * size
    assert abs(totals(e) - e["unbalanced"]) < 1e-12 * size
    assert not conserves or abs(e["integrator"]) < 1e-12 * size
    for name in COLUMNS:
        if e[name] != 0.0 and not (name == "integrator" and conserves):
            assert abs(totals(e, flip=name) - e["unbalanced"]) > 1e-6 * size, name
    assert (e["viscous"] > 0.0) == (damping is not None)
    assert e["work_fields"] != 0.0
    if integrator == "backward_euler":
        assert e["integrator"] > 0.0


ROWS = {0: "integrator's inertia", 1: "f_int.dq", 2: "loads", 3: "gravity", 4: "supports", 5: "kinetic", 7: "fields"}


@pytest.mark.parametrize("row", ROWS)
def test_a_wrong_sign_on_the_device_shows(row, monkeypatch):
    """Each sum that the ledger is made of, with its sign turned before it is booked."""
    from warpfea.solvers.residual import RowReducer

    def run(turned):
        b, _ = scene("incremental")
        sim = wf.Simulation(b.finalize(device="cpu"), dt=4e-3, solver=wf.NewtonPCG(tol=1e-8), capture=False)
        if turned is not None:
            plain = RowReducer.__call__

            def wrong(self, rows, count, active, out):
                plain(self, rows, count, active, out)
                if out is sim.stepper.work.ledger_sums:
                    values = out.numpy()
                    values[turned] *= -1.0
                    out.assign(values)

            monkeypatch.setattr(RowReducer, "__call__", wrong)
        sim.step(5)
        e = {name: values[0] for name, values in sim.energies().items()}
        size = max(abs(e[name]) for name in COLUMNS)
        return max(abs(e["ledger_residual"] - e["unbalanced"]), abs(totals(e) - e["unbalanced"])) / size

    assert run(None) < 1e-12
    assert run(row) > 1e-6


def test_columns_have_their_own_definitions():
    b, body = scene("incremental", pressure=False)
    model = b.finalize(device="cpu")
    h = 4e-3
    sim = wf.Simulation(model, dt=h)
    M = model.mass_matrix()
    weights = {"potential": model.masses.lumped[0]}
    integrator = supports = viscous = 0.0
    for _ in range(10):
        u0, v0 = (getattr(sim.state, n).numpy()[0].copy() for n in ("displacement", "velocity"))
        W0 = model.strain_energy(sim.state)[0]
        before = sim.energies()
        sim.step()
        u1, v1 = (getattr(sim.state, n).numpy()[0] for n in ("displacement", "velocity"))
        W1 = model.strain_energy(sim.state)[0]
        dv, dq = (v1 - v0).ravel(), u1 - u0
        step_viscous = sim.energies()["viscous"][0] - before["viscous"][0]
        total_internal = sim.stepper.work.internal.numpy()[0]
        integrator += 0.5 * dv @ (M @ dv) + np.sum(total_internal * dq) - (W1 - W0) - step_viscous
        held = ~model.free_slots
        supports += np.sum((sim.stepper.work.g.numpy()[0] * dq)[held])
        # incremental law: the elastic force is known apart, so the rest of f_int is viscous
        viscous_force = total_internal - model.internal_force(sim.state)[0]
        viscous += np.sum(viscous_force * dq)
        assert step_viscous > 0.0
    e = sim.energies()
    v = sim.state.velocity.numpy()[0].ravel()
    u = sim.state.displacement.numpy()[0]
    assert e["kinetic"][0] == pytest.approx(0.5 * v @ (M @ v), rel=1e-12)
    assert e["strain"][0] == pytest.approx(model.strain_energy(sim.state)[0], rel=1e-12)
    assert e["potential"][0] == pytest.approx(9.81 * weights["potential"] @ u[:, 2], rel=1e-10)
    assert e["integrator"][0] == pytest.approx(integrator, rel=1e-9)
    assert e["work_supports"][0] == pytest.approx(supports, rel=1e-10)
    assert e["viscous"][0] == pytest.approx(viscous, rel=0.05)  # equal but for S : dF^T dF / 2


def test_undamped_energy_is_lost_to_the_integrator_alone():
    b = wf.ModelBuilder()
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(4, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
    b.clamp(body.nodes("x-"))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3, solver=wf.NewtonPCG(tol=1e-11))
    sim.step(50)
    e = sim.energies()
    assert e["kinetic"] + e["strain"] + e["potential"] == pytest.approx(-e["integrator"], rel=1e-8)
    assert e["work"][0] == 0.0
