"""Run time of a step: the captured step as a whole, and its launches one by one.

The whole step is timed as one graph. The same steps are then repeated from the same state without the graph, each
launch timed alone: on the GPU by events around the kernel, on the CPU by the host's clock. The time of an empty
kernel is subtracted from each launch. The difference of the whole step and its kernels is `between_ms`: kernel
starts, conditions of loops, clearing of flags, reading of the report.

Bytes are those of the arrays accessible to a launch, each counted once. Traffic is smaller for partly used or cached
arrays, and larger for repeated reads.
"""

import ast
import functools
import gc
import statistics
import time as clock
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from ...base.checks import is_count
from ...base.console import quiet_warp
from ...base.errors import ModelError
from ...base.launch import LAUNCH_PARTS, kernel_name
from ...kernels.common.empty_kernel import empty_kernels
from ...simulation.simulation import Simulation

__all__ = ["KernelTime", "LaunchRecorder", "Profile", "Replay", "copy_bandwidth", "launch_bytes", "profile", "replay"]

WARM_UP_STEPS = 2
EMPTY_LAUNCHES = 200
COPY_BYTES = {"cpu": 2**27, "cuda": 2**30}
COPY_REPEATS = 10


@dataclass(frozen=True)
class KernelTime:
    """Launches of one kernel for one part, per step.

    Attributes:
        part: purpose, see `LAUNCH_PARTS`. kernel: module.kernel.
        launches: per step. ms: time per step beyond that of empty launches. bytes: of accessible arrays, per step.
    """

    part: str
    kernel: str
    launches: float
    ms: float
    bytes: float

    @property
    def GBps(self) -> float | None:
        """1e9 bytes per second; None if the time is too short."""
        return self.bytes / self.ms / 1e6 if self.ms > 0.0 else None


@dataclass(frozen=True)
class Profile:
    """Result of `profile`.

    Attributes:
        step_ms: time of each step as one graph, with the reading of its report, ms.
        kernels: kernels per part, the longest first.
        newton, pcg: iterations per step.
        copy_GBps: bytes read and written per second, 1e9, by a copy of a large array on the device.
        empty_launch_us: time of an empty kernel, subtracted from each launch, us.
        about: a line about each part.
    """

    step_ms: tuple[float, ...]
    kernels: tuple[KernelTime, ...]
    newton: float
    pcg: float
    copy_GBps: float
    empty_launch_us: float
    about: dict[str, str] = field(default_factory=dict)

    @property
    def parts(self) -> dict[str, KernelTime]:
        """Sums over the kernels of each part with launches: `LAUNCH_PARTS` in order, then those of terms."""
        out = {}
        for name in dict.fromkeys([*LAUNCH_PARTS, *(k.part for k in self.kernels)]):
            rows = [k for k in self.kernels if k.part == name]
            if rows:
                sums = {key: sum(getattr(k, key) for k in rows) for key in ("launches", "ms", "bytes")}
                out[name] = KernelTime(name, "", **sums)
        return out

    @property
    def kernels_ms(self) -> float:
        """All kernels of a step, ms."""
        return sum(k.ms for k in self.kernels)

    @property
    def between_ms(self) -> float:
        """Mean step time beyond its kernels, ms; 0 if the single launches took longer."""
        return max(statistics.mean(self.step_ms) - self.kernels_ms, 0.0)

    @property
    def total_ms(self) -> float:
        """Reference of the shares: kernels and the time between them, ms."""
        return self.kernels_ms + self.between_ms

    @property
    def launches(self) -> float:
        """Launches per step."""
        return sum(k.launches for k in self.kernels)


@dataclass
class _LaunchTotals:
    """Sums over launches."""

    launches: int = 0
    seconds: float = 0.0
    bytes: int = 0


