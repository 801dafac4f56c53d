"""Time laws: a constant, samples (times, values), a `wp.func` of t, or a `Control`."""

import functools
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from .base.checks import float_array, number_hint
from .base.errors import ModelError
from .base.short_repr import use_short_repr

__all__ = ["Control", "Rotation", "TimeLaw", "time_law"]

SIZE_NAMES = {1: "a scalar", 3: "a vector"}
"""Sizes of a control, as text."""


@dataclass(frozen=True)
class Control:
    """A time law whose values the caller writes between steps, in each world its own: `sim.controls[name]`.

    Zero-order hold during a step; prescribed displacements and joint drives reach the value at the end of the step. In
    statics it is scaled by the load factor, as a constant load is; right-hand sides of joints are not. The same control
    may drive several things.

    Args:
        name: key in `sim.controls`; unique in a model.
        size: 1 for a scalar (pressure, angle, displacement along an axis), 3 for a vector.
        initial: number, or (size,): the value at the start and after `sim.reset`, in the unit of what it drives.

    Raises:
        ModelError: the name is not text, or size or initial value are out of range.
    """

    name: str
    size: int = 1
    initial: Any = 0.0

    def __post_init__(self) -> None:
        if not isinstance(self.name, str) or not self.name:
            raise ModelError(f"a control needs a name, got {self.name!r}")
        if isinstance(self.size, bool) or not isinstance(self.size, (int, np.integer)) or self.size not in SIZE_NAMES:
            raise ModelError(f"control {self.name!r}: size = {self.size!r} must be 1 (number) or 3 (vector)")
        value = float_array(self.initial)
        if value.shape not in ((), (self.size,)) or not np.all(np.isfinite(value)):
            expected = f"a finite number{' or 3 of them' if self.size == 3 else ''}"
            raise ModelError(f"control {self.name!r}: initial = {self.initial!r} must be {expected}")
        object.__setattr__(self, "size", int(self.size))
        object.__setattr__(self, "initial", tuple(np.broadcast_to(value, (self.size,)).tolist()))


@dataclass(frozen=True, eq=False)
class Rotation:
    """A prescribed rotation about an axis through an anchor.

    Args:
        anchor: (3,) m.
        axis: (3,), any length but zero.
        angle: time law, rad.
    """

    anchor: Any
    axis: Any
    angle: Any

    __repr__ = use_short_repr


@dataclass(frozen=True, eq=False)
class TimeLaw:
    """A value over time: samples, interpolated linearly and constant outside of them; a function of t; or a control.

    Attributes:
        times: (n,) s; one for a constant, empty for a function or a control.
        values: (n, 3) in the unit of what the law drives; of scalar laws the first column.
        function: wp.func of t (s), or None.
        scalar: True for a scalar value.
        control: source of the values, or None.
        ramped: True: in statics the value of a control is multiplied by the load factor.
        name: of the driven quantity, for messages.
        key: name of a constant added to the values, by which `wf.Adjoint` has derivatives; "" for none.
    """

    times: np.ndarray
    values: np.ndarray
    function: Any = None
    scalar: bool = False
    control: Control | None = None
    ramped: bool = True
    name: str = ""
    key: str = ""


def _as_vectors(values: np.ndarray, scalar: bool) -> np.ndarray:
    """(n, 3) values; those (n,) of a scalar law in the first column."""
    if not scalar:
        return values
    out = np.zeros((len(values), 3))
    out[:, 0] = values
    return out


def _is_flat_list(value: Any) -> bool:
    """True for a flat list of entries, False for a ragged one."""
    try:
        return np.ndim(value) == 1
    except ValueError:
        return False


def _parse_samples(value: Any, what: str, width: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) and values (n, *width) of a pair (times, values)."""
    try:
        times, values = np.asarray(value[0], dtype=float), np.asarray(value[1], dtype=float)
    except (TypeError, ValueError) as error:
        text = f"{what} = {value!r}: times and values must be numbers, all values of one shape"
        raise ModelError(text) from error
    if values.shape != (len(times), *width):
        raise ModelError(
            f"{what}: values have shape {values.shape}, expected {(len(times), *width)} for {len(times)} times"
        )
    if len(times) < 1 or np.any(np.diff(times) <= 0.0):
        raise ModelError(f"{what}: times must increase, got {times.tolist()}")
    if len(times) == 1:
        raise ModelError(f"{what}: a law over time needs at least two samples; give the value alone for a constant")
    return times, values


def _parse_constant(value: Any, what: str, width: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray]:
    """Time 0 (1,) and the value (1, *width)."""
    try:
        values = np.asarray(value, dtype=float)[None]
    except (TypeError, ValueError) as error:
        kinds = "number, vector, (times, values), wp.func or Control"
        rows = value if isinstance(value, (tuple, list)) else []
        pairs = len(rows) > 0 and all(isinstance(row, (tuple, list)) and len(row) == 2 for row in rows)
        hint = "; write pairs as ([t for t, _ in pairs], [v for _, v in pairs])" if pairs else number_hint(value)
        raise ModelError(f"{what} = {value!r} is not a {kinds}{hint}") from error
    if values.shape != (1, *width):
        hint = f"; write a vector such as (0, 0, {value!r})" if values.shape == (1,) else ""
        raise ModelError(f"{what} has shape {values.shape[1:]}, expected {width or 'a number'}{hint}")
    return np.zeros(1), values


def time_law(value: Any, what: str, *, scalar: bool = False, key: str | None = None) -> TimeLaw:
    """Time law from a user's value.

    Args:
        value: number or 3-vector; (times (n,), values (n,) or (n, 3)); a wp.func of t; or a Control; times in s.
        what: name used in errors.
        scalar: a scalar law instead of a vector law.
        key: see `TimeLaw`.

    Raises:
        ModelError: a Python function, a wrong shape, times that do not increase, a value that is not finite, or a
            control of another size.
    """
    if key is not None and not (isinstance(key, str) and key):
        raise ModelError(f"{what}: name = {key!r} must be a text")
    named = functools.partial(TimeLaw, scalar=scalar, name=what, key=key or "")
    if isinstance(value, Control):
        if value.size != (1 if scalar else 3):
            needed = SIZE_NAMES[1 if scalar else 3]
            raise ModelError(f"{what}: control {value.name!r} has size {value.size}, but {needed} is to be driven")
        return named(np.zeros(0), np.zeros((0, 3)), control=value)
    if isinstance(value, wp.Function):
        return named(np.zeros(0), np.zeros((0, 3)), function=value)
    if callable(value):
        name = getattr(value, "__name__", type(value).__name__).replace("<lambda>", "a lambda")
        raise ModelError(
            f"{what}: {name} is a Python function; Python functions do not run on the device: sample it, "
            "(times, [f(t) for t in times]) with times = np.linspace(0, t_end, 201), or define it with @wp.func"
        )
    sampled = isinstance(value, (tuple, list)) and len(value) == 2 and _is_flat_list(value[0])
    parse = _parse_samples if sampled else _parse_constant
    times, values = parse(value, what, () if scalar else (3,))
    if not (np.all(np.isfinite(times)) and np.all(np.isfinite(values))):
        raise ModelError(f"{what}: {value!r} holds a value that is not finite")
    return named(times, _as_vectors(values, scalar))
