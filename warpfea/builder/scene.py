"""Scenes: functions that return a ModelBuilder, with typed parameters that the command line can set.

    @wf.scene(dt=1e-3, t_end=0.5)
    def cantilever(*, length: float = 1.0, cells: int = 10) -> wf.ModelBuilder:
        '''A bar that bends under its own weight.

        Args:
            length: of the bar, m.
        '''

The module `warpfea.scenes.<name>` holds the scene `<name>`; a user's file may hold any number of them.
"""

from __future__ import annotations

import functools
import importlib
import importlib.util
import inspect
import itertools
import math
import pathlib
import pkgutil
import re
import sys
import types
import typing
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Generic, ParamSpec

from ..base.checks import check_positive, finite_number, number_hint
from ..base.errors import ModelError
from ..base.names import did_you_mean
from ..base.usercode import convert_user_errors

if TYPE_CHECKING:
    from .builder import ModelBuilder

__all__ = ["Parameter", "Scene", "find", "load_file", "locate", "names", "scene", "split_name"]

Params = ParamSpec("Params")
REQUIRED = inspect.Parameter.empty
_BOOL_WORDS = {"true": True, "yes": True, "on": True, "1": True, "false": False, "no": False, "off": False, "0": False}


@dataclass(frozen=True)
class Parameter:
    """Parameter of a scene: name, type, default (REQUIRED if there is none) and description."""

    name: str
    kind: Any
    default: Any
    doc: str = ""

    @property
    def required(self) -> bool:
        """True without a default."""
        return self.default is REQUIRED

    @property
    def kind_name(self) -> str:
        """Readable type."""
        return _kind_name(self.kind)

    def parse(self, text: str) -> Any:
        """Value parsed from `text`. ValueError states the expected type."""
        return _parse(text, self.kind)


class Scene(Generic[Params]):
    """A scene; a call returns its ModelBuilder.

    Attributes:
        name: of the function.
        dt, t_end: step and end time, s. integrator: name. tol: of the solver, or None.
        fps: frames of a USD file per simulated second.
        speed: simulated seconds per second of an animation.
        picture: time of a picture, s, or None for the end.
        reference, field: reference of `warpfea study`, see `scene`.
        description: first line of the docstring.
        parameters: by name.
    """

    dt: float
    t_end: float
    integrator: str
    tol: float | None
    fps: float
    speed: float
    picture: float | None
    reference: Any
    field: Callable[[Any], Any] | None

    def __init__(self, function: Callable[Params, ModelBuilder], options: dict[str, Any]) -> None:
        """Made by `scene`, of its options."""
        self.function = function
        functools.update_wrapper(self, function)
        self.name = function.__name__
        numbers = {name: options[name] for name in ("dt", "t_end", "fps", "speed")}
        check_positive(f"scene {self.name!r}", **numbers)
        vars(self).update(options | {name: float(value) for name, value in numbers.items()})
        text = inspect.getdoc(function) or ""
        self.description = text.split("\n\n")[0].replace("\n", " ").strip()
        self.details = text.partition("\n\n")[2].partition("Args:")[0].strip()
        self.parameters = _read_parameters(function, text)

    def __call__(self, *args: Params.args, **kwargs: Params.kwargs) -> ModelBuilder:
        return self.function(*args, **kwargs)

    def __repr__(self) -> str:
        return f"Scene({self.name!r}, dt={self.dt:g}, t_end={self.t_end:g})"

    def parse_settings(self, settings: Iterable[str]) -> dict[str, Any]:
        """Parameter values from `name=value` texts.

        Raises:
            ModelError: no `=`, a name given twice, an unknown parameter (lists the known ones), or a bad value.
        """
        out: dict[str, Any] = {}
        for setting in settings:
            name, equals, text = setting.partition("=")
            name = name.strip()
            if not equals or not name:
                raise ModelError(f"--set {setting}: expected name=value")
            if name not in self.parameters:
                hint = did_you_mean(name, self.parameters)
                raise ModelError(f"scene {self.name!r} has no parameter {name!r}; {self._parameter_listing()}{hint}")
            if name in out:
                raise ModelError(f"--set {name}: given twice")
            try:
                out[name] = self.parameters[name].parse(text.strip())
            except ValueError as error:
                hint = number_hint(text.strip())
                raise ModelError(
                    f"--set {setting}: {error} for parameter {name!r} of scene {self.name!r}{hint}"
                ) from None
        return out

    def resolve(self, given: dict[str, Any]) -> dict[str, Any]:
        """All parameters: given values and defaults. ModelError for one without either."""
        out = {}
        for name, parameter in self.parameters.items():
            if name not in given and parameter.required:
                kind = parameter.kind_name
                raise ModelError(f"scene {self.name!r}: parameter {name!r} ({kind}) has no default, give --set {name}=")
            out[name] = given.get(name, parameter.default)
        return out

    def build(self, given: dict[str, Any]) -> ModelBuilder:
        """Call the scene with the given parameters.

        Raises:
            ModelError: no ModelBuilder is returned, or the scene's code fails (with file and line).
        """
        from .builder import ModelBuilder

        with convert_user_errors(f"scene {self.name!r}"):
            out = self.function(**given)  # type: ignore[call-arg]
        if not isinstance(out, ModelBuilder):
            raise ModelError(f"scene {self.name!r} must return a ModelBuilder, it returned {type(out).__name__}")
        return out

    def _parameter_listing(self) -> str:
        if not self.parameters:
            return "it has none"
        texts = [p.name + ("" if p.required else f"={p.default}") for p in self.parameters.values()]
        return f"it has {', '.join(texts)}"


