"""(c_M M + (dq/dv) K) p of straight T10 whose rule has a point on each line from the centroid to a vertex.

A gradient is linear over such an element. With L_b the volume coordinates, e(v, b) the slot midway from vertex v to
vertex b and e(v, v) = v, the gradient in parent coordinates is D_v at vertex v, S at the centroid, and D at the point
that lies s of the way from the centroid to v:

    D_v = 4 E_v - C,    E_v = sum_b u_e(v, b) dL_b^T,    C = sum_b u_b dL_b^T
    S = sum_ab u_e(a, b) (dL_a + dL_b)^T    over the edges
    D = (1 - s) S + s D_v = H + 4 s E_v,    H = (1 - s) S - s C

Here dL_k is the k-th axis and dL_0 minus their sum, so that only differences of slots enter and a translation cancels.
Forces are the transpose: of the stress Q_v at a point slot e(v, b) takes 4 s Q_v dL_b, and all points together give

    corner b: -B dL_b,    edge a b: R (dL_a + dL_b),    B = s sum_v Q_v,    R = Q_centroid + (1 - s) sum_v Q_v.

From one point to the next only H of each field and B are kept; forces lie beside the fields in the memory of a cluster.
"""

import warp as wp

from ..common.modules import KernelSet
from .element_clusters import DIRECTION, DISPLACEMENT, VELOCITY

__all__ = ["vertex_product"]

EDGES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))
OPPOSITE_EDGE = (5, 3, 4, 1, 2, 0)
VERTEX_SLOTS = tuple(
    wp.vec4i(*(v if a == v else 4 + next(k for k, edge in enumerate(EDGES) if {a, v} == set(edge)) for a in range(4)))
    for v in range(4)
)
"""Slots e(v, b), b = 0 .. 3, of each vertex v: itself, and midway to the others."""


@wp.func_native("""
    #if defined(__CUDA_ARCH__)
    asm volatile("" ::: "memory");
    #endif
""")
def register_barrier():
    """Discard values held in registers: fewer registers let more blocks run at once."""


