"""Fields of a model: the registry of those of the elements, and values of any field at nodes and drawn points.

Each field is declared once, in `fields` of a term. Those of the elements are functions of the quantities of samples.py,
sampled first; others are evaluated by `samples` of their term.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..base.names import check_known, did_you_mean
from .term import FieldSpec

if TYPE_CHECKING:
    from ..model.state import State

__all__ = [
    "ELEMENT_FIELDS", "MATRIX", "SYMMETRIC", "VECTOR", "check_scalar", "field_at_nodes", "field_at_points",
    "field_drawn", "field_inside", "find_field", "matrix", "von_mises",
]  # fmt: skip

VECTOR = ("x", "y", "z")
SYMMETRIC = ("xx", "yy", "zz", "yz", "xz", "xy")
MATRIX = tuple(i + j for i in VECTOR for j in VECTOR)
"""Names of components."""


def von_mises(s: np.ndarray) -> np.ndarray:
    """Von Mises stress of Voigt stresses [..., 6]."""
    xx, yy, zz, yz, xz, xy = np.moveaxis(s, -1, 0)
    normal = 0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2)
    return np.sqrt(normal + 3.0 * (yz**2 + xz**2 + xy**2))


def matrix(values: np.ndarray) -> np.ndarray:
    """(..., 3, 3) of six components in Voigt order, or of nine."""
    index = [0, 5, 4, 5, 1, 3, 4, 3, 2] if values.shape[-1] == 6 else range(9)
    return values[..., list(index)].reshape(*values.shape[:-1], 3, 3)


def voigt(A: np.ndarray) -> np.ndarray:
    """(..., 6) of symmetric (..., 3, 3)."""
    return np.stack([A[..., i, j] for i, j in ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))], axis=-1)


def _transposed(A: np.ndarray) -> np.ndarray:
    return np.swapaxes(A, -1, -2)


def _inverse(F: np.ndarray) -> np.ndarray:
    """F^-1; NaN where there is none."""
    det = np.linalg.det(F)
    good = np.isfinite(det) & (det != 0.0)
    inverse = np.linalg.inv(np.where(good[..., None, None], F, np.eye(3)))
    return np.where(good[..., None, None], inverse, np.nan)


def first_piola(q: np.ndarray) -> np.ndarray:
    """P = J sigma F^-T, row by row, of stress and gradient (..., 15)."""
    F = matrix(q[..., 6:])
    P = np.linalg.det(F)[..., None, None] * matrix(q[..., :6]) @ _transposed(_inverse(F))
    return P.reshape(*q.shape[:-1], 9)


def second_piola(q: np.ndarray) -> np.ndarray:
    """S = F^-1 P."""
    return voigt(_inverse(matrix(q[..., 6:])) @ matrix(first_piola(q)))


def green_lagrange(q: np.ndarray) -> np.ndarray:
    """E = (F^T F - I) / 2."""
    F = matrix(q)
    return 0.5 * voigt(_transposed(F) @ F - np.eye(3))


def almansi(q: np.ndarray) -> np.ndarray:
    """e = (I - F^-T F^-1) / 2."""
    inverse = _inverse(matrix(q))
    return 0.5 * voigt(np.eye(3) - _transposed(inverse) @ inverse)


def _eigen(s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Principal values, largest first, and directions as rows."""
    A = matrix(s)
    good = np.isfinite(A).all(axis=(-1, -2))[..., None]
    values, vectors = np.linalg.eigh(np.where(good[..., None], A, 0.0))
    vectors = _transposed(vectors)[..., ::-1, :]
    return np.where(good, values[..., ::-1], np.nan), np.where(good[..., None], vectors, np.nan)


def principal(s: np.ndarray) -> np.ndarray:
    """Principal stresses, largest first."""
    return _eigen(s)[0]


def principal_directions(s: np.ndarray) -> np.ndarray:
    """Unit vectors of the principal stresses, one after another."""
    return _eigen(s)[1].reshape(*s.shape[:-1], 9)


def tresca(s: np.ndarray) -> np.ndarray:
    """Difference of the largest and the smallest principal stress, twice the largest shear stress."""
    values = principal(s)
    return np.asarray(values[..., 0] - values[..., 2])


def pressure(s: np.ndarray) -> np.ndarray:
    """-tr(sigma) / 3, positive in compression."""
    return np.asarray(-s[..., :3].mean(axis=-1))


def _first(values: np.ndarray) -> np.ndarray:
    return values[..., 0]


