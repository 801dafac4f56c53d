"""Rigid analytic shapes: signed distance, outward normal, and a swept test against tunnelling.

All in float64 and in the shape's own frame: half-space z <= 0, sphere about the origin, box along the axes, capsule and
cylinder along z. `size` as in `warpfea.model.shapes`, m: radius; half edges; radius and half length (of a
capsule: of its axis, without the caps).
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import f64, vec3d

__all__ = ["BOX", "CAPSULE", "CYLINDER", "HALF_SPACE", "MESH", "SHAPE_KINDS", "SPHERE", "shape_functions"]

SHAPE_KINDS = ("HalfSpace", "Sphere", "Box", "Capsule", "Cylinder", "TriMesh")
"""Classes of the shapes, in the order of their kinds: those that the device functions of colliders know."""
HALF_SPACE, SPHERE, BOX, CAPSULE, CYLINDER, MESH = range(len(SHAPE_KINDS))
LATERAL_SIDE = 6
"""Sides: 0 to 5 are the faces -x, +x, -y, +y, -z, +z (ends of a cylinder: 4, 5), 6 the lateral side of a cylinder."""
TUNNEL_DEPTH_RATIO = 0.5
"""A motion passes through a shape if it enters deeper than this fraction of its radius or thickness and leaves
again."""


@functools.cache
def shape_functions() -> KernelSet:
    """Device functions `distance`, `side_facing` and `sweep`."""

    @wp.func
    def unit_vector(v: vec3d) -> vec3d:
        """Unit vector along v; z for v = 0."""
        size = wp.length(v)
        if size > f64(0.0):
            return v / size
        return vec3d(f64(0.0), f64(0.0), f64(1.0))

    @wp.func
    def face_normal(side: int) -> vec3d:
        """Outward normal of a flat side."""
        n = vec3d()
        n[side / 2] = wp.where(side % 2 == 0, f64(-1.0), f64(1.0))
        return n

    @wp.func
    def half_size(kind: int, size: vec3d, axis: int) -> f64:
        """Half the thickness of a box or a cylinder along an axis, m."""
        if kind == CYLINDER:
            return wp.where(axis == 2, size[1], size[0])
        return size[axis]

    @wp.func
    def depth_below(kind: int, size: vec3d, y: vec3d, side: int) -> f64:
        """Signed depth of a position below a side of a box or a cylinder, m; positive inside."""
        if side == LATERAL_SIDE:
            return size[0] - wp.sqrt(y[0] * y[0] + y[1] * y[1])
        axis = side / 2
        sign = wp.where(side % 2 == 0, f64(-1.0), f64(1.0))
        return half_size(kind, size, axis) - sign * y[axis]

    @wp.func
    def closest_on_axis(size: vec3d, y: vec3d) -> vec3d:
        """Closest point to y on a capsule's axis."""
        return vec3d(f64(0.0), f64(0.0), wp.clamp(y[2], -size[1], size[1]))

    @wp.func
    def nearest_side(kind: int, size: vec3d, y: vec3d) -> int:
        """Nearest side to a position inside a box or a cylinder."""
        best = wp.int32(5)
        least = depth_below(kind, size, y, 5)
        first = wp.where(kind == CYLINDER, 4, 0)
        for side in range(first, 5):
            d = depth_below(kind, size, y, side)
            if d < least:
                least = d
                best = side
        if kind == CYLINDER:
            if depth_below(kind, size, y, LATERAL_SIDE) < least:
                best = wp.int32(LATERAL_SIDE)
        return best

    @wp.func
    def distance(kind: int, size: vec3d, y: vec3d, side: int) -> wp.vec4d:
        """(n, gap): outward unit normal and signed distance, m, negative inside.

        Inside a box or a cylinder the distance is that from `side`, or from the nearest side if -1.
        """
        n = vec3d(f64(0.0), f64(0.0), f64(1.0))
        gap = y[2]
        if kind == SPHERE:
            n = unit_vector(y)
            gap = wp.length(y) - size[0]
        elif kind == CAPSULE:
            arm = y - closest_on_axis(size, y)
            n = unit_vector(arm)
            gap = wp.length(arm) - size[0]
        elif kind == BOX or kind == CYLINDER:
            rho = wp.sqrt(y[0] * y[0] + y[1] * y[1])
            out = vec3d()
            for k in range(3):
                out[k] = wp.max(wp.abs(y[k]) - half_size(kind, size, k), f64(0.0)) * wp.sign(y[k])
            if kind == CYLINDER:
                over = wp.max(rho - size[0], f64(0.0)) / wp.max(rho, f64(1.0e-300))
                out[0] = over * y[0]
                out[1] = over * y[1]
            gap = wp.length(out)
            if gap > f64(0.0):
                n = out / gap
            else:
                face = side
                if face < 0:
                    face = nearest_side(kind, size, y)
                gap = -depth_below(kind, size, y, face)
                if face == LATERAL_SIDE:
                    n = unit_vector(vec3d(y[0], y[1], f64(0.0)))
                else:
                    n = face_normal(face)
        return wp.vec4d(n[0], n[1], n[2], gap)

    @wp.func
    def side_facing(kind: int, way: vec3d) -> int:
        """Side of a box or a cylinder whose normal is closest to a unit vector `way`."""
        axis = wp.int32(2)
        if kind == CYLINDER and way[2] * way[2] < f64(0.5):
            return LATERAL_SIDE
        for k in range(2):
            if kind == BOX and wp.abs(way[k]) > wp.abs(way[axis]):
                axis = k
        return 2 * axis + wp.where(way[axis] > f64(0.0), 1, 0)

    @wp.func
    def line_interval(kind: int, size: vec3d, a: vec3d, d: vec3d) -> vec3d:
        """Interval of t with a + t d within a box or a cylinder: t of entry, t of exit, and 16 x side of entry + side
        of exit; the first is not smaller than the second if there is none."""
        t_in = f64(-1.0e300)
        t_out = f64(1.0e300)
        side_in = wp.int32(0)
        side_out = wp.int32(0)
        first = wp.where(kind == CYLINDER, 2, 0)
        for axis in range(first, 3):
            h = half_size(kind, size, axis)
            low = 2 * axis
            if d[axis] == f64(0.0):
                if wp.abs(a[axis]) > h:
                    t_in = f64(1.0e300)
            else:
                t0 = (-h - a[axis]) / d[axis]
                t1 = (h - a[axis]) / d[axis]
                near = low
                far = low + 1
                if t0 > t1:
                    swap = t0
                    t0 = t1
                    t1 = swap
                    near = low + 1
                    far = low
                if t0 > t_in:
                    t_in = t0
                    side_in = near
                if t1 < t_out:
                    t_out = t1
                    side_out = far
        if kind == CYLINDER:
            aa = d[0] * d[0] + d[1] * d[1]
            bb = a[0] * d[0] + a[1] * d[1]
            cc = a[0] * a[0] + a[1] * a[1] - size[0] * size[0]
            root = bb * bb - aa * cc
            if aa == f64(0.0) or root < f64(0.0):
                if cc > f64(0.0):
                    t_in = f64(1.0e300)
            else:
                t0 = (-bb - wp.sqrt(root)) / aa
                t1 = (-bb + wp.sqrt(root)) / aa
                if t0 > t_in:
                    t_in = t0
                    side_in = wp.int32(LATERAL_SIDE)
                if t1 < t_out:
                    t_out = t1
                    side_out = wp.int32(LATERAL_SIDE)
        return vec3d(t_in, t_out, f64(16 * side_in + side_out))

    @wp.func
    def segment_distance(kind: int, size: vec3d, a: vec3d, d: vec3d) -> f64:
        """Smallest distance of a + t d, 0 <= t <= 1, from a sphere's centre or a capsule's axis."""
        aa = wp.dot(d, d)
        if aa == f64(0.0):
            return distance(kind, size, a, -1)[3] + size[0]
        half = wp.where(kind == CAPSULE, size[1], f64(0.0))
        t = wp.clamp(-wp.dot(a, d) / aa, f64(0.0), f64(1.0))
        for _ in range(8):  # alternating projection on the two segments: convex, and exact for a sphere
            z = wp.clamp(a[2] + t * d[2], -half, half)
            t = wp.clamp((z * d[2] - wp.dot(a, d)) / aa, f64(0.0), f64(1.0))
        p = a + t * d
        return wp.length(p - vec3d(f64(0.0), f64(0.0), wp.clamp(p[2], -half, half)))

    @wp.func
    def sweep(kind: int, size: vec3d, start: vec3d, end: vec3d, side: int) -> int:
        """Side through which a motion from `start` to `end` ends inside, -1: any; -2: it passed through.

        `side`: that at the start, -1: outside.
        """
        if kind == HALF_SPACE:
            return -1
        d = end - start
        if kind == SPHERE or kind == CAPSULE:
            near = segment_distance(kind, size, start, d)
            if near < f64(TUNNEL_DEPTH_RATIO) * size[0]:
                before = distance(kind, size, start, -1)
                after = distance(kind, size, end, -1)
                turned = before[0] * after[0] + before[1] * after[1] + before[2] * after[2]
                if turned < f64(0.0) or (after[3] > f64(0.0) and before[3] > f64(0.0)):
                    return -2
            return -1
        cross = line_interval(kind, size, start, d)
        code = int(cross[2])
        entry = code / 16
        leave = code % 16
        inside = cross[0] <= f64(0.0) and cross[1] >= f64(0.0)  # at the start
        if inside:
            entry = side
            if side < 0:
                entry = nearest_side(kind, size, start)
        elif cross[0] >= cross[1] or cross[0] > f64(1.0) or cross[1] < f64(0.0):
            return -1
        if cross[1] >= f64(1.0):
            return entry
        if leave == entry:
            if leave == LATERAL_SIDE:
                near = segment_distance(SPHERE, vec3d(size[0], f64(0.0), f64(0.0)), vec3d(start[0], start[1], f64(0.0)),
                                        vec3d(d[0], d[1], f64(0.0)))  # fmt: skip
                if near < f64(TUNNEL_DEPTH_RATIO) * size[0]:
                    return -2
            return -1
        # it left by another side: over an edge, or through
        limit = (
            f64(2.0) * f64(TUNNEL_DEPTH_RATIO) * half_size(kind, size, wp.where(entry == LATERAL_SIDE, 0, entry / 2))
        )
        if depth_below(kind, size, start + cross[1] * d, entry) > limit:
            return -2
        return -1

    return kernel_set(locals())
