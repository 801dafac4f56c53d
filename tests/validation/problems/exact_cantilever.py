"""The T10 cantilever S3 against its time-exact trajectory."""

from __future__ import annotations

import numpy as np

import warpfea as wf
from warpfea.studies.files import data_file
from warpfea.studies.files import reference_data as stored

FILES = {False: "S3_exact_svk_q5", True: "S3_exact_damped_svk_q5"}
MIDDLE = (0.5, 0.05, 0.05)
"""Centre of the end face, m."""


def trajectory(damped: bool) -> wf.Reference:
    """The mean of the end face every 10 ms, exact in time (DOP853, Radau) on the same elements."""
    name = FILES[damped]
    runs = stored(name)["runs"]
    path = runs["reference"]["trajectory"]
    error = next(v for key, v in runs["estimated_error"].items() if key.startswith("max_tip_difference"))
    return wf.Reference({"tip": (path["t"], np.array(MIDDLE) + path["tip_mean"])}, f"{name}.json, exact in time", error)


@wf.scene(dt=5e-4, t_end=0.5, integrator="bdf2", tol=1e-9, reference=trajectory)
def exact_cantilever(*, damped: bool = False) -> wf.ModelBuilder:
    """A cantilever of T10 elements falls under gravity; its motion on this mesh is known, so errors are of time.

    Args:
        damped: with Kelvin-Voigt damping of the fast modes excited by gravity.
    """
    b = wf.ModelBuilder(gravity=(0.0, 0.0, -9.81))
    values = stored(FILES[True])["kelvin_voigt"]
    damping = wf.KelvinVoigt(values["eta"], values["lambda_v"], form="rate") if damped else None
    law = wf.SVK(E=1e6, nu=0.3, density=1000.0, damping=damping)
    bar = b.add_solid(str(data_file("S3_cantilever.msh")), material=law, quadrature="tet5_paper", name="bar")
    b.clamp(bar.nodes(lambda X: np.abs(X[:, 0]) < 1e-9))
    b.add_probe("tip", bar.surface(lambda X: X[:, 0] > 0.5 - 1e-9))
    return b
