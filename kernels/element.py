"""Element kernels: internal force Eq. (32), energy, tangent product and diagonal blocks, for any table element.

One thread does one element of one world. The family of the element is only its numbers of slots and points and the
tables; straight tetrahedra share one table of parent gradients and keep J0^-1, others keep h per element and point.
Displacements are taken relative to the element's first position slot: a rigid translation then has exactly zero strain.
"""

import functools
import types as _types

import warp as wp

from . import materials
from .lanes import lane_functions
from .types import kernel_module, precision
from .vertex import vertex_product

__all__ = ["MASSIVE_BLOCK", "block_struct", "element_kernels"]

MASSIVE_BLOCK = 64
"""Threads of a block of `massive_product`: it takes so many registers that small blocks fill a device better."""


@functools.cache
def block_struct(dtype: str):
    """The constant data of one element block, in one precision."""
    p = precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33

    @wp.struct
    class ElementBlock:
        conn: wp.array2d(dtype=wp.int32)  # [local, elem] slot
        is_position: wp.array(dtype=T)  # [local] 1 for a position slot, 0 for a gradient slot
        gradient: wp.array3d(dtype=vec3)  # [point, local, elem] h_i; affine: [point, local, 0] parent gradient
        vertex_gradient: wp.array3d(dtype=vec3)  # the same at the vertices, for laws that need J > 0
        shape: wp.array3d(dtype=T)  # [point, local, elem or 0] s_i at the points of the mass rule (field loads)
        field_weight: wp.array2d(dtype=T)  # [point, elem] rho w at those points
        J0_inv: wp.array(dtype=mat33)  # [elem], affine only
        vertex_J0_inv: wp.array2d(dtype=mat33)
        weight: wp.array2d(dtype=T)  # [point, elem] W det J0; affine: [point, 0] W
        det_J0: wp.array(dtype=T)  # [elem], affine only
        mass: wp.array2d(dtype=T)  # [local, local] int s_i s_j over the parent; affine only
        density: wp.array(dtype=T)  # [elem] rho det J0, where it is constant; affine only
        material: wp.array(dtype=wp.int32)  # [elem]
        coefficients: wp.array3d(dtype=T)  # [world or 0, material, NCOEF]
        frame: wp.array2d(dtype=mat33)  # [point, elem] axes of the law, framed blocks only
        contribution_offset: wp.int32
        element_offset: wp.int32
        history_offset: wp.int32
        count: wp.int32

    return ElementBlock


