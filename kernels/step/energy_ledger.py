"""Energy ledger of a step: stored energy, losses, and work of loads, supports and fields."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_set, masked_kernel
from ..common.structs import balance_struct, mass_functions, topology_struct
from ..common.types import double_2d, f64, precision
from ..solvers.newton_control import control_struct
from .step_control import GROWTH_COLUMNS, step_struct

__all__ = [
    "EXPLICIT_VISCOUS",
    "LEDGER_COLUMNS",
    "LEDGER_TERM_ROWS",
    "LOSS",
    "NUMERICAL",
    "STORED",
    "WORK",
    "ledger_kernels",
    "term_energies_struct",
]

LEDGER_COLUMNS = (
    "kinetic",
    "strain",
    "potential",
    "work_loads",
    "work_supports",
    "work_fields",
    "viscous",
    "integrator",
    "ledger_residual",
    "unbalanced",
)
"""Columns of the energy ledger, J, accumulated since the start (the first three: current values); terms add theirs."""

STORED, WORK, LOSS, NUMERICAL, EXPLICIT_VISCOUS = range(5)
"""Kinds of energy increments of a term per substep: stored energy (current value); work on the model; loss; integrator
part; viscous loss of a force among the dead loads."""

LEDGER_TERM_ROWS = 10
GROWTH_SHARE, GROWTH_LARGEST, GROWTH_TURNOVER, GROWTH_ADDED, GROWTH_SINCE, GROWTH_STEPS, GROWTH_NEXT = range(
    len(GROWTH_COLUMNS)
)
"""Columns of GROWTH_COLUMNS."""
STARTUP_STEPS = 8.0
"""Initial substeps excluded from the energy monitor: relative to the small energy at the onset of a motion, no step
resolves it."""


@functools.cache
def term_energies_struct():
    """Energy increments of terms in a substep."""

    @wp.struct
    class TermEnergies:
        kind: wp.array(dtype=wp.int32)  # [row] STORED, WORK, ...
        nonpotential: wp.array(dtype=wp.int32)  # [row] 1: of a force whose work is counted as that of fields
        ledger_column: wp.array(dtype=wp.int32)  # [row] of the ledger, -1: none
        sums: wp.array2d(dtype=wp.float64)  # [row, world] J

    return TermEnergies


@functools.cache
def ledger_kernels(dtype: str, chord: bool, nonpotential: bool, module: wp.Module) -> KernelSet:
    """Kernels of the energy ledger, in the module of the step's; arguments as those of `step_kernels`.

    `chord`: the inertia's part of the integrator work is its work along the chord less the change of kinetic energy.
    """
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    mass_times = mass_functions(dtype).mass_times
    Step = step_struct()
    Newton = control_struct()
    Topology, Balance = topology_struct(dtype), balance_struct(dtype)
    TermEnergies = term_energies_struct()

    @wp.func
    def track_energy_growth(step: Step, world: int, before: f64, energy: f64, turnover: f64, added: f64):
        """Net energy added by the integrator and by residuals, over the peak energy plus the sum of |work|.

        Net, since second-order schemes exchange energy with the motion periodically; excluding the first steps from
        rest and those after work that exceeds all energy so far.
        """
        largest = wp.max(wp.max(step.energy_growth[world, GROWTH_LARGEST], step.min_energy[world]), before)
        turned = step.energy_growth[world, GROWTH_TURNOVER] + turnover
        steps = step.energy_growth[world, GROWTH_STEPS] + f64(1.0)
        if step.energy_growth[world, GROWTH_LARGEST] == f64(0.0) and before > f64(0.5) * energy:  # already in motion
            steps = f64(STARTUP_STEPS) + f64(1.0)
            step.energy_growth[world, GROWTH_NEXT] = before
        if turned > step.energy_growth[world, GROWTH_NEXT]:
            steps = f64(1.0)
            step.energy_growth[world, GROWTH_NEXT] = f64(2.0) * turned + largest
        largest = wp.max(largest, energy)
        total = step.energy_growth[world, GROWTH_ADDED]
        if steps > f64(STARTUP_STEPS):
            total += added
        share = total / (largest + turned)
        step.energy_growth[world, GROWTH_SHARE] = share
        step.energy_growth[world, GROWTH_LARGEST] = largest
        step.energy_growth[world, GROWTH_TURNOVER] = turned
        step.energy_growth[world, GROWTH_ADDED] = total
        step.energy_growth[world, GROWTH_STEPS] = steps
        if share > step.growth_warn_limit and step.energy_growth[world, GROWTH_SINCE] == f64(0.0):
            step.energy_growth[world, GROWTH_SINCE] = step.time[world]

    @masked_kernel(module, "step.accepted")
    def ledger_terms(step: Step, topo: Topology, balance: Balance, lumped: p.scalar_2d, u_n: p.vec3_2d, v_n: p.vec3_2d):
        """Per slot: integrator's inertia part, f_int.dq, loads.dq, gravity.dq, supports.dq, kinetic, free g.dq,
        nonpotential.dq, inertia.dq, gravity.u."""
        world, slot = wp.tid()
        Mv = mass_times(topo, balance.v, world, slot)
        dq = balance.u[world, slot] - u_n[world, slot]
        a = balance.inertia[world, slot]
        dv = balance.v[world, slot] - v_n[world, slot]
        f = topo.free[slot]
        held = vec3(T(1.0) - f[0], T(1.0) - f[1], T(1.0) - f[2])
        weight = lumped[world % lumped.shape[0], slot] * vec3(step.gravity[world])
        loads = balance.dead[world, slot]
        balance.rows[0, world, slot] = f64(0.5) * step.dq_dv[world] * f64(wp.dot(dv, a))
        balance.rows[1, world, slot] = f64(wp.dot(balance.internal[world, slot], dq))
        balance.rows[2, world, slot] = f64(wp.dot(loads, dq))
        balance.rows[3, world, slot] = f64(wp.dot(weight, dq))
        balance.rows[4, world, slot] = f64(wp.dot(wp.cw_mul(balance.g[world, slot], held), dq))
        balance.rows[5, world, slot] = f64(0.5) * f64(wp.dot(balance.v[world, slot], Mv))
        balance.rows[6, world, slot] = f64(wp.dot(wp.cw_mul(balance.g[world, slot], f), dq))
        balance.rows[7, world, slot] = f64(0.0)
        if wp.static(nonpotential):
            balance.rows[7, world, slot] = f64(wp.dot(balance.nonpotential[world, slot], dq))
        balance.rows[8, world, slot] = f64(wp.dot(a, dq))
        balance.rows[9, world, slot] = f64(wp.dot(weight, balance.u[world, slot]))

    @masked_kernel(module, "step.accepted")
    def update_ledger(step: Step, newton: Newton, sums: double_2d, energies: TermEnergies, ledger: double_2d):
        """Add a substep to the ledger; the integrator part by its own formula, never as the remainder.

        The force of a term does the work f.dq on a substep. Its stored energy and loss have columns; the remainder is
        the integrator's, or for a non-conservative force the work of fields.
        """
        world = wp.tid()
        kinetic = sums[5, world]
        strain = newton.elem_sums[0, world]
        change_K = kinetic - ledger[world, 0]
        change_W = strain - ledger[world, 1]
        implicit = f64(2.0) * newton.elem_sums[1, world] * (step.h[world] / step.dq_dv[world])
        held = f64(0.0)
        for k in range(energies.kind.shape[0]):
            if energies.kind[k] == EXPLICIT_VISCOUS:
                held += energies.sums[k, world]
        viscous = implicit + held
        loads = sums[2, world] + held - sums[3, world]
        numerical = sums[1, world] - change_W - implicit
        if wp.static(chord):
            numerical += sums[8, world] - change_K
        else:
            numerical += sums[0, world]
        work, turnover = f64(0.0), f64(0.0)
        fields = sums[7, world]
        stored, lost = f64(0.0), f64(0.0)
        energy = kinetic + strain
        for k in range(energies.kind.shape[0]):
            amount = energies.sums[k, world]
            column = energies.ledger_column[k]
            if energies.kind[k] == STORED:
                change = amount - ledger[world, column]
                stored += change
                energy += wp.abs(amount)  # of a spring given as a function it may be negative
                if energies.nonpotential[k] != 0:
                    fields += change
                else:
                    numerical -= change
                ledger[world, column] = amount
            elif energies.kind[k] == WORK:
                work += amount
                turnover += wp.abs(amount)
                if energies.nonpotential[k] != 0:
                    fields -= amount
                ledger[world, column] = ledger[world, column] + amount
            elif energies.kind[k] == LOSS:
                lost += amount
                if energies.nonpotential[k] != 0:
                    fields += amount
                else:
                    numerical -= amount
                ledger[world, column] = ledger[world, column] + amount
            elif energies.kind[k] == NUMERICAL:
                numerical += amount
        step.ledger_time[world] = step.time[world]
        ledger[world, 0] = kinetic
        ledger[world, 1] = strain
        ledger[world, 2] = -sums[9, world]
        ledger[world, 3] = ledger[world, 3] + loads
        ledger[world, 4] = ledger[world, 4] + sums[4, world]
        ledger[world, 5] = ledger[world, 5] + fields
        ledger[world, 6] = ledger[world, 6] + viscous
        ledger[world, 7] = ledger[world, 7] + numerical
        balance = change_K + change_W - sums[3, world] + viscous + numerical + stored + lost
        balance -= loads + sums[4, world] + fields + work
        ledger[world, 8] = ledger[world, 8] + balance
        ledger[world, 9] = ledger[world, 9] + sums[6, world]
        if step.growth_monitored != 0:
            turnover += wp.abs(loads) + wp.abs(sums[4, world]) + wp.abs(fields) + wp.abs(viscous)
            # stiff damping: an excess of `viscous` cancels a deficit of `numerical`; `balance`: work of residuals
            added = step.residual_work_counted * balance - (numerical + viscous)
            track_energy_growth(step, world, energy - (change_K + change_W + stored), energy, turnover, added)

    return kernel_set(locals())
