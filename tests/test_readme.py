"""READMEs, notes, tutorial: Python blocks run, commands parse, links and names exist, numbers match result files."""

from __future__ import annotations

import json
import pathlib
import re
import runpy
import shlex
import subprocess

import numpy as np
import pytest
import warp as wp
from warpfea.kernels.elements import materials

import warpfea as wf
from warpfea.cli.parser import parse
from warpfea.elements import family
from warpfea.simulation import integrators

ROOT = pathlib.Path(__file__).resolve().parent.parent
RESULTS = ROOT / "tests" / "results"
FOLDERS = (".", "kernels", "scenes", "tests", "warpfea", "warpfea/builder", "warpfea/simulation", "warpfea/solvers")
NOTES = ("tests", "warpfea/builder", "warpfea/simulation", "warpfea/solvers")
TUTORIAL = "scenes/TUTORIAL.md"
PAGES = [ROOT / folder / "README.md" for folder in FOLDERS]
PAGES += [ROOT / folder / "NOTES.md" for folder in NOTES]
PAGES += [
    ROOT / "kernels/CONSTANTS.md",
    ROOT / "kernels/LAUNCHES.md",
    ROOT / TUTORIAL,
    ROOT / "warpfea/builder/CONTACT.md",
    ROOT / "warpfea/builder/PARTS.md",
    ROOT / "warpfea/builder/SECTIONS.md",
    ROOT / "warpfea/builder/SPRINGS.md",
    ROOT / "warpfea/simulation/EXAMPLES.md",
    ROOT / "warpfea/simulation/FIELDS.md",
    ROOT / "warpfea/builder/ACTUATORS.md",
    ROOT / "warpfea/mesh/MESHES.md",
    ROOT / "warpfea/outputs/PAGE.md",
    ROOT / "warpfea/simulation/GRADIENTS.md",
    ROOT / "warpfea/simulation/LEARNING.md",
    ROOT / "warpfea/sweeps/SWEEPS.md",
]
TEXT = {path.relative_to(ROOT).as_posix(): path.read_text() for path in PAGES}
REGISTRIES = (family._families, materials.LAWS, integrators.INTEGRATORS)
FENCE = re.compile(r"^```(\w*)\n(.*?)^```$", re.DOTALL | re.MULTILINE)


def fences(name, *languages):
    """The text of the fenced blocks of a page in some languages, with the lines that they begin at."""
    found = FENCE.finditer(TEXT[name])
    return [(m[2], TEXT[name][: m.start()].count("\n") + 1) for m in found if m[1] in languages]


def prose(name):
    """A page without its fenced blocks."""
    return FENCE.sub("", TEXT[name])


OTHERS = [name for name in TEXT if name != TUTORIAL]
PYTHON = [pytest.param(code, id=f"{name}:{line}") for name in OTHERS for code, line in fences(name, "python")]
PYTHON += [pytest.param("\n\n".join(code for code, _ in fences(TUTORIAL, "python")), id=TUTORIAL)]  # one file


def test_all_pages_are_known():
    names = [p.relative_to(ROOT) for p in ROOT.rglob("*.md")]
    found = {ROOT / p for p in names if not any(part.startswith(".") or part == "build" for part in p.parts)}
    assert found - {ROOT / "CHANGELOG.md"} == set(PAGES)


def test_files_are_short():
    """The rule of 450 lines, and what tests/README.md lists as exceptions to it."""
    listed = TEXT["tests/README.md"].split("## Exceptions to the 450-line rule")[1]
    told = subprocess.run(["git", "ls-files", "*.py"], cwd=ROOT, capture_output=True, text=True, check=False)
    if told.returncode:
        pytest.skip("not a checkout")
    for name in told.stdout.split():
        path = ROOT / name
        if not name.startswith("tests/") and path.is_file() and f"`{name}`" not in listed:
            assert len(path.read_text().splitlines()) <= 450, name


def test_pages_are_short():
    lines = {name: len(text.splitlines()) for name, text in TEXT.items()}
    assert lines["README.md"] <= 240
    assert lines["warpfea/builder/README.md"] + lines["warpfea/simulation/README.md"] <= 700
    assert sum(count for name, count in lines.items() if name.endswith(("README.md", "NOTES.md"))) <= 2300


@pytest.mark.parametrize("name", TEXT)
def test_text_speaks_of_the_project_alone(name):
    words = ["/wo" + "rk/", "/ro" + "ot/", "/tm" + "p/", "pypi" + r"\.org", r"\bsess" + "ions?", r"\bhelp" + "ers?"]
    assert not re.search("|".join(words), TEXT[name])


