"""Buckling loads: statics tells a stable equilibrium from an unstable one, which a perfect structure does not leave."""

from __future__ import annotations

import warnings

import numpy as np

import warpfea as wf

from ..build import Count, Z, finalize
from ..case import Answer, Setting, case

GROUP = "Stability"
MODULUS, LENGTH, SIDE, THICKNESS = 2e11, 1.0, 0.02, 0.01
PUSH = 1e-5
"""Of the load, across a column."""


def _judged(b: wf.ModelBuilder, setting: Setting, stable: bool, reference: str) -> Answer:
    """Error 0 where statics says so, 1 where it says the other and 0.5 where it does not know."""
    count = Count()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", wf.StabilityWarning)
        found = wf.solve_static(finalize(b, setting), outputs=[count])
    assert found.stability is not None
    said = found.stability.stable[0]
    error = 0.5 if said is None else float(said is not stable)
    note = f"{found.stability.text} {found.stability.reasons[0]}, {int(found.stability.iterations[0])} products"
    return Answer(error, 0.1, reference, **count.fields, note=note)


@case("buckling-column", GROUP, values=(0.9, 1.1, 10.0), quick="both")
def column(setting: Setting, factor: float) -> Answer:
    """A perfect cantilever of 16 beam elements under so many times Euler's load is said to be stable or not."""
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
    """The same with 1e-5 of the load across it does not stay straight in silence: told, refused, or bent by 0.1 L."""
    load = factor * np.pi**2 * MODULUS * SIDE**4 / 12.0 / (4.0 * LENGTH**2)
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_beam([(0, 0, 0), (LENGTH, 0, 0)], elements=16, section=wf.Rectangle(SIDE, SIDE), normal=Z,
                      material=wf.SVK(E=MODULUS, nu=0.0), name="column")  # fmt: skip
    b.clamp(body.start, slots="position+section")
    b.add_point_load(body.end, (-load, 0.0, PUSH * load))
    b.add_probe("tip", body.end)
    count = Count()
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", wf.StabilityWarning)
        found = wf.solve_static(finalize(b, setting), outputs=[count])
    side = abs(float(found.probe("tip").displacement[0, -1, 2])) / LENGTH
    told = any(issubclass(w.category, wf.StabilityWarning) for w in said)
    note = f"{side:.2g} L to the side, {'un' if told else ''}stable"
    return Answer(0.0 if told or side > 0.1 else 1.0, 0.1, "Euler", **count.fields, note=note)


@case("buckling-plate", GROUP, values=(0.9, 1.1, 1.5), quick="both")
def plate(setting: Setting, factor: float) -> Answer:
    """A square plate of 8 x 8 shells, simply supported, under so many times its load in one direction.

    N = 4 pi^2 D / a^2 (Bryan 1891); of the mesh it is 0.976 of that.
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
