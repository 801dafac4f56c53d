"""Adjoint of contact: exact products, bars of histories, derivatives by parameters and paths of colliders; see
kernels/contact/adjoint.py."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

import numpy as np
import warp as wp

from ..base.errors import ModelError
from ..kernels.contact.adjoint import contact_adjoint_kernels, contact_adjoint_struct
from ..kernels.contact.structs import contact_scratch_struct, contact_struct
from ..materials import DENSITY_CONSTANTS
from ..model.contact_points import effective_modulus
from ..terms.gradients import FOUR_POINTS, Gradient, StepAdjoint, with_fields
from ..terms.protocols import Differentiable
from ..terms.term import StepContext, part
from .tables import MATERIAL_CONSTANTS, POINT_SUM_LANES, bodies_of, contact_constants, restitution_slopes

__all__ = ["ContactAdjoint", "DifferentiableColliders", "DifferentiableContact", "sum_of_gradients"]

RELATIVE_STEP = 1e-3
"""Four-point differences of the law's constants by those of materials, of which they are roots and quotients."""


class ContactAdjoint:
    """Arrays of the adjoint of a contact term.

    Attributes:
        data: bars of the points, as of kernels/contact/adjoint.py.
        constants: of the laws, with the points as contacts; differentiated: the same, with gradient arrays.
        attempt: scratch of the term, with a gradient array of the approach speeds.
        wanted: names of the constants whose derivatives are wanted.
    """

    def __init__(self, term: Any, at: StepAdjoint) -> None:
        t, m, ctx = term.tables, term.model, at.ctx
        self.term, self.tables, self.ctx = term, t, ctx
        self.kernels = contact_adjoint_kernels(m.dtype, t.own_laws)
        scratch = ctx.scratch[term.name]
        self.scratch, size = scratch, (m.worlds, t.points)
        self.data = contact_adjoint_struct()()
        for name, var in contact_adjoint_struct().vars.items():
            if name not in ("approach_bar", "switches", *term.unused_bars):
                setattr(self.data, name, self._array(name, size, var.type.dtype))
        self.data.switches = at.switches
        for name in term.carried_bars:
            at.bars[f"{term.name} {name}"] = getattr(self.data, name)
        speed = with_gradient(scratch["attempt"].approach_speed)
        self.data.approach_bar = speed.grad
        self.attempt = with_fields(contact_scratch_struct(m.dtype), scratch["attempt"], approach_speed=speed)
        self.of_point = np.repeat(np.arange(len(t.contacts)), np.diff(t.first))
        self.constants = contact_struct()()
        for name, var in contact_struct().vars.items():
            shape = (t.points,) if var.type.ndim == 1 else size
            setattr(self.constants, name, self._array(name, shape, var.type.dtype))
        self.updates = (-1, -1)
        self.wanted: dict[str, wp.array] = {}
        self.differentiated = with_fields(contact_struct(), self.constants)
        self.first: wp.array = wp.array(t.first, dtype=wp.int32, device=m.device)

    def _array(self, name: str, shape: tuple[int, ...], dtype: Any) -> wp.array:
        return self.ctx.work.array(f"{self.term.name} adjoint {name}", shape, dtype)

    def begin(self) -> None:
        """Copy the constants of the laws to the points, if they have changed."""
        updates = self.ctx.model.terms.parameter_updates, self.ctx.model.parameters.version
        if self.updates == updates:
            return
        self.updates = updates
        for name in contact_struct().vars:
            values = getattr(self.tables.data, name).numpy()
            into = getattr(self.constants, name)
            rows = values[self.of_point] if into.ndim == 1 else values[:, self.of_point]
            into.assign(np.broadcast_to(rows, (*into.shape, *values.shape[into.ndim :])))

    def want(self, name: str) -> wp.array:
        """Array of the derivatives by a constant, [world, point]."""
        if name not in self.wanted:
            array = with_gradient(getattr(self.constants, name))
            self.wanted[name] = array.grad
            setattr(self.differentiated, name, array)
        return self.wanted[name]

    def clear_wanted(self) -> None:
        """Begin the sums of a step."""
        for array in self.wanted.values():
            array.zero_()

    def spread_points(self, values: wp.array, active: wp.array) -> None:
        """Values of points on the slots of their facets, into the pool of products."""
        m, pool = self.ctx.model, self.ctx.work.pool_product
        for group in self.tables.groups:
            dim = (m.worlds, group.conn.shape[1], group.count)
            self.ctx.launch(self.kernels.spread_points, dim, [group.data, values, active, pool])

    def add_pool(self, active: wp.array, out: wp.array) -> None:
        """out [world, slot] += the pool of products."""
        m, pool = self.ctx.model, self.ctx.work.pool_product
        self.ctx.launch(self.kernels.add_pool, (m.worlds, m.slots), [m.topology, pool, active, out])

    def spread(self, values: wp.array, active: wp.array, out: wp.array) -> None:
        """out [world, slot] += values of points at their slots."""
        self.ctx.work.pool_product.zero_()
        self.spread_points(values, active)
        self.add_pool(active, out)

    def sum_of(self, factor: np.ndarray, values: wp.array, *, along: bool = True) -> Gradient:
        """Function that adds the sum over contacts of factor (worlds or 1, contacts) times values of their points; of
        vectors with `along` the scalar product."""
        vector = values.dtype is not wp.float64
        table: wp.array = wp.array(factor, dtype=values.dtype, device=self.ctx.model.device)
        kernel = self.kernels.sum_vectors if vector else self.kernels.sum_scalars

        def add(at: StepAdjoint, out: wp.array) -> None:
            more = [int(along)] if vector else []
            at.ctx.launch(kernel, at.dim[0], [self.first, table, values, at.active, *more, at.sums])
            at.accumulate(out, 1.0)

        return add


