"""State: the registry of all arrays that vary with time, one row per world.

Features register their arrays once; copying, rejection, reset, freezing, checkpoints and the memory report loop over
the registry.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import CheckpointError, ModelError
from ..base.memory import convert_memory_errors
from ..base.short_repr import truncated_lines
from ..kernels.common.state import state_kernels

if TYPE_CHECKING:
    from ..base.launch import Launcher

__all__ = ["ArraySpec", "State", "view_as_words"]

SOLVER_HISTORY_PREFIXES = ("preconditioner", "operator", "predictor", "summed")
"""Name prefixes of optional state arrays (solver history, summed time)."""
MONITOR_ARRAYS = ("energy_growth", "joint_angle")
"""Monitor arrays, optional in a checkpoint."""


@dataclass(frozen=True)
class ArraySpec:
    """A registered array: its name, dtype, shape per world, and initial value (broadcast)."""

    name: str
    dtype: Any
    shape: tuple[int, ...]
    initial: Any = 0


class State:
    """Arrays [world, ...] on one device; accessible as attributes.

    Attributes:
        displacement: [world, slot] vec3, m (gradient slots: 1), from the reference.
        velocity: [world, slot] vec3, m/s.
        time: [world] float64, s.
        worlds, device: as in the model.
        step_loads: of the state of a simulation, see `step_loads` in simulation/sampling.py.
    """

    step_loads: Callable[[], Any] = staticmethod(lambda: None)

    displacement: wp.array
    velocity: wp.array
    time: wp.array

    def __init__(self, worlds: int, device: Any) -> None:
        self.worlds = worlds
        self.device = device
        self.specs: dict[str, ArraySpec] = {}
        self._arrays: dict[str, wp.array] = {}
        self._words: dict[str, wp.array] = {}
        self.sealed = False
        self.requested_names: list[str] = []  # names in the order of `register`

    def __repr__(self) -> str:
        worlds = f"{self.worlds} world{'s' * (self.worlds != 1)}"
        return truncated_lines(f"State({worlds} on {self.device}: {', '.join(self.specs)})")

    def __getattr__(self, name: str) -> wp.array:
        arrays = self.__dict__.get("_arrays", {})
        raise AttributeError(f"state has no array {name!r}; it has {sorted(arrays)}")

    def register(self, name: str, dtype: Any, shape: tuple[int, ...] = (), initial: Any = 0) -> wp.array:
        """Add an array [world, *shape]; `initial` broadcasts to it. An existing array is kept.

        Raises:
            ModelError: an existing array of another kind, or rows that are not a multiple of 4 bytes.
        """
        spec = ArraySpec(name, dtype, tuple(shape), initial)
        self.requested_names.append(name)
        if name in self.specs:
            old = self.specs[name]
            if (old.dtype, old.shape) != (spec.dtype, spec.shape):
                raise ModelError(f"state array {name!r} is registered as {old.dtype}{old.shape}")
            return self._arrays[name]
        if self.sealed:
            raise ModelError(
                f"state array {name!r}: register it before the Simulation is made, which keeps copies of all"
            )
        row = int(np.prod(spec.shape, dtype=np.int64)) * wp.types.type_size_in_bytes(dtype)
        if row % 4:
            raise ModelError(f"state array {name!r}: a row has {row} bytes, which is no multiple of 4")
        shape = (self.worlds, *spec.shape)
        with convert_memory_errors(f"state array {name!r} of {' x '.join(map(str, shape))} items", self.device):
            array = wp.zeros(shape, dtype=dtype, device=self.device)
            values = np.asarray(initial)
            if values.ndim or values != 0:
                host = array.numpy()
                host[...] = values
                array.assign(host)
        self.specs[name] = spec
        self._add(name, array)
        return array

    def _add(self, name: str, array: wp.array) -> None:
        if not hasattr(self, name):  # else it is found by `numpy` alone
            setattr(self, name, array)
        self._arrays[name] = array

    @property
    def names(self) -> list[str]:
        """Names of the registered arrays."""
        return list(self.specs)

    @property
    def bytes(self) -> dict[str, int]:
        """Bytes of each array."""
        return {name: array.size * wp.types.type_size_in_bytes(array.dtype) for name, array in self._arrays.items()}

    def copy(self) -> State:
        """Copy of the state with the same registry."""
        out = State(self.worlds, self.device)
        out.specs = dict(self.specs)
        with convert_memory_errors(f"a copy of a state with {self.worlds} worlds", self.device):
            for name, array in self._arrays.items():
                out._add(name, wp.clone(array))
        return out

    def copy_rows(self, launch: Launcher, flags: wp.array, source: State, skip: tuple[str, ...] = ()) -> None:
        """Copy the rows of the flagged worlds from another state, bitwise."""
        kernel = state_kernels().copy_rows
        for name in self._arrays:
            if name in skip:
                continue
            a, b = source.words(name), self.words(name)
            if b.shape[1]:
                launch(kernel, b.shape, [flags, a, b])

    def words(self, name: str) -> wp.array:
        """Array viewed as [world, 32-bit word]."""
        if name not in self._words:
            self._words[name] = view_as_words(self._arrays[name])
        return self._words[name]

    def numpy(self) -> dict[str, np.ndarray]:
        """Copies of all arrays on the host."""
        return {name: array.numpy().copy() for name, array in self._arrays.items()}

    def load(self, values: dict[str, np.ndarray]) -> None:
        """Set all arrays from the host. Solver history is reset if `values` come from another solver, as are
        monitors missing in them.

        Raises:
            CheckpointError: a missing name or another shape; nothing is set then.
        """
        own, given = (
            {name for name in names if not (is_solver_history(name) or name in MONITOR_ARRAYS)}
            for names in (self._arrays, values)
        )
        if own != given:
            raise CheckpointError(
                f"state arrays differ: missing {sorted(own - given)}, unknown {sorted(given - own)}; a state goes on "
                "with the integrator, the ledger and the constraints that it was made with"
            )
        host = {name: array.numpy() for name, array in self._arrays.items()}
        memory = [name for name in host if is_solver_history(name)]
        for group in (memory, *([name] for name in MONITOR_ARRAYS if name in host)):
            if any(name not in values or values[name].shape != host[name].shape for name in group):
                fresh = {name: np.full_like(host[name], self.specs[name].initial) for name in group}
                values = values | fresh
        for name in self._arrays:
            expected = host[name]
            if values[name].shape != expected.shape or values[name].dtype != expected.dtype:
                raise CheckpointError(
                    f"state array {name!r} is {values[name].dtype}{values[name].shape}, expected "
                    f"{expected.dtype}{expected.shape}"
                )
        for name, array in self._arrays.items():
            array.assign(values[name])


def is_solver_history(name: str) -> bool:
    """True for arrays of solver history."""
    return name.partition("_")[0] in SOLVER_HISTORY_PREFIXES


def view_as_words(array: wp.array) -> wp.array:
    """Array viewed as [world, 32-bit word]."""
    size = array.size * wp.types.type_size_in_bytes(array.dtype) // 4
    out: Any = wp.array(
        ptr=array.ptr, dtype=wp.uint32, shape=(array.shape[0], size // max(array.shape[0], 1)), device=array.device
    )
    out._owner = array  # keeps the memory alive
    return out
