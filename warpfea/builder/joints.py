"""Joints as compositions of DP1, DP2, DIST and PIN (Paper I, section 5.4) with their own points and axes.

    spherical      PIN                     translational  3 DP1 + 2 DP2
    universal      PIN + DP1               fixed          PIN + 3 DP1
    revolute       PIN + 2 DP1             distance       DIST
    cylindrical    2 DP1 + 2 DP2

A material direction n of a body is F n, linear in the slots, in place of a chord between two points.
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..base.names import check_known, did_you_mean
from ..kernels.terms.constraints import ANGLE, DISTANCE, DOT
from ..model.joints import ConstraintRow, Joint, Vector, check_rows, constant_vector
from ..time_laws import TimeLaw, time_law
from .attachments import COINCIDENCE_TOL, GROUND, UNKNOWN_WEAKNESS, Attachment, Ground, make_attachment
from .checks import unit_vector, vector

__all__ = [
    "CONSTRAINT_KINDS", "GROUND", "JOINT_KINDS", "ConstraintKind", "ConstraintPoints", "Ground", "make_constraint",
    "make_joint", "pin_rows",
]  # fmt: skip

JOINT_KINDS = ("spherical", "universal", "revolute", "cylindrical", "translational", "fixed", "distance")
KINDS_WITH_AXIS = ("universal", "revolute", "cylindrical", "translational")
DRIVABLE_KINDS = ("revolute", "translational", "distance")
KINDS_WITH_PIN = ("spherical", "universal", "revolute", "fixed")
AngleVectors = tuple[Vector, Vector, Vector]
"""Vectors (a, a2, b) of the angle atan2(a2.b, a.b), see `_angle_vectors`."""


def make_joint(
    kind: str, parent: Any, child: Any, anchor: Any, axis: Any, axis2: Any, drive: Any, name: str
) -> Joint:  # fmt: skip
    """Compose a joint. ModelError naming the joint and the error."""
    what = f"joint {name!r}"
    P, Q = _attachments(what, kind, parent, child)
    if axis2 is not None and kind != "universal":
        raise ModelError(f"{what}: only universal joints have an axis2")
    law = None
    if drive is not None:
        if kind not in DRIVABLE_KINDS:
            raise ModelError(f"{what}: a {kind} joint can't be driven; {', '.join(DRIVABLE_KINDS)} can")
        law = time_law(drive, f"{what}: drive", scalar=True, key=f"{name}.drive")
    if kind == "distance":
        if axis is not None:
            raise ModelError(f"{what}: a distance joint has no axis")
        return _distance_joint(what, name, P, Q, anchor, law)
    if (axis is None) == (kind in KINDS_WITH_AXIS):
        raise ModelError(f"{what}: a {kind} joint {'needs an axis' if axis is None else 'has no axis'}")
    at = _joint_anchor(what, P, Q, anchor)
    n = None if axis is None else unit_vector(axis, f"{what}: axis")
    x_p, x_c = P.position(at, what), Q.position(at, what)
    gap = Vector(np.zeros(3), (x_c - x_p).parts)
    rows = pin_rows(gap) if kind in KINDS_WITH_PIN else []
    angle = travel = None
    if kind == "fixed":
        rows += _fixed_rotation_rows(P, Q, what)
    elif kind == "universal":
        assert n is not None
        rows.append(_cross_row(n, axis2, P, Q, what))
    elif n is not None:
        more, angle, travel = _guide_rows(kind, n, gap, P, Q, what)
        rows += more
    if law is not None:
        rows.append(_drive_row(kind, angle, travel, law, P, Q, what))
    return Joint(name, kind, rows, x_c, _pair_label(P, Q), angle, travel)


def _attachments(what: str, kind: str, parent: Any, child: Any) -> tuple[Attachment, Attachment]:
    """Parent and child of a joint. ModelError for an unknown kind, two grounds, or identical attachment points."""
    check_known(f"{what}: kind", kind, JOINT_KINDS)
    P, Q = make_attachment(parent, f"{what}: parent", child=False), make_attachment(child, f"{what}: child", child=True)
    if P.body is None and Q.body is None:
        raise ModelError(f"{what}: neither parent nor child is a body")
    if P.coincides_with(Q):
        raise ModelError(f"{what}: parent and child are the same place, {P.label}")
    return P, Q


def _cross_row(n: np.ndarray, axis2: Any, P: Attachment, Q: Attachment, what: str) -> ConstraintRow:
    """Perpendicular axes of a universal joint, n on the parent and axis2 on the child."""
    m = _perpendicular_to(n) if axis2 is None else unit_vector(axis2, f"{what}: axis2")
    if abs(n @ m) > 1e-6:
        raise ModelError(f"{what}: axis2 = {axis2!r} must be perpendicular to the axis")
    m = _orthogonalise(m, n)
    return _dot_row(P.direction(n, what), Q.direction(m, what))


def _guide_rows(
    kind: str, n: np.ndarray, gap: Vector, P: Attachment, Q: Attachment, what: str
) -> tuple[list[ConstraintRow], AngleVectors | None, tuple[Vector, Vector] | None]:
    """Rows of a revolute, cylindrical or translational joint besides its pin; vectors of its angle and travel."""
    u, w = _perpendicular_pair(n, P, Q)
    if P.weakness(n) + Q.weakness(u) + Q.weakness(w) <= Q.weakness(n) + P.weakness(u) + P.weakness(w):
        rows = [_dot_row(P.direction(n, what), Q.direction(d, what)) for d in (u, w)]
    else:
        rows = [_dot_row(P.direction(d, what), Q.direction(n, what)) for d in (u, w)]
    travel = None
    if kind != "revolute":
        rows += [ConstraintRow(DOT, gap, P.direction(d, what)) for d in (u, w)]
        travel = (gap, P.direction(n, what))
    if kind != "translational":
        return rows, _angle_vectors(n, u, w, P, Q, what), travel
    a, b = min(((u, w), (w, u)), key=lambda d: P.weakness(d[0]) + Q.weakness(d[1]))
    return [*rows, _dot_row(P.direction(a, what), Q.direction(b, what))], None, travel


def _drive_row(
    kind: str, angle: AngleVectors | None, travel: tuple[Vector, Vector] | None, law: TimeLaw, P: Attachment,
    Q: Attachment, what: str,
) -> ConstraintRow:  # fmt: skip
    """Row of the prescribed angle of a revolute joint, or of the travel of a translational one."""
    if kind != "revolute":
        assert travel is not None
        return ConstraintRow(DOT, *travel, law=law)
    if angle is None:
        raise ModelError(
            f"{what}: rotation angle about the axis undetermined by {P.label} and {Q.label}: give more nodes"
        )
    first, second, turned = angle
    return ConstraintRow(ANGLE, first, turned, 1.0, second, law, angular=True)


def _pair_label(P: Attachment, Q: Attachment) -> str:
    return f"{P.label} and {Q.label}"


def pin_rows(gap: Vector, law: TimeLaw | None = None) -> list[ConstraintRow]:
    """Three rows that constrain a vector to zero or the law's value."""
    options = [_right_side(law, k) for k in range(3)]
    return [ConstraintRow(DOT, gap, constant_vector(e), component=k, **options[k]) for k, e in enumerate(np.eye(3))]


