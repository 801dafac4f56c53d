"""Out-of-memory errors with the requested size and remedies."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .console import format_bytes
from .errors import CapacityError

__all__ = ["MEMORY_REMEDY", "convert_memory_errors"]

_ALLOCATION_ERROR = re.compile(r"Failed to allocate (?:(\d+) bytes|memory)|out of memory", re.IGNORECASE)


@contextmanager
def convert_memory_errors(what: str, device: Any) -> Iterator[None]:
    """Convert a failed allocation within, on a Warp device or the host, to a CapacityError about `what`."""
    try:
        yield
    except MemoryError as error:
        raise CapacityError(f"{what}: the host has no memory left ({error}){MEMORY_REMEDY}") from error
    except RuntimeError as error:
        found = _ALLOCATION_ERROR.search(str(error))
        if found is None:
            raise
        count = int(found[1]) if found[1] else 0
        asked = f": {count} bytes ({format_bytes(count)}) requested" if count else ""
        free = ""
        if getattr(device, "is_cuda", False):
            free = f", {format_bytes(device.free_memory)} of {format_bytes(device.total_memory)} are free"
        text = f"{what}: out of memory on {device}{asked}{free}{MEMORY_REMEDY}"
        raise CapacityError(text, bytes=count) from error


MEMORY_REMEDY = "; take fewer worlds, a coarser mesh, dtype='float32' or a device with more memory"
