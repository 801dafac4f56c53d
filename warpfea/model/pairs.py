"""Contact between bodies: description, and facets of master surfaces."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ..base.errors import ModelError
from ..elements import Rule
from ..elements.quadrature import lobatto_square, triangle_7, triangle_16
from ..kernels.contact.thickness import thickness_kernel
from ..mesh.cells import row_keys
from . import assembly
from .contact_points import ContactPoints, effective_modulus, points_by_faces, points_by_rules, rules_of_faces
from .contacts import ContactOptions
from .discretisation import element_functions
from .edges import Edges, parts_of, sharp_edges_of, sharp_sides
from .handles import SurfaceSet, once_per_surface
from .narrow import body_widths, facet_size, is_narrow, rules_for_width
from .surfaces import measure_to_skin

__all__ = [
    "PAIR_RULES",
    "FacetOptions",
    "MasterFacets",
    "PairContact",
    "facet_point_areas",
    "master_facets",
    "pair_points",
    "slave_and_master",
]

PAIR_RULES: dict[int, dict[int, Rule]] = {
    3: {7: triangle_7(), 16: triangle_16()},
    4: {n * n: lobatto_square(n) for n in (2, 3, 4, 5)},
}
"""Quadrature rules of slave faces, by the numbers of corners and of points."""
MASTER_SIZE_RATIO = 1.25
"""Ratio of element sizes beyond which the coarser surface is the master."""
MAX_CORNER_LENGTH = 2.0
"""Maximum length of the mitred corner normal, over the unit normal."""
RANK_TOL = 0.1
"""Relative singular value below which the normals at a node count as dependent."""


@dataclass(eq=False)
class FacetOptions(ContactOptions):
    """Base of contacts of points with the facets of a body, those of the last of its surfaces.

    Attributes:
        name: unique among the contacts of its builder.
        shadow: mean shadow over the area of the points, a quarter for those around a convex obstacle.
        one_sided: 1 if its points touch only facets that face theirs; EDGES if only within these.
        row_per_facet: True if its points are in one row for each facet.
    """

    name: str
    shadow: ClassVar[float] = 1.0
    one_sided: ClassVar[int] = 0
    row_per_facet: ClassVar[bool] = True

    def region_area(self, points: ContactPoints) -> float:
        """As of `ContactOptions`; without a radius that of its smaller surface."""
        area = super().region_area(points)
        return area if self.radius else min(self.shadow * area, float(facet_point_areas(self.facets).sum()))

    @property
    def facets(self) -> SurfaceSet:
        """The surface whose facets are touched."""
        return self.surfaces[-1]

    def sharp_edges(self) -> Edges | None:
        """Edges of the points' side that see edges of the other one."""
        return None


@dataclass(eq=False)
class PairContact(FacetOptions):
    """Contact of two surfaces; made by ModelBuilder.add_contact, which documents the values.

    Attributes:
        first, second: faces of two bodies; forces of reports are those on the first.
        slave, master: their roles: points of the slave against facets of the master.
        width: width of the master, m, that the points of the slave must see; None: by their rule.
    """

    first: SurfaceSet
    second: SurfaceSet
    name: str
    slave: SurfaceSet
    master: SurfaceSet
    width: float | None

    @property
    def surfaces(self) -> tuple[SurfaceSet, ...]:
        return self.slave, self.master

    @property
    def roles(self) -> tuple[Any, Any]:
        return self.slave.body, self.master.body

    def slave_points(self) -> tuple[ContactPoints, Any]:
        return pair_points(self.slave, self.points, self.width), 1.0

    def sharp_edges(self) -> Edges | None:
        """Sharp edges of the slave, if the master has some too and the stiffness is that of the elements."""
        if self.stiffness_of != "elements" or self.model != "patch" or self.treatment != "implicit":
            return None
        edges = parts_of(sharp_edges_of(self.slave), body_widths(self.master.body)[0])
        return edges if len(edges.facet) and sharp_sides(self.master).any() else None

    @property
    def sign(self) -> float:
        """As of `ContactOptions`."""
        return 1.0 if self.slave is self.first else -1.0

    def __repr__(self) -> str:
        return f"PairContact({self.name!r}, bodies {self.first.body.name!r} and {self.second.body.name!r})"


@dataclass(frozen=True, eq=False)
class MasterFacets:
    """Facets as polynomials, see kernels/contact/facet_structs.py.

    Attributes:
        conn: (F, L) body slots of the facets' elements.
        shape, director_shape: (F, M, L) monomial coefficients of the L slots' shape functions, and of their outward
            derivatives, 1/m.
        reference_position_coefficients, normal_coefficients: (F, M, 3) monomial coefficients of the reference position,
            m, and of the outward vector (mitred unit normals).
        corners, degree: 3 or 4, of each facet; of the polynomials.
        size: (F,) length of a side, m.
        depth_limit: (F,) half the thickness of the body behind it, m.
        half_angle: (4, F) of `sharp_sides`.
    """

    conn: np.ndarray
    shape: np.ndarray
    director_shape: np.ndarray
    reference_position_coefficients: np.ndarray
    normal_coefficients: np.ndarray
    corners: int
    degree: int
    size: np.ndarray
    depth_limit: np.ndarray
    half_angle: np.ndarray


