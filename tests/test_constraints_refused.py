"""Constraints and joints that are refused, by name."""

import pytest
import warp as wp
from constraint_models import bodies, joined

import warpfea as wf


def ends(one, two):
    return {"parent": one.surface("x+"), "child": two.surface("x-")}


BAD = {
    "kind": (lambda b, p, q: b.add_joint("hinge", **ends(p, q)), r"kind 'hinge' is unknown; there are spherical"),
    "no axis": (lambda b, p, q: b.add_joint("revolute", **ends(p, q)), r"a revolute joint needs an axis"),
    "axis": (lambda b, p, q: b.add_joint("fixed", axis=(1, 0, 0), **ends(p, q)), r"a fixed joint has no axis"),
    "axis zero": (lambda b, p, q: b.add_joint("revolute", axis=(0, 0, 0), **ends(p, q)), r"axis is zero"),
    "drive": (lambda b, p, q: b.add_joint("spherical", drive=1.0, **ends(p, q)), r"a spherical joint can't be driven"),
    "apart": (
        lambda b, p, q: b.add_joint("spherical", parent=p.surface("x-"), child=q.surface("x-")),
        r"are 1 m apart: give anchor=",
    ),
    "one ground": (
        lambda b, p, q: b.add_joint("fixed", parent=wf.GROUND, child=wf.GROUND),
        r"neither parent nor child is a body",
    ),
    "a node can't turn": (
        lambda b, p, q: b.add_joint("fixed", parent=wf.GROUND, child=p.nodes([0])),
        r"does not determine the rotation of direction",
    ),
    "handle": (lambda b, p, q: b.add_joint("fixed", parent=p, child=q.surface("x-")), r"expected .* got the body"),
    "name": (
        lambda b, p, q: [b.add_joint("fixed", name="j", **ends(p, q)) for _ in "ab"],
        r"joint name 'j' is used twice",
    ),
    "other builder": (
        lambda b, p, q: b.add_joint("fixed", parent=wf.GROUND, child=bodies()[1].surface("x-")),
        r"another builder",
    ),
    "axis2": (
        lambda b, p, q: b.add_joint("universal", axis=(1, 0, 0), axis2=(1, 1, 0), **ends(p, q)),
        r"axis2 = .* perpend",
    ),
    "ground rod": (
        lambda b, p, q: b.add_joint("distance", parent=wf.GROUND, child=p.at((0, 0, 0))),
        r"missing anchor=: the end point",
    ),
    "rod of no length": (
        lambda b, p, q: b.add_joint("distance", parent=p.at((1, 0.1, 0.1)), child=q.at((1, 0.1, 0.1))),
        r"its two points coincide",
    ),
    "DIST of no length": (
        lambda b, p, q: b.add_constraint("DIST", points=(p.at((1, 0, 0)), q.at((1, 0, 0)))),
        r"its two points coincide",
    ),
    "DIST negative": (
        lambda b, p, q: b.add_constraint("DIST", points=(p.at((0, 0, 0)), q.at((1, 0, 0))), value=-1.0),
        r"the distance must be positive, the law falls to -1 m",
    ),
    "DP1 of no length": (
        lambda b, p, q: b.add_constraint("DP1", points=(p.at((0, 0, 0)), p.at((0, 0, 0)), q.at((1, 0, 0)), (0, 0, 9))),
        r"its points P and Q coincide",
    ),
    "DP2 body": (
        lambda b, p, q: b.add_constraint(
            "DP2", points=(p.at((0, 0, 0)), p.at((1, 0, 0)), q.at((1, 0, 0)), q.at((2, 0, 0)))
        ),
        r"use DP1",
    ),
    "points": (lambda b, p, q: b.add_constraint("PIN", points=(p.at((0, 0, 0)),)), r"points must be 2 points"),
    "constraint": (lambda b, p, q: b.add_constraint("DP3", points=()), r"there are DP1, DP2, DIST, PIN"),
    "pin apart": (
        lambda b, p, q: b.add_constraint("PIN", points=(p.at((0, 0, 0)), q.at((1, 0, 0)))),
        r"are 1 m apart in the reference; value=",
    ),
    "all in space": (lambda b, p, q: b.add_constraint("PIN", points=((0, 0, 0), (0, 0, 0))), r"none of its points"),
    "weld outside": (lambda b, p, q: b.weld(p.surface("x-"), q), r"lies outside .*must lie in the other body"),
    "weld to the wrong surface": (
        lambda b, p, q: b.weld(p.surface("x+"), q.surface("x+")),
        r"is not on surface 'x\+' of body 'two'",
    ),
    "same place": (
        lambda b, p, q: b.add_joint("fixed", parent=p.surface("x+"), child=p.surface("x+")),
        r"are the same place",
    ),
    "axis2 of a rod": (
        lambda b, p, q: b.add_joint("distance", parent=p.at((0, 0, 0)), child=q.at((1, 0, 0)), axis2=(1, 0, 0)),
        r"only universal joints have an axis2",
    ),
    "no name": (lambda b, p, q: b.add_joint("fixed", name="", **ends(p, q)), r"joint name '' is no text"),
    "name of a list": (lambda b, p, q: b.add_joint("fixed", name=["a"], **ends(p, q)), r"is no text"),
    "weld itself": (lambda b, p, q: b.weld(p.surface("x-"), p), r"both sides are body 'one'"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_joints_are_refused(case):
    action, text = BAD[case]
    with pytest.raises(wf.ModelError, match=text):
        action(*bodies())


def test_handles_of_another_model_are_refused():
    model, _ = joined("fixed", ("ground", "surface"))
    _, other = joined("fixed", ("ground", "surface"))
    sim = wf.Simulation(model, dt=1e-3)
    for ask in (sim.joint_force, sim.violation, sim.joint_record, sim.joint_value):
        for what in (other, "elbow"):
            with pytest.raises(wf.ModelError, match="expected a joint of this model"):
                ask(what)
        if ask != sim.joint_value:
            ask("fixed_1")


@wp.func
def mixed_precision(t: wp.float64) -> wp.float64:
    return 0.5 * t


def test_a_law_that_does_not_compile_is_named():
    model, _ = joined("revolute", ("ground", "beam"), mixed_precision, axis=(0, 1, 0))
    with pytest.raises(wf.ModelError, match=r"mixed_precision.*write it in the precision"):
        wf.Simulation(model, dt=1e-3)


def test_a_mechanism_without_support_has_no_statics():
    model, _ = joined("revolute", ("ground", "surface"))
    with pytest.raises(wf.ModelError, match="has 1 unconstrained rigid-body mode"):
        wf.solve_static(model)
    model, _ = joined("fixed", ("ground", "surface"))
    assert wf.solve_static(model, load_steps=1).report.converged.all()