def scene(
    *,
    dt: float,
    t_end: float,
    integrator: str = "backward_euler",
    tol: float | None = None,
    fps: float = 60.0,
    speed: float = 1.0,
    picture: float | None = None,
    reference: Any = None,
    field: Callable[[Any], Any] | None = None,
) -> Callable[[Callable[Params, ModelBuilder]], Scene[Params]]:
    """Decorator: make a function that returns a ModelBuilder a scene.

    Args:
        dt: default step, s.
        t_end: default end time, s.
        integrator: default integrator.
        tol: default tolerance of the solver; None: the solver's own.
        fps: frames per simulated second in a USD file.
        speed: simulated seconds per second of a GIF; less than 1 is slow motion.
        picture: time of a PNG, s; None: the end.
        reference: known motion for `warpfea study`: a dict of probe names to functions of times (n,) returning
            positions (n, 3); a wf.Reference; or a function of scene parameters returning one.
        field: a function of the final simulation returning an array of mesh-independent shape, e.g. displacements at
            fixed points; `warpfea study` reports the norm of its error.

    Raises:
        ModelError: a number that is not positive.
    """
    options = locals()
    return lambda function: Scene(function, options)


# finding scenes


def names() -> list[str]:
    """Names of the scenes of warpfea, without importing them."""
    package = importlib.import_module("warpfea.scenes")
    return sorted(m.name for m in pkgutil.iter_modules(package.__path__) if not m.name.startswith("_"))


def find(name: str) -> Scene[Any]:
    """The scene `name` of warpfea. ModelError lists the known ones."""
    if name not in names():
        hint = did_you_mean(name, names())
        raise ModelError(
            f"there is no scene {name!r}; there are {', '.join(names())}, or give a .py or mesh file{hint}"
        )
    found = getattr(importlib.import_module(f"warpfea.scenes.{name}"), name, None)
    if not isinstance(found, Scene):
        raise ModelError(f"module warpfea.scenes.{name} does not define the scene {name!r}")
    return found


def split_name(what: str) -> tuple[str | None, str]:
    """File and scene of NAME, file.py or file.py:NAME; None without a file, "" without a name."""
    file, colon, name = what.rpartition(":")
    if colon and file.endswith(".py"):
        return file, name
    return (what, "") if what.endswith(".py") else (None, what)


def locate(what: str, content: bytes | None = None) -> Scene[Any]:
    """The scene NAME, file.py or file.py:NAME, from the file or its content. ModelError lists the known ones."""
    file, name = split_name(what)
    if file is None:
        return find(name)
    # absolute: Python stores the file's code under that path, so tracebacks show its lines
    found = load_file(pathlib.Path(file).absolute(), content)
    if not name:
        if len(found) > 1:
            raise ModelError(f"{file} holds several scenes, give {file}:NAME with one of {', '.join(found)}")
        return next(iter(found.values()))
    if name not in found:
        raise ModelError(f"{file} has no scene {name!r}; it has {', '.join(found)}{did_you_mean(name, found)}")
    return found[name]


_loaded = itertools.count()


