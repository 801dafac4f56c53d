"""Product with mass of straight 10-node tetrahedra whose rule has a point on each line from the centroid to a vertex.

A gradient is linear over such an element. With L_b the volume coordinates, e(v, b) the slot half-way from vertex v to
vertex b, and e(v, v) = v, at vertex v, at the centroid, and at the point that lies s of the way from there to v it is

    D_v = 4 E_v - C,    E_v = sum_b u_e(v, b) dL_b^T,    C = sum_b u_b dL_b^T
    S = sum_ab u_e(a, b) (dL_a + dL_b)^T    over the edges
    D = (1 - s) S + s D_v = H + 4 s E_v,    H = (1 - s) S - s C

in parent coordinates, where dL_k is the k-th axis and dL_0 minus their sum: differences of slots alone, which cancel a
translation. Forces are the transpose: slot e(v, b) takes 4 s Q_v dL_b of the stress Q_v at each point, and then

    corner b: -B dL_b,    edge a b: R (dL_a + dL_b),    B = s sum_v Q_v,    R = Q_centroid + (1 - s) sum_v Q_v.

What lives across a point is H of each field, B, and the slots that earlier vertices touched, not all values of slots.
"""

import types as _types

import warp as wp

from .types import precision

__all__ = ["vertex_product"]

EDGES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))
OPPOSITE = (5, 3, 4, 1, 2, 0)
SPOKES = tuple(
    wp.vec4i(*(v if a == v else 4 + next(k for k, edge in enumerate(EDGES) if {a, v} == set(edge)) for a in range(4)))
    for v in range(4)
)
"""e(v, b)."""


