"""Words of contact: depth over the element size, overlaps at the start, bodies that nobody named."""

import json
import warnings

import numpy as np
import pytest
from triangle_meshes import octahedron, sheet

import warpfea as wf
from warpfea.cli import main

SOFT = wf.SVK(E=1e6, nu=0.3, density=1000.0)


# depth over the size of the smallest element


@pytest.mark.parametrize(("element", "size"), [("T4", 0.05), ("H3843", 0.05), ("shell", 0.01), ("beam", 0.02)])
def test_sizes_of_elements(element, size):
    """Height of tetrahedra in a cube's corner and edge of bricks, 0.05; thickness of shells, side of beams."""
    b = wf.ModelBuilder()
    if element == "shell":
        body = b.add_shell(wf.mesh.grid((0.1, 0.1), cells=(2, 2)), thickness=0.01, material=SOFT)
    elif element == "beam":
        section = wf.Rectangle(0.03, 0.02)
        body = b.add_beam([(0, 0, 0), (1, 0, 0)], elements=4, section=section, normal=(0, 0, 1), material=SOFT)
    else:
        mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(2, 2, 2), element=element)
        body = b.add_solid(mesh, material=SOFT, element=element)
    pad = b.add_contact(body, b.add_collider(wf.HalfSpace((0, 0, 1), -1.0)))
    term = b.finalize(device="cpu").terms.named("contact")
    np.testing.assert_allclose(term.element_size(pad), size, rtol=1e-9)


def test_a_step_reports_the_depth_over_the_element_size():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)))
    pads = []
    for k, speed in enumerate((0.2, 0.1)):  # the faster one has larger elements
        mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1 + k,) * 3, element="T4", origin=(k, 0, 1e-5))
        cube = b.add_solid(mesh, material=SOFT)
        b.set_initial(cube, velocity=(0, 0, -speed))
        pads.append(b.add_contact(cube.surface("z-"), floor))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-5)
    assert sim.step().penetration == 0.0
    found = [sim.step().penetration[0] for _ in range(400)]
    depths = np.array([sim.contact_record(pad).penetration[0, 1:] for pad in pads])
    assert (depths.max(axis=1) > 1e-5).all()
    np.testing.assert_allclose(found, (depths / [[0.1], [0.05]]).max(axis=0), rtol=1e-12)


SCENE = """
import warpfea as wf

@wf.scene(dt=1e-2, t_end=.02)
def press(*, stiffness: float = 0.2) -> wf.ModelBuilder:
    '''A cube that is pressed onto a floor.'''
    b = wf.ModelBuilder()
    mesh = wf.mesh.box((.1, .1, .1), cells=(1, 1, 1))
    cube = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=.3, density=1000), name="cube")
    b.drive(cube.nodes("z+"), displacement=([0, .02, 1], [(0, 0, 0), (0, 0, -.006), (0, 0, -.006)]))
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)))
    b.add_contact(cube.surface("z-"), floor, stiffness=("region", stiffness), name="pad")
    return b
"""


@pytest.mark.parametrize("static", [False, True])
def test_commands_warn_of_deep_contact(static, tmp_path, monkeypatch, capfd):
    (tmp_path / "mine.py").write_text(SCENE)
    monkeypatch.chdir(tmp_path)
    words = ["run", "mine.py", "--device", "cpu", "--json", "s.json", *(["--static"] if static else [])]
    assert main(words) == 0
    out = " ".join(capfd.readouterr().out.split())
    pad = json.loads((tmp_path / "s.json").read_text())["contacts"]["pad"]
    assert pad["relative_penetration"] == pytest.approx(pad["penetration"] / 0.1)
    ratio = f"{pad['relative_penetration']:.2g}"
    text = f"WARNING contact 'pad': penetration of up to {ratio} of its smallest element; take a higher stiffness="
    assert text in out
    assert ("or a smaller dt" in out) != static
    assert main([*words, "--set", "stiffness=1000"]) == 0
    assert "WARNING" not in capfd.readouterr().out


# overlaps at the start


@pytest.mark.parametrize("height", [0.01, 0.04, 0.08])
def test_a_block_above_a_slender_strip_does_not_begin_inside(height):
    """Outward vectors of its end faces, inclined at their corners, cross far inside of it."""
    b = wf.ModelBuilder()
    strip = b.add_solid(wf.mesh.box((0.28, 0.03, 0.03), cells=(6, 1, 1)), material=SOFT, name="strip")
    mesh = wf.mesh.box((0.05, 0.05, 0.05), cells=(2, 2, 1), element="T4", origin=(0.11, 0.0, 0.03 + height))
    b.add_contact(b.add_solid(mesh, material=SOFT, name="block"), strip, overlap="refuse")
    assert wf.Simulation(b.finalize(device="cpu"), dt=1e-3).step().converged.all()


