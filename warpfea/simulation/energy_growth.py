"""Energy that integrator and residuals add: watched on the device (kernels/step/ledger.py), told and refused here.

The measure is net: what the ledger's `integrator` and `viscous` have fallen by since the watch began and its
`ledger_residual` has risen by, over the largest kinetic + strain + contact energy since plus the sum of |work| and of
what viscosity took. Residuals of a loose tolerance, or at the rounding of float32, do work that adds up; not so where
something is driven, which takes as much as they give: of a slider crank in float32 they give 15 J and take it again in
each turn, and its drive has that much less and more. Schemes of order 2 exchange
energy with the motion to and fro, by O(h^2) of it, and that does not add up; an instability does. Where damping is
stiff, `viscous` has too much by what `integrator` has too little: their sum is what counts. The first steps of a motion
that sets in from rest are left out.
"""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelWarning
from ..kernels.step.control import GROWTH
from ..model.assembly import element_volumes
from .jumps import drives

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State

__all__ = ["CHOICES", "REFUSED", "TOLD", "EnergyGrowth", "growth_error", "integrator_share"]

CHOICES = ("refuse", "warn", "ignore")
TOLD, REFUSED = 0.01, 0.1
"""Part of the energy that the integrator may add before it is told, and before steps are refused."""
CALMER = {
    "generalized_alpha": ("bdf2", "energy_momentum(rho_inf=0.8)", "backward_euler"),
    "energy_momentum": ("energy_momentum(rho_inf=0.8)", "bdf2", "backward_euler"),
    "bdf2": ("energy_momentum", "backward_euler"),
}
"""Schemes to take in place of one that adds energy."""
ROUNDING = 100.0
"""Strain, in units of rounding, whose energy is rounding."""


class EnergyGrowth:
    """The watch of a simulation.

    Args:
        choice: one of CHOICES.
        ledger: whether there is one: without, nothing is watched.
    """

    def __init__(self, choice: str, *, ledger: bool, static: bool) -> None:
        self.choice = choice
        self.watched = ledger and not static and choice != "ignore"
        self.told = False
        self._ledger = ledger

    def __str__(self) -> str:
        if not self.watched:
            return "not watched" + ("" if self._ledger else " (ledger=False)")
        refused = f", refused above {REFUSED:.0%}" if self.choice == "refuse" else ""
        return f"watched: warned of above {TOLD:.0%}{refused}"

    def bind(self, step: Any, model: Model, state: State) -> None:
        """Let the kernels of a step watch; a state that another simulation has had begins again."""
        if not self.watched:
            return
        rows = state.register("energy_growth", wp.float64, (len(GROWTH),))
        rows.zero_()
        step.growth, step.watched = rows, 1
        step.counted = float(not drives(model))
        self._model, self._rows = model, rows
        self._least = wp.zeros(model.worlds, dtype=wp.float64, device=model.device)
        self._written, self._writes = model.terms.written, model.terms.writes
        self._least.assign(least_energy(model))
        step.growth_told = TOLD
        step.growth_limit = REFUSED if self.choice == "refuse" else np.inf
        step.least_energy = self._least

    def follow(self) -> None:
        """Begin anew in the worlds whose parameters were set: what that does to energies is not the integrator's."""
        if not self.watched or self._written == self._model.terms.written:
            return
        writes = self._model.terms.writes
        chosen, self._writes = writes > self._writes, writes
        self._written = self._model.terms.written
        rows = self._rows.numpy()
        rows[chosen] = 0.0
        self._rows.assign(rows)
        self._least.assign(least_energy(self._model))

    def tell(self, sim: Any, shares: np.ndarray) -> None:
        """Warn once where a world's part (worlds,) is above TOLD."""
        if self.told or not (worst := float(np.max(shares))) > TOLD:
            return
        self.told = True
        world = int(np.argmax(shares))
        since = float(sim.state.energy_growth.numpy()[world, GROWTH.index("since")])
        refused = f"; steps are refused above {REFUSED:.0%}" if self.choice == "refuse" else ""
        where = f" in world {world}" if sim.model.worlds > 1 else ""
        warnings.warn(
            f"{source(sim, world)} adds energy: from t = {since:.6g} s on more than {TOLD:.0%} of the largest, by "
            f"now {worst:.1%}{where}{refused}; {remedy(sim, world)}",
            ModelWarning,
            stacklevel=4,
        )


def least_energy(model: Model) -> np.ndarray:
    """Energy below which all of it may be rounding, (worlds,) J: of a strain of some units of rounding everywhere."""
    unit, out = ROUNDING * float(np.finfo(model.dtype).eps), np.zeros(model.worlds)
    for body in model.bodies:
        volume = float(element_volumes(body).sum())
        worlds = range(model.worlds) if model.parameters.varies(body) else [None]
        moduli = [model.parameters.modulus(world)(body, None)[0] for world in worlds]
        out += unit**2 * volume * np.array(moduli)
    return out


def by_residuals(sim: Any, world: int) -> bool:
    """True where residuals that were accepted have added more than half of the energy; of a scheme that is unstable by
    itself it is the scheme."""
    if drives(sim.model) or sim.integrator.name == "generalized_alpha":
        return False
    share, largest, turnover = sim.state.energy_growth.numpy()[world, :3]
    added = share * (largest + turnover)
    return float(sim.energies()["ledger_residual"][world]) > 0.5 * added


def source(sim: Any, world: int) -> str:
    """Name of what adds the energy: the integrator, or residuals."""
    return "the work of accepted residuals" if by_residuals(sim, world) else sim.integrator.label


def remedy(sim: Any, world: int) -> str:
    """Schemes to write in place of the integrator, or a tolerance."""
    if by_residuals(sim, world):
        return "take a smaller tol" + (", or dtype='float64'" if sim.model.dtype == "float32" else "")
    others = [f"{other!r}" for other in CALMER.get(sim.integrator.name, ())]
    return f"take integrator={', '.join(others)} or a smaller dt" if others else "take a smaller dt"


def integrator_share(sim: Any) -> float:
    """Part of the energy turned over that the ledger's `integrator` took or gave, in the worst world.

    NaN where it is not watched; 0 where nothing was yet, as after a refused step.
    """
    if not sim.energy_growth.watched:
        return float("nan")
    rows = sim.state.energy_growth.numpy()
    scale = rows[:, GROWTH.index("largest")] + rows[:, GROWTH.index("turnover")]
    taken = np.abs(sim.energies()["integrator"])
    return float(np.max(np.divide(taken, scale, out=np.zeros_like(taken), where=scale > 0.0)))


def growth_error(sim: Any, world: int) -> str:
    """The message of a step that is refused since the integrator has added too much; the world's watch begins again."""
    rows = sim.state.energy_growth.numpy()
    share, since = (float(rows[world, GROWTH.index(name)]) for name in ("share", "since"))
    name, cure = source(sim, world), remedy(sim, world)
    rows[world] = 0.0
    sim.state.energy_growth.assign(rows)
    return (
        f"{name} has added {share:.1%} to the largest energy, more than {TOLD:.0%} from t = "
        f"{since:.6g} s on; {cure}; energy_growth='warn' lets it pass"
    )
