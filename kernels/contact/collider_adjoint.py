"""Adjoint of the geometry of colliders: a point's depth, normal and motion by its displacement and by the poses.

With a point's place x, the pose's motion eta(x) = shift + turn a x (x - anchor), and B the derivative of the normal:
d(normal) = turn a x n + B (dx - eta(x)), d(depth) = d(gap) - n.(dx - eta(x)), and the relative motion x - z, where z is
the end of the collider's material that was at the point at the start.
"""

import functools

import warp as wp

from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import f64, int_1d, mat33d, precision, vec3d, vec3d_2d
from .adjoint import contact_adjoint_functions, contact_adjoint_struct, force_bars_struct
from .collider_kinematics import collider_kinematics
from .collider_mesh import FLAT
from .collider_seams import SEAMS_SUFFIX
from .collider_shapes import BOX, CAPSULE, CYLINDER, HALF_SPACE, LATERAL_SIDE, MESH, SPHERE
from .colliders import MESH_SUFFIX, collider_functions
from .kinematics import kinematics_functions
from .law import ANY_GAP, FIXED_SPRING, MIN_APPROACH_SPEED, OwnLaws, law_names
from .structs import IN_REACH, collider_struct, contact_structs

__all__ = ["collider_adjoint_kernels"]


@functools.cache
def normal_derivatives(meshes: bool) -> KernelSet:
    """Device function `normal_derivative`."""
    Colliders = collider_struct(meshes)
    g = collider_functions(meshes)
    mesh = g.mesh if meshes else None
    nearest_on_mesh = getattr(mesh, "nearest_on_mesh", None)

    @wp.func
    def round_derivative(n: vec3d, plane: mat33d, radius: f64) -> mat33d:
        """Derivative of the unit vector n of an arm in a plane or in space, by the arm's end."""
        return (plane - wp.outer(n, n)) / radius

    @wp.func
    def shape_normal_derivative(kind: int, size: vec3d, y: vec3d, side: int, n: vec3d, gap: f64) -> mat33d:
        """`normal_derivative` of an analytic shape."""
        eye = wp.identity(n=3, dtype=f64)
        rho = wp.sqrt(y[0] * y[0] + y[1] * y[1])
        flat = wp.diag(vec3d(f64(1.0), f64(1.0), f64(0.0)))
        if kind == SPHERE:
            return round_derivative(n, eye, gap + size[0])
        if kind == CAPSULE:
            return round_derivative(n, wp.where(wp.abs(y[2]) <= size[1], flat, eye), gap + size[0])
        if kind == BOX and gap > f64(0.0):  # beside an edge or a corner
            plane = mat33d()
            for j in range(3):
                if n[j] != f64(0.0):
                    plane[j, j] = f64(1.0)
            return round_derivative(n, plane, gap)
        if kind == CYLINDER:
            radial = vec3d(y[0], y[1], f64(0.0)) / wp.max(rho, f64(1.0e-300))
            across = vec3d(-radial[1], radial[0], f64(0.0))
            part = wp.dot(n, radial)
            out = (part / wp.max(rho, f64(1.0e-300))) * wp.outer(across, across)
            if gap > f64(0.0) and part > f64(0.0) and n[2] != f64(0.0):  # beside the rim
                out += round_derivative(n, wp.outer(radial, radial) + wp.outer(vec3d(f64(0.0), f64(0.0), f64(1.0)),
                                        vec3d(f64(0.0), f64(0.0), f64(1.0))), gap)  # fmt: skip
            if gap <= f64(0.0) and side >= 0 and side != LATERAL_SIDE:
                return mat33d()
            return out
        return mat33d()

    @wp.func
    def normal_derivative(col: Colliders, k: int, y: vec3d, side: int) -> mat33d:
        """Derivative of the normal of `distance` by the position, in the collider's frame, 1/m."""
        if col.kind[k] == HALF_SPACE:
            return mat33d()
        d = g.distance(col, k, y, side)
        n = vec3d(d[0], d[1], d[2])
        if wp.static(meshes):
            if col.kind[k] == MESH:
                s = nearest_on_mesh(col, k, y, -1)
                if side >= 0 and d[3] < f64(0.0):
                    s = nearest_on_mesh(col, k, y, side)
                face = wp.length(wp.cross(n, col.mesh.normal[0, s.triangle])) < f64(1.0e-12)
                if s.feature == 0 or face or col.mesh.feature_kind[s.feature, s.triangle] == FLAT:
                    return mat33d()
                plane = wp.identity(n=3, dtype=f64)
                if s.feature <= 3:
                    a = col.mesh.corner[s.feature - 1, s.triangle]
                    e = wp.normalize(col.mesh.corner[s.feature % 3, s.triangle] - a)
                    plane -= wp.outer(e, e)
                return round_derivative(n, plane, d[3])
        return shape_normal_derivative(col.kind[k], col.size[k], y, side, n, d[3])

    return kernel_set(locals())


