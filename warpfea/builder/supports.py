"""Supports as recorded by a builder: nodes clamped, moved or rotated."""

from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..model.bodies import Body
from ..model.description import Rotation, Support, support_slots
from ..model.handles import NodeSet
from ..time_laws import time_law
from .checks import component_mask, vector

__all__ = ["clamp_support", "drive_supports"]


def clamp_support(body: Body, nodes: NodeSet, slots: str, components: str) -> Support:
    """See ModelBuilder.clamp."""
    clamped_slots = support_slots(nodes, slots)
    if not len(clamped_slots):
        raise ModelError(f"clamp on {body.name!r}: the nodes {nodes.name!r} have no slots {slots!r}")
    return Support(body, clamped_slots, component_mask(components, f"clamp on {body.name!r}"))


def drive_supports(
    body: Body, nodes: NodeSet, displacement: Any, rotation: Any, components: str, slots: str | None
) -> list[Support]:
    """Support of the driven components, and one that clamps named gradients with a displacement; see
    ModelBuilder.drive.
    """
    what = f"drive of {nodes.name or 'nodes'!r} on body {body.name!r}"
    if (displacement is None) == (rotation is None):
        raise ModelError(f"{what}: give either displacement or rotation")
    slots = slots or ("position" if rotation is None else "all")
    support = Support(body, support_slots(nodes, slots), component_mask(components, what))
    if rotation is not None:
        if not isinstance(rotation, Rotation):
            raise ModelError(f"{what}: rotation must be a Rotation(anchor, axis, angle), got {rotation!r}")
        axis = vector(rotation.axis, f"{what}: axis")
        if not np.linalg.norm(axis) > 0.0:
            raise ModelError(f"{what}: axis is zero")
        support.law = time_law(rotation.angle, f"{what}: angle", scalar=True)
        support.rotation = (vector(rotation.anchor, f"{what}: anchor"), axis / np.linalg.norm(axis))
        return [support]
    out = []
    position_mask = np.isin(support.slots, support_slots(nodes, "position"))
    if not position_mask.any():
        raise ModelError(f"{what}: slots = {slots!r} has no position to displace; clamp holds gradients")
    if not position_mask.all():  # gradients stay constant
        out.append(Support(body, support.slots[~position_mask], support.components))
    support.slots = support.slots[position_mask]
    if isinstance(displacement, tuple) and len(displacement) == 2 and np.ndim(displacement[1]) == 3:
        times, values = np.asarray(displacement[0], float), np.asarray(displacement[1], float)
        if values.shape != (len(times), len(nodes), 3):
            raise ModelError(f"{what}: values have shape {values.shape}, expected {(len(times), len(nodes), 3)}")
        used = np.flatnonzero(body.node_slot[nodes.indices] >= 0)
        support.node_laws = [time_law((times, values[:, k]), what) for k in used]
    else:
        support.law = time_law(displacement, f"{what}: displacement")
    return [*out, support]
