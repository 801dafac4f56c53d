"""Adjoint of a step of any scheme: the right side of its solve, and the bars of its start.

A bar of a quantity is the derivative of the loss by it, w the multiplier of g = 0, mu/d that of c = 0, d = dq/dv. With
H = m M + d K, q_{n+1} = q~ + d v, a_{n+1} = a_v (v - v_n) - a_a a_n and w_{n+1} = m (v - v~) the system is

    H^T w + J^T mu = V + d q_bar,    V = v_bar + a_v a_bar + m w_bar,    J w = 0,

and q~_bar = q_bar - K^T w - J^T mu/d = (m M w - V + r)/d by its residual r: no difference of nearly equal numbers where
the stiffness dominates. On prescribed components r/d is the bar of their position instead: that of a drive, or q_n.
"""

import functools
from typing import Any

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import IMPACT_REPEATED, mass_functions, topology_struct
from ..common.types import double_1d, f64, int_1d, precision
from .step_control import Coefficients, step_struct

__all__ = ["step_adjoint_kernels"]


@functools.cache
def step_adjoint_kernels(dtype: str, scheme: Any, impacts: bool = False) -> KernelSet:
    """Kernels in one precision for a scheme, as of `step_kernels`.

    `impacts`: a step may have been taken again with backward Euler, which changes v_{n-1}, see `accept_state`.
    Bars `q_before`, `v_before` are those of q_{n-1} and v_{n-1} of multistep schemes, of a_n and w_n of schemes with
    accelerations, else those of q_n and v_n, unused.
    """
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    Step, Topology = step_struct(), topology_struct(dtype)
    mass_times = mass_functions(dtype).mass_times
    multistep, takes_velocity, accelerated = scheme.multistep, scheme.takes_velocity, scheme.accelerated
    coefficients = scheme.coefficients
    impacts = impacts and multistep
    module = kernel_module(f"step_adjoint_{dtype}_{scheme.kernel_variant}{'_impacts' * impacts}")

    @wp.func
    def step_coefficients(step: Step, world: int) -> Coefficients:
        """Coefficients of the step."""
        c = Coefficients()
        if wp.static(accelerated):
            c = coefficients(step.h[world], step.acceleration_step[world], step.scheme_parameter)
            c.q_a = step.q_a[world]
        else:
            c.a0 = step.a0[world]
            c.a1 = step.a1[world]
        if wp.static(takes_velocity):
            c.b = step.b[world]
        c.dq_dv = step.dq_dv[world]
        c.mass_factor = step.mass_factor[world]
        return c

    @wp.func
    def stops(step: Step, world: int) -> bool:
        """True for a step that was taken again with backward Euler."""
        if wp.static(impacts):
            return step.impact[world] == IMPACT_REPEATED
        return False

    @wp.func
    def velocity_bar(
        step: Step, c: Coefficients, v_bar: p.vec3_2d, q_before: p.vec3_2d, v_before: p.vec3_2d, world: int, slot: int
    ) -> vec3:
        """V."""
        V = v_bar[world, slot]
        if wp.static(accelerated):
            V += T(c.a_v) * q_before[world, slot] + T(c.mass_factor) * v_before[world, slot]
        if stops(step, world):
            V += v_before[world, slot]
        return V

    @wp.func
    def add_predictor_bar(
        c: Coefficients, x: vec3, q_bar: p.vec3_2d, v_bar: p.vec3_2d, q_before: p.vec3_2d, v_before: p.vec3_2d,
        world: int, slot: int,
    ):  # fmt: skip
        """Add a bar of q~ to those of the state at the start."""
        q_bar[world, slot] = q_bar[world, slot] + T(c.a0) * x
        if wp.static(takes_velocity):
            v_bar[world, slot] = v_bar[world, slot] + T(c.b) * x
        if wp.static(multistep):
            q_before[world, slot] = q_before[world, slot] - T(c.a1) * x
        if wp.static(accelerated):
            q_before[world, slot] = q_before[world, slot] + T(c.q_a) * x

    @masked_kernel(module, "active")
    def right_side(
        step: Step, q_bar: p.vec3_2d, v_bar: p.vec3_2d, q_before: p.vec3_2d, v_before: p.vec3_2d, active: int_1d,
        out: p.vec3_2d, w: p.vec3_2d,
    ):  # fmt: skip
        """V + d q_bar; w = 0."""
        world, slot = wp.tid()
        c = step_coefficients(step, world)
        V = velocity_bar(step, c, v_bar, q_before, v_before, world, slot)
        out[world, slot] = V + T(c.dq_dv) * q_bar[world, slot]
        w[world, slot] = vec3()

    @masked_kernel(module, "active")
    def step_back(
        step: Step, topo: Topology, driven: p.vec3_1d, w: p.vec3_2d, gradient: p.vec3_2d, active: int_1d,
        q_bar: p.vec3_2d, v_bar: p.vec3_2d, q_before: p.vec3_2d, v_before: p.vec3_2d, drive_bar: p.vec3_2d,
    ):  # fmt: skip
        """Bars at the start of the step, and those of driven positions."""
        world, slot = wp.tid()
        c = step_coefficients(step, world)
        scale = T(1.0) / T(c.dq_dv)
        momentum = T(c.mass_factor) * mass_times(topo, w, world, slot)
        V = velocity_bar(step, c, v_bar, q_before, v_before, world, slot)
        r = -gradient[world, slot]
        reaction = r - wp.cw_mul(topo.free[slot], r)
        drive = wp.cw_mul(driven[slot], r)
        v_tilde = momentum
        q_start = scale * (reaction - drive)
        v_start = vec3()
        if wp.static(multistep):
            previous_velocity_bar = v_before[world, slot]
            q_start += q_before[world, slot]
            q_before[world, slot] = vec3()
            v_before[world, slot] = -T(c.a1) * v_tilde
            if stops(step, world):
                previous = step.acceleration_step[world]
                ratio = wp.where(previous > f64(0.0), step.h[world] / wp.max(previous, f64(1.0e-300)), f64(0.0))
                previous_velocity_bar = T(-ratio) * previous_velocity_bar
                v_before[world, slot] = v_before[world, slot] - previous_velocity_bar
            v_start += previous_velocity_bar
        if wp.static(accelerated):
            a_bar = q_before[world, slot]
            v_tilde -= T(c.mass_factor) * v_before[world, slot]
            v_start -= T(c.a_v) * a_bar
            q_before[world, slot] = T(c.v_a) * v_tilde - T(c.a_a) * a_bar
            v_before[world, slot] = T(c.v_w) * v_tilde
        q_bar[world, slot] = q_start
        v_bar[world, slot] = v_start + T(c.a0) * v_tilde
        x = scale * (momentum - V + r - reaction)
        add_predictor_bar(c, x, q_bar, v_bar, q_before, v_before, world, slot)
        drive_bar[world, slot] = scale * drive

    @masked_kernel(module, "active")
    def add_predictor(
        step: Step, x: p.vec3_2d, active: int_1d, q_bar: p.vec3_2d, v_bar: p.vec3_2d, q_before: p.vec3_2d,
        v_before: p.vec3_2d,
    ):  # fmt: skip
        """Add bars x of q~ to those of the state at the start."""
        world, slot = wp.tid()
        c = step_coefficients(step, world)
        add_predictor_bar(c, x[world, slot], q_bar, v_bar, q_before, v_before, world, slot)

    # forward: changes of the state along a direction

    @masked_kernel(module, "active")
    def predict_change(
        step: Step, q: p.vec3_2d, v: p.vec3_2d, q_before: p.vec3_2d, v_before: p.vec3_2d, active: int_1d,
        q_tilde: p.vec3_2d, v_tilde: p.vec3_2d, x: p.vec3_2d,
    ):  # fmt: skip
        """Changes of q~ and v~, and x = dq~/d + dv~."""
        world, slot = wp.tid()
        c = step_coefficients(step, world)
        dq = T(c.a0) * q[world, slot]
        dv = vec3()
        if wp.static(not scheme.static):
            dv = T(c.a0) * v[world, slot]
        if wp.static(takes_velocity):
            dq += T(c.b) * v[world, slot]
        if wp.static(multistep):
            dq -= T(c.a1) * q_before[world, slot]
            dv -= T(c.a1) * v_before[world, slot]
        if wp.static(accelerated):
            dq += T(c.q_a) * q_before[world, slot]
            dv += T(c.v_a) * q_before[world, slot] + T(c.v_w) * v_before[world, slot]
        q_tilde[world, slot] = dq
        v_tilde[world, slot] = dv
        x[world, slot] = (T(1.0) / T(c.dq_dv)) * dq + dv

    @masked_kernel(module, "active")
    def prescribe_change(
        step: Step, driven: p.vec3_1d, free: p.vec3_1d, q: p.vec3_2d, drive: p.vec3_2d, active: int_1d, w: p.vec3_2d
    ):
        """w = (change of the position)/d of prescribed components, 0 of others."""
        world, slot = wp.tid()
        scale = T(1.0) / T(step_coefficients(step, world).dq_dv)
        prescribed_change = q[world, slot] - wp.cw_mul(free[slot] + driven[slot], q[world, slot])
        w[world, slot] = scale * (prescribed_change + wp.cw_mul(driven[slot], drive[world, slot]))

    @masked_kernel(module, "active")
    def change_side(step: Step, topo: Topology, x: p.vec3_2d, force: p.vec3_2d, active: int_1d, out: p.vec3_2d):
        """m M x + force: the right side of H w + J^T mu."""
        world, slot = wp.tid()
        out[world, slot] = T(step.mass_factor[world]) * mass_times(topo, x, world, slot) + force[world, slot]

    @masked_kernel(module, "active")
    def change_state(
        step: Step, w: p.vec3_2d, q_tilde: p.vec3_2d, v_tilde: p.vec3_2d, active: int_1d, q: p.vec3_2d, v: p.vec3_2d,
        q_before: p.vec3_2d, v_before: p.vec3_2d,
    ):  # fmt: skip
        """Changes of the state at the end from w = (change of the position)/d and those at the start."""
        world, slot = wp.tid()
        c = step_coefficients(step, world)
        dv = w[world, slot] - (T(1.0) / T(c.dq_dv)) * q_tilde[world, slot]
        if wp.static(multistep):
            q_before[world, slot] = q[world, slot]
            v_before[world, slot] = v[world, slot]
        if wp.static(accelerated):
            q_before[world, slot] = T(c.a_v) * (dv - v[world, slot]) - T(c.a_a) * q_before[world, slot]
            v_before[world, slot] = T(c.mass_factor) * (dv - v_tilde[world, slot])
        q[world, slot] = T(c.dq_dv) * w[world, slot]
        v[world, slot] = dv

    @masked_kernel(module, "active")
    def history_field(
        step: Step, part: int, q: p.vec3_2d, v: p.vec3_2d, before: p.vec3_2d, active: int_1d, x: p.vec3_2d,
        scale: double_1d,
    ):  # fmt: skip
        """x and scale: sym((scale I + grad x)^T grad dy) is the change of the past strain in strain rates by dy, of y =
        q_n (part 0), v_n (1), or a_n or q_{n-1} (2)."""
        world, slot = wp.tid()
        c = step_coefficients(step, world)
        own = c.a0
        y = T(c.a0) * q[world, slot]
        if wp.static(accelerated):
            a, b = T(c.q_a), T(c.b)
            y = q[world, slot] + b * v[world, slot] + a * before[world, slot]
            if part == 1:
                own = c.b
                y = b * q[world, slot] + (T(2.0) * a) * v[world, slot]
            elif part == 2:
                own = c.q_a
                y = a * q[world, slot]
        elif wp.static(multistep):
            if part == 2:
                own = -c.a1
                y = -T(c.a1) * before[world, slot]
        x[world, slot] = y
        scale[world] = own

    return kernel_set(locals())
