"""Evaluation of forces, energy, tangent and stresses at a state for output and checks.

Scalar fields of a model at nodes and drawn points: each field is declared once, in `fields` of a term, and evaluated by
its `samples`.
"""

from __future__ import annotations

import functools
import itertools
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..base.errors import ModelError
from ..base.launch import Launcher
from ..base.memory import convert_memory_errors
from ..base.names import check_known
from ..elements import Rule, get_family
from ..kernels.common.types import precision
from ..kernels.elements.element_slots import iterate_struct
from ..kernels.elements.materials import DEFINED_FOR_ANY_J
from ..kernels.step.gather import gather_kernels
from ..model import assembly
from ..model.assembly import element_chunks, shape_and_jacobian, shape_gradients, slot_graph
from ..model.blocks import output_block
from ..model.state import State
from .elements import Elements
from .term import FieldSpec, StepContext

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["Evaluation", "field_at_nodes", "field_at_points", "find_field", "lowest_jacobian"]


class Evaluation:
    """Evaluation of a model at a state; allocates its arrays at each call."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.launch = Launcher(model.device)
        self.elements = Elements(model)

    def _zeros(self, shape: tuple[int, ...], dtype: Any) -> wp.array:
        with convert_memory_errors("an evaluation at a state", self.model.device):
            return wp.zeros(shape, dtype=dtype, device=self.model.device)

    def _gather(self, contribution: wp.array) -> np.ndarray:
        m = self.model
        out = self._zeros((m.worlds, m.slots), m.types.vec3)
        kernel = gather_kernels(m.dtype).gather_force
        self.launch(kernel, (m.worlds, m.slots), [m.topology, contribution, self._all_worlds(), out])
        return out.numpy()

    def _all_worlds(self) -> wp.array:
        return wp.ones(self.model.worlds, dtype=wp.int32, device=self.model.device)

    def _step_context(self, u: wp.array) -> StepContext:
        """Step context of the element term: the elastic part at displacements u (worlds, slots)."""
        m, B = self.model, u.shape[0]
        least = [wp.full(B, 1e30, dtype=wp.float64, device=m.device) for _ in range(2)]
        none: Any = None
        stage = iterate_struct(m.dtype)()
        stage.u = stage.v = u
        stage.history = self._zeros((1, 1), m.types.sym)
        stage.dq_dv = wp.ones(B, dtype=wp.float64, device=m.device)
        work: Any = SimpleNamespace(
            u=u,
            stage=stage,
            data_of=lambda block: block.data,
            contribution=self._zeros((B, m.contributions), m.types.vec3),
            energy_rows=self._zeros((2, B, m.element_count), wp.float64),
            newton=SimpleNamespace(min_J=least[0], domain_J=least[1]),
        )
        return StepContext(m, work, self.launch, state=none, u_before=none, inertia=False)

    def internal_force(self, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Elastic force [world, slot, 3], strain energy [world], smallest J [world]."""
        ctx = self._step_context(state.displacement)
        w = ctx.work
        self.elements.force(ctx, self._all_worlds())
        return self._gather(w.contribution), w.energy_rows.numpy()[0].sum(axis=1), w.newton.min_J.numpy()

    def viscous_force(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Viscous force [world, slot, 3] and dissipation rate [world]."""
        m = self.model
        contribution = self._zeros((m.worlds, m.contributions), m.types.vec3)
        power = self._zeros((m.worlds, m.element_count), wp.float64)
        for block in m.blocks:
            if block.key.damping:
                args = [block.data, state.displacement, state.velocity, self._all_worlds(), contribution, power]
                self.launch(block.kernels.viscous_force, (m.worlds, block.count), args)
        return self._gather(contribution), power.numpy().sum(axis=1)

    def minimum_jacobian(self, state: State) -> np.ndarray:
        """Smallest det F at the points (and vertices, for laws that need J > 0), [world]."""
        return self.internal_force(state)[2]

    def dissipation_rate(self, state: State) -> np.ndarray:
        """Viscous dissipation, the integral of S_vis : Edot, [world], W."""
        return self.viscous_force(state)[1]

    def constraints(self, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Constraint values [world, row], gradients [world, 3 row + side, 3] and right-hand sides [world, row] at a
        state.

        Raises:
            ModelError: a model without constraints.
        """
        return self._require_constraints().values(state)

    def constraint_values(self, state: State) -> np.ndarray:
        """Values c of all rows of the constraints, [world, row], m; those of joint k: model.constraints.rows_of[k]."""
        return self.constraints(state)[0]

    def constraint_jacobian(self, state: State, world: int = 0) -> sp.csr_matrix:
        """dc/dq of one world, (rows, 3 slots) CSR, evaluated on the device."""
        return self._require_constraints().jacobian(state, world)

    def constraint_curvature(self, state: State, multipliers: Any, direction: Any) -> np.ndarray:
        """sum multipliers_i d2c_i/dq2 times a direction (slots, 3), [world, slot, 3]; multipliers (rows,), N."""
        return self._require_constraints().curvature(state, np.asarray(multipliers), np.asarray(direction))

    def _require_constraints(self) -> Any:
        term = self.model.terms.constraints
        if term is None:
            raise ModelError("the model has no constraints")
        return term

    def tangent_matrix(self, state: State, world: int) -> sp.csr_matrix:
        """df_int/dq as CSR, by one product per colour and axis; no element has two slots of one colour."""
        m = self.model
        row = state.displacement.numpy()[world : world + 1]
        ctx = self._step_context(wp.array(row, dtype=m.types.vec3, device=m.device))
        direction = self._zeros((1, m.slots), m.types.vec3)
        flag = wp.ones(1, dtype=wp.int32, device=m.device)
        conns = [b.connectivity for b in m.blocks]
        colour = assembly.greedy_colouring(slot_graph(m.blocks, m.slots))
        rows, cols, values = [], [], []
        for c in range(int(colour.max()) + 1):
            for axis in range(3):
                host = np.zeros((1, m.slots, 3), dtype=precision(m.dtype).T._type_)
                host[0, colour == c, axis] = 1.0
                direction.assign(host)
                with m.parameters.temporarily_restricted_to_worlds(world, world + 1):
                    self.elements.tangent(ctx, direction, flag)
                out = ctx.work.contribution.numpy()[0]
                for block, conn in zip(m.blocks, conns):
                    part = out[block.contribution_offset :][: block.count * block.slots]
                    part = part.reshape(block.slots, block.count, 3)
                    elem, local = np.nonzero(colour[conn] == c)
                    column = 3 * conn[elem, local] + axis
                    f = part[:, elem, :]
                    index = 3 * conn[elem].T[:, :, None] + np.arange(3)
                    rows.append(index.ravel())
                    cols.append(np.broadcast_to(column[None, :, None], f.shape).ravel())
                    values.append(f.astype(float).ravel())
        n = 3 * m.slots
        data = (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols)))
        return sp.csr_matrix(data, shape=(n, n))

    def stresses(self, state: State, body: Any = None) -> list[tuple[Any, np.ndarray]]:
        """Cauchy stress per block (of a body) at the points, [world, point, elem, 6] as xx yy zz yz xz xy, Pa.

        With an energy in parts each block has the stress of its part; parts add up.
        """
        return [(block, stress) for block, stress, _ in self._at_points(state, body)]

    def _at_points(self, state: State, body: Any) -> list[tuple[Any, np.ndarray, np.ndarray]]:
        """Block, Cauchy stress and J [world, point, elem] of `stresses`."""
        m = self.model
        out = []
        for block in m.blocks:
            if body is not None and all(part.body is not body for part in block.host_blocks):
                continue
            if block.key.tying:
                scheme = block.key.output_scheme
                if scheme is None:
                    continue  # a shell's transverse shear stress vanishes at its faces, the output points
                block.stress_output = block.stress_output or output_block(m, block, scheme)
                block = block.stress_output
            stress = self._zeros((m.worlds, block.points, block.count), m.types.sym)
            J = self._zeros((m.worlds, block.points, block.count), m.types.T)
            kernel = block.kernels_for(m.dtype, None).point_stress
            self.launch(kernel, (m.worlds, block.count), [block.data, state.displacement, stress, J])
            out.append((block, stress.numpy(), J.numpy()))
        return out

    def sample_stress(self, state: State, body: Any) -> np.ndarray:
        """Cauchy stress at the samples of each mesh node, [world, node x sample, 6], Pa.

        Each part of the energy is fitted per element and evaluated at the samples; parts add up, elements are averaged
        by volume.
        """
        out = self._at_samples(body, [(block, stress) for block, stress, _ in self._at_points(state, body)])
        return 0.0 * out if body.rigid else out  # that of the nominal stiffness is round-off

    def sample_jacobian(self, state: State, body: Any) -> np.ndarray:
        """J = det F at the samples of each mesh node, [world, node x sample, 1], from the points of the first part of
        the energy, as `sample_stress`."""
        found = self._at_points(state, body)
        return self._at_samples(body, [(b, J[..., None]) for b, _, J in found if _is_first(b)])

    def sample_energy_density(self, state: State, body: Any) -> np.ndarray:
        """Strain energy density at the samples of each mesh node, [world, node x sample, 1], J/m^3: mean of the
        elements at the node, weighted by volume."""
        ctx = self._step_context(state.displacement)
        self.elements.force(ctx, self._all_worlds())
        energy = ctx.work.energy_rows.numpy()[0]
        found = []
        for block in self.model.blocks:
            volumes = [assembly.element_volumes(part.body)[part.elements] for part in block.host_blocks]
            own = energy[:, block.element_offset : block.element_offset + block.count]
            found.append((block, (own / np.concatenate(volumes))[:, None, :, None]))
        return self._at_samples(body, found)

    def _at_samples(self, body: Any, values: list[tuple[Any, np.ndarray]]) -> np.ndarray:
        """Values at the samples of each mesh node, [world, node x sample, k], from those of blocks: [world, point,
        elem, k], or [world, 1, elem, k] constant in each element."""
        m, family = self.model, body.family
        k = family.node_samples.shape[1]
        total = np.zeros((m.worlds, len(body.mesh.points) * k, values[0][1].shape[3]))
        weight = np.zeros(total.shape[1])
        volumes = assembly.element_volumes(body)
        for block, at_points in values:
            first = 0
            fit = _extrapolation_matrix(block.key.rule, family.node_samples.reshape(-1, 3))
            if at_points.shape[1] == 1:
                fit = np.ones((len(fit), 1))
            for part in block.host_blocks:
                members = slice(first, first + len(part.elements))
                first += len(part.elements)
                if part.body is not body:
                    continue
                at_samples = np.einsum("nq,bqek->benk", fit, at_points[:, :, members].astype(float))
                rows = (body.mesh.cells[part.elements][:, :, None] * k + np.arange(k)).reshape(len(part.elements), -1)
                v = volumes[part.elements]
                if _is_first(block):
                    np.add.at(weight, rows, v[:, None])
                for b in range(m.worlds):
                    np.add.at(total[b], rows, at_samples[b] * v[:, None, None])
        total /= np.where(weight > 0.0, weight, 1.0)[None, :, None]
        return np.broadcast_to(total[:, weight > 0.0][:, :1], total.shape) if body.rigid else total


