"""Joint attachment points: position and local deformation gradient of a body or the ground."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..model import assembly
from ..model.description import support_slots
from ..model.discretisation import Discretisation
from ..model.handles import MaterialPoint, NodeSet, SurfaceSet
from ..model.joints import Vector, VectorPart, constant_vector
from ..model.rigid import RigidBody
from .checks import vector

__all__ = ["COINCIDENCE_TOL", "GROUND", "UNKNOWN_WEAKNESS", "Attachment", "Ground", "as_point", "make_attachment"]

COINCIDENCE_TOL = 1e-9
"""Distance of coincident points, relative to the size of their bodies."""
FLAT_SURFACE, FLAT_NODES = 1e-2, 1e-3
"""Variance of points across their plane, over that in it, below which the normal's rotation is undetermined by a
fit.
"""
FACE_NORMAL_WEAKNESS = 0.5
"""Weakness of the normal of a solid's face."""
UNKNOWN_WEAKNESS = 10.0
"""Weakness of a direction whose rotation is not determined."""


class Ground:
    """The fixed ground; `warpfea.GROUND`."""

    def __repr__(self) -> str:
        return "GROUND"


GROUND = Ground()


@dataclass(frozen=True, eq=False)
class Attachment:
    """Attachment point on a body or the ground, with the local affine motion x + F (Y - X).

    Attributes:
        body: None for the ground.
        X: (3,) reference position, m.
        slots, weights, gradients: (n,), (n,), (n, 3): x = sum weights e, F = sum e gradients^T.
        known_directions: (3, 3) projector on the directions n with known F n.
        weak_directions: (3, 3) projector on those that a point constrains with almost no stiffness: a beam's axis,
            a shell's tangents; in part (`FACE_NORMAL_WEAKNESS`) the normal of a solid's face.
        label: for messages.
        child: the joint's child side.
    """

    body: Discretisation | None
    X: np.ndarray
    slots: np.ndarray
    weights: np.ndarray
    gradients: np.ndarray
    known_directions: np.ndarray
    weak_directions: np.ndarray
    label: str
    child: bool

    def position(self, at: np.ndarray, what: str) -> Vector:
        """Current position x + F (at - X) of the reference point `at` (3,), m."""
        arm = at - self.X
        if self.body is None:
            return constant_vector(at)
        weights = self.weights
        if np.linalg.norm(arm) > COINCIDENCE_TOL * self.size:
            self._check(arm / np.linalg.norm(arm), what)
            weights = weights + self.gradients @ arm
        return Vector(at, (VectorPart(self.body, self.slots, weights, self.child),))

    def direction(self, n: np.ndarray, what: str) -> Vector:
        """Material direction F n of the reference direction n (3,)."""
        if self.body is None:
            return constant_vector(n)
        self._check(n, what)
        return Vector(n, (VectorPart(self.body, self.slots, self.gradients @ n, self.child),))

    def _check(self, n: np.ndarray, what: str) -> None:
        lost = np.linalg.norm(n - self.known_directions @ n)
        if lost > 1e-6:
            raise ModelError(
                f"{what}: {self.label} does not determine the rotation of direction {np.round(n, 6).tolist()}: give "
                "a surface, a material point, or more nodes"
            )

    def weakness(self, n: np.ndarray) -> float:
        """0 for a direction carried by the section, director or solid, 1 for others; 10: not known."""
        if self.body is None:
            return 0.0
        unknown = np.linalg.norm(n - self.known_directions @ n) > 1e-6
        return float(np.linalg.norm(self.weak_directions @ n) + UNKNOWN_WEAKNESS * unknown)

    @property
    def size(self) -> float:
        """Diagonal of the body's bounding box, m; 0 for the ground."""
        if self.body is None:
            return 0.0
        low, high = self.body.mesh.bounding_box()
        return float(np.linalg.norm(np.asarray(high) - np.asarray(low)))

    def coincides_with(self, other: Attachment) -> bool:
        """True if both are the same point of the same body."""
        same = np.array_equal(self.slots, other.slots) and np.array_equal(self.weights, other.weights)
        return same and self.body is not None and self.body is other.body


def as_point(thing: Any) -> Any:
    """Nodes or a surface of a rigid part as the point of their mean; other things as they are."""
    if isinstance(thing, (NodeSet, SurfaceSet)) and isinstance(thing.body, RigidBody):
        return thing.body.mean_point(thing)
    return thing


