"""The banded preconditioner: factors against scipy, matrices that are not positive, when it is chosen, resumed runs."""

from types import SimpleNamespace

import numpy as np
import pytest
import scipy.sparse.linalg as spl
import warp as wp
from warpfea.kernels.solvers.band import BLOCK

import warpfea as wf
from warpfea.builder.scene import find
from warpfea.simulation.checkpoint import save_checkpoint
from warpfea.solvers import choose_solver
from warpfea.solvers.band import MAX_AUTO_WIDTH, Band, find_band
from warpfea.studies.bench.problems import PROBLEMS

SIZES = {"bar": (12, 1, 1), "beam": 60, "plate": (12, 1)}


def simulation(builder, *, dtype="float64", worlds=1, dt=1e-3, **options):
    model = builder.finalize(device="cpu", dtype=dtype, worlds=worlds)
    return wf.Simulation(model, dt=dt, solver=wf.NewtonPCG(**options), ledger=False, capture=False)


def parts(sim):
    """The factors, the assembly, and ones for all worlds."""
    pre = sim.stepper.newton.preconditioner
    return pre.band, pre.assembler, wp.ones(sim.model.worlds, dtype=wp.int32, device="cpu")


def assembled(sim, u, *, projected):
    _, matrix, on = parts(sim)
    out, work = matrix.allocate_values("test"), sim.stepper.work
    iterate = work.iterate(u, work.v_stage, work.step.dq_dv)
    matrix.assemble(iterate, work.step.mass_factor, on, out, projected=projected)
    return out


def on_diagonal(matrix):
    """Which entries of the pattern are diagonal blocks."""
    graph = matrix.pattern.graph
    return np.repeat(np.arange(graph.shape[0]), np.diff(graph.indptr)) == graph.indices


def solved(sim, r):
    """B r of each world, (worlds, 3 slots)."""
    band, _, on = parts(sim)
    model = sim.model
    given = wp.array(r.reshape(model.worlds, -1, 3), dtype=model.types.vec3, device="cpu")
    z = wp.zeros_like(given)
    band.solve(given, z, on)
    return z.numpy().reshape(model.worlds, -1).astype(float)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("name", SIZES)
def test_factors_against_scipy(name, dtype):
    sim = simulation(PROBLEMS[name].build(SIZES[name]), dtype=dtype)
    sim.step()
    band, matrix, on = parts(sim)
    value = assembled(sim, sim.stepper.work.u, projected=True)
    band.factorise(value, on)
    assert not band.diagonal_shift.numpy().any()
    H = matrix.host_csr(value).tocsc().astype(float)
    r = np.random.default_rng(0).standard_normal(H.shape[0]) * sim.model.slot_table.free.ravel()
    expected = spl.spsolve(H, r)
    limit = {"float64": 1e-9, "float32": 2e-2}[dtype]
    assert np.linalg.norm(solved(sim, r)[0] - expected) < limit * np.linalg.norm(expected)


def test_the_band_holds_all_of_the_pattern():
    for name, size in SIZES.items():
        sim = simulation(PROBLEMS[name].build(size))
        _, matrix, _ = parts(sim)
        band = find_band(sim.model)
        place = band.slot_position.numpy()
        np.testing.assert_array_equal(place[band.slot_order.numpy()], np.arange(sim.model.slots))
        entries = matrix.pattern.graph.tocoo()
        reach = (3 * place[entries.row] + 2) // BLOCK - (3 * place[entries.col]) // BLOCK
        assert reach.max() == band.half_bandwidth
        assert band.block_rows * BLOCK >= 3 * sim.model.slots


def column(h=1.0):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    box = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(10, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1.0))
    b.clamp(box.nodes("x-"))
    return b


def test_of_a_matrix_that_is_not_positive_they_still_are():
    """A column pressed beyond its buckling load."""
    sim = simulation(column(), dt=1.0)
    sim.step()
    u = sim.stepper.work.u.numpy()
    u[0, :, 0] -= 0.3 * (sim.model.slot_table.reference[:, 0] - sim.model.slot_table.reference[:, 0].min())
    band, matrix, on = parts(sim)
    value = assembled(sim, wp.array(u, dtype=sim.model.types.vec3, device="cpu"), projected=False)
    assert np.linalg.eigvalsh(matrix.host_csr(value).toarray())[0] < 0.0
    band.factorise(value, on)
    assert 0.0 < band.diagonal_shift.numpy()[0] <= 1.0
    B = np.stack([solved(sim, e)[0] for e in np.eye(3 * sim.model.slots)])
    assert np.all(np.isfinite(B))
    np.testing.assert_allclose(B, B.T, rtol=0, atol=1e-10 * np.abs(B).max())
    assert np.linalg.eigvalsh(0.5 * (B + B.T))[0] > 0.0


