"""Contact laws of one point as derivatives of scalars: normal force of the depth, potentials of friction.

delta is the depth, m; delta_n that at the start of the step; all in float64. The elastic force is k delta^1.5 for a
lumped contact ("sphere"), else k delta.

"default": Hunt and Crossley's normal force and an anchored friction spring. In patches with mu_static > mu the points
begin to slip one after another, the least loaded first, and slipping points carry only mu: a stiff body slides before
mu_static.

"paper": Paper I, Eqs. (73)-(83), unmodified. Known properties: with max(0, .) rebounds for e = 0.1, 0.3, 0.5, 0.7, 0.9
are 0.2527, 0.3971, 0.5503, 0.7182, 0.9020 (spheres) and 0.2242, 0.3635, 0.5174, 0.6926, 0.8914 (patches). The implicit
patch force jumps at first contact, and some impacts have no solution (`smoothing` ramps it). With k_t ~ sqrt(delta) and
a persistent spring, energy is created when the normal load rises (Elata and Berryman 1996). Eq. (83) reverses the
spring where gamma_t v exceeds mu F_n. Eq. (78) does not rotate it with the bodies: a sticking block walks on a rotating
plate.

"smooth": Paper I, 6.2.

A law of one's own is an entry of `LAWS`, see "Add a contact law" in warpfea/README.md.
"""

import functools
from collections.abc import Iterable
from typing import NamedTuple

import warp as wp

from ..common.modules import KernelSet, definition_name, kernel_set

__all__ = [
    "ANY_GAP",
    "CRITICAL_DAMPING",
    "FIXED_SPRING",
    "HARDENING_DEPTH",
    "HARDENS",
    "IMPACT_SPEED",
    "LAWS",
    "MIN_APPROACH_SPEED",
    "SLIP_SPEED",
    "SPEED_DAMPING",
    "TRAIT_BITS",
    "UNLOADING",
    "ContactLaw",
    "OwnLaws",
    "elastic_force",
    "huber_friction",
    "law_code",
    "law_functions",
    "law_names",
    "own_laws",
    "smooth_friction",
]

f64, vec3d, vec4d = wp.float64, wp.vec3d, wp.vec4d
SPEED_DAMPING, UNLOADING, FIXED_SPRING, SLIP_SPEED, ANY_GAP, CRITICAL_DAMPING, HARDENS = (1 << bit for bit in range(7))
"""Traits of a law, added up. SPEED_DAMPING: its damping g is d/(v_i h), with d of the restitution and v_i the largest
approach speed, else gamma_n/h. UNLOADING: a lumped contact that unloads reduces its elastic slip with its radius.
FIXED_SPRING: Eqs. (78) and (83) of Paper I, where the elastic slip does not turn with the bodies and may reverse.
SLIP_SPEED: friction of the slip speed, without elastic slip. ANY_GAP: it acts at any gap. CRITICAL_DAMPING: with
SPEED_DAMPING, restitution 0 is told by g < 0, minus the critical damping over h, N/m. HARDENS: with the stiffness of
the elements `ramp` is the depth beyond which the elastic force hardens."""
TRAIT_BITS = 7
MIN_APPROACH_SPEED = 1e-3
"""Lower bound of the approach speed in the damping of the default law, m/s."""
HARDENING_DEPTH, HARDENING = 0.004, 40.0
"""A contact that has the stiffness of its elements hardens beyond this depth d_h, over theirs, at a pressure of 2 % of
E*: its elastic force is k (d + this number times (d - d_h)^2 / d_h). So corners and edges, whose points have little
area, sink 1 % of an element, and a uniform pressure stays uniform."""
IMPACT_SPEED = 0.05
"""Approach speed of a point, m/s, up to which restitution 0 does not damp it: points that enter a rolling contact would
brake it."""


@wp.func
def elastic_force(single_point: int, k: f64, delta: f64) -> wp.vec2d:
    """Elastic force, N, and stored energy, J."""
    if delta <= f64(0.0):
        return wp.vec2d()
    if single_point != 0:
        force = k * delta * wp.sqrt(delta)
        return wp.vec2d(force, f64(0.4) * force * delta)
    return wp.vec2d(k * delta, f64(0.5) * k * delta * delta)


