"""Loads, drives, moments and stresses of ANCF bodies beside each other in one model."""

import numpy as np
import pytest
import warp as wp

import warpfea as wf

LAW = wf.SVK(E=1e7, nu=0.3, density=1000.0)


@wp.func
def rising(x: wp.vec3d, t: wp.float64) -> wp.vec3d:
    return wp.vec3d(wp.float64(0.0), wp.float64(0.0), x[0])


def add_beam(b, start, length, elements, **options):
    line = [start, np.add(start, (length, 0.0, 0.0))]
    section = options.pop("section", wf.Rectangle(0.1, 0.1))
    return b.add_beam(line, elements=elements, section=section, normal=(0, 0, 1), material=LAW, **options)


def test_a_field_load_takes_each_elements_own_functions():
    speeds = []
    for elements in (1, 2):  # of the other beam, which comes first in the block
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        other = add_beam(b, (0, 0, 0), 1.0, elements)
        beam = add_beam(b, (0, 1, 0), 8.0, 4)
        b.clamp(other.start)
        b.clamp(beam.start)
        b.add_body_force(rising)
        sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
        sim.step()
        speeds.append(sim.state.velocity.numpy()[0, beam.slots])
    np.testing.assert_allclose(speeds[0], speeds[1], atol=1e-6 * np.abs(speeds[1]).max())


@pytest.mark.parametrize("displacement", [(0.0, 0.0, 0.0), ([0, 1], np.zeros((2, 1, 3)))], ids=["constant", "per node"])
def test_a_displacement_holds_the_gradients_that_are_named(displacement):
    b = wf.ModelBuilder()
    beam = add_beam(b, (0, 0, 0), 1.0, 2)
    b.drive(beam.start, displacement=displacement, slots="all")
    model = b.finalize(device="cpu")
    assert not model.free_slots[beam.slots[:4]].any()


def test_a_displacement_needs_positions():
    b = wf.ModelBuilder()
    beam = add_beam(b, (0, 0, 0), 1.0, 2)
    with pytest.raises(wf.ModelError, match="slots = 'axis' has no position"):
        b.drive(beam.start, displacement=(0, 0, 0), slots="axis")


def test_a_rotation_turns_the_section_too():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    beam = add_beam(b, (0, 0, 0), 1.0, 2)
    b.drive(beam.start, rotation=wf.Rotation(anchor=(0, 0, 0), axis=(0, 0, 1), angle=0.3))
    result = wf.solve_static(b.finalize(device="cpu"), load_steps=3, tol=1e-10)
    np.testing.assert_allclose(result.positions(beam)[0, -1], [np.cos(0.3), np.sin(0.3), 0.0], atol=1e-9)


def test_drives_per_node_skip_orphan_nodes():
    mesh = wf.mesh.box((1, 1, 1), cells=(1, 1, 1), element="T4")
    points = np.vstack([[[5.0, 5.0, 5.0]], mesh.points])
    moved = wf.mesh.Mesh(points, mesh.cells + 1, "tetra", node_sets={"some": [0, 1, 2]})
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    with pytest.warns(wf.MeshWarning):
        body = b.add_solid(moved, material=LAW)
    values = np.zeros((2, 3, 3))
    values[1, :, 0] = 0.0, 0.01, 0.02
    b.drive(body.nodes("some"), displacement=([0, 1e-3], values))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3)
    sim.step()
    np.testing.assert_allclose(sim.displacements(body)[0, 1:3, 0], [0.01, 0.02], atol=1e-12)


def test_a_moment_on_a_named_side_of_enmc_takes_its_corners():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(wf.mesh.box((1, 1, 1), cells=(1, 1, 1), element="ENMC"), element="ENMC", material=LAW)
    b.add_moment(body.nodes("x+"), (1.0, 0, 0))
    assert len(b.description.moments[0].slots) == 4
    face_nodes = body.nodes(np.flatnonzero(body.node_slot_count == 1))
    with pytest.raises(wf.ModelError, match="no gradients"):
        b.add_moment(face_nodes, (1.0, 0, 0))
    with pytest.raises(wf.ModelError, match="no slots 'gradients'"):
        b.clamp(face_nodes, slots="gradients")


