"""Stiffness of contact from the elements that touch, and restitution 0."""

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.contact.law import CRITICAL_DAMPING, HARDENING, LAWS, ContactLaw, default_law, hunt_crossley

import warpfea as wf
from warpfea.contact.tables import ELEMENT_STIFFNESS

f64 = wp.float64
SIDE, NU = 0.1, 0.3


def block(b, E, cells, low=0.0, name="block"):
    mesh = wf.mesh.box((SIDE,) * 3, cells=(cells,) * 3, origin=(0, 0, low))
    return b.add_solid(mesh, material=wf.NeoHookean.from_E_nu(E=E, nu=NU, density=1000.0), name=name)


def pressed(E, cells, other, *, pressure=1e4, worlds=1, **options):
    """Model of a block that a pressure, Pa, presses on a floor or on a clamped block (E, cells), and the contact."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = block(b, E, cells)
    if other is None:
        base = b.add_collider(wf.HalfSpace((0, 0, 1)))
    else:
        base = block(b, *other, low=-SIDE, name="base")
        b.clamp(base.nodes(lambda X: np.ones(len(X), dtype=bool)))
        base = base.surface("z+")
    b.clamp(body.nodes("z+"), components="xy")
    b.add_traction(body.surface("z+"), (0, 0, -pressure))
    pad = b.add_contact(body.surface("z-"), base, **({"stiffness": "elements"} | options))
    return b.finalize(device="cpu", worlds=worlds), pad


def mean_depth(model, pad, world=0):
    """Depth of the contact whose force is that of the record, m."""
    r = wf.solve_static(model, stabilise=True).contact_record(pad)
    return float(r.stored[world, -1] / r.normal_force[world, -1]) * 2.0


@pytest.mark.parametrize("E", [1e4, 1e9])
@pytest.mark.parametrize("other", [None, (1e9, 2), (1e5, 1)])
def test_the_depth_is_a_tenth_of_the_compression_of_the_elements(E, other):
    """Of a uniform pressure p: p (1 - nu^2) (h_1/E_1 + h_2/E_2) / 10, h the heights of the elements."""
    p = 1e-3 * (E if other is None else min(E, other[0]))
    model, pad = pressed(E, 2, other, pressure=p)
    heights = SIDE / 2 / E + (0.0 if other is None else SIDE / other[1] / other[0])
    wanted = p * (1.0 - NU**2) * heights / ELEMENT_STIFFNESS
    assert mean_depth(model, pad) == pytest.approx(wanted, rel=0.02)  # the pressure is uneven at the borders


def test_a_uniform_pressure_stays_uniform_over_elements_of_unlike_depth():
    """Their depths differ by less than four times, so they share a stiffness."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))

    def leaning(X):
        return np.column_stack([X[:, :2], X[:, 2] * (1.0 + 8.0 * X[:, 0] * (1.0 - X[:, 2] / SIDE))])

    mesh = wf.mesh.box((SIDE,) * 3, cells=(3, 1, 2), map=leaning)
    body = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=NU, density=1000.0))
    b.add_traction(body.surface("z+"), (0, 0, -1e3))
    pad = b.add_contact(body.surface("z-"), b.add_collider(wf.HalfSpace((0, 0, 1))), stiffness="elements")
    r = wf.solve_static(b.finalize(device="cpu"), stabilise=True).contact_record(pad)
    mean = 2.0 * r.stored[0, -1] / r.normal_force[0, -1]
    assert r.penetration[0, -1] == pytest.approx(mean, rel=1e-3)


def test_the_stiffness_follows_the_parameters_of_a_world():
    model, pad = pressed(1e6, 1, None, worlds=2)
    model.set_parameter("block.E", [1e6, 4e6])
    first, second = (mean_depth(model, pad, world) for world in (0, 1))
    assert second == pytest.approx(0.25 * first, rel=0.02)


