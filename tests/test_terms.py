"""A term, an element and a material of one's own, each in this file alone.

The term is a penalty half-space z >= 0 with a spring that sticks where a node first touched: a potential with history,
two columns of the ledger, a field, a step limit, 3x3 blocks in every solver.
"""

import functools
import types
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.common.entries import add_block_function
from warpfea.kernels.common.structs import pattern_struct, topology_struct
from warpfea.kernels.common.traits import Traits
from warpfea.kernels.common.types import kernel_module, precision
from warpfea.kernels.elements import materials as laws
from warpfea.kernels.solvers.control import control_struct

import warpfea as wf
from warpfea import elements
from warpfea.elements.quadrature import box_rule
from warpfea.simulation.checkpoint import load_checkpoint, save_checkpoint
from warpfea.terms.term import LOSS, STORED, Column, FieldSpec, Term

DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
DTYPES = ["float64", "float32"]


@functools.cache
def floor_kernels(dtype):
    """Kernels of the half-space z >= 0; item k is one slot with the reference height `height[k]`."""
    p = precision(dtype)
    T, vec3, sym6, mat33 = p.T, p.vec3, p.sym, p.mat33
    f64 = wp.float64
    Newton, Topology, Pattern = control_struct(), topology_struct(dtype), pattern_struct()
    add_block = add_block_function(dtype)
    module = kernel_module(f"test_floor_{dtype}")

    @wp.func
    def spring(u: vec3, anchor: vec3, stuck: int) -> vec3:
        """Slip since the point stuck, in the plane."""
        return T(f64(stuck)) * vec3(u[0] - anchor[0], u[1] - anchor[1], T(0.0))

    @wp.kernel(module=module)
    def force(
        slot: wp.array(dtype=wp.int32), height: wp.array(dtype=T), k: T, kt: T, u: wp.array2d(dtype=vec3),
        anchor: wp.array2d(dtype=vec3), stuck: wp.array2d(dtype=wp.int32), active: wp.array(dtype=wp.int32),
        offset: int, pool: wp.array2d(dtype=vec3), stiffness: wp.array2d(dtype=vec3), rows: wp.array3d(dtype=f64),
    ):  # fmt: skip
        """k min(gap, 0) in z, kt times the slip in x and y of what sticks; the energy of both."""
        world, item = wp.tid()
        if active[world] == 0:
            return
        x = u[world, slot[item]]
        gap = wp.min(height[item] + x[2], T(0.0))
        slip = spring(x, anchor[world, item], stuck[world, item])
        pool[world, offset + item] = kt * slip + vec3(T(0.0), T(0.0), k * gap)
        hard = T(0.0)
        if gap < T(0.0):
            hard = k
        soft = kt * T(f64(stuck[world, item]))
        stiffness[world, item] = vec3(soft, soft, hard)
        energy = f64(T(0.5) * (k * gap * gap + kt * wp.dot(slip, slip)))
        for row in range(3):
            rows[row, world, item] = energy

    @wp.kernel(module=module)
    def product(
        slot: wp.array(dtype=wp.int32), stiffness: wp.array2d(dtype=vec3), p: wp.array2d(dtype=vec3),
        active: wp.array(dtype=wp.int32), offset: int, pool: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """K p."""
        world, item = wp.tid()
        if active[world] != 0:
            pool[world, offset + item] = wp.cw_mul(stiffness[world, item], p[world, slot[item]])

    @wp.kernel(module=module)
    def diagonal(
        stiffness: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), offset: int, pool: wp.array2d(dtype=sym6)
    ):
        """K in Voigt order."""
        world, item = wp.tid()
        if active[world] != 0:
            s = stiffness[world, item]
            pool[world, offset + item] = sym6(s[0], s[1], s[2], T(0.0), T(0.0), T(0.0))

    @wp.kernel(module=module)
    def add(
        topo: Topology, pattern: Pattern, entry: wp.array(dtype=wp.int32), stiffness: wp.array2d(dtype=vec3),
        dq_dv: wp.array(dtype=f64), active: wp.array(dtype=wp.int32), value: wp.array2d(dtype=mat33),
    ):  # fmt: skip
        """value += (dq/dv) K."""
        world, item = wp.tid()
        if active[world] != 0:
            A = T(dq_dv[world]) * wp.diag(stiffness[world, item])
            add_block(topo, pattern.upper[entry[item]], A, world, value)

    @wp.kernel(module=module)
    def limit(
        slot: wp.array(dtype=wp.int32), height: wp.array(dtype=T), depth: T, u: wp.array2d(dtype=vec3),
        p: wp.array2d(dtype=vec3), newton: Newton,
    ):  # fmt: skip
        """No node gets deeper than `depth` in one step of Newton's method."""
        world, item = wp.tid()
        if newton.active[world] == 0:
            return
        room = height[item] + u[world, slot[item]][2] + depth
        fall = -T(newton.dq_dv[world]) * p[world, slot[item]][2]
        if room > T(0.0) and fall > room:
            wp.atomic_min(newton.limit, world, wp.max(f64(room / fall), f64(1.0e-3)))

    @wp.kernel(module=module)
    def book(
        slot: wp.array(dtype=wp.int32), height: wp.array(dtype=T), k: T, kt: T, u: wp.array2d(dtype=vec3),
        anchor: wp.array2d(dtype=vec3), stuck: wp.array2d(dtype=wp.int32), accepted: wp.array(dtype=wp.int32),
        rows: wp.array3d(dtype=f64),
    ):  # fmt: skip
        """What is stored when history is kept, and what the springs of points that leave lose."""
        world, item = wp.tid()
        if accepted[world] == 0:
            return
        x = u[world, slot[item]]
        gap = wp.min(height[item] + x[2], T(0.0))
        slip = spring(x, anchor[world, item], stuck[world, item])
        tangential = f64(T(0.5) * kt * wp.dot(slip, slip))
        rows[0, world, item] = f64(T(0.5) * k * gap * gap)
        rows[1, world, item] = f64(0.0)
        if gap < T(0.0):
            rows[0, world, item] = rows[0, world, item] + tangential
        else:
            rows[1, world, item] = tangential

    @wp.kernel(module=module)
    def commit(
        slot: wp.array(dtype=wp.int32), height: wp.array(dtype=T), u: wp.array2d(dtype=vec3),
        accepted: wp.array(dtype=wp.int32), anchor: wp.array2d(dtype=vec3), stuck: wp.array2d(dtype=wp.int32),
    ):  # fmt: skip
        """Points that touch first stick where they are; those that leave let go."""
        world, item = wp.tid()
        if accepted[world] == 0:
            return
        x = u[world, slot[item]]
        if height[item] + x[2] >= T(0.0):
            stuck[world, item] = 0
        elif stuck[world, item] == 0:
            stuck[world, item] = 1
            anchor[world, item] = x

    kernels = (force, product, diagonal, add, limit, book, commit)
    return types.SimpleNamespace(module=module, **{kernel.key.rsplit("__", 1)[-1]: kernel for kernel in kernels})


