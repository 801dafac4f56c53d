"""Contact description: colliders (moving rigid shapes) and contacts."""

from __future__ import annotations

from dataclasses import dataclass

from ..time_laws import Rotation, TimeLaw
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
        seam: largest difference of level of two colliders that is a seam, m, or None.
        index: number in its builder, of contacts of its class.
    """

    mu: float = 0.0
    mu_static: float = 0.0
    restitution: float = 1.0
    law: str = "default"
    treatment: str = "implicit"
    stiffness: float = 1.0
    stiffness_of: str = "region"
    model: str = "patch"
    radius: float | None = None
    offset: float = 0.0
    points: int | None = None
    smoothing: float | tuple[float, float] | None = None
    overlap: str = "auto"
    overlap_time: float = 0.1
    seam: float | None = None
    index: int = -1


@dataclass(eq=False)
class Contact(ContactOptions):
    """Contact of a surface with a collider; made by ModelBuilder.add_contact, which documents the values.

    Attributes:
        surface: faces of the body.
        collider: the obstacle.
        name: unique among the contacts of its builder.
    """

    surface: SurfaceSet
    collider: Collider
    name: str

    @property
    def body(self) -> Discretisation:
        """The body of the surface."""
        return self.surface.body

    @property
    def surfaces(self) -> tuple[SurfaceSet, ...]:
        """Surfaces of bodies in the contact."""
        return (self.surface,)

    def __repr__(self) -> str:
        return f"Contact({self.name!r}, body {self.body.name!r} with collider {self.collider.name!r})"
