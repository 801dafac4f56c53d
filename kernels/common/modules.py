"""Modules that kernels are compiled in, kernels with a mask of worlds, and what a factory returns."""

import ast
import types as _types
from collections.abc import Callable
from typing import Any

import warp as wp

__all__ = ["SHORT_UNROLL", "KernelSet", "definition_name", "kernel_module", "kernel_set", "masked_kernel"]

KernelSet = _types.SimpleNamespace
"""Types, structs, functions and kernels of a factory, as attributes."""
SHORT_UNROLL = 4
"""`max_unroll` of modules with short loops over components: unrolled they index registers, not memory."""


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


_definitions: dict[str, list[Any]] = {}


def definition_name(name: str, definition: Any) -> str:
    """`name` of a user's definition in names of modules; name_2, name_3, ... of later definitions of that name.

    A module compiles all kernels that it ever had: one that does not compile would be in the way of its correction.
    """
    known = _definitions.setdefault(name, [])
    if definition not in known:
        known.append(definition)
    return name if definition == known[0] else f"{name}_{known.index(definition) + 1}"


class _Mask:
    """Transformer of a kernel's syntax tree for `masked_kernel`."""

    def __init__(self, flags: str):
        self.flags = flags

    def visit(self, tree: ast.Module) -> ast.Module:
        """The tree with the test inserted after the line `world, ... = wp.tid()`."""
        body = tree.body[0].body
        at = next(k for k, line in enumerate(body) if "wp.tid()" in ast.unparse(line))
        test = ast.parse(f"if {self.flags}[world] == 0:\n    return").body[0]
        for node in ast.walk(test):
            ast.copy_location(node, body[at])
        body.insert(at + 1, test)
        return tree


def masked_kernel(
    module: wp.Module, flags: str, key: str | None = None, **options: Any
) -> Callable[[Callable], wp.Kernel]:
    """Decorator: a kernel that does nothing in the worlds where `flags` is 0.

    `if flags[world] == 0: return` stands behind its line `world, ... = wp.tid()`.

    Args:
        module: see `kernel_module`.
        flags: [world] an argument of the kernel, "active", or a member of one, "step.accepted". A literal: Warp's cache
            knows the kernel by its source, decorators included.
        key: name, if not that of the function.
        options: as `launch_bounds` of `wp.kernel`.
    """
    return lambda function: wp.Kernel(function, key, module, options, [_Mask(flags)])


def kernel_set(names: dict[str, Any]) -> KernelSet:
    """The kernels, functions and structs that a factory defines, as attributes: `return kernel_set(locals())`."""
    return KernelSet(**names)
