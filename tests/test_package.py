"""Packaging: the folders of the top level install as sub-packages, from a wheel, in place, and from a clone."""

import ast
import importlib.metadata
import importlib.util
import os
import pathlib
import re
import subprocess
import sys
import sysconfig
import tomllib

import pytest

ROOT = pathlib.Path(__file__).resolve().parent.parent
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())


def python(code, cwd):
    """Run code from another folder; where the project is not installed, with the clone on the path."""
    env = dict(os.environ)
    if importlib.util.find_spec("warpfea") is None or not list(importlib.metadata.distributions(name="warpfea")):
        env["PYTHONPATH"] = str(ROOT)
    return subprocess.run([sys.executable, "-c", code], cwd=cwd, capture_output=True, text=True, check=False, env=env)


def test_packages_lists_every_folder():
    listed = set(PROJECT["tool"]["setuptools"]["packages"])
    found = {"warpfea.kernels", "warpfea.scenes"}
    for init in (ROOT / "warpfea").rglob("__init__.py"):
        found.add(".".join(init.parent.relative_to(ROOT).parts))
    assert listed == found


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


def test_wheel_runs_a_scene_from_another_folder(tmp_path):
    wheels = tmp_path / "wheels"
    build = [sys.executable, "-m", "pip", "wheel", "--no-deps", "-q", "-w", str(wheels), str(ROOT)]
    subprocess.run(build, check=True, capture_output=True)
    (wheel,) = wheels.glob("*.whl")
    # an empty environment; only the dependencies are borrowed from this one, and its own warpfea is not
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", str(tmp_path / "venv")], check=True)
    inside = tmp_path / "venv" / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", str(inside), "install", "-q", "--no-deps", str(wheel)]
    subprocess.run(install, check=True, capture_output=True)
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
    out = subprocess.run([str(inside), "-c", code], cwd=elsewhere, capture_output=True, text=True, check=False)
    assert out.returncode == 0, out.stderr
    assert (elsewhere / "out.json").exists()


KERNEL_FILES = sorted((ROOT / "kernels").glob("*.py"))


@pytest.mark.parametrize("path", KERNEL_FILES, ids=[p.stem for p in KERNEL_FILES])
def test_kernels_import_nothing_from_the_host_side(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom):
            assert node.level <= 1, ast.unparse(node)
            if node.level == 0:
                assert node.module.split(".")[0] in ("warp", "collections", "typing"), ast.unparse(node)
        if isinstance(node, ast.Import):
            assert {a.name.split(".")[0] for a in node.names} <= {"warp", "functools", "types", "math"}, ast.unparse(
                node
            )


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


@pytest.mark.parametrize("path", [p for p in KERNEL_FILES if p.stem != "raycast"], ids=lambda p: p.stem)
def test_no_bare_float_literals_in_device_code(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef) and any("wp." in ast.unparse(d) for d in node.decorator_list):
            for literal, wrapped in literal_floats(node):
                assert wrapped, f"{path.name}:{literal.lineno} {node.name}: wrap {literal.value} in the scalar type"


@pytest.mark.parametrize("path", [p for p in KERNEL_FILES if p.stem != "raycast"], ids=lambda p: p.stem)
def test_kernels_are_short_and_say_what_they_do(path):
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.FunctionDef) and any("kernel" in ast.unparse(d) for d in node.decorator_list):
            assert ast.get_docstring(node), node.name
            assert node.end_lineno - node.lineno < 80, node.name


def test_text_speaks_of_the_project_alone():
    words = re.compile("|".join(["/wo" + "rk/", "/ro" + "ot/", "pypi" + r"\.org", "closing " + "note"]))
    for path in [*ROOT.glob("*.md"), *(ROOT / "warpfea").rglob("*.py"), *KERNEL_FILES, *(ROOT / "scenes").glob("*.py")]:
        assert not words.search(path.read_text()), path
