"""Banded Cholesky factors of the whole matrix, for models with a narrow band: chains of beams, strips, slender bars.

Measured on one core, ms per step with the two-level preconditioner and with the band: bars of T10 with 1 x 1, 2 x 2 and
3 x 3 cells across (bandwidth 84, 208 and 392) 10.9 and 1.0, 38 and 4.4, 40 and 10.6; 100 links of E = 7e12 Pa on joints
43 and 5.2 (413 with 3x3 blocks); a square plate of 16 x 16 shells (404) 17.4 and 11.5 in vibration, but 29 and 41 where
it turns and bends so fast that factors last for few steps only. Wider bands do worse.

Where a factorisation costs little beside the matrix itself, every matrix of the operator is factored, which leaves one
iteration of PCG per solve; wider bands are factored when the rule of kernels/solvers/reuse.py says so.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..base.errors import ModelError
from ..kernels.solvers.band import BLOCK, band_kernels, column_type
from ..kernels.solvers.band_block import band_block_kernels, window_numbers
from .assembled import coupled_slots

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..terms.workspace import Workspace
    from .assembled import Pattern

__all__ = ["Band", "BandFactor", "block_band", "find_band"]

WIDEST = 112
"""Widest band that is chosen by itself, blocks beside the diagonal; beyond, the two-level preconditioner is cheaper."""
WHOLE_SLOTS = 160
"""A model of up to this many slots is factored as a whole: here in a band of any width, or else as a dense matrix."""
LARGEST = 2**31
"""Bytes of the factors of a world from which on 32-bit indices can't address them."""
BLOCK_BYTES, WORLD_BYTES = 48 * 1024, 200_000
"""On CUDA: of the window of a block of threads, and of the factors of a world that it may take."""
ASSEMBLY, FACTORISATION = 1.0, 5.5e-5
"""us per unknown on one core: assembling H of 3243 and T10 elements; a factorisation, per square of the bandwidth."""
PRODUCT, SOLUTION = 0.06, 5.4e-4
"""us per unknown on one core: H p; forward and backward substitution, per bandwidth."""


def block_band(model: Model) -> Band | None:
    """The narrow band of a small model on CUDA that a block of threads per world factors; else None."""
    band = find_band(model) if model.device.is_cuda else None
    if band is None:
        return None
    size = wp.types.type_size_in_bytes(model.types.T)
    factors = band.rows * (band.width + 1) * BLOCK**2 * size
    return band if factors <= WORLD_BYTES and window_numbers(band.width) * size < BLOCK_BYTES else None


@dataclass(eq=False)
class Band:
    """An order of the slots in which the pattern is a band.

    Attributes:
        slot_at, place_of: (slots,) on the device, the order and its inverse.
        rows: 4 x 4 blocks on the diagonal.
        width: blocks beside the diagonal in a row.
    """

    slot_at: wp.array
    place_of: wp.array
    rows: int
    width: int

    @property
    def rebuild_cost(self) -> float:
        """Cost of the matrix and its factors, in iterations of PCG."""
        b = BLOCK * self.width
        return (ASSEMBLY + FACTORISATION * b * b) / (PRODUCT + SOLUTION * b)

    @property
    def quick(self) -> bool:
        """Whether a factorisation costs little beside assembling the matrix."""
        return FACTORISATION * (BLOCK * self.width) ** 2 < 0.2 * ASSEMBLY


def find_band(model: Model, *, any_width: bool = False) -> Band | None:
    """The band in the reverse Cuthill-McKee order if it is narrow or the model small, or with `any_width`; else None.

    Raises:
        ModelError: with `any_width`, factors too large to address.
    """
    name = "band" if any_width else "narrow band"
    if name not in model.cache:
        model.cache[name] = _find_band(model, any_width)
    return model.cache[name]