def with_gradient(of: wp.array) -> wp.array:
    """The same memory, with a gradient array."""
    return wp.array(ptr=of.ptr, dtype=of.dtype, shape=of.shape, device=of.device, requires_grad=True)


def sum_of_gradients(parts: list[Gradient]) -> Gradient:
    """Sum of several."""

    def add(at: StepAdjoint, out: wp.array) -> None:
        for each in parts:
            each(at, out)

    return add


class DifferentiableContact(Differentiable):
    """Adjoint of a contact term but for its geometry: `exact_product`, `linearise_adjoint`, `add_history_gradient`.

    Attributes:
        adjoint_kernels: of the geometry.
        carried_bars: bars of histories, in `ContactAdjoint.data`; unused_bars: arrays there that it does without.
    """

    carried_bars: tuple[str, ...] = ("spring_bar", "speed_bar")
    unused_bars: tuple[str, ...] = ()

    tables: Any
    adjoint_kernels: Any

    def adjoint(self, ctx: StepContext) -> ContactAdjoint:
        """Its arrays, once `prepare_adjoint` was called."""
        found: ContactAdjoint = ctx.scratch[self.name]["adjoint"]
        return found

    def not_differentiable(self, ctx: StepContext) -> str | None:
        t = self.tables
        if ctx.midpoint or ctx.accelerated:
            return "mid-point schemes and schemes with accelerations"
        if t.has_single_point:
            return "contacts of model='sphere'"
        if t.rolls:
            return "rigid capsules and cylinders that roll (model='patch' takes points on their facets)"
        if t.explicit:
            return "treatment='explicit'"
        if not ctx.inertia and (t.data.mu_static.numpy() > 0.0).any():
            return "friction in statics, which depends on the path"
        return None

    def is_symmetric(self, ctx: StepContext) -> bool:
        return False

    def prepare_adjoint(self, at: StepAdjoint) -> Iterable[wp.Module]:
        adjoint = ContactAdjoint(self, at)
        at.ctx.scratch[self.name]["adjoint"] = adjoint
        return {adjoint.kernels.module, self.adjoint_kernels.module}

    def begin_adjoint(self, at: StepAdjoint) -> None:
        self.adjoint(at.ctx).begin()

    # parameters

    def gradients(self, ctx: StepContext) -> Mapping[str, Callable[[], Gradient]]:
        out: dict[str, Callable[[], Gradient]] = {}
        owner_of = {id(c.edges): c for c in self.model.description.contacts if c.edges is not None}
        found: dict[str, list[int]] = {}
        for k, contact in enumerate(self.tables.contacts):
            for of in (contact, owner_of.get(id(contact))):  # values of a contact are those of its edges, too
                if of is not None:
                    found.setdefault(of.name, []).append(k)
        for owner, members in found.items():
            for name in ("mu", "mu_static", "restitution", "stiffness"):
                out[f"{owner}.{name}"] = partial(self._law_gradients, ctx, members, name)
        parameters = self.model.parameters
        known = parameters.setters()
        for owner, parts in parameters.owners().items():
            mine = {id(body) for body, _ in parts}
            touched = [k for k, c in enumerate(self.tables.contacts) if mine & {id(body) for body in bodies_of(c)}]
            for name in (key.rpartition(".")[2] for key in known if key.rpartition(".")[0] == owner):
                if touched:
                    out[f"{owner}.{name}"] = partial(self._material_gradient, ctx, touched, parts, name)
        return out

    def _factors(self, columns: dict[int, Any]) -> np.ndarray:
        """Table (worlds, contacts) with these columns."""
        out = np.zeros((self.model.worlds, len(self.tables.contacts)))
        for k, values in columns.items():
            out[:, k] = values
        return out

    def _law_gradients(self, ctx: StepContext, of: list[int], name: str) -> Gradient:
        """Derivative by a parameter of some contacts."""
        return sum_of_gradients([self._law_gradient(ctx, k, name) for k in of])

    def _law_gradient(self, ctx: StepContext, k: int, name: str) -> Gradient:
        """Derivative by a parameter of a contact."""
        a, data = self.adjoint(ctx), self.tables.data  # constants are known in `backward`
        mu, mu_static = (getattr(data, key).numpy()[:, k] for key in ("mu", "mu_static"))
        factors: dict[str, Any] = {"stiffness": {"scale": 1.0}, "mu_static": {"mu_static": 1.0}}
        factors["mu"] = {"mu": 1.0, "mu_static": mu_static == mu}
        if name == "restitution":
            slopes = restitution_slopes(data.damping.numpy()[:, k], data.beta.numpy()[:, k])
            if np.isnan(slopes).any():
                raise ModelError("Adjoint: a restitution of 0 has no derivative")
            factors[name] = dict(zip(("damping", "beta"), slopes))
        return sum_of_gradients([a.sum_of(self._factors({k: f}), a.want(key)) for key, f in factors[name].items()])

    def _material_gradient(self, ctx: StepContext, of: list[int], members: list[Any], name: str) -> Gradient:
        """Derivative by a constant of some materials, through the constants of the laws that follow from it."""
        a, m, tables = self.adjoint(ctx), self.model, self.tables
        size = m.worlds, len(tables.contacts)
        found = {key: np.zeros((*size, 3) if key == "compliance" else size) for key in MATERIAL_CONSTANTS}
        for k in of:
            varies = any(m.parameters.varies(body) for body in bodies_of(tables.contacts[k]))
            for world in range(m.worlds if varies else 1):
                rows = world if varies else slice(None)
                for key, value in self._slopes(tables.contacts[k], members, name, world).items():
                    found[key][rows, k] = value
        return sum_of_gradients([a.sum_of(f, a.want(key)) for key, f in found.items() if f.any()])

    def _slopes(self, contact: Any, members: list[Any], name: str, world: int) -> dict[str, Any]:
        """Derivatives of the constants of a contact in a world by a constant of some materials."""
        value = self.model.parameters.material_in_world(members[0][0], members[0][1], world).constants[name]
        step = RELATIVE_STEP * (abs(float(value)) or 1.0)
        near = [self._shifted_constants(contact, members, name, world, k * step) for k, _ in FOUR_POINTS]
        return {key: sum(w / step * np.asarray(at[key]) for (_, w), at in zip(FOUR_POINTS, near)) for key in near[0]}

    def _shifted_constants(
        self, contact: Any, members: list[Any], name: str, world: int, shift: float
    ) -> dict[str, Any]:
        """Constants of a contact in a world, with a constant of some materials shifted."""
        p, m = self.model.parameters, self.model

        def modulus(body: Any, surface: Any) -> Any:
            laws = [p.material_in_world(body, k, world) for k in range(len(body.materials))]
            for k in (k for owner, k in members if owner is body):
                laws[k] = laws[k].with_constants({name: laws[k].constants[name] + shift})
            return effective_modulus(body, surface, laws)

        def mass(body: Any) -> float:
            own = [m.masses.parts[m.bodies.index(owner), k].scaled_mass for owner, k in members if owner is body]
            return p.mass(body, world) + (sum(own) * shift if name in DENSITY_CONSTANTS else 0.0)

        area = self.tables.region_areas[self.tables.number[contact.index]]
        return contact_constants(contact, area, mass, modulus)


