"""The two-level preconditioner: its partition, matrices and inverses against numpy."""

import numpy as np
import pytest
import scipy.sparse as sp
import warp as wp
from two_level_models import bar

import warpfea as wf
from warpfea.model.partition import bisect_groups, connected_groups, morton_order
from warpfea.solvers.matrix_assembly import MatrixAssembler
from warpfea.studies.bench.problems import PROBLEMS


def simulation(builder, *, device="cpu", dtype="float64", dt=1e-3, shake=0.0, **options):
    """A simulation after one step, with the operator made at its state, shaken by so much."""
    model = builder.finalize(device=device, dtype=dtype)
    options = {"preconditioner": "two-level"} | options
    sim = wf.Simulation(model, dt=dt, solver=wf.NewtonPCG(**options), ledger=False, capture=False)
    sim.step()
    work = sim.stepper.work
    if shake:
        u = work.u.numpy()
        u += shake * np.random.default_rng(0).standard_normal(u.shape) * (model.slot_table.free > 0)
        work.u.assign(u)
    return sim


def on(sim):
    return wp.ones(sim.model.worlds, dtype=wp.int32, device=sim.model.device)


def product(sim, p):
    work, residual = sim.stepper.work, sim.stepper.newton.residual
    work.p.assign(p.reshape(work.p.numpy().shape))
    residual.assemble_matrix(on(sim))
    residual.product(work.p, work.Hp, on(sim))
    return work.Hp.numpy()[0].ravel().astype(float)


def assembled(sim, *, projected, whole=None):
    work, residual = sim.stepper.work, sim.stepper.newton.residual
    matrix = residual.assembler
    if whole is not None:
        matrix = MatrixAssembler(sim.model, work, sim.stepper.launch, residual.block_kernels, whole)
    out = matrix.allocate_values("test")
    matrix.assemble(work.stage, work.step.mass_factor, on(sim), out, projected=projected)
    return matrix.host_csr(out)


def apply(sim, r):
    work = sim.stepper.work
    work.r.assign(r.reshape(work.r.numpy().shape))
    sim.stepper.newton.preconditioner.apply(work.r, work.z, on(sim))
    return work.z.numpy()[0].ravel().astype(float)


def random_free(sim, seed=1):
    free = sim.model.slot_table.free.ravel()
    return np.random.default_rng(seed).standard_normal(free.size) * free


def damped(form):
    material = wf.SVK(E=1e6, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(eta=50.0, lambda_v=70.0, form=form))
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    box = b.add_solid(wf.mesh.box((0.4, 0.1, 0.1), cells=(4, 1, 1)), material=material)
    b.clamp(box.nodes("x-"))
    return b


def askew(form):
    """A beam along no axis, with viscosity."""
    law = wf.SVK(E=1e7, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(eta=50.0, lambda_v=70.0, form=form))
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    section = wf.Rectangle(0.05, 0.03)
    body = b.add_beam([(0, 0, 0), (0.6, 0.5, 0.4)], elements=3, section=section, normal=(0, 0, 1), material=law)
    b.clamp(body.start)
    return b


def bent():
    """A box whose middle nodes lie off the middle."""
    mesh = wf.mesh.box((3.0, 2.0, 1.0), cells=(1, 1, 1), element="T10")
    inside = (mesh.points[:, :1] > 0) & (mesh.points[:, :1] < 3)
    points = mesh.points + 0.02 * inside * np.sin(mesh.points[:, [1, 2, 0]])
    return wf.mesh.Mesh(points, mesh.cells, mesh.cell_type)


def rubber():
    material = wf.MooneyRivlin(mu10=3e5, mu01=1e5, k=1e7, density=1000.0)
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    box = b.add_solid(wf.mesh.box((0.4, 0.1, 0.1), cells=(4, 1, 1)), material=material)
    b.clamp(box.nodes("x-"))
    return b


SCENES = {
    "T10": lambda: bar(300),
    "T10 rubber": rubber,
    "T10 incremental": lambda: damped("incremental"),
    "T10 rate": lambda: damped("rate"),
    "3243": lambda: PROBLEMS["beam"].build(4),
    "3443": lambda: PROBLEMS["plate"].build(2),
    "3243 askew, incremental": lambda: askew("incremental"),
    "3243 askew, rate": lambda: askew("rate"),
    "3843": lambda: PROBLEMS["H3843"].build((2, 1, 1)),
    "ENMC": lambda: PROBLEMS["ENMC"].build((1, 1, 1)),
    "curved T10": lambda: PROBLEMS["bar"].build(bent()),
}


