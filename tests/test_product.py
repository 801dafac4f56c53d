"""H v by elements and by matrix on tiny problems of `warpfea bench`: both are the matrix of the step."""

import numpy as np
import pytest
from product_state import DT, apply, prepare

from warpfea.studies.bench.problems import LAW, PROBLEMS

SIZES = {"bar": (2, 1, 1), "beam": 2, "plate": 1, "ENMC": (1, 1, 1), "FN18": (1, 1, 1)}


def model_of(name, dtype="float64"):
    """A small model without damping."""
    return PROBLEMS[name].build(SIZES[name], law=LAW).finalize(device="cpu", dtype=dtype)


@pytest.mark.parametrize("name", SIZES)
def test_both_operators_are_the_matrix_of_the_step(name):
    model = model_of(name)
    got = {}
    for operator in ("elements", "matrix"):
        sim, residual = prepare(model, operator)
        assert residual.plan.uses_matrix == (operator == "matrix")
        direction, out = apply(model, residual)
        got[operator] = out.numpy()[0]
    state = model.state()
    state.displacement.assign(sim.stepper.work.u)
    assert np.abs(sim.stepper.work.u.numpy()).max() > 0.0
    p, dt = direction.numpy()[0], DT
    expected = model.masses.matrix @ p / dt + dt * (model.tangent_matrix(state) @ p.ravel()).reshape(-1, 3)
    expected *= model.slot_table.free
    for value in got.values():
        assert np.abs(value - expected).max() < 1e-11 * np.abs(expected).max()


@pytest.mark.parametrize("name", [*SIZES, "H3843"])
def test_unknowns_of_a_size(name):
    size = PROBLEMS[name].size_for(1000)
    model = PROBLEMS[name].build(size).finalize(device="cpu")
    assert PROBLEMS[name].unknowns(size) == model.info()["unknowns"]
    assert PROBLEMS[name].unknowns(size) == pytest.approx(1000, rel=0.3)