def _is_first(block: Any) -> bool:
    """True for blocks of the first part of the energy, which has each element once; not for stress output."""
    return block.key.part == 0 and block.key.scheme not in get_family(block.key.family).output_schemes


def lowest_jacobian(model: Model, u: np.ndarray) -> tuple[float, int, str]:
    """Smallest J at points and vertices, model index and description of its element; u (slots, 3), m."""
    best, index, text = np.inf, -1, "no element"
    needs_positive_J = any(block.key.law not in DEFINED_FOR_ANY_J for block in model.blocks)
    for block in model.blocks:
        if needs_positive_J and block.key.law in DEFINED_FOR_ANY_J:
            continue  # J <= 0 is admissible
        for part in block.host_blocks:
            body = part.body
            rule = block.key.rule
            points = np.vstack([rule.points, body.family.vertices])
            for members in element_chunks(body, part.elements, len(points)):
                _, ds, J0, _ = shape_and_jacobian(body, members, points)
                U = u[body.slot_offset + body.connectivity[members]]
                F = np.eye(3) + np.einsum("esk,eqsl->eqkl", U, shape_gradients(ds, J0))
                J = np.linalg.det(F).min(axis=1)
                low = int(np.argmin(np.where(np.isnan(J), -np.inf, J)))
                if not J[low] >= best:
                    best, index = float(J[low]), body.element_offset + int(members[low])
                    text = f"element {int(members[low])} of body {body.name!r} (J = {best:.3g})"
    return best, index, text


