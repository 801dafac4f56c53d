"""Contact between bodies in a linear solve: products, blocks, and preconditioner corrections."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Any

import warp as wp

from ..kernels.common.state import state_kernels
from ..kernels.terms.contact import contact_kernels
from ..kernels.terms.contact_ledger import contact_block_kernels
from ..kernels.terms.pair_blocks import pair_block_kernels
from ..kernels.terms.pair_structs import point_list_struct
from ..kernels.terms.pairs import pair_kernels
from ..model.state import view_as_words
from .contact_tables import facet_pattern_entries
from .facet_tables import POINT_SUM_LANES
from .pair_rigid_modes import PairRigidModes
from .pair_tables import PairTables
from .term import StepContext, Term, part

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["PairSolves"]


class PairSolves(Term):
    """Linear-solver part of `Pairs`.

    Attributes:
        tables: points and facets on the device.
        obstacle_kernels, kernels: kernels common with obstacle contact, and those of contact between bodies.
    """

    name = "pairs"

    def __init__(self, model: Model) -> None:
        super().__init__(model)
        self.tables = PairTables(model)
        self.obstacle_kernels, self.kernels = contact_kernels(model.dtype, False), pair_kernels(model.dtype)

    @part("pairs")
    def product(self, ctx: StepContext, p: wp.array, active: wp.array) -> None:
        s, m, w, t, k = ctx.scratch[self.name], self.model, ctx.work, self.tables, self.kernels
        attempt, pair, masters = s["attempt"], s["pair"], s["masters"]
        for group in t.groups:
            dim = (m.worlds, group.count, group.data.point_count)
            ctx.launch(k.point_products, dim, [masters, group.data, active, p, attempt, pair])
        for group in t.groups:  # the last group includes the master facets
            entries = group.conn.size + (t.master_conn.size if group is t.groups[-1] else 0)
            lanes = ctx.launch.lanes(POINT_SUM_LANES)
            args = [masters, group.data, active, lanes, entries - 1, attempt, pair, w.pool_product]
            ctx.launch(k.gather_pair_products, (m.worlds, ctx.launch.padded(lanes * entries)), args)

    @part("pairs")
    def diagonal(self, ctx: StepContext, active: wp.array) -> None:
        s, m, w, t = ctx.scratch[self.name], self.model, ctx.work, self.tables
        for group in t.groups:
            args = [group.data, active, s["attempt"], w.pool_block]
            ctx.launch(self.obstacle_kernels.diagonal, (m.worlds, group.count, group.conn.shape[1]), args)
        args = [s["masters"], active, s["attempt"], s["pair"], w.pool_block]
        ctx.launch(self.kernels.master_diagonal, (m.worlds, t.facets, t.master_conn.shape[1]), args)

    def cached_inputs(self, ctx: StepContext) -> list[tuple[str, wp.array]]:
        s = ctx.scratch[self.name]
        t = s["pair"]
        arrays = {
            "list_size": t.list_size,
            "list_start": t.list_start,
            "list_point": t.list_point,
            "shape_values": t.shape_values,
            "listed_facet": t.listed_facet,
        }
        return [("stiffness", s["attempt"].stiffness), *arrays.items()]

    def reset_scratch(self, ctx: StepContext, flags: wp.array) -> None:
        # lists are longer than their contents, and a preconditioner copies all of them
        for _, array in self.cached_inputs(ctx):
            words = view_as_words(array)
            ctx.launch(state_kernels().clear_rows, words.shape, [flags, words])

    def allocate_blocks(self, ctx: StepContext, matrix: Any, *, projected: bool) -> None:
        if "pair blocks" not in self.model.cache:
            conns = [group.conn for group in self.tables.groups] + [self.tables.master_conn]
            self.model.cache["pair blocks"] = [
                facet_pattern_entries(self.model, conn, matrix.pattern) for conn in conns
            ]

    def blocks(
        self, ctx: StepContext, matrix: Any, kept: list[wp.array], dq_dv: wp.array, active: wp.array, out: wp.array,
        *, projected: bool,
    ) -> None:  # fmt: skip
        """Stiffness of the points on their own facets and on master facets, without the coupling of both."""
        m, t = self.model, self.tables
        lists = point_list_struct()()
        stiffness, lists.list_size, lists.list_start, lists.list_point, weight, _ = kept
        *slaves, masters = m.cache["pair blocks"]
        add = contact_block_kernels(m.dtype).add_contact_blocks
        for group, (index, begin, source, count) in zip(t.groups, slaves):
            args = [m.topology, matrix.pattern.data, group.data, index, begin, source, stiffness, weight]
            ctx.launch(add, (m.worlds, count), [*args, dq_dv, active, out])
        index, begin, source, count = masters
        args = [m.topology, matrix.pattern.data, index, begin, source, stiffness, weight, lists]
        add = pair_block_kernels(m.dtype).add_master_blocks
        ctx.launch(add, (m.worlds, count), [*args, dq_dv, active, out])

    def block_modules(self) -> set[wp.Module]:
        dtype = self.model.dtype
        return {contact_block_kernels(dtype).module, pair_block_kernels(dtype).module}

    def coupled_bodies(self) -> list[tuple[int, int]]:
        number = {id(body): k for k, body in enumerate(self.model.bodies)}
        return [(number[id(c.first.body)], number[id(c.second.body)]) for c in self.tables.contacts]

    def allocate_mode_coupling(self, ctx: StepContext, motions: Any) -> Iterable[wp.Module]:
        s = ctx.scratch[self.name]
        s["motions"] = PairRigidModes(ctx, self.tables, s["masters"], motions)
        return {s["motions"].kernels.module}

    def add_mode_coupling(self, ctx: StepContext, kept: list[wp.array], dq_dv: wp.array, active: wp.array) -> None:
        ctx.scratch[self.name]["motions"].add(kept, dq_dv, active)
