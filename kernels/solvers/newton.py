"""Newton's method per world: convergence, forcing terms, line search, acceptance. One thread per world."""

import functools
import types as _types

import warp as wp

from ..common.traits import NO_TERMS, Traits
from ..common.types import kernel_module
from .control import (
    FAIL_CURVATURE,
    FAIL_FLOOR,
    FAIL_ITERATIONS,
    FAIL_JACOBIAN,
    FAIL_LIMIT,
    FAIL_NAN,
    FAIL_WORK,
    FLOOR_LANES,
    control_struct,
)
from .judging import COARSE, SWIFT, TRIES, judging_functions
from .outer import outer_kernels
from .pcg import pcg_struct
from .perturbation import SCATTER
from .searching import NOISE, TURN, search_kernels

__all__ = ["newton_kernels"]

ROUNDS = 3
"""Maximum linear solves of an attempt per allowed iteration: bounds solves without a step."""
RIGID = 64.0
"""Roundings of the displacements below which an error is negligible, whatever the reference energy."""
FAR_FORCING = 0.1  # of the first solve of a step that starts far from its end: a tighter solution is wasted
HOPELESS = 3.0
"""Strain energy increase of a first iterate, in kinetic energies, above which other first iterates are tried."""


@functools.cache
def newton_kernels(traits: Traits = NO_TERMS) -> _types.SimpleNamespace:
    """Kernels of the Newton iteration, of one thread per world; scalars are float64.

    They depend on the traits "stored", "gated", "limited", "walls" and "midpoint".
    """
    f64 = wp.float64
    Control = control_struct()
    PCG = pcg_struct()
    stored, gated, limited, walls = traits.stored, traits.gated, traits.limited, traits.walls
    midpoint = traits.midpoint
    judging = judging_functions(traits)
    objective, magnitude = judging.objective, judging.magnitude
    measure, settle, fail = judging.measure, judging.settle, judging.fail
    accept, give_up, record, patience = judging.accept, judging.give_up, judging.record, judging.patience
    module = kernel_module(f"newton{traits.suffix('stored', 'gated', 'limited', 'walls', 'midpoint')}", light=True)

    searching = search_kernels(traits, module)
    lost = searching.lost

    @wp.kernel(module=module)
    def reset_min_J(ctl: Control, active: wp.array(dtype=wp.int32)):
        """Reset the smallest J before an evaluation."""
        world = wp.tid()
        if active[world] != 0:
            ctl.min_J[world] = f64(1.0e30)
            ctl.domain_J[world] = f64(1.0e30)
            if wp.static(walls):
                ctl.touching[world] = 0

    @wp.func
    def start(ctl: Control, world: int):
        """Initialise the iteration at its first iterate, and test that for convergence."""
        measure(ctl, world)
        phi = objective(ctl, world) + ctl.slot_sums[7, world]
        ctl.phi[world] = phi
        ctl.phi_magnitude[world] = magnitude(ctl, world)
        ctl.forcing[world] = ctl.first_forcing
        ctl.reused[world] = 0
        ctl.leaps[world] = 0
        ctl.mixed[world] = 0
        ctl.tame[world] = 0
        ctl.mark[world] = 0
        ctl.restoring[world] = 0
        ctl.radius[world] = f64(TURN)
        ctl.strict[world] = 0
        ctl.strict_count[world] = 0
        ctl.negative[world] = 0
        ctl.unsolved[world] = 0
        ctl.bent[world] = 0
        ctl.rounds[world] = 0
        ctl.eta[world] = f64(1.0e30)
        ctl.slope[world] = f64(0.0)
        if wp.static(walls):
            ctl.refreshed[world] = 0
            ctl.new_walls[world] = 0
            ctl.excursions[world] = 0
        if ctl.domain_J[world] <= f64(0.0):
            give_up(ctl, world, FAIL_JACOBIAN)
        elif not (wp.isfinite(phi) and wp.isfinite(ctl.norm[world])):
            give_up(ctl, world, FAIL_NAN)
        elif wp.static(walls) and ctl.norm[world] > f64(0.0):
            record(ctl, world)  # frozen quantities are not those of this iterate: it cannot be accepted
        else:
            settle(ctl, world)

    @wp.func
    def hopeless(ctl: Control, world: int) -> bool:
        """True if other first iterates should be tried: Phi exceeds a bound of Phi at q_n, or J <= 0.

        At q_n Phi is the strain energy of the state plus a kinetic energy: row 10 of `residual` for backward Euler, a
        third of it for BDF2.
        """
        phi = objective(ctl, world)
        if wp.static(midpoint):
            return not (wp.isfinite(phi) and ctl.min_J[world] > f64(0.0))
        bound = ctl.potential[world] / ctl.dq_dv[world] + f64(HOPELESS) * ctl.slot_sums[10, world]
        bound += f64(NOISE) * ctl.eps * magnitude(ctl, world)
        return not (phi <= bound and wp.isfinite(phi) and ctl.min_J[world] > f64(0.0))

    @wp.kernel(module=module)
    def begin(ctl: Control, stage: int):
        """Start with the first iterate; `stage` 0: the only one. 1: others may be better. 2: it was chosen."""
        world = wp.tid()
        if stage != 2:
            ctl.choose[world] = 0
        if ctl.active[world] == 0 or (stage == 2 and ctl.choose[world] == 0):
            return
        if stage == 1:
            if hopeless(ctl, world):
                ctl.choose[world] = 1
                wp.atomic_max(ctl.any_hard, 0, 1)
                return
        start(ctl, world)
        if stage == 2 and ctl.fixed_forcing == 0:
            ctl.forcing[world] = f64(FAR_FORCING)

    @wp.kernel(module=module)
    def compare(ctl: Control, first: int, better: wp.array(dtype=wp.int32)):
        """Flag the worlds where the first iterate just evaluated is the best so far: J > 0 before Phi."""
        world = wp.tid()
        better[world] = 0
        if ctl.choose[world] == 0:
            return
        phi = objective(ctl, world)
        if not (wp.isfinite(phi) and ctl.domain_J[world] > f64(0.0)):
            phi = f64(1.0e300)
        low = wp.min(ctl.min_J[world], f64(0.0))
        if first != 0 or low > ctl.best_norm[world] or (low == ctl.best_norm[world] and phi < ctl.best_phi[world]):
            ctl.best_phi[world] = phi
            ctl.best_norm[world] = low
            better[world] = 1
            if first == 0:
                ctl.predicted[world] = 0

    @wp.func
    def open_search(ctl: Control, world: int):
        """Check the search direction and start the line search."""
        ctl.bent[world] = wp.max(ctl.bent[world], ctl.negative[world])
        ctl.searching[world] = 1
        barred = False
        if wp.static(limited):
            barred = not ctl.limit[world] > f64(0.0)
        if not wp.isfinite(ctl.slope[world]):
            fail(ctl, world, FAIL_NAN)
        elif barred:
            fail(ctl, world, FAIL_LIMIT)
        elif ctl.negative[world] != 0 and ctl.mixed[world] == 1:
            if ctl.leaps[world] > 0:
                ctl.restoring[world] = 1
            else:
                ctl.mixed[world] = wp.where(lost(ctl, world), 0, 2)
                ctl.tame[world] = 1
                ctl.alpha[world] = f64(0.0)
        elif ctl.slope[world] >= f64(0.0) and wp.static(not midpoint):  # midpoint: |g| can still fall
            if ctl.reused[world] != 0:
                ctl.alpha[world] = f64(0.0)
            elif ctl.leaps[world] > 0:
                ctl.restoring[world] = 1
            else:
                fail(ctl, world, FAIL_CURVATURE)

    @wp.kernel(module=module)
    def judge_floor(ctl: Control, component_of_part: wp.array(dtype=wp.int32)):
        """Error estimate of a stalled residual, relative to the solution, of the worst part.

        With H p = -g in the energy norm: eta = sqrt(-g.p dq/dv) / sqrt(2 strain energy + dv.M dv); for each part
        separately, since a stiff part would hide the error of a soft one joined to it.
        """
        world = wp.tid()
        if ctl.strict[world] != 2:
            return
        ctl.strict[world] = 0
        if ctl.unsolved[world] != 0 and ctl.eps > f64(COARSE):  # this solve cannot give the error either
            give_up(ctl, world, FAIL_FLOOR)
            return
        dq = ctl.dq_dv[world]
        largest, whole = f64(0.0), f64(0.0)
        for part in range(component_of_part.shape[0]):
            for lane in range(FLOOR_LANES):
                whole += ctl.floor_sums[0, world, part, lane]
                largest = wp.max(largest, ctl.floor_sums[4, world, part, lane])
        if wp.static(walls):  # gaps have position round-off
            largest = wp.max(largest, ctl.length)
        worst = f64(0.0)
        for part in range(component_of_part.shape[0]):
            if ctl.quiet[world, component_of_part[part]] == 0:
                work, kinetic, strain, step, speed = f64(0.0), f64(0.0), f64(0.0), f64(0.0), f64(0.0)
                for lane in range(FLOOR_LANES):
                    work += ctl.floor_sums[0, world, part, lane]
                    kinetic += ctl.floor_sums[1, world, part, lane]
                    strain += ctl.floor_sums[2, world, part, lane]
                    step = wp.max(step, ctl.floor_sums[3, world, part, lane])
                    speed = wp.max(speed, ctl.floor_sums[5, world, part, lane])
                eta = f64(1.0e30)
                if ctl.negative[world] == 0 and wp.isfinite(work) and whole > f64(0.0):
                    eta = wp.sqrt(wp.abs(work) * dq / wp.max(f64(2.0) * strain + kinetic * dq, f64(1.0e-300)))
                    if ctl.eps > f64(COARSE):  # a soft direction may be invisible to the energy
                        eta = wp.max(eta, f64(SCATTER) * dq * step / wp.max(largest, f64(1.0e-300)))
                    if eta > ctl.floor_bound and dq * step <= f64(RIGID) * ctl.eps * largest:
                        eta = dq * step / wp.max(largest, f64(1.0e-300))
                    if eta > ctl.floor_bound and step <= f64(SWIFT) * ctl.eps * speed and ctl.eps < f64(COARSE):
                        eta = step / speed
                worst = wp.max(worst, eta)
        ctl.eta[world] = worst
        if worst <= ctl.floor_bound:
            ctl.floor[world] = wp.max(ctl.floor[world], worst)
            accept(ctl, world)
            return
        tries = ctl.strict_count[world] + 1
        ctl.strict_count[world] = tries
        known = worst < f64(1.0e30)
        if tries >= TRIES or (known and tries > 1 and worst > f64(0.5) * ctl.last_eta[world]):
            give_up(ctl, world, wp.where(known, FAIL_FLOOR, FAIL_CURVATURE))
            return
        ctl.last_eta[world] = worst
        open_search(ctl, world)

    @wp.kernel(module=module)
    def begin_search(ctl: Control, pcg: PCG):
        """Slope along the new direction; the first trial is the full step."""
        world = wp.tid()
        if ctl.active[world] == 0:
            ctl.searching[world] = 0
            return
        ctl.slope[world] = ctl.slope_sum[0, world]
        ctl.alpha[world] = f64(1.0)
        if wp.static(limited):
            ctl.alpha[world] = wp.min(ctl.limit[world], f64(1.0))
        ctl.rounds[world] = ctl.rounds[world] + 1
        ctl.searches[world] = 0
        ctl.grown[world] = wp.where(ctl.negative[world] != 0 and ctl.equilibrium != 0, 0, -1)
        if wp.static(walls):
            ctl.lower[world] = wp.vec2d(f64(0.0), ctl.slope_sum[0, world])
            ctl.upper[world] = wp.vec2d()
        ctl.wish[world] = 0
        ctl.turn[world] = f64(0.0)
        ctl.searching[world] = 1
        ctl.predicted[world] = 0
        ctl.mark[world] = 0
        if wp.static(stored):
            ctl.stepped[world] = 0
        if wp.static(gated):
            if ctl.classical == 0:
                ctl.outer[world] = ctl.outer[world] + 1
        if ctl.strict[world] != 0 and pcg.total[world] < pcg.max_work:
            # estimate the error before following the direction
            ctl.strict[world] = 2
            ctl.searching[world] = 0
            wp.atomic_max(ctl.any_hard, 0, 1)
        elif pcg.total[world] >= pcg.max_work:
            give_up(ctl, world, FAIL_WORK)
        elif ctl.rounds[world] > ROUNDS * patience(ctl, world) * ctl.max_iterations:
            give_up(ctl, world, FAIL_ITERATIONS)
        else:
            open_search(ctl, world)

    outer = outer_kernels(traits, module)
    return _types.SimpleNamespace(
        **vars(outer),
        **vars(searching),
        module=module,
        measure=measure,
        accept=accept,
        record=record,
        reset_min_J=reset_min_J,
        begin=begin,
        compare=compare,
        judge_floor=judge_floor,
        begin_search=begin_search,
    )
