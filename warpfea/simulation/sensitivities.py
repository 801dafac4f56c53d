"""Forward sensitivities of a tape: the changes of its probes along a direction, by the steps linearised in order."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import warp as wp

from ..base.checks import float_array
from ..base.errors import ModelError
from ..base.names import listing
from ..terms.checks import overrides
from ..terms.gradients import Sensitivity
from ..terms.protocols import Differentiable
from .tape import ProbeArrays

__all__ = ["ForwardSensitivities"]


class ForwardSensitivities:
    """Tangent-linear run over the steps of a tape.

    Raises:
        ModelError: a parameter, term or scheme without one, by name.
    """

    def __init__(self, tape: Any) -> None:
        self.tape, self.model, self.solver = tape, tape.model, tape.solver
        if tape.stepper.integrator.accelerated:
            raise ModelError("Adjoint.forward: 'generalized_alpha' has no sensitivities of its initial accelerations")
        own = Differentiable.add_history_change
        for term in self.model.terms.having(Differentiable):
            backward = (Differentiable.add_history_gradient, Differentiable.linearise_adjoint)
            if any(overrides(term, method) for method in backward) and not overrides(term, own):
                raise ModelError(f"Adjoint.forward: {term.name!r} has no sensitivities of its histories")
        tape.at.prepare_forward()
        self.gradients: dict[str, list[Any]] = {
            name: [make() for make in makers] for name, makers in tape.outputs.items()
        }
        for name, found in self.gradients.items():
            if not all(isinstance(gradient, Sensitivity) for gradient in found):
                raise ModelError(f"Adjoint.forward: {name!r} has no sensitivity; take backward()")
        self.changes = {name: tape.zeros(tape.size_of(name)) for name, found in self.gradients.items() if found}
        self.updates = tape.updates
        self.graph: wp.Graph | None = None

    def run(self, direction: Mapping[str, Any]) -> dict[str, ProbeArrays]:
        """Changes of all probes along a direction."""
        tape, a, m = self.tape, self.solver, self.model
        series = self._read(direction)
        tape.begin()
        out = {name: self._empty(tape.probe(name)) for name in (p.name for p in m.description.probes)}
        for name in ("displacement", "velocity"):
            if (key := f"initial.{name}") in series:
                a.bars[name].assign(series.pop(key))
        for k in range(tape.steps):
            for name, values in series.items():
                self.changes[name].assign(values[:, k] if values.ndim == 3 else values)
            for part in reversed(tape.parts(k)):
                tape.load(part)
                self.graph = self.graph or self._capture()
                wp.capture_launch(self.graph)
            for probe in out.values():
                args = [probe.slot, probe.weight, probe.offset, a.q_bar, a.v_bar, k, *probe.arrays]
                tape.stepper.launch(a.kernels.probe_values, m.worlds, args)
        return out

    def _read(self, direction: Mapping[str, Any]) -> dict[str, np.ndarray]:
        """Changes of all parameters, as arrays of their shapes."""
        tape, m = self.tape, self.model
        unknown = [name for name in direction if name not in tape.names]
        if unknown:
            raise ModelError(f"Adjoint.forward: {unknown[0]!r} is none of the tape's: {listing(tape.names)}")
        out = {}
        for name in tape.names:
            laws = name in m.terms.time_laws.controls and not tape.static
            shape: tuple[int, ...] = (m.worlds, tape.steps) if laws else (m.worlds,)
            shape = (m.worlds, m.slots, 3) if name not in self.changes else (*shape, tape.size_of(name))
            given = direction.get(name, 0.0)
            values = float_array(given.numpy() if hasattr(given, "numpy") else given)
            if name in self.changes and shape[-1] == 1 and values.ndim == len(shape) - 1:
                values = values[..., None]
            try:
                out[name] = np.broadcast_to(values, shape)
            except ValueError:
                raise ModelError(f"Adjoint.forward: {name!r} has shape {values.shape}, not {shape}") from None
            if not np.isfinite(values).all():
                raise ModelError(f"Adjoint.forward: {name!r} has changes that are no finite numbers")
        return out

    def _empty(self, probe: ProbeArrays) -> ProbeArrays:
        arrays = [wp.zeros_like(array, requires_grad=False) for array in probe.arrays]
        return ProbeArrays(probe.slot, probe.weight, wp.vec3d(), *arrays)

    def _capture(self) -> wp.Graph:
        """Graph of one step, from the change of the state at its start."""
        tape, at = self.tape, self.tape.at

        def parameters() -> None:
            for name, found in self.gradients.items():
                for gradient in found:
                    gradient.change(at, self.changes[name])

        def histories() -> None:
            for term in self.model.terms.having(Differentiable):
                term.add_history_change(at)

        with wp.ScopedCapture(device=self.model.device) as recorded:
            tape.linearise()
            self.solver.step_forward(parameters, histories)
        return recorded.graph
