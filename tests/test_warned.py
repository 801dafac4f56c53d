"""Warnings of what is likely meant otherwise, each a line that says what to write. All were silent on 8934ce7."""

import warnings

import numpy as np
import pytest
import warp as wp

import warpfea as wf
from warpfea.builder.scene import find, names
from warpfea.cli import main


@wp.func
def shake(t: wp.float64) -> wp.vec3d:  # m
    zero = wp.float64(0.0)
    return wp.vec3d(wp.float64(0.05) * wp.cos(t), zero, zero)


def bar(drive=None, turn=None, load=None, E=1e6, nu=0.3, density=1000.0, law=wf.SVK):
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    material = law.from_E_nu(E=E, nu=nu, density=density)
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1), element="T4"), material=material, name="bar")
    b.clamp(body.nodes("x-"))
    if drive is not None:
        b.drive(body.nodes("x+"), displacement=drive)
    if turn is not None:
        rotation = wf.Rotation(anchor=(1, 0.1, 0.1), axis=(1, 0, 0), angle=turn)
        b.drive(body.nodes("x+"), rotation=rotation)
    if load is not None:
        b.add_traction(body.surface("x+"), load)
    return b.finalize(device="cpu")


def silent(make):
    with warnings.catch_warnings():
        warnings.simplefilter("error", wf.ModelWarning)
        return make()


@pytest.mark.parametrize(("E", "density"), [(2.1e5, 7850.0), (7e4, 2700.0), (1.1e5, 4500.0)])
def test_a_metal_in_mpa(E, density):
    with pytest.warns(
        wf.ModelWarning, match=r"body 'bar': SVK with E = .* implausible wave speed .* is E given in MPa\? Steel"
    ):
        bar(E=E, density=density)


@pytest.mark.parametrize(("E", "density"), [(1e4, 1000.0), (2e6, 7200.0), (2.1e11, 7850.0), (1e5, 2000.0)])
def test_soft_matter_is_no_metal(E, density):
    assert silent(lambda: bar(E=E, density=density)).worlds == 1


@pytest.mark.parametrize("law", [wf.SVK, wf.NeoHookean])
def test_a_solid_that_locks(law):
    with pytest.warns(wf.ModelWarning, match=r"body 'bar': \w+ with nu = 0.4999: volumetric locking.* use nu=0.49"):
        bar(nu=0.4999, law=law)
    silent(lambda: bar(nu=0.499, law=law))


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"drive": (0.1, 0, 0)}, r"initial jump of 0.1 m: drive of 'x\+' on body 'bar': displacement at t = 0 s"),
        ({"drive": ([0, 1], [(0.01, 0, 0), (0.1, 0, 0)])}, r"jump of 0.01 m: .*displacement at t = 0 s"),
        ({"drive": shake}, r"jump of 0.05 m: .*displacement at t = 0 s"),
        ({"turn": 0.3}, r"jump of 0.0423 m: .*angle at t = 0 s"),
    ],
)
def test_a_drive_that_jumps_at_the_start(options, told):
    model = bar(**options)
    with pytest.warns(wf.ModelWarning, match=told + r".*such as \(\[0, 0.1\], \[0, value\]\)"):
        wf.Simulation(model, dt=1e-3)
    if options.get("drive", (0.1, 0, 0)) != (0.1, 0, 0):
        return  # statics ends at other values
    result = silent(lambda: wf.solve_static(model, load_steps=1))
    silent(lambda: wf.Simulation(model, result.state.copy(), dt=1e-3))  # it is there already


def test_a_drive_that_begins_where_its_nodes_are():
    assert silent(lambda: wf.Simulation(bar(drive=([0, 1], [(0, 0, 0), (0.1, 0, 0)])), dt=1e-3)).time == 0.0
    assert silent(lambda: wf.Simulation(bar(turn=([0, 1], [0, 1.0])), dt=1e-3)).time == 0.0
    assert silent(lambda: wf.Simulation(bar(drive=wf.Control("x", 3)), dt=1e-3)).time == 0.0


