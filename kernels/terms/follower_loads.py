"""Follower loads: pressure on faces, moments, and their tangents."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import int_1d, precision, vec3d_2d

__all__ = ["follower_struct", "moment_kernels", "pressure_kernels"]


@functools.cache
def follower_struct(dtype: str):
    """Loaded items (faces, or points with a moment): their slots, time laws and tables."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3

    @wp.struct
    class FollowerLoads:
        conn: wp.array2d(dtype=wp.int32)  # [local, item] slot
        time_law: wp.array(dtype=wp.int32)  # [item] index in the table of time laws
        first_entry: wp.int32  # entry of a contribution: first_entry + local * item_count + item
        item_count: wp.int32
        # faces
        reference: wp.array2d(dtype=vec3)  # [local, item] reference value, m; positions relative to the first slot
        is_position: wp.array2d(dtype=T)  # [local, item] 1 for a position, 0 for a gradient
        shape: wp.array3d(dtype=T)  # [point, local, item]
        shape_da: wp.array3d(dtype=T)  # derivatives along the coordinates a and b of the face
        shape_db: wp.array3d(dtype=T)
        weight: wp.array(dtype=T)  # [point] quadrature weight in (a, b), without the area
        # points with a moment
        vector_coefficients: wp.array2d(dtype=vec3)  # [local, item] c_ki of the vectors y_k = sum_i c_ki e_i
        reference_vectors: wp.array(dtype=p.mat33)  # [item] reference values of the vectors y_k, as columns
        moment_fraction: wp.array(dtype=T)  # [item] fraction of the total moment, 1 / number of points

    return FollowerLoads


