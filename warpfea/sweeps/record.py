"""Record of a sweep: an append-only file of JSON lines that alone decides which designs are done."""

from __future__ import annotations

import json
import os
import pathlib
import zlib
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from ..base.errors import CheckpointError
from .worker import Rows

__all__ = ["Record"]

SCHEMA = 1


class Record:
    """The record in a file, and what its lines say.

    Each line ends with the checksum of what precedes it. The first one holds the settings, others a design's row, the
    plan of a group of designs ("group", "plan", "device"), or tasks whose worker died ("lost": a design, "worlds").

    Args:
        path: of the file. settings: of the sweep: "measures" by name, number of "designs", and others.
        resume: go on with the file; None: if it is there.

    Attributes:
        done: (count,) flags of designs that have ended. values: (measures, count), NaN without one.
        failures: status, not "done", and reason by design.
        retries: number of lost tasks. deaths: of the worker of a design alone. plans: plan and device by group.

    Raises:
        CheckpointError: a file of another sweep, with a damaged line, in use, or there without `resume`.
    """

    def __init__(self, path: pathlib.Path, settings: Mapping[str, Any], *, resume: bool) -> None:
        self.path, self.measures = path, tuple(settings["measures"])
        self.count = count = settings["designs"]
        self.done, self.values = np.zeros(count, dtype=bool), np.full((len(self.measures), count), np.nan)
        self._rows = dict(zip(self.measures, self.values))
        self.failures, self.retries = dict[int, tuple[str, str]](), 0
        self.deaths, self.plans = dict[int, int](), dict[str, dict[str, Any]]()
        try:
            self._file = open(path, "a+b")  # noqa: SIM115
        except OSError as error:
            raise CheckpointError(f"{path}: can't be opened ({error})") from error
        try:
            self._lock()
            self._file.seek(0)
            if not resume and (lines := self._file.readlines(1 << 20)):
                content = _decode(lines[0]) or {}
                if len(lines) > 1 or content.get("schema") != SCHEMA or "settings" not in content:
                    raise CheckpointError(
                        f"{path}: is there; go on with it (resume=True, --resume) or take another folder"
                    )
                self._file.truncate(0)  # settings without a row, of a sweep that was refused
            size = self._read(json.loads(json.dumps(settings)))
            self._file.truncate(size)
            if size == 0:
                self.append({"schema": SCHEMA, "settings": settings})
                _sync_folder(path.parent)
        except BaseException:
            self._file.close()
            raise

    def _lock(self) -> None:
        """Refuse a second driver; the system frees the lock of one that died."""
        try:
            import fcntl
        except ImportError:  # not on Windows
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            raise CheckpointError(f"{self.path}: another sweep is writing it") from error

    def _read(self, settings: dict[str, Any]) -> int:
        """Read the lines that are there; returns the size up to a torn last one."""
        self._file.seek(0)
        offset = 0
        for number, line in enumerate(self._file, 1):
            content = _decode(line)
            if not line.endswith(b"\n"):  # torn: it is the last
                break
            if content is None:
                raise CheckpointError(
                    f"{self.path}: line {number} is damaged; restore the file, or begin anew in another folder"
                )
            if number == 1:
                self._check_settings(content, settings)
            else:
                self._note(content, number)
            offset += len(line)
        return offset

    def _check_settings(self, content: dict[str, Any], settings: dict[str, Any]) -> None:
        found = content.get("settings")
        if content.get("schema") != SCHEMA or not isinstance(found, dict):
            raise CheckpointError(f"{self.path}: is no record of a sweep that this version reads")
        for name in dict.fromkeys([*settings, *found]):
            if found.get(name) != settings.get(name):
                raise CheckpointError(
                    f"{self.path}: is of another sweep: {name} was {found.get(name)!r}, is {settings.get(name)!r}"
                )

    def _note(self, content: Mapping[str, Any], number: int) -> None:
        """Take account of a line."""
        if "group" in content:
            self.plans[content["group"]] = {"plan": content["plan"], "device": content["device"]}
            return
        index = content.get("lost", content.get("design"))
        if not (isinstance(index, int) and 0 <= index < self.count):
            raise CheckpointError(f"{self.path}: line {number} names a design that there is not: {index}")
        if "lost" in content:
            self.retries += 1
            if content["worlds"] == 1:
                self.deaths[index] = self.deaths.get(index, 0) + 1
        elif self.done[index]:
            raise CheckpointError(f"{self.path}: line {number} repeats design {index}")
        else:
            self.done[index] = True
            for name, value in content["values"].items():
                if value is not None:
                    self._rows[name][index] = value
            if content["status"] != "done":
                self.failures[index] = content["status"], content["reason"]

    def append(self, *lines: Mapping[str, Any], rows: Rows | None = None) -> None:
        """Write lines, then rows, to the disk. CheckpointError."""
        for line in lines:
            if "settings" not in line:
                self._note(line, 0)
        texts = list(map(json.dumps, lines))
        if rows is not None:
            self._note_rows(rows)
            texts += _lines(rows)
        try:
            self._file.write(b"".join(map(_encode, texts)))
            self._file.flush()
            os.fsync(self._file.fileno())
        except OSError as error:
            raise CheckpointError(f"{self.path}: can't be written ({error})") from error

    def _note_rows(self, rows: Rows) -> None:
        """Take account of rows."""
        design, status, reason = (rows.columns[name] for name in ("design", "status", "reason"))
        self.done[design] = True
        self.values[:, design] = np.array([rows.values[name] for name in self.measures], dtype=float)  # None: NaN
        self.failures |= {k: (how, why) for k, how, why in zip(design, status, reason) if how != "done"}

    def close(self) -> None:
        """Close the file. CheckpointError."""
        try:
            self._file.close()
        except OSError as error:  # lines that a full disk refused before
            raise CheckpointError(f"{self.path}: can't be written ({error})") from error


def _sync_folder(folder: pathlib.Path) -> None:
    """Have the name of a new file on the disk."""
    if os.name == "posix":
        number = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(number)
        finally:
            os.close(number)


def _lines(rows: Rows) -> Iterable[str]:
    """Lines of rows in JSON: nothing in them depends on batch or worker."""
    numbers = [json.dumps(column)[1:-1].split(", ") for column in (rows.columns["design"], *rows.values.values())]
    status, reason = (rows.columns[name] for name in ("status", "reason"))
    texts = {text: json.dumps(text) for text in {*status, *reason}}  # many designs have the same
    values = ", ".join(json.dumps(name).replace("%", "%%") + ": %s" for name in rows.values)
    line = f'{{"design": %s, "values": {{{values}}}, "status": %s, "reason": %s}}'
    return map(line.__mod__, zip(*numbers, map(texts.__getitem__, status), map(texts.__getitem__, reason)))


def _encode(line: str) -> bytes:
    """A line with its checksum, which JSON readers see as one more key."""
    body = line[:-1].encode()
    return body + b', "crc": "%08x"}\n' % zlib.crc32(body)


def _decode(line: bytes) -> dict[str, Any] | None:
    """Content of a line, None for a damaged one."""
    body, _, end = line.rpartition(b', "crc": "')
    if end != b'%08x"}\n' % zlib.crc32(body):
        return None
    try:
        out = json.loads(body + b"}")
    except ValueError:
        return None
    return out if isinstance(out, dict) else None
