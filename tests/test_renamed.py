"""Former names of members of a term are refused by name: they would be defined, and never called."""

import pytest

from warpfea.terms.renamed import RENAMED
from warpfea.terms.term import Term


@pytest.mark.parametrize("old", sorted(RENAMED))
def test_a_former_name_is_refused(old):
    with pytest.raises(TypeError, match=f"^Own.{old}: .* called '{RENAMED[old]}' now"):
        type("Own", (Term,), {old: lambda self, *args: None})


def test_names_of_today_exist():
    made = dir(Term) + list(vars(Term(None)))
    assert not set(RENAMED.values()) - {*made}


def test_names_of_today_are_accepted():
    assert type("Own", (Term,), {name: lambda self, *args: None for name in RENAMED.values()}).__base__ is Term