def test_a_law_that_ends_before_the_run():
    sim = wf.Simulation(bar(load=([0, 0.01], [(0, 0, 0), (0, 0, -1.0)])), dt=2e-3)
    silent(lambda: sim.run(0.01))
    told = r"end before t_end = 0.014 s.*: traction on 'x\+' of body 'bar' \(t = 0.01 s\);.*two equal samples"
    with pytest.warns(wf.ModelWarning, match=told):
        sim.run(0.014)
    silent(lambda: sim.run(0.016))  # once
    held = bar(load=([0, 0.01, 0.02], [(0, 0, 0), (0, 0, -1.0), (0, 0, -1.0)]))
    silent(lambda: wf.Simulation(held, dt=2e-3).run(0.03))


S = np.linspace(0.0, 1.0, 21)


@pytest.mark.parametrize(
    ("shape", "warned"),
    [
        (np.sin(np.pi / 2 * S), False),  # comes to rest; before d66a448 each of these was warned of
        (S**2 * (3.0 - 2.0 * S), False),
        (np.sin(np.pi * S), False),  # a pulse, over at its end
        (np.interp(S, [0, 0.5, 1], [0, 1, 0]), False),
        (S, True),
        (S**2, True),
        (np.interp(S, [0, 0.5, 1], [0, 1, 0.5]), True),
        (np.sin(2 * np.pi * S), True),  # a period of a vibration
        (np.where(S < 1.0, 0.0, 1.0), True),
    ],
)
def test_laws_that_are_over_where_they_end(shape, warned):
    law = (0.01 * S, shape[:, None] * (0.0, 0.0, -1.0))
    sim = wf.Simulation(bar(load=law), dt=1e-2)
    if warned:
        with pytest.warns(wf.ModelWarning, match="time laws end before t_end"):
            sim.run(0.02)
    else:
        silent(lambda: sim.run(0.02))


def test_pairs_and_ragged_samples():
    """On d66a448 numpy's ValueError came through."""
    pairs = [(0, (0, 0, 0)), (1, (0, 0, 1.0))]
    with pytest.raises(wf.ModelError, match=r"traction on 'x\+'.*write pairs as \(\[t for t, _ in pairs\], \["):
        bar(load=pairs)
    bar(load=([t for t, _ in pairs], [v for _, v in pairs]))
    with pytest.raises(wf.ModelError, match=r"traction on 'x\+'.*numbers, all values of one shape"):
        bar(load=([0, 1], [(0, 0, 0), (0, 1.0)]))


def test_steel_in_grams_per_cubic_centimetre():
    """On d66a448 only densities below 1 kg/m^3 were warned of."""
    with pytest.warns(wf.MeshWarning, match=r"the density of SVK is 7.85 kg/m\^3. Is it in another unit"):
        bar(E=2.1e11, density=7.85)
    with warnings.catch_warnings():
        warnings.simplefilter("error", wf.MeshWarning)
        bar(E=1e5, density=7.85)  # a foam


@pytest.mark.parametrize("name", names())
def test_no_scene_is_warned_of(name):
    scene = find(name)
    model = silent(lambda: scene().finalize(device="cpu"))
    for law in model.terms.time_laws.laws:
        ended = len(law.times) > 1 and law.times[-1] < scene.t_end
        assert not ended or np.array_equal(law.values[-1], law.values[-2]), law.name


def test_the_command_line_prints_warnings(tmp_path, capsys):
    path = tmp_path / "metal.py"
    path.write_text("""
import warpfea as wf

@wf.scene(dt=2e-3, t_end=0.01)
def metal() -> wf.ModelBuilder:
    b = wf.ModelBuilder()
    mesh = wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1), element="T4")
    bar = b.add_solid(mesh, material=wf.SVK(E=210_000, nu=0.3, density=7850.0), name="bar")
    b.clamp(bar.nodes("x-"))
    return b
""")
    assert main(["run", str(path), "--device", "cpu", "--quiet"]) == 0
    assert (
        "warpfea: warning: body 'bar': SVK with E = 2.1e+05 Pa and 7850 kg/m^3: implausible wave speed"
        in capsys.readouterr().err
    )


def test_the_hook_keeps_its_energy():
    """With backward Euler, as on 8934ce7, 78 % of the work was lost; with BDF2 8 %."""
    assert find("hook").integrator == "bdf2"
    assert find("cantilever").integrator == "bdf2"
