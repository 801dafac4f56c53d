"""Colliders and contacts as recorded by a builder; documented at the methods of ModelBuilder."""

from __future__ import annotations

from collections.abc import Callable, Collection
from itertools import combinations, product
from typing import Any

import numpy as np
import warp as wp

from ..base.checks import is_count, is_number
from ..base.errors import ModelError
from ..base.names import check_choice
from ..contact import ANY_GAP, LAWS, ContactLaw
from ..kernels.contact.collider_shapes import SHAPE_KINDS
from ..model.bodies import Body
from ..model.contact_points import check_contact_points
from ..model.contacts import Collider, Contact
from ..model.description import Description
from ..model.edge_points import edge_contact
from ..model.handles import SurfaceSet
from ..model.obstacle_points import ObstacleContact, has_own_points, narrow_width
from ..model.pairs import PAIR_RULES, FacetOptions, PairContact, slave_and_master
from ..model.rigid import RigidBody
from ..model.rolling import ROLLING_SHAPES, RollingContact
from ..model.segments import SEGMENT_POINTS, SegmentContact, has_segments
from ..model.shapes import Shape, Sphere
from ..model.triangle_mesh import TriMesh
from ..time_laws import Rotation, time_law
from .bodies import unused_name
from .checks import checked_rotation

__all__ = ["add_contact", "make_collider", "pairs_without_contact"]

TIME_TREATMENTS = ("implicit", "explicit")
CONTACT_MODELS = ("patch", "sphere")
OVERLAP_OPTIONS = ("auto", "refuse", "offset")
SHAPE_NAMES = f"{', '.join(SHAPE_KINDS[:-1])} or {SHAPE_KINDS[-1]}"


def make_collider(d: Description, shape: Any, path: Any, name: str | None) -> Collider:
    """See ModelBuilder.add_collider."""
    if not isinstance(shape, Shape):
        raise ModelError(f"add_collider: expected a shape ({SHAPE_NAMES}), got {shape!r}")
    if getattr(shape, "kind", None) not in range(len(SHAPE_KINDS)):
        raise ModelError(
            f"add_collider: {type(shape).__name__} has no device functions, kind = {getattr(shape, 'kind', None)!r}; "
            f"give a {SHAPE_NAMES}, or add the kind to kernels/contact/collider_shapes.py"
        )
    default = {"HalfSpace": "half_space", "TriMesh": "mesh"}.get(type(shape).__name__, type(shape).__name__.lower())
    name = unused_name(name, default, {c.name for c in d.colliders}, "collider")
    out = Collider(shape, name, index=len(d.colliders))
    what = f"collider {name!r}: path"
    if isinstance(path, Rotation):
        out.rotation = checked_rotation(path, what)
    elif path is not None:
        out.law = time_law(path, what)
    return out


def outer_surface(thing: Body | SurfaceSet) -> SurfaceSet:
    """A surface, or all outer faces of a body.

    Raises:
        ModelError: no faces, interior faces, or a repeated face.
    """
    body = thing if isinstance(thing, Body) else thing.body
    surface = SurfaceSet(body, body.boundary) if isinstance(thing, Body) else thing
    what = f"add_contact: surface {surface.name!r} of body {body.name!r}" if surface.name else (
        f"add_contact: the surface of body {body.name!r}")  # fmt: skip
    if not len(surface):
        raise ModelError(f"{what} has no faces")
    count = len(body.family.faces)
    number, outer = surface.faces @ (count, 1), body.boundary @ (count, 1)
    for k in np.flatnonzero(~np.isin(number, outer))[:1]:
        raise ModelError(f"{what}: face {surface.faces[k].tolist()} (element, local face) is no outer face")
    if len(np.unique(number)) < len(number):
        raise ModelError(f"{what} has a face twice")
    return surface


def add_contact(
    d: Description, thing: Body | SurfaceSet, other: Any, name: str | None, *, clipping: bool, **options: Any
) -> Contact | FacetOptions:  # fmt: skip
    """Record a contact with a collider or another body; see ModelBuilder.add_contact."""
    if other is None:
        raise NotImplementedError(
            "add_contact: a body with itself is not part of this version; give a collider or another body"
        )
    make = next((make for kind, make in KINDS.items() if isinstance(other, kind)), make_contact)
    contact = make(d, thing, other, name, clipping=clipping, **options)
    check_clipping(contact, clipping)
    if clipping and isinstance(contact, PairContact) and has_segments(contact):
        contact = SegmentContact(**vars(contact))
    elif clipping and isinstance(contact, (Contact, PairContact)):
        contact.edges = edge_contact(contact, len(d.contacts_of(FacetOptions)) + isinstance(contact, PairContact))
    d.contacts.append(contact)
    return contact