def _right_side(law: TimeLaw | None, component: int = 0) -> dict[str, Any]:
    """Constant right sides are fixed: statics must not ramp them or a control."""
    if law is not None and len(law.values) == 1:
        return {"fixed": float(law.values[0, component])}
    return {"law": replace(law, ramped=False) if law is not None and law.control is not None else law}


def _dot_row(a: Vector, b: Vector) -> ConstraintRow:
    """Perpendicular directions; the cosine times the model's size is the violation."""
    return ConstraintRow(DOT, a, b, _inverse_lengths(a, b), angular=True)


def _inverse_lengths(a: Vector, b: Vector) -> float:
    return 1.0 / float(np.linalg.norm(a.value) * np.linalg.norm(b.value))


def _fixed_rotation_rows(P: Attachment, Q: Attachment, what: str) -> list[ConstraintRow]:
    """Three DP1 between two aligned triads, the pairs chosen among directions that both sides carry."""
    triads = [np.eye(3)]
    for side in (Q, P):
        if side.body is not None and side.weak_directions.any():
            _, vectors = np.linalg.eigh(side.weak_directions)
            triads.append(vectors.T)
    best = None
    for triad in triads:
        for i, j, k in itertools.permutations(range(3)):
            # either side's i, j against the other's j, k, k
            pairs = ((i, j), (i, k), (j, k))
            for flip in (False, True):
                chosen = [(b, a) if flip else (a, b) for a, b in pairs]
                cost = sum(P.weakness(triad[a]) + Q.weakness(triad[b]) for a, b in chosen)
                if best is None or cost < best[0] - 1e-9:
                    best = (cost, [(triad[a], triad[b]) for a, b in chosen])
    assert best is not None
    return [_dot_row(P.direction(a, what), Q.direction(b, what)) for a, b in best[1]]


def _perpendicular_pair(n: np.ndarray, P: Attachment, Q: Attachment) -> tuple[np.ndarray, np.ndarray]:
    """Two directions completing a right-handed triad (u, w, n), along the weakly held direction if any."""
    u = _perpendicular_to(n)
    for side in (Q, P):
        if side.body is not None and side.weak_directions.any():
            lean = side.weak_directions - np.outer(side.weak_directions @ n, n)
            values, vectors = np.linalg.eigh((lean + lean.T) / 2.0)
            first = vectors[:, -1] - (vectors[:, -1] @ n) * n
            if np.linalg.norm(first) > 1e-6:
                u = first / np.linalg.norm(first)
                break
    return u, np.cross(n, u)


