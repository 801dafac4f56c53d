"""Laws of contact alone: each force is the derivative of its scalar, grows with depth, and rebounds as stated."""

import functools
import math

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.contact.law import DEFAULT, PAPER, SMOOTH, huber_friction, law_functions, smooth_friction

from warpfea.contact.tables import hunt_crossley_damping, restitution_beta

COUNT = 4000
DEVICES = ["cpu", pytest.param("cuda", marks=pytest.mark.cuda)]
STEP = 1e-6
"""Of central differences, over the depth's scale."""


@functools.cache
def _kernels():
    normal_law, friction = law_functions().normal_law, huber_friction
    f64, vec3d = wp.float64, wp.vec3d
    module = wp.get_module("contact_laws_alone")
    wp.set_module_options({"enable_backward": False}, module=module)

    @wp.kernel(module=module)
    def normal(
        law: int, lumped: int, k: f64, g: wp.array(dtype=f64), ramp: f64, eps: f64, delta: wp.array(dtype=f64),
        delta_n: wp.array(dtype=f64), out: wp.array(dtype=wp.vec4d),
    ):  # fmt: skip
        i = wp.tid()
        out[i] = normal_law(law, lumped, k, g[i], ramp, eps, delta[i], delta_n[i])

    @wp.kernel(module=module)
    def tangent(
        smooth: int, a: f64, b: f64, slip: wp.array(dtype=vec3d), cap: wp.array(dtype=f64),
        out: wp.array(dtype=wp.vec2d),
    ):  # fmt: skip
        i = wp.tid()
        if smooth != 0:
            out[i] = smooth_friction(slip[i], a, b, cap[i])
        else:
            out[i] = friction(a * slip[i], a, cap[i])

    return normal, tangent


def law_at(law, lumped, k, g, ramp, eps, delta, delta_n, device="cpu"):
    """(n, 3): normal force, N, its derivative, N/m, and its potential, J."""
    shape = np.broadcast(g, delta, delta_n).shape
    arrays = [
        wp.array(np.broadcast_to(x, shape).astype(float), dtype=wp.float64, device=device) for x in (g, delta, delta_n)
    ]
    out = wp.zeros(shape, dtype=wp.vec4d, device=device)
    inputs = [law, lumped, k, arrays[0], ramp, eps, arrays[1], arrays[2], out]
    wp.launch(_kernels()[0], shape[0], inputs, device=device)
    return out.numpy()


def friction_at(smooth, a, b, slip, cap, device="cpu"):
    """(n, 2): potential, J, and what multiplies the trial force or the slip."""
    out = wp.zeros(len(slip), dtype=wp.vec2d, device=device)
    inputs = [
        smooth,
        a,
        b,
        wp.array(slip, dtype=wp.vec3d, device=device),
        wp.array(cap, dtype=wp.float64, device=device),
    ]
    wp.launch(_kernels()[1], len(slip), [*inputs, out], device=device)
    return out.numpy()


NORMAL = {
    "default, patch": (DEFAULT, 0, 0.0, 0.0),
    "default, sphere": (DEFAULT, 1, 0.0, 0.0),
    "paper, patch": (PAPER, 0, 0.0, 0.0),
    "paper, sphere": (PAPER, 1, 0.0, 0.0),
    "paper, patch ramped in": (PAPER, 0, 0.4, 0.0),
    "smooth": (SMOOTH, 0, 0.0, 0.05),
}
K = 3.0


def random_depths(law, seed=0):
    """Rates, depths and depths before, of both signs; a third of the rates far above and far below 1."""
    rng = np.random.default_rng(seed)
    g = rng.uniform(0.0, 4.0, COUNT) * rng.choice([1e-3, 1.0, 30.0], COUNT)
    delta, delta_n = rng.uniform(-0.2, 1.0, COUNT), rng.uniform(-1.0, 1.0, COUNT)
    g[:20] = 0.0
    return g, delta, delta_n


def inner(parts, delta, kinks):
    """Points whose differences do not straddle a kink: the force acts on both sides or on neither."""
    ok = (parts[0][:, 0] > 0.0) == (parts[1][:, 0] > 0.0)
    for kink in kinks:
        ok &= np.abs(delta - kink) > 2.0 * STEP
    return ok