@wp.func
def hardening(k: f64, rate: f64, depth: f64, delta: f64, delta_n: f64) -> vec4d:
    """Part of `hunt_crossley` that is due to hardening beyond `depth` > 0, for delta > depth."""
    a = f64(HARDENING) * k / depth
    y = delta - depth
    force = a * y * y
    factor = f64(1.0) + rate * (delta - delta_n)
    at_depth = f64(1.0) + rate * (depth - delta_n)
    psi = force * y * (at_depth / f64(3.0) + f64(0.25) * rate * y)
    if at_depth < f64(0.0):  # the force begins at y = -at_depth / rate
        low = -at_depth / rate
        psi -= a * low * low * low * at_depth / f64(12.0)
    size = force * y * (f64(1.0) + rate * (wp.abs(delta_n) + delta))
    return vec4d(force * factor, f64(2.0) * a * y * factor + force * rate, psi, size)


@wp.func
def hunt_crossley(
    single_point: int, k: f64, rate: f64, ramp: f64, eps: f64, delta: f64, delta_n: f64
) -> vec4d:  # fmt: skip
    """F = F_el (1 + rate (delta - delta_n)), not below 0 (Hunt and Crossley 1975), its derivative, its integral,
    and the magnitude of the terms that the integral is the difference of (for its round-off).

    rate = chi / h, 1/m. F increases with delta wherever it is positive, so its integral is convex.
    """
    if delta <= f64(0.0):
        return vec4d()
    factor = f64(1.0) + rate * (delta - delta_n)
    if factor <= f64(0.0):
        return vec4d()
    m = wp.where(single_point != 0, f64(1.5), f64(1.0))
    c0 = f64(1.0) - rate * delta_n
    power = elastic_force(single_point, k, delta)[0]
    force = power * factor
    slope = m * force / delta + power * rate
    psi = power * delta * (c0 / (m + f64(1.0)) + rate * delta / (m + f64(2.0)))
    size = power * delta * ((f64(1.0) + rate * wp.abs(delta_n)) / (m + f64(1.0)) + rate * delta / (m + f64(2.0)))
    if c0 < f64(0.0):  # the force begins at delta_a > 0
        begin = -c0 / rate
        low = elastic_force(single_point, k, begin)[0] * begin
        psi -= low * (c0 / (m + f64(1.0)) + rate * begin / (m + f64(2.0)))
    out = vec4d(force, slope, psi, size)
    if ramp > f64(0.0) and delta > ramp:
        out += hardening(k, rate, ramp, delta, delta_n)
    return out


@wp.func
def damped_force(single_point: int, k: f64, g: f64, ramp: f64, delta: f64, delta_n: f64) -> vec3d:
    """k_n delta - gamma_n v_n of Eq. (77) before the cut at 0, its derivative and its integral.

    g = gamma_n / h (of spheres gamma_n is g h delta^(1/4)); the damping grows linearly over the depth `ramp`.
    """
    spring = elastic_force(single_point, k, delta)
    if single_point != 0:
        root = wp.sqrt(wp.sqrt(delta))
        force = spring[0] + g * root * (delta - delta_n)
        slope = f64(0.25) * force / wp.max(delta, f64(1.0e-300)) + root * (f64(1.25) * k * root + g)
        psi = spring[1] + g * root * delta * (delta / f64(2.25) - delta_n / f64(1.25))
        return vec3d(force, slope, psi)
    if delta < ramp:
        part = delta / ramp
        force = spring[0] + g * part * (delta - delta_n)
        psi = spring[1] + g * part * delta * (delta / f64(3.0) - f64(0.5) * delta_n)
        return vec3d(force, k + g * part + g / ramp * (delta - delta_n), psi)
    psi = spring[1] + g * (f64(0.5) * delta * delta - delta_n * delta)
    # reduction of the integral by the ramp
    psi += g * ramp * (f64(0.5) * delta_n - ramp / f64(6.0))
    return vec3d(spring[0] + g * (delta - delta_n), k + g, psi)


@wp.func
def paper_law(single_point: int, k: f64, g: f64, ramp: f64, eps: f64, delta: f64, delta_n: f64) -> vec4d:
    """Eq. (77): max(0, k_n delta - gamma_n v_n), its derivative, integral, and the magnitude of the integral."""
    if delta <= f64(0.0):
        return vec4d()
    out = damped_force(single_point, k, g, ramp, delta, delta_n)
    if out[0] <= f64(0.0):
        return vec4d()
    size = elastic_force(single_point, k, delta)[1] + g * delta * (delta + wp.abs(delta_n))
    if delta_n > f64(0.0) and g > f64(0.0):
        low = f64(0.0)  # depth at which the force begins: negative below, positive at delta_n
        high = wp.min(delta, delta_n)
        for _ in range(60):
            middle = f64(0.5) * (low + high)
            if damped_force(single_point, k, g, ramp, middle, delta_n)[0] > f64(0.0):
                high = middle
            else:
                low = middle
        out[2] = out[2] - damped_force(single_point, k, g, ramp, low, delta_n)[2]
    return vec4d(out[0], out[1], out[2], size)


