"""Product (c_M M + (dq/dv) K) p of straight elements, mass included; see kernels/elements/element_clusters.py."""

import functools

import warp as wp

from ..common.modules import kernel_module
from .element_clusters import DIRECTION, DISPLACEMENT, VELOCITY, cluster_functions
from .matrix import scheme_suffix
from .points import point_functions
from .vertex import vertex_product

__all__ = ["with_mass_kernel"]


@functools.cache
def with_mass_kernel(
    dtype: str,
    law: str,
    slots: int,
    points: int,
    damping: str | None,
    vertex: bool,
    size: int,
    midpoint: bool = False,
    dissipative: bool = False,
) -> wp.Kernel:
    """Kernel `with_mass_product` of one kind of straight elements.

    Args:
        dtype: precision.
        law: name in `materials.LAWS`.
        slots, points: slots and quadrature points per element.
        damping: None, "incremental" or "rate" (implicit Kelvin-Voigt forms).
        vertex: 10-node tetrahedra with a rule that kernels/elements/vertex.py handles.
        size: elements of a cluster.
        midpoint, dissipative: of the conserving scheme, see `point_functions`.
    """
    fn = point_functions(dtype, law, slots, True, damping, False, midpoint, dissipative)
    p = fn.types
    T, vec3 = p.T, p.vec3
    Block, Local, NS = fn.Block, fn.Local, fn.slots
    shared = cluster_functions(dtype, size, slots, 3 if fn.uses_v else 2)
    Pool = shared.Pool
    # unrolled loops over slots keep them in registers; the loops over points are longer and stay loops
    form = "vertex" if vertex else "affine"
    name = f"with_mass_{dtype}_{law}_{slots}_{points}_{form}_{damping}_{size}{scheme_suffix(midpoint, dissipative)}"
    module = kernel_module(name, max_unroll=16, block_dim=size)

    if vertex:
        product = vertex_product(points, fn, shared)
    else:

        @wp.func
        def fetch_slots(block: Block, pool: Pool, field: int, at: int) -> Local:
            """Slot values of an element; positions relative to the first slot, so that a translation has no strain."""
            out = Local()
            first = shared.fetch(pool, field, 0, at)
            for i in range(NS):
                out[i] = shared.fetch(pool, field, i, at) - block.is_position[i] * first
            return out

        @wp.func
        def product(
            block: Block, pool: Pool, history: p.sym_2d, dq: T, scale: T, form: int, world: int, elem: int, at: int
        ):
            """Set the forces (scale M + dq K) p of element `at` of a cluster."""
            u = fetch_slots(block, pool, DISPLACEMENT, at)
            du = fetch_slots(block, pool, DIRECTION, at)
            v = Local()
            if wp.static(fn.uses_v):
                v = fetch_slots(block, pool, VELOCITY, at)
            f = fn.tangent_force(block, u, du, v, history, dq, form, world, elem)
            first = shared.fetch(pool, DIRECTION, 0, at)
            for i in range(NS):
                a = vec3()
                total = T(0.0)
                for j in range(NS):
                    a += block.parent_mass[i, j] * du[j]
                    total += block.parent_mass[i, j]
                shared.set_force(pool, i, at, dq * f[i] + scale * (a + total * first))

    # for this kind the bound spills few registers (measured); for others the compiler chooses
    bounded = vertex and law == "svk" and damping is None and not midpoint
    return shared.make_product_kernel(module, Block, product, bounded)
