"""Stiffness matrices of table elements: column by column on a GPU, a whole element at a time on the CPU.

A GPU has many threads with few registers: one thread computes one column of an element's matrix. A core of a CPU
computes whole elements: it forms dP/dF once per quadrature point, and its vector units process the slots of a panel
(up to MAX_PANEL_SLOTS slots) side by side.
"""

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import int_1d, precision
from .element_slots import iterate_struct

__all__ = [
    "PANEL_UNROLL",
    "column_kernel",
    "matrix_kernels",
    "panel_kernel",
    "panel_layout",
    "panel_row",
    "panel_row_type",
    "scheme_suffix",
]

MAX_PANEL_SLOTS = 8
"""Maximum number of slots of a panel: eight 64-bit numbers fill the widest vector registers."""
PANEL_UNROLL = 9
"""`max_unroll` of modules that process panels: with the loops over components unrolled, those over slots vectorise."""


def panel_layout(slots: int) -> tuple[int, int, int]:
    """Number of panels, slots per panel, and total rows: a panel has a row for each slot up to its last one."""
    panels = -(-slots // MAX_PANEL_SLOTS)
    width = -(-slots // panels)
    return panels, width, width * panels * (panels - 1) // 2 + slots


@wp.func
def panel_row(panel: int, width: int, a: int) -> int:
    """Row of an element's matrix with K_ab of slot a for the slots b of a panel, `width` slots wide."""
    return width * ((panel * (panel + 1)) / 2) + a


def panel_row_type(dtype: str, slots: int):
    """Type of a row: component (i, j) of K_ab at [3 i + j, b], for the `slots` slots b of a panel."""
    return wp.types.matrix(shape=(9, slots), dtype=precision(dtype).T)


@wp.func
def stress_form(form: int, use_prediction: int) -> int:
    """Stress in a matrix: `form` if not 0 or without a prediction, else 1 + `use_prediction`; see `point_state`."""
    if form != 0 or use_prediction == 0:
        return form
    return 1 + use_prediction


def scheme_suffix(midpoint: bool, dissipative: bool) -> str:
    """Module name suffix of a midpoint scheme."""
    return "_dissipative" if dissipative else "_midpoint" if midpoint else ""


def column_kernel(fn: KernelSet, module: wp.Module) -> wp.Kernel:
    """Kernel `element_matrix` of one kind of element block.

    Args:
        fn: functions of the kind: of points.py or assumed_strain.py, and `matrix_column`.
        module: that it is compiled in.
    """
    p, Block, NS, Iterate = fn.types, fn.Block, fn.slots, iterate_struct(fn.types.name)

    @masked_kernel(module, "active")
    def element_matrix(
        block: Block, iterate: Iterate, lines: p.vec3_3d, form: int, add: int, active: int_1d, matrix: p.vec3_3d
    ):
        """K of each element, Eqs. (35) and (54), as the columns of its 3x3 blocks K_ab, a <= b; one thread per column.

        Args:
            form: 0: K. 1: positive semi-definite at each point: without compression and viscous stress in the
                geometric part, and with `spd_increment` for laws that need J > 0; a function of u alone.
            add: 1: add to `matrix`, which holds K of another part of the energy.
        """
        world, index = wp.tid()
        elem = index % block.count
        b = index / block.count / 3
        axis = (index / block.count) % 3
        stress = stress_form(form, iterate.use_prediction[world])
        K = fn.matrix_column(block, p.T(iterate.dq_dv[world]), lines, stress, b, axis, world, elem)
        for a in range(NS):
            if a <= b:
                pair = a * NS - (a * (a - 1)) / 2 + b - a
                f = K[a]
                if add != 0:
                    f = f + matrix[world, 3 * pair + axis, elem]
                matrix[world, 3 * pair + axis, elem] = f

    return element_matrix


def panel_kernel(fn: KernelSet, module: wp.Module) -> wp.Kernel:
    """Kernel `element_matrix_panels` of one kind of element block.

    Args:
        fn: functions of the kind: of points.py or assumed_strain.py, and `add_panels`.
        module: that it is compiled in.
    """
    p, Block, Iterate = fn.types, fn.Block, iterate_struct(fn.types.name)
    Rows = panel_row_type(p.name, panel_layout(fn.slots)[1])

    @masked_kernel(module, "active")
    def element_matrix_panels(
        block: Block, iterate: Iterate, form: int, active: int_1d, add: int, matrix: wp.array3d(dtype=Rows)
    ):
        """K of each element by one thread; it needs no `prepare_matrix`.

        Args:
            matrix: [world, elem, panel_row(panel, a)], K_ab over the slots b of a panel, see `panel_row_type`.
            form, add: see `element_matrix`.
        """
        world, elem = wp.tid()
        U, V = fn.load_slots(block, iterate.u, world, elem), fn.load_velocities(block, iterate.v, world, elem)
        step = fn.load_last_change(block, iterate, world, elem)
        stress = stress_form(form, iterate.use_prediction[world])
        if add == 0:
            for k in range(matrix.shape[2]):
                matrix[world, elem, k] = Rows()
        dq = p.T(iterate.dq_dv[world])
        fn.add_panels(block, U, V, step, iterate.history, dq, stress, world, elem, matrix)

    return element_matrix_panels


def matrix_kernels(fn: KernelSet, name: str) -> KernelSet:
    """Kernels `prepare_matrix`, `element_matrix`, `element_matrix_panels` of one kind of element block.

    Args:
        fn: the functions of points.py for this kind.
        name: beginning of the names of the modules.
    """
    p = fn.types
    T, vec3, mat33, sym_2d = p.T, p.vec3, p.mat33, p.sym_2d
    t, m, Block, Local, coef = fn.tensors, fn.law, fn.Block, fn.Local, fn.coef
    NS, needs_J, affine, framed = fn.slots, fn.needs_J, fn.affine, fn.framed
    midpoint, dissipative, Iterate = fn.midpoint, fn.dissipative, iterate_struct(p.name)
    module = kernel_module(f"{name}_matrix", max_unroll=16)
    rows_module = kernel_module(f"{name}_rows", max_unroll=PANEL_UNROLL)
    PANELS, P, _ = panel_layout(NS)
    Rows = wp.array3d(dtype=panel_row_type(p.name, P))
    Slots = wp.types.matrix(shape=(3 * PANELS, P), dtype=T)
    Tensor = wp.types.matrix(shape=(9, 9), dtype=T)
    moduli9 = t.moduli9
    Products = wp.types.matrix(shape=(27, P), dtype=T)

    @wp.func
    def point_state(
        block: Block, U: Local, V: Local, step: Local, history: p.sym_2d, dq: T, c: coef, form: int, world: int,
        point: int, elem: int,
    ):  # fmt: skip
        """F with columns along the law's axes, and the second Piola-Kirchhoff stress S there, Pa.

        `form` 0: S with its viscous part; 1: without it, and with compression removed. For laws that need J > 0, S is
        the viscous part alone; their elastic tangent comes entirely from `increment` or `spd_increment`.
        `form` 2: S is that of the linear prediction (mixed integration points, Magisano, Leonetti and Garcea 2017),
        `step` the last change of the slots, m; see `predicted_stress_change`. `form` 3: without compression, as with
        `form` 1, but with the viscous part.
        """
        G = fn.field_gradient(block, U, point, elem)
        local = fn.to_material_axes(block, G, point, elem)
        F = t.identity() + G
        S = mat33()
        if wp.static(midpoint):
            if form != 1:
                S = fn.midpoint_stress(block, local, fn.velocity_gradient(block, V, point, elem), c)
        if wp.static(not needs_J):
            if wp.static(midpoint):
                if form == 1:
                    S = m.pk2_stress(t.green_lagrange(local), c)
                    S += fn.max_compression(S) * t.identity()
            else:
                S = m.pk2_stress(t.green_lagrange(local), c)
                if form == 1:
                    S += fn.max_compression(S) * t.identity()
        if wp.static(fn.viscous):
            if form != 1:
                Fdot = fn.velocity_gradient(block, V, point, elem)
                S += fn.viscous_stress(block, local, Fdot, history, c, dq, world, point, elem)
        if form == 3:
            S += fn.max_compression(S) * t.identity()
        elif form == 2:
            ahead = fn.material_gradient(block, step, point, elem)
            S += fn.predicted_stress_change(local, ahead, c, dq)
        if wp.static(framed):
            F = F * block.material_axes[point, elem]
        return F, S

    @wp.func
    def elastic_increment(block: Block, F: mat33, dF: mat33, c: coef) -> mat33:
        """dP of a law that needs J > 0; `midpoint`: without the part of S, given by `point_state`."""
        if wp.static(midpoint):
            return F * fn.midpoint_stress_increment(block, F - t.identity(), t.sym(wp.transpose(F) * dF), c)
        else:
            return m.increment(F - t.identity(), dF, c)

    @masked_kernel(module, "active")
    def prepare_matrix(block: Block, iterate: Iterate, form: int, active: int_1d, lines: p.vec3_3d):
        """F and S of `point_state`, common to all columns of an element's matrix: [world, 5 point + row, elem].

        Rows 0 to 2 are those of F, row 3 is the diagonal of S, row 4 its components (23, 13, 12). `form`: see
        `element_matrix`.
        """
        world, point, elem = wp.tid()
        U, V = fn.load_slots(block, iterate.u, world, elem), fn.load_velocities(block, iterate.v, world, elem)
        c = fn.coefficients(block, world, elem)
        step = fn.load_last_change(block, iterate, world, elem)
        dq, stress = T(iterate.dq_dv[world]), stress_form(form, iterate.use_prediction[world])
        F, S = point_state(block, U, V, step, iterate.history, dq, c, stress, world, point, elem)
        for i in range(3):
            lines[world, 5 * point + i, elem] = F[i]
        lines[world, 5 * point + 3, elem] = vec3(S[0, 0], S[1, 1], S[2, 2])
        lines[world, 5 * point + 4, elem] = vec3(S[1, 2], S[0, 2], S[0, 1])

    @wp.func
    def load_point(lines: p.vec3_3d, world: int, point: int, elem: int):
        """F and S of a point from the rows of `prepare_matrix`."""
        F = wp.matrix_from_rows(
            lines[world, 5 * point, elem], lines[world, 5 * point + 1, elem], lines[world, 5 * point + 2, elem]
        )
        d = lines[world, 5 * point + 3, elem]
        o = lines[world, 5 * point + 4, elem]
        return F, mat33(d[0], o[2], o[1], o[2], d[1], o[0], o[1], o[0], d[2])

    @wp.func
    def material_slot_gradient(block: Block, point: int, slot: int, elem: int) -> vec3:
        """h of a slot at a point, along the law's axes, 1/m."""
        h = fn.slot_gradient(block, point, slot, elem)
        if wp.static(framed):
            h = wp.transpose(block.material_axes[point, elem]) * h
        return h

    @wp.func
    def matrix_column(
        block: Block, dq: T, lines: p.vec3_3d, form: int, b: int, axis: int, world: int, elem: int
    ) -> Local:
        """Column `axis` of the blocks K_ab, a <= b, from F and S of the points; `form`: see `point_state`."""
        c = fn.coefficients(block, world, elem)
        cv = fn.damping_coefficients(c, T(1.0) / dq)
        unit = vec3()
        unit[axis] = T(1.0)
        out = Local()
        for point in range(block.shape_gradient.shape[0]):
            F, S = load_point(lines, world, point, elem)
            h = material_slot_gradient(block, point, b, elem)
            # dF = unit h^T, so that F^T dF is the outer product of a row of F and h
            B = t.sym(wp.outer(wp.transpose(F) * unit, h))
            dP = wp.outer(unit, S * h)
            if wp.static(not needs_J):
                dS = m.pk2_stress(B, c)
                if wp.static(dissipative):
                    dS = fn.dissipation_factor(block) * dS
                if wp.static(fn.viscous):
                    dS += t.isotropic_stress(B, cv[0], cv[1])
                dP += F * dS
            else:
                if wp.static(fn.viscous):
                    dP += F * t.isotropic_stress(B, cv[0], cv[1])
                if form == 1 or form == 3:
                    dP += fn.spd_increment(F, wp.outer(unit, h), c)
                else:
                    dP += elastic_increment(block, F, wp.outer(unit, h), c)
            if wp.static(framed):
                dP = dP * wp.transpose(block.material_axes[point, elem])
            dP = fn.tangent_weight(block, point, elem) * dP
            if wp.static(affine):
                dP = dP * wp.transpose(fn.inverse_jacobian(block, elem))
            for a in range(NS):
                if a <= b:
                    if wp.static(affine):
                        out[a] = out[a] + dP * block.shape_gradient[point, a, 0]
                    else:
                        out[a] = out[a] + dP * block.shape_gradient[point, a, elem]
        return out

    @wp.func
    def elasticity_tensor(block: Block, F: mat33, S: mat33, moduli: moduli9, c: coef, positive: bool, w: T) -> Tensor:
        """w dP_ik/dF_jl at [3 i + k, 3 j + l]: of S, of stresses linear in E (`moduli`), and of laws that need J > 0.

        With the shear moduli G and the other moduli D of `moduli`, the first two give S_kl delta_ij + D_kl F_ik F_jl +
        G_kl F_il F_jk for k != l, and S_kk delta_ij + D_kk F_ik F_jk + sum of G_mk F_im F_jm over m != k for k = l.
        """
        A = Tensor()
        for k in range(3):
            low = wp.where(k == 0, 1, 0)
            high = 3 - k - low  # the other two axes
            for i in range(3):
                x = w * moduli[k] * F[i, k]
                y = w * moduli[9 - k - low] * F[i, low]
                z = w * moduli[9 - k - high] * F[i, high]
                for j in range(3):
                    A[3 * i + k, 3 * j + k] = x * F[j, k] + y * F[j, low] + z * F[j, high]
                A[3 * i + k, 3 * i + k] = A[3 * i + k, 3 * i + k] + w * S[k, k]
                for l in range(k + 1, 3):
                    x = w * moduli[6 - k - l] * F[i, k]
                    y = w * moduli[9 - k - l] * F[i, l]
                    for j in range(3):
                        a = x * F[j, l] + y * F[j, k]
                        A[3 * i + k, 3 * j + l] = a
                        A[3 * j + l, 3 * i + k] = a
                    a = A[3 * i + k, 3 * i + l] + w * S[k, l]
                    A[3 * i + k, 3 * i + l] = a
                    A[3 * i + l, 3 * i + k] = a
        if wp.static(needs_J):
            for j in range(3):
                for l in range(3):
                    dF = mat33()
                    dF[j, l] = w
                    dP = mat33()
                    if positive:
                        dP = fn.spd_increment(F, dF, c)
                    else:
                        dP = elastic_increment(block, F, dF, c)
                    for i in range(3):
                        for k in range(3):
                            A[3 * i + k, 3 * j + l] = A[3 * i + k, 3 * j + l] + dP[i, k]
        return A

    @wp.func
    def tangent_moduli(block: Block, c: coef, dq: T) -> moduli9:
        """Moduli of the stresses that are linear in E, viscous stress included, Pa; 0 for a law that needs J > 0."""
        cv = fn.damping_coefficients(c, T(1.0) / dq)
        moduli = t.moduli9()
        if wp.static(not needs_J):
            moduli = m.moduli(c)
            if wp.static(dissipative):
                moduli = fn.dissipation_factor(block) * moduli
        if wp.static(fn.viscous):
            moduli += t.isotropic_moduli(cv[0], cv[1])
        return moduli

    @wp.func
    def add_panels(
        block: Block, U: Local, V: Local, step: Local, history: sym_2d, dq: T, form: int, world: int, elem: int, K: Rows
    ):
        """Add K by panels: A is dP/dF at a point; the rows of D, over b, are A : (e_j h_b^T) of a panel, and
        K_ab = h_a . D_b."""
        c = fn.coefficients(block, world, elem)
        moduli = tangent_moduli(block, c, dq)
        h, H = Local(), Slots()
        for point in range(block.shape_gradient.shape[0]):
            F, S = point_state(block, U, V, step, history, dq, c, form, world, point, elem)
            into = t.identity()
            if wp.static(framed):
                into = wp.transpose(block.material_axes[point, elem])
            if wp.static(affine):
                into = into * wp.transpose(fn.inverse_jacobian(block, elem))
            for a in range(NS):
                if wp.static(affine):
                    h[a] = into * block.shape_gradient[point, a, 0]
                elif wp.static(framed):
                    h[a] = into * block.shape_gradient[point, a, elem]
                else:
                    h[a] = block.shape_gradient[point, a, elem]
                for l in range(3):
                    H[3 * (a / P) + l, a % P] = h[a][l]
            w = fn.tangent_weight(block, point, elem)
            A = elasticity_tensor(block, F, S, moduli, c, form == 1 or form == 3, w)
            for panel in range((block.conn.shape[0] + P - 1) / P):  # PANELS, but not unrolled
                D = Products()
                for i in range(9):
                    for j in range(3):
                        D[3 * i + j] = (
                            A[i, 3 * j] * H[3 * panel]
                            + A[i, 3 * j + 1] * H[3 * panel + 1]
                            + A[i, 3 * j + 2] * H[3 * panel + 2]
                        )
                for a in range(wp.min(NS, P * (panel + 1))):
                    g = h[a]
                    row = panel_row(panel, P, a)
                    R = K[world, elem, row]
                    for i in range(3):
                        for j in range(3):
                            k = 3 * i + j
                            R[k] = R[k] + g[0] * D[6 * i + k] + g[1] * D[6 * i + 3 + k] + g[2] * D[6 * i + 6 + k]
                    K[world, elem, row] = R

    fn = kernel_set(vars(fn) | {"matrix_column": matrix_column, "add_panels": add_panels})
    element_matrix, element_matrix_panels = column_kernel(fn, module), panel_kernel(fn, rows_module)
    return kernel_set(locals())