class Floor(Term):
    """A penalty half-space z >= 0 under all nodes of a model, k and kt in N/m."""

    name = "floor"
    columns = (Column("floor_stored", STORED), Column("floor_lost", LOSS))
    fields: ClassVar = {"floor_gap": FieldSpec("height over the floor", "m")}
    parts: ClassVar = {"floor": "a penalty half-space"}

    def __init__(self, model, k=2e4, kt=1e4, depth=5e-3):
        super().__init__(model)
        self.traits = Traits(pooled=True, stored=True, limited=True)
        self.k, self.kt, self.depth = k, kt, depth
        self.kernels = floor_kernels(model.dtype)

    def build(self, laws):
        m = self.model
        slots = np.flatnonzero(m.slot_kind == 0)
        origin = np.concatenate([np.tile(b.origin, (b.slot_count, 1)) for b in m.bodies])
        self.height_host = (m.reference + origin)[slots, 2]
        self.slots, self.dim = slots, (m.worlds, len(slots))
        self.slot, self.height = m.array("floor", slots, wp.int32), m.array("floor", self.height_host, m.types.T)
        self.connectivity, self.rows = [slots[:, None]], len(slots)

    def hold(self, free):
        free[:] = 0.0

    def hash(self, h):
        h.update(f"{self.k} {self.kt} {self.depth}".encode())

    def register(self, at):
        at.state.register("floor_anchor", self.model.types.vec3, (len(self.slots),))
        at.state.register("floor_stuck", wp.int32, (len(self.slots),))

    def allocate(self, work, at):
        stiffness = work.array("floor stiffness", self.dim, self.model.types.vec3)
        at.scratch[self.name] = stiffness, work.array("floor rows", (2, *self.dim), wp.float64)

    def modules(self, at):
        return {self.kernels.module}

    def force(self, at, active):
        w, s = at.work, at.state
        args = [self.slot, self.height, self.k, self.kt, w.u, s.floor_anchor, s.floor_stuck, active, self.offset]
        args += [w.pool_force, at.scratch[self.name][0], w.rows_of(self)]
        with at.launch.part("floor"):
            at.launch(self.kernels.force, self.dim, args)

    prepare = force

    def aim(self, at, active):
        w = at.work
        at.launch(self.kernels.limit, self.dim, [self.slot, self.height, self.depth, w.u, w.direction, w.newton])

    def product(self, at, p, active):
        args = [self.slot, at.scratch[self.name][0], p, active, self.offset, at.work.pool_product]
        at.launch(self.kernels.product, self.dim, args)

    def diagonal(self, at, active):
        at.launch(self.kernels.diagonal, self.dim, [at.scratch[self.name][0], active, self.offset, at.work.pool_block])

    def keep(self, at):
        return [("floor", at.scratch[self.name][0])]

    def reserve(self, at, matrix, *, projected):
        self.entry = self.model.array("floor", matrix.pattern.find(self.slots, self.slots), wp.int32)

    def blocks(self, at, matrix, kept, dq_dv, active, out, *, projected):
        args = [self.model.topology, matrix.pattern.data, self.entry, *kept, dq_dv, active, out]
        at.launch(self.kernels.add, self.dim, args)

    def book(self, at, accepted):
        w, s, rows = at.work, at.state, at.scratch[self.name][1]
        args = [self.slot, self.height, self.k, self.kt, w.u, s.floor_anchor, s.floor_stuck, accepted, rows]
        at.launch(self.kernels.book, self.dim, args)
        return rows

    def commit(self, at, accepted):
        s = at.state
        args = [self.slot, self.height, at.work.u, accepted, s.floor_anchor, s.floor_stuck]
        at.launch(self.kernels.commit, self.dim, args)

    def measure(self, at):
        u, s = at.state.displacement.numpy().astype(float)[:, self.slots], at.state
        gap = np.minimum(self.height_host + u[:, :, 2], 0.0)
        slip = np.linalg.norm((u - s.floor_anchor.numpy())[:, :, :2], axis=2) * s.floor_stuck.numpy()
        return {"floor_stored": 0.5 * (self.k * gap**2 + self.kt * slip**2).sum(axis=1)}

    def sample(self, field, body, state):
        first = body.slot_offset + body.node_slot
        return body.mesh.points[:, 2] + state.displacement.numpy()[:, first, 2].astype(float)


