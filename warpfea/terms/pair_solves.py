"""Contact between bodies in a linear solve: products, blocks, and preconditioner corrections."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import warp as wp

from ..kernels.common.state import state_kernels
from ..kernels.terms.contact import contact_kernels
from ..kernels.terms.contact_books import contact_block_kernels
from ..kernels.terms.pair_blocks import pair_block_kernels
from ..kernels.terms.pairs import pair_kernels
from ..model.state import words_of
from .contact_tables import block_entries
from .facet_tables import LISTED
from .pair_motions import PairMotions
from .pair_tables import PairTables
from .term import At, Term, part

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["PairSolves"]


class PairSolves(Term):
    """Linear-solver part of `Pairs`.

    Attributes:
        tables: points and facets on the device.
        shared, kernels: kernels common with obstacle contact, and those of contact between bodies.
    """

    name = "pairs"

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.tables = PairTables(model)
        self.shared, self.kernels = contact_kernels(model.dtype, False), pair_kernels(model.dtype)

    @part("pairs")
    def product(self, at: At, p: wp.array, active: wp.array) -> None:
        s, m, w, t, k = at.scratch[self.name], self.model, at.work, self.tables, self.kernels
        attempt, touching, masters = s["attempt"], s["touching"], s["masters"]
        for group in t.groups:
            dim = (m.worlds, group.count, group.data.points)
            at.launch(k.product_points, dim, [masters, group.data, active, p, attempt, touching])
        for group in t.groups:  # the last group includes the master facets
            entries = group.conn.size + (t.master_conn.size if group is t.groups[-1] else 0)
            lanes = at.launch.lanes(LISTED)
            args = [masters, group.data, active, lanes, entries - 1, attempt, touching, w.pool_product]
            at.launch(k.product_sides, (m.worlds, at.launch.padded(lanes * entries)), args)

    @part("pairs")
    def diagonal(self, at: At, active: wp.array) -> None:
        s, m, w, t = at.scratch[self.name], self.model, at.work, self.tables
        for group in t.groups:
            args = [group.data, active, s["attempt"], w.pool_block]
            at.launch(self.shared.diagonal, (m.worlds, group.count, group.conn.shape[1]), args)
        args = [s["masters"], active, s["attempt"], s["touching"], w.pool_block]
        at.launch(self.kernels.diagonal_masters, (m.worlds, t.facets, t.master_conn.shape[1]), args)

    def keep(self, at: At) -> list[tuple[str, wp.array]]:
        s = at.scratch[self.name]
        t = s["touching"]
        arrays = {"points": t.points, "start": t.start, "entry": t.entry, "weight": t.weight, "listed": t.listed}
        return [("stiffness", s["attempt"].stiffness), *arrays.items()]

    def restart(self, at: At, flags: wp.array) -> None:
        # lists are longer than their contents, and a preconditioner copies all of them
        for _, array in self.keep(at):
            words = words_of(array)
            at.launch(state_kernels().clear_rows, words.shape, [flags, words])

    def reserve(self, at: At, matrix: Any, *, projected: bool) -> None:
        if "pair blocks" not in self.model.cache:
            conns = [group.conn for group in self.tables.groups] + [self.tables.master_conn]
            self.model.cache["pair blocks"] = [block_entries(self.model, conn, matrix.pattern) for conn in conns]

    def blocks(
        self, at: At, matrix: Any, kept: list[wp.array], dq_dv: wp.array, active: wp.array, out: wp.array,
        *, projected: bool,
    ) -> None:  # fmt: skip
        """Stiffness of the points on their own facets and on master facets, without the coupling of both."""
        m, t = self.model, self.tables
        stiffness, points, start, entry, weight, _ = kept
        *slaves, masters = m.cache["pair blocks"]
        add = contact_block_kernels(m.dtype).add_contact
        for group, (index, begin, source, count) in zip(t.groups, slaves):
            args = [m.topology, matrix.pattern.data, group.data, index, begin, source, stiffness, weight]
            at.launch(add, (m.worlds, count), [*args, dq_dv, active, out])
        index, begin, source, count = masters
        args = [m.topology, matrix.pattern.data, index, begin, source, stiffness, weight, points, start, entry]
        add = pair_block_kernels(m.dtype).add_masters
        at.launch(add, (m.worlds, count), [*args, dq_dv, active, out])

    def block_modules(self) -> set[wp.Module]:
        dtype = self.model.dtype
        return {contact_block_kernels(dtype).module, pair_block_kernels(dtype).module}

    def couples(self) -> list[tuple[int, int]]:
        number = {id(body): k for k, body in enumerate(self.model.bodies)}
        return [(number[id(c.first.body)], number[id(c.second.body)]) for c in self.tables.contacts]

    def reserve_motions(self, at: At, motions: Any) -> Iterable[wp.Module]:
        s = at.scratch[self.name]
        s["motions"] = PairMotions(at, self.tables, s["masters"], motions)
        return {s["motions"].kernels.module}

    def couple(self, at: At, kept: list[wp.array], dq_dv: wp.array, active: wp.array) -> None:
        at.scratch[self.name]["motions"].add(kept, dq_dv, active)
