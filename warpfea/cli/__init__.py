"""The command line: `warpfea run | scenes | info | render | bench | study | sweep | stress | profile`.

Exit codes: 0 success, 2 bad input or usage, 3 rejected step or failed case, 4 output error, 130 interrupted (files
valid), 1 internal error.
"""

import os
import sys
import warnings
from collections.abc import Sequence

from ..base.errors import ConstraintError, ConvergenceError, Error, OutputError

__all__ = ["main"]

DONE, DEFECT, BAD_INPUT, NOT_CONVERGED, OUTPUT_FAILED, INTERRUPTED = 0, 1, 2, 3, 4, 130


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command line `argv` (by default sys.argv[1:]), return the exit code. Raises with --debug only."""
    words = list(sys.argv[1:] if argv is None else argv)
    debug = "--debug" in words
    try:
        from ..base.devices import find_device  # inside the try block, so that Ctrl-C is handled
        from . import parser

        try:
            arguments = parser.parse(words)
        except SystemExit as leave:  # --help and --version
            return int(leave.code or 0)
        with warnings.catch_warnings():
            warnings.simplefilter("always", UserWarning)
            warnings.showwarning = _show_warning
            if getattr(arguments, "device", None) is not None:
                find_device(arguments.device)  # ModelError for an unknown one, before any work
            return int(arguments.command(arguments))
    except KeyboardInterrupt as stop:
        if debug:
            raise
        print(f"warpfea: interrupted{f': {stop}' if str(stop) else ''}", file=sys.stderr)
        return INTERRUPTED
    except BrokenPipeError:  # closed pipe: the reader of our output has ended
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
        return DONE
    except Exception as error:
        if debug:
            raise
        code, text = _describe(error)
        print(f"warpfea: error: {text}", file=sys.stderr)
        return code


def _describe(error: Exception) -> tuple[int, str]:
    """Exit code and one line for an error."""
    text = " ".join(str(error).split())
    if isinstance(error, (ConvergenceError, ConstraintError)):
        return NOT_CONVERGED, text
    if isinstance(error, OutputError):
        return OUTPUT_FAILED, text
    if isinstance(error, (Error, NotImplementedError)):
        return BAD_INPUT, text
    return DEFECT, f"{type(error).__name__}: {text} (a defect; --debug shows where)"


def _show_warning(message: Warning | str, *_: object, **__: object) -> None:
    print(f"warpfea: warning: {' '.join(str(message).split())}", file=sys.stderr)
