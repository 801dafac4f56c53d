"""Seams between bodies: a point that enters a body by a side face that a neighbour hides meets the level surface.

As at seams between colliders (collider_seams.py), by the same lengths. The side face is that of the touched facet, or
that of the point's own facet, which slides under the edge of the other body; it is hidden where a neighbour's surface
begins within `reach` in front of it, is across the face and at most `depth` above the point, and the surface behind
the side face is within `seam` of that level. `warpfea/contact/seams.py` lists the neighbours of both. A level
face of an obstacle at rest is a surface of facets without slots. What enters an obstacle beside a body finds the level
of that by `find_levels`.
"""

import functools

import warp as wp

from ..common.modules import SHORT_UNROLL, KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import f64, precision, vec3d
from .broad_phase import broad_phase_kernels
from .collider_seams import MIN_CROSS_COSINE
from .facet_candidates import BORDER_TOLERANCE, facet_candidate_functions
from .facet_structs import master_struct, pair_scratch_struct
from .kinematics import OPPOSING_COSINE, kinematics_functions
from .projection import OUTSIDE_TOLERANCE, facet_projection_functions
from .structs import contact_structs

__all__ = ["body_level_kernels", "facet_seam_functions"]


@functools.cache
def facet_seam_functions(dtype: str) -> KernelSet:
    """Device functions in one precision of the displacements."""
    Masters, PairScratch = master_struct(dtype), pair_scratch_struct(dtype)
    f, candidates = facet_projection_functions(dtype), facet_candidate_functions(dtype)
    SlavePoint, FacetCandidate = candidates.SlavePoint, candidates.FacetCandidate
    closest_facet = broad_phase_kernels(dtype).closest_facet

    @wp.func
    def normal_and_height(mas: Masters, pair: PairScratch, world: int, item: int, xi: vec3d) -> wp.vec4d:
        """Normal of a facet at coordinates, and the height above it, m."""
        s = f.surface_point(mas, pair.displacement, world, item, xi)
        n = f.unit_normal(s)
        return wp.vec4d(n[0], n[1], n[2], xi[2] * wp.dot(n, s.director))

    @wp.func
    def hidden_level(mas: Masters, pair: PairScratch, world: int, row: int, x: vec3d, n: vec3d, gap: f64) -> vec3d:
        """Normal of the neighbour that hides a side face; 0: none does.

        Args:
            row: of the side, see `master_struct`.
            x: position behind the side face, of outward normal n, by -`gap`, m.
        """
        lengths = mas.seam_lengths[row]
        far = lengths[0] + lengths[2]
        cross = f64(MIN_CROSS_COSINE)
        front = x + (lengths[1] - gap) * n
        behind = x - f64(2.0) * lengths[2] * n  # there no edge of the neighbour is nearer than the level
        for e in range(mas.neighbor_start[row], mas.neighbor_start[row + 1]):
            at = closest_facet(mas, pair, world, mas.neighbor[e], front, far, f64(BORDER_TOLERANCE), n, -cross, cross)
            if at[3] < f64(0.0):
                continue
            level = normal_and_height(mas, pair, world, wp.int32(at[3]), vec3d(at[0], at[1], at[2]))
            way = vec3d(level[0], level[1], level[2])
            if level[3] > lengths[0] or level[3] < -lengths[2]:
                continue
            at = closest_facet(mas, pair, world, mas.seam_surface[row], behind, far, f64(BORDER_TOLERANCE), way,
                               f64(OPPOSING_COSINE), f64(1.1))  # fmt: skip
            if at[3] >= f64(0.0):
                own = normal_and_height(mas, pair, world, wp.int32(at[3]), vec3d(at[0], at[1], at[2]))
                if wp.abs(own[3] - level[3]) <= lengths[0]:
                    return way
        return vec3d()

    @wp.func
    def level_candidate(mas: Masters, pair: PairScratch, slave: SlavePoint, found: FacetCandidate) -> FacetCandidate:
        """The facet at the level of a neighbour for a point that enters a body by a hidden side face, none if it is not
        there; else the facet as found."""
        out = found
        world = slave.world
        side = normal_and_height(mas, pair, world, found.facet, found.xi)
        n = vec3d(side[0], side[1], side[2])
        row = 2 * slave.contact
        way = hidden_level(mas, pair, world, row, slave.position, n, side[3])
        if wp.length_sq(way) == f64(0.0):
            row += 1  # the side face of the point's own body
            way = -hidden_level(mas, pair, world, row, slave.position, -n, f64(0.0))
        if wp.length_sq(way) > f64(0.0):
            far = mas.seam_lengths[row][0] + mas.seam_lengths[row][2]
            at = closest_facet(mas, pair, world, mas.surface_of[slave.contact], slave.position, far,
                               f64(OUTSIDE_TOLERANCE), way, f64(OPPOSING_COSINE), f64(1.1))  # fmt: skip
            out.passed_through = False
            out.facet = wp.int32(at[3])
            out.xi = vec3d(at[0], at[1], at[2])
        return out

    return kernel_set(locals())


@functools.cache
def body_level_kernels(dtype: str) -> KernelSet:
    """Kernel of the levels of bodies beside obstacles."""
    Masters, PairScratch, Facets = master_struct(dtype), pair_scratch_struct(dtype), contact_structs(dtype).Facets
    vec3, k = precision(dtype).vec3, kinematics_functions(dtype)
    closest_facet = broad_phase_kernels(dtype).closest_facet
    normal_and_height = facet_seam_functions(dtype).normal_and_height
    module = kernel_module(f"contact_body_levels_{dtype}", max_unroll=SHORT_UNROLL)

    @masked_kernel(module, "active")
    def find_levels(
        mas: Masters, pair: PairScratch, facets: Facets, u: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32),
        start: wp.array(dtype=wp.int32), surface: wp.array(dtype=wp.int32), normal: wp.array(dtype=vec3d),
        lengths: wp.array(dtype=wp.vec2d), level: wp.array2d(dtype=wp.vec4d),
    ):  # fmt: skip
        """`body_level` of points of obstacles' contacts at displacements u, those of `pair`.

        Args:
            start: [contact + 1] first row of a collider's contact; in rows: the body's surface, its normal at the
                level, and how far it continues, m and over the side of a facet.
        """
        world, item, q = wp.tid()
        c = facets.contact[item]
        x = k.position_at(facets, q, k.column(facets, world, item)) + k.interpolate(facets, u, world, q, item)
        found = wp.vec4d()
        for e in range(start[c], start[c + 1]):
            far = lengths[e]
            at = closest_facet(mas, pair, world, surface[e], x, far[0], far[1], normal[e], f64(OPPOSING_COSINE),
                               f64(1.1))  # fmt: skip
            if at[3] >= f64(0.0) and wp.length_sq(found) == f64(0.0):
                found = normal_and_height(mas, pair, world, wp.int32(at[3]), vec3d(at[0], at[1], at[2]))
        level[world, facets.first_point + item * facets.point_count + q] = found

    return kernel_set(locals())
