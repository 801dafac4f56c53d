"""Fields b(r, t) at the current position, Eq. (23)."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from .. import elements as families
from ..kernels.terms.loads import body_force_kernel
from ..model import assembly
from ..model.description import BodyForce
from .term import StepContext, Term
from .time_law_table import TimeLawTable, argument_precision

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["BodyForces"]


@dataclass(eq=False)
class BodyForceBlock:
    """Body force on the elements of one block that belong to one body.

    Attributes:
        kernel: device code of the force, specialised for the user's field.
        block: element block. members: indices (count,) of the body's elements in it.
        origin: position of the body's reference origin, m.
        offset: first entry of the block in the term's own pool entries. count: number of elements.
    """

    kernel: Any
    block: Any
    members: Any
    origin: Any
    offset: int
    count: int


class BodyForces(Term):
    """Body force fields, non-potential in general: their force is frozen during a line search."""

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
            block.data.shape = m.array("loads", np.moveaxis(shape, 0, 2), m.types.T)
            block.data.mass_weight = m.array("loads", np.concatenate(weights).T, m.types.T)
            block.body_force_rule = rule

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        return {field.kernel.module for field in self.block_forces}

    def force(self, ctx: StepContext, active: wp.array) -> None:
        m, w = self.model, ctx.work
        for field in self.block_forces:
            args = [field.block.data, field.members, m.slot_table.reference_array, field.origin]
            args += [
                w.u_stage,
                w.stage_time,
                w.step.load_factor,
                active,
                self.offset + field.offset,
                w.nonpotential_contribution,
            ]
            ctx.launch(field.kernel, (m.worlds, field.count), args)

    def hash(self, h: Any) -> None:
        for force in self.model.description.body_forces:
            h.update(force.function.key.encode())
