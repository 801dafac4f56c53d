"""Loads and prescribed motion of a model on the device: time laws, dead loads, fields, pressure, driven slots."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from .. import elements as families
from ..base.errors import ModelError
from ..elements import Rule
from ..kernels.common.structs import topology_struct
from ..kernels.step.gather import gather_kernels
from ..kernels.terms.followers import follower_struct, moment_kernels, pressure_kernels
from ..kernels.terms.loads import body_force_kernel, law_function_kernel, law_struct, load_kernels
from ..laws import TimeLaw
from ..model import assembly

if TYPE_CHECKING:
    from ..model.description import BodyForce, Moment, Pressure, Support
    from ..model.model import Model

__all__ = ["FieldPart", "FollowerPart", "Loads"]


@dataclass(eq=False)
class FieldPart:
    """A body force on the elements of one block that belong to one body."""

    kernel: Any
    block: Any
    members: Any
    origin: Any
    offset: int
    count: int


@dataclass(eq=False)
class FollowerPart:
    """A pressure on faces or a moment at points: device data, the force kernel and that of its symmetric tangent."""

    data: Any
    force: Any
    product: Any
    count: int


@dataclass(eq=False)
class Drives:
    """Driven slots on the device; `arm` and `axis` for rotations."""

    slot: Any
    law: Any
    count: int
    components: Any = None
    arm: Any = None
    axis: Any = None


@dataclass(eq=False)
class _Laws:
    laws: list[TimeLaw] = field(default_factory=list)

    def add(self, law: TimeLaw) -> int:
        self.laws.append(law)
        return len(self.laws) - 1


class Loads:
    """Device side of the loads of a model; absent kinds have no arrays.

    Attributes:
        law_count: number of time laws.
        has_dead: gravity or dead loads are there.
        nonpotential_entries: number of contributions of non-potential forces.
    """

    def __init__(self, model: Model, gravity: np.ndarray) -> None:
        self.model = model
        self.kernels = load_kernels(model.dtype)
        self.gravity_host = np.tile(gravity, (model.worlds, 1))
        self.gravity = model.array("loads", self.gravity_host, wp.vec3d)
        self._laws = _Laws()
        self._build_dead()
        self._build_drives()
        self._nonpotential: list[np.ndarray] = []
        self._offset = 0
        self.followers: list[FollowerPart] = [self._build_pressure(p) for p in model.description.pressures]
        self.followers += [self._build_moment(p) for p in model.description.moments]
        self.fields = [p for f in model.description.body_forces for p in self._build_field(f)]
        self._build_nonpotential()
        if model.constraints:
            model.constraints.build(model.component, self._laws.add)
        self._upload_laws()

    # construction

    def _build_dead(self) -> None:
        m = self.model
        slots, laws, weights = [], [], []
        for load in m.description.dead_loads:
            index = self._laws.add(load.law)
            slots.append(load.body.slot_offset + load.slots)
            laws.append(np.full(len(load.slots), index))
            weights.append(load.weights)
        slot = np.concatenate(slots) if slots else np.zeros(0, dtype=np.int64)
        order = np.argsort(slot, kind="stable")
        start = np.concatenate([[0], np.cumsum(np.bincount(slot, minlength=m.slots))])
        law = np.concatenate(laws) if laws else np.zeros(0)
        weight = np.concatenate(weights) if weights else np.zeros(0)
        explicit = any(b.key.damping == "explicit" for b in m.blocks)  # books its force with the dead loads
        self.has_dead = bool(len(slots)) or bool(np.any(self.gravity_host)) or explicit
        self.dead_start = m.array("loads", start, wp.int32)
        self.dead_law = m.array("loads", law[order] if len(order) else np.zeros(1), wp.int32)
        table = np.repeat(weight[order][:, None], 3, axis=1) if len(order) else np.zeros((1, 3))
        self.dead_weight = m.array("loads", table, m.types.vec3)
        self._dead_hash = (slot, law, weight)

    def _build_drives(self) -> None:
        """One row per driven slot with a law for each component; two different laws on one component are refused."""
        taken: dict[tuple[int, int], Any] = {}
        moved: dict[int, list[int]] = {}
        turned: list[tuple[int, int, np.ndarray, np.ndarray, np.ndarray]] = []
        for support in self.model.description.supports:
            slots = support.body.slot_offset + support.slots
            arms = self._arms(support, support.rotation[0]) if support.rotation else None
            index = self._laws.add(support.law) if support.law is not None else -1
            for k, slot in enumerate(slots):
                node_law = support.node_laws[k] if support.node_laws else None
                own = index if node_law is None else self._laws.add(node_law)
                self._claim(
                    taken, support, int(slot), (node_law or support.law, id(support) if arms is not None else 0)
                )
                if arms is not None:
                    assert support.rotation is not None
                    turned.append((slot, own, support.components, arms[k], support.rotation[1]))
                elif own >= 0:
                    row = moved.setdefault(int(slot), [-1, -1, -1])
                    for c in np.flatnonzero(support.components):
                        row[c] = own
        m = self.model
        self.moved: Drives | None = None
        self.turned: Drives | None = None
        if moved:
            rows = np.array([[slot, *laws] for slot, laws in moved.items()])
            self.moved = Drives(
                m.array("drives", rows[:, 0], wp.int32), m.array("drives", rows[:, 1:], wp.vec3i), len(rows)
            )
        if turned:
            slot, law, components, arm, axis = (np.array(column) for column in zip(*turned))
            self.turned = Drives(
                m.array("drives", slot, wp.int32),
                m.array("drives", law, wp.int32),
                len(turned),
                components=m.array("drives", components, wp.vec3d),
                arm=m.array("drives", arm, wp.vec3d),
                axis=m.array("drives", axis, wp.vec3d),
            )

    def _claim(self, taken: dict[tuple[int, int], Any], support: Support, slot: int, kind: Any) -> None:
        """Note who prescribes a component; equal prescriptions may meet, others may not."""
        body = support.body
        for c in np.flatnonzero(support.components):
            other = taken.setdefault((slot, int(c)), kind)
            if other is kind or (other[1] == kind[1] and _same_law(other[0], kind[0])):
                continue
            node = int(body.slot_node[slot - body.slot_offset])
            raise ModelError(
                f"body {body.name!r}: two supports prescribe component {'xyz'[c]} of node {node} differently; let "
                "one of them leave it out (components=, or a selection without the node)"
            )

    def _arms(self, support: Support, anchor: np.ndarray) -> np.ndarray:
        body = support.body
        arms = body.reference[support.slots].copy()
        position = body.slot_kind[support.slots] == 0
        arms[position] += body.origin - anchor
        return arms

    def _follower(self, conn: np.ndarray, law: TimeLaw) -> Any:
        """Device data common to the follower loads; conn (items, local) in the model's slots."""
        m = self.model
        data = follower_struct(m.dtype)()
        data.conn = m.array("loads", conn.T, wp.int32)
        data.law = m.array("loads", np.full(len(conn), self._laws.add(law)), wp.int32)
        data.offset, data.count = self._offset, len(conn)
        self._seat(conn)
        return data

    def _build_pressure(self, pressure: Pressure) -> FollowerPart:
        m = self.model
        body = pressure.surface.body
        t = assembly.facet_tables(pressure.surface)
        data = self._follower(t.conn + body.slot_offset, pressure.law)
        position = body.slot_kind[t.conn] == 0
        value = body.reference[t.conn]
        value = np.where(position[:, :, None], value - value[:, :1], value)
        data.reference = m.array("loads", np.swapaxes(value, 0, 1), m.types.vec3)
        data.is_position = m.array("loads", position.T.astype(float), m.types.T)
        for name, table in (("shape", t.shape), ("d_a", t.d_a), ("d_b", t.d_b)):
            setattr(data, name, m.array("loads", np.moveaxis(table, 0, 2), m.types.T))
        data.weight = m.array("loads", t.weights, m.types.T)
        k = pressure_kernels(m.dtype)
        return FollowerPart(data, k.pressure, k.pressure_product, len(t.conn))

    def _build_moment(self, moment: Moment) -> FollowerPart:
        m = self.model
        data = self._follower(moment.slots + moment.body.slot_offset, moment.law)
        data.gradient = m.array("loads", np.swapaxes(moment.vectors, 0, 1), m.types.vec3)
        data.axes = m.array("loads", moment.axes, m.types.mat33)
        data.share = m.array("loads", np.full(len(moment.slots), 1.0 / len(moment.slots)), m.types.T)
        k = moment_kernels(m.dtype, moment.body.family.spin_vectors)
        return FollowerPart(data, k.moment, k.moment_product, len(moment.slots))

    def _build_field(self, force: BodyForce) -> list[FieldPart]:
        m = self.model
        parts = []
        for block in m.blocks:
            first = 0
            for part in block.parts:
                members = np.arange(first, first + len(part.elements))
                first += len(part.elements)
                if part.body not in force.bodies or block.key.part:  # one part of an element's energy stands for it
                    continue
                rule = self._field_tables(block)
                take = _argument_precision(force.function, m.dtype)
                parts.append(
                    FieldPart(
                        kernel=body_force_kernel(force.function, m.dtype, block.slots, len(rule.weights), take),
                        block=block,
                        members=m.array("loads", members, wp.int32),
                        origin=wp.vec3d(*part.body.origin),
                        offset=self._offset,
                        count=len(members),
                    )
                )
                self._seat(part.conn + part.body.slot_offset)
        return parts

    def _field_tables(self, block: Any) -> Rule:
        """Shape functions and rho w at the points of the mass rule, made once per block."""
        m = self.model
        rules = [assembly.mass_rule(p.body, block.key.affine) for p in block.parts]
        rule = max(rules, key=lambda r: r.degree)
        if block.field_rule is None:
            weights, shapes = [], []
            for part in block.parts:
                for elems in assembly.chunks(part.body, part.elements, len(rule.weights)):
                    s, _, _, det = assembly.geometry(part.body, elems, rule.points)
                    rho = assembly.density_at(part.body, elems, s, part.body.connectivity[elems])
                    weights.append(rho * det * rule.weights)
                    shapes.append(s)
            per_element = families.get(block.key.family).has_gradients
            shape = np.concatenate(shapes) if per_element else shapes[0]
            block.data.shape = m.array("loads", np.moveaxis(shape, 0, 2), m.types.T)
            block.data.field_weight = m.array("loads", np.concatenate(weights).T, m.types.T)
            block.field_rule = rule
        return block.field_rule

    def _seat(self, conn: np.ndarray) -> None:
        self._nonpotential.append(conn)
        self._offset += conn.size

    def _build_nonpotential(self) -> None:
        """Gather table of the non-potential forces."""
        m = self.model
        self.nonpotential_entries = self._offset
        self.nonpotential_topology: Any = None
        if not self._offset:
            return
        start, order = assembly.gather_table(self._nonpotential, m.slots)
        topo = topology_struct(m.dtype)()
        topo.start = m.array("loads", start, wp.int32)
        topo.entry = m.array("loads", order, wp.int32)
        self.nonpotential_topology = topo

    def _upload_laws(self) -> None:
        m = self.model
        laws = self._laws.laws
        self.law_count = len(laws)
        self.laws = law_struct()()
        self.function_laws: list[tuple[Any, int]] = []
        if not laws:
            return
        start = np.concatenate([[0], np.cumsum([len(w.times) for w in laws])])
        self.laws.start = m.array("laws", start, wp.int32)
        self.laws.times = m.array("laws", np.concatenate([w.times for w in laws] + [[0.0]]), wp.float64)
        self.laws.values = m.array("laws", np.concatenate([w.values for w in laws] + [np.zeros((1, 3))]), wp.vec3d)
        for k, law in enumerate(laws):
            if law.function is not None:
                take = _argument_precision(law.function, m.dtype)
                self.function_laws.append((law_function_kernel(law.function, law.scalar, take), k))

    def gather_kernels(self) -> Any:
        """The gather kernels that fit the loads there are."""
        constrained = self.model.constraints is not None
        return gather_kernels(self.model.dtype, self.nonpotential, bool(self.followers), constrained)

    def used_kernels(self) -> list[Any]:
        """The kernels that a step launches for the loads there are."""
        k = self.kernels
        out = [part.kernel for part in self.fields] + [kernel for kernel, _ in self.function_laws]
        out += [k.evaluate_laws] * bool(self.law_count) + [k.dead_load] * self.has_dead
        out += [k.drive_displacement] * bool(self.moved) + [k.drive_rotation] * bool(self.turned)
        out += [kernel for part in self.followers for kernel in (part.force, part.product)]
        out += [k.add_explicit] * any(b.key.damping == "explicit" for b in self.model.blocks)
        return out

    # use

    @property
    def nonpotential(self) -> bool:
        """Whether forces without a potential act."""
        return self._offset > 0

    def set_gravity(self, gravity: Any) -> None:
        """Gravity of all worlds (3,) or per world (worlds, 3), m/s^2.

        Raises:
            ModelError: wrong shape, a value that is not finite, or a model built without gravity.
        """
        values = np.asarray(gravity, dtype=float)
        shape = (self.model.worlds, 3)
        if values.shape == (3,):
            values = np.broadcast_to(values, shape)
        if values.shape != shape or not np.all(np.isfinite(values)):
            raise ModelError(f"gravity has shape {values.shape}, expected finite values of shape (3,) or {shape}")
        if not self.has_dead and np.any(values):
            raise ModelError(
                "the model was built without gravity or dead loads, so their kernels were left out: build it with a "
                "gravity that is not zero"
            )
        self.gravity_host = values.copy()
        self.gravity.assign(values)

    def hash(self, h: Any) -> None:
        """Feed what defines the loads into a hash."""
        for values in self._dead_hash:
            h.update(np.ascontiguousarray(values).tobytes())
        for law in self._laws.laws:
            h.update(law.times.tobytes() + law.values.tobytes())
            if law.function is not None:
                h.update(law.function.key.encode())
        for conn in self._nonpotential:
            h.update(np.ascontiguousarray(conn).tobytes())
        for force in self.model.description.body_forces:
            h.update(force.function.key.encode())
        for pressure in self.model.description.pressures:
            h.update(np.ascontiguousarray(pressure.surface.faces).tobytes())
        for moment in self.model.description.moments:
            h.update(np.ascontiguousarray(moment.vectors).tobytes())
        for drive in (self.moved, self.turned):
            for values in (drive.slot, drive.law, drive.components, drive.arm, drive.axis) if drive else ():
                if values is not None:
                    h.update(values.numpy().tobytes())


def _same_law(a: TimeLaw | None, b: TimeLaw | None) -> bool:
    if a is None or b is None:
        return a is b
    return a.function is b.function and np.array_equal(a.times, b.times) and np.array_equal(a.values, b.values)


def _argument_precision(function: wp.Function, default: str) -> str:
    """Precision that a user's function takes, from its annotations."""
    text = " ".join(str(t) for t in getattr(function, "input_types", {}).values())
    if any(word in text for word in ("float64", "vec3d", "vec_t[float64")):
        return "float64"
    if any(word in text for word in ("float32", "vec3f", "<class 'float'>")):
        return "float32"
    return default
