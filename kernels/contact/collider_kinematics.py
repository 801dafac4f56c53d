"""Points against rigid shapes: the geometry of colliders, their poses, and the record of a point."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import f64, precision, vec3d
from .collider_seams import SEAMS_SUFFIX, seam_functions
from .collider_shapes import BOX, CYLINDER, MESH
from .colliders import MESH_SUFFIX, collider_functions
from .kinematics import (
    ENTRY_DEPTH,
    GEOMETRIES,
    MAX_DEPTH_RATIO,
    MIN_NORMAL_COSINE,
    OPPOSING_COSINE,
    kinematics_functions,
)
from .law import ANY_GAP
from .structs import FREE, IN_REACH, PASSED, TURNED, collider_struct, contact_structs

__all__ = ["MAX_COLLIDER_ROTATION", "collider_kinematics", "pose_kernels"]

MAX_COLLIDER_ROTATION = 1.0
"""Largest rotation of a touched collider in a step, rad; larger rotations are rejected."""
BESIDE_DEPTH = 0.25
"""Depth over that of an element to which a facet below an edge does not touch the side face that it does not face."""
EDGE_ENTRY_SLOPE = 100.0
"""Depth over that below the side face from which a point over an edge is in contact: one that wavers at the edge must
not gain and lose its force."""
BESIDE = -3
"""In place of a side: the point has none."""


@functools.cache
def collider_kinematics(dtype: str, meshes: bool, seams: bool = False) -> KernelSet:
    """Device functions of the geometry, see kinematics.py; `meshes`: some collider is a triangle mesh; `seams`: some
    contact has neighbours, see collider_seams.py."""
    vec3 = precision(dtype).vec3
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    Other = collider_struct(meshes)
    k, g = kinematics_functions(dtype), collider_functions(meshes)
    interpolate, distance, stored_side = k.interpolate, g.distance, g.stored_side
    seam = seam_functions(meshes) if seams else None
    names = ("entered_level", "foot", "kept_sheet_side", "is_shared")
    entered_level, foot, kept_sheet_side, is_shared = (getattr(seam, name, None) for name in names)

    @wp.func
    def set_start(
        col: Other, scr: ContactScratch, world: int, kc: int, point: int, y: vec3d, side: int, activation: f64
    ) -> vec3d:  # fmt: skip
        """Set position and depth of a point at the start of an attempt; the normal there in the collider's frame."""
        d = distance(col, kc, y, side)
        scr.start_position[world, point] = y
        scr.activation_gap[world, point] = activation
        scr.start_depth[world, point] = activation - d[3]
        return vec3d(d[0], d[1], d[2])

    @wp.func
    def material_velocity(col: Other, clock: Clock, world: int, kc: int, y: vec3d) -> vec3d:
        """Mean velocity in the attempt of the collider's material at y in its frame, m/s."""
        before = col.previous_rotation[world, kc] * y + col.previous_position[world, kc]
        return (col.rotation[world, kc] * y + col.position[world, kc] - before) / clock.h[world]

    @wp.func
    def direction(n: vec3d) -> int:
        """Axis and sign that a vector is closest to: 2 times the axis, + 1 where positive."""
        axis = wp.int32(0)
        for j in range(1, 3):
            if wp.abs(n[j]) > wp.abs(n[axis]):
                axis = j
        return 2 * axis + wp.where(n[axis] > f64(0.0), 1, 0)

    @wp.func
    def begin_point(
        con: Contacts, col: Other, facets: Facets, his: History, clock: Clock, scr: ContactScratch,
        u_n: wp.array2d(dtype=vec3), v_n: wp.array2d(dtype=vec3), world: int, item: int, q: int,
    ):  # fmt: skip
        """Position and depth of a point at the start of an attempt, and the approach speed of the damping."""
        c = facets.contact[item]
        point = facets.first_point + item * facets.point_count + q
        rec = k.history_row(con, c, point)
        kc = col.of_contact[c]
        shift = interpolate(facets, u_n, world, q, item)
        rotation = col.previous_rotation[world, kc]
        X = k.position_at(facets, q, k.column(facets, world, item))
        y = wp.transpose(rotation) * (X + shift - col.previous_position[world, kc])
        in_contact = his.speed[world, rec] > f64(0.0)
        if wp.static(meshes):
            if not in_contact:
                state = g.sheet_side(col, kc, y, his.contact_state[world, rec])
                if wp.static(seams):
                    state = kept_sheet_side(col, c, y, his.contact_state[world, rec], state)
                his.contact_state[world, rec] = state
        side = stored_side(in_contact, his.contact_state[world, rec])
        now = k.activation_gap(con, his, world, c, point, clock.time[world], col.previous_margin[world, kc])
        n = set_start(col, scr, world, kc, point, y, side, now)
        scr.start_displacement[world, point] = shift
        speed = f64(0.0)
        if clock.is_static == 0:
            v = material_velocity(col, clock, world, kc, y) - interpolate(facets, v_n, world, q, item)
            speed = wp.dot(rotation * n, v)
            if k.is_edge(facets, item):  # a rolling point descends initially at twice its mean speed
                rolled = k.depth_at_start(con, facets, his, scr, world, c, item, point) - scr.start_depth[world, point]
                speed -= f64(2.0) * rolled / clock.h[world]
        scr.approach_speed[world, point] = k.approach_speed(his, world, rec, speed)
        face = direction(n)
        if in_contact and scr.start_depth[world, point] > col.deepest[world, kc, face]:
            wp.atomic_max(col.deepest, world, kc, face, scr.start_depth[world, point])

    @wp.func
    def side_slid_onto(
        col: Other, facets: Facets, scr: ContactScratch, world: int, kc: int, item: int, y: vec3d, d: wp.vec4d
    ) -> int:  # fmt: skip
        """Side of a solid that a point slid onto over its edge, and entered by the side face there; -1: none.

        That side is above the point by at most the depth of other points on it. BESIDE where it is higher and the
        point's facet does not face the side face: it sags below the edge.
        y, d: position in the collider's frame, m, normal and gap by the face.
        """
        solid = col.kind[kc] == BOX or col.kind[kc] == CYLINDER
        if wp.static(meshes):
            solid = solid or (col.kind[kc] == MESH and col.size[kc][2] != f64(0.0))
        n = vec3d(d[0], d[1], d[2])
        inward = k.inward_normal(facets, scr, world, item)
        if not solid or wp.length_sq(inward) == f64(0.0):
            return -1
        apart = wp.dot(n, inward) < f64(MIN_NORMAL_COSINE)
        way = k.tangential(n, inward)
        if wp.length_sq(way) < f64(0.5):
            way = k.tangential(n, vec3d(n[1], n[2], n[0]) + vec3d(f64(0.0), n[2], -n[1]))
        way = wp.normalize(way)
        for _ in range(4):  # along the facet's normal first
            side = g.side_facing(col, kc, y, way, f64(1.0))
            if side >= 0:
                found = distance(col, kc, y, side)
                level = vec3d(found[0], found[1], found[2])
                others = col.deepest[world, kc, direction(level)]
                most = f64(MAX_DEPTH_RATIO) * others
                least = f64(OPPOSING_COSINE)  # Warp sets a constant where it first stands: not behind an `and`
                if apart and wp.dot(level, inward) > least:
                    most = wp.max(most, f64(ENTRY_DEPTH) * facets.element_depth[item])
                unopposed = wp.dot(level, inward) > -f64(MIN_NORMAL_COSINE)
                if unopposed and wp.dot(level, way) > least and found[3] < f64(0.0):
                    if -found[3] <= wp.min(most, f64(EDGE_ENTRY_SLOPE) * -d[3]):
                        return side
                    # a blunt edge also meets facets between both sides
                    if others > f64(0.0) or wp.dot(n, level) < f64(MIN_NORMAL_COSINE):
                        most = wp.max(most, f64(BESIDE_DEPTH) * facets.element_depth[item])
                    if apart and -found[3] <= most:
                        return BESIDE
            way = wp.cross(n, way)
        return -1

    @wp.func
    def side_met(
        col: Other, facets: Facets, scr: ContactScratch, world: int, c: int, item: int, point: int, y: vec3d,
        d: wp.vec4d, side: int, swept: int,
    ) -> wp.vec4d:  # fmt: skip
        """Shift of a point, m, and the side that it meets there in place of `swept`; -1: that one, or BESIDE.

        y, d: as of `side_slid_onto`; side: at the start, see `stored_side`.
        """
        level = wp.int32(-1)
        if side < 0 and d[3] < f64(0.0) and swept != -2:
            level = side_slid_onto(col, facets, scr, world, col.of_contact[c], item, y, d)
        if wp.static(seams):
            start = scr.start_position[world, point]
            if level == -1:
                level = entered_level(col, world, c, point, start, y, d, side, swept)
            if level < 0:
                found = foot(col, world, c, point, start, y, d[3], side)
                if found[3] >= f64(0.0):
                    return found
        return wp.vec4d(f64(0.0), f64(0.0), f64(0.0), f64(level))

    @wp.func
    def start_motion(
        con: Contacts, col: Other, facets: Facets, his: History, clock: Clock, scr: ContactScratch,
        v_n: wp.array2d(dtype=vec3), world: int, item: int, q: int,
    ):  # fmt: skip
        """Normal, and velocity of a point relative to the collider, m/s, at the start of the attempt."""
        c = facets.contact[item]
        point = facets.first_point + item * facets.point_count + q
        kc = col.of_contact[c]
        y = scr.start_position[world, point]
        d = distance(col, kc, y, stored_side(True, his.contact_state[world, k.history_row(con, c, point)]))
        v = interpolate(facets, v_n, world, q, item) - material_velocity(col, clock, world, kc, y)
        return col.previous_rotation[world, kc] * vec3d(d[0], d[1], d[2]), v

    @wp.func
    def turn_in_step(col: Other, world: int, kc: int) -> f64:
        """Rotation of a collider in the step, rad."""
        if col.rotation_law[kc] < 0:
            return f64(0.0)
        return col.angle[world, kc] - col.previous_angle[world, kc]

    @wp.func
    def is_far(con: Contacts, col: Other, c: int, gap: f64) -> bool:
        """True if a point is outside of a mesh by a lower bound `gap` of its distance: this avoids a search."""
        kind = col.kind[col.of_contact[c]]
        return kind == MESH and con.law[c] & ANY_GAP == 0 and gap > f64(0.0)

    @wp.func
    def set_depth(
        con: Contacts, col: Other, facets: Facets, his: History, scr: ContactScratch, world: int, c: int, point: int,
        item: int, t: PointContact, activation: f64,
    ) -> PointContact:  # fmt: skip
        """The record with side, normal, depths and state from its local position and relative motion."""
        out = t
        kc = col.of_contact[c]
        rotation = col.rotation[world, kc]
        start = scr.start_position[world, point]
        before = scr.start_depth[world, point]
        in_contact = his.speed[world, k.history_row(con, c, point)] > f64(0.0)
        d = wp.vec4d(f64(0.0), f64(0.0), f64(1.0), f64(0.0))
        out.feature = -1
        far = bool(False)
        level = wp.int32(-1)
        if wp.static(meshes):
            d[3] = scr.activation_gap[world, point] - before - wp.length(t.local_position - start)
            far = not in_contact and d[3] > activation and is_far(con, col, c, d[3])
        if not far:
            side = stored_side(in_contact, his.contact_state[world, k.history_row(con, c, point)])
            out.feature = g.sweep(col, kc, start, t.local_position, side)
            d = distance(col, kc, t.local_position, out.feature)
            met = side_met(col, facets, scr, world, c, item, point, t.local_position, d, side, out.feature)
            level = wp.int32(met[3])
            if level >= 0:
                out.feature = level
                d = distance(col, kc, t.local_position + vec3d(met[0], met[1], met[2]), level)
        out.normal = rotation * vec3d(d[0], d[1], d[2])
        out.depth = activation - d[3]
        change = g.depth_change(col, kc, out.feature, start, t.local_position,
                                wp.transpose(rotation) * t.relative_motion,
                                scr.activation_gap[world, point] - before, d[3])  # fmt: skip
        if change[1] != f64(0.0):
            out.depth = before + change[0] + (activation - scr.activation_gap[world, point])
        out.previous_depth = k.depth_at_start(con, facets, his, scr, world, c, item, point)
        if level >= 0:  # the depth at the start is the distance from the side face
            out.previous_depth = out.depth + wp.dot(out.normal, t.relative_motion)
        near = out.depth > f64(0.0) or before > f64(0.0)
        out.state = wp.where(out.feature == -2, PASSED, wp.where(level == BESIDE, FREE, IN_REACH))
        if near and out.feature != -2 and wp.abs(turn_in_step(col, world, kc)) > f64(MAX_COLLIDER_ROTATION):
            out.state = TURNED
        if wp.static(seams):
            if d[3] < f64(0.0) and is_shared(col, world, c, t.local_position, vec3d(d[0], d[1], d[2]), d[3]):
                out.state = wp.where(out.state == IN_REACH, FREE, out.state)
        return out

    @wp.func
    def evaluate(
        con: Contacts, col: Other, facets: Facets, his: History, scr: ContactScratch, world: int, q: int, item: int,
        point: int, u: wp.array2d(dtype=vec3d), time: f64,
    ) -> PointContact:  # fmt: skip
        """The record of a point at displacements u (float64, see kernels/contact/double_displacements.py)."""
        out = PointContact()
        c = facets.contact[item]
        kc = col.of_contact[c]
        rec = k.history_row(con, c, point)
        moved = k.interpolate_acting(facets, scr, u, world, q, item)
        out.position = k.reference_position(facets, scr, world, q, item) + moved
        rotation = col.rotation[world, kc]
        out.local_position = wp.transpose(rotation) * (out.position - col.position[world, kc])
        motion = moved - scr.start_displacement[world, point] - col.translation[world, kc]
        if col.rotation_law[kc] >= 0:
            motion -= col.rotation_change[world, kc] * (
                col.previous_rotation[world, kc] * scr.start_position[world, point]
            )
        out.relative_motion = motion
        activation = k.activation_gap(con, his, world, c, point, time, col.margin[world, kc])
        out = set_depth(con, col, facets, his, scr, world, c, point, item, out, activation)
        out.stiffness_ratio = k.stiffness_ratio(con, facets, world, c, item, f64(0.0))
        if his.speed[world, rec] > f64(0.0):
            out.spring = k.turned_spring(con, his, world, c, rec, rotation)
        return out

    @wp.func
    def frozen_motion(
        col: Other, facets: Facets, scr: ContactScratch, u: wp.array2d(dtype=vec3d), world: int, q: int, item: int,
        point: int, t: PointContact, limit: f64, fresh: int,
    ) -> PointContact:  # fmt: skip
        """The record itself: motion relative to a rigid shape is linear in the displacements."""
        return t

    @wp.func
    def transmit(
        con: Contacts, col: Other, scr: ContactScratch, world: int, c: int, point: int, t: PointContact, friction: vec3d
    ):  # fmt: skip
        """No-op: a collider has no slots."""
        return

    @wp.func
    def other_product(
        col: Other, scr: ContactScratch, p: wp.array2d(dtype=vec3), world: int, point: int, d: vec3
    ) -> vec3:  # fmt: skip
        """Stiffness of a point times its displacement d, N."""
        return k.multiply_symmetric(scr.stiffness[world, point], d)

    @wp.func
    def gather_other_product(
        col: Other, scr: ContactScratch, world: int, entry: int, lane: int, lanes: int
    ) -> vec3:  # fmt: skip
        """Zero: a collider has no slots."""
        return vec3()

    @wp.func
    def other_entries(col: Other) -> int:
        """First pool entry of the other side: none."""
        return 0

    @wp.func
    def report_sign(col: Other, c: int) -> f64:
        """1: reports state the force on the body."""
        return f64(1.0)

    @wp.func
    def carried(con: Contacts, col: Other, world: int, c: int, t: PointContact) -> vec3d:
        """Motion of the collider's material at a point, m, by its last velocity."""
        kc = col.of_contact[c]
        if col.rotation_law[kc] < 0:
            return col.translation[world, kc]
        return turn_in_step(col, world, kc) * wp.cross(col.rotation_axis[kc], t.position - col.rotation_anchor[kc])

    @wp.func
    def slip_frame(col: Other, world: int, c: int, point: int, t: PointContact) -> wp.mat33d:
        """Axes of the collider as columns."""
        return col.rotation[world, col.of_contact[c]]

    @wp.func
    def touched_state(col: Other, world: int, c: int, point: int, t: PointContact) -> int:
        """Side of the collider that a point is in contact with, + 1."""
        return g.updated_side(col, col.of_contact[c], t.local_position, t.feature) + 1

    @wp.func
    def released_state(col: Other, his: History, world: int, c: int, point: int, rec: int) -> int:
        """Contact state of a point that is not in contact: its side of a sheet."""
        in_contact = his.speed[world, rec] > f64(0.0)
        return g.released_contact_state(col, col.of_contact[c], in_contact, his.contact_state[world, rec])

    @wp.func
    def store_side(col: Other, world: int, kc: int):
        """Store the pose of a collider after an accepted step."""
        col.previous_position[world, kc] = col.position[world, kc]
        col.previous_rotation[world, kc] = col.rotation[world, kc]
        col.previous_angle[world, kc] = col.angle[world, kc]
        col.previous_margin[world, kc] = col.margin[world, kc]

    return kernel_set(locals())


