"""Adjoint of springs: bars of the start of a step that rates take, derivatives by parameters and targets."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import topology_struct
from ..common.types import double_1d, double_2d, f64, int_1d, mat33d, precision, vec3d, vec3d_2d
from .bounded_laws import FRICTION, STOP, bounded_functions
from .spring_coordinates import CHORD, VECTOR, coordinate_functions
from .spring_laws import OwnForces, law_functions, spring_struct
from .springs import mat33d_2d, scratch_struct, spring_kernels

__all__ = ["parameter_struct", "spring_gradient_kernels"]

STEP = 1e-5
"""Step of central differences by a parameter, over its size or 1: forces are linear in nearly all, between their kinks,
and round-off is 1e-11 of the force."""


@functools.cache
def parameter_struct():
    """A parameter of a spring."""

    @wp.struct
    class Parameter:
        column: wp.int32  # of its array: the spring
        law: wp.int32  # time law that it is in place of the array, or -1
        first: wp.int32  # items of the spring
        last: wp.int32
        in_motion: wp.float64  # 1, or 0 in statics
        stiffness: wp.float64  # change of the stiffness by the parameter besides, of FRICTION

    return Parameter


@functools.cache
def spring_gradient_kernels(
    dtype: str, own: OwnForces = (), bounded: bool = False, has_chords: bool = False
) -> KernelSet:
    """Kernels of springs at the end of a step; arguments as those of `spring_kernels`."""
    p = precision(dtype)
    Springs, Scratch, Topology = spring_struct(), scratch_struct(), topology_struct(dtype)
    k, law, c = spring_kernels(dtype, False, own, bounded, has_chords), law_functions(own), coordinate_functions(False)
    more, Parameter = bounded_functions(False), parameter_struct()
    module = kernel_module(f"{k.module.name.rpartition('.')[2]}_gradients")

    @wp.func
    def force_slope(
        spr: Springs, law_value: vec3d_2d, inverse: f64, y: f64, by: wp.vec2d, world: int, item: int, scr: Scratch
    ) -> f64:  # fmt: skip
        """Derivative of the force by y~ and the anchor of friction, along `by`."""
        sp, reference, winding = spr.spring[item], scr.reference[world, item], scr.winding[world, item]
        if wp.static(bounded):
            if spr.law[sp] < 0:
                value, stiffness = k.scheduled(spr, law_value, world, sp), spr.stiffness[world, sp]
                y0, anchor = scr.start[world, item], scr.anchor[world, item]
                slope = more.bounded_force(spr, world, sp, winding, y0, y, reference, inverse, anchor, value)[1]
                if slope == f64(0.0):
                    return f64(0.0)
                rate = slope - stiffness
                if spr.law[sp] == STOP:
                    p = more.penetration(spr, world, sp, winding, y)
                    if p * more.penetration(spr, world, sp, winding, reference) <= f64(0.0):
                        rate = f64(0.0)
                return -by[0] * rate - by[1] * stiffness
        return -by[0] * inverse * law.viscous_force(spr, world, sp, y + winding, (y - reference) * inverse)[2]

    @masked_kernel(module, "active")
    def rate_bars(
        spr: Springs, u: p.vec3_2d, past: p.vec3_2d, law_value: vec3d_2d, factor: double_1d, sign: f64,
        dq_dv: double_1d, w: p.vec3_2d, forwards: int, active: int_1d, scr: Scratch, out: mat33d_2d,
    ):  # fmt: skip
        """Bars of the vectors at a past displacement, of which y~ has the coordinate times a signed factor; of a VECTOR
        those of q~. `forwards`: forces by changes w in place of bars."""
        world, item = wp.tid()
        kind, sp = spr.kind[item], spr.spring[item]
        inverse = f64(1.0) / dq_dv[world]
        D = k.vectors(spr, w, world, item)
        if kind == VECTOR:
            out[world, item] = (spr.scale[item] * spr.damping[world, sp] * inverse) * D
            return
        out[world, item] = mat33d()
        if kind == CHORD or factor[world] == f64(0.0):
            return
        V = spr.reference[item] + k.vectors(spr, u, world, item)
        y0 = scr.start[world, item]
        y = c.coordinate(kind, V, y0)
        slope = force_slope(spr, law_value, inverse, y, wp.vec2d(f64(1.0), f64(0.0)), world, item, scr)
        before = spr.reference[item] + k.vectors(spr, past, world, item)
        end, start = c.derivatives(kind, V, y).g, c.derivatives(kind, before, c.coordinate(kind, before, y0)).g
        if forwards == 0:
            out[world, item] = (-sign * factor[world] * slope * wp.ddot(end, D)) * start
        else:
            out[world, item] = (-sign * factor[world] * slope * wp.ddot(start, D)) * end

    if bounded:

        @masked_kernel(module, "active")
        def end_anchors(
            spr: Springs, u: p.vec3_2d, anchor_bar: double_2d, active: int_1d, scr: Scratch, out: mat33d_2d
        ):
            """Bars of the vectors at the end of a step by anchors that slip along; these no longer act at its start."""
            world, item = wp.tid()
            out[world, item] = mat33d()
            sp = spr.spring[item]
            if spr.law[sp] != FRICTION:
                return
            V = spr.reference[item] + k.vectors(spr, u, world, item)
            y = c.coordinate(spr.kind[item], V, scr.start[world, item])
            if spr.stiffness[world, sp] * wp.abs(y - scr.anchor[world, item]) >= spr.max_force[world, sp]:
                out[world, item] = anchor_bar[world, item] * c.derivatives(spr.kind[item], V, y).g
                anchor_bar[world, item] = f64(0.0)

        @masked_kernel(module, "active")
        def start_anchors(
            spr: Springs, u: p.vec3_2d, u_n: p.vec3_2d, law_value: vec3d_2d, anchor: double_2d, dq_dv: double_1d,
            w: p.vec3_2d, active: int_1d, scr: Scratch, anchor_bar: double_2d, out: mat33d_2d,
        ):  # fmt: skip
            """Bars of anchors at the start, and of the vectors there by those that begin at y."""
            world, item = wp.tid()
            out[world, item] = mat33d()
            kind = spr.kind[item]
            if spr.law[spr.spring[item]] != FRICTION:
                return
            V = spr.reference[item] + k.vectors(spr, u, world, item)
            y0 = scr.start[world, item]
            y = c.coordinate(kind, V, y0)
            by = wp.vec2d(f64(0.0), f64(1.0))
            slope = force_slope(spr, law_value, f64(1.0) / dq_dv[world], y, by, world, item, scr)
            work = slope * wp.ddot(c.derivatives(kind, V, y).g, k.vectors(spr, w, world, item))
            anchor_bar[world, item] = anchor_bar[world, item] - work
            if wp.isnan(anchor[world, item]):
                before = spr.reference[item] + k.vectors(spr, u_n, world, item)
                out[world, item] = anchor_bar[world, item] * c.derivatives(kind, before, y0).g

    @masked_kernel(module, "active")
    def sum_entries(
        topo: Topology, spr: Springs, offset: int, of_item: mat33d_2d, kind: int, active: int_1d, out: p.vec3_2d
    ):
        """Vectors of the items with their weights at a slot; `kind`: 1: of a VECTOR, 0: of the others, -1: of all."""
        world, slot = wp.tid()
        total = vec3d()
        for n in range(topo.pool_start[slot], topo.pool_start[slot + 1]):
            entry = topo.pool_entry[n] - offset
            if entry >= 0 and entry < spr.entry_slot.shape[0]:
                item = spr.entry_item[entry]
                if kind < 0 or wp.where(spr.kind[item] == VECTOR, 1, 0) == kind:
                    total += spr.entry_weight[entry] * of_item[world, item]
        out[world, slot] = p.vec3(total)

    @masked_kernel(module, "active")
    def parameter_force(
        spr: Springs, u: p.vec3_2d, start: p.vec3_2d, law_value: vec3d_2d, dq_dv: double_1d, parameter: double_2d,
        chosen: Parameter, factor: f64, active: int_1d, scr: Scratch, out: mat33d_2d,
    ):  # fmt: skip
        """out += factor times df/dparameter of the items of a spring; of an infinite one 0."""
        world = wp.tid()
        value = parameter[world, chosen.column]
        if chosen.law >= 0:
            value = law_value[world, chosen.law][0]
        if not wp.isfinite(value):
            return
        stiffness = f64(spr.stiffness[world, chosen.column])  # a value: unpacked it would be read anew
        inverse = chosen.in_motion / dq_dv[world]
        step = f64(STEP) * wp.max(wp.abs(value), f64(1.0))
        scale = factor / ((value + step) - (value - step))
        for item in range(chosen.first, chosen.last):
            kind, along, force = spr.kind[item], f64(0.0), mat33d()
            V = spr.reference[item] + k.vectors(spr, u, world, item)
            y = f64(0.0)
            if kind != VECTOR and kind != CHORD:
                y = c.coordinate(kind, V, scr.start[world, item])
            for side in range(3):
                shifted = value + step * f64(wp.where(side == 2, 0, 1 - 2 * side))
                if chosen.law >= 0:
                    law_value[world, chosen.law] = vec3d(shifted, f64(0.0), f64(0.0))
                else:
                    parameter[world, chosen.column] = shifted
                    if chosen.stiffness != f64(0.0):
                        spr.stiffness[world, chosen.column] = stiffness + chosen.stiffness * (shifted - value)
                if side < 2:
                    sign = f64(1 - 2 * side)
                    if kind == VECTOR or kind == CHORD:
                        k.evaluate_vector(spr, u, start, inverse, world, item, scr)
                        force += sign * scr.force[world, item]
                    else:
                        more_along = k.force_along(spr, law_value, chosen.in_motion, inverse, V, y, world, item, scr)
                        along += sign * more_along[0]
            if kind != VECTOR and kind != CHORD:
                force = along * c.derivatives(kind, V, y).g
            out[world, item] = out[world, item] + scale * force

    return kernel_set(locals())
