"""Errors in user code, reported with file and line."""

import traceback
from collections.abc import Iterator
from contextlib import contextmanager

from .errors import Error, ModelError

__all__ = ["convert_user_errors"]


@contextmanager
def convert_user_errors(what: str) -> Iterator[None]:
    """Convert an error of the user code within to a ModelError about `what`; errors of warpfea pass."""
    try:
        yield
    except (Error, NotImplementedError):
        raise
    except (Exception, SystemExit) as error:
        last = traceback.extract_tb(error.__traceback__)[-1]
        raise ModelError(f"{what}: {type(error).__name__}: {error} ({last.filename}:{last.lineno})") from error
