"""Discontinuous drives within a rejected step."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..kernels.terms.constraints import ANGLE

if TYPE_CHECKING:
    from ..model.model import Model
    from ..time_laws import TimeLaw

__all__ = ["discontinuous_drives_text", "list_drives"]

MIN_JUMP_RATIO = 10.0
"""Smallest ratio of a drive's jump to its motion in the preceding equal time."""
MIN_JUMP_ANGLE = 0.1
"""Smallest jump of an angle, rad."""


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
