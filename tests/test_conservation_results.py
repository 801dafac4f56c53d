"""tests/results/conservation_cpu.json, by `python -m tests.validation conservation`, and README."""

import pytest
from result_files import RESULTS, content_of
from validation.conservation import CASES, FREE, MECHANISMS, STEPS

BOUND = {"svk": 1e-9, "mooney_rivlin": 1e-8, "neo_hookean": 1e-8}
"""Relative errors of energy and both momenta that are asked for, over 1e4 steps with a tolerance of 1e-12."""


@pytest.fixture(scope="module")
def parts():
    return content_of("conservation_cpu.json")["parts"]


@pytest.mark.parametrize("family", FREE)
def test_free_bodies_keep_energy_and_momenta(parts, family):
    rows = parts[family]["rows"]
    assert [(row["family"], row["law"]) for row in rows] == [case for case in CASES if case[0].split()[0] == family]
    for row in rows:
        assert row["steps"] == STEPS
        assert max(row["energy"], row["linear"], row["angular"]) < BOUND[row["law"]], row
        assert row["integrator"] < 1e-11, row  # sums of 1e4 roundings
        assert row["strain"] > 0.3
        assert row["stretch"] > 0.08


def test_mechanisms_keep_energy(parts):
    rows = parts["constrained"]["rows"]
    assert [row["scene"] for row in rows] == list(MECHANISMS)
    for row in rows:
        assert row["steps"] == STEPS
        assert row["energy"] < 1e-8
        assert row["integrator"] < 1e-11
        assert row["violation"] < 1e-12


def test_ten_thousand_revolutions(parts):
    rows = parts["revolutions"]["rows"]
    assert [row["family"] for row in rows] == ["T10", "3243 tied"]
    for row in rows:
        assert row["turns"] >= 1e4
        assert row["steps"] > 9e5  # the bound is that of 1e4 steps, for 90 times as many roundings
        assert max(row["energy"], row["linear"], row["angular"]) < 1e-8
        assert row["strain"] > 0.2


def test_the_table_is_of_the_file(parts):
    text = (
        (RESULTS.parent / "README.md")
        .read_text()
        .partition("<!-- conservation -->")[2]
        .partition("<!-- /conservation -->")[0]
    )
    assert text.strip() == table(parts)


def table(parts):
    """The table of the README: the worst of each family, and the mechanisms."""
    lines = ["| | energy | momentum | angular momentum | Newton iterations, most |", "|---|---|---|---|---|"]
    for family in FREE:
        rows = parts[family]["rows"]
        worst = [f"{max(row[name] for row in rows):.0e}" for name in ("energy", "linear", "angular")]
        mean = sum(row["newton"] for row in rows) / len(rows)
        lines.append(f"| {family} | {' | '.join(worst)} | {mean:.1f}, {max(row['newton_max'] for row in rows)} |")
    for row in parts.get("constrained", {"rows": []})["rows"]:
        name = row["scene"].replace("_", " ")
        lines.append(f"| {name} | {row['energy']:.0e} | | | {row['newton']:.1f}, {row['newton_max']} |")
    return "\n".join(lines)
