"""Tables of contacts and colliders on the device, their triangle meshes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..base.launch import Launcher
from ..base.worlds import set_rows, values_per_world
from ..kernels.contact.collider_mesh import mesh_struct
from ..kernels.contact.collider_seams import SEAMS_SUFFIX
from ..kernels.contact.colliders import MESH_SUFFIX
from ..kernels.contact.structs import collider_struct, contact_struct
from ..model import assembly
from ..model.contact_points import ContactPoints
from ..model.contacts import Collider, Contact
from ..model.pairs import FacetOptions
from ..model.rolling import RollingContact
from ..model.shapes import HalfSpace, Shape
from ..model.triangle_mesh import TriMesh
from ..terms.time_law_table import TimeLawTable
from .seams import mixed_seams, seam_tables
from .tables import WORLD_PARAMETERS, FacetTables, check_chosen_values, clamped_slots

if TYPE_CHECKING:
    from ..model.model import Model
    from ..model.state import State

__all__ = ["ContactTables", "facet_pattern_entries", "poses_by_laws", "upload_collider_meshes"]


def poses_by_laws(model: Model, laws: Sequence[tuple[Collider, int]], state: State) -> tuple[np.ndarray, np.ndarray]:
    """Positions (worlds, K, 3), m, and axes (worlds, K, 3, 3) of colliders at a state by their time laws (-1: none)."""
    value = model.terms.time_laws.values_at_state(Launcher(model.device), state)[0].numpy()
    found = [collider.poses(value[:, law]) for collider, law in laws]
    position, rotation = (np.stack(parts, axis=1) for parts in zip(*found))
    return position, rotation


class ContactTables(FacetTables[Contact]):
    """Contacts with colliders of a model, and the colliders.

    Attributes:
        colliders: descriptions. shapes: on the device, without poses. collider_laws: with the numbers of their laws.
        seams: neighbours of the contacts, None if no contact has one. mixed: seams with bodies.
        clamped_point_counts: number of points per contact excluded because all their slots are clamped.
    """

    def __init__(self, model: Model) -> None:
        super().__init__(model, model.description.contacts_of(Contact))
        self.colliders: list[Collider] = list(model.description.colliders)
        self.stored_sides = len(self.colliders)
        self.clamped = clamped_slots(model)
        self.clamped_point_counts: list[int] = []
        self.mixed = model.cache.setdefault("mixed seams", mixed_seams(model.description))
        self.seams = seam_tables(self.contacts, [p.X.reshape(-1, 3) for p in self.host], self.mixed)
        self.area_fractions = [self._area_fraction(*row) for row in zip(self.contacts, self.host, self.region_areas)]

    @property
    def has_meshes(self) -> bool:
        """True if a collider is a triangle mesh."""
        return any(isinstance(collider.shape, TriMesh) for collider in self.colliders)

    @property
    def rolls(self) -> bool:
        return any(isinstance(contact, RollingContact) for contact in self.contacts)

    def _edge_rows(self, chosen: list[int]) -> dict[str, Any]:
        begin = np.cumsum([0, *(len(self.host[k].conn) for k in chosen)])
        rolling = [
            {**contact.rolling_rows(self.host[k]), "start": start}
            for k, start in zip(chosen, begin)
            if isinstance(contact := self.contacts[k], RollingContact)
        ]
        if not rolling:
            return {}
        rows = np.concatenate([row["row"] + row["start"] for row in rolling])
        edge_row, columns, p = np.full(begin[-1], -1), len(rows) * self.model.worlds, self.host[chosen[0]]
        edge_row[rows] = np.arange(len(rows))
        tables = {name: np.concatenate([row[name] for row in rolling]) for name in ("rolling_axis", "rolling_end")}
        gradient = np.concatenate([row["rolling_gradient"] for row in rolling])
        return {
            "edge_rows": len(rows), "edge_row": edge_row, "edge_shape": np.zeros((*p.shape.shape[1:], columns)),
            "edge_X": np.zeros((p.area.shape[1], columns, 3)), "rolling_axis": tables["rolling_axis"],
            "rolling_end": tables["rolling_end"].T, "rolling_gradient": np.swapaxes(gradient, 0, 1),
        }  # fmt: skip

    @property
    def geometry(self) -> str:
        """Name of the colliders in `GEOMETRIES`."""
        return f"colliders{MESH_SUFFIX * self.has_meshes}{SEAMS_SUFFIX * (self.seams is not None)}"

    @property
    def has_sheets(self) -> bool:
        """True if a collider mesh is a sheet (no inside)."""
        return any(collider.is_sheet for collider in self.colliders)

    def _area_fraction(self, contact: Contact, p: ContactPoints, region: float) -> np.ndarray:
        """Area fraction (F, P) of each point in the contact region; 0 if all its slots are clamped."""
        slots = p.conn + contact.body.slot_offset
        moves = np.any((np.abs(p.shape) > 1e-12) & ~self.clamped[slots][:, None, :], axis=2)
        used = moves & (p.area > 0.0)
        self.clamped_point_counts.append(int((~used & (p.area > 0.0)).sum()))
        if not used.any():
            raise ModelError(
                f"contact {contact.name!r}: all points of the surface of body {contact.body.name!r} are clamped; "
                "choose another surface, or leave the contact out"
            )
        if contact.model == "sphere":
            return used.astype(float)
        return np.where(used, p.area / region, 0.0)

    def build(self, laws: TimeLawTable, pool: int) -> None:
        """Upload the tables; `pool`: first pool entry of the term."""
        self._build_facets(pool)
        self.data = contact_struct()()
        self._upload_laws(self.data, [self.law_constants(c) for c in self.contacts])
        self.shapes = self._upload_colliders(laws)
        self.store_built_values()

    def parameters(self) -> dict[str, Callable[[Any, np.ndarray], None]]:
        """Setters of the parameters of contacts and colliders."""
        narrow = [contact.sides[1] for contact in self.model.description.contacts_of(FacetOptions)]
        setters = {f"{k.name}.offset": partial(self._set_surface_offset, k) for k in self.colliders if k not in narrow}
        return super().parameters() | setters

    def _set_surface_offset(self, collider: Collider, values: Any, mask: np.ndarray) -> None:
        """Offset the surface of a collider along its normals in the chosen worlds."""
        what = f"collider {collider.name!r}"
        wanted = values_per_world(what, "offset", values, self.model.worlds)
        check_chosen_values(what, "offset", wanted, ~mask, np.isfinite(wanted))
        if isinstance(collider.shape, HalfSpace):
            wanted = wanted - collider.shape.offset
        set_rows(self.shapes.margin, (mask, self.colliders.index(collider)), wanted[mask])

    @property
    def parameter_arrays(self) -> dict[str, wp.array]:
        return super().parameter_arrays | {"margin": self.shapes.margin}

    def _upload_colliders(self, laws: TimeLawTable) -> Any:
        """Device struct of the colliders, without poses."""
        m, K = self.model, self.colliders
        out = collider_struct(self.has_meshes)()
        frames = [k.shape.frame() for k in K]
        tables: dict[str, Any] = {
            "of_contact": [K.index(c.collider) for c in self.contacts],
            "margin": np.zeros((m.worlds, len(K))),
            "kind": [k.shape.kind for k in K],
            "size": [shape_sizes(k.shape, self._contact_positions(k)) for k in K],
            "center": [center for center, _ in frames],
            "axes": [axes for _, axes in frames],
            "translation_law": [laws.add(k.law) if k.law is not None else -1 for k in K],
            "rotation_law": [laws.add(k.rotation.angle) if k.rotation is not None else -1 for k in K],
            "rotation_anchor": [k.rotation.anchor if k.rotation else np.zeros(3) for k in K],
            "rotation_axis": [k.rotation.axis if k.rotation else (0.0, 0.0, 1.0) for k in K],
        }
        laws_of = zip(tables["translation_law"], tables["rotation_law"])
        self.collider_laws = [(k, max(pair)) for k, pair in zip(K, laws_of)]
        m.memory.fill(out, "contact", **tables | (vars(self.seams) if self.seams else {}))
        if self.has_meshes:
            out.mesh = upload_collider_meshes(m, [k.shape for k in K])
        return out

    def _contact_positions(self, collider: Collider) -> list[np.ndarray]:
        """Points (n, 3), m, of the surfaces in contact with a collider."""
        return [p.X.reshape(-1, 3) for c, p in zip(self.contacts, self.host) if c.collider is collider]

    def hash(self, h: Any) -> None:
        """Hash the definition of the contacts."""
        for collider in self.colliders:
            center, axes = collider.shape.frame()
            h.update(f"{collider.name} {collider.shape.kind}".encode())
            h.update(np.concatenate([collider.shape.sizes, center, axes.ravel()]).tobytes())
            if isinstance(collider.shape, TriMesh):
                h.update(collider.shape.points.tobytes() + collider.shape.triangles.tobytes())
            if collider.rotation is not None:
                h.update(np.concatenate([collider.rotation.anchor, collider.rotation.axis]).tobytes())
        for contact, p in zip(self.contacts, self.host):
            fixed = ("surface", "collider", "edges", *WORLD_PARAMETERS)
            values = {k: v for k, v in vars(contact).items() if k not in fixed}
            h.update(f"{contact.collider.name} {sorted(values.items())}".encode())
            h.update(np.ascontiguousarray(p.faces).tobytes())
        h.update(self.built_values)


def facet_pattern_entries(model: Model, conn: np.ndarray, pattern: Any) -> tuple[wp.array, wp.array, wp.array, int]:
    """Pattern entries of the facets: entry indices, start of each item, and (facet, slot, slot)."""
    a, b = (x.ravel() for x in np.indices((conn.shape[1],) * 2))
    facet = np.repeat(np.arange(len(conn)), len(a))
    a, b = np.tile(a, len(conn)), np.tile(b, len(conn))
    chosen, entry, start = assembly.grouped_items(pattern.find_upper(conn[facet, a], conn[facet, b]))
    source = np.stack([facet[chosen], a[chosen], b[chosen]], axis=1)
    arrays = (model.array("contact", x, t) for x, t in ((entry, wp.int32), (start, wp.int32), (source, wp.vec3i)))
    return (*arrays, len(entry))  # type: ignore[return-value]


def upload_collider_meshes(model: Model, shapes: Sequence[Shape]) -> Any:
    """Device struct of all meshes among the collider shapes; a mesh used twice is stored once."""
    found = dict.fromkeys(shape for shape in shapes if isinstance(shape, TriMesh))
    out, parts = mesh_struct()(), [shape.tables for shape in found]
    boxes, leaves, triangles = (np.cumsum([0, *counts]) for counts in zip(
        *((len(p.low), len(p.start), len(p.corner[0])) for p in parts)))  # fmt: skip
    place = {shape: k for k, shape in enumerate(found)}
    index = [place.get(shape, -1) for shape in shapes]  # type: ignore[call-overload]
    tables = {
        "first_box": [boxes[k] if k >= 0 else 0 for k in index],
        "first_leaf": [leaves[k] if k >= 0 else 0 for k in index],
        "inner_count": [len(parts[k].start) - 2 if k >= 0 else 0 for k in index],
        "box_low": np.concatenate([p.low for p in parts]),
        "box_high": np.concatenate([p.high for p in parts]),
        "leaf_start": np.concatenate([p.start + n for p, n in zip(parts, triangles)]),
        "corner": np.concatenate([p.corner for p in parts], axis=1),
        "normal": np.concatenate([p.normal for p in parts], axis=1),
        "feature_kind": np.concatenate([p.border for p in parts], axis=1),
    }
    model.memory.fill(out, "contact", **tables)
    return out


def shape_sizes(shape: Shape, surfaces: Sequence[np.ndarray]) -> np.ndarray:
    """`Shape.sizes`; for a sheet the detection thickness, m: the second largest edge of the smallest bounding box of a
    surface that touches it. `surfaces`: their points, (n, 3)."""
    out = shape.sizes
    if isinstance(shape, TriMesh) and not shape.closed:
        out[1] = min((np.sort(np.ptp(X, axis=0))[1] for X in surfaces), default=out[0])
    return out