STRESS, GRADIENT = ("stress",), ("gradient",)
INVARIANTS = ("von_mises", "tresca", "pressure", "principal.1")
ELEMENT_FIELDS = {
    "von_mises": FieldSpec("von Mises stress", "Pa", None, np.maximum, function=von_mises, quantities=STRESS),
    "displacement": FieldSpec("displacement", "m", of_slots=True, function=functools.partial(np.linalg.norm, axis=-1)),
    "J": FieldSpec("volume ratio J", "", None, np.minimum, function=_first, quantities=("jacobian",)),
    "strain_energy_density": FieldSpec(
        "strain energy density", "J/m3", None, np.maximum, function=_first, quantities=("energy",)
    ),
    "viscous_dissipation": FieldSpec(
        "viscous dissipation", "W/m3", None, np.maximum, function=_first, quantities=("dissipation",)
    ),
    "tresca": FieldSpec("Tresca stress", "Pa", None, np.maximum, function=tresca, quantities=STRESS),
    "pressure": FieldSpec("pressure", "Pa", None, np.maximum, function=pressure, quantities=STRESS),
    "cauchy": FieldSpec("Cauchy stress", "Pa", components=SYMMETRIC, quantities=STRESS, scalars=INVARIANTS),
    "principal": FieldSpec(
        "principal stress", "Pa", function=principal, components=("1", "2", "3"), quantities=STRESS, scalars=INVARIANTS
    ),
    "principal_directions": FieldSpec(
        "principal directions", "", function=principal_directions, quantities=STRESS,
        components=tuple(f"{k}{c}" for k in "123" for c in VECTOR),
    ),
    "first_piola": FieldSpec(
        "first Piola-Kirchhoff stress", "Pa", function=first_piola, components=MATRIX, quantities=STRESS + GRADIENT,
        scalars=INVARIANTS,
    ),
    "second_piola": FieldSpec(
        "second Piola-Kirchhoff stress", "Pa", function=second_piola, components=SYMMETRIC,
        quantities=STRESS + GRADIENT, scalars=INVARIANTS,
    ),
    "green_lagrange": FieldSpec(
        "Green-Lagrange strain", "", function=green_lagrange, components=SYMMETRIC, quantities=GRADIENT,
        scalars=("J", "strain_energy_density"),
    ),
    "almansi": FieldSpec(
        "Almansi strain", "", function=almansi, components=SYMMETRIC, quantities=GRADIENT,
        scalars=("J", "strain_energy_density"),
    ),
    "velocity": FieldSpec("velocity", "m/s", of_slots=True, components=VECTOR),
}  # fmt: skip
"""Fields of every model."""


def find_field(terms: Any, name: Any) -> FieldSpec:
    """Specification of a field, or of a component of it, "cauchy.xx". Raises ModelError, listing the available names,
    for an unknown one."""
    whole, dot, part = name.partition(".") if isinstance(name, str) else (name, "", "")
    check_known("field", whole, terms.fields)
    spec: FieldSpec = terms.fields[whole]
    if not dot:
        return spec
    if part not in spec.components:
        known = [f"{whole}.{c}" for c in spec.components] or ["no components, as it is a scalar"]
        raise ModelError(f"field {name!r} is unknown; {whole!r} has {', '.join(known)}{did_you_mean(name, known)}")
    return _component(spec, part)


def _component(spec: FieldSpec, part: str) -> FieldSpec:
    """One component of a field as a scalar."""
    k = spec.components.index(part)

    def pick(values: np.ndarray) -> np.ndarray:
        return (values if spec.function is None else spec.function(values))[..., k]

    reduction = np.maximum if spec.quantities else spec.node_reduction
    return replace(spec, title=f"{spec.title} {part}", function=pick, components=(), node_reduction=reduction)


def check_scalar(terms: Any, name: str) -> None:
    """Raise ModelError for a field with components, where a scalar is needed."""
    spec = find_field(terms, name)
    if spec.components:
        one = f"a component such as {name}.{spec.components[0]}"
        instead = f"{', '.join(spec.scalars)}, or {one}" if spec.scalars else one
        count = len(spec.components)
        raise ModelError(f"field {name!r} has {count} components where a scalar is needed: take {instead}")


def _term_name(name: str) -> str:
    return name.partition(".")[0]


