"""Distance, sweep and side of a point for colliders of all kinds.

Models without triangle meshes use functions compiled without the mesh code.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import f64, vec3d
from .collider_mesh import mesh_functions
from .collider_shapes import BOX, HALF_SPACE, MESH, SPHERE, shape_functions
from .structs import SLIP_FLAG, collider_struct

__all__ = ["MESH_SUFFIX", "collider_functions"]

MESH_SUFFIX = "_meshes"
"""Suffix of the names of modules compiled with the mesh code."""

MESH_FUNCTIONS = ("distance", "sweep", "updated_side", "depth_change", "sheet_side", "side_facing",
                  "height_beside")  # fmt: skip


@functools.cache
def collider_functions(meshes: bool) -> KernelSet:
    """Device functions, see `shape_functions` and `mesh_functions`."""
    Colliders = collider_struct(meshes)
    shapes = shape_functions()
    of_shape, sweep_shape, shape_side_facing = shapes.distance, shapes.sweep, shapes.side_facing
    mesh = mesh_functions(Colliders) if meshes else KernelSet(**dict.fromkeys(MESH_FUNCTIONS))
    distance_on_mesh, sweep_mesh, side_on_mesh, depth_change_on_mesh, sheet_side_on_mesh, mesh_side_facing, beside = (
        getattr(mesh, name) for name in MESH_FUNCTIONS
    )

    @wp.func
    def distance(col: Colliders, k: int, y: vec3d, side: int) -> wp.vec4d:
        """Outward unit normal and signed distance at a position in the frame of collider k."""
        if wp.static(meshes):
            if col.kind[k] == MESH:
                return distance_on_mesh(col, k, y, side)
        return of_shape(col.kind[k], col.size[k], y, side)

    @wp.func
    def sweep(col: Colliders, k: int, start: vec3d, end: vec3d, side: int) -> int:
        """Side through which a motion ends inside, -1: any; -2: it passed through the collider."""
        if wp.static(meshes):
            if col.kind[k] == MESH:
                return sweep_mesh(col, k, start, end, side)
        return sweep_shape(col.kind[k], col.size[k], start, end, side)

    @wp.func
    def side_facing(col: Colliders, k: int, y: vec3d, way: vec3d, sign: f64) -> int:
        """Side of a box, cylinder or mesh ahead of y that faces along `way`; sign -1: from behind a sheet; -1: none."""
        if wp.static(meshes):
            if col.kind[k] == MESH:
                return mesh_side_facing(col, k, y, way, sign)
        return shape_side_facing(col.kind[k], way)

    @wp.func
    def height_beside(col: Colliders, k: int, y: vec3d) -> f64:
        """Distance from the plane of a sheet, m, of a position beyond its boundary; else -1."""
        if wp.static(meshes):
            if col.kind[k] == MESH and col.size[k][2] == f64(0.0):
                return beside(col, k, y)
        return f64(-1.0)

    @wp.func
    def stored_side(in_contact: bool, contact_state: int) -> int:
        """Side stored in a contact state, -1: none; of a point without contact to a sheet -3 in front of it, -4
        behind."""
        if in_contact:
            return contact_state % SLIP_FLAG - 1
        if wp.static(meshes):
            if contact_state % SLIP_FLAG > 0:
                return -2 - contact_state % SLIP_FLAG
        return -1

    @wp.func
    def sheet_side(col: Colliders, k: int, y: vec3d, contact_state: int) -> int:
        """Contact state of a free point: its side of a sheet, unchanged where round-off hides the side."""
        if wp.static(meshes):
            if col.kind[k] == MESH and col.size[k][2] == f64(0.0):
                return sheet_side_on_mesh(col, k, y, contact_state)
        return 0

    @wp.func
    def released_contact_state(col: Colliders, k: int, in_contact: bool, contact_state: int) -> int:
        """Contact state of a point that has left contact."""
        if wp.static(meshes):
            if col.kind[k] == MESH and col.size[k][2] == f64(0.0):
                if in_contact and contact_state % SLIP_FLAG > 0:
                    return 1 + (contact_state % SLIP_FLAG - 1) % 2
                return wp.where(in_contact, 0, contact_state)
        return 0

    @wp.func
    def updated_side(col: Colliders, k: int, y: vec3d, side: int) -> int:
        """Updated side of a point at y that was swept to a side: on a mesh it slides over triangles."""
        if wp.static(meshes):
            if col.kind[k] == MESH:
                return side_on_mesh(col, k, y, side)
        return wp.max(side, -1)

    @wp.func
    def depth_change(
        col: Colliders, k: int, side: int, start: vec3d, y: vec3d, local: vec3d, before: f64, after: f64
    ) -> wp.vec2d:  # fmt: skip
        """(change of depth, 1) from the motion itself where that is exact, else (difference of the end distances, 0).

        A difference of positions has their round-off, which exceeds the motion of a stiff body at rest.
        """
        kind = col.kind[k]
        if kind == HALF_SPACE:
            return wp.vec2d(-local[2], f64(1.0))
        if kind == SPHERE:
            return wp.vec2d(
                -wp.dot(y + start, local) / wp.max(wp.length(y) + wp.length(start), f64(1.0e-300)), f64(1.0)
            )
        if kind == BOX and side >= 0:
            h = col.size[k]
            axis = side / 2
            sign = wp.where(side % 2 == 0, f64(-1.0), f64(1.0))
            flat = wp.abs(h[axis] - sign * start[axis] + before) <= f64(1.0e-12) * h[axis]
            for j in range(3):
                if j != axis and wp.abs(start[j]) > h[j]:
                    flat = False
            if flat:
                return wp.vec2d(-sign * local[axis], f64(1.0))
        if wp.static(meshes):
            if kind == MESH:
                return depth_change_on_mesh(col, k, side, start, y, local, before, after)
        return wp.vec2d()

    return kernel_set(locals())