@once_per_surface
def pair_points(surface: SurfaceSet, points: int | None = None, width: float | None = None) -> ContactPoints:
    """Points of a slave surface, corners included: `points` per face, or 16, since meshes need not match; None with a
    `width`, m: equidistant ones that a thing of this width can't pass between."""
    if points is None and width is not None:
        return points_by_faces(surface, rules_for_width(surface, width))
    return points_by_rules(surface, PAIR_RULES, {3: 16, 4: 16}, points)


@once_per_surface
def facet_point_areas(surface: SurfaceSet) -> np.ndarray:
    """(F, 16) areas of `pair_points`, m^2."""
    rules = rules_of_faces(surface, {corners: known[16] for corners, known in PAIR_RULES.items()})
    return assembly.facet_areas(surface.body, assembly.facet_tables(surface, rules=rules))


def slave_and_master(first: SurfaceSet, second: SurfaceSet) -> tuple[SurfaceSet, SurfaceSet, float | None]:
    """Slave, master, and `PairContact.width`.

    The side that is narrower than the other's facets is the slave. Otherwise, or if both are (crossed bars), the
    coarser surface is the master; at equal size the stiffer, then the second.
    """
    widths = [body_widths(surface.body) for surface in (first, second)]
    (side_1, size_1), (side_2, size_2) = (facet_size(surface) for surface in (first, second))
    narrow = [is_narrow(widths[0], side_2), is_narrow(widths[1], side_1)]
    if narrow[0] != narrow[1]:
        return (first, second, None) if narrow[0] else (second, first, None)
    modulus_1, modulus_2 = (effective_modulus(surface.body, surface)[0] for surface in (first, second))
    if size_1 > MASTER_SIZE_RATIO * size_2 or (size_2 <= MASTER_SIZE_RATIO * size_1 and modulus_1 > modulus_2):
        return second, first, widths[0][0] if narrow[0] else None
    return first, second, widths[1][0] if narrow[1] else None


def monomial_exponents(corners: int, degree: int) -> np.ndarray:
    """(M, 2) exponents of the monomials: triangles to a total degree, quadrilaterals to one per direction."""
    return np.array([(i, j) for i in range(degree + 1) for j in range(degree + 1) if corners == 4 or i + j <= degree])


def interpolation_nodes(corners: int, degree: int) -> np.ndarray:
    """(M, 2) equidistant interpolation points of a polynomial with these monomials."""
    return monomial_exponents(corners, degree) / degree


def monomials(points: np.ndarray, corners: int, degree: int) -> np.ndarray:
    """(Q, M) values at points."""
    return np.asarray(np.prod(points[:, None, :] ** monomial_exponents(corners, degree), axis=2))


def bernstein_from_monomials(corners: int, degree: int) -> np.ndarray:
    """(M, M): control points of Bernstein's form, whose convex hull holds the facet, from monomial coefficients."""
    powers = monomial_exponents(corners, degree)
    nodes = interpolation_nodes(corners, degree)
    if corners == 4:
        values = [math.comb(degree, i) * math.comb(degree, j) * nodes[:, 0] ** i * (1 - nodes[:, 0]) ** (degree - i)
                  * nodes[:, 1] ** j * (1 - nodes[:, 1]) ** (degree - j) for i, j in powers]  # fmt: skip
    else:
        rest = 1.0 - nodes.sum(axis=1)
        values = [math.factorial(degree) / (math.factorial(i) * math.factorial(j) * math.factorial(degree - i - j))
                  * nodes[:, 0] ** i * nodes[:, 1] ** j * rest ** (degree - i - j) for i, j in powers]  # fmt: skip
    return np.linalg.solve(np.stack(values, axis=1), monomials(nodes, corners, degree))


def _shape_functions(surface: SurfaceSet, ab: np.ndarray) -> np.ndarray:
    """(F, Q, S) shape functions of all slots of the elements at face coordinates ab (Q, 2)."""
    body, faces = surface.body, surface.faces
    shape = np.empty((len(faces), len(ab), body.family.slots))
    for face in np.unique(faces[:, 1]):
        rows = np.flatnonzero(faces[:, 1] == face)
        shape[rows] = element_functions(body, faces[rows, 0], body.family.face_points(int(face), ab)[0])[0]
    return shape


