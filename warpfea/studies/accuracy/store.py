"""Finished points of a study: in memory, and in a file for resuming an interrupted study."""

import functools
import hashlib
import inspect
import json
import os
import pathlib
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

from ...base.console import to_json
from ...base.errors import OutputError
from ...base.provenance import machine
from ...builder.scene import Scene
from .measure import REFUSED, TOO_LONG, Outcome
from .settings import Setting

__all__ = ["OutcomeStore", "code_version"]

_ROOT = pathlib.Path(__file__).resolve().parents[2]
UNRELATED_FOLDERS = ("cli", "outputs", "studies", "__pycache__")
"""Folders of the package without influence on results."""


@functools.cache
def _package_version() -> str:
    """Hash of the code of a run, device code included."""
    import warpfea.kernels as kernels

    total = hashlib.sha256()
    for root in (_ROOT, pathlib.Path(next(iter(kernels.__path__)))):
        for path in sorted(root.rglob("*.py")):
            if not set(path.relative_to(root).parts) & set(UNRELATED_FOLDERS):
                total.update(path.read_bytes())
    return total.hexdigest()


def code_version(scene: Scene[Any], device: str) -> str:
    """Dependencies of results and times besides the settings: package, scene file, machine."""
    file = inspect.getsourcefile(scene.function)
    own = pathlib.Path(file).read_bytes() if file and pathlib.Path(file).is_file() else b""
    return json.dumps([_package_version(), hashlib.sha256(own).hexdigest(), scene.name, machine(device)])


class OutcomeStore:
    """Outcomes by setting. With a file each finished run is appended at once.

    Args:
        file: storage; None: memory only.
        version: function of a device returning its code version.

    Raises:
        OutputError: the file can't be read or written.
    """

    def __init__(self, file: pathlib.Path | None, version: Callable[[str], str]) -> None:
        self.file, self.version = file, functools.cache(version)
        self.outcomes: dict[str, Outcome] = {}
        if file is not None and file.exists():
            try:
                text = file.read_text()
            except (OSError, ValueError) as error:
                raise OutputError(f"{file}: can't be read ({error})") from error
            for line in text.splitlines():
                try:
                    data = json.loads(line)
                    self.outcomes[data["key"]] = Outcome.from_dict(data)
                except (ValueError, KeyError, TypeError):  # line truncated by a kill
                    continue
            if text and not text.endswith("\n"):
                self._append("\n")

    def get(self, setting: Setting, repeat: int, limit: float | None) -> Outcome | None:
        """Outcome of a setting, unless it has fewer repetitions or was given up earlier than requested."""
        found = self.outcomes.get(setting.hash_key(self.version(setting.device)))
        if found is None or found.cost.get("asked", repeat) < repeat:
            return None
        if found.status == TOO_LONG and (limit is None or limit > found.cost["limit"]):
            return None
        return found

    def put(self, setting: Setting, outcome: Outcome) -> None:
        """Store an outcome. OutputError."""
        key = setting.hash_key(self.version(setting.device))
        self.outcomes[key] = outcome
        if self.file is not None and outcome.status != REFUSED:
            line = {"key": key, "settings": asdict(setting), **outcome.to_dict()}
            self._append(json.dumps(to_json(line)) + "\n")

    def summary(self) -> str:
        """Text of the partial results of an interrupted study."""
        if self.file is None:
            return "nothing is kept without a folder for it"
        count = sum(outcome.status != REFUSED for outcome in self.outcomes.values())
        if count == 0:
            return "no run was finished yet"
        return f"{self.file} holds {count} finished runs, which the same study does not run again"

    def _append(self, text: str) -> None:
        assert self.file is not None
        try:
            with open(self.file, "a") as stream:
                stream.write(text)
                stream.flush()
                os.fsync(stream.fileno())
        except OSError as error:
            raise OutputError(f"{self.file}: can't be written ({error})") from error
