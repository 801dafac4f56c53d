"""Constant device arrays of a model, and their bytes by purpose."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

__all__ = ["Memory"]


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
