"""Element kernels: internal force Eq. (32), energy, tangent product and diagonal blocks, for any table element.

One thread processes one element of one world, with the functions of points.py.
"""

import functools

import warp as wp

from ..common.lanes import lane_functions, warp_minimum
from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import double_1d, double_3d, int_1d
from . import materials
from .element_slots import iterate_struct
from .matrix import matrix_kernels, scheme_suffix
from .output import output_kernels
from .points import point_functions
from .products import tangent_kernel

__all__ = ["element_kernels"]


@functools.cache
def element_kernels(
    dtype: str,
    law: str,
    slots: int,
    affine: bool,
    damping: str | None,
    framed: bool = False,
    midpoint: bool = False,
    dissipative: bool = False,
) -> KernelSet:
    """Kernels of one kind of element block.

    Args:
        dtype: precision.
        law: name in `materials.LAWS`.
        slots: per element.
        affine: straight elements with parent gradients and one J0 each; False: a table of h_i per element and point.
        damping: None, "incremental" or "rate" (implicit Kelvin-Voigt forms).
        framed: the law has axes of its own at each point, `block.material_axes`.
        midpoint: conserving scheme, see `point_functions` and kernels/elements/energy_momentum.py; u is that at the
            midpoint of the step and v half of the change of u. Energies and J are those at its end.
        dissipative: its dissipative form.
    """
    fn = point_functions(dtype, law, slots, affine, damping, framed, midpoint, dissipative)
    p = fn.types
    T, vec3, mat33, sym6 = p.T, p.vec3, p.mat33, p.sym
    t, m, Block, Local = fn.tensors, fn.law, fn.Block, fn.Local
    NS, needs_J, Iterate = fn.slots, fn.needs_J, iterate_struct(dtype)
    constant = affine and slots == 4  # F of a straight T4 is constant
    ETA_INDEX, LAMBDA_V_INDEX = materials.ETA_INDEX, materials.LAMBDA_V_INDEX
    viscous = materials.svk(dtype)
    lane_sum, row_sum = lane_functions(dtype).lane_sum, lane_functions(dtype).row_sum
    form = "affine" if affine else "framed" if framed else "table"
    name = f"element_{dtype}_{law}_{slots}_{form}_{damping}{scheme_suffix(midpoint, dissipative)}"
    module = kernel_module(name)

    @masked_kernel(module, "active")
    def internal_force(
        block: Block, iterate: Iterate, active: int_1d, lanes: int, contribution: p.vec3_2d,
        energy: double_3d, min_J: double_1d, domain_J: double_1d,
    ):  # fmt: skip
        """Internal force contributions (N), Eqs. (32) and (70), strain energy and viscous potential (J) by element.

        `lanes` threads share the quadrature points of an element. The smallest J goes to `min_J`, and for laws that
        need J > 0 that of the points to `domain_J`: the vertices, included in `min_J`, have no energy barrier.
        """
        world, index = wp.tid()
        lane = index % lanes
        elem = wp.min(index / lanes, block.count - 1)
        c = fn.coefficients(block, world, elem)
        U = fn.load_slots(block, iterate.u, world, elem)
        f = Local()
        psi = T(0.0)
        psi_v = T(0.0)
        J_low = T(1.0e30)
        V = fn.load_velocities(block, iterate.v, world, elem)
        dq = T(iterate.dq_dv[world])
        for point in range(lane, block.shape_gradient.shape[0], lanes):
            G = fn.field_gradient(block, U, point, elem)
            w = fn.point_weight(block, point, elem)
            local = fn.to_material_axes(block, G, point, elem)
            Fdot = fn.velocity_gradient(block, V, point, elem)
            P = mat33()
            if wp.static(midpoint):
                J_low = wp.min(J_low, T(1.0) + t.volume_change(local + Fdot))
                mean = fn.midpoint_stress(block, local, Fdot, c)
                P = mean + local * mean
                psi += w * m.energy(local + Fdot, c)
            else:
                J_low = wp.min(J_low, T(1.0) + t.volume_change(G))
                P = m.stress(local, c)
                psi += w * m.energy(local, c)
            if wp.static(fn.viscous):
                rate = fn.strain_rate(block, local, Fdot, iterate.history, dq, world, point, elem)
                S = t.isotropic_stress(rate, c[LAMBDA_V_INDEX], c[ETA_INDEX])
                P = P + S + local * S
                psi_v += T(0.5) * dq * w * wp.ddot(S, rate)
            f = fn.add_point_forces(block, f, fn.to_body_axes(block, P, point, elem), point, elem)
        for i in range(NS):
            f[i] = lane_sum(f[i], lanes)
        stored = row_sum(wp.float64(psi), lanes)
        lost = row_sum(wp.float64(psi_v), lanes)
        low = wp.float64(J_low)
        if wp.static(needs_J):
            lowest = warp_minimum(low, world)
            if lowest < domain_J[world]:
                wp.atomic_min(domain_J, world, lowest)
            if wp.static(not constant):
                if wp.static(midpoint):
                    U = U + V
                low = wp.min(low, wp.float64(fn.vertex_jacobian(block, U, elem)))
        low = warp_minimum(low, world)
        if low < min_J[world]:
            wp.atomic_min(min_J, world, low)
        if lane == 0 and index < block.count * lanes:
            fn.store_forces(block, f, world, elem, contribution)
            energy[0, world, block.element_offset + elem] = stored
            energy[1, world, block.element_offset + elem] = lost

    @masked_kernel(module, "active")
    def inverted_elements(block: Block, before: p.vec3_2d, u: p.vec3_2d, active: int_1d, inverted: int_1d):
        """Flag the worlds with a quadrature point that had J > 0 at `before` and has J <= 0 at u."""
        world, elem = wp.tid()
        U = fn.load_slots(block, u, world, elem)
        past = fn.load_slots(block, before, world, elem)
        for point in range(block.shape_gradient.shape[0]):
            if T(1.0) + t.volume_change(fn.field_gradient(block, U, point, elem)) <= T(0.0):
                if T(1.0) + t.volume_change(fn.field_gradient(block, past, point, elem)) > T(0.0):
                    inverted[world] = 1

    @masked_kernel(module, "active")
    def largest_gradient(block: Block, direction: p.vec3_2d, active: int_1d, gradient_norm: double_1d):
        """Largest gradient of a direction at the quadrature points, as a norm: rotation or strain per unit step."""
        world, elem = wp.tid()
        P = fn.load_slots(block, direction, world, elem)
        most = T(0.0)
        for point in range(block.shape_gradient.shape[0]):
            G = fn.field_gradient(block, P, point, elem)
            most = wp.max(most, wp.ddot(G, G))
        wp.atomic_max(gradient_norm, world, wp.float64(wp.sqrt(most)))

    tangent_product = tangent_kernel(fn, module)

    @masked_kernel(module, "active")
    def diagonal_blocks(block: Block, u: p.vec3_2d, dq_dv: double_1d, active: int_1d, contribution: p.sym_2d):
        """The 3x3 diagonal blocks of K in Voigt order, positive semi-definite at each point, for preconditioners."""
        world, elem = wp.tid()
        c = fn.coefficients(block, world, elem)
        cv = fn.damping_coefficients(c, T(1.0) / T(dq_dv[world]))
        U = fn.load_slots(block, u, world, elem)
        for i in range(NS):
            B = sym6()
            contribution[world, block.contribution_offset + i * block.count + elem] = B
        for point in range(block.shape_gradient.shape[0]):
            G = fn.field_gradient(block, U, point, elem)
            w = fn.tangent_weight(block, point, elem)
            for i in range(NS):
                a = fn.slot_gradient(block, point, i, elem)
                K = mat33()
                if wp.static(framed):
                    R = block.material_axes[point, elem]
                    K = fn.to_body_axes(
                        block, m.block(fn.to_material_axes(block, G, point, elem), wp.transpose(R) * a, c), point, elem
                    )
                else:
                    K = m.block(G, a, c)
                if wp.static(dissipative):
                    K = fn.dissipation_factor(block) * K
                if wp.static(fn.viscous):
                    K = K + viscous.block(mat33() + G, a, cv)
                entry = block.contribution_offset + i * block.count + elem
                contribution[world, entry] = contribution[world, entry] + w * fn.to_voigt(K)

    return kernel_set(vars(matrix_kernels(fn, name)) | vars(output_kernels(fn, name)) | locals())