for name, flags in {"": (False, False), MESH_SUFFIX: (True, False), SEAMS_SUFFIX: (False, True),
                    MESH_SUFFIX + SEAMS_SUFFIX: (True, True)}.items():  # fmt: skip
    GEOMETRIES[f"colliders{name}"] = functools.partial(collider_kinematics, meshes=flags[0], seams=flags[1])


@functools.cache
def pose_kernels(meshes: bool) -> KernelSet:
    """Kernel of the poses of colliders."""
    Colliders = collider_struct(meshes)
    module = kernel_module(f"collider_poses{MESH_SUFFIX * meshes}", light=True)

    @masked_kernel(module, "active")
    def update_poses(
        col: Colliders, value: wp.array2d(dtype=vec3d), active: wp.array(dtype=wp.int32)
    ):  # fmt: skip
        """Poses of the colliders at the end of the attempt, and their motion in it."""
        world, k = wp.tid()
        position = col.center[k]
        rotation = col.axes[k]
        if col.rotation_law[k] >= 0:
            angle = value[world, col.rotation_law[k]][0]
            n = col.rotation_axis[k]
            N = wp.skew(n)
            half = wp.sin(f64(0.5) * angle)
            R = wp.identity(n=3, dtype=f64) + wp.sin(angle) * N + (f64(2.0) * half * half) * (N * N)
            position = col.rotation_anchor[k] + R * (position - col.rotation_anchor[k])
            rotation = R * rotation
        if col.translation_law[k] >= 0:
            position += value[world, col.translation_law[k]]
        for face in range(6):
            col.deepest[world, k, face] = f64(0.0)
        col.position[world, k] = position
        col.rotation[world, k] = rotation
        col.translation[world, k] = position - col.previous_position[world, k]
        if col.rotation_law[k] >= 0:
            col.angle[world, k] = value[world, col.rotation_law[k]][0]
            col.rotation_change[world, k] = rotation * wp.transpose(col.previous_rotation[world, k]) - wp.identity(
                n=3, dtype=f64
            )

    return kernel_set(locals())
