"""Beams and shells against the literature, and at extreme slenderness."""

import numpy as np

import warpfea as wf

from ..build import StepStats, Z, beam, relative_error, solve
from ..case import Answer, Setting, case

ROUND_OFF_REFUSAL = ("float32 round-off limit reached",)


@case("bend45", "Beams and shells", values=(16, 32), quick="both")
def bend45(setting: Setting, elements: int) -> Answer:
    """Bend of 45 degrees, radius 100, section 1 x 1, with an out-of-plane tip load of 600.

    The reference is the geometrically exact beam with shear and the torsion constant 0.1406 of the square; the polar
    moment 1/6, as often published, gives another position.
    """
    R, angle = 100.0, np.pi / 4
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    arc = b.add_beam(
        lambda s: (R * (1.0 - np.cos(angle * s)), R * np.sin(angle * s), 0.0), elements=elements, normal=Z,
        section=wf.Rectangle(1.0, 1.0), material=wf.SVK(E=1e7, nu=0.0),
    )  # fmt: skip
    b.clamp(arc.start, slots="position+section")
    b.add_point_load(arc.end, (0, 0, 600.0))
    b.add_probe("tip", arc.end)
    found = solve(b, setting, load_steps=6)
    tip = found.result.probe("tip").position[0, -1]
    start = np.array([R * (1.0 - np.cos(angle)), R * np.sin(angle), 0.0])
    exact = np.array([15.558, 46.892, 53.608])
    error = float(np.linalg.norm(tip - exact) / np.linalg.norm(exact - start))
    return Answer(error, 1e-3, "Reissner's beam, 15.558, 46.892, 53.608", **found.stats.answer_fields,
                  note="end at " + ", ".join(f"{x:.3f}" for x in tip))  # fmt: skip


