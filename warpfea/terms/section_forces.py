"""Section forces of beams from the nodal forces of elements less the loads on them, and resultants of shells from the
stress at their faces, at the nodes and in the present axes of the section."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..model.assembly import facet_areas, facet_tables
from ..model.masses import element_mass_matrices
from .fields import matrix
from .term import FieldSpec

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State

__all__ = ["SECTION_FIELDS", "section_field"]

SECTION_FIELDS = {
    "section_force": FieldSpec(
        "section force", "N, N m", components=("N", "Qy", "Qz", "T", "My", "Mz"), cell_type="line"
    ),
    "shell_force": FieldSpec(
        "shell force", "N/m, N", components=("nxx", "nyy", "nxy", "mxx", "myy", "mxy"), cell_type="quad"
    ),
}
"""Of beams (y along the width, z along the height of the section), and of shells per length (x, y along the node's axes
in the surface)."""


def section_field(name: str, model: Model, body: Any, state: State) -> np.ndarray:
    """Values (worlds, nodes, 6) of a field of SECTION_FIELDS.

    Raises:
        ModelError: a body that is no beam, or no shell.
    """
    cell_type = SECTION_FIELDS[name].cell_type
    if body.mesh.cell_type != cell_type or not body.family.has_gradients:
        kind = "beams" if cell_type == "line" else "shells"
        raise ModelError(f"field {name!r} is one of {kind}; body {body.name!r} has element {body.family.name}")
    return (_of_beam if name == "section_force" else _of_shell)(model, body, state)


def _present_axes(body: Any, state: State) -> tuple[np.ndarray, np.ndarray]:
    """Present slot values (worlds, nodes, 4, 3) of each node, the position relative to itself, and orthonormal axes as
    rows (worlds, nodes, 3, 3), the first along the first gradient."""
    u = state.displacement.numpy()[:, body.slot_range].astype(float)
    rows = body.node_slot[:, None] + np.arange(4)
    values = (body.reference + u)[:, rows]
    values[:, :, 0] = 0.0
    first, second = values[:, :, 1], values[:, :, 2]
    t = first / np.linalg.norm(first, axis=2)[..., None]
    second = second - np.einsum("bnk,bnk->bn", second, t)[..., None] * t
    second /= np.linalg.norm(second, axis=2)[..., None]
    return values, np.stack([t, second, np.cross(t, second)], axis=2)


def _element_loads(model: Model, body: Any, state: State) -> np.ndarray:
    """Consistent loads (worlds, elements, slots, 3) of weight, inertia, tractions and pressure on side faces, contact
    and body forces on each element, so that the nodal forces less these are the resultants at its ends."""
    out = np.zeros((model.worlds, *body.connectivity.shape, 3))
    known = state.step_loads()
    if known is None:
        return out
    pull, law_values = known[0][:, body.slot_range], known[1]
    if pull.any():
        index = [b is body for b in model.bodies].index(True)
        for k in range(len(body.materials)):
            scale = model.masses.scales[index, k][:, None, None, None]
            for part, mass, _ in element_mass_matrices(body, k):
                out[:, part] += scale * np.einsum("eij,bejc->beic", mass, pull[:, body.connectivity[part]])
    for surface, law in model.terms.dead_loads.tractions:
        if surface.body is body and len(surface):
            tables = facet_tables(surface)
            weights = np.einsum("fq,fqi->fi", facet_areas(body, tables), tables.shape)
            elements = surface.faces[:, 0]
            slots = np.argmax(body.connectivity[elements][:, None] == tables.conn[:, :, None], axis=2)
            second = slots >= out.shape[2] // 2
            side = ((weights != 0.0) & second).any(axis=1) & ((weights != 0.0) & ~second).any(axis=1)  # no end face
            weights = np.where(side[:, None], weights, 0.0)
            at: Any = slice(None), elements[:, None], slots
            np.add.at(out, at, weights[:, :, None] * law_values[:, law, None, None])
    for conn, forces in known[2]:
        _add_items(out, body, conn - body.slot_offset, forces)
    return out


def _add_items(out: np.ndarray, body: Any, conn: np.ndarray, forces: np.ndarray) -> None:
    """Add forces (worlds, items, k, 3) on slots (items, k) of a body to the element that holds them; those on one node
    act at it."""
    nodes = len(body.mesh.points)
    node = np.full(body.slot_count + 1, nodes)
    node[body.node_slot[:, None] + np.arange(4)] = np.arange(nodes)[:, None]
    inside = ((conn >= 0) & (conn < body.slot_count)).all(axis=1)
    acting = inside[:, None] & (forces != 0.0).any(axis=(0, 3))
    at = node[np.where(acting, conn, -1)]
    low, high = at.min(axis=1), np.where(acting, at, -1).max(axis=1)
    pairs = np.sort(body.mesh.cells, axis=1)
    order = np.lexsort(pairs.T[::-1])
    number = pairs[order] @ np.array([nodes + 1, 1])
    wanted = low * (nodes + 1) + high
    found = np.searchsorted(number, wanted).clip(max=len(number) - 1)
    items = np.flatnonzero((low < high) & (number[found] == wanted))
    elements = order[found[items]]
    slots = np.argmax(body.connectivity[elements][:, None] == conn[items][:, :, None], axis=2)
    index: Any = slice(None), elements[:, None], slots
    np.add.at(out, index, forces[:, items])


def _of_beam(model: Model, body: Any, state: State) -> np.ndarray:
    """Force and moment of the beam after a node on the part before it; at the end those of the load on the beam."""
    forces = model.evaluation.element_forces(state, body) - _element_loads(model, body, state)
    values, axes = _present_axes(body, state)
    out = np.zeros((model.worlds, len(body.mesh.points), 2, 3))
    cells, slots = body.mesh.cells, forces.shape[2] // 2
    for end, sign in ((1, 1.0), (0, -1.0)):  # the element after a node counts where there is one
        at = cells[:, end]
        f = sign * forces[:, :, end * slots : (end + 1) * slots]
        out[:, at, 0] = f[:, :, 0]
        out[:, at, 1] = np.cross(values[:, at], f).sum(axis=2)
    return np.einsum("bnik,bnck->bnci", axes, out).reshape(*out.shape[:2], 6)


def _of_shell(model: Model, body: Any, state: State) -> np.ndarray:
    """Membrane forces and moments: integrals over the thickness of the stress, linear between the faces."""
    stress = model.evaluation.samples.at_samples("stress", state, body)
    stress = matrix(stress.reshape(len(stress), -1, 2, 6))
    _, axes = _present_axes(body, state)
    local = np.einsum("bnik,bnfkl,bnjl->bnfij", axes, stress, axes)
    thickness = np.zeros(len(body.mesh.points))
    thickness[body.mesh.cells] = np.linalg.norm(body.frames[..., 2], axis=2)
    t = thickness[:, None, None]
    n = 0.5 * t * (local[:, :, 1] + local[:, :, 0])
    m = t**2 / 12.0 * (local[:, :, 1] - local[:, :, 0])
    return np.stack([x[..., i, j] for x in (n, m) for i, j in ((0, 0), (1, 1), (0, 1))], axis=2)
