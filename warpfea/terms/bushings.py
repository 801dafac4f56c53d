"""Values per world of bushings, and forces of springs at the last step."""

from __future__ import annotations

from typing import Any

import numpy as np

from ..base.worlds import check_values_per_world, set_rows, values_per_world
from ..kernels.terms.springs import LENGTH
from ..model.springs import Bushing, Spring, bushing_parts, coordinate_gradients
from .term import StepContext

__all__ = ["force_of_spring", "set_bushing"]


def force_of_spring(term: Any, ctx: StepContext, handle: Spring | Bushing) -> np.ndarray:
    """(worlds, ...) force, by the term `Springs`; of springs with one coordinate a number: of LENGTH its tension, of
    others that on the child.

    The derivatives of the potential are those of the last evaluation; with `energy_momentum` they are means over the
    step, which a turn in the step makes smaller to second order.
    """
    if isinstance(handle, Bushing):
        slot, weight, _ = handle.place.entries()
        x = _positions(term, ctx)
        at = np.einsum("s,bsk->bk", weight, x[:, slot]) if len(slot) else handle.place.value[None]
        found = sum(_wrench(term, ctx, x, at, spring, second=len(slot) > 0) for spring in handle.springs)
        return np.asarray(found if len(slot) else -found)
    if not handle.scalar:
        x = _positions(term, ctx)
        return _wrench(term, ctx, x, np.zeros((1, 3)), handle, second=False)[:, :3]
    item = int(_items(term, handle)[0])
    own, kind = slice(term.entry_start[item], term.entry_start[item + 1]), int(term.kind[item])
    u = ctx.state.displacement.numpy()[:, term.entry_slot[own]].astype(float)
    out = []
    for x, force in zip(u, ctx.scratch[term.name][0].force.numpy()[:, item]):
        (g,) = coordinate_gradients(kind, term.definition["reference"][item] + term.entry_weight[own].T @ x)
        out.append(np.sum(force * g) / np.sum(g * g))
    return np.array(out) if kind == LENGTH else -np.array(out)


def _items(term: Any, spring: Spring) -> np.ndarray:
    return np.flatnonzero(term.definition["spring"] == term.springs.index(spring))


def _positions(term: Any, ctx: StepContext) -> np.ndarray:
    """Values (worlds, slots, 3) of the slots, m."""
    table, bodies = term.model.slot_table, term.model.bodies
    origin = np.concatenate([np.tile(body.origin, (body.slot_count, 1)) for body in bodies])
    reference = table.reference + (table.kind == 0)[:, None] * origin
    return np.asarray(reference + ctx.state.displacement.numpy().astype(float))


def _wrench(
    term: Any, ctx: StepContext, x: np.ndarray, at: np.ndarray, spring: Spring, *, second: bool
) -> np.ndarray:  # fmt: skip
    """Force and moment (worlds, 6) about `at` (worlds, 3) of the items of a spring on the slots of one end."""
    position = (term.model.slot_table.kind == 0)[:, None]
    force, out = ctx.scratch[term.name][0].force.numpy(), np.zeros((len(x), 6))
    for item in _items(term, spring):
        for side, vector in enumerate(term.items[item]):
            slot, weight, of_second = vector.entries()
            slot, weight = slot[of_second == second], weight[of_second == second]
            f = -weight[:, None] * force[:, item, side][:, None]
            out[:, :3] += (position[slot] * f).sum(axis=1)
            out[:, 3:] += np.cross(x[:, slot] - position[slot] * at[:, None], f).sum(axis=1)
    return out


def set_bushing(term: Any, bushing: Bushing, name: str, values: Any, mask: np.ndarray) -> None:
    """Write "stiffness" or "damping" (6,) of a bushing in the chosen worlds."""
    what, label = "set_parameter", f"{bushing.name}.{name}"
    wanted = values_per_world(what, label, values, term.model.worlds, (6,))
    good = (np.isfinite(wanted) & (wanted >= 0.0)).all(axis=1)
    check_values_per_world(what, label, wanted, ~mask | good, "six values, 0 or more")
    parts = bushing_parts(wanted, damping=name == "damping")
    built = np.isin(np.arange(parts.shape[1]), bushing.parts)
    text = "0 along and about axes that the bushing was added without"
    check_values_per_world(what, label, wanted, ~mask | ~parts[:, ~built].any(axis=1), text)
    rows = [term.springs.index(spring) for spring in bushing.springs]
    set_rows(getattr(term.data, name), np.ix_(mask, rows), parts[np.ix_(mask, built)])
