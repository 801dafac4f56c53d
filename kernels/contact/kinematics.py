"""Kinematics of a point of contact: what its own side gives, before the geometry of the other side fills the record.

The record is `PointContact` (structs.py). A geometry of the other side is one file that adds itself to `GEOMETRIES`:
collider_kinematics.py for rigid shapes, facet_kinematics.py for facets of bodies. Assembly and ledger are made once for
each geometry, from its struct `Other` and these device functions:

begin_point: position, depth and approach speed of a point at the start of an attempt.
start_motion: normal, and velocity relative to the other side, at the start (explicit contacts).
evaluate: the record at an iterate.
frozen_motion: the record with the motion that friction acts on while its limit is frozen.
transmit: what the other side needs to gather the force of a point on its slots.
other_product: force of a point for a direction of a product, on its own side; keeps what the other side gathers.
gather_other_product, other_entries: sum of a slot of the other side, and the place of its first entry.
report_sign: 1, or -1 where reports state the force on the other side.
carried: prescribed motion of the other side's material at a point in the step less that of the point, which does work.
slip_frame: axes in which the elastic slip is stored, turned with the other side.
touched_state, released_state: `History.contact_state` of a point after a step, in contact or not.
store_side: what the other side stores after a step.
"""

import functools
from collections.abc import Callable
from typing import Any

import warp as wp

from ..common.modules import KernelSet, kernel_set
from ..common.types import f64, precision, vec3d
from .law import FIXED_SPRING, MIN_APPROACH_SPEED
from .structs import contact_structs

__all__ = [
    "ENTRY_DEPTH",
    "GEOMETRIES",
    "MAX_DEPTH_RATIO",
    "MIN_NORMAL_COSINE",
    "OPPOSING_COSINE",
    "kinematics_functions",
]

MIN_NORMAL_COSINE = 0.1
"""Minimum cosine of the normals of two facets that a point in contact passes between: excludes the edge of a box."""
OPPOSING_COSINE = 0.5
"""Cosine of a facet's normal and the slave's reversed normal above which they face each other; below its negative they
face the same way."""
MAX_DEPTH_RATIO, ENTRY_DEPTH = 2.0, 1e-4
"""Largest depth of a point that enters from beside a facet, over the deepest active penetration; or over the depth of
an element, where nothing touches yet."""

GEOMETRIES: dict[str, Callable[[str], KernelSet]] = {}
"""Geometries of the other side by name: the precision of the displacements -> device functions and `Other`."""


