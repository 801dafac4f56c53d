"""Runs inside PyTorch's autograd: `wf.torch.rollout`. Importing this module does not import torch."""

from __future__ import annotations

import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import warp as wp

from ..base.errors import ModelError
from ..base.names import listing
from ..model.state import State
from .adjoint import INITIAL, Adjoint
from .simulation import Simulation

__all__ = ["Trajectory", "rollout"]


@dataclass(frozen=True, eq=False)
class Trajectory:
    """Tensors (worlds, steps, 3) of a probe at the ends of the steps, float64 on the model's device, m and m/s."""

    displacement: Any
    velocity: Any
    position: Any


def rollout(
    sim: Simulation,
    controls: Mapping[str, Any] | None = None,
    parameters: Mapping[str, Any] | None = None,
    state: Any = None,
    *,
    steps: int | None = None,
    tol: float = 1e-10,
) -> dict[str, Trajectory]:
    """Reset a simulation, run it, and return its probes by name, differentiable by the given tensors that require it.

    The way back of an earlier rollout repeats it first.

    Args:
        sim: as of `wf.Adjoint`; it is advanced in place.
        controls: by name, (worlds, steps, size), or what broadcasts to it.
        parameters: by name, (worlds,), of gravity (worlds, 3), or what broadcasts to it; as of `Model.set_parameter`.
        state: the start: displacements and velocities (worlds, slots, 3), or a state; None: the model's initial one.
        steps: their number; None: that of the controls.
        tol: as of `wf.Adjoint`.

    Raises:
        ModelError: torch is not installed, another shape, or as `wf.Adjoint`. ConvergenceError: as `Adjoint.run` and
            `Adjoint.backward`.
    """
    torch = _torch()
    m, controls, parameters = sim.model, controls or {}, parameters or {}
    start: dict[str, Any] = {} if state is None or isinstance(state, State) else dict(zip(INITIAL, state))
    place = {"dtype": torch.float64, "device": wp.device_to_torch(m.device)}
    given = {name: torch.as_tensor(value, **place) for name, value in {**controls, **parameters, **start}.items()}
    if steps is None and (flat := [name for name in controls if given[name].ndim < 2]):
        raise ModelError(f"rollout: controls are ([worlds,] steps, size); give steps= for {listing(flat)}")
    lengths = {given[name].shape[-2] for name in controls} if steps is None else {steps}
    if len(lengths) != 1:
        raise ModelError(f"rollout: the number of steps is not clear from the controls: {sorted(lengths)}; give steps=")
    (count,) = lengths
    shapes: dict[str, tuple[int, ...]] = {name: (m.worlds, count, sim.controls[name].shape[1]) for name in controls}
    shapes |= {name: (m.worlds, 3) if name == "gravity" else (m.worlds,) for name in parameters}
    shapes |= {name: (m.worlds, m.slots, 3) for name in start}
    try:
        tensors = [torch.broadcast_to(given[name], shape) for name, shape in shapes.items()]
    except RuntimeError as error:
        raise ModelError(f"rollout: takes {shapes}, got { {n: tuple(t.shape) for n, t in given.items()} }") from error
    names = [name for name, tensor in zip(shapes, tensors) if tensor.requires_grad] or [INITIAL[1]]
    tapes = vars(sim).setdefault("rollout_tapes", {})  # the kernels of a tape are loaded, its steps recorded once
    tape = tapes.get((*names, tol)) or tapes.setdefault((*names, tol), Adjoint(sim, names, tol=tol))

    def run(names: list[str], tensors: Sequence[Any]) -> None:
        values: dict[str, Any] = {name: wp.from_torch(x.detach().contiguous()) for name, x in zip(names, tensors)}
        for name in parameters:
            m.set_parameter(name, values[name])
        _reset(sim, state if isinstance(state, State) else None, {name: values[name] for name in start})
        tape.clear()
        for k in range(count):
            for name in controls:
                sim.controls[name].assign(values[name][:, k])
            tape.run(1)
        vars(sim)["rollout_latest"] = tape.kept

    probes = [probe.name for probe in m.description.probes]
    out = _function().apply(tape, run, list(shapes), names, probes, *tensors)
    return {name: Trajectory(*out[3 * k : 3 * k + 3]) for k, name in enumerate(probes)}


def _torch() -> Any:
    try:
        import torch
    except ImportError as error:
        raise ModelError(f"wf.torch needs PyTorch: pip install 'warpfea[torch]' ({error})") from error
    return torch


def _reset(sim: Simulation, state: State | None, start: dict[str, wp.array]) -> None:
    """Reset all worlds, to the initial state with the given displacements and velocities."""
    everyone = wp.ones(sim.model.worlds, dtype=wp.int32, device=sim.model.device)
    sim.reset(everyone if state is None else None, state)
    if start:
        source = sim.state.copy()
        for name, array in start.items():
            wp.copy(getattr(source, name.rpartition(".")[2]), array.view(sim.model.types.vec3))
        sim.reset(everyone, source)


@functools.cache
def _function() -> Any:
    """The autograd.Function of a rollout; defined here, so that torch is imported on use."""
    torch = _torch()

    base: Any = torch.autograd.Function

    class Rollout(base):
        @staticmethod
        def forward(ctx, tape, run, given, names, probes, *tensors):
            run(given, tensors)
            ctx.more, ctx.kept = (tape, run, given, names, probes), tape.kept
            ctx.save_for_backward(*tensors)
            arrays = (array for name in probes for array in tape.probe(name).arrays)
            return tuple(wp.to_torch(array, requires_grad=False) for array in arrays)

        @staticmethod
        @torch.autograd.function.once_differentiable
        def backward(ctx, *bars):
            tape, run, given, names, probes = ctx.more
            if vars(tape.sim)["rollout_latest"] is not ctx.kept:  # another may have set parameters
                run(given, ctx.saved_tensors)
            for array, bar in zip((array for name in probes for array in tape.probe(name).arrays), bars):
                wp.to_torch(array.grad).copy_(bar)
            g = {name: wp.to_torch(array) for name, array in tape.backward().items()}
            return (None,) * 5 + tuple(g[name] if name in names else None for name in given)

    return Rollout
