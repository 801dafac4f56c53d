"""A CUDA device against the CPU on the same models, in both precisions: every kind of element, law, load, constraint.

h = 1e-3 s; differences over the tip's travel. The tests run the same cases if a device is available.
"""

# mypy: disable-error-code="index"
# (vectors of device functions: Warp does not declare that they can be indexed)

from __future__ import annotations

import time as clock
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import numpy as np
import warp as wp

import warpfea as wf
from warpfea.base.errors import UsageError
from warpfea.studies.files import data_file

from .table import Row, Run, Table

__all__ = ["CASES", "TABLE", "cantilever", "compare", "s3_mesh", "simulate"]

SVK: dict[str, Any] = {"E": 1e6, "nu": 0.3, "density": 1000.0}
DAMPING = {form: wf.KelvinVoigt(3e3, 4.5e3, form=form) for form in ("incremental", "rate", "explicit")}


@wp.func
def swirl(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """A body force about the z axis, with a part oscillating in time; N/kg."""
    return wp.vec3d(-x[1], x[0], wp.sin(t))


def s3_mesh():
    """The S3 cantilever, from a file without a mesh reader."""
    table = np.load(data_file("S3_cantilever.npz"))
    return wf.mesh.Mesh(table["points"], table["cells"], "tetra10", name="s3")


def cantilever(material=None, mesh=None, **options):
    """The S3 cantilever, or another mesh clamped at its lowest x; the probe is the face 0.5 m from there."""
    b = wf.ModelBuilder()
    body = b.add_solid(mesh or s3_mesh(), material=material or wf.SVK(**SVK), name="s3", **options)
    low = body.mesh.points[:, 0].min()
    b.clamp(body.nodes(lambda X: X[:, 0] < low + 1e-9))
    b.add_probe("tip", body.surface(lambda X: X[:, 0] > low + 0.5 - 1e-9))
    return b, body


def loaded():
    """Every kind of load at once, on a curved body."""
    b = wf.ModelBuilder()
    mesh = wf.mesh.cylinder(0.1, 0.5, cells=(4, 6))
    soft = wf.MooneyRivlin(mu10=1e5, mu01=5e4, k=1e6, density=1000.0, damping=DAMPING["incremental"])
    body = b.add_solid(mesh, material=soft, name="rod")
    b.drive(body.nodes("bottom"), rotation=wf.Rotation((0, 0, 0), (0, 0, 1), ([0, 1], [0, 3.0])))
    b.add_pressure(body.surface("side"), 500.0)
    b.add_traction(body.surface("top"), ([0, 0.1], [(0, 0, 0), (300.0, 0, 100.0)]))
    b.add_body_force(swirl)
    b.add_probe("tip", body.surface("top"))
    return b, body


def beam(integration):
    """A 3243 beam under its weight and an end moment."""
    b = wf.ModelBuilder()
    law = wf.SVK(E=1e7, nu=0.3, density=1000.0, damping=DAMPING["incremental"] if integration == "tied" else None)
    body = b.add_beam([(0, 0, 0), (1, 0, 0)], elements=16, section=wf.Rectangle(0.05, 0.05), normal=(0, 0, 1),
                      material=law, integration=integration)  # fmt: skip
    b.clamp(body.start, slots="position+section")
    b.add_moment(body.end, (1.0, -2.0, 0.5))
    b.add_probe("tip", body.end)
    return b, body


def plate(integration):
    """A 3443 plate of skew quads under its weight and a pressure."""
    b = wf.ModelBuilder()
    mesh = wf.mesh.grid(
        (1.0, 0.5), cells=(8, 4), map=lambda X: X + 0.2 * np.stack([X[:, 1], 0 * X[:, 0], 0 * X[:, 0]], 1)
    )
    body = b.add_shell(mesh, thickness=0.02, material=wf.SVK(E=1e8, nu=0.3, density=1000.0), integration=integration)
    b.clamp(body.edge("x-"))
    b.add_pressure(body.surface("top"), 50.0)
    b.add_probe("tip", body.edge("x+"))
    return b, body


def solid(element):
    """A bar of ANCF solids under its weight and a traction."""
    b = wf.ModelBuilder()
    mesh = wf.mesh.box((0.5, 0.1, 0.1), cells=(4, 1, 1), element=element)
    body = b.add_solid(mesh, element=element, material=wf.SVK(**SVK), name="bar")
    b.clamp(body.nodes(lambda X: X[:, 0] < 1e-9))
    b.add_traction(body.surface("x+"), (0.0, 100.0, 0.0))
    b.add_probe("tip", body.surface("x+"))
    return b, body


def mechanism():
    """A driven beam, a T10 block and a plate welded on, a beam on a hinge, a rod to the ground: all kinds of rows."""
    b = wf.ModelBuilder()
    law = wf.SVK(E=1e7, nu=0.3, density=1000.0)
    arm = b.add_beam(
        [(0, 0, 0), (0.5, 0, 0)], elements=2, section=wf.Rectangle(0.05, 0.05), normal=(0, 0, 1), material=law
    )
    block = b.add_solid(
        wf.mesh.box((0.1, 0.1, 0.1), cells=(2, 1, 1)), transform=(np.eye(3), (0.5, -0.05, -0.05)), material=law
    )
    grid = wf.mesh.grid((0.4, 0.1), cells=(2, 1))
    plate = b.add_shell(grid, thickness=0.02, material=law, transform=(np.eye(3), (0.6, -0.05, 0)))
    b.add_joint("revolute", parent=wf.GROUND, child=arm.start, axis=(0, 1, 0), drive=([0, 1], [0, 3.0]))
    b.weld(arm.end, block)
    b.weld(plate.edge("x-"), block)
    flap = b.add_beam(
        [(1.0, 0, 0), (1.3, 0, 0)], elements=2, section=wf.Rectangle(0.02, 0.02), normal=(0, 0, 1), material=law
    )
    b.add_joint("revolute", parent=plate.edge("x+"), child=flap.start, axis=(0, 1, 0))
    b.add_joint("distance", parent=wf.GROUND, child=flap.end, anchor=(1.3, 0, 0.5))
    b.add_probe("tip", flap.end)
    return b, flap


def chain():
    """Links of one T10 cell on revolute joints: more coupled rows than fit one inverse, swept by colour."""
    b = wf.ModelBuilder()
    law = wf.SVK(E=1e7, nu=0.3, density=1000.0)
    end: Any = wf.GROUND
    for k in range(16):
        mesh = wf.mesh.box((0.1, 0.05, 0.05), cells=(1, 1, 1))
        link = b.add_solid(mesh, transform=(np.eye(3), (0.1 * k, 0, 0)), material=law)
        whole = link.nodes(lambda X: X[:, 0] > -1.0)
        b.add_joint("revolute", parent=end, child=whole, anchor=(0.1 * k, 0.025, 0.025), axis=(0, 1, 0))
        end = whole
    b.add_probe("tip", end)
    return b, link


ANCF: dict[str, Callable[[], tuple[wf.ModelBuilder, wf.Body]]] = {
    "3243 tied": lambda: beam("tied"),
    "3243 split": lambda: beam("split"),
    "3243 full": lambda: beam("full"),
    "3443 tied": lambda: plate("tied"),
    "3443 full": lambda: plate("full"),
    **{name: partial(solid, name) for name in ("ENMC", "FN", "FN18", "H3843")},
}
CASES: dict[str, Callable[[], tuple[wf.ModelBuilder, wf.Body]]] = {
    "S3 svk tet4": lambda: cantilever(),
    "S3 svk tet5_paper": lambda: cantilever(quadrature="tet5_paper"),
    "S3 svk damped incremental": lambda: cantilever(wf.SVK(**SVK, damping=DAMPING["incremental"])),
    "S3 svk damped rate": lambda: cantilever(wf.SVK(**SVK, damping=DAMPING["rate"])),
    "S3 mooney-rivlin": lambda: cantilever(wf.MooneyRivlin(mu10=1e5, mu01=5e4, k=1e6, density=1000.0)),
    "S3 neo-hookean": lambda: cantilever(wf.NeoHookean(mu=3e5, k=1e6, density=1000.0)),
    "curved rod, all loads": loaded,
    **ANCF,
    "mechanism": mechanism,
    "T10 chain": chain,
}


STEPS = 100
CONSTRAINT_TOL = {"float64": 1e-13, "float32": None}
"""Tolerance for nearly dependent rows of a weld: the default's residual violation, 1e-8 of the size, is path
dependent.
"""


def simulate(case, device, dtype="float64", steps=100, integrator="backward_euler", tol=None, worlds=1, dt=1e-3):
    """Tip displacement over time (worlds, steps, 3) and the last report, of one case on one device."""
    b, body = CASES[case]()
    model = b.finalize(device=device, dtype=dtype, worlds=worlds)
    tol = tol or (1e-12 if dtype == "float64" else None)
    solver = wf.NewtonPCG(tol=tol)
    sim = wf.Simulation(model, dt=dt, integrator=integrator, solver=solver, constraint_tol=CONSTRAINT_TOL[dtype])
    start = clock.perf_counter()
    report = sim.step(steps)
    wall = (clock.perf_counter() - start) / steps
    return sim.probe("tip").displacement, report, wall, sim


def compare(case, integrator="backward_euler", steps=STEPS, cuda="cuda:0"):
    """One row: difference of CUDA and CPU in both precisions, relative to the tip's travel."""
    row = {"case": case, "integrator": integrator, "steps": steps, "tol_float64": 1e-12}
    reference, _, wall, _ = simulate(case, "cpu", steps=steps, integrator=integrator)
    travel = np.abs(reference).max()
    row["cpu_ms_per_step"] = 1e3 * wall
    for dtype in ("float64", "float32"):
        tip, report, wall, _ = simulate(case, cuda, dtype, steps=steps, integrator=integrator)
        row[f"cuda_{dtype}_difference"] = float(np.abs(tip - reference).max() / travel)
        row[f"cuda_{dtype}_residual"] = float(report.residual[0])
        row[f"cuda_{dtype}_ms_per_step"] = 1e3 * wall
    return row


def rows(run: Run) -> Iterator[Row]:
    """A row per case, and one of bdf2."""
    for case in CASES:
        yield compare(case, steps=run.options["steps"], cuda=run.device)
    yield compare("S3 svk tet4", integrator="bdf2", steps=run.options["steps"], cuda=run.device)


def check(run: Run) -> None:
    """UsageError without a CUDA device."""
    if not wp.get_device(run.device).is_cuda:
        raise UsageError(f"--device {run.device}: name a CUDA device, it is compared with the CPU")


TABLE = Table(
    about=__doc__,
    parts={"rows": rows},
    results={"device_agreement.json": "devices --device cuda:0 --out tests/results/device_agreement.json"},
    settings={"dt": 1e-3, "tol_float64": 1e-12},
    options={"steps": STEPS},
    device="cuda:0",
    check=check,
)
