"""Tables of contacts between bodies on the device: points of slave surfaces, facets of master surfaces."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..kernels.contact.facet_structs import edge_struct, master_struct
from ..kernels.contact.structs import contact_struct
from ..model.contact_points import element_depths, element_edge_and_depth
from ..model.contacts import Collider, Contact
from ..model.edges import Edges, edge_places, with_edges
from ..model.handles import SurfaceSet
from ..model.pairs import (
    FacetOptions,
    MasterFacets,
    bernstein_from_monomials,
    master_facets,
    monomial_exponents,
)
from .seams import LevelFacets, MixedSeam, facet_seam_tables
from .tables import TOUCHING_DEPTH_RATIO, WORLD_PARAMETERS, FacetTables, clamped_slots

if TYPE_CHECKING:
    from ..model.model import Model
    from ..terms.time_law_table import TimeLawTable

__all__ = ["PairTables"]


def refuse_offset(contact: FacetOptions, values: Any, mask: np.ndarray) -> None:
    """Raise ModelError: an offset of an obstacle whose points touch facets."""
    body, collider = contact.sides
    raise ModelError(
        f"collider {collider.name!r}: offset can't be set: its own points touch facets of body {body.name!r} (contact "
        f"{contact.name!r}), as it is narrower than these or has clipping=; take finer facets without it"
    )


class PairTables(FacetTables[FacetOptions]):
    """Contacts between bodies of a model, and of obstacles narrower than the facets of a body; points lie on the slave
    surfaces, or on the obstacles.

    Attributes:
        surfaces, masters: distinct master surfaces, and those of seams, and their facets; master_of: master surface of
            each contact. seams: neighbours of the contacts, empty if there are none. mixed: those with colliders,
            whose level faces are among the surfaces.
        facets: number of master facets. bodies: bodies in a pair.
        collider_laws: all colliders with the numbers of their time laws, if poses follow from these alone.
        carriers: obstacles that move with points on them; carrier_laws: numbers of their time laws.
        max_gap: largest reported gap, m. max_overlap_depth: search depth of initial overlaps, m.
    """

    def __init__(self, model: Model) -> None:
        super().__init__(model, model.description.contacts_of(FacetOptions))
        self.surfaces: list[Any] = []
        self.master_of = [self.number_of(contact.facets) for contact in self.contacts]
        self.mixed: list[MixedSeam] = model.cache.get("mixed seams", [])
        self.seams = facet_seam_tables(self.contacts, self.number_of, self.mixed)
        self.masters: list[MasterFacets] = [
            s.facets() if isinstance(s, LevelFacets) else master_facets(s) for s in self.surfaces
        ]
        self._check_clamped()
        self.area_fractions = [f * p.area / area for f, p, area in zip(self.factors, self.host, self.region_areas)]
        self.edges = [contact.sharp_edges() for contact in self.contacts]
        for k, edges in enumerate(self.edges):
            if edges is not None:
                self._add_edges(k, edges)
        self.facets = sum(len(m.conn) for m in self.masters)
        self.bodies = sorted({surface.body.index for c in self.contacts for surface in c.surfaces})
        self.edge_data: list[Any] = []
        moving = [c.sides[1] for c in self.contacts if c.grounded and c.sides[1].moves]
        self.carriers: list[Collider] = list(dict.fromkeys(moving))

    def number_of(self, surface: SurfaceSet | LevelFacets) -> int:
        """Number of a surface among those with facets."""
        for k, other in enumerate(self.surfaces):
            if other.body is surface.body and np.array_equal(other.faces, surface.faces):
                return k
        self.surfaces.append(surface)
        return len(self.surfaces) - 1

    def _add_edges(self, k: int, edges: Edges) -> None:
        """Add the rows of a contact's edges: the area of each is that with the stiffness of both elements' depths."""
        count, p = len(self.host[k].conn), with_edges(self.host[k], edges)
        row, number = edge_places(edges, p.area.shape[1])
        fraction = np.zeros_like(p.area)
        fraction[:count] = self.area_fractions[k]
        sharp = self.masters[self.master_of[k]].half_angle.any(axis=0)
        other = float(element_edge_and_depth(self.surfaces[self.master_of[k]])[1][sharp].min())
        fraction[count + row, number] = edges.depth * other / self.region_areas[k]
        self.host[k], self.area_fractions[k] = p, fraction

    def _edge_rows(self, chosen: list[int]) -> dict[str, Any]:
        sizes = [len(self.host[k].conn) for k in chosen]
        begin = np.cumsum(sizes) - sizes
        parts, item, number, owner = [], [], [], []
        for start, size, k in zip(begin, sizes, chosen):
            edges = self.edges[k]
            if edges is not None:
                row, place = edge_places(edges, self.host[k].area.shape[1])
                parts.append(edges)
                item.append(start + size - row[-1] - 1 + row)
                number.append(place)
                owner.append(np.where(self.contacts[k].row_per_facet, start + edges.facet, -1))
        if not parts:
            self.edge_data.append(None)
            return {}
        rows, data, p = np.unique(np.concatenate(item)), edge_struct(self.model.dtype)(), self.host[chosen[0]]
        edge_row, width = np.full(sum(sizes), -1), p.conn.shape[1]
        edge_row[rows] = np.arange(len(rows))
        shapes = [np.pad(e.shape, ((0, 0), (0, 0), (0, width - e.shape.shape[2]), (0, 0))) for e in parts]
        self.model.memory.fill(
            data, "contact", row=np.concatenate(item), number=np.concatenate(number), owner=np.concatenate(owner),
            half_angle=np.concatenate([e.half_angle for e in parts]), edge_count=sum(len(e.facet) for e in parts),
            shape=np.concatenate(shapes, axis=3), X=np.concatenate([e.X for e in parts], axis=2),
        )  # fmt: skip
        self.edge_data.append(data)
        columns = 2 * len(rows) * self.model.worlds  # and those of friction
        return {
            "edge_rows": len(rows), "edge_row": edge_row, "edge_shape": np.zeros((*p.shape.shape[1:], columns)),
            "edge_X": np.zeros((p.area.shape[1], columns, 3)),
        }  # fmt: skip

    def _check_clamped(self) -> None:
        """Raise ModelError for a contact whose slots are all clamped."""
        clamped = clamped_slots(self.model)
        for contact, slots in zip(self.contacts, self.slots):
            if clamped[slots].all():
                bodies = " and ".join(repr(side.name) for side in contact.sides[: 2 - contact.grounded])
                raise ModelError(
                    f"contact {contact.name!r}: all of the surfaces of bodies {bodies} is clamped; leave the contact "
                    "out, or free one of them"
                )

    @property
    def connectivity(self) -> list[np.ndarray]:
        """Slots of the facets of each group, and of the master facets."""
        return [*super().connectivity, self.master_conn]

    @property
    def slots(self) -> list[np.ndarray]:
        """Model slots of both surfaces of each contact."""
        return [np.concatenate(sides) for sides in self.slots_by_side]

    @property
    def slots_by_side(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """Model slots of the points and of the facets of each contact."""
        out = []
        for contact, p, k in zip(self.contacts, self.host, self.master_of):
            slave = np.unique(p.conn) + contact.body.slot_offset
            out.append((slave, np.unique(self.masters[k].conn) + contact.facets.body.slot_offset))
        return out

    def build(self, laws: TimeLawTable, pool: int) -> None:
        """Upload the tables; `pool`: first pool entry of the term."""
        self.pool = self._build_facets(pool)
        both = zip(self.groups, self.edge_data)
        self.edge_groups = [(group, edges) for group, edges in both if edges is not None]
        self.data = contact_struct()()
        self._upload_laws(self.data, [self.law_constants(c) for c in self.contacts])
        self.store_built_values()
        self.reach_distance = 1e-3 * max(float(mas.size.mean()) for mas in self.masters) + max(
            abs(contact.offset) for contact in self.contacts
        )
        self.max_overlap_depth = max(float(mas.depth_limit.max()) for mas in self.masters)
        angles_or_motions: list[Any] = [k.rotation.angle if k.rotation else k.law for k in self.carriers]
        self.carrier_laws = [laws.add(law) for law in angles_or_motions]
        self.collider_laws: list[tuple[Collider, int]] = []
        if any(contact.grounded for contact in self.contacts) and not self.model.description.contacts_of(Contact):
            for collider in self.model.description.colliders:
                law = collider.rotation.angle if collider.rotation else collider.law
                self.collider_laws.append((collider, laws.add(law) if law is not None else -1))
        self.max_gap = max(float(mas.size.max()) for mas in self.masters)
        self.master_conn = self._master_conn()
        self.other_entries = self.master_conn.size
        self.size = self.model.size

    def parameters(self) -> dict[str, Callable[[Any, np.ndarray], None]]:
        """Setters of the parameters of contacts; refusals of the offsets of their obstacles."""
        obstacles = [contact for contact in self.contacts if contact.grounded]
        return super().parameters() | {f"{c.sides[1].name}.offset": partial(refuse_offset, c) for c in obstacles}

    def reference_boxes(self) -> tuple[np.ndarray, np.ndarray]:
        """Lower and upper corners (facets, 3) of the reference bounding boxes."""
        nodes = [
            np.einsum(
                "qm,fmk->fqk", bernstein_from_monomials(mas.corners, mas.degree), mas.reference_position_coefficients
            )
            for mas in self.masters
        ]
        low, high = ([getattr(x, name)(axis=1) for x in nodes] for name in ("min", "max"))
        return np.concatenate(low).astype(np.float32), np.concatenate(high).astype(np.float32)

    @property
    def box_groups(self) -> wp.array:
        """Groups of the boxes of [world, facet]: one per world and surface."""
        counts = [len(mas.conn) for mas in self.masters]
        group = np.repeat(np.arange(len(counts)), counts)
        groups = (np.arange(self.model.worlds)[:, None] * len(counts) + group).ravel()
        return wp.array(groups, dtype=wp.int32, device=self.model.device)

    def _master_conn(self) -> np.ndarray:
        """Model slots (facets, L); smaller facets repeat their last slot, with zero shape functions."""
        width = max(mas.conn.shape[1] for mas in self.masters)
        conns = [mas.conn + surface.body.slot_offset for mas, surface in zip(self.masters, self.surfaces)]
        return np.concatenate([np.pad(conn, ((0, 0), (0, width - conn.shape[1])), mode="edge") for conn in conns])

    def master_data(self, tree: Any) -> Any:
        """Device struct for a bounding volume hierarchy."""
        m, all_of = self.model, self.masters
        if "pair masters" not in m.cache:
            width = self.master_conn.shape[1]
            kinds = sorted({(mas.corners, mas.degree) for mas in all_of})
            most = max(len(monomial_exponents(*kind)) for kind in kinds)

            def concatenated(name: str) -> np.ndarray:
                values = [getattr(mas, name) for mas in all_of]
                if values[0].ndim == 3 and name in ("shape", "director_shape"):
                    values = [np.pad(x, ((0, 0), (0, most - x.shape[1]), (0, width - x.shape[2]))) for x in values]
                elif values[0].ndim == 3:
                    values = [np.pad(x, ((0, 0), (0, most - x.shape[1]), (0, 0))) for x in values]
                return np.concatenate(values)

            power = np.zeros((len(kinds), most, 2), dtype=np.int32)
            hull = np.zeros((len(kinds), most, most))
            for k, kind in enumerate(kinds):
                count = len(monomial_exponents(*kind))
                power[k, :count] = monomial_exponents(*kind)
                hull[k, :count, :count] = bernstein_from_monomials(*kind)
            counts = [len(mas.conn) for mas in all_of]
            tables = {
                "surface_of": self.master_of,
                "sign": [c.sign for c in self.contacts],
                "one_sided": [c.one_sided for c in self.contacts],
                "bodies": [[self.bodies.index(c.surfaces[i].body.index) for i in (0, -1)] for c in self.contacts],
                "conn": self.master_conn.T,
                "shape": np.moveaxis(concatenated("shape"), 0, 2),
                "director_shape": np.moveaxis(concatenated("director_shape"), 0, 2),
                "reference_position_coefficients": np.swapaxes(concatenated("reference_position_coefficients"), 0, 1),
                "reference_director_coefficients": np.swapaxes(concatenated("normal_coefficients"), 0, 1),
                "facet_kind": np.repeat([kinds.index((q.corners, q.degree)) for q in all_of], counts),
                "monomial_count": [len(monomial_exponents(*kind)) for kind in kinds],
                "corner_count": [kind[0] for kind in kinds],
                "exponents": power,
                "hull_coefficients": hull,
                "depth_limit": concatenated("depth_limit"),
                "element_depth": np.concatenate(
                    [np.ones(len(s.faces)) if isinstance(s, LevelFacets) else element_depths(s) for s in self.surfaces]
                ),
                "side_length": concatenated("size"),
                "surface": np.repeat(np.arange(len(counts)), counts),
                "half_angle": np.concatenate([mas.half_angle for mas in all_of], axis=1),
                "max_monomials": most,
                "surface_count": len(self.surfaces),
                "touch_depth": TOUCHING_DEPTH_RATIO * self.size,
                "first_entry": self.pool,
                "facet_count": self.facets,
                **self._carrier_tables(),
            } | self.seams
            m.cache["pair masters"] = master_struct(m.dtype)()
            m.memory.fill(m.cache["pair masters"], "contact", **tables)
        out = master_struct(m.dtype)()
        out.assign(m.cache["pair masters"])
        out.tree = tree
        return out

    def _carrier_tables(self) -> dict[str, Any]:
        """Fields of `master_struct` of the obstacles that move."""
        K = self.carriers
        out: dict[str, Any] = {"carrier": [K.index(c.sides[1]) if c.sides[1] in K else -1 for c in self.contacts]}
        return out if not K else out | {
            "carrier_law": self.carrier_laws,
            "carrier_turns": [int(k.rotation is not None) for k in K],
            "carrier_anchor": [k.rotation.anchor if k.rotation else np.zeros(3) for k in K],
            "carrier_axis": [k.rotation.axis if k.rotation else np.zeros(3) for k in K],
        }  # fmt: skip

    def hash(self, h: Any) -> None:
        """Hash the definition of the contacts."""
        for contact, p, k in zip(self.contacts, self.host, self.master_of):
            fixed = ("first", "second", "slave", "master", "surface", "collider", "edges", "of", *WORLD_PARAMETERS)
            values = {name: v for name, v in vars(contact).items() if name not in fixed}
            h.update(f"{' '.join(side.name for side in contact.sides)} {sorted(values.items())}".encode())
            h.update(np.ascontiguousarray(p.faces).tobytes() + np.ascontiguousarray(self.surfaces[k].faces).tobytes())
            if contact.grounded:
                h.update(p.X.tobytes())
        h.update(self.built_values)