def test_no_shift_makes_it_positive_and_unknowns_go_alone():
    sim = simulation(column())
    sim.step()
    band, matrix, on = parts(sim)
    value = assembled(sim, sim.stepper.work.u, projected=True)
    blocks, diagonal = value.numpy(), on_diagonal(matrix)
    blocks[0, ~diagonal] *= 30.0
    value.assign(blocks)
    band.factorise(value, on)
    assert band.failed.numpy()[0] > 0
    B = np.stack([solved(sim, e)[0] for e in np.eye(3 * sim.model.slots)])
    assert np.all(np.isfinite(B))
    assert np.linalg.eigvalsh(0.5 * (B + B.T))[0] > 0.0


def test_worlds_that_are_not_flagged_keep_theirs():
    sim = simulation(PROBLEMS["beam"].build(4), worlds=3)
    sim.step()
    band, _, on = parts(sim)
    value = assembled(sim, sim.stepper.work.u, projected=True)
    band.factorise(value, on)
    before = band.factors.numpy().copy()
    value.assign(2.0 * value.numpy())
    band.factorise(value, wp.array([0, 1, 0], dtype=wp.int32, device="cpu"))
    after = band.factors.numpy()
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    assert not np.array_equal(after[1], before[1])


def kind(sim):
    assert (sim.methods["preconditioner"] == "banded") == (sim.stepper.newton.preconditioner.band is not None)
    return sim.methods["preconditioner"]


def test_auto_takes_it_where_the_band_is_narrow():
    assert kind(simulation(PROBLEMS["bar"].build((30, 1, 1)))) == "banded"
    assert kind(simulation(PROBLEMS["bar"].build((9, 6, 6)))) == "two-level"
    assert kind(simulation(PROBLEMS["bar"].build((9, 6, 6)), preconditioner="banded")) == "banded"
    assert kind(simulation(PROBLEMS["bar"].build((30, 1, 1)), preconditioner="two-level")) == "two-level"
    # with inverses in another precision there are only levels
    assert kind(simulation(PROBLEMS["bar"].build((30, 1, 1)), preconditioner_dtype="float32")) == "two-level"
    with pytest.raises(wf.ModelError, match=r"'banded' keeps its factors in.*float64: leave out.*'float32', or take"):
        simulation(PROBLEMS["bar"].build((3, 1, 1)), preconditioner="banded", preconditioner_dtype="float32")


def test_on_a_gpu_it_is_for_small_models():
    def beam(elements):
        b = wf.ModelBuilder()
        steel = wf.SVK(E=2e11, nu=0.3, density=7800.0)
        b.add_beam(
            [(0, 0, 0), (1, 0, 0)],
            elements=elements,
            section=wf.Rectangle(0.02, 0.02),
            normal=(0, 0, 1),
            material=steel,
        )
        return b.finalize(device="cpu")

    small, large = beam(16), beam(200)
    cuda, banded = SimpleNamespace(is_cuda=True), wf.NewtonPCG(preconditioner="banded")
    assert choose_solver(small, small.device).preconditioner == "banded"
    assert choose_solver(small, cuda, options=banded).preconditioner == "banded"
    assert choose_solver(small, cuda).preconditioner == "two-level"
    assert choose_solver(small, cuda, many=True).preconditioner == "banded"
    assert choose_solver(large, cuda, many=True).preconditioner == "two-level"
    with pytest.raises(wf.ModelError, match=r"on a GPU for small models with a narrow band; .* take 'auto' or"):
        choose_solver(large, cuda, options=banded)


def test_wider_bands_are_kept_for_longer():
    def band(width):
        return Band(wp.zeros(0, dtype=wp.int32), wp.zeros(0, dtype=wp.int32), 100, width)

    costs = [band(width).rebuild_cost for width in (5, 20, MAX_AUTO_WIDTH)]
    assert costs[2] > 2.0 * costs[0]
    assert band(5).cheap_to_factorise
    assert not band(MAX_AUTO_WIDTH).cheap_to_factorise


@pytest.mark.parametrize("links", [10, 40])
def test_chains_of_joints_take_few_iterations(links):
    scene = find("chain")
    model = scene.build(scene.resolve({"links": links})).finalize(device="cpu")
    counts, ends = {}, {}
    for name in ("auto", "banded", "two-level"):
        sim = wf.Simulation(model, dt=1e-3, solver=wf.NewtonPCG(preconditioner=name, tol=1e-11), ledger=False)
        reports = [sim.step() for _ in range(5)]
        counts[name] = sum(int(r.pcg[0]) for r in reports)
        ends[name] = sim.state.displacement.numpy()
    assert counts["auto"] == counts["banded"]
    assert counts["banded"] <= 4 * sum(int(r.newton[0]) for r in reports)
    assert counts["banded"] <= counts["two-level"]
    np.testing.assert_allclose(ends["banded"], ends["two-level"], rtol=0, atol=1e-8 * model.size)


def swinging(name, damping):
    law = wf.SVK(E=1e7, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(eta=500.0, lambda_v=700.0) if damping else None)
    b = wf.ModelBuilder()
    if name == "T10":
        body = b.add_solid(wf.mesh.box((1.0, 0.1, 0.1), cells=(10, 1, 1)), material=law)
        b.clamp(body.nodes("x-"))
    else:
        section = wf.Rectangle(0.05, 0.05)
        body = b.add_beam([(0, 0, 0), (1, 0, 0)], elements=12, section=section, normal=(0, 0, 1), material=law)
        b.clamp(body.start)
    return b


