"""Element blocks: device tables of elements processed by one kernel, and host tables of elements with tied strains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import warp as wp

from .. import elements
from ..kernels.elements.assumed_strain import assumed_strain_kernels
from ..kernels.elements.assumed_strain_block import assumed_strain_struct
from ..kernels.elements.element import element_kernels
from ..kernels.elements.element_clusters import cluster_size
from ..kernels.elements.exact_product import exact_product_kernel, tied_exact_product_kernel
from ..kernels.elements.materials import DEFINED_FOR_ANY_J
from ..kernels.elements.points import block_struct
from ..kernels.elements.products import predicted_stress_product
from ..kernels.elements.with_mass import with_mass_kernel
from ..materials import Material
from . import assembly
from .assembly import HostBlock, element_chunks, orthonormal, shape_and_jacobian, shape_gradients

__all__ = ["Block", "build_block", "couplings", "output_block", "output_rows", "tangent_damping"]


@dataclass(eq=False)
class Block:
    """Element block: kind, device data, source elements; one kernel launch.

    `couplings_per_world`: couplings of assumed strains differ between worlds. `det_J0`: det J0 of straight elements,
    whose mass is det J0 times one table.
    """

    key: assembly.BlockKey
    data: Any
    kernels: Any
    host_blocks: list[assembly.HostBlock]
    count: int
    points: int
    slots: int
    contribution_offset: int
    element_offset: int
    cluster_size: int
    body_force_rule: Any = None
    stress_output: Any = None
    couplings_per_world: bool = False
    det_J0: np.ndarray | None = None

    @property
    def connectivity(self) -> np.ndarray:
        """(elements, slots per element) slots of the model, on the host."""
        return np.concatenate([p.conn + p.body.slot_offset for p in self.host_blocks])

    @property
    def with_mass(self) -> bool:
        """True if the mass is that of the elements, a number times one table."""
        return self.key.affine and not any(
            p.body.point_masses or callable(p.body.materials[p.material][1].density) for p in self.host_blocks
        )

    def kernels_for(self, dtype: str, damping: str | None, midpoint: bool = False, dissipative: bool = False) -> Any:
        """The kernels of this kind of element with another form of damping; `midpoint`: of the conserving scheme,
        `dissipative`: of its dissipative form."""
        k = self.key
        if k.tying and midpoint:
            return assumed_strain_kernels(
                dtype, self.slots, self.points, k.tying.width, midpoint, self.couplings_per_world, dissipative
            )
        if k.tying:
            return self.kernels
        damping = tangent_damping(damping, midpoint=midpoint)
        return element_kernels(dtype, k.law, self.slots, k.affine, damping, k.framed, midpoint, dissipative)

    def dissipative_data(self, dtype: str, dissipation: float) -> Any:
        """Constants for the dissipative mid-point scheme with its chi."""
        kind = assumed_strain_struct if self.key.tying else block_struct
        out = kind(dtype, True)()
        for name in kind(dtype).vars:
            setattr(out, name, getattr(self.data, name))
        out.dissipation = dissipation
        return out

    def use_couplings_per_world(self, dtype: str) -> None:
        """Select the kernels that read couplings per world."""
        assert self.key.tying is not None
        self.couplings_per_world = True
        self.kernels = assumed_strain_kernels(dtype, self.slots, self.points, self.key.tying.width, False, True)

    def predicted_stress_product(self, dtype: str) -> wp.Kernel:
        """Kernel of K p with the stress of the linear prediction, without viscosity."""
        k = self.key
        if k.tying:
            return self.kernels.predicted_stress_product
        return predicted_stress_product(dtype, k.law, self.slots, k.affine, k.framed)

    def exact_product(self, dtype: str, damping: str | None, midpoint: bool, dissipative: bool) -> wp.Kernel:
        """Kernel of products with the exact tangent or its transpose, where `tangent_product` is not that."""
        k = self.key
        if k.tying:
            kind = (self.slots, self.points, k.tying.width, midpoint, self.couplings_per_world, dissipative)
            return tied_exact_product_kernel(dtype, *kind)
        damping = tangent_damping(damping, midpoint=midpoint)
        return exact_product_kernel(dtype, k.law, self.slots, k.affine, damping, k.framed, midpoint, dissipative)

    def with_mass_product(
        self, dtype: str, damping: str | None, midpoint: bool = False, dissipative: bool = False
    ) -> wp.Kernel:
        """Kernel of the product of a with_mass block, with a form of damping; others: see `kernels_for`."""
        k, damping = self.key, tangent_damping(damping, midpoint=midpoint)
        kind = (k.law, self.slots, self.points, damping, k.vertex, self.cluster_size)
        return with_mass_kernel(dtype, *kind, midpoint, dissipative)


def tangent_damping(damping: str | None, *, midpoint: bool = False) -> str | None:
    """Form of damping in element kernels: explicit damping is a load, see warpfea/terms/elements.py; incremental and
    rate forms of the conserving scheme have Edot = (E1 - E0)/h."""
    return None if damping == "explicit" else "rate" if damping == "incremental" and midpoint else damping


def build_block(model: Any, key: assembly.BlockKey, parts: list[assembly.HostBlock]) -> Block:
    """Block of a key; its contributions, elements and strain history follow those of the model's blocks so far."""
    family = elements.get_family(key.family)
    conn = np.concatenate([p.conn + p.body.slot_offset for p in parts])
    data = (assumed_strain_struct if key.tying else block_struct)(model.dtype)()
    rows = np.concatenate([np.full(len(p.elements), p.coefficient_row) for p in parts])
    model.memory.fill(data, "elements", conn=conn.T, is_position=family.slot_kind == 0, material=rows)
    data.coefficients = model.parameters.coefficients
    data.contribution_offset, data.element_offset = model.contributions, model.element_count
    data.history_offset = model.history_count
    data.count = len(conn)
    det = None
    if key.tying:
        _tied_tables(model, data, key, parts)
        points = len(key.tying.points)
        kernels = assumed_strain_kernels(model.dtype, family.slots, points, key.tying.width)
    else:
        det = _point_tables(model, data, key, parts)
        points = len(key.rule.weights)
        kind = (key.law, family.slots, key.affine, tangent_damping(key.damping), key.framed)
        kernels = element_kernels(model.dtype, *kind, False, False)
    cluster = cluster_size(model.dtype, len(conn), fit=model.device.is_cuda)
    sizes = len(conn), points, family.slots
    return Block(key, data, kernels, parts, *sizes, model.contributions, model.element_count, cluster, det_J0=det)


