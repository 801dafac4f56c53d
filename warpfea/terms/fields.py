"""Scalar fields of a model: registry of the terms' fields, and their values at nodes and drawn points.

Every field is declared once, in `fields` of a term, and evaluated by its `samples`; those of the elements are here.
"""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..base.names import check_known
from .term import FieldSpec

if TYPE_CHECKING:
    from ..model.state import State

__all__ = ["ELEMENT_FIELDS", "field_at_nodes", "field_at_points", "find_field", "von_mises"]


def von_mises(s: np.ndarray) -> np.ndarray:
    """Von Mises stress of Voigt stresses [..., 6]."""
    xx, yy, zz, yz, xz, xy = np.moveaxis(s, -1, 0)
    normal = 0.5 * ((xx - yy) ** 2 + (yy - zz) ** 2 + (zz - xx) ** 2)
    return np.sqrt(normal + 3.0 * (yz**2 + xz**2 + xy**2))


ELEMENT_FIELDS = {
    "von_mises": FieldSpec("von Mises stress", "Pa", node_reduction=np.maximum, scalar=von_mises),
    "displacement": FieldSpec("displacement", "m", of_slots=True, scalar=functools.partial(np.linalg.norm, axis=-1)),
    "J": FieldSpec("volume ratio J", "", node_reduction=np.minimum),
    "strain_energy_density": FieldSpec("strain energy density", "J/m3", node_reduction=np.maximum),
}
"""Fields of every model."""


def find_field(terms: Any, name: str) -> FieldSpec:
    """Specification of a field. Raises ModelError, listing the available names, for an unknown one."""
    check_known("field", name, terms.fields)
    return terms.fields[name]


def _sample_field(terms: Any, name: str, body: Any, state: State) -> np.ndarray:
    """Samples of a field, joined over its terms; nodal values are repeated at each sample.

    Raises:
        ModelError: an unknown field, or a term returns another shape.
    """
    spec, count = find_field(terms, name), body.family.node_samples.shape[1]
    nodes = len(body.mesh.points)
    rows = body.slot_count if spec.of_slots else nodes * count if spec.node_reduction else nodes
    found = []
    for term in (term for term in terms if name in term.fields):
        values = np.asarray(term.samples(name, body, state))
        expected = (terms.model.worlds, rows)
        if values.shape[: 2 if spec.scalar else None] != expected:
            raise ModelError(f"term {term.name!r}: samples({name!r}) gave {values.shape}; expected {expected}")
        found.append(values if spec.of_slots or spec.node_reduction else np.repeat(values, count, axis=1))
    return functools.reduce(spec.join, found) if spec.join else found[0]


def field_at_nodes(terms: Any, name: str, body: Any, state: State) -> np.ndarray:
    """Values (worlds, nodes) of a field."""
    spec, values = find_field(terms, name), _sample_field(terms, name, body, state)
    if spec.scalar:
        values = spec.scalar(values)
    nodes, used = len(body.mesh.points), body.mesh.used_nodes
    if spec.of_slots:
        out = np.zeros((len(values), nodes))
        out[:, used] = values[:, body.node_slot[used]]
        return out
    values = values.reshape(len(values), nodes, -1)
    return np.asarray(spec.node_reduction.reduce(values, axis=2) if spec.node_reduction else values[:, :, 0])


def field_at_points(terms: Any, name: str, body: Any, state: State, drawn: Any) -> np.ndarray:
    """Values (worlds, points) of a field at the points of a Skin or Drawing of the body."""
    spec, values = find_field(terms, name), _sample_field(terms, name, body, state)
    weights = drawn.slot_weights if spec.of_slots else drawn.node_weights
    values = np.stack([weights @ row for row in values])
    return spec.scalar(values) if spec.scalar else values
