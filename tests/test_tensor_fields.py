"""Tensor fields: uniform states of every law, materials side by side, invariants, sampling, section forces."""

import functools

import numpy as np
import pytest
from result_files import rows_of
from stress_recovery import errors

import warpfea as wf
from warpfea.simulation.results import Results
from warpfea.terms.elements import Elements
from warpfea.terms.fields import MATRIX, SYMMETRIC

GRADIENT = np.eye(3) + np.array([(0.1, 0.05, 0.0), (0.02, -0.04, 0.03), (0.0, 0.01, 0.06)])
VOIGT = ((0, 0), (1, 1), (2, 2), (1, 2), (0, 2), (0, 1))
LAWS = {
    "SVK": wf.SVK(E=1e6, nu=0.3, density=1000.0),
    "MooneyRivlin": wf.MooneyRivlin(mu10=3e5, mu01=1e5, k=1e7, density=1000.0),
    "NeoHookean": wf.NeoHookean(mu=4e5, k=1e7, density=1000.0),
}


def voigt(A):
    return np.array([A[i, j] for i, j in VOIGT])


def second_piola(name, F):
    """S of the three laws, by their energies in C."""
    C, J, law = F.T @ F, np.linalg.det(F), LAWS[name]
    if name == "SVK":
        lam, mu = law.lame
        E = 0.5 * (C - np.eye(3))
        return lam * np.trace(E) * np.eye(3) + 2 * mu * E
    inverse, I1 = np.linalg.inv(C), np.trace(C)
    I2 = 0.5 * (I1**2 - np.trace(C @ C))
    mu10, mu01 = (law.mu10, law.mu01) if name == "MooneyRivlin" else (law.mu / 2, 0.0)
    S = 2 * mu10 * J ** (-2 / 3) * (np.eye(3) - I1 / 3 * inverse)
    S += 2 * mu01 * J ** (-4 / 3) * (I1 * np.eye(3) - C - 2 * I2 / 3 * inverse)
    return S + law.k * (J - 1.0) * J * inverse


def move(model, F):
    """State with x = F X everywhere."""
    state = model.state()
    origin = np.concatenate([np.where(body.slot_kind[:, None] == 0, body.origin, 0.0) for body in model.bodies])
    state.displacement.assign(((model.slot_table.reference + origin) @ (F - np.eye(3)).T)[None])
    return state


@pytest.mark.parametrize("name", LAWS)
def test_uniform_state(name):
    b = wf.ModelBuilder()
    for k, element in enumerate(("T4", "T10")):
        b.add_solid(
            wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1), element=element, origin=(0, k, 0)),
            material=LAWS[name],
            name=element,
        )
    if name == "SVK":  # whose elements have other laws elsewhere
        options = {"material": LAWS[name], "integration": "full"}
        b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1), element="H3843"), material=LAWS[name], name="H3843")
        section = wf.Rectangle(0.1, 0.1)
        b.add_beam([(0, 0, 0), (1, 0, 0)], elements=2, section=section, normal=(0, 0, 1), name="3243", **options)
        b.add_shell(wf.mesh.grid((1, 0.2), cells=(2, 1)), thickness=0.1, name="3443", **options)
    model = b.finalize(device="cpu")
    results = Results(model, move(model, GRADIENT))
    F, J = GRADIENT, np.linalg.det(GRADIENT)
    S = second_piola(name, F)
    sigma = F @ S @ F.T / J
    inverse = np.linalg.inv(F)
    values, vectors = np.linalg.eigh(sigma)
    exact = {
        "cauchy": voigt(sigma),
        "second_piola": voigt(S),
        "first_piola": (F @ S).ravel(),
        "green_lagrange": voigt(0.5 * (F.T @ F - np.eye(3))),
        "almansi": voigt(0.5 * (np.eye(3) - inverse.T @ inverse)),
        "principal": values[::-1],
        "tresca": values[2] - values[0],
        "pressure": -np.trace(sigma) / 3,
        "von_mises": np.sqrt(1.5 * np.sum((sigma - np.trace(sigma) / 3 * np.eye(3)) ** 2)),
        "J": J,
    }
    for body in model.bodies:
        for field, value in exact.items():
            size = np.abs(value).max()
            for found in (
                results.field(field, body),
                results.field(field, body, at="elements"),
                results.field(field, body, at="points"),
                results.skin_field(field, body),
                results.sample(body.at(body.mesh.points.mean(axis=0)), field),
            ):
                assert np.abs(found - value).max() < 1e-12 * size, (body.name, field)
        directions = results.field("principal_directions", body)[0, 0].reshape(3, 3)
        assert np.abs(np.abs(directions @ vectors[:, ::-1]) - np.eye(3)).max() < 1e-9
        assert results.field("cauchy.xy", body) == pytest.approx(sigma[0, 1], rel=1e-11)
        assert results.field("first_piola.yz", body) == pytest.approx((F @ S)[1, 2], rel=1e-11)
        assert results.field("principal.3", body) == pytest.approx(values[0], rel=1e-11)


