"""The command line, called in this process: scenes, info, render, bench, help."""

from __future__ import annotations

import json
import pathlib
import subprocess
import sys

import mesh_writers as writers
import numpy as np
import pytest
from cli_runs import SHORT, SVK, run, working_folder

import warpfea as wf
from warpfea.base.console import compile_progress_bar
from warpfea.builder.scene import find


@pytest.fixture
def folder(tmp_path, monkeypatch):
    return working_folder(tmp_path, monkeypatch)


HERE = pathlib.Path(__file__).resolve().parent


def test_scenes_lists_and_describes(folder, capfd):
    code, out, _ = run(capfd, "scenes")
    assert code == 0
    for name in ("cantilever", "hook", "twist"):
        assert f"\n{name}" in out
    code, out, _ = run(capfd, "scenes", "twist")
    assert code == 0
    assert "--set turns" in out
    assert "of the driven end" in out
    code, out, _ = run(capfd, "scenes", "mine.py")
    assert code == 0
    assert "An error in the scene itself." in out
    assert "--set force" in run(capfd, "scenes", "mine.py:good")[1]


def test_info_tells_features_and_costs(folder, capfd):
    words = ["info", "cantilever", "--set", "cells=2", "--device", "cpu"]
    code, out, err = run(capfd, *words)
    assert (code, err) == (0, "")
    for word in (
        "12 T10 elements",
        "left out",
        "contact",
        "bytes per unknown",
        "launches",
        "matrix_product",
        "operator matrix, preconditioner banded",
    ):
        assert word.replace("bytes", "B") in out
    code, out, _ = run(capfd, *words, "--json", "-")
    info = json.loads(out)
    assert code == 0
    assert info["launches"] > 20
    assert "gravity" in info["features"]
    assert any(k.endswith("matrix_product") for k in info["kernels"])
    assert info["bytes_per_unknown"] > 100


def test_info_shows_the_groups_of_a_mesh_without_a_material(folder, capfd):
    code, out, err = run(capfd, "info", "part.msh")
    assert (code, err) == (0, "")
    for words in (
        "12 tetra10",
        "1 x 0.2 x 0.2 m, volume 0.04 m^3",
        "body (12 elements)",
        "x- (2 faces)",
        "x- (9 nodes)",
    ):
        assert words in out
    code, out, _ = run(capfd, "info", "part.msh", "--scale", "1e-3", "--json", "-")
    assert code == 0
    mesh = json.loads(out)["mesh"]
    assert mesh["element_groups"] == {"body": 12}
    assert mesh["surface_groups"]["x-"] == 2
    assert mesh["node_groups"]["x-"] == 9
    np.testing.assert_allclose(mesh["bounding_box"], [[0, 0, 0], [1e-3, 2e-4, 2e-4]], atol=1e-18)
    code, out, _ = run(capfd, "info", "part.msh", "--material", SVK, "--clamp", "x-", "--device", "cpu")
    assert code == 0
    for words in ("x- (2 faces)", "launches", "40 kg"):
        assert words in out


def test_info_of_surface_groups_only_and_of_a_shell(folder, capfd):
    box = wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1))
    parts = writers.Parts.of(box)
    writers.write(parts, folder / "part.msh", "msh22")
    text = (folder / "part.msh").read_text()
    assert '"body"' in text
    lines = text.splitlines()
    tag = next(line.split()[1] for line in lines if line.endswith('"body"'))
    bare = [line for line in lines if not line.endswith('"body"')]
    for k, line in enumerate(bare):  # tetrahedra without a tag
        words = line.split()
        if len(words) > 10 and words[1] == "11" and words[3] == tag:
            bare[k] = " ".join([*words[:3], "0", *words[4:]])
    start = bare.index("$PhysicalNames")
    bare[start + 1] = str(int(bare[start + 1]) - 1)
    (folder / "bare.msh").write_text("\n".join(bare) + "\n")
    code, out, _ = run(capfd, "info", "bare.msh")
    assert code == 0
    assert "element groups  none" in out
    assert "x- (2 faces)" in out
    code, _, err = run(capfd, "run", "bare.msh", "--clamp", "x-")
    assert code == 2
    assert "element groups found: none (its surface groups: x-" in err
    assert "Physical Volume" in err
    code, _, err = run(capfd, "run", "bare.msh", "--material", f"body={SVK}")
    assert code == 2
    assert "the volume has no group" in err