def vertex_product(dtype: str, module: wp.Module, points: int, rate: bool, fn: _types.SimpleNamespace) -> wp.Kernel:
    """The kernel `massive_product` in this form.

    Args:
        dtype: precision.
        module: for the kernel; its short loops must be unrolled, that slots are registers.
        points: 4, one for each vertex, or 5, the centroid before them.
        rate: increments need the velocity gradient.
        fn: functions of points.py.
    """
    p = precision(dtype)
    T, vec3, mat33, sym6 = p.T, p.vec3, p.mat33, p.sym
    Block, coefficients, point_increment = fn.Block, fn.coefficients, fn.point_increment
    Local = wp.types.matrix(shape=(10, 3), dtype=T)
    FIRST = points - 4

    @wp.func
    def spokes(block: Block, field: wp.array2d(dtype=vec3), world: int, elem: int, e: wp.vec4i) -> mat33:
        """sum_b u_e(b) dL_b^T."""
        o = field[world, block.conn[e[0], elem]]
        return wp.matrix_from_cols(
            field[world, block.conn[e[1], elem]] - o,
            field[world, block.conn[e[2], elem]] - o,
            field[world, block.conn[e[3], elem]] - o,
        )

    @wp.func
    def central(block: Block, field: wp.array2d(dtype=vec3), world: int, elem: int) -> mat33:
        """S, where opposite edges have opposite signs."""
        a = field[world, block.conn[5, elem]] - field[world, block.conn[7, elem]]
        b = field[world, block.conn[8, elem]] - field[world, block.conn[6, elem]]
        c = field[world, block.conn[9, elem]] - field[world, block.conn[4, elem]]
        return wp.matrix_from_cols(a + b, a + c, b + c)

    @wp.func
    def shared(block: Block, field: wp.array2d(dtype=vec3), world: int, elem: int, s: T) -> mat33:
        """H."""
        S = central(block, field, world, elem)
        return S - s * (S + spokes(block, field, world, elem, wp.vec4i(0, 1, 2, 3)))

    @wp.func
    def column(Q: mat33, b: int) -> vec3:
        """Q dL_b."""
        if b == 0:
            return vec3(-Q[0, 0] - Q[0, 1] - Q[0, 2], -Q[1, 0] - Q[1, 1] - Q[1, 2], -Q[2, 0] - Q[2, 1] - Q[2, 2])
        return vec3(Q[0, b - 1], Q[1, b - 1], Q[2, b - 1])

    @wp.func
    def inertia(block: Block, field: wp.array2d(dtype=vec3), world: int, elem: int, scale: T, force: Local) -> Local:
        """Adds scale M u, where M has one number for each way that two slots can lie to each other."""
        u = Local()
        for i in range(10):
            u[i] = field[world, block.conn[i, elem]]
        beside = scale * block.mass[0, 1]
        near = scale * block.mass[0, 4]
        far = scale * block.mass[0, 5]
        joined = scale * block.mass[4, 5]
        corners = u[0] + u[1] + u[2] + u[3]
        edges = u[4] + u[5] + u[6] + u[7] + u[8] + u[9]
        of_corner = scale * block.mass[0, 0] - beside
        of_edge = scale * block.mass[4, 4] - joined
        across = scale * block.mass[4, 9] - joined
        # what all corners and all edges have in common, then what differs from it
        at_corner = beside * corners + far * edges
        at_edge = far * corners + joined * edges
        out = force
        for i in range(4):
            out[i] = out[i] + at_corner + of_corner * u[i]
        for k in range(6):
            a, b = wp.static(EDGES[k][0]), wp.static(EDGES[k][1])
            o = wp.static(4 + OPPOSITE[k])
            out[a] = out[a] + (near - far) * u[4 + k]
            out[b] = out[b] + (near - far) * u[4 + k]
            out[4 + k] = out[4 + k] + at_edge + (near - far) * (u[a] + u[b]) + of_edge * u[4 + k] + across * u[o]
        return out

    @wp.kernel(module=module)
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
        """c_M M p + (dq/dv) K p; slots are read anew at each vertex, to hold fewer registers."""
        world, elem = wp.tid()
        if active[world] == 0:
            return
        c = coefficients(block, world, elem)
        dq = T(dq_dv[world])
        # the first function's gradient at the first vertex's point is 3 s dL_0
        s = -block.gradient[FIRST, 0, 0][0] / T(3.0)
        H = shared(block, u, world, elem, s)
        dH = shared(block, direction, world, elem, s)
        rate_H = mat33()
        if wp.static(rate):
            rate_H = shared(block, v, world, elem, s)
        f = Local()
        B = mat33()
        for k in range(4):
            J0_inv = block.J0_inv[elem]
            G = (H + T(4.0) * s * spokes(block, u, world, elem, wp.static(SPOKES[k]))) * J0_inv
            dG = (dH + T(4.0) * s * spokes(block, direction, world, elem, wp.static(SPOKES[k]))) * J0_inv
            Fdot = mat33()
            if wp.static(rate):
                Fdot = (rate_H + T(4.0) * s * spokes(block, v, world, elem, wp.static(SPOKES[k]))) * J0_inv
            dP = point_increment(block, G, dG, Fdot, history, c, dq, world, FIRST + k, elem)
            w = dq * s * block.weight[FIRST + k, 0] * block.det_J0[elem]
            Q = w * dP * wp.transpose(J0_inv)
            B += Q
            for b in range(4):
                slot = wp.static(SPOKES[k][b])
                f[slot] = f[slot] + T(4.0) * column(Q, b)
        R = (T(1.0) / s - T(1.0)) * B
        if wp.static(FIRST == 1):
            G = central(block, u, world, elem) * block.J0_inv[elem]
            dG = central(block, direction, world, elem) * block.J0_inv[elem]
            Fdot = mat33()
            if wp.static(rate):
                Fdot = central(block, v, world, elem) * block.J0_inv[elem]
            dP = point_increment(block, G, dG, Fdot, history, c, dq, world, 0, elem)
            R += dq * block.weight[0, 0] * block.det_J0[elem] * dP * wp.transpose(block.J0_inv[elem])
        for b in range(4):
            f[b] = f[b] - column(B, b)
        for k in range(6):
            f[4 + k] = f[4 + k] + column(R, wp.static(EDGES[k][0])) + column(R, wp.static(EDGES[k][1]))
        f = inertia(block, direction, world, elem, T(mass_factor[world]) * block.density[elem], f)
        for i in range(10):
            contribution[world, block.contribution_offset + i * block.count + elem] = f[i]

    return massive_product