def block_on_floor(device="cpu", dtype="float64", worlds=1, velocity=(1.0, 0.0, -1.0), height=2e-3, options=None):
    b = wf.ModelBuilder()
    mesh = wf.mesh.box((0.1, 0.05, 0.05), cells=(4, 2, 2), origin=(0, 0, height))
    box = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1000.0), name="box")
    b.set_initial(box, velocity=velocity)
    b.add_probe("corner", box.at((0, 0, height)))
    b.add_term(lambda model: Floor(model, **(options or {})))
    return b.finalize(device=device, dtype=dtype, worlds=worlds), box


def bounced(model, solver=None, steps=8, dt=1e-3, **options):
    sim = wf.Simulation(model, dt=dt, solver=solver, **options)
    sim.step(steps)
    return sim


def poised(device="cpu", dtype="float64", **options):
    """A simulation with a random state, partly below the floor, some of it stuck; its term evaluated."""
    model, _ = block_on_floor(device, dtype, height=-2e-2)
    sim = wf.Simulation(model, dt=1e-3, **options)
    rng = np.random.default_rng(1)
    at, term = sim.stepper.at, model.terms.find(Floor)
    at.state.floor_stuck.assign(rng.integers(0, 2, term.dim))
    at.state.floor_anchor.assign(rng.normal(scale=1e-3, size=(*term.dim, 3)))
    w = sim.stepper.work
    w.u.assign(rng.normal(scale=1e-3, size=(1, model.slots, 3)))
    w.step.dq_dv.fill_(1e-3)
    w.step.mass_factor.fill_(1e3)
    return sim, term, wp.ones(1, dtype=wp.int32, device=device)


