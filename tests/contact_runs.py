"""Cubes that are thrown at colliders."""

from __future__ import annotations

import pytest

import warpfea as wf

DT = 1e-3
TIGHT = wf.NewtonPCG(tol=1e-12)
FLOOR = wf.HalfSpace((0, 0, 1), -0.002)
TURN = wf.Rotation(anchor=(0, 0, 0), axis=(0, 0.2, 1), angle=([0, 1], [0, 10.0]))
SLIDE = ([0, 0.01, 0.02, 0.05], [(0, 0, 0), (0, 0.01, 0.003), (0.01, 0, -0.002), (0.05, 0, 0)])
PLACES = {
    "plane": (FLOOR, None),
    "path": (FLOOR, SLIDE),
    "rotation": (FLOOR, TURN),
    "ball": (wf.Sphere((0.05, 0.05, -0.2), 0.199), None),
    "capsule": (wf.Capsule((-0.1, 0.05, -0.1), (0.2, 0.05, -0.1), 0.099), TURN),
    "cylinder": (wf.Cylinder((-0.1, 0.05, -0.1), (0.2, 0.05, -0.1), 0.099), ([0, 1], [(0, 0, 0), (3, 0, 0)])),
    "box": (wf.Box((0.05, 0.05, -0.102), (0.3, 0.3, 0.2)), TURN),
}
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
DTYPES = ["float64", "float32"]


def thrown(place="plane", *, E=1e6, device="cpu", dtype="float64", worlds=1, shape=None, **options):
    """A cube of 0.1 m and 1 kg that spins and slides onto an obstacle: builder, cube, model."""
    b = wf.ModelBuilder()
    cube = b.add_solid(
        wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=wf.SVK(E=E, nu=0.3, density=1000), name="cube"
    )
    b.set_initial(cube, velocity=(1.0, 0.2, -0.3), angular_velocity=(0, 3, 5))
    found, path = PLACES[place]
    floor = b.add_collider(shape or found, path=path, name="floor")
    b.add_contact(cube, floor, **({"mu": 0.5, "restitution": 0.5, "name": "pad"} | options))
    return b, cube, b.finalize(device=device, dtype=dtype, worlds=worlds)


def simulated(steps, *args, dt=DT, integrator="backward_euler", solver=None, **options):
    sim = wf.Simulation(thrown(*args, **options)[2], dt=dt, integrator=integrator, solver=solver)
    sim.step(steps)
    return sim
