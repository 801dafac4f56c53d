"""Modes of vibration and of buckling against closed forms."""

import numpy as np
import pytest
import scipy.linalg
import warp as wp
from scipy.integrate import solve_bvp
from scipy.optimize import brentq
from spring_models import oscillator

import warpfea as wf
from warpfea.outputs import animation

E, RHO = 2e9, 1000.0
LAW = wf.SVK(E=E, nu=0.0, density=RHO)
WIDTH, HEIGHT = 0.02, 0.01


def beam(elements, curve=((0, 0, 0), (1, 0, 0)), section=(WIDTH, HEIGHT), law=LAW):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_beam(
        curve, elements=elements, section=wf.Rectangle(*section), normal=(0, 0, 1), material=law, name="b"
    )
    return b, body


def bending(k, h, length=1.0):
    """Hz of a slender beam with wave number k / length."""
    return (k / length) ** 2 * np.sqrt(E * h**2 / 12.0 / RHO) / (2.0 * np.pi)


def test_cantilever_and_its_effective_mass():
    b, body = beam(8)
    b.clamp(body.start, slots="all")
    found = wf.modes(b.finalize(device="cpu"), count=4)
    expected = [bending(k, h) for k in (1.8751041, 4.6940911) for h in (HEIGHT, WIDTH)]
    assert found.frequencies == pytest.approx(expected, rel=3e-3)
    assert found.rigid_body_modes == 0
    mass = RHO * WIDTH * HEIGHT
    for mode, axis, share in ((0, 2, 0.6131), (1, 1, 0.6131), (2, 2, 0.1883)):
        assert found.effective_mass[mode, axis] == pytest.approx(share * mass, rel=2e-3)
    tip = found.shape(body)[:, -1]
    assert np.abs(tip[:2]) == pytest.approx(np.array([(0, 0, 1), (0, 1, 0)]), abs=1e-6)
    every = wf.modes(b.finalize(device="cpu"), count=200)  # all of them
    moved = every.effective_mass.sum(axis=0)[:3]
    assert 0.95 * mass < moved.min()
    assert moved.max() < mass


def test_welded_beams_vibrate_as_one():
    """Two halves of the cantilever, tied by a weld; without it the second is free."""
    b, first = beam(4, curve=((0, 0, 0), (0.5, 0, 0)))
    section, curve = wf.Rectangle(WIDTH, HEIGHT), ((0.5, 0, 0), (1, 0, 0))
    second = b.add_beam(curve, elements=4, section=section, normal=(0, 0, 1), material=LAW, name="c")
    b.clamp(first.start, slots="all")
    assert wf.modes(b.finalize(device="cpu"), count=8).rigid_body_modes == 6
    b.weld(second.start, first)
    found = wf.modes(b.finalize(device="cpu"), count=4)
    assert found.rigid_body_modes == 0
    expected = [bending(k, h) for k in (1.8751041, 4.6940911) for h in (HEIGHT, WIDTH)]
    assert found.frequencies == pytest.approx(expected, rel=3e-3)
    ends = [found.shape(body)[:, node] for body, node in ((first, -1), (second, 0))]
    assert ends[0] == pytest.approx(ends[1], abs=1e-6)  # the halves move together
    assert np.abs(found.shape(second)[0, -1, 2]) == pytest.approx(1.0, abs=1e-6)


def test_free_beam_by_both_methods_has_six_rigid_body_modes():
    expected = [bending(4.7300407, h) for h in (HEIGHT, WIDTH)]
    for elements in (12, 40):  # all eigenvalues, and Lanczos' method
        b, _ = beam(elements)
        found = wf.modes(b.finalize(device="cpu"), count=8)
        assert found.rigid_body_modes == 6
        assert (found.frequencies[:6] == 0.0).all()
        assert found.frequencies[6:] == pytest.approx(expected, rel=3e-3)
        assert np.isnan(found.damping_ratios[:6]).all()
        mass = RHO * WIDTH * HEIGHT
        assert found.effective_mass[:6].sum(axis=0)[:3] == pytest.approx(mass, rel=1e-8)
        near = wf.modes(b.finalize(device="cpu"), count=1, shift=1.1 * expected[1])
        assert near.frequencies == pytest.approx(expected[1:], rel=3e-3)


