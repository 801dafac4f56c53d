"""Common parts of ANCF elements: monomial bases, nodal basis B^-1 b of Paper I, Cartesian gradient slots.

The functions of a family live on a parent square, cube or simplex, with slots r, r_xi, r_eta, r_zeta at each node.
Neighbours share gradients along axes of the node instead. A frame T = dX/dxi per element and node, in those axes,
transforms the functions of one into those of the other (Paper T's S* = S T; `to_node_axes`). This covers curved,
stretched or rotated elements, and elements that meet at a node share its slots for any direction of their parent lines.
"""

import functools
from collections.abc import Callable

import numpy as np

from ..base.errors import ModelError

__all__ = ["monomials", "nodal_basis", "nodal_functions", "nodal_shape_functions", "to_node_axes"]


def monomials(powers: np.ndarray, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (Q, m) and derivatives (Q, m, 3) of the monomials with exponents (m, 3) at xi (Q, 3)."""
    p = powers.astype(float)
    values = np.prod(xi[:, None, :] ** p, axis=2)
    out = np.empty((len(xi), len(p), 3))
    for k in range(3):
        lower = p.copy()
        lower[:, k] = np.maximum(lower[:, k] - 1.0, 0.0)
        out[:, :, k] = p[:, k] * np.prod(xi[:, None, :] ** lower, axis=2)
    return values, out


def nodal_basis(powers: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """B^-1 (m, m) with B = [b, b_u, b_v, b_w at each node]: the functions are s = B^-1 b, Eqs. (2b) and (3b).

    Raises:
        ModelError: the basis does not fit these nodes, e.g. that of 3443 with nodes in the u-v plane, whose B has rank
            10 of 16: with Paper I's basis the mid-surface is the u-w plane and the thickness is along v.
    """
    b, db = monomials(powers, nodes)
    columns = np.concatenate([b[:, :, None], db], axis=2)  # node, monomial, (value and three derivatives)
    B = np.moveaxis(columns, 1, 0).reshape(len(powers), -1)
    rank = int(np.linalg.matrix_rank(B))
    if B.shape[0] != B.shape[1] or rank < len(B):
        raise ModelError(
            f"ANCF basis of {len(powers)} monomials: B has rank {rank} at these {len(nodes)} nodes; the basis of 3443 "
            "needs its nodes in the u-w plane, with the thickness along v"
        )
    return np.linalg.inv(B)


def nodal_functions(powers: np.ndarray, inverse: np.ndarray, xi: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """s = B^-1 b and ds/dxi at xi (Q, 3): (Q, m), (Q, m, 3)."""
    b, db = monomials(powers, xi)
    return b @ inverse.T, np.einsum("sm,qmk->qsk", inverse, db)


def nodal_shape_functions(powers: np.ndarray, nodes: np.ndarray) -> Callable[..., tuple[np.ndarray, np.ndarray]]:
    """`Family.shape` of the functions s = B^-1 b with slots along the node's axes; B^-1 is computed on first use."""
    inverse = functools.cache(lambda: nodal_basis(powers, nodes))

    def shape(xi: np.ndarray, nodes: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return to_node_axes(*nodal_functions(powers, inverse(), xi), frames)

    return shape


def to_node_axes(s: np.ndarray, ds: np.ndarray, frames: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """From slots of parent gradients to slots along the node's axes: s_(n,k) = sum_a s_(n,a) T_n[k, a].

    Args:
        s, ds: (Q, 4 n), (Q, 4 n, 3) functions of the value and three parent gradients at each node.
        frames: (E, n, 3, 3) T = dX/dxi in the axes of the node, m.

    Returns:
        (E, Q, 4 n) and (E, Q, 4 n, 3).
    """
    E, n = frames.shape[:2]
    Q = len(s)
    a = s.reshape(Q, n, 4)
    b = ds.reshape(Q, n, 4, 3)
    out = np.empty((E, Q, n, 4))
    dout = np.empty((E, Q, n, 4, 3))
    out[..., 0] = a[None, :, :, 0]
    dout[..., 0, :] = b[None, :, :, 0]
    out[..., 1:] = np.einsum("qna,enka->eqnk", a[:, :, 1:], frames, optimize=True)
    dout[..., 1:, :] = np.einsum("qnal,enka->eqnkl", b[:, :, 1:], frames, optimize=True)
    return out.reshape(E, Q, 4 * n), dout.reshape(E, Q, 4 * n, 3)
