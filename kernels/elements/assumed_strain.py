"""Elements with assumed natural strain (Dvorkin and Bathe 1984), integration="tied": force, energy, products, matrices.

Strains e_t = 2 E_ab = x_a . x_b - X_a . X_b, mostly shears, are taken at tying points ("ties") t, where x_a and x_b are
the derivatives of the position along two parent directions or two axes of the element. Interpolation, metric and
quadrature are one symmetric matrix A per element, made on the host: the energy is (mu/2) e.A e, J.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import double_1d, double_3d, int_1d, precision
from .assumed_strain_block import assumed_shear_functions, assumed_strain_struct, coupling_entry_function
from .element_slots import iterate_struct, slot_access_functions
from .matrix import PANEL_UNROLL, column_kernel, panel_kernel, panel_layout, panel_row, panel_row_type, scheme_suffix
from .products import predicted_stress_kernel, tangent_kernel

__all__ = ["assumed_strain_kernels"]


@functools.cache
def assumed_strain_kernels(
    dtype: str,
    slots: int,
    ties: int,
    width: int,
    midpoint: bool = False,
    worlds: bool = False,
    dissipative: bool = False,
) -> KernelSet:
    """Kernels of elements with assumed strains, with the arguments of `element_kernels`: one loop launches both.

    Args:
        dtype: precision.
        slots, ties: slots and tying points per element.
        width: A couples the ties of each run of `width`.
        midpoint: conserving scheme: u is that at the midpoint of the step, v half of the change of u; the shears in
            forces and products are the mean of those at both ends, and the energy is that at the end.
        dissipative: with (chi/2) of the shears' change added to the mean, see kernels/elements/energy_momentum.py.
        worlds: A differs between worlds, stored side by side.
    """
    types = p = precision(dtype)
    T, vec3, mat33, sym6, sym_2d = p.T, p.vec3, p.mat33, p.sym, p.sym_2d
    Block, Iterate = assumed_strain_struct(dtype, dissipative), iterate_struct(dtype)
    name = f"tied_{dtype}_{slots}_{ties}_{width}{scheme_suffix(midpoint, dissipative)}{'_worlds' if worlds else ''}"
    module = kernel_module(name)
    matrix_module = kernel_module(f"{name}_matrix", max_unroll=8)
    coupling_entry = coupling_entry_function(dtype, worlds, dissipative)
    shears = assumed_shear_functions(dtype, slots, ties, dissipative)
    Local, Ties, TieVectors = shears.Local, shears.Ties, shears.TieVectors
    directional_derivative, kinematics = shears.directional_derivative, shears.kinematics
    add_second_order, step_shears = shears.add_second_order, shears.step_shears
    load_slots, load_last_change, store_forces = slot_access_functions(dtype, slots, Block)
    NS, NT, W = slots, ties, width
    PANELS, P, _ = panel_layout(NS)
    Row = wp.types.vector(length=P, dtype=T)
    TIES_PER_LOAD = 4 if NT % 4 == 0 else 1  # ties added to a row of the matrix between its load and its store
    Rows = wp.array3d(dtype=panel_row_type(dtype, P))
    Slots = wp.types.matrix(shape=(NT * PANELS, P), dtype=T)
    Changes = wp.types.matrix(shape=(3 * NT * PANELS, P), dtype=T)
    Products = wp.types.matrix(shape=(3 * NT, P), dtype=T)
    rows_module = kernel_module(f"{name}_rows", max_unroll=PANEL_UNROLL)

    @wp.func
    def midpoint_weight(x: T) -> T:
        """Half of a stiffness with `midpoint`: midpoint values move by half of the end's change."""
        if wp.static(midpoint):
            return T(0.5) * x
        else:
            return x

    @wp.func
    def matrix_modulus(block: Block, mu: T) -> T:
        """Modulus in a matrix: `midpoint_weight`, times (1 + chi) in a dissipative step."""
        if wp.static(dissipative):
            return (T(1.0) + block.dissipation) * midpoint_weight(mu)
        else:
            return midpoint_weight(mu)

    @wp.func
    def tying_stresses(block: Block, e: Ties, world: int, elem: int) -> Ties:
        """s = mu A e, the derivative of the energy by the shears, N/m."""
        mu = block.coefficients[world % block.coefficients.shape[0], block.material[elem], 0]
        s = Ties()
        for t in range(NT):
            total = T(0.0)
            first = (t / W) * W
            for k in range(W):
                total += coupling_entry(block, t, k, world, elem) * e[first + k]
            s[t] = mu * total
        return s

    @wp.func
    def load_velocities(block: Block, v: p.vec3_2d, world: int, elem: int) -> Local:
        """Half change of an element's slots if `midpoint`, else zeros."""
        if wp.static(midpoint):
            return load_slots(block, v, world, elem)
        else:
            return Local()

    @wp.func
    def change_of_force(
        block: Block, P: Local, D: Local, x1: TieVectors, x2: TieVectors, e: Ties, world: int, elem: int
    ) -> Local:
        """Forces for a change P of the slots, with x_a, x_b and the shears e of the geometric part, N.

        `midpoint`: shears change along x_a and x_b at the end of the step, given by D.
        """
        de = Ties()
        for t in range(NT):
            a = x1[t]
            d = x2[t]
            if wp.static(midpoint):
                a += directional_derivative(block.derivative_a, D, t, elem)
                d += directional_derivative(block.derivative_b, D, t, elem)
            de[t] = wp.dot(a, directional_derivative(block.derivative_b, P, t, elem)) + wp.dot(
                d, directional_derivative(block.derivative_a, P, t, elem)
            )
            if wp.static(dissipative):
                de[t] = (T(1.0) + block.dissipation) * de[t]
        s = tying_stresses(block, e, world, elem)
        ds = tying_stresses(block, de, world, elem)
        f = Local()
        for t in range(NT):
            da = ds[t] * x1[t] + s[t] * directional_derivative(block.derivative_a, P, t, elem)
            dd = ds[t] * x2[t] + s[t] * directional_derivative(block.derivative_b, P, t, elem)
            for i in range(NS):
                f[i] = f[i] + block.derivative_a[t, i, elem] * dd + block.derivative_b[t, i, elem] * da
        if wp.static(midpoint):
            f = T(0.5) * f
        return f

    @wp.kernel(module=module)
    def internal_force(
        block: Block, iterate: Iterate, active: int_1d, lanes: int, contribution: p.vec3_2d,
        energy: double_3d, min_J: double_1d, domain_J: double_1d,
    ):  # fmt: skip
        """f_i = sum_t s_t (s_i,a x_b + s_i,b x_a), N, and the energy e.s/2, J; one thread per element."""
        world, elem = wp.tid()
        if active[world] == 0 or elem >= block.count:
            return
        U = load_slots(block, iterate.u, world, elem)
        x1, x2, e = kinematics(block, U, elem)
        s = Ties()
        if wp.static(midpoint):
            D = load_slots(block, iterate.v, world, elem)
            s = tying_stresses(block, step_shears(block, x1, x2, D, e, elem), world, elem)
            _, _, e = kinematics(block, U + D, elem)
        else:
            s = tying_stresses(block, e, world, elem)
        f = Local()
        for t in range(NT):
            a = s[t] * x1[t]
            d = s[t] * x2[t]
            for i in range(NS):
                f[i] = f[i] + block.derivative_a[t, i, elem] * d + block.derivative_b[t, i, elem] * a
        store_forces(block, f, world, elem, contribution)
        if wp.static(midpoint):
            s = tying_stresses(block, e, world, elem)
        energy[0, world, block.element_offset + elem] = wp.float64(T(0.5) * wp.dot(e, s))
        energy[1, world, block.element_offset + elem] = wp.float64(0.0)

    @wp.func
    def tangent_force(
        block: Block, U: Local, dU: Local, V: Local, history: p.sym_2d, dq: T, form: int, world: int, elem: int
    ) -> Local:
        """K dU: the change of `internal_force` with a change dU of the slots; `form` 2: see `point_increment`."""
        x1, x2, e = kinematics(block, U, elem)
        if wp.static(midpoint):
            if form == 2:
                _, _, e = kinematics(block, U - V, elem)
            else:
                e = step_shears(block, x1, x2, V, e, elem)
        return change_of_force(block, dU, V, x1, x2, e, world, elem)

    @wp.func
    def predicted_force(
        block: Block, U: Local, dU: Local, step: Local, history: p.sym_2d, dq: T, form: int, world: int, elem: int
    ) -> Local:
        """K dU with the shear stress of the linear prediction; `form`: `use_prediction` of the kernel."""
        x1, x2, e = kinematics(block, U, elem)
        if form == 1:
            e = add_second_order(block, step, e, T(-1.0), elem)
        if form == 2:
            e = Ties()
        return change_of_force(block, dU, Local(), x1, x2, e, world, elem)

    @masked_kernel(module, "active")
    def diagonal_blocks(block: Block, u: p.vec3_2d, dq_dv: double_1d, active: int_1d, contribution: p.sym_2d):
        """The 3x3 diagonal blocks of K in Voigt order, without the geometric part: positive semi-definite, as A is."""
        world, elem = wp.tid()
        U = load_slots(block, u, world, elem)
        mu = block.coefficients[world % block.coefficients.shape[0], block.material[elem], 0]
        for i in range(NS):
            b = TieVectors()
            for t in range(NT):
                a = block.X_a[t, elem] + directional_derivative(block.derivative_a, U, t, elem)
                d = block.X_b[t, elem] + directional_derivative(block.derivative_b, U, t, elem)
                b[t] = block.derivative_a[t, i, elem] * d + block.derivative_b[t, i, elem] * a
            K = mat33()
            for t in range(NT):
                row = vec3()
                first = (t / W) * W
                for k in range(W):
                    row += coupling_entry(block, t, k, world, elem) * b[first + k]
                K += wp.outer(b[t], row)
            entry = block.contribution_offset + i * block.count + elem
            contribution[world, entry] = matrix_modulus(block, mu) * sym6(
                K[0, 0], K[1, 1], K[2, 2], K[1, 2], K[0, 2], K[0, 1]
            )

    @masked_kernel(matrix_module, "active")
    def prepare_matrix(block: Block, iterate: Iterate, form: int, active: int_1d, lines: p.vec3_3d):
        """Data of the ties common to all columns of an element's matrix, [world, row, elem].

        Row `tie` holds x_a, row NT + tie x_b, and row 2 NT + tie the shear e_t in its first component.
        """
        world, tie, elem = wp.tid()
        da = vec3()
        dd = vec3()
        first = iterate.u[world, block.conn[0, elem]]
        for i in range(NS):
            x = iterate.u[world, block.conn[i, elem]] - block.is_position[i] * first
            da += block.derivative_a[tie, i, elem] * x
            dd += block.derivative_b[tie, i, elem] * x
        a = block.X_a[tie, elem] + da
        d = block.X_b[tie, elem] + dd
        shear = wp.dot(block.X_a[tie, elem], dd) + wp.dot(da, d)
        if wp.static(midpoint):
            D = load_slots(block, iterate.v, world, elem)
            half_a = directional_derivative(block.derivative_a, D, tie, elem)
            half_d = directional_derivative(block.derivative_b, D, tie, elem)
            shear += wp.dot(half_a, half_d)
            if wp.static(dissipative):
                shear += block.dissipation * (wp.dot(a, half_d) + wp.dot(d, half_a))
        if iterate.use_prediction[world] == 1:
            change = load_slots(block, iterate.v, world, elem) - load_slots(block, iterate.base, world, elem)
            factor = T(iterate.dq_dv[world]) * T(iterate.dq_dv[world])
            shear -= factor * wp.dot(
                directional_derivative(block.derivative_a, change, tie, elem),
                directional_derivative(block.derivative_b, change, tie, elem),
            )
        lines[world, tie, elem] = a
        lines[world, NT + tie, elem] = d
        lines[world, 2 * NT + tie, elem] = vec3(shear, T(0.0), T(0.0))

    @masked_kernel(matrix_module, "active")
    def prepare_stress(block: Block, iterate: Iterate, active: int_1d, lines: p.vec3_3d):
        """s = mu A e of the ties, in the first components of the rows 3 NT + tie."""
        world, tie, elem = wp.tid()
        first = (tie / W) * W
        s = T(0.0)
        for k in range(W):
            s += coupling_entry(block, tie, k, world, elem) * lines[world, 2 * NT + first + k, elem][0]
        mu = block.coefficients[world % block.coefficients.shape[0], block.material[elem], 0]
        if iterate.use_prediction[world] == 2:
            mu = T(0.0)  # no geometric part
        lines[world, 3 * NT + tie, elem] = vec3(midpoint_weight(mu) * s, T(0.0), T(0.0))

    @wp.func
    def matrix_column(
        block: Block, dq: T, lines: p.vec3_3d, form: int, b: int, axis: int, world: int, elem: int
    ) -> Local:
        """Column `axis` of the blocks K_ab, a <= b; `form` 1: without the geometric part."""
        mu = matrix_modulus(block, block.coefficients[world % block.coefficients.shape[0], block.material[elem], 0])
        unit = vec3()
        unit[axis] = T(1.0)
        change = Ties()
        for t in range(NT):
            x = lines[world, t, elem][axis]
            y = lines[world, NT + t, elem][axis]
            change[t] = mu * (block.derivative_a[t, b, elem] * y + block.derivative_b[t, b, elem] * x)
        out = Local()
        for t in range(NT):
            first = (t / W) * W
            s = T(0.0)
            for k in range(W):
                s += coupling_entry(block, t, k, world, elem) * change[first + k]
            da = s * lines[world, t, elem]
            dd = s * lines[world, NT + t, elem]
            if form != 1:
                stress = lines[world, 3 * NT + t, elem][0]
                da += (stress * block.derivative_a[t, b, elem]) * unit
                dd += (stress * block.derivative_b[t, b, elem]) * unit
            for a in range(NS):
                if a <= b:
                    out[a] = out[a] + block.derivative_a[t, a, elem] * dd + block.derivative_b[t, a, elem] * da
        return out

    @wp.func
    def add_panels(
        block: Block, U: Local, V: Local, step: Local, history: sym_2d, dq: T, form: int, world: int, elem: int, K: Rows
    ):
        """Add K = mu B^T A B + geometric part by panels; `form`: see `point_state`."""
        mu = matrix_modulus(block, block.coefficients[world % block.coefficients.shape[0], block.material[elem], 0])
        x1, x2, e = kinematics(block, U, elem)
        first, second, B = Slots(), Slots(), Changes()
        for t in range(NT):
            d1 = x1[t]
            d2 = x2[t]
            for a in range(NS):
                f = block.derivative_a[t, a, elem]
                s = block.derivative_b[t, a, elem]
                row = NT * (a / P) + t
                first[row, a % P] = f
                second[row, a % P] = s
                for i in range(3):
                    B[3 * row + i, a % P] = f * d2[i] + s * d1[i]
        if form == 2:
            e = add_second_order(block, step, e, T(-1.0), elem)
        stress = Ties()
        if wp.static(midpoint):
            e = step_shears(block, x1, x2, V, e, elem)
        if form != 1 and form != 3:
            stress = tying_stresses(block, e, world, elem)
        for panel in range((block.conn.shape[0] + P - 1) / P):  # PANELS, but not unrolled
            AB = Products()
            for t in range(NT):
                x, y, z = Row(), Row(), Row()
                for k in range(W):
                    other = 3 * (NT * panel + (t / W) * W + k)
                    c = mu * coupling_entry(block, t, k, world, elem)
                    x = x + c * B[other]
                    y = y + c * B[other + 1]
                    z = z + c * B[other + 2]
                AB[3 * t] = x
                AB[3 * t + 1] = y
                AB[3 * t + 2] = z
            for group in range(NT / TIES_PER_LOAD):
                for a in range(wp.min(NS, P * (panel + 1))):
                    at = panel_row(panel, P, a)
                    R = K[world, elem, at]
                    row = NT * (a / P) + TIES_PER_LOAD * group
                    n = a % P
                    for o in range(TIES_PER_LOAD):
                        t = TIES_PER_LOAD * group + o
                        for i in range(3):
                            c = B[3 * (row + o) + i, n]
                            for j in range(3):
                                R[3 * i + j] = R[3 * i + j] + c * AB[3 * t + j]
                        G = midpoint_weight(stress[t]) * (
                            second[row + o, n] * first[NT * panel + t] + first[row + o, n] * second[NT * panel + t]
                        )
                        for i in range(3):
                            R[4 * i] = R[4 * i] + G
                    K[world, elem, at] = R

    fn = kernel_set(locals())
    tangent_product = tangent_kernel(fn, module)
    predicted_stress_product = predicted_stress_kernel(fn, kernel_module(f"{name}_mixed"))
    element_matrix, element_matrix_panels = column_kernel(fn, matrix_module), panel_kernel(fn, rows_module)
    return kernel_set(locals())
