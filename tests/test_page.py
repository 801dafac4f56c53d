"""The HTML page of a run, in a real browser; skipped where there is none."""

from __future__ import annotations

import io
import json
import pathlib
import re

import numpy as np
import pytest
from browser import Tab, open_browser
from stub_simulation import StubSim, drive

import warpfea as wf
from warpfea.outputs.html import HTMLWriter
from warpfea.outputs.page import NO_VALUE, _Block
from warpfea.outputs.render import render_usd

RESULT = pathlib.Path(__file__).parent / "results" / "html_cpu.json"
EVIL = '</script><script>window.broken = 1</script><b>"&'


class Sim(StubSim):
    """The stub near the origin, with a name that would end an element and a field that is NaN on one body."""

    def __init__(self, **options):
        super().__init__(far=(0.2, 0.5, 0.0), **options)
        self.bodies[1].name = EVIL

    def field(self, name, body):
        values = super().field(name, body)
        return np.full_like(values, np.nan) if name == "von_mises" and body.name == EVIL else values


@pytest.fixture(scope="module")
def browser():
    with open_browser() as running:
        yield running


@pytest.fixture(scope="module")
def page(tmp_path_factory, browser):
    path = tmp_path_factory.mktemp("page") / "x.html"
    sim, states = Sim(worlds=2), []
    writer = HTMLWriter(path, fps=50.0, title=EVIL, parameters={"E": 1e7}, command="warpfea run x")
    drive(sim, writer, 20, lambda s: states.append([s.positions(b)[:, b.skin.nodes] for b in s.bodies]))
    tab = Tab(browser, path)
    tab.sim, tab.states = sim, states[::2]
    return tab


def picture(tab):
    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(tab.page.locator("#picture").screenshot())).convert("RGB")).astype(int)[
        8:-8, 8:-8
    ]


def settle(tab, **values):
    """Set properties of the view; the picture."""
    tab("values => { Object.assign(page.view, values); page.view.draw(); }", values)
    return picture(tab)


def test_page_is_quiet_and_whole(page):
    assert page("!!page.view")
    assert not page.errors
    assert not page.foreign
    assert not page("window.broken")
    assert page("document.title") == page("document.getElementById('title').textContent") == EVIL
    assert page("page.view.ready") > 0.0
    assert not page("document.getElementById('message').textContent")
    assert "warpfea run x" in page("document.getElementById('facts').textContent")


def test_points_are_those_of_the_run(page):
    """Each point of each frame within half a quantum of the rest and of the displacement."""
    origin, offsets = np.array(page("page.data.origin")), np.array(page("page.data.offsets"))
    for k in range(4):
        shape = divmod(k, 2)
        at = f"page.view.surfaces[{k}]"
        step, quantum = page(f"{at}.packed.step"), page(f"{at}.packed.quantum")
        for frame in (0, 3, 10):
            wanted = page.states[frame][shape[0]][shape[1]] - origin + offsets[shape[1]]
            got = page(f"k => {{ const s = {at}; s.move(k, 0, 1); return Array.from(s.points); }}", frame)
            error = np.abs(np.reshape(got, (-1, 3)) - wanted).max()
            assert error <= 0.5 * quantum + 2e-6, (k, frame)
        assert 0.0 < quantum < 1e-4
        assert 0.0 < step < 1e-4


def test_slider_moves_the_picture(page):
    before = settle(page, time=0)
    page.page.locator("#frame").evaluate("e => { e.value = 8; e.dispatchEvent(new Event('input')); }")
    after = picture(page)
    assert (np.abs(before - after).max(axis=2) > 30).sum() > 500
    assert page("document.getElementById('clock').textContent") == "t = 0.16 s"
    page.page.locator("#picture").press("Home")
    assert (picture(page) == before).all()


