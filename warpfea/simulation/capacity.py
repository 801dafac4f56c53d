"""Memory check of a simulation before allocation.

Bytes per world are measured with simulations of one and of two worlds, unless a rough bound fits in memory.
"""

from __future__ import annotations

import bisect
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import warp as wp

from ..base.console import format_bytes
from ..base.errors import CapacityError
from ..base.memory import MEMORY_REMEDY

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State
    from .stepper import Stepper

__all__ = ["check_capacity", "free_bytes"]

MAX_SCRATCH_VECTORS_PER_SLOT = 3000
"""Upper bound of scratch vectors per slot (pendulums 200 to 600, solids of T10 300, piles of bodies 2000)."""
RESERVED_FRACTION = 0.02
"""Memory fraction reserved for uncounted allocations (code, graphs, pools)."""


def free_bytes(device: Any) -> int | None:
    """Available device memory, bytes; None if unknown."""
    if device.is_cuda:
        pool = 0
        if wp.is_mempool_enabled(device):  # includes memory returned to the pool
            pool = wp.get_mempool_used_mem_high(device) - wp.get_mempool_used_mem_current(device)
        return min(int(device.free_memory + pool), int(device.total_memory))
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    found = [line.split()[1] for line in lines if line.startswith("MemAvailable:")]
    return 1024 * int(found[0]) if found else None


def check_capacity(model: Model, make: Callable[[Model, State], Stepper]) -> None:
    """Raise CapacityError if a simulation of a model does not fit; `make` constructs its stepper.

    Raises:
        CapacityError: with the bytes per world, and the largest number of worlds that fits.
    """
    free = free_bytes(model.device)
    item = 3 * wp.types.type_size_in_bytes(model.types.T)
    if free is None or model.worlds <= 2 or model.worlds * model.slots * MAX_SCRATCH_VECTORS_PER_SLOT * item < free:
        return
    (one_world, chunks), (two_worlds, _) = (_array_bytes(model, worlds, make) for worlds in (1, 2))

    def total_bytes(worlds: int) -> int:
        growth = {name: two_worlds[name] - count for name, count in one_world.items()}
        return sum(count + (chunks.get(name, int)(worlds) - 1) * growth[name] for name, count in one_world.items())

    room = int((1.0 - RESERVED_FRACTION) * free)
    need = total_bytes(model.worlds)
    if need <= room:
        return
    fit = bisect.bisect_right(range(1, model.worlds), room, key=total_bytes)
    per_world = need // model.worlds
    raise CapacityError(
        f"a simulation of {model.worlds} worlds takes {format_bytes(need)}, {per_world} bytes per world, and "
        f"{model.device} has {format_bytes(free)} free; maximum: {fit} worlds{MEMORY_REMEDY}",
        bytes=need, per_world=per_world, worlds=fit,
    )  # fmt: skip


def _array_bytes(
    model: Model, worlds: int, make: Callable[[Model, State], Stepper]
) -> tuple[dict[str, int], dict[str, Callable[[int], int]]]:
    """Bytes of the arrays of the state and scratch of a simulation of a number of worlds, by name; and chunk sizes of
    chunked arrays."""
    small = model.resized(worlds)
    stepper = make(small, small.state())
    return stepper.bytes(), {f"work.{name}": chunk for name, chunk in stepper.work.chunks.items()}
