"""Holonomic constraints by augmented Lagrangian: rows c(q, t) = 0 m, their derivatives, and multipliers in N.

Every constraint is built from vectors a = sum_k w_k e_k, linear in the slots (a difference of two points, a material
direction, a constant), at most three per row:

    DOT       c = scale (a.b - f)                       DP1, DP2; PIN with b a constant axis
    DISTANCE  c = scale (|a| - f)                       DIST
    ANGLE     c = scale (cos f a2 - sin f a).b          the sine of the angle between b and the direction f of (a, a2)
    FORMULA+  c = scale (h(a, b, a2) - f)               device functions of one's own, see constraint_formulas.py

Vectors are the terms 3 row + side, sides a, b, a2. Rows are evaluated in float64 from displacements, so that c is free
of the round-off of large coordinates. One thread per (world, row); slots gather from terms in a fixed order.
"""

import functools

import warp as wp

from ..common.modules import KernelSet, kernel_module, kernel_set, masked_kernel
from ..common.types import double_1d, double_2d, f64, int_1d, int_2d, precision, vec3d, vec3d_2d

__all__ = [
    "ANGLE",
    "DISTANCE",
    "DOT",
    "FORMULA",
    "JOINT_COLUMNS",
    "VELOCITY",
    "constraint_functions",
    "constraint_kernels",
    "constraint_struct",
    "joint_struct",
    "multiplier_struct",
]

DOT = 0
DISTANCE = 1
ANGLE = 2
FORMULA = 3
"""Kind of the rows of a model's first formula; the others follow."""
VELOCITY = 1 << 30
"""Kind of rows at the level of velocities, see velocity_rows.py."""
JOINT_COLUMNS = 7
"""Columns per joint in the report of a step: force and moment on the child, N and N m, and violation, m."""
SINGLE_ROUNDING = 2.0**-23
"""Round-off of positions in float32."""
MAX_DRIVE_ROTATION = 1.0
"""Largest change of a driven angle in a substep, rad: a larger one may crush a body instead of turning it."""


@functools.cache
def constraint_struct():
    """Constraint rows, their vectors (terms) as weighted sums of slots, and what rows share with each other."""

    @wp.struct
    class Constraints:
        kind: wp.array(dtype=wp.int32)  # [row] DOT, DISTANCE, ANGLE, FORMULA + the index of a formula, VELOCITY
        scale: wp.array(dtype=wp.float64)  # [row] m per unit of the bracket: lengths of the model for angles, else 1
        reference_product: wp.array(dtype=wp.float64)  # [row] A.B in the reference configuration; |A|^2 of a distance
        constant_target: wp.array(dtype=wp.float64)  # [row] constant part of f: m, rad or a cosine
        law: wp.array(dtype=wp.int32)  # [row] time law added to f, -1: none
        law_component: wp.array(dtype=wp.int32)  # [row] component of that law's value
        connected_component: wp.array(dtype=wp.int32)  # [row] connected component of the model
        term_start: wp.array(dtype=wp.int32)  # [3 row + 1] first entry (slot, weight) of each term
        term_slot: wp.array(dtype=wp.int32)
        term_weight: wp.array(dtype=wp.float64)
        reference: wp.array(dtype=wp.vec3d)  # [3 row] value of a term in the reference configuration
        slot_start: wp.array(dtype=wp.int32)  # [slot + 1] the same entries by slot
        slot_term: wp.array(dtype=wp.int32)
        slot_weight: wp.array(dtype=wp.float64)
        cluster: wp.array(dtype=wp.int32)  # [row] cluster of rows inverted together
        cluster_start: wp.array(dtype=wp.int32)  # [cluster + 1] rows
        matrix_start: wp.array(dtype=wp.int32)  # [cluster] entry of its dense matrix
        pair_start: wp.array(dtype=wp.int32)  # [matrix entry + 1] first pair of terms of an entry
        pair_side: wp.array(dtype=wp.vec2i)  # [pair] sides of the row and of the column
        pair_block: wp.array(dtype=wp.int32)  # [pair] block of both vectors
        coupling_start: wp.array(dtype=wp.int32)  # [row + 1] first coupling of a row to rows of other clusters
        coupling_row: wp.array(dtype=wp.int32)  # [coupling]
        coupling_column: wp.array(dtype=wp.int32)  # [coupling]
        coupling_pair_start: wp.array(dtype=wp.int32)  # [coupling + 1] first pair of terms
        colour: wp.array(dtype=wp.int32)  # [cluster] colour; coupled clusters differ
        colour_cluster: wp.array(dtype=wp.int32)  # clusters by colour
        block_start: wp.array(dtype=wp.int32)  # [block + 1]
        block_slot: wp.array(dtype=wp.int32)
        block_weight: wp.array(dtype=wp.float64)  # product of both weights at the slot

    return Constraints


