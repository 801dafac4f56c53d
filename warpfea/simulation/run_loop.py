"""Around the step loop: closing outputs, Ctrl-C, the progress bar."""

from __future__ import annotations

import contextlib
import signal
import sys
from collections.abc import Callable, Iterator
from typing import Any

__all__ = ["close_all", "interruptible", "step_bar"]


def close_all(opened: list[Any], sim: Any, *, quiet: bool = True) -> None:
    """Close all, also after one has failed; then raise the first error, unless `quiet`."""
    failed: Exception | None = None
    for out in opened:
        try:
            out.close(sim)
        except Exception as error:
            failed = failed or error
    if failed and not quiet:
        raise failed


@contextlib.contextmanager
def interruptible() -> Iterator[Callable[[], bool]]:
    """Ctrl-C sets a flag instead of breaking a step; a second one breaks at once."""
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
def step_bar(total: int, t_end: float, progress: bool | None) -> Iterator[Callable[[Any], None]]:
    if progress is None:
        progress = sys.stderr.isatty()
    if not progress:
        yield lambda report: None
        return
    from tqdm import tqdm

    with tqdm(total=total, unit="step", dynamic_ncols=True) as bar:

        def update(report: Any) -> None:
            bar.set_description(f"t {report.time.min():.4g}/{t_end:g} s", refresh=False)
            bar.set_postfix_str(f"newton {report.newton.max()} pcg {report.pcg.max()}", refresh=False)
            bar.update()

        yield update
