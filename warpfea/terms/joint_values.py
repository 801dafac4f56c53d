"""Angle, travel and length of joints and their rates; turns of angles that no drive prescribes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..kernels.terms.constraints import ANGLE, DISTANCE
from ..kernels.terms.joint_angles import joint_angle_kernels
from ..kernels.terms.springs import ANGLE as ANGLE_COORDINATE
from ..kernels.terms.springs import LENGTH, TRAVEL
from ..model.joints import Joint, Vector
from ..model.springs import coordinate_gradients, coordinate_value

if TYPE_CHECKING:
    from ..model.model import Model
    from .term import StepContext

__all__ = ["JointAngles", "coordinate_vectors", "joint_value", "turn_source", "vector_tables"]


class JointAngles:
    """Joints with an angle that no drive prescribes: `state.joint_angle` [world, joint] counts their turns.

    Attributes:
        number: of each of them, by its index among all joints.
    """

    def __init__(self, model: Model, joints: Sequence[Joint]) -> None:
        self.model = model
        free = [(k, joint) for k, joint in enumerate(joints) if joint.angle and _drive_row(joint) < 0]
        self.joints = [joint for _, joint in free]
        self.number = {k: n for n, (k, _) in enumerate(free)}

    def upload(self) -> None:
        """Tables on the device."""
        vectors = [v for joint in self.joints for v in coordinate_vectors(joint)["angle"]]
        self.tables = vector_tables(vectors, lambda values, dtype: self.model.array("constraints", values, dtype))

    def register(self, ctx: StepContext) -> None:
        """Register the angles with the state."""
        if self.joints:
            ctx.state.register("joint_angle", wp.float64, (len(self.joints),))

    def modules(self) -> set[wp.Module]:
        """Module of that kernel."""
        return {joint_angle_kernels(self.model.dtype).module} if self.joints else set()


def vector_tables(vectors: Sequence[Vector], array: Any) -> list[wp.array]:
    """Start, slots, weights and reference values of vectors, by `array(values, dtype)`."""
    entries = [vector.entries() for vector in vectors]
    start = np.concatenate([[0], np.cumsum([len(slots) for slots, _, _ in entries])])
    slot = np.concatenate([*(slots for slots, _, _ in entries), np.zeros(1)])
    weight = np.concatenate([*(weights for _, weights, _ in entries), np.zeros(1)])
    values = np.array([vector.value for vector in vectors], dtype=float).reshape(-1, 3)
    kinds = ((start, wp.int32), (slot, wp.int32), (weight, wp.float64), (values, wp.vec3d))
    return [array(column, dtype) for column, dtype in kinds]


def coordinate_vectors(joint: Joint) -> dict[str, list[Vector]]:
    """Vectors of a joint that define its "angle" (a, b, a2), "travel" (two) and "length" (one), if any."""
    length = [joint.rows[0].a] if joint.rows[0].kind == DISTANCE else []
    angle = [joint.angle[k] for k in (0, 2, 1)] if joint.angle else []
    has = {"angle": angle, "travel": list(joint.travel or ()), "length": length}
    return {name: vectors for name, vectors in has.items() if vectors}


def _drive_row(joint: Joint) -> int:
    """Row of a joint, from its first, that drives its angle, or -1."""
    return next((k for k, row in enumerate(joint.rows) if row.kind == ANGLE), -1)


def turn_source(tables: Any, joint: Joint) -> int:
    """Source of the turns of an angle: the row of its drive, -2 - its number in `JointAngles`, or -1."""
    row = _drive_row(joint)
    if row >= 0:
        return int(tables.rows_of[joint.index][row])
    return -2 - tables.angles.number[joint.index] if joint.index in tables.angles.number else -1


def joint_value(tables: Any, joint: Joint, what: str | None, state: Any, *, rate: bool) -> np.ndarray:
    """Joint coordinate (worlds,): "angle" (rad), "travel" or "length" (m), or its rate; ModelError if undefined."""
    has = coordinate_vectors(joint)
    what = what or next(iter(has), None)
    if what not in has:
        raise ModelError(f"joint {joint.name!r}: a {joint.kind} joint has no {what or 'angle, travel or length'}")
    turns, source = tables.targets(state), turn_source(tables, joint)
    if source < -1:
        source = -2 - source
        turns = state.joint_angle.numpy() if "joint_angle" in state.names else np.zeros((state.worlds, source + 1))
    entries = [vector.entries() for vector in has[what]]
    kind, out = {"angle": ANGLE_COORDINATE, "travel": TRAVEL, "length": LENGTH}[what], []
    for world, (u, v) in enumerate(zip(state.displacement.numpy(), state.velocity.numpy())):
        vectors = np.array([x.value + w @ u[slots].astype(float) for x, (slots, w, _) in zip(has[what], entries)])
        if rate:
            gradient = coordinate_gradients(kind, vectors)[0]
            out.append(sum(g @ (w @ v[slots].astype(float)) for g, (slots, w, _) in zip(gradient, entries)))
            continue
        value = coordinate_value(kind, vectors)
        if source >= 0 and what == "angle":
            value += 2.0 * np.pi * np.round((turns[world, source] - value) / (2.0 * np.pi))
        out.append(value)
    return np.array(out, dtype=float)
