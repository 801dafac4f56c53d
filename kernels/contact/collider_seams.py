"""Seams between colliders: a point of a body on a level surface does not meet the side face of the next collider.

A point that enters a collider by a side face would take its normal, although a neighbour's surface at the same level
ends there. The neighbours of a contact are the colliders of its body's other contacts, and its own one if that is a
mesh of several parts; `warpfea/contact/seams.py` lists them; -1 stands for a flexible body at the level, whose surface
each point has from the start of the step. A side face is hidden where a neighbour begins within `reach` in front of it,
its surface there is across the face, at most `depth` above the point, and the collider's own surface is within `seam`
of that level: the point takes the collider's surface. At the foot of a real step a higher neighbour must not count: the
edge of a body that the step holds would gain and lose the support below it within a step of time, which has no
solution. Where colliders of one level overlap, the higher one acts, or the first of those within `seam`. The lower face
of a collider that stands on a neighbour is hidden too: points there meet its sides.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import f64, vec3d
from .collider_shapes import BOX, CYLINDER, HALF_SPACE, MESH
from .colliders import collider_functions
from .structs import collider_struct

__all__ = ["LEVEL_COSINE", "SEAMS_SUFFIX", "seam_functions"]

SEAMS_SUFFIX = "_seams"
"""Suffix of the names of modules compiled with seams."""
MIN_CROSS_COSINE = 0.5
"""Largest cosine between the normals of a side face and of a surface across it."""
LEVEL_COSINE = 0.9999
"""Smallest cosine between the normals of faces of one level."""


@functools.cache
def seam_functions(meshes: bool) -> KernelSet:
    """Device functions `entered_level`, `foot`, `kept_sheet_side` and `is_shared`."""
    Colliders, g = collider_struct(meshes), collider_functions(meshes)
    distance, side_facing, height_beside = g.distance, g.side_facing, g.height_beside

    @wp.func
    def from_neighbor(
        col: Colliders, world: int, kc: int, point: int, b: int, start: vec3d, y: vec3d, way: vec3d
    ) -> wp.vec4d:  # fmt: skip
        """Normal and signed distance of collider b at a position, within it of the side along `way`, if that is not 0;
        all in the frame of collider kc. b = -1: of the body beside it, for a point from `start`."""
        if b < 0:
            level = col.body_level[world, point]
            up = wp.transpose(col.rotation[world, kc]) * vec3d(level[0], level[1], level[2])
            height = wp.where(wp.length_sq(up) > f64(0.0), level[3] + wp.dot(up, y - start), f64(1.0e30))
            return wp.vec4d(up[0], up[1], up[2], height)
        R = wp.transpose(col.rotation[world, kc]) * col.rotation[world, b]
        x = col.rotation[world, kc] * y + col.position[world, kc]
        place = wp.transpose(col.rotation[world, b]) * (x - col.position[world, b])
        found = distance(col, b, place, -1)
        if found[3] < f64(0.0) and wp.length_sq(way) > f64(0.0):
            found = distance(col, b, place, side_facing(col, b, place, wp.transpose(R) * way, f64(1.0)))
        n = R * vec3d(found[0], found[1], found[2])
        return wp.vec4d(n[0], n[1], n[2], found[3])

    @wp.func
    def level_sheet_side(col: Colliders, world: int, c: int, point: int, start: vec3d, y: vec3d, side: int) -> int:
        """Side of a sheet below which a point comes from beside it, from a neighbour at the same level; -1: none.

        Args:
            start, y: positions at the start of the step and now, in the sheet's frame, m.
            side: -3 in front of it, -4 behind.
        """
        kc = col.of_contact[c]
        if side > -3 or height_beside(col, kc, start) < f64(0.0) or height_beside(col, kc, y) >= f64(0.0):
            return -1
        lengths = col.seam_lengths[c]
        d = distance(col, kc, y, -1)
        n = vec3d(d[0], d[1], d[2])
        sign = wp.where(side == -3, f64(1.0), f64(-1.0))
        for e in range(col.neighbor_start[c], col.neighbor_start[c + 1]):
            at = y - lengths[1] * wp.normalize(y - start)
            found = from_neighbor(col, world, kc, point, col.neighbor[e], start, at, vec3d())
            across = wp.abs(wp.dot(vec3d(found[0], found[1], found[2]), n)) > f64(MIN_CROSS_COSINE)
            if across and d[3] <= wp.min(wp.abs(found[3]) + lengths[0], lengths[2]):
                return side_facing(col, kc, y, -sign * n, sign)
        return -1

    @wp.func
    def kept_sheet_side(col: Colliders, c: int, y: vec3d, before: int, now: int) -> int:
        """Contact state of a free point: beside a sheet, level with it, that before; in front where there is none."""
        if before == now:
            return now
        height = height_beside(col, col.of_contact[c], y)
        level = wp.where(before == 0, col.seam_lengths[c][0], col.seam_lengths[c][2])
        return wp.where(height >= f64(0.0) and height <= level, wp.max(before, 1), now)

    @wp.func
    def is_shared(col: Colliders, world: int, c: int, y: vec3d, n: vec3d, gap: f64) -> bool:
        """True for a point of normal n on a collider that is also on a neighbour, of the same level or higher by less
        than `depth`: where colliders overlap, one acts. Arguments as of `level_side`."""
        kc = col.of_contact[c]
        lengths = col.seam_lengths[c]
        seam = lengths[0]
        for e in range(col.neighbor_start[c], col.neighbor_start[c + 1]):
            b = col.neighbor[e]
            if col.neighbor_shares[e] != 0:
                found = from_neighbor(col, world, kc, 0, b, y, y, n)
                first = found[3] < gap - seam or (found[3] <= gap + seam and b < kc)
                first = first and found[3] >= gap - lengths[2]  # not the top of a wall
                if first and found[3] < f64(0.0) and wp.dot(vec3d(found[0], found[1], found[2]), n) > f64(LEVEL_COSINE):
                    return True
        return False

    @wp.func
    def level_side(
        col: Colliders, world: int, c: int, point: int, start: vec3d, y: vec3d, n: vec3d, gap: f64
    ) -> int:  # fmt: skip
        """Side of a contact's collider at the level of a neighbour that hides a side face; -1: it is not hidden.

        Args:
            start: as of `entered_level`.
            y: position in the collider's frame, behind a face of unit normal n by -`gap`, m.
        """
        kc = col.of_contact[c]
        if col.kind[kc] == HALF_SPACE:
            return -1
        lengths = col.seam_lengths[c]
        for e in range(col.neighbor_start[c], col.neighbor_start[c + 1]):
            at = y + (lengths[1] - gap) * n
            found = from_neighbor(col, world, kc, point, col.neighbor[e], start, at, vec3d())
            level = vec3d(found[0], found[1], found[2])
            within = found[3] <= lengths[0] and found[3] >= -lengths[2]
            if within and wp.abs(wp.dot(level, n)) < f64(MIN_CROSS_COSINE):
                behind = y - f64(2.0) * lengths[2] * n  # there no edge of the neighbour is nearer than the level
                side = side_facing(col, kc, behind, level, f64(1.0))
                if side >= 0 and wp.abs(distance(col, kc, behind, side)[3] - found[3]) <= lengths[0]:
                    return side
        return -1

    @wp.func
    def foot(
        col: Colliders, world: int, c: int, point: int, start: vec3d, y: vec3d, gap: f64, side: int
    ) -> wp.vec4d:  # fmt: skip
        """Shift of a point at the foot of a contact's collider that stands on a neighbour, within `seam` of its level,
        to `seam` above that, m, and the side that it meets there, as its lower face is hidden; -1: none.

        Args:
            start, y: as of `entered_level`; gap: at y, m; side: of the collider at the start, see `stored_side`.
        """
        kc = col.of_contact[c]
        lengths = col.seam_lengths[c]
        solid = col.kind[kc] == BOX or col.kind[kc] == CYLINDER
        if wp.static(meshes):
            solid = solid or (col.kind[kc] == MESH and col.size[kc][2] != f64(0.0))
        if not solid or gap > lengths[0]:
            return wp.vec4d(f64(0.0), f64(0.0), f64(0.0), f64(-1.0))
        for e in range(col.neighbor_start[c], col.neighbor_start[c + 1]):
            found = from_neighbor(col, world, kc, point, col.neighbor[e], start, y, vec3d())
            level = vec3d(found[0], found[1], found[2])
            lift = (lengths[0] - found[3]) * level
            if col.neighbor[e] == kc or found[3] > lengths[0] or found[3] < -lengths[2]:
                continue  # nothing stands on itself
            at = y + lift
            lower = distance(col, kc, at, side_facing(col, kc, at, -level, f64(1.0)))
            if lower[3] > f64(0.0) or lower[3] < f64(-2.0) * lengths[0]:
                continue
            d = distance(col, kc, start + lift, side)
            n = vec3d(d[0], d[1], d[2])
            if wp.abs(wp.dot(n, level)) < f64(MIN_CROSS_COSINE):
                return wp.vec4d(lift[0], lift[1], lift[2], f64(side_facing(col, kc, at, n, f64(1.0))))
        return wp.vec4d(f64(0.0), f64(0.0), f64(0.0), f64(-1.0))

    @wp.func
    def entered_level(
        col: Colliders, world: int, c: int, point: int, start: vec3d, y: vec3d, d: wp.vec4d, side: int, swept: int
    ) -> int:  # fmt: skip
        """Side at the level of a neighbour for a point that enters a contact's collider; -1: none.

        Args:
            start, y: positions at the start of the step and now, in the collider's frame, m.
            d: normal and gap at y. side, swept: of the collider at the start, see `stored_side`, and at y.
        """
        if d[3] < f64(0.0) and swept != -2 and (swept != side or side < 0):
            return level_side(col, world, c, point, start, y, vec3d(d[0], d[1], d[2]), d[3])
        if wp.static(meshes):
            if d[3] >= f64(0.0) and swept == -1:
                return level_sheet_side(col, world, c, point, start, y, side)
        return -1

    return kernel_set(locals())
