"""Quantities of the elements at nodes, drawn points and quadrature points, from which fields are made.

    stress       Cauchy stress, elastic part (6): xx yy zz yz xz xy, Pa
    gradient     deformation gradient F (9), row by row
    jacobian     det F (1)
    energy       strain energy density (1), mean of each element, J/m^3
    dissipation  power lost to material damping per volume (1), mean of each element, W/m^3

A value at a node is a weighted sum of those at the quadrature points of its elements: each element's fit, averaged by
volume over the elements of one material. Nodes between materials take the one that was given first. The sums are done
on the device, for drawn points by the product of both weights.
"""

from __future__ import annotations

import itertools
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..elements import Rule
from ..kernels.elements.output import gradient_kernel
from ..kernels.outputs.fields import field_kernels
from ..model import assembly
from ..model.state import State

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["QUANTITIES", "Samples"]

QUANTITIES = {"stress": 6, "gradient": 9, "jacobian": 1, "energy": 1, "dissipation": 1}
"""Numbers of components."""


class Samples:
    """Samples of the quantities of a model at a state.

    Attributes:
        operators: weights on the device, as long as those of the points live.
    """

    def __init__(self, model: Model) -> None:
        self.model = model
        self.operators: dict[tuple[Any, ...], tuple[Any, Any]] = {}

    def at_samples(
        self,
        name: str,
        state: State,
        body: Any,
        weights: sp.csr_matrix | None = None,
        elements: Any = None,
        worlds: int | None = None,
    ) -> np.ndarray:
        """Values (worlds, n, k) of a quantity at the samples of all mesh nodes, or of their weighted sums (n, samples).

        Args:
            elements: indices of the elements that count, by default all; nodes of no other have NaN.
            worlds: so many of the first worlds, by default all.
        """
        m = self.model
        worlds = worlds or m.worlds
        rows = len(body.mesh.points) * body.family.node_samples.shape[1] if weights is None else weights.shape[0]
        if body.rigid:
            return self._of_rigid_part(name, state, body, rows)[:worlds]
        out = np.zeros((worlds, rows, QUANTITIES[name]))
        missing = np.zeros(rows, dtype=bool)
        if name in ("energy", "dissipation"):
            for block, values in self._element_means(name, state, body):
                operator, missing = self._operators(body, [block], weights, elements, constant=True)[0]
                for world in range(worlds):
                    out[world, :, 0] += operator @ values[world]
        else:
            for group in self.groups(body, every_part=name == "stress"):
                operators = self._operators(body, group, weights, elements)
                total = None
                for block, (operator, without) in zip(group, operators):
                    missing = without
                    at_points = self.point_values(name, block, state, worlds)
                    total = self._gather(name, at_points, block, operator, total)
                assert total is not None
                out += total.numpy().reshape(out.shape)
        if elements is not None:
            out[:, missing] = np.nan
        return out

    def at_points(self, name: str, state: State, body: Any) -> np.ndarray:
        """Values (worlds, elements, points, k) at the quadrature points of the first part of the energy, in the mesh's
        order of elements; NaN where an element has fewer points."""
        m, groups = self.model, self.groups(body, every_part=name == "stress")
        count = max(block.points for block in groups[0])
        out = np.full((m.worlds, len(body.mesh.cells), count, QUANTITIES[name]), np.nan)
        if name in ("energy", "dissipation"):
            total = np.zeros(out.shape[:2])
            for block, values in self._element_means(name, state, body):
                for own, members in _members(block, body):
                    total[:, members] += values[:, own]
            return np.where(np.isnan(self.at_points("jacobian", state, body)), np.nan, total[:, :, None, None])
        rules = {e: block.key.rule for block in groups[0] for _, own in _members(block, body) for e in own}
        for block in groups[0]:
            for _, members in _members(block, body):
                out[:, members, : block.points] = 0.0
        for block in itertools.chain(*groups):
            values = self.point_values(name, block, state).numpy().astype(float)
            values = values.reshape(*values.shape[:3], -1)
            for own, members in _members(block, body):
                rule = rules[int(members[0])]
                fit = np.eye(block.points) if rule is block.key.rule else _fit(block.key.rule, rule.points)
                out[:, members, : len(fit)] += np.einsum("nq,bqek->benk", fit, values[:, :, own])
        return out

    def element_means(self, values: np.ndarray, body: Any) -> np.ndarray:
        """Means by volume (worlds, elements, k) of values at quadrature points (worlds, elements, points, k)."""
        total = np.zeros((len(values), values.shape[1], values.shape[3]))
        for block in self.groups(body, every_part=False)[0]:
            rule = block.key.rule
            for _, members in _members(block, body):
                _, _, _, det = assembly.shape_and_jacobian(body, members, rule.points)
                weight = det * rule.weights
                weight = weight / weight.sum(axis=1)[:, None]
                total[:, members] = np.einsum("eq,beqk->bek", weight, values[:, members, : block.points])
        return total

    def slot_sums(
        self, values: wp.array, weights: sp.csr_matrix, worlds: Sequence[int] | None = None, offset: int = 0
    ) -> np.ndarray:
        """Sums (worlds, n, 3) of slot vectors by weights (n, slots), of all worlds or some; no other slots or worlds
        leave the device.

        Args:
            offset: slot of the first column, of a body its own.
        """
        known, key = self.operators, ("slots", id(weights))
        if key not in known:
            slots = np.unique(weights.indices)
            at: Any = wp.array(slots + offset, dtype=wp.int32, device=values.device)
            known[key] = (at, weights[:, slots]), weakref.ref(weights, lambda _: known.pop(key, None))
        at, weights = known[key][0]
        rows: Any = None if worlds is None else wp.array(list(worlds), dtype=wp.int32, device=values.device)
        return np.stack([weights @ row for row in wp.indexedarray(values, [rows, at]).numpy().astype(float)])

    # quadrature points

    def groups(self, body: Any, *, every_part: bool) -> list[list[Any]]:
        """Blocks of a body by the part of its energy; of tied parts those of their stress output."""
        groups: dict[tuple[int, str], list[Any]] = {}
        for block in self.model.blocks:
            if all(part.body is not body for part in block.host_blocks):
                continue
            at = self.model.evaluation.output_of(block) if block.key.tying else block
            if at is not None and (every_part or block.key.part == 0):
                groups.setdefault((block.key.part, at.key.integral.name), []).append(at)
        return list(groups.values())

    def point_values(self, name: str, block: Any, state: State, worlds: int | None = None) -> wp.array:
        """Values [world, point, elem] of a block, of so many of the first worlds."""
        m, evaluation = self.model, self.model.evaluation
        shape = (worlds or m.worlds, block.points, block.count)
        if name == "gradient":
            out, kernel = (
                evaluation.zeros(shape, m.types.mat33),
                gradient_kernel(m.dtype, block.slots, block.key.affine),
            )
            evaluation.launch(kernel, shape[::2], [block.data, state.displacement, out])
            return out
        kernels = block.kernels_for(m.dtype, None)
        stress, J = evaluation.zeros(shape, m.types.sym), evaluation.zeros(shape, m.types.T)
        evaluation.launch(kernels.point_stress, shape[::2], [block.data, state.displacement, stress, J])
        return stress if name == "stress" else J

    def _element_means(self, name: str, state: State, body: Any) -> list[tuple[Any, np.ndarray]]:
        """Blocks of a body with energies or powers of their elements over the volume, (worlds, elements)."""
        m, out = self.model, []
        evaluation = m.evaluation
        per_element = evaluation.element_energies(state) if name == "energy" else evaluation.element_losses(state)
        for block in m.blocks:
            if any(part.body is body for part in block.host_blocks):
                volumes = [assembly.element_volumes(part.body)[part.elements] for part in block.host_blocks]
                own = per_element[:, block.element_offset : block.element_offset + block.count]
                out.append((block, own / np.concatenate(volumes)))
        return out

    def _of_rigid_part(self, name: str, state: State, body: Any, rows: int) -> np.ndarray:
        """A rigid part has one gradient; the stress of its nominal stiffness is round-off."""
        m = self.model
        value = np.zeros((m.worlds, QUANTITIES[name]))
        if name in ("gradient", "jacobian"):
            block = self.groups(body, every_part=False)[0][0]
            own = _members(block, body)[0][0].start
            value = self.point_values(name, block, state).numpy()[:, 0, own].reshape(m.worlds, -1).astype(float)
        return np.repeat(value[:, None], rows, axis=1)

    # weights

    def _gather(self, name: str, values: wp.array, block: Any, operator: Any, total: wp.array | None) -> wp.array:
        """Weighted sums [world, row] of the values of a block, added to those of other blocks."""
        m, kernels = self.model, field_kernels(self.model.dtype)
        start, column, weight = operator
        rows = start.shape[0] - 1
        types = {6: m.types.sym, 9: m.types.mat33, 1: m.types.T}
        gather = {6: kernels.symmetric, 9: kernels.matrices, 1: kernels.scalars}
        k, shape = QUANTITIES[name], (values.shape[0], rows)
        total = m.evaluation.zeros(shape, types[k]) if total is None else total
        m.evaluation.launch(gather[k], shape, [start, column, weight, block.count, values, total])
        return total

    def _operators(
        self, body: Any, blocks: list[Any], weights: Any, elements: Any, *, constant: bool = False
    ) -> list[tuple[Any, np.ndarray]]:
        """Weights of each block as arrays on the device, or of `constant` values in elements as a matrix; rows without
        an element. Those of all elements are kept as long as the weights."""
        m, known = self.model, self.operators
        key = (body.name, constant, id(weights), *(id(block) for block in blocks))
        if key in known and elements is None:
            return known[key][0]  # type: ignore[no-any-return]
        matrices, missing = _averages(body, blocks, elements, weights, constant=constant)
        if weights is not None:
            matrices = [(weights @ matrix).tocsr() for matrix in matrices]
            missing = np.asarray(abs(weights) @ missing).astype(bool)
        out = []
        for matrix in matrices:
            arrays: Any = matrix
            if not constant:
                parts = ((matrix.indptr, wp.int32), (matrix.indices, wp.int32), (matrix.data, m.types.T))
                arrays = [wp.array(values, dtype=dtype, device=m.device) for values, dtype in parts]
            out.append((arrays, missing))
        if elements is None:
            known[key] = out, None if weights is None else weakref.ref(weights, lambda _: known.pop(key, None))
        return out