# the partition


@pytest.mark.parametrize("weight", [1, 4])
def test_groups_fit_and_stay_within_their_label(weight):
    rng = np.random.default_rng(0)
    X, labels = rng.random((500, 3)), rng.integers(0, 3, 500)
    group = bisect_groups(X, np.full(500, weight), labels, 16)
    sizes = np.bincount(group, minlength=0) * weight
    assert sizes.min() > 0
    assert sizes.max() <= 16
    assert sizes.mean() > 10  # they are well filled
    for g in range(len(sizes)):
        assert len(np.unique(labels[group == g])) == 1
    extent = np.mean([np.ptp(X[group == g], axis=0).max() for g in range(len(sizes))])
    assert extent < 0.6  # and compact


def test_items_larger_than_a_group_are_refused():
    with pytest.raises(ValueError, match="does not fit"):
        bisect_groups(np.zeros((2, 3)), np.array([4, 20]), np.zeros(2), 16)


def test_groups_are_split_into_connected_parts():
    graph = sp.csr_matrix(np.array([[1, 1, 0, 0], [1, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]))
    np.testing.assert_array_equal(connected_groups(np.array([0, 0, 0, 1]), graph), [0, 0, 1, 2])


def test_mortons_curve_keeps_neighbours_together():
    X = np.random.default_rng(0).random((4000, 3))
    jumps = [np.linalg.norm(np.diff(X[order], axis=0), axis=1).mean() for order in (np.arange(4000), morton_order(X))]
    assert jumps[1] < 0.2 * jumps[0]


def test_large_bodies_are_numbered_by_place_and_report_in_file_order(monkeypatch):
    ends = []
    for limit in (10**9, 0):
        monkeypatch.setattr("warpfea.model.discretisation.ORDERED_NODES", limit)
        b = bar(1000)
        model = b.finalize(device="cpu")
        sim = wf.Simulation(model, dt=1e-3, solver=wf.NewtonPCG(tol=1e-11))
        sim.step(3)
        body = model.bodies[0]
        own = sim.state.displacement.numpy()[:, body.slots]  # slots are in file order too
        np.testing.assert_array_equal(own, sim.displacements(body))
        ends.append((sim.positions(body), sim.field("von_mises", body), body.slots))
    assert not np.array_equal(ends[0][2], ends[1][2])
    for k in range(2):
        np.testing.assert_allclose(ends[0][k], ends[1][k], rtol=1e-9, atol=1e-9 * np.abs(ends[0][k]).max())


# the matrix


@pytest.mark.parametrize(
    ("scene", "dtype"),
    [
        pytest.param(scene, "float64", marks=[pytest.mark.slow] if scene in ("3243 askew, rate", "T10 rate") else [])
        for scene in SCENES
    ]
    + [pytest.param(s, "float32", marks=pytest.mark.slow) for s in ("T10 rubber", "3243 askew, incremental")],
)
def test_columns_and_whole_elements_give_one_matrix(scene, dtype):
    """The kernels of a GPU and those of the CPU, here both on the CPU."""
    sim = simulation(SCENES[scene](), shake=1e-3, dtype=dtype)
    for projected in (False, True):
        by_column, whole = (assembled(sim, projected=projected, whole=whole) for whole in (False, True))
        assert abs(by_column).max() > 0.0
        limit = {"float64": 2e-15, "float32": 1e-6}[dtype] * abs(by_column).max()
        assert abs(by_column - whole).max() < limit


@pytest.mark.parametrize("operator", ["elements", "matrix"])
@pytest.mark.parametrize("scene", SCENES)
def test_the_matrix_is_the_operator(scene, operator):
    sim = simulation(SCENES[scene](), shake=1e-3, operator=operator)
    p = random_free(sim)
    H = assembled(sim, projected=False)
    expected = (H @ p) * sim.model.slot_table.free.ravel()
    np.testing.assert_allclose(product(sim, p), expected, rtol=0, atol=1e-12 * np.abs(expected).max())


def test_operators_walk_the_same_way():
    ends = []
    for operator in ("elements", "matrix"):
        sim = wf.Simulation(
            PROBLEMS["plate"].build(2).finalize(device="cpu"),
            dt=1e-3,
            solver=wf.NewtonPCG(tol=1e-11, operator=operator),
        )
        sim.step(5)
        ends.append(sim.probe("tip").displacement)
    np.testing.assert_allclose(ends[0], ends[1], rtol=0, atol=1e-9 * np.abs(ends[0]).max())


@pytest.mark.parametrize("scene", SCENES)
def test_the_projected_matrix_is_positive(scene):
    sim = simulation(SCENES[scene](), shake=1e-3)
    H = assembled(sim, projected=True).toarray()
    np.testing.assert_allclose(H, H.T, rtol=0, atol=1e-13 * np.abs(H).max())
    assert np.linalg.eigvalsh(H)[0] > 0.0


def test_compression_makes_H_indefinite_but_not_what_the_preconditioner_is_made_of():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    box = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(10, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1.0))
    b.clamp(box.nodes("x-"))
    sim = simulation(b, dt=1.0)
    u = sim.stepper.work.u.numpy()
    X = box.mesh.points[:, 0] - box.mesh.points[:, 0].min()
    u[0, :, 0] = -0.3 * X
    sim.stepper.work.u.assign(u)
    values = [np.linalg.eigvalsh(assembled(sim, projected=projected).toarray())[0] for projected in (False, True)]
    assert values[0] < 0.0 < values[1]


