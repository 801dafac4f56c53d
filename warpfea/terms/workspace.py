"""Arrays written by a step, allocated once per simulation."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from operator import attrgetter, methodcaller
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.memory import convert_memory_errors
from ..elements.rigid import NOMINAL_PERIOD
from ..kernels.common.lanes import WARP_SIZE
from ..kernels.common.reduce import CHUNK
from ..kernels.common.structs import balance_struct
from ..kernels.elements.element_slots import iterate_struct
from ..kernels.solvers.newton_control import FLOOR_LANES, FLOOR_ROWS, GROUP_LANES, GROUP_ROWS, TERM_ROWS, control_struct
from ..kernels.solvers.pcg import FREE_GROUP_LANES, pcg_struct
from ..kernels.step.energy_ledger import LEDGER_TERM_ROWS
from ..kernels.step.gather import RESIDUAL_ROWS
from ..kernels.step.step_control import step_struct
from ..kernels.terms.constraints import multiplier_struct

if TYPE_CHECKING:
    from ..model.blocks import Block
    from ..model.model import Model

__all__ = ["Workspace"]


def _own_data(own: Mapping[Block, Any], of_others: Callable[[Block], Any], block: Block) -> Any:
    """Constants of a block: its own in a simulation, or those of the model."""
    return own[block] if block in own else of_others(block)


class Workspace:
    """Scratch of a simulation. Unused features get an array of one item.

    Notation of the step: v velocities, u displacements, g residual, H its derivative; r, z, p, Hp vectors of PCG.
    """

    def __init__(
        self, model: Model, *, max_newton: int, ledger: bool, midpoint: bool = False, dissipation: float = 0.0
    ) -> None:
        self.device = model.device
        self._dtype = model.dtype
        # constants of an element block in the form that the scheme's kernels take
        self.data_of: Callable[[Block], Any] = attrgetter("data")
        if dissipation:
            self.data_of = methodcaller("dissipative_data", model.dtype, dissipation)
        # weights of the elements of rigid parts, for `limit_rigid_stiffness`, and those of the model
        self.rigid_weights: list[tuple[wp.array, np.ndarray]] = []
        own = {b: self._with_own_weights(self.data_of(b)) for b in model.blocks if b.host_blocks[0].body.rigid}
        if own:
            self.data_of = partial(_own_data, own, self.data_of)
        self.bytes: dict[str, int] = {}
        # arrays for a chunk of the worlds: chunk size as a function of the number of worlds
        self.chunks: dict[str, Callable[[int], int]] = {}
        self.blocks_shape, self.sym = (model.worlds, model.contributions), model.types.sym
        B, n, vec3 = model.worlds, model.slots, model.types.vec3

        def field(name: str) -> wp.array:
            return self.array(name, (B, n), vec3)

        # iterate, base point of the line search, best iterate
        self.v, self.u, self.base_velocity, self.best_velocity = field("v"), field("u"), field("base"), field("best")
        # stage positions, and stage velocities of the elements
        self.u_stage, self.v_stage = (field("u_stage"), field("v_stage")) if midpoint else (self.u, self.v)
        self.q_tilde, self.v_tilde = field("q_tilde"), field("v_tilde")
        # PCG
        self.direction, self.r, self.z, self.p, self.Hp = (field(k) for k in ("direction", "r", "z", "p", "Hp"))
        # parts of the residual, and the diagonal of H
        self.g, self.inertia, self.internal = field("g"), field("inertia"), field("internal")
        terms, traits = model.terms, model.terms.traits
        # with constraints PCG uses the gradient of the augmented potential
        self.gradient = field("gradient") if traits.constraint_rows else self.g
        self.dead, self.dead_magnitude = field("dead"), field("dead_magnitude")
        self.diagonal = field("diagonal")
        self.inverse = self.array("inverse", (B, n), model.types.mat33)
        self.contribution = self.array("contribution", (B, model.contributions), vec3)
        # for a preconditioner of diagonal blocks only
        self.block_contribution: wp.array = wp.zeros((0, 0), dtype=model.types.sym, device=model.device)
        none = self.array("none", (1, 1), vec3)
        side = (B, terms.nonpotential_entries)
        self.nonpotential = field("nonpotential") if traits.nonpotential else none
        self.nonpotential_frozen = field("nonpotential_frozen") if traits.nonpotential else none
        self.nonpotential_contribution = (
            self.array("nonpotential_contribution", side, vec3) if traits.nonpotential else none
        )
        self.nonpotential_tangent = (
            self.array("nonpotential_tangent", side, vec3) if traits.tangent else self.nonpotential_contribution
        )
        pool = (B, terms.pool_entries) if traits.pooled else (1, 1)
        self.pool_force = self.array("pool_force", pool, vec3) if traits.pooled else none
        self.pool_product = self.array("pool_product", pool, vec3) if traits.pooled else none
        self.pool_block = self.array("pool_block", pool, model.types.sym) if traits.pooled else self.block_contribution
        rows = (TERM_ROWS, B, terms.rows) if traits.stored else (1, 1, 1)
        self.term_rows = self.array("term_rows", rows, wp.float64) if traits.stored else None
        columns = sum(len(term.columns) for term in terms)
        self.increment_sums = self.array("increment_sums", (max(columns, 1), B), wp.float64)
        self.history = self.array("history", (B, max(model.history_count, 1)), model.types.sym)
        # scratch for kernels whose sums are unused
        self.spare_rows = self.array("spare_rows", (2, B, n) if traits.constraint_rows else (1, 1, 1), wp.float64)
        # PCG sums have one row per warp
        self.warp_size = WARP_SIZE if model.device.is_cuda else 1
        self.warp_rows = self.array("warp_rows", (2, B, -(-n // self.warp_size)), wp.float64)
        self.rows = self.array("rows", (max(RESIDUAL_ROWS, LEDGER_TERM_ROWS), B, n), wp.float64)
        self.energy_rows = self.array("energy_rows", (2, B, model.element_count), wp.float64)
        max_summed_items = max(n, model.element_count, terms.rows, *(term.increment_rows for term in terms))
        chunks = -(-max_summed_items // CHUNK) if max_summed_items > CHUNK else 1
        self.max_summed_items = chunks * CHUNK  # maximum items of a summed row
        most = max(RESIDUAL_ROWS, LEDGER_TERM_ROWS, *(len(term.columns) for term in terms))
        self.chunk_sums = self.array("partial", (most, B, chunks), wp.float64)
        self.time_law_values = self.array("law_value", (B, max(terms.time_laws.count, 1)), wp.vec3d)
        self.time_law_stage_values = self.time_law_values
        if midpoint:
            self.time_law_stage_values = self.array("law_stage", self.time_law_values.shape, wp.vec3d)
        translations = max(model.components.free_group_count, 1)
        self.group_partial = self.array("group_partial", (B, translations, FREE_GROUP_LANES), vec3)
        self.group_velocity = self.array("group_velocity", (B, translations), vec3)
        self.ledger_sums = self.array("ledger_sums", (LEDGER_TERM_ROWS if ledger else 1, B), wp.float64)
        self.report = self.array("report", (B, terms.report_width), wp.float64)
        self.any_flag = self.array("any_flag", (5,), wp.int32)
        C = model.components.count
        groups = model.components.residual_groups.count
        sums = (GROUP_ROWS, B, groups) if groups > 1 else (1, 1, 1)
        self.residual_group_partial = self.array(
            "residual_group_partial", (*sums, GROUP_LANES) if groups > 1 else (1, 1, 1, 1), wp.float64
        )
        skip: tuple[str, ...]
        skip = ("violation", "negative_curvature", "pcg_unconverged", "component_of_group")  # for other solvers
        skip += () if traits.has_constraints else ("multiplier_updates", "violation_ratio")
        skip += () if traits.stored else ("term_sums", "trial_accepted")
        skip += () if traits.limited else ("limit",)
        of_contact = (
            "updated", "unilateral_changed", "penetrating_steps", "partly_updated", "contact_active", "penalty_factor",
            "continued", "update_due",
        )  # fmt: skip
        skip += () if traits.unilateral else (*of_contact, "bracket_low", "bracket_high")
        self.newton = self.struct(
            control_struct(), B, skip=skip,
            residual_history=(B, max_newton + 1), slot_sums=(RESIDUAL_ROWS, B), group_sums=sums,
            component_converged=(B, C),
            term_sums=(TERM_ROWS, B), sums=(FLOOR_ROWS, B, model.components.error_estimate_groups.count, FLOOR_LANES),
        )  # fmt: skip
        self.newton.norms.component_count, self.newton.norms.group_count = C, groups
        if traits.unilateral:
            self.newton.frozen.penalty_factor.fill_(1.0)
        self.multipliers: Any = multiplier_struct()()  # of constraints, if any
        self.pcg = self.struct(pcg_struct(), B, sums=(2, B), curvature=(1, B))
        solve = self.newton.solve
        solve.negative_curvature, solve.pcg_unconverged = self.pcg.negative_curvature, self.pcg.pcg_unconverged
        unused: tuple[str, ...] = (
            "b",
            "q_a",
            "acceleration_step",
            "any_rejected",
            "summed_time",
            "world_end",
            "impact",
        )
        unused += ("energy_growth", "min_energy")
        unused += () if midpoint else ("stage_time", "rate_time")
        self.step = self.struct(step_struct(), B, skip=unused, run_end=(2,))
        self.stage_time = self.step.stage_time if midpoint else self.step.new_time
        if not midpoint:
            self.step.rate_time = self.step.dq_dv
        # contact evaluates gaps in double precision, of positions
        farthest = max(float(np.abs(body.mesh.bounding_box()).max()) for body in model.bodies)
        self.gap_displacement = farthest * float(np.finfo(np.float64).eps / np.finfo(model.dtype).eps)
        self.balance = balance_struct(model.dtype)()
        for name in balance_struct(model.dtype).vars:
            of_step = name in ("mass_factor", "dq_dv")
            setattr(self.balance, name, getattr(self.step if of_step else self, name))
        self.stage = self.iterate(self.u_stage, self.v_stage, self.step.rate_time)

    def _with_own_weights(self, data: Any) -> Any:
        """Copy of the constants of a block of rigid parts whose weights change with the step."""
        out = data._cls()
        for name in data._cls.vars:
            setattr(out, name, getattr(data, name))
        out.quadrature_weight = wp.clone(data.quadrature_weight)
        self.rigid_weights.append((out.quadrature_weight, data.quadrature_weight.numpy()))
        return out

    def limit_rigid_stiffness(self, h: float | None) -> None:
        """Limit the stiffness of the elements of rigid parts to about their mass over h^2 in steps of h, s, of all
        worlds: much more would hide motions by its round-off. None: the whole."""
        for own, whole in self.rigid_weights:
            own.assign(whole * (1.0 if h is None else min(1.0, (NOMINAL_PERIOD / h) ** 2)))

    def iterate(self, u: wp.array, v: wp.array, dq_dv: wp.array, worlds: slice = slice(None)) -> Any:
        """Struct of the arrays of some worlds from which element kernels evaluate an iterate."""
        arrays = {"u": u, "v": v, "base": self.base_velocity, "history": self.history, "dq_dv": dq_dv}
        out = iterate_struct(self._dtype)()
        for name, array in (arrays | {"use_prediction": self.newton.solve.predicted_stress}).items():
            setattr(out, name, array if worlds == slice(None) else array[worlds])
        return out

    def allocate_diagonal_blocks(self) -> None:
        """Allocate the diagonal blocks of element matrices."""
        if self.block_contribution.shape != self.blocks_shape:
            self.block_contribution = self.array("block_contribution", self.blocks_shape, self.sym)

    def rows_of(self, term: Any) -> wp.array:
        """Rows of a term's potential, [TERM_ROWS, world, row]."""
        if self.term_rows is None or not term.rows:
            raise ModelError(f"term {term.name!r} has no rows of a potential: build must set `rows`, one per item")
        first, last = term.row_offset, term.row_offset + term.rows
        whole = last - first == self.term_rows.shape[2]
        return self.term_rows if whole else self.term_rows[:, :, first:last]

    def array(self, name: str, shape: tuple[int, ...], dtype: Any) -> wp.array:
        """Zeroed array, counted in bytes. ModelError if too large to index."""
        step = wp.types.type_size_in_bytes(dtype)
        for k in range(len(shape) - 1, 0, -1):
            step *= shape[k]
            if shape[k - 1] > 1 and step >= 2**31:
                raise ModelError(
                    f"{name}: an array of {' x '.join(map(str, shape))} items has {step / 2**30:.1f} GiB between two "
                    "neighbours, and at most 2 can be addressed: take fewer worlds, or smaller bodies"
                )
        with convert_memory_errors(f"array {name!r} of {' x '.join(map(str, shape))} items", self.device):
            out = wp.zeros(shape, dtype=dtype, device=self.device)
        self.bytes[name] = int(np.prod(shape, dtype=np.int64)) * wp.types.type_size_in_bytes(dtype)
        return out

    def struct(self, kind: Any, worlds: int, skip: tuple[str, ...] = (), **shapes: tuple[int, ...]) -> Any:
        """Control struct with one array [world] per array field of it and its structs, or of the given shape."""
        out = kind()
        special = {
            "elem_sums": (2, worlds),
            "slope_sum": (1, worlds),
            "tangent_sum": (1, worlds),
            **dict.fromkeys(("any_active", "any_running", "any_rare_branch", "any_estimate_error"), (1,)),
        } | shapes
        for name, var in kind.vars.items():
            if isinstance(var.type, wp.array):
                if name not in skip:
                    setattr(out, name, self.array(f"{kind.key}.{name}", special.get(name, (worlds,)), var.type.dtype))
            elif hasattr(var.type, "vars"):
                setattr(out, name, self.struct(var.type, worlds, skip, **shapes))
        return out
