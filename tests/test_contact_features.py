"""Contact with obstacles narrower than the facets of a body: their points see the facets."""

import numpy as np
import pytest

import warpfea as wf
from warpfea.model.obstacle_points import ObstacleContact

G = 9.81
E, RHO = 1e9, 1000.0
MAT = wf.SVK(E=E, nu=0.3, density=RHO)


def plate(b, kind, size, thickness=0.02, material=MAT):
    """A plate of 1 x 0.4 m on z = 0, of elements of `size`, m."""
    cells = (round(1.0 / size), max(1, round(0.4 / size)))
    if kind == "shell":
        mesh = wf.mesh.grid((1.0, 0.4), cells=cells, origin=(-0.5, -0.2, 0.5 * thickness))
        return b.add_shell(mesh, thickness=thickness, material=material, name="plate")
    mesh = wf.mesh.box((1.0, 0.4, thickness), cells=(*cells, 1), origin=(-0.5, -0.2, 0.0), element=kind)
    return b.add_solid(mesh, material=material, name="plate")


@pytest.mark.parametrize(
    ("kind", "size", "rail", "error"),
    [
        ("T10", 0.25, 0.02, 0.16),
        ("T10", 0.125, 0.019, 0.09),
        ("shell", 0.25, 0.05, 0.12),
        ("shell", 0.125, 0.02, 0.05),
        pytest.param("H3843", 0.5, 0.02, 0.12, marks=pytest.mark.slow),
        pytest.param("H3843", 0.25, 0.05, 0.08, marks=pytest.mark.slow),
        *(
            pytest.param(*row, marks=pytest.mark.slow)
            for row in (
                ("T10", 0.5, 0.02, 0.5),
                ("T10", 0.5, 0.05, 0.52),
                ("T10", 0.25, 0.05, 0.18),
                ("H3843", 0.5, 0.05, 0.1),
                ("H3843", 0.25, 0.02, 0.06),
                ("shell", 0.5, 0.02, 0.5),
                ("shell", 0.5, 0.05, 0.53),
                ("shell", 0.25, 0.02, 0.12),
                ("H3843", 0.125, 0.019, 0.04),
                ("shell", 0.125, 0.019, 0.05),
            )
        ),
    ],
)
def test_a_plate_rests_on_rails_narrower_than_its_facets(kind, size, rail, error):
    """Deflection of a beam with overhangs a on supports L apart: q L^4 (5 - 24 a^2/L^2)/(384 E I), to the error of
    such elements. Before, it fell through, or bent 27 % too far."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    body = plate(b, kind, size)
    b.clamp(body.nodes(lambda X: np.abs(X[:, 0]) < 1e-9), slots="position", components="x")
    b.clamp(body.nodes(lambda X: (np.abs(X[:, 0]) < 1e-9) & (X[:, 1] < -0.19)), slots="position", components="y")
    rails = [b.add_collider(wf.Box((x, 0.0, -0.05), (rail, 1.0, 0.1))) for x in (-0.4, 0.4)]
    pads = [b.add_contact(body, r, stiffness="elements") for r in rails]
    at_rest = wf.solve_static(b.finalize(device="cpu"), stabilise=True)
    weight = 0.4 * 0.02 * RHO * G
    records = [at_rest.contact_record(pad) for pad in pads]
    assert sum(record.force[0, -1, 2] for record in records) == pytest.approx(weight, rel=1e-7)
    assert max(record.penetration[0, -1] for record in records) < 1e-4 * 0.02
    span, overhang = 0.8 - rail, 0.1 + 0.5 * rail
    wanted = weight * span**4 * (5.0 - 24.0 * (overhang / span) ** 2) / (384.0 * E * 0.4 * 0.02**3 / 12.0)
    X = body.mesh.points
    middle = np.abs(X[:, 0]) < 1e-9
    assert (X[:, 2] - at_rest.positions(body)[0, :, 2])[middle].mean() == pytest.approx(wanted, rel=error)


def bars(b, kind, count, material, v):
    """Bars of 0.4 m, elements of 0.1 m, side by side and each shifted along itself, that fall and stay upright."""
    out = []
    for k, x in enumerate(np.linspace(-0.09, 0.09, count)):
        y = 0.15 * k
        if kind == "T10":
            mesh = wf.mesh.box((0.4, 0.1, 0.1), cells=(4, 1, 1), origin=(x - 0.2, y - 0.05, 0.0))
            body = b.add_solid(mesh, material=material)
        elif kind == "shell":
            mesh = wf.mesh.grid((0.4, 0.1), cells=(4, 1), origin=(x - 0.2, y - 0.05, 0.005))
            body = b.add_shell(mesh, thickness=0.01, material=material)
        else:
            ends = [(x - 0.2, y, 0.01), (x + 0.2, y, 0.01)]
            body = b.add_beam(ends, elements=4, section=wf.Rectangle(0.02, 0.02), normal=(0, 0, 1), material=material)
        b.clamp(body.nodes(lambda X: np.ones(len(X), dtype=bool)), slots="position", components="xy")
        b.set_initial(body, velocity=(0, 0, v))
        out.append(body)
    return out


@pytest.mark.parametrize(
    ("kind", "radius"),
    [
        ("T10", 0.005),
        ("beam", 0.005),
        *(
            pytest.param(kind, radius, marks=pytest.mark.slow)
            for radius in (0.005, 0.01, 0.02)
            for kind in ("T10", "shell", "beam")
            if (radius > 0.005) != (kind == "shell")  # a shell takes a minute: the thinnest
        ),
    ],
)
def test_bars_do_not_pass_a_peg(kind, radius):
    """Before, 10 to 13 of 13 passed one of 5 mm, 0 to 4 of 20 mm."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    count = 3 if kind == "shell" and radius > 0.005 else 7
    bodies = bars(b, kind, count, wf.SVK(E=1e7, nu=0.3, density=RHO), -1.0)
    low = -radius - 1e-3
    ends = [[(0, 0.15 * k + y, low) for y in (-0.06, 0.06)] for k in range(count)]
    pegs = [b.add_collider(wf.Capsule(*both, radius)) for both in ends]
    pads = [b.add_contact(*pair, stiffness="elements", restitution=0.0) for pair in zip(bodies, pegs)]
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3)
    sim.step(15)
    for body, pad in zip(bodies, pads):
        record = sim.contact_record(pad)
        assert record.normal_force.max() > 0.0
        assert record.penetration.max() < 2e-4
        x = sim.positions(body)[0]
        near = np.argmin(np.abs(x[:, 0]))
        assert x[near, 2] > -0.03  # free fall: -0.035