def test_menus_change_the_colors(page):
    pictures = [settle(page, time=5)]
    for menu, choice in (("field", "1"), ("map", "cividis"), ("map", "viridis"), ("field", "0")):
        page.page.select_option(f"#{menu}", choice)
        pictures.append(picture(page))
    for a, b in ((0, 1), (1, 2), (2, 3)):
        assert (np.abs(pictures[a] - pictures[b]).max(axis=2) > 30).sum() > 500
    assert (pictures[0] == pictures[4]).all()
    page.page.fill("#high", "2e6")
    page.page.locator("#high").press("Enter")
    page.page.locator("#high").blur()
    assert (np.abs(picture(page) - pictures[0]).max(axis=2) > 30).sum() > 500
    page.page.fill("#low", "1.999e6")
    page.page.locator("#low").press("Enter")
    page.page.locator("#low").blur()
    ticks = page("Array.from(document.querySelectorAll('#ticks li'), (tick) => tick.textContent)")
    assert (ticks[0], ticks[4], len(set(ticks))) == ("2", "1.999", 5)
    page.page.click("#auto")
    assert (picture(page) == pictures[0]).all()


def test_nan_is_grey_and_hidden_parts_show(page):
    colored = settle(page, time=5)
    assert page("page.view.surfaces[2].vertices.every((x, i) => i % 8 < 6 || x === 0)")  # no value, not valid
    vivid = np.ptp(colored, axis=2) > 60
    assert vivid.any()
    page("{ page.view.shown = () => page.view.surfaces.slice(2); page.view.draw(); }")
    alone = picture(page)
    page("{ delete page.view.shown; page.view.draw(); }")
    assert np.ptp(alone[150:-60, 100:-200], axis=2).max() < 40  # grey on the sky
    for box in ("edges", "ghost"):
        page.page.check(f"#{box}")
        assert (np.abs(picture(page) - colored).max(axis=2) > 15).sum() > 200, box
        page.page.uncheck(f"#{box}")
    page.page.select_option("#cut", "+x")
    assert (np.abs(picture(page) - colored).max(axis=2) > 15).sum() > 500
    page.page.select_option("#cut", "")
    page.page.fill("#scale", "3")
    page.page.locator("#scale").blur()
    assert (np.abs(picture(page) - colored).max(axis=2) > 15).sum() > 500
    page.page.fill("#scale", "1")
    page.page.locator("#scale").blur()


def test_hover_reads_the_value(page):
    """At a frame, the value of the point is that of the run to half a quantum, which is shown."""
    settle(page, time=6)
    bar = page.sim.bodies[0]
    page.page.select_option("#world", "1")
    page("{ page.view.fit(); page.view.draw(); }")
    point = page("""(() => { const v = page.view, s = v.surfaces[1], w = document.getElementById("stage"), all = [];
      for (let p = 0; p < s.count; p++) {
        const [x, y] = v.camera.project(Array.from(s.points.subarray(3 * p, 3 * p + 3)), v.aspect());
        const at = [(x + 1) / 2 * w.clientWidth, (1 - y) / 2 * w.clientHeight], hit = v.pick(...at);
        if (hit && hit.surface === s && hit.point === p) all.push([p, ...at]);
      } return all[Math.floor(all.length / 2)]; })()""")
    box = page.page.locator("#picture").bounding_box()
    page.page.mouse.move(box["x"] + point[1], box["y"] + point[2])
    hovered = page("page.view.hovered")
    time = page("page.data.times[6]")
    wanted = 1e6 * (bar.mesh.points[bar.skin.nodes[int(point[0])], 0] + time)
    assert abs(hovered["value"] - wanted) <= hovered["half"] * (1 + 1e-6)
    assert 0.0 < hovered["half"] < 4e3
    told = page("document.getElementById('tip').textContent")
    for text in ("bar, world 1", "\u00b1 0.0", "MPa"):
        assert text in told
    page.page.select_option("#world", "-1")
    page("{ page.view.fit(); page.view.draw(); }")


