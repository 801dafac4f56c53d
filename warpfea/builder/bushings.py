"""Bushings as springs along axes of both ends, chords between these axes, and dampers of their products."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..base.checks import float_array
from ..base.errors import ModelError
from ..kernels.terms.springs import CHORD, TRAVEL
from ..model.joints import Vector
from ..model.springs import Bushing, Spring, bushing_parts
from .attachments import Attachment, make_attachment

__all__ = ["make_bushing"]

ORTHONORMAL = 1e-9
"""Tolerance of orthonormal axes."""


def make_bushing(
    what: str, name: str, first: Any, second: Any, stiffness: Any, damping: Any, axes: Any
) -> Bushing:  # fmt: skip
    """A bushing and its springs; see ModelBuilder.add_bushing."""
    k, c = (_six_values(what, label, values) for label, values in (("stiffness", stiffness), ("damping", damping)))
    if not k.any() and not c.any():
        raise ModelError(f"{what}: stiffness and damping are all 0")
    e = np.eye(3) if axes is None else float_array(axes)
    if e.shape != (3, 3) or np.abs(e @ e.T - np.eye(3)).max() > ORTHONORMAL or np.linalg.det(e) < 0.0:
        raise ModelError(f"{what}: axes = {axes!r} must be (3, 3) rows, orthonormal and right-handed")
    P, Q = _ends(what, first, second, e)
    gap = Q.position(Q.X, what) - P.position(P.X, what)
    a, b = ([end.direction(n, what) for n in e] for end in (P, Q))
    between, out = f"{P.label} and {Q.label}", list[Spring]()

    vectors: list[list[tuple[Vector, ...]]] = [[(gap, x), (gap, y)] for x, y in zip(a, b)]
    vectors += [[(x - y,)] for x, y in zip(a, b)]
    vectors += [[(x, y)] for x in a for y in b]
    values = np.stack([bushing_parts(k, damping=False), bushing_parts(c, damping=True)], axis=1)
    built = np.asarray(values.any(axis=1))
    built[3:6] |= k[3:].any()  # one of them vanishes where k_5 + k_6 = k_4: other values may need it
    built[6::4] |= c[3:].any()
    parts = np.flatnonzero(built).tolist()
    for part in parts:
        kind, items = CHORD if 3 <= part < 6 else TRAVEL, vectors[part]
        rest = float(items[0][0].value @ items[0][1].value) if kind == TRAVEL else 0.0
        stiffness, damping = map(float, values[part])
        scale = np.ones(len(items))
        out.append(Spring(name, kind, items, stiffness, damping, rest, scale, between=between, keys={}))
    return Bushing(name, out, parts, Q.position(Q.X, what))


def _ends(what: str, first: Any, second: Any, axes: np.ndarray) -> tuple[Attachment, Attachment]:
    """Both ends, the ground at the place of the other one. ModelError, or NotImplementedError, for unfit ones."""
    P, Q = (make_attachment(end, f"{what}: {label}", child=label == "second")
            for end, label in ((first, "first"), (second, "second")))  # fmt: skip
    if P.body is None and Q.body is None:
        raise ModelError(f"{what}: neither of its ends is on a body")
    if P.coincides_with(Q):
        raise ModelError(f"{what}: both ends are the same place, {P.label}")
    if P.body is None and np.isnan(P.X).any():
        P = replace(P, X=Q.X)
    if Q.body is None and np.isnan(Q.X).any():
        Q = replace(Q, X=P.X)
    for end in (P, Q):
        if max(end.weakness(n) for n in axes) >= 1.0:
            raise NotImplementedError(
                f"{what}: {end.label}, a beam, a shell or nodes without a rotation, carries moments about some axes "
                "only: bushings on these are not part of this version; weld a rigid part to it and give a point of that"
            )
    return P, Q


def _six_values(what: str, label: str, values: Any) -> np.ndarray:
    out = float_array(values)
    out = np.full(6, float(out)) if out.shape == () else out
    if out.shape != (6,) or not np.all(np.isfinite(out) & (out >= 0.0)):
        raise ModelError(f"{what}: {label} = {values!r} must be six values, 0 or more, or one for all")
    return out
