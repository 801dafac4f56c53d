"""Loads that do not depend on the iterate, gravity Eq. (24), forces and tractions Eq. (72); fields b(r, t) at the
current position, Eq. (23)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from .. import elements as families
from ..base.errors import ModelError
from ..base.worlds import check_values_per_world, values_per_world
from ..kernels.step.gather import gather_kernels
from ..kernels.terms.loads import body_force_kernel, body_force_product_kernel, load_kernels
from ..materials import DENSITY_CONSTANTS
from ..model import assembly
from ..model.assembly import require_density
from ..model.description import BodyForce
from .gradients import ForceGradient, Gradient, StepAdjoint, law_weights
from .protocols import Differentiable, Parametrised
from .shape_gradients import traction_gradient
from .term import StepContext, part
from .time_law_table import TimeLawTable, argument_precision

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.handles import SurfaceSet
    from ..model.model import Model
    from ..model.state import State

__all__ = ["BodyForces", "DeadLoads"]


class DeadLoads(Parametrised, Differentiable):
    """Dead loads: assembled once per attempt into work.dead.

    Gravity, [world] on the device, is part of every model; without any load nothing is launched. With a time law of
    gravity `gravity` follows the law, and `constant_gravity`, which the load of a static path scales, is zero.
    """

    name = "dead loads"

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.kernels = load_kernels(model.dtype)
        self.gravity = model.array("loads", np.tile(model.description.gravity, (model.worlds, 1)), wp.vec3d)
        self.gravity_law = model.description.gravity_law
        self.constant_gravity = self.gravity

    @classmethod
    def of(cls, model: Model) -> DeadLoads:
        """Every model has this term, for gravity."""
        return cls(model)

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        return {
            "gravity": model.terms.dead_loads.has_gravity,
            "dead loads": bool(model.description.dead_loads),
        }

    def build(self, laws: TimeLawTable) -> None:
        m = self.model
        slots, numbers, weights = [], [], []
        self.tractions: list[tuple[SurfaceSet, int]] = []
        for load in m.description.dead_loads:
            index = laws.add(load.law)
            self.tractions += [(load.surface, index)] if load.surface else []
            slots.append(load.body.slot_offset + load.slots)
            numbers.append(np.full(len(load.slots), index))
            weights.append(load.weights)
        if self.gravity_law is not None:
            self.constant_gravity = m.array("loads", self.gravity.numpy(), wp.vec3d)
            self.gravity_law_index = laws.add(self.gravity_law)
            slots.append(np.arange(m.slots))
            numbers.append(np.full(m.slots, self.gravity_law_index))
            weights.append(m.masses.lumped[0])
        slot = np.concatenate(slots) if slots else np.zeros(0, dtype=np.int64)
        order = np.argsort(slot, kind="stable")
        start = np.concatenate([[0], np.cumsum(np.bincount(slot, minlength=m.slots))])
        law = np.concatenate(numbers) if numbers else np.zeros(0)
        weight = np.concatenate(weights) if weights else np.zeros(0)
        explicit = any(b.key.damping == "explicit" for b in m.blocks)  # adds its force to the dead loads
        self.has_loads = bool(len(slots)) or self.has_gravity or explicit
        self.slot_start = m.array("loads", start, wp.int32)
        self.law = m.array("loads", law[order] if len(order) else np.zeros(1), wp.int32)
        table = np.repeat(weight[order][:, None], 3, axis=1) if len(order) else np.zeros((1, 3))
        self.weight = m.array("loads", table, m.types.vec3)
        self._definition = (slot, law, weight)

    @property
    def has_gravity(self) -> bool:
        """True with gravity or a time law of it."""
        return self.gravity_law is not None or bool(np.any(self.gravity.numpy()))

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        law = [self.kernels.copy_gravity.module] * (self.gravity_law is not None)
        return law + [self.kernels.dead_load.module] * self.has_loads

    def take_gravity(self, launch: Launcher, value: wp.array, active: wp.array) -> None:
        """Set gravity at the end of the attempt from the values of the time laws."""
        if self.gravity_law is not None:
            launch(self.kernels.copy_gravity, self.model.worlds, [value, self.gravity_law_index, active, self.gravity])

    @part("loads")
    def begin(self, ctx: StepContext, active: wp.array) -> None:
        """Assemble force and magnitude of all dead loads per slot."""
        if not self.has_loads:
            return
        m, w = self.model, ctx.work
        args = [
            self.slot_start,
            self.law,
            self.weight,
            w.time_law_stage_values,
            m.masses.lumped_values,
            self.constant_gravity,
            w.step.load_factor,
            active,
        ]
        ctx.launch(self.kernels.dead_load, (m.worlds, m.slots), [*args, w.dead, w.dead_magnitude])

    def set_gravity(self, gravity: Any, mask: np.ndarray) -> None:
        """Set gravity in the chosen worlds, (3,) or (worlds, 3), m/s^2.

        Raises:
            ModelError: wrong shape, a non-finite value, a material without density, or a model built without gravity or
                with a time law of it.
        """
        if self.gravity_law is not None:
            raise ModelError("the model was built with a time law of gravity, which set_gravity can't replace")
        values = values_per_world("set_gravity", "gravity", gravity, self.model.worlds, (3,))
        check_values_per_world("set_gravity", "gravity", values, ~mask | np.isfinite(values).all(axis=1), "finite")
        values = np.where(mask[:, None], values, self.gravity.numpy())
        if np.any(values):
            require_density(self.model.bodies, "gravity")
        if not self.has_loads and np.any(values):
            raise ModelError(
                "the model was built without gravity or dead loads, so their kernels were left out: build it with a "
                "gravity that is not zero"
            )
        self.gravity.assign(values)

    def matrices(self, state: State, world: int) -> tuple[None, None]:
        return None, None

    def gradients(self, ctx: StepContext) -> Mapping[str, Callable[[], Gradient]]:
        def force(at: StepAdjoint, k: int) -> None:
            args = [self.model.masses.lumped_values, at.ctx.work.step.load_factor, k, at.active, at.scratch]
            at.ctx.launch(at.kernels.gravity_force, at.dim, args)

        return {"gravity": lambda: GravityGradient(force)} if self.gravity_law is None else {}

    def law_gradient(self, ctx: StepContext, law: int) -> Gradient | None:
        slot, number, weight = (values[self._definition[1] == law] for values in self._definition)
        return law_weights(self.model, slot, weight[:, None]) if len(number) else None

    def shape_gradients(self, ctx: StepContext) -> list[Callable[[], Gradient]]:
        return [partial(traction_gradient, ctx, self.tractions)] if self.tractions else []

    def parameter_arrays(self) -> dict[str, wp.array]:
        return {} if self.gravity_law is not None else {"gravity": self.gravity}

    def hash(self, h: Any) -> None:
        for values in self._definition:
            h.update(np.ascontiguousarray(values).tobytes())


class GravityGradient(ForceGradient):
    """Derivative by gravity, of its three components at once."""

    def __call__(self, at: StepAdjoint, out: wp.array) -> None:
        m, w = at.ctx.model, at.ctx.work
        args = [m.masses.lumped_values, w.step.load_factor, at.w, at.active, w.rows]
        at.ctx.launch(at.kernels.gravity_rows, at.dim, args)
        at.add(out)


@dataclass(eq=False)
class BodyForceBlock:
    """Body force on the elements of one block that belong to one body.

    Attributes:
        kernel: device code of the force, specialised for the user's field.
        block: element block. members: indices (count,) of the body's elements in it.
        origin: position of the body's reference origin, m.
        offset: first entry of the block in the term's own pool entries. count: number of elements.
        function: the user's field. host: the elements of the body, of one material.
    """

    kernel: Any
    block: Any
    members: Any
    origin: Any
    offset: int
    count: int
    function: wp.Function
    host: Any

    def product(self, dtype: str, transposed: bool) -> wp.Kernel:
        """Device code of the force's derivative, or of its transpose."""
        return body_force_product_kernel(self.function, dtype, argument_precision(self.function, dtype), transposed)


