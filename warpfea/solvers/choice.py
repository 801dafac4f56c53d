"""Choice of a simulation's methods: preconditioner, operator, reuse and forcing, in one function of model and options.

A GPU takes banded factors for many worlds only: 4096 pendulums of 201 unknowns take 560 000 world-steps/s with them and
315 000 with two levels, slider-cranks of 225 unknowns 77 000 and 18 700; a single pendulum 912 and 1220 steps/s.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ..base.errors import ModelError
from ..terms.protocols import Constrained, Coupled, Tied
from .band import Band, find_band, fits_thread_block
from .jacobi import Jacobi
from .matrix_assembly import MAX_FULL_FACTOR_SLOTS
from .newton import NewtonPCG
from .plan import BLOCK_PRECONDITIONERS, SolverPlan
from .rigid_body_modes import mode_bodies

if TYPE_CHECKING:
    from ..model.model import Model

__all__ = ["check_plan", "choose_adjoint_operator", "choose_solver"]

SMALL_BODY_SLOTS = 64
"""Mean number of slots of a body below which bodies on joints take block Jacobi."""
MAX_MATRIX_FREE_SLOTS = 10
"""Slots per element up to which H p from elements is cheaper than from their matrix, on a GPU."""
MAX_FAST_ASSEMBLY_SLOTS = 16384
"""Slots up to which a GPU assembles a matrix faster than it solves with one."""
MATRIX_REBUILD_COST = {False: 2.0, True: 0.5}
"""Assembly cost in Newton iterations, on the CPU and on CUDA."""
BAND_REBUILD_COST = 3.0
"""Assembly cost in Newton iterations of matrices factored in a band on a GPU. 4096 pendulums take 8.5, 8.1 and 8.2 ms
per step with 0.5, 1.5 and 3 at a tolerance of 1e-8, and 6.9, 5.7 and 4.2 ms at 1e-4."""
REBUILD_COST = 40.0
"""Setup cost of the two-level preconditioner, in PCG iterations."""
COUPLED_REBUILD_COST = 10.0
"""The same where terms couple bodies, as contacts change: a pile of ten cubes of 4^3 cells takes 86 PCG iterations and
0.95 builds per step with 40, 70 and 1.7 with 10, no fewer with 5 or 2."""
JACOBI_REBUILD_COST = 10.0
"""Extra iterations of Jacobi's descent that trigger a rebuild of its B: fewer than for Newton's method, since an old B
costs accuracy here, not time. Of 5, 10, 20 and 40 on soft bars in large rotations, 40 saves a tenth of the time at up
to 70 times the error."""


def choose_solver(
    model: Model,
    device: Any,
    many: bool = False,
    *,
    options: NewtonPCG | Jacobi | None = None,
    scheme: str = "dynamics",
) -> SolverPlan:
    """Methods for a model on a device, whose `is_cuda` alone counts; `many`: of many worlds.

    Raises:
        ModelError: an option that is not for this model or device.
    """
    given = NewtonPCG() if options is None else options
    jacobi = isinstance(given, Jacobi)
    newton = given.newton_options if isinstance(given, Jacobi) else given
    direct, on_cuda, static = newton.linear == "direct", device.is_cuda, scheme == "statics"
    if jacobi or direct:
        refuse_couplings(model, "Jacobi" if jacobi else "NewtonPCG(linear='direct')")
    kind = "factors" if direct else choose_preconditioner(model, newton, on_cuda, many)
    band = (find_band(model) or find_band(model, any_width=True)) if kind == "banded" else None
    storage = newton.preconditioner_dtype or model.dtype
    operator = choose_operator(model, newton, kind, scheme, on_cuda)
    reuse = choose_matrix_reuse(model, scheme, on_cuda) if operator == "matrix" else 0
    factors = operator == "matrix" and _factors_operator(model, kind, storage, band, static, on_cuda, reuse)
    free = model.components.free_group_count > 0  # bodies whose momentum is conserved by the translation correction
    modes = kind not in ("factors", *BLOCK_PRECONDITIONERS) and bool(mode_bodies(model))
    cost = COUPLED_REBUILD_COST if modes else REBUILD_COST
    cost = band.rebuild_cost if band is not None and not factors else cost
    return SolverPlan(
        solver="jacobi" if jacobi else "newton-pcg",
        linear=newton.linear,
        krylov="bicgstab" if scheme == "midpoint" else "pcg",
        preconditioner=kind,
        storage=storage,
        half_bandwidth=band.half_bandwidth if band is not None else 0,
        body_modes=modes,
        rebuild_cost=JACOBI_REBUILD_COST if jacobi else cost,
        operator=operator,
        matrix_reuse_level=reuse,
        matrix_rebuild_cost=BAND_REBUILD_COST if on_cuda and band is not None else MATRIX_REBUILD_COST[on_cuda],
        factors_operator=factors,
        exact=factors and band is not None and model.dtype == "float64" and not static and not free,
        first_forcing=_first_forcing(model, newton, kind, static),
        scheme=scheme,
        dtype=model.dtype,
        on_cuda=on_cuda,
    )


def choose_preconditioner(model: Model, options: NewtonPCG, on_cuda: bool, many: bool) -> str:
    """Name of the preconditioner: banded factors for a narrow band, else block Jacobi if bodies on joints are too small
    for several groups of nodes.

    Raises:
        ModelError: "banded" for a larger model on a GPU, or with a storage precision other than the model's.
    """
    name, storage = options.preconditioner, options.preconditioner_dtype
    kept = storage in (None, model.dtype)
    banded = kept and (not on_cuda or fits_thread_block(find_band(model), model))
    if name == "banded" and kept and not banded:
        raise ModelError(
            "NewtonPCG: preconditioner = 'banded' is for the CPU, and on a GPU for small models with a narrow band; "
            f"for this one on {model.device} take 'auto' or 'two-level'"
        )
    if name == "banded" and not banded:
        raise ModelError(
            f"NewtonPCG: preconditioner = 'banded' keeps its factors in the model's precision, {model.dtype}: leave "
            f"out preconditioner_dtype = {storage!r}, or take 'two-level'"
        )
    if name != "auto":
        return name
    if banded and (many or not on_cuda) and find_band(model) is not None:
        return "banded"
    small = model.slots < SMALL_BODY_SLOTS * (int(model.components.mesh_of_slot.max()) + 1)
    deflated = model.terms.traits.has_constraints and small and model.slots > MAX_FULL_FACTOR_SLOTS
    return "deflated" if deflated else "two-level"


def choose_operator(model: Model, options: NewtonPCG, kind: str, scheme: str, on_cuda: bool) -> str:
    """Source of the products H p.

    Elements with many points per slot cost more than their matrix. On the CPU it is used whenever the preconditioner
    needs one anyway: one core assembles H in the time of 2 to 7 products of ANCF elements, and of 15 of straight
    tetrahedra. An equilibrium takes few products per iterate, and fewer iterates with the predicted stress.
    """
    cheaper = any(block.slots > MAX_MATRIX_FREE_SLOTS or block.key.tying for block in model.blocks)
    if not on_cuda:
        cheaper = kind not in BLOCK_PRECONDITIONERS
    elif kind == "banded":  # their factors solve with the matrix
        cheaper = True
    if kind == "factors":  # they live as long as the matrix, unless terms add to it
        cheaper = not model.terms.has_tangents
    if scheme == "midpoint":  # symmetric matrix, unsymmetric operator of a mid-point step
        cheaper = False
    if options.operator == "matrix" or (options.operator == "auto" and cheaper):
        return "matrix"
    if scheme == "statics":
        return "predicted stress"
    return "clusters" if all(block.with_mass for block in model.blocks) else "elements"


def choose_adjoint_operator(model: Model, plan: SolverPlan, on_cuda: bool) -> str:
    """Option `operator` of the adjoint of steps with a plan, whose matrix would be that of each step.

    Beside banded factors kept over steps a solve takes 3 to 8 products. A matrix of T10 costs as much as 15; one of T4
    less than the solve. One of beams costs less than their products on a CPU, and more on a GPU (a step back of 4096
    pendulums on an H200: 5.1 ms with it, 4.6 ms without).
    """
    cheaper = all((block.with_mass or on_cuda) and block.slots > 4 for block in model.blocks)
    kept = plan.preconditioner == "banded" and not model.terms.traits.constraint_rows
    return "elements" if cheaper and kept else "auto"


def choose_matrix_reuse(model: Model, scheme: str, on_cuda: bool) -> int:
    """Reuse of the operator's matrix: 0 none, 1 over the iterates of a step, 2 also over steps.

    Not over steps in statics (large steps) nor with damping (the viscous stress is no function of the state of a
    resumed run); not at all with constraints of elastic bodies (their forces are only as accurate as the solve); a GPU
    assembles a small matrix at negligible cost.
    """
    if model.terms.traits.has_constraints and _constrains_elements(model):
        return 0
    damped = scheme == "midpoint" or any(block.key.damping in ("incremental", "rate") for block in model.blocks)
    small = on_cuda and model.slots <= MAX_FAST_ASSEMBLY_SLOTS
    return 2 if scheme != "statics" and not damped else 0 if small else 1


def _constrains_elements(model: Model) -> bool:
    """False if constraints tie slots of rigid parts alone, beside elastic bodies."""
    constrained = model.terms.having(Constrained)
    if not all(isinstance(term, Tied) for term in constrained):
        return True
    elastic = [block.connectivity.ravel() for block in model.blocks if not block.host_blocks[0].body.family.rigid]
    tied = [slots for term in constrained for slots in term.tied_slots()]
    return not elastic or bool(np.isin(np.concatenate(tied), np.concatenate(elastic)).any())


def _factors_operator(
    model: Model, kind: str, storage: str, band: Band | None, static: bool, on_cuda: bool, reuse: int
) -> bool:
    """True for factors of the operator's matrix: if cheap, or for static equilibria of beams (the preconditioner's own
    matrix then only serves D); wider bands are reused for longer."""
    traits = model.terms.traits
    if kind == "factors":
        return not model.terms.has_tangents
    order = band
    if kind == "two-level" and storage == model.dtype and static and model.slots <= MAX_FULL_FACTOR_SLOTS:
        order = find_band(model)
    # (a GPU factors the band of a small model, joint terms included, in about the time of its matrix)
    quick = order is not None and (order.cheap_to_factorise or (band is not None and on_cuda))
    whole = not (traits.pooled or traits.constraint_rows) or (on_cuda and not traits.pooled and reuse == 0)
    return quick and whole and not traits.tangent


def _first_forcing(model: Model, options: NewtonPCG, kind: str, static: bool) -> float:
    """Forcing term of the first solve.

    A good preconditioner makes a decade of PCG cheaper than another Newton iteration (in statics the first iterates are
    far off: solving them tightly is wasted).
    """
    if options.forcing is not None:
        return options.forcing
    out = 0.1 if kind in BLOCK_PRECONDITIONERS or static else 0.001
    # constraints are stiff: a loose first solve costs more iterations than it saves
    return min(out, 0.01) if model.terms.traits.has_constraints else out


def check_plan(plan: SolverPlan, model: Model, options: NewtonPCG | Jacobi, scheme: str) -> None:
    """Raise ModelError for a plan that does not fit the model, the solver's options or the scheme."""
    if not isinstance(plan, SolverPlan):
        raise ModelError(f"plan = {plan!r} must be a SolverPlan, as `plan` of a Simulation")
    own = options
    if isinstance(own, NewtonPCG) and own.operator == "auto":  # what the options leave open
        own = replace(own, operator="matrix" if plan.uses_matrix else "elements")
    if isinstance(own, NewtonPCG) and own.preconditioner == "auto" and "direct" not in (own.linear, plan.linear):
        own = replace(own, preconditioner=plan.preconditioner)
    fitting = choose_solver(model, model.device, options=own, scheme=scheme)
    for field in fields(SolverPlan):
        found, needed = getattr(plan, field.name), getattr(fitting, field.name)
        if found != needed:
            raise ModelError(
                f"plan: {field.name} = {found!r} does not fit this simulation, which takes {needed!r}; "
                "take the plan of a simulation with the same description, device, integrator and solver options"
            )


def refuse_couplings(model: Model, name: str) -> None:
    """Raise ModelError for a term that couples bodies without a shared element: the matrix has a fixed pattern."""
    found = [(term.name, couples) for term in model.terms.having(Coupled) if (couples := term.coupled_bodies())]
    if found:
        kind, couples = found[0]
        a, b = (repr(model.bodies[k].name) for k in couples[0])
        more = f" and {len(couples) - 1} more" if len(couples) > 1 else ""
        raise ModelError(
            f"{name} needs a fixed sparsity pattern, but {kind!r} couple bodies {a} and {b}{more}: use wf.NewtonPCG()"
        )
