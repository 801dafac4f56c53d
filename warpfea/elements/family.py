"""Element family tables: slots, shape functions, quadrature, faces."""

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..base.errors import ModelError
from ..base.names import check_known, did_you_mean
from .quadrature import Rule

__all__ = [
    "AssumedStrain", "EnergyPart", "Family", "ParentDomain", "VtkSubdivision", "families", "family_for_cell",
    "get_family", "register",
]  # fmt: skip


@dataclass(frozen=True, eq=False)
class AssumedStrain:
    """Assumed strains e = 2 E_ab at tying points, and their energy (mu/2) e.A e in an element, J.

    Attributes:
        points: (n, 3) parent coordinates.
        pairs: (n, 2) directions a, b of each strain: parent lines (e is covariant), or the axes of a framed part.
        coupling: function (J0 at the points (E, n, 3, 3), J0 and det J0 at the part's rule (E, Q, 3, 3) and (E, Q), the
            rule, the material, the body's section) -> A (E, n, width).
        width: A couples the points of each run of `width` points.
        material_constants: material constants in A.
    """

    points: np.ndarray
    pairs: np.ndarray
    coupling: Callable[[np.ndarray, np.ndarray, np.ndarray, Rule, Any, Any], np.ndarray]
    width: int
    material_constants: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class EnergyPart:
    """One integral of an element's strain energy; most elements have one, locking remedies split it.

    Attributes:
        name: name in reports.
        rule: quadrature of the integral.
        law: function Material -> (device law, coefficients), or None for the material's own.
        framed: the strains are along axes of the element: its first parent line, and the others made orthonormal to it.
        tying: the energy is that of strains at tying points, and the law gives mu (or another modulus in its place);
            None: of strains at the rule.
    """

    name: str
    rule: Rule
    law: Callable[[Any], tuple[str, tuple[float, ...]]] | None = None
    framed: bool = False
    tying: AssumedStrain | None = None


@dataclass(frozen=True)
class ParentDomain:
    """The parent domain: the unit tetrahedron, or a box.

    Attributes:
        low, high: corners of the box; None for the tetrahedron.
    """

    low: tuple[float, float, float] | None = None
    high: tuple[float, float, float] | None = None

    @property
    def center(self) -> np.ndarray:
        """(3,) parent coordinates of the middle."""
        return np.full(3, 0.25) if self.low is None else 0.5 * (np.array(self.low) + np.array(self.high))

    @property
    def sides(self) -> tuple[np.ndarray, np.ndarray]:
        """Inner normals (m, 3) and bounds (m,) of the sides: normal . xi >= bound inside."""
        if self.low is None:
            return np.vstack([np.eye(3), -np.ones(3)]), np.array([0.0, 0.0, 0.0, -1.0])
        return np.vstack([np.eye(3), -np.eye(3)]), np.concatenate([self.low, -np.array(self.high)])

    def outside_distance(self, xi: np.ndarray) -> np.ndarray:
        """Outside distance of points (..., 3), (...,) in parent units; 0 inside."""
        if self.low is None:
            least = np.minimum(xi.min(axis=-1), 1.0 - xi.sum(axis=-1))
            return np.maximum(-least, 0.0)
        return np.maximum(np.maximum(np.array(self.low) - xi, xi - np.array(self.high)).max(axis=-1), 0.0)


@dataclass(frozen=True, eq=False)
class VtkSubdivision:
    """VTK drawing of an element: parent points (P, 3), meshio cell type, cells (C, n)."""

    points: np.ndarray
    cell_type: str
    cells: np.ndarray


