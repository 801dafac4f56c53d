"""`warpfea study`: its registry, the help of each study, and what the reports write."""

import importlib
import json
import pathlib

import pytest

from warpfea.cli import main
from warpfea.studies.registry import STUDIES

RESULTS = pathlib.Path(__file__).resolve().parent / "results"
ORIGIN = {"command", "commit", "machine", "versions"}


def module_of(name):
    return importlib.import_module(f"warpfea.studies.{STUDIES[name].module}")


@pytest.mark.parametrize("name", STUDIES)
def test_registry_says_what_the_module_does(name):
    entry, module = STUDIES[name], module_of(name)
    assert callable(module.run)
    assert f"`warpfea study {name}`" in module.__doc__
    if entry.parts:
        assert tuple(part for part, _ in entry.parts) == tuple(module.PARTS)
    for file in entry.results:
        assert (RESULTS / file).is_file()


def test_every_result_is_of_a_study_or_a_benchmark():
    """By the command that stands in it; those made before the reports were commands name a script."""
    known = {file for entry in STUDIES.values() for file in entry.results}
    for path in RESULTS.glob("*.json"):
        content = json.loads(path.read_text())
        words = content["command"] if "command" in content else next(iter(content["parts"].values()))["command"]
        assert (path.name in known) != words.startswith(("warpfea bench", "warpfea stress")), path.name


@pytest.mark.parametrize("name", STUDIES)
def test_help_teaches(name, capsys):
    entry = STUDIES[name]
    assert main(["study", name, "--help"]) == 0
    text = capsys.readouterr().out
    assert f"warpfea study {name} {entry.example}".strip() in text
    for part, what in entry.parts:
        assert part in text
        assert what in text
    assert ("--out" in text) == bool(entry.out)


def test_the_list_names_every_study(capsys):
    assert main(["study", "--help"]) == 0
    text = capsys.readouterr().out
    assert all(name in text for name in STUDIES)
    assert main(["study"]) == 2
    assert "STUDY" in capsys.readouterr().err


def test_parts_are_replaced_one_by_one(tmp_path, capsys):
    path = tmp_path / "ancf.json"
    words = ["study", "ancf", "--quick", "--out", str(path), "--device", "cpu"]
    assert main([*words, "--only", "static_beam", "--only", "princeton"]) == 0
    printed = capsys.readouterr().out
    first = json.loads(path.read_text())
    assert first["schema"] == 1
    assert list(first["parts"]) == ["static_beam", "princeton"]
    for part in first["parts"].values():
        assert {"about", "rows", "wall_s"} | ORIGIN == set(part)
        assert part["command"].startswith("warpfea study ancf --quick")
        assert part["machine"]["device"] == "cpu"
    assert len(first["parts"]["static_beam"]["rows"]) == 12
    assert printed.count("integration tied") >= 4
    assert main([*words, "--only", "princeton", "--quiet"]) == 0
    assert not capsys.readouterr().out
    second = json.loads(path.read_text())
    assert second["parts"]["static_beam"] == first["parts"]["static_beam"]
    assert second["parts"]["princeton"]["command"] != first["parts"]["princeton"]["command"]


def test_tables_share_an_origin(tmp_path, capsys):
    path = tmp_path / "joints.json"
    words = ["study", "joints", "--joints", "2", "--steps", "1", "--device", "cpu", "--out", str(path)]
    assert main([*words, "--only", "cost"]) == 0
    content = json.loads(path.read_text())
    assert {"schema", "settings", "cost"} | ORIGIN == set(content)
    assert content["settings"]["steps"] == 1
    assert {row["joints"] for row in content["cost"]} == {2}
    assert len(capsys.readouterr().out.splitlines()) == len(content["cost"]) == 13


def test_reports_write_what_was_committed(monkeypatch, tmp_path):
    """The keys of the rows are those of the committed files, of a small run of each."""
    jacobi = module_of("jacobi")
    name, scene = next(iter(jacobi.SCENES.items()))
    monkeypatch.setattr(jacobi, "SCENES", {name: scene})
    monkeypatch.setattr(jacobi, "ITERATIONS", (2,))
    path = tmp_path / "jacobi.json"
    assert main(["study", "jacobi", "--steps", "2", "--quiet", "--out", str(path)]) == 0
    made, committed = (json.loads(p.read_text()) for p in (path, RESULTS / "jacobi_cpu.json"))
    assert list(made) == list(committed)
    for solver in ("newton-pcg", "jacobi"):
        old, new = (next(r for r in c["rows"] if r["solver"] == solver) for c in (committed, made))
        assert list(old) == list(new)


@pytest.mark.parametrize(
    ("words", "code", "named"),
    [
        (["joints", "--out", "no/folder/j.json"], 4, "no/folder"),
        (["joints", "--out", "j.txt"], 2, "j.txt"),
        (["ancf", "--only", "spin"], 2, "'spin'"),
        (["devices", "--device", "cpu"], 2, "CUDA"),
        (["joints", "--joints", "few"], 2, "'few'"),
        (["jacobi", "--quick"], 2, "--quick"),
    ],
)
def test_bad_usage_is_one_line(words, code, named, capsys):
    assert main(["study", *words]) == code
    printed, err = capsys.readouterr()
    assert not printed
    assert named in err
    assert err.count("\n") == 1


def test_data_that_lies_in_the_checkout_alone_is_named(monkeypatch, capsys, tmp_path):
    from warpfea.studies import checkout

    monkeypatch.setattr(checkout, "DATA", tmp_path)
    assert main(["study", "ancf", "--only", "static_beam", "--quiet"]) == 2
    err = capsys.readouterr().err
    assert "chrono_3243_3443.json" in err
    assert "checkout" in err


def test_versions_compares_medians():
    from warpfea.studies.reports.versions import merge

    def runs(*times):
        return [[{"label": "a", "unknowns": 3, "ms_per_step": ms, "newton_per_step": 2.0}] for ms in times]

    (row,) = merge(runs(1.0, 9.0, 2.0), runs(3.0, 2.5, 0.1))
    assert row["label"] == "a 3"
    assert (row["before"], row["now"], row["ratio"]) == (2.0, 2.5, 1.25)
    assert row["before_ms"] == [1.0, 9.0, 2.0]
    assert row["newton_per_step"] == [2.0, 2.0]
    assert list(merge(runs(1.0), [[]])) == []


def test_versions_wants_a_checkout(tmp_path, capsys):
    assert main(["study", "versions", "--before", str(tmp_path)]) == 2
    assert "--before" in capsys.readouterr().err
