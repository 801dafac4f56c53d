"""Patch tests on tetrahedra of aspect ratio 1e4."""

from typing import Any

import numpy as np

import warpfea as wf
from warpfea.mesh.cells import CELL_TYPES

from ..build import StepStats, finalize, relative_error
from ..case import Answer, Setting, case

ASPECT = 1e4
SLIVER_HEIGHT = 1.0 / (3.0 * ASPECT)
"""Height of the middle layer, m; its cells are a third of a metre long."""
DISPLACEMENT_GRADIENT = np.array([[0.10, 0.05, 0.0], [0.0, -0.05, 0.08], [0.02, 0.0, 0.07]])
"""Displacement gradient of the affine motion."""
LAW = wf.SVK(E=1e6, nu=0.3)


def _sliver_mesh(element: str) -> Any:
    """A unit cube of 3 x 3 x 3 cells with a thin middle layer; its inner nodes shifted along the layer."""
    rng = np.random.default_rng(0)
    mesh = wf.mesh.box((1, 1, 1), cells=(3, 3, 3), element="T10" if element == "T10" else "T4")
    points = mesh.points.copy()
    levels = np.array([0.0, 0.5 - SLIVER_HEIGHT / 2, 0.5 + SLIVER_HEIGHT / 2, 1.0])
    points[:, 2] = np.interp(points[:, 2], np.linspace(0.0, 1.0, 4), levels)
    corners = np.unique(mesh.cells[:, :4])
    inner = corners[((mesh.points[corners] > 1e-9) & (mesh.points[corners] < 1 - 1e-9)).all(axis=1)]
    points[inner, :2] += rng.uniform(-0.08, 0.08, (len(inner), 2))
    if element == "T10":
        a, b = CELL_TYPES["tetra10"].edges.T
        points[mesh.cells[:, 4:]] = 0.5 * (points[mesh.cells[:, a]] + points[mesh.cells[:, b]])
    return wf.mesh.Mesh(points, mesh.cells, mesh.cell_type)


@case("slivers", "Meshes", values=("T4", "T10", "ENMC", "FN18"), quick="both",
      refusal={"float32": ("float32 round-off limit reached",)})  # fmt: skip
def sliver_patch_test(setting: Setting, element: str) -> Answer:
    """The boundary of a cube with a layer of slivers, aspect 1e4, is moved affinely; inner nodes start off their place.

    The offset is a third of a sliver's height, 0.03 for gradients. Criterion: relative stress error.
    """
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(_sliver_mesh(element), element=element, material=LAW)
    points = body.mesh.points
    outer = body.nodes(np.unique(body.mesh.faces(body.mesh.boundary())))
    b.clamp(outer)
    b.set_initial(body, displacement=lambda X: X @ DISPLACEMENT_GRADIENT.T)
    model = finalize(b, setting)
    state = model.state()
    exact = state.displacement.numpy()[0].astype(float)
    height = np.where(body.slot_kind == 0, SLIVER_HEIGHT / 3.0, 0.03)[:, None]
    noise = height * np.random.default_rng(1).uniform(-1.0, 1.0, exact.shape)
    start = exact + noise * model.free_slots.reshape(exact.shape)
    state.displacement.assign(start[None].astype(state.displacement.numpy().dtype))
    stats = StepStats()
    result = wf.solve_static(model, load_steps=1, state=state, tol=None if setting.single else 1e-11, outputs=[stats])
    got = result.state.displacement.numpy()[0]
    F = np.eye(3) + DISPLACEMENT_GRADIENT
    lam, mu = LAW.lame
    strain = 0.5 * (F.T @ F - np.eye(3))
    sigma = F @ (lam * np.trace(strain) * np.eye(3) + 2.0 * mu * strain) @ F.T / np.linalg.det(F)
    sigma = sigma[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
    stress = max(relative_error(s, np.broadcast_to(sigma, s.shape)) for _, s in model.evaluation.stresses(result.state))
    positions = body.slot_kind == 0
    return Answer(relative_error(got[positions], exact[positions]), 1e-5 if setting.single else 1e-8, "affine motion",
                  **stats.answer_fields, limits={"stress": (stress, 0.05 if setting.single else 1e-6)},
                  note=f"{len(points)} nodes, {len(points) - len(outer)} of them free")  # fmt: skip
