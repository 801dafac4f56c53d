"""Contact between bodies at a state: gap, elastic force and facet of every point, for fields and checks."""

import functools
import types as _types

import warp as wp

from ..common.types import SMALL, kernel_module
from .contact_data import attempt_struct, contact_struct, facet_struct, history_struct, of_world
from .contact_laws import PAPER, law_functions
from .contact_touch import touch_functions
from .pair_data import master_struct, seat_struct, touching_struct
from .pair_places import OUTER, place_functions
from .pair_seek import seek_kernels

__all__ = ["found_struct", "survey_kernels"]


@functools.cache
def found_struct():
    """Result of the evaluation, [world, point]."""

    @wp.struct
    class Found:
        gap: wp.array2d(dtype=wp.float64)  # m, 1e30: no facet nearby
        normal: wp.array2d(dtype=wp.float64)  # force, N
        force: wp.array2d(dtype=wp.vec3d)  # on the slave, N
        facet: wp.array2d(dtype=wp.int32)  # -1: none
        spot: wp.array2d(dtype=wp.vec3d)  # coordinates on it
        reaction: wp.array3d(dtype=wp.vec3d)  # [world, point, local] forces on its slots, N

    return Found


@functools.cache
def survey_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels in one precision of the model."""
    f64, vec3d = wp.float64, wp.vec3d
    Contacts, Facets, History = contact_struct(False), facet_struct(dtype), history_struct()
    Attempt, Found = attempt_struct(dtype), found_struct()
    Masters, Seats, Touching = master_struct(dtype), seat_struct(), touching_struct(dtype)
    k, places, seek = touch_functions(dtype, False), place_functions(dtype), seek_kernels(dtype)
    Touch, along, reach, hold, in_plane = k.Touch, k.along, k.reach, k.hold, k.in_plane
    friction_force, normal_law = k.friction_force, law_functions().normal_law
    jet, locate, outside, outward, middle = places.jet, places.locate, places.outside, places.outward, places.middle
    foot_of, weigh, frame, down, up = places.foot_of, places.weigh, seek.frame, seek.down, seek.up
    module = kernel_module(f"pair_survey_{dtype}", max_unroll=SMALL)

    @wp.func
    def nearest(mas: Masters, t: Touching, world: int, surface: int, x: vec3d, far: f64) -> wp.vec4d:
        """Coordinates of x on the closest facet of a surface, and that facet; -1: none within `far`."""
        out = wp.vec4d(f64(0.0), f64(0.0), f64(0.0), f64(-1.0))
        height = far
        off = f64(OUTER)
        pad = vec3d(far, far, far)
        root = wp.bvh_get_group_root(mas.tree, world * mas.surfaces + surface)
        query = wp.bvh_query_aabb(mas.tree, down(x - pad), up(x + pad), root)
        index = wp.int32(0)
        while wp.bvh_query_next(query, index):
            f = index - world * mas.count
            corners = mas.corners[mas.kind[f]]
            found = locate(mas, t.C, t.D, world, f, x, middle(corners))
            spot = vec3d(found[0], found[1], found[2])
            o = outside(corners, spot)
            if found[3] != f64(0.0) and o <= off:
                s = jet(mas, t.C, t.D, world, f, spot)
                gap = spot[2] * wp.dot(outward(s), s.c)
                closer = wp.abs(gap) < height or (wp.abs(gap) == height and f64(f) < out[3])
                if gap >= -mas.limit[f] and (o < off or closer) and wp.abs(gap) <= far:
                    out = wp.vec4d(spot[0], spot[1], spot[2], f64(f))
                    height = wp.abs(gap)
                    off = o
        return out

    @wp.kernel(module=module)
    def survey(
        con: Contacts, mas: Masters, facets: Facets, his: History, seats: Seats, time: wp.array(dtype=f64),
        u: wp.array2d(dtype=vec3d), far: f64, at: Attempt, t: Touching, out: Found,
    ):  # fmt: skip
        """Gaps of points in contact on their facets, of others on the closest facet; elastic forces, without motion."""
        world, item, q = wp.tid()
        c = facets.contact[item]
        point = facets.point + item * facets.points + q
        share = facets.share[q, item]
        out.gap[world, point] = f64(1.0e30)
        out.facet[world, point] = -1
        if share == f64(0.0):
            return
        x = facets.X[q, item] + along(facets, u, world, q, item)
        live = his.speed[world, point] > f64(0.0)
        f = wp.int32(-1)
        place = vec3d()
        if live:
            f = seats.seat[world, point] - 1
            found = locate(mas, t.C, t.D, world, f, x, seats.spot[world, point])
            place = vec3d(found[0], found[1], found[2])
            if found[3] == f64(0.0):
                f = -1
        if f < 0:
            found = nearest(mas, t, world, mas.of[c], x, far)
            place = vec3d(found[0], found[1], found[2])
            f = wp.int32(found[3])
        if f < 0:
            return
        foot = foot_of(mas, t.C, t.D, world, f, place)
        s = Touch()
        s.n = foot.n
        begins = reach(con, his, world, c, point, time[world], f64(0.0))
        s.depth = begins - (place[2] * foot.rise + foot.rest)
        k_n = con.scale[world, c] * of_world(con.normal, world, c)
        s.law = normal_law(con.law[c], 0, k_n, f64(0.0), con.ramp[c], con.force_eps[c], s.depth, s.depth)
        if live:
            s.whole = his.spring[world, point]
            if con.law[c] != PAPER:
                s.whole = frame(jet(mas, t.C, t.D, world, f, place)) * s.whole
        s = in_plane(s, s.n)
        held = hold(con, his, at, world, c, point, s)
        held[2] = f64(1.0)
        pressed = share * s.law[0] * s.n
        pulled = share * friction_force(con, world, c, s, held, f64(0.0))
        out.gap[world, point] = -s.depth
        out.normal[world, point] = share * s.law[0]
        out.force[world, point] = pressed - pulled
        out.facet[world, point] = f
        out.spot[world, point] = place
        for i in range(mas.conn.shape[0]):
            out.reaction[world, point, i] = weigh(mas, f, i, place) * pulled - weigh(mas, f, i, foot.spot) * pressed

    return _types.SimpleNamespace(module=module, survey=survey)
