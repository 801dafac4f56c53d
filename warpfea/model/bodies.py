"""Bodies as returned by a builder: named sets, points, drawn geometry."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from . import surfaces
from .discretisation import Discretisation
from .handles import ElementSet, MaterialPoint, NodeSet, SurfaceSet
from .locate import locate

__all__ = ["Body"]


@dataclass(eq=False, repr=False)
class Body(Discretisation):
    """Flexible body. Made by ModelBuilder; nodes and elements are numbered as in its mesh."""

    # named sets

    def nodes(self, selection: Any) -> NodeSet:
        """Nodes by group name, predicate of X (n, 3) -> mask, or indices. MeshError lists the known names."""
        return NodeSet(self, self.mesh.nodes(selection), _label(selection))

    def surface(self, selection: Any) -> SurfaceSet:
        """Faces by group name, predicate of face centroids, or rows (element, local face).

        Beams name "start", "end", "side-", "side+", "normal-", "normal+"; shells "top", "bottom" and the strips over
        their named edges.
        """
        return SurfaceSet(self, surfaces.select_faces(self, selection), _label(selection))

    def elements(self, selection: Any) -> ElementSet:
        """Elements by group name, predicate of centroids, or indices."""
        return ElementSet(self, self.mesh.elements(selection), _label(selection))

    def at(self, X: Any) -> MaterialPoint:
        """The material point at the reference position X (3,), m. Raises ModelError for X outside the body."""
        return locate(self, X)

    @property
    def start(self) -> NodeSet:
        """First node of a beam. MeshError for other bodies."""
        return self.nodes("start")

    @property
    def end(self) -> NodeSet:
        """Last node of a beam."""
        return self.nodes("end")

    def edge(self, name: str) -> NodeSet:
        """Nodes of a named edge of a shell."""
        return self.nodes(name)

    @cached_property
    def skin(self) -> surfaces.Skin:
        """Drawn surface."""
        return surfaces.make_skin(self)

    @cached_property
    def drawing(self) -> surfaces.Drawing:
        """Drawn cells."""
        return surfaces.make_drawing(self)


def _label(selection: Any) -> str:
    return selection if isinstance(selection, str) else ""