def _extrapolation_matrix(rule: Rule, at: np.ndarray) -> np.ndarray:
    """Extrapolation matrix (n, Q) from the points of a rule to parent points (n, 3).

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


def find_field(terms: Any, name: str) -> FieldSpec:
    """Specification of a field. Raises ModelError, listing the available names, for an unknown one."""
    check_known("field", name, terms.fields)
    return terms.fields[name]


def _sample_field(terms: Any, name: str, body: Any, state: State) -> np.ndarray:
    """Samples of a field, joined over its terms; nodal values are repeated at each sample.

    Raises:
        ModelError: an unknown field, or a term returns another shape.
    """
    spec, count = find_field(terms, name), body.family.node_samples.shape[1]
    nodes = len(body.mesh.points)
    rows = body.slot_count if spec.of_slots else nodes * count if spec.node_reduction else nodes
    found = []
    for term in (term for term in terms if name in term.fields):
        values = np.asarray(term.samples(name, body, state))
        expected = (terms.model.worlds, rows)
        if values.shape[: 2 if spec.scalar else None] != expected:
            raise ModelError(f"term {term.name!r}: samples({name!r}) gave {values.shape}; expected {expected}")
        found.append(values if spec.of_slots or spec.node_reduction else np.repeat(values, count, axis=1))
    return functools.reduce(spec.join, found) if spec.join else found[0]


def field_at_nodes(terms: Any, name: str, body: Any, state: State) -> np.ndarray:
    """Values (worlds, nodes) of a field."""
    spec, values = find_field(terms, name), _sample_field(terms, name, body, state)
    if spec.scalar:
        values = spec.scalar(values)
    nodes = len(body.mesh.points)
    if spec.of_slots:
        return body.at_nodes(values[..., None])[..., 0]
    values = values.reshape(len(values), nodes, -1)
    return np.asarray(spec.node_reduction.reduce(values, axis=2) if spec.node_reduction else values[:, :, 0])


def field_at_points(terms: Any, name: str, body: Any, state: State, drawn: Any) -> np.ndarray:
    """Values (worlds, points) of a field at the points of a Skin or Drawing of the body."""
    spec, values = find_field(terms, name), _sample_field(terms, name, body, state)
    weights = drawn.slot_weights if spec.of_slots else drawn.node_weights
    values = np.stack([weights @ row for row in values])
    return spec.scalar(values) if spec.scalar else values