@case("sze-cantilever", "Beams and shells", quick="both")
def sze_cantilever(setting: Setting) -> Answer:
    """Strip 10 x 1 x 0.1 sheared at its end until it stands up: 16 shells."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    strip = b.add_shell(wf.mesh.grid((10.0, 1.0), cells=(16, 1)), thickness=0.1, material=wf.SVK(E=1.2e6, nu=0.0))
    b.clamp(strip.edge("x-"), slots="position+director")
    b.add_traction(strip.surface("x+"), (0, 0, 4.0 / 0.1))
    b.add_probe("tip", strip.edge("x+"))
    found = solve(b, setting, load_steps=8)
    error, note = (
        relative_error((-found.tip[0], found.tip[2]), (3.286, 6.698)),
        f"{-found.tip[0]:.3f}, {found.tip[2]:.3f}",
    )
    return Answer(error, 0.01, "Sze, Liu and Lo 2004: 3.286, 6.698", **found.stats.answer_fields, note=note)


@case("scordelis-lo", "Beams and shells", values=(8, 16), quick="float64", refusal={"float32": ROUND_OFF_REFUSAL})
def scordelis_lo(setting: Setting, cells: int) -> Answer:
    """Barrel roof, radius 25, length 50, thickness 0.25, under its weight; `cells` along each side of a quarter."""
    R, length, half, load_scale = 25.0, 50.0, np.radians(40.0), 1e-4
    b = wf.ModelBuilder(gravity=(0, 0, -10.0 * load_scale))  # 90 per area of the mid-surface
    grid = wf.mesh.grid((length, 2.0 * half), cells=(2 * cells, 2 * cells), origin=(0.0, -half, 0.0), map=lambda X:
                        np.column_stack([X[:, 0], R * np.sin(X[:, 1]), R * np.cos(X[:, 1])]))  # fmt: skip
    normals = grid.points * (0.0, 1.0 / R, 1.0 / R)
    roof = b.add_shell(grid, thickness=0.25, material=wf.SVK(E=4.32e8, nu=0.0, density=36.0), normals=normals)
    for side in ("x-", "x+"):
        b.clamp(roof.edge(side), slots="position", components="yz")
    middle = roof.nodes(lambda X: (np.abs(X[:, 0] - length / 2) < 1e-6) & (np.abs(X[:, 1]) < 1e-6))
    b.clamp(middle, slots="position", components="x")
    b.add_probe("edge", roof.at((length / 2, R * np.sin(half), R * np.cos(half))))
    stats = StepStats()
    sag = -solve(b, setting, stats, load_steps=1).result.probe("edge").displacement[0, -1, 2] / load_scale
    return Answer(abs(sag / 0.3006 - 1.0), 0.01, "deep shell theory, 0.3006", **stats.answer_fields,
                  note=f"{sag:.4f}; MacNeal and Harder give 0.3024")  # fmt: skip


@case("hemisphere", "Beams and shells", refusal={"float32": ROUND_OFF_REFUSAL})
def hemisphere(setting: Setting) -> Answer:
    """Hemisphere, radius 10, thickness 0.04, with a hole of 18 degrees, pinched; 16 x 16 shells to a quarter.

    With 8 x 8 the shells are 5 % too stiff.
    """
    R, top = 10.0, np.radians(72.0)

    def ball(X: np.ndarray) -> np.ndarray:
        around, up = X[:, 0], X[:, 1]
        return R * np.column_stack([np.cos(around) * np.cos(up), np.sin(around) * np.cos(up), np.sin(up)])

    b = wf.ModelBuilder(gravity=(0, 0, 0))
    grid = wf.mesh.grid((2.0 * np.pi, top), cells=(64, 16), map=ball)
    shell = b.add_shell(grid, thickness=0.04, material=wf.SVK(E=6.825e7, nu=0.3), normals=grid.points / R)
    load_scale = 1e-4
    for k, direction in enumerate(np.array([(1, 0, 0), (0, -1, 0), (-1, 0, 0), (0, 1, 0)], dtype=float)):
        place = ball(np.array([[k * np.pi / 2, 0.0, 0.0]]))[0]
        node = shell.nodes(lambda X, place=place: np.linalg.norm(X - place, axis=1) < 1e-6)
        b.add_point_load(node, tuple(2.0 * load_scale * direction))
        if k % 2 == 0:  # fixes the rigid modes that symmetry leaves free
            b.clamp(node, slots="position", components="y")
            rim = shell.nodes(lambda X, x=place[0]: np.linalg.norm(X - ball(
                np.array([[0.0 if x > 0 else np.pi, top, 0.0]]))[0], axis=1) < 1e-6)  # fmt: skip
            b.clamp(rim, slots="position", components="yz")
        else:
            b.clamp(node, slots="position", components="x")
        if k == 0:
            b.add_probe("load", node)
    stats = StepStats()
    got = solve(b, setting, stats, load_steps=1).result.probe("load").displacement[0, -1, 0] / load_scale
    source = "0.0935; the literature has 0.0930 to 0.0940"
    return Answer(abs(got / 0.0935 - 1.0), 0.01, source, **stats.answer_fields, note=f"{got:.4f}")


@case("slender", "Beams and shells", values=("beam", "plate"), quick="both", refusal={"float32": ROUND_OFF_REFUSAL})
def slender_structures(setting: Setting, value: str) -> Answer:
    """A cantilever 1e5 times as long as it is high, a clamped plate 1e4 times as wide as it is thick; linear theory."""
    E, nu = 1e9, 0.3
    if value == "beam":
        h, exact, bound = 1e-5, 1e-3, 1e-3
        b, body = beam(16, h, wf.SVK(E=E, nu=nu))
        b.add_point_load(body.end, (0, 0, 3e-3 * E * h**4 / 12.0))
    else:
        h, exact, bound = 1e-4, 1e-6, 0.02  # deflects by a hundredth of its thickness
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        plate = b.add_shell(wf.mesh.grid((1, 1), cells=(8, 8)), thickness=h, material=wf.SVK(E=E, nu=nu))
        for side in ("x-", "x+", "y-", "y+"):
            b.clamp(plate.edge(side), slots="position+director")
        D = E * h**3 / 12.0 / (1.0 - nu**2)
        b.add_traction(plate.surface("top"), (0, 0, exact * D / 1.26532e-3))
        b.add_probe("tip", plate.at((0.5, 0.5, 0.0)))
    found = solve(b, setting, load_steps=1)
    got = found.tip[2]
    return Answer(
        abs(got / exact - 1.0), bound, "Euler and Kirchhoff", **found.stats.answer_fields, note=f"{got:.6g} m"
    )
