"""energy_momentum(rho_inf=...): no growth of energy, momenta, theory of a mode, order; stiff bodies that spin."""

import numpy as np
import pytest
import scipy.linalg
import warp as wp
from validation.conservation import RATE, Conserved, tumble

import warpfea as wf
from warpfea.model.assembly import shape_and_jacobian, shape_gradients
from warpfea.simulation import integrators
from warpfea.studies.stress.case import Setting
from warpfea.studies.stress.cases import rotation

TIGHT = wf.NewtonPCG(tol=1e-12)
OMEGA = np.array([1.0, 2.0, 10.0])
SPEED = float(np.linalg.norm(OMEGA))
LOSSY = "energy_momentum(rho_inf=0.8)"


def spun(E, law=None, cells=(2, 1, 1), worlds=1):
    """A free T10 bar of 0.5 x 0.2 x 0.1 m that spins at OMEGA."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = law or wf.SVK(E=E, nu=0.3, density=1000.0)
    bar = b.add_solid(wf.mesh.box((0.5, 0.2, 0.1), cells=cells), material=law, name="bar")
    b.set_initial(bar, velocity=lambda X: np.cross(OMEGA, X - (0.25, 0.1, 0.05)) + (1.0, -0.5, 0.3))
    return b.finalize(device="cpu", worlds=worlds)


def rotor(E):
    """A 3243 beam of 0.5 m on a revolute joint that spins at SPEED."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law, section = wf.SVK(E=E, nu=0.3, density=1000.0), wf.Rectangle(0.05, 0.05)
    arm = b.add_beam([(0, 0, 0), (0.5, 0, 0)], elements=2, section=section, normal=(0, 0, 1), material=law)
    b.add_joint("revolute", parent=wf.GROUND, child=arm.start, axis=(0, 0, 1))
    b.set_initial(arm, angular_velocity=(0.0, 0.0, SPEED))
    return b.finalize(device="cpu")


def energy(sim):
    e = sim.energies()
    return float(e["kinetic"][0] + e["strain"][0])


# energy and momenta


def losses(E, turn, steps):
    """Largest gain of energy in a step, errors of the momenta and of both ledgers of energy, and the largest error that
    a step reports, of a free bar."""
    sim = wf.Simulation(spun(E), dt=turn / SPEED, integrator=LOSSY, solver=TIGHT)
    watch, last, gain = Conserved(sim), energy(sim), 0.0
    start = last
    for _ in range(steps):
        sim.step()
        watch.measure()
        now = energy(sim)
        gain, last = max(gain, now / last - 1.0), now
    e = {name: values[0] for name, values in sim.energies().items()}
    lost = abs(e["integrator"] - (start - last))
    lost = lost / start if lost > 1e-4 * (start - last) else 0.0
    errors = [watch.linear, watch.angular, lost, abs(e["ledger_residual"]) / start]
    return gain, max(errors), float(sim.max_floor)


@pytest.mark.parametrize(
    ("E", "turn", "steps"),
    [(1e7, 0.2, 60), (1e9, 0.2, 40), (1e7, 1.0, 20)]
    + [pytest.param(E, turn, 300, marks=pytest.mark.slow) for E in (1e7, 1e9) for turn in (0.2, 0.5)]
    + [pytest.param(2e11, 0.2, 300, marks=pytest.mark.slow), pytest.param(1e9, 1.0, 300, marks=pytest.mark.slow)]
    + [pytest.param(2e11, 0.5, 300, marks=[pytest.mark.slow, pytest.mark.xfail(reason=
        "by rounding 5e-10 to 1.7e-5: where BiCGStab stalls the step is accepted with its estimate, up to 1e-4")])],
)  # fmt: skip
def test_a_free_bar_gains_no_energy_and_keeps_its_momenta(E, turn, steps):
    """generalized_alpha has 440 times the energy at 1e9 Pa after 300 steps of 0.2; 8934ce7 has no rho_inf here."""
    gain, error, _ = losses(E, turn, steps)
    assert gain <= 1e-11
    assert error < 1e-10


@pytest.mark.slow
def test_errors_of_steps_that_rounding_stops_are_those_they_report():
    gain, error, floor = losses(2e11, 0.5, 300)
    assert gain <= max(1e-11, floor)
    assert error < max(1e-10, floor)


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda:0", marks=pytest.mark.cuda)])
@pytest.mark.parametrize("scheme", ["energy_momentum", LOSSY])
def test_the_body_of_the_stress_rows_keeps_its_momenta_at_a_tight_tolerance(scheme, device):
    """Rows `turning` of `warpfea stress` keep angular momentum to 1e-6 at the default tolerance, 1e-8."""
    model = rotation._rotating_body(Setting(device, "float64"), "free", 1e9)
    sim = wf.Simulation(model, dt=0.2 / SPEED, integrator=scheme, solver=wf.NewtonPCG(tol=1e-12))
    watch = Conserved(sim)
    for _ in range(100):
        sim.step()
    (_, p, L), (now_p, now_L) = watch.first, watch._momenta(sim)  # p is 0: both over L, as in the rows
    assert max(np.linalg.norm(now_p - p), np.linalg.norm(now_L - L)) < 1e-10 * np.linalg.norm(L)


