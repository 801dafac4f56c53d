"""Lagrange tetrahedra T4 and T10, Eqs. (4)-(9); nodes are corners 1-4, then edges 12, 23, 31, 14, 24, 34."""

from __future__ import annotations

import numpy as np

from ..mesh.cells import TET_EDGES, barycentric, tet4_gradients, tet10_gradients
from .family import Family, Parent, VtkSubdivision, register
from .quadrature import TET_RULES, conical_tet, triangle_6

__all__ = ["CORNERS", "FACES", "T4", "T10"]

CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
MIDDLES = np.array([(CORNERS[a] + CORNERS[b]) / 2 for a, b in TET_EDGES])
FACES = ((0, 2, 1), (0, 1, 3), (1, 2, 3), (0, 3, 2))
"""Corners of each face, outward, in the order of the mesh's local faces."""
TET_SIDES = tuple(CORNERS[list(face)] for face in FACES)
QUADRATIC = VtkSubdivision(np.vstack([CORNERS, MIDDLES]), "tetra10", np.arange(10)[None])


def _shape4(xi: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return barycentric(xi)[None], tet4_gradients(xi)[None]


def _shape10(xi: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    L = barycentric(xi)
    a, b = TET_EDGES.T
    return np.concatenate([L * (2.0 * L - 1.0), 4.0 * L[:, a] * L[:, b]], axis=1)[None], tet10_gradients(xi)[None]


T10 = register(
    Family(
        name="T10",
        cell_type="tetra10",
        node_slots=((0,),) * 10,
        shape=_shape10,
        rules={name: TET_RULES[name] for name in ("tet4", "tet5_paper", "tet8", "tet14")},
        curved_rule=TET_RULES["tet8"],
        mass_rule=TET_RULES["tet14"],
        curved_mass_rule=conical_tet(4),
        vertices=CORNERS,
        affine=True,
        parent=Parent(),
        faces=TET_SIDES,
        face_rule=triangle_6(),
        divisions=((2, 2),) * 4,
        node_samples=QUADRATIC.points[:, None],
        vtk_subdivision=QUADRATIC,
    )
)

T4 = register(
    Family(
        name="T4",
        cell_type="tetra",
        node_slots=((0,),) * 4,
        shape=_shape4,
        rules={name: TET_RULES[name] for name in ("tet1", "tet4")},
        curved_rule=TET_RULES["tet1"],
        mass_rule=TET_RULES["tet4"],
        curved_mass_rule=conical_tet(3),
        vertices=CORNERS,
        affine=True,
        parent=Parent(),
        faces=TET_SIDES,
        face_rule=triangle_6(),
        divisions=((1, 1),) * 4,
        node_samples=CORNERS[:, None],
        vtk_subdivision=VtkSubdivision(CORNERS, "tetra", np.arange(4)[None]),
    )
)
