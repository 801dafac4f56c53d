"""Shortened contact scenes with every integrator.

rows    error of the probes against a finer run, over their travel, and changes of terms of the energy ledger over the
        run, over the largest energy exchanged: `integrator` (positive: the scheme dissipates), `contact_loss`
        (restitution and damping of contacts) and `friction`.
orders  in the step, of each curve, by least squares over its resolved rows.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from warpfea.builder.scene import find
from warpfea.studies.accuracy import StudyOptions, study

from .table import Row, Run, Table

__all__ = ["TABLE"]

METHODS = ("backward_euler", "bdf2", "energy_momentum", "generalized_alpha(rho_inf=0.8)")
SCENES: dict[str, tuple[dict[str, Any], float, float]] = {
    "bouncing_ball": ({"cells": 2, "drop": 0.02}, 0.12, 1e-3),
    "tilting_table": ({"rate": 50.0}, 0.4, 1e-2),
    "gripper": ({"cells": 2}, 0.5, 1e-2),
    "beam_over_cylinders": ({"elements": 6, "drop": 0.01}, 0.12, 2e-3),
    "belt": ({"start": 0.05}, 0.2, 5e-3),
}
"""Name -> parameters, end and largest step, s."""
HALVINGS = 3
TERMS = ("integrator", "contact_loss", "friction", "viscous", "ledger_residual")
_orders: list[Row] = []


def rows(run: Run) -> Iterator[Row]:
    """A row per scene, integrator and step."""
    _orders.clear()
    for name, (values, end, dt) in SCENES.items():
        steps = [dt / 2**k for k in range(2 if run.quick else HALVINGS)]
        found = study(
            find(name), over={"method": METHODS, "dt": steps}, parameters=values, t_end=end, device=run.device,
            options=StudyOptions(repeat=1, split="none", finer={"method": "bdf2"}, progress=False),
        )  # fmt: skip
        own = found.references[0]
        _orders.extend(
            {"scene": name, "method": fit["curve"], "order": fit["order"], "steps": fit["rows"]} for fit in found.fits()
        )
        for row in found:
            ledger = row.ledger or {}
            yield {
                "scene": name, "method": row.setting.method, "dt": row.setting.dt, "status": row.status,
                "why": row.why, "error": row.error, "own_error": own["own_error"]["l2"], "order": row.orders.get("dt"),
                **{term: ledger.get(term) for term in TERMS}, "seconds": row.seconds, "newton": row.newton,
            }  # fmt: skip


def orders(run: Run) -> list[Row]:
    """Orders of each scene and integrator of `rows`."""
    return list(_orders)


TABLE = Table(
    about=__doc__,
    parts={"rows": rows, "orders": orders},
    results={"contact_integrators_cpu.json": "contact_integrators --out tests/results/contact_integrators_cpu.json"},
    settings={name: {"parameters": values, "t_end": end, "dt": dt} for name, (values, end, dt) in SCENES.items()},
)
