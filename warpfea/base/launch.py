"""Launches of kernels, counted, so that what a scene costs can be listed, asserted and timed."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

import warp as wp

from ..kernels.common.lanes import WARP
from .console import quiet_warp
from .errors import ModelError

__all__ = ["PARTS", "Launcher", "Recorder", "kernel_name", "labelled"]

P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S")

PARTS = {
    "residual": "forces of the elements and their sum at the nodes",
    "product": "the operator H v of the linear solve",
    "assembly": "H as a matrix, where products are made with it",
    "preconditioner": "z = B r",
    "build": "the preconditioner at a new iterate",
    "vectors": "vector updates, dot products and sums",
    "loads": "time laws, loads, drives, histories of damping",
    "control": "start of a step, line search, decisions of the loops",
    "commit": "acceptance of a step, energy ledger, report",
}
"""What the launches of a step are for. A launch without a label is "control"."""


class Recorder(Protocol):
    """Does the launches in place of the Launcher, to time them."""

    def __call__(
        self, part: str, kernel: wp.Kernel, size: Sequence[int], inputs: list[Any], make: Callable[[], wp.Launch]
    ) -> None:
        """Launch `kernel` on items and blocks of `size` for `part`; `make` gives the command that does it."""


class Launcher:
    """Launches on one device; remembers which kernels and modules were used and how often.

    Attributes:
        recorder: does the launches, if set; they are not counted then.
        label: the part that launches belong to. parts: those there are: `PARTS`, and what terms add.
        rare_launches: those that only a hard step does; they are not among `launches`.
    """

    def __init__(self, device: Any) -> None:
        self.device = device
        self.launches = 0
        self.rare_launches = 0
        self.rarely = False
        self.kernels: set[str] = set()
        self.modules: set[str] = set()
        self.recorder: Recorder | None = None
        self.label = "control"
        self.parts = dict(PARTS)

    def __call__(self, kernel: wp.Kernel, dim: int | Sequence[int], inputs: list[Any], block_dim: int = 256) -> None:
        """Launch one thread per item of `dim`; an empty launch is left out."""
        if min([dim] if isinstance(dim, int) else dim) == 0:
            return
        self._do(wp.launch, kernel, [dim] if isinstance(dim, int) else dim, inputs, block_dim)

    def lanes(self, per_row: int) -> int:
        """Lanes that share a row with so many entries: a power of two; one on the CPU."""
        if not self.device.is_cuda:
            return 1
        return min(WARP, 1 << max(0, max(per_row, 1).bit_length() - 1))

    def padded(self, threads: int) -> int:
        """Threads in whole warps, as sums over lanes want."""
        return -(-threads // WARP) * WARP if self.device.is_cuda else threads

    def tiled(self, kernel: wp.Kernel, dim: Sequence[int], inputs: list[Any], block_dim: int = 256) -> None:
        """Launch one block per item of `dim`."""
        self._do(wp.launch_tiled, kernel, dim, inputs, block_dim)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Launches within belong to part `name`; the innermost counts."""
        if name not in self.parts:
            raise ModelError(f"part {name!r} is unknown; there are {', '.join(self.parts)}, and `parts` of terms")
        outer, self.label = self.label, name
        try:
            yield
        finally:
            self.label = outer

    @contextmanager
    def rare(self) -> Iterator[None]:
        """Launches within are for hard steps alone: a condition on the device leads to them."""
        outer, self.rarely = self.rarely, True
        try:
            yield
        finally:
            self.rarely = outer

    def _do(
        self, launch: Callable[..., Any], kernel: wp.Kernel, dim: Sequence[int], inputs: list[Any], block_dim: int
    ) -> None:
        do = functools.partial(launch, kernel, dim=dim, inputs=inputs, device=self.device, block_dim=block_dim)
        if self.recorder is not None:
            self.recorder(self.label, kernel, (*dim, block_dim), inputs, functools.partial(do, record_cmd=True))
            return
        self._count(kernel)
        with quiet_warp():  # a module that no Simulation has loaded is loaded now
            do()

    def _count(self, kernel: wp.Kernel) -> None:
        if self.rarely:
            self.rare_launches += 1
            return
        self.launches += 1
        self.kernels.add(kernel_name(kernel))
        self.modules.add(kernel.module.name)


def kernel_name(kernel: wp.Kernel) -> str:
    """module.kernel for reading."""
    return f"{kernel.module.name.removeprefix('warpfea.kernels.')}.{kernel.key.rsplit('__locals__', 1)[-1]}"


def labelled(name: str) -> Callable[[Callable[Concatenate[S, P], R]], Callable[Concatenate[S, P], R]]:
    """Marks a method of an object with a `launch`: its launches belong to part `name`, see `PARTS`."""

    def mark(method: Callable[Concatenate[S, P], R]) -> Callable[Concatenate[S, P], R]:
        @functools.wraps(method)
        def marked(self: S, *args: P.args, **options: P.kwargs) -> R:
            with self.launch.part(name):  # type: ignore[attr-defined]
                return method(self, *args, **options)

        return marked

    return mark