# levels


def dense_apply(sim):
    n = 3 * sim.model.slots
    return np.stack([apply(sim, np.eye(n)[k]) for k in range(n)], axis=1)


@pytest.mark.parametrize("scene", ["T10", "3243"])
def test_a_small_model_is_inverted_as_a_whole(scene):
    sim = simulation(SCENES[scene]())
    assert sim.stepper.newton.preconditioner.levels[0].is_dense
    free = sim.model.slot_table.free.ravel() > 0
    place = sim.stepper.newton.preconditioner.reuse.linearisation_point
    sim.stepper.work.u.assign(place)
    H = assembled(sim, projected=True).toarray()[free][:, free]
    B = dense_apply(sim)[free][:, free]
    np.testing.assert_allclose(B @ H, np.eye(len(H)), rtol=0, atol=1e-7)


def coarse_functions(sim, depth=0):
    """P of a level from its groups and weights, (3 slots, 3 coarse slots)."""
    level = sim.stepper.newton.preconditioner.levels[depth]
    n = level.slot_count
    group, weight = level.device_data.group_of_slot.numpy(), level.device_data.affine_values.numpy()
    columns = (4 * group[:, None] + np.arange(4)).ravel()
    P = sp.csr_matrix((weight.ravel(), (np.repeat(np.arange(n), 4), columns)), shape=(n, 4 * level.group_count))
    return sp.kron(P, sp.eye(3)).tocsr()