@wp.func
def hardened_damping(k: f64, slope: f64, force_at_depth: f64, depth: f64, delta: f64, size: f64) -> vec4d:
    """max(0, F_h + slope y + a y^2), y = delta - depth, where the contact has hardened, F_h its force at `depth`."""
    a = f64(HARDENING) * k / depth
    y = delta - depth
    force = force_at_depth + slope * y + a * y * y
    if force <= f64(0.0):
        return vec4d()
    psi = y * (force_at_depth + y * (f64(0.5) * slope + a * y / f64(3.0)))
    if force_at_depth >= f64(0.0):  # from its zero before
        psi += f64(0.5) * force_at_depth * force_at_depth / slope
    else:
        low = f64(-2.0) * force_at_depth / (slope + wp.sqrt(slope * slope - f64(4.0) * a * force_at_depth))
        psi -= low * (force_at_depth + low * (f64(0.5) * slope + a * low / f64(3.0)))
    return vec4d(force, slope + f64(2.0) * a * y, psi, size + a * y * y * y)


@wp.func
def default_law(single_point: int, k: f64, rate: f64, ramp: f64, eps: f64, delta: f64, delta_n: f64) -> vec4d:
    """Hunt and Crossley's law. Restitution 0, which has no rate, is told by rate < 0, minus a damping g, N/m: then
    F = max(0, k delta + g (delta - max(0, delta_n))), continuous at touch as it is, with a convex integral. `ramp`:
    depth beyond which the elastic force hardens, 0: none."""
    if rate >= f64(0.0):
        return hunt_crossley(single_point, k, rate, ramp, eps, delta, delta_n)
    before = wp.max(delta_n, f64(0.0))
    if single_point != 0:
        return paper_law(single_point, k, -rate, f64(0.0), eps, delta, before)
    slope = k - rate
    force = slope * delta + rate * before
    psi = f64(0.5) * force * force / slope
    if ramp > f64(0.0) and delta > ramp:
        return hardened_damping(k, slope, slope * ramp + rate * before, ramp, delta, psi - rate * before * delta)
    if delta <= f64(0.0) or force <= f64(0.0):
        return vec4d()
    return vec4d(force, slope, psi, psi - rate * before * delta)


@wp.func
def smooth_law(single_point: int, k: f64, g: f64, ramp: f64, eps: f64, delta: f64, delta_n: f64) -> vec4d:
    """(y + sqrt(y^2 + eps^2)) / 2 in place of max(0, y) (Paper I, 6.2), y = k delta - gamma v, at any gap."""
    y = k * delta + g * (delta - delta_n)
    root = wp.sqrt(y * y + eps * eps)
    total = y + root
    if y < f64(0.0):
        total = eps * eps / (root - y)
    slope = k + g
    logarithm = wp.log((wp.abs(y) + root) / eps) * wp.sign(y)
    psi = f64(0.25) * (y * total + eps * eps * logarithm) / slope
    return vec4d(f64(0.5) * total, f64(0.5) * total / root * slope, psi, wp.abs(psi) + k * delta * delta)


@wp.func
def huber_friction(trial: vec3d, stiffness: f64, friction_limit: f64) -> wp.vec2d:
    """Huber potential, J, of a trial force stiffness x slip cut at `friction_limit`, and the fraction of the trial
    force that acts."""
    size = wp.length(trial)
    if size <= friction_limit:
        return wp.vec2d(f64(0.5) * size * size / stiffness, f64(1.0))
    return wp.vec2d(
        (friction_limit * size - f64(0.5) * friction_limit * friction_limit) / stiffness, friction_limit / size
    )


@wp.func
def smooth_friction(slip: vec3d, inv_h: f64, v_eps: f64, friction_limit: f64) -> wp.vec2d:
    """friction_limit v / sqrt(v^2 + v_eps^2) (Paper I, 6.2), v = slip/h: potential, J, and force over slip, N/m."""
    v = inv_h * slip
    root = wp.sqrt(wp.dot(v, v) + v_eps * v_eps)
    if inv_h == f64(0.0):
        return wp.vec2d()
    return wp.vec2d(friction_limit * wp.dot(v, v) / (root + v_eps) / inv_h, friction_limit * inv_h / root)