@functools.cache
def multiplier_struct():
    """Values, gradients and multipliers of the constraint rows: [world, row], [world, term]."""

    @wp.struct
    class Multipliers:
        constraint_value: wp.array2d(dtype=wp.float64)  # c, m
        target: wp.array2d(dtype=wp.float64)  # f
        last_target: wp.array2d(dtype=wp.float64)  # f of the last accepted step
        gradient: wp.array2d(dtype=wp.vec3d)  # [world, term] dc / d vector, where forces are evaluated
        end_gradient: wp.array2d(dtype=wp.vec3d)  # dc / d vector at the end of the step, the derivative of c
        signed_scale: wp.array2d(dtype=wp.float64)  # `Constraints.scale`, negative beyond a right angle
        multiplier: wp.array2d(dtype=wp.float64)  # lambda, N
        multiplier_change: wp.array2d(dtype=wp.float64)  # change of lambda in a full Newton step, N
        trial_multiplier: wp.array2d(dtype=wp.float64)  # lambda at the trial of the line search, N
        frozen_force: wp.array2d(dtype=wp.float64)  # lambda + rho c with lambda frozen in the line search
        penalty_force: wp.array2d(dtype=wp.float64)  # rho c
        penalty: wp.array2d(dtype=wp.float64)  # rho, N/m
        product: wp.array2d(dtype=wp.vec3d)  # [world, term] contributions to H p
        curvature: wp.array2d(dtype=wp.mat33d)  # [world, 9 row + 3 side + other] d2c / (d vector d other), by formulas
        rows: wp.array3d(dtype=wp.float64)  # [TERM_ROWS, world, row] of the potential, J
        # [world, component] largest |c| above round-off, m; in a last column that of all rows
        violation: wp.array2d(dtype=wp.float64)
        stiffest: wp.array2d(dtype=wp.float64)  # [world, component] largest stiffness of rows, 1 / (J D^-1 J^T)_ii
        compliance_block: wp.array2d(dtype=wp.mat33d)  # [world, block] sum w w D^-1 over common slots
        inverse_matrix: wp.array2d(dtype=wp.float64)  # [world, entry] of clusters: (1 / (dq/dv rho) + J D^-1 J^T)^-1
        coupling: wp.array2d(dtype=wp.float64)  # [world, coupling] J D^-1 J^T between clusters
        deflation_rhs: wp.array2d(dtype=wp.float64)  # J D^-1 r of a residual r
        sweep_rhs: wp.array2d(dtype=wp.float64)  # right side of a Gauss-Seidel sweep
        deflation_solution: wp.array2d(dtype=wp.float64)  # inverse matrix times J D^-1 r, by sweeps
        outer_updates: wp.int32  # 1: multipliers change in the outer loop only
        penalty_ratio: wp.float64  # kappa, rho over the stiffness of the constrained slots
        rounding_limit: wp.float64  # m, largest violation that may be round-off of positions, in float32
        chain_ratio: wp.float64  # least rho over the stiffness of the stiffest row of a component, or 0

    return Multipliers


