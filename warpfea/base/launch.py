"""Counted kernel launches: the cost of a scene can be listed, asserted and timed; their modules compiled and loaded."""

import functools
import os
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import ExitStack, contextmanager, suppress
from typing import Any, Concatenate, ParamSpec, Protocol, TypeVar

import warp as wp

from ..kernels.common.lanes import WARP_SIZE
from .console import quiet_warp
from .errors import ModelError

__all__ = ["LAUNCH_PARTS", "Launcher", "OnCompile", "Recorder", "kernel_name", "launch_part", "load_modules", "part"]

P = ParamSpec("P")
R = TypeVar("R")
S = TypeVar("S")
F = TypeVar("F", bound=Callable[..., Any])
OnCompile = Callable[[int, int, str], None]

LAUNCH_PARTS = {
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
"""Purposes of the launches of a step. A launch without a label is "control"."""


class Recorder(Protocol):
    """Executes launches in place of the Launcher, for timing."""

    def __call__(
        self, part: str, kernel: wp.Kernel, size: Sequence[int], inputs: list[Any], make: Callable[[], wp.Launch]
    ) -> None:
        """Launch `kernel` on items and blocks of `size` for `part`; `make` returns the command."""


class Launcher:
    """Launcher of one device that counts launches per kernel and module.

    Attributes:
        recorder: executes the launches if set; they are then not counted.
        label: current part. parts: `LAUNCH_PARTS` and those added by terms.
        rare_launches: launches in rarely taken branches, not counted in `launches`.
    """

    def __init__(self, device: Any) -> None:
        self.device = device
        self.launches = 0
        self.rare_launches = 0
        self.in_rare_branch = False
        self.kernels: set[str] = set()
        self.modules: set[str] = set()
        self.recorder: Recorder | None = None
        self.label = "control"
        self.parts = dict(LAUNCH_PARTS)

    def __call__(self, kernel: wp.Kernel, dim: int | Sequence[int], inputs: list[Any], block_dim: int = 0) -> None:
        """Launch one thread per item of `dim`; empty launches are skipped. 0: blocks of the module's option."""
        if min([dim] if isinstance(dim, int) else dim) == 0:
            return
        size = block_dim or kernel.module.options["block_dim"] or 256
        self._launch(wp.launch, kernel, [dim] if isinstance(dim, int) else dim, inputs, size)

    def lanes(self, per_row: int) -> int:
        """Lanes that share a row of the given number of entries: a power of two; one on the CPU."""
        if not self.device.is_cuda:
            return 1
        return min(WARP_SIZE, 1 << max(0, max(per_row, 1).bit_length() - 1))

    def padded(self, threads: int) -> int:
        """Threads rounded up to whole warps, for sums over lanes."""
        return -(-threads // WARP_SIZE) * WARP_SIZE if self.device.is_cuda else threads

    def tiled(self, kernel: wp.Kernel, dim: Sequence[int], inputs: list[Any], block_dim: int = 256) -> None:
        """Launch one block per item of `dim`."""
        self._launch(wp.launch_tiled, kernel, dim, inputs, block_dim)

    @contextmanager
    def part(self, name: str) -> Iterator[None]:
        """Context: launches within belong to part `name`; the innermost counts."""
        if name not in self.parts:
            raise ModelError(f"part {name!r} is unknown; there are {', '.join(self.parts)}, and `parts` of terms")
        outer, self.label = self.label, name
        try:
            yield
        finally:
            self.label = outer

    @contextmanager
    def rare(self) -> Iterator[None]:
        """Context for launches inside a rarely taken device branch (not counted)."""
        outer, self.in_rare_branch = self.in_rare_branch, True
        try:
            yield
        finally:
            self.in_rare_branch = outer

    def _launch(
        self, launch: Callable[..., Any], kernel: wp.Kernel, dim: Sequence[int], inputs: list[Any], block_dim: int
    ) -> None:
        do = functools.partial(launch, kernel, dim=dim, inputs=inputs, device=self.device, block_dim=block_dim)
        if self.recorder is not None:
            self.recorder(self.label, kernel, (*dim, block_dim), inputs, functools.partial(do, record_cmd=True))
            return
        self._count_launch(kernel)
        with quiet_warp():  # load a module that no Simulation has loaded yet
            do()

    def _count_launch(self, kernel: wp.Kernel) -> None:
        if self.in_rare_branch:
            self.rare_launches += 1
            return
        self.launches += 1
        self.kernels.add(kernel_name(kernel))
        self.modules.add(kernel.module.name)


def kernel_name(kernel: wp.Kernel) -> str:
    """Readable name module.kernel."""
    return f"{kernel.module.name.removeprefix('warpfea.kernels.')}.{kernel.key.rsplit('__locals__', 1)[-1]}"


def launch_part(name: str) -> Callable[[Callable[Concatenate[S, P], R]], Callable[Concatenate[S, P], R]]:
    """Decorator: attribute a method's launches to profile part `name`, see `LAUNCH_PARTS`."""

    def decorate(method: Callable[Concatenate[S, P], R]) -> Callable[Concatenate[S, P], R]:
        @functools.wraps(method)
        def wrapper(self: S, *args: P.args, **options: P.kwargs) -> R:
            with self.launch.part(name):  # type: ignore[attr-defined]
                return method(self, *args, **options)

        return wrapper

    return decorate


def part(name: str = "") -> Callable[[F], F]:
    """Decorator: attribute the launches of a term's method to profile part `name`, by default that of its name."""

    def decorate(method: F) -> F:
        @functools.wraps(method)
        def wrapper(self: Any, ctx: Any, *args: Any, **options: Any) -> Any:
            with ctx.launch.part(name or self.name):
                return method(self, ctx, *args, **options)

        return wrapper  # type: ignore[return-value]

    return decorate


def load_modules(modules: dict[str, wp.Module], device: Any, on_compile: OnCompile | None) -> None:
    """Compile modules by name on several threads; loaded ones are free. `on_compile(done, total, name)` is called for
    each. Of several processes that need a kernel one compiles it, and the others wait.

    Raises:
        ModelError: a user's function that Warp can't compile.
    """

    def load(name: str, module: wp.Module) -> None:
        with module_lock(name):
            wp.force_load(device, [module], max_workers=0)

    with ThreadPoolExecutor(min(os.cpu_count() or 1, 4)) as pool:
        waiting = {pool.submit(load, name, module): name for name, module in modules.items()}
        for done, future in enumerate(as_completed(waiting)):
            _raise_compile_error(future, waiting[future])
            if on_compile:
                on_compile(done + 1, len(waiting), waiting[future])


@contextmanager
def module_lock(name: str) -> Iterator[None]:
    """Lock of a module in the kernel cache, among processes; the system frees it if its holder dies."""
    with ExitStack() as stack:
        with suppress(ImportError, OSError):  # Windows; a cache that can't be written
            import fcntl

            folder = os.path.join(str(wp.config.kernel_cache_dir), "locks")
            os.makedirs(folder, exist_ok=True)
            file = stack.enter_context(open(os.path.join(folder, name), "w"))
            fcntl.flock(file, fcntl.LOCK_EX)
        yield


def _raise_compile_error(future: Future[Any], name: str) -> None:
    """Re-raise compilation errors; those of a user's function as ModelError."""
    try:
        future.result()
    except Exception as error:
        if ".law_" in name or ".field_" in name:
            reason = str(error).strip().splitlines()[-1]
            raise ModelError(
                f"Warp can't compile a wp.func given as a time law or field ({name.rpartition('.')[2]}): {reason}; "
                "write it in the precision of its annotations, such as def f(t: wp.float64) -> wp.float64: return "
                "wp.float64(2.0) * t"
            ) from error
        raise
