"""Large and small bodies in float32: 3x3 blocks whose determinants it can't hold."""

import functools

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.common.inverse import inverse_function
from warpfea.kernels.common.modules import kernel_module
from warpfea.kernels.common.types import precision

import warpfea as wf


@functools.cache
def invert(dtype):
    """A kernel that inverts blocks on their free components."""
    p = precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33
    free_inverse = inverse_function(dtype)

    @wp.kernel(module=kernel_module(f"test_inverse_{dtype}"))
    def kernel(A: wp.array(dtype=mat33), free: wp.array(dtype=vec3), out: wp.array(dtype=mat33)):
        i = wp.tid()
        out[i] = free_inverse(A[i], T(0.0), free[i])

    def run(blocks, free):
        out = wp.zeros(len(blocks), dtype=mat33, device="cpu")
        given = [wp.array(x, dtype=t, device="cpu") for x, t in ((blocks, mat33), (free, vec3))]
        wp.launch(kernel, len(blocks), [*given, out], device="cpu")
        return out.numpy().astype(float)

    return run


@pytest.mark.parametrize(("dtype", "tol", "powers"), [("float32", 2e-5, (-92, 100)), ("float64", 1e-12, (-92, 300))])
def test_inverses_of_blocks_of_any_size(dtype, tol, powers):
    rng = np.random.default_rng(0)
    root = rng.standard_normal((20, 3, 3))
    A = root @ np.swapaxes(root, 1, 2) + np.eye(3)
    free = np.ones((20, 3))
    free[::4, 1] = 0.0
    exact = np.zeros_like(A)
    for k in range(20):
        at = np.ix_(*[np.flatnonzero(free[k])] * 2)
        exact[k][at] = np.linalg.inv(A[k][at])
    for power in (*powers, 0, -50, 50):
        scaled = invert(dtype)(A * 2.0**power, free) * 2.0**power
        assert np.abs(scaled - exact).max() < tol


def test_indefinite_blocks_give_positive_inverses():
    A = np.diag([2.0, -4.0, 1.0]) + 0.1
    for power in (-90, 0, 90):
        B = invert("float32")(np.array([A]) * 2.0**power, np.ones((1, 3)))[0] * 2.0**power
        np.testing.assert_allclose(B, np.diag(1.0 / np.abs(np.diag(A))), rtol=1e-6)


CASES = {  # edge (m), E (Pa): float32 has no product of three stiffnesses of these
    "steel of 1 km": (1e3, 2.1e11),
    "steel of 100 km": (1e5, 2.1e11),
    "jelly of 1 mm": (1e-3, 1e-3),
}


def bent(edge, E, dtype):
    """A block of two by two by two cells, held at one end, whose other end a traction of 1 % of E draws aside."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=E, nu=0.3, density=7850.0)
    body = b.add_solid(wf.mesh.box((edge, edge, edge), cells=(2, 2, 2)), material=law)
    b.clamp(body.nodes("x-"))
    b.add_traction(body.surface("x+"), (0, 0, -0.01 * E))
    b.add_probe("tip", body.surface("x+"))
    return b.finalize(device="cpu", dtype=dtype)


@functools.cache
def statics(edge, E, dtype):
    """Deflection over the edge, and the iterations that it took."""
    result = wf.solve_static(bent(edge, E, dtype), load_steps=1, solver=wf.NewtonPCG(preconditioner="block-jacobi"))
    return result.probe("tip").displacement[0, -1] / edge, int(result.simulation.totals["pcg"][0])


@pytest.mark.filterwarnings("ignore:body 'box' is")
@pytest.mark.parametrize("case", CASES)
def test_statics_of_any_size_in_float32(case):
    """The same shape and, within rounding, as many iterations as the block of 1 m takes."""
    shape, count = statics(*CASES[case], "float32")
    exact, _ = statics(1.0, 2.1e7, "float64")
    _, usual = statics(1.0, 2.1e7, "float32")
    assert np.abs(shape - exact).max() < 1e-4 * np.abs(exact).max()
    assert count <= 1.1 * usual + 2


@pytest.mark.filterwarnings("ignore:body 'box' is")
@pytest.mark.parametrize("case", CASES)
def test_steps_of_any_size_in_float32(case):
    edge, E = CASES[case]
    dt = 0.2 * edge * np.sqrt(7850.0 / E)  # a fifth of the time that a wave takes through the block
    tips = {}
    for dtype in ("float32", "float64"):
        sim = wf.Simulation(bent(edge, E, dtype), dt=dt, solver=wf.NewtonPCG(preconditioner="block-jacobi"))
        assert sim.step(3).converged.all()
        tips[dtype] = sim.probe("tip").displacement[0, -1] / edge
    assert np.abs(tips["float32"] - tips["float64"]).max() < 1e-3 * np.abs(tips["float64"]).max()