@functools.cache
def joint_struct():
    """Rows of each joint, and the child side of their entries, for reactions."""

    @wp.struct
    class Joints:
        first_row: wp.array(dtype=wp.int32)  # [joint]
        end_row: wp.array(dtype=wp.int32)  # last row + 1
        anchor: wp.array(dtype=wp.vec3d)  # [joint] reference position
        anchor_start: wp.array(dtype=wp.int32)  # [joint + 1]
        anchor_slot: wp.array(dtype=wp.int32)
        anchor_weight: wp.array(dtype=wp.float64)
        entry_role: wp.array(dtype=wp.int32)  # [entry] of a term: +-1 gradient, +-2 position; > 0: of the
        # child, < 0: of the parent of a child fixed in space, whose reaction counts; 0: not counted
        slot_position: wp.array(dtype=wp.vec3d)  # [entry] reference position of its slot, m

    return Joints


@functools.cache
def constraint_functions(dtype: str) -> KernelSet:
    """Device functions of the vectors, values and gradients of rows."""
    p = precision(dtype)
    vec3 = p.vec3
    Constraints, Multipliers = constraint_struct(), multiplier_struct()

    @wp.func
    def store_row(mul: Multipliers, state: double_2d, last_target: double_2d, world: int, row: int):
        """Store the multiplier and the right side of a row in the state."""
        state[world, row] = mul.trial_multiplier[world, row]
        last_target[world, row] = mul.target[world, row]

    @wp.func
    def term_vector(con: Constraints, term: int, x: p.vec3_2d, world: int) -> vec3d:
        """sum_k w_k x_k of a term."""
        s = vec3d()
        for k in range(con.term_start[term], con.term_start[term + 1]):
            s += con.term_weight[k] * vec3d(x[world, con.term_slot[k]])
        return s

    @wp.func
    def directional_derivative(con: Constraints, gradient: vec3d_2d, x: p.vec3_2d, world: int, row: int) -> f64:
        """(J x) of a row."""
        s = wp.dot(gradient[world, 3 * row], term_vector(con, 3 * row, x, world))
        s += wp.dot(gradient[world, 3 * row + 1], term_vector(con, 3 * row + 1, x, world))
        if con.kind[row] >= ANGLE:
            s += wp.dot(gradient[world, 3 * row + 2], term_vector(con, 3 * row + 2, x, world))
        return s

    @wp.func
    def right_side(con: Constraints, law_value: vec3d_2d, world: int, row: int) -> f64:
        """f of a row."""
        f = con.constant_target[row]
        if con.law[row] >= 0:
            f = f + law_value[world, con.law[row]][con.law_component[row]]
        return f

    @wp.func
    def store_gradients(into: vec3d_2d, world: int, row: int, G: wp.mat33d):
        """Store the output of `constraint_gradients`."""
        for side in range(3):
            into[world, 3 * row + side] = G[side]

    @wp.func
    def term_size(con: Constraints, term: int, u: p.vec3_2d, world: int) -> f64:
        """Sum of |w_k u_k| of a vector, whose round-off is that of the vector."""
        s = f64(0.0)
        for k in range(con.term_start[term], con.term_start[term + 1]):
            s += wp.length(con.term_weight[k] * vec3d(u[world, con.term_slot[k]]))
        return s

    @wp.func
    def store_value(
        con: Constraints, mul: Multipliers, u: p.vec3_2d, alpha: f64, world: int, row: int, scale: f64, f: f64, c: f64,
        size: f64,
    ):  # fmt: skip
        """Store c and f of a row, its multiplier at the trial step, and its part of the augmented potential.

        The size of that part, of which round-off is a fraction, follows the summands of c, which cancel: displacements,
        and `size`.
        """
        for term in range(3 * row, 3 * row + 3):
            size += wp.length(mul.gradient[world, term]) * term_size(con, term, u, world)
        rho = mul.penalty[world, row]
        frozen = mul.multiplier[world, row]
        new = frozen
        mul.constraint_value[world, row] = c
        mul.signed_scale[world, row] = scale
        mul.target[world, row] = f
        mul.frozen_force[world, row] = frozen + rho * c
        mul.trial_multiplier[world, row] = frozen + rho * c
        mul.penalty_force[world, row] = f64(0.0)
        if mul.outer_updates == 0:
            new = frozen + alpha * mul.multiplier_change[world, row]
            mul.trial_multiplier[world, row] = new
            mul.penalty_force[world, row] = rho * c
        penalty_energy = f64(0.5) * rho * c * c
        mul.rows[0, world, row] = frozen * c + penalty_energy
        mul.rows[1, world, row] = new * c + penalty_energy
        mul.rows[2, world, row] = wp.max(wp.abs(frozen), wp.abs(new)) * size + penalty_energy
        wp.atomic_max(mul.violation, world, mul.violation.shape[1] - 1, wp.abs(c))
        if wp.abs(c) > wp.min(f64(SINGLE_ROUNDING) * size, mul.rounding_limit):
            wp.atomic_max(mul.violation, world, con.connected_component[row], wp.abs(c))

    return kernel_set(locals())


