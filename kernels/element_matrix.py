"""Matrices of table elements, column by column."""

import types as _types

import warp as wp

from . import materials

__all__ = ["matrix_kernels"]


def matrix_kernels(fn: _types.SimpleNamespace, module: wp.Module) -> tuple[wp.Kernel, wp.Kernel]:
    """`prepare_matrix` and `element_matrix` of the block with the functions fn of points.py."""
    T, vec3, mat33, sym6 = fn.types.T, fn.types.vec3, fn.types.mat33, fn.types.sym
    t, m, Block, Local, coef = fn.tensors, fn.law, fn.Block, fn.Local, fn.coef
    NS, affine, damping, framed, needs_J = fn.slots, fn.affine, fn.damping, fn.framed, fn.needs_J
    ETA, LAMBDA_V = materials.ETA, materials.LAMBDA_V

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

    @wp.kernel(module=module)
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
        G = fn.gradient_of(block, fn.load(block, u, world, elem), q, elem)
        F = t.identity() + G
        S = mat33()
        if wp.static(not needs_J):
            c = fn.coefficients(block, world, elem)
            S = m.stiffness(t.green(fn.into_axes(block, G, q, elem)), c)
            if form == 1:
                S += compression(S) * t.identity()
        if wp.static(damping == "incremental" or damping == "rate"):
            if form == 0:
                c = fn.coefficients(block, world, elem)
                V = Local()
                if wp.static(damping == "rate"):
                    V = fn.load(block, v, world, elem)
                Fdot = fn.velocity_gradient(block, V, q, elem)
                rate = fn.strain_rate(block, G, Fdot, history, T(dq_dv[world]), world, q, elem)
                S += fn.into_axes(block, t.isotropic(rate, c[LAMBDA_V], c[ETA]), q, elem)
        if wp.static(framed):
            F = F * block.frame[q, elem]
        for i in range(3):
            lines[world, 5 * q + i, elem] = F[i]
        lines[world, 5 * q + 3, elem] = vec3(S[0, 0], S[1, 1], S[2, 2])
        lines[world, 5 * q + 4, elem] = vec3(S[1, 2], S[0, 2], S[0, 1])

    @wp.kernel(module=module)
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
        c = fn.coefficients(block, world, elem)
        cv = fn.damping_coefficients(c, T(1.0) / T(dq_dv[world]))
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
                h = wp.transpose(fn.inverse_jacobian(block, elem)) * block.gradient[q, b, 0]
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
            dP = fn.weight_of(block, q, elem) * dP
            if wp.static(affine):
                dP = dP * wp.transpose(fn.inverse_jacobian(block, elem))
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

    return prepare_matrix, element_matrix
