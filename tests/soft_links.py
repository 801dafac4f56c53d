"""Soft links on hinges and bars with loads that jump, for generalized-alpha."""

import numpy as np
import warp as wp

import warpfea as wf

EXACT = wf.NewtonPCG(tol=1e-12)


def links(count, gravity=(0, 0, -9.81), E=1e4, drive=None, damping=None):
    """Soft T10 links on hinges along y, and what makes their initial velocities those of a turn."""
    b = wf.ModelBuilder(gravity=gravity)
    law = wf.SVK(E=E, nu=0.3, density=1000.0, damping=damping)
    bodies = [
        b.add_solid(wf.mesh.box((0.2, 0.05, 0.05), cells=(2, 1, 1), origin=(0.2 * k, -0.05 * k, 0)), material=law)
        for k in range(count)
    ]
    anchor = np.array([0.025, 0, 0.025])
    hold = bodies[0].nodes(lambda X: X[:, 0] < 0.051)
    b.add_joint("revolute", parent=wf.GROUND, child=hold, anchor=anchor, axis=(0, 1, 0), drive=drive, name="pivot")
    if count > 1:
        ends = bodies[0].nodes(lambda X: X[:, 0] > 0.149), bodies[1].nodes(lambda X: X[:, 0] < 0.251)
        b.add_joint("revolute", parent=ends[0], child=ends[1], anchor=(0.2, 0, 0.025), axis=(0, 1, 0), name="elbow")
    b.add_probe("tip", bodies[-1].surface("x+"))
    return b, bodies, anchor


def turning(model, bodies, anchor, omega):
    """A state in which the bodies turn about y."""
    state = model.state()
    v = state.velocity.numpy()
    for body in bodies:
        X = body.reference + body.origin
        v[0, body.slot_offset : body.slot_offset + len(X)] = np.cross([0, omega, 0], X - anchor)
    state.velocity.assign(v)
    return state


@wp.func
def swing(t: wp.float64) -> wp.float64:
    return wp.float64(0.25) * wp.sin(wp.float64(20.0) * t) + wp.float64(20.0) * t * t + wp.float64(800.0) * t * t * t


def double_pendulum():
    b, bodies, anchor = links(2)
    model = b.finalize(device="cpu")
    return model, turning(model, bodies, anchor, 5.0)


JUMP = 0.004


def pulled(load):
    """A clamped bar whose end is pulled by a load that jumps, or whose root is driven with a speed that jumps."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    bar = b.add_solid(wf.mesh.box((0.2, 0.05, 0.05), cells=(2, 1, 1)), material=wf.SVK(E=1e4, nu=0.3, density=1000.0))
    if load:
        b.clamp(bar.nodes("x-"))
        law = ([0, JUMP, JUMP + 1e-9, 1], [(0, 0, 0), (0, 0, 0), (200, 0, 50), (200, 0, 50)])
        b.add_traction(bar.surface("x+"), law)
    else:
        b.drive(bar.nodes("x-"), displacement=([0, JUMP, 1], [(0, 0, 0), (1e-3, 0, 0), (1e-3, 0, 0)]))
    b.add_probe("tip", bar.surface("x+"))
    b.add_probe("root", bar.surface("x-"))
    return b.finalize(device="cpu")