def test_playing_and_turning(page):
    start = settle(page, time=0)
    page.page.click("#play")
    page.page.wait_for_function("page.view.time > 1")
    page.page.click("#play")
    assert not page("page.view.playing")
    settle(page, time=0)
    azimuth = page("page.view.camera.azimuth")
    box = page.page.locator("#picture").bounding_box()
    page.page.mouse.move(box["x"] + 300, box["y"] + 200)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + 360, box["y"] + 220)
    page.page.mouse.up()
    assert page("page.view.camera.azimuth") == pytest.approx(azimuth - 24.0)
    assert (np.abs(picture(page) - start).max(axis=2) > 30).sum() > 500
    distance = page("page.view.camera.distance")
    page.page.mouse.wheel(0, 200)
    page.page.wait_for_function(f"page.view.camera.distance > {1.2 * distance}")
    mark = page("page.view.camera.target")
    seen = "(x) => page.view.camera.project(x, page.view.aspect())"
    before = np.array(page(seen, mark))[:2]
    page.page.keyboard.down("Shift")
    page.page.mouse.move(box["x"] + 300, box["y"] + 200)
    page.page.mouse.down()
    page.page.mouse.move(box["x"] + 360, box["y"] + 220)
    page.page.mouse.up()
    page.page.keyboard.up("Shift")
    moved = (np.array(page(seen, mark))[:2] - before) / 2 * (box["width"], box["height"])
    assert moved == pytest.approx((60, -20), abs=1.0)  # what is held follows the pointer
    rates = page("""(() => {
      const view = page.view, frames = [], out = [], own = window.requestAnimationFrame;
      window.requestAnimationFrame = (frame) => frames.push(frame);
      for (const speed of [0.5, 2]) {
        [document.getElementById("speed").value, view.time] = [speed, 0];
        view.play();
        frames.pop()(performance.now() + 200);
        view.pause();
        out.push(view.seconds());
      }
      [document.getElementById("speed").value, window.requestAnimationFrame] = [1, own];
      return out; })()""")
    assert rates[1] == pytest.approx(4.0 * rates[0], rel=0.1)
    assert not page.errors


def test_without_webgl_a_message(tmp_path, browser):
    path = tmp_path / "x.html"
    sim = Sim(worlds=1)
    sim.totals, sim.steps = {"rough": np.array([2])}, 3
    drive(sim, HTMLWriter(path, fields=[]), 3)
    tab = Tab(browser, path, script="HTMLCanvasElement.prototype.getContext = ((get) => function (kind, how) {"
              " return kind === 'webgl2' ? null : get.call(this, kind, how); })"
              "(HTMLCanvasElement.prototype.getContext);")  # fmt: skip
    assert "no WebGL2" in tab.page.locator("#message").inner_text()
    assert not tab.page.locator("#stage").is_visible()
    assert tab.page.locator("#notes").inner_text() == "the tolerance was not reached in 2 of 3 steps"


def test_page_of_a_usd_file(tmp_path, browser):
    usd, path = tmp_path / "x.usdc", tmp_path / "x.html"
    sim = StubSim(worlds=2, far=(0.2, 0.5, 0.0))
    drive(sim, wf.USDWriter(usd, fps=50.0), 20)
    assert render_usd(usd, path) == path
    tab = Tab(browser, path, (390, 760), color_scheme="dark")
    assert not tab.errors
    assert tab("page.data.surfaces.map((s) => s.name)") == ["bar", "2nd box"]
    assert tab("page.data.times.length") == 11
    got = tab("(() => { const s = page.view.surfaces[1]; s.move(10, 0, 1); return Array.from(s.points); })()")
    shift = np.array(tab("page.data.offsets[1]")) - tab("page.data.origin")
    wanted = sim.skin_points(sim.bodies[0])[1] + shift
    assert np.abs(np.reshape(got, (-1, 3)) - wanted).max() < 1e-4
    assert tab("document.documentElement.scrollWidth") <= 390  # a phone needs no scrolling sideways
    # no point of any frame is under the bar of colours
    reach_of = """(() => { const v = page.view, out = [];
      for (let k = 0; k < page.data.times.length; k++) for (const s of v.surfaces) {
        s.move(k, 0, 1);
        for (let p = 0; p < s.count; p++)
          out.push(v.camera.project(Array.from(s.points.subarray(3 * p, 3 * p + 3)), v.aspect())[0]);
      } return [Math.min(...out), Math.max(...out)]; })()"""
    reach = tab(reach_of)
    bar_of = """(() => { const box = (id) => document.getElementById(id).getBoundingClientRect();
      return (box("legend").left - box("picture").left) / box("picture").width * 2 - 1; })()"""
    assert -1.0 < reach[0] < -0.6
    assert tab(bar_of) - 0.3 < reach[1] < tab(bar_of)
    tab.page.set_viewport_size({"width": 300, "height": 760})  # as a narrower window
    tab.page.wait_for_timeout(300)
    reach = tab(reach_of)
    assert -1.0 < reach[0] < -0.6
    assert reach[1] < tab(bar_of)
    dark = tab("getComputedStyle(document.body).backgroundColor")
    assert max(map(int, dark[4:-1].split(","))) < 60