class LaunchRecorder:
    """Executes launches one by one and books time and bytes by part and kernel.

    Commands are cached, for little host work between repeated launches: caches stay warm.
    """

    def __init__(self, device: Any) -> None:
        self.device = wp.get_device(device)
        self._pending: list[_LaunchTotals] = []
        self._totals: dict[tuple[str, str], _LaunchTotals] = {}
        self._known: dict[Any, tuple[wp.Launch, _LaunchTotals, int, list[Any]]] = {}

    def __call__(
        self, part: str, kernel: wp.Kernel, size: Sequence[int], inputs: list[Any], make: Callable[[], wp.Launch]
    ) -> None:
        """Execute the launch; on the CPU time it."""
        key = (part, kernel, *size, *map(_argument_key, inputs))
        known = self._known.get(key)
        if known is None:
            totals = self._totals.setdefault((part, kernel_name(kernel)), _LaunchTotals())
            # the inputs are referenced, so that the id of a struct stays unique
            known = self._known[key] = make(), totals, launch_bytes(inputs, _struct_members(kernel)), inputs
        command, totals, reached, _ = known
        if self.device.is_cuda:
            self._pending.append(totals)
            command.launch()
        else:
            began = clock.perf_counter()
            command.launch()
            totals.seconds += clock.perf_counter() - began
        totals.launches += 1
        totals.bytes += reached

    def clear(self) -> None:
        """Clear the bookings; commands are kept."""
        self._pending.clear()
        for totals in self._totals.values():
            totals.launches, totals.seconds, totals.bytes = 0, 0.0, 0

    def measure(self, work: Callable[[], object]) -> None:
        """Call `work` with its launches recorded; on the GPU collect their times."""
        if not self.device.is_cuda:
            collects = gc.isenabled()
            gc.disable()  # host garbage collection would be booked on a launch
            try:
                work()
            finally:
                if collects:
                    gc.enable()
            return
        wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)
        try:
            work()
        finally:
            results = wp.timing_end()
        self.book_times([r.elapsed for r in results])

    def book_times(self, elapsed_ms: list[float]) -> None:
        """Book the times of the pending launches, in their order. ModelError if others were timed too."""
        if len(elapsed_ms) != len(self._pending):
            raise ModelError(
                f"profile: {len(elapsed_ms)} kernels were timed and {len(self._pending)} launched; others run that "
                "do not pass the Launcher"
            )
        for totals, ms in zip(self._pending, elapsed_ms):
            totals.seconds += 1e-3 * ms
        self._pending.clear()

    def kernels(self, steps: int, empty: float) -> tuple[KernelTime, ...]:
        """Bookings per step, less `empty` seconds per launch; the longest first."""
        rows = []
        for (part, kernel), b in self._totals.items():
            if b.launches:
                ms = 1e3 * max(b.seconds - b.launches * empty, 0.0)
                rows.append(KernelTime(part, kernel, b.launches / steps, ms / steps, b.bytes / steps))
        return tuple(sorted(rows, key=lambda row: -row.ms))


def _argument_key(value: Any) -> Any:
    """Key of the arguments of a launch."""
    if isinstance(value, wp.array):
        return value.ptr, value.shape, value.strides
    return value if isinstance(value, (int, float)) else id(value)


def launch_bytes(inputs: list[Any], members: set[str] | None = None) -> int:
    """Bytes of the arrays among arguments and in their structs, each once; `members`: the used ones of structs."""
    found: dict[int, int] = {}

    def visit(value: Any) -> None:
        if isinstance(value, wp.array):
            if value.ptr:
                count = int(np.prod([n for n, stride in zip(value.shape, value.strides) if stride], dtype=np.int64))
                size = count * wp.types.type_size_in_bytes(value.dtype)
                found[value.ptr] = max(found.get(value.ptr, 0), size)
        elif hasattr(value, "_cls"):
            for name in value._cls.vars:
                if members is None or name in members:
                    visit(getattr(value, name))

    for value in inputs:
        visit(value)
    return sum(found.values())


@functools.cache
def _struct_members(kernel: wp.Kernel) -> set[str] | None:
    """Names of all struct members in a kernel and its functions; None if unknown."""
    names: set[str] = set()
    seen: set[int] = set()
    waiting = [kernel.adj]
    try:
        while waiting:
            adjoint = waiting.pop()
            if id(adjoint) in seen:
                continue
            seen.add(id(adjoint))
            names |= {node.attr for node in ast.walk(adjoint.tree) if isinstance(node, ast.Attribute)}
            for function in adjoint.get_references()[2]:
                waiting += [f.adj for f in (function, *function.user_overloads.values()) if f.adj is not None]
    except (AttributeError, TypeError):
        return None
    return names


@dataclass(frozen=True)
class Replay:
    """Steps executed as graphs, and again launch by launch.

    Attributes:
        step_ms: of each step as a graph, ms.
        newton, pcg: iterations per step.
        recorder: has booked the launches.
    """

    step_ms: tuple[float, ...]
    newton: float
    pcg: float
    recorder: LaunchRecorder


