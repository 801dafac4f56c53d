"""Linear solves of contact between bodies: rigid motions that correct preconditioners, and solvers that refuse it."""

from __future__ import annotations

import numpy as np
import pytest
import scipy.sparse as sp
import warp as wp

import warpfea as wf
from warpfea.contact.facets import FacetContact
from warpfea.solvers import choice
from warpfea.solvers.matrix_assembly import MAX_FULL_FACTOR_SLOTS

SIDE = 0.2


def stack(cubes, E, *, element="T4", cells=2, held="xyz", worlds=1, dtype="float64", foreign=False):
    """Cubes on a plate that stands on its lower face, each askew on the one below; `foreign`: one apart of them."""
    b = wf.ModelBuilder()
    law = wf.NeoHookean.from_E_nu(E=E, nu=0.4, density=1000.0)

    def box(size, cells, origin, name):
        return b.add_solid(
            wf.mesh.box(size, cells=cells, origin=origin, element=element), material=law, element=element, name=name
        )

    below = box((2 * SIDE, 2 * SIDE, 0.1), (2, 2, 1), (-SIDE, -SIDE, -0.1), "plate")
    b.clamp(below.nodes("z-"), components=held)
    for k in range(cubes):
        cube = box((SIDE,) * 3, (cells,) * 3, (0.003 * k - 0.1, 0.002 * k - 0.1, SIDE * k), f"cube {k}")
        b.add_contact(cube.surface("z-"), below.surface("z+"), mu=0.5)
        below = cube
    if foreign:
        box((SIDE,) * 3, (1, 1, 1), (1.0, 0.0, 0.0), "apart")
    return b.finalize(device="cpu", dtype=dtype, worlds=worlds)


def simulation(model, kind, **options):
    how = wf.NewtonPCG(preconditioner=kind, max_pcg=20000, **options)
    return wf.Simulation(model, dt=1e-2, solver=how, ledger=False, capture=False)


def watch(sim, after):
    """Solve with all that is kept made anew, and call `after` after each solve."""
    loop = sim.stepper.newton
    solve = loop.pcg.solve

    def anew(active):
        loop.residual.assemble_matrix(active)
        loop.preconditioner.start(active, rebuild=True)
        solve(active)
        after(loop)

    loop.pcg.solve = anew


def iterations(model, kind):
    sim, counts = simulation(model, kind, forcing=1e-8), []
    watch(sim, lambda loop: counts.append(int(sim.stepper.work.pcg.iterations.numpy()[0])))
    sim.step(2)
    return float(np.mean(counts))


@pytest.mark.parametrize("kind", ["banded", pytest.param("two-level", marks=pytest.mark.slow)])
def test_iterations_do_not_grow_with_the_stack(kind):
    few, many = (iterations(stack(n, 1e8, cells=3), kind) for n in (5, 20))
    assert many < 1.5 * few


def test_without_the_motions_they_do(monkeypatch):
    monkeypatch.setattr(choice, "mode_bodies", lambda model: {})
    few, many = (iterations(stack(n, 1e8), "banded") for n in (5, 20))
    assert many > 1.5 * few


def place(model, u):
    """Places of slots (m), or their gradients, and which are places."""
    is_place = model.slot_table.kind == 0
    origin = np.concatenate([np.tile(body.origin, (body.slot_count, 1)) for body in model.bodies])
    return model.slot_table.reference + origin * is_place[:, None] + u, is_place


def motions_of(model, u, bodies):
    """(3 slots, 6 bodies) rigid motions of bodies at u, about the origin."""
    x, is_place = place(model, u)
    out = []
    for body in bodies:
        own = np.zeros(model.slots)
        own[body.slot_offset : body.slot_offset + body.slot_count] = 1.0
        for axis in np.eye(3):
            out.append(((own * is_place)[:, None] * axis).ravel())
        for axis in np.eye(3):
            out.append((own[:, None] * np.cross(axis, x)).ravel())
    return np.array(out).T


def system(loop):
    """H that the preconditioner is made from, with what couples the bodies, from the points one by one."""
    model, at = loop.model, loop.residual.ctx
    pre, graph = loop.preconditioner, loop.preconditioner.assembler.pattern.graph
    shape = (3 * model.slots,) * 2
    own = sp.bsr_matrix((pre.block_values.numpy()[0], graph.indices, graph.indptr), shape=shape).toarray()
    term = model.terms.find(FacetContact)
    touching, attempt = at.scratch["pairs"]["pair"], at.scratch["pairs"]["attempt"]
    stiffness, listed, weight = (
        x.numpy()[0] for x in (attempt.stiffness, touching.listed_facet, touching.shape_values)
    )
    cross = np.zeros(shape)
    for group in term.tables.groups:
        functions = group.data.shape.numpy()
        for item, conn in enumerate(group.conn):
            for q in range(group.data.point_count):
                point = group.data.first_point + item * group.data.point_count + q
                k = stiffness[point]
                if listed[point] == 0 or not k.any():
                    continue
                K = np.array([[k[0], k[5], k[4]], [k[5], k[1], k[3]], [k[4], k[3], k[2]]])
                for i, a in enumerate(conn):
                    for j, c in enumerate(term.tables.master_conn[listed[point] - 1]):
                        block = functions[q, i, item] * weight[point, j] * K
                        cross[3 * a : 3 * a + 3, 3 * c : 3 * c + 3] -= block
    free = model.slot_table.free.ravel()
    cross = free[:, None] * cross * free * float(at.work.step.dq_dv.numpy()[0])
    return own * (free[:, None] * free), cross + cross.T


