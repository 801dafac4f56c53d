"""The files of tests/results."""

import json
import pathlib

RESULTS = pathlib.Path(__file__).resolve().parent / "results"


def content_of(name, command="", device=""):
    """The content of a file that a command of this beginning made on a device of this beginning."""
    content = json.loads((RESULTS / name).read_text())
    assert content.get("command", "").startswith(command)
    assert not device or content["machine"]["device"].startswith(device)
    return content


def rows_of(name, command="", device=""):
    """Its rows."""
    return content_of(name, command, device)["rows"]
