"""Mass matrices: one for all worlds, or one per world after densities were set (Model.set_parameter)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..materials import Material
from . import assembly

if TYPE_CHECKING:
    from .discretisation import Discretisation

__all__ = [
    "MassPart",
    "Masses",
    "all_mass_parts",
    "body_mass",
    "center_of_mass",
    "element_mass_matrices",
    "has_constant_density",
    "mass_parts",
]


def _entry_keys(matrix: sp.csr_matrix) -> np.ndarray:
    """Row-major indices of the entries."""
    n = np.int64(matrix.shape[0])
    return np.repeat(np.arange(n), np.diff(matrix.indptr)) * n + matrix.indices


@dataclass(frozen=True)
class MassPart:
    """Mass contribution of a material: scale x matrix.

    Attributes:
        scale: the density, kg/m^3, or 1 if it is a function or given per element.
        matrix: scalar mass matrix / scale, (slots, slots) CSR of the body.
        scaled_mass: mass / scale.
    """

    scale: float
    matrix: sp.csr_matrix
    scaled_mass: float


def has_constant_density(material: Material) -> bool:
    """True if the density of a material is one number."""
    return not callable(assembly.density_of(material)) and np.ndim(assembly.density_of(material)) == 0


def element_mass_matrices(body: Any, material: int) -> Iterator[tuple[np.ndarray, np.ndarray, float]]:
    """Chunks of the elements of a material: elements, their scalar matrices (E, S, S) of Eq. (20) over the scale of
    the material, see MassPart, and their mass over it."""
    flat = assembly.is_straight(body)
    for affine in (True, False):
        chosen = np.flatnonzero((flat == affine) & (body.material_of == material))
        rule = assembly.mass_rule(body, affine)
        for part in assembly.element_chunks(body, chosen, len(rule.weights)):
            s, _, _, det = assembly.shape_and_jacobian(body, part, rule.points)
            w = assembly.density_at(body, part, s, body.connectivity[part], assembly.UNIT_DENSITY) * det * rule.weights
            subscripts = "eq,qi,qj->eij" if len(s) == 1 else "eq,eqi,eqj->eij"
            table = s[0] if len(s) == 1 else s
            yield part, np.einsum(subscripts, w, table, table, optimize=True), float(w.sum())


def mass_parts(body: Any) -> list[MassPart]:
    """Consistent scalar mass m_ij = int rho s_i s_j dV (Eq. 20) of each material of a body."""
    if body.rigid:
        return [MassPart(body.materials[0][1].density, body.scalar_mass, body.moments[0, 0])]
    n = body.slot_count
    scales = [
        float(assembly.density_of(m)) if has_constant_density(m) else assembly.UNIT_DENSITY for _, m in body.materials
    ]
    out = []
    for k, scale in enumerate(scales):
        sums, mass = [sp.csr_matrix((n, n))], 0.0
        for part, local, total in element_mass_matrices(body, k):
            mass += total
            conn = body.connectivity[part]
            S = conn.shape[1]
            rows = np.repeat(conn, S, axis=1).ravel()
            cols = np.tile(conn, (1, S)).ravel()
            sums.append(sp.csr_matrix((local.ravel(), (rows, cols)), shape=(n, n)))
            while len(sums) > 1 and sums[-2].nnz <= 2 * sums[-1].nnz:  # a sum copies all of both
                sums[-2:] = [sums[-2] + sums[-1]]
        out.append(MassPart(scale, sum(sums[1:], sums[0]), mass))
    return out


def all_mass_parts(body: Discretisation) -> list[MassPart]:
    """Mass of each material of a body, and of its point masses, if any."""
    points = []
    if body.point_masses:
        matrix = sp.csr_matrix((body.slot_count,) * 2)
        for point in body.point_masses:
            entries = [point.slots[k.ravel()] for k in np.indices((len(point.slots),) * 2)]
            matrix = matrix + sp.csr_matrix((point.matrix.ravel(), entries), shape=matrix.shape)
        points.append(MassPart(1.0, matrix, sum(point.mass for point in body.point_masses)))
    return mass_parts(body) + points


def body_mass(body: Discretisation) -> sp.csr_matrix:
    """Consistent scalar mass matrix of a body (Eq. 20), (slots, slots) CSR, kg."""
    return sum((part.scale * part.matrix for part in all_mass_parts(body)), sp.csr_matrix((body.slot_count,) * 2))


def center_of_mass(body: Discretisation, values: np.ndarray) -> np.ndarray:
    """Centre of mass (m) of a body with slot values (slots, 3) relative to its origin."""
    position = (body.slot_kind == 0).astype(float)
    lumped = body_mass(body) @ position
    return lumped @ values / (lumped @ position) + body.origin


class Masses:
    """The consistent mass matrix (Eq. 20) as a sum over materials: density times the matrix of a density of 1.

    Densities given as functions or per element are included in the matrix, and scaled by a factor. Device arrays
    have one row per world if densities were set, else one shared row.

    Attributes:
        matrix: (slots, slots) CSR as the bodies were built, kg.
        entry_values, lumped: (worlds or 1, entries), its entries; (worlds or 1, slots), its sums over position slots.
        values, lumped_values: device copies.
    """

    def __init__(self, model: Any) -> None:
        self.model = model
        parts_of_bodies = [all_mass_parts(body) for body in model.bodies]
        self.parts = {(b, k): part for b, parts in enumerate(parts_of_bodies) for k, part in enumerate(parts)}
        # includes zeros at entries of other matrices
        patterns = [sum(abs(part.matrix) for part in parts) for parts in parts_of_bodies]
        self.matrix = sp.block_diag(patterns, format="csr")
        self.matrix.sort_indices()
        self.entry_indices = {key: self._entry_indices(key, patterns[key[0]]) for key in self.parts}
        self.scales = {key: np.array([part.scale]) for key, part in self.parts.items()}
        self._sum_over_materials()
        self.matrix = self._csr(0)
        self.values = model.array("mass", self.entry_values, model.types.T)
        self.lumped_values = model.array("slots", self.lumped, model.types.T)

    @property
    def varies_by_world(self) -> bool:
        """True with one mass matrix per world."""
        return len(self.entry_values) != 1

    def world_matrix(self, world: int) -> sp.csr_matrix:
        """(slots, slots) CSR, kg."""
        return self._csr(world % len(self.entry_values))

    def lumped_in_worlds(self, worlds: int) -> np.ndarray:
        """(worlds, slots) lumped masses, kg."""
        return np.broadcast_to(self.lumped, (worlds, self.lumped.shape[1]))

    def total_of_body(self, body: Discretisation, world: int = 0) -> float:
        """Mass of a body, kg; 0 for a material without density (statics only)."""
        if any(material.density is None for _, material in body.materials):
            return 0.0
        index = self.model.bodies.index(body)
        return sum(
            float(self.scales[key][world % len(self.scales[key])]) * part.scaled_mass
            for key, part in self.parts.items()
            if key[0] == index
        )

    def pattern_masses(self, pattern: Any) -> np.ndarray:
        """(worlds or 1, upper entries) masses of a pattern of blocks (solvers/matrix_assembly.py), kg."""
        upper = pattern.upper_entries
        if len(self.matrix.indices) == pattern.entry_count:
            return self.entry_values[:, upper[:, 0]]
        key = _entry_keys(self.matrix)
        wanted = upper[:, 2].astype(np.int64) * self.matrix.shape[0] + upper[:, 3]
        at = np.minimum(np.searchsorted(key, wanted), len(key) - 1)
        return np.where(key[at] == wanted, self.entry_values[:, at], 0.0)

    def group_masses(self, of_slot: np.ndarray, slots: np.ndarray, count: int) -> np.ndarray:
        """(worlds or 1, groups) masses of groups of position slots, kg."""
        return np.array([np.bincount(of_slot[slots], weights=row[slots], minlength=count) for row in self.lumped])

    def element_masses(self, parts: list[assembly.HostBlock], det: np.ndarray) -> np.ndarray:
        """(worlds or 1, elements) density times det J0 of a block of straight elements, kg."""
        rows, first = [], 0
        for part in parts:
            last = first + len(part.elements)
            material = part.body.materials[part.material][1]
            own = (
                assembly.UNIT_DENSITY
                if has_constant_density(material)
                else np.asarray(material.density, dtype=float)[part.elements]
            )
            scale = self.scales[self.model.bodies.index(part.body), part.material]
            rows.append(scale[:, None] * (own * det[first:last]))
            first = last
        worlds = max(len(row) for row in rows)
        return np.concatenate([np.broadcast_to(row, (worlds, row.shape[1])) for row in rows], axis=1)

    def set_densities(self, scales: dict[tuple[int, int], np.ndarray]) -> None:
        """Set densities, or factors on them, (worlds,), by body index and material index."""
        self.scales |= scales
        self._sum_over_materials()
        m, known = self.model, self.model.cache
        self.values = self._replace_array("mass", self.values, self.entry_values)
        self.lumped_values = self._replace_array("slots", self.lumped_values, self.lumped)
        m.topology.mass_value = self.values
        if "matrix" in known:
            pattern, mass = known["matrix"]
            known["matrix"] = pattern, self._replace_array("matrix pattern", mass, self.pattern_masses(pattern))
        if m.components.free_group_count:
            m.components.free_groups.mass = self._replace_array(
                "groups", m.components.free_groups.mass, self.group_masses(*known["free groups"])
            )
            m.components.free_groups.lumped_mass = self.lumped_values
        for block in m.blocks:
            if block.det_J0 is not None:
                table = self.element_masses(block.host_blocks, block.det_J0)
                block.data.density_det_J0 = self._replace_array("elements", block.data.density_det_J0, table)

    def _replace_array(self, name: str, array: wp.array, values: np.ndarray) -> wp.array:
        """Write values into a device array, or into a new one if the number of worlds differs."""
        if array.shape == values.shape:
            array.assign(values)
            return array
        self.model.memory.uncount(name, array)
        return self.model.array(name, values, self.model.types.T)

    def _sum_over_materials(self) -> None:
        """Sum the tables over materials, in the same order for any number of worlds."""
        worlds = max(len(scale) for scale in self.scales.values())
        self.entry_values = np.zeros((worlds, self.matrix.nnz))
        self.lumped = np.zeros((worlds, self.matrix.shape[0]))
        for key, scale in self.scales.items():
            body, part = self.model.bodies[key[0]], self.parts[key]
            self.entry_values[:, self.entry_indices[key]] += scale[:, None] * part.matrix.data
            rows = slice(body.slot_offset, body.slot_offset + body.slot_count)
            self.lumped[:, rows] += scale[:, None] * (part.matrix @ self.model.slot_table.is_position[rows])

    def _entry_indices(self, key: tuple[int, int], pattern: sp.csr_matrix) -> slice | np.ndarray:
        """Entry indices of a part in `matrix`, whose rows of a body have the body's pattern."""
        part = self.parts[key].matrix
        for matrix in (pattern, part):
            matrix.sort_indices()
        first = int(self.matrix.indptr[self.model.bodies[key[0]].slot_offset])
        if part.nnz == pattern.nnz:  # all of the body
            return slice(first, first + part.nnz)
        return first + np.searchsorted(_entry_keys(pattern), _entry_keys(part))

    def _csr(self, world: int) -> sp.csr_matrix:
        return sp.csr_matrix(
            (self.entry_values[world], self.matrix.indices, self.matrix.indptr), shape=self.matrix.shape
        )
