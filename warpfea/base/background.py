"""Calls in another thread, one after the other, so that a run goes on while its files are written."""

import collections
import concurrent.futures
from collections.abc import Callable
from typing import Any

__all__ = ["Background"]

MAX_WAITING = 8
"""Bound of the calls that wait, and so of the memory of their arguments."""


class Background:
    """Calls in their order in one thread.

    An error of a call is raised by a later `call` or by `finish`; those that wait behind it are left out.
    """

    def __init__(self) -> None:
        self._thread: concurrent.futures.ThreadPoolExecutor | None = None
        self._waiting: collections.deque[concurrent.futures.Future[Any]] = collections.deque()

    def call(self, function: Callable[..., Any], *arguments: Any) -> None:
        """Have a function called once those before it are done; waits while many are not."""
        while self._waiting and (len(self._waiting) >= MAX_WAITING or self._waiting[0].done()):
            self._waiting.popleft().result()
        self._thread = self._thread or concurrent.futures.ThreadPoolExecutor(1)
        self._waiting.append(self._thread.submit(self._unless_failed, list(self._waiting), function, arguments))

    @staticmethod
    def _unless_failed(before: list[Any], function: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
        if all(call.exception() is None for call in before):
            function(*arguments)

    def finish(self) -> None:
        """Wait for all calls."""
        try:
            while self._waiting:
                self._waiting.popleft().result()
        finally:
            self.stop()

    def stop(self) -> None:
        """Drop the calls that have not begun, wait for the one that runs, and end the thread."""
        for call in self._waiting:
            call.cancel()
        self._waiting.clear()
        if self._thread is not None:
            self._thread.shutdown()
        self._thread = None
