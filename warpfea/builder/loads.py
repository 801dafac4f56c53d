"""Supports, loads, initial states and probes as recorded by a builder; documented at the methods of ModelBuilder."""

from dataclasses import replace
from typing import Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..model.assembly import surface_weights
from ..model.bodies import Body
from ..model.description import DeadLoad, Moment, Pressure, Probe, Support, support_slots
from ..model.handles import MaterialPoint, NodeSet, SurfaceSet
from ..model.masses import center_of_mass
from ..time_laws import Rotation, time_law
from .attachments import as_point
from .checks import checked_rotation, component_mask, slot_field, vector

__all__ = [
    "check_field",
    "clamp_support",
    "dead_traction",
    "drive_supports",
    "follower_pressure",
    "moment_load",
    "point_load",
    "probe_at",
    "set_initial_positions",
    "set_initial_state",
]


def point_load(body: Body, point: MaterialPoint | NodeSet, force: Any, name: str | None = None) -> DeadLoad:
    """See ModelBuilder.add_point_load."""
    law = time_law(force, f"point load on {body.name!r}", key=name)
    point = as_point(point)
    if isinstance(point, NodeSet):
        slots, weights = _node_mean(point)
    else:
        slots, weights = point.slots, point.weights
    return DeadLoad(body, slots, weights, law, "point load")


def _node_mean(nodes: NodeSet) -> tuple[np.ndarray, np.ndarray]:
    """Slots and weights of the mean position of nodes."""
    slots = support_slots(nodes, "position")
    return slots, np.full(len(slots), 1.0 / len(slots))


def moment_load(body: Body, point: MaterialPoint | NodeSet, moment: Any, name: str | None = None) -> Moment:
    """See ModelBuilder.add_moment."""
    law = time_law(moment, f"moment on {body.name!r}", key=name)
    point = as_point(point)
    if isinstance(point, MaterialPoint):
        slots, vectors, axes = point.slots[None], (point.gradients @ point.axes)[None], point.axes[None]
    else:
        nodes = point.indices[body.node_slot_count[point.indices] == 4]
        if not len(nodes):
            raise ModelError(
                f"add_moment: nodes of body {body.name!r} ({body.family.name}) have no gradients to turn; use a "
                "point body.at(...), or add_traction"
            )
        slots = body.node_slot[nodes][:, None] + np.arange(1, 4)
        vectors = np.tile(np.eye(3), (len(slots), 1, 1))
        axes = np.swapaxes(body.reference[slots], 1, 2)
    vectors = vectors * (np.arange(3) >= 3 - body.family.spin_vectors)
    return Moment(body, slots, vectors, axes, law)


def dead_traction(body: Body, surface: SurfaceSet, traction: Any, name: str | None = None) -> DeadLoad:
    """See ModelBuilder.add_traction."""
    law = time_law(traction, f"traction on {surface.name or 'faces'!r} of body {body.name!r}", key=name)
    slots, weights = surface_weights(surface)
    return DeadLoad(body, slots, weights, law, "traction", surface)


def follower_pressure(body: Body, surface: SurfaceSet, pressure: Any, name: str | None = None) -> Pressure:
    """See ModelBuilder.add_pressure."""
    what = f"pressure on {surface.name or 'faces'!r} of body {body.name!r}"
    law = time_law(pressure, what, scalar=True, key=name)
    if not len(surface):
        raise ModelError(f"pressure on body {body.name!r}: the surface has no faces")
    return Pressure(surface, law)


def check_field(field: Any) -> None:
    """Raise ModelError unless a body force is a wp.func of position and time."""
    if not isinstance(field, wp.Function):
        raise ModelError(
            f"add_body_force: the field must be a wp.func, got {field!r}; write def f(x: wp.vec3d, t: wp.float64) -> "
            "wp.vec3d with @wp.func above it"
        )
    if len(field.input_types) != 2:
        raise ModelError(
            f"add_body_force: {field.key} takes {len(field.input_types)} arguments; it must be "
            "(x: wp.vec3d, t: wp.float64) -> wp.vec3d, or the same in float32"
        )


def set_initial_positions(body: Body, initial: Any) -> None:
    """Initial positions of a body as an argument of the methods of ModelBuilder that add one; None: the reference."""
    if initial is not None:
        start, reference = slot_field(body, initial, f"body {body.name!r}: initial"), slot_field(body, lambda X: X, "")
        body.initial_displacement = start - reference


def set_initial_state(body: Body, velocity: Any, angular_velocity: Any, displacement: Any) -> None:
    """See ModelBuilder.set_initial."""
    label = f"body {body.name!r}"
    if displacement is not None:
        body.initial_displacement = slot_field(body, displacement, f"{label}: initial displacement")
    if velocity is None and angular_velocity is None:
        return
    slots = np.zeros((body.slot_count, 3))
    if velocity is not None:
        slots += slot_field(body, velocity, f"{label}: velocity")
    if angular_velocity is not None:
        spin = vector(angular_velocity, f"{label}: angular_velocity")
        x = body.reference + (0.0 if body.initial_displacement is None else body.initial_displacement)
        position = body.slot_kind == 0
        arm = np.where(position[:, None], x + body.origin - center_of_mass(body, x), x)
        slots += np.cross(spin, arm)
    body.velocity = slots


def probe_at(name: str, body: Body, where: MaterialPoint | SurfaceSet | NodeSet) -> Probe:
    """See ModelBuilder.add_probe."""
    where, surface, area = as_point(where), None, 1.0
    if isinstance(where, MaterialPoint):
        slots, weights = where.slots, where.weights
    elif isinstance(where, SurfaceSet):
        slots, weights = surface_weights(where)
        surface, area = where, float(weights[body.slot_kind[slots] == 0].sum())
        weights = weights / area
    else:
        slots, weights = _node_mean(where)
    X = weights @ (body.reference[slots] + (body.slot_kind[slots] == 0)[:, None] * body.origin)
    return Probe(name, body, slots, weights, X, surface, area)


def clamp_support(body: Body, nodes: NodeSet, slots: str, components: str) -> Support:
    """See ModelBuilder.clamp."""
    clamped_slots = support_slots(nodes, slots)
    if not len(clamped_slots):
        raise ModelError(f"clamp on {body.name!r}: the nodes {nodes.name!r} have no slots {slots!r}")
    return Support(body, clamped_slots, component_mask(components, f"clamp on {body.name!r}"))


def drive_supports(
    body: Body, nodes: NodeSet, displacement: Any, rotation: Any, components: str, slots: str | None,
    name: str | None = None,
) -> list[Support]:  # fmt: skip
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
        support.rotation = checked_rotation(rotation, what)
        support.law = replace(support.rotation.angle, key=name or "")
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
        support.node_laws = [time_law((times, values[:, k]), what, key=name) for k in used]
    else:
        support.law = time_law(displacement, f"{what}: displacement", key=name)
    return [*out, support]