def test_the_sides_of_a_rail_under_the_end_of_a_plate_do_not_press_on_it():
    """The rails end where the plate ends: points of their outer sides took the plate's end faces, with a thrust of
    440 N that halved its deflection."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    body = plate(b, "T10", 0.25)
    rails = [b.add_collider(wf.Box((x, 0.0, -0.05), (0.02, 1.0, 0.1))) for x in (-0.49, 0.49)]
    pads = [b.add_contact(body, rail, stiffness="elements", restitution=0.0) for rail in rails]
    sim = wf.Simulation(b.finalize(device="cpu"), dt=4e-3)
    sim.step(12)
    for pad in pads:
        force = sim.contact_record(pad).force[0]
        assert np.abs(force[:, 0]).max() < 3.0 < force[:, 2].max()
    assert abs(sim.energies()["ledger_residual"][0]) < 1e-7


@pytest.mark.parametrize(
    ("kind", "size", "obstacle"),
    [
        ("shell", 0.2, wf.Capsule((0.03, -0.2, -0.005), (0.03, 0.2, -0.005), 0.004)),
        ("T10", 0.4, wf.Sphere((0.07, 0.03, -0.011), 0.01)),
        ("shell", 0.1, wf.Sphere((0.07, 0.03, -0.051), 0.05)),
        *(
            pytest.param(kind, size, wf.Sphere((0.07, 0.03, -radius - 1e-3), radius), marks=pytest.mark.slow)
            for kind, size, radius in (
                ("T10", 0.4, 0.05),
                ("T10", 0.1, 0.01),
                ("T10", 0.1, 0.05),
                ("shell", 0.4, 0.01),
                ("shell", 0.4, 0.05),
                ("shell", 0.1, 0.01),
            )
        ),
    ],
)
def test_a_plate_does_not_pass_a_capsule_or_a_ball(kind, size, obstacle):
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    body = plate(b, kind, size)
    b.set_initial(body, velocity=(0, 0, -0.5))
    pad = b.add_contact(body, b.add_collider(obstacle))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3)
    sim.step(15)
    record = sim.contact_record(pad)
    assert 2e-3 * record.force[0, :, 2].sum() > 0.25 * 8.0 * (0.5 + 0.03 * G)  # a quarter of the momentum
    assert record.penetration.max() < 2e-4
    assert abs(sim.energies()["ledger_residual"][0]) < 1e-6


def bar(b, kind, cells, along, at, material):
    """A bar of 0.4 x 0.01 x 0.01 m along x or y through a point."""
    ends = np.array(at) + np.outer((-0.2, 0.2), np.eye(3)[along])
    if kind == "beam":
        return b.add_beam(
            ends, elements=cells, section=wf.Rectangle(0.01, 0.01), normal=(0, 0, 1), material=material
        )  # fmt: skip
    size, count = np.full(3, 0.01), np.ones(3, dtype=int)
    size[along], count[along] = 0.4, cells
    mesh = wf.mesh.box(tuple(size), cells=tuple(count), origin=tuple(np.array(at) - 0.5 * size), element=kind)
    return b.add_solid(mesh, material=material)


@pytest.mark.parametrize(
    ("kind", "cells"),
    [("T10", (2, 2)), ("beam", (1, 4)), pytest.param("H3843", (2, 3), marks=pytest.mark.slow)],
)
def test_crossed_bars_hold_each_other(kind, cells):
    """Bars of elements 10 to 40 times as long as wide. Before, they passed through each other without a force."""
    material = wf.SVK(E=1e10, nu=0.3, density=RHO, damping=wf.KelvinVoigt(eta=1e6))
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    low = bar(b, kind, cells[0], 0, (0.0, 0.013, 0.0), material)
    high = bar(b, kind, cells[1], 1, (0.017, 0.013, 0.012), material)
    b.clamp(low.nodes(lambda X: np.abs(X[:, 0]) > 0.199))
    pad = b.add_contact(low, high, mu=0.3)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3)
    sim.step(60)
    record = sim.contact_record(pad)
    weight = 0.4 * 0.01**2 * RHO * G
    assert record.force[0, -10:, 2].mean() == pytest.approx(-weight, rel=0.02)
    assert record.penetration.max() < 1e-4 * 0.01
    assert sim.positions(high)[0, :, 2].mean() == pytest.approx(0.01, abs=2e-4)


@pytest.mark.parametrize(("beside", "facet", "whole"), [(1e-4, 0.1, True), (1e-3, 0.05, False), (1.5e-2, 0.4, False)])
def test_a_block_falls_freely_beside_the_border_of_a_body(beside, facet, whole):
    """Before, it hung in the air within 5 % of a facet's side beside the border, or was thrown by up to 17 weights."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    cells = (max(1, round(0.4 / facet)),) * 2 + (1,)
    table = b.add_solid(wf.mesh.box((0.4, 0.4, 0.05), cells=cells, origin=(-0.4, -0.2, -0.05)), material=MAT)
    b.clamp(table.nodes(lambda X: X[:, 2] < -0.04))
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(2, 2, 2), origin=(beside, -0.05, 0.005))
    block = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=0.3, density=RHO))
    pad = b.add_contact(*(block, table) if whole else (block.surface("z-"), table.surface("z+")), mu=0.3)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3)
    sim.step(60)
    assert not sim.contact_record(pad).force.any()
    fallen = 0.055 - sim.positions(block)[0, :, 2].mean()
    assert fallen == pytest.approx(0.5 * G * 0.12 * 0.122, rel=1e-9)  # backward Euler


