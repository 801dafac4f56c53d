"""Losses of a tape's probes, with their derivatives: `wf.loss`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.launch import Launcher
from ..kernels.solvers.adjoint import adjoint_kernels
from .reports import ProbeRecord
from .tape import ProbeArrays

__all__ = ["Loss", "sum_of_squares"]


@dataclass(eq=False)
class Loss:
    """A loss of each world.

    Attributes:
        array: [world]. values, record: of `sum_of_squares`. scale: factor.
    """

    array: wp.array
    values: wp.array
    record: wp.array
    scale: float

    def numpy(self) -> np.ndarray:
        """(worlds,) values."""
        return self.array.numpy()

    def backward(self) -> None:
        """Write the derivatives by the values to their `.grad`."""
        kernel = adjoint_kernels("float64", False).squared_error
        args = [self.values, self.record, wp.float64(self.scale), self.array, self.values.grad]
        Launcher(self.array.device)(kernel, len(self.array), args)


def sum_of_squares(p: ProbeArrays | wp.array, record: Any, *, scale: float = 1.0) -> Loss:
    """Sum of scale (value - record)^2 over steps and components, of each world.

    Args:
        p: a probe of a tape, whose displacements count, or one of its arrays.
        record: (steps, 3) or (worlds, steps, 3), m, or a record of `Simulation.probe`; NaN: not recorded.

    Raises:
        ModelError: another shape, or no probe.
    """
    values = p.displacement if isinstance(p, ProbeArrays) else p
    if not isinstance(values, wp.array):
        raise ModelError(f"sum_of_squares: needs a probe of a tape or one of its arrays, got {type(p).__name__}")
    host = np.asarray(record.displacement if isinstance(record, ProbeRecord) else record, dtype=float)
    host = host[None] if host.ndim == 2 else host
    if host.shape[1:] != values.shape[1:] or host.shape[0] not in (1, values.shape[0]):
        raise ModelError(f"sum_of_squares: record has shape {host.shape}, the probe {values.shape}")
    target: wp.array = wp.array(host, dtype=wp.float64, device=values.device)
    out = Loss(wp.zeros(values.shape[0], dtype=wp.float64, device=values.device), values, target, scale)
    out.backward()
    return out
