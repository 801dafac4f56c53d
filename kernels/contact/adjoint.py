"""Adjoint of contact: derivatives of the force of a point, and of the history after it, at the converged end of a step.

The laws of a point are differentiated by Warp, as one scalar, the work of the point's force on given directions; the
geometry of the other side by hand (collider_adjoint.py). Friction limits are those of the end, as converged. All
arrays are [world, point]: each thread adds to its own entry, so that sums have one order.
"""

import functools

import warp as wp

from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import topology_struct
from ..common.types import double_2d, f64, int_1d, precision, vec3d, vec3d_2d
from .friction import friction_functions
from .kinematics import kinematics_functions
from .law import OwnLaws, law_names
from .structs import SLIP_FLAG, WITH_STIFFNESS, contact_structs

__all__ = [
    "contact_adjoint_functions",
    "contact_adjoint_kernels",
    "contact_adjoint_struct",
    "force_bars_struct",
    "point_bars_struct",
]


@functools.cache
def contact_adjoint_struct():
    """Adjoint quantities of the points; a bar is the derivative of the loss by a quantity."""

    @wp.struct
    class ContactAdjoint:
        jacobian: wp.array2d(dtype=wp.mat33d)  # derivative of a point's force by its displacement at the end, N/m
        spring_bar: wp.array2d(dtype=wp.vec3d)  # of `History.spring`; after the step back, at its start
        speed_bar: wp.array2d(dtype=wp.float64)  # of `History.speed`
        end_bar: wp.array2d(dtype=wp.vec3d)  # of the displacement at the end, through the histories
        start_bar: wp.array2d(dtype=wp.vec3d)  # of the displacement at the start
        velocity_bar: wp.array2d(dtype=wp.vec3d)  # of the velocity at the start
        gap_bar: wp.array2d(dtype=wp.float64)  # of the gap at which contact begins, at the end and at the start
        shift_bar: wp.array2d(dtype=wp.vec3d)  # of a translation of the collider at the end, and at the next start
        turn_bar: wp.array2d(dtype=wp.float64)  # of its rotation about its axis
        start_shift_bar: wp.array2d(dtype=wp.vec3d)  # of its translation at the start
        start_turn_bar: wp.array2d(dtype=wp.float64)
        approach_bar: wp.array2d(dtype=wp.float64)  # of `ContactScratch.approach_speed`: its gradient array
        switches: wp.array(dtype=wp.int32)  # [world] points that came into contact or left it, began to slip or stuck

    return ContactAdjoint


@functools.cache
def point_bars_struct():
    """Bars of the record of a point."""

    @wp.struct
    class PointBars:
        """Bars of the record of a point, and its forces on the residual and slip after the step, without its area."""

        normal: vec3d
        depth: f64
        previous_depth: f64
        motion: vec3d
        spring: vec3d
        approach_speed: f64
        normal_force: vec3d
        friction: vec3d
        slip: vec3d

    return PointBars


@functools.cache
def force_bars_struct():
    """Bars of what the laws of a point give."""

    @wp.struct
    class ForceBars:
        """Directions on which forces on the residual work, and bars of the history after the step."""

        normal_force: vec3d
        friction: vec3d
        slip: vec3d
        speed: f64

    return ForceBars


@functools.cache
def contact_adjoint_functions(dtype: str, own: OwnLaws = ()) -> KernelSet:
    """Device functions of the laws: `law_bars`, `is_slipping` and `count_switch`."""
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    law, k = friction_functions(dtype, own), kinematics_functions(dtype)
    ContactAdjoint, PointBars, ForceBars = contact_adjoint_struct(), point_bars_struct(), force_bars_struct()

    @wp.func
    def law_work(
        con: Contacts, facets: Facets, his: History, scr: ContactScratch, world: int, point: int, item: int,
        other_depth: f64, record: PointContact, inv_h: f64, direction: ForceBars,
    ) -> f64:  # fmt: skip
        """Sum of what the laws give times its bars `direction`. `con`: with the point as the contact."""
        t = record
        t.stiffness_ratio = k.stiffness_ratio(con, facets, world, point, item, other_depth)
        t = law.with_normal_force(con, scr, world, point, point, t, inv_h)
        limits = law.friction_parameters(con, his, world, point, point, t)
        t = law.in_friction_plane(t, t.normal, limits[2])
        out = wp.dot(direction.friction, law.friction_force(con, world, point, t, limits, inv_h))
        out -= t.normal_values[0] * wp.dot(direction.normal_force, t.normal)
        if t.normal_values[0] > f64(0.0) and limits[1] > f64(0.0):
            out += wp.dot(direction.slip, law.return_mapping(con, world, point, t, limits, inv_h))
        return out + direction.speed * wp.max(scr.approach_speed[world, point], inv_h * (t.depth - t.previous_depth))

    @wp.func
    def is_slipping(
        con: Contacts, facets: Facets, his: History, scr: ContactScratch, world: int, point: int, item: int,
        other_depth: f64, record: PointContact, inv_h: f64,
    ) -> bool:  # fmt: skip
        """True if the friction of a point is at its limit; arguments as of `law_work`."""
        t = record
        t.stiffness_ratio = k.stiffness_ratio(con, facets, world, point, item, other_depth)
        t = law.with_normal_force(con, scr, world, point, point, t, inv_h)
        limits = law.friction_parameters(con, his, world, point, point, t)
        t = law.in_friction_plane(t, t.normal, limits[2])
        return limits[0] > f64(0.0) and law.is_slipping(con, world, point, t, limits, inv_h)

    @wp.func
    def law_bars(
        con: Contacts, facets: Facets, his: History, scr: ContactScratch, adj: ContactAdjoint, world: int, point: int,
        item: int, other_depth: f64, record: PointContact, inv_h: f64, direction: ForceBars,
    ) -> PointBars:  # fmt: skip
        """Gradient of `law_work`; that by the constants is added to the gradient arrays of `con`."""
        adj.approach_bar[world, point] = f64(0.0)
        _con, _facets, _his, _scr, _w, _p, _i, _d, bar, _h, force = wp.grad(law_work)(
            con, facets, his, scr, world, point, item, other_depth, record, inv_h, direction
        )
        out = PointBars()
        out.normal = bar.normal
        out.depth = bar.depth
        out.previous_depth = bar.previous_depth
        out.motion = bar.relative_motion
        out.spring = bar.spring
        out.approach_speed = adj.approach_bar[world, point]
        out.normal_force = force.normal_force
        out.friction = force.friction
        out.slip = force.slip
        return out

    @wp.func
    def count_switch(his: History, adj: ContactAdjoint, world: int, point: int, touching: bool, slipping: bool):
        """Count a point that came into contact in the step, or left it, began to slip or stuck."""
        was_touching = his.speed[world, point] > f64(0.0)
        was_slipping = was_touching and his.contact_state[world, point] >= SLIP_FLAG
        if touching != was_touching or (touching and slipping != was_slipping):
            wp.atomic_add(adj.switches, world, 1)

    return kernel_set(locals())


