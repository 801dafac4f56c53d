"""Joints as compositions of DP1, DP2, DIST and PIN (Paper I, section 5.4) that place their own points and axes.

    spherical      PIN                     translational  3 DP1 + 2 DP2
    universal      PIN + DP1               fixed          PIN + 3 DP1
    revolute       PIN + 2 DP1             distance       DIST
    cylindrical    2 DP1 + 2 DP2

A material direction n of a body is F n, linear in the slots, in place of a chord between two points.
"""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..kernels.terms.constraints import DISTANCE, DOT, TURN
from ..laws import TimeLaw, time_law
from ..model import assembly
from ..model.bodies import Body
from ..model.description import support_slots
from ..model.handles import MaterialPoint, NodeSet, SurfaceSet
from ..model.joints import Joint, Part, Row, Vector, constant
from .checks import vector

__all__ = ["GROUND", "JOINTS", "Ground", "attach", "make_constraint", "make_joint", "pin_rows"]

JOINTS = ("spherical", "universal", "revolute", "cylindrical", "translational", "fixed", "distance")
NEEDS_AXIS = ("universal", "revolute", "cylindrical", "translational")
DRIVEN = ("revolute", "translational", "distance")
COINCIDENT = 1e-9
"""Distance of places that are one, over the size of their bodies."""
FLAT_SURFACE, FLAT_NODES = 1e-2, 1e-3
"""Variance of places across their plane, over that in it, below which a fit does not tell how its normal turns."""
ACROSS = 0.5
UNKNOWN = 10.0
CONSTRAINTS = {"DP1": 4, "DP2": 4, "DIST": 2, "PIN": 2}


class Ground:
    """The world that does not move; `warpfea.GROUND`."""

    def __repr__(self) -> str:
        return "GROUND"


GROUND = Ground()


@dataclass(frozen=True, eq=False)
class Attachment:
    """A place on a body, or on the ground, with the affine motion around it: x + F (Y - X).

    Attributes:
        body: None for the ground.
        X: (3,) reference position, m.
        slots, weights, gradients: (n,), (n,), (n, 3): x = sum weights e, F = sum e gradients^T.
        known: (3, 3) projector on the directions n for which F n is known.
        weak: (3, 3) projector on those that bend at a point for next to nothing: a beam's axis, a shell's tangents;
            less (`ACROSS`) of a solid's face.
        label: for messages.
        child: the joint's child side.
    """

    body: Body | None
    X: np.ndarray
    slots: np.ndarray
    weights: np.ndarray
    gradients: np.ndarray
    known: np.ndarray
    weak: np.ndarray
    label: str
    child: bool

    def position(self, at: np.ndarray, what: str) -> Vector:
        """The place of the point that is at `at` (3,) in the reference; off X it is carried along by F."""
        arm = at - self.X
        if self.body is None:
            return constant(at)
        weights = self.weights
        if np.linalg.norm(arm) > COINCIDENT * self.size:
            self._check(arm / np.linalg.norm(arm), what)
            weights = weights + self.gradients @ arm
        return Vector(at, (Part(self.body, self.slots, weights, self.child),))

    def direction(self, n: np.ndarray, what: str) -> Vector:
        """F n."""
        if self.body is None:
            return constant(n)
        self._check(n, what)
        return Vector(n, (Part(self.body, self.slots, self.gradients @ n, self.child),))

    def _check(self, n: np.ndarray, what: str) -> None:
        lost = np.linalg.norm(n - self.known @ n)
        if lost > 1e-6:
            raise ModelError(
                f"{what}: {self.label} does not tell how the direction {np.round(n, 6).tolist()} turns; give a "
                "surface, a material point, or more nodes that span it"
            )

    def weakness(self, n: np.ndarray) -> float:
        """0 for a direction that the section, director or solid carries, 1 for one that it does not; 10: not known."""
        if self.body is None:
            return 0.0
        return float(np.linalg.norm(self.weak @ n) + UNKNOWN * (np.linalg.norm(n - self.known @ n) > 1e-6))

    @property
    def size(self) -> float:
        """Diagonal of the body's box, m; 0 of the ground."""
        if self.body is None:
            return 0.0
        low, high = self.body.mesh.bounding_box()
        return float(np.linalg.norm(np.asarray(high) - np.asarray(low)))

    def same_as(self, other: Attachment) -> bool:
        """Whether both are the same place of the same body."""
        return (
            self.body is not None
            and self.body is other.body
            and np.array_equal(self.slots, other.slots)
            and np.array_equal(self.weights, other.weights)
        )