# code


@pytest.fixture
def _registries():
    """A recipe's element, law and integrator are gone after it."""
    before = [dict(registry) for registry in REGISTRIES]
    yield
    for registry, entries in zip(REGISTRIES, before):
        registry.clear()
        registry.update(entries)


@pytest.mark.parametrize("code", PYTHON)
@pytest.mark.usefixtures("_registries")
def test_code_runs(code, tmp_path, monkeypatch, capsys):
    """Files are written, simulations have gone on without a failure, and all that is printed is a number."""
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "example.py"
    file.write_text(code)
    monkeypatch.setattr(wp, "get_preferred_device", lambda: wp.get_device("cpu"))
    names = runpy.run_path(str(file))
    written = [path.name for path in tmp_path.rglob("*") if path.is_file() and path.stat().st_size > 0]
    for name in re.findall(r'Writer\("([^"]+)"', code):
        assert any(path.startswith(name) for path in written), name
    for sim in (value for value in names.values() if isinstance(value, wf.Simulation)):
        assert (np.asarray(sim.time) > 0.0).all()
        assert not np.asarray(sim.status).any()
        assert np.isfinite(sim.state.displacement.numpy()).all()
    assert not re.search(r"\b(nan|inf)\b", capsys.readouterr().out)


def test_there_is_code_for_newcomers():
    first, builder = (
        "\n".join(code for code, _ in fences(name, "python")) for name in ("README.md", "warpfea/builder/README.md")
    )
    wanted = ("add_solid", "add_beam", "add_shell", "add_joint", "solve_static", "PNGWriter", "USDWriter", "GIFWriter")
    for name in (*wanted, "mass_matrix", "tangent_matrix", "free_slots", "wf.modes", "set_gravity", "worlds="):
        assert name in first, name
    wanted = ("add_moment", "spline", "weld", "add_pressure", "add_traction", "add_body_force", "add_point_load")
    joints = ("drive", "GROUND", "joint_force", "joint_record", "joint_value", "violation", "add_constraint")
    for name in (*wanted, *joints, "clamp", "set_initial", "add_probe"):
        assert name in builder, name


# commands


def commands():
    """The lines that call warpfea, of blocks and of `code`, with what they need to be parsed."""
    for name in TEXT:
        lines = [line for code, _ in fences(name, "sh") for line in code.replace("\\\n", " ").splitlines()]
        lines += [" ".join(text.split()) for text in re.findall(r"`(warpfea [^`]*)`", prose(name))]
        for line in lines:
            for part in line.split("&&"):
                words = shlex.split(part, comments=True)
                if words and words[0].endswith("warpfea") and len(words) > 1:
                    yield pytest.param(words[1:], id=f"{name}: {' '.join(words[1:])}"[:100])


@pytest.mark.parametrize("words", list(commands()))
def test_commands_parse(words, capsys):
    if len(words) == 1 or "COMMAND" in words:  # the name alone
        with pytest.raises(SystemExit, match="0"):
            parse([word for word in words[:1] if word != "COMMAND"] + ["--help"])
    else:
        assert callable(parse(words).command)


# links, names, numbers


@pytest.mark.parametrize("name", TEXT)
def test_links_lead_somewhere(name):
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(name)):
        if target.startswith("https://"):
            continue
        file, _, anchor = target.partition("#")
        path = (ROOT / name).parent / file if file else ROOT / name
        assert path.exists(), target
        if anchor:
            assert anchor in anchors(path), target


def anchors(path):
    """Those that a renderer gives to headings."""
    titles = re.findall(r"^#+ (.*)$", path.read_text(), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


@pytest.mark.parametrize("name", TEXT)
def test_files_named_in_code_exist(name):
    for text in re.findall(r"`([\w./-]+\.(?:py|json|npz|msh))`", prose(name)):
        places = [ROOT, (ROOT / name).parent, ROOT / "warpfea", RESULTS]
        if "/" in text or text.endswith("_h200.json"):
            assert any((place / text).exists() for place in places), text


@pytest.mark.parametrize("name", TEXT)
def test_public_names_exist(name):
    for attribute in re.findall(r"\bwf\.(\w+)", TEXT[name]):
        assert attribute in wf.__all__, attribute


def rows(name, section):
    """Cells of the rows of the tables between two marks, or below a heading; without heads."""
    text = TEXT[name]
    if section.startswith("#"):
        text = re.split(r"^##? ", text.split(f"\n{section}\n")[1], flags=re.MULTILINE)[0]
    else:
        text = text.split(f"<!-- {section} -->")[1].split(f"<!-- /{section} -->")[0]
    lines = text.splitlines()
    rules = {k for k, line in enumerate(lines) if line.startswith("|") and set(line) <= set("|-")}
    heads = {k - 1 for k in rules}
    kept = [line for k, line in enumerate(lines) if line.startswith("|") and k not in rules | heads]
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in kept]


