"""Variants of ablation.py: each changes the sources as they are."""

import pytest
from ablation import CONSTANTS, MECHANISMS, ROOT, constant_file, disabled, tables, variants
from random_cases import build, draw
from result_files import content_of


@pytest.mark.parametrize("name", CONSTANTS)
def test_constants_are_defined_once_and_differ_when_disabled(name):
    _, value = constant_file(name)
    assert value != CONSTANTS[name].disabled


@pytest.mark.parametrize("name", MECHANISMS)
def test_mechanisms_can_be_switched_off(name, tmp_path):
    for file, *_ in MECHANISMS[name]:
        copy = tmp_path / file
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_text((ROOT / file).read_text())
    disabled(name, tmp_path)
    assert all((tmp_path / file).read_text() != (ROOT / file).read_text() for file, *_ in MECHANISMS[name])


def test_a_mechanism_that_is_gone_is_told(tmp_path):
    with pytest.raises(KeyError, match="0 definitions"):
        constant_file("NO_SUCH_CONSTANT")
    file = tmp_path / MECHANISMS["Armijo"][0][0]
    file.parent.mkdir(parents=True)
    file.write_text("")
    with pytest.raises(KeyError, match="Armijo"):
        disabled("Armijo", tmp_path)


def test_variants_are_many_and_random_models_can_be_built():
    assert len(variants()) == 1 + len(MECHANISMS) + len(CONSTANTS)
    for seed in range(12):
        assert build(draw(seed)).bodies
    assert draw(3) == draw(3)


def rows():
    return [row for part in content_of("ablation_cpu.json")["parts"].values() for row in part["rows"]]


def is_needed(name):
    """A row is lost without it, or iterations rise by a tenth, in all rows or, with matrices, factorisations, launches
    or bytes, in a scene (`rises`); of piles, which may be 5 % slower, by a twentieth."""
    alone = [row for row in rows() if row["variant"] == name]
    rise = [max(row["newton"], row["pcg"]) - (1.05 if row["of"] == "piles" else 1.1) for row in alone]
    return any(row["lost"] or row.get("rises") for row in alone) or max(rise) > 0.0


@pytest.mark.parametrize("name", MECHANISMS)
def test_mechanisms_are_needed(name):
    assert is_needed(name)


@pytest.mark.parametrize("name", CONSTANTS)
def test_constants_are_needed(name):
    assert is_needed(name)


def test_the_page_shows_the_tables():
    assert (ROOT / "kernels" / "CONSTANTS.md").read_text().endswith(tables(rows()))
