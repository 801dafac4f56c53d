"""Model: constant data of a scene on one device, and functions evaluated at a state."""

from __future__ import annotations

import hashlib
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
import warp as wp

from ..base.devices import find_device
from ..base.errors import ModelError
from ..base.memory import convert_memory_errors
from ..kernels.common.types import precision
from ..kernels.elements.materials import DEFINED_FOR_ANY_J, NCOEF
from . import assembly
from .blocks import Block, build_block
from .bodies import Body
from .description import Description
from .masses import Masses
from .parameters import MaterialParameters
from .residual_groups import slot_groups
from .state import State
from .topology import label_components, make_free_groups, make_topology

__all__ = ["Block", "Model"]


MAX_LISTED_BODIES = 3
"""Maximum number of bodies listed by a repr."""


class ModelSource(Protocol):
    """Source of a Model: a ModelBuilder."""

    description: Description
    gravity: np.ndarray
    up_axis: str

    @property
    def bodies(self) -> list[Body]:
        """Bodies in the order of addition."""

    def make_terms(self, model: Model) -> tuple[Any, Any]:
        """Terms of a model (forces, contact, constraints), and the evaluator of its quantities at a state."""


class Model:
    """Made by ModelBuilder.finalize; constant except for `set_gravity` and `set_parameter`.

    Attributes:
        bodies: the bodies, in the order they were added.
        worlds: number of copies of the model stepped together; dtype, device, up_axis: as given.
        slots: number of slots (3-vector unknowns: node positions and gradients) of all bodies.
        size: diagonal of the box of all nodes, m; reference length of constraint tolerances.
        blocks: element blocks.
        mesh_component, component: (slots,) connected component, by elements alone and also by constraints.
        free_groups, free_group_count: components with an unconstrained translation: device struct and number.
        cache: tables shared by solvers.
        mass_host: scalar mass matrix (slots, slots), CSR on the host, kg.
    """

    def __init__(
        self,
        builder: ModelSource,
        *,
        device: Any = None,
        dtype: str = "float64",
        worlds: int = 1,
        tables: bool = False,
    ) -> None:
        if dtype not in ("float64", "float32"):
            raise ModelError(f"dtype = {dtype!r} is neither 'float64' nor 'float32'")
        if not isinstance(worlds, (int, np.integer)) or worlds < 1:
            raise ModelError(f"worlds = {worlds!r} must be a positive whole number")
        if not builder.bodies:
            raise ModelError("the model has no body: call add_solid, add_beam or add_shell first")
        self.device = find_device(device)
        self.dtype = dtype
        self.worlds = int(worlds)
        self.up_axis = builder.up_axis
        self.description = builder.description
        self.bodies: list[Body] = list(builder.bodies)
        self.types = precision(dtype)
        self._memory: dict[str, int] = {}
        self.cache: dict[str, Any] = {}
        self.parameters = MaterialParameters(self)
        self._source, self._tables = builder, tables
        with convert_memory_errors(f"a model with {self.worlds} worlds", self.device):
            self._build(builder, tables)

    def resized(self, worlds: int, dtype: str | None = None) -> Model:
        """New model of the same description with another number of worlds or precision; values set by `set_parameter`
        are not carried over."""
        return Model(self._source, device=self.device, dtype=dtype or self.dtype, worlds=worlds, tables=self._tables)

    def _build(self, builder: ModelSource, tables: bool) -> None:
        """Number, assemble and upload the description."""
        self._number_slots()
        self._assemble_mass()
        self._build_blocks(tables)
        self.gravity = np.asarray(builder.gravity, dtype=float)
        self.probes = list(builder.description.probes)
        self.terms, self.evaluation = builder.make_terms(self)
        self.mesh_component, self.component = label_components(self.graph(), self.terms.tied_slots())
        self.component_count = int(self.component.max()) + 1
        self.terms.build()
        self.topology = make_topology(self)
        self._upload_components()
        self.free_groups, self.free_group_count = make_free_groups(self)

    def __repr__(self) -> str:
        names = ", ".join(repr(body.name) for body in self.bodies)
        what = names if len(self.bodies) <= MAX_LISTED_BODIES else f"{len(self.bodies)} bodies"
        mass = "no density" if self.mass is None else f"{self.mass:.4g} kg"
        worlds = f", {self.worlds} worlds" if self.worlds > 1 else ""
        return f"Model({what}, {int(self.free_slots.sum())} unknowns, {mass}, {self.device}, {self.dtype}{worlds})"

    @property
    def mass(self) -> float | None:
        """Mass, kg, of the first world; None for a material without density."""
        laws = [law for body in self.bodies for _, law in body.materials]
        if any(law.density is None for law in laws):
            return None
        return float(self.masses.lumped[0][self.slot_kind == 0].sum())

    # construction

    def array(self, name: str, values: Any, dtype: Any) -> wp.array:
        """Upload a constant array; its bytes are counted under `name`."""
        out: Any = wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)
        self.count_bytes(name, out)
        return out

    def count_bytes(self, name: str, *arrays: wp.array) -> None:
        """Count the bytes of device arrays under `name`."""
        for array in arrays:
            self._memory[name] = self._memory.get(name, 0) + array.size * wp.types.type_size_in_bytes(array.dtype)

    def uncount_bytes(self, name: str, *arrays: wp.array) -> None:
        """Subtract the bytes of released arrays under `name`."""
        for array in arrays:
            self._memory[name] -= array.size * wp.types.type_size_in_bytes(array.dtype)

    def element_array(self, values: np.ndarray, dtype: Any) -> wp.array:
        """Upload element data [..., element]: coalesced on a GPU, contiguous per element on the CPU."""
        if self.device.is_cuda:
            return self.array("elements", values, dtype)
        last = np.ndim(values) - (2 if dtype is self.types.mat33 else 1 if dtype is self.types.vec3 else 0) - 1
        out = self.array("elements", np.moveaxis(values, last, 0), dtype)
        return out.transpose((*range(1, out.ndim), 0))

    def _number_slots(self) -> None:
        offset, elements_before = 0, 0
        for body in self.bodies:
            body.element_offset = elements_before
            elements_before += len(body.mesh.cells)
            for rule in {body.rule, body.curved_rule}:
                for part in body.family.scheme(rule):
                    assembly.check_orientation(body, part)
            body.slot_offset = offset
            offset += body.slot_count
        self.slots = offset
        boxes = np.array([body.mesh.bounding_box() for body in self.bodies])
        self.size = float(np.linalg.norm(boxes[:, 1].max(axis=0) - boxes[:, 0].min(axis=0)))
        self.slot_kind = np.concatenate([body.slot_kind for body in self.bodies])
        self.reference = np.concatenate([body.reference for body in self.bodies])
        self.is_position_host = (self.slot_kind == 0).astype(float)
        T, vec3 = self.types.T, self.types.vec3
        self.is_position = self.array("slots", self.is_position_host, T)
        self.reference_device = None
        if self.description.body_forces:
            self.reference_device = self.array("reference", self.reference, vec3)
        self.free_host = np.ones((self.slots, 3))
        self.clamped_host = np.zeros((self.slots, 3), dtype=bool)
        for support in self.description.supports:
            rows = support.body.slot_offset + support.slots
            self.free_host[rows] *= 1.0 - support.components
            if support.law is None and support.node_laws is None:
                self.clamped_host[rows] |= support.components.astype(bool)
        if not self.free_host.any() and not self.description.all_contacts:
            raise ModelError("every component of every node is prescribed: nothing is left to solve for")

    def _assemble_mass(self) -> None:
        self.masses = Masses(self)
        self.mass_host, self.lumped_host = self.masses.matrix, self.masses.lumped[0]

    def _build_blocks(self, tables: bool) -> None:
        groups: dict[assembly.BlockKey, list[assembly.HostBlock]] = {}
        rows: list[np.ndarray] = []
        self.materials = [(body, group, material) for body in self.bodies for group, material in body.materials]
        for body in self.bodies:
            for host in assembly.host_blocks(body, tables=tables):
                groups.setdefault(host.key, []).append(host)
                host.coefficient_row = len(rows)
                rows.append(assembly.coefficient_rows(host.coefficients, body.materials[host.material][1]))
        self.coefficient_table = np.array(rows).reshape(1, -1, NCOEF)
        self.coefficients = self.array("materials", self.coefficient_table, self.types.T)
        self._initial_coefficients = self.coefficients.numpy().tobytes()
        self.blocks: list[Block] = []
        contribution, element, history = 0, 0, 0
        for key, parts in groups.items():
            block = build_block(self, key, parts, contribution, element, history)
            self.blocks.append(block)
            contribution += block.count * block.slots
            element += block.count
            if key.damping == "incremental":
                history += block.count * block.points
        self.contributions, self.element_count, self.history_count = contribution, element, history

    @property
    def constraints(self) -> Any:
        """Tables of the constraints (see terms.constraint_tables), or None."""
        term = self.terms.constraints
        return term and term.tables

    def _upload_components(self) -> None:
        """Upload the groups of slots whose residuals are measured together: of one connected component and similar
        stiffness for the solver, of one mesh component and similar stiffness for the error estimate."""
        self.residual_groups = slot_groups(self, self.component)
        self.error_estimate_groups = slot_groups(self, self.mesh_component)
        if self.component_count > 1:
            self.component_of_slot = self.array("components", self.component, wp.int32)

    def graph(self) -> sp.csr_matrix:
        """Pairs of slots that share an element."""
        return assembly.slot_graph([b.connectivity for b in self.blocks], self.slots)

    # public methods

    @property
    def free_slots(self) -> np.ndarray:
        """(slots, 3) mask of the components that are unknowns."""
        return self.free_host.astype(bool)

    @property
    def needs_positive_J(self) -> bool:
        """True if a law of the model requires J > 0."""
        return any(b.key.law not in DEFINED_FOR_ANY_J for b in self.blocks)

    @property
    def features(self) -> dict[str, bool]:
        """Optional features used by the scene."""
        return self.terms.features | {
            "driven nodes": any(s.law or s.node_laws for s in self.description.supports),
            "free groups": self.free_group_count > 0,
            "separate components": self.component_count > 1,
            "probes": bool(self.probes),
        }

    @property
    def bytes(self) -> dict[str, int]:
        """Bytes of the constant arrays by purpose."""
        return dict(self._memory)

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
            "contacts": [fact for term in (self.terms.contact, self.terms.pairs) if term for fact in term.info()],
            "features": [k for k, on in features.items() if on],
            "left_out": [k for k, on in features.items() if not on],
            "blocks": [
                {
                    "element": b.key.family,
                    "law": b.key.law,
                    "elements": b.count,
                    "points": b.points,
                    "affine": b.key.affine,
                }
                for b in self.blocks
            ],
            "bytes": self.bytes | {"total": sum(self._memory.values())},
            "kernels": sorted({b.kernels.module.name.removeprefix("warpfea.kernels.") for b in self.blocks}),
        }

    def state(self) -> State:
        """A new State with the initial displacements and velocities of the bodies, and values of controls."""
        out = State(self.worlds, self.device)
        vec3 = self.types.vec3
        u = np.zeros((self.slots, 3))
        v = np.zeros((self.slots, 3))
        for body in self.bodies:
            rows = body.slots
            if body.initial_displacement is not None:
                u[rows] = body.initial_displacement
            if body.velocity is not None:
                v[rows] = body.velocity
        v[self.clamped_host] = 0.0  # driven components keep the user's initial velocities
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

    def dissipation_rate(self, state: State) -> np.ndarray:
        """Viscous dissipation, the integral of S_vis : Edot, [world], W."""
        return self.evaluation.viscous_force(state)[1]

    def strain_energy(self, state: State) -> np.ndarray:
        """[world], J."""
        return self.evaluation.internal_force(state)[1]

    def minimum_jacobian(self, state: State) -> np.ndarray:
        """Smallest det F at the points (and vertices, for laws that need J > 0), [world]."""
        return self.evaluation.internal_force(state)[2]

    def tangent_matrix(self, state: State, world: int = 0) -> sp.csr_matrix:
        """Elastic tangent df_int/dq of one world, (3 slots, 3 slots) CSR, N/m; clamped rows included."""
        return self.evaluation.tangent_matrix(state, world)

    def constraint_values(self, state: State) -> np.ndarray:
        """Values c of all rows of the constraints, [world, row], m; those of joint k: model.constraints.rows_of[k]."""
        return self.evaluation.constraints(state)[0]

    def constraint_jacobian(self, state: State, world: int = 0) -> sp.csr_matrix:
        """dc/dq of one world, (rows, 3 slots) CSR, evaluated on the device."""
        return self.evaluation.constraint_jacobian(state, world)

    def constraint_curvature(self, state: State, multipliers: Any, direction: Any) -> np.ndarray:
        """sum multipliers_i d2c_i/dq2 times a direction (slots, 3), [world, slot, 3]; multipliers (rows,), N."""
        return self.evaluation.constraint_curvature(state, np.asarray(multipliers), np.asarray(direction))

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
        for term in (self.terms.contact, self.terms.pairs):
            if term is not None:
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
                surface, m. A surface moved into a body pushes it out. "gravity", as set_gravity.
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
        h.update(self.reference.tobytes())
        h.update(self.free_host.tobytes())
        h.update(self.mass_host.data.tobytes())
        h.update(self._initial_coefficients)
        self.terms.hash(h)
        return h.hexdigest()
