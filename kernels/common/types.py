"""Scalar, vector and matrix types per precision, and the modules that kernels are compiled in."""

import functools
import types as _types
from typing import Any

import warp as wp

__all__ = [
    "SHORT_UNROLL", "double_1d", "double_2d", "double_3d", "int_1d", "int_2d", "kernel_module", "kernel_set",
    "precision", "vec3d_1d", "vec3d_2d",
]  # fmt: skip

int_1d, int_2d = wp.array(dtype=wp.int32), wp.array2d(dtype=wp.int32)
double_1d, double_2d, double_3d = (kind(dtype=wp.float64) for kind in (wp.array, wp.array2d, wp.array3d))
vec3d_1d, vec3d_2d = wp.array(dtype=wp.vec3d), wp.array2d(dtype=wp.vec3d)
"""Types of array arguments by their number of indices, as `vec3_2d` of `precision`."""

SHORT_UNROLL = 4
"""`max_unroll` of modules with short loops over components: unrolled they index registers, not memory."""


@functools.cache
def precision(dtype: str) -> _types.SimpleNamespace:
    """Types of one precision, "float64" or "float32": scalar T, vec2, vec3, sym (Voigt xx yy zz yz xz xy), mat33.

    Types of arrays end in their number of indices: a field at the slots, [world, slot], is `vec3_2d`.
    """
    T = {"float64": wp.float64, "float32": wp.float32}[dtype]
    vec2, vec3, sym = (wp.types.vector(length=n, dtype=T) for n in (2, 3, 6))
    mat33 = wp.types.matrix(shape=(3, 3), dtype=T)
    scalar_1d, scalar_2d, scalar_3d = wp.array(dtype=T), wp.array2d(dtype=T), wp.array3d(dtype=T)
    vec3_1d, vec3_2d, vec3_3d = wp.array(dtype=vec3), wp.array2d(dtype=vec3), wp.array3d(dtype=vec3)
    sym_2d, mat33_2d = wp.array2d(dtype=sym), wp.array2d(dtype=mat33)
    return _types.SimpleNamespace(name=dtype, **{k: v for k, v in locals().items() if k != "dtype"})


def kernel_module(name: str, light: bool = False, **options) -> wp.Module:
    """The Warp module `name` with the options common to all kernels.

    Loops are not unrolled: a T10 tangent kernel with the default unrolling compiles for minutes. Adjoint code is
    disabled: it triples compile time.

    Args:
        name: of the module, without the package.
        light: its kernels have one thread per world. Compilation outweighs their run time, so that they are compiled
            without optimisation: an eighth of the time, and the same bits. Ignored where there is a CUDA device, as
            the option would act on it too.
        options: of Warp, for this module.
    """
    module = wp.get_module(f"warpfea.kernels.{name}")
    if light and not wp.is_cuda_available():
        options = {"optimization_level": 0} | options
    wp.set_module_options({"enable_backward": False, "max_unroll": 1} | options, module=module)
    return module


def kernel_set(names: dict[str, Any]) -> _types.SimpleNamespace:
    """The kernels, functions and structs that a factory defines, as attributes: `return kernel_set(locals())`."""
    return _types.SimpleNamespace(**names)
