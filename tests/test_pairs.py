"""Contact between bodies: both feel one force at one place, whatever their elements; worlds, checkpoints, float32."""

from __future__ import annotations

import numpy as np
import pytest
from contact_runs import DEVICES

import warpfea as wf
from warpfea.contact.facets import FacetContact

SOFT = wf.SVK(E=2e5, nu=0.3, density=1000.0)
DT = 1e-3
LAWS = {
    "default": {"mu": 0.4, "mu_static": 0.6, "restitution": 0.6},
    "paper": {"law": "paper", "mu": 0.4, "restitution": 0.6},
    "explicit": {"law": "paper", "treatment": "explicit", "mu": 0.4, "restitution": 0.6},
}


def body(b, kind, name, z, side, cells, top=False):
    """A body of a family, `side` wide around the z axis; its lowest plane at z, with `top` its topmost."""
    low, thin = -0.5 * side, 0.2 * side
    if kind == "beam":
        middle = z - 0.5 * thin if top else z + 0.5 * thin
        section = wf.Rectangle(thin, thin)
        line = [(low, 0.0, middle), (low + side, 0.0, middle)]
        return b.add_beam(line, elements=cells, section=section, normal=(0, 0, 1), material=SOFT, name=name)
    if kind == "shell":
        middle = z - 0.5 * thin if top else z + 0.5 * thin
        mesh = wf.mesh.grid((side, side), cells=(cells, cells), origin=(low, low, middle))
        return b.add_shell(mesh, thickness=thin, material=SOFT, name=name)
    element = kind if kind in ("T10", "H3843") else "T4"
    mesh = wf.mesh.box((side,) * 3, cells=(cells,) * 3, origin=(low, low, z - side if top else z), element=element)
    options = {} if kind in ("T4", "T10") else {"element": kind}
    return b.add_solid(mesh, material=SOFT, name=name, **options)


KINDS = ("T4", "T10", "ENMC", "FN", "H3843", "beam", "shell")


def thrown(kind, role, *, worlds=1, dtype="float64", device="cpu", **options):
    """A body that flies askew onto a free one, 0.2 mm below; the one of `kind` is the slave, or the master."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    if role == "slave":
        upper, lower = body(b, kind, "upper", 2e-4, 0.1, 2), body(b, "T4", "lower", 0.0, 0.16, 1, top=True)
    else:
        upper, lower = body(b, "T4", "upper", 2e-4, 0.06, 2), body(b, kind, "lower", 0.0, 0.16, 1, top=True)
    b.set_initial(upper, velocity=(0.3, 0.1, -0.6), angular_velocity=(1.0, -2.0, 3.0))
    b.set_initial(lower, velocity=(0.0, 0.05, 0.1))
    pair = b.add_contact(upper, lower, name="pair", **options)
    assert pair.slave.body is upper
    return b.finalize(device=device, dtype=dtype, worlds=worlds), pair


TIGHT = wf.NewtonPCG(tol=1e-12, max_newton=60)


def balance(sim, u=None):
    """|Sum| and |moment| of a pair's forces on all slots, at the displacements of the state or others; and sum |F|."""
    model, work = sim.model, sim.stepper.work
    term = model.terms.find(FacetContact)
    pool = work.pool_force.numpy()[0].astype(float)
    kind = np.concatenate([x.slot_kind for x in model.description.bodies])
    shift = np.concatenate([np.where(x.slot_kind[:, None] == 0, x.origin, 0.0) for x in model.description.bodies])
    place = (
        np.concatenate([x.reference for x in model.description.bodies])
        + shift
        + (work.u.numpy()[0] if u is None else u)
    )
    force, moment, size, first = np.zeros(3), np.zeros(3), 0.0, term.offset
    for conn in term.connectivity:
        f = pool[first : first + conn.size].reshape(conn.shape[1], conn.shape[0], 3)
        first += conn.size
        slots = conn.T
        force += f[kind[slots] == 0].sum(axis=0)
        moment += np.cross(place[slots], f).sum(axis=(0, 1))
        size += np.linalg.norm(f[kind[slots] == 0], axis=1).sum()
    return np.linalg.norm(force), np.linalg.norm(moment), size


def momenta(sim):
    """Momentum of each body, and sum m |v| of all."""
    model, v = sim.model, sim.state.velocity.numpy()[0].astype(float)
    kind = np.concatenate([x.slot_kind for x in model.description.bodies])
    mass = np.asarray(model.mass_matrix()[::3, ::3][kind == 0].sum(axis=0)).ravel()
    first = model.description.bodies[1].slot_offset
    scale = (np.abs(mass) * np.linalg.norm(v, axis=1)).sum()
    return np.stack([mass[:first] @ v[:first], mass[first:] @ v[first:]]), scale


CASES = [(kind, role, "default", "backward_euler") for kind in KINDS for role in ("slave", "master")]
CASES += [(kind, "slave", law, "backward_euler") for kind in ("T4", "T10") for law in ("paper", "explicit")]
CASES += [(kind, role, "default", scheme) for kind, role in (("T10", "slave"), ("T10", "master"), ("H3843", "slave"),
          ("shell", "master"), ("beam", "slave")) for scheme in ("bdf2", "generalized_alpha")]  # fmt: skip


