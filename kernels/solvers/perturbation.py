"""Residuals at randomly rounded positions; their mean yields the error due to round-off.

Stochastic arithmetic in the manner of CESTAC (Vignes 1993, Mathematics and Computers in Simulation 35, 233-261): each
sample perturbs the bits of the positions and so has different round-off.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.structs import mass_functions, topology_struct
from ..common.types import double_1d, f64, int_1d, precision
from .newton_control import control_struct

__all__ = ["SAMPLES", "SCATTER_FACTOR", "perturbation_kernels"]

SAMPLES, SAMPLE_WEIGHT = 4, 0.25
"""Number of evaluations, and the weight of each."""
SCATTER_FACTOR = 2.0
"""Factor on a displacement estimated from the mean residual: its scatter is half of the round-off error."""
MAX_PERTURBATION = 3
"""Largest perturbation of a component, in roundings."""


@functools.cache
def perturbation_kernels(dtype: str) -> KernelSet:
    """Kernels in one precision of the vectors."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    Control = control_struct()
    Topology, mass_entry = topology_struct(dtype), mass_functions(dtype).mass_entry
    module = kernel_module(f"perturbation_{dtype}")

    @wp.kernel(module=module)
    def begin_samples(ctl: Control, flags: int_1d, perturbation_sum: p.vec3_2d, gradient_sum: p.vec3_2d):
        """Flag the worlds whose next solve estimates the error; clear both sums there."""
        world, slot = wp.tid()
        asks = ctl.active[world] != 0 and ctl.floor.estimate_error[world] == 1  # finished worlds keep their positions
        if slot == 0:
            flags[world] = wp.where(asks, 1, 0)
        if asks:
            perturbation_sum[world, slot] = vec3()
            gradient_sum[world, slot] = vec3()

    @masked_kernel(module, "flags")
    def perturb_positions(
        ctl: Control, flags: int_1d, sample: int, u: p.vec3_2d,
        perturbation_sum: p.vec3_2d,
    ):  # fmt: skip
        """u += d, up to MAX_PERTURBATION roundings, random per slot and sample; perturbation_sum += d / (dq/dv)."""
        world, slot = wp.tid()
        x = u[world, slot]
        y = vec3()
        state = wp.rand_init(sample, slot)
        for k in range(3):
            y[k] = x[k] + T(f64(wp.randi(state, -MAX_PERTURBATION, MAX_PERTURBATION + 1)) * ctl.floor.eps) * x[k]
        u[world, slot] = y
        perturbation_sum[world, slot] = perturbation_sum[world, slot] + (y - x) / T(ctl.dq_dv[world])

    @masked_kernel(module, "flags")
    def add_sample(flags: int_1d, gradient: p.vec3_2d, gradient_sum: p.vec3_2d):
        """gradient_sum += gradient."""
        world, slot = wp.tid()
        gradient_sum[world, slot] = gradient_sum[world, slot] + gradient[world, slot]

    @masked_kernel(module, "flags")
    def mean_gradient(
        topo: Topology, mass_factor: double_1d, flags: int_1d, perturbation_sum: p.vec3_2d, product: p.vec3_2d,
        gradient_sum: p.vec3_2d, gradient: p.vec3_2d,
    ):  # fmt: skip
        """Mean over the samples of g(u + d) - (dq/dv) K p, with p = d / (dq/dv) and `product` = H p of their sum."""
        world, slot = wp.tid()
        a = vec3()
        for k in range(topo.mass_start[slot], topo.mass_start[slot + 1]):
            a += mass_entry(topo, world, k) * perturbation_sum[world, topo.mass_column[k]]
        stiff = product[world, slot] - T(mass_factor[world]) * a
        gradient[world, slot] = T(SAMPLE_WEIGHT) * (gradient_sum[world, slot] - stiff)

    return kernel_set(locals())
