"""Discontinuities of time laws: value and slope jumps, drives that jump within a rejected or in the first step, ends
before the end of a run."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelWarning
from ..kernels.terms.constraints import ANGLE

if TYPE_CHECKING:
    from ..model.description import Support
    from ..model.model import Model
    from ..time_laws import TimeLaw

__all__ = [
    "discontinuous_drives_text",
    "jump_intervals",
    "kink_times",
    "list_drives",
    "warn_early_ends",
    "warn_initial_jumps",
]

MIN_JUMP_RATIO = 10.0
"""Smallest ratio of a drive's jump to its motion in the preceding equal time."""
MIN_JUMP_ANGLE = 0.1
"""Smallest jump of an angle, rad."""
MIN_SLOPE_CHANGE = 0.25
"""Slope change of a kink over the largest slope; samples of a smooth law change less."""
MIN_KINK_HEIGHT = 0.03
"""Slope change of a kink times the shorter adjacent interval, over the law's range: detects kinks beside a large jump,
above the value of a coarsely sampled sine that passes `MIN_SLOPE_CHANGE`."""
MAX_JUMP_DURATION = 1e-3
"""Duration of a jump, over the step."""
INITIAL_JUMP_RATIO = 1e-4
"""Smallest reported distance of driven nodes from the start of their law, over the model's size; joints raise an
error."""
END_SLOPE, PULSE_END = 0.05, 1e-9
"""End slope treated as zero, over the largest slope; end value treated as 0."""
MAX_NAMES = 4
"""Maximum number of laws named in a message."""


def discontinuous_drives_text(sim: Any, world: int) -> str:
    """Description of the drives that jump within the last attempt of a world's rejected step; "" without any.

    Thresholds: an element size for displacements, m, `MIN_JUMP_ANGLE` for angles.
    """
    driven = list_drives(sim.model)
    if not driven:
        return ""
    step = sim.stepper.work.step
    end, h = float(step.new_time.numpy()[world]), float(step.h.numpy()[world])
    late, start, early = (sim.stepper.law_values(end - k * h)[world] for k in range(3))
    least = _element_size(sim.model)
    texts = []
    for name, angular, entries in driven:
        moved, before = (
            max(float(np.linalg.norm((b[number] - a[number]) * mask)) for number, mask in entries)
            for a, b in ((start, late), (early, start))
        )
        if moved > max(MIN_JUMP_RATIO * before, MIN_JUMP_ANGLE if angular else least):
            texts.append(f"{name} by {moved:.3g} {'rad' if angular else 'm'}")
    if not texts:
        return ""
    span = f"{100.0 * h:.3g} % of the load" if sim.integrator.static else f"{h:.3g} s"
    return f"; discontinuous drive within {span}: {', '.join(texts[:4])}{', ...' if len(texts) > 4 else ''}: use a ramp"


def list_drives(model: Model) -> list[tuple[str, bool, list[tuple[int, np.ndarray]]]]:
    """Name of each drive, True if angular, and its law indices with their prescribed components."""
    number = {id(law): k for k, law in enumerate(model.terms.time_laws.laws)}
    out: list[tuple[str, bool, list[tuple[int, np.ndarray]]]] = []

    def add(name: str, angular: bool, laws: list[tuple[TimeLaw, np.ndarray]]) -> None:
        entries = [(number[id(law)], mask) for law, mask in laws if id(law) in number]
        if entries:
            out.append((name, angular, entries))

    for joint in model.constraints.joints if model.constraints else ():
        rows = [row for row in joint.rows if row.law is not None]
        laws = [(row.law, np.eye(3)[row.component]) for row in rows if row.law is not None]
        add(f"joint {joint.name!r}", any(row.kind == ANGLE for row in rows), laws)
    for support in model.description.supports:
        turns = support.rotation is not None
        mask = np.eye(3)[0] if turns else np.asarray(support.components, dtype=float)
        known = support.node_laws or ([support.law] if support.law is not None else [])
        add(f"the drive of body {support.body.name!r}", turns, [(law, mask) for law in known])
    return out


def _element_size(model: Model) -> float:
    """Median diagonal of the elements' bounding boxes, m."""
    sizes = []
    for block in model.blocks:
        for part in block.host_blocks:
            points = part.body.reference[part.conn]
            place = (part.body.slot_kind[part.conn] == 0)[:, :, None]
            low, high = np.where(place, points, np.inf).min(axis=1), np.where(place, points, -np.inf).max(axis=1)
            sizes.append(np.linalg.norm(high - low, axis=1))
    return float(np.median(np.concatenate(sizes)))


def jump_intervals(law: TimeLaw, dt: float) -> np.ndarray:
    """Start and end times (n, 2), s, of jumps relative to a step dt."""
    t = law.times
    if len(t) < 2:
        return np.zeros((0, 2))
    steep = (np.diff(t) < MAX_JUMP_DURATION * dt) & np.any(np.diff(law.values, axis=0) != 0.0, axis=1)
    return np.stack([t[:-1][steep], t[1:][steep]], axis=1)


def kink_times(law: TimeLaw, dt: float) -> np.ndarray:
    """Times (n,), s, of slope jumps of a sampled law; value jumps are in `jump_intervals`."""
    t = law.times
    if len(t) < 2:
        return np.zeros(0)
    smooth = np.diff(t) >= MAX_JUMP_DURATION * dt
    slope = np.where(smooth[:, None], np.diff(law.values, axis=0) / np.diff(t)[:, None], 0.0)
    slope = np.concatenate([np.zeros((1, 3)), slope, np.zeros((1, 3))])
    bend = np.linalg.norm(np.diff(slope, axis=0), axis=1)
    beside = np.concatenate([[np.inf], np.diff(t), [np.inf]])
    bulge = bend * np.minimum(beside[:-1], beside[1:])
    extent = np.linalg.norm(np.ptp(law.values, axis=0))
    steepest = np.linalg.norm(slope, axis=1).max()
    return t[
        (bend > MIN_SLOPE_CHANGE * np.maximum(steepest, 1e-300))
        | (bulge > MIN_KINK_HEIGHT * np.maximum(extent, 1e-300))
    ]


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
        axis, angle = support.rotation.axis, values[id(support.law)][0]
        turn = np.cross(axis, body.reference[slots] + body.origin - support.rotation.anchor)
        target = np.sin(angle) * turn + (1.0 - np.cos(angle)) * np.cross(axis, turn)
    elif support.node_laws:
        target = np.array([values[id(support.node_laws[k])] for k in chosen])
    else:
        target = values[id(support.law)]
    return np.asarray((target - u[slots + body.slot_offset]) * np.asarray(support.components, dtype=float))
