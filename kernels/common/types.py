"""Scalar, vector and matrix types per precision, and the modules that kernels are compiled in."""

import functools
import types as _types

import warp as wp

__all__ = ["SHORT_UNROLL", "kernel_module", "precision"]

SHORT_UNROLL = 4
"""`max_unroll` of modules with short loops over components: unrolled they index registers, not memory."""


@functools.cache
def precision(dtype: str) -> _types.SimpleNamespace:
    """Types of one precision, "float64" or "float32": scalar T, vec2, vec3, sym (Voigt xx yy zz yz xz xy), mat33."""
    scalar = {"float64": wp.float64, "float32": wp.float32}[dtype]
    return _types.SimpleNamespace(
        name=dtype,
        T=scalar,
        vec2=wp.types.vector(length=2, dtype=scalar),
        vec3=wp.types.vector(length=3, dtype=scalar),
        sym=wp.types.vector(length=6, dtype=scalar),
        mat33=wp.types.matrix(shape=(3, 3), dtype=scalar),
    )


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
