"""Bodies whose constants differ between worlds, and the bits of one world's state."""

from dataclasses import replace

import numpy as np

import warpfea as wf

E, NU, ETA = np.array([1e6, 2.1e6, 0.7e6]), np.array([0.3, 0.45, 0.2]), np.array([30.0, 0.0, 77.0])
RHO = np.array([1100.0, 2530.0, 870.0])
VALUES = {"E": E, "nu": NU, "eta": ETA, "density": RHO}
SVK, NEO, RIVLIN = wf.SVK.from_E_nu, wf.NeoHookean.from_E_nu, wf.MooneyRivlin.from_E_nu


def material(law=SVK, E=1e6, nu=0.3, eta=30.0, density=1100.0, form="incremental"):
    return law(E=E, nu=nu, density=density, damping=wf.KelvinVoigt(eta, 20.0, form))


def solid(element="T10", bulge=0.0, **options):
    def add(b, law):
        mesh = wf.mesh.box((0.1, 0.02, 0.02), cells=(3, 1, 1), element="T4" if element == "ENMC" else element)
        if bulge:
            x = mesh.points
            mesh = replace(mesh, points=x + bulge * np.sin(np.pi * x[:, :1] / 0.1) * [0.0, 0.0, 1.0])
        more = {"element": element} if element == "ENMC" else {}
        body = b.add_solid(mesh, material=law, name="body", **more, **options)
        b.clamp(body.nodes("x-"), slots="all")
        b.add_probe("tip", body.surface("x+"))

    return add


def beam(integration="tied"):
    def add(b, law):
        body = b.add_beam([(0, 0, 0), (0.1, 0, 0)], elements=3, section=wf.Rectangle(0.01, 0.02), normal=(0, 0, 1),
                          material=law, integration=integration, name="body")  # fmt: skip
        b.clamp(body.start, slots="all")
        b.add_probe("tip", body.end)

    return add


def shell(integration="tied"):
    def add(b, law):
        body = b.add_shell(wf.mesh.grid((0.1, 0.05), cells=(3, 2)), thickness=0.01, material=law,
                           integration=integration, name="body")  # fmt: skip
        b.clamp(body.edge("x-"), slots="all")
        b.add_probe("tip", body.edge("x+"))

    return add


def model(add, law, worlds=1, dtype="float64", gravity=(0.0, 3.0, -9.81)):
    b = wf.ModelBuilder(gravity=gravity)
    add(b, law)
    return b.finalize(device="cpu", worlds=worlds, dtype=dtype)


def varied(add, worlds=3, names=tuple(VALUES), dtype="float64", **law):
    out = model(add, material(**law), worlds, dtype)
    for name in names:
        out.set_parameter(f"body.{name}", VALUES[name])
    return out


def rows(sim, world):
    return {name: values[world].tobytes() for name, values in sim.state.numpy().items() if name != "status"}


CASES = {
    "T4": (solid("T4"), {}),
    "T10": (solid(), {"law": NEO}),
    "curved T10": (solid(bulge=0.004), {"law": RIVLIN}),
    "T10 rate": (solid(), {"form": "rate"}),
    "T10 explicit": (solid(), {"form": "explicit"}),
    "ENMC": (solid("ENMC"), {}),
    "3243": (beam(), {}),
    "3243 split": (beam("split"), {}),
    "3243 full": (beam("full"), {"law": RIVLIN}),
    "3443": (shell(), {}),
    "3443 full": (shell("full"), {"law": NEO}),
}
