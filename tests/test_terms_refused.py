"""Mistakes in user-defined terms are refused by name: the half-space of floor_term.py, spoilt."""

import functools
import types
from typing import ClassVar

import numpy as np
import pytest
import warp as wp
from floor_term import Floor
from warpfea.kernels.common.modules import kernel_module
from warpfea.kernels.common.traits import Traits
from warpfea.kernels.common.types import precision

import warpfea as wf
from warpfea.simulation.checkpoint import load_checkpoint, save_checkpoint
from warpfea.terms.protocols import PROTOCOLS, Constrained, Tied
from warpfea.terms.term import LOSS, STORED, WORK, Column, FieldSpec, Term


def model_with(*makers, gravity=(0, 0, -9.81), velocity=(1.0, 0.0, -1.0), worlds=1, height=2e-3, **material):
    b = wf.ModelBuilder(gravity=gravity)
    mesh = wf.mesh.box((0.1, 0.05, 0.05), cells=(4, 2, 2), origin=(0, 0, height))
    box = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1000.0, **material), name="box")
    b.set_initial(box, velocity=velocity)
    for make in makers:
        b.add_term(make)
    return b.finalize(worlds=worlds)


def kind(*bases, **members):
    """A floor with other attributes or methods."""
    return type("Odd", (*bases, Floor), members)


def connected(change):
    def build(self, laws):
        Floor.build(self, laws)
        self.connectivity = change(self)

    return kind(build=build)


def booking(change):
    return kind(
        energy_increments=lambda self, ctx, accepted: change(self, Floor.energy_increments(self, ctx, accepted))
    )


def declaring(**traits):
    def init(self, model):
        Floor.__init__(self, model)
        self.traits = Traits(**traits)

    return kind(__init__=init)


def measuring(change):
    return kind(stored_energy=lambda self, ctx: change(Floor.stored_energy(self, ctx)))


ODD = {
    "slots too large": (connected(lambda t: [t.slots[:, None] + 1]), r"'floor', connectivity\[0\].*not within 0 to"),
    "negative slots": (connected(lambda t: [t.slots[:, None] - 1]), r"slots -1 to"),
    "a list of numbers": (connected(lambda t: [t.slots]), r"\(items, slots of an item\), got int64\[225\]"),
    "fractions": (connected(lambda t: [t.slots[:, None].astype(float)]), r"array of ints.*got float64"),
    "a bare array": (connected(lambda t: t.slots[:, None]), "must be a list of arrays"),
    "no entries": (connected(lambda t: []), "rows of a potential, but it sets no connectivity"),
    "constraint's traits": (declaring(has_constraints=True), "'floor' sets traits: they follow from its tables"),
    "tangent of a potential": (declaring(tangent=True), "'floor' sets traits"),
    "traits of a class": (kind(traits=Traits(limited=True)), "'floor' sets traits"),
    "multipliers": (kind(Constrained), "'floor' derives from Constrained: register a kind of constraints"),
    "kind of column": (kind(columns=(Column("x", 17),)), "kind 17 is none of STORED"),
    "column without a name": (kind(columns=(Column("", STORED),)), "STORED needs a name"),
    "column of the ledger": (kind(columns=(Column("kinetic", LOSS),)), "the ledger has a column"),
    "work by another name": (kind(columns=(Column("pushing", WORK),)), "name columns of work work_"),
    "column twice": (kind(columns=(Column("a", STORED), Column("a", LOSS))), "column 'a' stores energy and is shared"),
    "no measure": (kind(stored_energy=Term.stored_energy), "override stored_energy"),
    "no book": (kind(energy_increments=Term.energy_increments), "does not override energy_increments"),
    "no name": (kind(name=None), "Odd: `name` must be a non-empty string"),
    "field of every model": (kind(fields={"von_mises": FieldSpec("x", "m")}), "both have a field 'von_mises'"),
    "part of every model": (kind(parts={"vectors": "x"}), "a part of profiles 'vectors' is taken"),
    "a class": (lambda model: Floor, "expected a warpfea.terms.Term"),
    "a number": (lambda model: 3, "returned 3"),
}  # fmt: skip


@pytest.mark.parametrize("case", list(ODD))
def test_a_term_that_does_not_fit_is_refused_by_the_model(case):
    make, message = ODD[case]
    with pytest.raises(wf.ModelError, match=message):
        model_with(make)


@pytest.mark.parametrize("protocol", PROTOCOLS)
def test_a_method_of_a_protocol_needs_its_base(protocol):
    """Nothing would call it: the refusal names method, protocol and class."""
    for method in (name for name in vars(protocol) if not name.startswith("_")):
        Odd = type("Odd", (Term,), {"name": "odd", method: lambda self, *args: None})
        with pytest.raises(wf.ModelError, match=f"'odd': {method} is a method of {protocol.__name__}.*derive Odd"):
            model_with(Odd)