@pytest.mark.slow
@pytest.mark.parametrize("turn", [0.2, 1.0])
def test_a_rotor_on_a_joint_gains_no_energy(turn):
    sim = wf.Simulation(rotor(1e9), dt=turn / SPEED, integrator=LOSSY, solver=TIGHT, constraint_tol=1e-13)
    last = energy(sim)
    start = last
    for _ in range(40):
        sim.step()
        now = energy(sim)
        assert now <= last + 1e-10 * start
        last = now
    assert last < start


def strains(body, u, rule):
    """Green's strain (E, Q, 3, 3) and volumes (E, Q) at the points of a rule, from displacements alone."""
    elements = np.arange(len(body.connectivity))
    _, ds, J0, det = shape_and_jacobian(body, elements, rule.points)
    F = np.eye(3) + np.einsum("esk,eqsl->eqkl", u[body.connectivity], shape_gradients(ds, J0))
    return 0.5 * (np.swapaxes(F, 2, 3) @ F - np.eye(3)), det * rule.weights


@pytest.mark.parametrize(("rho", "eta"), [(0.8, 0.0), (0.0, 0.0), pytest.param(0.8, 50.0, marks=pytest.mark.slow)])
def test_the_integrator_takes_chi_half_of_the_strains_change(rho, eta):
    """The ledger against (chi/2) int dE : C : dE by numpy, step by step, beside damping, which stays `viscous`."""
    E, nu = 1e6, 0.3
    law = wf.SVK(E=E, nu=nu, density=1000.0, damping=wf.KelvinVoigt(eta, 0.6 * eta) if eta else None)
    model = spun(E, law, cells=(1, 1, 1))
    sim = wf.Simulation(model, dt=0.3 / SPEED, integrator=wf.EnergyMomentum(rho_inf=rho), solver=TIGHT)
    (body,), (block,) = model.bodies, model.blocks
    lam, mu, chi = E * nu / ((1 + nu) * (1 - 2 * nu)), E / (2 * (1 + nu)), (1 - rho) / (1 + rho)
    expected, damped = 0.0, 0.0
    before, w = strains(body, sim.state.displacement.numpy()[0], block.key.rule)
    for _ in range(8):
        sim.step()
        now, _ = strains(body, sim.state.displacement.numpy()[0], block.key.rule)
        dE = now - before
        square, trace = np.einsum("eqij,eqij->eq", dE, dE), np.trace(dE, axis1=2, axis2=3)
        expected += 0.5 * chi * np.sum(w * (lam * trace**2 + 2 * mu * square))
        damped += np.sum(w * (0.6 * eta * trace**2 + 2 * eta * square)) / sim.dt
        before = now
    e = {name: values[0] for name, values in sim.energies().items()}
    assert e["integrator"] == pytest.approx(expected, rel=1e-8)
    assert e["viscous"] == pytest.approx(damped, rel=1e-8)


@pytest.mark.parametrize(
    ("family", "law"),
    [("T10", "svk")]
    + [
        pytest.param(*case, marks=pytest.mark.slow)
        for case in (("T4", "neo_hookean"), ("3243 tied", "svk"), ("T10", "mooney_rivlin"), ("3443 tied", "svk"))
    ],
)  # fmt: skip
def test_families_and_laws_lose_energy_and_keep_momenta(family, law):
    """Bodies that pulsate: the energy falls in each step, and the ledger has where it went."""
    sim = wf.Simulation(tumble(family, law), dt=5e-3, integrator=LOSSY, solver=TIGHT)
    watch, seen = Conserved(sim), [energy(sim)]
    for _ in range(30):
        sim.step()
        watch.measure()
        seen.append(energy(sim))
    assert max(np.diff(seen)) < 0.0
    assert seen[-1] < 0.999 * seen[0]
    assert max(watch.linear, watch.angular) < 1e-10
    e = {name: values[0] for name, values in sim.energies().items()}
    assert e["integrator"] == pytest.approx(seen[0] - seen[-1], rel=1e-8)


# a linear mode, order


