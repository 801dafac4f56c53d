"""Loads on the device: time laws, dead loads Eq. (72), body forces Eq. (23), driven nodes."""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import double_1d, double_2d, double_3d, f64, int_1d, precision, vec3d_1d, vec3d_2d
from ..elements.points import block_struct

__all__ = ["body_force_kernel", "body_force_product_kernel", "load_kernels", "time_law_kernel", "time_law_struct"]


@functools.cache
def time_law_struct():
    """Time laws: each a constant (one sample) or samples in time, piecewise linear, constant beyond both ends."""

    @wp.struct
    class TimeLaws:
        sample_start: wp.array(
            dtype=wp.int32
        )  # [law + 1] first sample; without samples a function or control sets the value
        sample_time: wp.array(dtype=wp.float64)  # s
        sample_value: wp.array(dtype=wp.vec3d)

    return TimeLaws


@functools.cache
def load_kernels(dtype: str) -> KernelSet:
    """Kernels of the loads in one precision."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    Laws = time_law_struct()
    # a module per kind of load: a scene compiles only those it uses
    laws_module = kernel_module(f"laws_{dtype}")
    controls_module = kernel_module(f"controls_{dtype}")
    dead_module = kernel_module(f"dead_load_{dtype}")
    gravity_module = kernel_module("gravity_law")
    explicit_module = kernel_module(f"explicit_{dtype}")
    drive_module = kernel_module(f"drive_{dtype}")
    turn_module = kernel_module(f"drive_rotation_{dtype}")

    @masked_kernel(laws_module, "active")
    def evaluate_time_laws(laws: Laws, time: double_1d, ramp: double_1d, active: int_1d, value: vec3d_2d):
        """Value of each law at the new time; constants are scaled by the ramp of a static load path."""
        world, law = wp.tid()
        first = laws.sample_start[law]
        last = laws.sample_start[law + 1] - 1
        if last < first:
            return
        if last == first:
            value[world, law] = ramp[world] * laws.sample_value[first]
            return
        t = time[world]
        k = first
        while k < last - 1 and laws.sample_time[k + 1] < t:
            k += 1
        s = (t - laws.sample_time[k]) / (laws.sample_time[k + 1] - laws.sample_time[k])
        s = wp.clamp(s, f64(0.0), f64(1.0))
        value[world, law] = (f64(1.0) - s) * laws.sample_value[k] + s * laws.sample_value[k + 1]

    @masked_kernel(controls_module, "active")
    def evaluate_control(control: double_2d, law: int, ramped: int, ramp: double_1d, active: int_1d, value: vec3d_2d):
        """Value of a law that is a control; scaled by the ramp of a static load path if a constant would be."""
        world = wp.tid()
        x = wp.vec3d()
        for c in range(control.shape[1]):
            x[c] = control[world, c]
        if ramped != 0:
            x = ramp[world] * x
        value[world, law] = x

    @masked_kernel(dead_module, "active")
    def dead_load(
        start: int_1d, law: int_1d, weight: p.vec3_1d, value: vec3d_2d, lumped: p.scalar_2d, gravity: vec3d_1d,
        ramp: double_1d, active: int_1d, force: p.vec3_2d, magnitude: p.vec3_2d,
    ):  # fmt: skip
        """Sum of weight x value per slot (Eq. 72), gravity included (Eq. 24), and of the magnitudes."""
        world, slot = wp.tid()
        f = (T(ramp[world]) * lumped[world % lumped.shape[0], slot]) * vec3(gravity[world])
        m = wp.cw_mul(f, wp.sign(f))
        for k in range(start[slot], start[slot + 1]):
            x = wp.cw_mul(weight[k], vec3(value[world, law[k]]))
            f += x
            m += wp.cw_mul(x, wp.sign(x))
        force[world, slot] = f
        magnitude[world, slot] = m

    @masked_kernel(gravity_module, "active")
    def copy_gravity(value: vec3d_2d, law: int, active: int_1d, gravity: vec3d_1d):
        """Gravity, m/s^2, from the value of a time law."""
        world = wp.tid()
        gravity[world] = value[world, law]

    @masked_kernel(explicit_module, "accepted")
    def explicit_work_rows(a: p.vec3_2d, u: p.vec3_2d, u_n: p.vec3_2d, accepted: int_1d, rows: double_3d):
        """Work of an explicit force on a substep, a.dq per slot."""
        world, slot = wp.tid()
        rows[0, world, slot] = f64(wp.dot(a[world, slot], u[world, slot] - u_n[world, slot]))

    @masked_kernel(explicit_module, "active")
    def subtract_explicit_force(explicit_force: p.vec3_2d, active: int_1d, force: p.vec3_2d):
        """Dead force -= explicit internal force."""
        world, slot = wp.tid()
        force[world, slot] = force[world, slot] - explicit_force[world, slot]

    @masked_kernel(drive_module, "active")
    def drive_displacement(
        slot: int_1d,
        law: wp.array(dtype=wp.vec3i),
        value: vec3d_2d,
        q_tilde: p.vec3_2d,
        dq_dv: double_1d,
        active: int_1d,
        v: p.vec3_2d,
    ):
        """v = (u(t) - q~)/(dq/dv) on the driven components, u(t) the value of a law per component (-1: not driven)."""
        world, k = wp.tid()
        s = slot[k]
        velocity = v[world, s]
        for c in range(3):
            row = law[k][c]
            if row >= 0:
                velocity[c] = T((value[world, row][c] - f64(q_tilde[world, s][c])) / dq_dv[world])
        v[world, s] = velocity

    @masked_kernel(turn_module, "active")
    def drive_rotation(
        slot: int_1d, law: int_1d, components: vec3d_1d, arm: vec3d_1d, axis: vec3d_1d, value: vec3d_2d,
        q_tilde: p.vec3_2d, dq_dv: double_1d, active: int_1d, v: p.vec3_2d,
    ):  # fmt: skip
        """`drive_displacement` for u(t) = (R(angle) - I) arm, arm the slot's reference position relative to the anchor
        (Rodrigues)."""
        world, k = wp.tid()
        s = slot[k]
        angle = value[world, law[k]][0]
        n = axis[k]
        half = wp.sin(f64(0.5) * angle)
        turn = wp.cross(n, arm[k])
        target = wp.sin(angle) * turn + f64(2.0) * half * half * wp.cross(n, turn)
        velocity = v[world, s]
        for c in range(3):
            if components[k][c] != f64(0.0):
                velocity[c] = T((target[c] - f64(q_tilde[world, s][c])) / dq_dv[world])
        v[world, s] = velocity

    return kernel_set(locals())


@functools.lru_cache(maxsize=256)
def time_law_kernel(function: wp.Function, scalar: bool, take_dtype: str):
    """Kernel that evaluates one time law given as a `wp.func` of t (s)."""
    A = precision(take_dtype).T

    def set_time_law(
        law: int, time: wp.array(dtype=f64), active: wp.array(dtype=wp.int32), value: wp.array2d(dtype=wp.vec3d)
    ):
        """Value of a law given as a function of t."""
        world = wp.tid()
        if active[world] == 0:
            return
        if wp.static(scalar):
            value[world, law] = wp.vec3d(f64(function(A(time[world]))), f64(0.0), f64(0.0))
        else:
            value[world, law] = wp.vec3d(function(A(time[world])))

    return wp.Kernel(func=set_time_law, module=_unique_module("law", function, scalar, take_dtype))


@functools.lru_cache(maxsize=256)
def body_force_kernel(function: wp.Function, dtype: str, take_dtype: str):
    """Kernel of Eq. (23): f_i = sum_q rho w s_i b(r_q, t), b at the current position; the same for all elements."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    take = precision(take_dtype)
    Block = block_struct(dtype)

    def add_body_force(
        block: Block, members: wp.array(dtype=wp.int32), reference: wp.array(dtype=vec3), origin: wp.vec3d,
        u: wp.array2d(dtype=vec3), time: wp.array(dtype=f64), ramp: wp.array(dtype=f64),
        active: wp.array(dtype=wp.int32), offset: int, contribution: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """f_i = sum_q rho w s_i b(r_q, t) of one element."""
        world, k = wp.tid()
        if active[world] == 0:
            return
        elem = members[k]
        column = elem % block.shape.shape[2]
        count = members.shape[0]
        slots = block.conn.shape[0]
        for i in range(slots):
            contribution[world, offset + i * count + k] = vec3()
        for q in range(block.mass_weight.shape[0]):
            r = vec3()
            for i in range(slots):
                s = block.conn[i, elem]
                r += block.shape[q, i, column] * (reference[s] + u[world, s])
            x = take.vec3(origin + wp.vec3d(r))
            b = vec3(function(x, take.T(time[world])))
            f = (T(ramp[world]) * block.mass_weight[q, elem]) * b
            for i in range(slots):
                e = offset + i * count + k
                contribution[world, e] = contribution[world, e] + block.shape[q, i, column] * f

    return wp.Kernel(func=add_body_force, module=_unique_module("field", function, dtype, take_dtype))


@functools.lru_cache(maxsize=256)
def body_force_product_kernel(function: wp.Function, dtype: str, take_dtype: str, transposed: bool):
    """Kernel of the derivative of `body_force_kernel` along a direction, or its transpose, by that of the field."""
    p = precision(dtype)
    T, vec3 = p.T, p.vec3
    take = precision(take_dtype)
    A, avec3 = take.T, take.vec3
    Block = block_struct(dtype)

    @wp.func
    def field_work(d: avec3, x: avec3, t: A) -> A:
        """d.b(x, t), whose derivative by x is (db/dx)^T d."""
        return wp.dot(d, avec3(function(x, t)))

    def add_body_force_product(
        block: Block, members: wp.array(dtype=wp.int32), reference: wp.array(dtype=vec3), origin: wp.vec3d, factor: T,
        u: wp.array2d(dtype=vec3), time: wp.array(dtype=f64), ramp: wp.array(dtype=f64),
        direction: wp.array2d(dtype=vec3), active: wp.array(dtype=wp.int32), offset: int,
        contribution: wp.array2d(dtype=vec3),
    ):  # fmt: skip
        """Factor times sum_q rho w s_i (db/dr) d(r_q) of one element, d the direction; `transposed`: (db/dr)^T."""
        world, k = wp.tid()
        if active[world] == 0:
            return
        t = A(time[world])
        count = members.shape[0]
        slots = block.conn.shape[0]
        elem = members[k]
        column = elem % block.shape.shape[2]
        for i in range(slots):
            contribution[world, offset + i * count + k] = vec3()
        for q in range(block.mass_weight.shape[0]):
            r = vec3()
            d = vec3()
            for i in range(slots):
                s = block.conn[i, elem]
                r += block.shape[q, i, column] * (reference[s] + u[world, s])
                d += block.shape[q, i, column] * direction[world, s]
            x = avec3(origin + wp.vec3d(r))
            g = avec3()
            if wp.static(transposed):
                _d, g, _t = wp.grad(field_work)(avec3(d), x, t)
            else:
                for c in range(3):
                    unit = avec3()
                    unit[c] = A(1.0)
                    _e, row, _s = wp.grad(field_work)(unit, x, t)
                    g[c] = wp.dot(row, avec3(d))
            f = (factor * T(ramp[world]) * block.mass_weight[q, elem]) * vec3(g)
            for i in range(slots):
                e = offset + i * count + k
                contribution[world, e] = contribution[world, e] + block.shape[q, i, column] * f

    module = _unique_module("field_product", function, dtype, take_dtype, transposed)
    return wp.Kernel(func=add_body_force_product, module=module)


_functions_by_key: dict[str, list[wp.Function]] = {}


def _unique_module(kind: str, function: wp.Function, *key) -> wp.Module:
    """Module of a user function, with a name reproducible across processes for the kernel cache."""
    same = _functions_by_key.setdefault(function.key, [])
    if function not in same:
        same.append(function)
    parts = [kind, function.key, str(same.index(function)), *map(str, key)]
    return kernel_module("_".join(parts).replace(".", "_"))
