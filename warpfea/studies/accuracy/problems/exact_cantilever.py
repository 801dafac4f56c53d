"""The T10 cantilever S3 against its trajectory that is exact in time."""

from __future__ import annotations

import numpy as np

import warpfea as wf

from ...checkout import data_file
from ...checkout import reference as stored

MIDDLE = (0.5, 0.05, 0.05)
"""Of the end face, m."""


def trajectory() -> wf.Reference:
    """The mean of the end face every 10 ms, by DOP853 at rtol = 1e-11 on the same elements."""
    runs = stored("S3_exact_svk_q5")["runs"]
    path = runs["reference"]["trajectory"]
    error = runs["estimated_error"]["max_tip_difference_rtol1e9_vs_1e11"]
    return wf.Reference(
        {"tip": (path["t"], np.array(MIDDLE) + path["tip_mean"])}, "S3_exact_svk_q5.json, exact in time", error
    )


@wf.scene(dt=5e-4, t_end=0.5, integrator="bdf2", tol=1e-9, reference=trajectory)
def exact_cantilever() -> wf.ModelBuilder:
    """A cantilever of T10 elements falls under gravity; its motion on this mesh is known, so errors are of time."""
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    law = wf.SVK(E=1e6, nu=0.3, density=1000.0)
    bar = b.add_solid(str(data_file("S3_cantilever.msh")), material=law, quadrature="tet5_paper", name="bar")
    b.clamp(bar.nodes(lambda X: np.abs(X[:, 0]) < 1e-9))
    b.add_probe("tip", bar.surface(lambda X: X[:, 0] > 0.5 - 1e-9))
    return b
