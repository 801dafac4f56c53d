"""Contact of surface points with their other side: forces, tangent, friction limits, products; for any geometry.

A point's force is the derivative of a scalar: `normal_law` of its depth, and friction of its anchored slip with a
frozen limit mu F_n (friction.py says when limits are updated). Gap and law are evaluated in float64.
"""

import functools

import warp as wp

from ..common.block_entries import add_symmetric_function
from ..common.lanes import lane_functions
from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import pattern_struct, topology_struct
from ..common.types import f64, precision, vec3d
from .facet_structs import point_list_struct
from .friction import EXACT_TOLERANCE, TOUCHING_PART_UPDATES, friction_functions
from .kinematics import GEOMETRIES, kinematics_functions
from .law import ANY_GAP, OwnLaws, law_names
from .structs import FORCE_ONLY, FREE, INACTIVE, PASSED, TURNED, WITH_STIFFNESS, contact_structs

__all__ = ["AITKEN_LANES", "block_kernels", "contact_kernels", "contact_module"]

AITKEN_LANES = 128
SLOW_REDUCTION = 0.35
"""Ratio of successive changes of the friction limits above which they are relaxed."""


def contact_module(dtype: str, geometry: str, own: OwnLaws) -> wp.Module:
    """Module of assembly and ledger."""
    # kernels with many registers: blocks of 64 of 4096 pressed fingers take 9 ms, of 256 threads 17
    name = "_".join(["contact", dtype, geometry, *law_names(own)])
    return kernel_module(name, max_unroll=SHORT_UNROLL, block_dim=64)


