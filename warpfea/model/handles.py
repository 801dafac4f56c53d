"""Handles of parts of a body: sets of nodes, faces and elements, and material points."""

from __future__ import annotations

import functools
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np

from .discretisation import Discretisation

__all__ = ["ElementSet", "MaterialPoint", "NodeSet", "SurfaceSet", "once_per_surface"]

F = TypeVar("F", bound=Callable[..., Any])


@dataclass(frozen=True, eq=False, repr=False)
class _IndexSet:
    """Parts of a body, by index (n,)."""

    body: Discretisation
    indices: np.ndarray
    name: str = ""

    def __len__(self) -> int:
        return len(self.indices)

    def __repr__(self) -> str:
        return _describe(self, "nodes" if isinstance(self, NodeSet) else "elements")


class NodeSet(_IndexSet):
    """Nodes of a body, by index in the mesh file's order (n,)."""


class ElementSet(_IndexSet):
    """Elements of a body by index (n,)."""


@dataclass(frozen=True, eq=False, repr=False)
class SurfaceSet:
    """Faces of a body, rows (element, local face) (n, 2)."""

    body: Discretisation
    faces: np.ndarray
    name: str = ""

    def __len__(self) -> int:
        return len(self.faces)

    def __repr__(self) -> str:
        return _describe(self, "faces")

    @property
    def nodes(self) -> np.ndarray:
        """(n, 3, 4 or 6) node indices of each face of a solid, outward."""
        return self.body.mesh.faces(self.faces)


@dataclass(frozen=True, eq=False)
class MaterialPoint:
    """A material point of a body: its position is the sum of weights times the values of body slots.

    Attributes:
        body: the body.
        slots: (n,) body slots.
        weights: (n,) shape functions at the point.
        X: (3,) reference position, m.
        gradients: (n, 3) dweights/dX, 1/m: the deformation gradient is sum e_i gradients_i^T.
        axes: (3, 3) columns: in a beam its axis, width and height there; in a shell two tangents and the director;
            in a solid the global axes.
        element: index of the element that holds the point. xi: (3,) parent coordinates in it.
    """

    body: Discretisation
    slots: np.ndarray
    weights: np.ndarray
    X: np.ndarray
    gradients: np.ndarray
    axes: np.ndarray
    element: int = -1
    xi: np.ndarray | None = None

    def __repr__(self) -> str:
        place = ", ".join(f"{x:.6g}" for x in self.X)
        return f"MaterialPoint(({place}) m of body {self.body.name!r}, element {self.element})"


def _describe(handle: _IndexSet | SurfaceSet, what: str) -> str:
    """A set in one line."""
    name = f"{handle.name!r}, " if handle.name else ""
    return f"{type(handle).__name__}({name}{len(handle)} {what} of body {handle.body.name!r})"


def once_per_surface(function: F) -> F:
    """Decorator of a function of a surface and hashable values that is evaluated once for the same faces of a body.

    Of thirty bodies that may all touch each other it is asked for 435 pairs. What it returns must not be changed.
    """
    known: weakref.WeakKeyDictionary[Discretisation, dict[Any, Any]] = weakref.WeakKeyDictionary()

    @functools.wraps(function)
    def wrapper(surface: SurfaceSet, *values: Any, **named: Any) -> Any:
        found, key = known.setdefault(surface.body, {}), (surface.faces.tobytes(), values, *named.items())
        if key not in found:
            found[key] = function(surface, *values, **named)
        return found[key]

    return wrapper  # type: ignore[return-value]
