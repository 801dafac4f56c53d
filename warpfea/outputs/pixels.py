"""Pixels of the ray caster: triangles and rays of those asked for, bytes, neighbours that differ."""

from __future__ import annotations

import concurrent.futures
import functools
import os
from typing import Any

import numpy as np
import numpy.typing as npt

from .colormap import to_srgb

__all__ = ["MIDDLE", "SUBPIXELS", "Image", "cast_pixels", "edge_pixels", "grown", "pixels_of", "rasterize", "to_bytes"]

Floats = npt.NDArray[np.floating[Any]]
Image = npt.NDArray[np.uint8]
# 8 rooks: one per row and column of an 8 x 8 raster
SUBPIXELS = np.array([[(k + 0.5) / 8, ((5 * k + 2) % 8 + 0.5) / 8] for k in range(8)], dtype=np.float32)
MIDDLE = np.array([[0.5, 0.5]])


def cast_pixels(
    wp: Any, raycast: Any, scene: Any, pixels: npt.NDArray[np.int32], offsets: Floats, faces: Any = None
) -> npt.NDArray[np.float32]:
    """Mean colours (n, 3), linear light, of pixels (n, 2) over samples at offsets, by as many threads as there are
    cores.

    faces: (n, k) that the rays of the samples meet first, -1 for none; None: not known.
    """
    many, out = wp.array(pixels, dtype=wp.vec2i), wp.empty(len(pixels), dtype=wp.vec3)
    places = wp.array(offsets, dtype=wp.vec2)
    met = wp.array(np.zeros((0, 0)) if faces is None else faces, dtype=wp.int32)

    def launch(first: int, last: int) -> None:
        if last > first:
            some = met if faces is None else met[first:last]
            arrays = [scene, many[first:last], places, some, out[first:last]]
            wp.launch(raycast.cast_rays, -(-(last - first) // raycast.PIXELS), arrays, device="cpu")

    launch(0, min(1, len(pixels)))  # loads the kernel, which threads must not do at once
    threads = min(os.cpu_count() or 1, 8, 1 + len(pixels) * len(offsets) // 4096)
    ends = np.linspace(1, len(pixels), 1 + threads).astype(int).tolist()
    with concurrent.futures.ThreadPoolExecutor(len(ends)) as pool:
        list(pool.map(launch, ends[:-1], ends[1:]))
    return np.asarray(out.numpy())


def pixels_of(mask: npt.NDArray[np.bool_], corner: Any = (0, 0)) -> npt.NDArray[np.int32]:
    """(n, 2) column and row of the pixels of a mask whose first one lies at a corner of the picture."""
    rows, columns = np.divmod(np.flatnonzero(mask), mask.shape[1])
    return np.stack([columns + corner[0], rows + corner[1]], axis=1).astype(np.int32)


def rasterize(
    wp: Any, raycast: Any, corners: Floats, triangles: npt.NDArray[Any], cells: npt.NDArray[np.bool_], offsets: Floats
) -> npt.NDArray[np.int32]:
    """(n, k) triangles next to the viewer at k offsets (0 to 1) in each of n chosen cells of a grid, -1 for none.

    corners: (P, 3), x and y in cells, and what grows towards the viewer from zero.
    """
    chosen, slots = np.flatnonzero(cells), np.full(cells.shape, -1, dtype=np.int32)
    slots.ravel()[chosen] = np.arange(len(chosen))
    shape = len(chosen), len(offsets)
    nearest, faces = wp.zeros(shape, dtype=wp.float64), wp.full(shape, -1, dtype=wp.int32)
    arrays = [wp.array(corners, dtype=wp.vec3d), wp.array(triangles, dtype=wp.int32), wp.array(slots, dtype=wp.int32)]
    arrays += [wp.array(offsets, dtype=wp.vec2d), nearest, faces]
    wp.launch(raycast.rasterize, len(triangles), arrays, device="cpu")
    return np.asarray(faces.numpy())


def to_bytes(linear: npt.NDArray[np.float32]) -> Image:
    """sRGB components, 0 to 255, of linear light, by a table: the nearest ones, or in shades near black one off."""
    table = _byte_table()
    return table[(np.clip(linear, 0.0, 1.0) * np.float32(len(table) - 1) + np.float32(0.5)).astype(np.uint16)]


@functools.cache
def _byte_table() -> Image:
    return np.round(255.0 * to_srgb(np.arange(1 << 16) / 65535.0)).astype(np.uint8)


def edge_pixels(image: Image, limit: int = 6) -> npt.NDArray[np.bool_]:
    """(height, width) pixels of an sRGB picture that differ from a neighbour by more than a limit, of 255."""
    edges = np.zeros(image.shape[:2], dtype=bool)
    for channel in np.moveaxis(image.astype(np.int16), 2, 0):  # over an axis of length three numpy is slow
        down = np.abs(np.diff(channel, axis=0)) > limit
        across = np.abs(np.diff(channel, axis=1)) > limit
        edges[1:] |= down
        edges[:-1] |= down
        edges[:, 1:] |= across
        edges[:, :-1] |= across
    return edges


def grown(mask: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """A mask and its neighbours along rows and columns."""
    out = mask.copy()
    out[1:] |= mask[:-1]
    out[:-1] |= mask[1:]
    out[:, 1:] |= mask[:, :-1]
    out[:, :-1] |= mask[:, 1:]
    return out
