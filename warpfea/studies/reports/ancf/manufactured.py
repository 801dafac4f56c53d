"""Manufactured displacements: a clamped cube, a simply supported beam and plate; errors and their orders in h."""

# mypy: disable-error-code="index"
# (vectors of device functions: Warp does not declare that they can be indexed)

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

import warpfea as wf
from warpfea.model.assembly import geometry

from ..parts import Rows
from .cases import X, Z, static

__all__ = ["manufactured", "manufactured_structures"]

A = wp.constant(wp.float64(1e-6))
PI = wp.constant(wp.float64(np.pi))
LAW = wf.SVK(E=1.0, nu=0.25, density=1.0)  # lambda = mu = 0.4


@wp.func
def manufactured_force(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """-div of the small-strain stress of u = A sin(pi x) sin(pi y) sin(pi z) (1, 1, 1), lambda = mu = 0.4."""
    s = wp.vec3d(wp.sin(PI * x[0]), wp.sin(PI * x[1]), wp.sin(PI * x[2]))
    c = wp.vec3d(wp.cos(PI * x[0]), wp.cos(PI * x[1]), wp.cos(PI * x[2]))
    sss = s[0] * s[1] * s[2]
    xy = c[0] * c[1] * s[2]
    yz = s[0] * c[1] * c[2]
    xz = c[0] * s[1] * c[2]
    k = A * PI * PI * wp.float64(0.4)
    three, two, one = wp.float64(3.0), wp.float64(2.0), wp.float64(1.0)
    grad_div = wp.vec3d(-sss + xy + xz, -sss + xy + yz, -sss + xz + yz)
    return k * (three * wp.vec3d(sss, sss, sss) * one - two * grad_div)


def manufactured(device: Any, quick: bool) -> Rows:
    """A manufactured displacement of a clamped cube: error of u in the mean square over its own, and its order in h."""
    rows = []
    sizes = {"T4": (4, 8, 16), "T10": (2, 4, 8), "FN": (2, 4, 8, 16), "FN18": (2, 4, 8, 16), "ENMC": (2, 4, 8, 16),
             "H3843": (2, 4, 8, 12)}  # fmt: skip
    for element, counts in sizes.items():
        last: tuple[int, float] | None = None
        for n in counts[:2] if quick else counts:
            b = wf.ModelBuilder(gravity=(0, 0, 0))
            cube = b.add_solid(wf.mesh.box((1, 1, 1), cells=(n, n, n), element=element), element=element, material=LAW)
            for axis in range(3):
                for side in (0.0, 1.0):
                    face = cube.nodes(lambda X, a=axis, s=side: np.abs(X[:, a] - s) < 1e-9)
                    b.clamp(face, slots="position")
                    if element not in ("T4", "T10"):  # the face's own directions: it stays where it is
                        names = [f"gradient-{c}" for k, c in enumerate("xyz") if k != axis]
                        b.clamp(face, slots="+".join(names))
            b.add_body_force(manufactured_force, bodies=[cube])
            result, seconds = static(b, device, load_steps=1, tol=1e-9)
            error = _mean_square_error(cube, result.state)
            unknowns = int(result.simulation.model.free_slots.sum())
            order = None if last is None else float(np.log(last[1] / error) / np.log(n / last[0]))
            last = (n, error)
            rows.append({"element": element, "cells": n, "unknowns": unknowns, "error": error, "order": order,
                         "seconds": seconds})  # fmt: skip
    return rows


def _mean_square_error(body, state):
    """Error of the displacement in the mean square over the body, over that of the exact one."""
    rule = body.family.curved_mass_rule
    every = np.arange(len(body.mesh.cells))
    s, _, _, det = geometry(body, every, rule.points)
    conn = body.connectivity
    u = state.displacement.numpy()[0, body.slot_offset : body.slot_offset + body.slot_count]  # as connectivity counts
    position = (body.slot_kind[conn] == 0)[:, :, None]
    table = np.broadcast_to(s, (len(every), *s.shape[1:]))
    x = np.einsum("eqs,esk->eqk", table, body.reference[conn] + position * body.origin)
    got = np.einsum("eqs,esk->eqk", table, u[conn])
    exact = 1e-6 * np.prod(np.sin(np.pi * x), axis=2)[:, :, None]
    w = (det * rule.weights)[:, :, None]
    return float(np.sqrt(np.sum(w * (got - exact) ** 2) / (3.0 * np.sum(w * exact**2))))


@wp.func
def sine_in_x(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """A load per mass along the beam."""
    return wp.vec3d(wp.float64(0.0), wp.float64(0.0), -A * wp.sin(PI * x[0]))


@wp.func
def sine_in_xy(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    """A load per mass over the plate."""
    return wp.vec3d(wp.float64(0.0), wp.float64(0.0), -A * wp.sin(PI * x[0]) * wp.sin(PI * x[1]))


def manufactured_structures(device: Any, quick: bool) -> Rows:
    """Simply supported beam and plate of size 1, thickness 0.05, bent into sines: mid deflection, closed forms."""
    rows = []
    h, E, nu = 0.05, 1e3, 0.3
    mu = E / 2.0 / (1.0 + nu)
    for integration, k in (("tied", 5.0 / 6.0), ("split", 1.0)):
        exact = 1e-6 * (1.0 / (E * h**2 / 12.0 * np.pi**4) + 1.0 / (k * mu * np.pi**2))  # rho = 1; per area of section
        last = None
        for n in (2, 4, 8, 16):
            b = wf.ModelBuilder(gravity=(0, 0, 0))
            beam = b.add_beam([(0, 0, 0), X], elements=n, section=wf.Rectangle(h, h), normal=Z,
                              material=wf.SVK(E=E, nu=nu, density=1.0), integration=integration)  # fmt: skip
            b.clamp(beam.start, slots="position")
            b.clamp(beam.end, slots="position", components="yz")
            b.clamp(beam.nodes(lambda X: X[:, 0] > -1.0), components="y")
            b.add_body_force(sine_in_x, bodies=[beam])
            b.add_probe("middle", beam.at((0.5, 0.0, 0.0)))
            rows.append(_order_row("3243", integration, n, static(b, device, load_steps=1, tol=1e-9), exact, last))
            last = rows[-1]
    D = E * h**2 / 12.0 / (1.0 - nu**2)
    exact = 1e-6 * (1.0 / (4.0 * np.pi**4 * D) + 1.0 / (2.0 * np.pi**2 * 5.0 / 6.0 * mu))
    last = None
    for n in (2, 4, 8) if quick else (2, 4, 8, 16):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        plate = b.add_shell(wf.mesh.grid((1.0, 1.0), cells=(n, n)), thickness=h,
                            material=wf.SVK(E=E, nu=nu, density=1.0))  # fmt: skip
        b.clamp(plate.nodes(lambda X: X[:, 0] > -1.0), slots="position", components="xy")
        for sides, along in ((("x-", "x+"), "y"), (("y-", "y+"), "x")):
            for side in sides:
                b.clamp(plate.edge(side), slots="position", components="z")
                b.clamp(plate.edge(side), slots="director", components=along)
        b.add_body_force(sine_in_xy, bodies=[plate])
        b.add_probe("middle", plate.at((0.5, 0.5, 0.0)))
        rows.append(_order_row("3443", "tied", n, static(b, device, load_steps=1, tol=1e-9), exact, last))
        last = rows[-1]
    return rows


def _order_row(element, integration, n, solved, exact, last):
    """Error of the deflection of the middle over its exact value, and its order from the row before."""
    result, seconds = solved
    w = -result.probe("middle").displacement[0, -1, 2]
    error = float(abs(w / exact - 1.0))
    order = float(np.log2(last["error"] / error)) if last and last["integration"] == integration else None
    return {"element": element, "integration": integration, "elements": n, "error": error, "order": order,
            "seconds": seconds}  # fmt: skip
