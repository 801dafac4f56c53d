"""Slider-cranks: a stiff one against the closed form, an elastic one against the floating frame."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

import warpfea as wf

from ..parts import Rows
from .cases import EVERY, X, Y, Z, place, timed, work
from .rigid import STANDARD, slider_crank_kinematics
from .rod import floating_frame_slider_crank

__all__ = ["flexible_slider_crank", "rigid_slider_crank"]

STIFF = 2e14
"""Of the crank and the slider beside the elastic rod, Pa."""


def slider_crank(device, *, speed, E, dt, stiff=None, elements=4, shear=5.0 / 6.0):
    """The slider-crank of STANDARD of rigid.py in the x-z plane with a rod of modulus E, at crank angle 0 with the
    rigid mechanism's velocities; crank and slider, a box of 2 cm, of modulus `stiff`."""
    data = STANDARD
    r, L, a, side = data["crank"], data["rod"], 0.02, data["side"]
    b = wf.ModelBuilder(gravity=(0, 0, 0))

    def law(E, density=data["density"]):
        return wf.SVK(E=E, nu=0.3, density=density)

    stiff = stiff or E
    crank = b.add_beam([0 * X, r * X], elements=1, section=wf.Rectangle(0.02, 0.02), normal=Z, material=law(stiff),
                       name="crank")  # fmt: skip
    rod = b.add_beam([r * X, (r + L) * X], elements=elements, section=wf.Rectangle(side, side, shear=shear), normal=Z,
                     material=law(E), name="rod")  # fmt: skip
    box = wf.mesh.box((a, a, a), cells=(1, 1, 1), origin=(r + L - a / 2, -a / 2, -a / 2))
    slider = b.add_solid(box, material=law(stiff, data["slider_mass"] / a**3), name="slider")
    whole = slider.nodes(EVERY)
    b.add_joint("revolute", parent=wf.GROUND, child=crank.start, axis=-Y, drive=([0.0, 1e3], [0.0, 1e3 * speed]))
    b.add_joint("revolute", parent=crank.end, child=rod.start, axis=-Y)
    b.add_joint("revolute", parent=whole, child=rod.end, axis=-Y, anchor=(r + L) * X)
    b.add_joint("translational", parent=wf.GROUND, child=whole, axis=X)
    b.set_initial(crank, velocity=lambda P: speed * np.cross(-Y, P))
    b.set_initial(rod, velocity=lambda P: speed * r * (Z + np.cross(Y, P - r * X) / L))
    for name, point in (("slider", whole), ("start", rod.start), ("middle", rod.at((r + L / 2) * X)), ("end", rod.end)):
        b.add_probe(name, point)
    return wf.Simulation(b.finalize(device=device), dt=dt, integrator="bdf2")


def deflection(sim):
    """Middle of the rod from the chord between its pins, positive to the left of it, m."""
    chord = place(sim, "end") - place(sim, "start")
    middle = place(sim, "middle") - place(sim, "start")
    return (chord[:, 0] * middle[:, 1] - chord[:, 1] * middle[:, 0]) / np.linalg.norm(chord, axis=1)


