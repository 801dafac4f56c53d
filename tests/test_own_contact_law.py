"""A contact law of one's own, in this file alone: an exponential normal force with Hunt and Crossley's damping."""

import math

import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea.contact import LAWS, ContactLaw
from warpfea.contact.evaluation import evaluate_points
from warpfea.contact.tables import contact_constants

f64 = wp.float64
LENGTH = 1e-5
"""L, m, of the force k L (exp(d / L) - 1)."""
WEIGHT = 9.81


@wp.func
def integral(k: f64, c0: f64, g: f64, x: f64) -> f64:
    """Integral of k L (exp(x / L) - 1) (c0 + g x) from 0, J."""
    L = f64(LENGTH)
    e = wp.exp(x / L)
    return k * L * (c0 * (L * (e - f64(1.0)) - x) + g * (L * x * e - L * L * (e - f64(1.0)) - f64(0.5) * x * x))


@wp.func
def exponential(single_point: int, k: f64, g: f64, ramp: f64, eps: f64, delta: f64, delta_n: f64) -> wp.vec4d:
    """F = k L (exp(d / L) - 1) (1 + g (d - d_n)), not below 0."""
    c0 = f64(1.0) - g * delta_n
    if delta <= f64(0.0) or c0 + g * delta <= f64(0.0):
        return wp.vec4d()
    e = wp.exp(delta / f64(LENGTH))
    spring = k * f64(LENGTH) * (e - f64(1.0))
    psi = integral(k, c0, g, delta)
    if c0 < f64(0.0):
        psi -= integral(k, c0, g, -c0 / g)
    size = integral(k, wp.abs(c0), g, delta)
    return wp.vec4d(spring * (c0 + g * delta), k * e * (c0 + g * delta) + spring * g, psi, size)


@pytest.fixture
def registered(monkeypatch):
    monkeypatch.setitem(LAWS, "exponential", ContactLaw(exponential))


def resting_block(law, other="collider", **options):
    """A stiff cube of 1 kg on a floor; k so that it rests at a depth of 2 L with the exponential law."""
    b = wf.ModelBuilder(gravity=(0, 0, -WEIGHT))
    mesh = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1))
    block = b.add_solid(mesh, material=wf.SVK(E=1e10, nu=0.0, density=1000.0), name="block")
    if other == "collider":
        other = b.add_collider(wf.HalfSpace(normal=(0, 0, 1), offset=0.0))
    else:
        where = wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), origin=(0, 0, -0.1))
        base = b.add_solid(where, material=wf.SVK(E=1e10, nu=0.0, density=1000.0), name="base")
        b.clamp(base.nodes(lambda X: X[:, 2] < 1.0))
        other = base.surface("z+")
    pad = b.add_contact(
        block.surface("z-"), other, law=law, name="pad", **{"stiffness": "region", "restitution": 1.0, **options}
    )
    return b, block, pad


def stiffness_for_depth():
    k = contact_constants(resting_block("default")[2])["normal_stiffness"]
    return WEIGHT / (LENGTH * math.expm1(2.0)) / k


@wp.kernel(enable_backward=False)
def law_values(g: f64, delta: wp.array(dtype=f64), delta_n: wp.array(dtype=f64), out: wp.array(dtype=wp.vec4d)):
    i = wp.tid()
    out[i] = exponential(0, f64(1e6), g, f64(0.0), f64(0.0), delta[i], delta_n[i])


def evaluated(g, delta, delta_n):
    """Force, its derivative, its integral, and the magnitude of its terms, each (n,)."""
    arrays = [wp.array(x, dtype=f64, device="cpu") for x in np.broadcast_arrays(delta, delta_n)]
    out = wp.zeros(len(delta), dtype=wp.vec4d, device="cpu")
    wp.launch(law_values, len(delta), inputs=[g, *arrays, out], device="cpu")
    return out.numpy().T


@pytest.mark.parametrize("g", [0.0, 3e4])
@pytest.mark.parametrize("start", [-1e-5, 5e-6, 6e-5])
def test_derivatives_are_differences(g, start):
    """The integral's derivative is the force, the force's the second value; also where damping ends it."""
    delta = np.linspace(-1e-5, 5e-5, 602)
    force, slope, psi, size = evaluated(g, delta, start)
    step = 1e-9
    above, below = (evaluated(g, delta + sign * step, start) for sign in (1.0, -1.0))
    smooth = (above[0] > 0.0) == (below[0] > 0.0)  # no kink between
    assert smooth.sum() > 598
    assert (force > 0.0).sum() > 50
    np.testing.assert_allclose((above[2] - below[2]) / (2.0 * step), force, rtol=1e-6, atol=1e-6 * force.max())
    change = (above[0] - below[0]) / (2.0 * step)
    np.testing.assert_allclose(change[smooth], slope[smooth], rtol=1e-6, atol=1e-6 * slope.max())
    np.testing.assert_array_equal(psi[force == 0.0], 0.0)
    summed = np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(delta))  # it is 0 where the force begins
    np.testing.assert_allclose(psi[1:], summed, atol=1e-4 * psi.max())
    assert (size >= 0.0).all()


def test_without_damping_it_is_elastic():
    """For g = 0 the energy depends on the depth alone, and so does the force for delta_n = delta."""
    delta = np.linspace(1e-6, 5e-5, 20)
    spring = evaluated(0.0, delta, 0.0)
    np.testing.assert_array_equal(evaluated(0.0, delta, delta), spring)
    np.testing.assert_allclose(evaluated(3e4, delta, delta)[0], spring[0], rtol=1e-14)
    L = LENGTH
    np.testing.assert_allclose(spring[2], 1e6 * L * (L * np.expm1(delta / L) - delta), rtol=1e-10)


