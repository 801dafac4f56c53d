"""Buckling loads: stability detection in statics for perfect structures, which stay on the primary path."""

from __future__ import annotations

import warnings

import numpy as np

import warpfea as wf

from ..case import Answer, Setting, case
from ._common import Effort, Z, finalize

GROUP = "Stability"
MODULUS, LENGTH, SIDE, THICKNESS = 2e11, 1.0, 0.02, 0.01
PUSH = 1e-5
"""Transverse load on a column, as a fraction."""


def _judged(b: wf.ModelBuilder, setting: Setting, stable: bool, reference: str) -> Answer:
    """Error 0 for the correct stability, 1 for the opposite and 0.5 for unknown."""
    effort = Effort()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wf.StabilityWarning)
        found = wf.solve_static(finalize(b, setting), outputs=[effort])
    assert found.stability is not None
    said = found.stability.stable[0]
    error = 0.5 if said is None else float(said is not stable)
    note = f"{found.stability.text} {found.stability.reasons[0]}, {int(found.stability.iterations[0])} products"
    return Answer(error, 0.1, reference, **effort.told, note=note)


@case("buckling-column", GROUP, values=(0.9, 1.1, 10.0), quick="both")
def column(setting: Setting, factor: float) -> Answer:
    """A perfect cantilever of 16 beam elements under multiples of Euler's load is reported stable or unstable."""
    load = factor * np.pi**2 * MODULUS * SIDE**4 / 12.0 / (4.0 * LENGTH**2)
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_beam([(0, 0, 0), (LENGTH, 0, 0)], elements=16, section=wf.Rectangle(SIDE, SIDE), normal=Z,
                      material=wf.SVK(E=MODULUS, nu=0.0), name="column")  # fmt: skip
    b.clamp(body.start, slots="position+section")
    b.add_point_load(body.end, (-load, 0.0, 0.0))
    return _judged(b, setting, factor < 1.0, "Euler")


@case("buckling-pushed", GROUP, values=(1.01, 1.1, 10.0), quick="both",
      refusal={"float64": ("was not accepted",), "float32": ("float32",)})  # fmt: skip
def pushed(setting: Setting, factor: float) -> Answer:
    """The cantilever with 1e-5 of the load across it: reported unstable, refused, or bent by 0.1 L, never silently
    straight.
    """
    load = factor * np.pi**2 * MODULUS * SIDE**4 / 12.0 / (4.0 * LENGTH**2)
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_beam([(0, 0, 0), (LENGTH, 0, 0)], elements=16, section=wf.Rectangle(SIDE, SIDE), normal=Z,
                      material=wf.SVK(E=MODULUS, nu=0.0), name="column")  # fmt: skip
    b.clamp(body.start, slots="position+section")
    b.add_point_load(body.end, (-load, 0.0, PUSH * load))
    b.add_probe("tip", body.end)
    effort = Effort()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", wf.StabilityWarning)
        found = wf.solve_static(finalize(b, setting), outputs=[effort])
    side = abs(float(found.probe("tip").displacement[0, -1, 2])) / LENGTH
    told = any(issubclass(w.category, wf.StabilityWarning) for w in said)
    note = f"{side:.2g} L to the side, {'un' if told else ''}stable"
    return Answer(0.0 if told or side > 0.1 else 1.0, 0.1, "Euler", **effort.told, note=note)


@case("buckling-plate", GROUP, values=(0.9, 1.1, 1.5), quick="both")
def plate(setting: Setting, factor: float) -> Answer:
    """A square plate of 8 x 8 shells, simply supported, under multiples of its uniaxial buckling load.

    N = 4 pi^2 D / a^2 (Bryan 1891); the mesh has 0.976 of that.
    """
    nu = 0.3
    critical = 4.0 * np.pi**2 * MODULUS * THICKNESS**3 / 12.0 / (1.0 - nu**2) / LENGTH**2
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.grid((LENGTH, LENGTH), cells=(8, 8))
    body = b.add_shell(mesh, thickness=THICKNESS, material=wf.SVK(E=MODULUS, nu=nu), name="plate")
    for side, components in (("x-", "xz"), ("x+", "z"), ("y-", "yz"), ("y+", "z")):
        b.clamp(body.edge(side), components=components, slots="position")
    b.add_traction(body.surface("x+"), (-factor * critical / THICKNESS, 0.0, 0.0))
    return _judged(b, setting, factor < 1.0, "Bryan")