def test_a_factor_is_of_the_elements_unless_the_region_is_named():
    wanted = (None, "elements", 4.0, "region", ("region", 4.0))
    depths = [mean_depth(*pressed(1e6, 2, None, stiffness=s)) for s in wanted]
    assert depths[0] == depths[1] > 3.0 * depths[2]
    assert depths[3] > 3.0 * depths[4]
    assert depths[3] > 1.1 * depths[0]


@wp.kernel(enable_backward=False)
def law_values(
    single: int, rate: f64, ramp: f64, before: f64, delta: wp.array(dtype=f64), out: wp.array(dtype=wp.vec4d)
):  # fmt: skip
    i = wp.tid()
    out[i] = default_law(single, f64(1e6), rate, ramp, f64(0.0), delta[i], before)


def law_at(d, rate, before, *, single=0, ramp=0.0):
    """Force, slope, potential and its size at the depths d, m."""
    out = wp.zeros(len(d), dtype=wp.vec4d, device="cpu")
    inputs = [single, rate, ramp, before, wp.array(d, dtype=f64, device="cpu"), out]
    wp.launch(law_values, len(d), inputs, device="cpu")
    return out.numpy().T


def check_differences(d, force, slope, psi, size):
    """Slope and potential by differences, but for the kinks of the force."""
    np.testing.assert_allclose(np.gradient(psi, d)[1:-1], force[1:-1], atol=2e-3 * force.max())
    ends = np.flatnonzero((force[1:] > 0.0) != (force[:-1] > 0.0))
    smooth = np.setdiff1d(np.arange(2, len(d) - 2), ends[:, None] + np.arange(-2, 4))
    np.testing.assert_allclose(np.gradient(force, d)[smooth], slope[smooth], rtol=2e-2, atol=1e-3 * slope.max())
    assert (size >= psi - 1e-15).all()


@pytest.mark.parametrize("single", [0, 1])
@pytest.mark.parametrize("before", [-1e-4, 0.0, 1e-3])
def test_without_a_rebound_the_law_is_continuous_and_has_a_potential(single, before):
    """F = max(0, k d^m + g d^((m-1)/2) (d - max(0, d_n))), m = 1 or 1.5, its slope and integral by differences."""
    g = 5e5
    d = np.linspace(-2e-4, 3e-3, 20001)
    force, slope, psi, size = law_at(d, -g, before, single=single)
    depth = np.maximum(d, 0.0)
    wanted = 1e6 * depth ** (1.5 if single else 1.0) + g * depth ** (0.25 * single) * (depth - max(before, 0.0))
    np.testing.assert_allclose(force, np.maximum(wanted, 0.0), atol=1e-12 * force.max())
    check_differences(d, force, slope, psi, size)


@pytest.mark.parametrize("rate", [0.0, 1e3, -5e6])  # elastic, Hunt and Crossley's, restitution 0
@pytest.mark.parametrize("before", [-1e-4, 8e-4, 2.8e-3])  # of the last two some begin after the contact has hardened
def test_a_contact_hardens_beyond_a_depth(rate, before):
    """F = k (d + c (d - r)^2 / r) beyond r, with the damping of F or of k; the same bits up to r."""
    r = 1e-3
    d = np.linspace(-2e-4, 4e-3, 20001)
    force, slope, psi, size = law_at(d, rate, before, ramp=r)
    np.testing.assert_array_equal(force[d <= r], law_at(d, rate, before)[0][d <= r])
    elastic = 1e6 * (np.maximum(d, 0.0) + HARDENING * np.maximum(d - r, 0.0) ** 2 / r)
    damped = elastic * (1.0 + rate * (d - before)) if rate >= 0.0 else elastic - rate * (d - max(before, 0.0)) * (d > 0)
    np.testing.assert_allclose(force, np.maximum(damped, 0.0), atol=1e-12 * force.max())
    check_differences(d, force, slope, psi, size)


TURNS = {"edge": ((1, 0, 0), np.pi / 4), "corner": ((1, 0, 0), np.pi / 6, (0, 1, 0), -np.pi / 6)}


