"""warpfea stress: how rows are chosen, judged, printed, kept and gone on with; toy cases, no kernels."""

import json
import math
import types

import numpy as np
import pytest

import warpfea as wf
from warpfea.cli import main
from warpfea.studies.stress import case as table_of_cases
from warpfea.studies.stress import suite
from warpfea.studies.stress.build import StepStats
from warpfea.studies.stress.case import Answer, Setting, Skipped, case, label
from warpfea.studies.stress.suite import Row, load_cases, run_row, select_rows

REAL = dict(load_cases())
BOTH = ("float64", "float32")


def right(setting):
    """Is right."""
    return Answer(1e-3, 1e-2, "a closed form", newton=4, pcg=20, limits={"newton": (4, 10)}, drift=1e-6)


def wrong(setting):
    """Is off."""
    return Answer(1e-1, 1e-2, "a closed form")


def unknown(setting):
    """Is no number."""
    return Answer(math.nan, 1e-2, "a closed form")


def slow(setting):
    """Takes too many iterations."""
    return Answer(0.0, 1e-2, "a closed form", limits={"newton": (40, 10)})


def refuses(setting):
    """Raises a named error."""
    raise wf.ConvergenceError("element 3 would turn\ninside out")


def breaks(setting):
    """Raises another error."""
    raise ValueError("a defect")


def absent(setting):
    """Needs a mesh."""
    return Answer(0.0, 1.0, str(setting.mesh("dolphin.msh")))


@pytest.fixture
def cases(monkeypatch):
    """An empty table in place of the cases there are; `add(run, name, ...)` fills it."""
    monkeypatch.setattr(table_of_cases, "CASES", {})
    monkeypatch.setattr(suite, "load_cases", lambda: table_of_cases.CASES)
    return table_of_cases.CASES


def judged(run, dtype="float64", meshes=None, **options):
    """The row that a toy case gives."""
    case("toy", "toys", **options)(run)
    toy = table_of_cases.CASES["toy"]
    return run_row(Row(toy, toy.values[0], dtype), Setting("cpu", dtype, meshes))


INSIDE_OUT = {"float64": ["inside out"]}


@pytest.mark.parametrize(
    ("run", "options", "outcome", "passed", "note"),
    [
        (right, {}, "done", True, ""),
        (wrong, {}, "FAILED", False, "accepted wrong: error 0.1 > 0.01"),
        (unknown, {}, "FAILED", False, "accepted wrong: error nan > 0.01"),
        (slow, {}, "FAILED", False, "newton 40 > 10"),
        (refuses, {"refusal": INSIDE_OUT}, "refused", True, "inside out"),
        (refuses, {"refusal": {"float64": ["float32"]}}, "FAILED", False, "which does not say 'float32'"),
        (refuses, {"refusal": {"float32": ["inside out"]}}, "FAILED", False, "refused: ConvergenceError"),
        (refuses, {"refusal": INSIDE_OUT, "must_refuse": True}, "refused", True, "inside out"),
        (right, {"refusal": INSIDE_OUT, "must_refuse": True}, "FAILED", False, "accepted what is to be refused"),
        (breaks, {"refusal": INSIDE_OUT}, "FAILED", False, "ValueError: a defect"),
        (absent, {}, "no mesh", None, ""),
    ],
)
def test_what_a_row_comes_to(cases, run, options, outcome, passed, note):
    row = judged(run, **options)
    assert (row["outcome"], row["passed"]) == (outcome, passed)
    assert note in row["note"]
    assert "\n" not in row["note"]
    json.dumps(row, allow_nan=False)


def test_a_mesh_that_is_there_is_read(cases, tmp_path):
    (tmp_path / "dolphin.msh").touch()
    assert judged(absent, meshes=tmp_path)["passed"]


