"""When a preconditioner is made anew: it is kept until what it costs in iterations exceeds what making it costs.

The rule counts iterations, never time, and its memory is part of the state, so that a resumed run does the same.
"""

import functools
import types as _types

import warp as wp

from .newton import control_struct
from .pcg import pcg_struct
from .types import kernel_module, precision

__all__ = ["lag_kernels", "lag_struct"]


@functools.cache
def lag_struct():
    """What the rule knows of each world."""

    @wp.struct
    class LagControl:
        build: wp.array(dtype=wp.int32)  # make it now
        moved: wp.array(dtype=wp.int32)  # at the present iterate; else again where it was made
        stale: wp.array(dtype=wp.int32)  # the matrices at hand are not those of the state
        due: wp.array(dtype=wp.int32)  # state: make it at the next solve
        mass_factor: wp.array(dtype=wp.float64)  # state: c_M and dq/dv it was made for; negative: never made
        dq_dv: wp.array(dtype=wp.float64)
        rate: wp.array(dtype=wp.float64)  # state: iterations per decade of the first solve with it; 0: none yet
        excess: wp.array(dtype=wp.float64)  # state: iterations beyond that rate since
        limit: wp.float64  # excess that pays for making it
        any_build: wp.array(dtype=wp.int32)

    return LagControl


@functools.cache
def lag_kernels(dtype: str) -> _types.SimpleNamespace:
    """Kernels of the rule."""
    p = precision(dtype)
    vec3 = p.vec3
    f64 = wp.float64
    Lag = lag_struct()
    Newton, PCG = control_struct(), pcg_struct()
    module = kernel_module(f"lag_{dtype}")

    @wp.kernel(module=module)
    def decide(
        lag: Lag, mass_factor: wp.array(dtype=f64), dq_dv: wp.array(dtype=f64), active: wp.array(dtype=wp.int32)
    ):
        """Before a solve: which worlds make theirs."""
        world = wp.tid()
        lag.build[world] = 0
        lag.moved[world] = 0
        if active[world] == 0:
            return
        same = lag.mass_factor[world] == mass_factor[world] and lag.dq_dv[world] == dq_dv[world]
        if lag.due[world] != 0 or not same:
            lag.moved[world] = 1
            lag.due[world] = 0
            lag.mass_factor[world] = mass_factor[world]
            lag.dq_dv[world] = dq_dv[world]
            lag.rate[world] = f64(0.0)
            lag.excess[world] = f64(0.0)
        if lag.moved[world] != 0 or lag.stale[world] != 0:
            lag.build[world] = 1
            lag.stale[world] = 0
            wp.atomic_max(lag.any_build, 0, 1)

    @wp.kernel(module=module)
    def judge(lag: Lag, newton: Newton, pcg: PCG):
        """After a solve: what it cost."""
        world = wp.tid()
        if newton.active[world] == 0 or pcg.iterations[world] == 0:
            return
        count = f64(pcg.iterations[world])
        gained = wp.max(pcg.first_norm[world] / wp.max(pcg.norm[world], f64(1.0e-300)), f64(2.0))
        decades = wp.log10(gained)
        if lag.rate[world] == f64(0.0):
            lag.rate[world] = count / decades
        else:
            lag.excess[world] = lag.excess[world] + wp.max(count - lag.rate[world] * decades - f64(1.0), f64(0.0))
            if lag.excess[world] > lag.limit:
                lag.due[world] = 1

    @wp.kernel(module=module)
    def mark(flags: wp.array(dtype=wp.int32), lag: Lag):
        """The state of flagged worlds was set from elsewhere."""
        world = wp.tid()
        if flags[world] != 0:
            lag.stale[world] = 1

    @wp.kernel(module=module)
    def keep_vectors(
        source: wp.array2d(dtype=vec3), flags: wp.array(dtype=wp.int32), target: wp.array2d(dtype=vec3)
    ):
        """target = source in the flagged worlds."""
        world, k = wp.tid()
        if flags[world] != 0:
            target[world, k] = source[world, k]

    @wp.kernel(module=module)
    def keep_rows(
        gradient: wp.array2d(dtype=wp.vec3d),
        stiffness: wp.array2d(dtype=f64),
        flags: wp.array(dtype=wp.int32),
        kept_gradient: wp.array2d(dtype=wp.vec3d),
        kept_stiffness: wp.array2d(dtype=f64),
    ):
        """The same for the constraints' rows."""
        world, row = wp.tid()
        if flags[world] != 0:
            kept_stiffness[world, row] = stiffness[world, row]
            for side in range(3):
                kept_gradient[world, 3 * row + side] = gradient[world, 3 * row + side]

    return _types.SimpleNamespace(
        module=module, decide=decide, judge=judge, mark=mark, keep_vectors=keep_vectors, keep_rows=keep_rows
    )