@functools.cache
def constraint_kernels(dtype: str, midpoint: bool = False) -> KernelSet:
    """Kernels of the constraints for one precision of the slots.

    `midpoint`: rows hold at the end of a step; forces act along a midpoint gradient, (a0 + a1) / (|a0| + |a1|) of a
    distance, at the mean of the angles of a turn: the work of a step is exactly lambda times the change of c.
    """
    p = precision(dtype)
    vec3 = p.vec3
    Constraints, Multipliers, Joints = constraint_struct(), multiplier_struct(), joint_struct()
    functions = constraint_functions(dtype)
    module = kernel_module(f"constraints_{dtype}{'_midpoint' if midpoint else ''}")

    @wp.func
    def constraint_gradients(kind: int, scale: f64, f: f64, a: vec3d, b: vec3d, a2: vec3d) -> wp.mat33d:
        """dc/da, dc/db, dc/da2 as rows, linear in the vectors; of a distance a must be a unit vector."""
        if kind == DISTANCE:
            return wp.matrix_from_rows(scale * a, vec3d(), vec3d())
        if kind == ANGLE:
            s = scale * wp.sin(f)
            c = scale * wp.cos(f)
            return wp.matrix_from_rows(-s * b, c * a2 - s * a, c * b)
        return wp.matrix_from_rows(scale * b, scale * a, vec3d())

    @masked_kernel(module, "active")
    def reset_violation(active: int_1d, mul: Multipliers):
        """Reset the largest violations before an evaluation."""
        world, component = wp.tid()
        mul.violation[world, component] = f64(0.0)
        mul.stiffest[world, component] = f64(0.0)

    @wp.kernel(module=module)
    def evaluate(
        con: Constraints, u: p.vec3_2d, u_stage: p.vec3_2d, law_value: vec3d_2d, alpha: double_1d, active: int_1d,
        mul: Multipliers,
    ):  # fmt: skip
        """c at u, its gradients at u_stage; multipliers of the trial step; the rows of the augmented potential."""
        world, row = wp.tid()
        kind = con.kind[row]
        if active[world] == 0 or kind >= FORMULA:
            return
        scale = con.scale[row]
        f = functions.right_side(con, law_value, world, row)
        da = functions.term_vector(con, 3 * row, u, world)
        db = functions.term_vector(con, 3 * row + 1, u, world)
        A, B = con.reference[3 * row], con.reference[3 * row + 1]
        a = A + da
        b = B + db
        a2 = vec3d()
        c = f64(0.0)
        slope = a
        if kind == DISTANCE:
            size = wp.length(a)
            # |a| - f without cancellation when f is the reference length
            c = scale * (con.reference_product[row] - f * f + f64(2.0) * wp.dot(A, da) + wp.dot(da, da)) / (size + f)
            slope = a / size
        elif kind == ANGLE:
            a2 = con.reference[3 * row + 2] + functions.term_vector(con, 3 * row + 2, u, world)
            along = wp.sin(f) * a2 + wp.cos(f) * a
            c = scale * wp.dot(wp.cos(f) * a2 - wp.sin(f) * a, b)
            if wp.dot(along, b) < f64(0.0):
                # beyond a right angle: the sine also vanishes at a half turn, which is no solution
                c = wp.sign(c) * f64(2.0) * scale - c
                scale = -scale
            if wp.abs(f - mul.last_target[world, row]) > f64(MAX_DRIVE_ROTATION):
                c = f64(2.0) * con.scale[row]  # ambiguous number of turns: the step must be halved
        else:
            c = scale * (con.reference_product[row] - f + wp.dot(A, db) + wp.dot(da, B) + wp.dot(da, db))
        angle = f  # at which the forces act
        if wp.static(midpoint):
            functions.store_gradients(mul.end_gradient, world, row, constraint_gradients(kind, scale, f, slope, b, a2))
            middle = A + functions.term_vector(con, 3 * row, u_stage, world)
            slope = middle
            if kind == DISTANCE:
                slope = middle * (f64(2.0) / (wp.length(a) + wp.length(f64(2.0) * middle - a)))
            b = B + functions.term_vector(con, 3 * row + 1, u_stage, world)
            if kind == ANGLE:
                a2 = con.reference[3 * row + 2] + functions.term_vector(con, 3 * row + 2, u_stage, world)
                if wp.isfinite(mul.last_target[world, row]):
                    angle = f64(0.5) * (mul.last_target[world, row] + f)
        functions.store_gradients(mul.gradient, world, row, constraint_gradients(kind, scale, angle, slope, b, a2))
        functions.store_value(con, mul, u, alpha[world], world, row, scale, f, c, wp.abs(c))

    @masked_kernel(module, "active")
    def product_terms(con: Constraints, mul: Multipliers, p_in: p.vec3_2d, dq_dv: double_1d, active: int_1d):
        """Contributions to (dq/dv) (rho J^T J + sum lambda d2c/dq2) p, one vector per term."""
        world, row = wp.tid()
        kind = con.kind[row]
        a = functions.term_vector(con, 3 * row, p_in, world)
        b = functions.term_vector(con, 3 * row + 1, p_in, world)
        a2 = vec3d()
        if kind >= ANGLE:
            a2 = functions.term_vector(con, 3 * row + 2, p_in, world)
        Ga = mul.gradient[world, 3 * row]
        Gb = mul.gradient[world, 3 * row + 1]
        Gc = mul.gradient[world, 3 * row + 2]
        change = wp.dot(mul.end_gradient[world, 3 * row], a) + wp.dot(mul.end_gradient[world, 3 * row + 1], b)
        change += wp.dot(mul.end_gradient[world, 3 * row + 2], a2)
        f = mul.target[world, row]
        scale = mul.signed_scale[world, row]
        if kind == DISTANCE:
            n = Ga / scale
            size = wp.abs(mul.constraint_value[world, row] / scale + f)
            a = (a - wp.dot(n, a) * n) / size
        curvature_part = constraint_gradients(kind, scale, f, a, b, a2)
        if kind >= FORMULA:
            for side in range(3):
                k = 9 * row + 3 * side
                curvature_part[side] = (
                    mul.curvature[world, k] * a + mul.curvature[world, k + 1] * b + mul.curvature[world, k + 2] * a2
                )
        penalty_part = dq_dv[world] * mul.penalty[world, row] * change
        force = dq_dv[world] * mul.trial_multiplier[world, row]
        if wp.static(midpoint):  # the gradients move by half of the end's change
            force = f64(0.5) * force
        mul.product[world, 3 * row] = penalty_part * Ga + force * curvature_part[0]
        mul.product[world, 3 * row + 1] = penalty_part * Gb + force * curvature_part[1]
        mul.product[world, 3 * row + 2] = penalty_part * Gc + force * curvature_part[2]

    @masked_kernel(module, "active")
    def load_multipliers(state: double_2d, last_target: double_2d, active: int_1d, mul: Multipliers):
        """Warm start: multipliers and right sides of the last accepted step."""
        world, row = wp.tid()
        mul.last_target[world, row] = last_target[world, row]
        mul.multiplier[world, row] = state[world, row]
        mul.trial_multiplier[world, row] = state[world, row]
        mul.multiplier_change[world, row] = f64(0.0)
        mul.penalty[world, row] = f64(0.0)

    @masked_kernel(module, "active")
    def predict_change(
        con: Constraints, mul: Multipliers, direction: p.vec3_2d, converged: int_2d, dq_dv: double_1d, active: int_1d
    ):
        """Change of lambda in a full Newton step, rho (c + (dq/dv) J p); 0 in converged components."""
        world, row = wp.tid()
        mul.multiplier_change[world, row] = f64(0.0)
        if converged[world, con.connected_component[row]] == 0:
            change = dq_dv[world] * functions.directional_derivative(con, mul.end_gradient, direction, world, row)
            mul.multiplier_change[world, row] = mul.penalty[world, row] * (mul.constraint_value[world, row] + change)

    @masked_kernel(module, "flags")
    def accept_trial(flags: int_1d, mul: Multipliers):
        """Make the trial's multipliers those of the iterate; clear their change, for another evaluation of it."""
        world, row = wp.tid()
        mul.multiplier[world, row] = mul.trial_multiplier[world, row]
        mul.multiplier_change[world, row] = f64(0.0)

    @masked_kernel(module, "accepted")
    def store_multipliers(accepted: int_1d, mul: Multipliers, state: double_2d, last_target: double_2d):
        """Store the multipliers and right sides of an accepted step in the state."""
        world, row = wp.tid()
        functions.store_row(mul, state, last_target, world, row)

    @masked_kernel(module, "accepted")
    def work_terms(
        con: Constraints, mul: Multipliers, u: p.vec3_2d, u_n: p.vec3_2d, last_target: double_2d, accepted: int_1d
    ):
        """Work of a substep per row: of the drive, -lambda scale df, and lambda (J dq - scale df), which is lost.

        A fixed constraint does no work along the exact path, but some along a chord. `midpoint`: a driven row does the
        work of its drive alone.
        """
        world, row = wp.tid()
        moved = f64(0.0)  # J dq
        for term in range(3 * row, 3 * row + 3):
            s = vec3d()
            for k in range(con.term_start[term], con.term_start[term + 1]):
                slot = con.term_slot[k]
                s += con.term_weight[k] * vec3d(u[world, slot] - u_n[world, slot])
            moved += wp.dot(mul.gradient[world, term], s)
        driven = con.scale[row] * (mul.target[world, row] - last_target[world, row])
        if wp.static(midpoint):
            if con.law[row] >= 0:
                driven = moved
        mul.rows[0, world, row] = -mul.trial_multiplier[world, row] * driven
        mul.rows[1, world, row] = mul.trial_multiplier[world, row] * (moved - driven)

    @wp.kernel(module=module)
    def joint_report(
        con: Constraints,
        mul: Multipliers,
        joints: Joints,
        u: p.vec3_2d,
        force: double_2d,
        first_column: int,
        report: double_2d,
    ):
        """Force and moment about the anchor by each joint on its child, world axes, and its violation."""
        world, joint = wp.tid()
        anchor = joints.anchor[joint]  # current position, m
        for k in range(joints.anchor_start[joint], joints.anchor_start[joint + 1]):
            anchor += joints.anchor_weight[k] * vec3d(u[world, joints.anchor_slot[k]])
        F = vec3d()
        M = vec3d()
        violation = f64(0.0)
        for row in range(joints.first_row[joint], joints.end_row[joint]):
            violation = wp.max(violation, wp.abs(mul.constraint_value[world, row]))
            for term in range(3 * row, 3 * row + 3):
                for k in range(con.term_start[term], con.term_start[term + 1]):
                    role = joints.entry_role[k]
                    if role != 0:
                        f = -(force[world, row] * con.term_weight[k]) * mul.gradient[world, term]
                        f = f64(wp.sign(role)) * f
                        arm = joints.slot_position[k] + vec3d(u[world, con.term_slot[k]])
                        if wp.abs(role) == 2:
                            arm = arm - anchor
                            F += f
                        M += wp.cross(arm, f)
        column = first_column + JOINT_COLUMNS * joint
        for c in range(3):
            report[world, column + c] = F[c]
            report[world, column + 3 + c] = M[c]
        report[world, column + 6] = violation

    return kernel_set(locals())