def _sample_field(terms: Any, name: str, body: Any, state: State) -> np.ndarray:
    """Samples of a field that is no function of quantities, joined over its terms; nodal values are repeated at each
    sample.

    Raises:
        ModelError: a term returns another shape.
    """
    spec, count = find_field(terms, name), body.family.node_samples.shape[1]
    nodes = len(body.mesh.points)
    rows = body.slot_count if spec.of_slots else nodes * count if spec.node_reduction else nodes
    found = []
    for term in (term for term in terms if _term_name(name) in term.fields):
        values = np.asarray(term.samples(_term_name(name), body, state))
        expected = (terms.model.worlds, rows)
        if values.shape[: 2 if spec.function or spec.components else None] != expected:
            raise ModelError(f"term {term.name!r}: samples({name!r}) gave {values.shape}; expected {expected}")
        found.append(values if spec.of_slots or spec.node_reduction else np.repeat(values, count, axis=1))
    return functools.reduce(spec.join, found) if spec.join else found[0]


def _quantities(terms: Any, spec: FieldSpec, body: Any, state: State, *options: Any) -> np.ndarray:
    """Quantities of a field side by side; `options` of `at_samples`."""
    samples = terms.evaluation.samples
    return np.concatenate([samples.at_samples(q, state, body, *options) for q in spec.quantities], axis=2)


def field_at_nodes(terms: Any, name: str, body: Any, state: State, elements: Any = None) -> np.ndarray:
    """Values (worlds, nodes) of a field, (worlds, nodes, k) of one with components.

    Args:
        elements: indices of the elements that count; NaN at other nodes.

    Raises:
        ModelError: an unknown field, or elements for one that is not of the elements.
    """
    spec, nodes = find_field(terms, name), len(body.mesh.points)
    if elements is not None and not spec.quantities:
        raise ModelError(f"field {name!r} is not of elements: leave out elements=")
    if spec.quantities:
        values = _quantities(terms, spec, body, state, None, elements)
        if spec.components:
            values = values.reshape(len(values), nodes, -1, values.shape[2]).mean(axis=2)
    else:
        values = _sample_field(terms, name, body, state)
        if spec.of_slots:
            values = body.at_nodes(values)
        elif spec.components:
            values = values.reshape(len(values), nodes, -1, values.shape[2]).mean(axis=2)
    if spec.function:
        values = spec.function(values)
    if spec.of_slots or spec.components:
        return values
    values = values.reshape(len(values), nodes, -1)
    return np.asarray(spec.node_reduction.reduce(values, axis=2) if spec.node_reduction else values[:, :, 0])


def field_at_points(
    terms: Any, name: str, body: Any, state: State, drawn: Any, worlds: Sequence[int] | None = None
) -> np.ndarray:
    """Values (worlds, points) or (worlds, points, k) of a field at the points of a Skin or Drawing of the body.

    Args:
        worlds: numbers of the worlds wanted, by default all.
    """
    spec = find_field(terms, name)
    chosen = slice(None) if worlds is None else list(worlds)
    if spec.quantities:
        count = None if worlds is None else 1 + max(worlds)
        values = _quantities(terms, spec, body, state, drawn.node_weights, None, count)[chosen]
    else:
        values = _sample_field(terms, name, body, state)[chosen]
        weights = drawn.slot_weights if spec.of_slots else drawn.node_weights
        values = np.stack([weights @ row for row in values])
    return spec.function(values) if spec.function else values


def field_drawn(
    terms: Any, name: str, body: Any, state: State, drawn: Any, worlds: Sequence[int] | None = None
) -> np.ndarray:
    """As `field_at_points`; NaN on bodies of elements that lack the field, such as section forces on solids."""
    spec = find_field(terms, name)
    if spec.cell_type in ("", body.mesh.cell_type):
        return field_at_points(terms, name, body, state, drawn, worlds)
    shape = terms.model.worlds if worlds is None else len(worlds), drawn.slot_weights.shape[0]
    return np.full((*shape, *([len(spec.components)] if spec.components else [])), np.nan)


def field_inside(terms: Any, name: str, body: Any, state: State, at: str) -> np.ndarray:
    """Values at the quadrature points (worlds, elements, points[, k]), or their means (worlds, elements[, k]).

    Raises:
        ModelError: a field that is not of the elements.
    """
    spec = find_field(terms, name)
    if not spec.quantities:
        raise ModelError(f"field {name!r} is one of nodes: leave out at={at!r}")
    samples = terms.evaluation.samples
    values = np.concatenate([samples.at_points(q, state, body) for q in spec.quantities], axis=3)
    if at == "elements":
        values = samples.element_means(values, body)
    return spec.function(values) if spec.function else values
