"""Model: the constant side of a scene on one device, and functions that evaluate it at a state."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import scipy.sparse as sp
import warp as wp

from .. import elements
from ..base.errors import ModelError
from ..kernels.common.structs import topology_struct
from ..kernels.common.types import precision
from ..kernels.elements.cluster import cluster_size
from ..kernels.elements.element import element_kernels
from ..kernels.elements.materials import ANY_J, NCOEF
from ..kernels.elements.points import block_struct
from ..kernels.elements.tied import tied_kernels, tied_struct
from ..kernels.elements.with_mass import with_mass_kernel
from ..kernels.solvers.pcg import groups_struct
from . import assembly
from .bodies import Body
from .description import Description
from .state import State

__all__ = ["Block", "Model", "find_device"]


class Source(Protocol):
    """What a Model is made from: a ModelBuilder."""

    bodies: list[Body]
    description: Description
    gravity: np.ndarray
    up_axis: str

    def assemble(self, model: Model) -> tuple[Any, Any]:
        """The TermSet of a model, and what evaluates it at a state."""


@dataclass(eq=False)
class Block:
    """Elements that one kernel does: their kind, device data, and where they came from."""

    key: assembly.BlockKey
    data: Any
    kernels: Any
    parts: list[assembly.HostBlock]
    count: int
    points: int
    slots: int
    contribution_offset: int
    element_offset: int
    cluster: int
    field_rule: Any = None
    shear: Any = None

    @property
    def connectivity(self) -> np.ndarray:
        """(elements, slots per element) slots of the model, on the host."""
        return np.concatenate([p.conn + p.body.slot_offset for p in self.parts])

    @property
    def with_mass(self) -> bool:
        """Whether the mass of an element is one table times a number."""
        return self.key.affine and not any(callable(p.body.materials[p.material][1].density) for p in self.parts)

    def kernels_for(self, dtype: str, damping: str | None) -> Any:
        """The kernels of this kind of element with another form of damping."""
        k = self.key
        if k.tying:
            return self.kernels
        return element_kernels(dtype, k.law, self.slots, self.points, k.affine, damping, k.framed)

    def with_mass_product(self, dtype: str, damping: str | None) -> wp.Kernel:
        """The kernel of the product of a with_mass block, with a form of damping."""
        k = self.key
        return with_mass_kernel(dtype, k.law, self.slots, self.points, damping, k.vertex, self.cluster)


class Model:
    """Made by ModelBuilder.finalize; constant but for `set_gravity`.

    Attributes:
        bodies: the bodies, in the order they were added.
        worlds, dtype, device, up_axis: as given.
        slots: number of slots of all bodies.
        size: diagonal of the box of all nodes, m; tolerances of constraints are measured with it.
        blocks: element blocks.
        cache: tables that solvers made of the model and share.
        mass_host: scalar mass matrix (slots, slots), CSR on the host, kg.
    """

    def __init__(
        self,
        builder: Source,
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
        self._number()
        self._assemble_mass()
        self._build_blocks(tables)
        self.gravity = np.asarray(builder.gravity, dtype=float)
        self.probes = list(builder.description.probes)
        self.terms, self.evaluation = builder.assemble(self)
        self._label_components()
        self.terms.build()
        self._build_topology()
        self._build_groups()

    # construction

    def array(self, name: str, values: Any, dtype: Any) -> wp.array:
        """Upload a constant; its bytes are counted under `name`."""
        out: Any = wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device)
        self.count(name, out)
        return out

    def count(self, name: str, *arrays: wp.array) -> None:
        """Count the bytes of arrays made on the device under `name`."""
        for array in arrays:
            self._memory[name] = self._memory.get(name, 0) + array.size * wp.types.type_size_in_bytes(array.dtype)

    def element_array(self, values: np.ndarray, dtype: Any) -> wp.array:
        """Upload a constant of elements, [..., element]: neighbours stand side by side on a GPU, where threads do
        elements together, and what belongs to an element on a CPU, which does one after the other."""
        if self.device.is_cuda:
            return self.array("elements", values, dtype)
        last = np.ndim(values) - (2 if dtype is self.types.mat33 else 1 if dtype is self.types.vec3 else 0) - 1
        out = self.array("elements", np.moveaxis(values, last, 0), dtype)
        return out.transpose((*range(1, out.ndim), 0))

    def _number(self) -> None:
        offset, elements_before = 0, 0
        for body in self.bodies:
            body.element_offset = elements_before
            elements_before += len(body.mesh.cells)
            for rule in {body.rule, body.curved_rule}:
                for part in body.family.scheme(rule):
                    assembly.check_orientation(body, part.rule)
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
        if not self.free_host.any():
            raise ModelError("every component of every node is prescribed: nothing is left to solve for")

    def _assemble_mass(self) -> None:
        self.mass_host = sp.block_diag([assembly.body_mass(b) for b in self.bodies], format="csr")
        self.mass_host.sum_duplicates()
        self.lumped_host = self.mass_host @ self.is_position_host
        self.lumped = self.array("slots", self.lumped_host, self.types.T)

    def _build_blocks(self, tables: bool) -> None:
        groups: dict[assembly.BlockKey, list[assembly.HostBlock]] = {}
        rows: list[np.ndarray] = []
        self.materials = [(body, group, material) for body in self.bodies for group, material in body.materials]
        for body in self.bodies:
            for host in assembly.host_blocks(body, tables=tables):
                groups.setdefault(host.key, []).append(host)
                row = np.zeros(NCOEF)
                row[: len(host.coefficients)] = host.coefficients
                damping = body.materials[host.material][1].damping
                if damping:
                    row[-2:] = damping.eta, damping.lambda_v
                host.row = len(rows)
                rows.append(row)
        self.coefficients = self.array("materials", np.array(rows)[None], self.types.T)
        self.blocks: list[Block] = []
        contribution, element, history = 0, 0, 0
        for key, parts in groups.items():
            block = self._build_block(key, parts, contribution, element, history)
            self.blocks.append(block)
            contribution += block.count * block.slots
            element += block.count
            if key.damping == "incremental":
                history += block.count * block.points
        self.contributions, self.element_count, self.history_count = contribution, element, history

    def _build_block(
        self, key: assembly.BlockKey, parts: list[assembly.HostBlock], contribution: int, element: int, history: int
    ) -> Block:
        family = elements.get(key.family)
        conn = np.concatenate([p.conn + p.body.slot_offset for p in parts])
        data = (tied_struct if key.tying else block_struct)(self.dtype)()
        data.conn = self.array("elements", conn.T, wp.int32)
        data.is_position = self.array("elements", (family.slot_kind == 0).astype(float), self.types.T)
        rows = [np.full(len(p.elements), p.row) for p in parts]
        data.material = self.array("elements", np.concatenate(rows), wp.int32)
        data.coefficients = self.coefficients
        data.contribution_offset, data.element_offset, data.history_offset = contribution, element, history
        data.count = len(conn)
        if key.tying:
            self._tied_tables(data, key, parts)
            points = len(key.tying.points)
            kernels = tied_kernels(self.dtype, family.slots, points, key.tying.width)
        else:
            self._point_tables(data, key, parts)
            points = len(key.rule.weights)
            kind = (key.law, family.slots, points, key.affine, key.damping, key.framed)
            kernels = element_kernels(self.dtype, *kind)
        cluster = cluster_size(self.dtype, len(conn), fit=self.device.is_cuda)
        return Block(key, data, kernels, parts, len(conn), points, family.slots, contribution, element, cluster)

    def shear_block(self, block: Block) -> Block:
        """Elements of a tied block with their shears at points, for output."""
        name = "shear stress"
        key = replace(block.key, scheme=name, part=0, law="orthotropic", framed=True)
        (part,) = key.output_scheme(name) or ()
        assert part.law is not None
        parts, rows = [], []
        for host in block.parts:
            _, values = part.law(host.body.materials[host.material][1])
            parts.append(assembly.HostBlock(key, host.body, host.elements, host.material, values))
            rows.append(np.pad(values, (0, NCOEF - len(values))))
        data = block_struct(self.dtype)()
        data.conn, data.is_position, data.count = block.data.conn, block.data.is_position, block.count
        data.coefficients = self.array("output", np.array(rows)[None], self.types.T)
        index = np.concatenate([np.full(len(p.elements), k) for k, p in enumerate(parts)])
        data.material = self.array("output", index, wp.int32)
        self._point_tables(data, key, parts)
        points = len(key.rule.weights)
        kernels = element_kernels(self.dtype, key.law, block.slots, points, False, None, True)
        return Block(key, data, kernels, parts, block.count, points, block.slots, 0, 0, block.cluster)

    def _tied_tables(self, data: Any, key: assembly.BlockKey, parts: list[assembly.HostBlock]) -> None:
        T, vec3 = self.types.T, self.types.vec3
        tables = [
            assembly.tied_tables(part, members)
            for part in parts
            for members in assembly.chunks(part.body, part.elements, len(key.rule.weights))
        ]
        for name, dtype in (("first", T), ("second", T), ("X_first", vec3), ("X_second", vec3), ("coupling", T)):
            table = np.concatenate([getattr(t, name) for t in tables])
            axis = 1 if dtype is vec3 else 2
            setattr(data, name, self.element_array(np.moveaxis(table, 0, axis), dtype))

    def _point_tables(self, data: Any, key: assembly.BlockKey, parts: list[assembly.HostBlock]) -> None:
        T, vec3, mat33 = self.types.T, self.types.vec3, self.types.mat33
        family, rule = elements.get(key.family), key.rule
        Q = len(rule.weights)
        points = np.vstack([rule.points, family.vertices])
        h, w, J0, axes = [], [], [], []
        for part in parts:
            for members in assembly.chunks(part.body, part.elements, len(points)):
                if key.affine:
                    _, _, J, det = assembly.geometry(part.body, members, family.vertices[:1])
                    J0.append(np.linalg.inv(J[:, 0]))
                    w.append(det[:, 0])
                else:
                    _, ds, J, det = assembly.geometry(part.body, members, points)
                    h.append(assembly.gradients(ds, J))
                    w.append(det[:, :Q] * rule.weights)
                    if key.framed:
                        axes.append(assembly.orthonormal(J[:, :Q]))
        if key.affine:
            _, ds = family.shape(points, np.zeros((1, len(family.node_slots), 3)))
            table = ds[0][:, :, None, :]
            data.J0_inv = self.element_array(np.concatenate(J0).reshape(-1, 9).T, T)
            data.det_J0 = self.array("elements", np.concatenate(w), T)
            if not any(callable(p.body.materials[p.material][1].density) for p in parts):
                data.mass = self.array("elements", assembly.parent_mass(family), T)
                density = [assembly.element_density(p) for p in parts]
                data.density = self.array("elements", np.concatenate(density) * np.concatenate(w), T)
            data.weight = self.array("elements", rule.weights[:, None], T)
        else:
            table = np.moveaxis(np.concatenate(h), 0, 2)
            data.weight = self.element_array(np.concatenate(w).T, T)
        data.gradient = self.element_array(table[:Q], vec3)
        if key.law not in ANY_J:
            data.vertex_gradient = self.element_array(table[Q:], vec3)
        if key.framed:
            data.frame = self.element_array(np.moveaxis(np.concatenate(axes), 0, 1), mat33)

    @property
    def constraints(self) -> Any:
        """Tables of the constraints (see terms.constraint_tables), or None."""
        term = self.terms.constraints
        return term and term.tables

    def _build_topology(self) -> None:
        T, vec3 = self.types.T, self.types.vec3
        topo = topology_struct(self.dtype)()
        start, entry = assembly.gather_table([b.connectivity for b in self.blocks], self.slots)
        topo.start = self.array("topology", start, wp.int32)
        topo.entry = self.array("topology", entry, wp.int32)
        topo.mass_start = self.array("mass", self.mass_host.indptr, wp.int32)
        topo.mass_column = self.array("mass", self.mass_host.indices, wp.int32)
        topo.mass_value = self.array("mass", self.mass_host.data, T)
        topo.free = self.array("slots", self.free_host, vec3)
        topo.held = self.array("slots", (self.free_host == 0.0) @ [1, 2, 4], wp.uint8)
        self.terms.join(topo)
        self.topology = topo

    def graph(self) -> sp.csr_matrix:
        """Which slots share an element."""
        return assembly.slot_graph([b.connectivity for b in self.blocks], self.slots)

    def _label_components(self) -> None:
        """Connected component of each slot: by elements alone (`part`), and with what joints tie (`component`)."""
        self.part = assembly.components_of(self.graph())
        self.component = self.part
        groups = self.terms.ties()
        if groups:
            ties = sp.lil_matrix((self.part.max() + 1, self.part.max() + 1))
            for slots in groups:
                parts = np.unique(self.part[slots])
                ties[parts[0], parts] = 1.0
            self.component = assembly.components_of(ties.tocsr())[self.part]
        self.component_count = int(self.component.max()) + 1

    def _build_groups(self) -> None:
        """Bodies, or separate parts of one, that no support holds in some direction (DESIGN 5)."""
        T, vec3 = self.types.T, self.types.vec3
        label, count = self.component, self.component_count
        free = np.ones((count, 3))
        for c in range(3):
            held = np.unique(label[self.free_host[:, c] == 0.0])
            free[held, c] = 0.0
        self.terms.hold(free)
        if count > 1:
            order = np.argsort(label, kind="stable")
            edges = np.concatenate([[0], np.cumsum(np.bincount(label, minlength=count))])
            self.component_start = self.array("components", edges, wp.int32)
            self.component_slot = self.array("components", order, wp.int32)
            self.component_of_slot = self.array("components", label, wp.int32)
        keep = np.flatnonzero(free.any(axis=1))
        self.group_count = len(keep)
        self.groups = groups_struct(self.dtype)()
        if not self.group_count:
            return
        number = np.full(count, -1)
        number[keep] = np.arange(len(keep))
        of_slot = number[label]
        slots = np.flatnonzero((of_slot >= 0) & (self.slot_kind == 0))
        slots = slots[np.argsort(of_slot[slots], kind="stable")]
        mass = np.bincount(of_slot[slots], weights=self.lumped_host[slots], minlength=len(keep))
        start = np.concatenate([[0], np.cumsum(np.bincount(of_slot[slots], minlength=len(keep)))])
        self.groups.start = self.array("groups", start, wp.int32)
        self.groups.slot = self.array("groups", slots, wp.int32)
        self.groups.of_slot = self.array("groups", of_slot, wp.int32)
        self.groups.is_position = self.is_position
        self.groups.lumped = self.lumped
        self.groups.mass = self.array("groups", mass, T)
        self.groups.free = self.array("groups", free[keep], vec3)

    def check_static_supports(self) -> None:
        """Raise ModelError for a part that can move as a rigid body: statics has no answer for it."""
        ties = None
        if self.constraints:
            ties = self.constraint_jacobian(self.state())
        for label in range(self.component_count):
            slots = np.flatnonzero(self.component == label)
            parts, part = np.unique(self.part[slots], return_inverse=True)
            motions = np.zeros((len(parts), 6, len(slots), 3))
            for k in range(len(parts)):
                own = np.flatnonzero(part == k)
                motions[k][:, own] = assembly.rigid_modes(self.reference[slots[own]], self.slot_kind[slots[own]])
            modes = motions.reshape(6 * len(parts), -1)
            modes /= np.linalg.norm(modes, axis=1)[:, None]
            held = modes[:, (self.free_host[slots] == 0.0).ravel()]
            if ties is not None:
                columns = (3 * slots[:, None] + np.arange(3)).ravel()
                assert self.constraints is not None
                rows = np.flatnonzero(self.constraints.component_host == label)
                held = np.hstack([held, (ties[rows][:, columns] @ modes.T).T / self.size])
            values = np.linalg.svd(held, compute_uv=False) if held.size else np.zeros(0)
            free = len(modes) - int(np.sum(values > 1e-9))
            if free:
                body = next(b for b in self.bodies if b.slot_offset <= slots[0] < b.slot_offset + b.slot_count)
                raise ModelError(
                    f"body {body.name!r} is not supported: supports and joints leave {free} rigid "
                    f"motion{'s' * (free > 1)} free, and statics has no unique answer (that gravity would hold it is "
                    "not counted): clamp or drive more nodes, or let a damped dynamic run come to rest"
                )

    # what users call

    @property
    def free_slots(self) -> np.ndarray:
        """(slots, 3) mask of the components that are unknowns."""
        return self.free_host.astype(bool)

    @property
    def needs_positive_J(self) -> bool:
        """Whether a law of the model is defined for J > 0 only."""
        return any(b.key.law not in ANY_J for b in self.blocks)

    @property
    def features(self) -> dict[str, bool]:
        """Which optional features the scene uses."""
        return self.terms.features | {
            "driven nodes": any(s.law or s.node_laws for s in self.description.supports),
            "free groups": self.group_count > 0,
            "separate components": self.component_count > 1,
            "probes": bool(self.probes),
        }

    @property
    def bytes(self) -> dict[str, int]:
        """Bytes of the constant arrays by purpose."""
        return dict(self._memory)

    def info(self) -> dict[str, Any]:
        """Features in and left out, counts, bytes of the constants, kernels' modules of the elements."""
        features = self.features
        return {
            "bodies": [
                {
                    "name": b.name,
                    "element": b.family.name,
                    "quadrature": sorted({k.key.scheme for k in self.blocks if any(p.body is b for p in k.parts)}),
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
            "mass": float(self.lumped_host[self.slot_kind == 0].sum()),
            "joints": [
                {"name": j.name, "kind": j.kind, "rows": len(j.rows), "between": j.between}
                for j in (self.constraints.joints if self.constraints else ())
            ],
            "features": [k for k, on in features.items() if on],
            "left_out": [k for k, on in features.items() if not on] + list(self.terms.later),
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
        """A new State with the initial displacements and velocities of the bodies."""
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
        v[self.clamped_host] = 0.0  # driven components keep what the user says
        out.register("displacement", vec3, (self.slots,), u)
        out.register("velocity", vec3, (self.slots,), v)
        out.register("time", wp.float64)
        return out

    def mass_matrix(self) -> sp.csr_matrix:
        """Consistent mass, (3 slots, 3 slots) CSR, kg; unknown 3 slot + component."""
        return sp.kron(self.mass_host, sp.identity(3), format="csr")

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
        """Values c of all rows of the constraints, [world, row], m; rows of a joint: constraints.rows_of."""
        return self.evaluation.constraints(state)[0]

    def constraint_jacobian(self, state: State, world: int = 0) -> sp.csr_matrix:
        """dc/dq of one world, (rows, 3 slots) CSR, with the gradients that the device computes."""
        return self.evaluation.constraint_jacobian(state, world)

    def constraint_curvature(self, state: State, multipliers: Any, direction: Any) -> np.ndarray:
        """sum multipliers_i d2c_i/dq2 times a direction (slots, 3), [world, slot, 3]; multipliers (rows,), N."""
        return self.evaluation.constraint_curvature(state, np.asarray(multipliers), np.asarray(direction))

    def set_gravity(self, gravity: Any) -> None:
        """Gravity of all worlds (3,) or per world (worlds, 3), m/s^2."""
        self.terms.dead.set_gravity(gravity)

    def set_parameter(self, name: str, values: Any) -> None:
        """Per-world material parameters are not part of this version."""
        raise NotImplementedError("set_parameter: per-world material parameters are not part of this version")

    def fingerprint(self) -> str:
        """Hash of all that a checkpoint must agree with: topology, geometry, laws, precision, supports, worlds."""
        h = hashlib.sha256(f"{self.dtype} {self.worlds} {self.slots}".encode())
        for block in self.blocks:
            h.update(repr(block.key).encode())
            for part in block.parts:
                h.update(np.ascontiguousarray(part.conn).tobytes())
        for body in self.bodies:
            h.update(repr(body.section).encode())
            if body.frames is not None:
                h.update(np.ascontiguousarray(body.frames).tobytes())
        h.update(self.reference.tobytes())
        h.update(self.free_host.tobytes())
        h.update(self.mass_host.data.tobytes())
        h.update(self.coefficients.numpy().tobytes())
        self.terms.hash(h)
        return h.hexdigest()


def find_device(device: Any) -> Any:
    """A Warp device by name, None for the preferred one. ModelError lists those there are."""
    try:
        return wp.get_device(device) if device is not None else wp.get_preferred_device()
    except Exception as error:
        names = ", ".join(str(d) for d in wp.get_devices())
        raise ModelError(f"device {device!r} is not there; Warp finds {names}") from error
