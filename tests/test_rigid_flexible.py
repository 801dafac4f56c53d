"""A rigid and a flexible link against equations of motion that are written down here, and integrated by scipy."""

import numpy as np
from scipy.integrate import solve_ivp

import warpfea as wf
from warpfea.mesh import Mesh

TIP, GRAVITY = np.array([0.5, 0.0, 0.0]), np.array([0.0, 0.0, -9.81])
NODES = np.array([TIP, (0.9, -0.15, 0.05), (0.9, 0.1, -0.1), (0.8, 0.05, 0.2)])
RUBBER = wf.SVK(E=2e3, nu=0.3, density=200.0)


def reference(inertia, mass, com, t_end):
    """Turn of the link (3, 3) and deformation gradient of a tetrahedron that hangs from its tip, at the end.

    The link turns by w about the origin; the tetrahedron has the positions x + F d of its vertices, x the tip, with the
    momentum m x' + F' s, and d/dt (x' s^T + F' D) = g s^T - V P(F) by Lagrange's equations of F.
    """
    d = NODES - TIP
    V = np.linalg.det(d[1:]) / 6.0
    weight = RUBBER.density * V
    s, D = weight / 4.0 * d.sum(axis=0), weight / 20.0 * (d.T @ d + np.outer(d.sum(axis=0), d.sum(axis=0)))
    inverse, beta = np.linalg.inv(D), s @ np.linalg.solve(D, s)
    lam, mu = RUBBER.lame
    about = inertia + mass * (com @ com * np.eye(3) - np.outer(com, com))

    def rate(_, y):
        A, w, F, dF = y[:9].reshape(3, 3), y[9:12], y[12:21].reshape(3, 3), y[21:].reshape(3, 3)
        E = 0.5 * (F.T @ F - np.eye(3))
        elastic = V * F @ (lam * np.trace(E) * np.eye(3) + 2.0 * mu * E)
        x, J = A @ TIP, A @ about @ A.T
        whirl = np.cross(w, np.cross(w, x))
        force = (weight - beta) * (GRAVITY - whirl) + elastic @ inverse @ s
        torque = np.cross(A @ com, mass * GRAVITY) + np.cross(x, force) - np.cross(w, J @ w)
        dw = np.linalg.solve(J + (weight - beta) * (x @ x * np.eye(3) - np.outer(x, x)), torque)
        ddF = (np.outer(GRAVITY - np.cross(dw, x) - whirl, s) - elastic) @ inverse
        return np.concatenate([np.cross(w, A.T).T.ravel(), dw, dF.ravel(), ddF.ravel()])

    start = np.concatenate([np.eye(3).ravel(), np.zeros(3), np.eye(3).ravel(), np.zeros(9)])
    y = solve_ivp(rate, (0.0, t_end), start, "DOP853", rtol=1e-11, atol=1e-12).y[:, -1]
    return y[:9].reshape(3, 3), y[12:21].reshape(3, 3)


def test_rigid_flexible_double_pendulum():
    """From rest, level, to stretches of 0.7 and 1.6: vertices within 1e-4 m at h = 1e-3 s, of second order."""
    t_end, errors = 0.5, []
    for h in (2e-3, 1e-3):
        b = wf.ModelBuilder(gravity=GRAVITY)
        link = b.add_rigid(wf.Box((0.25, 0, 0), (0.5, 0.05, 0.05)), density=400.0)
        body = b.add_solid(Mesh(NODES, np.array([[0, 1, 2, 3]]), "tetra"), material=RUBBER)
        b.add_joint("spherical", parent=wf.GROUND, child=link.at((0, 0, 0)))
        b.add_joint("spherical", parent=link.at(TIP), child=body.at(TIP))
        sim = wf.Simulation(b.finalize(device="cpu"), dt=h, integrator="energy_momentum",
                            solver=wf.NewtonPCG(tol=1e-11), constraint_tol=1e-12)  # fmt: skip
        sim.run(t_end)
        A, F = reference(link.inertia, link.mass, link.com, t_end)
        errors.append(np.abs(sim.positions(body)[0] - (A @ TIP + (NODES - TIP) @ F.T)).max())
    stretch = np.linalg.svd(F, compute_uv=False)
    assert np.abs(stretch - 1.0).max() > 0.5, stretch
    assert errors[1] < 1e-4, errors
    assert errors[0] / errors[1] > 3.5, errors
