"""Triangle meshes of colliders on the device."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from ..kernels.contact.collider_mesh import mesh_struct
from ..model.shapes import Shape
from ..model.triangle_mesh import TriMesh

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["shape_sizes", "upload_collider_meshes"]


def upload_collider_meshes(model: Model, shapes: Sequence[Shape]) -> Any:
    """Device struct of all meshes among the collider shapes; a mesh used twice is stored once."""
    found = dict.fromkeys(shape for shape in shapes if isinstance(shape, TriMesh))
    out, parts = mesh_struct()(), [shape.tables for shape in found]
    boxes, leaves, triangles = (np.cumsum([0, *counts]) for counts in zip(
        *((len(p.low), len(p.start), len(p.corner[0])) for p in parts)))  # fmt: skip
    place = {shape: k for k, shape in enumerate(found)}
    index = [place.get(shape, -1) for shape in shapes]  # type: ignore[call-overload]

    def upload(name: str, values: Any, dtype: Any) -> None:
        setattr(out, name, model.array("contact", np.ascontiguousarray(values), dtype))

    upload("first_box", [boxes[k] if k >= 0 else 0 for k in index], wp.int32)
    upload("first_leaf", [leaves[k] if k >= 0 else 0 for k in index], wp.int32)
    upload("inner_count", [len(parts[k].start) - 2 if k >= 0 else 0 for k in index], wp.int32)
    upload("box_low", np.concatenate([p.low for p in parts]), wp.vec3d)
    upload("box_high", np.concatenate([p.high for p in parts]), wp.vec3d)
    upload("leaf_start", np.concatenate([p.start + n for p, n in zip(parts, triangles)]), wp.int32)
    upload("corner", np.concatenate([p.corner for p in parts], axis=1), wp.vec3d)
    upload("normal", np.concatenate([p.normal for p in parts], axis=1), wp.vec3d)
    upload("feature_kind", np.concatenate([p.border for p in parts], axis=1), wp.int32)
    return out


def shape_sizes(shape: Shape, surfaces: Sequence[np.ndarray]) -> np.ndarray:
    """`Shape.sizes`; for a sheet the detection thickness, m: the second largest edge of the smallest bounding box of a
    surface that touches it. `surfaces`: their points, (n, 3)."""
    out = shape.sizes
    if isinstance(shape, TriMesh) and not shape.closed:
        out[1] = min((np.sort(np.ptp(X, axis=0))[1] for X in surfaces), default=out[0])
    return out
