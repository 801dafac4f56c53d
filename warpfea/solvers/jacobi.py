"""Tiled block-Jacobi descent with acceleration, a fixed number of iterations per step: options, and its loop."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import warp as wp

from ..errors import ModelError
from ..kernels.jacobi import PAIRS, jacobi_kernels, jacobi_struct
from .newton import NewtonLoop, NewtonPCG

if TYPE_CHECKING:
    from ..launch import Launcher
    from ..model import Model
    from ..workspace import Workspace

__all__ = ["Jacobi", "JacobiLoop"]

ACCELERATIONS = ("none", "chebyshev", "anderson2", "anderson", "conjugate")
GROWTH = 10.0


@dataclass(frozen=True)
class Jacobi:
    iterations: int = 8
    coarse: bool = True
    acceleration: str = "anderson"
    tol: float | None = None
    force_tol: float = 0.0
    max_halvings: int = 8
    window: int = 5
    step: float = 1.0
    largest: float = 3.5
    ratio: float = 16.0

    def tolerance(self, dtype: str) -> float:
        """The tolerance in one precision."""
        return self.newton.tolerance(dtype)

    @property
    def newton(self) -> NewtonPCG:
        """What of it Newton's method has too."""
        return NewtonPCG(
            tol=self.tol, force_tol=self.force_tol, max_newton=self.iterations, max_pcg=1,
            max_halvings=self.max_halvings, preconditioner="two-level" if self.coarse else "tiles",
            operator="elements",
        )  # fmt: skip

    @property
    def max_newton(self) -> int:
        """Evaluations of the residual per attempt but the first."""
        return self.iterations


class JacobiLoop(NewtonLoop):
    """Newton's loop with one application of the preconditioner in place of the linear solve and the line search."""

    def __init__(
        self,
        model: Model,
        work: Workspace,
        launch: Launcher,
        options: Jacobi,
        *,
        inertia: bool,
        constraint_tol: float,
    ) -> None:
        super().__init__(model, work, launch, options.newton, inertia=inertia, constraint_tol=constraint_tol)
        self.acceleration = options.acceleration
        self.own = jacobi_kernels(model.dtype, model.constraints is not None, options.acceleration)
        B = model.worlds
        paired = options.acceleration not in ("none", "chebyshev")
        shape = (options.window, B, model.slots) if paired else (1, 1, 1)
        self.paired = paired
        self.moves = work.array("jacobi moves", shape, model.types.vec3)
        self.changes = work.array("jacobi changes", shape, model.types.vec3)
        shapes = {"gram": (B, PAIRS, PAIRS), "factor": (B, PAIRS, PAIRS), "right": (B, PAIRS), "gamma": (B, PAIRS)}
        self.control = work.struct(jacobi_struct(), B, sums=(2 * PAIRS, B), **shapes)
        self.control.growth = GROWTH
        self.control.step = options.step
        self.control.window = options.window
        low = options.largest / options.ratio
        self.control.centre, self.control.half = 0.5 * (options.largest + low), 0.5 * (options.largest - low)

    def modules(self) -> set[wp.Module]:
        """Modules of its own."""
        return super().modules() | {self.own.module}

    def _solve(self) -> None:
        w = self.work
        self.launch(self.own.begin, self.model.worlds, [w.newton, self.control])
        self._any(w.newton.active, self.iterating)
        wp.capture_while(self.iterating, self._iterate)
        self.launch(self.own.tell, self.model.worlds, [w.newton, self.control, w.pcg, w.step.running])
        self.preconditioner.judge(w.newton.active)
        w.newton.active.zero_()

    def _iterate(self) -> None:
        m, w, k, launch, ctl = self.model, self.work, self.own, self.launch, self.control
        active = w.newton.active
        args = [w.newton, ctl, w.gradient, w.diagonal, m.topology.free, w.direction, w.p, w.r]
        launch(k.remember, self.dim, [*args, self.moves, self.changes, w.rows])
        if self.paired:
            self.residual.reduce(w.rows, 2 * PAIRS, active, ctl.sums)
        if self.acceleration != "none":
            launch(k.shares, m.worlds, [w.newton, ctl])
        if self.paired:
            launch(k.project, self.dim, [w.newton, ctl, self.changes, w.r])
        self.preconditioner.apply(w.r, w.z, active)
        if self.acceleration == "conjugate":
            launch(k.conjugate_rows, self.dim, [w.newton, ctl, self.changes, w.z, w.rows])
            self.residual.reduce(w.rows, PAIRS, active, ctl.sums)
            launch(k.conjugate, m.worlds, [w.newton, ctl])
        launch(k.combine, self.dim, [w.newton, ctl, self.moves, w.z, w.direction])
        if self.pcg.deflate:
            args = [w.newton, w.step.mass_factor, m.groups.lumped, w.gradient, m.topology.free, w.direction, w.r]
            launch(k.momentum_left, self.dim, args)
            self.pcg.translate(active)
        if self.constraints:
            self.constraints.predict(active)
        launch(k.advance, self.dim, [w.newton, w.direction, w.v])
        self.residual.evaluate(active)
        launch(k.judge, m.worlds, [w.newton, ctl])
        if self.constraints:
            self.constraints.adopt(w.newton.stepped)
        self._any(active, self.iterating)