class ContactLaw(NamedTuple):
    """Law of contact, chosen by `add_contact(..., law=name)`.

    Attributes:
        normal: device function (single_point, k, g, ramp, eps, delta, delta_n) -> (force, N, its derivative by the
            depth, N/m, its integral, J, magnitude of the integral's terms, J), of the whole region. k: normal
            stiffness, N/m (single_point: N/m^1.5); g: damping by trait SPEED_DAMPING, 0 for the elastic part; ramp,
            eps: from `smoothing`, m and N, or by trait HARDENS; delta, delta_n: depth now and at the start of the
            step, m. All are 0 for delta <= 0, without trait ANY_GAP.
        traits: sum of traits of the law.
        smoothing: noun of the option `smoothing`: None (refused), "depth" (ramp) or "pair" (eps and a slip speed).
        explicit: True if `treatment="explicit"` is available: Eqs. (77)-(83) of Paper I.
    """

    normal: wp.Function
    traits: int = SPEED_DAMPING | UNLOADING
    smoothing: str | None = None
    explicit: bool = False

    @property
    def least_restitution(self) -> float:
        """0, or the least positive number for a law that has no damping without a rebound."""
        undamped = self.traits & SPEED_DAMPING and not self.traits & CRITICAL_DAMPING
        return 5e-324 if undamped else 0.0


LAWS = {
    "default": ContactLaw(default_law, SPEED_DAMPING | UNLOADING | CRITICAL_DAMPING | HARDENS),
    "paper": ContactLaw(paper_law, FIXED_SPRING, "depth", explicit=True),
    "smooth": ContactLaw(smooth_law, SLIP_SPEED | ANY_GAP, "pair"),
}
"""Laws by name."""
BUILT_IN = dict(LAWS)
DEFAULT, PAPER, SMOOTH = range(3)
"""Numbers of the laws of `BUILT_IN`; one's own laws of a model follow."""
OwnLaws = tuple[tuple[str, ContactLaw], ...]
"""Names and definitions of the laws of a model that are not built in: kernels are cached by both."""


def own_laws(names: Iterable[str]) -> OwnLaws:
    """Laws of these names that are not built in, as `LAWS` defines them now."""
    return tuple((name, LAWS[name]) for name in sorted(set(names)) if LAWS[name] is not BUILT_IN.get(name))


def law_names(own: OwnLaws) -> list[str]:
    """Names of one's own laws in names of modules."""
    return [definition_name(name, law) for name, law in own]


def law_code(name: str, own: OwnLaws) -> int:
    """Number and traits of a law, as in `Contacts.law`."""
    laws = BUILT_IN | dict(own)
    return list(laws).index(name) << TRAIT_BITS | laws[name].traits


@functools.cache
def law_functions(own: OwnLaws = ()) -> KernelSet:
    """Device function `normal_law` of the built-in laws and those of one's own."""

    @wp.func
    def normal_law(
        law: int, single_point: int, k: f64, g: f64, ramp: f64, eps: f64, delta: f64, delta_n: f64
    ) -> vec4d:  # fmt: skip
        """Normal force, N, its derivative by the depth, N/m, its integral, J, and the magnitude of its terms; g is
        chi/h or gamma_n/h."""
        if law == DEFAULT:
            return default_law(single_point, k, g, ramp, eps, delta, delta_n)
        if law == PAPER:
            return paper_law(single_point, k, g, ramp, eps, delta, delta_n)
        return smooth_law(single_point, k, g, ramp, eps, delta, delta_n)

    numbers = list(BUILT_IN | dict(own))
    for name, definition in own:
        normal_law = _with_law(numbers.index(name), definition.normal, normal_law)
    return kernel_set({"normal_law": normal_law})


def _with_law(number: int, normal: wp.Function, others: wp.Function) -> wp.Function:
    """Device function of one more law."""

    @wp.func
    def normal_law(
        law: int, single_point: int, k: f64, g: f64, ramp: f64, eps: f64, delta: f64, delta_n: f64
    ) -> vec4d:  # fmt: skip
        """The law of this number, else another one."""
        if law == number:
            return normal(single_point, k, g, ramp, eps, delta, delta_n)
        return others(law, single_point, k, g, ramp, eps, delta, delta_n)

    return normal_law