def check_clipping(contact: Contact | FacetOptions, clipping: Any) -> None:
    """ModelError, or NotImplementedError, where the option `clipping` is not for a contact."""
    what = f"contact {contact.name!r}: clipping = {clipping!r}"
    if not isinstance(clipping, (bool, np.bool_)):
        raise ModelError(f"{what} must be True or False")
    if not clipping:
        return
    other = contact.sides[1]
    points = SEGMENT_POINTS if isinstance(contact, PairContact) else (contact.points,)
    reasons = {
        f"points = {contact.points}": contact.points not in (None, *points),
        "model = 'sphere'": contact.model == "sphere",
        "treatment = 'explicit'": contact.treatment == "explicit",
        f"law = {contact.law!r}, which acts at any distance,": LAWS[contact.law].traits & ANY_GAP,
        f"collider {other.name!r}, a sheet,": isinstance(other, Collider) and other.is_sheet,
    }
    for reason in (reason for reason, found in reasons.items() if found):
        raise NotImplementedError(f"{what} with {reason} is not part of this version; leave it out")


def default_model(thing: Any, other: Any, o: dict[str, Any]) -> dict[str, Any]:
    """The default of `model`: a ball on a convex obstacle touches it at one place, wherever the points of its facets
    are."""
    if o["model"] is not None:
        return {}
    if touches_without_facets(thing, other, o, Sphere):
        return {"model": "sphere", "radius": thing.shape.radius}
    return {"model": "patch"}


def touches_without_facets(thing: Any, other: Any, o: dict[str, Any], shapes: Any) -> bool:
    """True for a whole rigid part of one of the shapes on a collider that is no mesh, by default options."""
    plain = not o["clipping"] and (o["law"], o["treatment"]) == ("default", "implicit") and all(
        o[name] is None for name in ("model", "stiffness", "radius", "points", "seam")
    )  # fmt: skip
    solid = isinstance(other, Collider) and not isinstance(other.shape, TriMesh)
    return plain and solid and isinstance(thing, RigidBody) and isinstance(thing.shape, shapes)


def make_contact(
    d: Description, thing: Body | SurfaceSet, collider: Any, name: str | None, **options: Any
) -> Contact | ObstacleContact:
    """See ModelBuilder.add_contact.

    Args:
        options: all those of ModelBuilder.add_contact.
    """
    if isinstance(collider, Shape):
        shape = type(collider).__name__
        raise ModelError(f"add_contact: {shape} is a shape; give the collider that add_collider({shape}(...)) returns")
    if not isinstance(collider, Collider):
        raise ModelError(f"add_contact: expected a collider, as add_collider returns, got {collider!r}")
    if collider not in d.colliders:
        raise ModelError(f"add_contact: collider {collider.name!r} belongs to another builder")
    surface = outer_surface(thing)
    default = f"{surface.body.name} on {collider.name}"
    name = unused_name(name, default, {c.name for c in d.contacts}, "contact")
    kind = RollingContact if touches_without_facets(thing, collider, options, ROLLING_SHAPES) else Contact
    options |= default_model(thing, collider, options)
    options.pop("clipping")
    o = _checked_options(f"contact {name!r}", surface, dict(options))
    if o["model"] == "sphere" and collider.is_sheet:
        raise ModelError(
            f"contact {name!r}: collider {collider.name!r} is a sheet of triangles, and model = 'sphere' needs an "
            "obstacle with an inside: take model = 'patch', or a closed mesh"
        )
    patch = o["model"] == "patch" and o["treatment"] == "implicit" and not LAWS[o["law"]].traits & ANY_GAP
    width = narrow_width(surface, collider) if patch else None
    if width is not None and has_own_points(surface):
        for option in ("points", "seam"):
            if o[option] is not None:
                raise NotImplementedError(
                    f"contact {name!r}: {option} = for collider {collider.name!r}, narrower than the facets of body "
                    f"{surface.body.name!r}, is not part of this version; leave it out, or take finer facets"
                )
        o["index"] = len(d.contacts_of(FacetOptions))
        return ObstacleContact(surface=surface, collider=collider, name=name, **o)
    return kind(surface, collider, name, width=width, index=len(d.contacts_of(Contact)), **o)


