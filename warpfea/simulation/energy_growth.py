"""Monitor of spurious energy growth: device counters (kernels/step/energy_ledger.py), warnings, rejection.

Net measure: decrease of the ledger's `integrator` + `viscous` and increase of its `ledger_residual` since the start of
monitoring, over the largest kinetic + strain + contact energy since, plus the sum of |work| and of the viscous loss.
Accepted residuals of a loose tolerance, or at the round-off of float32, do work that may accumulate; they are excluded
in driven models, where the drive balances them: those of a slider crank in float32 give and take 15 J in each turn.
Second-order schemes exchange energy with the motion, by O(h^2) of it, which does not accumulate; an instability does.
With stiff damping errors of `viscous` and `integrator` cancel: only their sum counts. The first steps of a motion from
rest are excluded.
"""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelWarning
from ..base.worlds import set_rows
from ..kernels.step.step_control import GROWTH_COLUMNS
from ..model.assembly import element_volumes
from .discontinuities import list_drives

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State

__all__ = ["ENERGY_GROWTH_CHOICES", "EnergyGrowth", "growth_error_text", "integrator_energy_ratio"]

ENERGY_GROWTH_CHOICES = ("refuse", "warn", "ignore")
WARN_LIMIT, REFUSE_LIMIT = 0.01, 0.1
"""Energy gain of the integrator over the energy, for a warning and for rejection of steps."""
MORE_DISSIPATIVE_SCHEMES = {
    "generalized_alpha": ("bdf2", "energy_momentum(rho_inf=0.8)", "backward_euler"),
    "energy_momentum": ("energy_momentum(rho_inf=0.8)", "bdf2", "backward_euler"),
    "bdf2": ("energy_momentum", "backward_euler"),
}
"""Alternative schemes to one that gains energy."""
ROUND_OFF_STRAIN = 100.0
"""Strain in units of round-off whose energy counts as round-off."""


class EnergyGrowth:
    """Energy growth monitor of a simulation.

    Args:
        choice: one of ENERGY_GROWTH_CHOICES.
        ledger: True with an energy ledger, which monitoring requires.

    Attributes:
        warn_threshold: energy gain above which a step calls `warn`, which it does once.
    """

    def __init__(self, choice: str, *, ledger: bool, static: bool) -> None:
        self.choice = choice
        self.monitored = ledger and not static and choice != "ignore"
        self.warn_threshold = WARN_LIMIT
        self._ledger = ledger

    @property
    def warned(self) -> bool:
        """True once it has warned."""
        return self.warn_threshold > WARN_LIMIT

    def __str__(self) -> str:
        if not self.monitored:
            return "not watched" + ("" if self._ledger else " (ledger=False)")
        refused = f", refused above {REFUSE_LIMIT:.0%}" if self.choice == "refuse" else ""
        return f"watched: warned of above {WARN_LIMIT:.0%}{refused}"

    def bind(self, step: Any, model: Model, state: State) -> None:
        """Bind monitor arrays to the step control; resets the history of a reused state."""
        if not self.monitored:
            return
        rows = state.register("energy_growth", wp.float64, (len(GROWTH_COLUMNS),))
        rows.zero_()
        step.energy_growth, step.growth_monitored = rows, 1
        step.residual_work_counted = float(not list_drives(model))
        self._model, self._rows = model, rows
        self._round_off_energy = wp.zeros(model.worlds, dtype=wp.float64, device=model.device)
        self._writes = model.terms.world_updates
        self._round_off_energy.assign(round_off_energy(model))
        step.growth_warn_limit = WARN_LIMIT
        step.growth_limit = REFUSE_LIMIT if self.choice == "refuse" else np.inf
        step.min_energy = self._round_off_energy

    def restart_changed(self) -> None:
        """Restart in worlds whose parameters were set: the energy jump is not the integrator's."""
        if not self.monitored:
            return
        writes = self._model.terms.world_updates
        chosen, self._writes = writes > self._writes, writes
        set_rows(self._rows, chosen, 0.0)
        self._round_off_energy.assign(round_off_energy(self._model))

    def warn(self, sim: Any, shares: np.ndarray, stacklevel: int = 4) -> None:
        """Warn, once, of the largest energy gain of the worlds (worlds,)."""
        self.warn_threshold = np.inf
        world, worst = int(np.argmax(shares)), float(np.max(shares))
        since = float(sim.state.energy_growth.numpy()[world, GROWTH_COLUMNS.index("since")])
        refused = f"; steps are refused above {REFUSE_LIMIT:.0%}" if self.choice == "refuse" else ""
        where = f" in world {world}" if sim.model.worlds > 1 else ""
        source, cure = cause_and_remedy(sim, world)
        warnings.warn(
            f"{source} is gaining energy: {worst:.1%} of the peak energy{where} (above "
            f"{WARN_LIMIT:.0%} since t = {since:.6g} s){refused}; {cure}",
            ModelWarning,
            stacklevel=stacklevel,
        )


