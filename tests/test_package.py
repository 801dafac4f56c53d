"""Packaging: the folders of the top level install as sub-packages, from a wheel, in place, and from a clone.

The floors of the house: imports only go down, and the CUDA tests need neither meshio nor usd-core.
"""

import ast
import importlib.metadata
import importlib.util
import json
import os
import pathlib
import re
import shutil
import subprocess
import sys
import sysconfig
import tomllib

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
CLEAN = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "PYTHONHOME")}
"""The environment, in which Python finds what is installed and nothing else."""


def python(code, cwd):
    """Run code from another folder; where the project is not installed, with the clone on the path."""
    env = dict(os.environ)
    if importlib.util.find_spec("warpfea") is None or not list(importlib.metadata.distributions(name="warpfea")):
        env["PYTHONPATH"] = str(ROOT)
    return subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, check=False, env=env)


def test_packages_lists_every_folder():
    listed = PROJECT["tool"]["setuptools"]["packages"]
    assert len(listed) == len(set(listed))
    found = set()
    for name, folder in PROJECT["tool"]["setuptools"]["package-dir"].items():
        for init in (ROOT / folder).rglob("__init__.py"):
            found.add(".".join([name, *init.parent.relative_to(ROOT / folder).parts]))
    assert {"warpfea.kernels.common", "warpfea.scenes", "warpfea.studies.bench"} < found
    assert set(listed) == found


def test_every_folder_with_modules_is_a_package():
    """A folder without __init__.py would work here and be missing from a wheel."""
    for folder in PROJECT["tool"]["setuptools"]["package-dir"].values():
        for module in (ROOT / folder).rglob("*.py"):
            assert (module.parent / "__init__.py").is_file(), module


def test_an_unrelated_kernels_package_is_left_alone(tmp_path):
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels" / "__init__.py").write_text("WHOSE = 'theirs'")
    code = (
        "import kernels, warpfea, warpfea.kernels.common.types, sys;"
        "assert kernels.WHOSE == 'theirs';"
        "assert warpfea.kernels is not kernels;"
        "print(sorted(m for m in sys.modules if m == 'scenes' or m.startswith('kernels.')))"
    )
    out = python(code, tmp_path)
    assert out.stdout.strip() == "[]", out.stderr


def test_import_is_quiet_and_light(tmp_path):
    code = (
        "import sys, warpfea, warp as wp;"
        "bad = [m for m in sys.modules if m.split('.')[0] in ('pxr', 'meshio', 'PIL', 'kernels', 'scenes')];"
        "assert not bad, bad;"
        "assert wp._src.context.runtime is None, 'a device was started'"
    )
    out = python(code, tmp_path)
    assert out.returncode == 0, out.stderr
    assert out.stdout == ""
    assert out.stderr == ""


def test_nothing_else_of_the_checkout_is_importable():
    for name in ("tests", "pyproject"):
        with pytest.raises(ModuleNotFoundError):
            __import__(f"warpfea.{name}")


def copy_sources(target):
    """The files of a wheel, without leftovers of earlier builds."""
    target.mkdir()
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, target)
    for name in ("warpfea", "kernels", "scenes"):
        shutil.copytree(ROOT / name, target / name, ignore=shutil.ignore_patterns("__pycache__"))
    return target


@pytest.mark.slow
def test_wheel_runs_a_scene_from_another_folder(tmp_path):
    wheels = tmp_path / "wheels"
    sources = copy_sources(tmp_path / "sources")
    build = [sys.executable, "-m", "pip", "wheel", "--no-deps", "-q", "-w", str(wheels), str(sources)]
    subprocess.run(build, check=True, capture_output=True, env=CLEAN)
    (wheel,) = wheels.glob("*.whl")
    # an empty environment; only the dependencies are borrowed from this one, and its own warpfea is not
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True, env=CLEAN)
    inside = tmp_path / "venv" / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", str(inside), "install", "-q", "--no-deps", str(wheel)]
    subprocess.run(install, check=True, capture_output=True, env=CLEAN)
    (site,) = (tmp_path / "venv").glob("lib/python3*/site-packages")
    assert {p.name for p in site.iterdir() if not p.name.endswith(".dist-info")} == {"warpfea"}
    (site / "borrowed.pth").write_text(sysconfig.get_paths()["purelib"] + "\n")
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    code = (
        f"import sys, warpfea; assert warpfea.__file__.startswith({str(site)!r}), warpfea.__file__;"
        "from warpfea.cli import main;"
        "sys.exit(main(['run', 'cantilever', '--t-end', '0.01', '--set', 'cells=2', '--json', 'out.json']))"
    )
    call = [str(inside), "-c", code]
    out = subprocess.run(call, cwd=elsewhere, capture_output=True, text=True, check=False, env=CLEAN)
    assert out.returncode == 0, out.stderr
    assert (elsewhere / "out.json").exists()


KERNELS = ROOT / "kernels"
KERNEL_FILES = sorted(KERNELS.rglob("*.py"))


