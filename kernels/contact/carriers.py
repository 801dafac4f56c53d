"""Obstacles that move with points of their own, which touch facets of bodies: displacements of these points.

Points of bodies pay a branch: 20 steps of the scene block_stack with 3 blocks of 4^3 cells take 2.10 s of a core with
it and 2.10 s without, by repeated runs that differ by 2 %. Kernels of their own would be compiled twice.
"""

import functools
from typing import Any

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import f64, vec3d
from .facet_structs import master_struct, pair_history_struct, pair_scratch_struct
from .kinematics import kinematics_functions
from .structs import contact_structs

__all__ = ["END", "START", "carrier_functions", "carrier_kernels"]

START, END = 0, 1
"""Start and end of an attempt."""


@functools.cache
def carrier_functions(dtype: str) -> KernelSet:
    """Device functions in one precision of the displacements."""
    Facets = contact_structs(dtype).Facets
    Masters, PairScratch = master_struct(dtype), pair_scratch_struct(dtype)
    k = kinematics_functions(dtype)

    @wp.func
    def carried_by(mas: Masters, facets: Facets, pair: PairScratch, world: int, q: int, item: int, at: int) -> vec3d:
        """Displacement of a point of an obstacle that moves, m, at `START` or `END`."""
        carrier = mas.carrier[facets.contact[item]]
        arm = facets.X[q, item] - mas.carrier_anchor[carrier]
        return pair.carried_shift[at, world, carrier] + pair.carried_turn[at, world, carrier] * arm

    @wp.func
    def displacement(
        mas: Masters, facets: Facets, pair: PairScratch, u: wp.array2d(dtype=Any), world: int, q: int, item: int,
        at: int,
    ) -> vec3d:  # fmt: skip
        """Displacement of a point, m, with its slots or its obstacle; u: that of the slots then."""
        if mas.carrier[facets.contact[item]] >= 0:
            return carried_by(mas, facets, pair, world, q, item, at)
        return k.interpolate(facets, u, world, q, item)

    @wp.func
    def velocity(
        mas: Masters, facets: Facets, pair: PairScratch, v: wp.array2d(dtype=Any), world: int, q: int, item: int, h: f64
    ) -> vec3d:  # fmt: skip
        """Velocity of a point, m/s: by its slots at the start, or the mean one of its obstacle in the attempt."""
        if mas.carrier[facets.contact[item]] >= 0:
            motion = carried_by(mas, facets, pair, world, q, item, END)
            return (motion - carried_by(mas, facets, pair, world, q, item, START)) / h
        return k.interpolate(facets, v, world, q, item)

    @wp.func
    def motion_in_step(mas: Masters, pair: PairScratch, world: int, c: int, position: vec3d) -> vec3d:
        """Motion of the obstacle of the points at a position, m, by its last velocity; 0 of what does not move."""
        carrier = mas.carrier[c]
        if carrier < 0:
            return vec3d()
        change = pair.carried_shift[END, world, carrier] - pair.carried_shift[START, world, carrier]
        arm = position - mas.carrier_anchor[carrier]
        return change + pair.carried_angle[world, carrier] * wp.cross(mas.carrier_axis[carrier], arm)

    return kernel_set(locals())


@functools.cache
def carrier_kernels(dtype: str) -> KernelSet:
    """Kernels in one precision of the displacements."""
    Masters, PairHistory, PairScratch = master_struct(dtype), pair_history_struct(), pair_scratch_struct(dtype)
    module = kernel_module(f"contact_carriers_{dtype}", light=True)

    @wp.func
    def place(mas: Masters, pair: PairScratch, world: int, carrier: int, value: vec3d, at: int):
        """Displacement of an obstacle by the value of its law: its motion, m, or its angle, rad."""
        pair.carried_shift[at, world, carrier] = value
        if mas.carrier_turns[carrier] != 0:
            N = wp.skew(mas.carrier_axis[carrier])
            half = wp.sin(f64(0.5) * value[0])
            pair.carried_turn[at, world, carrier] = wp.sin(value[0]) * N + (f64(2.0) * half * half) * (N * N)
            pair.carried_shift[at, world, carrier] = vec3d()

    @masked_kernel(module, "active")
    def carry(
        mas: Masters, value: wp.array2d(dtype=vec3d), active: wp.array(dtype=wp.int32), settled: int, his: PairHistory,
        pair: PairScratch,
    ):  # fmt: skip
        """Displacements of the obstacles at the start, those in the state if it has them, and at the end of an attempt;
        `settled`: at a state, without motion."""
        world, carrier = wp.tid()
        now = value[world, mas.carrier_law[carrier]]
        old = his.carried[world, carrier]
        before = now
        if old[3] > f64(0.0):
            before = vec3d(old[0], old[1], old[2])
        if settled != 0:
            now = before
        place(mas, pair, world, carrier, before, START)
        place(mas, pair, world, carrier, now, END)
        pair.carried_value[world, carrier] = wp.vec4d(now[0], now[1], now[2], f64(1.0))
        if mas.carrier_turns[carrier] != 0:
            pair.carried_angle[world, carrier] = now[0] - before[0]

    return kernel_set(locals())
