"""Generalized-alpha in runs: worlds, checkpoints, precisions, solvers, and options that are refused."""

import numpy as np
import pytest
from soft_links import links, pulled

import warpfea as wf
from warpfea.simulation import integrators


def mechanism(worlds=1, dtype="float64", E=1e4):
    b, _, _ = links(2, E=E, drive=([0.0, 0.01, 0.05], [0.0, 0.05, 0.05]))
    return b.finalize(device="cpu", worlds=worlds, dtype=dtype)


def bits(sim, world=0):
    return {name: values[world].tobytes() for name, values in sim.state.numpy().items() if name != "status"}


def test_worlds_resume_and_reset_to_the_bit(tmp_path):
    """Across a kink of the drive, with a world that is reset in between."""
    model = mechanism(worlds=2)
    model.set_gravity([(0, 0, -9.81), (3.0, 0, 0)])
    sim = wf.Simulation(model, dt=1e-3, integrator="generalized_alpha")
    sim.step(5)
    sim.reset([False, True])
    sim.step(3)
    sim.run(sim.time.min() + 1e-3, outputs=[wf.Checkpoint(tmp_path / "c.npz")])
    again = wf.Simulation(model, dt=1e-3, integrator="generalized_alpha")
    again.resume(tmp_path / "c.npz")
    for s in (sim, again):
        s.step(4)
    for world, steps in ((0, 12), (1, 8)):  # world 0 is past the end of the run, and waits
        assert bits(sim, world) == bits(again, world)
        single = mechanism()
        single.set_gravity([(0, 0, -9.81), (3.0, 0, 0)][world])
        alone = wf.Simulation(single, dt=1e-3, integrator="generalized_alpha")
        alone.step(steps)
        assert bits(sim, world) == bits(alone), world


def test_a_checkpoint_of_another_radius_is_refused(tmp_path):
    sim = wf.Simulation(mechanism(), dt=1e-3, integrator="generalized_alpha")
    sim.run(1e-3, outputs=[wf.Checkpoint(tmp_path / "c.npz")])
    other = wf.Simulation(mechanism(), dt=1e-3, integrator=wf.GeneralizedAlpha(rho_inf=0.5))
    with pytest.raises(wf.CheckpointError, match=r"rho_inf=0.2.*rho_inf=0.5"):
        other.resume(tmp_path / "c.npz")


@pytest.mark.parametrize(
    "options", [{"dtype": "float32"}, {"solver": "outer"}, {"solver": "jacobi"}, {"solver": "direct"}]
)
def test_other_solvers_and_precisions_agree(options):
    found = []
    solvers = {
        "outer": wf.NewtonPCG(multipliers="outer"),
        "jacobi": wf.Jacobi(iterations=60, tol=1e-8),
        "direct": wf.NewtonPCG(linear="direct"),
    }
    for given in ({}, options):
        model = mechanism(dtype=given.get("dtype", "float64"))
        sim = wf.Simulation(model, dt=1e-3, integrator="generalized_alpha", solver=solvers.get(given.get("solver")))
        sim.step(20)
        found.append(sim.probe("tip").displacement[0])
    assert np.abs(found[1] - found[0]).max() < 2e-3 * np.abs(found[0]).max()


# words


@pytest.mark.parametrize("rho", [-0.1, 1.1, float("nan"), float("inf"), "0.8", True, None])
def test_a_bad_radius_is_refused(rho):
    with pytest.raises(wf.ModelError, match=r"rho_inf.*between 0 and 1"):
        wf.GeneralizedAlpha(rho_inf=rho)


def test_the_undamped_scheme_is_refused_with_joints_and_drives():
    b, _, _ = links(1)
    with pytest.raises(wf.ModelError, match=r"rho_inf = 1.*joint 'pivot'.*rho_inf < 1"):
        wf.Simulation(b.finalize(device="cpu"), dt=1e-3, integrator=wf.GeneralizedAlpha(rho_inf=1.0))
    with pytest.raises(wf.ModelError, match=r"rho_inf = 1.*a drive"):
        wf.Simulation(pulled(False), dt=1e-3, integrator="generalized_alpha(rho_inf=1)")
    wf.Simulation(pulled(True), dt=1e-3, integrator="generalized_alpha(rho_inf=1)").step()


def test_integrators_by_their_words():
    assert integrators.find_integrator("generalized_alpha").rho_inf == 0.2
    assert (
        integrators.find_integrator(" generalized_alpha ( rho_inf = 0.25 )").label == "generalized_alpha(rho_inf=0.25)"
    )
    assert integrators.find_integrator("bdf2()") is integrators.find_integrator("bdf2")
    scheme = wf.GeneralizedAlpha(rho_inf=0.3)
    assert integrators.find_integrator(scheme) is scheme
    for rho in (0.3, 1.0 / 3.0, 0.0):
        assert integrators.find_integrator(wf.GeneralizedAlpha(rho_inf=rho).label).rho_inf == rho  # to the last digit
    for text, words in (
        ("generalised_alpha", "did you mean 'generalized_alpha'"),
        ("generalized_alpha(rho_in=0.5)", "did you mean 'rho_inf'"),
        ("generalized_alpha(0.5)", "no option '0.5'"),
        ("generalized_alpha(rho_inf=half)", "rho_inf=half is not a number"),
        ("generalized_alpha(rho_inf=2)", "between 0 and 1"),
        ("bdf2(rho_inf=0.5)", "it has none"),
        ("static", "unknown"),
    ):
        with pytest.raises(wf.ModelError) as found:
            integrators.find_integrator(text)
        assert words in str(found.value)