def rigid_slider_crank(device: Any, quick: bool) -> Rows:
    """A slider-crank so stiff that it follows the closed form, over a turn and a bit; no gravity, bdf2.

    Errors are over the length of crank + rod; `deformation` is the largest of the rod's bending and stretch over its
    length and of the crank's stretch over its own."""
    r, L = STANDARD["crank"], STANDARD["rod"]
    cases = [(15.0, E, 400) for E in (2e10, 2e11, 2e12, 2e13, 2e14)] + [(15.0, 2e13, 100), (150.0, 2e15, 400)]
    rows = []
    for speed, E, count in [(15.0, 2e13, 100)] if quick else cases:
        sim = slider_crank(device, speed=speed, E=E, dt=2.0 * np.pi / speed / count, elements=2)
        seconds = timed(sim, count + count // 50)
        time = sim.probe("slider").time
        pin, slider, _ = slider_crank_kinematics(speed * time, r, L)
        start, end = place(sim, "start"), place(sim, "end")
        bend = np.abs(deflection(sim)).max() / L
        stretch = np.abs(np.linalg.norm(end - start, axis=1) / L - 1.0).max()
        crank = np.abs(np.linalg.norm(start, axis=1) / r - 1.0).max()
        rows.append({
            "speed": speed, "E": E, "dt": sim.dt, "turns": float(speed * time[-1] / (2.0 * np.pi)),
            "deformation": float(max(bend, stretch, crank)),
            "slider_error": float(np.abs(place(sim, "slider")[:, 0] - slider).max() / (r + L)),
            "pin_error": float(np.linalg.norm(start - pin, axis=1).max() / (r + L)),
            "off_line": float(np.abs(sim.probe("slider").position[0][:, 1:]).max() / (r + L)),
            **work(sim, seconds),
        })  # fmt: skip
    return rows


def flexible_slider_crank(device: Any, quick: bool) -> Rows:
    """Deflection of the middle of the elastic rod of STANDARD of rigid.py over its first turn, bdf2, over the
    largest of the reference (`floating_frame_slider_crank`, 6 modes).

    `from_model` is the distance from the reference, `from_limit` that from the limit of the series: of the time steps
    by Richardson's rule at order 2, of the mesh at the order that the last three runs show. `order` is that of
    successive differences, at the 500 times that all runs of a series share. The rod's axial ringing (18100 rad/s) and
    faster modes, 0.1 % of the deflection, turn by hundreds of rad: they come to order 2 at much smaller steps than the
    bending does. `slow_from_limit` and `slow_order` are therefore those of the deflection under a Hann window of two
    axial periods. The reference neglects shear and rotary inertia; the row `shear` neglects the shear as well (a factor
    of 1000)."""
    data = STANDARD
    turn = 2.0 * np.pi / data["speed"]
    common = 250 if quick else 500
    at = np.arange(1, common + 1) * turn / common
    part = common // 4 if quick else common  # of the turn
    bend, slide = floating_frame_slider_crank(np.concatenate([[0.0], at[:part]]), **data, modes=6)
    bend, slide, peak = bend[1:], slide[1:], np.abs(bend).max()
    window = np.hanning(2 + round(2 * (2.0 * np.pi / 18100.0) / (turn / common)))[1:-1]

    def slow(d):
        return np.convolve(d, window / window.sum(), mode="valid")

    def run(series, elements, count, **options):
        sim = slider_crank(device, speed=data["speed"], E=data["E"], dt=turn / count, stiff=STIFF, elements=elements,
                           **options)  # fmt: skip
        seconds = timed(sim, count * part // common)
        pick = slice(count // common - 1, None, count // common)
        d = deflection(sim)[pick]
        print(f"    {series}: {elements} elements, {count} steps, {seconds:.0f} s", flush=True)
        row = {"series": series, "elements": elements, "dt": sim.dt, "peak": float(np.abs(deflection(sim)).max()),
               "reference_peak": float(peak), "from_model": float(np.abs(d - bend).max() / peak),
               "slider_from_model": float(np.abs(place(sim, "slider")[pick, 0] - slide).max()),
               **work(sim, seconds)}  # fmt: skip
        return row, d

    def judge(runs, order=None):
        """Fill in orders and distances from the limit; the mesh and the step are halved from run to run."""
        rows = [row for row, _ in runs]
        for name, seen in (("", [d for _, d in runs]), ("slow_", [slow(d) for _, d in runs])):
            gaps = [np.abs(b - a).max() for a, b in itertools.pairwise(seen)]
            found = [float(np.log2(a / b)) for a, b in itertools.pairwise(gaps)]
            limit = seen[-1] + (seen[-1] - seen[-2]) / (2.0 ** (order or found[-1]) - 1.0)
            for row, d, p in zip(rows, seen, [None, None, *found]):
                row[f"{name}from_limit"] = float(np.abs(d - limit).max() / peak)
                row[f"{name}order"] = p
                if not name:
                    row["limit_from_model"] = float(np.abs(limit - bend).max() / peak)
        return rows

    if quick:
        return [run("time", 4, 1000)[0]]
    rows = judge([run("time", 4, n) for n in (500, 1000, 2000, 4000, 8000, 16000, 32000)], 2.0)
    rows += judge([run("mesh", n, 4000) for n in (2, 4, 8, 16)])
    rows.append(run("shear", 8, 4000, shear=1000.0)[0])
    return rows
