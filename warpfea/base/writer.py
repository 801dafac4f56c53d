"""Output protocol and atomic file writing."""

import contextlib
import itertools
import os
import pathlib
from collections.abc import Callable, Iterator, Sequence
from typing import Any

from .errors import OutputError
from .renamed import check_members

__all__ = [
    "Output", "aborted_on_error", "check_distinct", "check_folder", "check_target", "make_folder", "register_writer",
    "temporary_path", "write_atomically", "writer_for",
]  # fmt: skip


class Output:
    """A writer of results, called by `Simulation.run`: open, write ..., close.

    `write` is called once for the initial state and after each accepted step; the writer decides if a frame is due.
    `close` completes the file, also after an interrupted run. `abort` discards the output of the run and keeps an
    older target file. A writer may be reopened after either.

    Adaptive steps end where a frame is due: `rate` is frames per simulated second, None without a rate; `output_times`
    are single times, s. `animates`: its file has more than one frame. By default `open`, `close`, `abort` do nothing.
    """

    rate: float | None = None
    animates: bool = True
    output_times: Sequence[float] = ()

    def __init_subclass__(cls, **options: Any) -> None:
        """Refuse members by former names, see base/renamed.py."""
        super().__init_subclass__(**options)
        check_members(cls, Output)

    def open(self, sim: Any) -> None:
        """Check the target and start. OutputError if the target can't be written."""

    def write(self, sim: Any) -> None:
        """Write the current state if a frame is due."""
        raise NotImplementedError

    def close(self, sim: Any) -> None:
        """Finish; the target is complete and valid afterwards. OutputError otherwise."""

    def abort(self) -> None:
        """Remove temporary files; no effect if not open."""


WRITERS: dict[str, Callable[..., Any]] = {}
"""Functions (path, fields, **options) that make the writer of one file, by suffix."""


def register_writer(make: Callable[..., Any], *suffixes: str) -> None:
    """Let `writer_for` make writers of files with these suffixes."""
    WRITERS.update(dict.fromkeys(suffixes, make))


def writer_for(path: str | os.PathLike[str], fields: Sequence[str], **options: Any) -> Any:
    """The writer of a file by its suffix; the first of the fields is shown. OutputError for another suffix."""
    suffix = pathlib.Path(path).suffix.lower()
    if suffix not in WRITERS:
        raise OutputError(f"{path}: the file name must end in one of {', '.join(sorted(WRITERS))}")
    return WRITERS[suffix](path, fields, **options)


@contextlib.contextmanager
def aborted_on_error(writer: Any) -> Iterator[None]:
    """Discard what a writer began if the block raises."""
    try:
        yield
    except BaseException:
        writer.abort()
        raise


VIEWERS: list[Callable[..., None]] = []
"""Function (model, path, **options) that draws a model at its initial state, once writers are there."""

_counter = itertools.count()


def check_target(path: str | os.PathLike[str], suffixes: Sequence[str]) -> pathlib.Path:
    """The target as a path. OutputError unless it ends in one of `suffixes` and its folder can be written."""
    target = pathlib.Path(path)
    if target.suffix.lower() not in suffixes:
        raise OutputError(f"{target}: the file name must end in {' or '.join(suffixes)}")
    if target.is_dir():
        raise OutputError(f"{target}: is a folder, not a file")
    check_folder(target.parent, target)
    return target


def check_distinct(outputs: Sequence[Any]) -> None:
    """OutputError for two outputs to one file or folder, of which the last would be left."""
    targets = [getattr(out, "path", None) or getattr(out, "folder", None) for out in outputs]
    paths = [pathlib.Path(target).resolve() for target in targets if isinstance(target, (str, os.PathLike))]
    for k, path in enumerate(paths):
        if path in paths[:k]:
            raise OutputError(f"{path}: two outputs write to it; give each its own")


def check_folder(folder: pathlib.Path, target: pathlib.Path) -> None:
    """OutputError naming `target` unless `folder` exists and is writable."""
    if not folder.is_dir():
        raise OutputError(f"{target}: the folder {folder} does not exist")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"{target}: the folder {folder} is not writable")
    probe = folder / temporary_path(target).name
    try:  # a full disk or a read-only file system is detected only by writing
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OutputError(f"{target}: cannot write to folder {folder} ({error.strerror or error})") from error


def make_folder(folder: str | os.PathLike[str]) -> pathlib.Path:
    """Make the folder if it is not there. OutputError for one that can't be written, or is a file."""
    path = pathlib.Path(folder)
    try:
        if path.exists() and not path.is_dir():
            raise OutputError(f"{path}: is a file, not a folder")
        check_folder(path if path.exists() else path.parent, path)
        path.mkdir(exist_ok=True)
    except OSError as error:
        raise OutputError(f"{path}: can't be made ({error})") from error
    return path


def temporary_path(target: pathlib.Path) -> pathlib.Path:
    """An unused hidden name in the target's folder with the target's suffix."""
    return target.with_name(f".{target.stem}.{os.getpid()}-{next(_counter)}.part{target.suffix}")


def write_atomically(target: pathlib.Path, write: Callable[[pathlib.Path], object]) -> None:
    """Call `write(temporary)` and rename the result to `target`. OutputError for errors of the system."""
    temporary = temporary_path(target)
    try:
        write(temporary)
        os.replace(temporary, target)
    except OSError as error:
        raise OutputError(f"{target}: can't be written ({error})") from error
    finally:
        temporary.unlink(missing_ok=True)
