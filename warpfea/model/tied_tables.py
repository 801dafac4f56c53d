"""Host tables of elements with tied strains."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ..materials import Material
from .assembly import HostBlock, element_chunks, orthonormal, shape_and_jacobian, shape_gradients

__all__ = ["TiedTables", "couplings", "tied_tables"]


@dataclass(eq=False)
class TiedTables:
    """Tables of elements with tied strains e_t = x_a . x_b - X_a . X_b (see kernels/elements/assumed_strain.py).

    Attributes:
        derivative_a, derivative_b: (E, n, S) derivatives of s_i along a and b at the tying points.
        X_a, X_b: (E, n, 3) X_a and X_b.
        coupling: (E, n, width) A of the energy (mu/2) e.A e.
    """

    derivative_a: np.ndarray
    derivative_b: np.ndarray
    X_a: np.ndarray
    X_b: np.ndarray
    coupling: np.ndarray


def tied_tables(host: HostBlock, elements: np.ndarray) -> TiedTables:
    """Tables of the tied part of elements of a block."""
    part, body = host.key.integral, host.body
    tying = part.tying
    assert tying is not None
    _, ds, J, _ = shape_and_jacobian(body, elements, tying.points)
    along = J
    if part.framed:
        along = orthonormal(J)
        ds = shape_gradients(ds, J) @ along
    t = np.arange(len(tying.points))
    a, b = tying.pairs.T
    coupling = _coupling(host, elements, J, [body.materials[host.material][1]])[0]
    derivative_a, derivative_b = (np.moveaxis(ds[:, t, :, k], 0, 1) for k in (a, b))
    X_a, X_b = (np.moveaxis(along[:, t, :, k], 0, 1) for k in (a, b))
    return TiedTables(derivative_a, derivative_b, X_a, X_b, coupling)


def couplings(host: HostBlock, materials: Sequence[Material]) -> np.ndarray:
    """(materials, E, n, width) A of the tied elements of a block for other materials."""
    tying, rule = host.key.tying, host.key.rule
    assert tying is not None
    members = element_chunks(host.body, host.elements, len(rule.weights))
    tables = [_coupling(host, e, shape_and_jacobian(host.body, e, tying.points)[2], materials) for e in members]
    return np.concatenate(tables, axis=1)


def _coupling(host: HostBlock, elements: np.ndarray, J: np.ndarray, materials: Sequence[Material]) -> np.ndarray:
    part, body = host.key.integral, host.body
    tying = part.tying
    assert tying is not None
    _, _, J_rule, det = shape_and_jacobian(body, elements, part.rule.points)
    return np.stack([tying.coupling(J, J_rule, det, part.rule, material, body.section) for material in materials])
