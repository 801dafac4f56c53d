"""Modes of vibration and of buckling: small motions about a state at rest, joints included.

K phi = omega^2 M phi on the free components with J phi = 0. K is the tangent of the elements at the state (with its
prestress) plus those of springs and of joint forces, sum lambda d2c/dq2. Large models: Lanczos' method on the inverse
of K - sigma M bordered by J; small ones: a basis of J's null space. Multipliers of redundant rows stay bounded by
COMPLIANCE of linear_system.py on the diagonal.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import scipy.linalg
import scipy.sparse as sp
from scipy.sparse.linalg import ArpackNoConvergence, eigsh

from ..base.checks import check_positive, is_number
from ..base.errors import ModelError
from ..base.lazy import require_matplotlib
from ..base.writer import aborted_on_error, writer_for
from ..model.assembly import require_density
from ..model.state import State
from .checks import check_model
from .linear_system import LinearSystem, linearise
from .results import Results

if TYPE_CHECKING:
    from ..model.bodies import Body
    from ..model.model import Model

__all__ = ["Buckling", "Modes", "buckling", "modes"]

MAX_DENSE = 400
"""Number of unknowns up to which all eigenvalues are computed."""
RELATIVE_SHIFT = 1e-8
"""Default shift below zero, over the median of K_ii / M_ii. A bound: far above round-off, so that the matrix to
solve is not singular, and small, as a large one brings the lowest modes together."""
MAX_RESTARTS = 300
"""Restarts of Lanczos' method for buckling."""
MIN_LOAD_RATIO = 1e-4
"""Critical load of the reversed load over the smallest that counts: beyond, the material is far from linear. A
bound between the round-off of a load that has none and ratios for which linear stresses stand."""
HIDDEN = 1e-11
"""Round-off of the largest eigenvalue over those wanted, beyond which these are sought by themselves: a bound."""
ZERO = 1e-12
"""phi.K phi over phi.diag(K) phi below which it is round-off: a rigid-body mode. A bound: sums in float64
leave 1e-15, the softest bending mode of a beam of n elements is about 1 / n^4."""
AT_REST = 1e-9
"""Largest displacement of nodes at rest, over gradients times the model's size: bound of round-off."""
CYCLE_S, CYCLE_FRAMES = 2.0, 60
"""Duration and frames of a cycle drawn."""
DRAWN_SIZE = 0.1
"""Largest displacement drawn by default, over the size of the model."""


