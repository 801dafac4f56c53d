"""Out-of-memory errors with the requested size and remedies."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .console import size
from .errors import CapacityError

__all__ = ["REMEDY", "enough_memory"]

_REFUSED = re.compile(r"Failed to allocate (?:(\d+) bytes|memory)|out of memory", re.IGNORECASE)


@contextmanager
def enough_memory(what: str, device: Any) -> Iterator[None]:
    """Convert a failed allocation within, on a Warp device or the host, to a CapacityError about `what`."""
    try:
        yield
    except MemoryError as error:
        raise CapacityError(f"{what}: the host has no memory left ({error}){REMEDY}") from error
    except RuntimeError as error:
        found = _REFUSED.search(str(error))
        if found is None:
            raise
        count = int(found[1]) if found[1] else 0
        asked = f": {count} bytes ({size(count)}) requested" if count else ""
        text = f"{what}: out of memory on {device}{asked}{_room(device)}{REMEDY}"
        raise CapacityError(text, bytes=count) from error


REMEDY = "; take fewer worlds, a coarser mesh, dtype='float32' or a device with more memory"


def _room(device: Any) -> str:
    """Free and total memory of a GPU as text."""
    if not getattr(device, "is_cuda", False):
        return ""
    return f", {size(device.free_memory)} of {size(device.total_memory)} are free"