def energy_at(sim, term, active, u):
    at = sim.stepper.at
    at.work.u.assign(u[None])
    term.force(at, active)
    return at.work.rows_of(term).numpy()[0].sum()


@pytest.mark.parametrize("device", DEVICES)
def test_forces_are_differences_of_the_energy(device):
    sim, term, active = poised(device)
    at = sim.stepper.at
    u = at.work.u.numpy()[0].copy()
    rng = np.random.default_rng(2)
    d = rng.normal(size=u.shape)
    high, low = (energy_at(sim, term, active, u + s * 1e-7 * d) for s in (1.0, -1.0))
    energy_at(sim, term, active, u)
    force = at.work.pool_force.numpy()[0]
    assert np.abs(force).max() > 1.0
    slope = (force * d[term.slots]).sum()
    assert slope == pytest.approx((high - low) / 2e-7, rel=1e-6)


@pytest.mark.parametrize("device", DEVICES)
def test_product_is_the_difference_of_the_force(device):
    """Through the operator of the solver: elements, mass and the term."""
    sim, term, active = poised(device, solver=wf.NewtonPCG(operator="elements"))
    at, residual = sim.stepper.at, sim.stepper.newton.residual
    w, u = at.work, at.work.u.numpy()[0].copy()
    p = np.random.default_rng(3).normal(size=u.shape)

    def gradient(x):
        w.v_tilde.zero_()
        w.q_tilde.zero_()
        w.v.assign(x[None] / 1e-3)
        residual.evaluate(active)
        return w.gradient.numpy()[0].copy()

    high, low = (gradient(u + s * 1e-8 * p) for s in (1.0, -1.0))
    gradient(u)
    w.p.assign(p[None])
    residual.product(w.p, w.Hp, active)
    expected = 1e-3 * (high - low) / 2e-8
    product = w.Hp.numpy()[0]
    assert np.abs(product - expected).max() < 1e-6 * np.abs(expected).max()
    own = w.pool_product.numpy()[0]
    assert np.abs(1e-3 * own).max() > 1e-3 * np.abs(product).max()  # the term is felt


SOLVERS = {
    "matrix": wf.NewtonPCG(operator="matrix", tol=1e-12),
    "elements": wf.NewtonPCG(operator="elements", tol=1e-12),
    "banded": wf.NewtonPCG(preconditioner="banded", tol=1e-12),
    "two-level": wf.NewtonPCG(preconditioner="two-level", tol=1e-12),
    "block-jacobi": wf.NewtonPCG(preconditioner="block-jacobi", tol=1e-12),
    "direct": wf.NewtonPCG(linear="direct", tol=1e-12),
}


@functools.cache
def reference_motion():
    sim = bounced(block_on_floor()[0], SOLVERS["block-jacobi"])
    assert sim.state.floor_stuck.numpy().any()
    return sim.state.displacement.numpy(), sim.totals["pcg"][0]


@pytest.mark.parametrize("name", list(SOLVERS))
def test_solvers_agree(name):
    sim = bounced(block_on_floor()[0], SOLVERS[name])
    expected, pcg = reference_motion()
    assert np.abs(sim.state.displacement.numpy() - expected).max() < 1e-9 * np.abs(expected).max()
    if name == "direct":  # the factors hold the term: without it a solve takes several iterations
        assert sim.totals["pcg"][0] <= 1.2 * sim.totals["newton"][0]
    elif name != "block-jacobi":
        assert sim.totals["pcg"][0] < 0.7 * pcg


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("integrator", ["backward_euler", "bdf2"])
def test_ledger_closes(device, integrator):
    sim = wf.Simulation(block_on_floor(device)[0], dt=1e-3, integrator=integrator, solver=wf.NewtonPCG(tol=1e-10))
    stored, lost = [], []
    for _ in range(60):
        sim.step()
        e = sim.energies()
        stored.append(e["floor_stored"][0])
        lost.append(e["floor_lost"][0])
    assert max(stored) > 1e-3
    assert stored[-1] == pytest.approx(
        sim.model.terms.find(Floor).measure(sim.stepper.at)["floor_stored"][0], abs=1e-12
    )
    assert np.all(np.diff(lost) >= 0.0)
    assert lost[-1] > 1e-6  # points have left
    scale = e["kinetic"][0] + e["strain"][0] + max(stored)
    assert abs(e["ledger_residual"][0]) < 1e-8 * scale
    assert abs(e["ledger_residual"][0] - e["unbalanced"][0]) < 1e-12 * scale
    assert e["integrator"][0] > -1e-6 * scale