# ------------------------------------------------------------------------------------- without a browser


@pytest.mark.parametrize(("width", "order"), [(1, 0), (1, 2), (2, 1), (2, 2), (4, 1)])
def test_block_restores_integers(width, order):
    table = np.random.default_rng(0).integers(0, 2 ** (8 * width), (7, 5), dtype=np.uint64)
    block = _Block()
    assert block.add(table[:, :2], width)[0] == block.add(table[:, :2], width)[0] == 0  # equal arrays once
    offset, rows, columns, width, order = block.add(table, width, order)
    planes = np.frombuffer(b"".join(block.parts)[offset:], dtype=np.uint8).reshape(width, -1)
    code = np.ascontiguousarray(planes.T).view(f"<u{width}").reshape(rows, columns)
    code = (code >> 1) ^ (0 - (code & 1)).astype(code.dtype)
    for first in range(order, 0, -1):
        for row in range(first, rows):
            code[row] += code[row - 1]
    assert (code == table).all()


def test_frames_are_thinned_and_refused(tmp_path):
    writer = HTMLWriter(tmp_path / "x.html", fps=100.0, max_frames=8, worlds=[2])
    sim = Sim(worlds=3)
    drive(sim, writer, 40)
    text = (tmp_path / "x.html").read_text()
    head = json.loads(text.split('type="application/json">')[1].split("</script>")[0])
    assert 5 <= len(head["times"]) <= 9
    assert head["times"][-1] == pytest.approx(0.4)
    assert head["worlds"] == [2]
    assert head["surfaces"][0]["worlds"][0]["moves"][1] == len(head["times"])
    assert head["fields"][0]["step"] == pytest.approx(1.4e6 / (NO_VALUE - 1), rel=1e-3)
    for worlds in ([3], [-1], [0.5], [1, 1], [], 0, "1"):
        with pytest.raises(wf.OutputError, match="worlds 0 to 2, each once"):
            HTMLWriter(tmp_path / "y.html", worlds=worlds).open(sim)
    for options in ({"title": 3}, {"parameters": [("E", 1)]}):
        with pytest.raises(wf.ModelError, match="title must be a text and parameters a dictionary"):
            HTMLWriter(tmp_path / "y.html", **options)
    told = {"a": np.zeros(2), "b": [], "c": None, "d": 1.5}
    drive(sim, HTMLWriter(tmp_path / "y.html", fields=[], parameters=told), 3)  # arrays, too
    assert "a = [0. 0.], d = 1.5" in (tmp_path / "y.html").read_text()
    with pytest.raises(wf.OutputError, match=r"end in \.html"):
        HTMLWriter(tmp_path / "y.pdf").open(sim)
    with pytest.raises(wf.ModelError, match="max_frames"):
        HTMLWriter(tmp_path / "y.html", max_frames=1)


def test_result_file():
    """Bars of pages beside the ray caster (tests/page_bars.py)."""
    made = json.loads(RESULT.read_text())
    size = made["size"]
    assert size["points"] >= 10_000
    assert size["frames"] == 60
    assert size["MB"] <= 2.0
    assert size["ready_s"] < 1.0
    assert len({row["scene"] for row in made["pictures"]}) == 10
    for row in made["pictures"]:
        assert row["frames"] >= 20
        assert row["overlap"] >= 0.98, row["scene"]
        assert row["difference"] <= 0.05, row["scene"]
        assert row["errors"] == row["requests"] == 0


