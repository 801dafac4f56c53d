"""S3: a cantilever that drops under gravity, against exact step sequences and time-exact trajectories."""

from __future__ import annotations

import numpy as np
import pytest

import warpfea as wf

RULES = {"q4": "tet4", "q5": "tet5_paper"}
SAMPLES = 0.01
"""The references hold a value every 10 ms, s."""


@pytest.fixture(scope="module")
def cantilever(data, device):
    def make(ref, form=None):
        damping = None
        if form:
            values = ref["kelvin_voigt"]
            damping = wf.KelvinVoigt(values["eta"], values["lambda_v"], form=form)
        law = wf.SVK(E=ref["material"]["E"], nu=ref["material"]["nu"], density=ref["rho"], damping=damping)
        b = wf.ModelBuilder(gravity=ref["gravity"])
        rule = RULES[ref["stiffness_quadrature"][:2]]
        body = b.add_solid(data.mesh("S3_cantilever"), material=law, quadrature=rule)
        b.clamp(body.nodes(lambda X: np.abs(X[:, 0]) < 1e-9))
        b.add_probe("tip", body.surface(lambda X: X[:, 0] > 0.5 - 1e-9))
        b.add_probe("corner", body.nodes(lambda X: np.linalg.norm(X - (0.5, 0, 0), axis=1) < 1e-9))
        return body, b.finalize(device=device)

    return make


slow = pytest.mark.slow
RUNS = [
    ("S3_BE_svk_q4", None, "0.001"),
    ("S3_BE_svk_q5", None, "0.001"),
    pytest.param("S3_BE_svk_q5", None, "0.0005", marks=slow),
    pytest.param("S3_BE_svk_q5", None, "0.00025", marks=slow),
    pytest.param("S3_BE_svk_q4_damped_incremental", "incremental", "0.001", marks=slow),
    pytest.param("S3_BE_svk_q4_damped_incremental", "incremental", "0.0005", marks=slow),
    pytest.param("S3_BE_svk_q5_damped", "rate", "0.001", marks=slow),
    pytest.param("S3_BE_svk_q5_damped", "rate", "0.0005", marks=slow),
    pytest.param("S3_BE_svk_q5_damped", "rate", "0.00025", marks=slow),
]


@pytest.mark.parametrize(("name", "form", "h"), RUNS)
def test_backward_euler_sequence(cantilever, data, name, form, h):
    ref = data.json(name)
    body, model = cantilever(ref, form)
    run = ref["runs"][f"h={h}"]
    expected = {key: np.array(value) for key, value in run["trajectory"].items()}
    sim = wf.Simulation(model, dt=float(h), solver=wf.NewtonPCG(tol=1e-10))
    every = round(SAMPLES / sim.dt)
    energies, dissipation = [sim.energies()], [0.0]
    for _ in range(50):
        report = sim.step(every)
        assert not report.halvings.any()
        energies.append(sim.energies())
        dissipation.append(float(model.evaluation.dissipation_rate(sim.state)[0]))
    np.testing.assert_allclose(sim.probe("tip").time[every - 1 :: every], expected["t"][1:], rtol=1e-12)

    travel = np.abs(expected["tip_mean"]).max()
    speed = np.abs(expected["tip_mean_vel"]).max()
    for probe, key in (("tip", "tip_mean"), ("corner", "corner")):
        values = sim.probe(probe).displacement[0, every - 1 :: every]
        assert data.error(values, expected[key][1:], travel) < 1e-7
    values = sim.probe("tip").velocity[0, every - 1 :: every]
    assert data.error(values, expected["tip_mean_vel"][1:], speed) < 1e-7
    assert data.error(sim.displacements(body)[0], run["final_u"], travel) < 1e-7
    assert data.error(sim.velocities(body)[0], run["final_v"], speed) < 1e-7
    for key, ours in (("KE", "kinetic"), ("SE", "strain"), ("PE", "potential")):
        assert data.error([e[ours][0] for e in energies], expected[key]) < 1e-7
    if form == "rate":
        assert data.error(dissipation, expected["dissipation_rate"]) < 1e-7
    if form is None:
        total = np.array([e["kinetic"] + e["strain"] + e["potential"] for e in energies])[:, 0]
        assert data.error(total, expected["total"], expected["SE"].max()) < 1e-7