@pytest.mark.parametrize("name", NORMAL)
@pytest.mark.parametrize("device", DEVICES)
def test_normal_force_is_the_derivative_of_its_potential(device, name):
    law, lumped, ramp, eps = NORMAL[name]
    g, delta, delta_n = random_depths(law)
    at = [law_at(law, lumped, K, g, ramp, eps, delta + s, delta_n, device) for s in (-STEP, STEP)]
    middle = law_at(law, lumped, K, g, ramp, eps, delta, delta_n, device)
    ok = inner(at, delta, (0.0, ramp))
    assert ok.mean() > 0.99
    difference = (at[1][:, 2] - at[0][:, 2]) / (2.0 * STEP)
    scale = middle[:, 0] + K + g
    assert np.abs(difference - middle[:, 0])[ok].max() <= 1e-8 * scale.max()
    assert (np.abs(difference - middle[:, 0]) / scale)[ok].max() < 1e-7


@pytest.mark.parametrize("name", NORMAL)
@pytest.mark.parametrize("device", DEVICES)
def test_stiffness_is_the_derivative_of_the_normal_force(device, name):
    law, lumped, ramp, eps = NORMAL[name]
    g, delta, delta_n = random_depths(law, seed=1)
    delta = np.where(np.abs(delta) < 1e-2, 1e-2, delta)  # delta^(1/4) bends without bound at 0
    at = [law_at(law, lumped, K, g, ramp, eps, delta + s, delta_n, device) for s in (-STEP, STEP)]
    middle = law_at(law, lumped, K, g, ramp, eps, delta, delta_n, device)
    ok = inner(at, delta, (0.0, ramp))
    difference = (at[1][:, 0] - at[0][:, 0]) / (2.0 * STEP)
    assert (np.abs(difference - middle[:, 1]) / (K + g))[ok].max() < 1e-6


@pytest.mark.parametrize("name", NORMAL)
def test_normal_force_never_pulls_and_grows_with_depth(name):
    law, lumped, ramp, eps = NORMAL[name]
    g, _, delta_n = random_depths(law, seed=2)
    depths = np.linspace(-0.1, 1.0, 221)
    force = np.array([law_at(law, lumped, K, g, ramp, eps, np.full(COUNT, d), delta_n)[:, 0] for d in depths])
    assert force.min() >= 0.0
    assert (np.diff(force, axis=0) >= -1e-13 * (1.0 + force[1:])).all()
    if law != SMOOTH:
        assert (force[depths <= 0.0] == 0.0).all()


def test_smooth_force_tends_to_the_clip_as_eps_vanishes():
    g, delta, delta_n = random_depths(SMOOTH, seed=3)
    force = law_at(SMOOTH, 0, K, g, 0.0, 1e-9, delta, delta_n)[:, 0]
    clip = np.maximum(K * delta + g * (delta - delta_n), 0.0)
    assert np.abs(force - clip).max() <= 0.5e-9 * 1.001


@pytest.mark.parametrize("smooth", [0, 1])
@pytest.mark.parametrize("device", DEVICES)
def test_friction_is_the_derivative_of_its_potential_and_never_above_its_cap(device, smooth):
    rng = np.random.default_rng(4)
    slip = rng.normal(size=(COUNT, 3)) * rng.choice([1e-3, 1.0], COUNT)[:, None]
    cap = rng.uniform(0.0, 3.0, COUNT)
    a, b = (50.0, 0.02) if smooth else (2.0, 0.0)
    factor = friction_at(smooth, a, b, slip, cap, device)[:, 1]
    force = factor[:, None] * slip * (1.0 if smooth else a)
    assert (np.linalg.norm(force, axis=1) <= cap * (1.0 + 1e-14)).all()
    for axis in range(3):
        shift = np.zeros(3)
        shift[axis] = 1e-4 * (b / a if smooth else 1.0 / a)  # of the slip where the force bends
        high, low = (friction_at(smooth, a, b, slip + s, cap, device)[:, 0] for s in (shift, -shift))
        assert np.abs((high - low) / (2.0 * shift[axis]) - force[:, axis]).max() < (1e-6 if smooth else 1e-4)


def test_smooth_friction_creeps_as_its_formula_says():
    slip = np.array([[0.0, 0.004, 0.0]])
    h, v_eps, cap = 0.01, 0.3, 2.0
    _, factor = friction_at(1, 1.0 / h, v_eps, slip, np.array([cap]))[0]
    v = 0.004 / h
    assert factor * 0.004 == pytest.approx(cap * v / math.hypot(v, v_eps), rel=1e-14)


# a mass on one patch


def impact(lumped, law, e, per_contact):
    """Step, s, and what multiplies the step's change of depth, of a mass of 1 kg at 1 m/s on a contact with k = 1."""
    # half a period of a linear spring, or Hertz's 2.943 d_max / v
    duration = 2.943 * 1.25**0.4 if lumped else math.pi
    h = duration / per_contact
    if law == DEFAULT:
        return h, hunt_crossley_damping(e) / h
    # Eq. (76), S_n = 2 E a = 1.5 k_n
    return h, 2.0 * math.sqrt(5.0 / 6.0) * restitution_beta(e) * math.sqrt(1.5) / h


