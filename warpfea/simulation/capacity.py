"""Whether a device has room for a simulation of so many worlds, before anything of it is allocated.

What a world takes is measured with simulations of one and of two worlds. Where memory is plentiful, by a rough bound,
nothing is measured.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import warp as wp

from ..base.console import size
from ..base.errors import CapacityError

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State
    from .stepper import Stepper

__all__ = ["check_capacity", "free_bytes"]

PLENTY = 3000
"""Vectors per slot that no simulation takes (pendulums 200 to 600, solids of T10 300, piles of bodies 2000)."""
KEPT = 0.02
"""Share of the memory that is left to what is not counted: code, recorded graphs, pools."""


def free_bytes(device: Any) -> int | None:
    """Memory that is available on a device, bytes; None where that is not known."""
    if device.is_cuda:
        pool = 0
        if wp.is_mempool_enabled(device):  # what it has been given back is free, too
            pool = wp.get_mempool_used_mem_high(device) - wp.get_mempool_used_mem_current(device)
        return min(int(device.free_memory + pool), int(device.total_memory))
    try:
        lines = Path("/proc/meminfo").read_text().splitlines()
    except OSError:
        return None
    found = [line.split()[1] for line in lines if line.startswith("MemAvailable:")]
    return 1024 * int(found[0]) if found else None


def check_capacity(model: Model, make: Callable[[Model, State], Stepper]) -> None:
    """Raise CapacityError where a simulation of a model would not fit; `make` makes its stepper.

    Raises:
        CapacityError: with the bytes per world, and the largest number of worlds that fits.
    """
    free = free_bytes(model.device)
    item = 3 * wp.types.type_size_in_bytes(model.types.T)
    if free is None or model.worlds <= 2 or model.worlds * model.slots * PLENTY * item < free:
        return
    one, two = (_bytes(model, worlds, make) for worlds in (1, 2))
    per_world = two - one
    room = int((1.0 - KEPT) * free) - (one - per_world)
    if model.worlds * per_world <= room:
        return
    most = max(room // per_world, 0)
    need = one + (model.worlds - 1) * per_world
    raise CapacityError(
        f"a simulation of {model.worlds} worlds takes {size(need)}, {per_world} bytes per world, and {model.device} has "
        f"{size(free)} free: at most {most} worlds fit; take fewer, a coarser mesh, dtype='float32' or a device with "
        "more memory",
        bytes=need, per_world=per_world, worlds=most,
    )  # fmt: skip


def _bytes(model: Model, worlds: int, make: Callable[[Model, State], Stepper]) -> int:
    """Bytes of the state and of the scratch of a simulation of so many worlds."""
    small = model.resized(worlds)
    state = small.state()
    stepper = make(small, state)
    out = sum(stepper.work.bytes.values()) + sum(state.bytes.values())
    return out + (sum(stepper.backup.bytes.values()) if stepper.backup is not None else 0)
