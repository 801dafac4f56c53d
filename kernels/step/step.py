"""Step control: time levels, predictor, acceptance, energy ledger, report.

A step of dt, or of the remainder to the end, consists of substeps of dt / 2^level. A refused substep raises the level
by one; after an accepted one the level decreases as soon as the position is even, so that time stays an exact binary
fraction of dt.
"""

import functools
from typing import Any

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import IMPACT_FOUND, IMPACT_IGNORED, IMPACT_REPEATED, RESTART_REPEATED, free_components_function
from ..common.traits import NO_TERMS, Traits
from ..common.types import double_2d, f64, int_1d, precision
from ..solvers.newton_control import Failure, control_struct
from ..solvers.pcg import pcg_struct
from .energy_ledger import GROWTH_SHARE, ledger_kernels
from .step_control import STATUS, Coefficients, step_end_functions, step_struct

__all__ = ["step_kernels"]

FULL_LOAD_TOLERANCE = 1e-9
"""Tolerance of the load factor at full load."""
MAX_STEP_GROWTH = {"float64": 1e9, "float32": 1e4}
"""Largest step ratio for which a multistep scheme uses the previous step: beyond, its differences are round-off."""


@functools.cache
def step_kernels(dtype: str, scheme: Any, traits: Traits = NO_TERMS) -> KernelSet:
    """Kernels of the step loop.

    Args:
        dtype: precision of the vectors.
        scheme: the time discretisation, with `coefficients`, a wp.func (h, previous h, parameter) -> Coefficients, and
            the specialisation of its kernels: static (no inertia, v is the displacement increment), multistep (uses the
            state before the last), takes_velocity (v_n in q~), accelerated (with accelerations: a_n and w_n replace the
            state before the last), midpoint (forces at the midpoint), variant (their name).
        traits: of the model; depends on "nonpotential", "has_constraints" and "impacts".
    """
    p, free_components = precision(dtype), free_components_function(dtype)
    T, vec3 = p.T, p.vec3
    Step, limits = step_struct(), step_end_functions()
    Newton = control_struct()
    PCG = pcg_struct()
    coefficients, static, multistep = scheme.coefficients, scheme.static, scheme.multistep
    takes_velocity, accelerated, midpoint = scheme.takes_velocity, scheme.accelerated, scheme.midpoint
    MAX_GROWTH = MAX_STEP_GROWTH[dtype]
    impacts = traits.takes_again(scheme)
    variant = traits.suffix("nonpotential", "has_constraints", *(("impacts",) if impacts else ()))
    module = kernel_module(f"step_{dtype}_{scheme.kernel_variant}{variant}")

    @wp.func
    def attempt_coefficients(step: Step, world: int, previous: f64) -> Coefficients:
        """Coefficients of an attempt; those of backward Euler where an impact is not resolved."""
        c = Coefficients()
        c.a0 = f64(1.0)
        c.dq_dv = step.h[world]
        c.mass_factor = f64(1.0) / step.h[world]
        if wp.static(impacts):
            if step.impact[world] >= RESTART_REPEATED:
                return c
        return coefficients(step.h[world], previous, step.scheme_parameter)

    @wp.kernel(module=module)
    def begin_step(step: Step, newton: Newton, pcg: PCG):
        """Start a step in the running worlds before their end; refuse it after spurious energy growth."""
        world = wp.tid()
        time = step.time[world]
        alive = wp.where(step.status[world] == wp.static(STATUS["running"]), 1, 0)
        if time >= limits.end_time(step, world) - limits.time_tolerance(step, world):
            alive = 0
        if alive != 0 and step.growth_monitored != 0 and step.energy_growth[world, GROWTH_SHARE] > step.growth_limit:
            alive = 0
            step.status[world] = wp.static(STATUS["failed"])
            newton.failed[world] = Failure.ENERGY_GROWTH
        step.running[world] = alive
        step.rejected[world] = 0
        newton.step_iterations[world] = 0
        newton.floor.accepted_unconverged[world] = 0
        newton.floor.step_error[world] = f64(0.0)
        newton.strain_energy_start[world] = newton.strain_energy[world]
        if wp.static(traits.has_constraints):
            newton.multiplier_updates[world] = 0
        pcg.step_iterations[world] = 0
        step.halvings[world] = 0
        if alive == 0:
            return
        wp.atomic_max(step.any_running, 0, 1)
        step.halving_level[world] = 0
        step.substep_index[world] = 0
        step.step_start_time[world] = time
        if wp.abs(step.summed_time[world] - time) <= limits.time_tolerance(step, world):
            step.step_start_time[world] = step.summed_time[world]
        step.step_min_J[world] = f64(1.0e30)
        if wp.static(impacts):
            step.impact[world] = 0

    @wp.kernel(module=module)
    def begin_attempt(step: Step, newton: Newton):
        """Time levels and coefficients of the next substep."""
        world = wp.tid()
        if world == 0:
            step.any_running[0] = 0
            step.any_rejected[0] = 0
        if wp.static(impacts):
            # worlds that wait for others keep theirs, which says how their step was taken
            if step.running[world] != 0 and (step.accepted[world] != 0 or step.rejected[world] != 0):
                step.impact[world] = 0
        step.accepted[world] = 0
        step.first_rejection[world] = 0
        newton.active[world] = step.running[world]
        newton.search.active[world] = 0
        newton.floor.error[world] = f64(0.0)
        newton.inversion_suspected[world] = 0
        newton.inverted[world] = 0
        if step.running[world] == 0:
            return  # `rejected` stays set in a world that failed earlier in this step
        step.rejected[world] = 0
        newton.failed[world] = 0
        newton.iterations[world] = 0
        parts = f64(wp.lshift(1, step.halving_level[world]))
        span = limits.step_length(step, world)
        h = span / parts
        step.h[world] = h
        step.new_time[world] = step.step_start_time[world] + span * (f64(step.substep_index[world] + 1) / parts)
        if wp.static(midpoint):
            step.stage_time[world] = step.new_time[world] - f64(0.5) * h
            step.rate_time[world] = f64(0.5) * h
        previous = f64(0.0)
        if wp.static(multistep):
            # a state that was set, reset or advanced by another scheme has no history
            known = step.previous_end_time[world] == step.time[world]
            if known and h <= f64(MAX_GROWTH) * step.previous_h[world]:
                previous = step.previous_h[world]
        if wp.static(accelerated):
            previous = step.previous_h[world]
        if wp.static(accelerated or impacts):
            step.acceleration_step[world] = previous
        c = attempt_coefficients(step, world, previous)
        step.a0[world] = c.a0
        step.a1[world] = c.a1
        if wp.static(takes_velocity):
            step.b[world] = c.b
        if wp.static(accelerated):
            step.q_a[world] = c.q_a
        if wp.static(static):
            step.dq_dv[world] = f64(1.0)
            step.load_factor[world] = step.new_time[world]
            short = f64(1.0) - step.new_time[world]
            step.mass_factor[world] = wp.where(short > f64(FULL_LOAD_TOLERANCE), step.stabilisation * short, f64(0.0))
        else:
            step.dq_dv[world] = c.dq_dv
            step.mass_factor[world] = c.mass_factor
            step.load_factor[world] = f64(1.0)

    @wp.func
    def falling_velocity(step: Step, world: int, is_position: T, v_tilde: vec3, v_n: vec3) -> vec3:
        """v~ + (dq/dv) g, with accelerations v_n + h g; gravity acts on position slots."""
        if wp.static(accelerated):
            return v_n + (T(step.h[world]) * is_position) * vec3(step.gravity[world])
        else:
            fall = T(step.dq_dv[world])
            if wp.static(midpoint):
                fall = T(f64(1.0) / step.mass_factor[world])
            return v_tilde + (fall * is_position) * vec3(step.gravity[world])

    @masked_kernel(module, "step.running")
    def predict(
        step: Step, is_position: p.scalar_1d, free: p.vec3_1d, u_n: p.vec3_2d, v_n: p.vec3_2d, u_before: p.vec3_2d,
        v_before: p.vec3_2d, q_tilde: p.vec3_2d, v_tilde: p.vec3_2d, u: p.vec3_2d, v: p.vec3_2d,
    ):  # fmt: skip
        """q~, v~ and the first iterate; prescribed components keep their positions.

        The iterate is v~ + (dq/dv) g, or v_n + (h/h_{n-1}) (v_n - v_{n-1}) if the previous step is known: its error is
        then of second order in h, as stiff rotating bodies require. With accelerations it is v_n + h g.
        """
        world, slot = wp.tid()
        q = u_n[world, slot]
        w = v_n[world, slot]
        if wp.static(static):
            w = vec3()
        if wp.static(multistep):
            a0 = T(step.a0[world])
            a1 = T(step.a1[world])
            q = a0 * q - a1 * u_before[world, slot]
            w = a0 * w - a1 * v_before[world, slot]
        if wp.static(takes_velocity):
            q += T(step.b[world]) * v_n[world, slot]
        if wp.static(accelerated):
            c = attempt_coefficients(step, world, step.acceleration_step[world])
            a = u_before[world, slot]
            q += T(c.q_a) * a
            w += T(c.v_a) * a + T(c.v_w) * v_before[world, slot]
        q_tilde[world, slot] = q
        v_tilde[world, slot] = w
        first = vec3()
        if wp.static(not static):
            first = falling_velocity(step, world, is_position[slot], w, v_n[world, slot])
            if wp.static(multistep):
                if step.a1[world] > f64(0.0):  # linear extrapolation: also exact for a constant acceleration
                    ratio = T(step.h[world] / step.previous_h[world])
                    first = v_n[world, slot] + ratio * (v_n[world, slot] - v_before[world, slot])
        if wp.static(impacts):
            if step.impact[world] >= RESTART_REPEATED:  # where the attempt before has found the bodies
                first = (T(1.0) / T(step.dq_dv[world])) * (u[world, slot] - q)
        keep = (T(1.0) / T(step.dq_dv[world])) * (u_n[world, slot] - q)
        v[world, slot] = free_components(free[slot], first, keep)

    @masked_kernel(module, "newton.start.has_alternatives")
    def alternative_first_iterate(
        step: Step, newton: Newton, kind: int, is_position: p.scalar_1d, free: p.vec3_1d, u_n: p.vec3_2d,
        v_n: p.vec3_2d, q_tilde: p.vec3_2d, v_tilde: p.vec3_2d, v: p.vec3_2d,
    ):  # fmt: skip
        """Alternative first iterate on the free components: 0: v~ + (dq/dv) g, 1: v_n, 2: the one with q = q_n."""
        world, slot = wp.tid()
        new = v_n[world, slot]
        if kind == 0:
            new = falling_velocity(step, world, is_position[slot], v_tilde[world, slot], new)
        elif kind == 2:
            new = (T(1.0) / T(step.dq_dv[world])) * (u_n[world, slot] - q_tilde[world, slot])
        v[world, slot] = free_components(free[slot], new, v[world, slot])

    @wp.func
    def is_taken_again(step: Step, newton: Newton, world: int) -> bool:
        """True if an impact was found, or backward Euler failed for it; sets how the attempt is taken next."""
        impact = step.impact[world]
        if impact > 0 and impact <= IMPACT_FOUND and newton.failed[world] == 0 and newton.inverted[world] == 0:
            step.impact[world] = impact + (IMPACT_REPEATED - IMPACT_FOUND)
            return True
        if wp.static(midpoint):
            if impact == IMPACT_REPEATED and newton.failed[world] != 0:
                step.impact[world] = IMPACT_IGNORED
                return True
        return False

    @masked_kernel(module, "step.running")
    def end_attempt(step: Step, newton: Newton):
        """Accept the substep, or refuse and halve it, or take it again with backward Euler.

        Multistep schemes and averages of accelerations keep part of the force of an impact for the next steps, and
        throw a body back that the step has stopped, with more momentum than the forces of the report give it. A
        mid-point scheme takes its own attempt where that with backward Euler fails.
        """
        world = wp.tid()
        if wp.static(impacts):
            if is_taken_again(step, newton, world):
                wp.atomic_max(step.any_running, 0, 1)
                return
        if newton.inverted[world] != 0 and newton.failed[world] == 0:
            newton.failed[world] = Failure.ELEMENT_INVERTED
        if newton.failed[world] == 0:
            step.accepted[world] = 1
            step.step_min_J[world] = wp.min(step.step_min_J[world], newton.min_J[world])
            newton.floor.step_error[world] = wp.max(newton.floor.step_error[world], newton.floor.error[world])
            part = step.substep_index[world] + 1
            level = step.halving_level[world]
            while level > 0 and part % 2 == 0:
                part = part / 2
                level = level - 1
            step.substep_index[world] = part
            step.halving_level[world] = level
            step.time[world] = step.new_time[world]
            if level == 0:
                step.running[world] = 0
                step.summed_time[world] = step.new_time[world]
                if wp.abs(limits.end_time(step, world) - step.new_time[world]) <= limits.time_tolerance(step, world):
                    step.time[world] = limits.end_time(step, world)
            else:
                wp.atomic_max(step.any_running, 0, 1)
            return
        step.rejected[world] = 1
        if step.halvings[world] == 0:
            step.first_rejection[world] = 1
            wp.atomic_max(step.any_rejected, 0, 1)
        step.halvings[world] = step.halvings[world] + 1
        level = step.halving_level[world] + 1
        why = newton.failed[world]
        # a shorter step has no better round-off, and changes the motion
        hopeless = why == Failure.WORK or why == Failure.ROUNDOFF
        if step.newton_budget > 0 and newton.step_iterations[world] >= step.newton_budget:
            hopeless = True
        if hopeless or level > step.max_halvings:
            step.status[world] = wp.static(STATUS["failed"])
            step.running[world] = 0
            wp.atomic_max(step.any_rejected, 1, 1)
        else:
            step.halving_level[world] = level
            step.substep_index[world] = step.substep_index[world] * 2
            wp.atomic_max(step.any_running, 0, 1)

    @wp.kernel(module=module)
    def flag_failed_steps(step: Step, newton: Newton, flags: int_1d):
        """Flag the worlds whose step failed finally: its accepted substeps are rolled back."""
        world = wp.tid()
        flags[world] = 0
        if step.status[world] == wp.static(STATUS["failed"]) and step.rejected[world] == 1:
            flags[world] = 1
            newton.strain_energy[world] = newton.strain_energy_start[world]

    @masked_kernel(module, "step.accepted")
    def accept_state(
        step: Step, newton: Newton, u: p.vec3_2d, v: p.vec3_2d, u_n: p.vec3_2d, v_n: p.vec3_2d, u_before: p.vec3_2d,
        v_before: p.vec3_2d,
    ):  # fmt: skip
        """Store the accepted iterate in the state.

        After an impact what the scheme remembers of accelerations stays as before it, and total momentum that of the
        forces: accelerations, or the increment of the velocity in the step before. A restart leaves those of its step.
        """
        world, slot = wp.tid()
        impact = False
        if wp.static(impacts):
            impact = step.impact[world] == IMPACT_REPEATED
        if wp.static(multistep):
            u_before[world, slot] = u_n[world, slot]
            remembered = v_n[world, slot]
            if impact:
                gained = v_n[world, slot] - v_before[world, slot]
                previous = step.acceleration_step[world]  # 0: nothing is remembered
                ratio = wp.where(previous > f64(0.0), step.h[world] / wp.max(previous, f64(1.0e-300)), f64(0.0))
                remembered = v[world, slot] - T(ratio) * gained
            v_before[world, slot] = remembered
        if wp.static(accelerated) and not impact:
            c = attempt_coefficients(step, world, step.acceleration_step[world])
            a = u_before[world, slot]
            new = v[world, slot]
            before = v_n[world, slot] + T(c.v_a) * a + T(c.v_w) * v_before[world, slot]
            u_before[world, slot] = T(c.a_v) * (new - v_n[world, slot]) - T(c.a_a) * a
            v_before[world, slot] = T(c.mass_factor) * (new - before)
            if wp.static(impacts):
                if step.impact[world] == RESTART_REPEATED:
                    u_before[world, slot] = v_before[world, slot]
        u_n[world, slot] = u[world, slot]
        if slot == 0:
            if wp.static(multistep or accelerated):
                step.previous_h[world] = step.h[world]
                step.previous_end_time[world] = step.time[world]
            newton.strain_energy[world] = newton.elem_sums[0, world]
        if wp.static(not static):
            v_n[world, slot] = v[world, slot]

    @wp.kernel(module=module)
    def write_report(step: Step, newton: Newton, pcg: PCG, report: double_2d):
        """Report of a step, one array for the host; columns as `REPORT_COLUMNS`."""
        world = wp.tid()
        report[world, 0] = f64(step.status[world])
        report[world, 1] = f64(newton.step_iterations[world])
        report[world, 2] = f64(pcg.step_iterations[world])
        report[world, 3] = newton.norms.relative_residual[world]
        report[world, 4] = f64(step.halvings[world])
        report[world, 5] = step.step_min_J[world]
        report[world, 6] = step.time[world]
        report[world, 7] = f64(newton.failed[world])
        report[world, 8] = step.new_time[world]
        report[world, 9] = f64(0.0)
        report[world, 10] = f64(0.0)
        report[world, 11] = newton.norms.residual_force[world]
        report[world, 12] = f64(newton.floor.accepted_unconverged[world])
        report[world, 13] = newton.floor.step_error[world]
        report[world, 14] = f64(0.0)
        if step.growth_monitored != 0:
            report[world, 14] = step.energy_growth[world, GROWTH_SHARE]
        if wp.static(traits.has_constraints):
            report[world, 9] = newton.norms.violation[world, newton.norms.component_count]
            report[world, 10] = f64(newton.multiplier_updates[world])

    @wp.kernel(module=module)
    def probe_values(
        start: int_1d,
        slot: int_1d,
        weight: p.scalar_1d,
        u: p.vec3_2d,
        v: p.vec3_2d,
        first_column: int,
        report: double_2d,
    ):
        """Displacement and velocity of each probe, sum of s_i u_i, into the report."""
        world, probe = wp.tid()
        d = wp.vec3d()
        w = wp.vec3d()
        for k in range(start[probe], start[probe + 1]):
            s = f64(weight[k])
            d += s * wp.vec3d(u[world, slot[k]])
            w += s * wp.vec3d(v[world, slot[k]])
        for c in range(3):
            report[world, first_column + 6 * probe + c] = d[c]
            report[world, first_column + 6 * probe + 3 + c] = w[c]

    ledger = ledger_kernels(dtype, multistep or midpoint or accelerated, traits.nonpotential, module)
    return kernel_set(vars(ledger) | locals())
