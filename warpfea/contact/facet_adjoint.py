"""Adjoint of contact with facets of bodies, see kernels/contact/facet_adjoint.py."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cached_property
from typing import Any

import warp as wp

from ..base.errors import ModelError
from ..kernels.contact.facet_adjoint import (
    FACET_POINTS,
    adjoint_fields_struct,
    facet_adjoint_kernels,
    facet_adjoint_struct,
)
from ..kernels.contact.facet_structs import pair_scratch_struct, point_list_struct
from ..kernels.contact.point_lists import FACETS_PER_CHUNK
from ..terms.gradients import StepAdjoint, with_fields
from ..terms.term import StepContext, part
from .adjoint import DifferentiableContact

__all__ = ["DifferentiableFacets"]

END, START = 0, 1


class DifferentiableFacets(DifferentiableContact):
    """Adjoint of contact with facets of bodies: products of each point's derivatives."""

    unused_bars = ("jacobian", "gap_bar", "shift_bar", "turn_bar", "start_shift_bar", "start_turn_bar")

    @cached_property
    def adjoint_kernels(self) -> Any:
        """Kernels of the geometry."""
        return facet_adjoint_kernels(self.model.dtype, self.tables.own_laws)

    def not_differentiable(self, ctx: StepContext) -> str | None:
        t = self.tables
        if t.edge_groups:
            return "sharp edges of both bodies (surfaces without them, or stiffness='region', leave them out)"
        if t.carriers:
            return "obstacles with points of their own that move"
        return super().not_differentiable(ctx)

    def prepare_adjoint(self, at: StepAdjoint) -> Iterable[wp.Module]:
        modules = super().prepare_adjoint(at)
        s, t, w = at.ctx.scratch[self.name], self.tables, at.ctx.work
        worlds, points, facets = self.model.worlds, t.points, t.facets
        s["facet bars"] = bars = facet_adjoint_struct()()
        for name in facet_adjoint_struct().vars:
            array = w.array(f"{self.name} adjoint facet {name}", (worlds, points, FACET_POINTS), wp.vec3d)
            setattr(bars, name, array)
        # lists of the facets that motions are relative to, beside those of the facets at the end of the step
        shapes = {"listed_facet": (worlds, points), "list_count": (worlds * facets,), "list_point": (worlds, points)}
        shapes |= dict.fromkeys(("list_size", "list_start"), (worlds, facets)) | {"lists_changed": (1,)}
        shapes["chunk_offset"] = (worlds, -(-facets // FACETS_PER_CHUNK))
        lists = {name: w.array(f"{self.name} adjoint {name}", size, wp.int32) for name, size in shapes.items()}
        s["anchors"] = with_fields(pair_scratch_struct(self.model.dtype), s["pair"], **lists)
        s["lists"] = []
        for pair in (s["pair"], s["anchors"]):
            kept = point_list_struct()()
            for name in point_list_struct().vars:
                setattr(kept, name, getattr(pair, name))
            s["lists"].append(kept)
        return modules

    def _adjoint_of_points(
        self, ctx: StepContext, direction: wp.array, active: wp.array, weights: tuple[float, float], *, constants: Any,
        at_start: bool = False,
    ) -> None:  # fmt: skip
        """Bars of the points and of their places on facets."""
        a, s = self.adjoint(ctx), ctx.scratch[self.name]
        fields = adjoint_fields_struct(self.model.dtype)()
        fields.displacement, fields.velocity, fields.direction = s["u"], ctx.state.velocity, direction
        fields.force_weight, fields.history_weight = weights
        fields.at_start = int(at_start)
        for group in self.tables.groups:
            args = [self.tables.data, constants, s["other"], group.data, s["history"], s["clock"], fields]
            args += [active, a.attempt, a.data, s["facet bars"]]
            ctx.launch(self.adjoint_kernels.adjoint_of_points, group.point_threads(self.model.worlds), args)

    def _gather_facets(self, ctx: StepContext, active: wp.array, parts: list[tuple[int, int, int]]) -> None:
        """Bars of facet points into the pool, the sum of parts (lists, first, last)."""
        s, out = ctx.scratch[self.name], ctx.work.pool_product
        for k, (of, first, last) in enumerate(parts):
            args = [s["other"], s["lists"][of], s["facet bars"], first, last, active, int(k > 0), out]
            kernel = self.adjoint_kernels.gather_facet_bars
            ctx.launch(kernel, (self.model.worlds, self.tables.other_entries), args)

    @part()
    def exact_product(
        self, ctx: StepContext, p: wp.array, active: wp.array, *, transposed: bool, start: bool = False
    ) -> None:  # fmt: skip
        if not transposed:
            raise ModelError(f"Adjoint: {self.name!r} has no products of forward sensitivities")
        a = self.adjoint(ctx)
        self._adjoint_of_points(ctx, p, active, (1.0, 0.0), constants=a.constants)
        a.spread_points(a.data.end_bar, active)
        self._gather_facets(ctx, active, [(END, 0, 2), (START, 2, 3)])

    def linearise_adjoint(self, at: StepAdjoint) -> None:
        ctx, a = at.ctx, self.adjoint(at.ctx)
        s = ctx.scratch[self.name]
        args = [s["other"], at.active, s["attempt"], s["anchors"].listed_facet]
        ctx.launch(self.adjoint_kernels.list_anchors, (self.model.worlds, self.tables.points), args)
        self._build_point_lists(ctx, s["anchors"])  # type: ignore[attr-defined]
        self._adjoint_of_points(ctx, at.w, at.active, (0.0, 1.0), constants=a.constants)
        ctx.work.pool_product.zero_()
        a.spread_points(a.data.end_bar, at.active)
        self._gather_facets(ctx, at.active, [(END, 0, 2), (START, 2, 3)])
        a.add_pool(at.active, at.q_bar)

    def add_history_gradient(self, at: StepAdjoint) -> None:
        ctx, a, pool = at.ctx, self.adjoint(at.ctx), at.ctx.work.pool_product
        a.clear_wanted()
        weights = (-1.0, 1.0)
        self._adjoint_of_points(ctx, at.w, at.active, weights, constants=a.differentiated, at_start=True)
        for values, parts, out in ((a.data.start_bar, (0, 2), at.q_bar), (a.data.velocity_bar, (2, 3), at.v_bar)):
            pool.zero_()
            a.spread_points(values, at.active)
            self._gather_facets(ctx, at.active, [(START, *parts)])
            a.add_pool(at.active, out)