@pytest.mark.parametrize("other", ["collider", "body"])
def test_resting_depth(registered, other):
    """d = L ln(1 + W / (k L)); a linear spring would give L (exp(2) - 1)."""
    half = 2.0 if other == "body" else 1.0  # two equal bodies have half the stiffness
    b, block, _ = resting_block("exponential", other, stiffness=("region", half * stiffness_for_depth()))
    b.clamp(block.nodes("z+"), components="xy")
    result = wf.solve_static(b.finalize(device="cpu"), load_steps=2, stabilise=True)
    depth = -result.displacements(block)[0][block.mesh.points[:, 2] < 1e-9, 2]
    np.testing.assert_allclose(depth, 2.0 * LENGTH, rtol=2e-3)


def test_energy_of_an_impact(registered):
    """The stored energy is the law's own, and the ledger closes with what the damping takes."""
    b, block, _ = resting_block("exponential", stiffness=("region", stiffness_for_depth()), restitution=0.5)
    b.set_initial(block, velocity=(0, 0, -0.01))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=2e-5, solver=wf.NewtonPCG(tol=1e-12))
    k = stiffness_for_depth() * contact_constants(resting_block("default")[2])["normal_stiffness"]
    deepest = 0.0
    for _ in range(10):
        sim.step(20)
        depth = sim.contact_record("pad").penetration[0, -1]
        if depth > deepest:
            deepest = depth
            stored = k * LENGTH * (LENGTH * math.expm1(depth / LENGTH) - depth)
            assert sim.energies()["contact"][0] == pytest.approx(stored, rel=1e-3)
    energies = sim.energies()
    assert deepest > 2.0 * LENGTH
    assert energies["contact_loss"][0] > 0.1 * 0.5 * 0.01**2
    assert abs(energies["ledger_residual"][0]) < 1e-9 * 0.5 * 0.01**2


def linear(factor):
    """A law of `factor` times the linear spring, undamped."""

    @wp.func
    def force(single_point: int, k: f64, g: f64, ramp: f64, eps: f64, delta: f64, delta_n: f64) -> wp.vec4d:
        if delta <= f64(0.0):
            return wp.vec4d()
        K = f64(factor) * k
        psi = f64(0.5) * K * delta * delta
        return wp.vec4d(K * delta, K, psi, psi)

    return ContactLaw(force)


def relative_force(law, depth=1e-4):
    """Force of a block at a depth over that of a linear spring, as evaluated by a new model."""
    b, _, pad = resting_block(law)
    model = b.finalize(device="cpu")
    state = model.state()
    state.displacement.fill_(wp.vec3d(0.0, 0.0, -depth))
    (term,) = (term for term in model.terms.all if term.name == "contact")
    return evaluate_points(term, state)[1].sum() / (contact_constants(pad)["normal_stiffness"] * depth)


def test_laws_may_change_place_and_definition(monkeypatch):
    """A law is that of the entry of `LAWS` when the model is made, in any order of entries, also if redefined."""
    two, three = linear(2.0), linear(3.0)
    monkeypatch.setitem(LAWS, "one", two)
    assert relative_force("one") == pytest.approx(2.0, rel=1e-9)
    monkeypatch.delitem(LAWS, "one")
    monkeypatch.setitem(LAWS, "another", three)
    monkeypatch.setitem(LAWS, "one", two)
    assert relative_force("one") == pytest.approx(2.0, rel=1e-9)
    assert relative_force("another") == pytest.approx(3.0, rel=1e-9)
    monkeypatch.setitem(LAWS, "one", three)
    assert relative_force("one") == pytest.approx(3.0, rel=1e-9)
    monkeypatch.setitem(LAWS, "default", two)
    assert relative_force("default") == pytest.approx(2.0, rel=1e-9)


@wp.func
def single_precision(single_point: int, k: f64, g: f64, ramp: f64, eps: f64, delta: f64, delta_n: f64) -> wp.vec4d:
    return wp.vec4d(k * delta, k, 0.5 * k * delta * delta, f64(0.0))


def test_a_corrected_law_compiles(monkeypatch):
    monkeypatch.setitem(LAWS, "own", ContactLaw(single_precision))
    with pytest.raises(RuntimeError, match="single_precision"):
        relative_force("own")
    monkeypatch.setitem(LAWS, "own", linear(2.0))
    assert relative_force("own") == pytest.approx(2.0, rel=1e-9)


SPOILT = {
    "a bare function": (exponential, {}, r"LAWS\['own'\] is .*, no ContactLaw; write LAWS\['own'\] = ContactLaw"),
    "no device function": (
        ContactLaw(lambda *args: 0.0),
        {},
        r"`normal` of law 'own' is .*, no device function.*@wp.func",
    ),
    "smoothing": (ContactLaw(exponential), {"smoothing": 1e-4}, "law 'own' declares no smoothing; leave it out"),
    "explicit": (
        ContactLaw(exponential),
        {"treatment": "explicit"},
        "law 'own' declares no explicit force; 'paper'",
    ),
}


@pytest.mark.parametrize("case", SPOILT)
@pytest.mark.parametrize("other", ["collider", "body"])
def test_a_law_that_does_not_fit_is_refused(case, other, monkeypatch):
    law, options, message = SPOILT[case]
    monkeypatch.setitem(LAWS, "own", law)
    with pytest.raises(wf.ModelError, match=f"contact 'pad': .*{message}"):
        resting_block("own", other, **options)


def test_an_unknown_law_is_refused():
    with pytest.raises(wf.ModelError, match="law = 'exponential' is none of 'default', 'paper', 'smooth'"):
        resting_block("exponential")