@functools.cache
def two_materials():
    b = wf.ModelBuilder()
    mesh = wf.mesh.box((1, 0.2, 0.2), cells=(4, 1, 1), element="T4")
    left = mesh.centroids()[:, 0] < 0.5
    mesh.element_sets.update(soft=np.flatnonzero(left), hard=np.flatnonzero(~left))
    soft, hard = LAWS["SVK"], wf.SVK(E=3e6, nu=0.3, density=1000.0, damping=wf.KelvinVoigt(eta=100.0))
    body = b.add_solid(mesh, material={"soft": soft, "hard": hard}, name="bar")
    model = b.finalize(device="cpu")
    return model, body


def test_nodes_between_materials_take_the_first():
    model, body = two_materials()
    results = Results(model, move(model, GRADIENT))
    S, F = second_piola("SVK", GRADIENT), GRADIENT
    sigma = voigt(F @ S @ F.T / np.linalg.det(F))
    x = body.mesh.points[:, 0]
    found = results.field("cauchy", body)[0]
    assert np.abs(found[x < 0.5 + 1e-9] - sigma).max() < 1e-11 * np.abs(sigma).max()
    assert np.abs(found[x > 0.5 + 1e-9] - 3.0 * sigma).max() < 1e-11 * np.abs(sigma).max()
    hard = results.field("cauchy", body, elements=body.elements("hard"))[0]
    assert np.isnan(hard[x < 0.5 - 1e-9]).all()
    assert np.abs(hard[x > 0.5 - 1e-9] - 3.0 * sigma).max() < 1e-11 * np.abs(sigma).max()


def test_dissipation_is_that_of_the_viscous_force():
    model, body = two_materials()
    state = move(model, GRADIENT)
    rate = np.array([(0.3, 0.1, 0.0), (0.0, 0.2, 0.0), (0.0, 0.4, -0.1)])
    state.velocity.assign(((model.slot_table.reference + body.origin) @ rate.T)[None])
    results = Results(model, state)
    E = 0.5 * (rate.T @ GRADIENT + GRADIENT.T @ rate)
    found = results.field("viscous_dissipation", body, at="elements")[0]
    expected = np.where(np.isin(np.arange(len(found)), body.elements("hard").indices), 200.0 * np.sum(E * E), 0.0)
    assert found == pytest.approx(expected, rel=1e-11)
    assert results.field("velocity", body)[0] == pytest.approx(body.mesh.points @ rate.T, abs=1e-14)
    assert results.sample(body.line((0, 0.1, 0.1), (1, 0.1, 0.1), 5), "velocity")[0] == pytest.approx(
        np.column_stack([np.linspace(0, 1, 5), np.full(5, 0.1), np.full(5, 0.1)]) @ rate.T, abs=1e-13
    )


