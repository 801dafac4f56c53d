"""Step loop of a run: outputs, Ctrl-C, progress bar."""

from __future__ import annotations

import contextlib
import signal
import sys
import time as clock
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from ..base.writer import check_distinct
from ..kernels.step.step_control import STATUS

__all__ = ["interruptible", "run_steps", "step_bar"]


def run_steps(
    sim: Any,
    total: int,
    t_end: float,
    outputs: Sequence[Any],
    on_step: Callable[[Any], Any] | None,
    progress: bool | None,
) -> None:
    """Take `total` steps with outputs; see Simulation.run.

    Raises:
        KeyboardInterrupt: Ctrl-C with steps left; outputs are closed.
    """
    check_distinct(outputs)
    opened: list[Any] = []
    cut = False

    def call_each(do: Callable[[Any], Any], outs: Sequence[Any]) -> None:
        began = clock.perf_counter()
        try:
            for out in outs:
                do(out)
        finally:
            sim.output_s += clock.perf_counter() - began

    def open_output(out: Any) -> None:
        opened.append(out)
        out.open(sim)

    with interruptible() as interrupted, step_bar(total, t_end, progress, static=sim.load is not None) as bar:
        try:
            call_each(open_output, outputs)
            call_each(lambda out: out.write(sim), opened)
        except BaseException:  # interrupted before the first step: discard the files
            for out in opened:
                out.abort()
            raise
        try:
            for done in range(1, total + 1):
                report = sim.step()
                call_each(lambda out: out.write(sim), opened)
                bar(report)
                answer = None if on_step is None else on_step(sim)
                if isinstance(answer, (bool, np.bool_)) and not answer:
                    break
                cut = interrupted() and done < total
                if cut or (report.status != STATUS["running"]).all():
                    break
        except BaseException:
            close_all(opened, sim)
            raise
        call_each(lambda out: close_all(out, sim, quiet=False), [opened])
        if cut:
            raise KeyboardInterrupt


def close_all(opened: list[Any], sim: Any, *, quiet: bool = True) -> None:
    """Close all outputs, also after a failure or interruption; then raise the first error, unless `quiet`.

    Ctrl-C, which abandons the output being closed, is always raised.
    """
    failed: BaseException | None = None
    for out in opened:
        try:
            out.close(sim)
        except Exception as error:
            failed = failed or error
        except BaseException as error:
            failed, quiet = error, False
    if failed and not quiet:
        raise failed


@contextlib.contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Ctrl-C sets a flag instead of interrupting a step; a second one interrupts at once."""
    hit = [False]

    def handler(*_: Any) -> None:
        if hit[0]:
            raise KeyboardInterrupt
        hit[0] = True

    try:
        old = signal.signal(signal.SIGINT, handler)
    except ValueError:  # not in the main thread
        yield lambda: False
        return
    try:
        yield lambda: hit[0]
    finally:
        signal.signal(signal.SIGINT, old)


@contextlib.contextmanager
def step_bar(
    total: int, t_end: float, progress: bool | None, *, static: bool = False
) -> Iterator[Callable[[Any], None]]:
    """Progress bar on stderr with time or load, and iterations; None: if stderr is a terminal."""
    if progress is None:
        progress = sys.stderr.isatty()
    if not progress:
        yield lambda report: None
        return
    from tqdm import tqdm

    with tqdm(total=total, unit="step", dynamic_ncols=True) as bar:

        def update(report: Any) -> None:
            now = report.time.min()
            bar.set_description(f"load {100.0 * now:.4g} %" if static else f"t {now:.4g}/{t_end:g} s", refresh=False)
            bar.set_postfix_str(f"newton {report.newton.max()} pcg {report.pcg.max()}", refresh=False)
            bar.update()

        yield update