def test_torsion_shows_in_the_stress_of_every_integration():
    torque, a = 10.0, 0.1
    for integration in ("tied", "split", "full"):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        beam = add_beam(b, (0, 0, 0), 1.0, 4, integration=integration)
        b.clamp(beam.start, slots="position+section")
        b.add_moment(beam.end, (torque, 0, 0))
        result = wf.solve_static(b.finalize(device="cpu"), load_steps=1)
        stress = result.field("von_mises", beam)[0]
        # Saint-Venant's largest shear is 4.8 T / a^3; a section that stays plane has a like one at its corners
        np.testing.assert_allclose(stress / (np.sqrt(3) * 4.8 * torque / a**3), 1.0, atol=0.2)


def test_pressure_on_the_other_face_is_another_model():
    prints = []
    for side in ("top", "bottom"):
        b = wf.ModelBuilder()
        plate = b.add_shell(wf.mesh.grid((1, 1), cells=(1, 1)), thickness=0.1, material=LAW)
        b.clamp(plate.edge("x-"))
        b.add_pressure(plate.surface(side), 1.0)
        prints.append(b.finalize(device="cpu").fingerprint())
    assert prints[0] != prints[1]


def test_the_worst_element_is_counted_by_body_and_not_by_energy_part():
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    beam = add_beam(b, (0, 5, 0), 1.0, 4)
    soft = b.add_solid(
        wf.mesh.box((1, 0.4, 0.4), cells=(2, 1, 1), element="T4"),
        material=wf.NeoHookean.from_E_nu(E=1e6, nu=0.3, density=1000.0),
    )
    b.clamp(beam.start)
    b.clamp(soft.nodes("x-"))
    b.set_initial(soft, velocity=(-300.0, 0, 0))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-2, solver=wf.NewtonPCG(max_newton=2, max_halvings=1))
    with pytest.raises(wf.ConvergenceError, match="body 'box'") as caught:
        sim.step()
    assert 4 <= caught.value.element < 4 + len(soft.mesh.cells)


def quarter(elements):
    curve = lambda s: (np.sin(1.5 * np.pi * s), 0.0, 1.0 - np.cos(1.5 * np.pi * s))  # noqa: E731
    b = wf.ModelBuilder()
    return b.add_beam(curve, elements=elements, section=wf.Rectangle(0.1, 0.1), normal=(0, 1, 0), material=LAW)


def kinked():
    b = wf.ModelBuilder()
    curve = lambda s: (s, abs(s - 0.5), 0.0 * s)  # noqa: E731
    return b.add_beam(curve, elements=4, section=wf.Rectangle(0.01, 0.01), normal=(0, 0, 1), material=LAW)


def simulated(**options):
    b = wf.ModelBuilder()
    body = add_beam(b, (0, 0, 0), 1.0, 2)
    b.clamp(body.start)
    return wf.Simulation(b.finalize(device="cpu"), dt=1e-3), body


MISTAKES = {
    "coarse curve": (lambda: quarter(2), r"element \d .* turns by 135 degrees; use elements = 14"),
    "kink": (kinked, r"corner of 90 degrees at s = 0.5"),
    "normal": (lambda: wf.ModelBuilder().add_beam([(0, 0, 0), (1, 0, 0)], elements=1, section=wf.Rectangle(1, 1),
                                                  normal="z", material=LAW), "normal must be three"),
    "quads as a solid": (lambda: wf.ModelBuilder().add_solid(wf.mesh.grid((1, 1), cells=(1, 1)), material=LAW),
                         "use add_shell"),
    "damping": (lambda: wf.SVK(E=1.0, nu=0.3, damping=0.1), "must be a KelvinVoigt"),
    "builder": (lambda: wf.Simulation(wf.ModelBuilder(), dt=1.0), "finalize"),
    "static builder": (lambda: wf.solve_static(wf.ModelBuilder()), "finalize"),
    "outputs": (lambda: simulated()[0].run(1e-3, outputs=["a.usdc"]), "list of writers"),
    "reaction": (lambda: (lambda sim, body: sim.reaction(body))(*simulated()), "expected nodes"),
    "field": (lambda: (lambda sim, body: sim.field(body, "von_mises"))(*simulated()), r"field\(name, body\)"),
    "slots": (lambda: (lambda b: b.clamp(add_beam(b, (0, 0, 0), 1.0, 1).start, slots="director"))(wf.ModelBuilder()),
              "body 'beam'.*'axis', 'section'"),
}  # fmt: skip


@pytest.mark.parametrize("case", MISTAKES)
def test_mistakes_are_explained(case):
    action, text = MISTAKES[case]
    with pytest.raises(wf.ModelError, match=text):
        action()
