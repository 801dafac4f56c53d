"""Residuals judged by groups of like stiffness: soft or slender bodies beside stiff ones under large forces."""

import numpy as np
import pytest

import warpfea as wf
from warpfea.model.components import slenderness, stiffness_classes
from warpfea.studies.stress.cases import stiff_beside_soft as pairs


def settled(kind, dtype, tol=None, steps=20, device="cpu"):
    """Bend of the arm in a motion of steps of 50 ms, and Newton iterations."""
    model = pairs.block_and_arm(kind).finalize(device=device, dtype=dtype)
    sim = wf.Simulation(model, dt=0.05, solver=wf.NewtonPCG(tol=tol))
    newton = sum(int(sim.step().newton[0]) for _ in range(steps))
    return sim.probe("tip").displacement[0] - sim.probe("root").displacement[0], newton


@pytest.mark.parametrize("kind", ["joint", "weld", "materials"])
def test_motion_of_a_soft_arm_beside_a_loaded_block_in_float32(kind):
    """Fails on 8934ce7: the errors are 0.99, after 2 or 3 iterations in 300 steps, and `floor` is 0."""
    exact, _ = settled(kind, "float64", 1e-10)
    found, newton = settled(kind, "float32")
    assert np.abs(found - exact).max() < 1e-2 * np.abs(exact).max()
    assert newton >= 20


@pytest.mark.parametrize("load", [1.0, 1.013, 1.078])
def test_a_welded_arm_that_comes_to_rest_in_float32(monkeypatch, load):
    """Fails without UNSOLVED_TOL_FACTOR at 1.013 and 1.078: steps without an iteration, 1.05 % off."""
    monkeypatch.setattr(pairs, "GRAVITY", load * pairs.GRAVITY)
    exact, _ = settled("weld", "float64", 1e-10, steps=pairs.STEPS)
    found, _ = settled("weld", "float32", steps=pairs.STEPS)
    assert np.abs(found - exact).max() < 5e-4 * np.abs(exact).max()


@pytest.mark.cuda
def test_motion_of_a_soft_arm_beside_a_loaded_block_on_a_gpu():
    exact, _ = settled("joint", "float64", 1e-10)
    for dtype in ("float64", "float32"):
        found, _ = settled("joint", dtype, device="cuda:0")
        assert np.abs(found - exact).max() < 1e-2 * np.abs(exact).max()


def test_statics_of_a_soft_arm_beside_a_loaded_block():
    """Fails on 8934ce7: 0.44 in float32 and 4.5e-5 in float64, of one body of two materials."""
    exact = pairs.tip_displacement("materials", False, "cpu", "float64", 1e-10)[0]
    for dtype, bound in pairs.BOUNDS.items():
        found, count = pairs.tip_displacement("materials", False, "cpu", dtype, None)
        assert np.abs(found - exact).max() < bound * np.abs(exact).max()
        assert found[-1, 2] == pytest.approx(-pairs.timoshenko_sag(), rel=0.05)


def test_a_slender_strip_beside_a_loaded_block_is_refused_in_float32():
    """Fails on 8934ce7: an error of 0.34 is accepted with 2 iterations in 300 steps."""
    with pytest.raises(wf.ConvergenceError, match="float32 round-off limit reached"):
        settled("slender", "float32", steps=3)


def test_groups_are_materials_of_like_stiffness_in_what_is_joined():
    models = [pairs.block_and_arm(kind).finalize(device="cpu") for kind in pairs.CONNECTIONS]
    assert [model.components.residual_groups.count for model in models] == [2, 2, 2, 2]
    model = pairs.block_and_arm("materials").finalize(device="cpu")
    assert model.components.mesh_of_slot.max() == 0
    groups = model.components.residual_groups
    start, slot = (a.numpy() for a in (groups.slot_start, groups.slot))
    x = (model.slot_table.reference + model.bodies[0].origin)[:, 0]
    soft, hard = x[slot[: start[1]]], x[slot[start[1] :]]
    assert hard.max() == pytest.approx(0.2)  # slots between both belong to the steel
    assert soft.min() > 0.2 + 1e-6
    elements = np.diff(groups.element_start.numpy())
    assert elements.sum() == model.element_count
    assert elements[0] == pytest.approx(2 * elements[1])  # eight cells of twelve
    assert model.components.error_estimate_groups.count == 2


