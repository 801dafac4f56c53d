"""Circles, tubes, any sections and tapers against beam theory; shells of varying thickness."""

import numpy as np
import pytest
import scipy.linalg

import warpfea as wf
from warpfea.model.assembly import facet_areas, facet_tables

E, NU, RHO, L, R = 2e9, 0.3, 1000.0, 1.0, 0.03
G = E / (2 * (1 + NU))
LAW = wf.SVK(E=E, nu=NU, density=RHO)
BORE = 0.026
CIRCLE, TUBE = wf.Circle(R), wf.Tube(R, R - BORE)
SQUARE = np.array([(-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5)])
ROUND = pytest.mark.parametrize(
    ("section", "bore"), [pytest.param(CIRCLE, 0.0, id="circle"), pytest.param(TUBE, BORE, id="tube")]
)


def cantilever(section, force=(0, 0, 0), moment=(0, 0, 0), elements=8, integration="tied", tol=None, **options):
    """Displacement and gradients at the tip, and the model of a cantilever along x."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    beam = b.add_beam([(0, 0, 0), (L, 0, 0)], elements=elements, section=section, normal=(0, 0, 1), material=LAW,
                      integration=integration)  # fmt: skip
    b.clamp(beam.start, slots="position+section")
    if any(force):
        b.add_point_load(beam.end, force)
    if any(moment):
        b.add_moment(beam.end, moment)
    model = b.finalize(**{"device": "cpu"} | options)
    tip = wf.solve_static(model, load_steps=1, tol=tol).state.displacement.numpy()[0, beam.slots[-4:]]
    return tip, model


def bending(I, A, shear):  # noqa: E741
    """Deflection under 1 N at the tip."""
    return L**3 / (3 * E * I) + L / (shear * G * A)


@ROUND
def test_cantilever_torsion_and_frequencies(section, bore):
    I, A = np.pi * (R**4 - bore**4) / 4, np.pi * (R**2 - bore**2)  # noqa: E741
    tip, model = cantilever(section, force=(0, 0, -1))
    assert tip[0, 2] == pytest.approx(-bending(I, A, section.shear), rel=1e-5)
    turn = cantilever(section, moment=(1, 0, 0))[0]
    assert (turn[2] - turn[3])[[2, 1]].sum() / 2 == pytest.approx(L / (G * 2 * I), rel=1e-5)
    M, K = model.mass_matrix().toarray(), model.tangent_matrix(model.state(), world=0).toarray()
    free = model.free_slots.ravel()
    squares = scipy.linalg.eigh(K[np.ix_(free, free)], M[np.ix_(free, free)], eigvals_only=True, subset_by_index=[0, 1])
    assert np.sqrt(squares) == pytest.approx(1.875104**2 * np.sqrt(E * I / (RHO * A)) / L**2, rel=1e-2)


@pytest.mark.parametrize(
    ("device", "dtype"),
    [pytest.param("cpu", "float32", marks=pytest.mark.slow),
     *(pytest.param("cuda", dtype, marks=pytest.mark.cuda) for dtype in ("float64", "float32"))],
)  # fmt: skip
def test_devices_and_precisions(device, dtype):
    """A tube, and a circle that tapers, bent and twisted."""
    for section in (TUBE, (wf.Circle(0.04), wf.Circle(0.02))):
        for load in ({"force": (0, 0, -1)}, {"moment": (1, 0, 0)}):
            expected = cantilever(section, **load, tol=1e-11)[0]
            tol = 1e-11 if dtype == "float64" else None
            found = cantilever(section, **load, device=device, dtype=dtype, tol=tol)[0]
            bound = 1e-9 if dtype == "float64" else 1e-3
            assert np.abs(found - expected).max() < bound * np.abs(expected).max()


@pytest.mark.parametrize("integration", ["split", "full"])
def test_other_integrations(integration):
    """Without Poisson locking within 1 %; the full law bends with the modulus of uniaxial strain."""
    exact = bending(np.pi * R**4 / 4, np.pi * R**2, 1.0)
    locked = {"split": 1.0, "full": (1 - NU) / ((1 + NU) * (1 - 2 * NU))}[integration]
    tip = cantilever(CIRCLE, force=(0, 0, -1), integration=integration)[0]
    assert -tip[0, 2] * locked == pytest.approx(exact, rel=1e-2)


def test_square_by_points():
    """The four Gauss points of a square, off its centroid, are a `Rectangle`."""
    square = wf.Rectangle(0.06, 0.06)
    points, torsion = 0.06 * (SQUARE / 3**0.5 + 1.0), square.torsion_ratio * square.polar
    loads = {"force": (1, 2, 3), "moment": (0.5, 0.2, 0.1)}
    wanted = cantilever(square, **loads)[0]
    for outline in (0.06 * (SQUARE + 1.0), None):
        section = wf.Section(points, np.full(4, 9e-4), outline=outline, torsion=torsion)
        assert np.abs(cantilever(section, **loads)[0] - wanted).max() < 1e-12 * np.abs(wanted).max()


def test_torsion_of_outlines():
    """Saint-Venant's constants of a square and of an equilateral triangle, sqrt(3)/80 a^4; thin walls b t^3/3."""
    square = wf.Section(SQUARE / 3**0.5, np.full(4, 0.25), outline=SQUARE)
    exact = wf.Rectangle(1.0, 1.0)
    assert square.torsion == pytest.approx(exact.torsion_ratio * exact.polar, rel=1e-5)
    triangle = np.array([(0, 0), (1, 0), (0.5, 3**0.5 / 2)])
    section = wf.Section(0.5 * (triangle + triangle.mean(axis=0)), np.full(3, 3**0.5 / 12), outline=triangle)
    assert section.torsion == pytest.approx(3**0.5 / 80, rel=1e-5)


