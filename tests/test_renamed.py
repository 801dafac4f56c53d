"""Former names of members that a subclass defines are refused."""

import pytest

from warpfea.base.renamed import FORMER_MEMBERS
from warpfea.base.writer import Output
from warpfea.materials import Material
from warpfea.terms.protocols import PROTOCOLS
from warpfea.terms.term import Term

BASES = {base.__name__: base for base in (Term, Output, Material)}


@pytest.mark.parametrize(("base", "old"), [(base, old) for base in BASES for old in sorted(FORMER_MEMBERS[base])])
def test_a_former_name_is_refused(base, old):
    with pytest.raises(TypeError, match=f"^Own.{old}: .* called '{FORMER_MEMBERS[base][old]}' now"):
        type("Own", (BASES[base],), {old: lambda self, *args: None})


@pytest.mark.parametrize("base", BASES)
def test_names_of_today_are_accepted(base):
    names = FORMER_MEMBERS[base].values()
    known = {*dir(BASES[base])}
    if base == "Term":
        known |= {*vars(Term(None)), *(name for protocol in PROTOCOLS for name in (protocol.__name__, *vars(protocol)))}
    assert not {*names} - known
    assert type("Own", (BASES[base],), dict.fromkeys(names, ())).__base__ is BASES[base]