def test_first_steps(cantilever, data):
    """The first steps are in the references with more digits than the trajectories need."""
    ref = data.json("S3_BE_svk_q4")
    _, model = cantilever(ref)
    sim = wf.Simulation(model, dt=1e-3, solver=wf.NewtonPCG(tol=1e-12))
    for step in ref["runs"]["h=0.001"]["first_steps"]:
        while sim.steps < step["step"]:
            sim.step()
        tip = sim.probe("tip").displacement[0, -1]
        assert data.error(tip, step["tip_mean"]) < 1e-10


# order of convergence against the time-exact trajectory


def tip_errors(model, exact, integrator, h, t_end, halved):
    """Distance of the tip from the exact one every 10 ms; `halved`: every second step is made in two halves.

    Why that stands for refused steps: test_a_refused_step_equals_two_of_half_the_size.
    """
    sim = wf.Simulation(model, dt=h, integrator=integrator, solver=wf.NewtonPCG(tol=1e-9), ledger=False)
    every = round(SAMPLES / h)
    tip = []
    for k in range(round(t_end / h)):
        if halved and k % 2:
            sim.dt = h / 2
            sim.step(2)
            sim.dt = h
        else:
            sim.step()
        tip.append(sim.probe("tip").displacement[0, -1])
    assert sim.time[0] == pytest.approx(t_end, rel=1e-12)
    samples = np.array(tip)[every - 1 :: every]
    return np.linalg.norm(samples - exact[1 : 1 + len(samples)], axis=1)


@pytest.mark.parametrize("halved", [False, True], ids=["uniform", "halved"])
@pytest.mark.parametrize(
    ("integrator", "hs", "order", "slack"),
    [
        ("backward_euler", (5e-4, 1.25e-4), 1, 0.05),
        ("bdf2", (5e-4, 1.25e-4), 2, 0.1),
        # between neighbouring steps its order scatters by 0.3, for high modes that gravity strikes are damped by little
        ("generalized_alpha", (1e-3, 1.25e-4), 2, 0.1),
        # it damps nothing: steps must resolve all that moves before errors fall evenly
        pytest.param("energy_momentum", (6.25e-5, 3.125e-5), 2, 0.1, marks=slow),
    ],
)
def test_order_of_convergence(cantilever, data, integrator, hs, order, slack, halved):
    ref = data.json("S3_exact_svk_q5")
    exact = np.array(ref["runs"]["reference"]["trajectory"]["tip_mean"])
    _, model = cantilever(ref)
    worst = [tip_errors(model, exact, integrator, h, 0.03, halved).max() for h in hs]
    observed = np.log(worst[0] / worst[1]) / np.log(hs[0] / hs[1])
    assert observed == pytest.approx(order, abs=slack)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("integrator", "hs", "order", "slack", "halved"),
    [
        ("backward_euler", (1e-3, 1.25e-4), 1, 0.05, False),
        ("bdf2", (5e-4, 3.125e-5), 2, 0.1, True),
        ("energy_momentum", (5e-4, 3.125e-5), 2, 0.1, True),
    ],
)
def test_order_of_convergence_over_a_longer_time(cantilever, data, integrator, hs, order, slack, halved):
    ref = data.json("S3_exact_svk_q5")
    exact = np.array(ref["runs"]["reference"]["trajectory"]["tip_mean"])
    _, model = cantilever(ref)
    worst = [tip_errors(model, exact, integrator, h, 0.06, halved).max() for h in hs]
    assert np.log(worst[0] / worst[1]) / np.log(hs[0] / hs[1]) == pytest.approx(order, abs=slack)


@pytest.mark.parametrize(
    ("integrator", "dt"),
    [("backward_euler", 1e-3), ("bdf2", 1e-3), ("generalized_alpha", 1e-3), ("energy_momentum", 3.2e-3)],
)
def test_a_refused_step_equals_two_of_half_the_size(cantilever, data, integrator, dt):
    _, model = cantilever(data.json("S3_BE_svk_q4"))
    options = {"integrator": integrator, "ledger": False}
    ends = []
    for halves in (False, True):  # PCG is too weak for the whole step, and strong enough for a half
        start = wf.Simulation(model, dt=dt, **options)
        start.step(10)
        weak = wf.NewtonPCG(tol=1e-9, max_newton=4, max_pcg=12, preconditioner="block-jacobi")
        sim = wf.Simulation(model, start.state, dt=dt / 2 if halves else dt, solver=weak, **options)
        report = sim.step(2 if halves else 1)
        assert report.converged.all()
        assert report.halvings[0] == (0 if halves else 1)
        start.step(3)  # what a multistep scheme remembers is the same too
        ends.append(start.state.displacement.numpy())
    np.testing.assert_array_equal(ends[0], ends[1])