@functools.cache
def contact_kernels(dtype: str, geometry: str, own: OwnLaws = ()) -> KernelSet:
    """Kernels of contact in one precision of the displacements.

    Args:
        geometry: of the other side, see `GEOMETRIES`.
        own: laws of one's own in use.
    """
    p = precision(dtype)
    vec3, sym = p.vec3, p.sym
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    k, law, g = kinematics_functions(dtype), friction_functions(dtype, own), GEOMETRIES[geometry](dtype)
    Other, lane_sum, acting_shape_value = g.Other, lane_functions(dtype).lane_sum, k.acting_shape_value
    module = contact_module(dtype, geometry, own)

    @masked_kernel(module, "active")
    def begin_points(
        con: Contacts, other: Other, facets: Facets, his: History, clock: Clock, u_n: wp.array2d(dtype=vec3),
        v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), scr: ContactScratch,
    ):  # fmt: skip
        """Points at the start of an attempt: position, depth, approach speed of the damping."""
        world, item, q = wp.tid()
        if q == 0 and item == 0 and facets.first_row == 0:
            scr.passed_point[world] = 0
            scr.limit_updates[world] = 0
            scr.most_part_change[world] = f64(1.0)
            if clock.substep_index[world] == 0:
                scr.elapsed_time[world] = f64(0.0)
        if facets.area[q, item] > f64(0.0):
            g.begin_point(con, other, facets, his, clock, scr, u_n, v_n, world, item, q)

    @wp.kernel(module=module)
    def explicit_forces(
        con: Contacts, other: Other, facets: Facets, his: History, clock: Clock, v_n: wp.array2d(dtype=vec3),
        active: wp.array(dtype=wp.int32), scr: ContactScratch,
    ):  # fmt: skip
        """Forces of explicit contacts at the state that the attempt begins from."""
        world, item, q = wp.tid()
        c = facets.contact[item]
        if active[world] == 0 or facets.area_fraction[q, item] == f64(0.0) or con.is_explicit[c] == 0:
            return
        point = facets.first_point + item * facets.point_count + q
        scr.explicit_force[world, point] = vec3d()
        scr.explicit_elastic_slip[world, point] = vec3d()
        delta = scr.start_depth[world, point]
        if delta > f64(0.0):
            n, v = g.start_motion(con, other, facets, his, clock, scr, v_n, world, item, q)
            law.set_explicit_force(con, his, scr, world, c, point, delta, n, v, clock.h[world])

    @masked_kernel(module, "active")
    def forces(
        con: Contacts, other: Other, facets: Facets, his: History, clock: Clock, u: wp.array2d(dtype=vec3d),
        active: wp.array(dtype=wp.int32), fresh: int, scr: ContactScratch,
    ):  # fmt: skip
        """Forces of points, N, their stiffness and potential.

        `fresh`: an attempt begins: the first friction limits. Otherwise they are the frozen ones.
        """
        world, item, q = wp.tid()
        c = facets.contact[item]
        point = facets.first_point + item * facets.point_count + q
        area_fraction = facets.area_fraction[q, item] * k.is_acting(con, scr, world, c, point)
        scr.activity[world, point] = INACTIVE
        if area_fraction == f64(0.0):
            return
        rec = k.history_row(con, c, point)
        t = g.evaluate(con, other, facets, his, scr, world, q, item, point, u, clock.new_time[world])
        friction = vec3d()
        if t.state == PASSED or t.state == TURNED:  # an infinite potential: the iterate is refused
            scr.passed_point[world] = wp.where(t.state == PASSED, point + 1, -point - 1)
            scr.activity[world, point] = FORCE_ONLY
            scr.force[world, point] = vec3d()
            scr.energy[world, point] = wp.vec2d(f64(wp.inf), f64(0.0))
        elif con.is_explicit[c] != 0:
            force = -area_fraction * scr.explicit_force[world, point]
            if wp.length_sq(force) > f64(0.0):
                work = wp.dot(force, t.relative_motion)
                scr.activity[world, point] = FORCE_ONLY
                scr.force[world, point] = force
                scr.energy[world, point] = wp.vec2d(work, wp.abs(work))
        elif t.state == FREE:
            scr.updated_friction[world, rec] = vec3d()
            if fresh != 0:
                scr.frozen_friction[world, rec] = vec3d(f64(0.0), f64(0.0), f64(1.0))
                scr.frozen_normal[world, rec] = vec3d()
                scr.predicted_friction[world, point] = vec3d()
        else:
            inv_h = k.inverse_step(clock, world)
            ratio = t.stiffness_ratio
            t.stiffness_ratio = ratio * scr.penalty_factor[world]
            t = law.with_normal_force(con, scr, world, c, point, t, inv_h)
            t.stiffness_ratio = ratio
            frozen = law.friction_limits_at_iterate(con, his, scr, world, c, point, t, fresh)
            t = g.frozen_motion(other, facets, scr, u, world, q, item, point, t, frozen[0], fresh)
            t = law.in_friction_plane(t, scr.frozen_normal[world, rec], frozen[2])
            if t.depth > f64(0.0) or frozen[0] > f64(0.0) or law.has_trait(con, c, ANY_GAP):
                scr.activity[world, point] = WITH_STIFFNESS
                friction = law.set_point_force(con, scr, world, c, point, t, frozen, inv_h, area_fraction)
        g.transmit(con, other, scr, world, c, point, t, friction)

    @masked_kernel(module, "active")
    def gather_point_forces(
        facets: Facets, active: wp.array(dtype=wp.int32), lanes: int, scr: ContactScratch, pool: wp.array2d(dtype=vec3),
        rows: wp.array3d(dtype=f64), touching: wp.array(dtype=wp.int32),
    ):  # fmt: skip
        """Forces of facets on their slots and, once per facet, rows of the potential."""
        world, index = wp.tid()
        entry = wp.min(index / lanes, facets.facet_count * facets.conn.shape[0] - 1)
        item = entry % facets.facet_count
        i = entry / facets.facet_count
        lane = index % lanes
        first = facets.first_point + item * facets.point_count
        touched = wp.int32(INACTIVE)
        for q in range(facets.point_count):
            touched = wp.max(touched, scr.activity[world, first + q])
        f = vec3()
        if touched != INACTIVE:
            at = k.column(facets, world, item)
            for q in range(lane, facets.point_count, lanes):
                if scr.activity[world, first + q] != INACTIVE:
                    f += acting_shape_value(facets, scr, world, q, i, item, at) * vec3(scr.force[world, first + q])
        f = lane_sum(f, lanes)
        if lane > 0:
            return
        pool[world, facets.first_entry + entry] = f
        if i > 0:
            return
        row = facets.first_row + item
        before = scr.facet_activity[world, row]
        scr.facet_activity[world, row] = touched
        if wp.max(before, touched) == INACTIVE:
            return  # the rows are already zero
        energy = wp.vec2d()
        for q in range(facets.point_count):
            state = scr.activity[world, first + q]
            if state != INACTIVE:
                energy += scr.energy[world, first + q]
            if state != WITH_STIFFNESS:
                scr.stiffness[world, first + q] = sym()
        if touched != INACTIVE:
            wp.atomic_max(touching, world, 1)
        rows[0, world, row] = energy[0]
        rows[1, world, row] = energy[0]
        rows[2, world, row] = energy[1]

    @masked_kernel(module, "flags")
    def aitken_partial_sums(flags: wp.array(dtype=wp.int32), scr: ContactScratch):
        """Partial sums, by lanes, of r = limit of the iterate - frozen limit, and of its change, for relaxation."""
        world, lane = wp.tid()
        out = wp.vec4d()
        for point in range(lane, scr.aitken_residual.shape[1], AITKEN_LANES):
            if scr.activity[world, point] == WITH_STIFFNESS:
                r = scr.updated_friction[world, point][0] - scr.frozen_friction[world, point][0]
                old = scr.aitken_residual[world, point]
                new = scr.updated_friction[world, point][0]
                out += wp.vec4d(old * (r - old), (r - old) * (r - old), r * r, new * new)
        scr.aitken_sums[world, lane] = out

    @masked_kernel(module, "flags")
    def aitken_relaxation(
        flags: wp.array(dtype=wp.int32), tol: f64, scr: ContactScratch, unsettled: wp.array(dtype=wp.int32)
    ):
        """Relaxation factor of the friction limits: 1 while r shrinks, else Aitken's (Irons and Tuck 1969)."""
        world = wp.tid()
        total = wp.vec4d()
        for lane in range(AITKEN_LANES):
            total += scr.aitken_sums[world, lane]
        omega = f64(1.0)
        slow = total[2] > f64(SLOW_REDUCTION) * f64(SLOW_REDUCTION) * scr.aitken_norm2[world] and total[1] > f64(0.0)
        if scr.limit_updates[world] > 0 and slow and total[2] > tol * tol * total[3]:
            omega = wp.clamp(-scr.relaxation[world] * total[0] / total[1], f64(0.05), f64(2.0))
            unsettled[world] = 1
        scr.relaxation[world] = omega
        scr.aitken_norm2[world] = total[2]
        count = scr.limit_updates[world] + 1
        scr.limit_updates[world] = count
        if count >= TOUCHING_PART_UPDATES:
            most = wp.pow(f64(SLOW_REDUCTION), f64(count - TOUCHING_PART_UPDATES + 1))
            scr.most_part_change[world] = wp.where(tol > f64(EXACT_TOLERANCE), f64(0.0), most)

    @masked_kernel(module, "flags")
    def update_frozen(flags: wp.array(dtype=wp.int32), scr: ContactScratch):
        """Update the frozen friction limits by the relaxed change, and the plane of friction."""
        world, point = wp.tid()
        new = scr.updated_friction[world, point]
        r = new[0] - scr.frozen_friction[world, point][0]
        if scr.relaxation[world] != f64(1.0):
            new[0] = wp.max(scr.frozen_friction[world, point][0] + scr.relaxation[world] * r, f64(0.0))
        scr.aitken_residual[world, point] = r
        scr.frozen_friction[world, point] = new
        scr.frozen_normal[world, point] = scr.updated_normal[world, point]

    @wp.func
    def product_at_point(
        other: Other, facets: Facets, p: wp.array2d(dtype=vec3), scr: ContactScratch, world: int, item: int, q: int
    ) -> vec3:  # fmt: skip
        """K times the displacement of a point along p."""
        d = vec3()
        at = k.column(facets, world, item)
        for i in range(facets.conn.shape[0]):
            d += acting_shape_value(facets, scr, world, q, i, item, at) * p[world, facets.conn[i, item]]
        return g.other_product(other, scr, p, world, facets.first_point + item * facets.point_count + q, d)

    @wp.kernel(module=module)
    def point_products(
        other: Other, facets: Facets, active: wp.array(dtype=wp.int32), p: wp.array2d(dtype=vec3), scr: ContactScratch
    ):  # fmt: skip
        """K times the displacement of each point."""
        world, item, q = wp.tid()
        if active[world] == 0 or scr.facet_activity[world, facets.first_row + item] != WITH_STIFFNESS:
            return
        point = facets.first_point + item * facets.point_count + q
        scr.point_product[world, point] = product_at_point(other, facets, p, scr, world, item, q)

    @masked_kernel(module, "active")
    def predict_friction(
        con: Contacts, other: Other, facets: Facets, active: wp.array(dtype=wp.int32), dq_dv: wp.array(dtype=f64),
        p: wp.array2d(dtype=vec3), scr: ContactScratch,
    ):  # fmt: skip
        """Friction of points after the full step along p, by their stiffness."""
        world, item, q = wp.tid()
        c = facets.contact[item]
        point = facets.first_point + item * facets.point_count + q
        rec = k.history_row(con, c, point)
        if scr.activity[world, point] != WITH_STIFFNESS or scr.frozen_friction[world, rec][0] <= f64(0.0):
            return
        change = dq_dv[world] * vec3d(product_at_point(other, facets, p, scr, world, item, q))
        area_fraction = facets.area_fraction[q, item] * k.is_acting(con, scr, world, c, point)
        friction = k.tangential(scr.frozen_normal[world, rec], scr.force[world, point] + change)
        scr.predicted_friction[world, point] = friction / (area_fraction * scr.frozen_friction[world, rec][0])

    @masked_kernel(module, "active")
    def gather_products(
        other: Other, facets: Facets, active: wp.array(dtype=wp.int32), lanes: int, last: int, scr: ContactScratch,
        pool: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """Sums of the point products on the slots of the facets, and of the other side where `last` includes them."""
        world, index = wp.tid()
        out = vec3()
        own = facets.facet_count * facets.conn.shape[0]
        entry = wp.min(index / lanes, last)
        lane = index % lanes
        place = facets.first_entry + entry
        if entry < own:
            item = entry % facets.facet_count
            if scr.facet_activity[world, facets.first_row + item] == WITH_STIFFNESS:
                at = k.column(facets, world, item)
                for q in range(lane, facets.point_count, lanes):
                    flux = scr.point_product[world, facets.first_point + item * facets.point_count + q]
                    out += acting_shape_value(facets, scr, world, q, entry / facets.facet_count, item, at) * flux
        else:
            place = g.other_entries(other) + entry - own
            out = g.gather_other_product(other, scr, world, entry - own, lane, lanes)
        out = lane_sum(out, lanes)
        if lane == 0:
            pool[world, place] = out

    @masked_kernel(module, "active")
    def diagonal(facets: Facets, active: wp.array(dtype=wp.int32), scr: ContactScratch, pool: wp.array2d(dtype=sym)):
        """3x3 diagonal blocks of the facets."""
        world, item, i = wp.tid()
        out = sym()
        if scr.facet_activity[world, facets.first_row + item] == WITH_STIFFNESS:
            at = k.column(facets, world, item)
            for q in range(facets.point_count):
                s = acting_shape_value(facets, scr, world, q, i, item, at)
                out += s * s * scr.stiffness[world, facets.first_point + item * facets.point_count + q]
        pool[world, facets.first_entry + i * facets.facet_count + item] = out

    return kernel_set(locals())


@functools.cache
def block_kernels(dtype: str, listed: bool) -> KernelSet:
    """Contributions of contact to an assembled matrix: points on their own facets, or `listed` by the facets of the
    other side."""
    p = precision(dtype)
    T, mat33, sym = p.T, p.mat33, p.sym
    Facets, PointLists = contact_structs(dtype).Facets, point_list_struct()
    Points = PointLists if listed else Facets
    Topology, Pattern = topology_struct(dtype), pattern_struct()
    add_symmetric, is_edge = add_symmetric_function(dtype), kinematics_functions(dtype).is_edge
    module = kernel_module(f"{'pair' if listed else 'contact'}_blocks_{dtype}", max_unroll=SHORT_UNROLL)

    @wp.func
    def own_block(
        facets: Facets, stiffness: wp.array2d(dtype=sym), weight: wp.array3d(dtype=T), world: int, at: wp.vec3i, k6: sym
    ) -> sym:  # fmt: skip
        """k6 + sum over the points of a facet of s_a s_b K; `weight`: of moving contact points. Without those on edges:
        their shape values are not stored with a preconditioner, which a restart makes anew."""
        out = k6
        if is_edge(facets, at[0]):
            return out
        for q in range(facets.point_count):
            s = facets.shape[q, at[1], at[0]] * facets.shape[q, at[2], at[0]]
            if facets.tracks_deepest != 0:
                c = facets.contact[at[0]]
                s = weight[world, c, at[1]] * weight[world, c, at[2]]
            out += s * stiffness[world, facets.first_point + at[0] * facets.point_count + q]
        return out

    @wp.func
    def listed_block(
        lists: PointLists, stiffness: wp.array2d(dtype=sym), weight: wp.array3d(dtype=T), world: int, at: wp.vec3i,
        k6: sym,
    ) -> sym:  # fmt: skip
        """k6 + sum over the points listed by a facet of w_a w_b K."""
        out = k6
        begin = lists.list_start[world, at[0]]
        for k in range(lists.list_size[world, at[0]]):
            point = lists.list_point[world, begin + k]
            out += (weight[world, point, at[1]] * weight[world, point, at[2]]) * stiffness[world, point]
        return out

    block = listed_block if listed else own_block

    @masked_kernel(module, "active")
    def add_blocks(
        topo: Topology, pattern: Pattern, points: Points, entry: wp.array(dtype=wp.int32),
        start: wp.array(dtype=wp.int32), source: wp.array(dtype=wp.vec3i), stiffness: wp.array2d(dtype=sym),
        weight: wp.array3d(dtype=T), dq_dv: wp.array(dtype=f64), active: wp.array(dtype=wp.int32),
        value: wp.array2d(dtype=mat33),
    ):  # fmt: skip
        """value += (dq/dv) times the blocks of an entry; `source`: facet and two of its slots."""
        world, index = wp.tid()
        k6 = sym()
        for e in range(start[index], start[index + 1]):
            k6 = block(points, stiffness, weight, world, source[e], k6)
        add_symmetric(topo, pattern.upper[entry[index]], T(dq_dv[world]) * k6, world, value)

    return kernel_set(locals())