def marked(tab, kind):
    """Pixels of the overlay in the colour of a kind of marks, over the picture of the tab."""
    return tab(
        """(kind) => { const c = document.getElementById("overlay"), d = c.getContext("2d");
      const pixels = d.getImageData(0, 0, c.width, c.height).data;
      const text = getComputedStyle(document.documentElement).getPropertyValue(`--${kind}`).trim();
      const wanted = [1, 3, 5].map((k) => parseInt(text.slice(k, k + 2), 16));
      let count = 0;
      for (let i = 0; i < pixels.length; i += 4)
        if (pixels[i + 3] > 150 && wanted.every((x, k) => Math.abs(pixels[i + k] - x) < 12)) count++;
      return count; }""",
        kind,
    )


def test_colliders_marks_and_the_runs_warnings_are_drawn(tmp_path, browser):
    """Supports, a joint, a load and a spring in their colours, grey colliders, worlds on a grid and alone; warnings."""
    b = wf.ModelBuilder()
    law = wf.SVK(E=1e7, nu=0.3, density=1e3)
    bar = b.add_solid(wf.mesh.box((1, 0.2, 0.2), cells=(2, 1, 1)), material=law, name="bar")
    part = b.add_rigid(wf.Box((1.2, 0.1, 0.1), (0.2, 0.2, 0.2)), density=1e3, name="part")
    b.clamp(bar.nodes("x-"))
    b.add_joint("spherical", parent=bar.at((1, 0.1, 0.1)), child=part.at((1, 0.1, 0.1)))
    b.add_point_load(bar.at((0.5, 0.1, 0.2)), force=(0, 0, -50.0))
    b.add_spring((1.2, 0.1, 0.8), part.at((1.2, 0.1, 0.3)), stiffness=100.0)
    b.add_contact(bar, b.add_collider(wf.Sphere((0.5, 0.1, -0.7), 0.3), name="ball"))
    model = b.finalize(worlds=3, device="cpu")
    path = tmp_path / "x.html"
    sim = wf.Simulation(model, dt=1e-3)
    sim.totals["rough"][:] = 2  # as of steps that ended above the tolerance
    sim.run(
        2e-3, outputs=[HTMLWriter(path, fps=1000.0, color=None, fields=["displacement"], worlds=[0, 2])], progress=False
    )
    tab = Tab(browser, path)
    tab("page.view.draw()")
    assert tab.page.locator("#notes").inner_text().startswith("the tolerance was not reached in")
    titles = tab("page.data.plots.map((plot) => plot.title)")
    assert [title.partition(" ")[0] for title in titles] == ["joint", "contact", "contact", "energy"], titles
    kinds = ("support", "joint", "load", "spring")
    grid = {kind: marked(tab, kind) for kind in kinds}
    assert min(grid.values()) > 15, grid
    colors = picture(tab)
    alone = "page.view.shown = () => page.view.surfaces.filter((s) => s.kind === 'collider')"
    tab(f"{{ {alone}; page.view.draw(); }}")
    balls = picture(tab)
    tab("{ page.view.shown = () => []; page.view.draw(); }")
    empty = picture(tab)
    tab("{ delete page.view.shown; page.view.draw(); }")
    ball = np.abs(balls - empty).max(axis=2) > 12
    assert ball.sum() > 500
    assert np.ptp(balls[ball], axis=1).max() < 40  # grey
    columns = np.flatnonzero(ball.any(axis=0))
    assert (np.diff(columns) > 20).sum() == 1  # two of them, side by side: the worlds' grid
    assert (np.abs(colors - empty).max(axis=2) > 12).sum() > 3 * ball.sum() / 2
    tab.page.locator("#picture").press("m")
    assert max(marked(tab, kind) for kind in kinds) == 0
    tab.page.locator("#picture").press("m")
    tab.page.select_option("#world", "1")  # one world, larger
    tab("page.view.time = page.data.times.length - 1; page.view.draw()")
    x, y = tab("""(() => { const v = page.view, w = document.getElementById("stage");
      const s = v.shown().find((shown) => shown.name === "bar");
      for (let p = 0; p < s.count; p++) {
        const [x, y] = v.camera.project(Array.from(s.points.subarray(3 * p, 3 * p + 3)), v.aspect());
        const at = [(x + 1) / 2 * w.clientWidth, (1 - y) / 2 * w.clientHeight], hit = v.pick(...at);
        if (hit && hit.surface === s && hit.point === p) return at;
      } })()""")
    tab.page.locator("#picture").hover(position={"x": x, "y": y})
    tip = tab("document.getElementById('tip').innerText")
    told = re.search(r"bar, world 2, node (\d+)\s*\((.*)\) m", tip)
    assert told, tip
    here = [float(number) for number in told[2].split(",")]
    assert here == pytest.approx(sim.positions(bar)[2, int(told[1])], abs=1e-4)
    tab.page.mouse.move(0, 0)
    tab("page.view.time = 0")
    assert min(marked(tab, kind) for kind in kinds) > 15
    tab(f"{{ {alone}.filter((s) => s.world === 1); page.view.draw(); }}")
    one = np.abs(picture(tab) - empty).max(axis=2) > 12
    assert (np.diff(np.flatnonzero(one.any(axis=0))) > 20).sum() == 0
    tab("{ delete page.view.shown; page.view.draw(); }")
    for key, angles in (("1", [-90, 0]), ("2", [0, 0]), ("3", [-90, 89.9])):
        tab.page.locator("#picture").press(key)
        assert tab("[page.view.camera.azimuth, page.view.camera.elevation]") == angles
    before = tab("page.view.camera.distance")
    tab("page.view.camera.distance *= 2")
    tab.page.locator("#picture").press("f")
    assert tab("page.view.camera.distance") == pytest.approx(before)
    tab.page.locator("#picture").press(" ")
    assert tab("page.view.playing")
    assert not tab.errors


