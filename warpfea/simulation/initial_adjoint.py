"""Adjoint of the initial accelerations of generalized-alpha, without joints and drives: M w_0 = f - f_int(q_0, v_0).

It is that of a step: with multipliers x of M x = a_bar + w_bar on the free components the bars of q_0 and v_0 change by
-x . d(f_int - f), and those of parameters likewise. The step is that of the rates of strain at the state, with b = -h.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..base.worlds import set_rows
from ..terms.protocols import Constrained, Differentiable

if TYPE_CHECKING:
    from ..model.model import Model
    from ..terms.gradients import StepAdjoint
    from .stepper import Stepper

__all__ = ["check_initial_conditions", "step_back_to_initial"]


def check_initial_conditions(model: Model, scheme: Any) -> None:
    """ModelError for joints and drives, whose accelerations follow from rates of their positions."""
    if scheme.accelerated and (model.terms.supports.in_use or model.terms.having(Constrained)):
        raise ModelError(
            f"Adjoint: the initial accelerations of {scheme.name!r} have no adjoint with joints and drives; take "
            "'backward_euler', 'bdf2' or 'energy_momentum'"
        )


def step_back_to_initial(stepper: Stepper, at: StepAdjoint, flags: np.ndarray, h: float, gradients: Any) -> None:
    """Pass the bars of accelerations in the flagged worlds (worlds,) to those of the state and of parameters.

    The stepper has the state with these accelerations, h is the size of its step, s.
    """
    s, w, solver, state = stepper, stepper.work, at.solver, stepper.state
    start = s.initial_conditions
    assert start is not None
    mass = start.free_mass_solver()
    bars = [solver.bars[name] for name in s.integrator.history_arrays]
    total = sum(bar.numpy() for bar in bars)
    x = np.zeros_like(total)
    for world in np.flatnonzero(flags).tolist():
        x[world] = mass(world, total[world])
    start.unbalanced_force(flags, h)
    set_rows(w.v_tilde, flags, (state.velocity.numpy() - h * state.acceleration.numpy())[flags])  # type: ignore[attr-defined]
    for array, values in ((solver.w, x), *((bar, 0.0 * x) for bar in bars)):
        set_rows(array, flags, values[flags])
    w.step.running.assign(flags.astype(np.int32))
    solver.mu.zero_()
    solver.drive_bar.zero_()
    solver.operator.product(solver.w, w.Hp, at.active, solver.topology, start=True)
    s.launch(solver.kernels.subtract_force, solver.dim, [w.Hp, w.step.dq_dv, at.active, solver.q_bar])
    for term in s.model.terms.having(Differentiable):
        term.add_history_gradient(at)
    # prescribed components were stopped before, by an impulse on the free ones
    free, v_bar = s.model.slot_table.free, solver.v_bar.numpy().copy()
    for world in np.flatnonzero(flags).tolist():
        impulse = s.model.masses.world_matrix(world) @ mass(world, v_bar[world])
        v_bar[world] = np.where(free > 0.0, v_bar[world], impulse)
    set_rows(solver.v_bar, flags, v_bar[flags])
    for add, out in gradients:
        add(at, out)
