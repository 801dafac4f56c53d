"""Inverses of dense matrices, one per world, by block Gauss-Jordan with blocks of the size of a tile."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import warp as wp

from ..kernels.common.types import precision
from ..kernels.solvers.levels import LANES, TILE, level_kernels
from ..kernels.solvers.levels_build import build_kernels

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..terms.workspace import Workspace

__all__ = ["DenseInverse", "gauss_jordan"]


def gauss_jordan(
    launch: Launcher, kernels: Any, tiles: int, at: Any, matrix: wp.array, flags: wp.array, *, keep: bool
) -> None:
    """Inverses in place of tiles [world, tile, TILE, TILE]; `at` has their `diagonal`, and a `column` as scratch."""
    lanes = LANES if launch.device.is_cuda else 1
    args = [lanes, tiles, int(keep), flags, at.diagonal, at.column, matrix]
    launch(kernels.invert_tiles, flags.shape[0] * tiles * lanes, args, block_dim=LANES)


class DenseInverse:
    """A matrix [world, row, column] and its inverse in its place, in the precision `storage` in `stored`.

    Attributes:
        unknowns: of the matrix; size: those and what fills its last tile.
        matrix, scale: to be filled before `invert`, and the matrix' diagonal; zeros beyond the unknowns.
    """

    def __init__(
        self, model: Model, work: Workspace, launch: Launcher, name: str, unknowns: int, storage: str | None = None
    ) -> None:  # fmt: skip
        B, T = model.worlds, model.types.T
        storage = storage or model.dtype
        S, other = precision(storage).T, storage != model.dtype
        N = TILE * -(-unknowns // TILE)
        self.worlds, self.launch, self.unknowns, self.size = B, launch, unknowns, N
        self.kernels, self.making = level_kernels(model.dtype, storage), build_kernels(model.dtype, storage)
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

    def invert(self, flags: wp.array, *, keep: bool, reduce: Any) -> None:
        """The inverse in the flagged worlds; `reduce` sums rows (residual.Reducer)."""
        B, N, k, launch = self.worlds, self.size, self.making, self.launch
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
        n = self.unknowns
        lanes = self.launch.lanes(n)
        dim = (self.worlds, self.launch.padded(n * lanes))
        self.launch(self.kernels.apply_dense, dim, [self.stored, self.root, lanes, r, active, x])