def test_supported_plate_converges():
    errors = []
    for cells in (4, 8):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        law = wf.SVK(E=E, nu=0.3, density=RHO)
        plate = b.add_shell(wf.mesh.grid((1, 1), cells=(cells, cells)), thickness=0.01, material=law)
        edges = plate.nodes(lambda X: (np.abs(X[:, :2] - 0.5) > 0.5 - 1e-9).any(axis=1))
        b.clamp(edges, slots="position", components="z")
        b.clamp(plate.nodes(lambda X: (X[:, 0] < 1e-9) & (X[:, 1] < 1e-9)), slots="position", components="xy")
        b.clamp(plate.nodes(lambda X: (X[:, 0] > 1 - 1e-9) & (X[:, 1] < 1e-9)), slots="position", components="y")
        found = wf.modes(b.finalize(device="cpu"), count=3)
        first = np.pi / 2.0 * np.sqrt(E * 0.01**2 / 12.0 / (1.0 - 0.3**2) / RHO)
        errors.append(np.abs(found.frequencies / (first * np.array([2.0, 5.0, 5.0])) - 1.0).max())
    assert errors[1] < 0.01
    assert errors[0] > 3.0 * errors[1]


def test_closed_ring():
    """Love: omega^2 = EI n^2 (n^2 - 1)^2 / (rho A (n^2 + 1)) in the plane, n^2 + EI/GJ for n^2 + 1 out of it."""
    b, ring = beam(32, lambda s: np.array([np.cos(2 * np.pi * s), np.sin(2 * np.pi * s), 0.0]))
    b.add_joint("fixed", parent=ring.end, child=ring.start)
    found = wf.modes(b.finalize(device="cpu"), count=14)
    assert found.rigid_body_modes == 6
    n = np.array([2.0, 3.0, 4.0])
    twist = 2.0 * HEIGHT**3 * WIDTH / 12.0 / (0.229 * WIDTH * HEIGHT**3)  # EI / GJ
    out = np.sqrt(E * HEIGHT**2 / 12 / RHO * n**2 * (n**2 - 1) ** 2 / (n**2 + twist))
    plane = np.sqrt(E * WIDTH**2 / 12 / RHO * n**2 * (n**2 - 1) ** 2 / (n**2 + 1))
    expected = np.sort(np.repeat([*out, plane[0]], 2)) / (2 * np.pi)
    assert found.frequencies[6:] == pytest.approx(expected, rel=5e-3)


def test_spinning_string_has_its_prestress():
    """Flapping of a chain hinged on its axis, out of the plane of the spin: omega_n^2 = n (2 n - 1) Omega^2."""
    spin, count = 60.0, 24
    b, body = beam(count, section=(1e-3, 1e-3))
    b.clamp(body.start, slots="position")
    model = b.finalize(device="cpu")
    assert wf.modes(model, count=3).rigid_body_modes == 3

    def stretch(P):
        return brentq(lambda F: E * (F**2 - 1) / 2 * F - P, 1.0, 2.0)

    def rates(s, y):
        return np.array([[stretch(max(P, 0.0)) for P in y[1]], -RHO * spin**2 * y[0]])

    s = np.linspace(0, 1, 33)
    start = np.array([s, RHO * spin**2 * (1 - s**2) / 2])
    found = solve_bvp(rates, lambda a, c: np.array([a[0], c[1]]), s, start, tol=1e-9)
    at = np.linspace(0, 1, count + 1)
    state, u = model.state(), np.zeros((1, model.slots, 3))
    u[0, body.slot_kind == 0, 0] = found.sol(at)[0] - at
    along = body.slot_kind == 1
    u[0, along, 0] = (rates(at, found.sol(at))[0] - 1) * body.reference[along, 0]
    state.displacement.assign(u)
    modes = wf.modes(model, state, count=7)
    assert modes.rigid_body_modes == 1  # rolls about itself
    assert modes.eigenvalues[1:3] == pytest.approx(spin**2, rel=1e-5)
    assert modes.eigenvalues[3:5] == pytest.approx(6.0 * spin**2, rel=5e-3)


@pytest.mark.parametrize("density", [1.0, 1e-3, 1e-5])
def test_a_light_beam_carries_a_heavy_part(density):
    """Both planes by the flexibility of the tip, where the beam has up to 1e-11 of the mass."""
    b, body = beam(4, section=(WIDTH, WIDTH), law=wf.SVK(E=E, nu=0.0, density=density))
    b.clamp(body.start, slots="position+section")
    part = b.add_rigid(wf.Box((1.1, 0, 0), (0.2, 0.2, 0.2)), mass=10.0)
    b.weld(body.end, part)
    with pytest.warns(wf.MeshWarning, match="density of SVK"):
        model = b.finalize(device="cpu")
    K = E * WIDTH**4 / 12.0 * np.array([(12.0, -6.0), (-6.0, 4.0)])
    M = np.array([(10.0, 1.0), (1.0, part.inertia[1, 1] + 0.1)])
    squares = scipy.linalg.eigvalsh(K, M)
    found = wf.modes(model, count=5).eigenvalues
    assert found[[0, 1, 3, 4]] == pytest.approx(np.repeat(squares, 2), rel=2e-3)