def _find_band(model: Model, any_width: bool) -> Band | None:
    graph = coupled_slots(model)
    n = graph.shape[0]
    free = any_width or n <= WHOLE_SLOTS
    # in no order is a band narrower than half the number of a row's neighbours
    if not free and 3 * (int(np.diff(graph.indptr).max()) // 2) > BLOCK * (WIDEST + 1):
        return None
    order = sp.csgraph.reverse_cuthill_mckee(graph, symmetric_mode=True)
    place = np.empty(n, dtype=np.int64)
    place[order] = np.arange(n)
    rows = np.repeat(place, np.diff(graph.indptr))
    columns = place[graph.indices]
    width = int(((3 * rows + 2) // BLOCK - (3 * columns) // BLOCK).max())
    if not free and width > WIDEST:
        return None
    size = -(-3 * n // BLOCK) * BLOCK**2 * (width + 1) * wp.types.type_size_in_bytes(model.types.T)
    if size >= LARGEST:
        if any_width:
            raise ModelError(
                f"preconditioner = 'banded': the factors of {n} slots in a band of {BLOCK * width} unknowns take "
                f"{size / 2**30:.1f} GiB per world, more than {LARGEST / 2**30:.0f}: take 'two-level'"
            )
        return None
    at, of = (model.array("band", values, wp.int32) for values in (order, place))
    return Band(at, of, -(-3 * n // BLOCK), width)


class BandFactor:
    """The banded factors of all worlds, and the launches that make and apply them.

    Attributes:
        exact: (worlds,) flags of the worlds whose factors are those of the matrix, without a shift.
    """

    def __init__(self, model: Model, work: Workspace, launch: Launcher, band: Band, pattern: Pattern) -> None:
        self.band, self.pattern, self.launch, self.worlds = band, pattern, launch, model.worlds
        self.kernels = band_kernels(model.dtype)
        column: Any = column_type(model.dtype)
        B = model.worlds
        self.factors = work.array("band", (B, band.rows, BLOCK * (band.width + 1)), column)
        self.blocks = model.device.is_cuda
        if self.blocks:  # a block of threads per world
            self.by_block = band_block_kernels(model.dtype, band.rows, band.width)
            self.outside = work.array("band outside", (1, 1), model.types.T)
        else:
            self.y = work.array("band vector", (B, band.rows), column)
        self.shift = work.array("band shift", (B,), model.types.T)
        names = ("bad", "doing", "exact")
        self.bad, self.doing, self.exact = (work.array(f"band {name}", (B,), wp.int32) for name in names)
        self.again = work.array("band again", (1,), wp.int32)

    def modules(self) -> set[wp.Module]:
        """Modules that it launches."""
        return {self.kernels.module} | ({self.by_block.module} if self.blocks else set())

    def make(self, value: wp.array, active: wp.array) -> None:
        """Factor the blocks `value` [world, entry] of the active worlds.

        Where the matrix is not positive definite, a multiple of its diagonal is added until it is.
        """
        self.launch(self.kernels.begin, self.worlds, [active, self.doing, self.shift])
        self._factor(value)
        wp.capture_while(self.again, self._factor, value=value)

    def _factor(self, value: wp.array) -> None:
        b, k, launch = self.band, self.kernels, self.launch
        self.again.zero_()
        if self.blocks:
            lanes = self.by_block.lanes
            args = [lanes, self.outside, self.pattern.data, value, b.slot_at, b.place_of, self.shift]
            args += [self.doing, self.bad, self.factors]
            launch(self.by_block.factor, self.worlds * lanes, args, block_dim=lanes)
        else:
            slots = self.pattern.graph.shape[0]
            launch(k.clear, (self.worlds, b.rows), [slots, b.width, self.doing, self.factors])
            args = [self.pattern.data, value, b.place_of, b.width, self.shift, self.doing, self.factors]
            launch(k.fill, (self.worlds, slots), args)
            launch(k.factor, self.worlds, [b.width, self.doing, self.bad, self.factors])
        launch(k.settle, self.worlds, [self.bad, self.doing, self.shift, self.again, self.exact])

    def solve(self, r: wp.array, z: wp.array, active: wp.array) -> None:
        """z = A^-1 r, [world, slot]."""
        b = self.band
        if self.blocks:
            lanes = self.by_block.lanes
            args = [lanes, self.outside, self.factors, b.slot_at, r, active, z]
            self.launch(self.by_block.solve, self.worlds * lanes, args, block_dim=lanes)
            return
        self.launch(self.kernels.solve, self.worlds, [b.width, self.factors, b.slot_at, r, active, self.y, z])