def _members(block: Any, body: Any) -> list[tuple[slice, np.ndarray]]:
    """Positions within a block, and elements, of the parts that are of a body."""
    first, out = 0, []
    for part in block.host_blocks:
        if part.body is body:
            out.append((slice(first, first + len(part.elements)), part.elements))
        first += len(part.elements)
    return out


def _averages(
    body: Any, blocks: list[Any], elements: Any, weights: Any = None, *, constant: bool
) -> tuple[list[sp.csr_matrix], np.ndarray]:
    """Weights (samples of nodes, points x elements) of each block; samples without an element.

    Of the samples, those that the columns of `weights` (n, samples) need, a skin's being few; by default all.
    """
    family = body.family
    samples = family.node_samples.shape[1]
    rows = len(body.mesh.points) * samples
    volumes = assembly.element_volumes(body)
    if elements is not None:
        volumes = np.where(np.isin(np.arange(len(volumes)), elements), volumes, 0.0)
    used = np.full(rows, weights is None)
    if weights is not None:
        used[weights.indices] = True
    nodes = np.asarray(used.reshape(-1, samples).any(axis=1))
    near = np.flatnonzero(nodes[body.mesh.cells].any(axis=1))
    rank = np.empty(len(volumes), dtype=np.int64)
    rank[near] = np.arange(len(near))
    volumes, material_of = volumes[near], body.material_of[near]
    at = (body.mesh.cells[near][:, :, None] * samples + np.arange(samples)).reshape(len(near), -1)
    key = material_of[:, None] * rows + at
    total = np.bincount(key.ravel(), np.repeat(volumes, at.shape[1]), len(body.materials) * rows).reshape(-1, rows)
    material = np.argmax(total > 0.0, axis=0)
    size = total[material, np.arange(rows)]
    share = np.where((material[at] == material_of[:, None]) & used[at], volumes[:, None], 0.0)
    share /= np.where(size > 0.0, size, 1.0)[at]
    out = []
    for block in blocks:
        fit = np.ones((at.shape[1], 1)) if constant else _fit(block.key.rule, family.node_samples.reshape(-1, 3))
        points, parts = fit.shape[1], []
        for own, members in _members(block, body):
            here = np.isin(members, near)
            nodes = rank[members[here]]
            element, sample = np.nonzero(share[nodes])
            value = share[nodes][element, sample][:, None] * fit[sample]
            column = np.arange(points) * block.count + np.arange(own.start, own.stop)[here][element][:, None]
            row = np.broadcast_to(at[nodes][element, sample][:, None], value.shape)
            parts.append((value.ravel(), row.ravel(), column.ravel()))
        value, row, column = (np.concatenate(part) for part in zip(*parts))
        used_entries = value != 0.0
        entries = value[used_entries], (row[used_entries], column[used_entries])
        out.append(sp.csr_matrix(entries, shape=(rows, points * block.count)))
    return out, size == 0.0


def _fit(rule: Rule, at: np.ndarray) -> np.ndarray:
    """Matrix (n, Q) of the fit of an element from the points of a rule to parent points (n, 3).

    Product of Lagrange polynomials on a box; on the simplex a linear least-squares fit, or a constant with too few
    points.
    """
    if rule.counts:
        out = np.ones((len(at), 1))
        grid = rule.points.reshape(*rule.counts, 3)
        for axis in range(3):
            nodes = np.moveaxis(grid[..., axis], axis, 0).reshape(rule.counts[axis], -1)[:, 0]
            basis = np.ones((len(at), len(nodes)))
            for j, k in itertools.permutations(range(len(nodes)), 2):
                basis[:, j] *= (at[:, axis] - nodes[k]) / (nodes[j] - nodes[k])
            out = (out[:, :, None] * basis[:, None, :]).reshape(len(at), -1)
        return out
    points = rule.points
    if len(points) < 4:
        return np.full((len(at), len(points)), 1.0 / len(points))
    A = np.column_stack([np.ones(len(points)), points])
    return np.column_stack([np.ones(len(at)), at]) @ np.linalg.pinv(A)