def series(kind, moduli):
    """Three blocks in a row, the first clamped and loaded where it ends, so that the others go along as they are."""
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    first, middle, last = blocks = [
        b.add_solid(wf.mesh.box((0.3, 0.1, 0.1), cells=(2, 1, 1), origin=(0.3 * k, 0, 0)), material=wf.SVK(E=E, nu=0.0))
        for k, E in enumerate(moduli)
    ]
    b.clamp(first.nodes("x-"))
    for left, right in ((first, middle), (middle, last)):
        if kind == "joint":
            b.add_joint("fixed", parent=left.surface("x+"), child=right.surface("x-"))
        else:
            b.weld(right.nodes("x-"), left)
    b.add_traction(first.surface("x+"), (1e-4 * moduli[0], 0, 0))
    return b, blocks


def test_stiff_blocks_on_both_sides_of_a_soft_one_are_judged_apart():
    """Fails with one group of both stiff blocks: the free end of 1e12 Pa has an error of 0.43, converged, floor 0."""
    b, blocks = series("weld", (1e8, 1e6, 1e8))
    model = b.finalize(device="cpu", dtype="float32")
    assert model.components.residual_groups.count == 3
    result = wf.solve_static(model, unstable="ignore")
    exact = result.displacements(blocks[0])[0, :, 0].max()
    assert exact == pytest.approx(0.3 * 1e-4, rel=1e-3)
    assert np.abs(result.displacements(blocks[2])[0, :, 0] - exact).max() < 1e-4 * exact
    b, blocks = series("weld", (1e12, 1e6, 1e12))
    with pytest.raises(wf.ConvergenceError, match="float32 round-off limit reached"):
        wf.solve_static(b.finalize(device="cpu", dtype="float32"), unstable="ignore")


def test_stiff_blocks_that_a_joint_ties_are_one_group():
    counts = [series("joint", moduli)[0].finalize(device="cpu").components.residual_groups.count
              for moduli in ((1e9, 1e9, 1e5), (1e9, 1e5, 1e9), (1e9, 1e9, 1e9), (1e5, 1e9, 1e5))]  # fmt: skip
    assert counts == [2, 3, 1, 3]


def test_classes_of_stiffness():
    given = np.array([1e9, 1.0, 29.0, 2e9, 1.0, 1e9])
    assert list(stiffness_classes(given, np.array([0, 0, 0, 0, 1, 1]))) == [1, 0, 0, 1, 0, 1]
    assert list(stiffness_classes(given, np.arange(6))) == [0] * 6


def test_slenderness_of_a_box_and_of_a_beam():
    b = wf.ModelBuilder()
    law = wf.SVK(E=1e7, nu=0.3, density=1000.0)
    b.add_solid(wf.mesh.box((1.0, 0.5, 0.1), cells=(2, 1, 1)), material=law)
    b.add_beam([(5, 0, 0), (5, 2, 0)], elements=2, section=wf.Rectangle(0.1, 0.4), normal=(0, 0, 1), material=law)
    assert slenderness(b.finalize(device="cpu")) == pytest.approx([0.01, 0.0025])


def test_bodies_alike_are_one_group_and_cost_nothing():
    """Two links of one kind on hinges: no sums over groups, no arrays for them."""
    b = wf.ModelBuilder()
    law = wf.SVK(E=1e7, nu=0.3, density=1000.0)
    above = wf.GROUND
    for k in range(2):
        link = b.add_beam([(k, 0, 0), (k + 1, 0, 0)], elements=1, section=wf.Rectangle(0.1, 0.1), normal=(0, 0, 1),
                          material=law)  # fmt: skip
        b.add_joint("revolute", parent=above, child=link.start, axis=(0, 1, 0))
        above = link.end
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-2)
    assert sim.model.components.residual_groups.count == 1
    assert sim.model.components.error_estimate_groups.count == 2
    assert sim.stepper.work.newton.norms.group_sums.size == 1
    assert not any("perturbation" in module.name for module in sim.stepper.newton.modules())
