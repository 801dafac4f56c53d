"""Two elastic bodies pressed together, with meshes that do not match: balls and cylinders beside Hertz.

Run as `python tests/contact_hertz_pairs.py --out FILE`.
"""

import argparse
import json
import math
import pathlib
import sys
from typing import Any

import numpy as np
from validation.contact import WIDTH, A, E, fit_errors, grading, solved

import warpfea as wf
from warpfea.base.provenance import provenance_of
from warpfea.contact.evaluation import evaluate_pairs
from warpfea.contact.facets import FacetContact

RADIUS = 2.0
"""Of each surface, m: of both together 1 m."""
MODULI = (E, 2.0 * E)
"""Of the lower body and of the upper one, Pa."""
NU = 0.3
THICK = 0.2 * A
"""Of the slices of cylinders, m."""
FLAT = 10.0
"""Beyond so many contact radii faces level off: 5e-5 of the curvature there, and far elements keep their shape."""


def curved(place: Any, inner: int, flip: bool, round_axes: tuple[int, ...]) -> Any:
    """Map of a graded block whose upper face is a paraboloid, or a parabolic cylinder; turned over for the upper body.

    Edges are curved in the evenly meshed zone only: far elements are too long for it.
    """

    def drop(X: np.ndarray) -> Any:
        square = (place(X)[:, round_axes] ** 2).sum(axis=1)
        return square / (2.0 * RADIUS) / np.sqrt(1.0 + (square / (FLAT * A) ** 2) ** 2)

    def mapped(X: np.ndarray) -> np.ndarray:
        ends = [np.floor(np.rint(2.0 * X) / 2.0), np.ceil(np.rint(2.0 * X) / 2.0)]
        axes = (0, 2) if len(round_axes) == 1 else (0, 1, 2)
        near = np.max([np.abs(end[:, axes]).max(axis=1) for end in ends], axis=0) <= inner
        x = place(X)
        x[:, 2] -= np.where(near, drop(X), 0.5 * (drop(ends[0]) + drop(ends[1])))
        if not flip:
            return np.asarray(x)
        return np.asarray(x[:, [1, 0, 2]] * (1.0, 1.0, -1.0) if len(round_axes) == 2 else x * (1.0, -1.0, -1.0))

    return mapped


