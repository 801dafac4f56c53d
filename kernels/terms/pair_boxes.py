"""Master facets during an attempt: polynomial coefficients, midpoints, and bounding boxes of the tree."""

import functools
import types as _types
from typing import Any

import warp as wp

from ..common.types import SMALL, kernel_module, precision
from .pair_data import master_struct, touching_struct
from .pair_places import place_functions

__all__ = ["MARGIN", "box_kernels"]

MARGIN = 0.25
"""Enlargement of the boxes of the tree over a facet's side: they stay valid for several steps."""
ROUNDING = 2.4e-7


@functools.cache
def box_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels in one precision of the displacements, in the module of `seek_kernels`, and box functions."""
    vec3 = precision(dtype).vec3
    f64, vec3d, box3 = wp.float64, wp.vec3d, wp.vec3
    mat43 = wp.types.matrix(shape=(4, 3), dtype=f64)
    Masters, Touching = master_struct(dtype), touching_struct(dtype)
    f = place_functions(dtype)
    Jet, jet, middle, outward = f.Jet, f.jet, f.middle, f.outward
    module = kernel_module(f"pair_seek_{dtype}", max_unroll=SMALL)

    @wp.func
    def control(
        mas: Masters, u: wp.array2d(dtype=Any), world: int, item: int, m: int, C: wp.array2d(dtype=vec3d),
        D: wp.array2d(dtype=vec3d),
    ):  # fmt: skip
        """Coefficient m of a slot field on a master facet."""
        c = vec3d()
        d = vec3d()
        for i in range(mas.conn.shape[0]):
            value = vec3d(u[world, mas.conn[i, item]])
            c += f64(mas.shape[m, i, item]) * value
            d += f64(mas.rise[m, i, item]) * value
        C[world, mas.most * item + m] = c
        D[world, mas.most * item + m] = d

    @wp.kernel(module=module)
    def controls(
        mas: Masters, u: wp.array2d(dtype=vec3d), active: wp.array(dtype=wp.int32), C: wp.array2d(dtype=vec3d),
        D: wp.array2d(dtype=vec3d),
    ):  # fmt: skip
        """Coefficients of displacements on master facets in float64, see kernels/terms/contact_exact.py."""
        world, item, m = wp.tid()
        if active[world] != 0 and m < mas.terms[mas.kind[item]]:
            control(mas, u, world, item, m, C, D)

    @wp.kernel(module=module)
    def controls_before(
        mas: Masters, u_n: wp.array2d(dtype=vec3), v_n: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32),
        t: Touching,
    ):  # fmt: skip
        """Coefficients of displacements and velocities at the start of an attempt; resets the largest depths."""
        world, item, m = wp.tid()
        if active[world] != 0:
            for body in range(mas.most * item + m, t.deepest.shape[1], mas.most * mas.count):
                t.deepest[world, body] = f64(0.0)
        if active[world] != 0 and m < mas.terms[mas.kind[item]]:
            control(mas, v_n, world, item, m, t.V0, t.D0)
            control(mas, u_n, world, item, m, t.C0, t.D0)

    @wp.func
    def down(x: vec3d) -> box3:
        """x in single precision, rounded down by more than its largest round-off."""
        return box3(
            wp.float32(x[0] - wp.abs(x[0]) * f64(ROUNDING)),
            wp.float32(x[1] - wp.abs(x[1]) * f64(ROUNDING)),
            wp.float32(x[2] - wp.abs(x[2]) * f64(ROUNDING)),
        )

    @wp.func
    def up(x: vec3d) -> box3:
        """x in single precision, rounded up."""
        return -down(-x)

    @wp.func
    def contains(low: box3, high: box3, other_low: box3, other_high: box3) -> bool:
        """True if a box contains another one."""
        inside = bool(True)
        for j in range(3):
            if other_low[j] < low[j] or other_high[j] > high[j]:
                inside = False
        return inside

    @wp.func
    def rows_of(s: Jet) -> mat43:
        """Position and derivatives, packed in a matrix."""
        return mat43(s.x[0], s.x[1], s.x[2], s.a[0], s.a[1], s.a[2], s.b[0], s.b[1], s.b[2], s.c[0], s.c[1], s.c[2])

    @wp.func
    def jet_of(m: mat43) -> Jet:
        """Position and derivatives from their matrix."""
        return Jet(m[0], m[1], m[2], m[3])

    @wp.kernel(module=module)
    def check_boxes(mas: Masters, active: wp.array(dtype=wp.int32), t: Touching):
        """Flag facets outside of their boxes, at the start of the attempt or now; compute new boxes."""
        world, item = wp.tid()
        if active[world] == 0:
            return
        low = vec3d(f64(1.0e300), f64(1.0e300), f64(1.0e300))
        high = -low
        kind = mas.kind[item]
        count = mas.terms[kind]
        for q in range(count):
            x = vec3d()
            y = vec3d()
            for m in range(count):
                part = mas.hull[kind, q, m]
                if part != f64(0.0):
                    x += part * (mas.X[m, item] + t.C[world, mas.most * item + m])
                    y += part * (mas.X[m, item] + t.C0[world, mas.most * item + m])
            low = wp.min(low, wp.min(x, y))
            high = wp.max(high, wp.max(x, y))
        index = world * mas.count + item
        if not contains(t.lower[index], t.upper[index], down(low), up(high)):
            t.stale[0] = 1
        room = f64(MARGIN) * mas.size[item]
        pad = vec3d(room, room, room)
        t.wanted_lower[index] = down(low - pad)
        t.wanted_upper[index] = up(high + pad)

    @wp.kernel(module=module)
    def keep_middles(mas: Masters, active: wp.array(dtype=wp.int32), t: Touching):
        """Position and derivatives at the midpoint of each facet, at the start of the attempt and now, and the facet's
        largest height above the tangent plane there."""
        world, item = wp.tid()
        if active[world] == 0:
            return
        kind = mas.kind[item]
        count = mas.terms[kind]
        spot = middle(mas.corners[kind])
        s = jet(mas, t.C, t.D, world, item, spot)
        n = outward(s)
        swell = f64(0.0)
        for q in range(count):
            x = vec3d()
            for m in range(count):
                x += mas.hull[kind, q, m] * (mas.X[m, item] + t.C[world, mas.most * item + m])
            swell = wp.max(swell, wp.dot(x - s.x, n))
        t.swell[world, item] = swell
        t.middle[world, item] = rows_of(s)
        t.middle0[world, item] = rows_of(jet(mas, t.C0, t.D0, world, item, spot))

    @wp.kernel(module=module)
    def adopt_boxes(t: Touching):
        """Replace the boxes by the new ones."""
        index = wp.tid()
        t.lower[index] = t.wanted_lower[index]
        t.upper[index] = t.wanted_upper[index]
        if index == 0:
            t.stale[0] = 0
            t.fits[0] = t.fits[0] + 1

    return _types.SimpleNamespace(
        controls=controls, controls_before=controls_before, check_boxes=check_boxes, keep_middles=keep_middles,
        adopt_boxes=adopt_boxes, down=down, up=up, contains=contains, jet_of=jet_of,
    )  # fmt: skip