def test_the_ledger_shows_a_wrong_force(monkeypatch):
    """Energy that the force does not derive from has nowhere to go but into the integrator's column."""
    right = bounced(block_on_floor()[0], steps=6).energies()
    book = Floor.book

    def tripled(self, at, accepted):
        rows = book(self, at, accepted)
        rows.assign(3.0 * rows.numpy())
        return rows

    monkeypatch.setattr(Floor, "book", tripled)
    got = bounced(block_on_floor()[0], steps=6, capture=False).energies()
    amiss = 2.0 * (right["floor_stored"][0] + right["floor_lost"][0])
    assert amiss > 1e-4
    assert got["integrator"][0] == pytest.approx(right["integrator"][0] - amiss, rel=1e-9)


def test_the_step_is_limited():
    """Falling fast: without the limit the first iterate goes through the floor by half the box."""
    free, held = (
        bounced(block_on_floor(velocity=(0, 0, -8.0), options=dict(k=1e7, depth=depth))[0], steps=3, dt=4e-3)
        for depth in (1.0, 1e-3)
    )
    assert held.totals["newton"][0] != free.totals["newton"][0]
    difference = np.abs(held.state.displacement.numpy() - free.state.displacement.numpy()).max()
    assert difference < 1e-6 * np.abs(free.state.displacement.numpy()).max()


def stuck_state(model, dt=1e-3):
    """A simulation in which some points stick, and a state of the same kind to start others from."""
    sim = bounced(model, wf.NewtonPCG(tol=1e-12), steps=5, dt=dt)
    assert sim.state.floor_stuck.numpy().any()
    return sim


def test_a_rejected_step_leaves_the_history():
    model = block_on_floor()[0]
    sim = stuck_state(model)
    before = sim.state.numpy()
    hard = wf.Simulation(model, sim.state.like(), dt=1e-2, solver=wf.NewtonPCG(max_newton=1, max_halvings=2, tol=1e-12))
    with pytest.raises(wf.ConvergenceError):
        hard.step()
    after = hard.state.numpy()
    for name in ("floor_anchor", "floor_stuck", "displacement", "velocity", "ledger"):
        np.testing.assert_array_equal(after[name], before[name])


def test_halved_steps_are_short_steps():
    """A step that takes more iterations than there may be is done in two halves, history and ledger with it."""
    model = block_on_floor(velocity=(1.0, 0.0, -3.0))[0]
    long, short = (stuck_state(model, dt=5e-4) for _ in range(2))
    for most in range(2, 12):  # the fewest iterations that the half steps need are too few for the whole
        halved = wf.Simulation(
            model, long.state.like(), dt=1.6e-2, solver=wf.NewtonPCG(max_newton=most, max_halvings=1, tol=1e-12)
        )
        try:
            halved.step()
        except wf.ConvergenceError:
            continue
        break
    assert halved.last.halvings[0] == 1
    halves = wf.Simulation(model, short.state.like(), dt=8e-3, solver=wf.NewtonPCG(tol=1e-12))
    halves.step(2)
    for name in ("displacement", "velocity", "floor_anchor", "ledger"):
        a, b = halved.state.numpy()[name], halves.state.numpy()[name]
        assert np.abs(a - b).max() < 1e-8 * np.abs(b).max(), name
    np.testing.assert_array_equal(halved.state.floor_stuck.numpy(), halves.state.floor_stuck.numpy())


@pytest.mark.parametrize("solver", ["two-level", "banded"])
def test_resumed_runs_go_on_bit_for_bit(tmp_path, solver):
    whole = bounced(block_on_floor()[0], wf.NewtonPCG(preconditioner=solver), steps=6)
    save_checkpoint(whole, tmp_path / "c.npz")
    whole.step(6)
    resumed = wf.Simulation(block_on_floor()[0], dt=1e-3, solver=wf.NewtonPCG(preconditioner=solver))
    load_checkpoint(resumed, tmp_path / "c.npz")
    resumed.step(6)
    for name, values in whole.state.numpy().items():
        np.testing.assert_array_equal(resumed.state.numpy()[name], values, err_msg=name)
    with pytest.raises(wf.CheckpointError, match="another model"):
        load_checkpoint(wf.Simulation(block_on_floor(options=dict(k=1e3))[0], dt=1e-3), tmp_path / "c.npz")


