"""Integrators as words: "bdf2", "generalized_alpha(rho_inf=0.8)"."""

from __future__ import annotations

import importlib
import re
from typing import Any

from ..base.errors import ModelError
from . import integrators

__all__ = ["method", "split_methods"]

_CALL = re.compile(r"\s*([A-Za-z]\w*)\s*\((.*)\)\s*")


def method(text: str) -> Any:
    """What `Simulation(integrator=)` takes, from its name, or from a name with options: `name(option=value, ...)`.

    An integrator with options is a class of the package whose name is that of the integrator without underscores.

    Raises:
        ModelError: no such integrator, or an option that it does not have.
        NotImplementedError: it is not part of this version.
    """
    call = _CALL.fullmatch(text)
    if call is None:
        integrators.get(text.strip())
        return text.strip()
    name, inside = call.groups()
    options = {}
    for part in filter(None, (part.strip() for part in inside.split(","))):
        key, equals, value = part.partition("=")
        try:
            options[key.strip()] = float(value) if equals else float("nan")
        except ValueError:
            equals = ""
        if not equals:
            raise ModelError(f"integrator {text!r}: expected name=number in the brackets, got {part!r}")
    package = importlib.import_module(__package__.partition(".")[0])
    try:
        return getattr(package, "".join(word.capitalize() for word in name.split("_")))(**options)
    except AttributeError:
        integrators.get(name)  # names those there are
        raise ModelError(f"integrator {text!r}: {name} takes no options") from None
    except TypeError as error:
        raise ModelError(f"integrator {text!r}: {error}") from None


def split_methods(text: str) -> list[str]:
    """The words of a list with commas; commas in brackets belong to a word."""
    return [part.strip() for part in re.split(r",(?![^(]*\))", text)]