def test_a_block_flush_with_the_table_below_is_held_at_its_borders():
    """Points of its edges pass the table's surface at the border, to the rounding of a turned mesh."""
    c, s = np.cos(0.3), np.sin(0.3)
    turn = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    low, block = (
        b.add_solid(wf.mesh.box((0.1, 0.1, height), cells=(1, 1, 1), origin=(0.3, 0.2, z), map=lambda X: X @ turn),
                    material=wf.SVK(E=modulus, nu=0.3, density=RHO))
        for height, z, modulus in ((0.05, -0.05, 1e9), (0.1, 1e-3, 1e6))
    )  # fmt: skip
    b.clamp(low.nodes(lambda X: X[:, 2] < -0.04))
    b.add_contact(block, low, mu=0.3)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3)
    sim.step(40)
    z = sim.positions(block)[0, np.abs(block.mesh.points[:, 2] - 1e-3) < 1e-9, 2]
    np.testing.assert_allclose(z, z.mean(), rtol=0.1)


def on_a_rail(z, **options):
    """A plate with its lower face at z, and a rail narrower than its facets, with friction."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    mesh = wf.mesh.box((1.0, 0.4, 0.02), cells=(4, 2, 1), origin=(-0.5, -0.2, z), element="T10")
    body = b.add_solid(mesh, material=wf.SVK(E=1e7, nu=0.3, density=RHO), name="plate")
    rail = b.add_collider(wf.Box((0.0, 0.0, -0.05), (0.02, 1.0, 0.1)), name="rail")
    b.add_contact(body, rail, mu=0.3, name="pad", **options)
    return b, body, rail


def test_messages_name_the_rail_whose_points_they_give():
    b, _, _ = on_a_rail(-1e-3, overlap="refuse")
    text = r"contact 'pad': collider 'rail' begins 0.001 m inside body 'plate' \(world 0, reference point \(\S*0.01, "
    with pytest.raises(wf.ModelError, match=text):
        wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    b, body, _ = on_a_rail(1e-3)
    b.set_initial(body, velocity=(0, 0, -100.0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, solver=wf.NewtonPCG(max_halvings=0))
    text = r"a point of collider 'rail' \(reference place \S*0.00\d+, .* went through body 'plate'; .* thicker body"
    with pytest.raises(wf.PenetrationError, match=text):
        sim.step()


def test_a_rail_is_contact_with_an_obstacle():
    b, _, rail = on_a_rail(0.0)
    model = b.finalize(device="cpu")
    assert not {"contact", "friction"} & set(model.info()["left_out"])
    assert "contact between bodies" in model.info()["left_out"]
    (fact,) = model.info()["contacts"]
    assert (fact["body"], fact["collider"]) == ("plate", "rail")
    second = b.add_solid(wf.mesh.box((0.1,) * 3, cells=(8, 8, 8), origin=(0, 0, 1)), material=MAT, name="fine")
    pad = b.add_contact(second, rail)
    for steps in range(2):  # alone, and beside contact of points of a body
        with pytest.raises(wf.ModelError, match=r"collider 'rail': offset can't be set: .* facets of body 'plate'"):
            b.finalize(device="cpu").set_parameter("rail.offset", -5e-4)
        if steps == 0:
            b.description.contacts.remove(pad)


@pytest.mark.parametrize(("height", "seen"), [(0.4, True), (0.6, False)])
def test_a_wall_taller_than_two_facets_has_no_points_of_its_own(height, seen):
    """They would be all over it."""
    b = wf.ModelBuilder()
    body = plate(b, "T10", 0.25)
    pad = b.add_contact(body, b.add_collider(wf.Box((0, 0, -0.5 * height), (0.02, 1.0, height))))
    assert isinstance(pad, ObstacleContact) == seen


@pytest.mark.parametrize("option", [{"points": 7}, {"seam": 0.01}])
def test_options_that_points_of_a_rail_lack_are_refused(option):
    with pytest.raises(NotImplementedError, match=rf"'pad': {next(iter(option))} = for collider 'rail', .* 'plate'"):
        on_a_rail(0.0, **option)


def test_moving_obstacles_beside_a_rail_are_where_their_paths_lead():
    b, _, _ = on_a_rail(1e-3)
    b.add_collider(wf.Sphere((5, 0, 0), 0.1), path=([0, 2e-3], [(0, 0, 0), (1, 0, 0)]))
    turn = wf.Rotation(anchor=(5, 1, 0), axis=(0, 0, 2), angle=([0, 2e-3], [0, 0.5 * np.pi]))
    b.add_collider(wf.Box((6, 1, 0), (0.4, 0.1, 0.1)), path=turn)
    sim = wf.Simulation(b.finalize(device="cpu", worlds=2), dt=1e-3)
    sim.step(2)
    position, axes, offset = sim.collider_poses()
    np.testing.assert_allclose(position[1], [(0, 0, -0.05), (6, 0, 0), (5, 2, 0)], atol=1e-12)
    np.testing.assert_allclose(axes[1, 2], [(0, -1, 0), (1, 0, 0), (0, 0, 1)], atol=1e-12)
    assert not offset.any()


def test_a_bar_across_rails_does_not_pass_between_their_points():
    """Rails longer than wide had points 17 mm apart along them: a bar of 20 mm sank 5 mm into them."""
    b = wf.ModelBuilder(gravity=(0, 0, -G))
    ends = [(-0.15, 0.0, 0.0102), (0.15, 0.0, 0.0102)]
    material = wf.SVK(E=1e8, nu=0.3, density=RHO)
    body = b.add_beam(ends, elements=2, section=wf.Rectangle(0.02, 0.02), normal=(0, 0, 1), material=material)
    rails = [b.add_collider(wf.Box((x, 0.03, -0.02), (0.02, 0.33, 0.04))) for x in (-0.13, 0.13)]
    pads = [b.add_contact(body, rail, mu=0.3) for rail in rails]
    sim = wf.Simulation(b.finalize(device="cpu"), dt=4e-3)
    sim.step(20)
    for pad in pads:
        assert sim.contact_record(pad).force[0, -1, 2] == pytest.approx(0.15 * 0.02**2 * RHO * G, rel=1e-3)
    assert sim.positions(body)[0, :, 2].min() > 0.0098  # of the axis