R = 0.25
"""Radius of the lower side of a bent block, m."""


def bend(X):
    angle, r = X[:, 0] / R, R + X[:, 2]
    return np.column_stack([r * np.sin(angle), X[:, 1], r * np.cos(angle)])


def test_a_peg_between_an_arc_and_its_chord_does_not_begin_inside():
    """The inside test uses flat triangles, 0.36 mm below the arc there; its outer side is the one in contact."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.box((0.1, 0.05, 0.02), cells=(2, 1, 1), element="T10", origin=(-0.05, 0, 0), map=bend)
    arch = b.add_solid(mesh, material=SOFT, name="arch")
    top = (R * np.sin(0.05), R * np.cos(0.05) - 1e-4)
    mesh = wf.mesh.box((0.002, 0.01, 0.01), cells=(1, 1, 1), origin=(top[0] - 0.001, 0.02, top[1] - 0.01))
    peg = b.add_solid(mesh, material=SOFT, name="peg")
    b.add_contact(peg.surface("z+"), arch.surface("z+"), overlap="refuse")
    assert wf.Simulation(b.finalize(device="cpu"), dt=1e-3).step().converged.all()


def block_on(collider, map=None, cells=(2, 2, 2), origin=(0.0, 0.0, 0.0), **options):
    """A block of 0.1 m on an obstacle: simulation, body, contact."""
    b = wf.ModelBuilder()
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=cells, element="T4", origin=origin, map=map)
    block = b.add_solid(mesh, material=SOFT, name="block")
    pad = b.add_contact(block.surface("z-"), b.add_collider(collider, name="base"), stiffness=10, name="pad", **options)
    return wf.Simulation(b.finalize(device="cpu"), dt=1e-3), block, pad


def test_a_curve_laid_on_its_like_begins_stored():
    """Chords of an arc lie R (1 - cos(h/2R)) within the cylinder that the nodes are on."""
    depth = R * (1.0 - np.cos(0.05 / 2 / R))
    drum = wf.Cylinder((0, -1, 0), (0, 1, 0), R)
    text = rf"contact 'pad': body 'block' begins {depth:.3g} m inside collider 'base' .*it is stored.*overlap='offset'"
    with pytest.warns(wf.ModelWarning, match=text):
        sim, block, pad = block_on(drum, bend, origin=(-0.05, 0, 0))
    assert sim.step(20).converged.all()
    assert sim.contact_record(pad).penetration.max() < 0.2 * depth
    assert np.abs(sim.velocities(block)).max() < 3.0 * depth / 0.1  # it decays in overlap_time
    with pytest.raises(wf.ModelError, match="begins"):
        block_on(drum, bend, origin=(-0.05, 0, 0), overlap="refuse")


@pytest.mark.parametrize("pair", [False, True])
def test_overlaps_are_stored_up_to_five_percent_of_an_edge(pair):
    def begin(depth, **options):
        if not pair:
            return block_on(wf.HalfSpace((0, 0, 1), depth), **options)[0]
        b = wf.ModelBuilder()
        low, top = (b.add_solid(wf.mesh.box((0.1,) * 3, cells=(2, 2, 2), origin=(0, 0, z), element="T4"), material=SOFT)
                    for z in (0.0, 0.1 - depth))  # fmt: skip
        b.add_contact(top.surface("z-"), low.surface("z+"), name="pad", **options)
        return wf.Simulation(b.finalize(device="cpu"), dt=1e-3)

    with pytest.warns(wf.ModelWarning, match=r"begins 0\.0024 m inside"):
        sim = begin(0.0024)
    assert sim.step().penetration < 1e-2
    with pytest.raises(wf.ModelError, match=r"begins 0\.0026 m inside .*stores up to 0\.0025 m.*overlap='offset'"):
        begin(0.0026)
    with warnings.catch_warnings():
        warnings.simplefilter("error", wf.ModelWarning)
        begin(0.0026, overlap="offset")
        begin(1e-8)  # rounded coordinates: stored, without a word


# triangle meshes of rounded coordinates


def soup(points, triangles, noise):
    """Triangles with three points each, with noise."""
    corners = points[triangles].reshape(-1, 3)
    noise = noise * np.random.default_rng(1).standard_normal(corners.shape)
    return corners + noise, np.arange(len(corners)).reshape(-1, 3)


def test_a_noisy_soup_is_closed():
    points, triangles = octahedron()
    mesh = wf.TriMesh(*soup(points, triangles, 1e-8))
    assert mesh.closed
    assert len(np.unique(mesh.points, axis=0)) == 6
    np.testing.assert_allclose(mesh.volume, 4.0 / 3.0, rtol=1e-6)
    assert not wf.TriMesh(*soup(points, triangles, 1e-4)).closed
    ends = np.concatenate([points, [points[0] + 1e-7]])  # a needle of 1e-7 m at a corner
    needle = wf.TriMesh(ends, np.concatenate([triangles, [(0, 6, triangles[0, 1])]]))
    assert len(needle.triangles) == len(triangles)


def test_a_block_rests_on_a_noisy_sheet():
    points, triangles = sheet(6, 0.6, 0.0)
    found = []
    for mesh in (wf.TriMesh(points, triangles), wf.TriMesh(*soup(points, triangles, 1e-9))):
        sim, block, pad = block_on(mesh, overlap="refuse")
        assert sim.step(30).converged.all()
        assert sim.contact_record(pad).normal_force.max() > 1.0
        found.append(sim.displacements(block))
    np.testing.assert_allclose(*found, atol=1e-7)


# all pairs


def row_of_bodies(count, gap=1e-3):
    """Cubes of 0.1 m beside each other on a floor, and the floor."""
    b = wf.ModelBuilder()
    bodies = []
    for k in range(count):
        mesh = wf.mesh.box((0.1,) * 3, cells=(1, 1, 1), element="T4", origin=((0.1 + gap) * k, 0, 0))
        bodies.append(b.add_solid(mesh, material=SOFT, name=f"cube{k}"))
    return b, bodies, b.add_collider(wf.HalfSpace((0, 0, 1)), name="floor")


def sides(contact):
    return {contact.first.body, contact.second.body} if hasattr(contact, "first") else {contact.body, contact.collider}


def test_all_pairs_are_named_once():
    b, bodies, floor = row_of_bodies(4, gap=0.0)
    roof = b.add_collider(wf.Sphere((0, 0, 9), 1.0), name="roof")
    named = [b.add_contact(bodies[2].surface("x+"), bodies[3]), b.add_contact(bodies[1], floor)]
    b.weld(bodies[0].surface("x+"), bodies[1])
    b.add_joint("spherical", parent=bodies[1].surface("x+"), child=bodies[2].surface("x-"))
    rod = (bodies[0].surface("x+"), bodies[3].surface("x-"))
    b.add_joint("distance", parent=rod[0], child=rod[1])
    b.clamp(bodies[3].nodes(lambda X: X[:, 2] > -1.0))
    added = b.add_contact_all(mu=0.3, restitution=0.5)
    expected = [(0, 2), (0, 3), (1, 3), (0, floor), (0, roof), (1, roof), (2, floor), (2, roof)]
    wanted = [{bodies[j], bodies[k] if isinstance(k, int) else k} for j, k in expected]
    assert [sides(contact) for contact in added] == wanted
    assert b.description.contacts == named + added
    assert {(c.mu, c.restitution) for c in added} == {(0.3, 0.5)}
    assert added[0].name == "cube0 on cube2"
    assert b.add_contact_all() == []
    assert len(b.finalize(device="cpu").description.contacts) == 10


def test_all_pairs_that_are_no_pairs_are_refused():
    b, _, _ = row_of_bodies(1)
    b.description.colliders.clear()
    with pytest.raises(wf.ModelError, match=r"add_contact_all: there is no pair yet \(Body\('cube0'"):
        b.add_contact_all()
    b, _, _ = row_of_bodies(3)
    with pytest.raises(wf.ModelError, match="add_contact_all: name = names one contact"):
        b.add_contact_all(name="pad")
    with pytest.raises(NotImplementedError, match="law = 'smooth' acts at any distance"):
        b.add_contact_all(law="smooth")
    with pytest.raises(TypeError, match="stifness"):
        b.add_contact_all(stifness=2.0)
    assert b.description.contacts == []


def test_all_pairs_hold():
    """The second of three falls onto the first, all on a floor."""
    b, bodies, _ = row_of_bodies(2)
    top = b.add_solid(wf.mesh.box((0.1,) * 3, cells=(1, 1, 1), element="T4", origin=(0, 0, 0.101)), material=SOFT)
    b.add_contact_all(mu=0.3, restitution=0.3, stiffness=10.0)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3)
    assert sim.step(100).converged.all()
    assert sim.positions(top)[0, :, 2].min() > 0.095
    assert sim.positions(bodies[1])[0, :, 2].min() > -0.005


def test_pairs_whose_boxes_are_apart_cost_no_launch_and_list_no_point():
    """Two cubes that touch, and a third one far away: named as the one pair, and all three."""
    found = []
    for every in (False, True):
        b, low, top = crossing_cubes(gap=1e-4)
        flying(b, ((0.1,) * 3, (0, 0, 5.0), (1, 1, 1)), (0, 0, 0), "far")
        added = b.add_contact_all() if every else [b.add_contact(low, top)]
        sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
        before = sim.stepper.launch.launches
        pcg = sim.step(5).pcg[0]
        listed = np.count_nonzero(sim.state.numpy()["pairs_facet"])
        found.append((sim.stepper.launch.launches - before, pcg, listed, sim.positions(top)[0]))
    assert len(added) == 3
    assert found[0][:3] == found[1][:3]
    assert found[0][2] > 0
    np.testing.assert_allclose(found[0][3], found[1][3], rtol=0, atol=1e-11)


# bodies that nobody named


def flying(b, shape, speed, name):
    """A body of a unit velocity (m/s) times `speed`; shape: (size, origin, cells)."""
    size, origin, cells = shape
    body = b.add_solid(wf.mesh.box(size, cells=cells, origin=origin, element="T4"), material=SOFT, name=name)
    b.set_initial(body, velocity=speed)
    return body


def crossing_cubes(shift=0.0, gap=0.0105):
    """A cube that flies down, 1 mm in a step of 1 ms, onto another one; each face is two triangles."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    low = flying(b, ((0.1,) * 3, (0, 0, 0), (1, 1, 1)), (0, 0, 0), "low")
    top = flying(b, ((0.1,) * 3, (shift, shift, 0.1 + gap), (1, 1, 1)), (0, 0, -1.0), "top")
    return b, low, top