def test_a_field_of_one_value_is_not_shown_first(tmp_path):
    """A ball in flight has no stress: its page begins with the displacement."""
    sim = Sim(worlds=1)
    sim.field = lambda name, body: np.zeros((1, len(body.mesh.points))) + sim.time[:, None] * (name == "displacement")
    drive(sim, HTMLWriter(tmp_path / "x.html", fps=50.0), 5)
    text = (tmp_path / "x.html").read_text()
    head = json.loads(text.split('type="application/json">')[1].split("</script>")[0])
    assert head["fields"][head["color"]]["name"] == "displacement"


@pytest.mark.parametrize("name", ["hook", "four_bar"])
def test_committed_pages_open(name, browser):
    path = RESULT.parent / "pages" / f"{name}.html"
    assert path.stat().st_size <= 1e6
    tab = Tab(browser, path)
    assert tab("page.data.title") == name
    assert tab("page.view.surfaces.length") >= 1
    times, canvas = tab("page.data.times"), tab.page.locator("#plots canvas").first
    width = tab("page.plots.figures[0].canvas.clientWidth")
    pictures = []
    for share in (0.25, 0.75):  # a click on a plot sets the time, at which its cursor stands
        canvas.click(position={"x": 46 + share * (width - 52), "y": 30})
        shown = np.interp(tab("page.view.time"), range(len(times)), times)
        start, end = tab("page.plots.span(page.data.plots[0])")
        assert shown == pytest.approx(start + share * (end - start), abs=2.0 / width * (end - start))
        pictures.append(canvas.screenshot())
    assert pictures[0] != pictures[1]
    tab.page.locator("#picture").focus()
    for key, state in (("End", len(times) - 1), ("ArrowLeft", len(times) - 2), ("Home", 0), ("ArrowRight", 1)):
        tab.page.keyboard.press(key)
        assert tab("page.view.time") == state, key
    for key, box in (("e", "edges"), ("u", "ghost"), ("m", "marks")):
        before = tab(f"document.getElementById('{box}').checked")
        tab.page.keyboard.press(key)
        assert tab(f"document.getElementById('{box}').checked") != before, key
    assert not tab.errors
    assert not tab.foreign
