"""What the parts share: cantilevers, a timed static solve."""

from __future__ import annotations

import time as clock
from typing import Any

import warpfea as wf
from warpfea.simulation.statics import StaticResult

__all__ = ["X", "Z", "cantilever", "keep_plane", "static"]

X, Z = (1.0, 0.0, 0.0), (0.0, 0.0, 1.0)


def cantilever(
    elements: int, section: wf.Rectangle, law: wf.SVK, integration: str, length: float = 1.0, slots: str = "all"
) -> tuple[wf.ModelBuilder, wf.Body]:
    """A beam along x without gravity, `slots` of its root held, with the probe "tip"; `length` in m."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    beam = b.add_beam([(0, 0, 0), (length, 0, 0)], elements=elements, section=section, normal=Z, material=law,
                      integration=integration)  # fmt: skip
    b.clamp(beam.start, slots=slots)
    b.add_probe("tip", beam.end)
    return b, beam


def keep_plane(b: wf.ModelBuilder, beam: wf.Body, component: str) -> None:
    """Solve in a plane: all slots of the component held."""
    b.clamp(beam.nodes(lambda X: X[:, 0] > -1.0), components=component)


def static(b: wf.ModelBuilder, device: Any, **options: Any) -> tuple[StaticResult, float]:
    """The static result and the seconds that it took, compilation included."""
    model = b.finalize(device=device)
    began = clock.perf_counter()
    result = wf.solve_static(model, **options)
    return result, clock.perf_counter() - began