def output_block(model: Any, block: Block, scheme: str) -> Block:
    """Elements of a tied block with their strains at the points of an output scheme."""
    key = replace(block.key, scheme=scheme, part=0, law="orthotropic", framed=True)
    parts = [assembly.HostBlock(key, host.body, host.elements, host.material, ()) for host in block.host_blocks]
    data = block_struct(model.dtype)()
    data.conn, data.is_position, data.count = block.data.conn, block.data.is_position, block.count
    index = np.concatenate([np.full(len(p.elements), k) for k, p in enumerate(parts)])
    model.memory.fill(data, "output", coefficients=output_rows(model, block), material=index)
    _point_tables(model, data, key, parts)
    points = len(key.rule.weights)
    kernels = element_kernels(model.dtype, key.law, block.slots, False, None, True, False, False)
    return Block(key, data, kernels, parts, block.count, points, block.slots, 0, 0, block.cluster_size)


def output_rows(model: Any, block: Block) -> np.ndarray:
    """(worlds or 1, parts, NCOEF) coefficients of the elements of an output block."""
    scheme = block.key.output_scheme
    assert scheme is not None
    integral = replace(block.key, scheme=scheme, part=0).integral
    worlds = model.parameters.coefficients.shape[0]
    rows = []
    for host in block.host_blocks:
        material = model.parameters.material_of_worlds(host.body, host.material)
        _, values = assembly.law_and_coefficients(integral, material)
        rows.append(assembly.coefficient_rows(values, material, worlds))
    return np.stack(rows, axis=1)


def _tied_tables(model: Any, data: Any, key: assembly.BlockKey, parts: list[assembly.HostBlock]) -> None:
    """Tables of elements with tied strains."""
    T, vec3 = model.types.T, model.types.vec3
    tables = [
        tied_tables(part, members)
        for part in parts
        for members in assembly.element_chunks(part.body, part.elements, len(key.rule.weights))
    ]
    assert key.tying is not None
    names = [("derivative_a", T), ("X_a", vec3), ("coupling", T)]
    normal = np.array_equal(*key.tying.pairs.T)
    if not normal:
        names += [("derivative_b", T), ("X_b", vec3)]
    for name, dtype in names:
        table = np.concatenate([t[name] for t in tables])
        axis = 1 if dtype is vec3 else 2
        setattr(data, name, model.memory.element_array(np.moveaxis(table, 0, axis), dtype))
    if normal:  # strains x_a . x_a
        data.derivative_b, data.X_b = data.derivative_a, data.X_a


