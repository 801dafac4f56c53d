"""Rigid triangle meshes: nearest position, side and crossing by a bounding-box tree built once in the mesh's frame.

Unlike `wp.Bvh` the tree is float64 throughout: no outward rounding is needed, and each thread has its own stack
(queries of `wp.Bvh` share one per block on CUDA). It is balanced: the children of box i are 2 i + 1 and 2 i + 2.

A closed mesh is solid. A sheet, which has an edge with one triangle, acts on both of its sides. Angle-weighted normals
(Baerentzen and Aanaes, IEEE TVCG 11, 2005) determine the front. A point that has passed the surface keeps the triangle
of its entry until it leaves again: `side` is twice the triangle's number, plus 1 for an entry from behind. Candidates
are then the triangles that face like that one and are ahead of the point.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set

__all__ = ["BOUNDARY", "FLAT", "SHARP", "SIDE_TOLERANCE", "mesh_functions", "mesh_struct"]

SHARP, FLAT, BOUNDARY = range(3)
"""Edge between triangles of different planes, of one plane, or of a single triangle."""
STACK_SIZE = 40
"""Stack size: at most one box per level of a tree and one more; 2^30 triangles need 30."""
SAME_SIDE_COSINE = 0.5
"""Minimum cosine between the normals of triangles of one side."""
SURFACE_TOLERANCE = 1e-12
"""Distance behind a surface that counts as on it, over the mesh's size."""
SIDE_TOLERANCE = 1e-6
"""SURFACE_TOLERANCE for a point that was on the other side: bound of the float32 round-off of a step's end."""
MIN_PASSAGE = 1e-6
"""Depth of a negligible passage (over the edge of a blade), over the mesh's thickness."""


@functools.cache
def mesh_struct():
    """Triangles of all meshes, [collider], [box] or [.., triangle]; the triangles of a leaf are contiguous.

    Features of a triangle: 0 its face, 1 to 3 the edges ab, bc, ca, 4 to 6 the corners a, b, c.
    """

    @wp.struct
    class Meshes:
        first_box: wp.array(dtype=wp.int32)  # [collider] index of its first box
        first_leaf: wp.array(dtype=wp.int32)  # [collider] index of its first leaf
        inner_count: wp.array(dtype=wp.int32)  # [collider] number of boxes above the leaves
        box_low: wp.array(dtype=wp.vec3d)  # [box] corners of boxes, m
        box_high: wp.array(dtype=wp.vec3d)
        leaf_start: wp.array(dtype=wp.int32)  # [leaf] index of its first triangle; the next entry ends it
        corner: wp.array2d(dtype=wp.vec3d)  # [corner, triangle], m
        normal: wp.array2d(dtype=wp.vec3d)  # [feature, triangle] unit normal
        feature_kind: wp.array2d(dtype=wp.int32)  # [feature, triangle] FLAT, SHARP or BOUNDARY

    return Meshes