@functools.cache
def element_kernels(
    dtype: str,
    law: str,
    slots: int,
    points: int,
    affine: bool,
    damping: str | None,
    framed: bool = False,
    vertex: bool = False,
) -> _types.SimpleNamespace:
    """Kernels of one kind of element block.

    Args:
        dtype: precision.
        law: name in `materials.LAWS`.
        slots, points: slots and quadrature points per element.
        affine: parent gradients and one J0 per element, or a table of h.
        damping: None, "incremental", "rate" or "explicit" (Kelvin-Voigt forms).
        framed: the law has axes of its own at each point.
        vertex: straight 10-node tetrahedra with a rule for the product of kernels/vertex.py.
    """
    p = precision(dtype)
    T, vec3, mat33, sym6 = p.T, p.vec3, p.mat33, p.sym
    t = materials.tensors(dtype)
    m = materials.law(law, dtype)
    viscous = materials.svk(dtype)
    Block = block_struct(dtype)
    lane_sum, row_sum = lane_functions(dtype).lane_sum, lane_functions(dtype).row_sum
    NCOEF = materials.NCOEF
    coef = wp.types.vector(length=NCOEF, dtype=T)
    Local = wp.types.matrix(shape=(slots, 3), dtype=T)
    NS, NQ = slots, points
    needs_J = law not in materials.ANY_J
    ETA, LAMBDA_V = materials.ETA, materials.LAMBDA_V
    form = "vertex" if vertex else "affine" if affine else "framed" if framed else "table"
    name = f"element_{dtype}_{law}_{slots}_{points}_{form}_{damping}"
    module = kernel_module(name)
    # what only some scenes or only outputs launch is compiled apart
    history_module = kernel_module(f"{name}_history")
    viscous_module = kernel_module(f"{name}_viscous")
    stress_module = kernel_module(f"{name}_stress")
    # slots in registers, not in arrays that loops index; the loops over points stay loops
    matrix_module = kernel_module(f"{name}_matrix", max_unroll=16)
    massive_module = kernel_module(f"{name}_massive", max_unroll=16, block_dim=MASSIVE_BLOCK)

    @wp.func
    def coefficients(block: Block, world: int, elem: int) -> coef:
        c = coef()
        row = world % block.coefficients.shape[0]
        mat = block.material[elem]
        for k in range(NCOEF):
            c[k] = block.coefficients[row, mat, k]
        return c

    @wp.func
    def damping_coefficients(c: coef, scale: T) -> coef:
        d = coef()
        d[0] = c[LAMBDA_V] * scale
        d[1] = c[ETA] * scale
        return d

    @wp.func
    def load(block: Block, field: wp.array2d(dtype=vec3), world: int, elem: int) -> Local:
        """Slot values of an element, translations taken relative to the first slot."""
        U = Local()
        first = field[world, block.conn[0, elem]]
        for i in range(NS):
            U[i] = field[world, block.conn[i, elem]] - block.is_position[i] * first
        return U

    @wp.func
    def gradient_of(block: Block, U: Local, point: int, elem: int) -> mat33:
        """sum_i u_i h_i^T at a point."""
        D = mat33()
        for i in range(NS):
            if wp.static(affine):
                D += wp.outer(U[i], block.gradient[point, i, 0])
            else:
                D += wp.outer(U[i], block.gradient[point, i, elem])
        if wp.static(affine):
            D = D * block.J0_inv[elem]
        return D

    @wp.func
    def weight_of(block: Block, point: int, elem: int) -> T:
        if wp.static(affine):
            return block.weight[point, 0] * block.det_J0[elem]
        else:
            return block.weight[point, elem]

    @wp.func
    def scatter(block: Block, f: Local, P: mat33, point: int, elem: int) -> Local:
        """f_i += w P h_i."""
        Q = weight_of(block, point, elem) * P
        if wp.static(affine):
            Q = Q * wp.transpose(block.J0_inv[elem])
        out = f
        for i in range(NS):
            if wp.static(affine):
                out[i] = out[i] + Q * block.gradient[point, i, 0]
            else:
                out[i] = out[i] + Q * block.gradient[point, i, elem]
        return out

    @wp.func
    def pack(A: mat33) -> sym6:
        return sym6(A[0, 0], A[1, 1], A[2, 2], A[1, 2], A[0, 2], A[0, 1])

    @wp.func
    def unpack(a: sym6) -> mat33:
        return mat33(a[0], a[5], a[4], a[5], a[1], a[3], a[4], a[3], a[2])

    @wp.func
    def into_axes(block: Block, A: mat33, point: int, elem: int) -> mat33:
        """Components in the axes of the law."""
        if wp.static(framed):
            R = block.frame[point, elem]
            return wp.transpose(R) * A * R
        else:
            return A

    @wp.func
    def out_of_axes(block: Block, A: mat33, point: int, elem: int) -> mat33:
        """Components in the body's axes."""
        if wp.static(framed):
            R = block.frame[point, elem]
            return R * A * wp.transpose(R)
        else:
            return A

    @wp.func
    def history_index(block: Block, point: int, elem: int) -> int:
        return block.history_offset + point * block.count + elem

    @wp.func
    def velocity_gradient(block: Block, V: Local, point: int, elem: int) -> mat33:
        """Fdot where the form of damping needs it."""
        if wp.static(damping == "rate"):
            return gradient_of(block, V, point, elem)
        else:
            return mat33()

    @wp.func
    def strain_rate(
        block: Block, G: mat33, Fdot: mat33, history: wp.array2d(dtype=sym6), dq: T, world: int, point: int, elem: int
    ) -> mat33:
        """Edot at a point: (E - history)/dq (incremental), or Eq. (58) with F and Fdot at the new state (rate)."""
        if wp.static(damping == "incremental"):
            past = unpack(history[world, history_index(block, point, elem)])
            return (T(1.0) / dq) * (t.green(G) - past)
        else:
            return t.sym(wp.transpose(t.identity() + G) * Fdot)

    @wp.func
    def vertex_jacobian(block: Block, U: Local, elem: int) -> T:
        """Smallest J at the element's vertices, where a quadratic field is outside the hull of the points."""
        J = T(1.0e30)
        for q in range(block.vertex_gradient.shape[0]):
            D = mat33()
            for i in range(NS):
                if wp.static(affine):
                    D += wp.outer(U[i], block.vertex_gradient[q, i, 0])
                else:
                    D += wp.outer(U[i], block.vertex_gradient[q, i, elem])
            if wp.static(affine):
                D = D * block.J0_inv[elem]
            J = wp.min(J, T(1.0) + t.volume_change(D))
        return J

    @wp.kernel(module=module)
    def internal_force(
        block: Block,
        u: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        history: wp.array2d(dtype=sym6),
        dq_dv: wp.array(dtype=wp.float64),
        active: wp.array(dtype=wp.int32),
        lanes: int,
        contribution: wp.array2d(dtype=vec3),
        energy: wp.array3d(dtype=wp.float64),
        min_J: wp.array(dtype=wp.float64),
        domain_J: wp.array(dtype=wp.float64),
    ):
        """Internal force contributions, Eqs. (32) and (70), strain energy and viscous potential of each element.

        So many lanes share the points of an element.
        """
        world, index = wp.tid()
        if active[world] == 0:
            return
        lane = index % lanes
        elem = wp.min(index / lanes, block.count - 1)
        c = coefficients(block, world, elem)
        U = load(block, u, world, elem)
        f = Local()
        psi = T(0.0)
        psi_v = T(0.0)
        J_low = T(1.0e30)
        if wp.static(needs_J):
            J_low = vertex_jacobian(block, U, elem)
        V = Local()
        if wp.static(damping == "rate"):
            V = load(block, v, world, elem)
        dq = T(dq_dv[world])
        for q in range(lane, block.gradient.shape[0], lanes):
            G = gradient_of(block, U, q, elem)
            w = weight_of(block, q, elem)
            J_low = wp.min(J_low, T(1.0) + t.volume_change(G))
            local = into_axes(block, G, q, elem)
            P = out_of_axes(block, m.stress(local, c), q, elem)
            psi += w * m.energy(local, c)
            if wp.static(damping == "incremental" or damping == "rate"):
                rate = strain_rate(block, G, velocity_gradient(block, V, q, elem), history, dq, world, q, elem)
                S = t.isotropic(rate, c[LAMBDA_V], c[ETA])
                P = P + S + G * S
                psi_v += T(0.5) * dq * w * wp.ddot(S, rate)
            f = scatter(block, f, P, q, elem)
        for i in range(NS):
            f[i] = lane_sum(f[i], lanes)
        stored = row_sum(wp.float64(psi), lanes)
        lost = row_sum(wp.float64(psi_v), lanes)
        low = wp.float64(J_low)
        if low < min_J[world]:
            wp.atomic_min(min_J, world, low)
        if wp.static(needs_J):
            if low < domain_J[world]:
                wp.atomic_min(domain_J, world, low)
        if lane == 0 and index < block.count * lanes:
            for i in range(NS):
                contribution[world, block.contribution_offset + i * block.count + elem] = f[i]
            energy[0, world, block.element_offset + elem] = stored
            energy[1, world, block.element_offset + elem] = lost

    @wp.func
    def point_increment(
        block: Block,
        G: mat33,
        dG: mat33,
        Fdot: mat33,
        history: wp.array2d(dtype=sym6),
        c: coef,
        dq: T,
        world: int,
        point: int,
        elem: int,
    ) -> mat33:
        """dP at a point, with damping."""
        dP = m.increment(into_axes(block, G, point, elem), into_axes(block, dG, point, elem), c)
        dP = out_of_axes(block, dP, point, elem)
        if wp.static(damping == "incremental" or damping == "rate"):
            F = t.identity() + G
            S = t.isotropic(strain_rate(block, G, Fdot, history, dq, world, point, elem), c[LAMBDA_V], c[ETA])
            dS = t.isotropic(t.sym(wp.transpose(F) * dG), c[LAMBDA_V] / dq, c[ETA] / dq)
            dP = dP + dG * S + F * dS
        return dP

    @wp.func
    def tangent_force(
        block: Block,
        U: Local,
        dU: Local,
        V: Local,
        history: wp.array2d(dtype=sym6),
        dq: T,
        world: int,
        elem: int,
    ) -> Local:
        """K dU of an element."""
        c = coefficients(block, world, elem)
        f = Local()
        for q in range(block.gradient.shape[0]):
            G = gradient_of(block, U, q, elem)
            dG = gradient_of(block, dU, q, elem)
            Fdot = velocity_gradient(block, V, q, elem)
            dP = point_increment(block, G, dG, Fdot, history, c, dq, world, q, elem)
            f = scatter(block, f, dP, q, elem)
        return f

    if vertex:
        shared = _types.SimpleNamespace(Block=Block, coefficients=coefficients, point_increment=point_increment)
        massive_product = vertex_product(dtype, massive_module, points, damping == "rate", shared)
    else:

        @wp.kernel(module=massive_module)
        def massive_product(
            block: Block,
            u: wp.array2d(dtype=vec3),
            v: wp.array2d(dtype=vec3),
            history: wp.array2d(dtype=sym6),
            mass_factor: wp.array(dtype=wp.float64),
            dq_dv: wp.array(dtype=wp.float64),
            active: wp.array(dtype=wp.int32),
            direction: wp.array2d(dtype=vec3),
            contribution: wp.array2d(dtype=vec3),
        ):
            """c_M M p + (dq/dv) K p of straight elements, whose mass is one table times a number each.

            One thread does an element: four that share its points were half as fast, even where most of a device idles.
            """
            world, elem = wp.tid()
            if active[world] == 0:
                return
            U = load(block, u, world, elem)
            dU = load(block, direction, world, elem)
            V = Local()
            if wp.static(damping == "rate"):
                V = load(block, v, world, elem)
            dq = T(dq_dv[world])
            f = tangent_force(block, U, dU, V, history, dq, world, elem)
            scale = T(mass_factor[world]) * block.density[elem]
            first = direction[world, block.conn[0, elem]]
            for i in range(NS):
                a = vec3()
                total = T(0.0)
                for j in range(NS):
                    a += block.mass[i, j] * dU[j]
                    total += block.mass[i, j]
                a += total * first
                entry = block.contribution_offset + i * block.count + elem
                contribution[world, entry] = dq * f[i] + scale * a

    @wp.kernel(module=module)
    def tangent_product(
        block: Block,
        u: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        history: wp.array2d(dtype=sym6),
        dq_dv: wp.array(dtype=wp.float64),
        active: wp.array(dtype=wp.int32),
        direction: wp.array2d(dtype=vec3),
        contribution: wp.array2d(dtype=vec3),
    ):
        """K p, with K = df_int/dq at u (of the rate form only its symmetric part)."""
        world, elem = wp.tid()
        if active[world] == 0:
            return
        U = load(block, u, world, elem)
        dU = load(block, direction, world, elem)
        V = Local()
        if wp.static(damping == "rate"):
            V = load(block, v, world, elem)
        f = tangent_force(block, U, dU, V, history, T(dq_dv[world]), world, elem)
        for i in range(NS):
            contribution[world, block.contribution_offset + i * block.count + elem] = f[i]

    @wp.kernel(module=module)
    def diagonal_blocks(
        block: Block,
        u: wp.array2d(dtype=vec3),
        dq_dv: wp.array(dtype=wp.float64),
        active: wp.array(dtype=wp.int32),
        contribution: wp.array2d(dtype=sym6),
    ):
        """The 3x3 diagonal blocks of K, made positive at each point, in Voigt order."""
        world, elem = wp.tid()
        if active[world] == 0:
            return
        c = coefficients(block, world, elem)
        cv = damping_coefficients(c, T(1.0) / T(dq_dv[world]))
        U = load(block, u, world, elem)
        for i in range(NS):
            B = sym6()
            contribution[world, block.contribution_offset + i * block.count + elem] = B
        for q in range(block.gradient.shape[0]):
            G = gradient_of(block, U, q, elem)
            w = weight_of(block, q, elem)
            for i in range(NS):
                a = vec3()
                if wp.static(affine):
                    a = wp.transpose(block.J0_inv[elem]) * block.gradient[q, i, 0]
                else:
                    a = block.gradient[q, i, elem]
                K = mat33()
                if wp.static(framed):
                    R = block.frame[q, elem]
                    K = out_of_axes(block, m.block(into_axes(block, G, q, elem), wp.transpose(R) * a, c), q, elem)
                else:
                    K = m.block(G, a, c)
                if wp.static(damping == "incremental" or damping == "rate"):
                    K = K + viscous.block(mat33() + G, a, cv)
                entry = block.contribution_offset + i * block.count + elem
                contribution[world, entry] = contribution[world, entry] + w * pack(K)

    @wp.func
    def compression(S: mat33) -> T:
        """A bound of the largest compressive principal value of S (Gershgorin), 0 in tension."""
        low = T(0.0)
        for i in range(3):
            low = wp.max(low, wp.abs(S[i, 0]) + wp.abs(S[i, 1]) + wp.abs(S[i, 2]) - wp.abs(S[i, i]) - S[i, i])
        return low

    @wp.func
    def stand_in(F: mat33, dF: mat33, c: coef) -> mat33:
        """For laws whose tangent is indefinite far from rest: the stiffness at rest, turned with F and of its shape.

        c = (mu10, k, mu01), with mu = 2 (mu10 + mu01) and lambda = k - 2 mu / 3.
        """
        A = wp.sqrt(T(3.0) / wp.ddot(F, F)) * F
        mu = T(2.0) * (c[0] + c[2])
        return A * t.isotropic(t.sym(wp.transpose(A) * dF), wp.max(c[1] - mu * T(2.0) / T(3.0), T(0.0)), mu)

    @wp.kernel(module=matrix_module)
    def prepare_matrix(
        block: Block,
        u: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        history: wp.array2d(dtype=sym6),
        dq_dv: wp.array(dtype=wp.float64),
        form: int,
        active: wp.array(dtype=wp.int32),
        lines: wp.array3d(dtype=vec3),
    ):
        """What all columns of an element's matrix need of a point, [world, 5 point + row, elem].

        Three rows of F with columns along the law's axes, and the second Piola-Kirchhoff stress of `element_matrix`'s
        `form` there, its diagonal and (23, 13, 12).
        """
        world, q, elem = wp.tid()
        if active[world] == 0:
            return
        G = gradient_of(block, load(block, u, world, elem), q, elem)
        F = t.identity() + G
        S = mat33()
        if wp.static(not needs_J):
            c = coefficients(block, world, elem)
            S = m.stiffness(t.green(into_axes(block, G, q, elem)), c)
            if form == 1:
                S += compression(S) * t.identity()
        if wp.static(damping == "incremental" or damping == "rate"):
            if form == 0:
                c = coefficients(block, world, elem)
                V = Local()
                if wp.static(damping == "rate"):
                    V = load(block, v, world, elem)
                Fdot = velocity_gradient(block, V, q, elem)
                rate = strain_rate(block, G, Fdot, history, T(dq_dv[world]), world, q, elem)
                S += into_axes(block, t.isotropic(rate, c[LAMBDA_V], c[ETA]), q, elem)
        if wp.static(framed):
            F = F * block.frame[q, elem]
        for i in range(3):
            lines[world, 5 * q + i, elem] = F[i]
        lines[world, 5 * q + 3, elem] = vec3(S[0, 0], S[1, 1], S[2, 2])
        lines[world, 5 * q + 4, elem] = vec3(S[1, 2], S[0, 2], S[0, 1])

    @wp.kernel(module=matrix_module)
    def element_matrix(
        block: Block,
        dq_dv: wp.array(dtype=wp.float64),
        lines: wp.array3d(dtype=vec3),
        form: int,
        add: int,
        by_element: int,
        active: wp.array(dtype=wp.int32),
        matrix: wp.array3d(dtype=vec3),
    ):
        """K of each element as the columns of the 3x3 blocks of slots a <= b, row by row; one thread does one column.

        Args:
            form: 0: K; 1: without what can make it indefinite at a point, compression and stress of the viscosity, and
                with a stand-in for laws that need J > 0, a function of u.
            add: to what is there, of another part of the energy.
            by_element: consecutive threads do the columns of an element, else the elements' columns of one number.
        """
        world, index = wp.tid()
        if active[world] == 0:
            return
        column = index / block.count
        elem = index % block.count
        if by_element != 0:
            column = index % (3 * NS)
            elem = index / (3 * NS)
        b = column / 3
        axis = column % 3
        c = coefficients(block, world, elem)
        cv = damping_coefficients(c, T(1.0) / T(dq_dv[world]))
        unit = vec3()
        unit[axis] = T(1.0)
        out = Local()
        for q in range(block.gradient.shape[0]):
            F = wp.matrix_from_rows(
                lines[world, 5 * q, elem], lines[world, 5 * q + 1, elem], lines[world, 5 * q + 2, elem]
            )
            d = lines[world, 5 * q + 3, elem]
            o = lines[world, 5 * q + 4, elem]
            S = mat33(d[0], o[2], o[1], o[2], d[1], o[0], o[1], o[0], d[2])
            h = vec3()
            if wp.static(affine):
                h = wp.transpose(block.J0_inv[elem]) * block.gradient[q, b, 0]
            else:
                h = block.gradient[q, b, elem]
            if wp.static(framed):
                h = wp.transpose(block.frame[q, elem]) * h
            # dF = unit h^T, so that F^T dF is the outer product of a row of F and h
            B = t.sym(wp.outer(wp.transpose(F) * unit, h))
            dP = wp.outer(unit, S * h)
            if wp.static(not needs_J):
                dS = m.stiffness(B, c)
                if wp.static(damping == "incremental" or damping == "rate"):
                    dS += t.isotropic(B, cv[0], cv[1])
                dP += F * dS
            else:
                if wp.static(damping == "incremental" or damping == "rate"):
                    dP += F * t.isotropic(B, cv[0], cv[1])
                if form == 1:
                    dP += stand_in(F, wp.outer(unit, h), c)
                else:
                    dP += m.increment(F - t.identity(), wp.outer(unit, h), c)
            if wp.static(framed):
                dP = dP * wp.transpose(block.frame[q, elem])
            dP = weight_of(block, q, elem) * dP
            if wp.static(affine):
                dP = dP * wp.transpose(block.J0_inv[elem])
            for a in range(NS):
                if a <= b:
                    if wp.static(affine):
                        out[a] = out[a] + dP * block.gradient[q, a, 0]
                    else:
                        out[a] = out[a] + dP * block.gradient[q, a, elem]
        for a in range(NS):
            if a <= b:
                pair = a * NS - (a * (a - 1)) / 2 + b - a
                if add != 0:
                    out[a] = out[a] + matrix[world, 3 * pair + axis, elem]
                matrix[world, 3 * pair + axis, elem] = out[a]

    @wp.kernel(module=history_module)
    def strain_history(
        block: Block,
        u0: wp.array2d(dtype=vec3),
        u1: wp.array2d(dtype=vec3),
        a0: wp.array(dtype=wp.float64),
        a1: wp.array(dtype=wp.float64),
        active: wp.array(dtype=wp.int32),
        history: wp.array2d(dtype=sym6),
    ):
        """a0 E(u0) - a1 E(u1) per point: what the incremental strain rate is measured from."""
        world, elem = wp.tid()
        if active[world] == 0:
            return
        U0 = load(block, u0, world, elem)
        U1 = load(block, u1, world, elem)
        for q in range(NQ):
            E = T(a0[world]) * t.green(gradient_of(block, U0, q, elem))
            E = E - T(a1[world]) * t.green(gradient_of(block, U1, q, elem))
            history[world, history_index(block, q, elem)] = pack(E)

    @wp.kernel(module=viscous_module)
    def viscous_force(
        block: Block,
        u: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        active: wp.array(dtype=wp.int32),
        contribution: wp.array2d(dtype=vec3),
        power: wp.array2d(dtype=wp.float64),
    ):
        """Kelvin-Voigt force, Eqs. (58)-(70), at a given state, and its dissipation rate S_vis : Edot (W)."""
        world, elem = wp.tid()
        if active[world] == 0:
            return
        c = coefficients(block, world, elem)
        U = load(block, u, world, elem)
        V = load(block, v, world, elem)
        f = Local()
        rate_of_work = T(0.0)
        for q in range(NQ):
            G = gradient_of(block, U, q, elem)
            F = t.identity() + G
            rate = t.sym(wp.transpose(F) * gradient_of(block, V, q, elem))
            S = t.isotropic(rate, c[LAMBDA_V], c[ETA])
            rate_of_work += weight_of(block, q, elem) * wp.ddot(S, rate)
            f = scatter(block, f, F * S, q, elem)
        for i in range(NS):
            contribution[world, block.contribution_offset + i * block.count + elem] = f[i]
        power[world, block.element_offset + elem] = wp.float64(rate_of_work)

    @wp.kernel(module=stress_module)
    def point_stress(
        block: Block,
        u: wp.array2d(dtype=vec3),
        stress: wp.array3d(dtype=sym6),
        jacobian: wp.array3d(dtype=T),
    ):
        """Cauchy stress P F^T / J (elastic part) and J at the quadrature points, [world, point, elem]."""
        world, elem = wp.tid()
        c = coefficients(block, world, elem)
        U = load(block, u, world, elem)
        for q in range(NQ):
            G = gradient_of(block, U, q, elem)
            J = T(1.0) + t.volume_change(G)
            P = out_of_axes(block, m.stress(into_axes(block, G, q, elem), c), q, elem)
            stress[world, q, elem] = pack((T(1.0) / J) * (P + P * wp.transpose(G)))
            jacobian[world, q, elem] = J

    return _types.SimpleNamespace(
        module=module,
        internal_force=internal_force,
        tangent_product=tangent_product,
        massive_product=massive_product,
        diagonal_blocks=diagonal_blocks,
        prepare_matrix=prepare_matrix,
        element_matrix=element_matrix,
        strain_history=strain_history,
        viscous_force=viscous_force,
        point_stress=point_stress,
    )