def test_what_is_unknown_or_no_scalar_says_what_there_is(tmp_path):
    model, body = two_materials()
    results = Results(model, model.state())
    for name, text in (
        ("cauchi", r"'cauchi' is unknown.*did you mean 'cauchy'"),
        ("cauchy.yx", r"'cauchy' has cauchy.xx, cauchy.yy.*did you mean"),
        ("J.x", "'J' has no components, as it is a scalar"),
        ("cauchy.", r"'cauchy\.' is unknown; 'cauchy' has cauchy.xx"),
        (["J"], r"\['J'\] is unknown"),
        ("section_force", "'section_force' is one of beams; body 'bar' has element T4"),
    ):
        with pytest.raises(wf.ModelError, match=text):
            results.field(name, body)
    with pytest.raises(wf.ModelError, match="field 'displacement' is one of nodes: leave out at='points'"):
        results.field("displacement", body, at="points")
    with pytest.raises(wf.ModelError, match="elements= chooses what counts at nodes"):
        results.field("J", body, at="elements", elements=body.elements("hard"))
    with pytest.raises(wf.ModelError, match="expected material points"):
        results.sample((0, 0, 0), "J")
    for count in (-1, 0, 2.5, None):
        with pytest.raises(wf.ModelError, match=f"count = {count} must be a whole number"):
            body.line((0, 0.1, 0.1), (1, 0.1, 0.1), count)
    sim = wf.Simulation(model, dt=1e-3)
    text = (
        "'cauchy' has 6 components where a scalar is needed: take von_mises, tresca, pressure, principal.1, or a comp"
    )
    for writer in (
        wf.USDWriter(tmp_path / "a.usdc", fields=["cauchy"]),
        wf.PNGWriter(tmp_path / "a.png", field="cauchy"),
    ):
        with pytest.raises(wf.ModelError, match=text):
            writer.open(sim)


def test_section_forces_balance_the_loads_of_a_bent_beam():
    law = wf.SVK(E=1e7, nu=0.3, density=1000.0)
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    section = wf.Rectangle(0.05, 0.05)
    beam = b.add_beam([(0, 0, 0), (1, 0, 0)], elements=6, section=section, normal=(0, 0, 1), material=law, name="beam")
    b.clamp(beam.start, slots="all")
    loads = {6: np.array([2.0, 3.0, -10.0]), 3: np.array([0.0, 5.0, 4.0])}  # by node
    for node, force in loads.items():
        b.add_point_load(beam.at((node / 6, 0, 0)), force)
    model = b.finalize(device="cpu")
    r = wf.solve_static(model, load_steps=2, tol=1e-12, unstable="ignore")
    x = r.positions(beam)[0]
    assert abs(x[-1, 2]) > 0.1  # m: bent far
    found = r.field("section_force", beam)[0].reshape(-1, 2, 3)
    axes = np.swapaxes(r.node_gradients(beam)[0] @ beam.node_axes, 1, 2)
    t = axes[:, 0] / np.linalg.norm(axes[:, 0], axis=1)[:, None]
    for node in range(7):  # the part after the node; at the end its load
        beyond = [k for k in loads if k > node or k == node == 6]
        force = sum(loads[k] for k in beyond)
        moment = sum(np.cross(x[k] - x[node], loads[k]) for k in beyond)
        assert found[node, 0, 0] == pytest.approx(force @ t[node], abs=1e-7)
        assert found[node, 1, 0] == pytest.approx(moment @ t[node], abs=1e-8)
        assert np.linalg.norm(found[node, 0]) == pytest.approx(np.linalg.norm(force), rel=1e-8)
        assert np.linalg.norm(found[node, 1]) == pytest.approx(np.linalg.norm(moment), abs=1e-8)
    total = sum(loads.values())
    assert np.abs(r.reaction(beam.start)[0] + total).max() < 1e-8
    for about in (np.zeros(3), np.array([1.0, 0.0, 0.0])):
        moment = sum(np.cross(x[k] - about, force) for k, force in loads.items())
        assert np.abs(r.reaction_moment(beam.start, about=about)[0] + moment).max() < 1e-8
    with pytest.raises(wf.ModelError, match="'shell_force' is one of shells"):
        r.field("shell_force", beam)


