"""Parsing and validation of values given for all worlds or one per world."""

from typing import Any

import numpy as np
import warp as wp

from .checks import is_count
from .errors import ModelError

__all__ = [
    "check_values_per_world", "device_flags", "set_rows", "to_host", "values_per_world", "world_numbers",
    "worlds_mask",
]  # fmt: skip


def to_host(values: Any) -> np.ndarray:
    """Array on the host or a device (Warp, or shared memory of another library). TypeError, ValueError for others."""
    if isinstance(values, wp.array):
        values = values.numpy()
    elif hasattr(values, "detach"):  # of PyTorch
        values = values.detach().cpu().numpy()
    elif hasattr(values, "__cuda_array_interface__"):
        values = wp.array(values, copy=False).numpy()
    return np.asarray(values)


def worlds_mask(what: str, mask: Any, worlds: int) -> np.ndarray:
    """(worlds,) flags from a mask or world indices; default all.

    Raises:
        ModelError: neither, or ambiguous whole numbers.
    """
    if mask is None:
        return np.ones(worlds, dtype=bool)
    try:
        out = to_host(mask)
        known = out.dtype.kind in "biu" or out.size == 0
    except (TypeError, ValueError):
        known = False
    flags = known and out.shape == (worlds,) and bool(np.isin(out, (0, 1)).all())
    if flags and out.dtype.kind == "b":
        return out.astype(bool)
    numbers = known and out.dtype.kind != "b" and out.ndim < 2 and bool(np.isin(out, range(worlds)).all())
    numbers = numbers and len(set(out.ravel().tolist())) == out.size
    chosen = np.isin(np.arange(worlds), out) if numbers else np.zeros(worlds, dtype=bool)
    if flags and not numbers:  # whole numbers, one of them repeated
        return out.astype(bool)
    if numbers and (out.size < worlds or worlds > 3):  # for up to three worlds the numbers may be flags or statuses
        return chosen
    if flags:
        one, other = out.astype(bool).tolist(), chosen.tolist()
        raise ModelError(f"{what}: mask = {mask!r} is ambiguous (flags or world indices): write {one} or {other}")
    raise ModelError(
        f"{what}: mask = {mask!r} must be ({worlds},) of True and False, one per world, or world indices "
        f"from 0 to {worlds - 1}"
    )


def world_numbers(numbers: Any, worlds: int) -> list[int] | None:
    """Numbers of chosen worlds; None, for all, stays. ModelError for one that there is not, or none."""
    if numbers is None:
        return None
    chosen = list(numbers) if np.iterable(numbers) else []
    if not (chosen and all(is_count(k) and 0 <= k < worlds for k in chosen)):
        raise ModelError(f"worlds = {numbers!r} must be numbers from 0 to {worlds - 1}")
    return [int(k) for k in chosen]


def values_per_world(what: str, name: str, values: Any, worlds: int, row: tuple[int, ...] = ()) -> np.ndarray:
    """(worlds, *row) array of one value for all worlds, or one per world. ModelError for another shape."""
    one, each = f"{row}" if row else "a number", (worlds, *row)
    try:
        out = np.asarray(to_host(values), dtype=float)
    except (TypeError, ValueError):
        raise ModelError(f"{what}: {name} = {values!r} must be {one}, or one per world") from None
    if out.shape not in (row, each):
        raise ModelError(f"{what}: {name} has shape {out.shape}, expected {one} or {each}, one per world")
    return np.broadcast_to(out, each).astype(float)


def check_values_per_world(what: str, name: str, values: np.ndarray, good: np.ndarray, wanted: str) -> None:
    """Raise ModelError for the first world with an invalid value; `wanted`: the requirement."""
    for world in np.flatnonzero(~good)[:1]:
        raise ModelError(f"{what}: {name} = {values[world].tolist()!r} in world {world} must be {wanted}")


def device_flags(flags: Any, device: Any) -> wp.array:
    """Flags of worlds on a device, int32."""
    return wp.array(np.asarray(flags).astype(np.int32), dtype=wp.int32, device=device)


def set_rows(array: wp.array, chosen: Any, values: Any) -> None:
    """Set `array[chosen]`, with a mask or index of numpy, in place: captured graphs read the array."""
    host = array.numpy()
    host[chosen] = values
    array.assign(host)
