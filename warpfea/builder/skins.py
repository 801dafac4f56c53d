"""Method of ModelBuilder for fine surfaces that are drawn in place of a body's faces."""

from __future__ import annotations

from typing import Any

from ..base.checks import finite_number
from ..base.errors import ModelError
from ..mesh.mesh import transformation
from ..mesh.surface import surface_arrays
from ..model.bodies import Body
from ..model.description import Description
from .checks import body_of_handle

__all__ = ["SkinMethods"]


class SkinMethods:
    """Base of ModelBuilder: `add_skin`."""

    description: Description

    def add_skin(
        self, body: Body, surface: Any, *, scale: float = 1.0, transform: Any = None, distance: float | None = None
    ) -> None:
        """Draw a fine surface in place of a body's faces in USD, pictures and pages; it follows the elements.

        A vertex within an element moves with its shape functions, one outside with the deformation gradient of the
        nearest point, so that rigid motions and homogeneous deformations are exact; fields are those of that point.

        Args:
            surface: STL, OBJ or PLY file, or (points (n, 3), triangles (m, 3)), on the reference, m after `scale`.
            scale, transform: as for add_solid.
            distance: largest distance of a vertex from the body, m; by default a quarter of its largest element;
                rigid parts take any.

        Raises:
            MeshError: an unusable file. ModelError: a vertex further off.
        """
        body_of_handle(body, "add_skin", (Body,), self.description.bodies)
        what = f"add_skin({body.name!r})"
        A, t = transformation(scale, transform, what)
        if distance is not None and not finite_number(distance) >= 0.0:
            raise ModelError(f"{what}: distance = {distance!r} must be a length (m) of at least 0")
        points, triangles = surface_arrays(surface, what)
        body.skin = body.render_skin(points @ A.T + t, triangles, distance, what)
