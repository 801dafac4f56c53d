"""Cubes on springs of every kind, for the tests of springs and point masses."""

import numpy as np
import warp as wp

import warpfea as wf

EXACT = wf.NewtonPCG(tol=1e-12)


SCHEMES = ["backward_euler", "bdf2", "energy_momentum", "generalized_alpha"]


CENTRE = np.array([0.05, 0.05, 0.05])


CUBE = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element="T4")


TILTED = np.array([(2.0, 1.0, 2.0), (-2.0, 2.0, 1.0), (-1.0, -2.0, 2.0)]) / 3.0


HARD = wf.SVK(E=1e9, nu=0.3, density=1000.0)


@wp.func
def sway(t: wp.float64) -> wp.vec3d:
    return wp.float64(2.0) * wp.sin(wp.float64(17.0) * t) * wp.vec3d(wp.float64(1.0), wp.float64(0.0), wp.float64(0.0))


@wp.func
def twist(t: wp.float64) -> wp.vec3d:
    return wp.float64(0.01) * wp.sin(wp.float64(17.0) * t) * wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))


@wp.func
def hardening(length: wp.float64, rate: wp.float64) -> wp.float64:
    """100 e + 4000 e^3 with e the elongation over 0.3 m, and quadratic damping."""
    e = length - wp.float64(0.3)
    return wp.float64(100.0) * e + wp.float64(4000.0) * e * e * e + wp.float64(3.0) * rate * wp.abs(rate)


def cube(gravity=(0, 0, 0), **options):
    """A cube of 1 kg, hard beside all springs."""
    b = wf.ModelBuilder(gravity=gravity)
    return b, b.add_solid(CUBE, material=HARD, name="cube", **options)


def polar_inertia(body, axis_point):
    """About the axis through a point along z, by the mass matrix, kg m^2."""
    from warpfea.model.masses import body_mass

    X = (body.reference + body.origin - axis_point)[:, :2]
    return float(np.sum(X * (body_mass(body) @ X)))


def oscillator(kind, damping, forced):
    """Builder of a cube on a spring, with velocity 1 (m/s, rad/s) at rest length; its m, k and load amplitude."""
    gravity = sway if forced and kind != "torsion" else (0, 0, 0)
    b, body = cube(gravity)
    if kind == "torsion":
        hinge = b.add_joint("revolute", parent=wf.GROUND, child=body.surface("z-"), anchor=CENTRE, axis=(0, 0, 1))
        mass = polar_inertia(body, CENTRE)
        k = 100.0 * mass
        b.add_torsion_spring(hinge, stiffness=k, damping=damping * mass, name="s")
        b.set_initial(body, angular_velocity=(0, 0, 1.0))
        if forced:
            b.add_moment(body.at(CENTRE), twist)
        return b, mass, k, 0.01 * forced, hinge
    if kind == "foundation":
        b.add_foundation(body.surface("z-"), stiffness=100.0 / 0.01, damping=damping / 0.01, name="s")
        b.drive(body.nodes("z-"), displacement=(0, 0, 0), components="yz")
        b.drive(body.nodes("z+"), displacement=(0, 0, 0), components="yz")
    else:
        b.add_spring((-1.0, 0.05, 0.05), body.surface("x-"), stiffness=100.0, damping=damping, name="s")
    b.set_initial(body, velocity=(1.0, 0, 0))
    b.add_probe("p", body.surface("z-"))
    return b, 1.0, 100.0, 2.0 * forced, None


def linked(law="mixed", dtype="float64", device="cpu"):
    """Two cubes with springs of all kinds between them, to the ground and under one, and a hinge."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    soft = wf.SVK(E=1e5, nu=0.3, density=1000.0)
    first = b.add_solid(CUBE, material=soft, name="first")
    second = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), origin=(0.2, 0, 0), element="T10"),
                         material=soft, name="second")  # fmt: skip
    hinge = b.add_joint("revolute", parent=first.surface("x+"), child=second.surface("x-"), anchor=(0.15, 0.05, 0.05),
                        axis=(1, 2, 2))  # fmt: skip
    b.add_torsion_spring(hinge, stiffness=0.7, damping=0.05, rest=0.3, name="torsion")
    b.add_spring(first.at((0.1, 0.1, 0.1)), second.at((0.2, 0.03, 0.04)), stiffness=40.0, damping=0.5, rest=0.05,
                 name="line")  # fmt: skip
    samples = ([0.05, 0.2, 0.26, 0.4], [-3.0, -1.0, 2.0, 4.0])
    b.add_spring(first.surface("z+"), second.nodes("z-"), law=samples, damping=0.3, name="sampled")
    b.add_spring(second.at((0.3, 0.0, 0.0)), (0.35, -0.2, 0.2), law=hardening, name="own")
    b.add_bushing(first.surface("x-"), second.surface("x-"), stiffness=(30, 50, 20, 0.5, 0.4, 0.2),
                  damping=(0.3, 0.2, 0.4, 1e-3, 2e-3, 3e-3), axes=TILTED, name="bushing")  # fmt: skip
    if law == "mixed":
        b.add_foundation(first.surface("z-"), stiffness=2e3, damping=20.0, name="bed")
        b.add_point_mass(first.at((0.02, 0.03, 0.04)), 0.5, inertia=1e-3)
    return b.finalize(device=device, dtype=dtype), (first, second)