LATER = {
    "rows in 2D": (booking(lambda t, rows: rows[0]), r"expected float64\[at least 2, 1, items\]"),
    "too few rows": (booking(lambda t, rows: rows[:1]), r"returned float64\[1, 1, 225\]"),
    "single precision": (booking(lambda t, rows: wp.zeros(rows.shape, dtype=wp.float32)), r"returned float32"),
    "rows on the host": (booking(lambda t, rows: rows.numpy()), "returned ndarray"),
    "too long rows": (booking(lambda t, rows: wp.zeros((2, 1, 40000), dtype=wp.float64)), "build sets increment_rows"),
    "another column measured": (measuring(lambda found: {"nope": found["floor_stored"]}), r"gave \['nope'\]"),
    "one number measured": (measuring(lambda found: {"floor_stored": 1.0}), r"expected \(1,\)"),
    "nothing measured": (measuring(lambda found: None), "None"),
    "the state's own array": (
        kind(register=lambda self, ctx: ctx.state.register("displacement", self.model.types.vec3, (self.model.slots,))),
        "'displacement' is that of the state itself",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", list(LATER))
def test_a_term_that_does_not_fit_is_refused_by_the_simulation(case):
    make, message = LATER[case]
    model = model_with(make)
    with pytest.raises(wf.ModelError, match=message):
        wf.Simulation(model, dt=1e-3).step()


def test_two_terms_keep_out_of_each_others_way():
    with pytest.raises(wf.ModelError, match="two terms have the name 'floor'"):
        model_with(Floor, Floor)
    with pytest.raises(wf.ModelError, match="energy column 'floor_stored' stores energy and is shared"):
        model_with(Floor, kind(name="second"))
    other = dict(name="second", columns=(Column("more", STORED), Column("lost", LOSS)), fields={}, parts={})
    other["stored_energy"] = lambda self, ctx: {"more": Floor.stored_energy(self, ctx)["floor_stored"]}
    with pytest.raises(wf.ModelError, match=r"'second': the state's array 'floor_anchor' is that of term 'floor'"):
        wf.Simulation(model_with(Floor, kind(**other)), dt=1e-3)


def test_a_sample_of_another_shape_is_refused():
    b = wf.ModelBuilder()
    box = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=wf.SVK(E=1e6, nu=0.3, density=1000.0))
    b.add_term(kind(samples=lambda self, name, body, state: np.zeros(3)))
    sim = wf.Simulation(b.finalize(), dt=1e-3)
    with pytest.raises(wf.ModelError, match=r"samples\('floor_gap'\) gave \(3,\)"):
        sim.field("floor_gap", box)


def test_booked_rows_may_be_longer_than_anything_else():
    def build(self, laws):
        Floor.build(self, laws)
        self.increment_rows = 100_000

    def energy_increments(self, ctx, accepted):
        rows = wp.zeros((2, 1, self.increment_rows), dtype=wp.float64)
        rows[1].fill_(1e-6)
        return rows

    sim = wf.Simulation(model_with(kind(build=build, energy_increments=energy_increments)), dt=1e-3)
    sim.step()
    assert sim.energies()["floor_lost"][0] == pytest.approx(0.1, rel=1e-12)


@pytest.mark.parametrize("limit", [0.0, -1.0, np.nan])
@pytest.mark.parametrize("solver", [wf.NewtonPCG(max_halvings=2), wf.Jacobi(max_halvings=2)])
def test_a_term_that_allows_no_step_is_told(limit, solver):
    odd = kind(process_direction=lambda self, ctx, active: ctx.work.newton.search.limit.fill_(limit))
    sim = wf.Simulation(model_with(odd, height=-2e-3), dt=1e-3, solver=solver)
    before = sim.state.numpy()
    with pytest.raises(wf.ConvergenceError, match="a term allowed no step"):
        sim.step()
    np.testing.assert_array_equal(sim.state.numpy()["displacement"], before["displacement"])


def test_jacobi_keeps_to_the_limit():
    """No node moves by more than a tenth of what the descent asks for: it gets less far in the same iterations."""
    odd = kind(process_direction=lambda self, ctx, active: ctx.work.newton.search.limit.fill_(0.1))
    left = [
        wf.Simulation(model_with(make, height=-2e-3), dt=1e-3, solver=wf.Jacobi(iterations=3)).step().residual[0]
        for make in (Floor, odd)
    ]
    assert left[1] > 2.0 * left[0]


def test_what_holds_a_body_is_found_from_its_slots():
    """Without `mark_constrained` the correction by translations is left out where a tangent touches a component."""
    free = kind(mark_constrained=lambda self, free: None, translation_invariant=True)
    default = kind(mark_constrained=Tied.mark_constrained)
    counts = []
    for make in (default, free):
        sim = wf.Simulation(model_with(make), dt=1e-3)
        sim.step(8)
        counts.append(int(sim.totals["newton"][0]))
    assert counts[0] < counts[1]


def test_checkpoints_know_the_term(tmp_path):
    whole = wf.Simulation(model_with(kind(hash=Term.hash)), dt=1e-3)
    whole.step(2)
    save_checkpoint(whole, tmp_path / "c.npz")
    load_checkpoint(wf.Simulation(model_with(kind(hash=Term.hash)), dt=1e-3), tmp_path / "c.npz")
    softer = kind(hash=Term.hash)
    for make in (lambda model: softer(model, k=1e3), kind(hash=Term.hash, name="other")):
        with pytest.raises(wf.CheckpointError, match="another model"):
            load_checkpoint(wf.Simulation(model_with(make), dt=1e-3), tmp_path / "c.npz")


def test_terms_start_where_the_state_is_set(tmp_path):
    calls = []
    odd = kind(start=lambda self, ctx, active: calls.append(active.numpy().tolist()), hash=Term.hash)
    sim = wf.Simulation(model_with(odd, worlds=2), dt=1e-3)
    sim.step()
    sim.reset([True, False])
    save_checkpoint(sim, tmp_path / "c.npz")
    load_checkpoint(sim, tmp_path / "c.npz")
    assert calls == [[1, 1], [1, 0], [1, 1]]


def test_a_squeezed_body_has_a_force_scale():
    """At rest between springs its own forces cancel theirs: either alone is the scale, and steps still converge."""

    class Squeeze(Floor):
        def __init__(self, model):
            super().__init__(model, k=0.0)

        def commit(self, ctx, accepted):
            pass

    model = model_with(Squeeze, gravity=(0, 0, 0), velocity=(0, 0, 0), damping=wf.KelvinVoigt(eta=3e3, lambda_v=0.0))
    sim = wf.Simulation(model, dt=5e-3, energy_growth="ignore")  # the springs' energy is set by hand below
    term = model.terms.find(Squeeze)
    x = model.slot_table.reference[term.slots][:, 0]
    ends = np.isin(x, (x.min(), x.max()))
    sim.state.floor_stuck.assign(ends.astype(np.int32)[None])
    sim.state.floor_anchor.assign(np.where(ends, np.sign(x.mean() - x) * 5e-3, 0.0)[None, :, None] * [1.0, 0.0, 0.0])
    for _ in range(200):
        report = sim.step()
        assert report.residual[0] < 1e-7
    assert np.abs(model.internal_force(sim.state)).max() > 1.0


@functools.cache
def drag_kernels(dtype):
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    module = kernel_module(f"test_drag_{dtype}")

    @wp.kernel(module=module)
    def force(
        slot: wp.array(dtype=wp.int32), c: T, v: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), offset: int,
        out: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        world, item = wp.tid()
        if active[world] != 0:
            out[world, offset + item] = -c * v[world, slot[item]]

    @wp.kernel(module=module)
    def energy_increments(
        slot: wp.array(dtype=wp.int32), c: T, v: wp.array2d(dtype=vec3), u: wp.array2d(dtype=vec3),
        before: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), rows: wp.array3d(dtype=wp.float64),
    ):  # fmt: skip
        world, item = wp.tid()
        if active[world] != 0:
            k = slot[item]
            rows[0, world, item] = wp.float64(c * wp.dot(v[world, k], u[world, k] - before[world, k]))

    return types.SimpleNamespace(module=module, force=force, energy_increments=energy_increments)