@functools.cache
def kinematics_functions(dtype: str) -> KernelSet:
    """Device functions in one precision of the displacements; everything else is float64."""
    p = precision(dtype)
    T, vec3, sym = p.T, p.vec3, p.sym
    Contacts, Facets, History, ContactScratch, Clock, PointContact = contact_structs(dtype)

    @wp.func
    def is_edge(facets: Facets, item: int) -> bool:
        """True for a row of points on sharp edges, or of rolling points."""
        return facets.edge_rows > 0 and facets.edge_row[item] >= 0

    @wp.func
    def column(facets: Facets, world: int, item: int) -> int:
        """Column of the shape values and positions of a facet; points on edges have one for each world."""
        if not is_edge(facets, item):
            return item
        return facets.facet_count + world * facets.edge_rows + facets.edge_row[item]

    @wp.func
    def frozen_column(facets: Facets, world: int, item: int) -> int:
        """Column of the shape values by which friction acts: those of points on edges are frozen with its limit."""
        if not is_edge(facets, item):
            return item
        return column(facets, world, item) + facets.edge_shape.shape[2] / 2

    @wp.func
    def shape_at(facets: Facets, point: int, i: int, at: int) -> T:
        """Shape value of slot i at a point, in column `at`."""
        if at < facets.facet_count:
            return facets.shape[point, i, at]
        return facets.edge_shape[point, i, at - facets.facet_count]

    @wp.func
    def position_at(facets: Facets, point: int, at: int) -> vec3d:
        """Reference position of a point, m, in column `at`."""
        if at < facets.facet_count:
            return facets.X[point, at]
        return facets.edge_X[point, at - facets.facet_count]

    @wp.func
    def freeze_shape(facets: Facets, world: int, point: int, item: int):
        """Freeze the shape values of a point on an edge."""
        if is_edge(facets, item):
            for i in range(facets.conn.shape[0]):
                value = shape_at(facets, point, i, column(facets, world, item))
                facets.edge_shape[point, i, frozen_column(facets, world, item) - facets.facet_count] = value

    @wp.func
    def interpolate_at(
        facets: Facets, field: wp.array2d(dtype=Any), world: int, point: int, item: int, at: int
    ) -> vec3d:  # fmt: skip
        """sum_i s_i field_i by the shape values of a column."""
        out = vec3d()
        for i in range(facets.conn.shape[0]):
            out += f64(shape_at(facets, point, i, at)) * vec3d(field[world, facets.conn[i, item]])
        return out

    @wp.func
    def interpolate(facets: Facets, field: wp.array2d(dtype=Any), world: int, point: int, item: int) -> vec3d:
        """sum_i s_i field_i at a point."""
        return interpolate_at(facets, field, world, point, item, column(facets, world, item))

    @wp.func
    def acting_shape_value(
        facets: Facets, scr: ContactScratch, world: int, point: int, i: int, item: int, at: int
    ) -> T:
        """Shape value of slot i at the active point: a point of a facet with values in column `at`, or that of a lumped
        contact."""
        if facets.tracks_deepest != 0:
            return scr.shape_values[world, facets.contact[item], i]
        return shape_at(facets, point, i, at)

    @wp.func
    def interpolate_acting(
        facets: Facets, scr: ContactScratch, field: wp.array2d(dtype=Any), world: int, point: int, item: int
    ) -> vec3d:
        """sum_i s_i field_i at the active point."""
        if facets.tracks_deepest == 0:
            return interpolate(facets, field, world, point, item)
        out = vec3d()
        for i in range(facets.conn.shape[0]):
            out += f64(acting_shape_value(facets, scr, world, point, i, item, item)) * vec3d(
                field[world, facets.conn[i, item]]
            )
        return out

    @wp.func
    def reference_position(facets: Facets, scr: ContactScratch, world: int, point: int, item: int) -> vec3d:
        """Reference position of the active point, m."""
        if facets.tracks_deepest != 0:
            return scr.point_reference[world, facets.contact[item]]
        return position_at(facets, point, column(facets, world, item))

    @wp.func
    def inward_normal(facets: Facets, scr: ContactScratch, world: int, item: int) -> vec3d:
        """Inward normal of a facet at the start of the attempt, in its frame; 0 if undefined."""
        corners = facets.corners[item]
        if corners[0] < 0:
            return vec3d()
        point = facets.first_point + item * facets.point_count
        x = scr.start_position[world, point + corners[0]]
        return wp.normalize(
            wp.cross(
                scr.start_position[world, point + corners[2]] - x, scr.start_position[world, point + corners[1]] - x
            )
        )

    @wp.func
    def monomial_derivative(x: f64, power: int, derivative: int) -> f64:
        """Derivative of x^power of order `derivative`."""
        out = f64(1.0)
        for j in range(derivative):
            out *= f64(power - j)
        for _ in range(power - derivative):
            out *= x
        return out

    @wp.func
    def lagrange_polynomial(facets: Facets, q: int, s: wp.vec2d) -> f64:
        """Lagrange polynomial of a facet: 1 at point q and 0 at the others."""
        out = f64(0.0)
        for m in range(facets.exponents.shape[0]):
            out += facets.lagrange_coefficients[q, m] * (
                monomial_derivative(s[0], facets.exponents[m][0], 0)
                * monomial_derivative(s[1], facets.exponents[m][1], 0)
            )
        return out

    @wp.func
    def tangential(n: vec3d, a: vec3d) -> vec3d:
        """Component of a normal to n."""
        return a - wp.dot(n, a) * n

    @wp.func
    def history_row(con: Contacts, c: int, point: int) -> int:
        """Index of a point's history."""
        if con.single_point[c] != 0:
            return con.first_point[c]
        return point

    @wp.func
    def remaining_overlap(con: Contacts, his: History, world: int, c: int, point: int, time: f64) -> f64:
        """Remaining part of an initial overlap, m."""
        left = f64(1.0) - (time - his.overlap_time[world]) / con.overlap_decay_time[c]
        return his.overlap[world, point] * wp.clamp(left, f64(0.0), f64(1.0))

    @wp.func
    def overlap_recovery(con: Contacts, his: History, clock: Clock, world: int, c: int, point: int) -> f64:
        """Outward motion of the surface of an initial overlap in a substep, m: its force does work."""
        now = clock.new_time[world]
        before = remaining_overlap(con, his, world, c, point, now - clock.h[world])
        return before - remaining_overlap(con, his, world, c, point, now)

    @wp.func
    def activation_gap(con: Contacts, his: History, world: int, c: int, point: int, time: f64, margin: f64) -> f64:
        """Gap at which contact begins, m: offset + `margin` - remaining overlap."""
        return con.offset[c] + margin - remaining_overlap(con, his, world, c, point, time)

    @wp.func
    def approach_speed(his: History, world: int, rec: int, speed: f64) -> f64:
        """Approach speed of the damping, m/s: the largest since contact began; `speed`: at the start of the attempt."""
        return wp.max(wp.max(his.speed[world, rec], f64(MIN_APPROACH_SPEED)), speed)

    @wp.func
    def turned_spring(con: Contacts, his: History, world: int, c: int, rec: int, frame: wp.mat33d) -> vec3d:
        """Stored elastic slip of a point in contact, m, turned with the axes of the other side."""
        if con.law[c] & FIXED_SPRING != 0:
            return his.spring[world, rec]
        return frame * his.spring[world, rec]

    @wp.func
    def depth_at_start(
        con: Contacts, facets: Facets, his: History, scr: ContactScratch, world: int, c: int, item: int, point: int
    ) -> f64:
        """Depth at the start of the step, m; for a moving point in contact, that of the deepest position then."""
        if facets.tracks_deepest != 0 or is_edge(facets, item):
            rec = history_row(con, c, point)
            if his.speed[world, rec] > f64(0.0):
                return his.previous_depth[world, rec]
        return scr.start_depth[world, point]

    @wp.func
    def stiffness_ratio(
        con: Contacts, facets: Facets, world: int, c: int, item: int, other_depth: f64
    ) -> f64:  # fmt: skip
        """Factor on the stiffness of a contact at a facet, from the depths of the elements on both sides, m.

        The compliance per area is (c_1 depth_1 + c_2 depth_2) times that of the contact; one stiffness for the whole
        region is 1 + 0 + 0.
        """
        s = con.compliance[world % con.compliance.shape[0], c]
        return f64(1.0) / (s[0] + s[1] * facets.element_depth[item] + s[2] * other_depth)

    @wp.func
    def is_acting(con: Contacts, scr: ContactScratch, world: int, c: int, point: int) -> f64:
        """1, or 0 if another point represents the contact."""
        if con.single_point[c] != 0 and scr.contact_point[world, c] != point:
            return f64(0.0)
        return f64(1.0)

    @wp.func
    def inverse_step(clock: Clock, world: int) -> f64:
        """1/h, 1/s; 0 in statics."""
        if clock.is_static != 0:
            return f64(0.0)
        return f64(1.0) / clock.h[world]

    @wp.func
    def multiply_symmetric(k: sym, p: vec3) -> vec3:
        """Product of the symmetric matrix k (Voigt) with p."""
        return vec3(k[0] * p[0] + k[5] * p[1] + k[4] * p[2], k[5] * p[0] + k[1] * p[1] + k[3] * p[2],
                    k[4] * p[0] + k[3] * p[1] + k[2] * p[2])  # fmt: skip

    return kernel_set(locals())