def test_a_row_is_told_its_value_and_precision(cases):
    seen = []

    def run(setting, value):
        """Notes what it is told."""
        seen.append((setting.device, setting.dtype, setting.single, value))
        return right(setting)

    case("toy", "toys", values=(50, 1e3))(run)
    for row in select_rows(cases, [], False, BOTH):
        run_row(row, Setting("cpu", row.dtype))
    assert seen == [("cpu", d, d == "float32", v) for v in (50, 1e3) for d in BOTH]


def test_labels():
    assert label("a", None) == "a"
    assert [label("a", v) for v in ("T10", 50, 1e-8, ("T10", 0.5))] == ["a/T10", "a/50", "a/1e-08", "a/T10-0.5"]


def test_rows_are_chosen_by_case_row_group_precision_and_speed(cases):
    case("thin", "statics", values=(50, 500), quick="both")(right)
    case("long", "dynamics", quick="float64")(right)
    case("heavy", "dynamics")(right)

    def chosen(*names, quick=False, dtypes=BOTH):
        return [(row.label, row.dtype) for row in select_rows(cases, names, quick, dtypes)]

    assert chosen("thin/500", "heavy", dtypes=["float32"]) == [("thin/500", "float32"), ("heavy", "float32")]
    assert chosen("dynamics") == [(name, d) for name in ("long", "heavy") for d in BOTH]
    assert chosen(quick=True, dtypes=["float32"]) == [("thin/50", "float32"), ("thin/500", "float32")]
    assert ("long", "float64") in chosen(quick=True)
    assert len(chosen()) == 8


# the command


def stress(capfd, *words):
    """Exit code, stdout and stderr of the command line, on the CPU."""
    code = main(["stress", "--device", "cpu", *map(str, words)])
    out, err = capfd.readouterr()
    return code, out, err


def test_all_met_exits_0(cases, capfd, tmp_path):
    case("good", "toys")(right)
    case("refused", "toys", refusal={key: ["inside out"] for key in BOTH})(refuses)
    case("left", "toys")(absent)
    code, out, err = stress(capfd, "--json", tmp_path / "s.json")
    assert (code, err) == (0, "")
    assert "4 of 4 rows met their criterion, 2 left out" in out
    assert "refused" in out
    content = json.loads((tmp_path / "s.json").read_text())
    assert {"schema", "command", "commit", "machine", "versions", "settings", "rows"} == set(content)
    assert [row["precision"] for row in content["rows"]] == [*BOTH] * 3
    assert content["rows"][0]["limits"] == {"newton": {"value": 4, "bound": 10}}


def test_one_not_met_exits_3_and_is_named(cases, capfd):
    case("good", "toys")(right)
    case("bad", "toys", values=(1, 2))(wrong)
    code, out, err = stress(capfd, "--dtype", "float32")
    assert code == 3
    assert err == "not met: bad/1 float32, bad/2 float32\n"
    assert "1 of 3 rows met their criterion" in out
    code, out, err = stress(capfd, "--quiet")
    assert (code, out) == (3, "")
    assert err.startswith("not met")


def test_the_file_is_whole_after_each_row_and_is_gone_on_with(cases, capfd, tmp_path):
    path = tmp_path / "s.json"
    calls = []

    def interrupted(setting):
        """Ctrl-C in the second row."""
        calls.append(setting.dtype)
        if len(calls) == 2:
            assert len(json.loads(path.read_text())["rows"]) == 1
            raise KeyboardInterrupt
        return right(setting)

    case("toy", "toys")(interrupted)
    assert stress(capfd, "--json", path)[0] == 130
    assert [row["precision"] for row in json.loads(path.read_text())["rows"]] == ["float64"]
    code, out, _ = stress(capfd, "--json", path, "--resume")
    assert code == 0
    assert calls == ["float64", "float32", "float32"]
    assert "2 of 2 rows" in out
    assert len(json.loads(path.read_text())["rows"]) == 2
    assert [p.name for p in tmp_path.iterdir()] == ["s.json"]