def vertex_product(points: int, fn: KernelSet, shared: KernelSet) -> wp.Function:
    """Device function `product`, which sets the forces of an element in this form.

    Args:
        points: 4, one for each vertex, or 5, the centroid before them.
        fn: functions of points.py.
        shared: functions of kernels/elements/element_clusters.py.
    """
    p, rate = fn.types, fn.uses_v
    T, vec3, mat33 = p.T, p.vec3, p.mat33
    Pool, fetch, set_force, add_force = shared.Pool, shared.fetch, shared.set_force, shared.add_force
    Block, inverse_jacobian, point_increment = fn.Block, fn.inverse_jacobian, fn.point_increment
    Local = wp.types.matrix(shape=(10, 3), dtype=T)
    FIRST_VERTEX_POINT = points - 4

    @wp.func
    def edge_sum(pool: Pool, field: int, at: int, e: wp.vec4i) -> mat33:
        """sum_b u_e(b) dL_b^T of a field: E_v with e = e(v, .), C with the corners."""
        o = fetch(pool, field, e[0], at)
        return wp.matrix_from_cols(
            fetch(pool, field, e[1], at) - o, fetch(pool, field, e[2], at) - o, fetch(pool, field, e[3], at) - o
        )

    @wp.func
    def centroid_gradient(pool: Pool, field: int, at: int) -> mat33:
        """S of a field, the gradient at the centroid; opposite edges enter with opposite signs."""
        a = fetch(pool, field, 5, at) - fetch(pool, field, 7, at)
        b = fetch(pool, field, 8, at) - fetch(pool, field, 6, at)
        c = fetch(pool, field, 9, at) - fetch(pool, field, 4, at)
        return wp.matrix_from_cols(a + b, a + c, b + c)

    @wp.func
    def gradient_common_part(pool: Pool, field: int, at: int, s: T) -> mat33:
        """H = (1 - s) S - s C of a field, common to all four vertices."""
        S = centroid_gradient(pool, field, at)
        return S - s * (S + edge_sum(pool, field, at, wp.vec4i(0, 1, 2, 3)))

    @wp.func
    def times_coordinate_gradient(Q: mat33, b: int) -> vec3:
        """Q dL_b."""
        if b == 0:
            return vec3(-Q[0, 0] - Q[0, 1] - Q[0, 2], -Q[1, 0] - Q[1, 1] - Q[1, 2], -Q[2, 0] - Q[2, 1] - Q[2, 2])
        return vec3(Q[0, b - 1], Q[1, b - 1], Q[2, b - 1])

    @wp.func
    def add_common_forces(block: Block, pool: Pool, scale: T, B: mat33, R: mat33, at: int):
        """Add the forces of B and R, and scale M p.

        M (over the parent) has seven distinct entries, one for each relative position of two slots.
        """
        u = Local()
        for i in range(10):
            u[i] = fetch(pool, DIRECTION, i, at)
        beside = scale * block.parent_mass[0, 1]
        near = scale * block.parent_mass[0, 4]
        far = scale * block.parent_mass[0, 5]
        joined = scale * block.parent_mass[4, 5]
        corners = u[0] + u[1] + u[2] + u[3]
        edges = u[4] + u[5] + u[6] + u[7] + u[8] + u[9]
        of_corner = scale * block.parent_mass[0, 0] - beside
        of_edge = scale * block.parent_mass[4, 4] - joined
        across = scale * block.parent_mass[4, 9] - joined
        # first the part common to all corners and edges, then the differences from it
        at_corner = beside * corners + far * edges
        at_edge = far * corners + joined * edges
        for i in range(4):
            e = wp.static(VERTEX_SLOTS[i])
            around = u[e[0]] + u[e[1]] + u[e[2]] + u[e[3]] - u[i]
            add_force(
                pool, i, at, at_corner + of_corner * u[i] + (near - far) * around - times_coordinate_gradient(B, i)
            )
        for k in range(6):
            a, b = wp.static(EDGES[k][0]), wp.static(EDGES[k][1])
            o = wp.static(4 + OPPOSITE_EDGE[k])
            f = at_edge + (near - far) * (u[a] + u[b]) + of_edge * u[4 + k] + across * u[o]
            add_force(pool, 4 + k, at, f + times_coordinate_gradient(R, a) + times_coordinate_gradient(R, b))

    @wp.func
    def product(
        block: Block, pool: Pool, history: p.sym_2d, dq: T, scale: T, form: int, world: int, elem: int, at: int
    ):
        """Set the forces (scale M + dq K) p of element `at` of a cluster.

        Slots are read again at each vertex and forces are stored in the pool, to save registers.
        """
        c = fn.coefficients(block, world, elem)
        # the first function's gradient at the first vertex's point is 3 s dL_0
        s = -block.shape_gradient[FIRST_VERTEX_POINT, 0, 0][0] / T(3.0)
        H = gradient_common_part(pool, DISPLACEMENT, at, s)
        dH = gradient_common_part(pool, DIRECTION, at, s)
        rate_H = mat33()
        if wp.static(rate):
            rate_H = gradient_common_part(pool, VELOCITY, at, s)
        B = mat33()
        for k in range(4):
            register_barrier()
            point = FIRST_VERTEX_POINT + k
            e = wp.static(VERTEX_SLOTS[k])
            J0_inv = inverse_jacobian(block, elem)
            G = (H + T(4.0) * s * edge_sum(pool, DISPLACEMENT, at, e)) * J0_inv
            dG = (dH + T(4.0) * s * edge_sum(pool, DIRECTION, at, e)) * J0_inv
            Fdot = mat33()
            if wp.static(rate):
                Fdot = (rate_H + T(4.0) * s * edge_sum(pool, VELOCITY, at, e)) * J0_inv
            dP = point_increment(block, G, dG, Fdot, history, c, dq, form, world, point, elem)
            w = T(4.0) * dq * s * block.quadrature_weight[point, 0] * block.det_J0[elem]
            Q = w * dP * wp.transpose(J0_inv)
            B += T(0.25) * Q
            for b in range(4):
                if wp.static(b < k):  # the edge to a vertex already done has a force
                    add_force(pool, wp.static(VERTEX_SLOTS[k][b]), at, times_coordinate_gradient(Q, b))
                else:
                    set_force(pool, wp.static(VERTEX_SLOTS[k][b]), at, times_coordinate_gradient(Q, b))
        register_barrier()
        R = (T(1.0) / s - T(1.0)) * B
        if wp.static(FIRST_VERTEX_POINT == 1):
            G = centroid_gradient(pool, DISPLACEMENT, at) * inverse_jacobian(block, elem)
            dG = centroid_gradient(pool, DIRECTION, at) * inverse_jacobian(block, elem)
            Fdot = mat33()
            if wp.static(rate):
                Fdot = centroid_gradient(pool, VELOCITY, at) * inverse_jacobian(block, elem)
            dP = point_increment(block, G, dG, Fdot, history, c, dq, form, world, 0, elem)
            w = dq * block.quadrature_weight[0, 0] * block.det_J0[elem]
            R += w * dP * wp.transpose(inverse_jacobian(block, elem))
        add_common_forces(block, pool, scale, B, R, at)

    return product
