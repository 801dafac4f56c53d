"""Inverses of dense matrices by block Gauss-Jordan with tile-sized blocks: one per world, or one per uncoupled
component of it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..kernels.common.types import precision
from ..kernels.solvers.dense_components import dense_component_kernels
from ..kernels.solvers.levels import TILE_LANES, TILE_UNKNOWNS, level_kernels
from ..kernels.solvers.levels_build import build_kernels

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..terms.workspace import Workspace
    from .matrix_assembly import Pattern

__all__ = ["DenseComponents", "DenseInverse", "gauss_jordan"]


@dataclass(eq=False)
class DenseComponents:
    """Uncoupled components of a pattern.

    Attributes:
        count: number of components; max_slots: slots of the largest.
        slot_table: device table [component, position], -1 if unused; slot_position: its inverse, [slot].
    """

    count: int
    max_slots: int
    slot_table: wp.array
    slot_position: wp.array

    @classmethod
    def from_pattern(cls, model: Model, pattern: Pattern) -> DenseComponents | None:
        """Components of a pattern, or None if splitting the matrix saves no memory."""
        count, label = sp.csgraph.connected_components(pattern.graph, directed=False)
        slots = len(label)
        max_slots = int(np.bincount(label).max())
        if count * padded_size(3 * max_slots) ** 2 >= padded_size(3 * slots) ** 2:
            return None
        order = np.argsort(label, kind="stable")
        start = np.concatenate([[0], np.cumsum(np.bincount(label))])
        place = np.empty(slots, dtype=np.int64)
        place[order] = np.arange(slots) - start[label[order]]
        table = np.full((count, max_slots), -1)
        table[label, place] = np.arange(slots)
        return cls(count, max_slots, model.array("levels", table, wp.int32), model.array("levels", place, wp.int32))


def padded_size(unknowns: int) -> int:
    """Number of unknowns rounded up to whole tiles."""
    return TILE_UNKNOWNS * -(-unknowns // TILE_UNKNOWNS)


def gauss_jordan(
    launch: Launcher, kernels: Any, tiles: int, scratch: Any, matrix: wp.array, flags: wp.array, *, keep: bool
) -> None:
    """Invert tiles [world, tile, row, column] in place; `scratch` holds `pivot_diagonal` and `pivot_column`."""
    lanes = TILE_LANES if launch.device.is_cuda else 1
    args = [lanes, tiles, int(keep), flags, scratch.pivot_diagonal, scratch.pivot_column, matrix]
    launch(kernels.invert_tiles, flags.shape[0] * tiles * lanes, args, block_dim=TILE_LANES)


class DenseInverse:
    """Matrix [world, row, column] and its inverse in place; `stored_inverse` is a copy with precision `storage`.

    Attributes:
        unknowns: matrix size; padded_size: the same rounded up to whole tiles.
        matrix, matrix_diagonal: filled before `invert`, zero beyond the unknowns; `matrix` is then the inverse.
        inverse_root_diagonal: scaling of `stored_inverse` to a unit diagonal, if its precision is another.
        matrix_count: worlds x components.
    """

    def __init__(
        self, model: Model, work: Workspace, launch: Launcher, name: str, unknowns: int, storage: str | None = None,
        components: DenseComponents | None = None,
    ) -> None:  # fmt: skip
        B, T = model.worlds, model.types.T
        storage = storage or model.dtype
        S, other = precision(storage).T, storage != model.dtype
        assert not (other and components)
        self.worlds, self.launch, self.unknowns, self.components = B, launch, unknowns, components
        self.kernels, self.setup_kernels = level_kernels(model.dtype, storage), build_kernels(model.dtype, storage)
        if components:
            self.component_kernels = dense_component_kernels(model.dtype)
            B *= components.count
            unknowns = 3 * components.max_slots
            self.component_flags = work.array(f"{name} flags", (B,), wp.int32)
        self.matrix_count, self.padded_size = B, padded_size(unknowns)
        N = self.padded_size
        self.matrix = work.array(f"{name} inverse", (B, N, N), T)
        self.stored_inverse = work.array(f"{name} stored", (B, N, N), S) if other else self.matrix
        self.inverse_root_diagonal = work.array(f"{name} root", (B, N if other else 1), T)
        self.trace_terms = work.array(f"{name} rows", (1, B, N if other else 1), wp.float64)
        self.trace = work.array(f"{name} trace", (1, B), wp.float64)
        self.left_panel = work.array(f"{name} panels", (B, TILE_UNKNOWNS, N), T)
        self.top_panel = work.array(f"{name} panels 2", (B, TILE_UNKNOWNS, N), T)
        self.matrix_diagonal = work.array(f"{name} diagonal", (B, N), T)
        self.pivot_tile = work.array(f"{name} pivot", (B, 1, TILE_UNKNOWNS, TILE_UNKNOWNS), T)
        self.pivot_diagonal = work.array(f"{name} pivots", (B, 1, TILE_UNKNOWNS), T)
        self.pivot_column = work.array(f"{name} column", (B, 1, TILE_UNKNOWNS), T)

    def modules(self) -> set[wp.Module]:
        """Modules launched."""
        more = {self.component_kernels.module} if self.components else set()
        return {self.setup_kernels.module, self.kernels.module} | more

    def fill(self, pattern: Pattern, value: Any, flags: wp.array) -> None:
        """Copy a matrix of 3x3 blocks in the flagged worlds."""
        if self.components:
            self.launch(
                self.component_kernels.copy_flags_to_components, self.matrix_count, [flags, self.component_flags]
            )
            args = [pattern.data, value, self.components.slot_table, self.components.slot_position]
            args += [self.component_flags, self.matrix_diagonal, self.matrix]
            self.launch(self.component_kernels.fill_components, (self.matrix_count, self.padded_size), args)
            return
        args = [pattern.data, value, self.unknowns // 3, flags, self.matrix_diagonal, self.matrix]
        self.launch(self.setup_kernels.fill_dense, (self.worlds, self.padded_size // 3), args)

    def invert(self, flags: wp.array, *, keep: bool, reduce: Any) -> None:
        """Invert in the flagged worlds; `reduce` sums rows (residual.RowReducer)."""
        B, N, k, launch = self.matrix_count, self.padded_size, self.setup_kernels, self.launch
        if self.components:  # scattered by `fill`
            flags = self.component_flags
        for first in range(0, N, TILE_UNKNOWNS):
            args = [self.matrix, self.matrix_diagonal, first, flags, self.pivot_diagonal, self.pivot_tile]
            launch(k.copy_pivot_block, (B, TILE_UNKNOWNS, TILE_UNKNOWNS), args)
            gauss_jordan(launch, k, 1, self, self.pivot_tile, flags, keep=keep)
            args = [self.matrix, self.pivot_tile, first, flags, self.left_panel, self.top_panel]
            launch(k.compute_panels, (B, TILE_UNKNOWNS // 4, N), args)
            args = [self.pivot_tile, self.left_panel, self.top_panel, first, flags, self.matrix]
            launch(k.eliminate_pivot_block, (B, N // 4, N), args)
        if self.stored_inverse is not self.matrix:
            launch(k.trace_terms, (B, N), [self.matrix_diagonal, self.matrix, flags, self.trace_terms])
            reduce(self.trace_terms, 1, flags, self.trace)
            args = [self.matrix_diagonal, self.trace, self.matrix, flags, self.inverse_root_diagonal]
            args += [self.stored_inverse]
            launch(k.store_dense_inverse, (B, N, N), args)

    def apply(self, r: wp.array, x: wp.array, active: wp.array) -> None:
        """x = A^-1 r, [world, unknown]."""
        if self.components:
            lanes = self.launch.lanes(3 * self.components.max_slots)
            n = self.components.count * 3 * self.components.max_slots
            kernel, matrix = self.component_kernels.apply_component_inverses, [self.matrix, self.components.slot_table]
        else:
            lanes, n = self.launch.lanes(self.unknowns), self.unknowns
            kernel, matrix = self.kernels.apply_dense_inverse, [self.stored_inverse, self.inverse_root_diagonal]
        self.launch(kernel, (self.worlds, self.launch.padded(n * lanes)), [*matrix, lanes, r, active, x])
