"""Launches of kernels, counted, so that what a scene costs can be listed and asserted."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import warp as wp

from .kernels.lanes import WARP

__all__ = ["Launcher"]


class Launcher:
    """Launches on one device; remembers which kernels and modules were used and how often."""

    def __init__(self, device: Any) -> None:
        self.device = device
        self.launches = 0
        self.kernels: set[str] = set()
        self.modules: set[str] = set()

    def __call__(self, kernel: wp.Kernel, dim: int | Sequence[int], inputs: list[Any], block_dim: int = 256) -> None:
        """Launch one thread per item of `dim`; an empty launch is left out."""
        if min([dim] if isinstance(dim, int) else dim) == 0:
            return
        self._count(kernel)
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, block_dim=block_dim)

    def lanes(self, per_row: int) -> int:
        """Lanes that share a row with so many entries: a power of two; one on the CPU."""
        if not self.device.is_cuda:
            return 1
        return min(WARP, 1 << max(0, (max(per_row, 1) - 1).bit_length() - 1))

    def padded(self, threads: int) -> int:
        """Threads in whole warps, as sums over lanes want."""
        return -(-threads // WARP) * WARP if self.device.is_cuda else threads

    def tiled(self, kernel: wp.Kernel, dim: Sequence[int], inputs: list[Any], block_dim: int = 128) -> None:
        """Launch one block per item of `dim`."""
        self._count(kernel)
        wp.launch_tiled(kernel, dim=dim, inputs=inputs, block_dim=block_dim, device=self.device)

    def _count(self, kernel: wp.Kernel) -> None:
        self.launches += 1
        name = kernel.key.rsplit("__locals__", 1)[-1]
        self.kernels.add(f"{kernel.module.name.removeprefix('warpfea.kernels.')}.{name}")
        self.modules.add(kernel.module.name)
