"""Buckling loads: statics tells a stable equilibrium from an unstable one, which a perfect structure does not leave."""

import dataclasses
import warnings

import numpy as np

import warpfea as wf

from ..build import beam, solve
from ..case import Answer, Setting, case

GROUP = "Stability"
MODULUS, LENGTH, SIDE, THICKNESS = 2e11, 1.0, 0.02, 0.01
BUCKLED_DEFLECTION = 0.01507
"""Displacement of the middle, m, of 32 x 32 shells in float64 with imperfections of 1 and 0.1 mm, within 0.3 %."""
TRANSVERSE_FRACTION = 1e-5
"""Transverse load on a column over the axial one."""


def _stability_answer(b: wf.ModelBuilder, setting: Setting, stable: bool, reference: str) -> Answer:
    """Error 0 if statics reports the equilibrium as `stable`, 1 if as the opposite, 0.5 if as undecided."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wf.StabilityWarning)
        found = solve(b, setting)
    stability = found.result.stability
    assert stability is not None
    error = 0.5 if stability.stable[0] is None else float(stability.stable[0] is not stable)
    note = f"{stability.text} {stability.reasons[0]}, {int(stability.iterations[0])} products"
    return Answer(error, 0.1, reference, **found.stats.answer_fields, note=note)


def _column_model(factor: float, transverse: float = 0.0) -> wf.ModelBuilder:
    """A cantilever of 16 beam elements under so many times Euler's load, and the fraction `transverse` of it across."""
    load = factor * np.pi**2 * MODULUS * SIDE**4 / 12.0 / (4.0 * LENGTH**2)
    b, body = beam(16, SIDE, wf.SVK(E=MODULUS, nu=0.0), LENGTH)
    b.add_point_load(body.end, (-load, 0.0, transverse * load))
    return b


@case("buckling-column", GROUP, values=(0.9, 1.1, 10.0), quick="both")
def perfect_column(setting: Setting, factor: float) -> Answer:
    """A perfect cantilever under so many times Euler's load is reported as stable or not."""
    return _stability_answer(_column_model(factor), setting, factor < 1.0, "Euler")


@case("buckling-pushed", GROUP, values=(1.01, 1.1, 10.0), quick="both",
      refusal={"float64": ("was not accepted",), "float32": ("float32",)})  # fmt: skip
def imperfect_column(setting: Setting, factor: float) -> Answer:
    """With 1e-5 of the load across it a column is reported as unstable, refused, or bent by 0.1 L."""
    with warnings.catch_warnings(record=True) as warnings_caught:
        warnings.simplefilter("always", wf.StabilityWarning)
        found = solve(_column_model(factor, TRANSVERSE_FRACTION), setting)
    side = abs(float(found.tip[2])) / LENGTH
    warned = any(issubclass(w.category, wf.StabilityWarning) for w in warnings_caught)
    note = f"{side:.2g} L to the side, {'un' if warned else ''}stable"
    return Answer(0.0 if warned or side > 0.1 else 1.0, 0.1, "Euler", **found.stats.answer_fields, note=note)


def _supported_plate(factor: float, imperfection: float = 0.0) -> tuple[wf.ModelBuilder, wf.Body]:
    """A square plate of 8 x 8 shells, simply supported, under so many times its load in one direction.

    N = 4 pi^2 D / a^2 (Bryan 1891); of the mesh it is 0.976 of that. `imperfection`: height of the middle, m, in the
    shape of its lowest mode.
    """
    nu = 0.3
    critical = 4.0 * np.pi**2 * MODULUS * THICKNESS**3 / 12.0 / (1.0 - nu**2) / LENGTH**2
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.grid((LENGTH, LENGTH), cells=(8, 8))
    x, y = mesh.points[:, 0] / LENGTH, mesh.points[:, 1] / LENGTH
    points = np.column_stack([mesh.points[:, :2], imperfection * np.sin(np.pi * x) * np.sin(np.pi * y)])
    mesh = dataclasses.replace(mesh, points=points)
    body = b.add_shell(mesh, thickness=THICKNESS, material=wf.SVK(E=MODULUS, nu=nu), name="plate")
    for side, components in (("x-", "xz"), ("x+", "z"), ("y-", "yz"), ("y+", "z")):
        b.clamp(body.edge(side), components=components, slots="position")
    b.add_traction(body.surface("x+"), (-factor * critical / THICKNESS, 0.0, 0.0))
    return b, body


@case("buckling-plate", GROUP, values=(0.9, 1.1, 1.5), quick="both")
def perfect_plate(setting: Setting, factor: float) -> Answer:
    """A perfect, simply supported plate under so many times Bryan's load is reported as stable or not."""
    return _stability_answer(_supported_plate(factor)[0], setting, factor < 1.0, "Bryan")


@case("buckling-imperfect-plate", GROUP, values=(1e-3, 1e-4), quick="both")
def imperfect_plate(setting: Setting, imperfection: float) -> Answer:
    """At 1.5 of Bryan's load the plate buckles as far as one of 32 x 32 shells, and is stable."""
    b, body = _supported_plate(1.5, imperfection)
    b.add_probe("middle", body.at((LENGTH / 2, LENGTH / 2, imperfection)))
    found = solve(b, setting)
    assert found.result.report.stable is not None
    middle = float(found.result.probe("middle").displacement[0, -1, 2])
    error = abs(middle / BUCKLED_DEFLECTION - 1.0) if found.result.report.stable[0] else 1.0
    return Answer(error, 0.04, "32 x 32 shells", **found.stats.answer_fields, note=f"middle at {middle:.4g} m")