def turn(axis, angle, *more):
    """Matrix of a rotation about an axis through 0, after that of `more`."""
    K = np.cross(np.eye(3), axis)
    R = np.eye(3) + np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
    return R @ turn(*more) if more else R


def pushed(how, other, stiffness, cells=2, load_steps=5):
    """Penetration over an element's side, and force, N, of a cube whose edge or corner is pushed 4 mm into a floor or
    a block as soft as itself by its far faces."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    R = turn(*TURNS[how])
    corners = (np.array(np.meshgrid(*[(0, SIDE)] * 3)).reshape(3, -1).T - SIDE / 2) @ R.T
    centre = np.array([0, 0, -corners[:, 2].min()])
    rubber = wf.NeoHookean.from_E_nu(E=1e6, nu=NU, density=1000.0)
    mesh = wf.mesh.box((SIDE,) * 3, cells=(cells,) * 3, map=lambda X: (X - SIDE / 2) @ R.T + centre)
    cube = b.add_solid(mesh, material=rubber, name="cube")
    far = slice(1 if how == "edge" else 0, 3)
    b.drive(cube.nodes(lambda X: (((X - centre) @ R)[:, far] > 0.499 * SIDE).any(axis=1)), displacement=(0, 0, -4e-3))
    if other == "floor":
        base = b.add_collider(wf.HalfSpace((0, 0, 1)))
    else:
        mesh = wf.mesh.box((0.2, 0.2, 0.1), cells=(2 * cells, 2 * cells, cells), origin=(-0.1, -0.1, -0.1))
        block = b.add_solid(mesh, material=rubber, name="block")
        b.clamp(block.nodes("z-"))
        base = block.surface("z+")
    pad = b.add_contact(cube, base, stiffness=stiffness)
    record = wf.solve_static(b.finalize(device="cpu"), load_steps=load_steps, unstable="ignore").contact_record(pad)
    return record.penetration[0, -1] * cells / SIDE, record.normal_force[0, -1]


@pytest.mark.parametrize("other", ["floor", "block"])
@pytest.mark.parametrize("how", TURNS)
def test_edges_and_corners_sink_one_hundredth_of_an_element(how, other):
    """Before, a corner sank half of its way into the block, with half of the force of a stiff contact."""
    depth, force = pushed(how, other, None)
    assert depth < 0.01
    assert force == pytest.approx(pushed(how, other, 100.0)[1], rel=0.1)


def test_an_edge_rests_in_the_valley_between_two_facets():
    """It presses on the border of facets, which bend; points near the end of one were taken to and fro."""
    assert pushed("edge", "block", None, cells=4, load_steps=10)[0] < 0.01


def dropped(E, height, *, t_end, dtype="float64", **options):
    """Simulation of a falling block, and its contact with the floor."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    body = block(b, E, 2, low=height)
    pad = b.add_contact(body, b.add_collider(wf.HalfSpace((0, 0, 1))), stiffness="elements", **options)
    sim = wf.Simulation(b.finalize(device="cpu", dtype=dtype), dt=1e-3)
    sim.run(t_end=t_end)
    return sim, pad


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_a_stiff_block_does_not_come_back(dtype):
    """After 0.2 s less than 1e-6 of the energy of a drop of 2 cm is left."""
    sim, pad = dropped(1e8, 0.02, t_end=0.2, restitution=0.0, dtype=dtype)
    assert sim.energies()["kinetic"][0] < 1e-6 * 9.81 * 0.02
    force = sim.contact_record(pad).normal_force[0, -20:].mean()
    assert force == pytest.approx(9.81, rel=1e-3 if dtype == "float64" else 1e-2)
    assert abs(sim.energies()["ledger_residual"][0]) < (1e-6 if dtype == "float64" else 1e-3) * 9.81 * 0.02