def test_pictures_take_field_view_and_range(folder, capfd, monkeypatch):
    from warpfea.outputs import animation

    shown = []
    label = animation.draw_labels

    def note(image, time, bar, *rest):
        shown.append(bar)
        return label(image, time, bar, *rest)

    monkeypatch.setattr(animation, "draw_labels", note)
    look = ["--field", "displacement", "--range", "-1e-3,2e-3", "--view", "-60,10", "--quiet"]
    assert run(capfd, *SHORT, "--png", "a.png", "--gif", "a.gif", "--usd", "a.usdc", "--html", "a.html", *look)[0] == 0
    text = (folder / "a.html").read_text()
    page = json.loads(text.split('id="header" type="application/json">')[1].partition("</script>")[0])
    assert (page["range"], page["view"], page["fields"][page["color"]]["name"]) == (
        [-1e-3, 2e-3],
        [-60, 10],
        "displacement",
    )
    assert {mark["kind"] for mark in page["markers"]} == {"support", "probe"}
    assert [plot["title"] for plot in page["plots"]] == ["probe tip: displacement", "energy"]
    facts = dict(page["facts"])
    assert facts["command"].startswith("warpfea run cantilever --device cpu")
    assert {"cells", "warp", "simulation"} <= facts.keys()
    assert {(bar[0], bar[1], bar[2]) for bar in shown} == {(-1e-3, 2e-3, "displacement")}
    shown.clear()
    assert run(capfd, "render", "a.usdc", "-o", "b.html", "--quiet")[0] == 0
    assert '"kind":"support"' in (folder / "b.html").read_text()
    code, _, err = run(capfd, "render", "a.usdc", "-o", "b.html", "--size", "64x64")
    assert code == 2
    assert "--size is for pictures" in err
    render = ["render", "a.usdc", "-o", "b.png", "--quiet", "--draw", "edges"]
    assert run(capfd, *render)[0] == 0
    assert shown[-1][:3] == (-1e-3, 2e-3, "displacement")
    assert run(capfd, *render, "--field", "von_mises", "--range", "0,5")[0] == 0
    assert shown[-1][:3] == (0.0, 5.0, "von Mises stress")
    assert run(capfd, *render, "--field", "none")[0] == 0
    assert shown[-1] is None
    assert run(capfd, *SHORT, "--png", "c.png", "--field", "none", "--quiet")[0] == 0
    assert shown[-1] is None
    first, second = ((folder / name).read_bytes() for name in ("a.png", "b.png"))
    assert first != second
    code, _, err = run(capfd, *render, "--field", "vonmises")
    assert code == 2
    assert "did you mean 'von_mises'" in err


def test_render_draws_a_usd_file(folder, capfd):
    assert run(capfd, *SHORT, "--usd", "a.usdc", "--quiet")[0] == 0
    code, out, _ = run(capfd, "render", "a.usdc", "-o", "b.png", "--size", "200x100", "--view", "-60,20")
    assert (code, out) == (0, "wrote b.png\n")
    from PIL import Image

    assert Image.open("b.png").size == (200, 100)


def test_bench_measures_time_and_error(folder, capfd):
    words = ["bench", "--unknowns", "300", "--dtype", "float64", "--steps", "3", "--repeat", "1", "--device", "cpu"]
    code, out, err = run(capfd, *words, "--out", "bench.json")
    assert (code, err) == (0, "")
    assert "ms/step" in out
    content = json.loads((folder / "bench.json").read_text())
    assert content["command"] == f"warpfea {' '.join(words)} --out bench.json"
    assert {"machine", "versions", "settings", "rows", "commit", "schema"} <= set(content)
    (row,) = content["rows"]
    assert row["unknowns"] == 270
    assert row["tip"] > 0
    assert row["tip_error"] < 1e-6
    assert row["residual"] < 1e-7
    assert row["ms_per_step"] > 0
    assert row["linear"] == "pcg"


@pytest.mark.parametrize("command", [[], ["run"], ["scenes"], ["info"], ["render"], ["bench"]])
def test_help_teaches(capfd, command):
    code, out, err = run(capfd, *command, "--help")
    assert (code, err) == (0, "")
    assert "usage: warpfea" in out
    if command in ([], ["run"], ["render"], ["bench"]):
        assert "examples:" in out
    if command in (["run"], ["render"]):
        assert "contact_pressure, gap" in " ".join(out.split())


def test_the_bar_of_the_compilation_goes_to_stderr(capfd):
    ready = []
    model = find("cantilever")(cells=2).finalize(device="cpu")
    wf.Simulation(model, dt=1e-3, on_compile=lambda *news: ready.append(news))
    done, total, names = zip(*ready)
    assert done == tuple(range(1, total[0] + 1))
    assert "warpfea.kernels.reduce" in names
    capfd.readouterr()
    with compile_progress_bar(True) as update:
        for news in ready:
            update(*news)
    out, err = capfd.readouterr()
    assert out == ""
    assert "compiling kernels" in err
    with compile_progress_bar(None) as update:  # not a terminal
        update(*ready[0])
    assert capfd.readouterr() == ("", "")


def test_version(capfd):
    assert run(capfd, "--version")[:2] == (0, f"warpfea {wf.__version__}\n")


def test_the_module_runs_as_a_program():
    done = subprocess.run(
        [sys.executable, "-m", "warpfea", "run", "derrick"], cwd=HERE.parent, capture_output=True, text=True
    )
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("warpfea: error: there is no scene 'derrick'")