@dataclass(frozen=True, eq=False, repr=False)
class Shapes:
    """Vectors of an eigenproblem.

    Attributes:
        model: the model. state: about which it moves.
        vectors: (count, slots, 3) displacements of all slots.
    """

    model: Model
    state: State
    vectors: np.ndarray

    def shape(self, body: Body) -> np.ndarray:
        """Displacements (count, nodes, 3) of a body; the largest of the model in each mode is 1 m, or all are 0 in
        one that deforms sections alone."""
        results = Results(self.model, self.state)
        results.check_body(body, "shape")
        return results.at_mesh_nodes(body, self.vectors / self._largest()[:, None, None])

    def _largest(self) -> np.ndarray:
        """Largest displacement of each mode, m; infinite where it is round-off beside the gradients times the size."""
        size, is_position = np.linalg.norm(self.vectors, axis=2), self.model.slot_table.is_position
        moved, gradients = (size * is_position).max(axis=1), (size * (1.0 - is_position)).max(axis=1)
        return np.where(moved > AT_REST * self.model.size * gradients, moved, np.inf)

    def write(self, path: str | os.PathLike[str], mode: int = 1, *, size: float | None = None, **options: Any) -> None:
        """Write one mode, counted from 1: an animation of a cycle, or a picture of its largest displacement.

        Args:
            path: its suffix chooses the writer, such as .usdc, .gif or .png.
            size: largest displacement, m; by default a tenth of the model's size.
            options: of the writer.

        Raises:
            ModelError: no such mode. OutputError: see the writer.
        """
        if isinstance(mode, bool) or not isinstance(mode, (int, np.integer)) or not 1 <= mode <= len(self.vectors):
            raise ModelError(f"mode = {mode!r} must be a number from 1 to {len(self.vectors)}")
        if size is not None:
            check_positive("modes", size=size)
        if np.isinf(self._largest()[mode - 1]):
            raise ModelError(f"{self.label(mode)} moves no node: it deforms sections of beams or shells alone")
        writer = writer_for(path, ["displacement"], **options)
        motion = ModeMotion(self.model, self.state.copy())
        motion.label = self.label(mode)
        start = self.state.displacement.numpy()
        amplitude = DRAWN_SIZE * self.model.size if size is None else size
        step = amplitude * self.vectors[mode - 1] / self._largest()[mode - 1]
        frames = range(CYCLE_FRAMES + 1) if writer.animates else [CYCLE_FRAMES // 4]
        with aborted_on_error(writer):
            for k in frames:
                motion.time[:] = k * CYCLE_S / CYCLE_FRAMES
                moved = start + np.sin(2.0 * np.pi * k / CYCLE_FRAMES) * step
                motion.state.displacement.assign(moved.astype(start.dtype))
                if k == frames[0]:
                    writer.open(motion)
                writer.write(motion)
            writer.close(motion)

    def label(self, mode: int) -> str:
        """Title of a mode."""
        return f"mode {mode}"


class ModeMotion(Results):
    """Results of a mode that moves, for writers."""

    label = ""

    def __init__(self, model: Model, state: State) -> None:
        super().__init__(model, state)
        self.time, self.dt = np.zeros(model.worlds), CYCLE_S / CYCLE_FRAMES


@dataclass(frozen=True, eq=False, repr=False)
class Modes(Shapes):
    """Modes of vibration, by rising frequency.

    Attributes:
        vectors: with phi.M phi = 1.
        eigenvalues: (count,) omega^2, 1/s^2.
        rigid_body_modes: number of those without stiffness.
        damping_ratios: (count,) phi.C phi / (2 omega), of material damping and dampers; NaN of rigid-body modes.
        participation: (count, 6) phi.M r of unit translations along, and rotations about, x, y and z, about the
            origin.
    """

    eigenvalues: np.ndarray
    rigid_body_modes: int
    damping_ratios: np.ndarray
    participation: np.ndarray

    @property
    def frequencies(self) -> np.ndarray:
        """(count,) Hz. Negative: the state is unstable, and the mode grows at this rate times 2 pi, 1/s."""
        return np.sign(self.eigenvalues) * np.sqrt(np.abs(self.eigenvalues)) / (2.0 * np.pi)

    @property
    def effective_mass(self) -> np.ndarray:
        """(count, 6) squares of the participation, kg and kg m^2; those of all modes add up to the mass that moves."""
        return self.participation**2

    def label(self, mode: int) -> str:
        return f"mode {mode}, {self.frequencies[mode - 1]:.3g} Hz"

    def __repr__(self) -> str:
        rigid = f", {self.rigid_body_modes} rigid" if self.rigid_body_modes else ""
        return f"Modes({len(self.vectors)}{rigid}: {', '.join(f'{f:.4g}' for f in self.frequencies)} Hz)"

    def plot(self) -> Any:
        """Matplotlib figure: frequencies, and the share of the mass that each mode moves along x, y and z.

        OutputError without matplotlib.
        """
        figure = require_matplotlib()(figsize=(6.4, 4.8), layout="constrained")
        top, bottom = figure.subplots(2, 1, sharex=True)
        number = np.arange(1, len(self.vectors) + 1)
        top.bar(number, self.frequencies, color="0.4")
        top.set_ylabel("frequency, Hz")
        share = self.effective_mass[:, :3] / (self.model.mass or 1.0)
        for axis in range(3):
            bottom.bar(number + 0.25 * (axis - 1), share[:, axis], 0.25, label="xyz"[axis])
        bottom.set_ylabel("effective mass / mass")
        bottom.set_xlabel("mode")
        bottom.xaxis.get_major_locator().set_params(integer=True)
        bottom.legend()
        return figure


@dataclass(frozen=True, eq=False, repr=False)
class Buckling(Shapes):
    """Buckling modes, by rising load.

    Attributes:
        factors: (count,) critical loads over the load of the state.
    """

    factors: np.ndarray

    def label(self, mode: int) -> str:
        return f"mode {mode}, {self.factors[mode - 1]:.4g} times the load"

    def __repr__(self) -> str:
        return f"Buckling({', '.join(f'{f:.4g}' for f in self.factors)} times the load)"


def modes(
    model: Model, state: State | None = None, *, count: int = 10, shift: float | None = None, world: int = 0
) -> Modes:
    """Modes of vibration about a state.

    Velocities of the state have no effect: no gyroscopic forces.

    Args:
        state: by default the initial state. Of a static result: its prestress and joint forces count.
        count: number of modes, the lowest ones.
        shift: Hz, the modes nearest to it instead.
        world: the world whose modes they are.

    Raises:
        ModelError: a material without density, forces whose stiffness is not known (pressure, moments, force fields,
            terms of your own), active contact, a float32 model, or an option out of range.
    """
    check_model(model)
    require_density(model.bodies, "modes")
    if shift is not None and not (is_number(shift) and shift >= 0.0):
        raise ModelError(f"modes: shift = {shift!r} must be a frequency, Hz, 0 or more")
    state = model.state() if state is None else state
    system = linearise("modes", model, state, count, world)
    M = system.restrict(model.mass_matrix(world))
    values, vectors = _vibrations(system, M, count, None if shift is None else (2.0 * np.pi * shift) ** 2)
    phi = system.expand(vectors)
    size = ZERO * np.sum([part.size() for part in system.parts], axis=0) @ vectors**2
    rigid, energy = np.abs(values) <= size, np.diag(system.project(vectors))
    if np.any(np.abs(values - energy) > 0.01 * np.abs(energy) + size):
        raise ModelError(
            "modes: a rigid part is so small beside its distance from springs that round-off hides them; give it a "
            "larger inertia (a radius of 1e-4 of the distance changes no frequency)"
        )
    values[rigid] = 0.0
    lost = _modal_damping(model, state, world, system, phi)
    omega = np.sqrt(np.abs(values))
    ratio = np.where(rigid, np.nan, lost / np.where(rigid, 1.0, 2.0 * omega))
    moving = phi.reshape(len(phi), -1) @ (model.mass_matrix(world) @ _rigid_motions(model).T)
    return Modes(model, state, phi, values, int(rigid.sum()), ratio, moving)


def buckling(model: Model, state: State, *, count: int = 1, world: int = 0) -> Buckling:
    """Linear buckling: K(0) + factor K_G is singular, K_G the geometric stiffness of the state's stress and joint
    forces at rest.

    Args:
        state: equilibrium under a part of the load, such as of `solve_static(model).state`, so small that its
            displacements are linear in the load.
        count: number of buckling modes, those of the smallest positive factors.
        world: the world.

    Raises:
        ModelError: as `modes`; a model that is not held; no buckling under this load, or fewer modes than asked.
    """
    check_model(model)
    loaded = linearise("buckling", model, state, count, world)
    start = model.state()
    start.displacement.zero_()
    system = linearise("buckling", model, start, count, world)
    G = system.K - loaded.K
    at_rest, at_load = (model.evaluation.tangent_matrix(at, world) for at in (start, state))
    # the difference has the turn of the elements to first order alone, which softens
    change = at_load - at_rest - model.evaluation.stress_stiffness(state, world)
    G = G + system.restrict(change)
    if len(system.index) <= MAX_DENSE:
        Z = system.null_space()
        try:
            mu, y = scipy.linalg.eigh(Z.T @ (G @ Z), Z.T @ (system.K @ Z))
        except np.linalg.LinAlgError as error:
            raise ModelError("buckling: the unloaded model is not held: clamp or connect it") from error
        vectors = Z @ y
    else:
        inverse = system.inverse(system.K)
        n = len(system.index)
        v0 = inverse.matvec(system.K @ np.random.default_rng(0).standard_normal(n))
        try:
            mu, vectors = eigsh(G, k=count, M=system.K, Minv=inverse, which="LA", v0=v0, maxiter=MAX_RESTARTS)
        except ArpackNoConvergence as error:  # none is above those near zero
            mu, vectors = error.eigenvalues, error.eigenvectors
    best = np.argsort(-mu)[:count]
    found = int((mu[best] > MIN_LOAD_RATIO * max(-mu.min(initial=0.0), 0.0)).sum())
    if found < count:
        raise ModelError(f"buckling: {found} modes under this load, {count} asked: does it compress anything?")
    return Buckling(model, state, system.expand(vectors[:, best]), 1.0 / mu[best])


def _vibrations(
    system: LinearSystem, M: sp.csr_matrix, count: int, shift: float | None
) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues (count,), rising, and vectors (free, count) of K phi = lambda M phi."""
    n = len(system.index)
    if n <= MAX_DENSE or 4 * count > n:
        Z = system.null_space()
        if any(abs(part.W).max() > 1.0 for part in system.parts):  # soft motions apart from stiff ones
            Z = Z @ np.linalg.eigh(system.project(Z))[1]
        values, vectors = _dense_vibrations(system.project(Z), Z.T @ (M @ Z), count)
        near = np.argsort(np.abs(values - (shift or 0.0)) if shift is not None else values)[:count]
        near = near[np.argsort(values[near])]
        return values[near], Z @ vectors[:, near]
    ratio = np.median(system.K.diagonal()[M.diagonal() > 0.0] / M.diagonal()[M.diagonal() > 0.0])
    sigma = -RELATIVE_SHIFT * float(ratio) if shift is None else shift
    inverse = system.inverse(system.K - sigma * M)
    v0 = inverse.matvec(M @ np.random.default_rng(0).standard_normal(n))
    values, vectors = eigsh(system.K, k=count, M=M, sigma=sigma, OPinv=inverse, v0=v0)
    order = np.argsort(values)
    return values[order], vectors[:, order]


def _dense_vibrations(K: np.ndarray, M: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """All eigenvalues and vectors; directions without mass follow the others at rest. The largest of light elements
    beside heavy parts hide the `count` lowest in their round-off: these are those of M phi = mu (K + shift M) phi."""
    mass, axes = np.linalg.eigh(M)
    heavy = mass > 1e-13 * mass[-1]
    T = axes[:, heavy] / np.sqrt(mass[heavy])
    if not heavy.all():
        V = axes[:, ~heavy]
        T = T - V @ np.linalg.lstsq(V.T @ K @ V, V.T @ K @ T, rcond=None)[0]
    values, y = np.linalg.eigh(T.T @ K @ T)
    vectors, count = T @ y, min(count, len(values))
    if np.finfo(float).eps * values[-1] > HIDDEN * abs(values[:count]).max():
        shift = RELATIVE_SHIFT * float(np.median(np.diag(K)[np.diag(M) > 0.0] / np.diag(M)[np.diag(M) > 0.0]))
        try:
            mu, low = scipy.linalg.eigh(M, K + shift * M, subset_by_index=[len(K) - count, len(K) - 1])
        except np.linalg.LinAlgError:  # an unstable state
            return values, vectors
        values[:count], vectors[:, :count] = 1.0 / mu[::-1] - shift, low[:, ::-1] / np.sqrt(mu[::-1])
    return values, vectors


def _modal_damping(model: Model, state: State, world: int, system: LinearSystem, phi: np.ndarray) -> np.ndarray:
    """phi.C phi (count,), 1/s."""
    lost = np.zeros(len(phi))
    if any(block.key.damping for block in model.blocks):
        moved = state.copy()
        for k, vector in enumerate(phi):
            moved.velocity.assign(np.broadcast_to(vector, moved.velocity.numpy().shape))
            lost[k] = np.sum(model.viscous_force(moved)[world] * vector)
    flat = phi.reshape(len(phi), -1)
    return lost + sum(np.diag(C.project(flat.T)) for C in system.C)


def _rigid_motions(model: Model) -> np.ndarray:
    """(6, 3 slots) translations, and rotations about the origin."""
    table = model.slot_table
    origin = np.concatenate([np.tile(body.origin, (body.slot_count, 1)) for body in model.bodies])
    x = table.reference + table.is_position[:, None] * origin
    out = np.zeros((6, model.slots, 3))
    for k, axis in enumerate(np.eye(3)):
        out[k] = table.is_position[:, None] * axis
        out[3 + k] = np.cross(axis, x)
    return out.reshape(6, -1)