@pytest.mark.cuda
@pytest.mark.parametrize("dtype", ["float64", "float32"])
def test_fields_on_the_device_are_those_of_the_host(dtype):
    found = []
    for device in ("cpu", "cuda:0"):
        b = wf.ModelBuilder()
        body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(3, 1, 1)), material=LAWS["SVK"], name="box")
        model = b.finalize(device=device, dtype=dtype, worlds=2)
        state = model.state()
        u = np.random.default_rng(0).standard_normal((model.slots, 3)) * 1e-3
        state.displacement.assign(np.tile(u, (2, 1, 1)).astype(dtype))
        results = Results(model, state)
        found.append([results.field(name, body) for name in ("cauchy", "first_piola", "J", "strain_energy_density")])
        found[-1] += [results.skin_field("von_mises", body), results.skin_field("von_mises", body, [1])]
        found[-1] += [results.skin_points(body), results.skin_points(body, [1])]
    for cpu, cuda in zip(*found):
        assert np.abs(cpu - cuda).max() < (1e-10 if dtype == "float64" else 1e-3) * np.abs(cpu).max()


def test_tensors_in_vtu(tmp_path):
    import meshio

    b = wf.ModelBuilder()
    box = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(1, 1, 1), element="T4"), material=LAWS["SVK"], name="box")
    options = {"section": wf.Rectangle(0.1, 0.1), "normal": (0, 0, 1), "material": LAWS["SVK"], "name": "beam"}
    b.add_beam([(0, 1, 0), (1, 1, 0)], elements=1, **options)
    model = b.finalize(device="cpu")
    sim = wf.Simulation(model, move(model, GRADIENT), dt=1e-3)
    writer = wf.VTUWriter(tmp_path / "vtu", fields=["cauchy", "first_piola", "section_force", "principal"])
    writer.open(sim)
    writer.write(sim)
    writer.close(sim)
    solid, beam = (meshio.read(tmp_path / "vtu" / f"{name}_0000_000000.vtu").point_data for name in ("box", "beam"))
    sigma = sim.field("cauchy", box)[0, 0]
    assert solid["cauchy"][0] == pytest.approx(
        sigma[[SYMMETRIC.index(c) for c in ("xx", "yy", "zz", "xy", "yz", "xz")]]
    )
    assert solid["first_piola"][0] == pytest.approx(sim.field("first_piola", box)[0, 0])
    assert MATRIX[1] == "xy"
    assert "section_force" not in solid
    assert beam["section_force"].shape[1] == 6
    assert beam["cauchy"].shape[1] == 6


def test_history_of_a_field_and_of_reactions():
    law = wf.SVK(E=1e5, nu=0.3, density=1000.0)
    b = wf.ModelBuilder()
    box = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1), element="T4"), material=law, name="box")
    b.clamp(box.nodes("x-"))
    sim = wf.Simulation(b.finalize(device="cpu", worlds=2), dt=1e-2)
    points = box.line((0.1, 0.1, 0.1), (0.9, 0.1, 0.1), 3)
    stress, held = sim.history("cauchy", points), sim.history("reaction", box.nodes("x-"))
    for _ in range(3):
        sim.step()
    assert stress.time == pytest.approx([0.01, 0.02, 0.03])
    assert stress.values.shape == (2, 3, 3, 6)
    kept = len(sim.model.evaluation.samples.operators)
    assert kept == 1
    for _ in range(3):
        assert np.array_equal(stress.values[:, -1], sim.sample(points, "cauchy"))
    assert len(sim.model.evaluation.samples.operators) == kept  # those of a history stay, of samples they go
    assert held.values.shape == (2, 3, 6)
    assert np.array_equal(held.values[:, -1, :3], sim.reaction(box.nodes("x-")))
    assert np.array_equal(held.values[:, -1, 3:], sim.reaction_moment(box.nodes("x-")))
    assert repr(held) == "History(3 steps)"
    with pytest.raises(wf.ModelError, match="did you mean 'cauchy'"):
        sim.history("cauchi", points)


