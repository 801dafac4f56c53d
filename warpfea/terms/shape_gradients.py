"""Derivatives of a loss by the reference values of the slots, "mesh.X": positions, and gradients of ANCF elements.

They are those at fixed displacements, of the discretisation as built: rules, parent coordinates of material points and
the sizes of ANCF elements (`Discretisation.frames`) stay.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..kernels.elements.materials import DEFINED_FOR_ANY_J
from ..kernels.elements.points import block_struct
from ..kernels.elements.shape_gradient import shape_gradient_kernels, tied_shape_gradient_kernel, tied_shape_struct
from ..kernels.terms.shape_gradients import shape_kernels
from ..model import assembly
from ..model.blocks import tangent_damping
from ..model.masses import has_constant_density
from .gradients import FOUR_POINTS, Gradient, StepAdjoint, compile_kernels, with_fields

if TYPE_CHECKING:
    from ..model.blocks import Block
    from ..model.description import Probe
    from ..model.handles import SurfaceSet
    from ..model.model import Model
    from .term import StepContext

__all__ = ["MESH", "MeshGradient", "internal_force_gradient", "mass_gradient", "not_shaped", "traction_gradient"]

MESH = "mesh.X"
RELATIVE_STEP = 1e-3
"""Change of J0 in differences of fourth order of the couplings of assumed strains: both errors are near 1e-13."""


class MeshGradient:
    """Derivative by the reference values of a model.

    Raises:
        ModelError: a term without one, by name.
    """

    def __init__(self, ctx: StepContext) -> None:
        self.model = m = ctx.model
        self.makers: list[Callable[[], Gradient]] = []
        for term in m.terms:
            found = term.shape_gradients(ctx)
            if isinstance(found, str):
                raise ModelError(f"Adjoint: {MESH!r} has no derivative with {term.name!r}: {found}")
            self.makers += found
        self.makers += m.terms.supports.shape_gradients()
        self.kernels = shape_kernels(m.dtype)
        compile_kernels(m, [self.kernels.probe_shape])
        self.reference: wp.array = wp.array(np.tile(m.slot_table.reference, (m.worlds, 1, 1)), dtype=m.types.vec3,
                                            device=m.device)  # fmt: skip
        self.all_worlds = wp.ones(m.worlds, dtype=wp.int32, device=m.device)
        self._of_probes: dict[str, list[wp.array]] = {}

    def zeros(self) -> wp.array:
        """[world, slot] derivatives."""
        return wp.zeros_like(self.reference)

    def add_probes(
        self, launch: Any, probes: Mapping[str, Any], k: int, end: Mapping[str, wp.array], out: wp.array
    ) -> None:
        """Direct derivatives by the probes at a step: of their reference positions, and of the weights of surfaces."""
        m, x, at = self.model, self.reference, self.all_worlds
        u, v = end["displacement"], end["velocity"]
        for given in m.description.probes:
            if given.name not in probes:
                continue
            probe = probes[given.name]
            args = [probe.slot, probe.weight, k, probe.position.grad, out]
            launch(self.kernels.probe_shape, (m.worlds, len(probe.slot)), args)
            d, s, p = probe.displacement, probe.velocity, probe.position
            for array, values in ((d, u), (s, v), (p, u), (p, x)) if given.surface else ():
                bars: wp.array = wp.array(array.grad[:, k : k + 1], dtype=wp.vec3d)
                args = [*self._probe_tables(given), bars, values, at, out]
                launch(self.kernels.dead_load_shape, x.shape, args)

    def _probe_tables(self, given: Probe) -> list[wp.array]:
        """Derivatives of the weights of a probe of a surface, the integrals of its functions over their sum."""
        if given.name not in self._of_probes:
            assert given.surface is not None
            i, j, change = surface_weight_gradients(given.surface)
            total, first = np.zeros((given.body.slot_count, 3)), given.body.slot_offset
            np.add.at(total, j, (given.body.slot_kind[i] == 0)[:, None] * change)
            moved = np.flatnonzero(total.any(axis=1))
            i = np.concatenate([i, np.repeat(given.slots, len(moved))])
            j = np.concatenate([j, np.tile(moved, len(given.slots))])
            mean = np.einsum("i,jk->ijk", -given.weights, total[moved]).reshape(-1, 3)
            change = np.concatenate([change, mean]) / given.area
            self._of_probes[given.name] = by_slot(self.model, i + first, j + first, change)
        return self._of_probes[given.name]


def not_shaped(ctx: StepContext) -> str:
    """Feature of the elements without a derivative by their reference, or ""."""
    m = ctx.model
    if ctx.midpoint and (ctx.dissipation or any(b.key.law not in DEFINED_FOR_ANY_J for b in m.blocks)):
        return "steps of energy_momentum but of stresses linear in the strain"
    if any(b.couplings_per_world for b in m.blocks):
        return "nu of beams and shells with remedies against locking differs between worlds"
    if any(not has_constant_density(law) and callable(law.density) for body in m.bodies for _, law in body.materials):
        return "a density is a function of X"
    if any(mass.inertia for body in m.bodies for mass in body.point_masses):
        return "a point mass has an inertia"
    return ""


def internal_force_gradient(ctx: StepContext) -> Gradient:
    """Of the internal force."""
    m, points, tied = ctx.model, [], []
    for block in m.blocks:
        key, dtype = block.key, m.dtype
        if key.tying:
            kernel = tied_shape_gradient_kernel(
                dtype, block.slots, block.points, key.tying.width, key.framed, ctx.midpoint
            )
            tied.append((block, kernel, tied_shape(m, block)))
        else:
            damping = tangent_damping(key.damping, midpoint=ctx.midpoint) if ctx.inertia else None
            kind = (key.law, block.slots, key.affine, damping, key.framed, ctx.midpoint)
            points.append((block, shape_gradient_kernels(dtype, *kind)))
    compile_kernels(m, [*(k.shape_gradient for _, k in points), *(kernel for _, kernel, _ in tied)])
    past = [(b, k) for b, k in points if b.key.damping == "incremental" and ctx.inertia and not ctx.midpoint]

    def add(at: StepAdjoint, out: wp.array) -> None:
        w, launch = at.ctx.work, at.ctx.launch
        w.contribution.zero_()
        for block, k in points:
            args = [block.data, w.stage, at.w, at.active, w.contribution]
            launch(k.shape_gradient, (m.worlds, block.count), args)
        for block, kernel, shape in tied:
            launch(
                kernel,
                (m.worlds, block.count),
                [block.data, shape, w.u_stage, w.v_stage, at.w, at.active, w.contribution],
            )
        collect(at, out)
        for name, x, scale in at.history_fields() if past else ():
            w.contribution.zero_()
            for block, k in past:
                args = [block.data, w.u, getattr(at.ctx.state, name), x, scale, at.w, w.step.dq_dv, at.active]
                launch(k.history_shape, (m.worlds, block.count), [*args, w.contribution])
            collect(at, out)

    return add


def collect(at: StepAdjoint, out: wp.array) -> None:
    """out += contributions of the elements."""
    at.gather(at.scratch)
    at.ctx.launch(at.kernels.add_vector, at.dim, [at.scratch, at.active, out])


def tied_shape(m: Model, block: Block) -> Any:
    """Geometry of a block of assumed strains."""
    tying, S = block.key.tying, block.slots
    assert tying is not None
    gradients, axes, changes = [], [], []
    for host in block.host_blocks:
        for members in assembly.element_chunks(host.body, host.elements, S * len(tying.points) * tying.width):
            _, ds, J, _ = assembly.shape_and_jacobian(host.body, members, tying.points)
            gradients.append(assembly.shape_gradients(ds, J))
            axes.append(assembly.orthonormal(J))
            changes.append(_coupling_gradients(host, members, ds, J))
    shape, one = tied_shape_struct(m.dtype)(), np.zeros((1, 1, 1, 3))
    framed = block.key.framed
    shape.pair = wp.array(tying.pairs, dtype=wp.int32, device=m.device)
    h = np.moveaxis(np.concatenate(gradients), 0, 2) if framed else one
    shape.shape_gradient = m.memory.element_array(h, m.types.vec3)
    R = np.moveaxis(np.concatenate(axes), 0, 1) if framed else one
    shape.axes = m.memory.element_array(R if framed else np.zeros((1, 1, 3, 3)), m.types.mat33)
    change = np.concatenate(changes)
    table = np.moveaxis(change.reshape(len(change), -1, S, 3), 0, 2)
    shape.coupling_gradient = m.memory.element_array(table, m.types.vec3)
    return shape


def _coupling_gradients(host: Any, members: np.ndarray, ds: np.ndarray, J: np.ndarray) -> np.ndarray:
    """(E, ties, width, S, 3) derivatives of the couplings A by the reference values, by differences."""
    part, body = host.key.integral, host.body
    tying, rule, material = part.tying, part.rule, body.materials[host.material][1]
    _, ds_rule, J_rule, _ = assembly.shape_and_jacobian(body, members, rule.points)
    E, n, S, _ = np.broadcast_to(ds, (len(J), *ds.shape[1:])).shape
    out = np.zeros((E, n, tying.width, S, 3))
    size = np.linalg.norm(np.concatenate([J, J_rule], axis=1), axis=2).min(axis=1)  # of each column
    for i in range(S):
        both = np.concatenate([ds[:, :, i], ds_rule[:, :, i]], axis=1)
        step = RELATIVE_STEP / np.max(np.abs(both).max(axis=1) / size, axis=1)
        for c in range(3):
            for point, weight in FOUR_POINTS:
                shifted = [J.copy(), J_rule.copy()]
                for table, change in zip(shifted, (ds, ds_rule)):
                    table[:, :, c] += (point * step)[:, None, None] * change[:, :, i]
                det = np.linalg.det(shifted[1])
                A = tying.coupling(*shifted, det, rule, material, body.section)
                out[..., i, c] += (weight / step)[:, None, None] * A
    return out


def mass_gradient(ctx: StepContext) -> Gradient:
    """Of inertia and gravity."""
    m, kernels, launches = ctx.model, shape_kernels(ctx.model.dtype), []
    for block in m.blocks:
        if block.key.part == 0:  # one part of the energy represents the element
            launches.append((block, *_mass_tables(m, block)))
    loads = m.terms.dead_loads
    compile_kernels(m, [kernels.mass_shape])

    def add(at: StepAdjoint, out: wp.array) -> None:
        w, step = at.ctx.work, at.ctx.work.step
        ramp = step.load_factor if loads.gravity_law is None else wp.ones_like(step.load_factor)
        args = [m.slot_table.is_position_array, loads.gravity, ramp, w.v, w.v_tilde, step.mass_factor, at.active]
        at.ctx.launch(kernels.acceleration_of_mass, at.dim, [*args, at.scratch])
        w.contribution.zero_()
        for block, data, density in launches:
            args = [data, density, at.scratch, at.w, at.active, w.contribution]
            at.ctx.launch(kernels.mass_shape, (m.worlds, block.count), args)
        collect(at, out)

    return add


def _mass_tables(m: Model, block: Block) -> tuple[Any, wp.array]:
    """Functions, their gradients and volumes at the points of a mass rule, and densities [world or 0, elem]."""
    shapes, gradients, volumes, densities = [], [], [], []
    for host in block.host_blocks:
        rule, body = host.body.family.curved_mass_rule, host.body
        for members in assembly.element_chunks(body, host.elements, 3 * len(rule.weights)):
            s, ds, J, det = assembly.shape_and_jacobian(body, members, rule.points)
            shapes.append(s)
            gradients.append(assembly.shape_gradients(ds, J))
            rho = assembly.density_at(body, members, s, body.connectivity[members], assembly.UNIT_DENSITY)
            volumes.append(rho * det * rule.weights)
        scale = m.masses.scales[[b is body for b in m.bodies].index(True), host.material]
        densities.append(np.broadcast_to(scale[:, None], (len(scale), len(host.elements))))
    worlds = max(len(rows) for rows in densities)
    rho = np.concatenate([np.broadcast_to(rows, (worlds, rows.shape[1])) for rows in densities], axis=1)
    shape = np.concatenate(shapes) if len(shapes[0]) > 1 or block.slots > 10 else shapes[0]
    tables = {
        "shape": m.memory.element_array(np.moveaxis(shape, 0, 2), m.types.T),
        "mass_weight": m.memory.element_array(np.concatenate(volumes).T, m.types.T),
        "shape_gradient": m.memory.element_array(np.moveaxis(np.concatenate(gradients), 0, 2), m.types.vec3),
    }
    data = with_fields(block_struct(m.dtype), block.data, **tables)
    return data, m.array("mass", rho, m.types.T)


def traction_gradient(ctx: StepContext, tractions: list[tuple[SurfaceSet, int]]) -> Gradient:
    """Of the areas under dead tractions, with the numbers of their laws."""
    m, kernel = ctx.model, shape_kernels(ctx.model.dtype).dead_load_shape
    parts = []
    for surface, law in tractions:
        i, j, change = surface_weight_gradients(surface)
        parts.append((i + surface.body.slot_offset, j + surface.body.slot_offset, change, np.full(len(i), law)))
    tables = by_slot(m, *(np.concatenate(column) for column in zip(*parts)))
    compile_kernels(m, [kernel])

    def add(at: StepAdjoint, out: wp.array) -> None:
        args = [*tables, at.ctx.work.time_law_stage_values, at.w, at.active, out]
        at.ctx.launch(kernel, at.dim, args)

    return add


def by_slot(
    m: Model, i: np.ndarray, j: np.ndarray, change: np.ndarray, law: np.ndarray | None = None
) -> list[wp.array]:  # fmt: skip
    """Device tables of changes dweight_i/dX_j by slot j: start, i, law and change."""
    order = np.argsort(j, kind="stable")
    start = np.concatenate([[0], np.cumsum(np.bincount(j, minlength=m.slots))])
    numbers = np.zeros(len(i)) if law is None else law
    tables = [(start, wp.int32), (i[order], wp.int32), (numbers[order], wp.int32), (change[order], m.types.vec3)]
    return [wp.array(values, dtype=kind, device=m.device) for values, kind in tables]


def surface_weight_gradients(surface: SurfaceSet) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Body slots i and j (n,) and derivatives (n, 3) of the integrals of the functions i over a surface by X_j."""
    body, t = surface.body, assembly.facet_tables(surface)
    X = body.reference[t.conn]
    a, b = assembly.at_points(t.d_a, X), assembly.at_points(t.d_b, X)
    n = np.cross(a, b)
    n *= t.weights[:, :, None] / np.linalg.norm(n, axis=2, keepdims=True)
    sides = [np.einsum("fqi,fqj,fqk->fijk", t.shape, *pair, optimize=True)
             for pair in ((t.d_a, np.cross(b, n)), (t.d_b, np.cross(n, a)))]  # fmt: skip
    change = sides[0] + sides[1]
    i, j = (np.broadcast_to(t.conn[index], change.shape[:3]) for index in (np.s_[:, :, None], np.s_[:, None, :]))
    return i.ravel(), j.ravel(), change.reshape(-1, 3)
