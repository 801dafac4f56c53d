"""Scalar, vector and matrix types per precision."""

import functools

import warp as wp

from .modules import KernelSet

__all__ = [
    "double_1d", "double_2d", "double_3d", "f64", "int_1d", "int_2d", "mat33d", "precision", "vec3d", "vec3d_1d",
    "vec3d_2d",
]  # fmt: skip

f64, vec3d, mat33d = wp.float64, wp.vec3d, wp.mat33d
int_1d, int_2d = wp.array(dtype=wp.int32), wp.array2d(dtype=wp.int32)
double_1d, double_2d, double_3d = (kind(dtype=wp.float64) for kind in (wp.array, wp.array2d, wp.array3d))
vec3d_1d, vec3d_2d = wp.array(dtype=wp.vec3d), wp.array2d(dtype=wp.vec3d)
"""Types of array arguments by their number of indices, as `vec3_2d` of `precision`."""


@functools.cache
def precision(dtype: str) -> KernelSet:
    """Types of one precision, "float64" or "float32": scalar T, vec2, vec3, sym (Voigt xx yy zz yz xz xy), mat33.

    Types of arrays end in their number of indices: a field at the slots, [world, slot], is `vec3_2d`.
    """
    T = {"float64": wp.float64, "float32": wp.float32}[dtype]
    vec2, vec3, sym = (wp.types.vector(length=n, dtype=T) for n in (2, 3, 6))
    mat33 = wp.types.matrix(shape=(3, 3), dtype=T)
    scalar_1d, scalar_2d, scalar_3d = wp.array(dtype=T), wp.array2d(dtype=T), wp.array3d(dtype=T)
    vec3_1d, vec3_2d, vec3_3d = wp.array(dtype=vec3), wp.array2d(dtype=vec3), wp.array3d(dtype=vec3)
    sym_2d, mat33_2d = wp.array2d(dtype=sym), wp.array2d(dtype=mat33)
    return KernelSet(name=dtype, **{k: v for k, v in locals().items() if k != "dtype"})
