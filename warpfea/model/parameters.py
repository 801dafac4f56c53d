"""Per-world material constants: Model.set_parameter for bodies."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from contextlib import contextmanager
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import CheckpointError, ModelError
from ..base.names import listing
from ..base.worlds import check_values_per_world, values_per_world
from ..kernels.elements.materials import NCOEF
from ..materials import ADMISSIBLE_VALUES, DENSITY_CONSTANTS, Material
from . import assembly
from .blocks import Block, couplings, output_rows
from .contact_points import Modulus, effective_modulus, elastic_constants

if TYPE_CHECKING:
    from collections.abc import Iterator

    from .discretisation import Discretisation
    from .handles import SurfaceSet

__all__ = ["MaterialParameters"]

Owner = tuple["Discretisation", int]
"""A body and the index of one of its materials."""
DAMPING_CONSTANTS = ("eta", "lambda_v")
SHARED_DATA = {
    "the mesh": ("cells", "elements", "mesh", "points"),
    "the reference geometry": ("frames", "height", "scale", "section", "thickness", "width"),
    "the element's kernels": ("integration", "law", "quadrature"),
    "the kernels of damping": ("form",),
}
"""Shared data, and the body data that belong to them and can't be parameters."""


class MaterialParameters:
    """Material constants of each world.

    Until one is set, all worlds read the single coefficient table of the model. It is then replaced by a table with
    one row per world, as are the dependent couplings of assumed strains: kernels get other arrays, so the first
    value must precede the simulations.

    Attributes:
        values: (worlds,) set values by (body index, material index, name).
        simulated: True once a simulation of the model exists.
        version: number of writes.
        coefficient_table: (worlds or 1, rows, NCOEF) coefficients of the device laws, one row per host block;
            coefficients: device copy; initial_coefficients: its bytes as built.
    """

    def __init__(self, model: Any, hosts: list[assembly.HostBlock]) -> None:
        self.model = model
        rows = []
        for row, host in enumerate(hosts):
            host.coefficient_row = row
            rows.append(assembly.coefficient_rows(host.coefficients, host.body.materials[host.material][1]))
        self.coefficient_table = np.array(rows).reshape(1, -1, NCOEF)
        self.coefficients = model.array("materials", self.coefficient_table, model.types.T)
        self.initial_coefficients = self.coefficients.numpy().tobytes()
        self.values: dict[tuple[int, int, str], np.ndarray] = {}
        self.simulated = False
        self.version = 0
        # allocated on first use: a model may have more worlds than fit into memory
        self._changes: np.ndarray | None = None
        self._couplings: dict[int, np.ndarray] = {}

    @property
    def changes(self) -> np.ndarray:
        """(worlds,) number of writes to each world."""
        if self._changes is None:
            self._changes = np.zeros(self.model.worlds, dtype=np.int64)
        return self._changes

    # names

    def owners(self) -> dict[str, list[Owner]]:
        """Materials by group name, "hook.arm", and all of a body by its name, "hook"."""
        out: dict[str, list[Owner]] = {}
        for body in self.model.bodies:
            out[body.name] = [(body, k) for k in range(len(body.materials))]
            out |= {f"{body.name}.{group}": [(body, k)] for k, (group, _) in enumerate(body.materials) if group}
        return out

    def setters(self) -> dict[str, Callable[[Any, np.ndarray], None]]:
        """Settable constants by name; for a body those common to all its materials."""
        out: dict[str, Callable[[Any, np.ndarray], None]] = {}
        for owner, members in self.owners().items():
            every = [body.materials[k][1].constants for body, k in members]
            for name in every[0]:
                if all(name in constants for constants in every):
                    out[f"{owner}.{name}"] = partial(self._set, owner, members, name)
        return out

    def explain(self, name: Any) -> str | None:
        """Reason why a name is not a parameter, or None."""
        owners = self.owners()
        owner, _, what = str(name).rpartition(".")
        if owner not in owners:
            return None
        laws = [body.materials[k][1] for body, k in owners[owner]]
        kinds = " and ".join(dict.fromkeys(type(law).__name__ for law in laws))
        for shared, names in SHARED_DATA.items():
            if what in names:
                return f"shared by all worlds ({shared}): build a separate model"
        if what in DAMPING_CONSTANTS:
            return f"the material {kinds} has no damping, so its kernels were left out; give it KelvinVoigt(eta=0)"
        for law in laws:
            if what in {"E", "nu", *law.constant_names} - set(law.constants):
                made = [constant for constant in law.constants if constant not in DENSITY_CONSTANTS]
                other = "from_E_nu" if what in ("E", "nu") else "its constructor"
                return f"the material {type(law).__name__} was made of {listing(made)}; {other} takes {what!r}"
        return None

    # values

    def material_in_world(self, body: Discretisation, k: int, world: int) -> Material:
        """Material of a body in one world."""
        return self._material((body, k), self.values, world)

    def varies(self, body: Discretisation) -> bool:
        """True if constants of a body's materials were set."""
        return any(index == self._index(body) for index, _, _ in self.values)

    def mass(self, body: Discretisation, world: int | None) -> float:
        """Mass of a body in a world or as built, kg; 0 for a material without density."""
        masses = self.model.masses
        return masses.total_of_body(body) if world is None else masses.total_of_body(body, world)

    def modulus(self, world: int | None) -> Modulus:
        """`effective_modulus` in a world, or as built."""
        if world is None:
            return effective_modulus

        def of(body: Discretisation, surface: SurfaceSet | None) -> tuple[float, float]:
            return effective_modulus(
                body, surface, [self.material_in_world(body, k, world) for k in range(len(body.materials))]
            )

        return of

    def youngs_modulus(self, body: Discretisation) -> np.ndarray:
        """The modulus of `effective_modulus` of a body in each world (worlds,), Pa, or one for all."""
        materials = [self.material_of_worlds(body, int(k)) for k in np.unique(body.material_of)]
        return np.max(np.broadcast_arrays(*(elastic_constants(material)[0] for material in materials)), axis=0)

    def material_of_worlds(self, body: Discretisation, k: int) -> Material:
        """Material of a body, with arrays for constants that differ between worlds."""
        return self._material((body, k), self.values)

    def _material(self, owner: Owner, values: Mapping[Any, np.ndarray], world: int | None = None) -> Material:
        body, k = owner
        material: Material = body.materials[k][1]
        mine = {name: v for (index, j, name), v in values.items() if (index, j) == (self._index(body), k)}
        if world is not None:
            mine = {name: float(v[world]) for name, v in mine.items()}  # type: ignore[misc]
        return material.with_constants(mine) if mine else material

    def _index(self, body: Discretisation) -> int:
        return self.model.bodies.index(body)  # type: ignore[arg-type]

    def _set(self, owner: str, members: list[Owner], name: str, values: Any, mask: np.ndarray) -> None:
        """Set a constant of some materials to values (worlds,) in the chosen worlds."""
        wanted = values_per_world(owner, name, values, self.model.worlds)
        good, text = ADMISSIBLE_VALUES.get(name, (np.isfinite, "finite"))
        check_values_per_world(owner, name, wanted, ~mask | (np.isfinite(wanted) & good(wanted)), text)
        if name in DENSITY_CONSTANTS:
            self._refuse_density(f"{owner}.{name}", [body for body, _ in members])
        keys = [(self._index(body), k, name) for body, k in members]
        if self.simulated and any(key not in self.values for key in keys):
            raise ModelError(
                f"set_parameter: '{owner}.{name}' was uniform when a Simulation of this model was made: set it "
                "before the first Simulation"
            )
        fresh = dict(self.values)
        for key, (body, k) in zip(keys, members):
            before = fresh.get(key, np.full(self.model.worlds, body.materials[k][1].constants[name]))
            fresh[key] = np.where(mask, wanted, before)
        self.values = fresh
        self._update_tables(members, name, mask)
        self.model.terms.update_materials(mask)
        self.changes[mask] += 1
        self.version += 1

    def _refuse_density(self, name: str, bodies: list[Discretisation]) -> None:
        """Refuse densities if data derived from them is shared by all worlds."""
        forces = [force for force in self.model.description.body_forces if set(force.bodies) & set(bodies)]
        if forces:
            raise ModelError(
                f"set_parameter: {name!r} can't be set: all worlds share what add_body_force does to a body, which is "
                "per mass; build a model of its own for another density"
            )
        if self.model.terms.dead_loads.gravity_law is not None:
            raise ModelError(
                f"set_parameter: {name!r} can't be set: all worlds share the weights of a time law of gravity; take "
                "constant gravity, which set_gravity sets in each world"
            )

    # tables

    def _update_tables(self, members: list[Owner], name: str, mask: np.ndarray) -> None:
        """Update the device tables of some materials."""
        m = self.model
        if name in DENSITY_CONSTANTS:
            keys = [(self._index(body), k) for body, k in members]
            m.masses.set_densities({key: self.values[(*key, name)] for key in keys})
            return
        if len(self.coefficient_table) != m.worlds:
            self.coefficient_table = np.tile(self.coefficient_table, (m.worlds, 1, 1))
        chosen = {(self._index(body), k) for body, k in members}
        for block in m.blocks:
            mine = [part for part in block.host_blocks if (self._index(part.body), part.material) in chosen]
            for part in mine:
                material = self.material_of_worlds(part.body, part.material)
                _, values = assembly.law_and_coefficients(part.key.integral, material)
                self.coefficient_table[:, part.coefficient_row] = assembly.coefficient_rows(values, material, m.worlds)
            tying = block.key.tying
            if mine and tying and name in tying.material_constants:
                self._update_couplings(block, mask)
            if mine and block.stress_output:
                block.stress_output.data.coefficients = m.array("output", output_rows(m, block), m.types.T)
        if self.coefficients.shape[0] == m.worlds:
            self.coefficients.assign(self.coefficient_table)
            return
        m.memory.uncount("materials", self.coefficients)
        self.coefficients = m.array("materials", self.coefficient_table, m.types.T)
        for block in m.blocks:
            block.data.coefficients = self.coefficients

    def _update_couplings(self, block: Block, mask: np.ndarray) -> None:
        """Couplings of assumed strains of a block in the chosen worlds, per world.

        Other constants are those of the bodies as built: E/mu, a function of nu, then rounds identically.
        """
        m, tying = self.model, block.key.tying
        assert tying is not None
        first = not block.couplings_per_world
        worlds = range(m.worlds) if first else np.flatnonzero(mask).tolist()
        table = self._couplings.get(block.contribution_offset)
        row = 0
        for part in block.host_blocks:
            owner = self._index(part.body), part.material
            own = {
                name: self.values[(*owner, name)] for name in tying.material_constants if (*owner, name) in self.values
            }
            numbers = [tuple(float(values[world]) for values in own.values()) for world in worlds]
            distinct = {key: k for k, key in enumerate(dict.fromkeys(numbers))}
            material = part.body.materials[part.material][1]
            made = couplings(part, [material.with_constants(dict(zip(own, key))) for key in distinct])
            if table is None:
                table = np.empty((m.worlds, block.count, *made.shape[2:]))
            rows = slice(row, row + made.shape[1])
            for world, key in zip(worlds, numbers):
                table[world, rows] = made[distinct[key]]
            row = rows.stop
        assert table is not None
        self._couplings[block.contribution_offset] = table
        values = np.moveaxis(table.reshape(-1, *table.shape[2:]), 0, 2)
        if not first:
            block.data.coupling.assign(np.ascontiguousarray(values))
            return
        m.memory.uncount("elements", block.data.coupling)
        block.data.coupling = m.memory.element_array(values, m.types.T)
        block.use_couplings_per_world(m.dtype)

    @contextmanager
    def temporarily_restricted_to_worlds(self, first: int, last: int) -> Iterator[None]:
        """Context: tables restricted to some worlds, for launches over them."""
        blocks = self.model.blocks if self.values else []
        kept: list[tuple[Block, Any, Any]]
        kept = [(block, block.data.coefficients, getattr(block.data, "coupling", None)) for block in blocks]
        try:
            for block, coefficients, coupling in kept:
                if coefficients.shape[0] == self.model.worlds:
                    block.data.coefficients = coefficients[first:last]
                if block.couplings_per_world:
                    block.data.coupling = coupling[:, :, first * block.count : last * block.count]
            yield
        finally:
            for block, coefficients, coupling in kept:
                block.data.coefficients = coefficients
                if block.couplings_per_world:
                    block.data.coupling = coupling

    # checkpoints

    def numpy(self) -> dict[str, np.ndarray]:
        """Set values by names "body.number.constant"."""
        return {f"{self.model.bodies[b].name}.{k}.{name}": v for (b, k, name), v in self.values.items()}

    def check(self, saved: Mapping[str, np.ndarray]) -> None:
        """Raise CheckpointError for invalid values of `numpy`, or constants other than those set here."""
        here = set(self.numpy())
        for name in sorted(here ^ set(saved)):
            owner, number, constant = name.rsplit(".", 2)
            of = {body.name: body for body in self.model.bodies}[owner]
            group = of.materials[int(number)][0]
            full = f"{owner}.{group}.{constant}" if group else f"{owner}.{constant}"
            first, second = ("model", "checkpoint") if name in here else ("checkpoint", "model")
            raise CheckpointError(
                f"the {first} has values of {full!r} set, the {second} has not; call set_parameter({full!r}, ...) "
                "before the Simulation of both or of none"
            )
        for name, values in saved.items():
            good, _ = ADMISSIBLE_VALUES.get(name.rsplit(".", 1)[1], (np.isfinite, ""))
            if values.shape != (self.model.worlds,) or not np.all(np.isfinite(values) & good(values)):
                raise CheckpointError(f"the values of {name!r} are damaged")

    def load(self, saved: Mapping[str, np.ndarray]) -> None:
        """Restore the values of `numpy`."""
        self.copy_values({owner: saved[key] for owner, key in zip(list(self.values), self.numpy())})

    def copy_values(self, values: Mapping[tuple[int, int, str], np.ndarray]) -> None:
        """Copy `values` of the same model, or of one in another precision."""
        every = np.ones(self.model.worlds, dtype=bool)
        for (b, k, name), of_worlds in values.items():
            body = self.model.bodies[b]
            self._set(body.name, [(body, k)], name, of_worlds, every)
