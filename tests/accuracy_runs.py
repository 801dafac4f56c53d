"""A scene of a falling box, and studies of it."""

import dataclasses

import numpy as np
import warp as wp

import warpfea as wf

G, T = 9.81, 0.04
START = np.array([1.0, 0.5, 0.5])


def fallen(times):
    return START - np.outer(0.5 * G * times**2, (0.0, 0.0, 1.0))


@wp.func
def nan_later(t: wp.float64) -> wp.vec3d:  # Pa
    zero = wp.float64(0.0)
    return wp.vec3d(zero, zero, wp.where(t > wp.float64(0.013), zero / zero, zero))


def corners(sim):
    return sim.displacements(sim.model.bodies[0])[0, :4]


@wf.scene(dt=5e-3, t_end=T, tol=1e-10, reference={"face": fallen}, field=corners)
def falling(*, cells: int = 1, element: str = "T10", bad: bool = False, gravity: float = G) -> wf.ModelBuilder:
    """A box that falls."""
    b = wf.ModelBuilder(gravity=(0, 0, -gravity))
    mesh = wf.mesh.box((1, 1, 1), cells=(cells, 1, 1), element=element)
    box = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=1000.0), name="box")
    if bad:
        b.add_traction(box.surface("z+"), nan_later)
    b.add_probe("face", box.surface("x+"))
    return b


STEPS = [5e-3, 2.5e-3, 1.25e-3]


FIELDS = {field.name for field in dataclasses.fields(wf.StudyOptions)}


def run(scene=falling, **given):
    given = {"device": "cpu", "repeat": 1, "split": "none"} | given
    options = wf.StudyOptions(**{k: given.pop(k) for k in FIELDS & given.keys()})
    return wf.study(scene, **given, options=options)