def test_hinged_chain_hangs_on_its_joint_forces():
    """Two uniform links: omega^2 = (3 -+ 6 / sqrt 7) g / l; without the joint forces nothing restores them."""
    b = wf.ModelBuilder()
    one, two = (
        b.add_rigid(wf.Box((0, 0, z), (1e-4, 1e-4, 1.0)), mass=1.0, inertia=(1 / 12, 1 / 12, 1e-6))
        for z in (-0.5, -1.5)
    )
    b.add_joint("revolute", parent=wf.GROUND, child=one.at((0, 0, 0)), axis=(0, 1, 0))
    b.add_joint("revolute", parent=one.at((0, 0, -1)), child=two.at((0, 0, -1)), axis=(0, 1, 0))
    model = b.finalize(device="cpu")
    assert wf.modes(model).rigid_body_modes == len(wf.modes(model).vectors) == 2
    sim = wf.Simulation(model, dt=1e-3, solver=wf.NewtonPCG(tol=1e-13), constraint_tol=1e-12)
    sim.step(2)
    found = wf.modes(model, sim.state)
    expected = 9.81 * (3.0 + np.array([-6.0, 6.0]) / np.sqrt(7.0))
    assert found.eigenvalues == pytest.approx(expected, rel=1e-7)
    assert "Modes(2: 0.4266, 1.144 Hz)" in repr(found)


@pytest.mark.parametrize("kind", ["length", "torsion", "foundation"])
def test_springs_and_dampers(kind):
    b, mass, k, _, _ = oscillator(kind, 2.0, False)
    found = wf.modes(b.finalize(device="cpu"), count=100)
    mode = np.argmin(np.abs(found.eigenvalues - k / mass))
    assert found.eigenvalues[mode] == pytest.approx(k / mass, rel=1e-6)
    assert found.damping_ratios[mode] == pytest.approx(2.0 / (2.0 * np.sqrt(k / mass)), rel=1e-5)


def test_springs_side_by_side_are_as_one():
    """Also four, whose vectors have 36 components, as many as the beam."""
    found = []
    for count in (2, 4):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        law, section = wf.SVK(E=E, nu=0.0, density=1e3), wf.Rectangle(0.02, 0.02)
        beam = b.add_beam([(0, 0, 0), (1, 0, 0)], elements=2, section=section, normal=(0, 0, 1), material=law)
        b.clamp(beam.start, slots="all")
        for _ in range(count):
            b.add_spring(beam.end, (1, 0, 1), stiffness=1e3 / count)
        found.append(wf.modes(b.finalize(device="cpu"), count=3).frequencies)
    assert found[1] == pytest.approx(found[0], rel=1e-9)


def test_a_small_part_far_from_its_joint_and_springs():
    """1 kg of 1e-14 kg m^2, 0.5 m from a joint with a stiffness, from a ball joint that a spring holds about one axis,
    and from a bushing: sqrt(c/(m l^2)); round-off of the weights of points was 1e-2 of it, and 0 Hz was told."""
    for kind, stiffness, rel in (("revolute", 25.0, 1e-6), ("spherical", 0.0, 1e-6), ("bushing", 1e5, 1e-3)):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        part = b.add_rigid(wf.Box((0.5, 0, 0), (0.1, 0.1, 0.1)), mass=1.0, inertia=(1e-14,) * 3, name="part")
        if kind == "bushing":
            b.add_bushing(wf.GROUND, part.at((0, 0, 0)), stiffness=(stiffness,) * 3 + (25.0,) * 3)
        else:
            axis = {"axis": (0, 0, 1), "stiffness": stiffness} if kind == "revolute" else {}
            b.add_joint(kind, parent=wf.GROUND, child=part.at((0, 0, 0)), **axis)
        if kind == "spherical":
            b.add_spring(part.at((0.5, 0, 0)), (0.5, 1, 0), stiffness=100.0)
        found = wf.modes(b.finalize(device="cpu"), count=3)
        assert found.rigid_body_modes == (2 if kind == "spherical" else 0)
        soft = found.eigenvalues[found.rigid_body_modes :][: 2 if kind == "bushing" else 1]
        exact = 1.0 / (0.01 + 1.0 / stiffness) if kind == "bushing" else 100.0
        assert soft == pytest.approx(exact, rel=rel), kind