@pytest.mark.parametrize("damping", [False, True])
@pytest.mark.parametrize("name", ["T10", "3243"])
def test_a_resumed_run_does_the_same(name, damping, tmp_path):
    def run():
        return wf.Simulation(swinging(name, damping).finalize(device="cpu"), dt=5e-3)

    whole = run()
    assert kind(whole) == "banded"
    whole.step(6)
    save_checkpoint(whole, tmp_path / "half.npz")
    whole.step(6)
    resumed = run()
    resumed.resume(tmp_path / "half.npz")
    resumed.step(6)
    for field, values in whole.state.numpy().items():
        np.testing.assert_array_equal(resumed.state.numpy()[field], values, err_msg=field)


def slender(dtype, elements=256):
    b = wf.ModelBuilder()
    law = wf.SVK(E=2e11, nu=0.3, density=7800.0)
    section = wf.Rectangle(0.01, 0.01)
    body = b.add_beam([(0, 0, 0), (1, 0, 0)], elements=elements, section=section, normal=(0, 0, 1), material=law)
    b.clamp(body.start)
    return b.finalize(device="cpu", dtype=dtype)


def test_what_rounding_takes_is_given_back_and_no_more():
    """A steel wire in float32: the last pivots are rounding."""
    with pytest.raises(wf.ConvergenceError, match="float32 round-off limit reached"):
        wf.Simulation(slender("float32"), dt=1e-3, ledger=False).step()
    sim = wf.Simulation(slender("float32", elements=64), dt=1e-3, ledger=False)
    for _ in range(3):
        sim.step()
    assert 0.0 <= sim.stepper.newton.preconditioner.band.diagonal_shift.numpy()[0] < 1e-4
    assert sim.totals["pcg"][0] < 2000
    exact = wf.Simulation(slender("float64"), dt=1e-3, ledger=False)
    exact.step(3)
    assert exact.stepper.newton.preconditioner.band.diagonal_shift.numpy()[0] == 0.0


def test_what_another_preconditioner_remembers_is_not_taken_over(tmp_path):
    def run(name):
        solver = wf.NewtonPCG(preconditioner=name, operator="elements")
        return wf.Simulation(swinging("T10", False).finalize(device="cpu"), dt=5e-3, solver=solver)

    first = run("two-level")
    first.step(4)
    save_checkpoint(first, tmp_path / "levels.npz")
    other = run("banded")
    other.resume(tmp_path / "levels.npz")
    np.testing.assert_array_equal(other.state.displacement.numpy(), first.state.displacement.numpy())
    assert not other.state.preconditioner_banded.numpy()[0, 3:].any()  # iterations of the first solve, and since
    other.step(2)
    assert 0.0 < other.state.preconditioner_banded.numpy()[0, 3] < 1.5


def test_factors_that_could_not_be_addressed_are_refused(monkeypatch):
    monkeypatch.setattr("warpfea.solvers.band.MAX_FACTOR_BYTES", 10000)
    with pytest.raises(wf.ModelError, match=r"'banded': the factors of \d+ slots in a band of 68 unknowns take"):
        simulation(PROBLEMS["bar"].build((12, 1, 1)), preconditioner="banded")
    assert kind(simulation(PROBLEMS["bar"].build((12, 1, 1)))) == "two-level"


def test_arrays_that_could_not_be_addressed_are_refused():
    sim = simulation(PROBLEMS["bar"].build((2, 1, 1)))
    with pytest.raises(wf.ModelError, match=r"big: an array of 2 x 300000000 items has 2.2 GiB between"):
        sim.stepper.work.array("big", (2, 300000000), wp.float64)


def test_negative_numbers_on_the_diagonal_take_the_other_sign():
    sim = simulation(PROBLEMS["beam"].build(4))
    sim.step()
    band, matrix, on = parts(sim)
    value = assembled(sim, sim.stepper.work.u, projected=True)
    blocks, diagonal = value.numpy(), on_diagonal(matrix)
    blocks[0, ~diagonal] = 0.0
    blocks[0, diagonal] = np.diag([1.0, 2.0, -4.0])
    value.assign(blocks)
    band.factorise(value, on)
    assert band.diagonal_shift.numpy()[0] == 0.0
    z = solved(sim, np.ones(3 * sim.model.slots))[0]
    np.testing.assert_allclose(z.reshape(-1, 3), np.tile([1.0, 0.5, 0.25], (sim.model.slots, 1)), rtol=1e-12)


def test_all_preconditioners_end_in_one_place():
    ends = []
    for name in ("banded", "two-level", "block-jacobi"):
        solver = wf.NewtonPCG(preconditioner=name, tol=1e-11)
        sim = wf.Simulation(swinging("3243", True).finalize(device="cpu"), dt=2e-3, solver=solver, ledger=False)
        sim.step(10)
        ends.append(sim.state.displacement.numpy())
    for other in ends[1:]:
        np.testing.assert_allclose(ends[0], other, rtol=0, atol=1e-8 * np.abs(other).max())
