"""Bushings as springs along axes of both ends, chords between these axes, and dampers of their products."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from ..base.checks import float_array
from ..base.errors import ModelError
from ..kernels.terms.springs import CHORD, TRAVEL
from ..model.joints import Vector
from ..model.springs import Spring
from .attachments import Attachment, make_attachment

__all__ = ["bushing_springs"]

ORTHONORMAL = 1e-9
"""Tolerance of orthonormal axes."""


def bushing_springs(
    what: str, name: str, first: Any, second: Any, stiffness: Any, damping: Any, axes: Any
) -> list[Spring]:  # fmt: skip
    """The springs of a bushing; see ModelBuilder.add_bushing."""
    k, c = (_six_values(what, label, values) for label, values in (("stiffness", stiffness), ("damping", damping)))
    if not k.any() and not c.any():
        raise ModelError(f"{what}: stiffness and damping are all 0")
    e = np.eye(3) if axes is None else float_array(axes)
    if e.shape != (3, 3) or np.abs(e @ e.T - np.eye(3)).max() > ORTHONORMAL or np.linalg.det(e) < 0.0:
        raise ModelError(f"{what}: axes = {axes!r} must be (3, 3) rows, orthonormal and right-handed")
    P, Q = _ends(what, first, second, e)
    gap = Q.position(Q.X, what) - P.position(P.X, what)
    a, b = ([end.direction(n, what) for n in e] for end in (P, Q))
    between, out = f"{P.label} and {Q.label}", []

    def add(kind: int, items: list[tuple[Vector, ...]], stiffness: float, damping: float = 0.0) -> None:
        rest = float(items[0][0].value @ items[0][1].value) if kind == TRAVEL else 0.0
        out.append(Spring(name, kind, items, stiffness, damping, rest, np.ones(len(items)), between=between, keys={}))

    for i in range(3):
        if k[i] or c[i]:
            add(TRAVEL, [(gap, a[i]), (gap, b[i])], 0.5 * k[i], 0.5 * c[i])
    for i, chord in enumerate(_by_planes(k[3:])):
        if chord:
            add(CHORD, [(a[i] - b[i],)], chord)
    same = np.maximum(_by_planes(c[3:]), 0.0)
    for i in range(3):
        for j in range(3):
            loss = same[i] if i == j else 0.5 * c[6 - i - j]
            if loss:
                add(TRAVEL, [(a[i], b[j])], 0.0, loss)
    return out


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


def _by_planes(about: np.ndarray) -> np.ndarray:
    """Weights (3,) of the angles between axes i, whose sums over the two axes that turn about one are `about`."""
    return np.asarray(0.5 * about.sum() - about)


def _six_values(what: str, label: str, values: Any) -> np.ndarray:
    out = float_array(values)
    out = np.full(6, float(out)) if out.shape == () else out
    if out.shape != (6,) or not np.all(np.isfinite(out) & (out >= 0.0)):
        raise ModelError(f"{what}: {label} = {values!r} must be six values, 0 or more, or one for all")
    return out