def test_material_damping():
    """Kelvin-Voigt stress eta / mu times the elastic one: C = (eta / mu) K."""
    eta, mu = 3e3, E / 2.0
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law = wf.SVK(E=E, nu=0.0, density=RHO, damping=wf.KelvinVoigt(eta=eta, lambda_v=0.0))
    body = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(2, 1, 1)), material=law)
    b.clamp(body.nodes("x-"))
    found = wf.modes(b.finalize(device="cpu"), count=3)
    assert found.damping_ratios == pytest.approx(eta / mu * np.pi * found.frequencies, rel=1e-6)


def test_buckling_takes_the_stress_of_any_law():
    """Sideways buckling of a deep solid is the same with laws of one modulus."""
    found = []
    for law in (wf.SVK(E=2e9, nu=0.0), wf.NeoHookean.from_E_nu(E=2e9, nu=0.0)):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        bar = b.add_solid(wf.mesh.box((1, 0.02, 0.06), cells=(8, 1, 1)), material=law)
        b.clamp(bar.nodes("x-"))
        b.add_traction(bar.surface("x+"), (0, 0, -1.0))
        model = b.finalize(device="cpu")
        found.append(wf.buckling(model, wf.solve_static(model, load_steps=1).state).factors[0])
    assert found[1] == pytest.approx(found[0], rel=1e-3)
    assert found[0] * 0.02 * 0.06 == pytest.approx(403.5, rel=0.25)  # N, Prandtl's; few elements


@pytest.mark.parametrize("load", [0.1, 10.0])
def test_lateral_buckling_of_a_deep_cantilever(load):
    """4.013 sqrt(E Iz G J) / L^2, from a thousandth of it and a ninth, though the sections turn before."""
    E, width, height = 2e9, 0.01, 0.1
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    law, section = wf.SVK(E=E, nu=0.0), wf.Rectangle(width, height)
    beam = b.add_beam([(0, 0, 0), (1, 0, 0)], elements=8, section=section, normal=(0, 0, 1), material=law)
    b.clamp(beam.start, slots="all")
    b.add_point_load(beam.at((1, 0, 0)), (0, 0, -load))
    model = b.finalize(device="cpu")
    torsion = height * width**3 / 3 * (1 - 0.63 * width / height)
    exact = 4.0126 * np.sqrt(E * height * width**3 / 12 * E / 2 * torsion)
    found = wf.buckling(model, wf.solve_static(model, load_steps=1).state)
    assert load * found.factors[0] == pytest.approx(exact, rel=0.01)


@pytest.mark.parametrize(("case", "length"), [("free", 2.0), ("pinned", 1.0), ("propped", 0.699156), ("clamped", 0.5)])
def test_eulers_columns(case, length):
    critical = np.pi**2 * E * WIDTH * HEIGHT**3 / 12.0 / length**2
    b, column = beam(8)
    if case == "pinned":
        b.clamp(column.start, slots="position")
        for end in (column.start, column.end):
            b.clamp(end, slots="all", components="y")
    else:
        b.clamp(column.start, slots="all")
    if case in ("pinned", "propped"):
        b.clamp(column.end, slots="position", components="yz")
    if case == "clamped":
        b.clamp(column.end, slots="all", components="yz")
    b.add_point_load(column.at((1, 0, 0)), (-0.01 * critical, 0, 0))
    model = b.finalize(device="cpu")
    state = wf.solve_static(model, load_steps=1, unstable="ignore").state
    found = wf.buckling(model, state)
    assert 0.01 * found.factors == pytest.approx([1.0], rel=5e-3)
    assert np.abs(found.shape(column)[0]).max() == pytest.approx(1.0)


@pytest.mark.parametrize("elements", [8, 40])  # all eigenvalues, and Lanczos' method
def test_buckling_in_compression_and_none_in_tension(elements):
    b, column = beam(elements)
    b.clamp(column.start, slots="all")
    critical = np.pi**2 * E * WIDTH * HEIGHT**3 / 12.0 / 4.0
    b.add_point_load(column.at((1, 0, 0)), (-0.01 * critical, 0, 0))
    model = b.finalize(device="cpu")
    state = wf.solve_static(model, load_steps=1, unstable="ignore").state
    assert 0.01 * wf.buckling(model, state, count=2).factors == pytest.approx([1.0, 4.0], rel=5e-3)
    state.displacement.assign(-state.displacement.numpy())
    with pytest.raises(wf.ModelError, match="0 modes under this load, 1 asked"):
        wf.buckling(model, state)


