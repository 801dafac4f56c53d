"""Wrong input is refused at once: the right class, and a text that names the entity and the value."""

import numpy as np
import pytest
import warp as wp

import warpfea as wf

LAW = wf.SVK(E=1e6, nu=0.3, density=1000.0)
MESH = wf.mesh.box((1, 0.5, 0.5), cells=(2, 1, 1))


def start(material=LAW, **options):
    b = wf.ModelBuilder()
    return b, b.add_solid(MESH, material=material, name="bar", **options)


def model_of(**options):
    b, body = start()
    b.clamp(body.nodes("x-"))
    return b.finalize(device="cpu", **options)


def static_of(prepare):
    b, body = start()
    prepare(b, body)
    return wf.solve_static(b.finalize(device="cpu"))


def other_body():
    return start()[1]


def build(action):
    b, body = start()
    action(b, body)


CASES = {
    "E negative": (lambda: wf.SVK(E=-1.0, nu=0.3), wf.ModelError, r"E = -1.0"),
    "E zero": (lambda: wf.SVK(E=0.0, nu=0.3), wf.ModelError, r"E = 0.0"),
    "E nan": (lambda: wf.SVK(E=float("nan"), nu=0.3), wf.ModelError, r"E = nan"),
    "E text": (lambda: wf.SVK(E="7e8", nu=0.3), wf.ModelError, r"E = '7e8'"),
    "nu half": (lambda: wf.SVK(E=1.0, nu=0.5), wf.ModelError, r"nu = 0.5"),
    "nu of neo-Hookean": (lambda: wf.NeoHookean.from_E_nu(E=1.0, nu=0.6), wf.ModelError, r"nu = 0.6"),
    "k negative": (lambda: wf.MooneyRivlin(mu10=1.0, mu01=1.0, k=-2.0), wf.ModelError, r"k = -2.0"),
    "mu01 negative": (lambda: wf.MooneyRivlin(mu10=1.0, mu01=-1.0, k=2.0), wf.ModelError, r"mu01 = -1.0"),
    "mu negative": (lambda: wf.NeoHookean(mu=-3.0, k=2.0), wf.ModelError, r"mu = -3.0"),
    "density zero": (lambda: wf.SVK(E=1.0, nu=0.3, density=0.0), wf.ModelError, r"density = 0.0"),
    "density length": (
        lambda: start(wf.SVK(E=1.0, nu=0.3, density=np.ones(5))), wf.ModelError, r"'bar'.* 5 values for 12 elements"),
    "density function": (
        lambda: start(wf.SVK(E=1.0, nu=0.3, density=lambda X: -X[:, 0])), wf.ModelError, r"'bar'.*density f\(X\)"),
    "viscosity negative": (lambda: wf.KelvinVoigt(-1.0), wf.ModelError, r"eta = -1.0"),
    "damping form": (lambda: wf.KelvinVoigt(1.0, form="magic"), wf.ModelError, r"form = 'magic'"),
    "gravity nan": (lambda: wf.ModelBuilder(gravity=(0, 0, np.nan)), wf.ModelError, r"gravity"),
    "gravity short": (lambda: wf.ModelBuilder(gravity=(0, 9.81)), wf.ModelError, r"gravity = \(0, 9.81\)"),
    "up axis": (lambda: wf.ModelBuilder(up_axis="X"), wf.ModelError, r"up_axis = 'X'"),
    "no such file": (lambda: build(lambda b, _: b.add_solid("no.msh", material=LAW)), wf.MeshError, r"no\.msh"),
    "mesh type": (lambda: build(lambda b, _: b.add_solid(3, material=LAW)), wf.ModelError, r"got int"),
    "material type": (lambda: start("steel"), wf.ModelError, r"'bar'.*'steel'"),
    "material group": (lambda: start({"arm": LAW}), wf.ModelError, r"'bar'.*'arm'"),
    "unknown element": (lambda: start(element="T11"), wf.ModelError, r"'T11' is unknown.*T10"),
    "wrong element": (lambda: start(element="T4"), wf.ModelError, r"'bar'.*T4 needs tetra cells"),
    "quadrature": (lambda: start(quadrature="tet99"), wf.ModelError, r"'tet99'.*tet4"),
    "name twice": (lambda: build(lambda b, _: b.add_solid(MESH, material=LAW, name="bar")), wf.ModelError, r"'bar' is"),
    "initial shape": (lambda: start(initial=np.zeros((3, 3))), wf.ModelError, r"'bar': initial.*\(3, 3\)"),
    "initial nan": (lambda: start(initial=MESH.points * np.nan), wf.ModelError, r"'bar': initial: node 0"),
    "node group": (lambda: build(lambda b, s: b.clamp(s.nodes("top"))), wf.MeshError, r"'top'.*x-"),
    "surface group": (lambda: build(lambda b, s: b.add_pressure(s.surface("up"), 1.0)), wf.MeshError, r"'up'.*x-"),
    "element group": (lambda: build(lambda b, s: s.elements("core")), wf.MeshError, r"'core'"),
    "empty selection": (
        lambda: build(lambda b, s: b.clamp(s.nodes(lambda X: X[:, 0] > 9))), wf.ModelError, r"'bar' is empty"),
    "point outside": (lambda: build(lambda b, s: s.at((3, 0, 0))), wf.ModelError, r"'bar': point \[3.0, 0.0, 0.0\]"),
    "point nan": (lambda: build(lambda b, s: s.at((np.nan, 0, 0))), wf.ModelError, r"'bar'.*finite"),
    "foreign body": (lambda: build(lambda b, s: b.clamp(other_body().nodes("x-"))), wf.ModelError, r"another builder"),
    "clamp of a body": (lambda: build(lambda b, s: b.clamp("x-")), wf.ModelError, r"clamp: expected a handle.*'x-'"),
    "components": (
        lambda: build(lambda b, s: b.clamp(s.nodes("x-"), components="xw")), wf.ModelError, r"components = 'xw'"),
    "clamp slots": (lambda: build(lambda b, s: b.clamp(s.nodes("x-"), slots="some")), wf.ModelError, r"slots = 'some'"),
    "traction nan": (
        lambda: build(lambda b, s: b.add_traction(s.surface("x+"), (0, 0, np.nan))), wf.ModelError, r"traction.*nan"),
    "force shape": (
        lambda: build(lambda b, s: b.add_point_load(s.at((1, 0, 0)), 5.0)), wf.ModelError, r"point load on 'bar'"),
    "pressure vector": (
        lambda: build(lambda b, s: b.add_pressure(s.surface("x+"), (1, 2, 3))), wf.ModelError, r"pressure on 'x\+'"),
    "times that fall": (
        lambda: build(lambda b, s: b.add_pressure(s.surface("x+"), ([0, 2, 1], [0, 1, 2]))), wf.ModelError, r"increas"),
    "values per time": (
        lambda: build(lambda b, s: b.add_pressure(s.surface("x+"), ([0, 1], [0, 1, 2]))), wf.ModelError, r"\(3,\)"),
    "python function": (
        lambda: build(lambda b, s: b.add_pressure(s.surface("x+"), lambda t: t)), wf.ModelError, r"wp\.func"),
    "field": (lambda: build(lambda b, s: b.add_body_force((0, 0, 1))), wf.ModelError, r"wp\.func, got \(0, 0, 1\)"),
    "drive of nothing": (lambda: build(lambda b, s: b.drive(s.nodes("x+"))), wf.ModelError, r"'x\+'.*either"),
    "drive axis": (
        lambda: build(lambda b, s: b.drive(s.nodes("x+"), rotation=wf.Rotation((0, 0, 0), (0, 0, 0), 1.0))),
        wf.ModelError, r"axis is zero"),
    "drive table": (
        lambda: build(lambda b, s: b.drive(s.nodes("x+"), displacement=([0, 1], np.zeros((2, 4, 3))))),
        wf.ModelError, r"\(2, 4, 3\), expected \(2, 9, 3\)"),
    "velocity shape": (
        lambda: build(lambda b, s: b.set_initial(s, velocity=np.zeros((2, 3)))), wf.ModelError, r"'bar': velocity"),
    "probe twice": (
        lambda: build(lambda b, s: [b.add_probe("p", s.nodes("x+")) for _ in "ab"]), wf.ModelError, r"probe 'p'"),
    "clamp of a surface": (
        lambda: build(lambda b, s: b.clamp(s.surface("x-"))), wf.ModelError, r"clamp: expected nodes.*got a surface"),
    "pressure on nodes": (
        lambda: build(lambda b, s: b.add_pressure(s.nodes("x-"), 1.0)), wf.ModelError, r"expected a surface.*'bar'"),
    "supports that differ": (
        lambda: static_of(lambda b, s: [b.clamp(s.nodes("x-")), b.drive(s.nodes("x-"), displacement=(0, 0, 1))]),
        wf.ModelError, r"'bar': two supports prescribe component x of node \d+"),
    "foreign state": (
        lambda: wf.Simulation(model_of(), model_of(dtype="float32").state(), dt=1.0), wf.ModelError, r"state is of"),
    "empty model": (lambda: wf.ModelBuilder().finalize(device="cpu"), wf.ModelError, r"no body"),
    "device": (lambda: model_of_device("tpu:7"), wf.ModelError, r"device 'tpu:7'.*cpu"),
    "dtype": (lambda: model_of(dtype="float16"), wf.ModelError, r"'float16'"),
    "worlds": (lambda: model_of(worlds=0), wf.ModelError, r"worlds = 0"),
    "dt zero": (lambda: wf.Simulation(model_of(), dt=0.0), wf.ModelError, r"dt = 0.0"),
    "dt negative": (lambda: wf.Simulation(model_of(), dt=-1e-3), wf.ModelError, r"dt = -0.001"),
    "dt nan": (lambda: wf.Simulation(model_of(), dt=float("nan")), wf.ModelError, r"dt = nan"),
    "integrator": (lambda: wf.Simulation(model_of(), dt=1.0, integrator="rk4"), wf.ModelError, r"'rk4'.*bdf2"),
    "preconditioner": (
        lambda: wf.Simulation(model_of(), dt=1.0, solver=wf.NewtonPCG(preconditioner="ilu")), wf.ModelError, r"'ilu'"),
    "tolerance": (lambda: wf.NewtonPCG(tol=2.0), wf.ModelError, r"tol = 2.0"),
    "max_newton": (lambda: wf.NewtonPCG(max_newton=0), wf.ModelError, r"max_newton = 0"),
    "load steps": (lambda: wf.solve_static(model_of(), load_steps=0), wf.ModelError, r"load_steps = 0"),
    "load steps by name": (lambda: wf.solve_static(model_of(), load_steps="all"), wf.ModelError, r"'all' .* or 'auto'"),
    "static unsupported": (lambda: static_of(lambda b, s: None), wf.ModelError, r"'bar' has 6 unconstrained rigid"),
    "static hinge": (
        lambda: static_of(lambda b, s: b.clamp(s.nodes(lambda X: (X[:, 0] < 1e-9) & (X[:, 1] < 1e-9)))),
        wf.ModelError, r"'bar' has 1 unconstrained rigid"),
    "all clamped": (
        lambda: static_of(lambda b, s: b.clamp(s.nodes(lambda X: X[:, 0] > -1))), wf.ModelError, r"nothing is left"),
    "gravity per world": (lambda: model_of(worlds=3).set_gravity(np.zeros((2, 3))), wf.ModelError, r"\(2, 3\)"),
}  # fmt: skip


def model_of_device(device):
    b, _ = start()
    return b.finalize(device=device)


@pytest.mark.parametrize("case", CASES, ids=[c.replace(" ", "-") for c in CASES])
def test_bad_input(case, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    action, kind, text = CASES[case]
    with pytest.raises(kind, match=text):
        action()
    assert list(tmp_path.iterdir()) == []


LATER = {"add_contact": lambda b, s: b.add_contact(s)}


@pytest.mark.parametrize("name", LATER)
def test_later_parts_say_so(name):
    with pytest.raises(NotImplementedError, match=name):
        build(LATER[name])


def test_functions_of_the_wrong_precision_are_understood():
    @wp.func
    def single(x: wp.vec3f, t: wp.float32) -> wp.vec3f:
        return wp.vec3f(1.0, 0.0, 0.0)

    b, body = start()
    b.add_body_force(single)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    sim.step()
    assert sim.velocities(body)[0, 0, 0] == pytest.approx(1e-3, rel=1e-6)
