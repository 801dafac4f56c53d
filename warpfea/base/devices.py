"""Device selection by name."""

from typing import Any

import warp as wp

from .console import quiet_warp
from .errors import ModelError

__all__ = ["find_device"]


def find_device(device: Any = None) -> wp.Device:
    """The Warp device of a name, None for the preferred one. ModelError lists the available ones."""
    with quiet_warp():
        if device is None:
            return wp.get_preferred_device()
        # for a GPU on a machine without one, Warp's library prints its own errors
        bare = str(device).startswith("cuda") and not wp.is_cuda_available()
        try:
            if not bare:
                return wp.get_device(device)
        except Exception:
            pass
        names = ", ".join(str(known) for known in wp.get_devices())
    hint = " (no CUDA GPU with a driver); use 'cpu', or omit the device" if bare else ""
    raise ModelError(f"device {device!r} not found; available: {names}{hint}")
