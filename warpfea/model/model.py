"""Model: constant data of a scene on one device, and functions evaluated at a state."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Callable
from typing import Any

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..base.devices import find_device
from ..base.errors import ModelError
from ..base.memory import Memory, convert_memory_errors
from ..base.names import check_choice
from ..base.notebook import summary_table
from ..base.writer import VIEWERS
from ..kernels.common.types import precision
from . import assembly
from .blocks import Block, build_block
from .bodies import Body
from .components import Components
from .description import Description
from .masses import Masses
from .parameters import MaterialParameters
from .slot_table import SlotTable, make_topology
from .state import State

__all__ = ["Block", "Model"]


MANY_WORLDS = 64
"""Number of worlds from which a model is one of many: solvers then choose what is fastest for many on a GPU."""
MAX_LISTED_BODIES = 3
"""Maximum number of bodies listed by a repr."""


class Model:
    """Made by ModelBuilder.finalize; constant except for `set_gravity` and `set_parameter`.

    Args:
        description: the scene; later additions to it do not change the model.
        terms: makes the set of terms (forces, contact, constraints) of a model, see terms.term_set.
        device, dtype, worlds, many: see ModelBuilder.finalize.
        tables: tables of shape gradients for straight elements, too.

    Attributes:
        bodies: the bodies, in the order they were added.
        worlds: number of copies of the model stepped together; dtype, device: as given.
        many: solvers take what is fastest for many worlds.
        slots: number of slots (3-vector unknowns: node positions and gradients) of all bodies.
        size: diagonal of the box of all nodes, m; reference length of constraint tolerances.
        slot_table: kinds, reference values and free components of the slots.
        blocks: element blocks; contributions, element_count, history_count: numbers of their contributions to slots,
            elements, and points with a history of damping.
        masses: mass matrix. parameters: material constants.
        terms: what adds to the residual. evaluation: forces, stresses and constraints at a state.
        components: connected components. topology: device tables that gather the contributions.
        memory: constant device arrays and their bytes. cache: tables shared by solvers.

    Raises:
        ModelError: no bodies, or an unknown device or precision.
        CapacityError: the device has too little memory.
    """

    def __init__(
        self,
        description: Description,
        terms: Callable[[Model], Any],
        *,
        device: Any = None,
        dtype: str = "float64",
        worlds: int = 1,
        many: bool | None = None,
        tables: bool = False,
    ) -> None:
        check_choice("dtype", dtype, ("float64", "float32"))
        if not isinstance(worlds, (int, np.integer)) or worlds < 1:
            raise ModelError(f"worlds = {worlds!r} must be a positive whole number")
        if not description.bodies:
            raise ModelError("the model has no body: call add_solid, add_beam or add_shell first")
        self.device = find_device(device)
        self.dtype = dtype
        self.worlds = int(worlds)
        self.many = self.worlds >= MANY_WORLDS if many is None else bool(many)
        self.description = description.copy()
        self.types = precision(dtype)
        self.memory = Memory(self.device, self.types)
        self.cache: dict[str, Any] = {}
        self._make_terms, self._tables = terms, tables
        with convert_memory_errors(f"a model with {self.worlds} worlds", self.device):
            self._build()

    def resized(self, worlds: int, dtype: str | None = None) -> Model:
        """New model of the same description with another number of worlds or precision; values set by `set_parameter`
        are not carried over."""
        return Model(
            self.description, self._make_terms, device=self.device, dtype=dtype or self.dtype, worlds=worlds,
            many=self.many, tables=self._tables,
        )  # fmt: skip

    def _build(self) -> None:
        """Number, assemble and upload the description."""
        self.slot_table = SlotTable(self.description, self.memory)
        self.slots = self.slot_table.count
        boxes = np.array([body.mesh.bounding_box() for body in self.bodies])
        self.size = float(np.linalg.norm(boxes[:, 1].max(axis=0) - boxes[:, 0].min(axis=0)))
        self.masses = Masses(self)
        hosts = [host for body in self.bodies for host in assembly.host_blocks(body, tables=self._tables)]
        self.parameters = MaterialParameters(self, hosts)
        self.blocks: list[Block] = []
        self.contributions, self.element_count, self.history_count = 0, 0, 0
        for key in dict.fromkeys(host.key for host in hosts):
            block = build_block(self, key, [host for host in hosts if host.key == key])
            self.blocks.append(block)
            self.contributions += block.count * block.slots
            self.element_count += block.count
            if key.damping == "incremental":
                self.history_count += block.count * block.points
        self.terms = self._make_terms(self)
        self.evaluation = self.terms.evaluation
        self.components = Components(self)
        self.terms.build()
        self.topology = make_topology(self)
        self.components.upload(self)

    def __repr__(self) -> str:
        names = ", ".join(repr(body.name) for body in self.bodies)
        what = names if len(self.bodies) <= MAX_LISTED_BODIES else f"{len(self.bodies)} bodies"
        mass = "no density" if self.mass is None else f"{self.mass:.4g} kg"
        worlds = f", {self.worlds} worlds" if self.worlds > 1 else ""
        return f"Model({what}, {int(self.free_slots.sum())} unknowns, {mass}, {self.device}, {self.dtype}{worlds})"

    def _repr_html_(self) -> str:
        info = self.info()
        rows = {name: info[name] for name in ("elements", "unknowns", "device", "dtype")}
        rows |= {"mass": "" if self.mass is None else f"{self.mass:.4g} kg", "features": ", ".join(info["features"])}
        rows |= {"worlds": self.worlds if self.worlds > 1 else "", "memory": f"{info['bytes']['total'] / 1e6:.3g} MB"}
        return summary_table("model", self.description.table() | rows)

    @property
    def mass(self) -> float | None:
        """Mass, kg, of the first world; None for a material without density."""
        laws = [law for body in self.bodies for _, law in body.materials]
        if any(law.density is None for law in laws):
            return None
        return float(self.masses.lumped[0][self.slot_table.kind == 0].sum())

    @property
    def bodies(self) -> list[Body]:
        """Bodies, in the order they were added."""
        return self.description.bodies

    def array(self, name: str, values: Any, dtype: Any) -> wp.array:
        """Upload a constant array; its bytes are counted under `name`."""
        return self.memory.array(name, values, dtype)

    @property
    def constraints(self) -> Any:
        """Tables of the constraints (see terms.constraint_tables), or None."""
        term = self.terms.constraints
        return term and term.tables

    # public methods

    @property
    def free_slots(self) -> np.ndarray:
        """(slots, 3) mask of the components that are unknowns."""
        return self.slot_table.free.astype(bool)

    @property
    def features(self) -> dict[str, bool]:
        """Optional features used by the scene."""
        return self.terms.features | {
            "driven nodes": any(s.law or s.node_laws for s in self.description.supports),
            "free groups": self.components.free_group_count > 0,
            "separate components": self.components.count > 1,
            "probes": bool(self.description.probes),
        }

    def info(self) -> dict[str, Any]:
        """Features used and unused, counts, contacts, bytes of the constants, kernel modules of the elements."""
        features = self.features
        return {
            "bodies": [
                {
                    "name": b.name,
                    "element": b.family.name,
                    "quadrature": sorted(
                        {k.key.scheme for k in self.blocks if any(p.body is b for p in k.host_blocks)}
                    ),
                    "elements": len(b.mesh.cells),
                    "nodes": len(b.mesh.used_nodes),
                    "materials": [type(m).__name__ + (f" ({g})" if g else "") for g, m in b.materials],
                }
                for b in self.bodies
            ],
            "worlds": self.worlds,
            "many": self.many,
            "dtype": self.dtype,
            "device": str(self.device),
            "slots": self.slots,
            "unknowns": int(self.free_slots.sum()),
            "elements": sum(len(body.mesh.cells) for body in self.bodies),
            "mass": self.mass,
            "joints": [
                {"name": j.name, "kind": j.kind, "rows": len(j.rows), "between": j.between}
                for j in (self.constraints.joints if self.constraints else ())
            ],
            "contacts": [fact for term in self.terms.contacts for fact in term.contacts_info()],
            "features": [k for k, on in features.items() if on],
            "left_out": [k for k, on in features.items() if not on],
            "blocks": [
                dict(element=b.key.family, law=b.key.law, elements=b.count, points=b.points, affine=b.key.affine)
                for b in self.blocks
            ],
            "bytes": self.memory.bytes | {"total": sum(self.memory.bytes.values())},
            "kernels": sorted({b.kernels.module.name.removeprefix("warpfea.kernels.") for b in self.blocks}),
        }

    def show(self, path: str | os.PathLike[str], **options: Any) -> None:
        """Draw the model at its initial state, with supports, joints, loads and obstacles, before a run.

        Args:
            path: .png, .html or another file of one writer.
            options: of that writer, see :class:`warpfea.PNGWriter` and :class:`warpfea.HTMLWriter`.

        Raises:
            ModelError, OutputError: see the writer.
        """
        VIEWERS[0](self, path, **options)

    def state(self) -> State:
        """A new State with the initial displacements and velocities of the bodies, and values of controls."""
        out = State(self.worlds, self.device)
        vec3 = self.types.vec3
        u = np.zeros((self.slots, 3))
        v = np.zeros((self.slots, 3))
        for body in self.bodies:
            rows = body.slot_range
            if body.initial_displacement is not None:
                u[rows] = body.initial_displacement
            if body.velocity is not None:
                v[rows] = body.velocity
        v[self.slot_table.clamped] = 0.0  # driven components keep the user's initial velocities
        out.register("displacement", vec3, (self.slots,), u)
        out.register("velocity", vec3, (self.slots,), v)
        out.register("time", wp.float64)
        self.terms.time_laws.register(out)
        return out

    def mass_matrix(self, world: int = 0) -> sp.csr_matrix:
        """Consistent mass of one world, (3 slots, 3 slots) CSR, kg; unknown 3 slot + component.

        Raises:
            ModelError: a material without a density.
        """
        assembly.require_density(self.bodies, "mass_matrix")
        return sp.kron(self.masses.world_matrix(world), sp.identity(3), format="csr")

    def internal_force(self, state: State) -> np.ndarray:
        """Elastic internal force, Eq. (32), [world, slot, 3], N."""
        return self.evaluation.internal_force(state)[0]

    def viscous_force(self, state: State) -> np.ndarray:
        """Kelvin-Voigt force of Eqs. (58)-(70) at the state's displacement and velocity, [world, slot, 3], N."""
        return self.evaluation.viscous_force(state)[0]

    def strain_energy(self, state: State) -> np.ndarray:
        """[world], J."""
        return self.evaluation.internal_force(state)[1]

    def tangent_matrix(self, state: State, world: int = 0) -> sp.csr_matrix:
        """Elastic tangent df_int/dq of one world, (3 slots, 3 slots) CSR, N/m; clamped rows included."""
        return self.evaluation.tangent_matrix(state, world)

    def set_gravity(self, gravity: Any, *, mask: Any = None) -> None:
        """Gravity of all worlds (3,) or per world (worlds, 3), m/s^2; for the worlds of `mask` (worlds,).

        Raises:
            ModelError: wrong shape, a value that is not finite, a material without a density, or a model built without
                gravity.
        """
        self.set_parameter("gravity", gravity, mask=mask)

    def contact_force(self, state: State) -> np.ndarray:
        """Nodal contact forces on the bodies at a state, without contact damping, [world, slot, 3], N.

        The state of a simulation has the friction springs and collider positions; for another state colliders follow
        their paths at its time, without friction.
        """
        out = np.zeros((self.worlds, self.slots, 3))
        for term in self.terms.contacts:
            out += term.nodal_force(state)
        return out

    def set_parameter(self, name: str, values: Any, *, mask: Any = None) -> None:
        """Set a parameter in all or some worlds; simulations use the new values from their next step on.

        Args:
            name: "B.E" with the name B of a body, or "B.G.E" with a group G that has a material of its own: a constant
                of the material (E and nu if made from them, else those of the law), eta and lambda_v of its damping
                (KelvinVoigt(eta=0) makes them settable from 0), or density, kg/m^3; density_factor for densities
                given as a function or per element. Set such a name for the first time before making simulations.
                "C.mu", "C.mu_static", "C.restitution" or "C.stiffness" with the name C of a contact, as of
                ModelBuilder.add_contact; mu_static follows mu if equal to it. "K.offset" with the name K of a
                collider: of a HalfSpace the offset of its plane, m; of other shapes the outward offset of the
                surface, m. A surface moved into a body pushes it out. "S.stiffness", "S.damping" or "S.rest" with the
                name S of a spring. "gravity", as set_gravity.
            values: a number, or (worlds,), on the host or on a device; of gravity (3,) or (worlds, 3).
            mask: (worlds,), on the host or on a device: the worlds to set. None: all.

        Raises:
            ModelError: an unknown name, a quantity that all worlds share, a wrong shape, or a value out of range.
        """
        self.terms.set_parameter(name, values, mask)

    def fingerprint(self) -> str:
        """Hash of the data that a checkpoint must match: topology, geometry, laws, precision, supports, worlds."""
        h = hashlib.sha256(f"{self.dtype} {self.worlds} {self.slots}".encode())
        for block in self.blocks:
            h.update(repr(block.key).encode())
            for part in block.host_blocks:
                h.update(np.ascontiguousarray(part.conn).tobytes())
        for body in self.bodies:
            h.update(repr(body.section).encode())
            if body.frames is not None:
                h.update(np.ascontiguousarray(body.frames).tobytes())
        h.update(self.slot_table.reference.tobytes())
        h.update(self.slot_table.free.tobytes())
        h.update(self.masses.matrix.data.tobytes())
        h.update(self.parameters.initial_coefficients)
        self.terms.hash(h)
        return h.hexdigest()
