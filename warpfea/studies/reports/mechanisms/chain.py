"""Reactions of the joints of a chain that hangs at rest."""

from __future__ import annotations

import time as clock
from collections.abc import Iterator
from typing import Any

import numpy as np

import warpfea as wf

from .cases import STEEL, X, Y, Z, work

__all__ = ["hanging_chain"]


def chain(device, kind, element, links, E):
    """Links 10 cm long that hang straight down from the ground: model, joints from the top, weight of a link (N)."""
    length, h = 0.1, 0.01
    b = wf.ModelBuilder()
    law = wf.SVK(E=E, nu=0.3, density=STEEL)
    above: Any = wf.GROUND
    joints = []
    top: Any
    low: Any
    for k in range(links):
        z = -k * length
        if element == "3243":
            link = b.add_beam([z * Z, (z - length) * Z], elements=1, section=wf.Rectangle(h, h), normal=Y, material=law)
            top, low = link.start, link.end
        else:
            mesh = wf.mesh.box((h, h, length), cells=(1, 1, 2), origin=(-h / 2, -h / 2, z - length))
            link = b.add_solid(mesh, material=law)
            top, low = link.surface("z+"), link.surface("z-")
        options: dict[str, Any] = {"revolute": {"axis": (X, Y)[k % 2]}, "universal": {"axis": X}}.get(kind, {})
        chosen = kind
        if kind == "fixed and held slides":
            chosen = ("fixed", "translational")[k % 2]
            options = {"axis": Z, "drive": 0.0} if k % 2 else {}
        joints.append(b.add_joint(chosen, parent=above, child=top, **options))
        above = low
    return b.finalize(device=device), joints, STEEL * h * h * length * 9.81


def hanging_chain(device: Any, quick: bool) -> Iterator[dict[str, Any]]:
    """Reaction of every joint of a chain of 10 steel links that hangs at rest, against the weight below it.

    By solve_static (one load step), where the joints leave no rigid motion, and by 20 steps of 10 ms of backward Euler
    from the straight unstressed chain, which its damping settles. `force_error` is the largest of |F - W| / W,
    `moment_error` of the moment over weight x link length."""
    stiff = {"max_pcg": 20000}
    cases: list[tuple[str, str, str, dict[str, Any]]] = [
        ("static", "fixed", "3243", {}),
        ("static", "fixed and held slides", "3243", {}),
        ("static", "fixed", "T10", {}),
    ]
    cases += [("dynamic", kind, "3243", {}) for kind in ("fixed", "spherical", "revolute", "universal")]
    cases += [("dynamic", kind, "T10", stiff) for kind in ("fixed", "spherical", "revolute")]
    if quick:
        cases = [
            ("static", "fixed", "3243", {}),
            ("dynamic", "spherical", "3243", {}),
            ("dynamic", "revolute", "3243", {}),
        ]
    links, E = 10, 2e11
    for way, kind, element, options in cases:
        model, joints, weight = chain(device, kind, element, links, E)
        began = clock.perf_counter()
        if way == "static":
            sim = wf.solve_static(model, load_steps=1).simulation
        else:
            sim = wf.Simulation(model, dt=1e-2, solver=wf.NewtonPCG(**options))
            sim.step(20)
        seconds = clock.perf_counter() - began
        below = weight * np.arange(links, 0, -1)
        got = np.array([sim.joint_force(joint)[0] for joint in joints])
        error = np.linalg.norm(got[:, :3] - below[:, None] * Z, axis=1) / below
        assert sim.last is not None
        yield {"way": way, "joints": kind, "element": element, "links": links, "E": E, "solver": options,
               "force_error": float(error.max()), "errors": [float(e) for e in error],
               "moment_error": float((np.linalg.norm(got[:, 3:], axis=1) / (0.1 * below)).max()),
               "residual": float(sim.last.residual[0]), "seconds": seconds, **work(sim, seconds)}  # fmt: skip
