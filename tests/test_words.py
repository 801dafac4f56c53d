"""Everything that others call or read says what it is: docstrings of device code and of the public host code."""

import ast
import collections
import csv
import functools
import pathlib

import pytest

ROOT = pathlib.Path(__file__).resolve().parents[1]
DEVICE = {"wp.func", "wp.func_native", "wp.kernel", "masked_kernel"}
RENAMED = ("pushed", "massive", "lagged", "guess")
"""Words for which the code has terms of the field: nonpotential, with_mass, reused, predictor."""

FORMER = ROOT / "tests" / "data" / "renames.csv"
"""kind, old, new, where: former names, which may not come back in the folders named, and former files."""
FORMER_TOLD = ("warpfea/base/renamed.py",)
"""Files that name former names to refuse them."""

# to be done: this set may only shrink
WITHOUT: set[str] = set()


def files(folder):
    return sorted(ROOT.joinpath(folder).rglob("*.py"))


@functools.cache
def parsed(path):
    return ast.parse(path.read_text(encoding="utf-8"))


def decorators(node):
    calls = (d.func if isinstance(d, ast.Call) else d for d in node.decorator_list)
    return {ast.unparse(d) for d in calls}


def device_code(tree):
    """Every wp.func and wp.kernel of a module, also inside the function that specialises it."""
    for node in ast.walk(tree):
        if isinstance(node, ast.FunctionDef) and DEVICE & decorators(node):
            yield node.name, node


def public(body, prefix=""):
    """Public functions, classes and methods of a module, but no functions inside functions."""
    for node in body:
        if not isinstance(node, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)) or node.name.startswith("_"):
            continue
        if any(d.endswith((".setter", ".deleter", "overload")) for d in decorators(node)):
            continue
        yield prefix + node.name, node
        if isinstance(node, ast.ClassDef):
            yield from public(node.body, f"{node.name}.")


def documented(trees):
    """(class, method) with a docstring, and the names of the bases of every class."""
    methods, bases = set(), {}
    for tree in trees:
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                names = [ast.unparse(b).split("[")[0].split(".")[-1] for b in node.bases]
                bases.setdefault(node.name, set()).update(names)
                for item in node.body:
                    if isinstance(item, ast.FunctionDef) and ast.get_docstring(item):
                        methods.add((node.name, item.name))
    return methods, bases


def inherits_docstring(name, methods, bases):
    """True if a method overrides one of a base class that has a docstring."""
    owner, _, method = name.rpartition(".")
    todo, seen = list(bases.get(owner, ())), set()
    while todo:
        base = todo.pop()
        if base not in seen:
            seen.add(base)
            if (base, method) in methods:
                return True
            todo += bases.get(base, ())
    return False


def without_docstring(folder):
    """Names "path:name" of what lacks one."""
    trees = {path: parsed(path) for path in files(folder)}
    methods, bases = documented(trees.values())
    for path, tree in trees.items():
        at = path.relative_to(ROOT).as_posix()
        if not ast.get_docstring(tree):
            yield f"{at}:"
        named = list(public(tree.body)) + (list(device_code(tree)) if folder == "kernels" else [])
        for name, node in named:
            if not ast.get_docstring(node) and not inherits_docstring(name, methods, bases):
                yield f"{at}:{name}"


@pytest.mark.parametrize("folder", ["kernels", "warpfea", "scenes"])
def test_code_has_docstrings(folder):
    found = set(without_docstring(folder))
    expected = {name for name in WITHOUT if name.startswith(f"{folder}/")}
    assert not found - expected, f"without a docstring: {', '.join(sorted(found - expected))}"
    assert not expected - found, f"have one now, take them off WITHOUT: {', '.join(sorted(expected - found))}"


def test_the_walk_finds_device_code():
    """Kernels lie inside functions, where a walk over modules alone would miss them."""
    found = {name for path in files("kernels") for name, _ in device_code(parsed(path))}
    assert {"internal_force", "cast_rays", "sync", "access", "jacobian_power_change"} <= found
    source = "def make():\n    @wp.func\n    def f(x: float):\n        return x\n"
    assert [name for name, node in device_code(ast.parse(source)) if not ast.get_docstring(node)] == ["f"]


def test_methods_inherit_docstrings():
    base = 'class A:\n    def f(self):\n        """F."""\n'
    other = "class B(A):\n    def f(self): ...\n    def g(self): ...\n"
    methods, bases = documented([ast.parse(base + other)])
    assert inherits_docstring("B.f", methods, bases)
    assert not inherits_docstring("B.g", methods, bases)
    assert not inherits_docstring("f", methods, bases)


def names(tree):
    """Names that a module defines: functions, classes, arguments, variables and attributes."""
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node.name
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, (ast.Name, ast.Attribute)) and isinstance(node.ctx, ast.Store):
            yield node.id if isinstance(node, ast.Name) else node.attr


@pytest.mark.parametrize("folder", ["kernels", "warpfea", "scenes"])
def test_names_are_terms_of_the_field(folder):
    """No name goes back to a word that a term of the field replaced."""
    # studies may guess how long a run takes
    chosen = [path for path in files(folder) if "studies" not in path.parts]
    used = {n for path in chosen for n in names(parsed(path)) if set(n.lower().split("_")) & {*RENAMED, "lag"}}
    assert not used, f"names to replace: {', '.join(sorted(used))}"


def identifiers(tree):
    """All names in a module: of variables, attributes, arguments, keywords, functions, classes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr
        elif isinstance(node, (ast.FunctionDef, ast.ClassDef)):
            yield node.name
        elif isinstance(node, (ast.arg, ast.keyword)) and node.arg:
            yield node.arg
        elif isinstance(node, ast.alias):
            yield node.asname or node.name


@functools.cache
def former():
    """Rows of FORMER."""
    with open(FORMER, newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_former_names_do_not_come_back():
    banned = collections.defaultdict(dict)
    for row in former():
        for folder in filter(None, row["where"].split(";")):
            banned[folder][row["old"]] = row["new"]
    found = set()
    for path in (path for folder in ("kernels", "warpfea", "scenes") for path in files(folder)):
        here = path.relative_to(ROOT)
        names = banned["/".join(here.parts[:-1][:2])]
        if names and here.as_posix() not in FORMER_TOLD:
            found |= {f"{here.as_posix()}: {n} is {names[n]} now" for n in {*identifiers(parsed(path))} & names.keys()}
    assert not found, "; ".join(sorted(found))


def test_former_files_do_not_come_back():
    back = [row["old"] for row in former() if row["kind"] == "file" and (ROOT / row["old"]).exists()]
    assert not back, f"files by a former name: {', '.join(back)}"


def opening(text):
    """The first word of a docstring."""
    return text.split(maxsplit=1)[0].strip(":,.;") if text.strip() else ""


def openings(tree):
    """Lines of docstrings of a module, also of attributes, that open with a question word."""
    for node in ast.walk(tree):
        for item in node.body if isinstance(getattr(node, "body", None), list) else ():
            text = item.value.value if isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant) else ""
            if isinstance(text, str) and opening(text) in ("What", "Where", "Whether", "How"):
                yield item.lineno


def test_docstrings_open_with_the_standard_noun_or_verb():
    found = []
    for folder in ("kernels", "warpfea", "scenes", "tests"):
        for path in files(folder):
            found += [f"{path.relative_to(ROOT).as_posix()}:{line}" for line in openings(parsed(path))]
    assert not found, f"{len(found)} docstrings open with a question word: {', '.join(found[:40])}"
