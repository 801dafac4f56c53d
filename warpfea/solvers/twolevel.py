"""Two-level preconditioner: inverses of tiles of 48 unknowns plus a coarse space, the affine motions of groups.

z = T r + P C P^T r. T holds dense inverses of the diagonal blocks of H for the tiles, P the four affine functions per
axis of each group of 64 slots (a position slot moves by a + B (X - Xc), a gradient slot along E by B E), and C
approximates the inverse of P^T H P. C is a dense inverse if that matrix is small, else CHEBYSHEV_STEPS steps of the
Chebyshev iteration, preconditioned by the same construction one level down. An additive sum of all levels is cheaper
per iteration, but its iterations grow with the mesh.

Rejected variants: NOTES.md.

If some slot order makes H a narrow band, H itself is the only level, factored as a band (band.py).

In statics a model of beams small enough for one dense inverse is factored instead, with every matrix of the operator:
slender bodies need the exact tangent and exact directions there.

With bodies that terms couple, as contacts do, C is one dense matrix with their couplings, if it is small enough, also
where T holds inverses of whole bodies; else their rigid body modes are added (rigid_body_modes.py).

An odd number of Chebyshev steps keeps C positive for any largest eigenvalue.

With constraints, tiles and coarse matrices contain the penalties. If a constraint couples slots of several tiles, (D +
(dq/dv) J^T rho J)^-1 by Woodbury's identity is added on the constrained slots.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import warp as wp

from ..base.launch import launch_part
from ..kernels.solvers.blocks import block_kernels
from ..kernels.solvers.levels import TILE_SLOTS, TILE_UNKNOWNS, level_kernels, level_struct
from ..kernels.solvers.levels_build import FACTOR_LANES, build_kernels
from ..kernels.solvers.pcg import pcg_kernels
from ..model.state import view_as_words
from ..terms.protocols import CachedInputs, Constrained, Coupled, Preconditioned
from .band import BandFactor, find_band
from .dense import gauss_jordan
from .level_arrays import LevelArrays
from .levels import GROUP_SLOTS, CoarseFunctions, Level, make_levels
from .matrix_assembly import leading_view, worlds_per_chunk
from .preconditioner import Preconditioner
from .reuse import ReuseRule
from .rigid_body_modes import RigidBodyModes

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..model.state import State
    from ..terms.workspace import Workspace
    from .residual import Residual

__all__ = ["TwoLevel"]

CHEBYSHEV_STEPS = 3
LARGEST_EIGENVALUE = 3.5
"""Assumed largest eigenvalue of a preconditioned coarse matrix (2.7 to 3.5 measured)."""
EIGENVALUE_RATIO = 8.0
"""Design ratio of largest to smallest eigenvalue of the Chebyshev steps."""


class TwoLevel(Preconditioner):
    """Preconditioner of the module docstring, rebuilt by the reuse rule (kernels/solvers/reuse.py).

    Attributes:
        factors_operator: triangular factors of every matrix of the operator, in place of inverses.
        block_terms: terms that add to the matrix.
        solved_directly: the first level is inverted or factored as a whole.
        block_values: matrix of the first level [world of a chunk, entry].
        cached_inputs: by term, the inputs of its blocks at the linearisation point.
    """

    def __init__(self, model: Model, work: Workspace, launch: Launcher, residual: Residual) -> None:
        self.model, self.work, self.launch, self.residual = model, work, launch, residual
        self.plan = plan = residual.plan
        self.storage_dtype = plan.storage
        assert residual.assembler is not None
        self.assembler = residual.assembler
        self.kernels = level_kernels(model.dtype, self.storage_dtype)
        self.setup_kernels = build_kernels(model.dtype, self.storage_dtype)
        self.block_kernels = block_kernels(model.dtype)
        self.block_jacobi = pcg_kernels(model.dtype, model.terms.traits.has_constraints).apply_block_jacobi
        self.dim = (model.worlds, model.slots)
        self.levels = self._make_levels()
        self.ctx, self.terms = residual.ctx, model.terms
        self.block_terms = self.terms.having(Preconditioned)
        for term in self.block_terms:
            term.allocate_blocks(self.ctx, self.assembler, projected=True)
        traits = model.terms.traits
        self.terms_add_blocks = traits.pooled or traits.constraint_rows  # terms add to the matrix
        first, pattern = self.levels[0], self.assembler.pattern
        band = first.band
        self.band = BandFactor(model, work, launch, band, pattern) if band is not None else None
        self.factors_operator = plan.factors_operator
        whole = self.factors_operator  # not by component
        of_level = partial(LevelArrays, model, work, launch, storage=self.storage_dtype, by_component=not whole)
        self.level_arrays = [of_level(level, depth) for depth, level in enumerate(self.levels)]
        if self.factors_operator:
            residual.on_assembled = self._factorise
            unknowns = 3 * model.slots if first.is_dense else 0
            self.half_solution = work.array("level 0 half", (model.worlds, unknowns), model.types.T)
        # matrix of a chunk of worlds; with factors a GPU needs more worlds at once to be busy
        share = 2 if self.factors_operator and self.terms_add_blocks else 1
        self.worlds_per_chunk = model.worlds
        if not plan.body_modes:
            work.chunks["preconditioner matrix"] = lambda worlds: min(worlds, share * worlds_per_chunk(worlds))
            self.worlds_per_chunk = work.chunks["preconditioner matrix"](model.worlds)
        self.block_values = self.assembler.allocate_values("preconditioner matrix", self.worlds_per_chunk)
        self.chunk_flags = work.array("preconditioner chunk", (model.worlds,), wp.int32)
        if plan.exact:
            assert self.band is not None
            work.pcg.preconditioner_is_exact = self.band.exact
        self.body_modes, self.mode_coupling_modules = self._make_body_modes()
        self.one_thread_per_row = 0 if model.device.is_cuda else 1
        self.solved_directly = first.is_dense or band is not None
        deflates = self.ctx.options.deflate_constraints and not (self.solved_directly or self._tiles_hold_constraints())
        self.corrections = self.terms.having(Constrained) if deflates else []
        self.ctx.options = replace(self.ctx.options, deflate_constraints=deflates)
        self.cached_inputs: dict[str, CachedInputs] = {}
        # iteration counts are not comparable; separate key
        name = "preconditioner" if band is None else "preconditioner_banded"
        self.reuse = ReuseRule(model, work, launch, name, plan.rebuild_cost)
        most = max([level.slot_count for level in self.levels[1:]], default=1)
        self.all_free = wp.full(most, 1.0, dtype=model.types.vec3, device=model.device)

    def _tiles_hold_constraints(self) -> bool:
        """True if the free slots of each constraint lie in one tile, whose inverse contains its penalty."""
        tile, slot_table = self.levels[0].device_data.tile_of_slot.numpy(), self.model.slot_table
        free = np.any(slot_table.free > 0.0, axis=1)
        for term in self.terms.having(Constrained):
            rows, slots, _ = term.incidence()
            pairs = np.column_stack([rows, tile[slots]])[free[slots]]
            if len(np.unique(pairs, axis=0)) > len(np.unique(pairs[:, 0])):
                return False
        return self.storage_dtype == self.model.dtype

    def _make_body_modes(self) -> tuple[RigidBodyModes | None, set[wp.Module]]:
        """Rigid body modes of bodies coupled by terms, and the term modules that they need."""
        if not self.plan.body_modes:
            return None, set()
        coupled = self.terms.having(Coupled)
        if self.couples_levels:
            dense = self.level_arrays[-1].dense_inverse
            assert dense is not None
            coarse = CoarseFunctions.of_levels(self.model, self.levels, dense.matrix)
            return None, set().union(*(term.allocate_coarse_coupling(self.ctx, coarse) for term in coupled))
        out = RigidBodyModes(self.model, self.work, self.launch, self.residual, self.assembler.pattern)
        return out, out.modules().union(*(term.allocate_mode_coupling(self.ctx, out) for term in coupled))

    def _make_levels(self) -> list[Level]:
        """Levels of "two-level", "tiles" (without a coarse space) or "banded"."""
        model, pattern, kind = self.model, self.assembler.pattern, self.plan.preconditioner
        if kind == "banded":
            band = find_band(model) or find_band(model, any_width=True)
            return [Level(pattern, model.slots, False, level_struct(model.dtype)(), band=band)]
        by_component = self.storage_dtype == model.dtype
        coupled = self.plan.body_modes and not self.plan.factors_operator
        key = f"{kind}{'' if by_component else ' whole'}{' coupled' if coupled else ''}"
        if key not in model.cache:
            options = {"coarse": kind != "tiles", "by_component": by_component, "coupled": coupled}
            model.cache[key] = make_levels(model, pattern, **options)
        return model.cache[key]

    @property
    def couples_levels(self) -> bool:
        """True if terms couple bodies in the matrix of the second level, in place of their rigid body modes."""
        return self.plan.body_modes and len(self.levels) == 2 and self.levels[1].components is None

    def register(self, state: State) -> None:
        """Register the linearisation point and the rule's counts in the state, for resumed runs."""
        self.reuse.register(state)
        for term in self.block_terms:
            kept = CachedInputs([], [], [])
            for key, array in term.cached_inputs(self.ctx):
                name = f"{term.name}_{key}".replace(" ", "_")
                kept.live.append(array)
                kept.cached.append(self.work.array(f"preconditioner {name}", array.shape, array.dtype))
                kept.state.append(state.register(f"preconditioner_{name}", array.dtype, array.shape[1:]))
            if kept.live:
                self.cached_inputs[term.name] = kept

    def _copy_cached(self, accepted: wp.array | None = None) -> None:
        reuse = self.reuse
        reuse.move_point(accepted)
        flags = reuse.no_flags if accepted is None else accepted
        for term in self.block_terms:
            kept = self.cached_inputs.get(term.name)
            if kept is not None and not term.copy_cached(self.ctx, kept, reuse.control, flags):
                for arrays in zip(kept.live, kept.state, kept.cached):
                    words = [view_as_words(array) for array in arrays]
                    self.launch(reuse.kernels.transfer_words, words[0].shape, [reuse.control, flags, *words])

    def modules(self) -> set[wp.Module]:
        """Modules launched."""
        out = {self.kernels.module, self.reuse.kernels.module, self.block_kernels.module}
        out |= self.assembler.modules() | self.mode_coupling_modules
        out |= self.band.modules() if self.band else {self.setup_kernels.module}
        dense = [] if self.band else [arrays.dense_inverse for arrays in self.level_arrays]
        return out.union(*(inverse.modules() for inverse in dense if inverse))

    @launch_part("build")
    def invalidate(self, flags: wp.array) -> None:
        """Invalidate history of worlds whose state was set externally."""
        self.reuse.invalidate(flags)

    def store_history(self, accepted: wp.array) -> None:
        """Store history in the state."""
        self._copy_cached(accepted)
        self.reuse.store_counts(accepted)

    @launch_part("build")
    def start(self, active: wp.array, *, rebuild: bool = False) -> None:
        """Rebuild where due, with D and the penalties that follow from D."""
        # factors that follow the operator's matrix reuse D only; beside contacts, which change as much, old inverses of
        # the whole matrix cost fewer iterations than they save (4096 fingers: 0.2 a solve and half of the rebuilds)
        kept = self.factors_operator or (self.solved_directly and self.model.terms.traits.unilateral)
        whole = rebuild and not (kept and self.plan.on_cuda)
        self.reuse.decide_rebuild(active, all_active=whole)
        self.reuse.rebuild_if_flagged(partial(self._build, penalty=True))

    @launch_part("build")
    def prepare(self, active: wp.array) -> None:
        """Rebuild where due, with the constraint penalties of the step."""
        self.reuse.decide_rebuild(active)
        self.reuse.rebuild_if_flagged(self._build)

    @launch_part("build")
    def record_cost(self) -> None:
        """Record the iteration count of the solve. Factors follow the operator's matrix: only D is kept, which weights
        the norms, and which no count of iterations calls for anew."""
        if not self.factors_operator:
            args = [self.reuse.control, self.work.newton, self.work.pcg]
            self.launch(self.reuse.kernels.count_solve, self.model.worlds, args)

    @launch_part("preconditioner")
    def apply(self, r: wp.array, z: wp.array, active: wp.array) -> None:
        """z = B r; partial sums r.z and r.D^-1 r in rows."""
        m, w, launch, k = self.model, self.work, self.launch, self.kernels
        level = self.levels[0]
        if self.solved_directly:
            if self.band:
                self.band.solve(r, z, active)
            else:
                self._apply_dense(0, r, z, active)
        coarse, correct = z, int(len(self.levels) > 1)
        if correct or not self.solved_directly:
            coarse = self._smooth(0, r, z, active)
        if self.body_modes:
            self.body_modes.apply(r, z, active)
        args = [level.device_data, correct, coarse, m.topology.free, r, w.diagonal, active, w.warp_size, z, w.warp_rows]
        dim = (m.worlds, launch.padded(m.slots))
        launch(k.add_coarse_correction, dim, args)
        if self.corrections:
            args = [w.inverse, r, w.diagonal, active, w.warp_size, w.Hp, w.spare_rows]
            launch(self.block_jacobi, dim, args)
            for term in self.corrections:
                term.precondition(self.ctx, r, w.Hp, active, into=z)

    # application

    def _apply_dense(self, depth: int, r: wp.array, x: wp.array, active: wp.array) -> None:
        n, B = self.levels[depth].slot_count, self.model.worlds
        flat_r, flat_x = (leading_view(a, (B, 3 * n), self.model.types.T) for a in (r, x))
        dense = self.level_arrays[depth].dense_inverse
        assert dense is not None
        if self.factors_operator:  # z = L^-T (L^-1 r)
            lanes = self.launch.lanes(3 * n)
            dim = (B, self.launch.padded(3 * n * lanes))
            for upper, given, out in ((0, flat_r, self.half_solution), (1, self.half_solution, flat_x)):
                args = [dense.stored_inverse, dense.inverse_root_diagonal, upper, lanes, given, active, out]
                self.launch(self.kernels.apply_triangular_inverse, dim, args)
            return
        dense.apply(flat_r, flat_x, active)

    def _smooth(self, depth: int, r: wp.array, z: wp.array, active: wp.array) -> wp.array:
        """z = T r on a level; returns the coarse correction C P^T r, not yet interpolated by P."""
        level, arrays = self.levels[depth], self.level_arrays[depth]
        last = depth + 1 == len(self.levels)  # tiles alone
        coarse = z if last else self.level_arrays[depth + 1].vectors["r"]
        share = 4 if self.model.device.is_cuda else 1
        first_group = self.launch.padded(share * TILE_SLOTS * level.tile_count)
        lanes = self.launch.lanes(GROUP_SLOTS)
        args = [level.device_data, arrays.stored_inverse, arrays.inverse_root_diagonal, self.one_thread_per_row]
        args += [share, lanes, first_group, r, active, z, coarse]
        threads = first_group + (0 if last else lanes * level.group_count)
        self.launch(self.kernels.smooth_and_restrict, (self.model.worlds, threads), args)
        if last:
            return z
        below = self.level_arrays[depth + 1].vectors
        if self.levels[depth + 1].is_dense:
            self._apply_dense(depth + 1, below["r"], below["x"], active)
        else:
            self._chebyshev(depth + 1, active)
        return below["x"]

    def _chebyshev(self, depth: int, active: wp.array) -> None:
        """x = C r on an intermediate level by Chebyshev steps; overwrites r."""
        level, arrays = self.levels[depth], self.level_arrays[depth]
        v = arrays.vectors
        dim = (self.model.worlds, level.slot_count)
        low = LARGEST_EIGENVALUE / EIGENVALUE_RATIO
        centre, half = 0.5 * (LARGEST_EIGENVALUE + low), 0.5 * (LARGEST_EIGENVALUE - low)
        ratio = centre / half
        rho = 1.0 / ratio
        keep, step = 0.0, 1.0 / centre
        for k in range(CHEBYSHEV_STEPS):
            coarse = self._smooth(depth, v["r"], v["z"], active)
            args = [level.device_data, 1, coarse, v["z"], keep, step, active, v["d"], v["x"]]
            self.launch(self.kernels.chebyshev_step, dim, args)
            if k < CHEBYSHEV_STEPS - 1:
                lanes = self.launch.lanes(level.pattern.mean_row_length)
                args = [level.pattern.data, arrays.block_values, v["d"], lanes, active, v["r"]]
                threads = self.launch.padded(level.slot_count * lanes)
                self.launch(self.kernels.subtract_product, (self.model.worlds, threads), args)
            new = 1.0 / (2.0 * ratio - rho)
            keep, step = new * rho, 2.0 * new / half
            rho = new

    def _chunks(self, flags: wp.array) -> Iterator[tuple[range, wp.array, wp.array]]:
        """Worlds of each chunk, flags of the worlds chosen by `flags`, and `value` indexed over all worlds."""
        B = self.model.worlds
        for first in range(0, B, self.worlds_per_chunk):
            worlds = range(first, min(first + self.worlds_per_chunk, B))
            if len(worlds) == B:
                yield worlds, flags, self.block_values
                return
            self.launch(self.block_kernels.select_worlds, B, [flags, worlds.start, worlds.stop, self.chunk_flags])
            yield worlds, self.chunk_flags, self.assembler.chunk_view(self.block_values, first)

    def _build(self, *, penalty: bool = False) -> None:
        m, w, launch, reuse = self.model, self.work, self.launch, self.reuse.control
        # rows are scaled once the penalties are known
        for worlds, flags, value in self._chunks(reuse.build_now):
            self.assembler.assemble(self.reuse.iterate, reuse.mass_factor, flags, value, projected=True, worlds=worlds)
            if self.terms_add_blocks and m.terms.traits.pooled:
                self._copy_cached()
                self._add_term_blocks(value, flags, penalties=False)
            args = [m.topology, self.assembler.pattern.data, value, flags, w.diagonal, w.inverse]
            launch(self.block_kernels.invert_diagonal_blocks, self.dim, args)
            if m.terms.traits.has_constraints:
                if penalty:
                    for term in self.terms.having(Constrained):
                        term.scale(self.ctx, flags)
                self._copy_cached()
                self._add_term_blocks(value, flags, penalties=True)
            self._factorise_or_fill(value, flags)
        if self.body_modes:
            self._add_mode_coupling(self.body_modes, reuse.build_now)
        if not (self.factors_operator or self.band):
            self._invert(reuse.build_now)

    def _factorise_or_fill(self, value: wp.array, flags: wp.array) -> None:
        """Factor the matrix of some worlds, or fill the tiles and the next level."""
        level, arrays = self.levels[0], self.level_arrays[0]
        if self.factors_operator:
            return
        if self.band:
            self.band.factorise(value, flags)
        else:
            if arrays.dense_inverse is not None:
                arrays.dense_inverse.fill(level.pattern, value, flags)
            self._fill(0, value, flags)

    def _fill(self, depth: int, value: wp.array, flags: wp.array) -> None:
        """Fill the tiles of a level and the matrix of the next one."""
        m, level, arrays = self.model, self.levels[depth], self.level_arrays[depth]
        if level.tile_count:
            args = [level.device_data, level.pattern.data, value, flags, arrays.pivot_diagonal, arrays.tile_inverse]
            self.launch(self.setup_kernels.fill_tiles, (m.worlds, level.tile_count, TILE_SLOTS), args)
        if depth + 1 < len(self.levels):
            assert level.galerkin_tables is not None
            free = self.all_free if depth else m.topology.free
            out = self.level_arrays[depth + 1].block_values
            args = [*level.galerkin_tables, level.device_data.affine_values, free, value, flags, out]
            self.launch(self.block_kernels.galerkin_product, (m.worlds, 16 * level.galerkin_tables[0].shape[0]), args)

    def _invert(self, flags: wp.array) -> None:
        """Invert all levels; the first is already filled."""
        coupled = [*self._coupled_terms()] if self.couples_levels else []
        for depth, (level, arrays) in enumerate(zip(self.levels, self.level_arrays)):
            if arrays.dense_inverse is not None:
                if depth:
                    arrays.dense_inverse.fill(level.pattern, arrays.block_values, flags)
                for term, kept in coupled:
                    term.add_coarse_coupling(self.ctx, kept, self.reuse.control.dq_dv, flags)
                arrays.dense_inverse.invert(flags, keep=depth == 0, reduce=self.residual.reduce)
                continue
            if arrays.block_values is not None:
                self._fill(depth, arrays.block_values, flags)
            self._invert_tiles(level, arrays, flags, keep=depth == 0)

    def _add_mode_coupling(self, motions: RigidBodyModes, flags: wp.array) -> None:
        """Assemble and invert the matrix of the rigid body modes."""
        motions.assemble(self.reuse.linearisation_point, self.block_values, flags)
        for term, kept in self._coupled_terms():
            term.add_mode_coupling(self.ctx, kept, self.reuse.control.dq_dv, flags)
        motions.invert(flags)

    def _coupled_terms(self) -> Iterator[tuple[Coupled, list[wp.array]]]:
        """Terms that couple bodies, and the inputs of their blocks."""
        for term in (term for term in self.terms.having(Coupled) if term.coupled_bodies()):
            yield term, self.cached_inputs[term.name].cached if term.name in self.cached_inputs else []

    def _add_term_blocks(self, value: wp.array, flags: wp.array, *, penalties: bool) -> None:
        """Add the terms' blocks to the matrix of some worlds: those that D is taken from, or the penalties."""
        reuse = self.reuse.control
        for term in self.block_terms:
            if isinstance(term, Constrained) == penalties:
                kept = self.cached_inputs[term.name].cached if term.name in self.cached_inputs else []
                term.blocks(self.ctx, self.assembler, kept, reuse.dq_dv, flags, value, projected=True)

    @launch_part("build")
    def _factorise(self, value: wp.array, flags: wp.array) -> None:
        if self.band and not self.terms_add_blocks:
            self.band.factorise(value, flags)
            return
        if self.band:
            for worlds, chosen, out in self._chunks(flags):
                self._copy_with_term_blocks(value, worlds, chosen, out)
                self.band.factorise(out, chosen)
            return
        dense = self.level_arrays[0].dense_inverse
        assert dense is not None
        lanes = FACTOR_LANES if self.model.device.is_cuda else 1
        dense.fill(self.levels[0].pattern, value, flags)
        args = [lanes, dense.matrix_diagonal, flags, dense.left_panel, dense.top_panel, dense.matrix]
        self.launch(self.setup_kernels.factor_dense, self.model.worlds * lanes, args, block_dim=FACTOR_LANES)

    def _copy_with_term_blocks(self, value: wp.array, worlds: range, flags: wp.array, out: wp.array) -> None:
        """Operator matrix of some worlds with all term contributions."""
        w, dim = self.work, (len(worlds), 3 * self.assembler.pattern.entry_count)
        rows = slice(worlds.start, worlds.stop)
        given, copy = (leading_view(a, dim, self.model.types.vec3) for a in (value[rows], self.block_values))
        self.launch(self.residual.vector_kernels.copy_active, dim, [given, flags[rows], copy])
        for term in self.block_terms:
            live = [array for _, array in term.cached_inputs(self.ctx)]
            term.blocks(self.ctx, self.assembler, live, w.step.dq_dv, flags, out, projected=False)

    def _invert_tiles(self, level: Level, arrays: LevelArrays, flags: wp.array, *, keep: bool) -> None:
        B, k = self.model.worlds, self.setup_kernels
        gauss_jordan(self.launch, k, level.tile_count, arrays, arrays.tile_inverse, flags, keep=keep)
        if arrays.stored_inverse is not arrays.tile_inverse:
            args = [level.tile_count, arrays.pivot_diagonal, arrays.tile_inverse, flags]
            args += [arrays.inverse_root_diagonal, arrays.stored_inverse]
            self.launch(k.store_tile_inverses, (B, level.tile_count, TILE_UNKNOWNS), args)
