"""The operator H v of a model at a state of small random displacements, with backward Euler's factors for DT."""

import numpy as np
import warp as wp

from warpfea.simulation.simulation import Simulation
from warpfea.studies.bench.measure import solver
from warpfea.studies.bench.problems import DENSITY

DT = 1e-3
DISPLACEMENT = 1e-4
"""Over the size of an element."""


def prepare(model, operator):
    """A simulation, and its residual whose operator stands at that state."""
    sim = Simulation(model, dt=DT, solver=solver(None, operator=operator), ledger=False, capture=False)
    w, residual = sim.stepper.work, sim.stepper.newton.residual
    elements = sum(len(body.mesh.cells) for body in model.bodies)
    length = (model.masses.lumped[0].sum() / DENSITY / elements) ** (1.0 / 3.0)
    scale = DISPLACEMENT * np.where(model.slot_table.is_position > 0.0, length, 1.0)
    _assign(model, w.u, scale[:, None] * _random(model, 1))
    w.step.dq_dv.fill_(DT)
    w.step.mass_factor.fill_(1.0 / DT)
    residual.assemble_matrix(wp.ones(model.worlds, dtype=wp.int32, device=model.device))
    return sim, residual


def apply(model, residual):
    """A random direction and the product with it, (worlds, slots) vectors."""
    direction, out = (wp.zeros((model.worlds, model.slots), dtype=model.types.vec3, device=model.device) for _ in "po")
    _assign(model, direction, _random(model, 2))
    residual.product(direction, out, wp.ones(model.worlds, dtype=wp.int32, device=model.device))
    return direction, out


def _random(model, seed):
    """(slots, 3) numbers, 0 where a component is prescribed."""
    return np.random.default_rng(seed).standard_normal((model.slots, 3)) * model.slot_table.free


def _assign(model, field, values):
    field.assign(np.tile(values, (model.worlds, 1, 1)).astype(model.dtype))
