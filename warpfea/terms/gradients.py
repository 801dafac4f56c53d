"""Derivatives of a loss by parameters, -w . dg/dparameter of each step, on the device.

All laws are linear in their device coefficients, viscosity too: the internal force evaluated with the derivatives of
the coefficients in their place is the derivative of the force, exactly. Derivatives of the coefficients by the
constants that users give are those of a complex step through the code of the materials.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np
import warp as wp

from ..base.console import quiet_warp
from ..base.launch import Launcher, load_modules
from ..kernels.common.structs import topology_struct
from ..kernels.elements.assumed_strain_block import assumed_strain_struct
from ..kernels.elements.materials import NCOEF
from ..kernels.elements.points import block_struct
from ..kernels.solvers.vectors import vector_kernels
from ..kernels.step.gather import gather_kernels
from ..materials import DENSITY_CONSTANTS
from ..model import assembly
from ..model.blocks import couplings

if TYPE_CHECKING:
    from ..model.model import Model
    from .term import StepContext

__all__ = [
    "COMPLEX_STEP",
    "FOUR_POINTS",
    "ForceGradient",
    "Gradient",
    "Sensitivity",
    "StepAdjoint",
    "WeightGradient",
    "compile_kernels",
    "law_weights",
    "material_gradients",
    "with_fields",
]

COMPLEX_STEP = 1e-30
"""Derivatives are exact to round-off for any small one."""
FOUR_POINTS = tuple(zip((-2.0, -1.0, 1.0, 2.0), (1.0 / 12.0, -2.0 / 3.0, 2.0 / 3.0, -1.0 / 12.0)))
"""Points and weights of central differences of fourth order."""


@dataclass(eq=False)
class StepAdjoint:
    """Adjoint of a linearised step.

    Attributes:
        ctx: at its end; its state is that of the start.
        solver: `AdjointSolver` of solvers/adjoint.py, which describes w, mu, bars, q_bar, v_bar, drive_bar, kernels.
        force, drive, q_tilde: of changes along a direction, in place of bars; known after `prepare_forward`.
        scratch: [world, slot].
        switches: [world] counts of points that came into contact or left it, began to slip or stuck.
    """

    ctx: StepContext
    solver: Any
    scratch: wp.array
    switches: wp.array

    def __post_init__(self) -> None:
        s = self.solver
        self.w, self.mu, self.q_bar, self.v_bar, self.drive_bar = s.w, s.mu, s.q_bar, s.v_bar, s.drive_bar
        self.bars: dict[str, wp.array] = s.bars
        self.kernels, self.integrator, self.ones = s.kernels, s.integrator, s.ones

    def prepare_forward(self) -> None:
        """Prepare for changes along a direction."""
        s = self.solver
        s.prepare_forward()
        self.force, self.drive, self.q_tilde = s.force, s.drive, s.q_tilde

    def history_fields(self) -> Iterator[tuple[str, wp.array, wp.array]]:
        """As of the solver."""
        return self.solver.history_fields()  # type: ignore[no-any-return]

    def add_predictor_bar(self, x: wp.array) -> None:
        """Add bars x of q~ to those of the state at the start."""
        self.solver.add_predictor_bar(x, self.active)

    @property
    def launch(self) -> Launcher:
        """Launches kernels."""
        return self.ctx.launch

    @property
    def active(self) -> wp.array:
        """Flags of the worlds of this step."""
        return self.solver.running

    @property
    def sums(self) -> wp.array:
        """[3, world] scratch."""
        return self.solver.control.sums

    @property
    def dim(self) -> tuple[int, int]:
        """(worlds, slots)."""
        return self.ctx.model.worlds, self.ctx.model.slots

    def add(self, out: wp.array, sign: float = 1.0) -> None:
        """out [world, k] += sign times the sums of the first rows of work.rows."""
        self.solver.newton.residual.reduce(self.ctx.work.rows, out.shape[1], self.active, self.sums)
        self.accumulate(out, sign)

    def accumulate(self, out: wp.array, sign: float) -> None:
        """out [world, k] += sign sums[k, world]."""
        self.ctx.launch(self.kernels.accumulate, out.shape, [self.sums, wp.float64(sign), self.active, out])

    def add_to(self, name: str, x: wp.array) -> None:
        """Bar of a state array += x."""
        self.ctx.launch(self.kernels.add_vector, self.dim, [x, self.active, self.bars[name]])

    def gather(self, out: wp.array) -> None:
        """Contributions of the elements, summed by slot."""
        m, w = self.ctx.model, self.ctx.work
        kernel = gather_kernels(m.dtype, self.ctx.traits).gather_force
        self.ctx.launch(kernel, self.dim, [m.topology, w.contribution, self.active, out])


class Gradient(Protocol):
    """Derivative by a parameter."""

    def __call__(self, at: StepAdjoint, out: wp.array, /) -> None:
        """Add the derivatives of a step to an array [world, k], float64."""


@runtime_checkable
class Sensitivity(Gradient, Protocol):
    """Derivative that goes forwards, too."""

    def change(self, at: StepAdjoint, change: wp.array) -> None:
        """Add the effect of a change [world, k] of the parameter to at.force or at.drive."""


def compile_kernels(model: Model, kernels: Iterable[wp.Kernel]) -> None:
    """Compile kernels before launches are captured."""
    with quiet_warp():
        load_modules({kernel.module.name: kernel.module for kernel in kernels}, model.device, None)


def with_fields(kind: Any, data: Any, **changes: Any) -> Any:
    """Copy of a struct with other values of some fields."""
    out = kind()
    for name in kind.vars:
        setattr(out, name, changes.get(name, getattr(data, name)))
    return out


@dataclass(eq=False)
class ForceGradient:
    """Derivative by a parameter of k components, from the change of the balance of forces along each.

    Attributes:
        force: writes -dg/dparameter, or its negative, by a component to at.scratch. sign: 1.0, or -1.0.
        inertia: by the mass, too.
    """

    force: Callable[[StepAdjoint, int], None]
    sign: float = 1.0
    inertia: bool = False

    def __call__(self, at: StepAdjoint, out: wp.array) -> None:
        m = at.ctx.model
        dot_terms = vector_kernels(m.dtype, m.terms.traits.has_constraints).dot_terms
        for k in range(out.shape[1]):
            self.force(at, k)
            at.ctx.launch(dot_terms, at.dim, [at.scratch, at.w, at.active, at.ctx.work.rows])
            at.add(out[:, k : k + 1], self.sign)

    def change(self, at: StepAdjoint, change: wp.array) -> None:
        """Add the force of a change [world, k] of the parameter to at.force."""
        for k in range(change.shape[1]):
            self.force(at, k)
            args = [at.scratch, change, k, wp.float64(self.sign), at.active, at.force]
            at.ctx.launch(at.kernels.scaled_change, at.dim, args)


@dataclass(eq=False)
class WeightGradient:
    """Derivative by the value of a law that acts on the slots with weights: their sums of a vector.

    Attributes:
        weight: [slot]. prescribed: on positions, else on forces.
    """

    weight: wp.array
    prescribed: bool

    def __call__(self, at: StepAdjoint, out: wp.array) -> None:
        args = [self.weight, at.drive_bar if self.prescribed else at.w, at.active, at.ctx.work.rows]
        at.ctx.launch(at.kernels.weighted_rows, at.dim, args)
        at.add(out)

    def change(self, at: StepAdjoint, change: wp.array) -> None:
        """Add the effect of a change [world, k] of the value to at.force or at.drive."""
        into = at.drive if self.prescribed else at.force
        at.ctx.launch(at.kernels.weighted_change, at.dim, [self.weight, change, at.active, into])


def law_weights(model: Model, slots: np.ndarray, weights: np.ndarray, *, prescribed: bool = False) -> WeightGradient:
    """Derivative by the value of a law that acts on slots with weights (n, 3) or (n, 1)."""
    table = np.zeros((model.slots, 3))
    np.add.at(table, slots, weights)
    return WeightGradient(wp.array(table, dtype=model.types.vec3, device=model.device), prescribed)


def material_gradients(ctx: StepContext, elements: Any) -> dict[str, Callable[[], Gradient]]:
    """Derivatives by the constants of materials, by the names of `Model.set_parameter`."""
    out: dict[str, Callable[[], Gradient]] = {}
    parameters = elements.model.parameters
    known = parameters.setters()
    for owner, members in parameters.owners().items():
        for name in (key.rpartition(".")[2] for key in known if key.rpartition(".")[0] == owner):
            make = density_gradient if name in DENSITY_CONSTANTS else constant_gradient
            out[f"{owner}.{name}"] = partial(make, ctx, elements, members, name)
    return out


def density_gradient(ctx: StepContext, elements: Any, members: list[Any], name: str) -> Gradient:
    """Derivative by the density of some materials, of inertia and gravity."""
    m = elements.model
    masses = m.masses
    entries, lumped = np.zeros((1, masses.matrix.nnz)), np.zeros((1, m.slots))
    for body, k in members:
        key = m.bodies.index(body), k
        part, rows = masses.parts[key].matrix, slice(body.slot_offset, body.slot_offset + body.slot_count)
        entries[0, masses.entry_indices[key]] += part.data
        lumped[0, rows] += part @ m.slot_table.is_position[rows]
    arrays: list[wp.array] = [wp.array(values, dtype=m.types.T, device=m.device) for values in (entries, lumped)]
    topology = with_fields(topology_struct(m.dtype), m.topology, mass_value=arrays[0])

    def force(at: StepAdjoint, k: int) -> None:
        w = at.ctx.work
        args = [topology, arrays[1], m.terms.dead_loads.gravity, w.step.load_factor, w.v, w.v_tilde]
        at.ctx.launch(at.kernels.density_force, at.dim, [*args, w.step.mass_factor, at.active, at.scratch])

    return ForceGradient(force, inertia=True)


def constant_gradient(ctx: StepContext, elements: Any, members: list[Any], name: str) -> Gradient:
    """Derivative by a constant of the laws or of the damping of some materials."""
    m = elements.model
    worlds = m.parameters.coefficients.shape[0]
    table = np.zeros((worlds, m.parameters.coefficients.shape[1], NCOEF))
    chosen = [block for block in m.blocks if any((p.body, p.material) in members for p in block.host_blocks)]
    for block in chosen:
        for part in block.host_blocks:
            if (part.body, part.material) in members:
                material = _shifted(m.parameters.material_of_worlds(part.body, part.material), name)
                _, values = assembly.law_and_coefficients(part.key.integral, material)
                rows = assembly.coefficient_rows(values, material, worlds, complex)
                table[:, part.coefficient_row] = rows.imag / COMPLEX_STEP
    coefficients: wp.array = wp.array(table, dtype=m.types.T, device=m.device)
    kernels = dict(zip(map(id, m.blocks), elements.kernels(ctx)))
    passes = [[(block, {"coefficients": coefficients}) for block in chosen]]
    tied = [block for block in chosen if block.key.tying and name in block.key.tying.material_constants]
    passes += [[(block, {"coupling": _coupling_derivative(m, block, members, name)}) for block in tied]] if tied else []
    launches = [
        [(block, kernels[id(block)], _block_data(ctx, block, changes)) for block, changes in row] for row in passes
    ]

    def force(at: StepAdjoint, k: int) -> None:
        w = at.ctx.work
        for number, row in enumerate(launches):
            w.contribution.zero_()
            for block, kernel, data in row:
                elements.block_force(at.ctx, block, kernel, data, at.active)
            at.gather(at.scratch if number == 0 else w.Hp)
        if len(launches) > 1:
            at.ctx.launch(at.kernels.add_vector, at.dim, [w.Hp, at.active, at.scratch])

    return ForceGradient(force, -1.0)


def _shifted(material: Any, name: str) -> Any:
    """The material with a complex step of a constant."""
    return material.with_constants({name: material.constants[name] + 1j * COMPLEX_STEP})


def _block_data(ctx: StepContext, block: Any, changes: dict[str, Any]) -> Any:
    kind = assumed_strain_struct if block.key.tying else block_struct
    return with_fields(kind(ctx.model.dtype, ctx.dissipation > 0.0), ctx.work.data_of(block), **changes)


def _coupling_derivative(m: Model, block: Any, members: list[Any], name: str) -> wp.array:
    """Derivative of the matrices A of a block with assumed strains, in their layout on the device."""
    worlds = m.worlds if block.couplings_per_world else 1
    tables = []
    for part in block.host_blocks:
        if (part.body, part.material) not in members:
            tables.append(np.zeros((worlds, len(part.elements), *block.data.coupling.shape[:2])))
            continue
        material = m.parameters.material_of_worlds(part.body, part.material)
        values, of_world = np.unique(np.broadcast_to(material.constants[name], (worlds,)), return_inverse=True)
        plain = part.body.materials[part.material][1]
        shifted = [plain.with_constants({name: float(value) + 1j * COMPLEX_STEP}) for value in values]
        tables.append((couplings(part, shifted).imag / COMPLEX_STEP)[of_world])
    table = np.concatenate(tables, axis=1)
    values = np.moveaxis(table.reshape(-1, *table.shape[2:]), 0, 2)
    return wp.array(np.ascontiguousarray(values), dtype=m.types.T, device=m.device)