def attach(thing: Any, what: str, *, child: bool) -> Attachment:
    """The attachment of a handle, or of a fixed place (3,). ModelError for anything else."""
    all_known, none_weak = np.eye(3), np.zeros((3, 3))
    if isinstance(thing, Ground):
        return Attachment(None, np.full(3, np.nan), *_none(), all_known, none_weak, "the ground", child)
    if isinstance(thing, MaterialPoint):
        label = f"the point {np.round(thing.X, 6).tolist()} of body {thing.body.name!r}"
        weak = _weak(thing.body, thing.axes)
        return Attachment(
            thing.body, thing.X, thing.slots, thing.weights, thing.gradients, all_known, weak, label, child
        )
    if isinstance(thing, NodeSet):
        return _of_nodes(thing, child)
    if isinstance(thing, SurfaceSet):
        return _of_surface(thing, child)
    if isinstance(thing, (tuple, list, np.ndarray)):
        return Attachment(None, vector(thing, what), *_none(), all_known, none_weak, "a fixed point", child)
    raise ModelError(
        f"{what}: expected wf.GROUND, body.at(X), body.nodes(...), body.surface(...), beam.start or beam.end, got "
        f"{thing!r}"
    )


def _none() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    return np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 3))


def _weak(body: Body, axes: np.ndarray) -> np.ndarray:
    """Projector on the axes (columns) that do not belong to a beam's section or a shell's director."""
    if body.family.solid:
        return np.zeros((3, 3))
    columns = axes[:, : 3 - body.family.spin_vectors]
    return columns @ columns.T


