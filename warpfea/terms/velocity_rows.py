"""Updates of constraints at the level of velocities; see kernels/terms/velocity_rows.py."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import warp as wp

from ..base.errors import ModelError
from ..kernels.terms.constraints import VELOCITY
from ..kernels.terms.velocity_rows import velocity_kernels
from .protocols import Tied, Updated
from .term import StepContext, part

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State
    from .workspace import Workspace

__all__ = ["VelocityRows"]


class VelocityRows(Updated, Tied):
    """Coefficients A of the rows of the constraints at the level of velocities: held during a line search."""

    name = "velocity rows"

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        rows = (row for joint in model.description.joints for row in joint.rows)
        return {"velocity constraints": any(row.kind == VELOCITY for row in rows)}

    def hash(self, h: Any) -> None:
        """The constraints hash the rows."""

    def allocate(self, work: Workspace, ctx: StepContext) -> None:
        """Refuse what has no velocities, or other ones at the end of a step."""
        if not ctx.inertia:
            self.restraints(ctx.state, 0)
        if ctx.accelerated:
            raise ModelError(
                f"{self._first}: generalized_alpha has no order shown with constraints of velocities; take bdf2 or "
                "energy_momentum"
            )

    @property
    def _first(self) -> str:
        joints = self.model.description.joints
        name = next(joint.name for joint in joints if any(row.kind == VELOCITY for row in joint.rows))
        return f"velocity constraint {name!r}"

    def matrices(self, state: State, world: int) -> Any:
        raise ModelError(f"{self._first}: modes are motions of positions; leave it out, or take a joint")

    def restraints(self, state: State, component: int) -> Any:
        raise ModelError(f"{self._first}: statics has no velocities; leave it out, or take a constraint of positions")

    def modules(self, ctx: StepContext) -> Iterable[wp.Module]:
        return {velocity_kernels(self.model.dtype).update.module}

    @part("constraints")
    def prepare(self, ctx: StepContext, active: wp.array) -> None:
        tables, w = self.model.constraints, ctx.work
        assert tables is not None
        tables.update_velocity_rows(ctx.launch, w.u_stage, active, w.multipliers)

    def update_frozen(self, ctx: StepContext, flags: wp.array) -> None:
        self.prepare(ctx, flags)
