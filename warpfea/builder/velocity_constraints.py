"""Constraints at the level of velocities: rolling, knife edges, prescribed speeds of joints."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..base.checks import is_number
from ..base.errors import ModelError
from ..base.names import check_known
from ..kernels.terms.constraints import VELOCITY
from ..kernels.terms.springs import ANGLE
from ..kernels.terms.velocity_rows import ANGLE_RATE, DISC, KNIFE, ROLL, TRAVEL_RATE
from ..model.description import Description
from ..model.handles import MaterialPoint, NodeSet, SurfaceSet
from ..model.joints import ConstraintRow, Joint, Vector, VectorPart, constant_vector
from ..model.springs import joint_coordinate
from ..time_laws import time_law
from .attachments import Attachment, make_attachment
from .checks import body_of_handle, joint_of, unit_vector

__all__ = ["VelocityMethods"]

KINDS = ("roll", "knife", "speed")


class VelocityMethods:
    """Base of ModelBuilder: `add_velocity_constraint`."""

    description: Description

    def add_velocity_constraint(
        self, kind: str, of: Any, *, axis: Any = None, radius: float | None = None, normal: Any = None,
        value: Any = None, name: str | None = None,
    ) -> Joint:  # fmt: skip
        """Constrain velocities: A(q) v = b at the velocity of the scheme.

        Args:
            kind: "roll": a disc rolls without slip on a plane, which it touches in the reference: the material point
                at its lowest place is at rest, and its height over the plane is kept in positions, too. "knife": a
                point does not move along an axis of its body, as a skate or a wheel that may slip forward. "speed": of
                a joint.
            of: the centre of the disc, or the point of the knife (body.at); of "speed" the joint, or its name.
            axis: (3,) of the disc, or the direction without motion, both in the reference.
            radius: of the disc, m.
            normal: (3,) of the plane, towards the disc; by default z.
            value: of "speed" a time law or Control of the joint's angle (rad/s) or travel (m/s), by default 0.
            name: unique name.

        Returns:
            Joint: the handle for sim.joint_force, the force on the body or the joint's child, and sim.violation.

        Raises:
            ModelError: an unknown kind, an argument that is missing or of another kind; by Simulation in statics and
                with generalized_alpha.
        """
        check_known("add_velocity_constraint: kind", kind, KINDS)
        name = self._joint_name(name, kind)  # type: ignore[attr-defined]
        what = f"velocity constraint {name!r}"
        if (radius is None) == (kind == "roll"):
            raise ModelError(f"{what}: {'missing radius=' if radius is None else f'a {kind} has no radius'}")
        if (axis is None) == (kind != "speed"):
            raise ModelError(f"{what}: {'missing axis=' if axis is None else 'a speed has no axis'}")
        if normal is not None and kind != "roll":
            raise ModelError(f"{what}: a {kind} has no normal")
        if value is not None and kind != "speed":
            raise ModelError(f"{what}: value = {value!r} is for a speed; a {kind} has none")
        if kind == "speed":
            joint = self._speed(what, name, of, 0.0 if value is None else value)
        else:
            body_of_handle(of, what, (MaterialPoint, NodeSet, SurfaceSet), self.description.bodies)
            at = make_attachment(of, what, child=True)
            e = unit_vector(axis, f"{what}: axis")
            x = at.position(at.X, what)
            n = unit_vector((0, 0, 1) if normal is None else normal, f"{what}: normal")
            rows = _roll_rows(what, at, e, radius, n) if kind == "roll" else [
                ConstraintRow(VELOCITY, x, at.direction(e, what), parameters=_row_parameters(KNIFE))
            ]  # fmt: skip
            joint = Joint(name, kind, rows, x, at.label)
        return self._record_joint(joint)  # type: ignore[attr-defined,no-any-return]

    def _speed(self, what: str, name: str, joint: Any, value: Any) -> Joint:
        joint = joint_of(joint, what, self.description.joints)
        found = joint_coordinate(joint)
        if found is None:
            raise ModelError(f"{what}: a {joint.kind} joint has no angle or travel, or its handles do not determine it")
        if any(row.law is not None for row in joint.rows):
            raise ModelError(f"{what}: joint {joint.name!r} is driven: its drive= prescribes what this would")
        kind, vectors = found
        law = time_law(value, f"{what}: value", scalar=True)
        law = replace(law, ramped=False) if law.control is not None else law
        a2 = vectors[2] if kind == ANGLE else None
        form = ANGLE_RATE if kind == ANGLE else TRAVEL_RATE
        row = ConstraintRow(VELOCITY, vectors[0], vectors[1], a2=a2, angular=kind == ANGLE,
                            parameters=_row_parameters(form), law=law)  # fmt: skip
        return Joint(name, "speed", [row], joint.anchor, joint.between)


def _row_parameters(form: int, n: Any = (0, 0, 0), s: Any = (0, 0, 0), radius: float = 0.0) -> np.ndarray:
    """Parameters of a row, see kernels/terms/velocity_rows.py."""
    return np.array([n, s, (radius, form, 0.0)], dtype=float)


def _roll_rows(what: str, at: Attachment, e: np.ndarray, radius: Any, n: np.ndarray) -> list[ConstraintRow]:
    """Height of a disc, and the motion of its lowest point along two directions of the plane."""
    if not (is_number(radius) and radius > 0.0):
        raise ModelError(f"{what}: radius = {radius!r} must be a positive number, m")
    lean = np.linalg.norm(n - (n @ e) * e)
    if lean < 1e-3:
        raise ModelError(f"{what}: the disc lies flat on the plane: its axis is along the normal")
    x = at.position(at.X, what)
    ground = at.X - radius * lean * n
    rise = x - constant_vector(ground)
    parts = tuple(VectorPart(p.body, p.slots, p.weights / radius, p.on_child_side) for p in rise.parts)
    height = ConstraintRow(DISC, Vector(rise.value / radius, parts), at.direction(e, what), float(radius),
                           constant_vector(n))  # fmt: skip
    first = np.cross(n, np.eye(3)[int(np.argmin(np.abs(n)))])
    first /= np.linalg.norm(first)
    u = np.cross(e, np.eye(3)[int(np.argmin(np.abs(e)))])
    u /= np.linalg.norm(u)
    across = [at.direction(d, what) for d in (u, np.cross(e, u))]
    moves = [
        ConstraintRow(VELOCITY, x, across[0], a2=across[1], parameters=_row_parameters(ROLL, n, s, radius))
        for s in (first, np.cross(n, first))
    ]
    return [height, *moves]