def _angle_vectors(
    n: np.ndarray, u: np.ndarray, w: np.ndarray, P: Attachment, Q: Attachment, what: str
) -> AngleVectors | None:
    """Vectors (a, a2, b) of the joint angle atan2(a2.b, a.b) about n, or None."""
    options: list[Any] = []
    for first, second in ((u, w), (w, -u)):
        for pair, other, sign in ((P, Q, 1.0), (Q, P, -1.0)):  # seen from the child, the parent rotates the other way
            cost = pair.weakness(u) + pair.weakness(w) + other.weakness(first)
            options.append((round(cost, 9), len(options), pair, other, first, sign * second))
    cost, _, pair, other, first, second = min(options, key=lambda option: option[:2])
    if cost >= UNKNOWN_WEAKNESS:
        return None
    return pair.direction(first, what), pair.direction(second, what), other.direction(first, what)


def _joint_anchor(what: str, P: Attachment, Q: Attachment, anchor: Any) -> np.ndarray:
    if anchor is not None:
        return vector(anchor, f"{what}: anchor")
    at = Q.X if Q.body is not None else P.X
    if P.body is not None and Q.body is not None:
        apart = float(np.linalg.norm(P.X - Q.X))
        if apart > COINCIDENCE_TOL * max(P.size, Q.size):
            raise ModelError(
                f"{what}: {P.label} and {Q.label} are {apart:.6g} m apart: give anchor= to keep the offset, or pin "
                "both with value=(0, 0, 0) and call solve_static to close it"
            )
    return at


def _distance_joint(what: str, name: str, P: Attachment, Q: Attachment, anchor: Any, law: TimeLaw | None) -> Joint:
    ends = []
    for side in (P, Q):
        if side.body is None and np.isnan(side.X).any():
            if anchor is None:
                raise ModelError(f"{what}: missing anchor=: the end point of the rod on the ground")
            ends.append(constant_vector(vector(anchor, f"{what}: anchor")))
        else:
            ends.append(side.position(side.X, what))
    if anchor is not None and P.body is not None and Q.body is not None:
        raise ModelError(f"{what}: a distance joint between two bodies ends at their points; it has no anchor")
    row = _distance_row(what, ends[0], ends[1], law, max(P.size, Q.size))
    return Joint(name, "distance", [row], ends[1], _pair_label(P, Q))


def _distance_row(what: str, p: Vector, q: Vector, law: TimeLaw | None, size: float) -> ConstraintRow:
    gap = q - p
    length = float(np.linalg.norm(gap.value))
    if length <= COINCIDENCE_TOL * size:
        raise ModelError(f"{what}: its two points coincide, so that the distance has no direction; pin them instead")
    if law is not None and len(law.values) and law.values[:, 0].min() <= 0.0:
        raise ModelError(f"{what}: the distance must be positive, the law falls to {law.values[:, 0].min():g} m")
    if law is not None and law.control is not None and not law.control.initial[0] > 0.0:
        raise ModelError(
            f"{what}: the distance must be positive, control {law.control.name!r} begins at "
            f"{law.control.initial[0]:g} m; give it an initial value"
        )
    return ConstraintRow(
        DISTANCE, gap, constant_vector(np.zeros(3)), **(_right_side(law) if law else {"fixed": length})
    )


def _orthogonalise(m: np.ndarray, n: np.ndarray) -> np.ndarray:
    m = m - (m @ n) * n
    return m / np.linalg.norm(m)


def _perpendicular_to(n: np.ndarray) -> np.ndarray:
    """A unit vector perpendicular to n, along a global axis if n is."""
    e = np.eye(3)[int(np.argmin(np.abs(n)))]
    return _orthogonalise(e, n)


# single constraints


@dataclass(frozen=True)
class ConstraintPoints:
    """Points of a single constraint.

    Attributes:
        what: the constraint, for messages.
        attachments: the points with their bodies.
        value: right side as the user gave it, or None.
    """

    what: str
    attachments: list[Attachment]
    value: Any

    @functools.cached_property
    def x(self) -> list[Vector]:
        """Position of each point."""
        return [point.position(point.X, self.what) for point in self.attachments]

    @property
    def size(self) -> float:
        """Largest size of a body, m."""
        return max(point.size for point in self.attachments)

    @property
    def law(self) -> TimeLaw | None:
        """Right side as a scalar time law, or None."""
        return None if self.value is None else time_law(self.value, f"{self.what}: value", scalar=True)

    def right_side(self, default: float) -> dict[str, Any]:
        """Keywords of a ConstraintRow for its right side; `default` if the user gave no value."""
        law = self.law
        return {"fixed": default} if law is None else _right_side(law)


