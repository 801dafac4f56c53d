"""Contact between bodies, with a potential per slave surface point, see kernels/terms/pairs.py."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..base.errors import PenetrationError
from ..kernels.common.traits import Traits
from ..kernels.solvers.control import FAIL_FLOOR, FAIL_WORK
from ..kernels.terms.contact import RELAX_LANES
from ..kernels.terms.contact_books import BOOKED, LANES, book_kernels
from ..kernels.terms.contact_data import RECORD, attempt_struct, clock_struct, history_struct
from ..kernels.terms.pair_books import pair_book_kernels
from ..kernels.terms.pair_data import seat_struct, touching_struct
from ..kernels.terms.pair_lists import CHUNK, list_kernels
from ..kernels.terms.pair_seek import seek_kernels
from ..model.state import State
from .contact_exact import Exact
from .contact_fields import CONTACT_FIELDS, contact_field
from .contact_parameters import contact_parameters
from .contact_starts import reference_place, refuse_sunk, store_overlaps, touching_depth
from .facet_tables import LISTED
from .pair_solves import PairSolves
from .pair_survey import survey
from .term import LOSS, NUMERICAL, STORED, WORK, At, Column, part

if TYPE_CHECKING:
    from ..model.model import Model
    from .time_laws import TimeLaws
    from .workspace import Workspace

__all__ = ["Pairs"]

KEPT = ("angle", "grown", "lead", "place", "turn")
"""History of colliders and of single-point contacts."""


class Pairs(PairSolves):
    """Contacts of a model between its bodies.

    Attributes:
        tables: points and facets on the device.
    """

    name = "pairs"
    columns = (
        Column("contact_pairs", STORED),
        Column("contact_loss", LOSS),
        Column("friction", LOSS),
        Column("collider_work", WORK),
        Column("", NUMERICAL),
    )
    fields = CONTACT_FIELDS
    parts = {"pairs": "contact between bodies: search, forces, products, history"}

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.traits = Traits(walls=True)
        self.books, self.seek = book_kernels(model.dtype, False), seek_kernels(model.dtype)
        self.lists, self.ending = list_kernels(model.dtype), pair_book_kernels(model.dtype)
        self.report_columns = len(RECORD) * len(self.tables.contacts)

    @classmethod
    def of(cls, model: Model) -> Pairs | None:
        return cls(model) if model.description.pairs else None

    @classmethod
    def features(cls, model: Model) -> dict[str, bool]:
        return {"contact between bodies": bool(model.description.pairs)}

    def ties(self) -> list[np.ndarray]:
        """Bodies in contact form one component."""
        return self.tables.slots

    def hold(self, free: np.ndarray) -> None:
        """No-op: the forces of a pair are self-equilibrated under translations."""

    def build(self, laws: TimeLaws) -> None:
        self.tables.build(self.offset)
        self.connectivity = [group.conn for group in self.tables.groups] + [self.tables.master_conn]
        self.exact = Exact(self.model, self.connectivity) if self.model.dtype == "float32" else None
        self.rows = self.booked_rows = self.tables.rows

    def hash(self, h: Any) -> None:
        self.tables.hash(h)

    # simulation setup

    def _attempt(self, work: Workspace) -> Any:
        t, B = self.tables, self.model.worlds
        C, P = len(t.contacts), t.points
        point = (B, P)
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(
            ("origin", "reach", "depth", "speed", "held", "next", "plane", "next_plane", "asked", "state", "force",
             "energy", "stiffness", "flux"), point)  # fmt: skip
        shapes |= dict.fromkeys(("dead", "dead_spring"), point if t.explicit else (1, 1))
        shapes |= dict.fromkeys(("through", "elapsed", "omega", "changes", "asked_size"), (B,))
        shapes |= {"asked_sums": (B, RELAX_LANES), "total": (B, C, len(RECORD)), "touched": (B, t.rows)}
        shapes |= {"rows": (len(RECORD), B, t.rows), "weight": (1, 1, 1)}
        out = attempt_struct(self.model.dtype)()
        for name, shape in shapes.items():
            dtype = attempt_struct(self.model.dtype).vars[name].type.dtype
            setattr(out, name, work.array(f"pairs {name}", shape, dtype))
        out.omega.fill_(1.0)
        return out

    def _touching(self, work: Workspace) -> Any:
        t, B = self.tables, self.model.worlds
        most = t.masters_of(wp.uint64(0)).most
        F, P, R = t.facets, t.points, t.rows
        shapes: dict[str, tuple[int, ...]] = dict.fromkeys(("C", "D", "C0", "D0", "V0"), (B, F * most))
        shapes |= dict.fromkeys(("lower", "upper", "wanted_lower", "wanted_upper", "count"), (B * F,))
        shapes |= dict.fromkeys(("stale", "fits", "changed"), (1,))
        shapes |= dict.fromkeys(("near", "calm_lower", "calm_upper", "calm"), (B, R))
        shapes |= dict.fromkeys(("points", "start", "middle", "middle0", "swell"), (B, F))
        shapes |= {"chunk": (B, -(-F // CHUNK))}
        shapes |= dict.fromkeys(("weight", "held_weight", "slope"), (B, P, t.master_conn.shape[1]))
        shapes |= {"lean": (B, P, 2), "deepest": (B, len(t.bodies))}
        out = touching_struct(self.model.dtype)()
        for name, var in touching_struct(self.model.dtype).vars.items():
            setattr(out, name, work.array(f"pairs {name}", shapes.get(name, (B, P)), var.type.dtype))
        out.fits.fill_(1)
        return out

    def allocate(self, work: Workspace, at: At) -> None:
        t, m = self.tables, self.model
        C, R, B = len(t.contacts), t.rows, m.worlds
        attempt, touching = self._attempt(work), self._touching(work)
        clock = clock_struct()()
        for name in ("time", "new_time", "h", "part"):
            setattr(clock, name, getattr(work.step, name))
        clock.time, clock.still = at.state.time, int(not at.inertia)
        tree = self._tree(touching)
        scratch = {
            "attempt": attempt,
            "touching": touching,
            "tree": tree,
            "masters": t.masters_of(tree.id),
            "clock": clock,
            "active": work.newton.touching,
            "booked": work.array("pairs booked", (BOOKED, B, R), wp.float64),
            "parts": work.array("pairs parts", (B, C, len(RECORD), LANES), wp.float64),
            "row_start": m.array("contact", t.row_start, wp.int32),
            "u": self.exact.allocate(work, self.name) if self.exact else work.u,
        }
        at.scratch[self.name] = scratch | at.scratch.get(self.name, {})

    def _tree(self, touching: Any) -> wp.Bvh:
        """Bounding volume hierarchy of the facets in the reference; one group per world and surface."""
        low, high = self.tables.boxes()
        touching.lower.assign(np.tile(low, (self.model.worlds, 1)))
        touching.upper.assign(np.tile(high, (self.model.worlds, 1)))
        return wp.Bvh(touching.lower, touching.upper, constructor="sah", groups=self.tables.box_groups)

    def history_of(self, make: Callable[[str, Any, tuple[int, ...]], wp.array]) -> tuple[Any, Any]:
        """Structs of history and facet assignment, with arrays from make(name, dtype, shape per world)."""
        history, seats = history_struct()(), seat_struct()()
        points = (self.tables.points,)
        for name, var in history_struct().vars.items():
            if name not in KEPT:
                shape = () if name in ("born", "posed") else points
                setattr(history, name, make(f"pairs_{name}", var.type.dtype, shape))
        for name, var in seat_struct().vars.items():
            setattr(seats, name, make(f"pairs_{name}", var.type.dtype, points))
        return history, seats

    def register(self, at: At) -> None:
        history, seats = self.history_of(at.state.register)
        at.scratch[self.name] = {"history": history, "seats": seats}

    def modules(self, at: At) -> Iterable[wp.Module]:
        exact = [self.exact.kernels.module] if self.exact else []
        return [self.shared.module, self.seek.module, self.kernels.module, *exact]

    def start(self, at: At, active: wp.array) -> None:
        """Initial overlaps at the state.

        Raises:
            ModelError: a new contact overlaps, and `overlap` is "refuse".
        """
        s, t = at.scratch[self.name], self.tables
        history = s["history"]
        new = (active.numpy() != 0) & ~(history.speed.numpy() > 0.0).any(axis=1)
        if not new.any():
            return
        flags: wp.array = wp.array(new.astype(np.int32), dtype=wp.int32, device=self.model.device)
        overlap, born = history.overlap.numpy(), history.born.numpy()
        overlap[new] = 0.0
        born[new] = at.state.time.numpy()[new]
        history.overlap.assign(overlap)
        history.born.assign(born)
        self._begin(at, flags)
        u = at.state.displacement
        if self.exact:
            u = s["u"]
            self.exact.widen(at.launch, at.state.displacement, flags, u)
        self._seek(at, u, flags, settling=t.deepest)
        seat = s["touching"].seat.numpy()
        depth = np.where((seat != -1) & new[:, None], s["touching"].depth.numpy(), 0.0)
        touching = touching_depth(self.model.size, at.state.displacement.numpy())
        store_overlaps(t, depth, touching, overlap)
        refuse_sunk(t, at.state.displacement.numpy(), s["touching"].x0.numpy(), seat, new)
        history.overlap.assign(overlap)

    def rewind(self, state: State) -> None:
        """Shift the start times of stored overlaps."""
        if "pairs_born" in state.specs:
            state.pairs_born.assign(state.pairs_born.numpy() - state.time.numpy())  # type: ignore[attr-defined]

    # in a step

    @part("pairs")
    def begin(self, at: At, active: wp.array) -> None:
        """Update facets and points at the start of the attempt."""
        at.scratch[self.name]["finished"] = False
        self._begin(at, active)

    def _begin(self, at: At, active: wp.array) -> None:
        s, m, t = at.scratch[self.name], self.model, self.tables
        touching, masters = s["touching"], s["masters"]
        u, v = at.state.displacement, at.state.velocity
        dim = (m.worlds, t.facets, masters.most)
        at.launch(self.seek.controls_before, dim, [masters, u, v, active, touching])
        for group in t.groups:
            args = [t.data, masters, group.data, s["history"], s["seats"], s["clock"]]
            dim = (m.worlds, group.count, group.data.points)
            at.launch(self.seek.begin_points, dim, [*args, u, v, active, s["attempt"], touching])
            if t.explicit:
                at.launch(self.kernels.explicit_forces, dim, [*args, v, active, s["attempt"], touching])

    def _refit(self, at: At) -> None:
        s = at.scratch[self.name]
        at.launch(self.seek.adopt_boxes, self.model.worlds * self.tables.facets, [s["touching"]])
        s["tree"].refit()

    def _seek(self, at: At, u: wp.array, active: wp.array, *, settling: float) -> None:
        """Assign all points to facets at u."""
        s, m, t, k = at.scratch[self.name], self.model, self.tables, self.seek
        touching, masters = s["touching"], s["masters"]
        dim = (m.worlds, t.facets, masters.most)
        at.launch(k.controls, dim, [masters, u, active, touching.C, touching.D])
        at.launch(k.check_boxes, (m.worlds, t.facets), [masters, active, touching])
        at.launch(k.keep_middles, (m.worlds, t.facets), [masters, active, touching])
        wp.capture_if(touching.stale, self._refit, at=at)
        for group, corners in zip(t.groups, t.corners):
            args = [t.data, masters, group.data, s["history"]]
            at.launch(k.look_around, (m.worlds, group.count), [*args, u, active, t.reaching + settling, touching])
            args += [s["seats"], s["clock"], u, at.state.velocity, active, settling]
            at.launch(k.seek, (m.worlds, group.count, group.data.points), [*args, s["attempt"], touching, corners])

    def prepare(self, at: At, active: wp.array) -> None:
        """Compute the first friction limits and the stiffness of the blocks."""
        self._forces(at, active, fresh=1)

    def force(self, at: At, active: wp.array) -> None:
        self._forces(at, active, fresh=0)

    @part("pairs")
    def _forces(self, at: At, active: wp.array, *, fresh: int) -> None:
        s, m, w, t = at.scratch[self.name], self.model, at.work, self.tables
        touching, masters = s["touching"], s["masters"]
        if at.moved:
            if self.exact:
                self.exact.follow(at, s["u"], active)
            self._seek(at, s["u"], active, settling=0.0)
        for group in t.groups:
            args = [t.data, masters, group.data, s["history"], s["seats"], s["clock"], s["u"], active, fresh]
            dim = (m.worlds, group.count, group.data.points)
            at.launch(self.kernels.forces, dim, [*args, s["attempt"], touching])
        wp.capture_if(touching.changed, self._list, at=at)
        for group in t.groups:
            sides, lanes = group.sides(at.launch, m.worlds)
            args = [group.data, active, lanes, s["attempt"], w.pool_force, w.rows_of(self), s["active"]]
            at.launch(self.shared.gather_points, sides, args)
        lanes = at.launch.lanes(LISTED)
        args = [masters, active, lanes, s["attempt"], touching, w.pool_force]
        at.launch(self.kernels.gather_masters, (m.worlds, at.launch.padded(lanes * t.master_conn.size)), args)

    def _list(self, at: At) -> None:
        """Build the point lists of the master facets."""
        s, m, t, k = at.scratch[self.name], self.model, self.tables, self.lists
        touching, masters = s["touching"], s["masters"]
        at.launch(k.clear_lists, m.worlds * t.facets, [touching])
        at.launch(k.count_points, (m.worlds, t.points), [masters, touching])
        at.launch(k.sum_chunks, touching.chunk.shape, [masters, touching])
        at.launch(k.scan_chunks, m.worlds, [touching])
        at.launch(k.place_lists, (m.worlds, t.facets), [masters, touching])
        at.launch(k.fill_lists, (m.worlds, t.points), [masters, touching])
        at.launch(k.sort_lists, (m.worlds, t.facets), [touching])

    @part("pairs")
    def refresh(self, at: At, flags: wp.array) -> None:
        k, m, attempt = self.shared, self.model, at.scratch[self.name]["attempt"]
        at.launch(k.partial_asked, (m.worlds, RELAX_LANES), [flags, attempt])
        at.launch(k.relax, m.worlds, [flags, at.work.newton.tol, attempt, at.work.newton.unsettled])
        at.launch(k.refresh, (m.worlds, self.tables.points), [flags, attempt])
        s = at.scratch[self.name]
        for group in self.tables.groups:
            args = [s["masters"], group.data, s["u"], flags, attempt, s["touching"]]
            at.launch(self.kernels.take_functions, (m.worlds, group.count, group.data.points), args)

    def book(self, at: At, accepted: wp.array) -> wp.array:
        self._finish(at, accepted)
        at.scratch[self.name]["finished"] = True
        return at.scratch[self.name]["booked"]

    @part("pairs")
    def _finish(self, at: At, accepted: wp.array) -> None:
        """Update history, ledger rows and records of an accepted substep."""
        s, m, t = at.scratch[self.name], self.model, self.tables
        C = len(t.contacts)
        self._seek(at, s["u"], accepted, settling=0.0)
        for group in t.groups:
            args = [t.data, s["masters"], group.data, s["history"], s["seats"], s["clock"], accepted]
            args += [s["attempt"], s["touching"], s["booked"]]
            at.launch(self.ending.finish, (m.worlds, group.count), args)
        args = [t.data, s["row_start"], accepted, s["attempt"], s["parts"]]
        at.launch(self.books.partial_records, (m.worlds, C, len(RECORD), LANES), args)
        args = [s["clock"], accepted, s["parts"], s["attempt"]]
        at.launch(self.books.total_records, (m.worlds, C, len(RECORD)), args)

    @part("pairs")
    def commit(self, at: At, accepted: wp.array) -> None:
        s, w = at.scratch[self.name], at.work
        if not s["finished"]:  # no ledger, `book` not called
            self._finish(at, accepted)
        args = [s["clock"], w.newton.potential, w.newton.term_sums, accepted, s["history"], s["attempt"]]
        at.launch(self.ending.close, self.model.worlds, args)

    def report(self, at: At) -> None:
        args = [at.scratch[self.name]["attempt"], self.report_offset, at.work.report]
        at.launch(self.books.write_records, (self.model.worlds, len(self.tables.contacts)), args)

    def measure(self, at: At) -> dict[str, np.ndarray]:
        """Stored energy according to the history, by points."""
        weights = np.concatenate([share.ravel() for share in self.tables.shares])
        return {"contact_pairs": at.scratch[self.name]["history"].stored.numpy() @ weights}

    # results

    def explain(self, at: At, world: int) -> tuple[type[PenetrationError], str] | None:
        found = int(at.scratch[self.name]["attempt"].through.numpy()[world])
        if found == 0 or int(at.work.newton.failed.numpy()[world]) in (FAIL_FLOOR, FAIL_WORK):
            return None
        t = self.tables
        k = int(np.searchsorted(t.first, found - 1, side="right")) - 1
        contact, where = t.contacts[k], reference_place(t, k, found - 1 - int(t.first[k]))
        return PenetrationError, (
            f"contact {contact.name!r}: a point of body {contact.slave.body.name!r} (reference place "
            f"{where}) went through body {contact.master.body.name!r}; take a larger "
            "stiffness= of the contact or a thicker body, or a smaller dt where it moves that far in a step"
        )

    def remark(self, at: At, world: int) -> str:
        touched = at.scratch[self.name]["attempt"].touched.numpy()[world] > 0
        t = self.tables
        names = [repr(c.name) for k, c in enumerate(t.contacts) if touched[t.row_start[k] : t.row_start[k + 1]].any()]
        more = f" and {len(names) - 3} more" if len(names) > 3 else ""
        return f"; in touch: contact {', '.join(names[:3])}{more}" if names else ""

    def parameter_arrays(self) -> dict[str, wp.array]:
        return self.tables.set_arrays

    def take_materials(self, mask: np.ndarray) -> None:
        self.tables.take_materials(mask)

    def parameters(self) -> dict[str, Callable[[Any, np.ndarray], None]]:
        return contact_parameters(self.tables)

    def facts(self) -> list[dict[str, Any]]:
        """Entries of `Model.info` per contact, in the order of addition."""
        t, out = self.tables, []
        for contact in self.model.description.pairs:
            k = t.number[contact.index]
            names = {"name": contact.name, "body": contact.first.body.name, "with": contact.second.body.name}
            numbers = {"points": int((t.shares[k] > 0.0).sum()), "facets": len(t.masters[t.of[k]].conn), "left_out": 0}
            out.append(names | {"law": contact.law, "model": contact.model} | numbers)
        return out

    # at a state

    def nodal_force(self, state: State) -> np.ndarray:
        """Elastic nodal forces of all contacts at a state, both bodies, (worlds, slots, 3), N."""
        return survey(self, state).nodal_force()

    def samples(self, field: str, body: Any, state: State) -> np.ndarray:
        bodies = [side.body for contact in self.tables.contacts for side in (contact.slave, contact.master)]
        patches = survey(self, state).patches(body) if body in bodies else []
        return contact_field(field, body, state.worlds, patches)