@pytest.mark.parametrize(("speed", "damped"), [(0.045, False), (0.055, True)])
def test_a_slow_approach_is_not_damped(speed, damped):
    """A floor that presses a held block, and goes back."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = block(b, 1e6, 1)
    b.clamp(body.nodes("z+"))
    times = [0.0, 0.02, 0.04]
    floor = b.add_collider(wf.HalfSpace((0, 0, 1), -1e-4), path=(times, [(0, 0, 0), (0, 0, 0.02 * speed), (0, 0, 0)]))
    pad = b.add_contact(body, floor)
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    sim.step(40)
    record = sim.contact_record(pad)
    assert record.normal_force.max() > 1.0
    assert (record.loss.sum() > 1e-3 * record.stored.max()) == damped
    assert abs(record.loss.sum()) < 1e-12 or damped


@pytest.mark.parametrize(("E", "restitution"), [(1e11, 0.3), (2e11, 0.0)])
def test_a_stiff_block_on_a_wheel_rests_at_the_rounding_of_its_gap(E, restitution):
    """Depths of 1e-10 m are differences of positions of 0.1 m: residuals do not fall to 1e-8 of the weight."""
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    mesh = wf.mesh.box((SIDE,) * 3, cells=(2, 2, 1), origin=(-SIDE / 2, -SIDE / 2, SIDE / 2))
    body = b.add_solid(mesh, material=wf.SVK(E=E, nu=NU, density=1000.0))
    b.clamp(body.nodes(lambda X: np.ones(len(X), dtype=bool)), components="xy")
    turn = wf.Rotation(anchor=(0, 0, 0), axis=(0, 1, 0), angle=([0, 100], [0, 100]))
    wheel = b.add_collider(wf.Cylinder((0, -1, 0), (0, 1, 0), SIDE / 2), path=turn)
    pad = b.add_contact(body, wheel, mu=0.4, restitution=restitution, stiffness="elements")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-3)
    reports = [sim.step() for _ in range(30)]
    assert all(report.converged.all() for report in reports)
    assert max(float(report.floor[0]) for report in reports) < 1e-4
    assert sim.contact_record(pad).force[0, -1] == pytest.approx([0.4 * 9.81, 0.0, 9.81], rel=1e-4, abs=1e-4)


def test_a_strip_laid_on_a_drum_of_its_radius_is_not_refused():
    """By the default options; before, the line search found no decrease after 65 steps."""
    R = 0.25

    def bent(X):
        angle, r = X[:, 0] / R, R + X[:, 2]
        return np.column_stack([r * np.sin(angle), X[:, 1], r * np.cos(angle)])

    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    mesh = wf.mesh.box((R, 0.1, 0.02), cells=(6, 2, 1), origin=(-R / 2, -0.05, 0), map=bent)
    strip = b.add_solid(mesh, material=wf.SVK(E=1e7, nu=NU, density=1000.0))
    b.add_contact(strip.surface("z-"), b.add_collider(wf.Cylinder((0, -1, 0), (0, 1, 0), R)))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    assert all(sim.step().converged.all() for _ in range(80))


def test_a_soft_block_sinks_little():
    """E = 1e5 Pa from 0.5 m: 40 mm, most of an element, with one stiffness of the region."""
    sim, pad = dropped(1e5, 0.5, t_end=0.36, restitution=0.0)
    assert sim.contact_record(pad).normal_force[0].max() > 100.0
    assert sim.contact_record(pad).penetration[0].max() < 0.05 * 0.05


def test_a_law_without_critical_damping_needs_a_restitution(monkeypatch):
    assert LAWS["default"].traits & CRITICAL_DAMPING
    monkeypatch.setitem(LAWS, "mine", ContactLaw(hunt_crossley))
    b = wf.ModelBuilder()
    floor = b.add_collider(wf.HalfSpace((0, 0, 1)))
    with pytest.raises(wf.ModelError, match=r"must be above 0 and at most 1: law .* has no critical damping"):
        b.add_contact(block(b, 1e6, 1), floor, law="mine", restitution=0.0)
