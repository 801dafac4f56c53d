"""Controls of a simulation: values written by the caller between steps."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.names import did_you_mean, listing
from ..base.short_repr import MAX_ITEMS, short_repr, truncated_lines
from ..terms.time_law_table import control_array
from ..time_laws import Control

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State

__all__ = ["ControlValue", "Controls"]


class Controls(Mapping[str, "ControlValue"]):
    """Controls in use in a model, by name: `sim.controls["jaw"][:] = 0.1`."""

    def __init__(self, model: Model, state: State) -> None:
        self._values = {
            name: ControlValue(control, getattr(state, control_array(name)))
            for name, control in model.terms.time_laws.controls.items()
        }

    def __getitem__(self, name: str) -> ControlValue:
        if name not in self._values:
            known = f"it has: {listing(self._values)}{did_you_mean(name, self._values)}"
            raise ModelError(f"no load or drive uses control {name!r}; {known}")
        return self._values[name]

    def __setitem__(self, name: str, values: Any) -> None:
        """Equivalent of `controls[name][:] = values`."""
        self[name].assign(values)

    def __contains__(self, name: object) -> bool:
        return name in self._values

    def __iter__(self) -> Iterator[str]:
        return iter(self._values)

    def __len__(self) -> int:
        return len(self._values)

    def __repr__(self) -> str:
        return truncated_lines(f"Controls({', '.join(map(repr, self._values.values()))})")


class ControlValue:
    """Values [world, size] of one control, in the unit of the driven quantity; written values act from the next step
    on.

    `value[:] = x`, `value[mask] = x` and `value[2, 0] = x` write with numpy's rules, one number per world also as
    (worlds,); `assign` also takes a Warp array. `array` is the memory of the state: kernels may write to it, and
    `wp.to_torch(value.array)` or `torch.from_dlpack(value)` share it without a copy. Values written through it are not
    validated.

    Attributes:
        control: the declared control.
        array: Warp array [world, size], float64.
    """

    def __init__(self, control: Control, array: wp.array) -> None:
        self.control = control
        self.array = array

    @property
    def shape(self) -> tuple[int, ...]:
        """(worlds, size)."""
        return tuple(self.array.shape)

    def numpy(self) -> np.ndarray:
        """A copy (worlds, size)."""
        return self.array.numpy().copy()

    def assign(self, values: Any) -> None:
        """Write the values of all worlds.

        Args:
            values: broadcastable to (worlds, size), or (worlds,) for a scalar control; or a Warp array (worlds, size)
                of float64, copied on the device without a check for non-finite values.

        Raises:
            ModelError: another shape or type, or a non-finite value; nothing is written then.
        """
        if not isinstance(values, wp.array):
            self[:] = values
            return
        if values.shape != self.shape or values.dtype != wp.float64:
            got = f"{values.dtype.__name__}{values.shape}"
            raise ModelError(f"{self._description} takes a Warp array float64{self.shape}, got {got}")
        wp.copy(self.array, values)

    def __setitem__(self, key: Any, values: Any) -> None:
        whole = key is Ellipsis or (isinstance(key, slice) and key == slice(None))
        target = np.empty(self.shape) if whole else self.numpy()
        try:
            given = np.asarray(values, dtype=float)
            part = target[key]
            if part.ndim == 2 and part.shape[1] == 1 and given.shape == part.shape[:1]:
                given = given[:, None]
            target[key] = given
        except (TypeError, ValueError, IndexError) as error:
            raise ModelError(f"{self._description} has values {self.shape}: {error}") from error
        # unwritten values may stay non-finite: a failed world can be repaired alone
        if not np.all(np.isfinite(given)) and not np.all(np.isfinite(target)):
            world, component = map(int, np.argwhere(~np.isfinite(target))[0])
            where = f"world {world}" + (f", component {component}" if self.shape[1] > 1 else "")
            raise ModelError(f"{self._description}: {target[world, component]} of {where} is not finite")
        self.array.assign(target)

    def __getitem__(self, key: Any) -> Any:
        """Read-only copy, so that `value[0][1] = x` raises instead of being lost."""
        values = self.numpy()
        values.flags.writeable = False
        out = values[key]
        if isinstance(out, np.ndarray):
            out.flags.writeable = False
        return out

    def __len__(self) -> int:
        return self.shape[0]

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> np.ndarray:
        if copy is False:
            raise ValueError(f"{self._description} is copied from the device; take .array")
        return self.numpy().astype(dtype or float)

    def __dlpack__(self, stream: Any = None) -> Any:
        return self.array.__dlpack__(stream)

    def __dlpack_device__(self) -> Any:
        return self.array.__dlpack_device__()

    def __repr__(self) -> str:
        values = self.numpy()
        shown = values.tolist() if len(values) <= MAX_ITEMS else short_repr(values)
        return f"ControlValue({self.control.name!r}, {shown})"

    @property
    def _description(self) -> str:
        return f"control {self.control.name!r}"