def run_explicit(lumped, e, per_contact):
    """The paper's law with the force of the last state, then velocity, then place, from touch on."""
    h, g = impact(lumped, PAPER, e, per_contact)
    x, v = 0.0, 1.0
    while x > 0.0 or v > 0.0:
        force = 0.0
        if x > 0.0:
            force = max(0.0, x ** (1.5 if lumped else 1.0) + g * h * (x**0.25 if lumped else 1.0) * v)
        v -= h * force
        x += h * v
    return -v


@functools.cache
def _rebound_kernel():
    """A mass on one contact by backward Euler; the equation of a step is solved by bisection."""
    normal_law = law_functions().normal_law
    f64 = wp.float64
    module = wp.get_module("contact_rebound_alone")
    wp.set_module_options({"enable_backward": False}, module=module)

    @wp.kernel(module=module)
    def rebound(
        law: int, lumped: int, h: wp.array(dtype=f64), g: wp.array(dtype=f64), steps: int, out: wp.array(dtype=f64)
    ):  # fmt: skip
        i = wp.tid()
        x, v = f64(0.0), f64(1.0)
        for _ in range(steps):
            free = x + h[i] * v
            low = wp.min(x, free) - f64(1.0)
            high = free + f64(0.0)  # not another name of free
            for _bisection in range(54):
                middle = f64(0.5) * (low + high)
                force = normal_law(law, lumped, f64(1.0), g[i], f64(0.0), f64(0.0), middle, x)[0]
                if (middle - free) / (h[i] * h[i]) + force > f64(0.0):
                    high = middle
                else:
                    low = middle
            v = (f64(0.5) * (low + high) - x) / h[i]
            x = f64(0.5) * (low + high)
            if x < f64(0.0):
                break
        out[i] = -v

    return rebound


def run_implicit(lumped, law, wanted, per_contact):
    """Restitution of a mass of 1 kg at 1 m/s on a contact with k = 1, for each that is wanted."""
    pairs = [impact(lumped, law, e, per_contact) for e in wanted]
    h, g = (wp.array([pair[k] for pair in pairs], dtype=wp.float64, device="cpu") for k in (0, 1))
    out = wp.zeros(len(pairs), dtype=wp.float64, device="cpu")
    wp.launch(_rebound_kernel(), len(pairs), [law, lumped, h, g, 40 * per_contact, out], device="cpu")
    return out.numpy()


WANTED = (0.1, 0.3, 0.5, 0.7, 0.9)
GIVEN = {"sphere": (0.2527, 0.3971, 0.5503, 0.7182, 0.9020), "patch": (0.2242, 0.3635, 0.5174, 0.6926, 0.8914)}


@pytest.mark.parametrize("model", GIVEN)
def test_rebound_of_the_paper_s_law_explicit_at_a_thousandth_of_the_contact(model):
    got = [run_explicit(int(model == "sphere"), e, 1000) for e in WANTED]
    assert np.abs(np.array(got) - GIVEN[model]).max() < 1e-3


@pytest.mark.parametrize("model", GIVEN)
def test_rebound_of_the_paper_s_law_implicit_extrapolated(model):
    coarse, fine = (run_implicit(int(model == "sphere"), PAPER, WANTED, n) for n in (1000, 2000))
    assert np.abs(2.0 * fine - coarse - GIVEN[model]).max() < 1e-3


@pytest.mark.parametrize("model", GIVEN)
def test_default_law_rebounds_as_wanted(model):
    coarse, fine = (run_implicit(int(model == "sphere"), DEFAULT, WANTED, n) for n in (1000, 2000))
    assert np.abs((2.0 * fine - coarse) / np.array(WANTED) - 1.0).max() < 0.01


def test_damping_of_the_default_law():
    d = [hunt_crossley_damping(e) for e in WANTED]
    assert d == pytest.approx([9.998, 3.087, 1.433, 0.635, 0.1665], rel=5e-4)
    for e, x in zip(WANTED, d):
        assert (1.0 + e) * x == pytest.approx(math.log((1.0 + x) / (1.0 - e * x)), rel=1e-10)


@pytest.mark.parametrize("lumped", [0, 1])
def test_explicit_contact_without_damping_gains_no_energy_at_20_steps(lumped):
    assert run_explicit(lumped, 1.0, 20) ** 2 - 1.0 < 2e-3
