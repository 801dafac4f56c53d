"""Device table of the time laws of a model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..kernels.terms.loads import load_kernels, time_law_kernel, time_law_struct
from ..time_laws import Control, TimeLaw

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..model.state import State

__all__ = ["TimeLawTable", "argument_precision", "control_array"]


class TimeLawTable:
    """Time laws, numbered as added, then uploaded; `evaluate` fills one row of values per world.

    Attributes:
        controls: those in use, by name; their values are state arrays, see `control_array`.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self.kernels = load_kernels(model.dtype)
        self.laws: list[TimeLaw] = []
        self.functions: list[tuple[Any, int]] = []
        self.controls: dict[str, Control] = {}
        self.control_laws: dict[tuple[str, bool], int] = {}
        self.data = time_law_struct()()

    def add(self, law: TimeLaw) -> int:
        """Index of a law; a control keeps its first index.

        Raises:
            ModelError: a name used by two controls.
        """
        if law.control is not None:
            known = self.controls.setdefault(law.control.name, law.control)
            if known != law.control:
                raise ModelError(
                    f"two controls have the name {known.name!r}: {known} and {law.control}; give each its own, or use "
                    "one for both"
                )
            if (known.name, law.ramped) in self.control_laws:
                return self.control_laws[known.name, law.ramped]
            self.control_laws[known.name, law.ramped] = len(self.laws)
        self.laws.append(law)
        return len(self.laws) - 1

    @property
    def names(self) -> list[str]:
        """Names of controls and of laws with a key."""
        return [*self.controls, *dict.fromkeys(law.key for law in self.laws if law.key)]

    def indices_of(self, name: str) -> list[int]:
        """Laws of a control or key."""
        controls = [law for (control, _), law in self.control_laws.items() if control == name]
        return controls + [k for k, law in enumerate(self.laws) if law.key == name and law.control is None]

    def size_of(self, name: str) -> int:
        """Number of components of a control or of the laws with a key; 1 of other names."""
        keyed = [law for law in self.laws if law.key == name]
        return self.controls[name].size if name in self.controls else 3 if any(not w.scalar for w in keyed) else 1

    def register(self, state: State) -> None:
        """Add missing arrays of control values to a state."""
        for control in self.controls.values():
            state.register(control_array(control.name), wp.float64, (control.size,), control.initial)

    @property
    def count(self) -> int:
        """Number of laws."""
        return len(self.laws)

    def upload(self) -> None:
        """Upload the device table; no-op without laws."""
        m, laws = self.model, self.laws
        if not laws:
            return
        start = np.concatenate([[0], np.cumsum([len(w.times) for w in laws])])
        times = np.concatenate([w.times for w in laws] + [[0.0]])
        values = np.concatenate([w.values for w in laws] + [np.zeros((1, 3))])
        m.memory.fill(self.data, "laws", sample_start=start, sample_time=times, sample_value=values)
        for k, law in enumerate(laws):
            if law.function is not None:
                take = argument_precision(law.function, m.dtype)
                self.functions.append((time_law_kernel(law.function, law.scalar, take), k))

    def evaluate(
        self, launch: Launcher, state: State, time: wp.array, ramp: wp.array, active: wp.array, value: wp.array
    ) -> None:
        """value[world, law] at times [world]; constants and controls are scaled by the ramp [world] of a static load
        path.

        Control values are read from the state.
        """
        if not self.laws:
            return
        B = self.model.worlds
        launch(self.kernels.evaluate_time_laws, (B, self.count), [self.data, time, ramp, active, value])
        for kernel, law in self.functions:
            launch(kernel, B, [law, time, active, value])
        for (name, ramped), law in self.control_laws.items():
            args = [getattr(state, control_array(name)), law, int(ramped), ramp, active, value]
            launch(self.kernels.evaluate_control, B, args)

    def values_at_state(self, launch: Launcher, state: State) -> tuple[wp.array, wp.array]:
        """Values [world, law] at the time of a state, at full load; and flags [world] of 1."""
        B, device = state.worlds, self.model.device
        value = wp.zeros((B, max(self.count, 1)), dtype=wp.vec3d, device=device)
        full, all_worlds = wp.ones(B, dtype=wp.float64, device=device), wp.ones(B, dtype=wp.int32, device=device)
        self.evaluate(launch, state, state.time, full, all_worlds, value)
        return value, all_worlds

    def modules(self) -> set[wp.Module]:
        """Modules launched by `evaluate`."""
        out = {kernel.module for kernel, _ in self.functions}
        out |= {self.kernels.evaluate_control.module} if self.controls else set()
        return out | ({self.kernels.evaluate_time_laws.module} if self.laws else set())

    def hash(self, h: Any) -> None:
        """Hash the laws."""
        for law in self.laws:
            h.update(law.times.tobytes() + law.values.tobytes())
            if law.function is not None:
                h.update(law.function.key.encode())
            if law.control is not None:
                h.update(f"{law.control!r} {law.ramped}".encode())


def control_array(name: str) -> str:
    """Name of the state array [world, size] with the values of a control."""
    return f"control_{name}"


def argument_precision(function: wp.Function, default: str) -> str:
    """Precision of a user function's arguments, from its annotations."""
    text = " ".join(str(t) for t in getattr(function, "input_types", {}).values())
    if any(word in text for word in ("float64", "vec3d", "vec_t[float64")):
        return "float64"
    if any(word in text for word in ("float32", "vec3f", "<class 'float'>")):
        return "float32"
    return default
