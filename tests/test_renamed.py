"""Former names of members of a term are refused by name: they would be defined, and never called."""

import pytest

from warpfea.terms.renamed import FORMER_MEMBERS
from warpfea.terms.term import Term


@pytest.mark.parametrize("old", sorted(FORMER_MEMBERS))
def test_a_former_name_is_refused(old):
    with pytest.raises(TypeError, match=f"^Own.{old}: .* called '{FORMER_MEMBERS[old]}' now"):
        type("Own", (Term,), {old: lambda self, *args: None})


def test_names_of_today_exist():
    made = dir(Term) + list(vars(Term(None)))
    assert not set(FORMER_MEMBERS.values()) - {*made}


def test_names_of_today_are_accepted():
    assert type("Own", (Term,), {name: lambda self, *args: None for name in FORMER_MEMBERS.values()}).__base__ is Term