def _fit(weights: np.ndarray, X: np.ndarray, flat: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Affine least-squares fit of points X (n, 3): mean (3,), gradients (n, 3), projector on what they span."""
    mean = weights @ X
    arm = X - mean
    C = arm.T @ (weights[:, None] * arm)
    values, vectors = np.linalg.eigh(C)
    good = vectors[:, values > flat * max(values.max(), 1e-300)]
    good = good if values.max() > 0.0 else good[:, :0]
    inverse = good @ np.diag(1.0 / np.diag(good.T @ C @ good)) @ good.T if good.size else np.zeros((3, 3))
    return mean, weights[:, None] * arm @ inverse, good @ good.T


def _of_nodes(nodes: NodeSet, child: bool) -> Attachment:
    """Mean of the nodes and the best affine motion of them; directions off their span by their gradient slots."""
    body = nodes.body
    label = f"nodes {nodes.name!r} of body {body.name!r}" if nodes.name else f"{len(nodes)} nodes of body {body.name!r}"
    position = support_slots(nodes, "position")
    X = body.reference[position] + body.origin
    weights = np.full(len(position), 1.0 / len(position))
    mean, gradients, span = _fit(weights, X, FLAT_NODES)
    weak = np.zeros((3, 3))
    full = nodes.indices[body.node_slot_count[nodes.indices] == 4]
    if len(full) and np.linalg.norm(span - np.eye(3)) > 1e-9:
        slots = body.node_slot[full][:, None] + np.arange(1, 4)
        axes = body.reference[slots]  # (n, slot, 3): e_k = F a_k
        rest = np.eye(3) - span
        position = np.concatenate([position, slots.ravel()])
        weights = np.concatenate([weights, np.zeros(slots.size)])
        gradients = np.concatenate([gradients, axes.reshape(-1, 3) @ rest / len(full)])
        weak = rest @ _weak(body, axes[0].T) @ rest
        span = np.eye(3)
    return Attachment(body, mean, position, weights, gradients, span, weak, label, child)


def _of_surface(surface: SurfaceSet, child: bool) -> Attachment:
    """Area mean of a surface; in its plane the best affine motion, across it the mean of F."""
    body = surface.body
    label = f"surface {surface.name!r} of body {body.name!r}" if surface.name else f"a surface of body {body.name!r}"
    t = assembly.facet_tables(surface)
    X, dA = assembly.facet_places(body, t)
    share = (dA / dA.sum()).ravel()
    X = X.reshape(-1, 3)
    mean, at_points, span = _fit(share, X, FLAT_SURFACE)
    n = body.slot_count
    weights, gradients = np.zeros(n), np.zeros((n, 3))
    np.add.at(weights, t.conn, np.einsum("fq,fqi->fi", dA / dA.sum(), t.shape))
    np.add.at(gradients, t.conn, np.einsum("fqk,fqi->fik", at_points.reshape(*dA.shape, 3), t.shape))
    weak = np.zeros((3, 3))
    rest = np.eye(3) - span
    if np.linalg.norm(rest) > 1e-9:
        rule = body.family.face_rule
        for face in np.unique(surface.faces[:, 1]):
            rows = np.flatnonzero(surface.faces[:, 1] == face)
            members = surface.faces[rows, 0]
            xi, _ = body.family.face_points(int(face), rule.points)
            _, ds, J, _ = assembly.geometry(body, members, xi)
            h = np.einsum("fq,fqsk->fsk", dA[rows] / dA.sum(), assembly.gradients(ds, J)) @ rest
            np.add.at(gradients, body.connectivity[members], h)
            weak = rest @ _weak(body, assembly.orthonormal(J[0, 0])) @ rest
        if body.family.solid:  # the mean of F across a face feels the strain at it, the fit in its plane does not
            weak = ACROSS * rest
    slots = np.flatnonzero((weights != 0.0) | gradients.any(axis=1))
    return Attachment(body, mean, slots, weights[slots], gradients[slots], np.eye(3), weak, label, child)


# joints


def make_joint(
    kind: str, parent: Any, child: Any, anchor: Any, axis: Any, axis2: Any, drive: Any, name: str
) -> Joint:  # fmt: skip
    """Compose a joint. Raises ModelError naming the joint and what is wrong."""
    what = f"joint {name!r}"
    if kind not in JOINTS:
        raise ModelError(f"{what}: kind {kind!r} is unknown; there are {', '.join(JOINTS)}")
    P, Q = attach(parent, f"{what}: parent", child=False), attach(child, f"{what}: child", child=True)
    if P.body is None and Q.body is None:
        raise ModelError(f"{what}: neither parent nor child is a body")
    if P.same_as(Q):
        raise ModelError(f"{what}: parent and child are the same place, {P.label}")
    if axis2 is not None and kind != "universal":
        raise ModelError(f"{what}: only universal joints have an axis2")
    law = None
    if drive is not None:
        if kind not in DRIVEN:
            raise ModelError(f"{what}: a {kind} joint can't be driven; {', '.join(DRIVEN)} can")
        law = time_law(drive, f"{what}: drive", scalar=True)
    if kind == "distance":
        if axis is not None:
            raise ModelError(f"{what}: a distance joint has no axis")
        return _distance(what, name, P, Q, anchor, law)
    if (axis is None) == (kind in NEEDS_AXIS):
        raise ModelError(f"{what}: a {kind} joint {'needs an axis' if axis is None else 'has no axis'}")
    at = _anchor(what, P, Q, anchor)
    n = None if axis is None else _unit(axis, f"{what}: axis")
    x_p, x_c = P.position(at, what), Q.position(at, what)
    gap = Vector(np.zeros(3), (x_c - x_p).parts)
    rows: list[Row] = []
    angle = travel = None
    if kind in ("spherical", "universal", "revolute", "fixed"):
        rows += pin_rows(gap)
    if kind == "universal":
        assert n is not None
        m = _perpendicular(n) if axis2 is None else _unit(axis2, f"{what}: axis2")
        if abs(n @ m) > 1e-6:
            raise ModelError(f"{what}: axis2 = {axis2!r} must be perpendicular to the axis")
        m = _orthogonal(m, n)
        rows.append(_dp(P.direction(n, what), Q.direction(m, what)))
    elif kind == "fixed":
        rows += _locked(P, Q, what)
    elif kind in ("revolute", "cylindrical", "translational"):
        assert n is not None
        u, w = _pair(n, P, Q)
        if P.weakness(n) + Q.weakness(u) + Q.weakness(w) <= Q.weakness(n) + P.weakness(u) + P.weakness(w):
            rows += [_dp(P.direction(n, what), Q.direction(d, what)) for d in (u, w)]
        else:
            rows += [_dp(P.direction(d, what), Q.direction(n, what)) for d in (u, w)]
        if kind != "revolute":
            rows += [Row(DOT, gap, P.direction(d, what)) for d in (u, w)]
            travel = (gap, P.direction(n, what))
        if kind == "translational":
            a, b = min(((u, w), (w, u)), key=lambda d: P.weakness(d[0]) + Q.weakness(d[1]))
            rows.append(_dp(P.direction(a, what), Q.direction(b, what)))
        else:
            angle = _angle(n, u, w, P, Q, what)
    if law is not None and kind == "revolute":
        if angle is None:
            raise ModelError(f"{what}: {P.label} and {Q.label} do not tell the angle about the axis; give more nodes")
        first, second, turned = angle
        rows.append(Row(TURN, first, turned, 1.0, second, law, angular=True))
    elif law is not None and travel is not None:
        rows.append(Row(DOT, *travel, law=law))
    return Joint(name, kind, rows, x_c, _between(P, Q), angle, travel)


def _between(P: Attachment, Q: Attachment) -> str:
    return f"{P.label} and {Q.label}"


def pin_rows(gap: Vector, law: TimeLaw | None = None) -> list[Row]:
    """Three rows that hold a vector at zero or at the law's value."""
    options = [_right_side(law, k) for k in range(3)]
    return [Row(DOT, gap, constant(e), component=k, **options[k]) for k, e in enumerate(np.eye(3))]


def _right_side(law: TimeLaw | None, component: int = 0) -> dict[str, Any]:
    """A constant is fixed: statics must not ramp it, as it does laws."""
    if law is not None and len(law.values) == 1:
        return {"fixed": float(law.values[0, component])}
    return {"law": law}


def _dp(a: Vector, b: Vector) -> Row:
    """Perpendicular directions; the cosine times the model's size is the violation."""
    return Row(DOT, a, b, _scale(a, b), angular=True)


def _scale(a: Vector, b: Vector) -> float:
    return 1.0 / float(np.linalg.norm(a.value) * np.linalg.norm(b.value))


def _locked(P: Attachment, Q: Attachment, what: str) -> list[Row]:
    """Three DP1 between two triads that agree, the pairs chosen among directions that both sides carry."""
    triads = [np.eye(3)]
    for side in (Q, P):
        if side.body is not None and side.weak.any():
            _, vectors = np.linalg.eigh(side.weak)
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
    return [_dp(P.direction(a, what), Q.direction(b, what)) for a, b in best[1]]


def _pair(n: np.ndarray, P: Attachment, Q: Attachment) -> tuple[np.ndarray, np.ndarray]:
    """Two directions that make a right-handed triad (u, w, n) with the axis, along a body's weak one where there is."""
    u = _perpendicular(n)
    for side in (Q, P):
        if side.body is not None and side.weak.any():
            lean = side.weak - np.outer(side.weak @ n, n)
            values, vectors = np.linalg.eigh((lean + lean.T) / 2.0)
            first = vectors[:, -1] - (vectors[:, -1] @ n) * n
            if np.linalg.norm(first) > 1e-6:
                u = first / np.linalg.norm(first)
                break
    return u, np.cross(n, u)


def _angle(
    n: np.ndarray, u: np.ndarray, w: np.ndarray, P: Attachment, Q: Attachment, what: str
) -> tuple[Vector, Vector, Vector] | None:
    """Vectors (a, a2, b): the child has turned about n by the angle of b from a towards a2; None: not known."""
    options: list[Any] = []
    for first, second in ((u, w), (w, -u)):
        for pair, other, sign in ((P, Q, 1.0), (Q, P, -1.0)):  # seen from the child, the parent turns the other way
            cost = pair.weakness(u) + pair.weakness(w) + other.weakness(first)
            options.append((round(cost, 9), len(options), pair, other, first, sign * second))
    cost, _, pair, other, first, second = min(options, key=lambda option: option[:2])
    if cost >= UNKNOWN:
        return None
    return pair.direction(first, what), pair.direction(second, what), other.direction(first, what)


def _anchor(what: str, P: Attachment, Q: Attachment, anchor: Any) -> np.ndarray:
    if anchor is not None:
        return vector(anchor, f"{what}: anchor")
    at = Q.X if Q.body is not None else P.X
    if P.body is not None and Q.body is not None:
        apart = float(np.linalg.norm(P.X - Q.X))
        if apart > COINCIDENT * max(P.size, Q.size):
            raise ModelError(
                f"{what}: {P.label} and {Q.label} are {apart:.6g} m apart; say where: anchor=, which keeps the gap (to "
                "close it, pin both with value=(0, 0, 0) and call solve_static)"
            )
    return at


def _distance(what: str, name: str, P: Attachment, Q: Attachment, anchor: Any, law: TimeLaw | None) -> Joint:
    ends = []
    for side in (P, Q):
        if side.body is None and np.isnan(side.X).any():
            if anchor is None:
                raise ModelError(f"{what}: say where on the ground the rod ends: anchor=")
            ends.append(constant(vector(anchor, f"{what}: anchor")))
        else:
            ends.append(side.position(side.X, what))
    if anchor is not None and P.body is not None and Q.body is not None:
        raise ModelError(f"{what}: a distance joint between two bodies ends at their points; it has no anchor")
    return Joint(name, "distance", [_dist(what, ends[0], ends[1], law, max(P.size, Q.size))], ends[1], _between(P, Q))


def _dist(what: str, p: Vector, q: Vector, law: TimeLaw | None, size: float) -> Row:
    gap = q - p
    length = float(np.linalg.norm(gap.value))
    if length <= COINCIDENT * size:
        raise ModelError(f"{what}: its two points coincide, so that the distance has no direction; pin them instead")
    if law is not None and len(law.values) and law.values[:, 0].min() <= 0.0:
        raise ModelError(f"{what}: the distance must be positive, the law falls to {law.values[:, 0].min():g} m")
    return Row(DISTANCE, gap, constant(np.zeros(3)), **(_right_side(law) if law else {"fixed": length}))


def _unit(value: Any, what: str) -> np.ndarray:
    n = vector(value, what)
    size = np.linalg.norm(n)
    if not size > 0.0:
        raise ModelError(f"{what} is zero")
    return n / size


def _orthogonal(m: np.ndarray, n: np.ndarray) -> np.ndarray:
    m = m - (m @ n) * n
    return m / np.linalg.norm(m)


def _perpendicular(n: np.ndarray) -> np.ndarray:
    """A unit vector perpendicular to n, along a global axis where n is."""
    e = np.eye(3)[int(np.argmin(np.abs(n)))]
    return _orthogonal(e, n)


# single constraints


def make_constraint(kind: str, points: Any, value: Any, name: str) -> Joint:
    """A single DP1, DP2, DIST or PIN between points: material points, nodes, surfaces (means), places in space (3,).

    Raises:
        ModelError: an unknown kind, a wrong number of points, or points that coincide where a direction is needed.
    """
    what = f"constraint {name!r} ({kind})"
    if kind not in CONSTRAINTS:
        raise ModelError(f"{what}: the kind is unknown; there are {', '.join(CONSTRAINTS)}")
    count = CONSTRAINTS[kind]
    if not isinstance(points, (tuple, list)) or len(points) != count:
        raise ModelError(f"{what}: points must be {count} points, got {points!r}")
    places = []
    for k, point in enumerate(points):
        if isinstance(point, Ground):
            raise ModelError(f"{what}: a point of the ground is given by its place (x, y, z)")
        places.append(attach(point, f"{what}: point {k + 1}", child=k == count - 1))
    first, last = places[0], places[-1]
    if count == 4 and places[2].body is last.body is not first.body:
        places[2] = replace(places[2], child=True)  # DP1 acts on the last point's body with a couple
    size = max(p.size for p in places)
    if all(p.body is None for p in places):
        raise ModelError(f"{what}: none of its points belongs to a body")
    x = [p.position(p.X, what) for p in places]
    between = ", ".join(p.label for p in places)
    if kind == "PIN":
        law = None if value is None else time_law(value, f"{what}: value")
        gap = x[0] - x[1]
        apart = float(np.linalg.norm(gap.value))
        if law is None:
            if apart > COINCIDENT * size:
                raise ModelError(
                    f"{what}: its points are {apart:.6g} m apart in the reference; value=(x, y, z) prescribes P - Q"
                )
            gap = Vector(np.zeros(3), gap.parts)
        return Joint(name, kind, pin_rows(gap, law), x[1], between)
    law = None if value is None else time_law(value, f"{what}: value", scalar=True)
    if kind == "DIST":
        return Joint(name, kind, [_dist(what, x[0], x[1], law, size)], x[1], between)
    a, b = x[1] - x[0], x[3] - x[2]
    if kind == "DP2" and places[2].body is not places[0].body:
        raise ModelError(f"{what}: its third point must be on the body of the first two; use DP1")
    for label, v in (("P and Q", a), ("R and T", b)):
        if np.linalg.norm(v.value) <= COINCIDENT * size:
            raise ModelError(f"{what}: its points {label} coincide, so that it has no direction")
    return Joint(name, kind, [Row(DOT, a, b, _scale(a, b), angular=True, **_right_side(law))], x[3], between)