def test_a_simulation_without_fields_compiles_nothing_of_them():
    model, body = two_materials()
    sim = wf.Simulation(model, dt=1e-3)
    sim.step()
    assert not any("fields" in name or "gradient" in name for name in sim.stepper.launch.modules)
    sim.field("almansi", body)
    assert any("fields" in name for name in model.evaluation.launch.modules)


def test_stress_at_nodes_is_of_second_order():
    """Lame and Kirsch; the file has other recoveries beside."""
    rows = {(row["problem"], row["element"], row["cells"]): row for row in rows_of("stress_recovery_cpu.json")}
    for problem in ("lame", "kirsch"):
        found = errors(problem, 4, "T10", ["average"])
        assert found["average"] == pytest.approx(rows[problem, "T10", 4]["average"], rel=1e-6)
        for element, order in (("T10", 1.9), ("T4", 1.1)):
            coarse, fine = (rows[problem, element, cells]["average"] for cells in (8, 16))
            assert np.log2(coarse[0] / fine[0]) > order
            least = min(rows[problem, element, 16][name][1] for name in ("l2_projection", "patch_recovery"))
            assert fine[1] < 1.2 * least


def test_shell_resultants():
    """A strip under a tip load, mxx is the force times the arm over the width: each element has one curvature, so that
    means of two are exact and ends of first order. Stretched, nxx is uniform."""
    misses = []
    for cells in (4, 8):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        law = wf.SVK(E=1e9, nu=0.0, density=1000.0)
        strip = b.add_shell(wf.mesh.grid((1, 0.2), cells=(cells, 1)), thickness=0.02, material=law, name="strip")
        b.clamp(strip.edge("x-"), slots="all")
        b.add_traction(strip.surface("x+"), (5.0, 0, -0.125))
        r = wf.solve_static(b.finalize(device="cpu"), load_steps=1, unstable="ignore", tol=1e-10)
        n, m = np.split(r.field("shell_force", strip)[0], 2, axis=1)
        arm = 1.0 - strip.mesh.points[:, 0]
        inside = (arm > 1e-9) & (arm < 0.7)
        assert n[arm < 0.7, 0] == pytest.approx(0.1, rel=0.03)
        assert np.abs(m[inside, 0]) == pytest.approx(0.0025 * arm[inside], rel=2e-3)
        misses.append(np.abs(np.abs(m[:, 0]) - 0.0025 * arm).max() / 0.0025)
    assert misses == pytest.approx([0.125, 0.0625], rel=0.02)


def test_moments_of_beams_from_their_stress():
    """Each element has one curvature: from the bending stress at the clamp the moment lacks half an element's length of
    its arm, where that of the nodal forces has no error."""
    misses = []
    for elements in (4, 8):
        b = wf.ModelBuilder(gravity=(0, 0, 0))
        law = wf.SVK(E=1e9, nu=0.0, density=1000.0)
        section, line = wf.Rectangle(0.03, 0.05), [(0, 0, 0), (1, 0, 0)]
        beam = b.add_beam(line, elements=elements, section=section, normal=(0, 0, 1), material=law, name="beam")
        b.clamp(beam.start, slots="all")
        b.add_point_load(beam.at((1, 0, 0)), (0, 0, -5.0))
        r = wf.solve_static(b.finalize(device="cpu"), load_steps=1, unstable="ignore", tol=1e-10)
        assert np.abs(r.field("section_force.My", beam)[0]) == pytest.approx(np.linspace(5, 0, elements + 1), abs=1e-4)
        stress = r.sample(beam.at((0, 0, 0.025)), "cauchy.xx")[0, 0]
        misses.append(1.0 - abs(stress) * 0.03 * 0.05**2 / 6 / 5.0)
    assert misses == pytest.approx([1 / 8, 1 / 16], rel=0.01)