def _gradients_and_normals(surface: SurfaceSet, ab: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Gradients dN/dX (F, Q, S, 3), 1/m, of `_shape_functions`, and outward unit normals (F, Q, 3)."""
    body, faces = surface.body, surface.faces
    gradient = np.empty((len(faces), len(ab), body.family.slots, 3))
    normal = np.empty((len(faces), len(ab), 3))
    for face in np.unique(faces[:, 1]):
        rows = np.flatnonzero(faces[:, 1] == face)
        xi, dxi = body.family.face_points(int(face), ab)
        ds = element_functions(body, faces[rows, 0], xi)[1]
        e = body.reference[body.connectivity[faces[rows, 0]]]
        ds = np.broadcast_to(ds, (len(rows), *ds.shape[1:]))
        J = np.einsum("esk,eqsd->eqkd", e, ds)
        gradient[rows] = np.einsum("eqsd,eqdk->eqsk", ds, np.linalg.inv(J))
        tangents = np.einsum("eqkd,qdj->eqkj", J, dxi)
        n = np.cross(tangents[..., 0], tangents[..., 1])
        normal[rows] = n / np.linalg.norm(n, axis=2, keepdims=True)
    return gradient, normal


def _mitred_normals(positions: np.ndarray, normal: np.ndarray, size: float) -> np.ndarray:
    """(F, Q, 3) node vectors with unit product with the normal of each facet at the node (mitred normals)."""
    place = np.round(positions.reshape(-1, 3) / (1e-7 * size)).astype(np.int64)
    place -= place.min(axis=0)
    inverse = np.unique(row_keys(place, int(place.max()) + 1), return_inverse=True)[1]
    flat = normal.reshape(-1, 3)
    order, counts = np.argsort(inverse, kind="stable"), np.bincount(inverse)
    first = np.cumsum(counts) - counts
    out = flat.copy()
    for count in np.unique(counts[counts > 1]):
        rows = order[first[counts == count, None] + np.arange(count)]
        n = flat[rows]
        vector = np.linalg.pinv(n, rcond=RANK_TOL).sum(axis=2)
        length = np.linalg.norm(vector, axis=1)
        mitred = (length > 0.0) & (np.einsum("fqk,fk->fq", n, vector).min(axis=1) > 0.0)
        vector *= np.minimum(1.0, MAX_CORNER_LENGTH / np.maximum(length, 1e-300))[:, None]
        out[rows[mitred]] = vector[mitred, None]
    return out.reshape(normal.shape)


def master_facets(surface: SurfaceSet) -> MasterFacets:
    """Facets of a surface as polynomials of the lowest exact degree.

    Raises:
        ModelError: triangles and quadrilaterals in one surface, or shape functions of degree above 3 on a face.
    """
    body, faces = surface.body, surface.faces
    kinds = {len(body.family.faces[int(k)]) for k in np.unique(faces[:, 1])}
    if len(kinds) > 1:
        raise ModelError(
            f"body {body.name!r}: a master surface must not mix triangles and quadrilaterals; name surfaces of one"
        )
    corners = kinds.pop()
    check = PAIR_RULES[corners][16].points
    wanted = _shape_functions(surface, check)
    for degree in (1, 2, 3):
        ab = interpolation_nodes(corners, degree)
        inverse = np.linalg.inv(monomials(ab, corners, degree))
        shape = _shape_functions(surface, ab)
        fitted = np.einsum("qm,mn,fns->fqs", monomials(check, corners, degree), inverse, shape)
        if np.abs(fitted - wanted).max() <= 1e-10 * np.abs(wanted).max():
            break
    else:
        raise ModelError(f"body {body.name!r}: shape functions of {body.family.name} on a face are of degree above 3")
    gradient, normal = _gradients_and_normals(surface, ab)
    conn = body.connectivity[faces[:, 0]]
    e = body.reference[conn]
    positions = np.einsum("fqs,fsk->fqk", shape, e) + body.origin
    area = facet_point_areas(surface).sum(axis=1)
    outward = _mitred_normals(positions, normal, float(np.sqrt(area.max())))
    director_shape = np.einsum("fqsk,fqk->fqs", gradient, outward)
    used = (np.abs(shape).max(axis=(0, 1)) > 0.0) | (np.abs(director_shape).max(axis=(0, 1)) > 0.0)
    conn, e, shape, director_shape = conn[:, used], e[:, used], shape[:, :, used], director_shape[:, :, used]
    shape, director_shape = (np.einsum("mq,fqs->fms", inverse, x) for x in (shape, director_shape))
    X = np.einsum("mq,fqk->fmk", inverse, positions)
    N = np.einsum("fms,fsk->fmk", director_shape, e)
    return MasterFacets(
        conn, shape, director_shape, X, N, corners, degree, np.sqrt(area), 0.5 * facet_thickness(surface),
        sharp_sides(surface),
    )  # fmt: skip


def facet_thickness(surface: SurfaceSet) -> np.ndarray:
    """(F,) thickness, m: inward distance from the middle of each facet to the opposite side of its body."""
    body = surface.body
    corners = len(body.family.faces[int(surface.faces[0, 1])])
    middle = np.full((1, 2), 1.0 / 3.0 if corners == 3 else 0.5)
    normal = _gradients_and_normals(surface, middle)[1]
    e = body.reference[body.connectivity[surface.faces[:, 0]]]
    positions = np.einsum("fqs,fsk->fqk", _shape_functions(surface, middle), e)[:, 0] + body.origin
    return measure_to_skin(body, thickness_kernel(), positions, normal[:, 0])
