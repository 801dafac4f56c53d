"""Patch tests on tetrahedra of aspect ratio 1e4."""

from __future__ import annotations

from typing import Any

import numpy as np

import warpfea as wf
from warpfea.mesh.cells import CELL_TYPES

from ..build import Count, finalize, off
from ..case import Answer, Setting, case

ASPECT = 1e4
SLIVER = 1.0 / (3.0 * ASPECT)
"""Height of the middle layer, m; its cells are a third of a metre long."""
STRAIN = np.array([[0.10, 0.05, 0.0], [0.0, -0.05, 0.08], [0.02, 0.0, 0.07]])
"""Displacement gradient of the affine motion."""
LAW = wf.SVK(E=1e6, nu=0.3)


def _mesh(element: str) -> Any:
    """A unit cube of 3 x 3 x 3 cells with a thin middle layer; its inner nodes shifted along the layer."""
    rng = np.random.default_rng(0)
    mesh = wf.mesh.box((1, 1, 1), cells=(3, 3, 3), element="T10" if element == "T10" else "T4")
    P = mesh.points.copy()
    levels = np.array([0.0, 0.5 - SLIVER / 2, 0.5 + SLIVER / 2, 1.0])
    P[:, 2] = np.interp(P[:, 2], np.linspace(0.0, 1.0, 4), levels)
    corners = np.unique(mesh.cells[:, :4])
    inner = corners[((mesh.points[corners] > 1e-9) & (mesh.points[corners] < 1 - 1e-9)).all(axis=1)]
    P[inner, :2] += rng.uniform(-0.08, 0.08, (len(inner), 2))
    if element == "T10":
        a, b = CELL_TYPES["tetra10"].edges.T
        P[mesh.cells[:, 4:]] = 0.5 * (P[mesh.cells[:, a]] + P[mesh.cells[:, b]])
    return wf.mesh.Mesh(P, mesh.cells, mesh.cell_type)


@case("slivers", "Meshes", values=("T4", "T10", "ENMC", "FN18"), quick="both",
      refusal={"float32": ("float32 round-off limit reached",)})  # fmt: skip
def slivers(setting: Setting, element: str) -> Answer:
    """The boundary of a cube with a layer of slivers, aspect 1e4, is moved affinely; inner nodes start off their place.

    The offset is a third of a sliver's height, 0.03 for gradients. Criterion: relative stress error.
    """
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(_mesh(element), element=element, material=LAW)
    P = body.mesh.points
    outer = body.nodes(np.unique(body.mesh.faces(body.mesh.boundary())))
    b.clamp(outer)
    b.set_initial(body, displacement=lambda X: X @ STRAIN.T)
    model = finalize(b, setting)
    state = model.state()
    exact = state.displacement.numpy()[0].astype(float)
    height = np.where(body.slot_kind == 0, SLIVER / 3.0, 0.03)[:, None]
    noise = height * np.random.default_rng(1).uniform(-1.0, 1.0, exact.shape)
    start = exact + noise * model.free_slots.reshape(exact.shape)
    state.displacement.assign(start[None].astype(state.displacement.numpy().dtype))
    count = Count()
    result = wf.solve_static(model, load_steps=1, state=state, tol=None if setting.single else 1e-11, outputs=[count])
    got = result.state.displacement.numpy()[0]
    F = np.eye(3) + STRAIN
    lam, mu = LAW.lame
    strain = 0.5 * (F.T @ F - np.eye(3))
    sigma = F @ (lam * np.trace(strain) * np.eye(3) + 2.0 * mu * strain) @ F.T / np.linalg.det(F)
    sigma = sigma[[0, 1, 2, 1, 0, 0], [0, 1, 2, 2, 2, 1]]
    stress = max(off(s, np.broadcast_to(sigma, s.shape)) for _, s in model.evaluation.stresses(result.state))
    places = body.slot_kind == 0
    return Answer(off(got[places], exact[places]), 1e-5 if setting.single else 1e-8, "affine motion", **count.fields,
                  limits={"stress": (stress, 0.05 if setting.single else 1e-6)},
                  note=f"{len(P)} nodes, {len(P) - len(outer)} of them free")  # fmt: skip