def test_statics_write_themselves_and_series_are_read_back(tmp_path, monkeypatch):
    import meshio

    monkeypatch.setitem(Elements.fields, "own", Elements.fields["cauchy"])  # a field that the reader does not know
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    box = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1), element="T4"), material=LAWS["SVK"], name="box")
    options = {"section": wf.Rectangle(0.1, 0.1), "normal": (0, 0, 1), "material": LAWS["SVK"], "name": "beam"}
    beam = b.add_beam([(0, 1, 0), (1, 1, 0)], elements=1, **options)
    b.clamp(box.nodes("x-"))
    b.clamp(beam.start, slots="all")
    b.add_point_load(box.at((1, 0.1, 0.1)), (100.0, 0, 0))
    b.add_point_load(beam.at((1, 1, 0)), (0, 0, -1.0))
    writer = wf.VTUWriter(tmp_path / "series", fields=["cauchy", "von_mises", "own"])
    r = wf.solve_static(b.finalize(device="cpu"), load_steps=2, outputs=[writer], unstable="ignore")
    for name in ("one.vtu", "one.usdc", "one.png", "one.html"):
        r.write(tmp_path / name)
        assert (tmp_path / name).stat().st_size > 500
    assert np.isnan(r.simulation.skin_field("section_force.N", box)).all()  # drawn grey
    for name in ("beam.html", "beam.usdc", "beam.png", "beam.vtu"):
        r.write(tmp_path / name, fields="section_force.N")
    assert np.isnan(meshio.read(tmp_path / "beam.vtu").point_data["section_force.N"][: len(box.mesh.points)]).all()
    r.write(tmp_path / "two.vtu", fields=["cauchy", "section_force"])
    mesh = meshio.read(tmp_path / "two.vtu")
    nodes = len(box.mesh.points)
    assert mesh.points[:nodes] == pytest.approx(r.positions(box)[0])
    assert mesh.point_data["cauchy"][:nodes, 0] == pytest.approx(r.field("cauchy.xx", box)[0])
    assert np.isnan(mesh.point_data["section_force"][:nodes]).all()
    assert np.isfinite(mesh.point_data["section_force"][nodes:]).all()
    assert [set(block) for block in mesh.cell_data["body"]] == [{0}, {1}]
    with pytest.raises(wf.OutputError, match=r"one.docx: the file name must end in one of .*\.html.*\.vtu"):
        r.write(tmp_path / "one.docx")

    (tmp_path / "empty").mkdir()
    with monkeypatch.context() as broken:
        broken.setattr(Results, "field_on", lambda *_: 1 / 0)
        for name in ("one.usdc", "one.png", "one.html"):
            with pytest.raises(ZeroDivisionError):
                r.write(tmp_path / "empty" / name)
    assert list((tmp_path / "empty").iterdir()) == []  # nor a temporary file

    saved = wf.read_results(tmp_path / "series")
    assert repr(saved) == "SavedResults(box, beam: 3 frames, 1 worlds)"
    assert saved.time == pytest.approx([0.0, 0.5, 1.0])
    assert saved.positions("box")[-1] == pytest.approx(r.positions(box), abs=1e-14)
    assert saved.field("cauchy", "box")[-1] == pytest.approx(r.field("cauchy", box), abs=1e-9)
    assert np.array_equal(saved.field("own", "box"), saved.field("cauchy", "box"))
    assert saved.fields("beam") == ["displacement", "velocity", "cauchy", "von_mises", "own"]
    with pytest.raises(wf.ModelError, match="did you mean 'von_mises'"):
        saved.field("mises", "box")
    with pytest.raises(wf.ModelError, match=r"two\.vtu: is one state, which meshio.read reads"):
        wf.read_results(tmp_path / "two.vtu")
    with pytest.raises(wf.ModelError, match="can't be read as a series"):
        wf.read_results(tmp_path / "none.pvd")
    (tmp_path / "series" / "box_0000_000001.vtu").write_text("<VTKFile")
    with pytest.raises(wf.MeshError, match=r"box_0000_000001\.vtu: can't be read, the file is damaged"):
        wf.read_results(tmp_path / "series").positions("box")


