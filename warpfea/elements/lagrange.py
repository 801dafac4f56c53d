"""Lagrange tetrahedra T4 and T10, Eqs. (4)-(9); nodes are corners 1-4, then edges 12, 23, 31, 14, 24, 34."""

import numpy as np

from ..mesh.cells import TET_EDGES, TET_FACES, barycentric, tet4_gradients, tet10_gradients
from .family import Family, VtkSubdivision, register
from .quadrature import TET_RULES, conical_tet, triangle_6

__all__ = ["T4", "T10", "TET_CORNERS", "TET_FACES"]

TET_CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
TET_EDGE_MIDPOINTS = np.array([(TET_CORNERS[a] + TET_CORNERS[b]) / 2 for a, b in TET_EDGES])
TET_FACE_CORNERS = tuple(TET_CORNERS[list(face)] for face in TET_FACES)
QUADRATIC_SUBDIVISION = VtkSubdivision(np.vstack([TET_CORNERS, TET_EDGE_MIDPOINTS]), "tetra10", np.arange(10)[None])


def _linear_shape_functions(xi: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return barycentric(xi)[None], tet4_gradients(xi)[None]


def _quadratic_shape_functions(xi: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    L = barycentric(xi)
    a, b = TET_EDGES.T
    return np.concatenate([L * (2.0 * L - 1.0), 4.0 * L[:, a] * L[:, b]], axis=1)[None], tet10_gradients(xi)[None]


T10 = register(
    Family(
        name="T10",
        cell_type="tetra10",
        node_slots=((0,),) * 10,
        shape=_quadratic_shape_functions,
        rules={name: TET_RULES[name] for name in ("tet4", "tet5_paper", "tet8", "tet14")},
        curved_rule=TET_RULES["tet8"],
        mass_rule=TET_RULES["tet14"],
        curved_mass_rule=conical_tet(4),
        vertices=TET_CORNERS,
        affine=True,
        faces=TET_FACE_CORNERS,
        face_rule=triangle_6(),
        face_divisions=((2, 2),) * 4,
        node_samples=QUADRATIC_SUBDIVISION.points[:, None],
        vtk_subdivision=QUADRATIC_SUBDIVISION,
    )
)

T4 = register(
    Family(
        name="T4",
        cell_type="tetra",
        node_slots=((0,),) * 4,
        shape=_linear_shape_functions,
        rules={name: TET_RULES[name] for name in ("tet1", "tet4")},
        curved_rule=TET_RULES["tet1"],
        mass_rule=TET_RULES["tet4"],
        curved_mass_rule=conical_tet(3),
        vertices=TET_CORNERS,
        affine=True,
        faces=TET_FACE_CORNERS,
        face_rule=triangle_6(),
        face_divisions=((1, 1),) * 4,
        node_samples=TET_CORNERS[:, None],
        vtk_subdivision=VtkSubdivision(TET_CORNERS, "tetra", np.arange(4)[None]),
    )
)