def name_of(path):
    return str(path.relative_to(KERNELS))


@pytest.mark.parametrize("path", KERNEL_FILES, ids=name_of)
def test_kernels_import_nothing_from_the_host_side(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level <= len(path.relative_to(KERNELS).parts), ast.unparse(node)
            if node.level == 0:
                assert node.module.split(".")[0] in ("warp", "collections", "typing"), ast.unparse(node)
        if isinstance(node, ast.Import):
            assert {a.name.split(".")[0] for a in node.names} <= {
                "ast",
                "enum",
                "warp",
                "functools",
                "types",
                "math",
            }, ast.unparse(node)


def literal_floats(function):
    """Bare float literals of a device function: Warp takes them as float32 without a word."""
    for node in ast.walk(function):
        for child in ast.iter_child_nodes(node):
            child.parent = node
    for node in ast.walk(function):
        if isinstance(node, ast.Constant) and isinstance(node.value, float):
            parent = node.parent
            if isinstance(parent, ast.UnaryOp):
                parent = parent.parent
            yield node, isinstance(parent, ast.Call)


def is_device_code(node):
    """True of a function that Warp compiles."""
    by = node.decorator_list if isinstance(node, ast.FunctionDef) else []
    return any(ast.unparse(d).startswith(("wp.", "masked_kernel(")) for d in by)


@pytest.mark.parametrize("path", [p for p in KERNEL_FILES if p.stem != "raycast"], ids=name_of)
def test_no_bare_float_literals_in_device_code(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if is_device_code(node):
            for literal, wrapped in literal_floats(node):
                assert wrapped, f"{path.name}:{literal.lineno} {node.name}: wrap {literal.value} in the scalar type"


@pytest.mark.parametrize("path", [p for p in KERNEL_FILES if p.stem != "raycast"], ids=name_of)
def test_kernels_are_short_and_say_what_they_do(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if is_device_code(node):
            assert ast.get_docstring(node), node.name
            assert node.end_lineno - node.lineno < 80, node.name


def test_files_of_device_code_are_short():
    assert [name_of(path) for path in KERNEL_FILES if len(path.read_text().splitlines()) > 450] == []


MANY = {
    "builder/contact_methods.py:add_contact": 18, "simulation/simulation.py:__init__": 19,
    "studies/accuracy/study.py:study": 13,
}  # fmt: skip
"""Functions of the host with more than 12 parameters, besides scenes; `study`: the scene, eleven keywords, options."""


def functions(folder):
    """Functions of a folder, nested ones and methods included, as ("path:name", node); names may repeat."""
    for path in sorted(folder.rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef):
                yield f"{path.relative_to(folder).as_posix()}:{node.name}", node


def decisions(node):
    """1 + branches, loops and logical operations of a function, without nested definitions."""
    count, todo = 1, list(ast.iter_child_nodes(node))
    while todo:
        one = todo.pop()
        if not isinstance(one, (ast.FunctionDef, ast.ClassDef, ast.Lambda)):
            count += isinstance(one, (ast.If, ast.For, ast.While, ast.IfExp))
            count += len(one.values) - 1 if isinstance(one, ast.BoolOp) else 0
            todo += ast.iter_child_nodes(one)
    return count


def parameters(node):
    """Parameters of a function but self and cls."""
    own = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
    return len([a for a in own if a.arg not in ("self", "cls")])


def test_functions_have_few_decisions_and_parameters():
    """Decisions of the host's functions are ruff's C901."""
    device = list(functions(KERNELS))
    assert [(name, n) for name, node in device if (n := decisions(node)) > 20] == []
    assert [(name, n) for name, node in device if (n := parameters(node)) > 12] == []
    host = [(name, n) for name, node in functions(ROOT / "warpfea") if (n := parameters(node)) > 12]
    assert sorted(host) == sorted(MANY.items())


def _of_folders(suffix):
    """Files of all folders of the project but its tests' data and results."""
    for folder in ("warpfea", "kernels", "scenes"):
        yield from (ROOT / folder).rglob(f"*.{suffix}")
    yield from (ROOT / "tests").glob(f"*.{suffix}")


def test_text_speaks_of_the_project_alone():
    words = re.compile("|".join(["/wo" + "rk/", "/ro" + "ot/", "pypi" + r"\.org", "closing " + "note"]))
    for path in [p for suffix in ("md", "py", "toml") for p in (*ROOT.glob(f"*.{suffix}"), *_of_folders(suffix))]:
        assert not words.search(path.read_text()), path


def lines_in(*folders):
    files = {path for folder in folders for path in (ROOT / folder).rglob("*.py") if path.name != "oracle.py"}
    return sum(len(path.read_text().splitlines()) for path in files)


def test_folders_keep_to_their_lines(record_property):
    assert lines_in("tests/validation") <= 4000
    assert lines_in("warpfea/studies") <= 6800
    record_property("lines outside tests", lines_in(*PROJECT["tool"]["setuptools"]["package-dir"].values()))


def test_contact_written_once_took_three_thousand_lines_away():
    """Of the code outside tests; what followed are parts of contact that were not there before."""
    found = json.loads((ROOT / "tests/results/lines.json").read_text())["commits"]
    assert all(sum(row["folders"].values()) == row["lines"] for row in found.values())
    assert found["before"]["lines"] - found["after"]["lines"] >= 3000


@pytest.mark.xfail(strict=True, reason="31 286 lines: longer names, files split by topic, tests of the renaming")
def test_tests_have_as_many_lines_as_at_51a4e5d():
    assert lines_in("tests") - lines_in("tests/validation") <= 30_864


# nothing stands twice

SHARED_LINES = 6


def code_lines(path):
    """(number, line) of the code and docstrings of a file; without imports, `__all__` and punctuation."""
    text, left_out = path.read_text(), set()
    for node in ast.walk(ast.parse(text)):
        listing = isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "__all__"
        if listing or isinstance(node, (ast.Import, ast.ImportFrom)):
            left_out.update(range(node.lineno, node.end_lineno + 1))
    lines = [(k, " ".join(line.split())) for k, line in enumerate(text.splitlines(), 1) if k not in left_out]
    return [(k, line) for k, line in lines if re.search(r"\w", line) and not line.startswith("#")]


def test_no_six_lines_stand_twice():
    first, twice = {}, set()
    for path in sorted([*(ROOT / "warpfea").rglob("*.py"), *KERNEL_FILES]):
        lines = code_lines(path)
        for k in range(len(lines) - SHARED_LINES + 1):
            run = tuple(line for _, line in lines[k : k + SHARED_LINES])
            place = (path, lines[k][0])
            if (other := first.setdefault(run, place)) != place:
                twice.add((other, place))
    assert [f"{a}:{i} ~ {b}:{j}" for (a, i), (b, j) in sorted(twice)] == []


# floors


def test_no_import_is_excused():
    """Imports for type checking count too, and none is ignored."""
    linter = PROJECT["tool"]["importlinter"]
    assert "exclude_type_checking_imports" not in linter
    for contract in linter["contracts"]:
        assert not {"ignore_imports", "unmatched_ignore_imports_alerting"} & set(contract), contract["name"]
    layers = next(c for c in linter["contracts"] if c.get("containers") == ["warpfea"])
    assert layers["exhaustive"]


def test_imports_only_go_down(tmp_path):
    """import-linter on a copy with kernels and scenes where they are installed; `.ci/run` does it on the package."""
    pytest.importorskip("importlinter")
    flat = tmp_path / "flat"
    flat.mkdir()
    for name, folder in sorted(PROJECT["tool"]["setuptools"]["package-dir"].items()):
        target = flat.joinpath(*name.split("."))
        shutil.copytree(ROOT / folder, target, ignore=shutil.ignore_patterns("__pycache__"))
    code = "import sys; from importlinter.cli import lint_imports_command; sys.exit(lint_imports_command())"
    words = ["--config", str(ROOT / "pyproject.toml"), "--no-cache", "--no-logo"]
    env = CLEAN | {"PYTHONPATH": str(flat)}
    call = [sys.executable, "-c", code, *words]
    out = subprocess.run(call, cwd=flat, capture_output=True, text=True, check=False, env=env)
    assert out.returncode == 0, out.stdout[-4000:] + out.stderr[-2000:]
    assert "0 broken" in out.stdout


# the tests where meshio and usd-core are missing

BLOCKER = """
import sys

class Blocker:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in ("meshio", "pxr"):
            raise ModuleNotFoundError(f"No module named {name!r} (blocked)", name=name)

sys.meta_path.insert(0, Blocker())
"""


@pytest.mark.slow
def test_cuda_tests_collect_without_meshio_and_usd(tmp_path):
    """As on a machine with a GPU and little else: every file is imported, and the tests marked `cuda` are found."""
    (tmp_path / "sitecustomize.py").write_text(BLOCKER)
    env = os.environ | {"PYTHONPATH": os.pathsep.join([str(tmp_path), str(ROOT)])}
    call = [sys.executable, "-c", "import meshio"]
    assert "blocked" in subprocess.run(call, capture_output=True, text=True, check=False, env=env).stderr
    call = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "cuda", "--collect-only", "tests"]
    out = subprocess.run(call, cwd=ROOT, capture_output=True, text=True, check=False, env=env)
    assert out.returncode == 0, out.stdout[-4000:]
    for name in ("test_device.py", "test_profile.py", "test_jacobi.py"):
        assert f"tests/{name}::" in out.stdout
    # and what they simulate is made without them
    code = (
        "from tests.validation import devices\n"
        "from warpfea.builder.scene import find\n"
        "for make in (*devices.CASES.values(), find('cantilever')): make()\n"
    )
    call = [sys.executable, "-c", code]
    out = subprocess.run(call, cwd=tmp_path, capture_output=True, text=True, check=False, env=env)
    assert out.returncode == 0, out.stderr