class BodyForces(Differentiable):
    """Body force fields, non-potential in general: their force is frozen during a line search, and H lacks their
    derivative."""

    name = "body forces"
    potential = False

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.block_forces: list[BodyForceBlock] = []

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        return {"body forces": bool(model.description.body_forces)}

    def build(self, laws: TimeLawTable) -> None:
        offset = 0
        for force in self.model.description.body_forces:
            for field, conn in self._block_forces(force):
                field.offset = offset
                offset += conn.size
                self.block_forces.append(field)
                self.connectivity.append(conn)

    def _block_forces(self, force: BodyForce) -> list[tuple[BodyForceBlock, np.ndarray]]:
        m = self.model
        out = []
        for block in m.blocks:
            first = 0
            for host in block.host_blocks:
                members = np.arange(first, first + len(host.elements))
                first += len(host.elements)
                if host.body not in force.bodies or block.key.part:  # one part of the energy represents the element
                    continue
                self._upload_shape_tables(block)
                take = argument_precision(force.function, m.dtype)
                field = BodyForceBlock(
                    kernel=body_force_kernel(force.function, m.dtype, take),
                    block=block,
                    members=m.array("loads", members, wp.int32),
                    origin=wp.vec3d(*host.body.origin),
                    offset=0,
                    count=len(members),
                    function=force.function,
                    host=host,
                )
                out.append((field, host.conn + host.body.slot_offset))
        return out

    def _upload_shape_tables(self, block: Any) -> None:
        """Tables of shape functions and rho w at the points of the mass rule, built once per block."""
        m = self.model
        rules = [assembly.mass_rule(p.body, block.key.affine) for p in block.host_blocks]
        rule = max(rules, key=lambda r: r.degree)
        if block.body_force_rule is None:
            weights, shapes = [], []
            for host in block.host_blocks:
                for elems in assembly.element_chunks(host.body, host.elements, len(rule.weights)):
                    s, _, _, det = assembly.shape_and_jacobian(host.body, elems, rule.points)
                    rho = assembly.density_at(host.body, elems, s, host.body.connectivity[elems])
                    weights.append(rho * det * rule.weights)
                    shapes.append(s)
            per_element = families.get_family(block.key.family).has_gradients
            shape = np.concatenate(shapes) if per_element else shapes[0]
            tables = {"shape": np.moveaxis(shape, 0, 2), "mass_weight": np.concatenate(weights).T}
            m.memory.fill(block.data, "loads", **tables)
            block.body_force_rule = rule

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        return {field.kernel.module for field in self.block_forces}

    def force(self, ctx: StepContext, active: wp.array) -> None:
        self._launch_forces(ctx, active, self.block_forces)

    def _launch_forces(self, ctx: StepContext, active: wp.array, fields: list[BodyForceBlock]) -> None:
        m, w = self.model, ctx.work
        for field in fields:
            args = [field.block.data, field.members, m.slot_table.reference_array, field.origin, w.u_stage]
            args += [w.stage_time, w.step.load_factor, active, self.offset + field.offset, w.nonpotential_contribution]
            ctx.launch(field.kernel, (m.worlds, field.count), args)

    def exact_product(
        self, ctx: StepContext, p: wp.array, active: wp.array, *, transposed: bool, start: bool = False
    ) -> None:  # fmt: skip
        m, w = self.model, ctx.work
        for field in self.block_forces:
            args = [field.block.data, field.members, m.slot_table.reference_array, field.origin, ctx.midpoint_factor]
            args += [w.u_stage, w.stage_time, w.step.load_factor, p, active, self.offset + field.offset]
            kernel = field.product(m.dtype, transposed)
            ctx.launch(kernel, (m.worlds, field.count), [*args, w.nonpotential_tangent])

    def is_symmetric(self, ctx: StepContext) -> bool:
        return False

    def prepare_adjoint(self, at: StepAdjoint) -> Iterable[wp.Module]:
        ways = (False, True)
        return {field.product(self.model.dtype, way).module for field in self.block_forces for way in ways}

    def hash(self, h: Any) -> None:
        for force in self.model.description.body_forces:
            h.update(force.function.key.encode())

    def gradients(self, ctx: StepContext) -> Mapping[str, Callable[[], Gradient]]:
        """By densities: the forces are per mass."""
        out = {}
        for owner, members in self.model.parameters.owners().items():
            fields = [f for f in self.block_forces if (f.host.body, f.host.material) in members]
            for name in DENSITY_CONSTANTS if fields else ():
                values = {body.materials[k][1].constants.get(name) for body, k in members}
                if values != {None}:
                    make = partial(self._density_gradient, ctx, f"{owner}.{name}", fields, values)
                    out[f"{owner}.{name}"] = make
        return out

    def _density_gradient(
        self, ctx: StepContext, name: str, fields: list[BodyForceBlock], values: set[Any]
    ) -> Gradient:
        if len(values) > 1:
            raise ModelError(
                f"Adjoint: {name!r} has several values, and a force per mass acts on it: take one material"
            )
        m = self.model
        gather = gather_kernels(m.dtype, ctx.traits).gather_force

        def force(at: StepAdjoint, _: int) -> None:
            w = at.ctx.work
            w.nonpotential_contribution.zero_()
            self._launch_forces(at.ctx, at.active, fields)
            args = [m.terms.nonpotential_topology, w.nonpotential_contribution, at.active, at.scratch]
            at.ctx.launch(gather, at.dim, args)

        return ForceGradient(force, 1.0 / values.pop())
