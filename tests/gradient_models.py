"""Runs whose gradients are compared with differences: all points of the differences are worlds of one run."""

import numpy as np

import warpfea as wf

LENGTHS = (1e-2, 3e-3, 1e-3)
POINTS = np.array([-2.0, -1.0, 1.0, 2.0])
WEIGHTS = np.array([1.0, -8.0, 8.0, -1.0]) / 12.0
SOLVER = wf.NewtonPCG(tol=1e-12)
LAW = wf.SVK(E=1e6, nu=0.3, density=1000.0)
TARGET = 0.01


def shifts(count):
    """(1 + count x lengths x 4, count) multiples of the scale of each parameter; world 0 has none."""
    rows = [np.zeros(count)]
    for k in range(count):
        rows += [length * point * np.eye(count)[k] for length in LENGTHS for point in POINTS]
    return np.array(rows)


def best_differences(values, exact):
    """Smallest relative error of four-point differences of values (worlds,) of `shifts`, per parameter."""
    table = values[1:].reshape(len(exact), len(LENGTHS), 4)
    found = (table @ WEIGHTS) / np.array(LENGTHS)
    return np.abs(found / np.asarray(exact)[:, None] - 1.0).min(axis=1)


def linked(kind, worlds=1, device="cpu", law=LAW):
    """Two bars of T4 on joints, with controls of drives and loads."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    bars = [
        b.add_solid(
            wf.mesh.box((0.1, 0.02, 0.02), cells=(2, 1, 1), element="T4"),
            transform=(np.eye(3), (x, 0, 0)),
            material=law,
            name=name,
        )
        for x, name in ((0.0, "a"), (0.1, "b"))
    ]
    first, second = bars
    pair = {"parent": first.surface("x+"), "child": second.surface("x-"), "anchor": (0.1, 0.01, 0.01)}
    if kind == "motor":
        start = {"parent": wf.GROUND, "child": first.surface("x-"), "anchor": (0, 0.01, 0.01), "axis": (0, 1, 0)}
        b.add_joint("revolute", drive=wf.Control("motor"), **start)
        b.add_joint("revolute", axis=(0, 1, 0), **pair)
    elif kind == "springs":
        start = {"parent": wf.GROUND, "child": first.surface("x-"), "anchor": (0, 0.01, 0.01), "axis": (0, 1, 0)}
        b.add_joint("revolute", **start, stiffness=0.3, damping=2e-3, name="hip")
        b.add_actuator("hip", wf.PD(kp=0.5, kd=5e-3, target=wf.Control("aim"), limit=10.0), name="servo")
        stop = wf.Stop(-1.0, -0.02, stiffness=2.0, damping=3e-3)
        b.add_joint("revolute", axis=(0, 1, 0), **pair, limits=stop, name="knee")
        b.add_actuator("knee", wf.Control("torque"), name="motor")
        b.add_actuator("knee", wf.PD(kp=1.0, kd=0.01, target=1.0, limit=0.03), name="weak")
        end = second.at((0.2, 0.01, 0.01))
        b.add_spring((0.25, 0.01, 0.1), end, stiffness=20.0, damping=0.1, rest=0.08, name="s")
        b.add_foundation(first.surface("z-"), stiffness=2e4, damping=30.0, name="bed")
    elif kind == "friction":
        start = {"parent": wf.GROUND, "child": first.surface("x-"), "anchor": (0, 0.01, 0.01), "axis": (0, 1, 0)}
        b.add_joint("revolute", **start, friction=0.05, name="hip")
        b.add_joint("revolute", axis=(0, 1, 0), **pair, friction=1e-3, name="knee")
        b.add_bushing(second.surface("x+"), wf.GROUND, name="mount", stiffness=(20, 30, 10, 0.02, 0.03, 0.04),
                      damping=(0.1, 0.2, 0.3, 1e-3, 1.2e-3, 1.5e-3))  # fmt: skip
    elif kind == "loads":
        b.clamp(first.nodes("x-"))
        b.add_joint("spherical", **pair)
        rod = wf.Control("rod", initial=float(np.hypot(0.04, 0.29)))
        b.add_joint(
            "distance", parent=wf.GROUND, child=second.at((0.2, 0.01, 0.01)), anchor=(0.2, 0.05, 0.3), drive=rod
        )
        b.add_traction(second.surface("x+"), wf.Control("pull", 3))
        b.add_point_load(first.at((0.1, 0.01, 0.01)), force=wf.Control("pull", 3))
    elif kind == "followers":
        b.clamp(first.nodes("x-"))
        b.add_joint("spherical", **pair)
        b.add_pressure(second.surface("z-"), wf.Control("pressure"))
        b.add_moment(first.at((0.1, 0.01, 0.01)), wf.Control("moment", 3))
    else:
        turn = wf.Rotation(anchor=(0.2, 0.01, 0.01), axis=(1, 0.3, 0), angle=wf.Control("turn"))
        b.drive(first.nodes("x-"), displacement=wf.Control("shift", 3))
        b.drive(second.nodes("x+"), rotation=turn)
        b.add_joint("fixed", **pair)
    b.add_probe("tip", second.at((0.2, 0.0, 0.02)) if kind != "drives" else second.surface("x-"))
    return b.finalize(device=device, worlds=worlds, many=False)


def controls(kind, steps):
    """Values (steps, size) of the controls of `linked`, and their scales."""
    ramp, rng = np.linspace(0.0, 1.0, steps)[:, None], np.random.default_rng(0)
    return {
        "motor": {"motor": 0.3 * ramp},
        "loads": {"pull": 10.0 * rng.standard_normal((steps, 3)), "rod": np.hypot(0.04, 0.29) + 0.002 * ramp},
        "springs": {"aim": 0.1 * ramp + 0.05, "torque": 0.002 * rng.standard_normal((steps, 1))},
        "followers": {"pressure": 500.0 + 500.0 * ramp, "moment": 0.02 * rng.standard_normal((steps, 3))},
        "drives": {"shift": 0.01 * ramp * np.ones(3), "turn": 0.4 * ramp},
    }.get(kind, {})


def bar(change=lambda b, box: None, law=LAW, gravity=(0, 0, -9.81)):
    """A model of one bar of T4."""
    b = wf.ModelBuilder(gravity=gravity)
    box = b.add_solid(wf.mesh.box((0.1, 0.02, 0.02), cells=(2, 1, 1), element="T4"), material=law, name="box")
    change(b, box)
    b.add_probe("tip", box.surface("x+"))
    return b.finalize(device="cpu")
