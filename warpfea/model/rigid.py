"""Rigid parts: affine motion x = r + A (X - X_c) with A^T A = I, moments of inertia of closed surfaces and shapes."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from scipy.spatial import cKDTree

from ..kernels.terms.constraints import DOT
from . import assembly
from .bodies import Body, point_coordinates
from .handles import MaterialPoint, NodeSet, SurfaceSet
from .joints import ConstraintRow, Joint, Vector, VectorPart
from .shapes import Box, Capsule, Cylinder, Shape, Sphere
from .surfaces import Skin

__all__ = ["RigidBody", "surface_moments", "volume_moments"]


@dataclass(eq=False, repr=False)
class RigidBody(Body):
    """Rigid part. Made by ModelBuilder.add_rigid.

    Twelve coordinates, the positions of four points, give x = r + A (X - X_c), and the angular velocity of Eq. (12) by
    A^T dA/dt. Six constraints a_i . a_j = delta_ij on the columns of A keep it a rotation. The mass is constant; where
    the inertia allows it the points carry a quarter of it each (an equimomental system). Four positions, unlike one
    and three gradients, have one unit, and all resist in statics. The cells of the mesh are cones from the centre of
    mass to the triangles of the surface.

    Attributes:
        com: (3,) centre of mass, m.
        moments: (4, 4) volume, and second moments of volume about the centre (of the mass, over the density).
        corners: (4,) mesh nodes that are the four points.
        elastic: a material for contact was given.
        shape: what it was made from.
    """

    com: np.ndarray = field(kw_only=True)
    moments: np.ndarray = field(kw_only=True)
    corners: np.ndarray = field(kw_only=True)
    elastic: bool = field(kw_only=True)
    shape: Any = field(kw_only=True, default=None)

    def __repr__(self) -> str:
        return f"RigidBody({self.name!r}, {self.mass:.4g} kg)"

    @property
    def mass(self) -> float:
        """Mass as built, kg."""
        return float(self.moments[0, 0] * self.materials[0][1].density)

    @property
    def inertia(self) -> np.ndarray:
        """(3, 3) tensor of inertia about the centre of mass in the reference, as built, kg m^2."""
        second = self.moments[1:, 1:] * self.materials[0][1].density
        return np.asarray(np.trace(second) * np.eye(3) - second)

    @property
    def affine(self) -> np.ndarray:
        """(4, 4) B: weights of the four points at X are [1, X - com] B."""
        assert self.frames is not None
        return np.asarray(self.frames[0, :4])

    @property
    def scalar_mass(self) -> sp.csr_matrix:
        """(4, 4) mass matrix over the density; entries below round-off are zero."""
        matrix = self.affine.T @ self.moments @ self.affine
        return sp.csr_matrix(np.where(np.abs(matrix) > 1e-14 * np.abs(matrix).max(), matrix, 0.0))

    # numbering: four slots whatever the mesh

    @cached_property
    def origin(self) -> np.ndarray:
        """(3,) centre of mass, m; positions on the device are relative to it."""
        return self.com

    @cached_property
    def node_slot_count(self) -> np.ndarray:
        return np.isin(np.arange(len(self.mesh.points)), self.corners).astype(np.int64)

    @cached_property
    def node_slot(self) -> np.ndarray:
        out = np.full(len(self.mesh.points), -1)
        out[self.corners] = np.arange(4)
        return out

    @cached_property
    def connectivity(self) -> np.ndarray:
        return np.tile(np.arange(4), (len(self.mesh.cells), 1))

    @cached_property
    def slot_node(self) -> np.ndarray:
        return self.corners

    @cached_property
    def surface_nodes(self) -> np.ndarray:
        return np.unique(self.mesh.cells[:, :3])

    def at_nodes(self, values: np.ndarray) -> np.ndarray:
        """Values (..., nodes, 3) at all points of the mesh from those of the four points (..., 4, 3)."""
        arms = self.mesh.points - self.com
        return np.asarray((np.column_stack([np.ones(len(arms)), arms]) @ self.affine) @ values)

    def node_functions(self, node: int) -> tuple[np.ndarray, np.ndarray]:
        point = self.point(self.mesh.points[node])
        return point.slots, point.weights

    @cached_property
    def element_order(self) -> np.ndarray:
        """The first element alone: F is the same in all."""
        return np.zeros(1, dtype=np.int64)

    @cached_property
    def rigid_depth(self) -> float:
        surface = SurfaceSet(self, self.boundary)
        area = float(assembly.facet_areas(self, assembly.facet_tables(surface)).sum())
        return 3.0 * float(self.moments[0, 0]) / area

    # points

    def at(self, X: Any) -> MaterialPoint:
        """The point at the reference position X (3,), m, also outside of the surface."""
        return self.point(point_coordinates(self, X))

    def point(self, X: np.ndarray) -> MaterialPoint:
        """The point at X (3,), m."""
        B = self.affine
        return MaterialPoint(self, np.arange(4), np.append(1.0, X - self.com) @ B, X, B[1:].T.copy(), np.eye(3), 0)

    def mean_point(self, handle: NodeSet | SurfaceSet) -> MaterialPoint:
        """The mean of nodes, or the area mean of a surface: exact for an affine motion."""
        if isinstance(handle, NodeSet):
            return self.point(self.mesh.points[handle.indices].mean(axis=0))
        corners = self.mesh.points[handle.nodes[:, :3]]
        area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
        return self.point(area @ corners.mean(axis=1) / area.sum())

    def render_skin(self, points: np.ndarray, triangles: np.ndarray, distance: float | None, what: str) -> Skin:
        """Any surface; fields are those of the next node of the part's own."""
        weights = np.column_stack([np.ones(len(points)), points - self.com]) @ self.affine
        nodes = self.surface_nodes[cKDTree(self.mesh.points[self.surface_nodes]).query(points)[1]]
        fields = sp.csr_matrix(
            (np.ones(len(nodes)), (np.arange(len(nodes)), nodes)), (len(nodes), len(self.mesh.points))
        )
        return Skin(triangles, sp.csr_matrix(weights), fields, np.zeros((0, 2), dtype=np.int64))

    def rotation_of(self, values: np.ndarray) -> np.ndarray:
        """(..., 3, 3) gradient of slot values (..., 4, 3): A - I of displacements, dA/dt of velocities."""
        return np.einsum("...sc,ks->...ck", values, self.affine[1:])

    def rigidity(self) -> Joint:
        """The six constraints a_i . a_j = delta_ij."""
        every, B = np.arange(4), self.affine
        a = [Vector(e, (VectorPart(self, every, B[k + 1], True),)) for k, e in enumerate(np.eye(3))]
        rows = [
            ConstraintRow(DOT, a[i], a[j], 1.0 if i != j else 0.5, fixed=float(i == j), angular=True)
            for i in range(3)
            for j in range(i, 3)
        ]
        at = Vector(self.com, (VectorPart(self, every, B[0], True),))
        return Joint(f"{self.name}.rigidity", "rigid", rows, at, f"body {self.name!r}")