@dataclass(frozen=True, eq=False, kw_only=True)
class Family:
    """An element family as tables: r = sum e_i s_i, F = sum e_i h_i^T (Eq. (1)) over its slots i.

    Attributes:
        name: selector, e.g. "T10".
        cell_type: mesh cell, e.g. "tetra10".
        node_slots: slot kinds of each element node; kind 0 is a position, 1..3 a gradient along the node's axes.
        shape: function (xi (Q, 3), nodes (E, n, 3)[, frames (E, n, 3, 3)]) -> (s (E or 1, Q, S),
            ds (E or 1, Q, S, 3)), ds = ds/dxi. One row if the functions are independent of the element's shape.
        rules: force quadrature rules by name; the first is the default.
        curved_rule: default force rule of curved elements (the patch test on a curved T10 needs degree 3).
        mass_rule: rule that integrates s_i s_j rho det J0 exactly on straight elements.
        curved_mass_rule: mass rule of curved elements.
        vertices: (4, 3) parent coordinates of the vertices, further test points of J.
        affine: True if J0 is constant in elements with straight sides.
        parent: the parent domain.
        faces: parent corners of each face, (3, 3) triangles or (4, 3) quadrilaterals, outward; mesh cells of solids
            count their faces in the same order.
        bulges: deviations of the sides a = 0 and a = 1 of quadrilateral faces from straight ones, (2, 2, 3): control
            points of cubics in b, off the thirds of the chords.
        face_names: of each face of a beam, in the order of its surface.
        face_shares: depth of the element behind each face, over its volume by the area of the face; () for 1.
        face_rule: rule on the unit triangle or square, exact for a pressure on a flat face.
        face_divisions: numbers (a, b) of parts of each face along its two sides for drawing; triangles take the first.
        node_samples: (n, k, 3) parent points at each element node where fields are evaluated for drawing.
        vtk_subdivision: drawing of an element in VTK.
        schemes: integrations of several parts by name; each force rule is also one of a single part.
        output_schemes: integrations that are for stress output only: "shear stress" in place of a tied part "shear".
        slot_sets: slot kinds by the name under which supports may hold them.
        spin_vectors: rotated by a moment: 3, the deformation gradient; 2, the section; 1, the director. A beam's axis
            or a shell's surface offers almost no rotational stiffness at a point, and must not carry it.
        solid: the mesh cell is the body itself; False for beams and shells, which add a section or a thickness.
        rigid: all cells of a body share four slots; not selectable as an element.
    """

    name: str
    cell_type: str
    node_slots: tuple[tuple[int, ...], ...]
    shape: Callable[..., tuple[np.ndarray, np.ndarray]]
    rules: dict[str, Rule]
    curved_rule: Rule
    mass_rule: Rule
    curved_mass_rule: Rule
    vertices: np.ndarray
    affine: bool = False
    parent: ParentDomain = ParentDomain()
    faces: tuple[np.ndarray, ...]
    bulges: dict[int, np.ndarray] = field(default_factory=dict)
    face_names: tuple[str, ...] = ()
    face_shares: tuple[float, ...] = ()
    face_rule: Rule
    face_divisions: tuple[tuple[int, int], ...]
    node_samples: np.ndarray
    vtk_subdivision: VtkSubdivision
    schemes: dict[str, tuple[EnergyPart, ...]] = field(default_factory=dict)
    output_schemes: dict[str, tuple[EnergyPart, ...]] = field(default_factory=dict)
    slot_sets: dict[str, tuple[int, ...]] = field(default_factory=dict)
    spin_vectors: int = 3
    solid: bool = True
    rigid: bool = False

    def scheme(self, name: str) -> tuple[EnergyPart, ...]:
        """The parts of the integration `name`, a scheme or a force rule. Raises KeyError."""
        known = {**self.schemes, **self.output_schemes}
        return known[name] if name in known else (EnergyPart(name, self.rules[name]),)

    @property
    def slots(self) -> int:
        """Slots per element."""
        return sum(len(kinds) for kinds in self.node_slots)

    @property
    def slot_node(self) -> np.ndarray:
        """(S,) element node of each slot."""
        return np.array([n for n, kinds in enumerate(self.node_slots) for _ in kinds])

    @property
    def slot_kind(self) -> np.ndarray:
        """(S,) kind of each slot."""
        return np.array([k for kinds in self.node_slots for k in kinds])

    @property
    def has_gradients(self) -> bool:
        """True if nodes carry gradient slots."""
        return any(k > 0 for kinds in self.node_slots for k in kinds)

    def slot_kinds_of(self, names: str) -> set[int]:
        """Slot kinds of names joined by "+", e.g. "position+axis". Raises ModelError listing the names."""
        known = {"position": (0,), **self.slot_sets, "all": (0, 1, 2, 3)}
        out: set[int] = set()
        for name in str(names).split("+"):
            if name not in known:
                raise ModelError(
                    f"slots = {names!r}: valid slots of element {self.name}: {', '.join(map(repr, known))}, or several "
                    f"joined by '+'{did_you_mean(name, known)}"
                )
            out |= set(known[name])
        return out

    def face_points(self, face: int, ab: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Parent points (Q, 3) of a face at (a, b) of the unit triangle or square (Q, 2), and dxi/d(a, b) (Q, 3, 2)."""
        c = self.faces[face]
        a, b = ab.T
        if len(c) == 3:
            xi = c[0] + a[:, None] * (c[1] - c[0]) + b[:, None] * (c[2] - c[0])
            return xi, np.broadcast_to(np.stack([c[1] - c[0], c[2] - c[0]], axis=1), (len(ab), 3, 2))
        N = np.stack([(1 - a) * (1 - b), a * (1 - b), a * b, (1 - a) * b], axis=1)
        da = np.stack([b - 1, 1 - b, b, -b], axis=1)
        db = np.stack([a - 1, -a, a, 1 - a], axis=1)
        xi, along, across = N @ c, da @ c, db @ c
        if face in self.bulges:
            d, sides = self.bulges[face], np.stack([1 - a, a], axis=1)
            f = 3 * b * (1 - b) * np.stack([1 - b, b])
            df = np.stack([3 * (1 - b) * (1 - 3 * b), 3 * b * (2 - 3 * b)])
            xi = xi + np.einsum("qi,jq,ijk->qk", sides, f, d)
            along = along + np.einsum("jq,jk->qk", f, d[1] - d[0])
            across = across + np.einsum("qi,jq,ijk->qk", sides, df, d)
        return xi, np.stack([along, across], axis=2)

    @property
    def node_points(self) -> np.ndarray:
        """(n, 3) parent coordinates of the element nodes."""
        return self.node_samples.mean(axis=1)

    def sample_weights(self, xi: np.ndarray) -> np.ndarray:
        """(Q, n k) weights of the nodes' samples for fields at xi (Q, 3): linear between corners, exact at a sample."""
        samples = self.node_samples.reshape(-1, 3)
        out = np.zeros((len(xi), len(samples)))
        if self.face_shares:  # of a beam with any section: linear in the section
            fit = np.linalg.pinv(np.insert(self.node_samples[0, :, 1:], 0, 1.0, axis=1))
            own, x = np.insert(xi[:, 1:], 0, 1.0, axis=1) @ fit, xi[:, :1]
            out = np.hstack([(1.0 - x) * own, x * own])
        elif self.parent.low is None:
            out[:, :4] = np.column_stack([1.0 - xi.sum(axis=1), xi])
        else:
            low, high = np.array(self.parent.low), np.array(self.parent.high)
            t = (xi - low) / (high - low)
            for corner in itertools.product((0.0, 1.0), repeat=3):
                at = int(np.argmin(np.abs(samples - (low + np.array(corner) * (high - low))).sum(axis=1)))
                out[:, at] = np.prod(np.where(corner, t, 1.0 - t), axis=1)
        distance = np.abs(xi[:, None, :] - samples).max(axis=2)
        for row in np.flatnonzero(distance.min(axis=1) < 1e-12):
            out[row] = 0.0
            out[row, int(np.argmin(distance[row]))] = 1.0
        return out

    def rule(self, name: str | None) -> Rule:
        """Force rule by name (None: the default). Raises ModelError listing the names."""
        if name is None:
            return next(iter(self.rules.values()))
        if name not in self.rules:
            raise ModelError(
                f"quadrature {name!r} is not a rule of element {self.name}; there are {', '.join(self.rules)}"
                f"{did_you_mean(name, self.rules)}"
            )
        return self.rules[name]


_families: dict[str, Family] = {}


def register(family: Family) -> Family:
    """Make a family selectable by its name, and return it."""
    _families[family.name] = family
    return family


def families() -> Sequence[str]:
    """Names of the registered families of flexible bodies."""
    return tuple(name for name, family in _families.items() if not family.rigid and not family.face_shares)


def known_family(name: str) -> Family | None:
    """The family `name`, if it is registered."""
    return _families.get(name)


def get_family(name: str) -> Family:
    """The family `name`. Raises ModelError listing the names."""
    check_known("element", name, _families)
    return _families[name]


def family_for_cell(cell_type: str) -> Family:
    """The default solid family of a cell type: the one with the fewest slots. Raises ModelError."""
    fits = [f for f in _families.values() if f.cell_type == cell_type and f.solid and not f.rigid]
    if fits:
        return min(fits, key=lambda f: f.slots)
    raise ModelError(f"no solid element for mesh cells of type {cell_type!r}")