@functools.cache
def pressure_kernels(dtype: str) -> KernelSet:
    """Kernels of pressures, Pa, on faces."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    FollowerLoads = follower_struct(dtype)
    pressure_module = kernel_module(f"pressure_{dtype}")

    @wp.func
    def surface_tangent(
        data: FollowerLoads, table: p.scalar_3d, u: p.vec3_2d, world: int, point: int, item: int
    ) -> vec3:
        """dx/da or dx/db of a face at a point, by the table of derivatives."""
        out = vec3()
        first = u[world, data.conn[0, item]]
        for i in range(data.conn.shape[0]):
            x = data.reference[i, item] + u[world, data.conn[i, item]] - data.is_position[i, item] * first
            out += table[point, i, item] * x
        return out

    @wp.func
    def interpolate(
        data: FollowerLoads, table: p.scalar_3d, field: p.vec3_2d, world: int, point: int, item: int
    ) -> vec3:
        """sum table_i field_i."""
        out = vec3()
        for i in range(data.conn.shape[0]):
            out += table[point, i, item] * field[world, data.conn[i, item]]
        return out

    @wp.func
    def clear_contribution(data: FollowerLoads, world: int, item: int, contribution: p.vec3_2d):
        """Zero the entries of an item."""
        for i in range(data.conn.shape[0]):
            contribution[world, data.first_entry + i * data.item_count + item] = vec3()

    @masked_kernel(pressure_module, "active")
    def pressure_force(data: FollowerLoads, u: p.vec3_2d, value: vec3d_2d, active: int_1d, contribution: p.vec3_2d):
        """f_i = - int p s_i (x_a x x_b): pressure p against the current outward normal of a face."""
        world, item = wp.tid()
        clear_contribution(data, world, item, contribution)
        for q in range(data.weight.shape[0]):
            normal = wp.cross(
                surface_tangent(data, data.shape_da, u, world, q, item),
                surface_tangent(data, data.shape_db, u, world, q, item),
            )
            f = (-T(value[world, data.time_law[item]][0]) * data.weight[q]) * normal
            for i in range(data.conn.shape[0]):
                k = data.first_entry + i * data.item_count + item
                contribution[world, k] = contribution[world, k] + data.shape[q, i, item] * f

    @masked_kernel(pressure_module, "active")
    def pressure_tangent_product(
        data: FollowerLoads, midpoint_factor: T, factors: p.vec2, u: p.vec3_2d, value: vec3d_2d, active: int_1d,
        direction: p.vec3_2d, contribution: p.vec3_2d,
    ):  # fmt: skip
        """(a K + b K^T)/2 d, (a, b) the factors, K = df/dq of the pressure force, d a direction; K is symmetric on a
        closed surface at uniform p.

        `midpoint_factor`: ratio of the stage's displacement increment to that of the step, 1/2 for midpoint schemes.
        """
        world, item = wp.tid()
        clear_contribution(data, world, item, contribution)
        for q in range(data.weight.shape[0]):
            a = surface_tangent(data, data.shape_da, u, world, q, item)
            b = surface_tangent(data, data.shape_db, u, world, q, item)
            da = interpolate(data, data.shape_da, direction, world, q, item)
            db = interpolate(data, data.shape_db, direction, world, q, item)
            d = interpolate(data, data.shape, direction, world, q, item)
            w = midpoint_factor * T(-0.5) * T(value[world, data.time_law[item]][0]) * data.weight[q]
            force = factors[0] * (wp.cross(da, b) + wp.cross(a, db))
            left = factors[1] * wp.cross(b, d)
            right = factors[1] * wp.cross(d, a)
            for i in range(data.conn.shape[0]):
                k = data.first_entry + i * data.item_count + item
                f = (
                    data.shape[q, i, item] * force
                    + data.shape_da[q, i, item] * left
                    + data.shape_db[q, i, item] * right
                )
                contribution[world, k] = contribution[world, k] + w * f

    return kernel_set(locals())


@functools.cache
def moment_kernels(dtype: str, vectors: int) -> KernelSet:
    """Kernels of moments, N m, that work on the angular velocity of a point's material vectors y_k = sum_i c_ki e_i.

    Args:
        vectors: 3, all of F (solids); 2, those of a beam's section, y_1 and y_2; 1, a shell's director, y_2.
    """
    p = precision(dtype)
    T, vec3, mat33 = p.T, p.vec3, p.mat33
    FollowerLoads = follower_struct(dtype)
    module = kernel_module(f"moment_{dtype}_{vectors}")
    first = 3 - vectors

    @wp.func
    def column(A: mat33, k: int) -> vec3:
        """Column k."""
        return vec3(A[0, k], A[1, k], A[2, k])

    @wp.func
    def with_column(A: mat33, k: int, a: vec3) -> mat33:
        """A with column k replaced by a."""
        out = A
        for c in range(3):
            out[c, k] = a[c]
        return out

    @wp.func
    def with_section_normal(Y: mat33) -> mat33:
        """Section vectors preceded by their unit normal."""
        return with_column(Y, 0, wp.normalize(wp.cross(column(Y, 1), column(Y, 2))))

    @wp.func
    def vector_forces(Y: mat33, m: vec3) -> mat33:
        """Forces on the vectors (columns) whose power is m.w, w the angular velocity of the vectors.

        3: w is the axial vector of Ydot Y^-1. 2: rotation of the section with its normal, w = axial of Adot A^-1 with A
        = [n, y_1, y_2]. 1: w = y x ydot / y^2.
        """
        out = mat33()
        if wp.static(vectors == 3):
            G = wp.transpose(wp.inverse(Y))
            for k in range(3):
                out = with_column(out, k, T(0.5) * wp.cross(m, column(G, k)))
        if wp.static(vectors == 2):
            A = with_section_normal(Y)
            n = column(A, 0)
            G = wp.transpose(wp.inverse(A))
            for k in range(1, 3):
                g = column(G, k)
                out = with_column(out, k, T(0.5) * (wp.cross(m, g) - wp.dot(m, wp.cross(n, g)) * n))
        if wp.static(vectors == 1):
            d = column(Y, 2)
            out = with_column(out, 2, wp.cross(m, d) / wp.dot(d, d))
        return out

    @wp.func
    def vector_forces_change(Y: mat33, dY: mat33, m: vec3) -> mat33:
        """Derivative of `vector_forces` along dY."""
        out = mat33()
        if wp.static(vectors == 3):
            G = wp.transpose(wp.inverse(Y))
            dG = -(G * wp.transpose(dY) * G)
            for k in range(3):
                out = with_column(out, k, T(0.5) * wp.cross(m, column(dG, k)))
        if wp.static(vectors == 2):
            A = with_section_normal(Y)
            n = column(A, 0)
            G = wp.transpose(wp.inverse(A))
            dn = -(wp.dot(n, column(dY, 1)) * column(G, 1) + wp.dot(n, column(dY, 2)) * column(G, 2))
            dG = -(G * wp.transpose(with_column(dY, 0, dn)) * G)
            for k in range(1, 3):
                g = column(G, k)
                dg = column(dG, k)
                dm = wp.dot(m, wp.cross(dn, g)) + wp.dot(m, wp.cross(n, dg))
                out = with_column(out, k, T(0.5) * (wp.cross(m, dg) - wp.dot(m, wp.cross(n, g)) * dn - dm * n))
        if wp.static(vectors == 1):
            d = column(Y, 2)
            dd = column(dY, 2)
            s = T(1.0) / wp.dot(d, d)
            out = with_column(out, 2, s * wp.cross(m, dd) - (T(2.0) * s * s * wp.dot(d, dd)) * wp.cross(m, d))
        return out

    @wp.func
    def interpolate_vectors(data: FollowerLoads, field: p.vec3_2d, world: int, item: int) -> mat33:
        """sum_i c_ki field_i in column k."""
        out = mat33()
        for i in range(data.conn.shape[0]):
            out += wp.outer(field[world, data.conn[i, item]], data.vector_coefficients[i, item])
        return out

    @wp.func
    def current_vectors(data: FollowerLoads, u: p.vec3_2d, world: int, item: int) -> mat33:
        """Current vectors: their reference values (the axes) plus displacements."""
        return data.reference_vectors[item] + interpolate_vectors(data, u, world, item)

    @masked_kernel(module, "active")
    def moment_force(data: FollowerLoads, u: p.vec3_2d, value: vec3d_2d, active: int_1d, contribution: p.vec3_2d):
        """f_i = sum_k c_ki phi_k with phi of `vector_forces`."""
        world, item = wp.tid()
        m = data.moment_fraction[item] * vec3(value[world, data.time_law[item]])
        phi = vector_forces(current_vectors(data, u, world, item), m)
        for i in range(data.conn.shape[0]):
            contribution[world, data.first_entry + i * data.item_count + item] = phi * data.vector_coefficients[i, item]

    @masked_kernel(module, "active")
    def moment_tangent_product(
        data: FollowerLoads, midpoint_factor: T, factors: p.vec2, u: p.vec3_2d, value: vec3d_2d, active: int_1d,
        direction: p.vec3_2d, contribution: p.vec3_2d,
    ):  # fmt: skip
        """(a K + b K^T)/2 d with K = df/dq, d a direction; arguments as of `pressure_tangent_product`."""
        world, item = wp.tid()
        m = (midpoint_factor * data.moment_fraction[item]) * vec3(value[world, data.time_law[item]])
        Y = current_vectors(data, u, world, item)
        D = interpolate_vectors(data, direction, world, item)
        S = T(0.5) * factors[0] * vector_forces_change(Y, D, m)
        for k in range(first, 3):
            for c in range(3):
                unit = mat33()
                unit[c, k] = T(1.0)
                S[c, k] = S[c, k] + T(0.5) * factors[1] * wp.ddot(D, vector_forces_change(Y, unit, m))
        for i in range(data.conn.shape[0]):
            contribution[world, data.first_entry + i * data.item_count + item] = S * data.vector_coefficients[i, item]

    return kernel_set(locals())