def make_pair(
    d: Description, first: Body | SurfaceSet, second: Body | SurfaceSet, name: str | None, **options: Any
) -> PairContact:  # fmt: skip
    """See ModelBuilder.add_contact, with two bodies."""
    a, b = outer_surface(first), outer_surface(second)
    if a.body is b.body:
        raise NotImplementedError(
            f"add_contact: body {a.body.name!r} with itself is not part of this version; give two bodies"
        )
    taken = {c.name for c in d.contacts}
    name = unused_name(name, f"{a.body.name} on {b.body.name}", taken, "contact")
    what = f"contact {name!r}"
    options |= default_model(a, b, options)
    options.pop("clipping")
    if options["model"] == "sphere":
        raise NotImplementedError(f"{what}: model = 'sphere' between bodies is not part of this version; take 'patch'")
    if _checked_law(what, options["law"]).traits & ANY_GAP:
        raise NotImplementedError(
            f"{what}: law = {options['law']!r} acts at any distance, and is for contact with colliders; take 'default' "
            "or 'paper'"
        )
    slave, master, width = slave_and_master(a, b)
    points, options["points"] = options["points"], None
    o = _checked_options(what, slave, dict(options))
    corners = {len(slave.body.family.faces[int(face)]) for face in np.unique(slave.faces[:, 1])}
    for k in corners:
        if points is not None and (not is_count(points) or points not in PAIR_RULES[k]):
            numbers = ", ".join(map(str, PAIR_RULES[k]))
            raise ModelError(
                f"{what}: points = {points!r}: faces of {slave.body.name!r} have rules of {numbers} points"
            )
    o["points"] = None if points is None else int(points)
    o["index"] = len(d.contacts_of(FacetOptions))
    return PairContact(first=a, second=b, name=name, slave=slave, master=master, width=width, **o)


def pairs_without_contact(d: Description, options: Collection[str]) -> list[tuple[Body, Body | Collider]]:
    """Pairs that `ModelBuilder.add_contact_all` adds. ModelError for the option `name`, or where there is no pair."""
    if "name" in options:
        raise ModelError("add_contact_all: name = names one contact; leave it out: names are 'BODY on OTHER'")
    if len(d.bodies) + len(d.colliders) < 2 or not d.bodies:
        raise ModelError(
            f"add_contact_all: there is no pair yet ({d.summary() or 'no bodies'}): call it after bodies and colliders"
        )
    known = d.contact_pairs.keys() | d.attached_pairs
    clamped = {id(body) for body in d.bodies if d.clamped_slots(body).all()} | {
        id(collider) for collider in d.colliders
    }
    others: list[tuple[Body, Body | Collider]] = list(combinations(d.bodies, 2))
    pairs = [*others, *product(d.bodies, d.colliders)]
    return [
        (body, other)
        for body, other in pairs
        if frozenset({id(body), id(other)}) not in known and not {id(body), id(other)} <= clamped
    ]


KINDS: dict[type, Callable[..., Contact | FacetOptions]] = {
    Body: make_pair, SurfaceSet: make_pair, Collider: make_contact,
}  # fmt: skip
"""Contacts by the type of the other side that `add_contact` is given."""