def profile(sim: Simulation, *, steps: int = 10, on_step: Callable[[], object] | None = None) -> Profile:
    """Profile the `steps` steps after a warm-up of two; the simulation is then at their end, as after `step`.

    Args:
        sim: a simulation with captured steps (capture=True).
        steps: number of timed steps, as graphs and then launch by launch.
        on_step: called after each of the 2 steps + 3 executed steps.

    Raises:
        ModelError: steps out of range, or a simulation without captured steps.
        ConvergenceError, ConstraintError: a step failed.
    """
    done = replay(sim, steps, on_step)
    empty = _empty_launch_seconds(sim.model.device)
    return Profile(
        step_ms=done.step_ms,
        kernels=done.recorder.kernels(steps, empty),
        newton=done.newton,
        pcg=done.pcg,
        copy_GBps=copy_bandwidth(sim.model.device),
        empty_launch_us=1e6 * empty,
        about=dict(sim.stepper.launch.parts),
    )


def replay(sim: Simulation, steps: int, on_step: Callable[[], object] | None = None) -> Replay:
    """Warm up, do the steps, and repeat them from the same state launch by launch; arguments as of `profile`.

    Raises:
        ModelError, ConvergenceError, ConstraintError: as `profile`.
    """
    if not (is_count(steps) and steps >= 1):
        raise ModelError(f"profile: steps = {steps!r} must be a whole number, at least 1")
    stepper = sim.stepper
    if stepper.graph is None:
        raise ModelError("profile: the simulation was made with capture=False, or with linear='direct'")

    def time_steps(count: int, run: Callable[[], object]) -> list[float]:
        times = []
        for _ in range(count):
            began = clock.perf_counter()
            run()
            times.append(1e3 * (clock.perf_counter() - began))
            if on_step is not None:
                on_step()
        return times

    time_steps(WARM_UP_STEPS - 1, sim.step)
    start = sim.state.numpy()
    time_steps(1, sim.step)
    before = {name: total.sum() for name, total in sim.totals.items()}
    step_ms = time_steps(steps, sim.step)
    per_step = {name: float(total.sum() - before[name]) / steps for name, total in sim.totals.items()}
    recorder = LaunchRecorder(sim.model.device)
    stepper.launch.recorder = recorder
    try:
        sim.state.load(start)
        stepper.invalidate()
        time_steps(1, stepper.launch_step)  # creates the commands, and data outside the state
        recorder.clear()
        time_steps(steps, lambda: recorder.measure(stepper.launch_step))
    finally:
        stepper.launch.recorder = None
    return Replay(tuple(step_ms), per_step["newton"], per_step["pcg"], recorder)


def _empty_launch_seconds(device: Any) -> float:
    """Seconds of an empty launch measured by the recorder: the median of single ones."""
    device = wp.get_device(device)
    flags = wp.zeros(1, dtype=wp.int32, device=device)
    with quiet_warp():  # load its module now
        command = wp.launch(empty_kernels().empty, dim=1, inputs=[flags], device=device, record_cmd=True)
        command.launch()
    if device.is_cuda:
        wp.timing_begin(cuda_filter=wp.TIMING_KERNEL)
        for _ in range(EMPTY_LAUNCHES):
            wp.synchronize_device(device)  # small kernels launched one by one also meet an idle device
            command.launch()
        return 1e-3 * statistics.median(r.elapsed for r in wp.timing_end())
    times = []
    for _ in range(EMPTY_LAUNCHES):
        began = clock.perf_counter()
        command.launch()
        times.append(clock.perf_counter() - began)
    return statistics.median(times)


def copy_bandwidth(device: Any) -> float:
    """1e9 bytes per second, read and written, of a copy between large arrays: the best of several."""
    device = wp.get_device(device)
    size = COPY_BYTES["cuda" if device.is_cuda else "cpu"]
    if device.is_cuda:
        size = min(size, device.free_memory // 4)
    source, target = (wp.zeros(int(size), dtype=wp.uint8, device=device) for _ in range(2))
    times = []
    for _ in range(1 + COPY_REPEATS):
        if device.is_cuda:
            first, last = (wp.Event(device, enable_timing=True) for _ in range(2))
            device.stream.record_event(first)
            wp.copy(target, source)
            device.stream.record_event(last)
            times.append(1e-3 * wp.get_event_elapsed_time(first, last))
        else:
            began = clock.perf_counter()
            wp.copy(target, source)
            times.append(clock.perf_counter() - began)
    return 2e-9 * size / min(times[1:])