class Drag(Term):
    """-c v on all nodes, N s/m: without a potential, and its loss in a column of its own."""

    name = "drag"
    potential = False
    columns = (Column("drag", LOSS),)
    fields: ClassVar = {}

    def __init__(self, model):
        super().__init__(model)
        self.kernels = drag_kernels(model.dtype)

    def build(self, laws):
        slots = np.flatnonzero(self.model.slot_table.kind == 0)
        self.slot, self.connectivity = self.model.array("drag", slots, wp.int32), [slots[:, None]]
        self.dim = (self.model.worlds, len(slots))

    def allocate(self, work, ctx):
        ctx.scratch[self.name] = work.array("drag rows", (1, *self.dim), wp.float64)

    def modules(self, ctx):
        return {self.kernels.module}

    def force(self, ctx, active):
        args = [self.slot, 0.05, ctx.work.v, active, self.offset, ctx.work.nonpotential_contribution]
        ctx.launch(self.kernels.force, self.dim, args)

    def energy_increments(self, ctx, accepted):
        rows, w = ctx.scratch[self.name], ctx.work
        ctx.launch(
            self.kernels.energy_increments,
            self.dim,
            [self.slot, 0.05, w.v, w.u, ctx.state.displacement, accepted, rows],
        )
        return rows


class Unbooked(Drag):
    columns = ()


def test_a_force_without_a_potential_books_its_loss_once():
    found = []
    for make in (Unbooked, Drag):
        sim = wf.Simulation(model_with(make), dt=1e-3)
        sim.step(20)
        found.append({name: values[0] for name, values in sim.energies().items()})
    lump, booked = found
    assert lump["work_fields"] < -0.1
    assert booked["drag"] == pytest.approx(-lump["work_fields"], rel=1e-12)
    assert abs(booked["work_fields"]) < 1e-12
    assert booked["integrator"] == pytest.approx(lump["integrator"], rel=1e-9)
    assert abs(booked["ledger_residual"]) < 1e-8
    assert "drag" not in lump