@functools.cache
def mesh_functions(Colliders) -> KernelSet:
    """Device functions of a `collider_struct` with `mesh`; `size`: its size, thickness, 1 if closed."""
    f64, vec3d, vec4d = wp.float64, wp.vec3d, wp.vec4d
    ints = wp.types.vector(length=STACK_SIZE, dtype=wp.int32)

    @wp.struct
    class Nearest:
        position: vec3d  # closest point, m
        distance_squared: f64  # m^2
        feature: wp.int32  # of the triangle, see `mesh_struct`
        triangle: wp.int32  # -1: none

    @wp.struct
    class Crossings:
        """First crossings of a segment to the back and to the front; parameter t in [0, 1], or 2."""

        entry_parameter: f64
        exit_parameter: f64
        entry_triangle: wp.int32
        exit_triangle: wp.int32

    @wp.func
    def closest_on_triangle(a: vec3d, b: vec3d, c: vec3d, n: vec3d, y: vec3d) -> vec4d:
        """Nearest position on a triangle to y, and its feature (Ericson, Real-Time Collision Detection, 2005,
        5.1.5)."""
        zero = f64(0.0)
        ab = b - a
        ac = c - a
        d1 = wp.dot(ab, y - a)
        d2 = wp.dot(ac, y - a)
        d3 = wp.dot(ab, y - b)
        d4 = wp.dot(ac, y - b)
        d5 = wp.dot(ab, y - c)
        d6 = wp.dot(ac, y - c)
        if d1 <= zero and d2 <= zero:
            return vec4d(a[0], a[1], a[2], f64(4.0))
        if d3 >= zero and d4 <= d3:
            return vec4d(b[0], b[1], b[2], f64(5.0))
        if d6 >= zero and d5 <= d6:
            return vec4d(c[0], c[1], c[2], f64(6.0))
        part = f64(0.0)
        place = y - wp.dot(y - a, n) * n
        if d1 >= zero and d3 <= zero and d1 * d4 - d3 * d2 <= zero:
            part = f64(1.0)
            place = a + (d1 / (d1 - d3)) * ab
        elif d4 >= d3 and d5 >= d6 and d3 * d6 - d5 * d4 <= zero:
            part = f64(2.0)
            place = b + ((d4 - d3) / ((d4 - d3) + (d5 - d6))) * (c - b)
        elif d2 >= zero and d6 <= zero and d5 * d2 - d1 * d6 <= zero:
            part = f64(3.0)
            place = a + (d2 / (d2 - d6)) * ac
        return vec4d(place[0], place[1], place[2], part)

    @wp.func
    def box_distance_squared(low: vec3d, high: vec3d, y: vec3d) -> f64:
        """Squared distance from a box."""
        out = f64(0.0)
        for k in range(3):
            d = wp.max(wp.max(low[k] - y[k], y[k] - high[k]), f64(0.0))
            out += d * d
        return out

    @wp.func
    def side_sign(side: int) -> f64:
        """Side sign: 1 for a point from the front, -1 from behind."""
        return wp.where(side >= 0 and side % 2 == 1, f64(-1.0), f64(1.0))

    @wp.func
    def is_candidate(col: Colliders, t: int, y: vec3d, way: vec3d, sign: f64) -> bool:
        """True if a triangle faces along `way` and is ahead of a point that has passed the surface from the front (sign
        1) or from behind (-1); 0: any."""
        if sign == f64(0.0):
            return True
        n = col.mesh.normal[0, t]
        if wp.dot(n, way) <= f64(SAME_SIDE_COSINE):
            return False
        return sign * wp.dot(y - col.mesh.corner[0, t], n) <= f64(0.0)

    @wp.func
    def nearest_facing(col: Colliders, k: int, y: vec3d, way: vec3d, sign: f64) -> Nearest:
        """Nearest position to y on the candidate triangles of a mesh."""
        best = Nearest()
        best.distance_squared = f64(1.0e300)
        best.triangle = -1
        base = col.mesh.first_box[k]
        inner = col.mesh.inner_count[k]
        waiting = ints()
        top = wp.int32(1)
        while top > 0:
            top -= 1
            i = waiting[top]
            if box_distance_squared(col.mesh.box_low[base + i], col.mesh.box_high[base + i], y) < best.distance_squared:
                if i < inner:
                    near = 2 * i + 1
                    far = near + 1
                    d_near = box_distance_squared(col.mesh.box_low[base + near], col.mesh.box_high[base + near], y)
                    d_far = box_distance_squared(col.mesh.box_low[base + far], col.mesh.box_high[base + far], y)
                    if d_far < d_near:
                        near = far
                        far = 2 * i + 1
                    waiting[top] = far
                    waiting[top + 1] = near
                    top += 2
                else:
                    leaf = col.mesh.first_leaf[k] + i - inner
                    for t in range(col.mesh.leaf_start[leaf], col.mesh.leaf_start[leaf + 1]):
                        if is_candidate(col, t, y, way, sign):
                            c = closest_on_triangle(col.mesh.corner[0, t], col.mesh.corner[1, t], col.mesh.corner[2, t],
                                           col.mesh.normal[0, t], y)  # fmt: skip
                            place = vec3d(c[0], c[1], c[2])
                            square = wp.length_sq(y - place)
                            if square < best.distance_squared:
                                best.distance_squared = square
                                best.position = place
                                best.feature = wp.int32(c[3])
                                best.triangle = t
        return best

    @wp.func
    def nearest_on_mesh(col: Colliders, k: int, y: vec3d, side: int) -> Nearest:
        """Nearest position on a mesh to y; with a side, among the triangles that face like its one."""
        if side < 0:
            return nearest_facing(col, k, y, vec3d(), f64(0.0))
        return nearest_facing(col, k, y, col.mesh.normal[0, side / 2], side_sign(side))

    @wp.func
    def signed_distance(col: Colliders, k: int, s: Nearest, y: vec3d) -> vec4d:
        """Normal and signed distance at the nearest position, positive in front of the surface."""
        n = col.mesh.normal[s.feature, s.triangle]
        if col.mesh.feature_kind[s.feature, s.triangle] == FLAT:
            return vec4d(n[0], n[1], n[2], wp.dot(y - col.mesh.corner[0, s.triangle], n))
        arm = y - s.position
        size = wp.length(arm)
        sign = wp.where(wp.dot(arm, n) >= f64(0.0), f64(1.0), f64(-1.0))
        if size > f64(1.0e-9) * col.size[k][0]:
            n = (sign / size) * arm
        return vec4d(n[0], n[1], n[2], sign * size)

    @wp.func
    def distance_behind(col: Colliders, k: int, s: Nearest, y: vec3d) -> vec4d:
        """`signed_distance` of a point behind the surface, with a normal in the cone of the feature, else of the plane.

        Below one part of a mesh the edge of another one may be nearer than the surface above.
        """
        d = signed_distance(col, k, s, y)
        n = col.mesh.normal[0, s.triangle]
        mean = col.mesh.normal[s.feature, s.triangle]
        cosine = wp.abs(wp.dot(vec3d(d[0], d[1], d[2]), mean))
        if col.mesh.feature_kind[s.feature, s.triangle] == SHARP and cosine < wp.dot(mean, n) - f64(SURFACE_TOLERANCE):
            return vec4d(n[0], n[1], n[2], wp.dot(y - col.mesh.corner[0, s.triangle], n))
        return d

    @wp.func
    def on_boundary(col: Colliders, s: Nearest) -> bool:
        """True if the nearest position is on the boundary of a sheet."""
        return col.mesh.feature_kind[s.feature, s.triangle] == BOUNDARY

    @wp.func
    def distance(col: Colliders, k: int, y: vec3d, side: int) -> vec4d:
        """Normal towards the side of the point, and signed distance; without a side: outside of a sheet."""
        s = nearest_on_mesh(col, k, y, -1)
        d = signed_distance(col, k, s, y)
        if col.size[k][2] == f64(0.0) and (side < 0 or on_boundary(col, s)):
            return wp.where(d[3] < f64(0.0), -d, d)
        d = side_sign(side) * d
        if side >= 0 and d[3] < f64(0.0):
            ahead = nearest_on_mesh(col, k, y, side)
            if ahead.triangle >= 0:
                d = side_sign(side) * distance_behind(col, k, ahead, y)
                if (d[3] > f64(0.0)) != on_boundary(col, ahead):  # away from the boundary it is outside
                    d = -d
        return d

    @wp.func
    def updated_side(col: Colliders, k: int, y: vec3d, side: int) -> int:
        """Side of a point at its new position, -1 outside."""
        if distance(col, k, y, side)[3] >= f64(0.0):
            return -1
        s = nearest_on_mesh(col, k, y, side)
        if s.triangle < 0:
            s = nearest_on_mesh(col, k, y, -1)
        return 2 * s.triangle + wp.max(side, 0) % 2

    @wp.func
    def side_facing(col: Colliders, k: int, y: vec3d, way: vec3d, sign: f64) -> int:
        """Side of the nearest triangle that faces along `way` and is ahead of y; sign: 1, -1 from behind; -1: none."""
        s = nearest_facing(col, k, y, way, sign)
        return wp.where(s.triangle < 0, -1, 2 * s.triangle + wp.where(sign < f64(0.0), 1, 0))

    @wp.func
    def height_beside(col: Colliders, k: int, y: vec3d) -> f64:
        """Distance from the plane of a sheet, m, of a position beyond its boundary; else -1."""
        s = nearest_on_mesh(col, k, y, -1)
        height = wp.abs(wp.dot(y - s.position, col.mesh.normal[0, s.triangle]))
        return wp.where(on_boundary(col, s), height, f64(-1.0))

    @wp.func
    def sheet_side(col: Colliders, k: int, y: vec3d, contact_state: int) -> int:
        """1 in front of a sheet, 2 behind, and unchanged within round-off of the sheet."""
        s = nearest_on_mesh(col, k, y, -1)
        above = wp.dot(y - s.position, col.mesh.normal[s.feature, s.triangle])
        if wp.abs(above) <= f64(SIDE_TOLERANCE) * col.size[k][0]:
            if contact_state == 0 and above < -f64(SURFACE_TOLERANCE) * col.size[k][0]:
                return 2
            return wp.max(contact_state, 1)
        return wp.where(above > f64(0.0), 1, 2)

    @wp.func
    def misses_box(low: vec3d, high: vec3d, middle: vec3d, half: vec3d) -> bool:
        """True if a segment misses a box (separating axes)."""
        e = f64(0.5) * (high - low)
        c = middle - f64(0.5) * (high + low)
        a = vec3d(wp.abs(half[0]), wp.abs(half[1]), wp.abs(half[2]))
        for k in range(3):
            if wp.abs(c[k]) > e[k] + a[k]:
                return True
        w = wp.cross(half, c)
        if wp.abs(w[0]) > e[1] * a[2] + e[2] * a[1]:
            return True
        if wp.abs(w[1]) > e[0] * a[2] + e[2] * a[0]:
            return True
        return wp.abs(w[2]) > e[0] * a[1] + e[1] * a[0]

    @wp.func
    def within_triangle(col: Colliders, t: int, p: vec3d, tol: f64) -> bool:
        """True if a position in the plane of a triangle is within it or within `tol` of it."""
        n = col.mesh.normal[0, t]
        for k in range(3):
            a = col.mesh.corner[k, t]
            edge = col.mesh.corner[(k + 1) % 3, t] - a
            if wp.dot(wp.cross(n, edge), p - a) < -tol * wp.length(edge):
                return False
        return True

    @wp.func
    def find_crossings(col: Colliders, k: int, a: vec3d, b: vec3d, side: int) -> Crossings:
        """Crossings of the surface by the segment from a to b; `side` at its start: -3 in front, -4 behind."""
        out = Crossings()
        out.entry_parameter = f64(2.0)
        out.exit_parameter = f64(2.0)
        tol = f64(SURFACE_TOLERANCE) * col.size[k][0]
        level = -tol  # lowest start height that counts as in front
        if side < -2:
            level = wp.where(side == -3, -f64(SIDE_TOLERANCE), f64(SIDE_TOLERANCE)) * col.size[k][0]
        reach = f64(2.0) * f64(SIDE_TOLERANCE) * col.size[k][0]
        margin = vec3d(reach, reach, reach)
        waiting = ints()
        top = wp.int32(1)
        while top > 0:
            top -= 1
            i = waiting[top]
            box = col.mesh.first_box[k] + i
            low, high = col.mesh.box_low[box] - margin, col.mesh.box_high[box] + margin
            if not misses_box(low, high, f64(0.5) * (a + b), f64(0.5) * (b - a)):
                if i < col.mesh.inner_count[k]:
                    waiting[top] = 2 * i + 1
                    waiting[top + 1] = 2 * i + 2
                    top += 2
                else:
                    leaf = col.mesh.first_leaf[k] + i - col.mesh.inner_count[k]
                    for t in range(col.mesh.leaf_start[leaf], col.mesh.leaf_start[leaf + 1]):
                        n = col.mesh.normal[0, t]
                        before = wp.dot(a - col.mesh.corner[0, t], n)
                        after = wp.dot(b - col.mesh.corner[0, t], n)
                        enters = before >= level and after < f64(0.0) and after < before
                        leaves = before < level and after >= f64(0.0) and after > before
                        if enters or leaves:
                            part = wp.clamp(before / (before - after), f64(0.0), f64(1.0))
                            if within_triangle(col, t, a + part * (b - a), f64(1000.0) * tol):
                                if enters and part < out.entry_parameter:
                                    out.entry_parameter = part
                                    out.entry_triangle = t
                                elif leaves and part < out.exit_parameter:
                                    out.exit_parameter = part
                                    out.exit_triangle = t
        return out

    @wp.func
    def passes_through(col: Colliders, k: int, first: int, entry: vec3d, last: int, leave: vec3d, sense: f64) -> bool:
        """True if a path in through a triangle and out through another crosses the mesh, not just its edge."""
        n = col.mesh.normal[0, first]
        turn = wp.dot(n, col.mesh.normal[0, last])
        deep = sense * wp.dot(n, entry - leave)
        thick = col.size[k][1]
        if turn < f64(-SAME_SIDE_COSINE):
            return deep > f64(MIN_PASSAGE) * thick
        return turn < f64(SAME_SIDE_COSINE) and deep > f64(0.5) * thick

    @wp.func
    def beyond_sheet(col: Colliders, k: int, side: int, y: vec3d) -> bool:
        """True if a point is so far behind a sheet that it is beyond it."""
        deep = side_sign(side) * wp.dot(col.mesh.normal[0, side / 2], col.mesh.corner[0, side / 2] - y)
        return col.size[k][2] == f64(0.0) and deep > col.size[k][1]

    @wp.func
    def sweep(col: Colliders, k: int, start: vec3d, end: vec3d, side: int) -> int:
        """Side through which a motion has passed the surface at its end, -1: none or any, -2: it passed through; see
        `shape_functions`."""
        h = find_crossings(col, k, start, end, side)
        d = end - start
        if side >= 0:
            leave = wp.where(side % 2 == 0, h.exit_parameter, h.entry_parameter)
            last = wp.where(side % 2 == 0, h.exit_triangle, h.entry_triangle)
            if leave > f64(1.0):
                return wp.where(beyond_sheet(col, k, side, end), -2, side)
            entry = col.mesh.corner[0, side / 2]
            if passes_through(col, k, side / 2, entry, last, start + leave * d, side_sign(side)):
                return -2
            return -1
        if h.entry_parameter > f64(1.0) and h.exit_parameter > f64(1.0):
            return -1
        behind = wp.where(col.size[k][2] == f64(0.0) and h.exit_parameter < h.entry_parameter, 1, 0)
        first = wp.where(behind == 1, h.exit_triangle, h.entry_triangle)
        last = wp.where(behind == 1, h.entry_triangle, h.exit_triangle)
        t0 = wp.where(behind == 1, h.exit_parameter, h.entry_parameter)
        t1 = wp.where(behind == 1, h.entry_parameter, h.exit_parameter)
        if t0 > f64(1.0) or t1 < t0:
            return -1
        if t1 > f64(1.0):
            return wp.where(beyond_sheet(col, k, 2 * first + behind, end), -2, 2 * first + behind)
        if passes_through(col, k, first, start + t0 * d, last, start + t1 * d, side_sign(behind)):
            return -2
        return -1

    @wp.func
    def depth_change(
        col: Colliders, k: int, side: int, start: vec3d, y: vec3d, local: vec3d, before: f64, after: f64
    ) -> wp.vec2d:  # fmt: skip
        """(change of depth, 1) by a motion along one plane, else (difference of the end distances, 0)."""
        if side < 0:
            return wp.vec2d()
        n = side_sign(side) * col.mesh.normal[0, side / 2]
        a = col.mesh.corner[0, side / 2]
        tol = f64(SURFACE_TOLERANCE) * col.size[k][0]
        if wp.abs(wp.dot(start - a, n) - before) <= tol and wp.abs(wp.dot(y - a, n) - after) <= tol:
            return wp.vec2d(-wp.dot(n, local), f64(1.0))
        return wp.vec2d()

    return kernel_set(locals())
