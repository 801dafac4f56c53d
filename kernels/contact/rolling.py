"""Points of round rigid parts on obstacles, which roll: each lies on a circle, or a ball, about a place on the axis,
where that is closest to the obstacle.

Its depth is stationary along the circle, so that the force at the fixed material point there is the derivative of the
elastic energy. Friction acts on the motion of that point, which changes along the circle by the square of the turn in a
step. In mid-point schemes it is the point that is closest in the middle of the turn, on a circle that is as deep at
both ends as the surface: the normal force does no work as the part rolls. It is then frozen with the friction limits.
"""

import functools

import warp as wp

from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import f64, precision, vec3d
from .collider_kinematics import collider_kinematics
from .collider_seams import SEAMS_SUFFIX
from .colliders import MESH_SUFFIX, collider_functions
from .kinematics import kinematics_functions
from .structs import collider_struct, contact_structs

__all__ = ["rolling_kernels"]

LEVEL_SINE = 0.1
"""Sine of the angle of an end face with the obstacle below which the point of its rim moves towards its centre: on a
face that lies flat no point of the rim is the closest, and a point that moves fast is not in the tangent. Below it the
points on the face, whose corners are there within 1e-3 of the radius as near, bear the load."""


@functools.cache
def rolling_kernels(dtype: str, meshes: bool, seams: bool) -> KernelSet:
    """Kernels in one precision of the displacements; arguments as of `collider_kinematics`."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    Colliders = collider_struct(meshes)
    k, distance = kinematics_functions(dtype), collider_functions(meshes).distance
    begin_point = collider_kinematics(dtype, meshes, seams).begin_point
    suffix = MESH_SUFFIX * meshes + SEAMS_SUFFIX * seams
    module = kernel_module(f"contact_rolling_{dtype}{suffix}", max_unroll=SHORT_UNROLL)

    @wp.func
    def arm(facets: Facets, row: int, q: int, way: vec3d) -> vec3d:
        """From the place on the axis to the surface along `way`, in the reference, m."""
        line = facets.rolling_axis[row]
        axis = vec3d(line[0], line[1], line[2])
        along = wp.dot(way, axis)
        if facets.rolling_end[q, row] * along > f64(0.0):
            return (line[3] / wp.length(way)) * way
        across = way - along * axis
        return (line[3] / wp.max(wp.length(across), f64(LEVEL_SINE))) * across

    @masked_kernel(module, "active")
    def place_points(
        con: Contacts, col: Colliders, facets: Facets, his: History, clock: Clock, u: wp.array2d(dtype=vec3d),
        u_n: wp.array2d(dtype=vec3), v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), middle: f64,
        settled: int, scr: ContactScratch,
    ):  # fmt: skip
        """Rolling points at displacements u: their reference positions, shape values, and start of the attempt;
        `middle`: share of the start in the turn; `settled`: at a state."""
        world, item, q = wp.tid()
        if not k.is_edge(facets, item) or facets.area_fraction[q, item] == f64(0.0):
            return
        row = facets.edge_row[item]
        kc = col.of_contact[facets.contact[item]]
        x = facets.X[q, item] + k.interpolate_at(facets, u, world, q, item, item)
        d = distance(col, kc, wp.transpose(col.rotation[world, kc]) * (x - col.position[world, kc]), -1)
        n = col.rotation[world, kc] * vec3d(d[0], d[1], d[2])
        way, back = -n, vec3d()  # turned back with the part; and its change to the start
        for i in range(facets.conn.shape[0]):
            slot = facets.conn[i, item]
            way -= wp.dot(n, u[world, slot]) * facets.rolling_gradient[i, row]
            back -= wp.dot(n, vec3d(u_n[world, slot]) - u[world, slot]) * facets.rolling_gradient[i, row]
        reach = arm(facets, row, q, way)
        if middle > f64(0.0):  # in the middle of the turn, as deep at both ends as the surface there
            low = wp.dot(reach, way)
            reach = arm(facets, row, q, way + middle * back)
            reach *= wp.min(low / wp.max(wp.dot(reach, way), f64(1.0e-300)), f64(2.0))
        at = k.column(facets, world, item) - facets.facet_count
        facets.edge_X[q, at] = facets.X[q, item] + reach
        for i in range(facets.conn.shape[0]):
            value = f64(facets.shape[q, i, item]) + wp.dot(facets.rolling_gradient[i, row], reach)
            facets.edge_shape[q, i, at] = T(value)
        if settled == 0:
            begin_point(con, col, facets, his, clock, scr, u_n, v_n, world, item, q)

    return kernel_set(locals())