class DifferentiableColliders(DifferentiableContact):
    """Adjoint of contact with colliders: a Jacobian for each point."""

    carried_bars = ("spring_bar", "speed_bar", "start_shift_bar", "start_turn_bar")

    @part()
    def exact_product(
        self, ctx: StepContext, p: wp.array, active: wp.array, *, transposed: bool, start: bool = False
    ) -> None:  # fmt: skip
        a, B = self.adjoint(ctx), self.model.worlds
        attempt, lanes = a.scratch["attempt"], ctx.launch.lanes(POINT_SUM_LANES)
        for group in self.tables.groups:
            args = [group.data, active, p, int(transposed), a.data, attempt]
            ctx.launch(a.kernels.exact_products, group.point_threads(B), args)
        for group in self.tables.groups:
            entries = group.conn.size
            args = [a.scratch["other"], group.data, active, lanes, entries - 1, attempt, ctx.work.pool_product]
            kernel = self.point_kernels.gather_products  # type: ignore[attr-defined]
            ctx.launch(kernel, (B, ctx.launch.padded(lanes * entries)), args)

    def linearise_adjoint(self, at: StepAdjoint) -> None:
        a, s = self.adjoint(at.ctx), at.ctx.scratch[self.name]
        for group in self.tables.groups:
            args = [self.tables.data, a.constants, s["other"], group.data, s["history"], s["clock"], s["u"]]
            args += [at.active, a.attempt, a.data]
            at.ctx.launch(self.adjoint_kernels.linearise_points, group.point_threads(self.model.worlds), args)
        a.spread(a.data.end_bar, at.active, at.q_bar)

    def add_history_gradient(self, at: StepAdjoint) -> None:
        a, s = self.adjoint(at.ctx), at.ctx.scratch[self.name]
        a.clear_wanted()
        for group in self.tables.groups:
            args = [self.tables.data, a.differentiated, s["other"], group.data, s["history"], s["clock"], s["u"]]
            args += [at.ctx.state.velocity, at.w, at.active, a.attempt, a.data]
            at.ctx.launch(self.adjoint_kernels.step_back_points, group.point_threads(self.model.worlds), args)
        a.spread(a.data.start_bar, at.active, at.q_bar)
        a.spread(a.data.velocity_bar, at.active, at.v_bar)
