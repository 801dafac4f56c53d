"""Mixed integration points: H with the stress of the linear prediction, by matrix and by elements."""

import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea.simulation.statics import begin_static

LAWS = {
    "svk": wf.SVK(E=1e6, nu=0.3, density=1000.0),
    "neo_hookean": wf.NeoHookean.from_E_nu(E=1e6, nu=0.3, density=1000.0),
}


def static(kind: str, operator: str, device: str = "cpu", dtype: str = "float64") -> wf.Simulation:
    """A static loop of a short body, before its first load step."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    if kind == "beam":
        section = wf.Rectangle(0.1, 0.1)
        body = b.add_beam([(0, 0, 0), (1, 0, 0)], elements=2, section=section, normal=(0, 0, 1), material=LAWS["svk"])
        b.clamp(body.start)
    else:
        body = b.add_solid(wf.mesh.box((1, 0.3, 0.3), cells=(2, 1, 1), element="T10"), material=LAWS[kind])
        b.clamp(body.nodes("x-"))
    solver = wf.NewtonPCG(operator=operator)
    return begin_static(b.finalize(device=device, dtype=dtype), load_steps=1, solver=solver)


def placed(sim: wf.Simulation, mixed: int, amount: float = 0.02) -> np.ndarray:
    """Put an iterate and the one before into the work arrays; returns a direction (1, slots, 3)."""
    w, rng = sim.stepper.work, np.random.default_rng(3)
    shape = w.u.numpy().shape
    kind = w.u.numpy().dtype
    free = sim.model.slot_table.free
    before = amount * rng.standard_normal(shape) * free
    now = before + amount * rng.standard_normal(shape) * free
    w.base_velocity.assign(before.astype(kind))
    w.v.assign(now.astype(kind))
    w.u.assign(now.astype(kind))
    w.step.dq_dv.fill_(1.0)
    w.step.mass_factor.zero_()
    w.newton.solve.predicted_stress.fill_(mixed)
    return rng.standard_normal(shape) * free


def product(sim: wf.Simulation, direction: np.ndarray) -> np.ndarray:
    """H p on the free components at the iterate in the work arrays."""
    w, residual = sim.stepper.work, sim.stepper.newton.residual
    on = wp.ones(1, dtype=wp.int32, device=sim.model.device)
    w.p.assign(direction.astype(w.p.numpy().dtype))
    residual.assemble_matrix(on)
    residual.product(w.p, w.Hp, on)
    return w.Hp.numpy().astype(float) * sim.model.slot_table.free


@pytest.mark.parametrize("mixed", [1, 2])
@pytest.mark.parametrize("kind", ["svk", "neo_hookean", "beam"])
def test_matrix_and_elements_agree(kind: str, mixed: int) -> None:
    """Both operators are the same H, and another one than that of the iterate alone."""
    results = {}
    for operator in ("matrix", "elements"):
        sim = static(kind, operator)
        p = placed(sim, mixed)
        results[operator] = product(sim, p)
        sim.stepper.work.newton.solve.predicted_stress.zero_()
        results[operator, "plain"] = product(sim, p)
    size = np.abs(results["matrix"]).max()
    np.testing.assert_allclose(results["elements"], results["matrix"], atol=1e-12 * size)
    assert np.abs(results["matrix"] - results["matrix", "plain"]).max() > 1e-3 * size


@pytest.mark.parametrize("kind", ["svk", "neo_hookean", "beam"])
def test_stress_is_that_of_the_linear_prediction(kind: str) -> None:
    """The difference from the stress of the iterate is of second order in the last step."""
    sim = static(kind, "matrix")
    p = placed(sim, 1, amount=1e-3)
    w = sim.stepper.work
    now, before = w.v.numpy(), w.base_velocity.numpy()
    difference = []
    for part in (1.0, 0.5):
        w.base_velocity.assign(now - part * (now - before))
        w.newton.solve.predicted_stress.fill_(1)
        mixed = product(sim, p)
        w.newton.solve.predicted_stress.zero_()
        difference.append(np.sum(p * (mixed - product(sim, p))))
    assert difference[0] / difference[1] == pytest.approx(4.0, rel=0.05)


@pytest.mark.parametrize("kind", ["svk", "neo_hookean", "beam"])
def test_positive_matrix_has_no_negative_curvature(kind: str) -> None:
    """An indefinite linear prediction is replaced by a positive semi-definite H."""
    sim = static(kind, "matrix")
    placed(sim, 2)
    w = sim.stepper.work
    squeezed = np.zeros(w.u.numpy().shape)
    if kind == "beam":
        squeezed[..., 1::4, 0] = -0.2  # the axial gradients
    squeezed[..., 0] -= 0.2 * _places(sim)
    squeezed *= sim.model.slot_table.free
    for array in (w.u, w.v, w.base_velocity):
        array.assign(squeezed.astype(array.numpy().dtype))
    lowest = {}
    for mixed in (2, 0):
        w.newton.solve.predicted_stress.fill_(mixed)
        residual = sim.stepper.newton.residual
        residual.assemble_matrix(wp.ones(1, dtype=wp.int32))
        dense = residual.assembler.host_csr(residual.operator_matrix).toarray()
        values = np.linalg.eigvalsh(0.5 * (dense + dense.T))
        lowest[mixed] = values[0] / values[-1]
    assert lowest[2] > -1e-12
    assert lowest[0] < -1e-6


def _places(sim: wf.Simulation) -> np.ndarray:
    """(slots,) reference x of position slots, 0 of gradients, m."""
    (body,) = sim.model.bodies
    x = np.zeros(sim.model.slots)
    nodes = body.mesh.points[:, 0]
    x[:: len(x) // len(nodes)] = nodes
    return x
