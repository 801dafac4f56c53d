"""Coarse space of rigid body modes of bodies coupled by terms, see kernels/solvers/rigid_body_modes.py."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.common.rigid import RIGID_MODES, bodies_struct
from ..kernels.solvers.rigid_body_modes import rigid_mode_kernels
from ..terms.protocols import Coupled
from .dense import DenseInverse
from .levels import MAX_BOTTOM_SLOTS
from .matrix_assembly import couples_slots

if TYPE_CHECKING:
    from ..base.launch import Launcher
    from ..model.model import Model
    from ..terms.workspace import Workspace
    from .matrix_assembly import Pattern
    from .residual import Residual

__all__ = ["RigidBodyModes", "lanes_for", "mode_bodies"]

CENTRE_SAMPLES = 16
"""Slots averaged for the centre of a body."""
MAX_LANES, MIN_PER_LANE = 256, 4
"""Maximum number of partial sums, and the minimum count per partial sum."""


def lanes_for(count: int) -> int:
    """Number of partial sums for `count` values: a power of two, independent of the number of worlds."""
    return int(min(MAX_LANES, 1 << max(0, (max(count, 1) - 1) // MIN_PER_LANE).bit_length()))


def mode_bodies(model: Model) -> dict[int, int]:
    """Mode index of each body that a term couples to another body with free rigid body modes.

    Bodies without free modes are omitted; the map is empty if the matrix would be too large to invert, or if the
    model is factored with the couplings.
    """
    if couples_slots(model):
        return {}
    free = [bool(allowed.any()) for allowed in map(_free_modes, [model] * len(model.bodies), range(len(model.bodies)))]
    terms = model.terms.having(Coupled)
    pairs = [(a, b) for term in terms for a, b in term.coupled_bodies() if a != b and free[a] and free[b]]
    chosen = sorted({body for pair in pairs for body in pair})
    most = MAX_BOTTOM_SLOTS["cuda" if model.device.is_cuda else "cpu"]
    return {body: k for k, body in enumerate(chosen)} if 2 * len(chosen) <= most else {}


def _free_modes(model: Model, body: int) -> np.ndarray:
    """Free modes (6,): unprescribed translations, and rotations of a body without prescribed components."""
    b = model.bodies[body]
    free = model.slot_table.free[b.slot_offset : b.slot_offset + b.slot_count]
    return np.concatenate([free.min(axis=0), np.full(3, free.min())])


class RigidBodyModes:
    """Rigid body modes R of `mode_bodies`, the matrix R^T H R and its inverse.

    Attributes:
        bodies: device struct of the bodies. mode_index: {index of a body in the model: its index here}.
        dense_inverse: inverse of R^T H R; a term's `add_mode_coupling` adds to its `matrix`.
    """

    def __init__(self, model: Model, work: Workspace, launch: Launcher, residual: Residual, pattern: Pattern) -> None:
        self.model, self.launch, self.residual, self.pattern = model, launch, residual, pattern
        self.kernels = rigid_mode_kernels(model.dtype)
        self.mode_index = mode_bodies(model)
        n, B, T = len(self.mode_index), model.worlds, model.types.T
        self.bodies = self._make_bodies_struct()
        self.bodies.lever_arm = work.array("motions arm", (B, model.slots), wp.vec3d)
        most = max(model.bodies[k].slot_count for k in self.mode_index)
        self.partial_sums = work.array("motions parts", (B, n, lanes_for(most), 3), wp.mat33d)
        self.dense_inverse = DenseInverse(model, work, launch, "motions", RIGID_MODES * n)
        self.r, self.x = (work.array(f"motions {name}", (B, RIGID_MODES * n), T) for name in "rx")

    def _make_bodies_struct(self) -> Any:
        m, chosen = self.model, [self.model.bodies[k] for k in self.mode_index]
        of_slot = np.full(m.slots, -1)
        place = m.slot_table.kind == 0
        X = np.array(m.slot_table.reference, dtype=float)
        sample, size = [], []
        for k, body in enumerate(chosen):
            own = slice(body.slot_offset, body.slot_offset + body.slot_count)
            of_slot[own] = k
            X[own] += np.asarray(body.origin) * place[own, None]
            at = body.slot_offset + np.flatnonzero(place[own])
            sample.append(at[np.linspace(0, len(at) - 1, CENTRE_SAMPLES).round().astype(int)])
            size.append(float(np.ptp(X[at], axis=0).max()))
        allowed = np.array([_free_modes(m, k) for k in self.mode_index])
        out = bodies_struct(m.dtype)()
        tables: dict[str, tuple[Any, Any]] = {
            "first_slot": ([body.slot_offset for body in chosen], wp.int32),
            "end_slot": ([body.slot_offset + body.slot_count for body in chosen], wp.int32),
            "body_size": (size, wp.float64),
            "free_translations": (allowed[:, :3], wp.vec3d),
            "free_rotations": (allowed[:, 3:], wp.vec3d),
            "centre_slots": (np.array(sample).T, wp.int32),
            "body_of_slot": (of_slot, wp.int32),
            "is_position": (place, m.types.T),
            "slot_reference": (X, wp.vec3d),
        }
        for name, (values, dtype) in tables.items():
            setattr(out, name, m.array("motions", np.ascontiguousarray(values), dtype))
        return out

    def lanes(self, count: int) -> int:
        """Number of partial sums for `count` values."""
        return lanes_for(count)

    def modules(self) -> set[wp.Module]:
        """Modules launched."""
        return {self.kernels.module} | self.dense_inverse.modules()

    def assemble(self, u: wp.array, value: wp.array, flags: wp.array) -> None:
        """Assemble the uncoupled matrix R^T H R at displacements u; `value`: H without the coupling terms."""
        m, k, dense = self.model, self.kernels, self.dense_inverse
        self.launch(k.update_arms, (m.worlds, m.slots), [self.bodies, u, flags])
        lanes = self.partial_sums.shape[2]
        args = [self.bodies, self.pattern.data, m.topology.free, value, flags, lanes, self.partial_sums]
        self.launch(k.body_matrix_partials, self.partial_sums.shape[:3], args)
        args = [flags, self.partial_sums, dense.matrix_diagonal, dense.matrix]
        self.launch(k.fill_matrix, (m.worlds, dense.padded_size), args)

    def invert(self, flags: wp.array) -> None:
        """Invert the matrix after terms have added to it."""
        self.dense_inverse.invert(flags, keep=False, reduce=self.residual.reduce)

    def apply(self, r: wp.array, z: wp.array, active: wp.array) -> None:
        """z += R (R^T H R)^-1 R^T r."""
        m, k, launch = self.model, self.kernels, self.launch
        args = [self.bodies, r, active, self.r]
        launch.tiled(k.restrict, (m.worlds, len(self.mode_index)), args)
        self.dense_inverse.apply(self.r, self.x, active)
        launch(k.prolong, (m.worlds, m.slots), [self.bodies, self.x, m.topology.free, active, z])
