"""Variants of ablation.py: each changes the sources as they are."""

import json

import pytest
from ablation import CONSTANTS, MECHANISMS, ROOT, constant_file, disabled, tables, variants
from random_cases import build, draw


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
    return json.loads((ROOT / "tests" / "results" / "ablation_cpu.json").read_text())["rows"]


@pytest.mark.parametrize("name", [*MECHANISMS, *CONSTANTS])
def test_what_is_there_is_needed(name):
    """A row of the stress suite or a random model is lost without it, or the iterations of all rise by a tenth."""
    alone = [row for row in rows() if row["variant"] == name]
    assert any(row["lost"] or row["newton"] > 1.1 or row["pcg"] > 1.1 for row in alone), name


def test_the_page_shows_the_tables():
    assert (ROOT / "kernels" / "CONSTANTS.md").read_text().endswith(tables(rows()))
