"""Master facets near a slave point: depth, side and motion decide which one it is in contact with."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import f64, vec3d
from .broad_phase import broad_phase_kernels
from .carriers import END, carrier_functions
from .facet_structs import EDGES, master_struct, pair_scratch_struct
from .kinematics import ENTRY_DEPTH, MAX_DEPTH_RATIO, MIN_NORMAL_COSINE, OPPOSING_COSINE, kinematics_functions
from .projection import OUTSIDE_TOLERANCE, facet_projection_functions
from .structs import contact_structs

__all__ = ["facet_candidate_functions"]

TUNNEL_LIMIT_RATIO = 0.25
"""Ratio to the depth limit of a facet above which a point that left the facet has passed through the body."""
BORDER_TOLERANCE = 1e-4
"""Distance over a side by which a point may pass a surface beside its border: round-off of flush borders."""
FACING_COSINE = 0.9
"""Cosine of a facet's normal and the slave's reversed normal above which a facet that a point slid onto over its edge
stands back: the flanks of a block that slides askew over an edge meet the side face below it less squarely."""
MAX_EDGE_TANGENT = 2.0
"""Maximum tangent of the angle between an outward vector and the normal of its facet, at the edge of a box."""


@functools.cache
def facet_candidate_functions(dtype: str) -> KernelSet:
    """Device functions in one precision of the displacements."""
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)
    Masters, PairScratch = master_struct(dtype), pair_scratch_struct(dtype)
    k, f = kinematics_functions(dtype), facet_projection_functions(dtype)
    (
        surface_point, displacement_change, distance_outside, facet_centre, inverse_map, newton_coordinates,
        unit_normal,
    ) = (
        f.surface_point, f.displacement_change, f.distance_outside, f.facet_centre, f.inverse_map,
        f.newton_coordinates, f.unit_normal,
    )  # fmt: skip
    boxes, displacement = broad_phase_kernels(dtype), carrier_functions(dtype).displacement

    @wp.struct
    class SlavePoint:
        """Slave point at an iterate, and the bounds of the search of its facet."""

        world: wp.int32
        contact: wp.int32
        slave_facet: wp.int32
        number_in_facet: wp.int32  # number among the points of the slave facet
        point: wp.int32  # index of the point among all
        displacement: vec3d  # displacement, m
        position: vec3d  # position, m
        start_position: vec3d  # position at the start of the attempt, m
        anchored: wp.bool  # it has an anchor facet
        motion: vec3d  # motion relative to the anchor facet's material, m
        facing_normal: vec3d  # normal of the anchor facet, else inward normal of the slave facet; 0: not yet set
        overlap_limit: f64  # m, > 0: no step; inner points up to that depth are in contact
        height_limit: f64  # largest height above a facet that is considered, m
        outside_depth: f64  # depth at the start of the attempt up to which a point was outside, m
        sudden_depth: f64  # depth beyond what a step adds, m; in statics none

    @wp.struct
    class FacetCandidate:
        """Candidate facet of a point."""

        facet: wp.int32  # -1: none
        xi: vec3d
        outside_distance: f64  # distance beyond the sides of the facet; 0 within its `edge_margin`
        total_outside_distance: f64  # distance beyond the sides without that margin
        height: f64  # height above the facet
        rank: wp.int32  # see `candidate_rank`
        entered: wp.bool  # the point passed a side of the body
        needs_entry: wp.bool  # the facet is accepted only with `entered`
        passed_through: wp.bool  # without another facet the point has left through one

    @wp.func
    def slave_point(facets: Facets, world: int, item: int, q: int) -> SlavePoint:
        """A point of a slave facet, without its state."""
        out = SlavePoint()
        out.world = world
        out.contact = facets.contact[item]
        out.slave_facet = item
        out.number_in_facet = q
        out.point = facets.first_point + item * facets.point_count + q
        return out

    @wp.func
    def deepest_contact(mas: Masters, pair: PairScratch, slave: SlavePoint) -> f64:
        """Penetration of the bodies' contacts at the start of the attempt, m."""
        bodies = mas.bodies[slave.contact]
        return wp.max(pair.deepest_contact[slave.world, bodies[0]], pair.deepest_contact[slave.world, bodies[1]])

    @wp.func
    def slave_point_at(
        con: Contacts, mas: Masters, facets: Facets, his: History, clock: Clock, scr: ContactScratch, pair: PairScratch,
        u: wp.array2d(dtype=vec3d), world: int, item: int, q: int, overlap_limit: f64,
    ) -> SlavePoint:  # fmt: skip
        """A point of a slave facet at displacements u, its motion relative to its anchor, and bounds of the search."""
        out = slave_point(facets, world, item, q)
        point = out.point
        offset = con.offset[out.contact]
        out.displacement = displacement(mas, facets, pair, u, world, q, item, END)
        out.position = facets.X[q, item] + out.displacement
        out.start_position = scr.start_position[world, point]
        overlap = k.remaining_overlap(con, his, world, out.contact, point, clock.time[world])
        out.overlap_limit = overlap_limit
        out.height_limit = overlap_limit + overlap + wp.abs(offset) + f64(1.0e-6) * wp.length(out.position)
        out.outside_depth = overlap + mas.touch_depth - wp.min(offset, f64(0.0))
        out.sudden_depth = f64(MAX_DEPTH_RATIO) * deepest_contact(mas, pair, out)
        if clock.is_static != 0 or out.sudden_depth == f64(0.0):
            out.sudden_depth = f64(1.0e300)
        out.anchored = pair.anchor_facet[world, point] > 0
        if out.anchored:
            f = pair.anchor_facet[world, point] - 1
            xi = pair.anchor_xi[world, point]
            change = displacement_change(mas, pair.displacement, pair.start_displacement, world, f, xi)
            out.motion = out.displacement - scr.start_displacement[world, point] - change
            out.height_limit += f64(2.0) * wp.abs(xi[2])
        return out

    @wp.func
    def has_left(mas: Masters, slave: SlavePoint, f: int, xi: vec3d, outside: f64) -> bool:
        """True if a point in contact is beside a facet and suddenly deep: an edge of the body has passed over it."""
        return -xi[2] > slave.sudden_depth and outside * mas.side_length[f] > -xi[2]

    @wp.func
    def anchor_candidate(mas: Masters, pair: PairScratch, slave: SlavePoint) -> FacetCandidate:
        """The anchor facet, with the coordinates that the point's motion leads to; none if the point has left it."""
        world = slave.world
        out = FacetCandidate(
            -1, vec3d(), f64(OUTSIDE_TOLERANCE), f64(OUTSIDE_TOLERANCE), f64(1.0e300), -1, False, False, False
        )
        if slave.overlap_limit > f64(0.0):
            out.outside_distance = f64(0.0)  # no tolerance: a point in front of one face may be beside another
        if slave.anchored:
            f = pair.anchor_facet[world, slave.point] - 1
            corners = mas.corner_count[mas.facet_kind[f]]
            first = pair.anchor_xi[world, slave.point]
            target = slave.motion
            found = wp.vec4d()
            tracked = bool(True)
            trials = wp.int32(0)
            while trials < 2 and found[3] == f64(0.0):  # by its motion, else by its position
                found = newton_coordinates(mas, pair.displacement, world, f, first, target, tracked)
                first = facet_centre(corners)
                target = slave.position
                tracked = False
                trials += 1
            xi = vec3d(found[0], found[1], found[2])
            o = distance_outside(corners, xi)
            if found[3] != f64(0.0) and o <= out.outside_distance and not has_left(mas, slave, f, xi, o):
                out = FacetCandidate(f, xi, o, o, wp.abs(xi[2]), -1, False, False, False)
        return out

    @wp.func
    def passed_through_facet(mas: Masters, pair: PairScratch, slave: SlavePoint, f: int) -> bool:
        """True if a point entered through a facet during the step, and deep."""
        world = slave.world
        kind = mas.facet_kind[f]
        m = facet_centre(mas.corner_count[kind])
        old = boxes.unpack_facet_point(pair.start_facet_centre[world, f])
        new = boxes.unpack_facet_point(pair.facet_centre[world, f])
        position_change = slave.position - slave.start_position - (new.position - old.position)
        deep = f64(TUNNEL_LIMIT_RATIO) * mas.depth_limit[f]
        if wp.length(position_change) <= deep:
            return False
        g0 = wp.dot(slave.start_position - old.position, unit_normal(old))
        g1 = wp.dot(slave.position - new.position, unit_normal(new))
        if g0 <= f64(0.0) or g1 >= -deep:
            return False
        y = slave.position - (g1 / (g1 - g0)) * position_change
        there = inverse_map(mas, pair.displacement, world, f, y, m)
        xi = vec3d(there[0], there[1], there[2])
        return there[3] != f64(0.0) and distance_outside(mas.corner_count[kind], xi) == f64(0.0)

    @wp.func
    def is_far(pair: PairScratch, slave: SlavePoint, f: int) -> bool:
        """True if a point is above a facet by more than twice `height_limit`."""
        s = boxes.unpack_facet_point(pair.facet_centre[slave.world, f])
        height = wp.dot(slave.position - s.position, unit_normal(s))
        return height > f64(2.0) * slave.height_limit + pair.bulge[slave.world, f]

    @wp.func
    def in_front(mas: Masters, pair: PairScratch, slave: SlavePoint, f: int) -> bool:
        """True if a point is above a facet by more than `height_limit` and within its sides."""
        corners = mas.corner_count[mas.facet_kind[f]]
        found = inverse_map(mas, pair.displacement, slave.world, f, slave.position, facet_centre(corners))
        within = distance_outside(corners, vec3d(found[0], found[1], found[2])) == f64(0.0)
        return found[3] != f64(0.0) and within and found[2] > slave.height_limit

    @wp.func
    def edge_margin(mas: Masters, f: int, xi: vec3d) -> f64:
        """Tolerance beyond a side, over its length, for points below an edge, where outward vectors are inclined."""
        return wp.max(-f64(MAX_EDGE_TANGENT) * xi[2] / mas.side_length[f], f64(0.0))

    @wp.func
    def passed_beside(mas: Masters, f: int, xi: vec3d, found: wp.vec4d) -> bool:
        """True if a point at `xi`, at the start of the attempt at `found`, passed the surface of a facet, or was below
        it then, beside the facet, or an edge of the facet passed over it."""
        corners = mas.corner_count[mas.facet_kind[f]]
        before = vec3d(found[0], found[1], found[2])
        part = f64(0.0)
        if before[2] > f64(0.0):
            part = before[2] / wp.max(before[2] - xi[2], before[2])
        there = before + part * (xi - before)
        inside = wp.where(xi[0] < xi[1], before[0], before[1])  # of the side that it is beyond now
        if wp.min(xi[0], xi[1]) >= f64(0.0):
            last = wp.where(xi[0] > xi[1], before[0], before[1])
            inside = f64(1.0) - wp.where(corners == 3, before[0] + before[1], last)
        swept = inside > f64(BORDER_TOLERANCE) and distance_outside(corners, xi) * mas.side_length[f] > -xi[2]
        return found[3] != f64(0.0) and (swept or distance_outside(corners, there) > f64(BORDER_TOLERANCE))

    @wp.func
    def within(mas: Masters, pair: PairScratch, slave: SlavePoint, f: int, xi: vec3d) -> f64:
        """Distance of coordinates from the border of a facet, over its side, minus what its border may sag below the
        edge of what it slides onto."""
        far = f64(1.0) - wp.max(xi[0], xi[1])
        if mas.corner_count[mas.facet_kind[f]] == 3:
            far = f64(1.0) - xi[0] - xi[1]
        sag = f64(MAX_DEPTH_RATIO) * deepest_contact(mas, pair, slave) / mas.side_length[f]
        return wp.min(wp.min(xi[0], xi[1]), far) - wp.max(sag, f64(BORDER_TOLERANCE))

    @wp.func
    def entered_sideways(
        mas: Masters, scr: ContactScratch, pair: PairScratch, slave: SlavePoint, f: int, xi: vec3d, found: wp.vec4d,
        gap: f64,
    ) -> bool:  # fmt: skip
        """True if a point is at a facet now, was beside it at the start of the attempt, at `found`, and was below its
        plane by at most the penetration of the bodies' contact: it slid under the edge of a body that has sunk in."""
        kind = mas.facet_kind[f]
        depth = scr.activation_gap[slave.world, slave.point] - gap
        most = wp.max(f64(MAX_DEPTH_RATIO) * deepest_contact(mas, pair, slave), f64(ENTRY_DEPTH) * mas.element_depth[f])
        if depth > wp.min(most, f64(TUNNEL_LIMIT_RATIO) * mas.depth_limit[f]):
            return False
        if distance_outside(mas.corner_count[kind], xi) > edge_margin(mas, f, xi):
            return False
        return found[3] == f64(0.0) or distance_outside(
            mas.corner_count[kind], vec3d(found[0], found[1], found[2])
        ) > f64(0.0)

    @wp.func
    def is_folded(mas: Masters, pair: PairScratch, world: int, f: int, xi: vec3d) -> bool:
        """True if the outward vectors of a facet cross between a point and its projection: the tangents have turned
        round, and coordinates within its sides say nothing."""
        s = surface_point(mas, pair.displacement, world, f, xi)
        base = surface_point(mas, pair.displacement, world, f, vec3d(xi[0], xi[1], f64(0.0)))
        n = wp.cross(base.tangent_a, base.tangent_b)
        trace = wp.dot(wp.cross(base.tangent_b, n), s.tangent_a) + wp.dot(wp.cross(n, base.tangent_a), s.tangent_b)
        return trace <= f64(0.0) or wp.dot(wp.cross(s.tangent_a, s.tangent_b), n) <= f64(0.0)

    @wp.func
    def candidate_rank(
        mas: Masters, scr: ContactScratch, pair: PairScratch, slave: SlavePoint, f: int, xi: vec3d, found: wp.vec4d
    ) -> int:
        """Rank of a facet for a point, -1: rejected by depth, by the previous facet, or by the side at the start of the
        attempt. Highest for facets that face the slave's squarely, then for one that the point reached from beside."""
        world = slave.world
        s = surface_point(mas, pair.displacement, world, f, xi)
        n = unit_normal(s)
        cosine = wp.dot(n, slave.facing_normal)
        gap = xi[2] * wp.dot(n, s.director)
        if (
            -gap > mas.depth_limit[f] or gap > slave.height_limit
        ):  # boxes depend on the other worlds: this test does not
            return -1
        if slave.anchored:
            return wp.where(cosine > f64(MIN_NORMAL_COSINE), 0, -1)
        if mas.one_sided[slave.contact] == EDGES and within(mas, pair, slave, f, xi) < f64(0.0):
            return -1  # the points of the facet's border act
        rank = wp.where(cosine > f64(OPPOSING_COSINE), 4, wp.where(cosine > -f64(OPPOSING_COSINE), 1, 0))
        rank = wp.where(cosine > f64(FACING_COSINE), 6, rank)
        if slave.overlap_limit > f64(0.0):
            if is_folded(mas, pair, world, f, xi):
                return -1
            rank = 0
        elif rank < 4 and mas.one_sided[slave.contact] != 0:
            return -1  # a point of an obstacle or edge: the other sides of its edge have points of their own
        else:
            projection = surface_point(mas, pair.start_displacement, world, f, vec3d(xi[0], xi[1], f64(0.0)))
            before = wp.dot(slave.start_position - projection.position, unit_normal(projection))
            if before < -slave.outside_depth:
                if rank == 0 or not entered_sideways(mas, scr, pair, slave, f, xi, found, before):
                    return -1
                rank = 5
        return rank

    @wp.func
    def precedes(new: FacetCandidate, old: FacetCandidate) -> bool:
        """True if a candidate is better: by its distance outside, then rank, total distance, height and number."""
        closer = new.height < old.height or (new.height == old.height and new.facet < old.facet)
        closer = new.total_outside_distance < old.total_outside_distance or (
            closer and new.total_outside_distance == old.total_outside_distance
        )
        closer = new.rank > old.rank or (closer and new.rank == old.rank)
        return (
            new.outside_distance < old.outside_distance
            or old.facet < 0
            or (new.outside_distance == old.outside_distance and closer)
        )

    @wp.func
    def better_candidate(
        mas: Masters, scr: ContactScratch, pair: PairScratch, slave: SlavePoint, f: int, candidate: FacetCandidate
    ) -> FacetCandidate:
        """The better of a candidate and another facet for a point."""
        out = candidate
        corners = mas.corner_count[mas.facet_kind[f]]
        found = inverse_map(mas, pair.displacement, slave.world, f, slave.position, facet_centre(corners))
        xi = vec3d(found[0], found[1], found[2])
        beyond = distance_outside(corners, xi)
        slack = f64(0.0)
        if not slave.anchored and slave.overlap_limit == f64(0.0):
            slack = edge_margin(mas, f, xi)
        most = wp.min(wp.max(candidate.outside_distance, slack), f64(OUTSIDE_TOLERANCE))
        if found[3] == f64(0.0) or beyond > most:
            return out
        if slave.anchored and has_left(mas, slave, f, xi, beyond):
            return out
        free = not slave.anchored and slave.overlap_limit == f64(0.0)
        start = wp.vec4d()
        if free:
            start = inverse_map(mas, pair.start_displacement, slave.world, f, slave.start_position, xi)
        rank = candidate_rank(mas, scr, pair, slave, f, xi, start)
        if rank < 0:
            return out
        beside = rank == 5
        if free and not beside and beyond > f64(0.0) and passed_beside(mas, f, xi, start):
            return out
        out.entered = out.entered or not beside
        o = beyond
        if rank > 1 and beyond <= slack:
            o = f64(0.0)
        new = FacetCandidate(
            f, xi, o, beyond, wp.abs(xi[2]), rank, out.entered, beside and beyond > f64(0.0), out.passed_through
        )
        if precedes(new, out):
            out = new
        return out

    @wp.func
    def is_beside_body(mas: Masters, pair: PairScratch, slave: SlavePoint, low: wp.vec3, high: wp.vec3) -> bool:
        """True if a point is in front of some facet in a box: outside of the body, and beside any other facet."""
        out = bool(False)
        index = wp.int32(0)
        root = wp.bvh_get_group_root(mas.tree, slave.world * mas.surface_count + mas.surface_of[slave.contact])
        query = wp.bvh_query_aabb(mas.tree, low, high, root)
        while wp.bvh_query_next(query, index):
            if in_front(mas, pair, slave, index - slave.world * mas.facet_count):
                out = True
        return out

    @wp.func
    def search_facets(
        mas: Masters, facets: Facets, scr: ContactScratch, pair: PairScratch, point: SlavePoint, first: FacetCandidate,
    ) -> FacetCandidate:  # fmt: skip
        """The best facet near a point's path in the attempt."""
        out = first
        slave = point
        world = slave.world
        free = not slave.anchored and slave.overlap_limit == f64(0.0)
        if slave.anchored:
            f = pair.anchor_facet[world, slave.point] - 1
            slave.facing_normal = unit_normal(
                surface_point(mas, pair.displacement, world, f, pair.anchor_xi[world, slave.point])
            )
            depth = scr.start_depth[world, slave.point] - wp.dot(slave.motion, slave.facing_normal)
            out.passed_through = depth > f64(TUNNEL_LIMIT_RATIO) * mas.depth_limit[f]
        wide = vec3d(slave.height_limit, slave.height_limit, slave.height_limit)
        low = boxes.round_down(wp.min(slave.position, slave.start_position) - wide)
        high = boxes.round_up(wp.max(slave.position, slave.start_position) + wide)
        root = wp.bvh_get_group_root(mas.tree, world * mas.surface_count + mas.surface_of[slave.contact])
        query = wp.bvh_query_aabb(mas.tree, low, high, root)
        index = wp.int32(0)
        while wp.bvh_query_next(query, index):
            f = index - world * mas.facet_count
            if is_far(pair, slave, f):
                continue
            if free and wp.length_sq(slave.facing_normal) == f64(0.0):
                slave.facing_normal = k.inward_normal(facets, scr, world, slave.slave_facet)
            out = better_candidate(mas, scr, pair, slave, f, out)
            if free and passed_through_facet(mas, pair, slave, f):
                out.passed_through = True
        if out.needs_entry and not out.entered:
            out.facet = -1  # it passed no side of the body
        if out.facet >= 0 and out.outside_distance > f64(0.0) and not slave.anchored:
            if is_beside_body(mas, pair, slave, low, high):
                out.facet = -1
        return out

    return kernel_set(locals())
