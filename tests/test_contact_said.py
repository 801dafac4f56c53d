"""Words of contact: depth over the element size, overlaps at the start, bodies that nobody named."""

import json

import numpy as np
import pytest

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
    term = b.finalize(device="cpu").terms.contact
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
def press(*, stiffness: float = 1.0) -> wf.ModelBuilder:
    '''A cube that is pressed onto a floor.'''
    b = wf.ModelBuilder()
    mesh = wf.mesh.box((.1, .1, .1), cells=(1, 1, 1))
    cube = b.add_solid(mesh, material=wf.SVK(E=1e6, nu=.3, density=1000), name="cube")
    b.drive(cube.nodes("z+"), displacement=([0, .02, 1], [(0, 0, 0), (0, 0, -.006), (0, 0, -.006)]))
    b.add_contact(cube.surface("z-"), b.add_collider(wf.HalfSpace((0, 0, 1))), stiffness=stiffness, name="pad")
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
