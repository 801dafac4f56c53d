"""Banded Cholesky factors of the whole matrix, for models with a narrow band: chains of beams, strips, slender bars.

Measured on one core, ms per step with the two-level preconditioner and with the band: bars of T10 with 1 x 1, 2 x 2 and
3 x 3 cells across (bandwidth 84, 208 and 392) 10.9 and 1.0, 38 and 4.4, 40 and 10.6; 100 links of E = 7e12 Pa on joints
43 and 5.2 (413 with 3x3 blocks); a square plate of 16 x 16 shells (404) 17.4 and 11.5 in vibration, but 29 and 41 in
fast rotation and bending, where factors last for few steps only. The gain falls further with wider bands.

If a factorisation is cheap relative to assembly, every matrix of the operator is factored, which leaves one PCG
iteration per solve; factors of wider bands are kept by the reuse rule (kernels/solvers/reuse.py).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..base.errors import ModelError
from ..kernels.solvers.band import BLOCK, band_kernels, block_column_type
from ..kernels.solvers.band_block import band_block_kernels, window_size
from .matrix_assembly import MAX_FULL_FACTOR_SLOTS, coupling_pattern

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..terms.workspace import Workspace
    from .matrix_assembly import Pattern

__all__ = ["Band", "BandFactor", "find_band", "fits_thread_block"]

MAX_AUTO_WIDTH = 112
"""Widest band chosen automatically, blocks beside the diagonal; beyond it the two-level preconditioner is cheaper."""
MAX_FACTOR_BYTES = 2**31
"""Size of the factors of one world above which 32-bit indices overflow, bytes."""
MAX_WINDOW_BYTES, MAX_WORLD_FACTOR_BYTES = 48 * 1024, 200_000
"""CUDA limits, bytes: the shared-memory window of a thread block, and the factors of one world that it factors."""
ASSEMBLY_TIME, FACTORISATION_TIME = 1.0, 5.5e-5
"""us per unknown on one core: assembling H of 3243 and T10 elements; a factorisation, per square of the bandwidth."""
PRODUCT_TIME, SOLUTION_TIME = 0.06, 5.4e-4
"""us per unknown on one core: H p; forward and backward substitution, per bandwidth."""


def fits_thread_block(band: Band | None, model: Model) -> bool:
    """True if a thread block of a GPU factors the narrow band of a small model, per world."""
    if band is None:
        return False
    size = wp.types.type_size_in_bytes(model.types.T)
    factors = band.block_rows * (band.half_bandwidth + 1) * BLOCK**2 * size
    return factors <= MAX_WORLD_FACTOR_BYTES and window_size(band.half_bandwidth) * size < MAX_WINDOW_BYTES


@dataclass(eq=False)
class Band:
    """Slot order in which the pattern is a band.

    Attributes:
        slot_order, slot_position: device tables (slots,), the order and its inverse.
        block_rows: number of 4 x 4 block rows.
        half_bandwidth: blocks beside the diagonal per row.
    """

    slot_order: wp.array
    slot_position: wp.array
    block_rows: int
    half_bandwidth: int

    @property
    def rebuild_cost(self) -> float:
        """Cost of assembly and factorisation, in PCG iterations."""
        b = BLOCK * self.half_bandwidth
        return (ASSEMBLY_TIME + FACTORISATION_TIME * b * b) / (PRODUCT_TIME + SOLUTION_TIME * b)

    @property
    def cheap_to_factorise(self) -> bool:
        """True if factorisation is cheap relative to assembly."""
        return FACTORISATION_TIME * (BLOCK * self.half_bandwidth) ** 2 < 0.2 * ASSEMBLY_TIME


def find_band(model: Model, *, any_width: bool = False) -> Band | None:
    """Band in the reverse Cuthill-McKee order if it is narrow, the model small, or `any_width` given; else None.

    Raises:
        ModelError: with `any_width`, factors too large to address.
    """
    name = "band" if any_width else "narrow band"
    if name not in model.cache:
        model.cache[name] = _find_band(model, any_width)
    return model.cache[name]


def _find_band(model: Model, any_width: bool) -> Band | None:
    graph = coupling_pattern(model)
    n = graph.shape[0]
    free = any_width or n <= MAX_FULL_FACTOR_SLOTS
    # lower bound of the bandwidth in any order: half the number of a row's neighbours
    if not free and 3 * (int(np.diff(graph.indptr).max()) // 2) > BLOCK * (MAX_AUTO_WIDTH + 1):
        return None
    order = sp.csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True)
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n)
    rows = np.repeat(place, np.diff(graph.indptr))
    columns = place[graph.indices]
    width = int(((3 * rows + 2) // BLOCK - (3 * columns) // BLOCK).max())
    if not free and width > MAX_AUTO_WIDTH:
        return None
    size = -(-3 * n // BLOCK) * BLOCK**2 * (width + 1) * wp.types.type_size_in_bytes(model.types.T)
    if size >= MAX_FACTOR_BYTES:
        if any_width:
            raise ModelError(
                f"preconditioner = 'banded': the factors of {n} slots in a band of {BLOCK * width} unknowns take "
                f"{size / 2**30:.1f} GiB per world, more than {MAX_FACTOR_BYTES / 2**30:.0f}: take 'two-level'"
            )
        return None
    at, of = (model.array("band", values, wp.int32) for values in (order, place))
    return Band(at, of, -(-3 * n // BLOCK), width)


class BandFactor:
    """Banded factors of all worlds, with the launches that compute and apply them.

    Attributes:
        exact: (worlds,) flags of worlds whose matrix was factored without a diagonal shift.
    """

    def __init__(self, model: Model, work: Workspace, launch: Launcher, band: Band, pattern: Pattern) -> None:
        self.band, self.pattern, self.launch, self.worlds = band, pattern, launch, model.worlds
        self.kernels = band_kernels(model.dtype)
        column: Any = block_column_type(model.dtype)
        B = model.worlds
        self.factors = work.array("band", (B, band.block_rows, BLOCK * (band.half_bandwidth + 1)), column)
        self.by_thread_block = model.device.is_cuda
        if self.by_thread_block:  # a block of threads per world
            self.thread_block_kernels = band_block_kernels(model.dtype, band.block_rows, band.half_bandwidth)
            self.window_memory = work.array("band outside", (1, 1), model.types.T)
        else:
            self.half_solution = work.array("band vector", (B, band.block_rows), column)
        self.diagonal_shift = work.array("band shift", (B,), model.types.T)
        names = ("bad", "doing", "exact")
        self.failed, self.pending, self.exact = (work.array(f"band {name}", (B,), wp.int32) for name in names)
        self.any_retry = work.array("band again", (1,), wp.int32)

    def modules(self) -> set[wp.Module]:
        """Modules launched."""
        return {self.kernels.module} | ({self.thread_block_kernels.module} if self.by_thread_block else set())

    def factorise(self, value: wp.array, active: wp.array) -> None:
        """Factor the blocks `value` [world, entry] of the active worlds.

        An indefinite matrix is shifted by multiples of its diagonal until it is positive definite.
        """
        self.launch(self.kernels.begin_factorisation, self.worlds, [active, self.pending, self.diagonal_shift])
        self._try_to_factorise(value)
        wp.capture_while(self.any_retry, self._try_to_factorise, value=value)

    def _try_to_factorise(self, value: wp.array) -> None:
        b, k, launch = self.band, self.kernels, self.launch
        self.any_retry.zero_()
        if self.by_thread_block:
            lanes = self.thread_block_kernels.lanes
            args = [lanes, self.window_memory, self.pattern.data, value, b.slot_order, b.slot_position]
            args += [self.diagonal_shift]
            args += [self.pending, self.failed, self.factors]
            launch(self.thread_block_kernels.factor, (self.worlds, lanes), args, block_dim=lanes)
        else:
            slots = self.pattern.graph.shape[0]
            launch(k.clear_band, (self.worlds, b.block_rows), [slots, b.half_bandwidth, self.pending, self.factors])
            args = [self.pattern.data, value, b.slot_position, b.half_bandwidth, self.diagonal_shift]
            args += [self.pending, self.factors]
            launch(k.fill_band, (self.worlds, slots), args)
            launch(k.factor_band, self.worlds, [b.half_bandwidth, self.pending, self.failed, self.factors])
        launch(k.raise_shift, self.worlds, [self.failed, self.pending, self.diagonal_shift, self.any_retry, self.exact])

    def solve(self, r: wp.array, z: wp.array, active: wp.array) -> None:
        """z = A^-1 r, [world, slot]."""
        b = self.band
        if self.by_thread_block:
            lanes = self.thread_block_kernels.lanes
            args = [lanes, self.window_memory, self.factors, b.slot_order, r, active, z]
            self.launch(self.thread_block_kernels.solve, (self.worlds, lanes), args, block_dim=lanes)
            return
        args = [b.half_bandwidth, self.factors, b.slot_order, r, active, self.half_solution, z]
        self.launch(self.kernels.solve, self.worlds, args)
