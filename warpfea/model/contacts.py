"""Contact description: colliders (moving rigid shapes) and contacts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from scipy.spatial.transform import Rotation as Turn

from ..time_laws import Rotation, TimeLaw
from .contact_points import ContactPoints, contact_points, element_depths
from .discretisation import Discretisation
from .handles import SurfaceSet
from .shapes import Shape
from .triangle_mesh import TriMesh

__all__ = ["Collider", "Contact", "ContactOptions"]


@dataclass(eq=False)
class Collider:
    """A rigid obstacle; made by ModelBuilder.add_collider.

    Attributes:
        shape: the shape at displacement 0.
        name: unique among the colliders of its builder.
        law: vector law of the displacement, m, or None.
        rotation: of the shape, or None; not both.
        index: number in its builder.
    """

    shape: Shape
    name: str
    law: TimeLaw | None = None
    rotation: Rotation | None = None
    index: int = -1

    @property
    def is_sheet(self) -> bool:
        """True for triangles without an inside."""
        return isinstance(self.shape, TriMesh) and not self.shape.closed

    @property
    def moves(self) -> bool:
        """True with a path, also a constant displacement."""
        return self.law is not None or self.rotation is not None

    def poses(self, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Positions (n, 3), m, and axes (n, 3, 3) at values (n, 3) of its law, m, or of its angle, rad."""
        position, axes = (np.tile(x, (len(value), *[1] * x.ndim)) for x in self.shape.frame())
        if self.rotation is not None:
            turn = Turn.from_rotvec(value[:, :1] * np.asarray(self.rotation.axis)).as_matrix()
            anchor = np.asarray(self.rotation.anchor)
            return anchor + np.einsum("nij,nj->ni", turn, position - anchor), turn @ axes
        return position + value if self.law is not None else position, axes

    def __repr__(self) -> str:
        return f"Collider({self.name!r}, {type(self.shape).__name__}{', moves' if self.moves else ''})"


@dataclass(eq=False, kw_only=True)
class ContactOptions:
    """Options common to contacts with colliders and between bodies.

    Attributes:
        mu, mu_static: coefficients of friction in slip and in stick, 0 <= mu <= mu_static.
        restitution: from 0 to 1.
        law: "default", "paper" or "smooth".
        treatment: "implicit", or "explicit" with the paper's law.
        stiffness: factor on the normal and the tangential stiffness.
        stiffness_of: "elements" that touch, or the contact's "region".
        model: "patch" or "sphere".
        radius: m, of the contact region ("patch") or of the body ("sphere"), or None.
        offset: gap at which contact begins, m.
        points: points of each face, or None for the default rules.
        smoothing: None; with the paper's law a depth, m; with the smooth law (eps in N, v_eps in m/s).
        overlap: "auto", "refuse" or "offset".
        overlap_time: time in which a stored overlap decays, s.
        seam: largest difference of level of two colliders or bodies that is a seam, m, or None.
        index: number in its builder, of contacts of its class.
        edges: contact of the edges of the touched side (`EdgeContact`), or None.
        sign: 1, or -1 where its points belong to the second of `sides`, as reports state the force on the first.
    """

    sign: ClassVar[Any] = 1.0

    mu: float
    mu_static: float
    restitution: float
    law: str
    treatment: str
    stiffness: float
    stiffness_of: str
    model: str
    radius: float | None
    offset: float
    points: int | None
    smoothing: float | tuple[float, float] | None
    overlap: str
    overlap_time: float
    seam: float | None
    index: int = -1
    edges: Any = None

    @property
    def surfaces(self) -> tuple[SurfaceSet, ...]:
        """Surfaces of bodies in the contact."""
        raise NotImplementedError

    @property
    def body(self) -> Discretisation:
        """The body of the first of them."""
        return self.surfaces[0].body

    @property
    def roles(self) -> tuple[Any, Any]:
        """The body or collider of the points, and the one that these touch."""
        raise NotImplementedError

    @property
    def sides(self) -> tuple[Any, Any]:
        """Both of them in the order of reports: a collider, or the second body, comes last."""
        return self.roles if self.sign > 0.0 else self.roles[::-1]

    def slave_points(self) -> tuple[ContactPoints, Any]:
        """Its points, and the factor on their stiffness by area."""
        return contact_points(self.surfaces[0], self.points), 1.0

    def region_area(self, points: ContactPoints) -> float:
        """Area that the stiffness is distributed over, m^2: of a disc of `radius`, or that of its points."""
        return math.pi * self.radius**2 if self.radius else float(points.area.sum())

    def own_depths(self, points: ContactPoints) -> np.ndarray:
        """(F,) depths of the elements behind the faces of its points, m."""
        return np.asarray(element_depths(self.surfaces[0])[points.rows])

    @property
    def grounded(self) -> bool:
        """True if one side is a collider."""
        return isinstance(self.sides[1], Collider)

    @property
    def texts(self) -> tuple[str, str]:
        """Texts of `roles` for messages."""
        of, touched = (f"{'collider' if isinstance(x, Collider) else 'body'} {x.name!r}" for x in self.roles)
        return of, touched


@dataclass(eq=False)
class Contact(ContactOptions):
    """Contact of a surface with a collider; made by ModelBuilder.add_contact, which documents the values.

    Attributes:
        surface: faces of the body.
        collider: the obstacle.
        name: unique among the contacts of its builder.
        width: of an obstacle narrower than the facets, m, which their points must see; None: points by their rule.
    """

    surface: SurfaceSet
    collider: Collider
    name: str
    width: float | None = None

    @property
    def surfaces(self) -> tuple[SurfaceSet, ...]:
        return (self.surface,)

    @property
    def roles(self) -> tuple[Any, Any]:
        return self.body, self.collider

    def slave_points(self) -> tuple[ContactPoints, Any]:
        return contact_points(self.surface, self.points, self.width), 1.0

    def region_area(self, points: ContactPoints) -> float:
        """As of `ContactOptions`; of the "sphere" over the depth: pi R, 1/R = 1/R_A + 1/R_B of both."""
        if self.model != "sphere":
            return super().region_area(points)
        assert self.radius is not None
        return math.pi / (1.0 / self.radius + 1.0 / self.collider.shape.radius_of_curvature)

    def __repr__(self) -> str:
        return f"Contact({self.name!r}, body {self.body.name!r} with collider {self.collider.name!r})"
