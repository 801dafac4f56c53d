"""Methods of ModelBuilder for colliders and contacts."""

from __future__ import annotations

from typing import Any

from ..model.bodies import Body
from ..model.contacts import Collider, Contact
from ..model.description import Description
from ..model.handles import SurfaceSet
from ..model.pairs import FacetOptions
from ..model.shapes import Shape
from .checks import body_of_handle
from .contacts import add_contact, make_collider, pairs_without_contact

__all__ = ["ContactMethods"]


class ContactMethods:
    """Base of ModelBuilder: `add_collider`, `add_contact`, `add_contact_all`."""

    description: Description

    def add_collider(self, shape: Shape, path: Any = None, name: str | None = None) -> Collider:
        """Add a rigid obstacle; it acts on bodies through `add_contact`.

        Args:
            shape: HalfSpace, Sphere, Box, Capsule, Cylinder or TriMesh, placed at displacement 0.
            path: time law of its displacement (3,), m, or a Rotation; None: it is fixed.
            name: unique name; by default the shape's.

        Raises:
            ModelError: not a shape, a non-finite path, or a name used twice.
        """
        collider = make_collider(self.description, shape, path, name)
        self.description.colliders.append(collider)
        return collider

    def add_contact(
        self, surface: Body | SurfaceSet, collider: Collider | Any = None, *, mu: float = 0.0,
        mu_static: float | None = None, restitution: float = 0.0, law: str = "default", treatment: str = "implicit",
        stiffness: Any = None, model: str | None = None, radius: float | None = None, offset: float = 0.0,
        points: int | None = None, smoothing: Any = None, overlap: str = "auto", overlap_time: float = 0.1,
        seam: float | None = None, clipping: bool = False, name: str | None = None,
    ) -> Contact | FacetOptions:  # fmt: skip
        """Define contact of a body, or a surface of it, with a collider or another body.

        Args:
            surface: outer faces; of a body all.
            collider: as `add_collider` returned it; or another body, or a surface of it.
            mu, mu_static: coefficients of friction in slip, and in stick if it is larger.
            restitution: speed after an impact over that before, from 0 to 1; 0 damps points that come faster than
                `IMPACT_SPEED`. Waves stay in the bodies.
            law: "default", "paper" (Paper I, Eqs. 72-83) or "smooth".
            treatment: "implicit", or "explicit" with the paper's law.
            stiffness: factor on the normal and the tangential stiffness, None: 1. They follow the elements that touch,
                so that the contact yields by a tenth of them (`ELEMENT_STIFFNESS`), and harden beyond `HARDENING_DEPTH`
                of their depth. "region", or ("region", factor), a radius, model "sphere" and Paper I's laws take k_n
                and k_t of Eqs. (74), (79) for the whole surface, without hardening.
            model: "patch", spread over the surface, or "sphere", one contact at the deepest place, by Hertz; None:
                "patch", but "sphere" of a rigid part made from a Sphere on a convex obstacle without other options.
            radius: m; "patch": disc whose area replaces the surface's; "sphere": local radius of the body.
            offset: gap at which contact begins, m.
            points: points of each face, see warpfea.model.contact_points; by default 7 or 4 x 4, between bodies 16;
                not for obstacles narrower than the facets.
            smoothing: "paper": depth over which its damping is ramped in, m; "smooth": (eps in N, v_eps in m/s).
            overlap: initial overlap: "refuse"; "offset": stored, decaying in `overlap_time`, s (statics: load factor);
                "auto": stored and said up to 5 % of the smallest edge of a face and 25 % of the depth of an element.
            seam: largest difference of level, m, at which the body passes from one of its colliders to the next, fixed
                to it, or from one other body to the next, or to a collider at rest level with it as built, as over one
                surface, also over a gap of up to a fifth of the surface's width; None: a thousandth of the width, the
                second largest edge of the surface's bounding box. More is a step with a side face. 0 or above, not for
                obstacles narrower than the facets.
            clipping: True: sharp edges of an obstacle bear on the surface within its facets, too, by points of their
                own at most half a facet apart (overhangs, table edges, knife edges), which cost as a contact between
                bodies; not of moving colliders. Facets of bodies that begin near each other cut each other: a
                uniform pressure passes unlike meshes exactly, until they slide.
            name: unique name; by default "BODY on COLLIDER".

        Bodies without a contact pass through each other; `Simulation(check_overlap=True)` names them. Between
        two, reported forces act on the first.

        Returns:
            Contact, ObstacleContact (narrower than the facets), PairContact: the handle for reports.

        Raises:
            ModelError: a value out of range, an unknown name, no faces, or a handle of another builder.
            NotImplementedError: a body with itself, options that bodies or narrow obstacles lack.
        """
        for side in (surface, collider) if isinstance(collider, (Body, SurfaceSet)) else (surface,):
            body_of_handle(side, "add_contact", (Body, SurfaceSet), self.description.bodies)
        options = dict(mu=mu, mu_static=mu_static, restitution=restitution, law=law, treatment=treatment,
                       stiffness=stiffness, model=model, radius=radius, offset=offset, points=points,
                       smoothing=smoothing, overlap=overlap, overlap_time=overlap_time, seam=seam,
                       clipping=clipping)  # fmt: skip
        return add_contact(self.description, surface, collider, name, **options)

    def add_contact_all(self, *, mu: float = 0.0, **options: Any) -> list[Contact | FacetOptions]:
        """Define contact of each two bodies, and of each body with each collider, as far as they have none.

        Bodies with themselves are not meant, and left out are bodies that a weld, a joint or a constraint (but for a
        rod, "distance" or "DIST") connects, whose surfaces overlap there, and those clamped all over where the other
        side is a collider or clamped, too. Call it last, or again: what is there already counts. Each pair has its
        contact points, which take memory; time is spent on those whose boxes meet.

        Args:
            mu, options: of each contact, as for `add_contact`, but for `name`.

        Returns:
            The new contacts, by bodies in the order of addition.

        Raises:
            ModelError: no two bodies and no collider, or as `add_contact`; nothing is added then.
            NotImplementedError: as `add_contact`.
        """
        contacts = self.description.contacts
        count = len(contacts)
        try:
            for body, other in pairs_without_contact(self.description, options):
                self.add_contact(body, other, mu=mu, **options)
        except BaseException:
            del contacts[count:]
            raise
        return contacts[count:]