def make_attachment(thing: Any, what: str, *, child: bool) -> Attachment:
    """Attachment of a handle, or of a fixed point (3,). ModelError for anything else."""
    no_slots = np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 3))
    thing = as_point(thing)
    if isinstance(thing, Ground):
        return Attachment(None, np.full(3, np.nan), *no_slots, np.eye(3), np.zeros((3, 3)), "the ground", child)
    if isinstance(thing, MaterialPoint):
        label = f"the point {np.round(thing.X, 6).tolist()} of body {thing.body.name!r}"
        weak = _weak_projector(thing.body, thing.axes)
        motion = thing.slots, thing.weights, thing.gradients
        return Attachment(thing.body, thing.X, *motion, np.eye(3), weak, label, child)
    if isinstance(thing, NodeSet):
        return _node_attachment(thing, child)
    if isinstance(thing, SurfaceSet):
        return _surface_attachment(thing, child)
    if isinstance(thing, (tuple, list, np.ndarray)):
        return Attachment(None, vector(thing, what), *no_slots, np.eye(3), np.zeros((3, 3)), "a fixed point", child)
    raise ModelError(
        f"{what}: expected wf.GROUND, body.at(X), body.nodes(...), body.surface(...), beam.start or beam.end, got "
        f"{thing!r}"
    )


def _weak_projector(body: Discretisation, axes: np.ndarray) -> np.ndarray:
    """Projector on the axes (columns) outside a beam's section or a shell's director."""
    if body.family.solid:
        return np.zeros((3, 3))
    columns = axes[:, : 3 - body.family.spin_vectors]
    return columns @ columns.T


def _affine_fit(weights: np.ndarray, X: np.ndarray, flat: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Affine least-squares fit of points X (n, 3): mean (3,), gradients (n, 3), projector on their span."""
    mean = weights @ X
    arm = X - mean
    C = arm.T @ (weights[:, None] * arm)
    values, vectors = np.linalg.eigh(C)
    good = vectors[:, values > flat * max(values.max(), 1e-300)]
    good = good if values.max() > 0.0 else good[:, :0]
    inverse = good @ np.diag(1.0 / np.diag(good.T @ C @ good)) @ good.T if good.size else np.zeros((3, 3))
    return mean, weights[:, None] * arm @ inverse, good @ good.T


def _node_attachment(nodes: NodeSet, child: bool) -> Attachment:
    """Mean of the nodes and their best-fit affine motion; directions off their span by their gradient slots."""
    body = nodes.body
    label = f"nodes {nodes.name!r} of body {body.name!r}" if nodes.name else f"{len(nodes)} nodes of body {body.name!r}"
    position = support_slots(nodes, "position")
    X = body.reference[position] + body.origin
    weights = np.full(len(position), 1.0 / len(position))
    mean, gradients, span = _affine_fit(weights, X, FLAT_NODES)
    weak = np.zeros((3, 3))
    full = nodes.indices[body.node_slot_count[nodes.indices] == 4]
    if len(full) and np.linalg.norm(span - np.eye(3)) > 1e-9:
        slots = body.node_slot[full][:, None] + np.arange(1, 4)
        axes = body.reference[slots]  # (n, slot, 3): e_k = F a_k
        rest = np.eye(3) - span
        position = np.concatenate([position, slots.ravel()])
        weights = np.concatenate([weights, np.zeros(slots.size)])
        gradients = np.concatenate([gradients, axes.reshape(-1, 3) @ rest / len(full)])
        weak = rest @ _weak_projector(body, axes[0].T) @ rest
        span = np.eye(3)
    return Attachment(body, mean, position, weights, gradients, span, weak, label, child)


def _surface_attachment(surface: SurfaceSet, child: bool) -> Attachment:
    """Area mean of a surface; in its plane the best-fit affine motion, across it the mean of F."""
    body = surface.body
    label = f"surface {surface.name!r} of body {body.name!r}" if surface.name else f"a surface of body {body.name!r}"
    t = assembly.facet_tables(surface)
    X, dA = assembly.facet_positions(body, t), assembly.facet_areas(body, t)
    share = (dA / dA.sum()).ravel()
    X = X.reshape(-1, 3)
    mean, at_points, span = _affine_fit(share, X, FLAT_SURFACE)
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
            _, ds, J, _ = assembly.shape_and_jacobian(body, members, xi)
            h = np.einsum("fq,fqsk->fsk", dA[rows] / dA.sum(), assembly.shape_gradients(ds, J)) @ rest
            np.add.at(gradients, body.connectivity[members], h)
            weak = rest @ _weak_projector(body, assembly.orthonormal(J[0, 0])) @ rest
        if body.family.solid:  # the mean of F normal to a face includes the local strain; the in-plane fit does not
            weak = FACE_NORMAL_WEAKNESS * rest
    slots = np.flatnonzero((weights != 0.0) | gradients.any(axis=1))
    return Attachment(body, mean, slots, weights[slots], gradients[slots], np.eye(3), weak, label, child)