def test_rows_of_another_commit_are_not_gone_on_with(cases, capfd, tmp_path):
    path = tmp_path / "s.json"
    case("toy", "toys")(right)
    assert stress(capfd, "--json", path)[0] == 0
    content = json.loads(path.read_text())
    path.write_text(json.dumps(content | {"commit": "another"}))
    code, _, err = stress(capfd, "--json", path, "--resume")
    assert code == 2
    assert "another commit" in err
    path.write_text("{}")
    assert "is no file of warpfea stress" in stress(capfd, "--json", path, "--resume")[2]
    assert "name it" in stress(capfd, "--resume")[2]


def test_json_on_stdout_is_all_that_is_there(cases, capfd):
    case("toy", "toys")(right)
    code, out, _ = stress(capfd, "--json", "-")
    assert code == 0
    assert len(json.loads(out)["rows"]) == 2


def test_debug_raises_what_is_none_of_warpfeas(cases):
    case("toy", "toys")(breaks)
    with pytest.raises(ValueError, match="a defect"):
        main(["stress", "--device", "cpu", "--debug"])


def test_wrong_words_exit_2(cases, capfd, tmp_path):
    case("elastica", "statics", values=(10, 100))(right)
    code, _, err = stress(capfd, "--case", "elastika")
    assert code == 2
    assert "did you mean 'elastica'?" in err
    assert "did you mean 'elastica/100'?" in stress(capfd, "--case", "elastic/100")[2]
    assert stress(capfd, "--case", "static")[2].endswith("did you mean 'statics'?\n")
    assert "or in the quick suite" in stress(capfd, "--quick")[2]
    assert stress(capfd, "--meshes", tmp_path / "none")[0] == 2
    assert stress(capfd, "--json", tmp_path / "none" / "s.json")[0] == 4
    assert main(["stress", "--device", "abacus"]) == 2


# the cases there are


def test_the_list_names_every_case(capfd):
    code, out, _ = stress(capfd, "--list")
    assert code == 0
    for name, found in REAL.items():
        assert f"  {name} " in out
        assert found.description in out


def test_the_cases_are_well_formed():
    groups = {found.group for found in REAL.values()}
    assert not groups & set(REAL)
    for name, found in REAL.items():
        assert found.quick in ("none", "float64", "both"), name
        assert set(found.refusal) <= set(BOTH), name
        labels = [label(name, value) for value in found.values]
        assert len(set(labels)) == len(labels), name
        assert not found.must_refuse or set(found.refusal) == set(BOTH), name


def test_skipped_is_no_named_error():
    assert not issubclass(Skipped, wf.Error)


def test_counts_hold_errors_to_the_floors_that_reports_told():
    def report(floor, newton=3, min_J=0.9):
        one = {"newton": newton, "pcg": 5, "halvings": 0, "violation": 0.0, "status": 0, "min_J": min_J, "floor": floor}
        last = types.SimpleNamespace(**{name: np.array([value]) for name, value in one.items()})
        return types.SimpleNamespace(last=last, model=types.SimpleNamespace(constraints=None))

    count = StepStats()
    count.add(report(1e-3))
    count.add(report(2e-3, newton=7))
    assert (count.newton, count.worst_newton, count.pcg, count.floor) == (10, 7, 10, 2e-3)
    assert count.answer(5e-3, 1e-2, "", reported_error=count.last_floor).passed
    assert not count.answer(7e-3, 1e-2, "", reported_error=count.last_floor).passed
    assert count.answer(7e-3, 1e-2, "", reported_error=count.sum_of_floors).passed
    assert count.answer(7e-3, 1e-2, "").passed
    count.add(report(0.0, min_J=-0.1))
    assert not count.answer(0.0, 1e-2, "", reported_error=count.last_floor).passed
    assert count.answer(0.0, 1e-2, "", lowest_J=None, reported_error=count.last_floor).passed
