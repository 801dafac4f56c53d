"""Warnings of time laws: ends before the end of a run, and drives that jump in the first step."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelWarning

if TYPE_CHECKING:
    from ..model.description import Support
    from ..time_laws import TimeLaw

__all__ = ["warn_early_ends", "warn_initial_jumps"]

INITIAL_JUMP_RATIO = 1e-4
"""Smallest reported distance of driven nodes from the start of their law, over the model's size; joints raise an
error."""
END_SLOPE, PULSE_END = 0.05, 1e-9
"""End slope treated as zero, over the largest slope; end value treated as 0."""
MAX_NAMES = 4
"""Maximum number of laws named in a message."""


def warn_early_ends(sim: Any, t_end: float) -> None:
    """Warn, once per law, of sampled laws with a nonzero end slope before t_end, s."""
    ended: dict[str, float] = {}
    for law in sim.model.terms.time_laws.laws:
        if len(law.times) < 2 or law.times[-1] >= t_end - 1e-9 * abs(t_end) or id(law) in sim.ended_laws:
            continue
        sim.ended_laws.add(id(law))
        if _changes_at_end(law):
            ended.setdefault(law.name, float(law.times[-1]))
    if ended:
        texts = ", ".join(f"{name} (t = {end:g} s)" for name, end in list(ended.items())[:MAX_NAMES])
        texts += f" and {len(ended) - MAX_NAMES} more" if len(ended) > MAX_NAMES else ""
        warnings.warn(
            f"time laws end before t_end = {t_end:g} s and hold their last values: {texts}; to confirm, end with two "
            "equal samples, such as ([0, 1, 2], [0, v, v])",
            ModelWarning,
            stacklevel=3,
        )


def _changes_at_end(law: TimeLaw) -> bool:
    """True if a sampled law has a nonzero end slope and is no pulse back to 0."""
    slopes = np.diff(law.values, axis=0) / np.diff(law.times)[:, None]
    if len(slopes) < 2:
        return bool(np.any(slopes))
    lengths = np.diff(law.times)
    end = slopes[-1] + (slopes[-1] - slopes[-2]) * lengths[-1] / (lengths[-1] + lengths[-2])
    end[slopes[-1] == 0.0] = 0.0
    if np.abs(end).max() <= END_SLOPE * np.abs(slopes).max():
        return False
    none = PULSE_END * np.abs(law.values).max()
    one_sided = (law.values >= -none).all(axis=0) | (law.values <= none).all(axis=0)
    return not (one_sided.all() and np.abs(law.values[-1]).max() <= none)


def warn_initial_jumps(sim: Any) -> None:
    """Warn of a drive that differs from its nodes' positions at the start of a motion, in the first world.

    Controls are not checked.
    """
    laws = {id(law): law for s in sim.model.description.supports for law in [s.law, *(s.node_laws or [])]
            if law is not None and law.control is None}  # fmt: skip
    if sim.integrator.static or not laws:
        return
    time = float(sim.time[0])
    values = _law_values_by_id(sim, laws, time)
    u = sim.state.displacement.numpy()[0].astype(float)
    for support in sim.model.description.supports:
        law = support.law or (support.node_laws or [None])[0]
        if law is None or id(law) not in values:
            continue
        worst = float(np.linalg.norm(_drive_error(support, values, u), axis=1).max(initial=0.0))
        if not worst > INITIAL_JUMP_RATIO * sim.model.size:
            continue
        warnings.warn(
            f"initial jump of {worst:.3g} m: {law.name} at t = {time:g} s differs from the nodes' positions: start it "
            "there, such as ([0, 0.1], [0, value]), or assemble the model with solve_static",
            ModelWarning,
            stacklevel=3,
        )
        return


def _law_values_by_id(sim: Any, laws: dict[int, TimeLaw], time: float) -> dict[int, np.ndarray]:
    """Values (3,) of each law at a time, s, by `id`; functions are evaluated on the device."""
    if any(law.function is not None for law in laws.values()):
        found = sim.stepper.law_values(time)[0]
        return {id(law): found[k] for k, law in enumerate(sim.model.terms.time_laws.laws) if id(law) in laws}
    return {k: np.array([np.interp(time, law.times, column) for column in law.values.T]) for k, law in laws.items()}


def _drive_error(support: Support, values: dict[int, np.ndarray], u: np.ndarray) -> np.ndarray:
    """Deviation (slots, 3), m, of driven positions from their time laws."""
    body = support.body
    chosen = np.flatnonzero(body.slot_kind[support.slots] == 0)
    slots = support.slots[chosen]
    if support.rotation is not None:
        anchor, axis = support.rotation
        angle = values[id(support.law)][0]
        arm = body.reference[slots] + body.origin - anchor
        turn = np.cross(axis, arm)
        target = np.sin(angle) * turn + (1.0 - np.cos(angle)) * np.cross(axis, turn)
    elif support.node_laws:
        target = np.array([values[id(support.node_laws[k])] for k in chosen])
    else:
        target = values[id(support.law)]
    return np.asarray((target - u[slots + body.slot_offset]) * np.asarray(support.components, dtype=float))