def silent(sim, steps):
    with warnings.catch_warnings():
        warnings.simplefilter("error", wf.ModelWarning)
        sim.step(steps)


@pytest.mark.parametrize("shift", [0.0, 0.03])
def test_bodies_that_cross_are_named_once_with_the_time(shift):
    sim = wf.Simulation(crossing_cubes(shift)[0].finalize(device="cpu"), dt=1e-3, check_overlap=True)
    silent(sim, 11)  # 0.5 mm: less than 5 % of a third of the edge
    silent(sim, 1)
    text = r"body 'low' and body 'top' have no contact and cross since t = 0.013 s .* write b.add_contact\(low, top\)"
    with pytest.warns(wf.ModelWarning, match=text):
        sim.step()
    silent(sim, 3)
    (found,) = sim.overlap_check.found
    assert (found.first, found.second, found.world) == ("low", "top", 0)
    assert found.time == pytest.approx(0.013)
    assert found.depth == pytest.approx(2.5e-3, rel=1e-5)


def test_pairs_that_are_meant_are_not_named():
    def contact(b, low, top):
        b.add_contact(top, low)

    def rod(b, low, top):
        b.add_joint("distance", parent=low.surface("z-"), child=top.surface("z+"))

    def joint(b, low, top):
        ends = {"parent": low.surface("z-"), "child": top.surface("z+")}
        b.add_joint("translational", **ends, anchor=(0.05, 0.05, 0), axis=(0, 0, 1))

    for connect, gap, left in ((contact, 1e-3, 1), (joint, 1e-3, 0), (rod, 1e-3, 1), (None, -0.01, 0), (None, 1e-3, 1)):
        b, low, top = crossing_cubes(0.02, gap)
        if connect:
            connect(b, low, top)
        sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, check_overlap=True)
        sim.overlap_check.begin(sim)
        assert len(sim.overlap_check.pairs) == left


