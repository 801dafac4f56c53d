"""Scenes: the decorator, typed parameters, users' files, and the scenes that come with warpfea."""

from __future__ import annotations

import pathlib
import subprocess
import sys
from typing import Literal

import numpy as np
import pytest

import warpfea as wf
from warpfea.builder.scene import Scene, find, load_file, names

ROOT = pathlib.Path(__file__).resolve().parent.parent
BUILTIN = [
    "arch", "arm", "ball_on_plate", "beam_over_cylinders", "belt", "block_stack", "bouncing_ball", "brick_floor",
    "cantilever", "chain", "comb", "crane", "crossed_beams", "double_pendulum", "finger_beam_shell", "four_bar",
    "gears", "gripper", "hook", "hung_plate", "links", "mixed", "overhang", "peg_in_hole", "pendulum", "pile",
    "plate_pendulum", "rollup", "slider_crank", "spin", "tilting_table", "top", "twist",
]  # fmt: skip


@wf.scene(dt=1e-3, t_end=0.01)
def sample(
    *,
    length: float = 1.0,
    cells: int = 2,
    damped: bool = False,
    force: tuple[float, float, float] = (0.0, 0.0, -1.0),
    kind: Literal["T4", "T10"] = "T10",
    limit: float | None = None,
    label: str = "box",
) -> wf.ModelBuilder:
    """First line,
    continued.

    Details.

    Args:
        length: of the box, m;
            continued.
        cells: along x.
    """
    b = wf.ModelBuilder()
    b.add_solid(
        wf.mesh.box((length, 1, 1), cells=(cells, 1, 1), element=kind), material=wf.SVK(E=1e6, nu=0.3), name=label
    )
    return b


def test_a_scene_is_still_a_function():
    assert isinstance(sample, Scene)
    assert sample.__name__ == "sample"
    builder = sample(length=2.0, cells=3)
    assert isinstance(builder, wf.ModelBuilder)
    assert len(builder.bodies[0].mesh.cells) == 18


def test_docstring_becomes_description_and_parameter_texts():
    assert sample.description == "First line, continued."
    assert sample.details == "Details."
    assert sample.parameters["length"].doc == "of the box, m; continued."
    assert sample.parameters["cells"].doc == "along x."
    assert sample.parameters["damped"].doc == ""


def test_settings_are_read_by_type():
    given = ["length=2e-1", "cells=4", "damped=yes", "force=1,-2,3.5", "kind=T4", "limit=3", "label=a=b"]
    values = sample.parse_settings(given)
    assert [values[name] for name in ("length", "cells", "damped", "kind")] == [0.2, 4, True, "T4"]
    assert [values[name] for name in ("force", "limit", "label")] == [(1.0, -2.0, 3.5), 3.0, "a=b"]
    assert isinstance(values["cells"], int)
    assert sample.parse_settings(["limit=none"]) == {"limit": None}
    resolved = sample.resolve({"cells": 4})
    assert resolved["cells"] == 4
    assert resolved["length"] == 1.0
    assert list(resolved) == list(sample.parameters)


@pytest.mark.parametrize(
    ("setting", "words"),
    [
        ("length", ["length", "name=value"]),
        ("width=1", ["'width'", "length=1.0", "cells=2"]),
        ("length=long", ["length", "'long'", "finite number"]),
        ("length=nan", ["length", "finite number"]),
        ("cells=2.5", ["cells", "'2.5'", "whole number"]),
        ("damped=maybe", ["damped", "true or false"]),
        ("force=1,2", ["force", "3 values"]),
        ("kind=T8", ["kind", "T4 or T10"]),
        ("limit=x", ["limit", "float or none"]),
    ],
)
def test_bad_settings_name_the_parameter(setting, words):
    with pytest.raises(wf.ModelError) as error:
        sample.parse_settings([setting])
    for word in words:
        assert word in str(error.value)


def test_a_parameter_given_twice_is_refused():
    with pytest.raises(wf.ModelError, match="length: given twice"):
        sample.parse_settings(["length=1", "length=2"])


def test_a_parameter_without_default_is_asked_for():
    @wf.scene(dt=1e-3, t_end=1.0)
    def needs(*, length: float) -> wf.ModelBuilder:
        return wf.ModelBuilder()

    with pytest.raises(wf.ModelError, match=r"'length' \(float\) has no default"):
        needs.resolve({})


@pytest.mark.parametrize(
    "options", [{"dt": 0.0, "t_end": 1.0}, {"dt": 1e-3, "t_end": -1.0}, {"dt": 1, "t_end": 1, "fps": 0}]
)
def test_bad_numbers_of_a_scene_are_refused(options):
    with pytest.raises(wf.ModelError, match="positive finite number"):
        wf.scene(**options)(lambda: wf.ModelBuilder())


