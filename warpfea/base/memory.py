"""Constant device arrays and their bytes by purpose; out-of-memory errors with the requested size and remedies."""

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
import warp as wp

from .console import format_bytes
from .errors import CapacityError

__all__ = ["MEMORY_REMEDY", "Memory", "convert_memory_errors"]

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


class Memory:
    """Uploads the constant arrays of a model and counts their bytes.

    Args:
        device: Warp device.
        types: precision of the model, see kernels.common.types.
    """

    def __init__(self, device: Any, types: Any) -> None:
        self.device, self.types = device, types
        self._bytes: dict[str, int] = {}

    @property
    def bytes(self) -> dict[str, int]:
        """Bytes of the constant arrays by purpose."""
        return dict(self._bytes)

    def array(self, name: str, values: Any, dtype: Any) -> wp.array:
        """Upload a constant array; its bytes are counted under `name`."""
        out: Any = wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)
        self.count(name, out)
        return out

    def fill(self, struct: Any, name: str, **values: Any) -> None:
        """Set fields of a struct: arrays are uploaded in the fields' types, their bytes counted under `name`."""
        for field, value in values.items():
            kind = struct._cls.vars[field].type
            setattr(struct, field, self.array(name, value, kind.dtype) if isinstance(kind, wp.array) else value)

    def count(self, name: str, *arrays: wp.array) -> None:
        """Count the bytes of device arrays under `name`."""
        for array in arrays:
            self._bytes[name] = self._bytes.get(name, 0) + array.size * wp.types.type_size_in_bytes(array.dtype)

    def uncount(self, name: str, *arrays: wp.array) -> None:
        """Subtract the bytes of released arrays under `name`."""
        for array in arrays:
            self._bytes[name] -= array.size * wp.types.type_size_in_bytes(array.dtype)

    def element_array(self, values: np.ndarray, dtype: Any) -> wp.array:
        """Upload element data [..., element]: coalesced on a GPU, contiguous per element on the CPU."""
        if self.device.is_cuda:
            return self.array("elements", values, dtype)
        last = np.ndim(values) - (2 if dtype is self.types.mat33 else 1 if dtype is self.types.vec3 else 0) - 1
        out = self.array("elements", np.moveaxis(values, last, 0), dtype)
        return out.transpose((*range(1, out.ndim), 0))
