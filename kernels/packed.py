"""Vectors of three padded to four, so that a thread of a GPU reads or writes each at once and from one sector.

Fields that elements gather at random, and what they contribute, are held so where products are made with elements.
"""

import functools
import types as _types

import warp as wp

from .types import kernel_module, precision

__all__ = ["packed_kernels", "packed_type"]

READ = """
    #if defined(__CUDA_ARCH__)
    {cuda}
    #else
    auto x = wp::index(a, world, i);
    return {{x[0], x[1], x[2]}};
    #endif
"""
WRITE = """
    #if defined(__CUDA_ARCH__)
    {cuda}
    #else
    wp::index(a, world, i) = {{v[0], v[1], v[2], 0}};
    #endif
"""
vec4f = wp.types.vector(length=4, dtype=wp.float32)
vec4d = wp.types.vector(length=4, dtype=wp.float64)


@wp.func_native(
    snippet=READ.format(
        cuda="float4 x = *reinterpret_cast<const float4*>(&wp::index(a, world, i)); return {x.x, x.y, x.z};"
    )
)
def read_float32(a: wp.array2d(dtype=vec4f), world: int, i: int) -> wp.vec3f: ...


@wp.func_native(
    snippet=READ.format(
        cuda="const double2* p = reinterpret_cast<const double2*>(&wp::index(a, world, i));"
        " double2 x = p[0]; double z = reinterpret_cast<const double*>(p)[2]; return {x.x, x.y, z};"
    )
)
def read_float64(a: wp.array2d(dtype=vec4d), world: int, i: int) -> wp.vec3d: ...


@wp.func_native(
    snippet=WRITE.format(
        cuda="*reinterpret_cast<float4*>(&wp::index(a, world, i)) = make_float4(v[0], v[1], v[2], 0.0f);"
    )
)
def write_float32(a: wp.array2d(dtype=vec4f), world: int, i: int, v: wp.vec3f): ...


@wp.func_native(
    snippet=WRITE.format(
        cuda="double2* p = reinterpret_cast<double2*>(&wp::index(a, world, i));"
        " p[0] = make_double2(v[0], v[1]); p[1] = make_double2(v[2], 0.0);"
    )
)
def write_float64(a: wp.array2d(dtype=vec4d), world: int, i: int, v: wp.vec3d): ...


def packed_type(dtype: str):
    """The padded vector of a precision."""
    return {"float64": vec4d, "float32": vec4f}[dtype]


@functools.cache
def packed_kernels(dtype: str) -> _types.SimpleNamespace:
    """Functions `read(array, world, i)` and `write(array, world, i, v)`, and the kernel `pack`."""
    vec3, vec4 = precision(dtype).vec3, packed_type(dtype)
    read = {"float64": read_float64, "float32": read_float32}[dtype]
    write = {"float64": write_float64, "float32": write_float32}[dtype]
    module = kernel_module(f"packed_{dtype}")

    @wp.kernel(module=module)
    def pack(source: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), out: wp.array2d(dtype=vec4)):
        """out = source."""
        world, slot = wp.tid()
        if active[world] != 0:
            write(out, world, slot, source[world, slot])

    return _types.SimpleNamespace(module=module, vec4=vec4, read=read, write=write, pack=pack)