@pytest.mark.parametrize("section", ["## Paper I", "## Paper T"])
def test_equations_are_where_the_table_says(section):
    table = rows("kernels/README.md", section)
    assert len(table) > 10
    for equation, _, functions, files in table:
        sources = [(ROOT / "kernels" / target).read_text() for target in re.findall(r"\]\((.*?)\)", files)]
        names = re.findall(r"`(\w+)`", functions)
        assert names, equation
        assert sources, equation
        for wanted in names:
            assert any(re.search(rf"(?m)^\s*def {wanted}\(|^{wanted}\b.*=", text) for text in sources), (
                equation,
                wanted,
            )


def test_the_table_has_the_equations_that_readers_look_for():
    text = " ".join(row[0] for row in rows("kernels/README.md", "## Paper I"))
    covered = set()
    for low, high in re.findall(r"\((\d+)\)(?:-\((\d+)\))?", text):
        covered |= set(range(int(low), int(high or low) + 1))
    left_out = {15, 16}  # what is said of them stands below the table
    assert covered == set(range(1, 85)) - left_out


ALWAYS = ("always", "energy ledger", "float64", "two-level, banded")
"""Conditions in the table of launches of kernels that each of these scenes launches, in the same order."""


def launch_table():
    """Rows of the table of launches: names of kernels, and what they depend on."""
    table = rows("kernels/LAUNCHES.md", "launch-order")
    return [(re.findall(r"`([\w.]+)`", kernels), when) for _, kernels, _, when, _ in table]


@pytest.mark.parametrize("name", ["cantilever", "hook", "hung_plate", "belt", "block_stack", "bouncing_ball"])
def test_launches_come_in_the_order_of_the_table(name, monkeypatch):
    from warpfea.base.launch import Launcher
    from warpfea.builder.scene import find

    seen = []
    count = Launcher._count_launch

    def watch(self, kernel):
        seen.append((pathlib.Path(kernel.func.__code__.co_filename).stem, kernel.func.__name__))
        count(self, kernel)

    monkeypatch.setattr(Launcher, "_count_launch", watch)
    scene = find(name)
    model = scene.build(scene.resolve({})).finalize(device="cpu")
    sim = wf.Simulation(model, dt=scene.dt, integrator=scene.integrator, capture=False)
    seen.clear()
    sim.step()
    first = list(dict.fromkeys(seen))
    sim.step(2)
    table = launch_table()
    place = {kernel: k for k, (kernels, _) in enumerate(table) for kernel in kernels}
    shared = ("begin", "start")  # names that several files have: the table gives the file
    for file, plain in dict.fromkeys(seen):
        assert f"{file}.{plain}" in place or (plain in place and plain not in shared), (file, plain)
    order = list(dict.fromkeys(f"{file}.{plain}" if f"{file}.{plain}" in place else plain for file, plain in first))
    always = [kernel for kernels, when in table if when in ALWAYS for kernel in kernels]
    assert len(always) >= 35
    launched = [kernel for kernel in order if kernel in always]
    assert launched == [kernel for kernel in always if kernel in launched]
    if name != "bouncing_ball":  # its first iterate, in free fall, is the solution
        assert launched == always
    anywhere = next(k for k, (_, when) in enumerate(table) if when == "wherever rows are summed")
    in_order = [kernel for kernel in order if place[kernel] != anywhere]
    assert in_order == sorted(in_order, key=place.get)


def test_the_table_of_launches_names_kernels():
    """Each in a file of its row; and per stage the functions of the host that launch it."""
    table = rows("kernels/LAUNCHES.md", "launch-order")
    assert 45 <= len(table) <= 90
    for _, kernels, files, _, _ in table:
        sources = {
            path.stem: path.read_text()
            for path in (ROOT / "kernels" / target for target in re.findall(r"\]\((.*?)\)", files))
        }
        used = set()
        for name in re.findall(r"`([\w.]+)`", kernels):
            file, _, plain = name.rpartition(".")
            found = {stem for stem, text in sources.items() if file in ("", stem) and f"def {plain}(" in text}
            assert found, name
            used |= found
        assert used == set(sources), kernels
    stages = [stage for stage, *_ in table if stage]
    host = "\n".join(path.read_text() for path in (ROOT / "warpfea").rglob("*.py"))
    for stage in stages:
        functions = re.findall(r"`(\w+)\.(\w+)`", stage)
        assert functions, stage
        for kind, function in functions:
            assert re.search(rf"(?ms)^class {kind}\b(?:(?!^\S).)*^    def {function}\(", host), stage