@pytest.mark.parametrize("integrator", ["backward_euler", "bdf2", "energy_momentum", "generalized_alpha"])
def test_acceleration_and_reaction(integrator):
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    law = LAWS["SVK"]
    falls = b.add_solid(wf.mesh.box((0.1, 0.1, 0.1), cells=(1, 1, 1), element="T4"), material=law, name="falls")
    stays = b.add_solid(wf.mesh.box((1, 0.1, 0.1), cells=(3, 1, 1), element="T4"), material=law, name="stays")
    b.clamp(stays.nodes("x-"))
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-3, integrator=integrator)
    nodes = stays.nodes("x-")
    pulled, sped = sim.history("reaction.z", nodes), sim.history("acceleration", nodes)
    with pytest.raises(wf.ModelError, match=r"'acceleration' is one of nodes: take body\.nodes"):
        sim.history("acceleration", stays.at((0.5, 0.05, 0.05)))
    assert np.isnan(sim.field("reaction", stays)).all()
    for _ in range(3):
        sim.step()
    assert sim.field("acceleration", falls)[0] == pytest.approx(np.tile([0, 0, -9.81], (8, 1)), abs=1e-6)
    held = sim.field("reaction", stays)[0]
    assert held.sum(axis=0) == pytest.approx(sim.reaction(stays.nodes("x-"))[0], abs=1e-9)
    assert np.array_equal(held[:, 2], sim.field("reaction.z", stays)[0])
    assert np.array_equal(pulled.values[0, -1], held[nodes.indices, 2])
    assert np.array_equal(sped.values[:, -1], sim.sample(nodes, "acceleration"))
    assert sped.values.shape == (1, 3, len(nodes), 3)
    with pytest.raises(wf.ModelError, match="'reaction' has 3 components where a scalar is needed: take a component"):
        sim.check_field("reaction", scalar=True)
    with pytest.raises(wf.ModelError, match="is one of nodes: it is not drawn"):
        sim.skin_field("reaction.z", stays)
    assert "reaction" not in Results(sim.model, sim.state).fields


def test_contact_traction_is_the_pressure_and_friction():
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    law = wf.SVK(E=1e6, nu=0.0, density=1000.0)
    mesh = wf.mesh.box((0.2, 0.2, 0.1), cells=(2, 2, 1), element="T4")
    box = b.add_solid(mesh, material=law, name="box")
    floor = b.add_collider(wf.HalfSpace((0, 0, 1), 0.0))
    b.add_contact(box, floor, mu=0.5)
    b.drive(box.nodes("z+"), displacement=([0, 1], [(0, 0, 0), (1e-4, 0, -1e-4)]))
    r = wf.solve_static(b.finalize(device="cpu"), load_steps=2, unstable="ignore")
    traction, pressure = r.field("contact_traction", box)[0], r.field("contact_pressure", box)[0]
    low = box.mesh.points[:, 2] < 1e-9
    assert pressure[low].min() > 100.0
    assert traction[:, 2] == pytest.approx(pressure, abs=1e-9 * pressure.max())
    assert (traction[~low] == 0.0).all()
    slope = np.linalg.norm(traction[low, :2], axis=1) / pressure[low]
    assert (traction[low, 0] < 0.0).all()  # friction holds it back
    assert 0.1 < slope.max() < 0.5 + 1e-9
