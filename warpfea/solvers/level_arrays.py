"""Matrices and vectors of the levels of a preconditioner."""

from __future__ import annotations

from typing import TYPE_CHECKING

import warp as wp

from ..kernels.common.types import precision
from ..kernels.solvers.levels import TILE_UNKNOWNS
from .dense import DenseInverse

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..terms.workspace import Workspace
    from .levels import Level

__all__ = ["LevelArrays"]


class LevelArrays:
    """Matrices and vectors of one level, [world, ...]."""

    def __init__(
        self, model: Model, work: Workspace, launch: Launcher, level: Level, depth: int, storage: str,
        by_component: bool
    ) -> None:  # fmt: skip
        B, n, T = model.worlds, level.slot_count, model.types.T
        S = precision(storage).T
        other = storage != model.dtype
        name = f"level {depth}"
        self.block_values = (
            work.array(f"{name} matrix", (B, level.pattern.entry_count), model.types.mat33) if depth else None
        )
        if level.band is not None:
            return
        components = level.components if by_component else None
        self.dense_inverse = (
            DenseInverse(model, work, launch, name, 3 * n, storage, components) if level.is_dense else None
        )
        if not level.is_dense:
            shape = (B, level.tile_count, TILE_UNKNOWNS, TILE_UNKNOWNS)
            self.tile_inverse = work.array(f"{name} inverse", shape, T)
            self.stored_inverse = work.array(f"{name} stored", shape, S) if other else self.tile_inverse
            self.inverse_root_diagonal = work.array(f"{name} root", shape[:3] if other else (1, 1, 1), T)
            self.pivot_diagonal = work.array(f"{name} pivots", (B, level.tile_count, TILE_UNKNOWNS), T)
            self.pivot_column = work.array(f"{name} column", (B, level.tile_count, TILE_UNKNOWNS), T)
        elif level.group_count:  # no tiles
            self.stored_inverse = work.array(f"{name} tiles", (1, 1, 1, 1), S)
            self.inverse_root_diagonal = work.array(f"{name} root tiles", (1, 1, 1), T)
        self.vectors: dict[str, wp.array] = {}
        if depth:
            names = ("r", "x") if level.is_dense else ("r", "x", "z", "d")
            self.vectors = {k: work.array(f"{name} {k}", (B, n), model.types.vec3) for k in names}