def round_off_energy(model: Model) -> np.ndarray:
    """Round-off level of the energy (worlds,), J: strain of ROUND_OFF_STRAIN eps everywhere; of a rigid part, whose
    supports hold to a tolerance, a fall by sqrt(eps) of its size."""
    fall = math.sqrt(np.finfo(model.dtype).eps) * float(np.linalg.norm(model.description.gravity))
    unit, out = ROUND_OFF_STRAIN * float(np.finfo(model.dtype).eps), np.zeros(model.worlds)
    for body in model.bodies:
        volume = float(element_volumes(body).sum())
        out += unit**2 * volume * model.parameters.youngs_modulus(body)
        if body.rigid:
            size = float(np.linalg.norm(np.ptp(np.array(body.mesh.bounding_box()), axis=0)))
            part = model.bodies.index(body), 0
            out += fall * size * model.masses.scales[part] * model.masses.parts[part].scaled_mass
    return out


def cause_and_remedy(sim: Any, world: int) -> tuple[str, str]:
    """Source of the energy, as text: accepted residuals that have added more than half of it (never for
    generalized-alpha, which is unstable by itself), or the integrator; and a tolerance or alternative integrators."""
    if not (list_drives(sim.model) or sim.integrator.name == "generalized_alpha"):
        share, largest, turnover = sim.state.energy_growth.numpy()[world, :3]
        if float(sim.energies()["ledger_residual"][world]) > 0.5 * share * (largest + turnover):
            finer = ", or dtype='float64'" if sim.model.dtype == "float32" else ""
            return "the work of accepted residuals", f"take a smaller tol{finer}"
    others = [f"{other!r}" for other in MORE_DISSIPATIVE_SCHEMES.get(sim.integrator.name, ())]
    better = f"integrator={', '.join(others)} or " if others else ""
    return sim.integrator.label, f"take {better}a smaller dt"


def integrator_energy_ratio(sim: Any) -> float:
    """Integrator loss or gain of the ledger over the energy exchanged, in the worst world.

    NaN without monitoring; 0 before any exchange, as after a rejected step.
    """
    if not sim.energy_growth.monitored:
        return float("nan")
    rows = sim.state.energy_growth.numpy()
    scale = rows[:, GROWTH_COLUMNS.index("largest")] + rows[:, GROWTH_COLUMNS.index("turnover")]
    taken = np.abs(sim.energies()["integrator"])
    return float(np.max(np.divide(taken, scale, out=np.zeros_like(taken), where=scale > 0.0)))


def growth_error_text(sim: Any, world: int) -> str:
    """Message of a step rejected for energy growth; restarts the monitor of the world."""
    rows = sim.state.energy_growth.numpy()
    share, since = (float(rows[world, GROWTH_COLUMNS.index(name)]) for name in ("share", "since"))
    name, cure = cause_and_remedy(sim, world)
    set_rows(sim.state.energy_growth, world, 0.0)
    return (
        f"{name}: energy gain {share:.1%} of the peak energy (above {WARN_LIMIT:.0%} since t = {since:.6g} s); {cure}; "
        "energy_growth='warn' continues"
    )