@functools.cache
def collider_adjoint_kernels(dtype: str, meshes: bool, seams: bool, own: OwnLaws = ()) -> KernelSet:
    """Kernels; arguments as of `contact_kernels`, `law`: the contacts' constants with the points as contacts."""
    p = precision(dtype)
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    Colliders, ContactAdjoint, ForceBars = collider_struct(meshes), contact_adjoint_struct(), force_bars_struct()
    g, k = collider_kinematics(dtype, meshes, seams), kinematics_functions(dtype)
    a = contact_adjoint_functions(dtype, own)
    PointBars, law_bars, is_slipping, count_switch = a.PointBars, a.law_bars, a.is_slipping, a.count_switch
    normal_derivative = normal_derivatives(meshes).normal_derivative
    stored_side = collider_functions(meshes).stored_side
    name = "_".join(["collider_adjoint", dtype, *law_names(own)])
    module = kernel_module(f"{name}{MESH_SUFFIX * meshes}{SEAMS_SUFFIX * seams}", max_unroll=SHORT_UNROLL, block_dim=64)

    @wp.func
    def world_axes(col: Colliders, con: Contacts, c: int, rotation: mat33d) -> mat33d:
        """Axes that the elastic slip is stored in."""
        if con.law[c] & FIXED_SPRING != 0:
            return wp.identity(n=3, dtype=f64)
        return rotation

    @wp.func
    def with_side_face(t: PointContact, bars: PointBars, start_depth: f64) -> PointBars:
        """The bars where the depth at the start was that at the end, less the motion: of a point on a side face."""
        out = bars
        if t.previous_depth != start_depth:
            out.depth += bars.previous_depth
            out.normal += bars.previous_depth * t.relative_motion
            out.motion += bars.previous_depth * t.normal
            out.previous_depth = f64(0.0)
        return out

    @wp.func
    def touches(con: Contacts, c: int, t: PointContact) -> bool:
        """True for a point that may have a force."""
        return t.state == IN_REACH and (t.depth > f64(0.0) or con.law[c] & ANY_GAP != 0)

    @masked_kernel(module, "active")
    def linearise_points(
        con: Contacts, law: Contacts, col: Colliders, facets: Facets, his: History, clock: Clock, u: vec3d_2d,
        active: int_1d, scr: ContactScratch, adj: ContactAdjoint,
    ):  # fmt: skip
        """Jacobians of the points at the end of a step, and the bars of its displacements through the histories."""
        world, item, q = wp.tid()
        c = facets.contact[item]
        point = facets.first_point + item * facets.point_count + q
        jacobian = mat33d()
        area = facets.area_fraction[q, item]
        end = vec3d()
        if area > f64(0.0):
            t = g.evaluate(con, col, facets, his, scr, world, q, item, point, u, clock.new_time[world])
            if touches(con, c, t):
                rotation = col.rotation[world, col.of_contact[c]]
                B = normal_derivative(col, col.of_contact[c], t.local_position, t.feature)
                B = rotation * B * wp.transpose(rotation)
                start_depth = k.depth_at_start(con, facets, his, scr, world, c, item, point)
                for row in range(4):
                    direction = ForceBars()
                    if row < 3:
                        unit = vec3d()
                        unit[row] = area
                        direction.normal_force = unit
                        direction.friction = unit
                    elif t.depth > f64(0.0):
                        direction.slip = world_axes(col, con, c, rotation) * adj.spring_bar[world, point]
                        direction.speed = adj.speed_bar[world, point]
                    bars = law_bars(law, facets, his, scr, adj, world, point, item, f64(0.0), t,
                                    k.inverse_step(clock, world), direction)  # fmt: skip
                    bars = with_side_face(t, bars, start_depth)
                    end = B * bars.normal - bars.depth * t.normal + bars.motion
                    if row < 3:
                        for j in range(3):
                            jacobian[row, j] = end[j]
        adj.jacobian[world, point] = jacobian
        adj.end_bar[world, point] = end

    @wp.struct
    class StartBars:
        """Bars of a point at the start of a step."""

        position: vec3d
        velocity: vec3d
        spring: vec3d
        speed: f64
        gap: f64
        shift: vec3d  # of the collider at the end
        turn: f64
        start_shift: vec3d  # of the collider at the start
        start_turn: f64

    @wp.func
    def store(adj: ContactAdjoint, world: int, point: int, bars: StartBars):
        """Store the bars of a point; those of a pose at the end have a part of the step after it."""
        adj.spring_bar[world, point] = bars.spring
        adj.speed_bar[world, point] = bars.speed
        adj.start_bar[world, point] = bars.position
        adj.velocity_bar[world, point] = bars.velocity
        adj.gap_bar[world, point] = bars.gap
        adj.shift_bar[world, point] = bars.shift + adj.start_shift_bar[world, point]
        adj.turn_bar[world, point] = bars.turn + adj.start_turn_bar[world, point]
        adj.start_shift_bar[world, point] = bars.start_shift
        adj.start_turn_bar[world, point] = bars.start_turn

    @masked_kernel(module, "active")
    def step_back_points(
        con: Contacts, law: Contacts, col: Colliders, facets: Facets, his: History, clock: Clock, u: vec3d_2d,
        v_n: p.vec3_2d, w: p.vec3_2d, active: int_1d, scr: ContactScratch, adj: ContactAdjoint,
    ):  # fmt: skip
        """Bars at the start of a step, of displacements, velocities, histories and poses, and of constants."""
        world, item, q = wp.tid()
        c = facets.contact[item]
        kc = col.of_contact[c]
        point = facets.first_point + item * facets.point_count + q
        area = facets.area_fraction[q, item]
        before = scr.start_depth[world, point]
        out = StartBars()
        was_touching = his.speed[world, point] > f64(0.0)
        touching = bool(False)
        slipping = bool(False)
        if area > f64(0.0):
            t = g.evaluate(con, col, facets, his, scr, world, q, item, point, u, clock.new_time[world])
            touching = t.state == IN_REACH and t.depth > f64(0.0)
            if touches(con, c, t):
                inv_h = k.inverse_step(clock, world)
                end_axes = col.rotation[world, kc]
                axes = world_axes(col, con, c, end_axes)
                start_axes = col.previous_rotation[world, kc]
                Q = end_axes * wp.transpose(start_axes)
                B = end_axes * normal_derivative(col, kc, t.local_position, t.feature) * wp.transpose(end_axes)
                direction = ForceBars()
                direction.normal_force = -area * k.interpolate(facets, w, world, q, item)
                direction.friction = direction.normal_force
                if touching:
                    direction.slip = axes * adj.spring_bar[world, point]
                    direction.speed = adj.speed_bar[world, point]
                bars = law_bars(law, facets, his, scr, adj, world, point, item, f64(0.0), t, inv_h, direction)
                bars = with_side_face(t, bars, before)
                # at the start
                y = scr.start_position[world, point]
                x_n = start_axes * y + col.previous_position[world, kc]
                side = stored_side(was_touching, his.contact_state[world, point])
                d = g.distance(col, kc, y, side)
                n = start_axes * vec3d(d[0], d[1], d[2])
                v = vec3d()
                if clock.is_static == 0:
                    v = g.material_velocity(col, clock, world, kc, y) - k.interpolate(facets, v_n, world, q, item)
                lowest = wp.max(his.speed[world, point], f64(MIN_APPROACH_SPEED))
                fast = f64(0.0)
                if wp.dot(n, v) > lowest:
                    fast = bars.approach_speed
                elif lowest > f64(MIN_APPROACH_SPEED):
                    out.speed = bars.approach_speed
                C = start_axes * normal_derivative(col, kc, y, side) * wp.transpose(start_axes)
                out.velocity = -fast * n
                at_end = B * bars.normal - bars.depth * t.normal
                moved = (fast * inv_h) * n - bars.motion  # on the end of the collider's material
                start = wp.transpose(Q) * moved - bars.previous_depth * n + fast * (C * v)
                axis = col.rotation_axis[kc]
                anchor = col.rotation_anchor[kc]
                material_point = t.position - t.relative_motion
                out.shift = moved - at_end
                out.turn = wp.dot(axis, wp.cross(t.normal, bars.normal) - wp.cross(t.position - anchor, at_end)
                                  + wp.cross(material_point - anchor, moved))  # fmt: skip
                if con.law[c] & FIXED_SPRING == 0:
                    out.turn += wp.dot(axis, wp.cross(t.spring, bars.spring) - wp.cross(bars.slip, direction.slip))
                out.start_shift = -start
                out.start_turn = wp.dot(axis, fast * wp.cross(n, v) - wp.cross(x_n - anchor, start))
                out.position = start - (fast * inv_h) * n
                out.gap = bars.depth + bars.previous_depth
                if was_touching:
                    out.spring = wp.transpose(axes) * bars.spring
                slipping = is_slipping(law, facets, his, scr, world, point, item, f64(0.0), t, inv_h)
        store(adj, world, point, out)
        count_switch(his, adj, world, point, touching, slipping)

    return kernel_set(locals())