def surface_moments(points: np.ndarray, triangles: np.ndarray) -> tuple[float, np.ndarray, np.ndarray]:
    """Volume, m^3, centre (3,), m, and second moments about it (3, 3), m^5, within a closed surface: exact sums over
    the signed tetrahedra from one point to its triangles."""
    at = points[triangles].mean(axis=(0, 1))
    x = points[triangles] - at
    volume = np.linalg.det(x) / 6.0
    total, sums = volume.sum(), x.sum(axis=1)
    center = volume @ sums / (4.0 * total)
    squares = np.einsum("tik,til->tkl", x, x) + np.einsum("tk,tl->tkl", sums, sums)
    second = np.einsum("t,tkl->kl", volume, squares) / 20.0 - total * np.outer(center, center)
    return float(total), at + center, second


def volume_moments(shape: Shape) -> tuple[float, np.ndarray, np.ndarray] | None:
    """Volume, centre and second moments of a box, sphere, capsule or cylinder; None for others."""
    center, axes = shape.frame()
    if isinstance(shape, Box):
        volume, diagonal = float(np.prod(shape.size)), shape.size**2 / 12.0
    elif isinstance(shape, (Sphere, Capsule, Cylinder)):
        r, half, _ = shape.sizes
        tube, ball = 2.0 * np.pi * r**2 * half, 4.0 / 3.0 * np.pi * r**3 * (not isinstance(shape, Cylinder))
        volume = float(tube + ball)
        across = tube * r**2 / 4.0 + ball * r**2 / 5.0
        along = tube * half**2 / 3.0 + ball * (r**2 / 5.0 + half**2 + 0.75 * half * r)
        diagonal = np.array([across, across, along]) / volume
    else:
        return None
    return volume, center, volume * (axes * diagonal) @ axes.T
