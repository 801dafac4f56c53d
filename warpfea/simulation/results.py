"""Results at the current state: positions, velocities, fields, drawn surface."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..model.bodies import Body
from ..model.state import State
from ..model.surfaces import reference_points
from ..terms.fields import field_at_nodes, field_at_points, find_field
from ..terms.term import FieldSpec

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["Results"]

MAX_NAMED_BODIES = 5
"""Maximum number of bodies named in a message."""


class Results:
    """Results of the present state of a model. Nodal results are in the mesh file's order, worlds first."""

    def __init__(self, model: Model, state: State) -> None:
        self.model, self.state = model, state

    def check_body(self, body: Any, what: str) -> None:
        """Raise ModelError unless `body` is the handle of a body of this model; the text begins with `what`."""
        if not isinstance(body, Body):
            names = ", ".join(repr(b.name) for b in self.model.bodies[:MAX_NAMED_BODIES])
            names += (
                f" and {len(self.model.bodies) - MAX_NAMED_BODIES} more"
                if len(self.model.bodies) > MAX_NAMED_BODIES
                else ""
            )
            raise ModelError(
                f"{what}: expected a body, by the handle that add_solid, add_beam or add_shell returned (of {names}), "
                f"got {body!r}"
            )
        if body not in self.model.bodies:
            raise ModelError(f"{what}: body {body.name!r} is not of this model")

    def at_mesh_nodes(self, body: Body, values: np.ndarray) -> np.ndarray:
        """Slot values at mesh nodes, (B, nodes, 3); 0 at nodes without an element."""
        out = np.zeros((self.model.worlds, len(body.mesh.points), 3))
        used = body.mesh.used_nodes
        out[:, used] = values[:, body.slot_offset + body.node_slot[used]]
        return out

    def displacements(self, body: Body) -> np.ndarray:
        """Nodal displacements (B, nodes, 3), m, in the mesh file's node order. ModelError for a body of another
        model."""
        self.check_body(body, "displacements")
        return self.at_mesh_nodes(body, self.state.displacement.numpy())

    def positions(self, body: Body) -> np.ndarray:
        """Nodal positions (B, nodes, 3), m. ModelError for a body of another model."""
        self.check_body(body, "positions")
        return body.mesh.points + self.displacements(body)

    def velocities(self, body: Body) -> np.ndarray:
        """Nodal velocities (B, nodes, 3), m/s. ModelError for a body of another model."""
        self.check_body(body, "velocities")
        return self.at_mesh_nodes(body, self.state.velocity.numpy())

    def point_positions(self, body: Body, weights: Any) -> np.ndarray:
        """Current positions (B, P, 3), m, of material points given by sparse weights (P, slots of the body)."""
        u = self.state.displacement.numpy()[:, body.slots].astype(float)
        return reference_points(body, weights) + np.stack([weights @ row for row in u])

    def skin_points(self, body: Body) -> np.ndarray:
        """Points (B, skin points, 3), m, of the drawn surface."""
        return self.point_positions(body, body.skin.slot_weights)

    def skin_field(self, name: str, body: Body) -> np.ndarray:
        """Scalar field (B, skin points) at the drawn surface."""
        return self.field_on(name, body, body.skin)

    def collider_poses(self) -> tuple[np.ndarray, np.ndarray, np.ndarray] | None:
        """Collider poses: positions (B, K, 3), m, rotations (B, K, 3, 3) with the shape's axes in the world as columns,
        and surface offsets (B, K), m; None for a model without contact."""
        term = self.model.terms.contact
        return term.poses(self.state) if term else None

    @property
    def fields(self) -> dict[str, FieldSpec]:
        """Available scalar fields, by name."""
        return self.model.terms.fields

    def check_field(self, name: str) -> None:
        """Raise ModelError, listing the available names, unless `name` is a field."""
        find_field(self.model.terms, name)

    def field_on(self, name: str, body: Body, drawn: Any) -> np.ndarray:
        """Scalar field (B, P) at the points of a Skin or Drawing of the body."""
        return field_at_points(self.model.terms, name, body, self.state, drawn)

    def field(self, name: str, body: Body) -> np.ndarray:
        """Scalar nodal field (B, nodes): "von_mises" (Pa, of the elastic Cauchy stress), "displacement" (m), "J"
        (det F), "strain_energy_density" (J/m^3, mean of the elements at a node), or one of a term: with contact
        "contact_pressure" (Pa, elastic, 0 away from contact) and "gap" (m, NaN off surfaces in contact).

        The stress at a beam node is the maximum over the corners of its section, at a shell node over its two faces.
        """
        self.check_body(body, "field(name, body)")
        return field_at_nodes(self.model.terms, name, body, self.state)

    def node_gradients(self, body: Body) -> np.ndarray:
        """Deformation gradient F (B, nodes, 3, 3) at the nodes of a body with gradient slots; NaN at others.

        For a beam or shell, F maps the node's reference axes (body.node_axes) to the present ones.
        """
        self.check_body(body, "node_gradients")
        if not body.family.has_gradients:
            raise ModelError(
                f"body {body.name!r}: element {body.family.name} has no nodal gradients (F at nodes exists for ANCF "
                "elements only)"
            )
        out = np.full((self.model.worlds, len(body.mesh.points), 3, 3), np.nan)
        u = self.state.displacement.numpy()[:, body.slots].astype(float)
        nodes = np.flatnonzero(body.node_slot_count == 4)
        rows = body.node_slot[nodes][:, None] + np.arange(1, 4)
        out[:, nodes] = np.eye(3) + np.einsum("bnkc,nkd->bncd", u[:, rows], body.reference[rows])
        return out
