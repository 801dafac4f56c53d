"""`python -m tests.validation`: its tables, their help and files, and the map of results to commands in README.md."""

import importlib
import json
import pathlib
import re
import shlex

import pytest
from validation import runner
from validation.table import Run, Table

from warpfea.base.errors import UsageError
from warpfea.cli.parser import parse

RESULTS = pathlib.Path(__file__).resolve().parent / "results"
ORIGIN = {"command", "commit", "machine", "versions"}
START = "python -m tests.validation "
MAP = (RESULTS.parent / "README.md").read_text().partition("## Results and the commands that made them")[2]
MADE = [
    [cell.strip() for cell in row.split("|")[1:3]]
    for row in MAP.partition("\n## ")[0].splitlines()
    if row.startswith("| `")
]
"""Rows of the map: files, and how they are made."""


@pytest.mark.parametrize("name", runner.names())
def test_tables_name_their_files(name):
    table = runner.find(name)
    for file, command in table.results.items():
        assert (RESULTS / file).is_file()
        assert shlex.split(command)[0] == name
        assert any(f"`{file}`" in files and f"`{START}{command}`" in how for files, how in MADE), file


@pytest.mark.parametrize("name", runner.names())
def test_help_teaches(name, capsys):
    table = runner.find(name)
    assert runner.main([name, "--help"]) == 0
    text = capsys.readouterr().out
    for word in (*table.parts, *table.options, *table.results, *(table.about or "").split("\n")[:1]):
        assert word in text


def test_the_list_names_every_table_and_file(capsys):
    assert runner.main(["--list"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in runner.names())
    assert all(file in text for name in runner.names() for file in runner.find(name).results)


@pytest.mark.parametrize(("files", "how"), MADE)
def test_commands_of_results_parse(files, how, tmp_path, monkeypatch):
    commands = [text for text in re.findall(r"`([^`]+)`", how) if text.startswith((START, "warpfea "))]
    if "no longer kept" in how:
        return
    assert commands or "](" in how, f"{files}: no command"
    for command in commands:
        if command.startswith(START):
            runner.parse(shlex.split(command.removeprefix(START)))
        else:
            parse(shlex.split(command)[1:])


def test_every_result_has_a_command():
    known = {file for files, _ in MADE for file in re.findall(r"`([\w.*/]+)`", files)}
    for path in RESULTS.glob("*.json"):
        assert path.name in known


def table_of(**options):
    def rows(run):
        """Numbers."""
        return [{"label": label, "x": run.options["n"]} for label in ("a-1", "a-2", "b") if run.wants(label)]

    def total(run):
        return {"of": len(run.made["rows"])}

    return Table(about="About.", parts={"rows": rows, "total": total}, settings={"k": 2}, options={"n": 3}, **options)


def test_tables_share_an_origin(tmp_path, capsys):
    out = tmp_path / "t.json"
    runner.run(table_of(columns=("label",)), Run(labels=("a-*",), out=out, options={"n": 4}), words=["t"])
    content = json.loads(out.read_text())
    assert {"schema", "settings", "rows", "total"} | ORIGIN == set(content)
    assert (content["command"], content["settings"]) == (f"{START}t", {"k": 2, "n": 4})
    assert content["rows"] == [{"label": "a-1", "x": 4}, {"label": "a-2", "x": 4}]
    assert content["total"] == {"of": 2}
    assert "label a-1\n" in capsys.readouterr().out


def test_parts_are_replaced_one_by_one(tmp_path):
    out = tmp_path / "t.json"
    runner.run(table_of(apart=True), Run(out=out, options={"n": 1}), words=["t"])
    first = json.loads(out.read_text())
    assert first["schema"] == 1
    assert {"about", "rows", "wall_s", "settings"} | ORIGIN == set(first["parts"]["rows"])
    runner.run(table_of(apart=True), Run(out=out, labels=("b",), options={"n": 2}), ["rows"], ["t", "--only", "rows"])
    second = json.loads(out.read_text())
    assert second["parts"]["total"] == first["parts"]["total"]
    assert second["parts"]["rows"]["rows"] == [{"label": "b", "x": 2}]
    with pytest.raises(UsageError, match="no such row"):
        runner.run(table_of(), Run(labels=("c",), options={"n": 1}), ["rows"])


@pytest.mark.parametrize(
    ("texts", "found"),
    [
        (["n=1e2"], {"n": 100, "sizes": (1, 2), "name": "x"}),
        (["sizes=5", "name=y"], {"n": 3, "sizes": [5], "name": "y"}),
    ],
)
def test_options_keep_their_types(texts, found):
    table = Table(about="", parts={}, options={"n": 3, "sizes": (1, 2), "name": "x"})
    assert table.changed(texts) == found


@pytest.mark.parametrize(
    ("words", "code", "named"),
    [
        (["joints", "--out", "no/folder/j.json"], 4, "no/folder"),
        (["joints", "--out", "j.txt"], 4, "j.txt"),
        (["ancf", "--only", "spin"], 2, "'spin'"),
        (["devices", "--device", "cpu"], 2, "CUDA"),
        (["joints", "--set", "joints=few"], 2, "'few'"),
        (["joints", "--set", "speed=1"], 2, "steps, joints"),
        (["join"], 2, "did you mean 'joints'"),
        ([], 2, "name a table"),
    ],
)
def test_bad_usage_is_one_line(words, code, named, capsys):
    assert runner.main(words) == code
    printed, err = capsys.readouterr()
    assert not printed
    assert named in err
    assert err.count("\n") == 1


def test_joints_are_counted_and_written(tmp_path, capsys):
    path = tmp_path / "joints.json"
    words = ["joints", "--set", "joints=2", "--set", "steps=1", "--only", "cost", "--out", str(path)]
    assert runner.main(words) == 0
    content = json.loads(path.read_text())
    assert {row["joints"] for row in content["cost"]} == {2}
    assert len(content["cost"]) == 13
    committed = json.loads((RESULTS / "joints_cpu.json").read_text())
    assert set(content["cost"][0]) == set(committed["cost"][0])


def test_data_that_lies_in_the_checkout_alone_is_named(monkeypatch, capsys, tmp_path):
    checkout = importlib.import_module("warpfea.studies.files")
    monkeypatch.setattr(checkout, "DATA_FOLDER", tmp_path)
    assert runner.main(["ancf", "--only", "static_beam", "--quiet"]) == 2
    err = capsys.readouterr().err
    assert "chrono_3243_3443.json" in err
    assert "checkout" in err