def result(name, key="rows"):
    return json.loads((RESULTS / name).read_text())[key]


def test_numbers_of_the_peer_table():
    measured = {row["label"]: row for row in result("peer_h200.json") if row["dtype"] == "float64"}
    table = rows("tests/README.md", "peer-numbers")
    assert [row[0] for row in table] == list(measured)
    for label, unknowns, peer, ms, speedup, iterations, residual, tip in table:
        row = measured[label]
        assert int(unknowns) == row["unknowns"]
        assert ms == f"{row['ms_per_step']:.3g}"
        assert peer == (str(row["peer_ms"]) if row["peer_ms"] else "-")
        assert speedup == (f"{row['speedup']:.3g}" if row["peer_ms"] else "-")
        assert iterations == f"{row['newton_per_step']:.1f}, {row['pcg_per_step']:.0f}"
        assert residual == f"{row['residual_force']:.0e}"
        assert tip == (f"{row['tip_difference']:.0e}" if row["peer_ms"] else "-")


def test_numbers_of_one_core():
    measured = {}
    for row in result("cpu.json"):
        measured.setdefault(row["label"], {})[row["solver"]] = row
    table = rows("tests/README.md", "cpu-numbers")
    assert [row[0] for row in table] == list(measured)
    for label, unknowns, *times, chrono in table:
        own = measured[label]
        assert int(unknowns) == own["default"]["unknowns"]
        for text, solver in zip(times, ("default", "block-jacobi", "direct")):
            assert float(text.split()[0]) == pytest.approx(own[solver]["ms_per_step"], rel=0.006), (label, solver)
        if chrono != "-":
            pair = [own["default"]["chrono_1"], own["default"]["chrono_2"]]
            assert [float(x) for x in chrono.split("/")] == pytest.approx(pair)


def test_numbers_of_joints():
    for device, joints, E, ms, iterations, before, *_ in rows("tests/README.md", "joint-numbers"):
        cost = result({"H200": "joints_h200.json", "CPU": "joints_cpu.json"}[device], "cost")
        own = [r for r in cost if "worlds" not in r and r["joints"] == int(joints) and r["E"] == float(E)]
        default = {r["dtype"]: r for r in own if r["method"] == "default"}
        for text, dtype in zip(ms.split(" / "), ("float64", "float32")):
            assert float(text) == pytest.approx(default[dtype]["ms_per_step"], abs=0.051)
        newton, pcg = map(float, iterations.split(","))
        assert (newton, pcg) == pytest.approx((default["float64"]["newton"], default["float64"]["pcg"]), abs=0.51)
        (old,) = (r for r in own if r["method"].startswith("before") and r["dtype"] == "float64")
        assert float(before) == pytest.approx(old["ms_per_step"], abs=0.051)


def test_numbers_of_orders():
    finest = {row["element"]: row for row in result("ancf_reference.json", "parts")["manufactured"]["rows"]}
    table = rows("tests/README.md", "order-numbers")
    assert {row[0] for row in table} == set(finest)
    for element, cells, unknowns, error, order in table:
        row = finest[element]
        assert (int(cells), int(unknowns)) == (row["cells"], row["unknowns"])
        assert error == f"{row['error']:.1e}"
        assert order == f"{row['order']:.2f}"


def test_files_of_results_are_listed():
    listed = TEXT["tests/README.md"].split("## Results and the commands")[1]
    for path in RESULTS.glob("*.json"):
        assert f"`{path.name}`" in listed, path.name


# pictures


def test_every_scene_has_its_picture():
    from PIL import Image

    scenes = {p.stem for p in (ROOT / "scenes").glob("*.py")} - {"__init__"}
    pictures = {p.stem: p for p in (RESULTS / "scenes").glob("*.png")}
    assert set(pictures) == scenes
    for name, path in pictures.items():
        assert f"results/scenes/{name}.png" in TEXT["scenes/README.md"]
        assert Image.open(path).size == (480, 300)
    assert sum(p.stat().st_size for p in pictures.values()) < 65.2e3 * len(pictures)