def test_principal_axes():
    """A rectangle given in coordinates turned by 0.3 rad bends about its own axes."""
    plain, c, s = wf.Rectangle(0.06, 0.03), np.cos(0.3), np.sin(0.3)
    turn = np.array([(c, s), (-s, c)])  # rows to turned coordinates
    corners = SQUARE * (0.06, 0.03)
    section = wf.Section(corners / 3**0.5 @ turn, np.full(4, 4.5e-4), outline=corners @ turn)
    assert section.angle == pytest.approx(0.3)
    for k, inertia in enumerate((0.03 * 0.06**3 / 12, 0.06 * 0.03**3 / 12)):
        force = np.array([(0, c, s), (0, -s, c)][k])
        tip = cantilever(section, force=force)[0][0]
        assert tip @ force == pytest.approx(bending(inertia, plain.area, 5 / 6), rel=1e-4)


def test_tapers():
    """Unit-load integrals over the length of a cone, and the turn of a rectangle of varying sides."""
    s = (np.arange(1000) + 0.5) / 1000
    r = 0.04 - 0.02 * s
    exact = np.mean((1 - s) ** 2 / (E * np.pi * r**4 / 4)) + np.mean(1 / (6 / 7 * G * np.pi * r**2))
    errors = [
        1 + cantilever((wf.Circle(0.04), wf.Circle(0.02)), (0, 0, -1), elements=n)[0][0, 2] / exact for n in (4, 8)
    ]
    assert abs(errors[1]) < 1e-3
    assert errors[0] / errors[1] > 3.5
    ends = [wf.Rectangle(0.08, 0.04), wf.Rectangle(0.04, 0.06)]
    between = [wf.Rectangle(0.08 - 0.04 * x, 0.04 + 0.02 * x) for x in s[::10]]
    turn = cantilever(ends, moment=(1, 0, 0))[0]
    assert turn[2, 2] == pytest.approx(np.mean([1 / (G * x.torsion_ratio * x.polar) for x in between]), rel=2e-3)


@ROUND
def test_pressed_on_a_cylinder(section, bore):
    """Ends go down by 0.3 r with the middle on a cylinder: the force of a beam bent by as much, so contact is at r."""
    d, b = 0.3 * R, wf.ModelBuilder(gravity=(0, 0, 0))
    beam = b.add_beam(
        [(0, 0, R + 0.05), (L, 0, R + 0.05)], elements=8, section=section, normal=(0, 0.3, 1), material=LAW
    )
    down = ([0, 1], [(0, 0, 0), (0, 0, -d)])
    b.drive(beam.start, displacement=down)
    b.drive(beam.end, displacement=down, components="yz")
    b.clamp(beam.start, slots="section", components="y")
    rod = b.add_collider(wf.Cylinder((L / 2, -0.3, 0), (L / 2, 0.3, 0), 0.05))
    contact = b.add_contact(beam.surface("side"), rod)
    static = wf.solve_static(b.finalize(device="cpu"), load_steps=2)
    I, A = np.pi * (R**4 - bore**4) / 4, np.pi * (R**2 - bore**2)  # noqa: E741
    stiffness = 1 / (L**3 / (48 * E * I) + L / (4 * section.shear * G * A))
    assert static.simulation.contact_record(contact).force[0, -1, 2] == pytest.approx(stiffness * d, rel=1e-2)