def test_a_scene_that_returns_no_builder_is_refused():
    nothing = wf.scene(dt=1.0, t_end=1.0)(lambda: None)
    with pytest.raises(wf.ModelError, match="returned NoneType"):
        nothing.build({})


def test_arbitrary_keywords_are_refused():
    with pytest.raises(wf.ModelError, match="'options'"):
        wf.scene(dt=1.0, t_end=1.0)(lambda **options: wf.ModelBuilder())


# users' files

FILE = """
import warpfea as wf
from warpfea.scenes.cantilever import cantilever

@wf.scene(dt=1e-3, t_end=0.1)
def one(*, size: float = 1.0) -> wf.ModelBuilder:
    '''The first.'''
    return cantilever(length=size)

@wf.scene(dt=1e-3, t_end=0.1)
def two() -> wf.ModelBuilder:
    return wf.ModelBuilder()
"""


def test_a_file_gives_its_own_scenes(tmp_path):
    file = tmp_path / "mine.py"
    file.write_text(FILE)
    found = load_file(file)
    assert list(found) == ["one", "two"]
    assert found["one"].description == "The first."
    assert isinstance(found["one"](size=2.0), wf.ModelBuilder)


def test_a_file_may_import_a_neighbour_and_scenes(tmp_path):
    (tmp_path / "neighbour_of_mine.py").write_text("LENGTH = 3.0\n")
    file = tmp_path / "mine.py"
    file.write_text("import neighbour_of_mine\nfrom warpfea.scenes.twist import twist\n")
    assert list(load_file(file)) == ["twist"]
    assert str(tmp_path) not in sys.path


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("x = 1\n", ["defines no scene"]),
        ("import warpfea\nx = 1 / 0\n", ["mine.py:2", "ZeroDivisionError"]),
        ("def f(:\n", ["mine.py:1", "SyntaxError"]),
        ("import no_such_module_there\n", ["mine.py:1", "no_such_module_there"]),
    ],
)
def test_bad_files_are_named_with_the_line(tmp_path, text, words):
    file = tmp_path / "mine.py"
    file.write_text(text)
    with pytest.raises(wf.ModelError) as error:
        load_file(file)
    for word in words:
        assert word in str(error.value)


# the scenes that come with warpfea


def test_the_registry_lists_without_importing():
    code = (
        "import sys, warpfea, warpfea.builder.scene as s\n"
        "import importlib; m = importlib.import_module('warpfea.builder.scene')\n"
        f"assert m.names() == {BUILTIN!r}, m.names()\n"
        "assert not [k for k in sys.modules if k.startswith('warpfea.scenes.')]\n"
        "assert not {'pxr', 'meshio', 'PIL', 'tqdm'} & set(sys.modules)\n"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


def test_names_and_find():
    assert names() == BUILTIN
    with pytest.raises(wf.ModelError, match="no scene 'derrick'; there are arch, arm, ball_on_plate"):
        find("derrick")


@pytest.mark.parametrize("name", BUILTIN)
def test_every_scene_is_described_and_builds(name):
    scene = find(name)
    assert scene.description.endswith(".")
    assert all(p.doc and not p.required for p in scene.parameters.values())
    builder = scene()
    d = builder.description
    assert d.supports or d.joints or d.contacts or name == "spin"  # floats
    assert builder.description.probes
    assert scene.picture is None or scene.picture < scene.t_end


def test_hook_is_large_enough_and_long_enough():
    scene = find("hook")
    body = scene().bodies[0]
    assert len(body.mesh.cells) >= 3000
    assert body.mesh.cell_type == "tetra10"
    assert {"body", "fixed", "pull"} <= set(body.mesh.element_sets) | set(body.mesh.surface_sets)
    assert scene.t_end * scene.fps >= 60


def test_cantilever_bends_as_a_beam():
    model = find("cantilever")(cells=10).finalize(device="cpu")
    result = wf.solve_static(model, load_steps=2, tol=1e-8)
    linear = 3 * 2700 * 9.81 / (2 * 7e8 * 0.03**2)
    tip = result.probe("tip").displacement[0, -1]
    assert -tip[2] == pytest.approx(linear, rel=0.08)
    assert abs(tip[1]) < 0.01 * linear


def test_twist_turns_its_end():
    scene = find("twist")
    model = scene(cells=3, across=1, turns=0.25, duration=0.1).finalize(device="cpu")
    sim = wf.Simulation(model, dt=1 / 60, solver=wf.NewtonPCG(tol=1e-6))
    sim.run(0.1)
    corner = sim.probe("corner").position[0, -1]
    np.testing.assert_allclose(corner, [0.3, -0.03, 0.03], atol=1e-12)