def amplification(rho, turn):
    """(q, h v) of q'' = -omega^2 q one step later, turn = omega h."""
    chi = (1 - rho) / (1 + rho)
    left = np.array([[1.0, -0.5], [0.5 * turn**2 * (1 + chi), 1.0]])
    right = np.array([[1.0, 0.5], [-0.5 * turn**2 * (1 - chi), 1.0]])
    return np.linalg.solve(left, right)


@pytest.mark.parametrize(("rho", "turn"), [(0.8, 0.3), (0.5, 3.0), (0.0, 30.0)])
def test_a_step_damps_a_mode_as_theory_says(rho, turn):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    bar = b.add_solid(wf.mesh.box((0.5, 0.2, 0.1), cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
    b.clamp(bar.nodes("x-"))
    model = b.finalize(device="cpu")
    K, M = model.tangent_matrix(model.state()).toarray(), model.mass_matrix().toarray()
    free = model.free_slots.ravel()
    values, vectors = scipy.linalg.eigh(K[np.ix_(free, free)], M[np.ix_(free, free)])
    shape = np.zeros(len(free))
    shape[free] = vectors[:, 0]
    h, small = turn / np.sqrt(values[0]), 1e-7 / np.abs(shape).max()
    columns = []
    for k in range(2):
        scheme = wf.EnergyMomentum(rho_inf=rho)
        sim = wf.Simulation(model, dt=h, integrator=scheme, solver=wf.NewtonPCG(tol=1e-12, force_tol=1e-16))
        array = (sim.state.displacement, sim.state.velocity)[k]
        array.assign((small / (1.0, h)[k] * shape).reshape(1, -1, 3))
        sim.step()
        ends = (sim.state.displacement.numpy()[0].ravel(), h * sim.state.velocity.numpy()[0].ravel())
        columns.append([shape @ (M @ end) / small for end in ends])
    A = amplification(rho, turn)
    np.testing.assert_allclose(np.array(columns).T, A, atol=1e-5 * np.abs(A).max())


def test_theory_has_its_radius_and_no_step_grows():
    """Far beyond the step strains fall by rho a step, and velocities, which nothing damps there, change their sign."""
    for rho in (0.0, 0.5, 0.8, 0.9):
        chi = (1 - rho) / (1 + rho)
        radii = {
            turn: np.abs(np.linalg.eigvals(amplification(rho, turn))).max() for turn in np.geomspace(1e-3, 1e5, 400)
        }
        assert max(radii.values()) <= 1.0 + 1e-12
        assert 1.0 - radii[1e-3] == pytest.approx(0.25 * chi * 1e-6, rel=0.01)
        assert min(np.abs(np.linalg.eigvals(amplification(rho, 1e5)))) == pytest.approx(rho, abs=1e-4)
        assert max(np.abs(np.linalg.eigvals(amplification(rho, 1e5)))) > 1.0 - 1e-4


@pytest.mark.slow
@pytest.mark.parametrize(("rho", "order"), [(1.0, 2.0), (0.8, 1.0)])
def test_order(rho, order):
    """A soft bar that spins and pulsates: all slots against 32 times as many steps."""
    ends = []
    for steps in (20, 40, 1280):
        sim = wf.Simulation(
            tumble("T4", "svk"), dt=0.02 / steps, integrator=wf.EnergyMomentum(rho_inf=rho), solver=TIGHT, ledger=False
        )
        sim.step(steps)
        ends.append(sim.state.displacement.numpy()[0])
    error = [np.linalg.norm(end - ends[-1]) for end in ends[:2]]
    assert np.log2(error[0] / error[1]) == pytest.approx(order, abs=0.15)


# what it is


def test_names_and_options():
    assert integrators.find_integrator("energy_momentum").rho_inf == 1.0
    assert integrators.find_integrator("energy_momentum").order == 2
    scheme = integrators.find_integrator(" energy_momentum ( rho_inf = 0.5 )")
    assert (scheme.rho_inf, scheme.order, scheme.label) == (0.5, 1, "energy_momentum(rho_inf=0.5)")
    assert scheme.dissipation == pytest.approx(1 / 3)
    assert repr(wf.EnergyMomentum(rho_inf=0.3)) == "EnergyMomentum(rho_inf=0.3)"
    with pytest.raises(wf.ModelError, match="did you mean 'rho_inf'"):
        integrators.find_integrator("energy_momentum(rho_in=0.5)")
    for rho in (-0.1, 1.1, np.nan, "half", True):
        with pytest.raises(wf.ModelError, match=r"rho_inf.*between 0 and 1"):
            wf.EnergyMomentum(rho_inf=rho)


def test_rho_1_is_the_conserving_scheme_to_the_last_bit():
    """No kernels of its own, and none of the dissipative form."""
    ends = []
    for scheme in ("energy_momentum", wf.EnergyMomentum(), "energy_momentum(rho_inf=1)"):
        sim = wf.Simulation(spun(1e7, cells=(1, 1, 1)), dt=0.2 / SPEED, integrator=scheme)
        assert not any("dissipative" in module.name for module in sim.stepper.modules())
        assert sim.integrator.label == "energy_momentum"
        sim.step(3)
        ends.append((sim.state.displacement.numpy(), sim.state.velocity.numpy()))
    for end in ends[1:]:
        for one, other in zip(ends[0], end):
            np.testing.assert_array_equal(one, other)


def test_worlds_with_parameters_equal_single_runs():
    """Constants that are set reach the dissipation as well."""

    def run(worlds, E):
        model = spun(1e7, cells=(1, 1, 1), worlds=worlds)
        model.set_parameter("bar.E", E)
        sim = wf.Simulation(model, dt=0.2 / SPEED, integrator="energy_momentum(rho_inf=0.5)")
        sim.step(4)
        return sim.state.displacement.numpy(), sim.energies()["integrator"]

    together, lost = run(2, [1e7, 3e6])
    for world, E in enumerate((1e7, 3e6)):
        alone, own = run(1, E)
        np.testing.assert_array_equal(together[world], alone[0])
        assert lost[world] == own[0]


# stiff bodies


def newton_budget(model, turn, steps, **options):
    sim = wf.Simulation(model, dt=turn / SPEED, integrator="energy_momentum", **options)
    reports = [sim.step() for _ in range(steps)]
    assert not any(report.halvings[0] for report in reports)
    return max(int(report.newton[0]) for report in reports)


@pytest.mark.parametrize(("E", "most"), [(1e6, 4), (1e9, 5), (1e12, 7)])
def test_stiff_bodies_take_few_iterations(E, most):
    """A bar that spins by 0.1 rad a step; fails on 8934ce7: 7, 32 and 151 iterations, the last in halved steps."""
    assert newton_budget(spun(E, cells=(4, 2, 1)), 0.1, 10) <= most


@pytest.mark.slow
@pytest.mark.parametrize("options", [{"linear": "direct"}, {"preconditioner": "two-level"}, {"operator": "elements"}])
def test_every_way_to_solve_takes_few_iterations(options):
    """8934ce7 takes 30 at 1e9 Pa."""
    assert newton_budget(spun(1e9), 0.1, 5, solver=wf.NewtonPCG(**options)) <= 7


def test_a_stiff_rotor_on_a_joint_takes_few_iterations():
    assert newton_budget(rotor(1e12), 0.1, 10) <= 7


@pytest.mark.slow
@pytest.mark.parametrize("family", ["T4", "ENMC", "3243 tied", "3443 tied", "3243 full"])
def test_stiff_bodies_of_every_family_take_few_iterations(family, monkeypatch):
    monkeypatch.setitem(tumble.__globals__["LAWS"], "svk", wf.SVK(E=1e12, nu=0.3, density=1000.0))
    model = tumble(family, "svk", stretch=0.0)
    sim = wf.Simulation(model, dt=0.1 / RATE, integrator="energy_momentum")
    assert max(int(sim.step().newton[0]) for _ in range(10)) <= 8


def test_a_slow_spin_takes_few_iterations():
    """0.1 rad/s and h = 1 s: as stiff beside its own forces as 1e13 Pa at 10 rad/s."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    bar = b.add_solid(wf.mesh.box((0.5, 0.2, 0.1), cells=(2, 1, 1)), material=wf.SVK(E=1e9, nu=0.3, density=1000.0))
    b.set_initial(bar, velocity=lambda X: np.cross(0.1 / SPEED * OMEGA, X - (0.25, 0.1, 0.05)))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1.0, integrator="energy_momentum")
    assert max(int(sim.step().newton[0]) for _ in range(5)) <= 8


@pytest.mark.cuda
def test_cuda_loses_what_the_cpu_loses():
    """In graphs: the same energy to 1e-9, and as few iterations."""
    lost = []
    for device in ("cpu", "cuda:0"):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        bar = b.add_solid(wf.mesh.box((0.5, 0.2, 0.1), cells=(2, 1, 1)), material=wf.SVK(E=1e7, nu=0.3, density=1e3))
        b.set_initial(bar, velocity=lambda X: np.cross(OMEGA, X - (0.25, 0.1, 0.05)))
        sim = wf.Simulation(b.finalize(device=device), dt=0.2 / SPEED, integrator=LOSSY, solver=TIGHT)
        assert max(int(sim.step().newton[0]) for _ in range(20)) <= 8
        lost.append(sim.energies()["integrator"][0])
    assert wp.get_device("cuda:0").is_cuda
    assert lost[1] == pytest.approx(lost[0], rel=1e-6)
