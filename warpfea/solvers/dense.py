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
from ..kernels.solvers.levels import LANES, TILE, level_kernels
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
        count: their number; most: slots of the largest.
        slot: device table [component, position], -1 if unused; place_of: its inverse, [slot].
    """

    count: int
    most: int
    slot: wp.array
    place_of: wp.array

    @classmethod
    def of(cls, model: Model, pattern: Pattern) -> DenseComponents | None:
        """None if splitting saves no memory."""
        count, label = sp.csgraph.connected_components(pattern.graph, directed=False)
        slots = len(label)
        most = int(np.bincount(label).max())
        if count * padded_size(3 * most) ** 2 >= padded_size(3 * slots) ** 2:
            return None
        order = np.argsort(label, kind="stable")
        start = np.concatenate([[0], np.cumsum(np.bincount(label))])
        place = np.empty(slots, dtype=np.int64)
        place[order] = np.arange(slots) - start[label[order]]
        table = np.full((count, most), -1)
        table[label, place] = np.arange(slots)
        return cls(count, most, model.array("levels", table, wp.int32), model.array("levels", place, wp.int32))


def padded_size(unknowns: int) -> int:
    """Number of unknowns rounded up to whole tiles."""
    return TILE * -(-unknowns // TILE)


def gauss_jordan(
    launch: Launcher, kernels: Any, tiles: int, at: Any, matrix: wp.array, flags: wp.array, *, keep: bool
) -> None:
    """Invert tiles [world, tile, TILE, TILE] in place; `at` holds their `diagonal` and a scratch `column`."""
    lanes = LANES if launch.device.is_cuda else 1
    args = [lanes, tiles, int(keep), flags, at.diagonal, at.column, matrix]
    launch(kernels.invert_tiles, flags.shape[0] * tiles * lanes, args, block_dim=LANES)


class DenseInverse:
    """Matrix [world, row, column] and its inverse in place, stored in `stored` with precision `storage`.

    Attributes:
        unknowns: matrix size; size: the same rounded up to whole tiles.
        matrix, scale: filled before `invert`: the matrix and its diagonal; zero beyond the unknowns.
    """

    def __init__(
        self, model: Model, work: Workspace, launch: Launcher, name: str, unknowns: int, storage: str | None = None,
        parts: DenseComponents | None = None,
    ) -> None:  # fmt: skip
        B, T = model.worlds, model.types.T
        storage = storage or model.dtype
        S, other = precision(storage).T, storage != model.dtype
        assert not (other and parts)
        self.worlds, self.launch, self.unknowns, self.parts = B, launch, unknowns, parts
        self.kernels, self.making = level_kernels(model.dtype, storage), build_kernels(model.dtype, storage)
        if parts:
            self.by_part = dense_component_kernels(model.dtype)
            B *= parts.count
            unknowns = 3 * parts.most
            self.flags = work.array(f"{name} flags", (B,), wp.int32)
        self.blocks, self.size = B, padded_size(unknowns)
        N = self.size
        self.matrix = work.array(f"{name} inverse", (B, N, N), T)
        self.stored = work.array(f"{name} stored", (B, N, N), S) if other else self.matrix
        self.root = work.array(f"{name} root", (B, N if other else 1), T)
        self.rows = work.array(f"{name} rows", (1, B, N if other else 1), wp.float64)
        self.trace = work.array(f"{name} trace", (1, B), wp.float64)
        self.left = work.array(f"{name} panels", (B, TILE, N), T)
        self.top = work.array(f"{name} panels 2", (B, TILE, N), T)
        self.scale = work.array(f"{name} diagonal", (B, N), T)
        self.pivot = work.array(f"{name} pivot", (B, 1, TILE, TILE), T)
        self.diagonal = work.array(f"{name} pivots", (B, 1, TILE), T)
        self.column = work.array(f"{name} column", (B, 1, TILE), T)

    def modules(self) -> set[wp.Module]:
        """Modules launched."""
        more = {self.by_part.module} if self.parts else set()
        return {self.making.module, self.kernels.module} | more

    def fill(self, pattern: Pattern, value: Any, flags: wp.array) -> None:
        """Copy a matrix of 3x3 blocks in the flagged worlds."""
        if self.parts:
            self.launch(self.by_part.spread, self.blocks, [flags, self.flags])
            args = [pattern.data, value, self.parts.slot, self.parts.place_of, self.flags, self.scale, self.matrix]
            self.launch(self.by_part.fill_parts, (self.blocks, self.size), args)
            return
        args = [pattern.data, value, self.unknowns // 3, flags, self.scale, self.matrix]
        self.launch(self.making.fill_dense, (self.worlds, self.size // 3), args)

    def invert(self, flags: wp.array, *, keep: bool, reduce: Any) -> None:
        """Invert in the flagged worlds; `reduce` sums rows (residual.Reducer)."""
        B, N, k, launch = self.blocks, self.size, self.making, self.launch
        if self.parts:  # scattered by `fill`
            flags = self.flags
        for first in range(0, N, TILE):
            args = [self.matrix, self.scale, first, flags, self.diagonal, self.pivot]
            launch(k.take_pivot, (B, TILE, TILE), args)
            gauss_jordan(launch, k, 1, self, self.pivot, flags, keep=keep)
            args = [self.matrix, self.pivot, first, flags, self.left, self.top]
            launch(k.take_panels, (B, TILE, N), args)
            args = [self.pivot, self.left, self.top, first, flags, self.matrix]
            launch(k.eliminate, (B, N // 4, N), args)
        if self.stored is not self.matrix:
            launch(k.dense_traces, (B, N), [self.scale, self.matrix, flags, self.rows])
            reduce(self.rows, 1, flags, self.trace)
            args = [self.scale, self.trace, self.matrix, flags, self.root, self.stored]
            launch(k.store_dense, (B, N, N), args)

    def apply(self, r: wp.array, x: wp.array, active: wp.array) -> None:
        """x = A^-1 r, [world, unknown]."""
        if self.parts:
            n = self.parts.count * 3 * self.parts.most
            lanes = self.launch.lanes(3 * self.parts.most)
            args = [self.matrix, self.parts.slot, lanes, r, active, x]
            self.launch(self.by_part.apply_parts, (self.worlds, self.launch.padded(n * lanes)), args)
            return
        n = self.unknowns
        lanes = self.launch.lanes(n)
        dim = (self.worlds, self.launch.padded(n * lanes))
        self.launch(self.kernels.apply_dense, dim, [self.stored, self.root, lanes, r, active, x])