@pytest.mark.parametrize(("name", "size"), [("bar", (7, 5, 2)), ("beam", 60), ("plate", 6)])
def test_tiles_and_coarse_space_against_numpy(name, size):
    sim = simulation(PROBLEMS[name].build(size))
    pre = sim.stepper.newton.preconditioner
    level, below = pre.levels
    assert not level.is_dense
    assert below.is_dense
    model = sim.model
    free = model.slot_table.free.ravel()
    sim.stepper.work.u.assign(pre.reuse.linearisation_point)
    H = assembled(sim, projected=True)
    # any affine motion of the whole body is one of the coarse space: it moves gradient slots by B E
    P = coarse_functions(sim)
    B = np.random.default_rng(0).standard_normal((3, 3))
    motion = model.slot_table.reference @ B.T + np.outer(model.slot_table.kind == 0, [1.0, 2.0, 3.0])
    fit = sp.linalg.lsqr(P, motion.ravel(), atol=1e-15, btol=1e-15)[0]
    np.testing.assert_allclose(P @ fit, motion.ravel(), rtol=0, atol=1e-8 * np.abs(motion).max())
    # the coarse matrix, and the sum of both parts
    F = sp.diags(free)
    A = (P.T @ F @ H @ F @ P).toarray()
    value = pre.level_arrays[1].block_values.numpy()[0]
    graph = below.pattern.graph
    device = sp.bsr_matrix((value, graph.indices, graph.indptr), shape=A.shape).toarray()
    np.testing.assert_allclose(device, A, rtol=0, atol=1e-12 * np.abs(A).max())
    r = random_free(sim)
    scale = 1.0 / np.sqrt(np.where(np.diag(A) > 0, np.diag(A), 1.0))
    coarse = scale * (np.linalg.pinv(scale[:, None] * A * scale, rcond=1e-11, hermitian=True) @ (scale * (P.T @ r)))
    expected = free * (P @ coarse)
    for tile in level.device_data.tile_slot.numpy():
        dofs = (3 * tile[tile >= 0][:, None] + np.arange(3)).ravel()
        expected[dofs] += np.linalg.solve(H[dofs][:, dofs].toarray(), r[dofs])
    np.testing.assert_allclose(apply(sim, r), expected, rtol=0, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("options", [{}, {"preconditioner_dtype": "float32"}])
@pytest.mark.parametrize(("name", "size"), [("bar", (13, 9, 5)), ("plate", 10), ("beam", 2000)])
def test_it_is_symmetric_and_positive_through_all_levels(name, size, options):
    sim = simulation(PROBLEMS[name].build(size), **options)
    assert len(sim.stepper.newton.preconditioner.levels) >= 3 or name == "plate"
    a, b = random_free(sim, 1), random_free(sim, 2)
    Ba, Bb = apply(sim, a), apply(sim, b)
    tolerance = 1e-9 if not options else 1e-5
    assert a @ Bb == pytest.approx(b @ Ba, abs=tolerance * np.sqrt((a @ Ba) * (b @ Bb)))
    assert a @ Ba > 0.0
    assert b @ Bb > 0.0
    assert np.abs(Ba[sim.model.slot_table.free.ravel() == 0]).max() == 0.0


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_functions_that_depend_on_each_other_are_dropped(dtype):
    """A tile inverse of a singular matrix: positive semi-definite, exact on what is left, and finite."""
    from warpfea.kernels.solvers.levels import TILE_LANES, TILE_UNKNOWNS
    from warpfea.kernels.solvers.levels_build import build_kernels

    rng = np.random.default_rng(0)
    half = rng.standard_normal((TILE_UNKNOWNS, TILE_UNKNOWNS - 5))
    half[7] = 0.0  # a row without an unknown
    A = half @ half.T
    T = {"float64": wp.float64, "float32": wp.float32}[dtype]
    matrix = wp.array(A[None, None], dtype=T, device="cpu")
    diagonal = wp.array(np.diag(A)[None, None], dtype=T, device="cpu")
    column = wp.zeros((1, 1, TILE_UNKNOWNS), dtype=T, device="cpu")
    active = wp.ones(1, dtype=wp.int32, device="cpu")
    args = [1, 1, 0, active, diagonal, column, matrix]
    wp.launch(build_kernels(dtype).invert_tiles, dim=1, inputs=args, device="cpu", block_dim=TILE_LANES)
    B = matrix.numpy()[0, 0].astype(float)
    kept = np.diag(B) != 0.0
    assert 0 < np.sum(~kept) <= 6
    assert not kept[7]
    assert np.all(B[~kept] == 0.0)
    rest = A[kept][:, kept]
    error = np.abs(B[kept][:, kept] @ rest - np.eye(kept.sum())).max()
    assert error < {"float64": 1e-6, "float32": 0.3}[dtype]
    assert np.linalg.eigvalsh(0.5 * (B + B.T))[0] > -1e-5 * np.abs(B).max()


def test_a_negative_row_gets_its_diagonal():
    from warpfea.kernels.solvers.levels import TILE_LANES, TILE_UNKNOWNS
    from warpfea.kernels.solvers.levels_build import build_kernels

    A = np.eye(TILE_UNKNOWNS)
    A[3, 3] = -2.0
    matrix = wp.array(A[None, None], dtype=wp.float64, device="cpu")
    diagonal = wp.array(np.diag(A)[None, None], dtype=wp.float64, device="cpu")
    column = wp.zeros((1, 1, TILE_UNKNOWNS), dtype=wp.float64, device="cpu")
    active = wp.ones(1, dtype=wp.int32, device="cpu")
    args = [1, 1, 1, active, diagonal, column, matrix]
    wp.launch(build_kernels("float64").invert_tiles, dim=1, inputs=args, device="cpu", block_dim=TILE_LANES)
    B = matrix.numpy()[0, 0]
    expected = np.ones(TILE_UNKNOWNS)
    expected[3] = 0.5
    np.testing.assert_allclose(B, np.diag(expected))
