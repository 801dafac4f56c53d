"""Matrices of table elements: column by column, or a whole element at a time.

Columns are for a GPU, where threads are many and registers few. A processor's core does whole elements: at a point it
makes dP/dF once, and its units of arithmetic take the numbers of several slots, a panel, side by side.
"""

import functools
import types as _types

import warp as wp

from . import materials
from .points import point_functions
from .types import kernel_module

__all__ = ["UNROLL", "matrix_kernels", "panels_of"]

WIDEST = 8
"""Most slots of a panel: eight numbers of 64 bits fill the widest registers there are."""
UNROLL = 9
"""`max_unroll` of modules that do panels: loops over components must not stand in the way of those over slots."""


def panels_of(slots: int) -> tuple[int, int]:
    """How many panels, and slots per panel."""
    panels = -(-slots // WIDEST)
    return panels, -(-slots // panels)


@functools.cache
def matrix_kernels(
    dtype: str, law: str, slots: int, affine: bool, damping: str | None, framed: bool
) -> _types.SimpleNamespace:
    """`prepare_matrix`, `element_matrix` and `element_rows` of a kind of element block, arguments as of its kernels."""
    fn = point_functions(dtype, law, slots, affine, damping, framed)
    T, vec3, mat33, sym6 = fn.types.T, fn.types.vec3, fn.types.mat33, fn.types.sym
    t, m, Block, Local, coef = fn.tensors, fn.law, fn.Block, fn.Local, fn.coef
    NS, needs_J = fn.slots, fn.needs_J
    ETA, LAMBDA_V = materials.ETA, materials.LAMBDA_V
    form = "affine" if affine else "framed" if framed else "table"
    name = f"element_{dtype}_{law}_{slots}_{form}_{damping}"
    module = kernel_module(f"{name}_matrix", max_unroll=16)
    rows_module = kernel_module(f"{name}_rows", max_unroll=UNROLL)
    PANELS, P = panels_of(NS)
    Row = wp.types.vector(length=P, dtype=T)
    Slots = wp.types.matrix(shape=(3 * PANELS, P), dtype=T)
    Tensor = wp.types.matrix(shape=(9, 9), dtype=T)
    Products = wp.types.matrix(shape=(27, P), dtype=T)

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

    @wp.func
    def point_state(
        block: Block,
        U: Local,
        V: Local,
        history: wp.array2d(dtype=sym6),
        dq_dv: wp.float64,
        c: coef,
        form: int,
        world: int,
        point: int,
        elem: int,
    ):
        """F with columns along the law's axes, and the second Piola-Kirchhoff stress of `form` there."""
        G = fn.gradient_of(block, U, point, elem)
        F = t.identity() + G
        S = mat33()
        if wp.static(not needs_J):
            S = m.stiffness(t.green(fn.into_axes(block, G, point, elem)), c)
            if form == 1:
                S += compression(S) * t.identity()
        if wp.static(damping == "incremental" or damping == "rate"):
            if form == 0:
                Fdot = fn.velocity_gradient(block, V, point, elem)
                rate = fn.strain_rate(block, G, Fdot, history, T(dq_dv), world, point, elem)
                S += fn.into_axes(block, t.isotropic(rate, c[LAMBDA_V], c[ETA]), point, elem)
        if wp.static(framed):
            F = F * block.frame[point, elem]
        return F, S

    @wp.func
    def velocities(block: Block, v: wp.array2d(dtype=vec3), world: int, elem: int) -> Local:
        """Those of the slots, where damping needs them."""
        if wp.static(damping == "rate"):
            return fn.load(block, v, world, elem)
        else:
            return Local()

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
        U, V = fn.load(block, u, world, elem), velocities(block, v, world, elem)
        c = fn.coefficients(block, world, elem)
        F, S = point_state(block, U, V, history, dq_dv[world], c, form, world, q, elem)
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
        active: wp.array(dtype=wp.int32),
        matrix: wp.array3d(dtype=vec3),
    ):
        """K of each element as the columns of the 3x3 blocks of slots a <= b, row by row; one thread does one column.

        Args:
            form: 0: K; 1: without what can make it indefinite at a point, compression and stress of the viscosity, and
                with a stand-in for laws that need J > 0, a function of u.
            add: to what is there, of another part of the energy.
        """
        world, index = wp.tid()
        if active[world] == 0:
            return
        column = index / block.count
        elem = index % block.count
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

    @wp.kernel(module=rows_module)
    def element_rows(
        block: Block,
        u: wp.array2d(dtype=vec3),
        v: wp.array2d(dtype=vec3),
        history: wp.array2d(dtype=sym6),
        dq_dv: wp.array(dtype=wp.float64),
        form: int,
        active: wp.array(dtype=wp.int32),
        add: int,
        matrix: wp.array3d(dtype=vec3),
    ):
        """`element_matrix` of all columns, and what `prepare_matrix` does, by one thread per element.

        A is dP/dF at a point; a panel's A : (e_j h_b^T) are the rows of D, over b, and K_ab = h_a . D_b.
        """
        world, elem = wp.tid()
        if active[world] == 0:
            return
        c = fn.coefficients(block, world, elem)
        cv = fn.damping_coefficients(c, T(1.0) / T(dq_dv[world]))
        U, V = fn.load(block, u, world, elem), velocities(block, v, world, elem)
        K = wp.zeros(shape=(wp.static(9 * NS * PANELS),), dtype=Row)
        H = Slots()
        for q in range(block.gradient.shape[0]):
            F, S = point_state(block, U, V, history, dq_dv[world], c, form, world, q, elem)
            into = t.identity()
            if wp.static(framed):
                into = wp.transpose(block.frame[q, elem])
            if wp.static(affine):
                into = into * wp.transpose(fn.inverse_jacobian(block, elem))
            for a in range(NS):
                h = vec3()
                if wp.static(affine):
                    h = into * block.gradient[q, a, 0]
                elif wp.static(framed):
                    h = into * block.gradient[q, a, elem]
                else:
                    h = block.gradient[q, a, elem]
                for l in range(3):
                    H[3 * (a / P) + l, a % P] = h[l]
            A = Tensor()
            w = fn.weight_of(block, q, elem)
            for j in range(3):
                half = (T(0.5) * w) * F[j]
                for l in range(3):
                    # sym(F^T dF) of dF = w e_j e_l^T
                    B = mat33()
                    for n in range(3):
                        B[n, l] = B[n, l] + half[n]
                        B[l, n] = B[l, n] + half[n]
                    dP = mat33()
                    if wp.static(not needs_J):
                        dS = m.stiffness(B, c)
                        if wp.static(damping == "incremental" or damping == "rate"):
                            dS += t.isotropic(B, cv[0], cv[1])
                        dP = F * dS
                    else:
                        if wp.static(damping == "incremental" or damping == "rate"):
                            dP = F * t.isotropic(B, cv[0], cv[1])
                        dF = mat33()
                        dF[j, l] = w
                        if form == 1:
                            dP += stand_in(F, dF, c)
                        else:
                            dP += m.increment(F - t.identity(), dF, c)
                    dP[j] = dP[j] + w * S[l]
                    for i in range(3):
                        for k in range(3):
                            A[3 * i + k, 3 * j + l] = dP[i, k]
            for panel in range((block.conn.shape[0] + P - 1) / P):
                D = Products()
                for i in range(9):
                    for j in range(3):
                        D[3 * i + j] = (
                            A[i, 3 * j] * H[3 * panel]
                            + A[i, 3 * j + 1] * H[3 * panel + 1]
                            + A[i, 3 * j + 2] * H[3 * panel + 2]
                        )
                for a in range(wp.min(NS, P * (panel + 1))):
                    x = H[3 * (a / P), a % P]
                    y = H[3 * (a / P) + 1, a % P]
                    z = H[3 * (a / P) + 2, a % P]
                    r = 9 * (panel * NS + a)
                    for i in range(3):
                        for j in range(3):
                            K[r + 3 * i + j] = (
                                K[r + 3 * i + j] + x * D[9 * i + j] + y * D[9 * i + 3 + j] + z * D[9 * i + 6 + j]
                            )
        for b in range(NS):
            for a in range(b + 1):
                pair = a * NS - (a * (a - 1)) / 2 + b - a
                r = 9 * ((b / P) * NS + a)
                for j in range(3):
                    total = vec3(K[r + j][b % P], K[r + 3 + j][b % P], K[r + 6 + j][b % P])
                    if add != 0:
                        total += matrix[world, 3 * pair + j, elem]
                    matrix[world, 3 * pair + j, elem] = total

    return _types.SimpleNamespace(
        prepare_matrix=prepare_matrix, element_matrix=element_matrix, element_rows=element_rows
    )