def test_a_mode_is_written_and_drawn(tmp_path, monkeypatch):
    b, body = beam(2)
    b.clamp(body.start, slots="all")
    found = wf.modes(b.finalize(device="cpu"), count=2)
    found.write(tmp_path / "mode.usdc", mode=2, size=0.2)
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.Open(str(tmp_path / "mode.usdc"))
    assert stage.GetEndTimeCode() - stage.GetStartTimeCode() == pytest.approx(120)  # 2 s at 60 frames a second
    mesh = UsdGeom.Mesh(stage.GetPrimAtPath("/World/world_0000/b/skin"))
    value = UsdGeom.PrimvarsAPI(mesh).GetPrimvar("displacement")
    assert max(value.Get(t).__len__() and max(value.Get(t)) for t in value.GetTimeSamples()) == pytest.approx(0.2, 1e-3)
    labels = []
    draw = animation.draw_labels
    monkeypatch.setattr(
        animation, "draw_labels", lambda image, text, *more: labels.append(text) or draw(image, text, *more)
    )
    found.write(tmp_path / "mode.png", mode=2, size=0.1)
    assert labels == [f"mode 2, {found.frequencies[1]:.3g} Hz"]
    found.write(tmp_path / "mode.html", mode=2, size=0.2)
    assert f"<title>{found.label(2)}</title>" in (tmp_path / "mode.html").read_text()
    assert (tmp_path / "mode.png").stat().st_size > 1000
    figure = found.plot()
    assert [axis.get_ylabel() for axis in figure.axes] == ["frequency, Hz", "effective mass / mass"]
    with pytest.raises(wf.ModelError, match="mode = 3 must be a number from 1 to 2"):
        found.write(tmp_path / "mode.png", mode=3)
    with pytest.raises(wf.ModelError, match=r"modes: size = \(320, 240\) must be a positive"):
        found.write(tmp_path / "mode.png", mode=1, size=(320, 240))
    with pytest.raises(wf.OutputError, match=r"end in one of .*\.usdc"):
        found.write(tmp_path / "mode.docx")


def test_modes_of_sections_alone_move_no_node(tmp_path):
    b, body = beam(1)
    b.clamp(body.start, slots="all")
    found = wf.modes(b.finalize(device="cpu"), count=6)
    largest = np.linalg.norm(found.shape(body), axis=2).max(axis=1)
    assert largest == pytest.approx([1, 1, 1, 1, 0, 1])
    with pytest.raises(wf.ModelError, match="mode 5, 204 Hz moves no node"):
        found.write(tmp_path / "mode.png", mode=5)


@wp.func
def swirl(x: wp.vec3d, t: wp.float64):
    """A force field for `add_body_force`."""
    return wp.vec3d(-x[1], x[0], t)


def test_what_has_no_modes_is_refused():
    def built(make, **options):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        law = wf.SVK(E=E, nu=0.3, density=options.pop("density", RHO))
        body = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1)), material=law, name="box")
        make(b, body)
        return b.finalize(device="cpu", **options)

    for make, options, text in (
        (lambda b, body: None, {"density": None}, "modes.*density"),
        (lambda b, body: b.add_pressure(body.surface("z+"), 1e3), {}, "stiffness of 'followers' is not known"),
        (lambda b, body: b.add_body_force(swirl), {}, "stiffness of 'body forces' is not known .*force fields"),
        (lambda b, body: None, {"dtype": "float32"}, "float32 can't resolve the stiffness"),
    ):
        with pytest.raises(wf.ModelError, match=text):
            wf.modes(built(make, **options))
    touching = built(lambda b, body: b.add_contact(body, b.add_collider(wf.HalfSpace((0, 0, 1), 0.0)), name="floor"))
    state = touching.state()
    assert wf.modes(touching, state, count=6).rigid_body_modes == 6
    state.displacement.assign(state.displacement.numpy() - [0, 0, 1e-5])
    with pytest.raises(wf.ModelError, match=r"contact is active in this state \('floor'\)"):
        wf.modes(touching, state)
    with pytest.raises(wf.ModelError, match="count = 0 must be"):
        wf.modes(touching, count=0)
    with pytest.raises(wf.ModelError, match="shift = 'a' must be a frequency"):
        wf.modes(touching, shift="a")
    state.displacement.fill_(np.nan)
    for find in (wf.modes, wf.buckling):
        with pytest.raises(wf.ModelError, match="positions of world 0 are not finite"):
            find(touching, state)
    with pytest.raises(wf.ModelError, match="world = 1 must be a number from 0 to 0"):
        wf.modes(touching, world=1)
