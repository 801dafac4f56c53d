"""Representations for notebooks, and the plot of a run."""

from __future__ import annotations

import html
import json
import re

import numpy as np
import pytest

import warpfea as wf
from warpfea.simulation.plots import record_plots


@pytest.fixture(scope="module")
def model():
    b = wf.ModelBuilder(gravity=(0, 0, -9.81))
    box = wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1))
    body = b.add_solid(box, material=wf.SVK(E=1e7, nu=0.3, density=1000), name="<bar>")
    b.clamp(body.nodes("x-"))
    b.add_probe("tip", body.surface("x+"))
    return b, b.finalize(device="cpu")


def cells(text):
    """Names and texts of a table."""
    pairs = re.findall(r"<th[^>]*>(.*?)</th><td[^>]*>(.*?)</td>", text)
    return {html.unescape(name): html.unescape(value) for name, value in pairs}


def test_tables_and_plot_of_a_run(model):
    builder, made = model
    assert "<bar>" not in builder._repr_html_()
    told = cells(builder._repr_html_())
    assert told["probes"] == "tip"
    assert told["gravity"] == "(0, 0, -9.81) m/s^2"
    assert "body <bar>" in told
    assert cells(made._repr_html_())["unknowns"] == str(int(made.free_slots.sum()))
    sim = wf.Simulation(made, dt=2e-3)
    with pytest.raises(wf.ModelError, match="no step was taken"):
        sim.plot()
    sim.step(4)
    told = cells(sim._repr_html_())
    assert (told["time"], told["steps"], told["worlds running"]) == ("0.008 s", "4", "1 of 1")
    assert told["Newton iterations"] == str(int(sim.totals["newton"].sum()))
    figure = sim.plot()
    titles = [axis.get_title() for axis in figure.axes]
    assert titles == ["probe tip: displacement", "energies now", "iterations of each step, most of all worlds"]
    z = figure.axes[0].lines[2].get_ydata()
    assert z == pytest.approx(sim.probe("tip").displacement[0, :, 2], rel=1e-5)
    counts = {line.get_label(): line.get_ydata() for line in figure.axes[2].lines}
    assert counts["newton"].sum() == sim.totals["newton"].sum()
    for world in (1, -1, 0.5, None):
        with pytest.raises(wf.ModelError, match=f"world = {world} must"):
            sim.plot(world)


def test_angles_of_joints_are_plotted():
    """On the figure and on the page, once their history is recorded."""
    b = wf.ModelBuilder()
    part = b.add_rigid(wf.Box((0.1, 0, 0), (0.1, 0.01, 0.01)), density=1e3, name="part")
    hinge = b.add_joint("revolute", parent=wf.GROUND, child=part.at((0, 0, 0)), axis=(0, 1, 0), name="hinge")
    sim = wf.Simulation(b.finalize(device="cpu"), dt=1e-2)
    angle = sim.history("angle", "hinge")
    with pytest.raises(wf.ModelError, match="travel"):
        sim.history("travel", hinge)
    found = []
    for _ in range(5):
        sim.step()
        found.append(sim.joint_value(hinge)[0])
    assert angle.values[0] == pytest.approx(found, rel=1e-12)
    assert found[-1] > 0.01
    axis = next(axis for axis in sim.plot().axes if axis.get_title() == "joint hinge: angle")
    assert axis.get_ylabel() == "rad"
    assert axis.lines[0].get_ydata() == pytest.approx(found, rel=1e-5)
    assert [plot["names"] for plot in record_plots(sim, [0]) if plot["units"] == "rad"] == [["angle"]]


def test_a_static_result_is_a_page(model):
    result = wf.solve_static(model[1], load_steps=1)
    text = result._repr_html_()
    assert text.startswith("<iframe srcdoc=")
    inner = html.unescape(re.search(r'srcdoc="([^"]*)"', text)[1])
    assert '"static":true' in inner
    assert inner.startswith("<!DOCTYPE html>")
    assert np.isfinite(result.simulation.field("von_mises", model[1].bodies[0])).all()


def test_a_model_is_shown_before_a_run(model, tmp_path):
    from PIL import Image

    model[1].show(tmp_path / "x.html")
    assert '"support"' in (tmp_path / "x.html").read_text()
    for name, options in (("x", {}), ("y", {"marks": ()})):
        model[1].show(tmp_path / f"{name}.png", size=(200, 120), **options)
    marked, plain = (np.asarray(Image.open(tmp_path / f"{name}.png")).astype(int) for name in "xy")
    green = [
        ((image[:, :, 1] > image[:, :, 0] + 60) & (image[:, :, 1] > image[:, :, 2] + 30)).sum()
        for image in (marked, plain)
    ]
    assert green[0] > 3 * green[1]  # of the axis y
    b = wf.ModelBuilder(gravity=(0, 0, 0))
    body = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=wf.SVK(E=1e7, nu=0.3, density=1e3))
    b.add_contact(body, b.add_collider(wf.Sphere((0.5, 0.1, -0.4), 0.3), path=[1e-9, 0, 0.1], name="ball"))
    b.finalize(device="cpu").show(tmp_path / "ball.html")  # obstacles too, at their places at the start
    head = (tmp_path / "ball.html").read_text().split('type="application/json">')[1].split("</script>")[0]
    page = json.loads(head)
    ball = next(surface for surface in page["surfaces"] if surface["name"] == "ball")
    place = ball["worlds"][0]
    low = np.array(place["low"]) + place["least"] + page["origin"]
    assert low[2] == pytest.approx(-0.6, abs=1e-3)


def test_springs_are_marked_from_end_to_end():
    from warpfea.outputs.markers import Markers, group_marks

    b = wf.ModelBuilder(gravity=(0, 0, 0))
    box = wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1))
    one, two = (b.add_solid(box, material=wf.SVK(E=1e7, nu=0.3, density=1000), name=name) for name in "ab")
    b.add_spring(one.at((1, 0.2, 0.2)), two.at((0, 0, 0)), stiffness=1.0)
    b.add_spring((0.0, 0.0, 3.0), one.at((0.5, 0.1, 0.1)), stiffness=1.0)
    made = b.finalize(device="cpu")
    sim = wf.Simulation(made, dt=1e-3)
    marks = Markers(sim, made.bodies)
    assert group_marks(marks.kinds(1)) == [("spring", [0, 1]), ("spring", [2, 3])]
    u = sim.state.displacement.numpy()
    u[0, : one.slot_count, 2] = 0.25  # the first body moves up
    sim.state.displacement.assign(u)
    wanted = [(1, 0.2, 0.45), (0, 0, 0), (0, 0, 3), (0.5, 0.1, 0.35)]
    assert np.abs(marks.points(sim)[0] - wanted).max() < 1e-12