@pytest.mark.parametrize("element", ["T4", "T10"])
@pytest.mark.parametrize("held", ["xyz", "z"])
def test_the_correction_is_that_of_the_coupled_motions(element, held):
    model = stack(3, 1e6, element=element, cells={"T4": 3, "T10": 1}[element], held=held, foreign=True)
    sim = simulation(model, "banded")
    rng = np.random.default_rng(3)
    found = []

    def after(loop):
        u = sim.stepper.work.u_stage.numpy()[0]
        own, cross = system(loop)
        plate, *cubes, _ = model.bodies
        R = motions_of(model, u, ([] if held == "xyz" else [plate]) + cubes)
        if held == "z":  # the plate slides, and does not turn
            R = R[:, [0, 1, *range(6, R.shape[1])]]
        r = rng.standard_normal((model.slots, 3)) * model.slot_table.free
        wanted = R @ np.linalg.solve(R.T @ (own + cross) @ R, R.T @ r.ravel())
        z = wp.zeros((1, model.slots), dtype=model.types.vec3, device="cpu")
        given = wp.array(r[None], dtype=model.types.vec3, device="cpu")
        loop.preconditioner.body_modes.apply(given, z, wp.ones(1, dtype=wp.int32, device="cpu"))
        error = np.abs(z.numpy()[0].ravel() - wanted).max() / np.abs(wanted).max()
        weight = np.abs(R.T @ cross @ R).max() / np.abs(R.T @ own @ R).max()
        found.append((error, weight))

    watch(sim, after)
    sim.step(3)
    errors, weights = np.array(found).T
    assert errors.max() < 1e-7
    assert weights.max() > 0.1  # and what couples them counts


@pytest.mark.parametrize("element", ["T4", "T10"])
def test_the_coarse_level_is_that_of_the_coupled_bodies(element):
    model = stack(3, 1e6, element=element, cells={"T4": 3, "T10": 2}[element], foreign=True)
    sim = simulation(model, "two-level")
    rng = np.random.default_rng(3)
    found = []

    def after(loop):
        own, cross = system(loop)
        levels, arrays = loop.preconditioner.levels, loop.preconditioner.level_arrays
        data, groups = levels[0].device_data, levels[0].group_count
        P = np.zeros((model.slots, groups, 4))
        P[np.arange(model.slots), data.group_of_slot.numpy()] = data.affine_values.numpy()
        P = np.kron(P.reshape(model.slots, -1), np.eye(3)) * model.slot_table.free.ravel()[:, None]
        r = P.T @ rng.standard_normal(3 * model.slots)
        exact = P.T @ (own + cross) @ P
        wanted = P @ np.linalg.lstsq(exact, r, rcond=1e-10)[0]
        z = P @ (arrays[1].dense_inverse.matrix.numpy()[0, : len(r), : len(r)] @ r)
        error = np.abs(z - wanted).max() / np.abs(wanted).max()
        found.append((error, np.abs(P.T @ cross @ P).max() / np.abs(exact).max()))

    watch(sim, after)
    sim.step(3)
    errors, weights = np.array(found).T
    assert errors.max() < 1e-7
    assert weights.max() > 0.1  # and what couples them counts


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("kind", ["banded", "two-level"])
@pytest.mark.parametrize("element", ["T4", "T10"])
def test_small_models_are_factored_with_their_couplings(element, kind, dtype):
    sim = simulation(stack(2, 1e6, element=element, cells=1, foreign=True, dtype=dtype), kind, forcing=1e-5)
    assert sim.model.slots <= MAX_FULL_FACTOR_SLOTS
    found, counts = [], []

    def after(loop):
        whole, cross = system(loop)
        of_body = np.repeat(np.arange(len(sim.model.bodies)), [3 * body.slot_count for body in sim.model.bodies])
        between = of_body[:, None] != of_body
        error = np.abs(np.where(between, whole, 0.0) - cross).max() / np.abs(whole).max()
        found.append((error, np.abs(cross).max() / np.abs(whole).max()))
        counts.append(int(sim.stepper.work.pcg.iterations.numpy()[0]))

    watch(sim, after)
    sim.step(3)
    errors, weights = np.array(found).T
    assert errors.max() < {"float64": 1e-14, "float32": 1e-6}[dtype]
    assert weights.max() > 0.1  # and they count
    assert max(counts) <= 6, counts


def test_bodies_that_touch_no_free_one_have_no_motions():
    model = stack(1, 1e6)
    assert choice.mode_bodies(model) == {}
    assert simulation(model, "banded").stepper.newton.preconditioner.body_modes is None
    assert choice.mode_bodies(stack(2, 1e6, cells=4, foreign=True)) == {1: 0, 2: 1}


@pytest.mark.parametrize("kind", ["banded", "two-level"])
def test_worlds_are_as_alone(kind):
    states = []
    for worlds in (1, 3):
        sim = simulation(stack(3, 1e7, worlds=worlds), kind)
        sim.step(4)
        states.append(sim.state.displacement.numpy())
    assert np.abs(states[0]).max() > 0.0
    assert np.array_equal(np.repeat(states[0], 3, axis=0), states[1])


def test_float32_takes_them_too():
    model = stack(4, 1e8, dtype="float32")
    sim = simulation(model, "banded")
    report = sim.step(3)
    assert report.converged.all()
    assert int(sim.totals["pcg"][0]) < 25 * int(sim.totals["newton"][0])


@pytest.mark.parametrize("solver", ["jacobi", "direct"])
def test_solvers_with_a_fixed_pattern_refuse_pairs(solver):
    model = stack(2, 1e6)
    with pytest.raises(wf.ModelError, match=r"'pairs'.*'cube 0' and 'plate'.*NewtonPCG\(\)"):
        wf.Simulation(model, dt=1e-2, solver=solver)