THROUGH = {
    "thin peg through a facet": ((0.004, 0.004, 0.1), (0.03, 0.06, 0.101)),
    "plate beside plate": ((0.1, 0.1, 0.002), (0.05, 0.05, 0.101)),
    "inside at once": ((0.02,) * 3, (0.04, 0.04, 0.101)),
}


@pytest.mark.parametrize("name", THROUGH)
def test_thin_bodies_are_seen(name):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    flying(b, ((0.1,) * 3, (0, 0, 0), (1, 1, 1)), (0, 0, 0), "low")
    flying(b, (*THROUGH[name], (1, 1, 1)), (0, 0, -1.0), "top")
    dt = 0.05 if "inside" in name else 3e-3
    sim = wf.Simulation(b.finalize(device="cpu"), dt=dt, check_overlap=True)
    with pytest.warns(wf.ModelWarning, match="body 'low' and body 'top' have no contact"):
        sim.step()


OBSTACLES = {
    "half-space": (wf.HalfSpace((0, 0, 1), 0.0), None),
    "ball": (wf.Sphere((0.03, 0.06, -0.004), 0.004), None),
    "box": (wf.Box((0.05, 0.05, -0.05), (0.1, 0.1, 0.1)), None),
    "sheet": (wf.TriMesh([(-1, -1, 0), (1, -1, 0), (0, 2, 0)], [(0, 1, 2)]), None),
    "moving": (wf.Capsule((-1, 0.03, -0.5), (1, 0.03, -0.5), 0.01), ([0, 1e-3], [(0, 0, 0), (0, 0, 0.5)])),
}