def _point_tables(model: Any, data: Any, key: assembly.BlockKey, parts: list[assembly.HostBlock]) -> np.ndarray | None:
    """Gradients, weights, maps and axes at the points of elements; det J0 if the mass is det J0 times a table."""
    T, vec3, mat33 = model.types.T, model.types.vec3, model.types.mat33
    family, rule = elements.get_family(key.family), key.rule
    Q = len(rule.weights)
    points = np.vstack([rule.points, family.vertices])
    h, w, J0, axes = [], [], [], []
    det_J0 = None
    for part in parts:
        for members in assembly.element_chunks(part.body, part.elements, len(points)):
            if key.affine:
                _, _, J, det = assembly.shape_and_jacobian(part.body, members, family.vertices[:1])
                J0.append(np.linalg.inv(J[:, 0]))
                w.append(det[:, 0])
            else:
                _, ds, J, det = assembly.shape_and_jacobian(part.body, members, points)
                h.append(assembly.shape_gradients(ds, J))
                w.append(det[:, :Q] * rule.weights)
                if key.framed:
                    axes.append(assembly.orthonormal(J[:, :Q]))
    if key.affine:
        _, ds = family.shape(points, np.zeros((1, len(family.node_slots), 3)))
        table = ds[0][:, :, None, :]
        data.J0_inv = model.memory.element_array(np.concatenate(J0).reshape(-1, 9).T, T)
        data.det_J0 = model.array("elements", np.concatenate(w), T)
        if not any(callable(p.body.materials[p.material][1].density) for p in parts):
            data.parent_mass = model.array("elements", assembly.parent_mass(family), T)
            det_J0 = np.concatenate(w)
            data.density_det_J0 = model.array("elements", model.masses.element_masses(parts, det_J0), T)
        data.quadrature_weight = model.array("elements", rule.weights[:, None], T)
    else:
        table = np.moveaxis(np.concatenate(h), 0, 2)
        data.quadrature_weight = model.memory.element_array(np.concatenate(w).T, T)
    data.shape_gradient = model.memory.element_array(table[:Q], vec3)
    if key.law not in DEFINED_FOR_ANY_J:
        data.vertex_shape_gradient = model.memory.element_array(table[Q:], vec3)
    if key.framed:
        data.material_axes = model.memory.element_array(np.moveaxis(np.concatenate(axes), 0, 1), mat33)
    return det_J0


def tied_tables(host: HostBlock, elements: np.ndarray) -> dict[str, np.ndarray]:
    """Tables of elements with tied strains e_t = x_a . x_b - X_a . X_b (see kernels/elements/assumed_strain.py).

    Returns:
        derivative_a, derivative_b: (E, n, S) derivatives of s_i along a and b at the tying points.
        X_a, X_b: (E, n, 3) X_a and X_b.
        coupling: (E, n, width) A of the energy (mu/2) e.A e.
    """
    part, body = host.key.integral, host.body
    tying = part.tying
    assert tying is not None
    _, ds, J, _ = shape_and_jacobian(body, elements, tying.points)
    along = J
    if part.framed:
        along = orthonormal(J)
        ds = shape_gradients(ds, J) @ along
    t = np.arange(len(tying.points))
    a, b = tying.pairs.T
    coupling = _coupling(host, elements, J, [body.materials[host.material][1]])[0]
    out = {f"derivative_{name}": np.moveaxis(ds[:, t, :, k], 0, 1) for name, k in (("a", a), ("b", b))}
    out |= {f"X_{name}": np.moveaxis(along[:, t, :, k], 0, 1) for name, k in (("a", a), ("b", b))}
    return out | {"coupling": coupling}


def couplings(host: HostBlock, materials: Sequence[Material]) -> np.ndarray:
    """(materials, E, n, width) A of the tied elements of a block for other materials."""
    tying, rule = host.key.tying, host.key.rule
    assert tying is not None
    members = element_chunks(host.body, host.elements, len(rule.weights))
    tables = [_coupling(host, e, shape_and_jacobian(host.body, e, tying.points)[2], materials) for e in members]
    return np.concatenate(tables, axis=1)


def _coupling(host: HostBlock, elements: np.ndarray, J: np.ndarray, materials: Sequence[Material]) -> np.ndarray:
    part, body = host.key.integral, host.body
    tying = part.tying
    assert tying is not None
    _, _, J_rule, det = shape_and_jacobian(body, elements, part.rule.points)
    return np.stack([tying.coupling(J, J_rule, det, part.rule, material, body.section) for material in materials])
