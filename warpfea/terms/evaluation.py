"""Evaluation of forces, energy, tangent and stresses at a state for output and checks."""

from __future__ import annotations

from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..base.errors import ModelError
from ..base.launch import Launcher
from ..base.memory import convert_memory_errors
from ..kernels.common.types import precision
from ..kernels.elements.element_slots import iterate_struct
from ..kernels.elements.materials import DEFINED_FOR_ANY_J
from ..kernels.step.gather import gather_kernels
from ..model import assembly
from ..model.assembly import element_chunks, shape_and_jacobian, shape_gradients, slot_graph
from ..model.blocks import output_block
from ..model.state import State
from .elements import Elements
from .samples import Samples
from .term import StepContext

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["Evaluation", "lowest_jacobian"]

SMALL_TURN = 1e-3
"""Factor of skew changes in `stress_stiffness`, whose square is the relative error."""


class Evaluation:
    """Evaluation of a model at a state; allocates its arrays at each call."""

    def __init__(self, model: Model) -> None:
        self.model = model
        self.launch = Launcher(model.device)
        self.elements = Elements(model)
        self.samples = Samples(model)

    def zeros(self, shape: tuple[int, ...], dtype: Any) -> wp.array:
        """Array of zeros on the device."""
        with convert_memory_errors("an evaluation at a state", self.model.device):
            return wp.zeros(shape, dtype=dtype, device=self.model.device)

    def _gather(self, contribution: wp.array) -> np.ndarray:
        m = self.model
        out = self.zeros((m.worlds, m.slots), m.types.vec3)
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
        stage.history = self.zeros((1, 1), m.types.sym)
        stage.dq_dv = wp.ones(B, dtype=wp.float64, device=m.device)
        work: Any = SimpleNamespace(
            u=u,
            stage=stage,
            data_of=lambda block: block.data,
            contribution=self.zeros((B, m.contributions), m.types.vec3),
            energy_rows=self.zeros((2, B, m.element_count), wp.float64),
            newton=SimpleNamespace(min_J=least[0], domain_J=least[1]),
        )
        return StepContext(m, work, self.launch, state=none, u_before=none, inertia=False)

    def internal_force(self, state: State) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Elastic force [world, slot, 3], strain energy [world], smallest J [world]."""
        ctx = self._step_context(state.displacement)
        w = ctx.work
        self.elements.force(ctx, self._all_worlds())
        return self._gather(w.contribution), w.energy_rows.numpy()[0].sum(axis=1), w.newton.min_J.numpy()

    def element_energies(self, state: State) -> np.ndarray:
        """Strain energies (worlds, elements of all blocks), J."""
        ctx = self._step_context(state.displacement)
        self.elements.force(ctx, self._all_worlds())
        return ctx.work.energy_rows.numpy()[0]

    def element_forces(self, state: State, body: Any) -> np.ndarray:
        """Elastic forces (worlds, elements, slots of an element, 3) of the elements of a body on their slots, N."""
        ctx = self._step_context(state.displacement)
        self.elements.force(ctx, self._all_worlds())
        contribution = ctx.work.contribution.numpy().astype(float)
        out = np.zeros((self.model.worlds, len(body.mesh.cells), body.connectivity.shape[1], 3))
        for block in self.model.blocks:
            own = contribution[:, block.contribution_offset :][:, : block.count * block.slots]
            own = own.reshape(len(out), block.slots, block.count, 3)
            first = 0
            for part in block.host_blocks:
                if part.body is body:
                    out[:, part.elements] += np.swapaxes(own[:, :, first : first + len(part.elements)], 1, 2)
                first += len(part.elements)
        return out

    def viscous_force(self, state: State) -> tuple[np.ndarray, np.ndarray]:
        """Viscous force [world, slot, 3] and dissipation rate [world]."""
        contribution, power = self._viscous(state)
        return self._gather(contribution), power.numpy().sum(axis=1)

    def element_losses(self, state: State) -> np.ndarray:
        """Viscous dissipation (worlds, elements of all blocks), W."""
        return self._viscous(state)[1].numpy()

    def _viscous(self, state: State) -> tuple[wp.array, wp.array]:
        """Viscous contributions of the elements, N, and power lost by each, W."""
        m = self.model
        contribution = self.zeros((m.worlds, m.contributions), m.types.vec3)
        power = self.zeros((m.worlds, m.element_count), wp.float64)
        for block in m.blocks:
            if block.key.damping:
                args = [block.data, state.displacement, state.velocity, self._all_worlds(), contribution, power]
                self.launch(block.kernels.viscous_force, (m.worlds, block.count), args)
        return contribution, power

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
        row = state.displacement.numpy()[world : world + 1]
        return self._assemble(self._step_context(self._row(row)), self.elements.tangent, world)

    def stress_stiffness(self, state: State, world: int) -> sp.csr_matrix:
        """Geometric stiffness at rest of the second Piola-Kirchhoff stress of small displacements u.

        A predicted stress lacks C : d^T d / 2 of the last change d, and S''(d, d) / 2: those of u. With d = V X + a V u
        and V X - a V u the difference is 2 a C : sym(V^T V du/dX), and S'' cancels where V is skew and d and -d count.
        Products of that kind give the sum of all without the turn of the elements.
        """
        m = self.model
        u = state.displacement.numpy()[world : world + 1].astype(float)
        place = m.slot_table.reference[None]
        a = np.abs(place).max() / (np.abs(u).max(initial=0.0) or 1.0)
        turns = [np.eye(3)]
        if any(block.key.law not in DEFINED_FOR_ANY_J for block in m.blocks):
            turns = [np.cross(axis, np.eye(3)) for axis in SMALL_TURN * np.concatenate([np.eye(3), -np.eye(3)])]
        share = 0.5 / (a * sum(np.trace(V.T @ V) for V in turns) / 3.0)
        steps = [((place + sign * a * u) @ V.T, -sign * share) for V in turns for sign in (1.0, -1.0)]
        out = sp.csr_matrix((3 * m.slots, 3 * m.slots))
        for step, factor in [*steps, (0.0 * u, 1.0), (u, -1.0)]:
            ctx = self._step_context(self.zeros((1, m.slots), m.types.vec3))
            stage = ctx.work.stage
            stage.v, stage.base = self._row(step), ctx.work.u
            stage.use_prediction = wp.ones(1, dtype=wp.int32, device=m.device)
            work: Any = ctx.work
            work.v, work.step, work.iterate = stage.v, stage, lambda *_, stage=stage: stage
            out = out + factor * self._assemble(ctx, self.elements.predicted_stress_tangent, world)
        return out

    def _row(self, values: np.ndarray) -> wp.array:
        return wp.array(values, dtype=self.model.types.vec3, device=self.model.device)

    def _assemble(self, ctx: StepContext, product: Any, world: int) -> sp.csr_matrix:
        """Matrix of the products of elements at a context of one world."""
        m = self.model
        direction = self.zeros((1, m.slots), m.types.vec3)
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
                    product(ctx, direction, flag)
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
        bodies = self.model.bodies if body is None else [body]
        blocks = {id(b): b for one in bodies for group in self.samples.groups(one, every_part=True) for b in group}
        return [(block, self.samples.point_values("stress", block, state).numpy()) for block in blocks.values()]

    def output_of(self, block: Any) -> Any:
        """Block of the stress output in place of a tied part of the energy; None if it has none: a shell's transverse
        shear stress vanishes at its faces, the output points."""
        if block.stress_output is None and block.key.output_scheme is not None:
            block.stress_output = output_block(self.model, block, block.key.output_scheme)
        return block.stress_output


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