def point_pressures(sim: wf.Simulation, round_axes: tuple[int, ...]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Distance to the axis (points,), m, pressure, Pa, and area, m^2, of the points of the slave surface."""
    (term,) = (term for term in sim.model.terms.all if isinstance(term, FacetContact))
    (p,), (contact,) = term.tables.host, term.tables.contacts
    u = sim.state.displacement.numpy()[0][p.conn + contact.body.slot_offset]
    x = (p.X + np.einsum("fpl,flk->fpk", p.shape, u)).reshape(-1, 3)
    area = p.area.ravel()
    normal = evaluate_pairs(term, sim.state).normal[0]
    return np.linalg.norm(x[:, round_axes], axis=1), normal / np.maximum(area, 1e-300), area


def pressed_case(
    *, balls: bool, inner: tuple[int, int], outer: tuple[int, int], stiffness: float | None, load_steps: int = 4,
    device: Any = "cpu"
) -> dict[str, Any]:  # fmt: skip
    """Press one elastic ball, or cylinder in plane strain, onto another of twice the modulus, R = 1 m of both.

    Meshed are a quarter of the balls and half a slice of the cylinders; `stiffness` is a multiple of the region's, by
    default the contact has that of the elements. The approach of Hertz is that of points far away; here it is that of
    the outer faces, 60 A away (cylinders 40), without a correction, which moves balls by F (1 - nu^2)/(60 pi E A) each.
    """
    depth, push, round_axes = (60.0, A**2, (0, 1)) if balls else (40.0, 2.0 * A**2, (0,))
    b, bodies = wf.ModelBuilder(gravity=(0, 0, 0)), []
    for k, name in enumerate(("lower", "upper")):
        n, wide = inner[k] + outer[k], inner[k] + outer[k] if balls else 1
        graded = grading(inner[k], outer[k], depth)

        def place(X: np.ndarray, graded: Any = graded) -> np.ndarray:
            x = graded(X if balls else X * (1.0, 0.0, 1.0))
            if not balls:
                x[:, 1] = (X[:, 1] - 0.5) * THICK
            return np.asarray(x)

        mesh = wf.mesh.box((n, wide, n), cells=(n, wide, n), origin=(0, 0, -n), element="T10",
                           map=curved(place, inner[k], k == 1, round_axes))  # fmt: skip
        body = b.add_solid(mesh, material=wf.SVK(E=MODULI[k], nu=NU, density=1000.0), name=name)
        for side in ("z-", "x+", "y+") if balls else ("z-", "x+"):
            b.clamp(body.nodes(side), components="xyz" if k == 0 else "xy")
            if k == 1:
                b.drive(body.nodes(side), displacement=([0.0, 1.0], [(0, 0, 0), (0, 0, -push)]), components="z")
        turned = balls and k == 1
        planes = (("y-" if turned else "x-", "x"), ("x-" if turned else "y-", "y"))
        for side, axis in (*planes, *(() if balls else (("y+", "y"),))):
            b.clamp(body.nodes(side), components=axis)
        bodies.append(body)
    reach = A if balls else math.sqrt(A * THICK / math.pi)
    chosen: Any = {} if stiffness is None else {"stiffness": ("region", stiffness), "radius": reach}
    pair = b.add_contact(bodies[0].surface("z+"), bodies[1].surface("z+"), name="pair", **chosen)
    sim, found, seconds = solved(b, load_steps, device)
    force = abs(float(found.contact_force(pair)[0, 2])) * (4.0 if balls else 2.0 / THICK)
    modulus = 1.0 / sum((1.0 - NU**2) / e for e in MODULI)
    radius = (0.75 * force / modulus) ** (1.0 / 3.0) if balls else math.sqrt(4.0 * force / (math.pi * modulus))
    peak = 1.5 * force / (math.pi * radius**2) if balls else 2.0 * force / (math.pi * radius)
    penetration = float(sim.contact_record(pair).penetration[0, -1])
    approach = {"approach_error": (A**2 - penetration) / radius**2 - 1.0} if balls else {}
    return {
        "nu": NU, "unknowns": int(sim.model.free_slots.sum()), "depth_over_a": depth * A / radius,
        "cells_per_radius": [n / WIDTH * radius / A for n in inner], "a_over_R": radius / RADIUS,
        "stiffness": stiffness, "points_of": sim.model.terms.contacts[0].tables.contacts[0].body.name, "force": force,
        **fit_errors(*point_pressures(sim, round_axes), radius, peak), **approach, "penetration": penetration,
        "load_steps": load_steps, "newton": int(found.newton[0]), "pcg": int(found.pcg[0]), "seconds": seconds,
    }  # fmt: skip


BALLS = [((4, 5), (5, 6), None), ((5, 7), (6, 7), None), ((4, 5), (5, 6), 300.0), ((6, 8), (6, 6), 300.0)]
CYLINDERS = [(i, o, stiffness) for stiffness in (None, 300.0) for i, o in (((5, 7), (6, 7)), ((10, 14), (8, 9)))]


def main():
    """Make the file."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--out", type=pathlib.Path, required=True)
    out = parser.parse_args().out
    content = provenance_of([], "cpu") | {"command": " ".join(["python", *sys.argv])}
    content["settings"] = {"E": MODULI, "surface_radius": RADIUS, "contact_radius": A, "nu": NU}
    for part, cases in {"balls": BALLS, "cylinders": CYLINDERS}.items():
        content[part] = [
            pressed_case(balls=part == "balls", inner=i, outer=o, stiffness=stiffness) for i, o, stiffness in cases
        ]
    out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