def test_reset_forgets():
    model = block_on_floor()[0]
    sim = bounced(model, steps=6)
    first = sim.state.numpy()
    assert first["floor_stuck"].any()
    sim.reset()
    assert not sim.state.floor_stuck.numpy().any()
    sim.step(6)
    for name in ("displacement", "velocity", "floor_anchor", "floor_stuck"):
        np.testing.assert_array_equal(sim.state.numpy()[name], first[name])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("device", DEVICES)
def test_worlds_are_bit_equal_to_their_own_runs(device, dtype):
    speeds = (-1.0, -0.5, -2.0)
    many = wf.Simulation(block_on_floor(device, dtype, worlds=3)[0], dt=1e-3)
    v = many.state.velocity.numpy()
    for world, speed in enumerate(speeds):
        v[world, :, 2] = speed
    many.state.velocity.assign(v)
    many.step(8)
    for world, speed in enumerate(speeds):
        one = wf.Simulation(block_on_floor(device, dtype, velocity=(1.0, 0.0, speed))[0], dt=1e-3)
        one.step(8)
        for name in ("displacement", "velocity", "floor_anchor", "floor_stuck"):
            np.testing.assert_array_equal(many.state.numpy()[name][world], one.state.numpy()[name][0], err_msg=name)


def test_single_precision_follows_double():
    single, double = (bounced(block_on_floor(dtype=dtype)[0]) for dtype in ("float32", "float64"))
    a, b = single.state.displacement.numpy(), double.state.displacement.numpy()
    assert np.abs(a - b).max() < 1e-3 * np.abs(b).max()


def test_what_the_model_tells_of_it():
    model, box = block_on_floor()
    assert "floor" in model.info()["features"]
    sim = bounced(model, steps=6)
    gap = sim.field("floor_gap", box)
    assert gap.shape == (1, len(box.mesh.points))
    assert gap.min() < 0.0 < gap.max()
    np.testing.assert_allclose(gap[0], sim.positions(box)[0, :, 2], atol=1e-15)
    with pytest.raises(wf.ModelError, match="floor_gap"):
        sim.field("nothing", box)
    assert {"floor stiffness", "floor rows"} <= {name.partition(".")[2] for name in sim.bytes()}
    plain = wf.ModelBuilder()
    plain.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1.0))
    assert "floor" not in plain.finalize(device="cpu").info()["features"]
    with pytest.raises(wf.ModelError, match="add_term"):
        plain.add_term(3)


# an element of one's own: the trilinear brick


def _trilinear(xi, nodes):
    corner = elements.get("H3843").node_samples[:, 0]
    factor = np.where(corner > 0.5, xi[:, None, :], 1.0 - xi[:, None, :])
    slope = np.where(corner > 0.5, 1.0, -1.0)
    s = factor.prod(axis=2)
    ds = np.stack([slope[:, k] * np.delete(factor, k, axis=2).prod(axis=2) for k in range(3)], axis=2)
    return s[None], ds[None]


@functools.cache
def brick():
    """H8 is H3843 without gradients: other slots, functions and rules."""
    unit, old = ((0.0, 1.0),) * 3, elements.get("H3843")
    rule = box_rule((2, 2, 2), unit)
    return elements.register(
        replace(
            old, name="H8", node_slots=((0,),) * 8, shape=_trilinear, rules={"2x2x2": rule}, curved_rule=rule,
            mass_rule=box_rule((3, 3, 3), unit), curved_mass_rule=box_rule((3, 3, 3), unit), slot_sets={},
        )
    )  # fmt: skip


