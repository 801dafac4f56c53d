"""Clusters of straight elements: every contribution is summed once, however elements and slots are ordered."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp
from product_state import DT, apply, prepare
from warpfea.kernels.elements.element_clusters import cluster_size, slot_capacity, table_layout

import warpfea as wf
from warpfea.solvers.clusters import cluster_tables


def summed(conn, size, values, n):
    """Sums by the kernel of contributions [element, local], from the tables alone."""
    count, slots = conn.shape
    t = cluster_tables(conn, size)
    place, start, words = table_layout(size, slots)
    table = t.table.view(np.uint16).reshape(-1, 2 * words).astype(int)
    assert (t.start[0], t.start[-1]) == (0, count)
    out = np.zeros(n)
    for k, (begin, end) in enumerate(zip(t.start[:-1], t.start[1:])):
        own = t.slot[t.slot_start[k] : t.slot_start[k + 1]]
        assert 0 < end - begin <= size
        assert len(own) == len(set(own)) <= slot_capacity(size, slots)
        elem = np.arange(end - begin)
        for i in range(slots):
            at = table[k, place + i * size + elem]
            np.testing.assert_array_equal(own[at], conn[begin:end, i])
        for j, slot in enumerate(own):
            for e in range(table[k, start + j], table[k, start + j + 1]):
                local, elem = divmod(table[k, e], size)
                assert conn[begin + elem, local] == slot
                out[slot] += values[begin + elem, local]
    return out


@pytest.mark.parametrize("size", [32, 64, 128])
@pytest.mark.parametrize(("count", "slots", "n"), [(1, 4, 4), (64, 10, 90), (300, 10, 5000), (300, 4, 60)])
def test_every_contribution_is_summed_once(size, count, slots, n):
    rng = np.random.default_rng(count)
    conn = np.array([rng.choice(n, slots, replace=False) for _ in range(count)])
    values = rng.uniform(-1, 1, conn.shape)
    expected = np.zeros(n)
    np.add.at(expected, conn, values)
    np.testing.assert_allclose(summed(conn, size, values, n), expected, atol=1e-14)


def test_sizes_of_clusters():
    assert [cluster_size("float32", n, fit=True) for n in (1, 32, 33, 64, 65, 1000)] == [32, 32, 64, 64, 128, 128]
    assert [cluster_size("float64", n, fit=True) for n in (1, 32, 33, 1000)] == [32, 32, 64, 64]
    assert [cluster_size(dtype, 1, fit=False) for dtype in ("float32", "float64")] == [128, 64]


def test_clusters_with_too_many_slots_are_halved():
    conn = np.arange(640).reshape(64, 10)
    assert np.diff(cluster_tables(conn, 64).start).tolist() == [32, 32]


@pytest.mark.parametrize(
    ("element", "dtype", "tol"), [("T10", "float64", 1e-12), ("T10", "float32", 1e-4), ("T4", "float64", 1e-12)]
)
def test_product_of_elements_in_any_order(element, dtype, tol):
    mesh = wf.mesh.box((1, 1, 1), cells=(4, 4, 3), element=element)
    rng = np.random.default_rng(1)
    order, to = rng.permutation(len(mesh.cells)), rng.permutation(len(mesh.points))
    points = np.empty_like(mesh.points)
    points[to] = mesh.points
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    shuffled = wf.mesh.Mesh(points, to[mesh.cells][order], mesh.cell_type)
    body = b.add_solid(shuffled, material=wf.SVK(E=1e6, nu=0.3, density=1e3))
    b.clamp(body.nodes(lambda X: X[:, 0] < 1e-9))
    model = b.finalize(device="cpu", dtype=dtype)
    sim, residual = prepare(model, "elements")
    ((_, clusters),) = residual.clusters.blocks
    assert (clusters > 1 + len(mesh.cells) // model.blocks[0].cluster_size) == (element == "T10")  # some were halved
    direction, out = apply(model, residual)
    p, dt = direction.numpy()[0].astype(float), DT
    exact = b.finalize(device="cpu") if dtype == "float32" else model
    state = exact.state()
    state.displacement.assign(sim.stepper.work.u.numpy().astype(float))
    expected = model.masses.matrix @ p / dt + dt * (exact.tangent_matrix(state) @ p.ravel()).reshape(-1, 3)
    expected *= model.slot_table.free
    assert np.abs(out.numpy()[0] - expected).max() < tol * np.abs(expected).max()


@pytest.mark.parametrize(("dtype", "tol"), [("float64", 1e-14), pytest.param("float32", 1e-5, marks=pytest.mark.slow)])
def test_several_blocks_and_worlds_against_the_plain_sum(dtype, tol):
    b = wf.ModelBuilder()
    for k, (element, form) in enumerate([("T10", "rate"), ("T4", None), ("T10", "incremental")]):
        damping = wf.KelvinVoigt(2e4, 3e4, form=form) if form else None
        mesh = wf.mesh.box((1, 1, 1), cells=(3, 3, 2 + k), element=element, origin=(2 * k, 0, 0))
        b.clamp(b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1e3, damping=damping)).nodes("x-"))
    model = b.finalize(device="cpu", dtype=dtype, worlds=3)
    sim = wf.Simulation(model, dt=1e-3, solver=wf.NewtonPCG(operator="elements"))
    residual, w = sim.stepper.newton.residual, sim.stepper.work
    rng = np.random.default_rng(5)
    for field in (w.u, w.v, w.p):
        field.assign((0.05 * rng.uniform(-1, 1, (3, model.slots, 3))).astype(dtype))
    w.history.assign((0.05 * rng.uniform(-1, 1, (3, model.history_count, 6))).astype(dtype))
    w.step.mass_factor.assign([1e3, 2e3, 3e3])
    w.step.dq_dv.assign([1e-3, 2e-3, 3e-3])
    active = wp.array([1, 0, 1], dtype=wp.int32, device="cpu")
    got = []
    for clusters in (residual.clusters, None):
        residual.clusters = clusters
        w.contribution.fill_(np.nan)
        residual.cluster_memory.numbers.fill_(np.nan)
        w.Hp.fill_(7.0)
        residual.product(w.p, w.Hp, active)
        got.append(w.Hp.numpy().astype(float))
    assert np.all(got[0][1] == 7.0)
    assert np.abs(got[0] - got[1]).max() < tol * np.abs(got[1]).max()