@pytest.mark.parametrize("name", OBSTACLES)
def test_obstacles_are_named(name):
    """Poses of moving ones are those of the contact with others."""
    shape, path = OBSTACLES[name]
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    flying(b, ((0.1,) * 3, (0, 0, 1e-3), (1, 1, 1)), (0, 0, -1.0), "cube")
    collider = b.add_collider(shape, path=path, name="base")
    other = flying(b, ((0.1,) * 3, (0, 0, 5.0), (1, 1, 1)), (0, 0, 0), "other")
    if path:
        b.add_contact(other, collider)
    sim = wf.Simulation(b.finalize(device="cpu", worlds=2), dt=1e-3, check_overlap=True)
    if path is None:
        silent(sim, 1)
    text = r"body 'cube' and collider 'base' .* in world 0 .*b.add_contact\(cube, base\)"
    with pytest.warns(wf.ModelWarning, match=text):
        sim.step(3)
    assert [crossing.second for crossing in sim.overlap_check.found] == ["base"]


def test_bodies_that_cross_unseen_by_their_contact_are_named():
    """Seven points of each of the cube's faces miss a thin capsule, whose own points implicit contacts have."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    cube = flying(b, ((0.1,) * 3, (0, 0, 0), (1, 1, 1)), (0, 0, 0), "cube")
    path = ([0, 0.02], [(0, 0, 0), (0, 0, 0.03)])
    pin = b.add_collider(wf.Capsule((-1, 0.021, -0.006), (1, 0.021, -0.006), 0.004), path=path, name="pin")
    b.add_contact(cube, pin, points=7, name="pad", law="paper", treatment="explicit")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, check_overlap=True)
    with pytest.warns(
        wf.ModelWarning, match="body 'cube' and collider 'pin' cross since t = .* contact 'pad' sees 0 m"
    ):
        sim.step(12)
    assert len(sim.overlap_check.found) == 1


def test_a_depth_that_a_soft_contact_sees_is_not_named():
    """Far above 5 % of a third of the edge, 1.7 mm."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    cube = flying(b, ((0.1,) * 3, (0, 0, 1e-4), (1, 1, 1)), (0, 0, -1.0), "cube")
    pad = b.add_contact(cube, b.add_collider(wf.HalfSpace((0, 0, 1), 0.0)), stiffness=("region", 0.05))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, check_overlap=True)
    silent(sim, 12)
    assert sim.contact_record(pad).penetration.max() > 4e-3


CROSSED = """
import warpfea as wf

@wf.scene(dt=1e-2, t_end=.2)
def fall() -> wf.ModelBuilder:
    '''A cube falls through another one.'''
    b = wf.ModelBuilder()
    law = wf.SVK(E=1e6, nu=.3, density=1000)
    for name, z in (("low", 0), ("top", .101)):
        mesh = wf.mesh.box((.1, .1, .1), cells=(1, 1, 1), origin=(0, 0, z))
        body = b.add_solid(mesh, material=law, name=name)
        if name == "low":
            b.clamp(body.nodes("z-"))
    return b
"""


def test_commands_name_bodies_that_cross(tmp_path, monkeypatch, capfd):
    (tmp_path / "mine.py").write_text(CROSSED)
    monkeypatch.chdir(tmp_path)
    words = ["run", "mine.py", "--device", "cpu", "--json", "s.json"]
    text = "body 'low' and body 'top' have no contact and cross since t ="
    assert main(words) == 0
    printed = capfd.readouterr()
    assert f"WARNING {text}" in " ".join(printed.out.split())
    assert text in printed.err
    (found,) = json.loads((tmp_path / "s.json").read_text())["overlaps"]
    assert (found["first"], found["second"]) == ("low", "top")
    assert 0.01 < found["time"] < 0.04
    assert main([*words, "--overlaps", "ignore"]) == 0
    assert text not in "".join(capfd.readouterr())


def test_without_the_check_there_is_nothing_of_it():
    sim = wf.Simulation(crossing_cubes(gap=-0.05)[0].finalize(device="cpu"), dt=1e-3)
    silent(sim, 3)
    assert sim.overlap_check is None