def load_file(path: str | pathlib.Path, content: bytes | None = None) -> dict[str, Scene[Any]]:
    """Run a Python file, or its content, and return its scenes by name; imported ones only if it defines none.

    A file of a package (a folder with __init__.py) may use relative imports, any other file imports from its own
    folder.

    Raises:
        ModelError: no such file, an error in it (with its line), or no scene in it.
    """
    file = pathlib.Path(path)
    if not file.is_file():
        raise ModelError(f"{file}: no such file")
    folder = file.resolve().parent
    packages: list[str] = []
    while (folder / "__init__.py").is_file():
        packages.insert(0, folder.name)
        folder = folder.parent
    name = f"_warpfea_scenes_{next(_loaded)}_{re.sub(r'[^0-9a-zA-Z_]', '_', file.stem)}"
    name = ".".join([*packages, name])
    spec = importlib.util.spec_from_file_location(name, file)
    if spec is None or spec.loader is None:
        raise ModelError(f"{file}: not a Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    sys.path.insert(0, str(folder))
    try:
        content = file.read_bytes() if content is None else content
        exec(compile(content, file, "exec", dont_inherit=True), module.__dict__)
    except Exception as error:
        del sys.modules[name]
        raise ModelError(f"{_error_location(error, file)}: {type(error).__name__}: {error}") from error
    finally:
        sys.path.remove(str(folder))
    every = {item.name: item for item in vars(module).values() if isinstance(item, Scene)}
    own = {key: item for key, item in every.items() if item.function.__module__ == name}
    if not every:
        raise ModelError(f"{file}: defines no scene; put @wf.scene(dt=..., t_end=...) before a function")
    return own or every


def _error_location(error: BaseException, file: pathlib.Path) -> str:
    """`file:line` of the deepest frame of an error that lies in the file."""
    if isinstance(error, SyntaxError):
        return f"{error.filename or file}:{error.lineno}"
    lines = []
    trace = error.__traceback__
    while trace is not None:
        if pathlib.Path(trace.tb_frame.f_code.co_filename) == file:
            lines.append(trace.tb_lineno)
        trace = trace.tb_next
    return f"{file}:{lines[-1]}" if lines else str(file)


# parameters


def _read_parameters(function: Callable[..., Any], text: str) -> dict[str, Parameter]:
    docs = _argument_docs(text)
    try:
        hints = typing.get_type_hints(function)
    except Exception:  # unresolvable annotation: use the type of the default
        hints = {}
    out = {}
    for name, item in inspect.signature(function).parameters.items():
        if item.kind in (item.VAR_POSITIONAL, item.VAR_KEYWORD, item.POSITIONAL_ONLY):
            raise ModelError(f"scene {function.__name__!r}: parameter {name!r} must be a keyword with a name")
        kind = hints.get(name)
        if kind is None:
            kind = str if item.default in (REQUIRED, None) else type(item.default)
        out[name] = Parameter(name, kind, item.default, docs.get(name, ""))
    return out


def _argument_docs(text: str) -> dict[str, str]:
    """Descriptions in the "Args:" section of a docstring; lines indented further continue one."""
    out: dict[str, str] = {}
    _, _, section = text.partition("Args:\n")
    current, indent = "", -1
    for line in section.splitlines():
        depth = len(line) - len(line.lstrip())
        if not line.strip() or depth == 0:
            break
        indent = depth if indent < 0 else indent
        if depth == indent and ":" in line:
            current, _, doc = line.strip().partition(":")
            out[current] = doc.strip()
        elif current:
            out[current] += " " + line.strip()
    return out


def _kind_name(kind: Any) -> str:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin is typing.Literal:
        return " or ".join(map(str, arguments))
    if origin is tuple:
        if arguments[-1] is Ellipsis:
            return f"{_kind_name(arguments[0])},..."
        return ",".join(_kind_name(a) for a in arguments)
    if origin in (typing.Union, types.UnionType):
        return " or ".join("none" if a is type(None) else _kind_name(a) for a in arguments)
    return getattr(kind, "__name__", str(kind))


def _parse(text: str, kind: Any) -> Any:
    origin, arguments = typing.get_origin(kind), typing.get_args(kind)
    if origin in (typing.Union, types.UnionType):
        return _parse_union(text, kind, arguments)
    if origin is typing.Literal:
        for value in arguments:
            if text == str(value):
                return value
        raise ValueError(f"{text!r} is not {_kind_name(kind)}")
    if origin is tuple or kind is tuple:
        return _parse_tuple(text, kind, arguments or (float, Ellipsis))
    if kind not in _SCALAR_PARSERS:
        raise ValueError(f"{text!r} can't be read as {_kind_name(kind)}")
    return _SCALAR_PARSERS[kind](text)


def _parse_bool(text: str) -> bool:
    if text.lower() not in _BOOL_WORDS:
        raise ValueError(f"{text!r} is not true or false")
    return _BOOL_WORDS[text.lower()]


def _parse_int(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"{text!r} is not a whole number") from None


def _parse_float(text: str) -> float:
    value = finite_number(text)
    if math.isnan(value):
        raise ValueError(f"{text!r} is not a finite number")
    return value


_SCALAR_PARSERS: dict[Any, Callable[[str], Any]] = {
    bool: _parse_bool, int: _parse_int, float: _parse_float, str: str, pathlib.Path: pathlib.Path,
}  # fmt: skip
"""Parsers of values other than unions, literals and tuples."""


def _parse_union(text: str, kind: Any, arguments: tuple[Any, ...]) -> Any:
    if type(None) in arguments and text.lower() == "none":
        return None
    for choice in arguments:
        try:
            if choice is not type(None):
                return _parse(text, choice)
        except ValueError:
            continue
    raise ValueError(f"{text!r} is not {_kind_name(kind)}")


def _parse_tuple(text: str, kind: Any, arguments: tuple[Any, ...]) -> tuple[Any, ...]:
    parts = [part.strip() for part in text.strip("()").split(",")]
    if arguments[-1] is Ellipsis:
        return tuple(_parse(part, arguments[0]) for part in parts)
    if len(parts) != len(arguments):
        raise ValueError(f"{text!r} is not {len(arguments)} values ({_kind_name(kind)})")
    return tuple(_parse(part, each) for part, each in zip(parts, arguments))
