"""Lagrange tetrahedra T4 and T10 (Paper I, Eqs. (4)-(9); node order 1-4, then edges 12, 23, 31, 14, 24, 34)."""

from __future__ import annotations

import numpy as np

from .family import Family, register
from .quadrature import TET_RULES, conical_tet

__all__ = ["T4", "T10"]

EDGES = ((0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3))

_DL = np.array([[-1.0, -1.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
_CORNERS = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])


def _bary(xi: np.ndarray) -> np.ndarray:
    return np.column_stack([1.0 - xi.sum(axis=1), xi])


def _shape4(xi: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    L = _bary(xi)
    return L[None], np.broadcast_to(_DL, (len(xi), 4, 3))[None]


def _shape10(xi: np.ndarray, nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    L = _bary(xi)
    s = np.empty((len(xi), 10))
    ds = np.empty((len(xi), 10, 3))
    s[:, :4] = L * (2.0 * L - 1.0)
    ds[:, :4] = (4.0 * L - 1.0)[:, :, None] * _DL
    for k, (a, b) in enumerate(EDGES, start=4):
        s[:, k] = 4.0 * L[:, a] * L[:, b]
        ds[:, k] = 4.0 * (L[:, a, None] * _DL[b] + L[:, b, None] * _DL[a])
    return s[None], ds[None]


T10 = register(
    Family(
        name="T10",
        cell_type="tetra10",
        node_slots=((0,),) * 10,
        shape=_shape10,
        rules={name: TET_RULES[name] for name in ("tet4", "tet5_paper", "tet14")},
        mass_rule=TET_RULES["tet14"],
        curved_mass_rule=conical_tet(4),
        vertices=_CORNERS,
        affine=True,
        node_points=np.vstack([_CORNERS, [(_CORNERS[a] + _CORNERS[b]) / 2 for a, b in EDGES]]),
    )
)

T4 = register(
    Family(
        name="T4",
        cell_type="tetra",
        node_slots=((0,),) * 4,
        shape=_shape4,
        rules={name: TET_RULES[name] for name in ("tet1", "tet4")},
        mass_rule=TET_RULES["tet4"],
        curved_mass_rule=TET_RULES["tet4"],
        vertices=_CORNERS,
        affine=True,
        node_points=_CORNERS,
    )
)