@pytest.mark.parametrize(("kind", "role", "law", "integrator"), CASES)
def test_a_pair_is_in_balance(kind, role, law, integrator):
    """Sum and moment of its forces in each step, and the momentum of the whole."""
    sim = wf.Simulation(thrown(kind, role, **LAWS[law])[0], dt=DT, solver=TIGHT, integrator=integrator)
    began, _ = momenta(sim)
    pushed = 0.0
    for _ in range(18):
        before = sim.state.displacement.numpy()[0].copy()
        sim.step()
        force, moment, size = balance(sim, before if law == "explicit" else None)
        assert force <= 1e-12 * size
        assert moment <= 1e-12 * size * 0.16
        pushed = max(pushed, size)
    ended, scale = momenta(sim)
    assert pushed > 0.0
    assert np.abs(ended[0] - began[0]).max() > 0.05 * scale
    assert np.abs(ended.sum(axis=0) - began.sum(axis=0)).max() <= 1e-12 * scale


@pytest.mark.parametrize("law", LAWS)
def test_a_pair_in_single_precision(law):
    sim = wf.Simulation(thrown("T10", "slave", dtype="float32", **LAWS[law])[0], dt=DT)
    exact = wf.Simulation(thrown("T10", "slave", **LAWS[law])[0], dt=DT)
    began, _ = momenta(sim)
    for _ in range(18):
        before = sim.state.displacement.numpy()[0].copy()
        sim.step()
        force, moment, size = balance(sim, before if law == "explicit" else None)
        assert force <= 1e-6 * size
        assert moment <= 1e-6 * size * 0.16
    exact.step(18)
    (ended, scale), (expected, _) = momenta(sim), momenta(exact)
    assert np.abs(ended.sum(axis=0) - began.sum(axis=0)).max() <= 1e-5 * scale
    assert np.abs(ended - expected).max() <= 0.02 * scale


def arrays(sim):
    return {f"state.{name}": values for name, values in sim.state.numpy().items()}


def launched(velocities, dtype="float64"):
    """A world for each velocity of the upper body."""
    model, _ = thrown("T10", "slave", worlds=len(velocities), dtype=dtype, **LAWS["default"])
    state = model.state()
    v = state.velocity.numpy()
    first = model.description.bodies[1].slot_offset
    v[:, :first] += np.asarray(velocities)[:, None, :]
    state.velocity.assign(v)
    return wf.Simulation(model, state, dt=DT)


@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_worlds_are_their_own_runs(dtype):
    """Of three worlds, one whose bodies fly apart."""
    velocities = [(0.0, 0.0, 0.0), (0.2, -0.1, -0.5), (0.0, 0.0, 3.0)]
    together = launched(velocities, dtype)
    together.step(12)
    all_of = arrays(together)
    pushed = [np.abs(all_of["state.pairs_facet"][w]).max() > 0 for w in range(3)]
    assert pushed == [True, True, False]
    for w, velocity in enumerate(velocities):
        alone = launched([velocity], dtype)
        alone.step(12)
        for name, values in arrays(alone).items():
            assert np.array_equal(values[0], all_of[name][w]), name


@pytest.mark.parametrize("law", LAWS)
def test_a_resumed_run_has_the_same_bits(law, tmp_path):
    whole, first, second = (wf.Simulation(thrown("T4", "slave", **LAWS[law])[0], dt=DT) for _ in range(3))
    whole.step(25)
    first.run(0.01, outputs=[wf.Checkpoint(tmp_path / "pair.npz", every=10)])
    assert np.abs(arrays(first)["state.pairs_facet"]).max() > 0
    second.resume(tmp_path / "pair.npz")
    second.step(15)
    for name, values in arrays(whole).items():
        assert np.array_equal(values, arrays(second)[name]), name


def angular_momentum(sim):
    """Angular momentum about the origin, and the sum of the magnitudes of its parts."""
    bodies, state = sim.model.description.bodies, sim.state.numpy()
    kind = np.concatenate([x.slot_kind for x in bodies])
    place = np.concatenate([x.reference + np.where(x.slot_kind[:, None] == 0, x.origin, 0.0) for x in bodies])
    parts = np.cross(place + state["displacement"][0], sim.model.mass_matrix()[::3, ::3] @ state["velocity"][0])
    return parts.sum(axis=0), np.abs(parts[kind == 0]).sum()


ROUND_OFF = {"float64": 1e-12, "float32": 2e-6}


TURNED = [
    ("T10", "master", "float64"), ("T10", "master", "float32"), ("H3843", "slave", "float64"),
    ("shell", "master", "float64"),
]  # fmt: skip


@pytest.mark.parametrize(("kind", "role", "dtype"), TURNED)
@pytest.mark.parametrize("device", DEVICES)
def test_energy_momentum_keeps_the_angular_momentum_of_a_pair(kind, role, dtype, device):
    """Forces at the end of the step change it by 1e-4 to 8e-4; here with friction, through impact and slip."""
    model, _ = thrown(kind, role, mu=0.3, dtype=dtype, device=device)
    solver = TIGHT if dtype == "float64" else None
    sim = wf.Simulation(model, dt=1e-3, solver=solver, integrator="energy_momentum")
    (before, size), (began, scale) = angular_momentum(sim), momenta(sim)
    sim.step(20)
    assert np.abs(momenta(sim)[0] - began).max() > 0.02 * scale
    assert np.abs(angular_momentum(sim)[0] - before).max() <= ROUND_OFF[dtype] * size