def _checked_options(what: str, surface: SurfaceSet, o: dict[str, Any]) -> dict[str, Any]:
    """Contact options with None replaced by defaults. ModelError names the invalid one."""
    law = _checked_law(what, o["law"])
    known = {"treatment": TIME_TREATMENTS, "model": CONTACT_MODELS, "overlap": OVERLAP_OPTIONS}
    for option, names in known.items():
        check_choice(f"{what}: {option}", o[option], names)
    if o["treatment"] == "explicit" and not law.explicit:
        raise ModelError(f"{what}: treatment = 'explicit': law {o['law']!r} declares no explicit force; 'paper' does")
    o["mu"] = _number(what, "mu", o["mu"], "a friction coefficient, 0 or above", low=0.0)
    if o["mu_static"] is None:
        o["mu_static"] = o["mu"]
    wanted = f"None, or at least mu = {o['mu']:g}"
    o["mu_static"] = _number(what, "mu_static", o["mu_static"], wanted, low=o["mu"])
    wanted = "from 0 to 1"
    if law.least_restitution:
        wanted = f"above 0 and at most 1: law {o['law']!r} has no critical damping, for which the default 0 stands"
    o["restitution"] = _number(what, "restitution", o["restitution"], wanted, low=law.least_restitution, high=1.0)
    may_follow = o["radius"] is None and o["model"] == "patch" and law.smoothing is None
    o["stiffness_of"], o["stiffness"] = _stiffness(what, o["stiffness"], may_follow)
    if o["radius"] is not None:
        o["radius"] = _number(what, "radius", o["radius"], "positive, m")
    elif o["model"] == "sphere":
        raise ModelError(
            f"{what}: model = 'sphere' needs radius= (m), the local radius of curvature R of the Hertz force "
            "4/3 E* sqrt(R) d^1.5"
        )
    o["offset"] = _number(what, "offset", o["offset"], "a finite number, m", low=-np.inf)
    o["overlap_time"] = _number(what, "overlap_time", o["overlap_time"], "positive, s")
    try:
        check_contact_points(surface, o["points"])
    except ModelError as error:
        raise ModelError(f"{what}: {error}") from None
    o["points"] = None if o["points"] is None else int(o["points"])
    if o["seam"] is not None:
        o["seam"] = _number(what, "seam", o["seam"], "a length of 0 or above, m, or None", low=0.0)
    o["smoothing"] = _smoothing(what, o["law"], o["smoothing"])
    return o


def _checked_law(what: str, name: str) -> ContactLaw:
    """A law of `LAWS`. ModelError for an unknown name, or an entry that is no law of a device function."""
    check_choice(f"{what}: law", name, LAWS)
    law = LAWS[name]
    if not isinstance(law, ContactLaw):
        raise ModelError(
            f"{what}: LAWS[{name!r}] is {law!r}, no ContactLaw; write LAWS[{name!r}] = ContactLaw(normal), normal its "
            "device function"
        )
    if not isinstance(law.normal, wp.Function):
        raise ModelError(
            f"{what}: `normal` of law {name!r} is {law.normal!r}, no device function: decorate it @wp.func"
        )
    return law


def _number(
    what: str, name: str, value: Any, wanted: str, *, low: float | None = None, high: float = np.inf
) -> float:  # fmt: skip
    """A finite number from `low` (None: above 0) to `high`."""
    if not is_number(value) or value > high or (value <= 0.0 if low is None else value < low):
        raise ModelError(f"{what}: {name} = {value!r} must be {wanted}")
    return float(value)


def _stiffness(what: str, value: Any, may_follow: bool) -> tuple[str, float]:
    """`ContactOptions.stiffness_of`, and the factor."""
    of, factor = value if isinstance(value, (tuple, list)) and len(value) == 2 else (None, value)
    if isinstance(value, str):
        of, factor = value, None
    wanted = "a positive factor, None for 1, 'region' or 'elements', or (one of these, factor)"
    if of not in (None, "region", "elements"):
        raise ModelError(f"{what}: stiffness = {value!r} must be {wanted}")
    if of == "elements" and not may_follow:
        raise ModelError(f"{what}: stiffness = {value!r} needs law = 'default', model = 'patch' and no radius")
    default = "elements" if may_follow else "region"
    return of or default, 1.0 if factor is None else _number(what, "stiffness", factor, wanted)


def _smoothing(what: str, law: str, value: Any) -> float | tuple[float, float] | None:
    """A depth or (eps, v_eps), as `ContactLaw.smoothing` of the law says, else None."""
    if value is None:
        return None
    kind = LAWS[law].smoothing
    if kind is None:
        raise ModelError(
            f"{what}: smoothing = {value!r}: law {law!r} declares no smoothing; leave it out, or take 'paper' or "
            "'smooth'"
        )
    if kind == "depth":
        return _number(what, "smoothing", value, "a positive depth, m, over which the paper's damping is ramped in")
    pair = tuple(value) if isinstance(value, (tuple, list, np.ndarray)) else ()
    if len(pair) != 2 or not all(is_number(v) and v > 0.0 for v in pair):
        raise ModelError(f"{what}: smoothing = {value!r} must be two positive numbers (eps in N, v_eps in m/s)")
    return float(pair[0]), float(pair[1])
