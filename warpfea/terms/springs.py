"""Springs, dampers, actuators, stops and friction of joints; see kernels/terms/springs.py."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..base.launch import Launcher
from ..base.worlds import check_values_per_world, set_rows, values_per_world
from ..kernels.common.modules import definition_name
from ..kernels.solvers.newton_control import TERM_ROWS
from ..kernels.terms.bounded_laws import FEEDBACK, FRICTION, STOP
from ..kernels.terms.chords import MAX_TURN
from ..kernels.terms.spring_laws import LINEAR, OWN, SAMPLED, OwnForces, spring_struct
from ..kernels.terms.springs import ANGLE, CHORD, LENGTH, TRAVEL, VECTOR, scratch_struct, spring_kernels
from ..model.assembly import grouped_items
from ..model.springs import MAX_FRICTION, Bushing, SampledForce, Spring, coordinate_gradients
from .bushings import force_of_spring, set_bushing
from .protocols import Diagnosed, Impacting, Parametrised, Preconditioned, Tied
from .spring_gradients import DifferentiableSprings
from .term import LOSS, NUMERICAL, STORED, WORK, Column, Congruence, StepContext, part
from .time_law_table import TimeLawTable

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State
    from .workspace import Workspace

__all__ = ["Springs"]

DEVICE_FIELDS = {
    "stiffness": "stiffness", "damping": "damping", "rest": "rest_coordinate", "max_force": "max_force",
    "lower_end": "lower_end", "upper_end": "upper_end",
}  # fmt: skip
"""Members of the device struct by those of a Spring."""
NEAR_MAX_TURN = 0.9
"""Share of the largest turn of a bushing from which a refused step tells of it."""
BLOCKS = {LENGTH: 1, VECTOR: 1, CHORD: 1, TRAVEL: 4, ANGLE: 9}
"""Blocks of the tangent by coordinate."""


class Springs(Tied, Preconditioned, Parametrised, Impacting, Diagnosed, DifferentiableSprings):
    """Springs of a model: a potential and a viscous force of each coordinate.

    Attributes:
        springs: in the order of addition.
        data: device tables.
    """

    name = "springs"
    translation_invariant = True  # but for those on the ground, see `mark_constrained`
    columns = (  # the work of actuators also counts among that of internal forces, where nothing stores it
        Column("springs", STORED), Column("spring_loss", LOSS), Column("actuators", WORK), Column("", NUMERICAL)
    )  # fmt: skip
    device_fields = DEVICE_FIELDS
    parts = {"springs": "springs, dampers, actuators, stops"}

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.springs: list[Spring] = model.description.springs
        self.own: OwnForces = tuple(
            (definition_name(law.key, law), law)
            for law in dict.fromkeys(s.law for s in self.springs if isinstance(s.law, wp.Function))
        )
        self.bounded = any(s.bounded for s in self.springs)
        self.impacts = any(s.law == STOP for s in self.springs)
        self.items = [vectors for spring in self.springs for vectors in spring.items]
        self.count = self.rows = len(self.items)
        self.kind = np.repeat([s.kind for s in self.springs], [len(s.items) for s in self.springs])
        self.features_used = self.own, self.bounded, bool((self.kind == CHORD).any())
        self.unused = () if self.bounded else ("anchor", "max_force", "lower_end", "upper_end", "schedule")
        self.dim = (model.worlds, self.count)

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        springs = model.description.springs
        return {"springs": bool(springs), "actuators": any(s.acting for s in springs)}

    # tables

    def _list_entries(self) -> None:
        """Slots of the items, and their weights in the three vectors."""
        parts = []
        for item, vectors in enumerate(self.items):
            found = [vector.entries()[:2] for vector in vectors]
            slots = np.unique(np.concatenate([slot for slot, _ in found]))
            weights = np.zeros((len(slots), 3))
            for side, (slot, weight) in enumerate(found):
                np.add.at(weights[:, side], np.searchsorted(slots, slot), weight)
            parts.append((np.full(len(slots), item), slots, weights))
        self.entry_item, self.entry_slot, self.entry_weight = (np.concatenate(column) for column in zip(*parts))
        self.entry_start = np.searchsorted(self.entry_item, np.arange(self.count + 1))

    def tied_slots(self) -> list[np.ndarray]:
        self._list_entries()
        sets = np.split(self.entry_slot, self.entry_start[1:-1])
        return [slots for slots, kind in zip(sets, self.kind) if kind != VECTOR]

    def build(self, laws: TimeLawTable) -> None:
        m, springs = self.model, self.springs
        sampled = [s.law if isinstance(s.law, SampledForce) else None for s in springs]
        pieces = [law for law in sampled if law is not None]
        functions = [function for _, function in self.own]
        codes = [LINEAR if s.law is None else s.law if s.bounded else OWN + functions.index(s.law)
                 if s.law in functions else SAMPLED for s in springs]  # fmt: skip
        schedule = [-1 if s.schedule is None else laws.add(s.schedule) for s in springs]
        reference = np.zeros((self.count, 3, 3))
        for item, vectors in enumerate(self.items):
            for side, vector in enumerate(vectors):
                reference[item, side] = vector.value
        blocks = np.array([BLOCKS[int(kind)] for kind in self.kind])
        self.block_count = int(blocks.sum())
        per_world = {
            field: np.tile([getattr(s, name) for s in springs], (m.worlds, 1))
            for name, field in DEVICE_FIELDS.items() if field not in self.unused
        }  # fmt: skip
        self.definition = (
            {
                "kind": self.kind,
                "spring": np.repeat(np.arange(len(springs)), [len(s.items) for s in springs]),
                "scale": np.concatenate([s.scale for s in springs]),
                "reference": reference,
                "entry_item": self.entry_item,
                "entry_slot": self.entry_slot,
                "entry_weight": self.entry_weight,
                "law": np.array(codes),
                "knot": np.concatenate([np.zeros(1), *(law.knots for law in pieces)]),
                "coefficients": np.concatenate([np.zeros((1, 4)), *(law.coefficients for law in pieces)]),
            }
            | per_world
            | ({"schedule": np.array(schedule)} if self.bounded else {})
        )
        self.data = spring_struct()()
        m.memory.fill(
            self.data, "springs", **self.definition, entry_start=self.entry_start,
            first_block=np.cumsum(blocks) - blocks,
            knot_start=1 + np.cumsum([0] + [len(law.knots) if law is not None else 0 for law in sampled]),
            knot_energy=np.concatenate([np.zeros(1), *(law.energy for law in pieces)]),
        )  # fmt: skip
        self.connectivity = [self.entry_slot[:, None]]

    def hash(self, h: Any) -> None:
        for values in self.definition.values():
            h.update(np.ascontiguousarray(values).tobytes())
        h.update(repr([name for name, _ in self.own]).encode())

    def mark_constrained(self, free: np.ndarray) -> None:
        """Components whose translation changes a vector are held by the ground: nothing else moves the vector along."""
        position = self.model.slot_table.kind == 0
        total = np.zeros((self.count, 3))
        size = np.zeros((self.count, 3))
        own = position[self.entry_slot]
        np.add.at(total, self.entry_item[own], self.entry_weight[own])
        np.add.at(size, self.entry_item[own], np.abs(self.entry_weight[own]))
        felt = np.any(np.abs(total) > 1e-9 * size, axis=1)[self.entry_item]
        free[np.unique(self.model.components.of_slot[self.entry_slot[felt]])] = 0.0

    def restraints(self, state: State, component: int) -> sp.csr_matrix:
        """Gradients of the coordinates; of VECTOR its components."""
        u = state.displacement.numpy()[0].astype(float)
        rows, columns, values, count = [], [], [], 0
        of = self.model.components.of_slot
        for item in range(self.count):
            own = slice(self.entry_start[item], self.entry_start[item + 1])
            slots, weights = self.entry_slot[own], self.entry_weight[own]
            if of[slots[0]] != component or not self.springs[self.definition["spring"][item]].resists:
                continue
            vectors = self.definition["reference"][item] + weights.T @ u[slots]
            for gradient in coordinate_gradients(int(self.kind[item]), vectors):
                rows.append(np.full(3 * len(slots), count))
                columns.append((3 * slots[:, None] + np.arange(3)).ravel())
                values.append((weights @ gradient).ravel())
                count += 1
        shape = (count, 3 * self.model.slots)
        if not count:
            return sp.csr_matrix(shape)
        return sp.csr_matrix((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape)

    def force_of(self, ctx: StepContext, handle: Spring | Bushing) -> np.ndarray:
        """(worlds, ...) see `force_of_spring`."""
        return force_of_spring(self, ctx, handle)

    def failure_note(self, ctx: StepContext, world: int) -> str:
        """Bushings near their largest turn; controllers that pull a joint by more than half a turn."""
        scratch, values = ctx.scratch[self.name][0], ctx.work.time_law_stage_values
        start = scratch.start.numpy() + scratch.winding.numpy()
        for item in np.flatnonzero(self.kind == ANGLE).tolist():
            k = self.definition["spring"][item]
            if self.springs[k].law == FEEDBACK and self.springs[k].max_force == np.inf:
                target = values.numpy()[world, self.definition["schedule"][k], 0]
                away = abs(target - start[world, item])
                if away > np.pi:
                    return (
                        f"; the target of controller {self.springs[k].name!r} is {away:.3g} rad away: give it as a "
                        "ramp, or the wf.PD a limit="
                    )
        u = ctx.work.u.numpy()[world].astype(float)
        for item in np.flatnonzero(self.kind == CHORD).tolist():
            own = slice(self.entry_start[item], self.entry_start[item + 1])
            chord = self.definition["reference"][item, 0] + self.entry_weight[own, 0] @ u[self.entry_slot[own]]
            turn = 2.0 * np.arcsin(min(0.5 * float(np.linalg.norm(chord)), 1.0))
            if turn > NEAR_MAX_TURN * MAX_TURN:
                name = self.springs[self.definition["spring"][item]].name
                return (
                    f"; bushing {name!r} is turned by {np.degrees(turn):.0f} degrees: its ends may turn by 170 degrees"
                )
        return ""

    def incidence(self) -> tuple[np.ndarray, np.ndarray, int]:
        return self.entry_item, self.entry_slot, self.count

    def _entry_pairs(self) -> tuple[np.ndarray, np.ndarray]:
        """All ordered pairs of entries of each item."""
        size = np.diff(self.entry_start)
        first = np.repeat(self.entry_start[:-1], size**2)
        pair = np.arange(len(first)) - np.repeat(np.cumsum(size**2) - size**2, size**2)
        width = np.repeat(size, size**2)
        return first + pair // width, first + pair % width

    # simulation setup

    def kernels(self, ctx: StepContext) -> Any:
        """Kernels for the integrator of a simulation."""
        return spring_kernels(self.model.dtype, ctx.midpoint, *self.features_used)

    def register(self, ctx: StepContext) -> None:
        if (self.kind == ANGLE).any():
            ctx.state.register("spring_angle", wp.float64, (self.count,))
        if any(spring.law == FRICTION for spring in self.springs):
            ctx.state.register("spring_anchor", wp.float64, (self.count,), np.nan)

    def allocate(self, work: Workspace, ctx: StepContext) -> None:
        scratch, B = scratch_struct()(), self.model.worlds
        for name, var in scratch_struct().vars.items():
            if name not in ("rows", *self.unused):
                shape = (B, self.block_count if name in ("hessian", "projected") else self.count)
                setattr(scratch, name, work.array(f"springs {name}", shape, var.type.dtype))
        scratch.rows = work.rows_of(self)
        ctx.scratch[self.name] = scratch, work.array("springs energies", (len(self.columns), *self.dim), wp.float64)

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        return {self.kernels(ctx).module}

    def _history(self, ctx: StepContext) -> list[wp.array]:
        """Angles with their turns, and anchors of friction [world, item]; in models without, arrays that are not
        read."""
        unread = ctx.scratch[self.name][0].start
        return [getattr(ctx.state, name, unread) for name in ("spring_angle", "spring_anchor")]

    # in a step

    @part("springs")
    def begin(self, ctx: StepContext, active: wp.array) -> None:
        """Coordinates at the start, from which rates are computed."""
        state, step = ctx.state, ctx.work.step
        first, second = (step.b, step.q_a) if ctx.accelerated else (step.a0, step.b if ctx.midpoint else step.a1)
        args = [self.data, state.displacement, state.velocity, ctx.u_before, int(ctx.accelerated), first, second]
        args += [*self._history(ctx), active, ctx.scratch[self.name][0]]
        ctx.launch(self.kernels(ctx).begin, self.dim, args)

    def start_of_step(self, ctx: StepContext) -> tuple[wp.array, list[Any]]:
        """Positions from which a VECTOR has its rate; values of time laws, 0 in statics, and the time of rates, s."""
        w = ctx.work
        start, span = (ctx.state.displacement, w.step.h) if ctx.midpoint else (w.q_tilde, w.step.dq_dv)
        return start, [w.time_law_stage_values, float(ctx.inertia), span]

    @part("springs")
    def force(self, ctx: StepContext, active: wp.array) -> None:
        w, k, (scratch, _) = ctx.work, self.kernels(ctx), ctx.scratch[self.name]
        start, step = self.start_of_step(ctx)
        ctx.launch(k.evaluate, self.dim, [self.data, w.u, start, *step, active, scratch])
        self._scatter(ctx, scratch.force, active, w.pool_force)

    prepare = force

    def _scatter(self, ctx: StepContext, of_item: wp.array, active: wp.array, pool: wp.array) -> None:
        args = [self.data, of_item, active, self.offset, pool]
        ctx.launch(self.kernels(ctx).scatter, (self.model.worlds, len(self.entry_item)), args)

    @part("springs")
    def product(self, ctx: StepContext, p: wp.array, active: wp.array) -> None:
        scratch, _ = ctx.scratch[self.name]
        ctx.launch(self.kernels(ctx).change, self.dim, [self.data, p, active, scratch])
        self._scatter(ctx, scratch.product, active, ctx.work.pool_product)

    @part("springs")
    def diagonal(self, ctx: StepContext, active: wp.array) -> None:
        args = [self.data, active, self.offset, ctx.scratch[self.name][0], ctx.work.pool_block]
        ctx.launch(self.kernels(ctx).diagonal, (self.model.worlds, len(self.entry_item)), args)

    @part("springs")
    def energy_increments(self, ctx: StepContext, accepted: wp.array) -> wp.array:
        scratch, rows = ctx.scratch[self.name]
        start, step = self.start_of_step(ctx)
        args = [self.data, ctx.work.u, start, ctx.state.displacement, *step, ctx.work.step.h, accepted, scratch, rows]
        ctx.launch(self.kernels(ctx).energies, self.dim, args)
        return rows

    @part("springs")
    def find_impacts(self, ctx: StepContext) -> None:
        w = ctx.work
        args = [self.data, w.u, w.step.h, w.step.dq_dv, w.step.running, w.newton.failed, ctx.scratch[self.name][0]]
        ctx.launch(self.kernels(ctx).find_impacts, self.dim, [*args, w.step.impact])

    @part("springs")
    def commit(self, ctx: StepContext, accepted: wp.array) -> None:
        if {"spring_angle", "spring_anchor"} & {*ctx.state.names}:
            args = [self.data, ctx.work.u, accepted, ctx.scratch[self.name][0], *self._history(ctx)]
            ctx.launch(self.kernels(ctx).store_history, self.dim, args)

    def stored_energy(self, ctx: StepContext) -> dict[str, np.ndarray]:
        active = wp.ones(self.model.worlds, dtype=wp.int32, device=self.model.device)
        self.begin(ctx, active)
        scratch, rows = ctx.scratch[self.name]
        u = ctx.state.displacement
        values = ctx.work.time_law_stage_values
        one = wp.ones_like(ctx.work.step.dq_dv)
        args = [self.data, u, u, u, values, 0.0, one, one, active, scratch, rows]
        ctx.launch(self.kernels(ctx).energies, self.dim, args)
        return {"springs": rows.numpy()[0].sum(axis=1)}

    def matrices(self, state: State, world: int) -> tuple[Congruence, Congruence]:
        """Derivatives of the forces by the positions, and by the velocities: what the tangent of a step at rest with
        dq/dv = 1 adds to that of statics."""
        m, u = self.model, state.displacement
        one = wp.ones(m.worlds, dtype=wp.float64, device=m.device)
        flags = wp.ones(m.worlds, dtype=wp.int32, device=m.device)

        def zeros(_: str, shape: tuple[int, ...], dtype: Any) -> wp.array:
            return wp.zeros(shape, dtype=dtype, device=m.device)

        step = SimpleNamespace(a0=one, a1=wp.zeros_like(one), dq_dv=one)
        rows = zeros("", (TERM_ROWS, *self.dim), wp.float64)
        work: Any = SimpleNamespace(array=zeros, rows_of=lambda term: rows, step=step, u=u, q_tilde=u)
        launch = Launcher(m.device)
        launch.parts |= self.parts
        ctx = StepContext(m, work, launch, state, u_before=u, inertia=False)
        self.allocate(work, ctx)
        self.begin(ctx, flags)
        value = m.terms.time_laws.values_at_state(launch, state)[0]
        scratch, found = ctx.scratch[self.name][0], []
        for in_motion in (0.0, 1.0):
            ctx.launch(self.kernels(ctx).evaluate, self.dim, [self.data, u, u, value, in_motion, one, flags, scratch])
            found.append(scratch.hessian.numpy()[world].copy())
        return self._matrix(found[0]), self._matrix(found[1] - found[0])

    def _matrix(self, blocks: np.ndarray) -> Congruence:
        """From the blocks (blocks, 3, 3) between the vectors of the items."""
        sides = np.sqrt([BLOCKS[int(kind)] for kind in self.kind]).astype(int)
        item = np.repeat(np.arange(self.count), sides**2)
        k = np.arange(len(item)) - np.repeat(np.cumsum(sides**2) - sides**2, sides**2)
        axis = np.arange(3)
        row, column = (9 * item + 3 * side for side in (k // sides[item], k % sides[item]))
        index = (row[:, None, None] + axis[:, None] + 0 * axis, column[:, None, None] + axis + 0 * axis[:, None])
        H = sp.csr_matrix((blocks.ravel(), [i.ravel() for i in index]), shape=(9 * self.count,) * 2)
        places = (9 * self.entry_item[:, None, None] + 3 * axis[:, None] + axis,
                  3 * self.entry_slot[:, None, None] + 0 * axis[:, None] + axis)  # fmt: skip
        weight = np.broadcast_to(self.entry_weight[:, :, None], places[0].shape)
        shape = (9 * self.count, 3 * self.model.slots)
        return Congruence(sp.csr_matrix((weight.ravel(), [i.ravel() for i in places]), shape=shape), H)

    # in a linear solve

    def cached_inputs(self, ctx: StepContext) -> list[tuple[str, wp.array]]:
        return [("springs", ctx.scratch[self.name][0].projected)]

    def allocate_blocks(self, ctx: StepContext, matrix: Any, *, projected: bool) -> None:
        if "springs" in self.model.cache:
            return
        row, column = self._entry_pairs()
        kept = self.entry_slot[row] <= self.entry_slot[column]
        row, column = row[kept], column[kept]
        found = matrix.pattern.find_upper(self.entry_slot[row], self.entry_slot[column])
        order, entry, start = grouped_items(found)
        tables = (entry, start, row[order], column[order])
        arrays = [self.model.array("matrix pattern", table, wp.int32) for table in tables]
        self.model.cache["springs"] = arrays, len(entry)

    def block_modules(self) -> Iterable[wp.Module]:
        return {spring_kernels(self.model.dtype, False, *self.features_used).module}

    def blocks(
        self, ctx: StepContext, matrix: Any, cached: list[wp.array], dq_dv: wp.array, active: wp.array, out: wp.array,
        *, projected: bool,
    ) -> None:  # fmt: skip
        (arrays, count), m = self.model.cache["springs"], self.model
        values = cached[0] if projected else ctx.scratch[self.name][0].hessian
        args = [m.topology, matrix.pattern.data, self.data, *arrays, values, dq_dv, active, out]
        ctx.launch(spring_kernels(m.dtype, False, *self.features_used).add_blocks, (m.worlds, count), args)

    # parameters

    def parameters(self) -> dict[str, Callable[[Any, np.ndarray], None]]:
        of_bushings: dict[str, Callable[[Any, np.ndarray], None]] = {
            f"{bushing.name}.{field}": partial(set_bushing, self, bushing, field)
            for bushing in self.model.description.bushings
            for field in ("stiffness", "damping")
        }
        return of_bushings | {
            name: partial(self._set_parameter, k, name, field)
            for k, spring in enumerate(self.springs)
            for name, field in spring.parameters.items()
        }

    def _set_parameter(self, k: int, name: str, field: str, values: Any, mask: np.ndarray) -> None:
        """Write one value of a spring in the chosen worlds."""
        what, spring = "set_parameter", self.springs[k]
        wanted = values_per_world(what, name, values, self.model.worlds)
        good, bound = np.isfinite(wanted), "finite"
        if field in ("lower_end", "upper_end"):
            other = getattr(self.data, "upper_end" if field == "lower_end" else "lower_end").numpy()[:, k]
            good &= wanted < other if field == "lower_end" else wanted > other
            bound = f"{'below the upper' if field == 'lower_end' else 'above the lower'} end"
        elif field != "rest" or self.kind[self.definition["spring"] == k][0] == LENGTH:
            good, bound = good & (wanted >= 0.0), "finite" if field == "rest" else "0 or more"
        if field == "max_force":
            good &= wanted <= MAX_FRICTION if spring.law == FRICTION else wanted > 0.0
            bound = f"0 to {MAX_FRICTION:g}" if spring.law == FRICTION else "positive"
        check_values_per_world(what, name, wanted, ~mask | good, bound)
        set_rows(getattr(self.data, DEVICE_FIELDS[field]), (mask, k), wanted[mask])
        if spring.law == FRICTION and spring.stick > 0.0:
            set_rows(self.data.stiffness, (mask, k), wanted[mask] / spring.stick)

    def parameter_arrays(self) -> dict[str, wp.array]:
        return {field: getattr(self.data, field) for field in DEVICE_FIELDS.values() if field not in self.unused}
