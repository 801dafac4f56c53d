"""Evaluation of the step's residual, Eq. (17), and of the operator H v, in the active worlds."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import warp as wp

from ..base.launch import launch_part
from ..kernels.common.lanes import WARP_SIZE
from ..kernels.common.reduce import CHUNK, MAX_WARP_ROW, reduce_kernels
from ..kernels.common.structs import product_terms_struct
from ..kernels.solvers.newton import newton_kernels
from ..kernels.solvers.newton_control import GROUP_LANES, GROUP_ROWS, TERM_ROWS
from ..kernels.solvers.vectors import vector_kernels
from ..kernels.step.gather import RESIDUAL_ROWS, gather_kernels
from ..kernels.step.midpoint import midpoint_kernels
from ..kernels.terms.constraints import constraint_struct
from ..terms.elements import Elements
from ..terms.protocols import Constrained
from ..terms.term import Term
from .clusters import ModelClusters, make_cluster_memory, make_clusters
from .matrix_assembly import MatrixAssembler, leading_view
from .reuse import ReuseRule

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.state import State
    from ..terms.term import StepContext
    from ..terms.workspace import Workspace
    from .plan import SolverPlan

__all__ = ["Residual", "RowReducer"]


class RowReducer:
    """Sums of rows [row, world, item] into [row, world], in an order that depends on the row length only."""

    def __init__(self, launch: Launcher, work: Workspace, worlds: int) -> None:
        self.launch = launch
        self.work = work
        self.worlds = worlds
        self.kernels = reduce_kernels()

    @launch_part("vectors")
    def __call__(self, rows: wp.array, count: int, active: wp.array, out: wp.array) -> None:
        """out[k] = sum of rows[k], k < count, in the active worlds."""
        n = rows.shape[2]
        if n <= MAX_WARP_ROW:
            lanes = self.launch.lanes(WARP_SIZE)
            self.launch(self.kernels.short_sums, count * self.worlds * lanes, [rows, lanes, active, out])
            return
        if n > CHUNK:
            partial = self.work.chunk_sums
            # all chunks of the scratch are written: zeros beyond the row's end
            dim = (count, self.worlds, partial.shape[2])
            self.launch.tiled(self.kernels.partial_sums, dim, [rows, active, partial])
            rows = partial
        self.launch.tiled(self.kernels.final_sums, (count, self.worlds), [rows, active, out])


class Residual:
    """Launches that evaluate g(v), Phi(v), the norms, and H p.

    Attributes:
        plan: the methods, as far as the operator goes; uses_matrix, uses_predicted_stress: as there.
        rule_over_steps: reuse rule of a matrix that serves several steps, or None.
        on_assembled: called with that matrix and the flags of worlds that reassembled it.
    """

    def __init__(self, ctx: StepContext, plan: SolverPlan) -> None:
        model, work, launch = ctx.model, ctx.work, ctx.launch
        self.ctx, self.model, self.work, self.launch, self.terms = ctx, model, work, launch, model.terms
        self.plan = plan
        self.uses_matrix, self.uses_predicted_stress = plan.uses_matrix, plan.uses_predicted_stress
        self.elements: Elements = model.terms.find(Elements)
        self.reduce = RowReducer(launch, work, model.worlds)
        traits = ctx.traits
        self.gather_kernels = gather_kernels(model.dtype, traits)
        self.newton_kernels = newton_kernels(traits)
        self.vector_kernels = vector_kernels(model.dtype, traits.has_constraints)
        self.midpoint_kernels = midpoint_kernels(model.dtype)
        constrained = traits.constraint_rows
        self.constraint_data = self.terms.find(Constrained).tables.data if constrained else constraint_struct()()
        self.dim = (model.worlds, model.slots)
        self.product_terms = self._make_product_terms()
        self.clusters: ModelClusters | None = None
        if plan.operator == "clusters":
            if "clusters" not in model.cache:
                model.cache["clusters"] = make_clusters(model)
            self.clusters = model.cache["clusters"]
            self.cluster_memory = make_cluster_memory(model, work, midpoint=ctx.midpoint)
            self.product_kernels = [
                block.with_mass_product(model.dtype, block.key.damping, ctx.midpoint, ctx.dissipation > 0.0)
                for block in model.blocks
            ]
        self.on_assembled: Callable[[wp.array, wp.array], None] | None = None
        self.assembler: MatrixAssembler | None = None
        if plan.assembles:
            self.assembler = MatrixAssembler(model, work, launch, self.elements.kernels(ctx))
        if self.uses_matrix:
            assert self.assembler is not None
            self.operator_matrix = self.assembler.allocate_values("operator matrix")
        if plan.matrix_reuse_level:
            self.matrix_reuse_rule = ReuseRule(model, work, launch, "operator", plan.matrix_rebuild_cost)
        self.rule_over_steps = self.matrix_reuse_rule if plan.reuses_across_steps else None

    def _make_product_terms(self) -> Any:
        """Terms of a product H p beyond the elements' part."""
        m, w = self.model, self.work
        out = product_terms_struct(m.dtype)()
        of = m.terms.nonpotential_topology if m.terms.traits.tangent else m.topology
        out.contribution_start, out.contribution_entry = of.contribution_start, of.contribution_entry
        out.contribution = w.nonpotential_tangent
        out.pool = w.pool_product
        if m.terms.traits.pooled:
            out.pool_start, out.pool_entry = m.topology.pool_start, m.topology.pool_entry
        out.mass_factor, out.dq_dv, out.warp_lanes = w.step.mass_factor, w.step.dq_dv, w.warp_size
        return out

    @property
    def block_kernels(self) -> list[Any]:
        """Kernels of the element blocks."""
        return self.elements.kernels(self.ctx)

    def modules(self) -> set[wp.Module]:
        """Modules of the gather and of an assembled matrix; terms list their own."""
        out = {self.gather_kernels.module, self.vector_kernels.module} | (
            {self.midpoint_kernels.module} if self.ctx.midpoint else set()
        )
        if self.uses_matrix:
            assert self.assembler is not None
            out |= {self.gather_kernels.matrix_module} | self.assembler.modules()
            out |= {self.matrix_reuse_rule.kernels.module} if self.plan.matrix_reuse_level else set()
        elif self.clusters:
            out |= {kernel.module for kernel in self.product_kernels}
        elif self.uses_predicted_stress:
            out |= {kernel.module for kernel in self.elements.predicted_stress_kernels()}
        return out

    def register(self, state: State) -> None:
        """Register the reuse data of the operator matrix in the state."""
        if self.rule_over_steps:
            self.rule_over_steps.register(state)

    def invalidate(self, flags: wp.array) -> None:
        """Invalidate history of worlds whose state was set externally."""
        if self.rule_over_steps:
            self.rule_over_steps.invalidate(flags)

    def store_history(self, accepted: wp.array) -> None:
        """Store the reuse data of the operator matrix in the state."""
        if rule := self.rule_over_steps:
            self.launch(rule.kernels.count_step, self.model.worlds, [rule.control, self.work.newton, accepted])
            rule.move_point(accepted)
            rule.store_counts(accepted)

    @launch_part("assembly")
    def linearise(self, active: wp.array) -> None:
        """Assemble the operator matrix at the iterate if its reuse rule requires it."""
        if not self.uses_matrix:
            return
        if not self.plan.matrix_reuse_level:
            self.assemble_matrix(active)
            return
        rule, args = self.matrix_reuse_rule, [self.matrix_reuse_rule.control, self.work.newton]
        level = self.plan.matrix_reuse_level
        self.launch(rule.kernels.check_matrix_reuse, self.model.worlds, [*args, level])
        rule.decide_rebuild(active)
        self.launch(rule.kernels.loosen_forcing, self.model.worlds, args)
        rule.rebuild_if_flagged(self._assemble)

    def _assemble(self) -> None:
        rule = self.matrix_reuse_rule
        self._assemble_at(rule.iterate, rule.control.mass_factor, rule.control.build_now)

    def assemble_matrix(self, active: wp.array) -> None:
        """Assemble the operator matrix at the iterate unconditionally."""
        if self.uses_matrix:
            self._assemble_at(self.work.stage, self.work.step.mass_factor, active)

    def _assemble_at(self, iterate: Any, mass_factor: wp.array, flags: wp.array) -> None:
        """Assemble the operator matrix at an iterate, as of `Workspace.iterate`."""
        assert self.assembler is not None
        self.assembler.assemble(iterate, mass_factor, flags, self.operator_matrix, projected=False)
        if self.on_assembled:
            self.on_assembled(self.operator_matrix, flags)

    def update_positions(self, active: wp.array) -> None:
        """Positions q~ + (dq/dv) v, and stage positions of mid-point schemes."""
        w, state = self.work, self.ctx.state
        self.launch(self.vector_kernels.update_position, self.dim, [w.q_tilde, w.v, w.step.dq_dv, active, w.u])
        if self.ctx.midpoint:
            args = [state.displacement, state.velocity, w.v, w.step.b, w.step.dq_dv, active, w.u_stage, w.v_stage]
            self.launch(self.midpoint_kernels.evaluate_midpoint, self.dim, args)

    @launch_part("residual")
    def reevaluate_frozen(self, active: wp.array) -> None:
        """Re-evaluate forces, g and sums after an update of frozen quantities."""
        self.ctx.positions_changed = False
        self.evaluate_forces(active, freeze=True)
        self.ctx.positions_changed = True

    @launch_part("residual")
    def evaluate(self, active: wp.array, *, freeze: bool = False) -> None:
        """Evaluate q, forces, g and all sums at the iterate v; `freeze`: Phi freezes the non-potential forces there."""
        w, launch = self.work, self.launch
        launch(self.newton_kernels.reset_min_J, self.model.worlds, [w.newton, active])
        self.update_positions(active)
        self.evaluate_forces(active, freeze=freeze)

    def evaluate_forces(self, active: wp.array, *, freeze: bool = False) -> None:
        """Evaluate forces, g and all sums at work.u and work.v."""
        m, w, launch = self.model, self.work, self.launch
        self.terms.call(self.ctx, Term, "force", active)
        if self.terms.traits.nonpotential:
            args = [self.terms.nonpotential_topology, w.nonpotential_contribution, active, w.nonpotential]
            launch(self.gather_kernels.gather_force, self.dim, args)
        if freeze:
            self.freeze_nonpotential(active)
        if w.term_rows is not None:
            self.reduce(w.term_rows, TERM_ROWS, active, w.newton.term_sums)
        args = [m.topology, w.contribution, w.balance, active, self.constraint_data, w.multipliers]
        launch(self.gather_kernels.residual, self.dim, args)
        self.reduce(w.rows, RESIDUAL_ROWS, active, w.newton.slot_sums)
        self.reduce(w.energy_rows, 2, active, w.newton.elem_sums)
        groups = m.components.residual_groups
        if groups.count > 1:
            args = [groups.slot_start, groups.slot, w.rows, active, w.residual_group_partial]
            launch(self.vector_kernels.group_norm_partials, (m.worlds, groups.count, GROUP_LANES), args)
            sums = (GROUP_ROWS, m.worlds, groups.count)
            launch(
                self.vector_kernels.sum_group_norms, sums, [w.residual_group_partial, active, w.newton.norms.group_sums]
            )

    @launch_part("loads")
    def freeze_nonpotential(self, active: wp.array) -> None:
        """Freeze the non-potential forces of Phi at this iterate."""
        if self.terms.traits.nonpotential:
            args = [self.work.nonpotential, active, self.work.nonpotential_frozen]
            self.launch(self.vector_kernels.copy_active, self.dim, args)

    @launch_part("build")
    def diagonal_blocks(self, active: wp.array) -> None:
        """Diagonal blocks of H at the iterate: D for the norms, inverses for the preconditioner."""
        m, w, launch = self.model, self.work, self.launch
        self.terms.call(self.ctx, Term, "diagonal", active)
        args = [m.topology, w.block_contribution, w.pool_block, w.step.mass_factor, w.step.dq_dv, active]
        args += [w.diagonal, w.inverse]
        launch(self.gather_kernels.gather_diagonal_blocks, self.dim, args)

    def cluster_products(self, p: wp.array, active: wp.array) -> None:
        """H p of the clusters of elements, with their mass, to be summed by `with_mass_sum`."""
        m, w = self.model, self.work
        assert self.clusters is not None
        for block, kernel, (data, count) in zip(m.blocks, self.product_kernels, self.clusters.blocks):
            lanes = block.cluster_size if m.device.is_cuda else 1
            args = [w.data_of(block), data, w.stage, w.step.mass_factor, active, p]
            args += [lanes, self.cluster_memory, w.contribution]
            self.launch(kernel, (m.worlds, count * lanes), args, block_dim=block.cluster_size)

    @launch_part("product")
    def product(self, p: wp.array, out: wp.array, active: wp.array) -> None:
        """out = H p at the iterate; partial sums of p.Hp in `curvature_rows`."""
        m, w, launch = self.model, self.work, self.launch
        if self.clusters:
            self.cluster_products(p, active)
        elif self.uses_predicted_stress:
            self.elements.predicted_stress_tangent(self.ctx, p, active)
        elif not self.uses_matrix:
            self.elements.tangent(self.ctx, p, active)
        self.terms.call(self.ctx, Term, "product", p, active)
        rest = [self.product_terms, p, active, self.constraint_data, w.multipliers]
        if self.uses_matrix:
            assert self.assembler is not None
            pattern = self.assembler.pattern
            lanes = launch.lanes(pattern.mean_row_length)
            threads = launch.padded(m.slots * lanes)
            self.curvature_rows = leading_view(w.rows, (1, m.worlds, threads // w.warp_size))
            args = [m.topology, pattern.data, self.operator_matrix, lanes, *rest, out, self.curvature_rows]
            launch(self.gather_kernels.matrix_product, (m.worlds, threads), args)
        else:
            self.curvature_rows = w.warp_rows
            topology = self.clusters.topology if self.clusters else m.topology
            total = self.gather_kernels.with_mass_sum if self.clusters else self.gather_kernels.operator_product
            args = [topology, w.contribution, *rest, out, w.warp_rows]
            launch(total, (m.worlds, launch.padded(m.slots)), args)

    @launch_part("loads")
    def tangent_curvature(self, active: wp.array) -> None:
        """p.K p of the non-potential forces along the direction p, into the Newton control."""
        w, launch = self.work, self.launch
        if not self.terms.traits.tangent:
            return
        for term in self.terms:
            if not term.potential:
                term.product(self.ctx, w.direction, active)
        args = [self.terms.nonpotential_topology, w.nonpotential_tangent, active, w.Hp]
        launch(self.gather_kernels.gather_force, self.dim, args)
        launch(self.vector_kernels.dot_terms, self.dim, [w.Hp, w.direction, active, w.rows])  # p is 0 where prescribed
        self.reduce(w.rows, 1, active, w.newton.search.tangent_sum)