def test_surfaces():
    """Areas of the faces, the volume of the drawn surface, and points on the circle at any angle."""
    for section, bore in ((CIRCLE, 0.0), (TUBE, BORE)):
        b = wf.ModelBuilder()
        beam = b.add_beam([(0, 0, 0), (L, 0, 0)], elements=2, section=section, normal=(0, 0, 1), material=LAW)
        areas = {"start": (R**2 - bore**2) * np.pi, "end": (R**2 - bore**2) * np.pi, "side": 2 * np.pi * R * L}
        for face, area in areas.items():
            surface = beam.surface(face)
            assert facet_areas(beam, facet_tables(surface)).sum() == pytest.approx(area, rel=1e-3)
        points = beam.skin.slot_weights @ beam.reference + beam.origin
        radius = np.linalg.norm(points[:, 1:], axis=1)
        assert radius.max() == pytest.approx(R, rel=3e-4)
        wall = radius[np.abs(points[:, 0] - 0.3 * L) < 0.1]
        assert np.unique(np.round(wall / R, 3)).tolist() == sorted({1.0, round(bore / R, 3)} - {0.0})
        t = points[beam.skin.triangles]
        volume = np.linalg.det(t).sum() / 6
        assert volume == pytest.approx(np.pi * (R**2 - bore**2) * L, rel=2e-2)


def test_thickness_per_node():
    """A strip whose height falls from t to t/2 under a load at its end: the integral of beam theory, nu = 0."""
    t, law = 0.02, wf.SVK(E=E, nu=0.0, density=RHO)

    def tip(thickness):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        strip = b.add_shell(wf.mesh.grid((L, 0.1), cells=(16, 1)), thickness=thickness, material=law)
        b.clamp(strip.edge("x-"), slots="position+director")
        b.add_traction(strip.surface("top"), (0, 0, -1.0))
        b.add_probe("tip", strip.edge("x+"))
        return wf.solve_static(b.finalize(device="cpu"), load_steps=1).probe("tip").displacement[0, -1, 2]

    s = (np.arange(1000) + 0.5) / 1000
    h = t * (1 - 0.5 * s)
    exact = -np.mean(0.5 * (1 - s) ** 2 * (1 - s) / (E * h**3 / 12)) - np.mean((1 - s) / (5 / 6 * E / 2 * h))
    thin = tip(lambda X: t * (1 - 0.5 * X[:, 0]))
    assert thin == pytest.approx(exact, rel=5e-3)
    grid = wf.mesh.grid((L, 0.1), cells=(16, 1))
    assert tip(t * (1 - 0.5 * grid.points[:, 0])) == thin


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: wf.Circle(0.0), "Circle: r = 0.0 must be a positive"),
        (lambda: wf.Circle("3 mm"), "write 0.003"),
        (lambda: wf.Tube(0.1, 0.1), "must be below the radius"),
        (lambda: wf.Tube(0.1, -0.01), "Tube: thickness = -0.01"),
        (lambda: wf.Section(SQUARE, [1, 1, 1, -1]), "weights must be 4 positive areas"),
        (lambda: wf.Section(SQUARE, [1, 1]), "weights must be 4 positive areas"),
        (lambda: wf.Section(SQUARE[:, :1], np.ones(4)), r"shape \(n, 2\)"),
        (lambda: wf.Section(SQUARE[:2], np.ones(2)), "lie on a line"),
        (lambda: wf.Section(SQUARE, np.ones(4), outline=SQUARE[:2]), r"outline must be finite vertices \(k, 2\)"),
        (lambda: wf.Section(SQUARE, np.ones(4), outline=SQUARE[[0, 2, 1, 3]]), "no area|crosses itself"),
        (lambda: wf.Section(SQUARE, np.ones(4), outline=SQUARE), "weights sum to 4 m"),
        (lambda: wf.Section(SQUARE, np.ones(4), torsion=9.0), "above the polar moment"),
        (lambda: cantilever((CIRCLE, TUBE)), "must be of one shape"),
        (lambda: cantilever((TUBE, wf.Tube(R, 0.01))), "must be of one shape"),
        (lambda: cantilever((CIRCLE,)), "or two of them"),
    ],
)
def test_bad_input(make, message):
    with pytest.raises(wf.ModelError, match=message):
        make()
