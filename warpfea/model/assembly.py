"""Host tables of a model, by numpy and scipy in float64: geometry, mass, connectivity."""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from .. import elements as families
from ..base.errors import MeshError, ModelError
from ..elements import EnergyPart, Rule
from ..elements.family import AssumedStrain
from ..elements.quadrature import composite_rule
from ..kernels.elements.materials import NCOEF
from ..materials import Material
from .discretisation import Discretisation, element_functions
from .handles import SurfaceSet

__all__ = [
    "BlockKey",
    "FacetTables",
    "HostBlock",
    "at_points",
    "density_of",
    "facet_area_vectors",
    "facet_areas",
    "facet_positions",
    "facet_tables",
    "gather_table",
    "greedy_colouring",
    "grouped_items",
    "host_blocks",
    "require_density",
    "rigid_modes",
    "surface_weights",
]

MAX_CHUNK_ELEMENTS = 20000
"""Maximum elements per pass for tables with one row per element."""
MAX_CHUNK_FACETS = 2000
"""Facets whose temporary arrays stay in the cache of a processor core."""
MAX_CHUNK_ENTRIES = 20_000_000
"""Maximum entries (elements x points x slots) of a table computed at once."""


def element_chunks(body: Discretisation, elements: np.ndarray, points: int) -> Iterator[np.ndarray]:
    """Runs of elements short enough for a table at `points` points."""
    per_element = points * body.family.slots if body.family.has_gradients else 1
    size = max(1, min(MAX_CHUNK_ELEMENTS, MAX_CHUNK_ENTRIES // per_element))
    for first in range(0, len(elements), size):
        yield elements[first : first + size]


@dataclass(frozen=True)
class BlockKey:
    """Key of an element block: elements with equal keys share a kernel.

    Attributes:
        scheme, part: name of the integration scheme of the family, and index of the part of the strain energy in it.
        law, damping: names of the device law and of the form of damping, None without.
        affine: J0 is constant in each element. framed: strains are taken in local orthonormal axes.
    """

    family: str
    scheme: str
    part: int
    law: str
    damping: str | None
    affine: bool
    framed: bool

    @property
    def output_scheme(self) -> str | None:
        """Integration of stress output in place of a tied part, if the family has one."""
        name = f"{self.integral.name} stress"
        return name if name in families.get_family(self.family).output_schemes else None

    @cached_property
    def integral(self) -> EnergyPart:
        """Part of the strain energy integrated by the block."""
        return families.get_family(self.family).scheme(self.scheme)[self.part]

    @property
    def rule(self) -> Rule:
        """Quadrature rule of the part."""
        return self.integral.rule

    @property
    def vertex(self) -> bool:
        """True if kernels/elements/vertex.py applies: straight T10 with points on lines to the vertices."""
        family = families.get_family(self.family)
        quadratic = family.cell_type == "tetra10" and family.slots == 10
        return self.affine and quadratic and not self.framed and self.rule.points_on_medians

    @cached_property
    def tying(self) -> AssumedStrain | None:
        """Tying of assumed strains of parts that have them; else None."""
        return self.integral.tying


@dataclass(eq=False)
class HostBlock:
    """Elements of one body with one key.

    Attributes:
        body: the body.
        elements: (E,) element indices in the body.
        material: index into the body's materials.
        coefficients: of the device law.
        coefficient_row: of the model's table of coefficients, set by MaterialParameters.
    """

    key: BlockKey
    body: Discretisation
    elements: np.ndarray
    material: int
    coefficients: tuple[float, ...]
    coefficient_row: int = -1

    @property
    def conn(self) -> np.ndarray:
        """(E, S) body slots of the elements."""
        return self.body.connectivity[self.elements]

    @property
    def nodes(self) -> np.ndarray:
        """(E, n, 3) reference node positions relative to the body origin."""
        return self.body.mesh.points[self.body.mesh.cells[self.elements]] - self.body.origin


def shape_and_jacobian(
    body: Discretisation, elements: np.ndarray, points: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Shape functions s_i and Jacobian J0 = dX/dxi at parent points.

    Returns:
        s (E or 1, Q, S), ds (E or 1, Q, S, 3), J0 (E, Q, 3, 3) = sum E_i ds_i^T, det J0 (E, Q).
    """
    s, ds = element_functions(body, elements, points)
    E = body.reference[body.connectivity[elements]]
    subscripts = "esk,qsl->eqkl" if len(ds) == 1 else "esk,eqsl->eqkl"
    J0 = np.einsum(subscripts, E, ds[0] if len(ds) == 1 else ds, optimize=True)
    return s, ds, J0, np.linalg.det(J0)


def shape_gradients(ds: np.ndarray, J0: np.ndarray) -> np.ndarray:
    """h_i = J0^-T ds_i/dxi, (E, Q, S, 3)."""
    inverse = np.linalg.inv(J0)
    return np.einsum("eqlk,eqsl->eqsk", inverse, np.broadcast_to(ds, (len(J0), *ds.shape[1:])), optimize=True)


def is_straight(body: Discretisation) -> np.ndarray:
    """(E,) True for elements with constant J0."""
    if not body.family.affine:
        return np.zeros(len(body.mesh.cells), dtype=bool)
    return body.mesh.straight_sided()


def mass_rule(body: Discretisation, affine: bool) -> Rule:
    """Mass rule: exact, also for curved sides; higher for a density that varies in space."""
    varying = any(callable(m.density) for _, m in body.materials)
    return body.family.mass_rule if affine and not varying else body.family.curved_mass_rule


UNIT_DENSITY = 1.0
"""Placeholder density, kg/m^3, of materials without one; uses of the mass are refused."""


def density_of(material: Material) -> Any:
    """Density of a material as given, or `UNIT_DENSITY`."""
    return UNIT_DENSITY if material.density is None else material.density


def require_density(bodies: Iterable[Discretisation], what: str) -> None:
    """Raise ModelError for the first material without a density; `what`: the purpose."""
    for body in bodies:
        for group, material in body.materials:
            if material.density is None:
                law = f"{type(material).__name__} of group {group!r}" if group else type(material).__name__
                without = ", or gravity=(0, 0, 0)" if what == "gravity" else ""
                raise ModelError(
                    f"body {body.name!r}: missing density of {law}, required by {what}: give it density=..., kg/m^3 "
                    f"(steel 7850, water 1000){without}"
                )


def density_at(
    body: Discretisation, elements: np.ndarray, s: np.ndarray, conn: np.ndarray, number: float | None = None
) -> np.ndarray:
    """(E, Q) density of elements at points; `number` replaces densities that are one number."""
    out = np.empty((len(elements), s.shape[1]))
    index = body.material_of[elements]
    for k, (_, material) in enumerate(body.materials):
        rows = np.flatnonzero(index == k)
        if not len(rows):
            continue
        density = density_of(material)
        if callable(density):
            position = body.slot_kind[conn[rows]] == 0
            E = body.reference[conn[rows]] + position[:, :, None] * body.origin
            table = np.broadcast_to(s, (len(elements), *s.shape[1:]))[rows]
            X = np.einsum("eqs,esk->eqk", table, E)
            values = np.asarray(density(X.reshape(-1, 3)), dtype=float).reshape(X.shape[:2])
            if not np.all(np.isfinite(values) & (values > 0.0)):
                raise ModelError(f"body {body.name!r}: density f(X) is not positive and finite everywhere")
            out[rows] = values
        elif np.ndim(density) == 1:
            out[rows] = np.asarray(density, dtype=float)[elements[rows], None]
        else:
            out[rows] = float(density) if number is None else number
    return out


def parent_mass(family: Any) -> np.ndarray:
    """(S, S) int s_i s_j over the parent element, for families with element-independent functions."""
    s, _ = family.shape(family.mass_rule.points, np.zeros((1, len(family.node_slots), 3)))
    table = np.asarray(s[0])
    return np.einsum("q,qi,qj->ij", family.mass_rule.weights, table, table)


def law_and_coefficients(integral: EnergyPart, material: Material) -> tuple[str, tuple[Any, ...]]:
    """Device law of a part of the energy, and its coefficients; arrays if those of the material are."""
    law, values = integral.law(material) if integral.law else (material.law, material.coefficients())
    assert law is not None
    return law, values


def coefficient_rows(values: Sequence[Any], material: Material, worlds: int = 1, dtype: Any = float) -> np.ndarray:
    """(worlds, NCOEF) coefficients in device layout, those of the damping last."""
    rows = np.zeros((worlds, NCOEF), dtype=dtype)
    for k, value in enumerate(values):
        rows[:, k] = value
    if material.damping:
        rows[:, -2], rows[:, -1] = material.damping.eta, material.damping.lambda_v
    return rows


def host_blocks(body: Discretisation, *, tables: bool) -> Iterator[HostBlock]:
    """Elements of a body by key; `tables`: tables of h_i for straight elements, too."""
    flat = is_straight(body)
    for k, (_, material) in enumerate(body.materials):
        damping = material.damping.form if material.damping else None
        for is_flat, rule in ((True, body.rule), (False, body.curved_rule)):
            chosen = (body.material_of == k) & (flat == is_flat)
            members = body.element_order[chosen[body.element_order]]
            if len(members):
                for part, integral in enumerate(body.family.scheme(rule)):
                    law, values = law_and_coefficients(integral, material)
                    key = BlockKey(
                        body.family.name,
                        rule,
                        part,
                        law,
                        damping if part == 0 else None,
                        is_flat and not tables,
                        integral.framed,
                    )
                    yield HostBlock(key, body, members, k, values)


_VOLUMES: weakref.WeakKeyDictionary[Discretisation, np.ndarray] = weakref.WeakKeyDictionary()
"""Values of `element_volumes` so far."""


def element_volumes(body: Discretisation) -> np.ndarray:
    """(E,) reference volumes of the elements, section and thickness included, m^3."""
    if body in _VOLUMES:
        return _VOLUMES[body]
    rule = body.family.rule(None)
    every = np.arange(len(body.mesh.cells))
    parts = [
        shape_and_jacobian(body, part, rule.points)[3] @ rule.weights
        for part in element_chunks(body, every, len(rule.weights))
    ]
    volumes = _VOLUMES[body] = np.concatenate(parts)
    volumes.flags.writeable = False
    return volumes


def orthonormal(J0: np.ndarray) -> np.ndarray:
    """Orthonormal axes (columns) from the columns of J0 (..., 3, 3) by Gram-Schmidt, the first along the first."""
    a = J0[..., 0] / np.linalg.norm(J0[..., 0], axis=-1, keepdims=True)
    b = J0[..., 1] - np.sum(J0[..., 1] * a, axis=-1, keepdims=True) * a
    b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    return np.stack([a, b, np.cross(a, b)], axis=-1)


def check_orientation(body: Discretisation, integral: EnergyPart) -> None:
    """Raise MeshError for det J0 <= 0 at an integration or tying point."""
    points = integral.rule.points
    if integral.tying:
        points = np.vstack([points, integral.tying.points])
    for part in element_chunks(body, np.arange(len(body.mesh.cells)), len(points)):
        det = shape_and_jacobian(body, part, points)[3]
        bad = np.flatnonzero((det <= 0.0).any(axis=1))
        if len(bad):
            raise MeshError(
                f"body {body.name!r} ({body.mesh.label}): element {int(part[bad[0]])} has det J0 = "
                f"{det[bad[0]].min():.3g} <= 0 at a quadrature point: it is inverted"
            )


def gather_table(conn: list[np.ndarray], slots: int) -> tuple[np.ndarray, np.ndarray]:
    """Gather table (CSR): start (slots + 1,) and contribution indices per slot.

    Contributions are ordered as `conn`, within a block as [local, elem].
    """
    flat = np.concatenate([c.T.ravel() for c in conn]) if conn else np.zeros(0, dtype=np.int64)
    order = np.argsort(flat, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(flat, minlength=slots))])
    return start.astype(np.int32), order.astype(np.int32)


def grouped_items(index: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Items with an index of 0 or more, in its order; the distinct indices, and the start of each one's items (CSR)."""
    chosen = np.flatnonzero(index >= 0)
    chosen = chosen[np.argsort(index[chosen], kind="stable")]
    distinct, count = np.unique(index[chosen], return_counts=True)
    return chosen, distinct, np.concatenate([[0], np.cumsum(count)])


def slot_graph(blocks: Iterable[Any], slots: int) -> sp.csr_matrix:
    """Pairs of slots that share an element. The mass matrix is no substitute: some of its entries are zero."""
    conn = [block.connectivity for block in blocks]
    count, width = sum(len(c) for c in conn), np.concatenate([np.full(len(c), c.shape[1]) for c in conn])
    rows, columns = np.repeat(np.arange(count), width), np.concatenate([c.ravel() for c in conn])
    incidence = sp.csr_matrix((np.ones(len(rows), dtype=np.int32), (rows, columns)), shape=(count, slots))
    return sp.csr_matrix(incidence.T @ incidence)


@dataclass(eq=False)
class FacetTables:
    """Shape functions of the faces of a surface, of the slots whose functions do not vanish there.

    Attributes:
        conn: (F, n) body slots; faces that have fewer repeat their first one with functions of zero.
        shape, d_a, d_b: (F, Q, n) functions and their derivatives by the two face coordinates a and b: dx/da x dx/db
            points outward.
        weights: (F, Q) of the face rules; faces with fewer points repeat their last one with weight 0.
    """

    conn: np.ndarray
    shape: np.ndarray
    d_a: np.ndarray
    d_b: np.ndarray
    weights: np.ndarray


def facet_tables(surface: SurfaceSet, parts: int = 1, rules: Mapping[int, Rule] | None = None) -> FacetTables:
    """Functions of the faces of a surface at points of each face.

    Args:
        surface: the faces.
        parts: the rule is repeated on parts x parts of a face.
        rules: rule by local face; by default the family's face rule for all.
    """
    body, faces = surface.body, surface.faces
    kinds = [int(face) for face in np.unique(faces[:, 1])]
    rule = {k: composite_rule(rules[k] if rules else body.family.face_rule, parts) for k in kinds}
    Q = max((len(r.weights) for r in rule.values()), default=0)
    parts_of_table = []
    for face in kinds:
        rows = np.flatnonzero(faces[:, 1] == face)
        pad = Q - len(rule[face].weights)
        xi, dxi = body.family.face_points(face, np.pad(rule[face].points, ((0, pad), (0, 0)), mode="edge"))
        s, ds = element_functions(body, faces[rows, 0], xi)
        values = np.stack([s, *np.einsum("eqsk,qkd->deqs", ds, dxi)])
        size = np.abs(values).max(axis=(0, 1, 2))
        used = np.flatnonzero(size > 1e-12 * size.max())
        parts_of_table.append((rows, used, values[..., used], np.pad(rule[face].weights, (0, pad))))
    width = max((len(used) for _, used, _, _ in parts_of_table), default=0)
    conn, weights = np.empty((len(faces), width), dtype=np.int64), np.empty((len(faces), Q))
    table = np.zeros((3, len(faces), Q, width))
    for rows, used, values, rule_weights in parts_of_table:
        slots = np.pad(used, (0, width - len(used)), constant_values=used[0])
        conn[rows] = body.connectivity[faces[rows, 0, None], slots]
        table[:, rows, :, : len(used)] = values
        weights[rows] = rule_weights
    return FacetTables(conn, table[0], table[1], table[2], weights)


def at_points(functions: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(F, Q, 3) sums of slot values (F, n, 3) with functions (F, Q, n); einsum of all components takes four times as
    long."""
    return np.stack([np.einsum("fqi,fi->fq", functions, values[:, :, k]) for k in range(3)], axis=2)


def facet_positions(body: Discretisation, t: FacetTables) -> np.ndarray:
    """(F, Q, 3) reference positions of face points, m."""
    return at_points(t.shape, body.reference[t.conn]) + body.origin


def facet_area_vectors(body: Discretisation, t: FacetTables) -> np.ndarray:
    """(F, Q, 3) outward vectors dX/da x dX/db at face points, m^2."""
    out = np.empty((*t.weights.shape, 3))
    for first in range(0, len(out), MAX_CHUNK_FACETS):
        rows = slice(first, first + MAX_CHUNK_FACETS)
        x = body.reference[t.conn[rows]]
        out[rows] = np.cross(at_points(t.d_a[rows], x), at_points(t.d_b[rows], x))
    return out


def facet_areas(body: Discretisation, t: FacetTables) -> np.ndarray:
    """(F, Q) reference areas of face points, m^2."""
    return np.asarray(np.linalg.norm(facet_area_vectors(body, t), axis=2) * t.weights)


def surface_weights(surface: SurfaceSet) -> tuple[np.ndarray, np.ndarray]:
    """Body slots, and integrals of their functions over a surface, curved or flat (m^2; m^3 for gradients)."""
    t = facet_tables(surface)
    weights = np.einsum("fq,fqi->fi", facet_areas(surface.body, t), t.shape)
    slots, inverse = np.unique(t.conn, return_inverse=True)
    return slots, np.bincount(inverse.ravel(), weights=weights.ravel(), minlength=len(slots))


def rigid_modes(x: np.ndarray, kind: np.ndarray) -> np.ndarray:
    """(6, slots, 3) rigid-body modes of slots with values x: translations, and rotations about the mean position."""
    modes = np.zeros((6, len(x), 3))
    position = kind == 0
    arm = x.copy()
    arm[position] -= x[position].mean(axis=0)
    for k in range(3):
        modes[k, position, k] = 1.0
        axis = np.zeros(3)
        axis[k] = 1.0
        modes[3 + k] = np.cross(axis, arm)
    return modes


def connected_components(graph: Any) -> np.ndarray:
    """(n,) connected component of each row of a symmetric sparse matrix."""
    return sp.csgraph.connected_components(graph, directed=False)[1]


def greedy_colouring(graph: sp.csr_matrix) -> np.ndarray:
    """Greedy colouring (n,) of the items of a symmetric graph: neighbours differ."""
    colour = np.full(graph.shape[0], -1)
    for k in range(len(colour)):
        taken = set(colour[graph.indices[graph.indptr[k] : graph.indptr[k + 1]]].tolist())
        colour[k] = next(c for c in itertools.count() if c not in taken)
    return colour