@functools.cache
def contact_adjoint_kernels(dtype: str, own: OwnLaws = ()) -> KernelSet:
    """Kernels of any geometry: products of the points' Jacobians, sums over points."""
    p = precision(dtype)
    vec3 = p.vec3
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    ContactAdjoint, Topology = contact_adjoint_struct(), topology_struct(dtype)
    k = kinematics_functions(dtype)
    module = kernel_module("_".join(["contact_adjoint", dtype, *law_names(own)]), max_unroll=SHORT_UNROLL)

    @masked_kernel(module, "active")
    def exact_products(
        facets: Facets, active: int_1d, direction: p.vec3_2d, transposed: int, adj: ContactAdjoint, scr: ContactScratch
    ):
        """Jacobian of each point, or its transpose, times its part of a direction."""
        world, item, q = wp.tid()
        point = facets.first_point + item * facets.point_count + q
        if scr.facet_activity[world, facets.first_row + item] != WITH_STIFFNESS:
            return
        K = adj.jacobian[world, point]
        if transposed != 0:
            K = wp.transpose(K)
        scr.point_product[world, point] = vec3(K * k.interpolate(facets, direction, world, q, item))

    @masked_kernel(module, "active")
    def spread_points(facets: Facets, values: vec3d_2d, active: int_1d, pool: p.vec3_2d):
        """Values of points on the slots of their facets."""
        world, i, item = wp.tid()
        out = vec3d()
        for q in range(facets.point_count):
            value = values[world, facets.first_point + item * facets.point_count + q]
            out += f64(k.shape_at(facets, q, i, item)) * value
        pool[world, facets.first_entry + i * facets.facet_count + item] = vec3(out)

    @masked_kernel(module, "active")
    def add_pool(topo: Topology, pool: p.vec3_2d, active: int_1d, out: p.vec3_2d):
        """out += the entries of each slot."""
        world, slot = wp.tid()
        total = vec3()
        for j in range(topo.pool_start[slot], topo.pool_start[slot + 1]):
            total += pool[world, topo.pool_entry[j]]
        out[world, slot] = out[world, slot] + total

    @masked_kernel(module, "active")
    def sum_scalars(first: int_1d, factor: double_2d, values: double_2d, active: int_1d, sums: double_2d):
        """Sum over contacts of factor times the values of their points."""
        world = wp.tid()
        total = f64(0.0)
        for c in range(factor.shape[1]):
            f = factor[world % factor.shape[0], c]
            if f != f64(0.0):
                part = f64(0.0)
                for point in range(first[c], first[c + 1]):
                    part += values[world, point]
                total += f * part
        sums[0, world] = total

    @masked_kernel(module, "active")
    def sum_vectors(first: int_1d, factor: vec3d_2d, values: vec3d_2d, active: int_1d, along: int, sums: double_2d):
        """Sum over contacts of factor times the values of their points, by component, or their scalar product."""
        world = wp.tid()
        total = vec3d()
        for c in range(factor.shape[1]):
            f = factor[world % factor.shape[0], c]
            if wp.length_sq(f) > f64(0.0):
                for point in range(first[c], first[c + 1]):
                    total += wp.cw_mul(f, values[world, point])
        if along != 0:
            total[0] = total[0] + total[1] + total[2]
        for j in range(3):
            sums[j, world] = total[j]

    return kernel_set(locals())