def test_an_element():
    """Mass, the patch test on a distorted mesh, and the tangent against differences."""
    brick()
    mesh = wf.mesh.box((1, 1, 1), cells=(2, 2, 2), element="H3843")
    inner = np.all((mesh.points > 0.1) & (mesh.points < 0.9), axis=1)
    points = mesh.points + 0.08 * inner[:, None] * np.array([1.0, -0.5, 0.7])
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(replace_points(mesh, points), element="H8", material=wf.SVK(E=1e5, nu=0.3, density=700.0))
    model = b.finalize(device="cpu")
    assert model.mass_host.sum() == pytest.approx(700.0, rel=1e-12)
    F = np.array([[0.1, 0.02, 0.0], [0.0, -0.05, 0.03], [0.01, 0.0, 0.04]])
    state = model.state()
    state.displacement.assign((body.reference @ F.T)[None])
    f = model.internal_force(state)[0]
    assert np.abs(f[inner]).max() < 1e-12 * np.abs(f).max()
    rng = np.random.default_rng(0)
    d = rng.normal(size=f.shape)
    u = state.displacement.numpy().copy()
    K = model.tangent_matrix(state)
    sides = []
    for s in (1e-6, -1e-6):
        state.displacement.assign(u + s * d[None])
        sides.append(model.internal_force(state)[0])
    expected = (sides[0] - sides[1]) / 2e-6
    assert np.abs((K @ d.ravel()).reshape(-1, 3) - expected).max() < 1e-7 * np.abs(expected).max()


def replace_points(mesh, points):
    out = replace(mesh, points=points)
    wf.mesh.check(out)
    return out


# a material of one's own: Psi = mu/2 E:E + q/4 (E:E)^2


@functools.cache
def quartic(dtype):
    """Device functions of the law; c = (mu/2, 0, 0, q): the first three are those of its stand-in at rest."""
    p, t, base = precision(dtype), laws.tensors(dtype), laws.svk(dtype)
    T, mat33, vec3 = p.T, p.mat33, p.vec3
    coef = wp.types.vector(length=laws.NCOEF, dtype=T)

    @wp.func
    def energy(G: mat33, c: coef) -> T:
        """Psi."""
        E = t.green(G)
        e = wp.ddot(E, E)
        return c[0] * e + T(0.25) * c[3] * e * e

    @wp.func
    def stress(G: mat33, c: coef) -> mat33:
        """P = F S, S = (mu + q E:E) E."""
        E = t.green(G)
        S = (T(2.0) * c[0] + c[3] * wp.ddot(E, E)) * E
        return S + G * S

    @wp.func
    def increment(G: mat33, dG: mat33, c: coef) -> mat33:
        """dP = dF S + F dS."""
        F = t.identity() + G
        E = t.green(G)
        dE = t.sym(wp.transpose(F) * dG)
        a = T(2.0) * c[0] + c[3] * wp.ddot(E, E)
        return dG * (a * E) + F * (a * dE + (T(2.0) * c[3] * wp.ddot(E, dE)) * E)

    @wp.func
    def block(G: mat33, a: vec3, c: coef) -> mat33:
        """That of its linear part, which is positive."""
        linear = coef()
        linear[1] = c[0]
        return base.block(G, a, linear)

    return types.SimpleNamespace(energy=energy, stress=stress, increment=increment, block=block)


@dataclass(frozen=True, eq=False)
class Quartic(wf.SVK):
    """S = (mu + q E:E) E, Pa."""

    q: float = 0.0
    law: ClassVar[str] = "test_quartic"

    def coefficients(self):
        return (self.E / 2.0, 0.0, 0.0, self.q)


def test_a_material(monkeypatch):
    """Force and tangent against differences of the energy, and a step."""
    monkeypatch.setitem(laws.LAWS, "test_quartic", quartic)
    b = wf.ModelBuilder()
    law = Quartic(E=1e5, nu=0.0, q=1e7, density=1000.0)
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(3, 1, 1)), material=law)
    b.clamp(body.nodes("x-"))
    model = b.finalize(device="cpu")
    rng = np.random.default_rng(0)
    u, d = 0.03 * rng.normal(size=(model.slots, 3)), rng.normal(size=(model.slots, 3))

    def at(x):
        state = model.state()
        state.displacement.assign(x[None])
        return state

    psi = [model.strain_energy(at(u + s * 1e-6 * d))[0] for s in (1, -1)]
    f = [model.internal_force(at(u + s * 1e-6 * d))[0] for s in (1, -1)]
    assert (model.internal_force(at(u))[0] * d).sum() == pytest.approx((psi[0] - psi[1]) / 2e-6, rel=1e-7)
    expected = (f[0] - f[1]) / 2e-6
    K = model.tangent_matrix(at(u))
    assert np.abs((K @ d.ravel()).reshape(-1, 3) - expected).max() < 1e-7 * np.abs(expected).max()
    sim = wf.Simulation(model, dt=1e-2)
    sim.step(3)
    assert sim.last.converged.all()
    assert sim.totals["newton"][0] <= 15