@dataclass(frozen=True)
class ConstraintKind:
    """Kind of single constraint.

    Attributes:
        points: number of points.
        rows: function of the ConstraintPoints that returns the rows; the last point carries the reaction.
    """

    points: int
    rows: Callable[[ConstraintPoints], list[ConstraintRow]]


def make_constraint(kind: str, points: Any, value: Any, name: str) -> Joint:
    """A single constraint of CONSTRAINT_KINDS between points: material points, nodes, surfaces (means), fixed points
    (3,).

    Raises:
        ModelError: an unknown kind, a wrong number of points, points that coincide where a direction is needed, or
            rows that are none.
    """
    what = f"constraint {name!r} ({kind})"
    at = ConstraintPoints(what, _constraint_points(what, kind, points), value)
    between = ", ".join(point.label for point in at.attachments)
    rows = CONSTRAINT_KINDS[kind].rows(at)
    check_rows(what, rows)
    return Joint(name, kind, rows, at.x[-1], between)


def _direction_rows(at: ConstraintPoints) -> list[ConstraintRow]:
    """DP1 and DP2: (Q - P).(T - R) = f."""
    P, Q, R, T = at.x
    a, b = Q - P, T - R
    for label, v in (("P and Q", a), ("R and T", b)):
        if np.linalg.norm(v.value) <= COINCIDENCE_TOL * at.size:
            raise ModelError(f"{at.what}: its points {label} coincide, so that it has no direction")
    return [ConstraintRow(DOT, a, b, _inverse_lengths(a, b), angular=True, **at.right_side(0.0))]


def _own_direction_rows(at: ConstraintPoints) -> list[ConstraintRow]:
    if at.attachments[2].body is not at.attachments[0].body:
        raise ModelError(f"{at.what}: its third point must be on the body of the first two; use DP1")
    return _direction_rows(at)


def _constraint_points(what: str, kind: str, points: Any) -> list[Attachment]:
    """Points of a single constraint. ModelError for an unknown kind, a wrong number, or no point on a body."""
    if kind not in CONSTRAINT_KINDS:
        raise ModelError(
            f"{what}: the kind is unknown; there are {', '.join(CONSTRAINT_KINDS)}"
            f"{did_you_mean(kind, CONSTRAINT_KINDS)}"
        )
    if not isinstance(CONSTRAINT_KINDS[kind], ConstraintKind):
        raise ModelError(
            f"{what}: CONSTRAINT_KINDS[{kind!r}] is {CONSTRAINT_KINDS[kind]!r}, no ConstraintKind; write "
            "ConstraintKind(number of points, function of them that returns rows)"
        )
    count = CONSTRAINT_KINDS[kind].points
    if not isinstance(points, (tuple, list)) or len(points) != count:
        raise ModelError(f"{what}: points must be {count} points, got {points!r}")
    attachments = []
    for k, point in enumerate(points):
        if isinstance(point, Ground):
            raise ModelError(f"{what}: a point of the ground is given by its place (x, y, z)")
        attachments.append(make_attachment(point, f"{what}: point {k + 1}", child=k == count - 1))
    first, last = attachments[0], attachments[-1]
    if count == 4 and attachments[2].body is last.body is not first.body:
        attachments[2] = replace(attachments[2], child=True)  # DP1 acts on the last point's body with a couple
    if all(p.body is None for p in attachments):
        raise ModelError(f"{what}: none of its points belongs to a body")
    return attachments


def _coincidence_rows(at: ConstraintPoints) -> list[ConstraintRow]:
    """Rows of P - Q = value, or of coincident points. ModelError for distinct points without a value."""
    P, Q = at.x
    gap = P - Q
    if at.value is not None:
        return pin_rows(gap, time_law(at.value, f"{at.what}: value"))
    apart = float(np.linalg.norm(gap.value))
    if apart > COINCIDENCE_TOL * at.size:
        raise ModelError(
            f"{at.what}: its points are {apart:.6g} m apart in the reference; value=(x, y, z) prescribes P - Q"
        )
    return pin_rows(Vector(np.zeros(3), gap.parts))


CONSTRAINT_KINDS = {
    "DP1": ConstraintKind(4, _direction_rows),
    "DP2": ConstraintKind(4, _own_direction_rows),
    "DIST": ConstraintKind(2, lambda at: [_distance_row(at.what, at.x[0], at.x[1], at.law, at.size)]),
    "PIN": ConstraintKind(2, _coincidence_rows),
}
"""Kinds of single constraints; another is an entry here."""
