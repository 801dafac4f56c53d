// Controls, pointer and keys, marks over the picture.

const $ = (id) => document.getElementById(id);
const PREFIXES = [[1e9, "G"], [1e6, "M"], [1e3, "k"], [1, ""], [1e-3, "m"], [1e-6, "\u00b5"], [1e-9, "n"]];
const COLLIDER = [0.6, 0.6, 0.61], PLANE = { light: [0.8, 0.81, 0.83], dark: [0.27, 0.29, 0.32] };
const DARK = matchMedia("(prefers-color-scheme: dark)");

function element(kind, text = "", parent = null) {
  const out = document.createElement(kind);
  out.textContent = text;
  parent?.append(out);
  return out;
}

function digits(value, count = 4) {
  if (!Number.isFinite(value)) return "none";
  const size = Math.abs(value);
  return size && (size < 1e-4 || size >= 1e6) ? value.toExponential(count - 2) : String(+value.toPrecision(count));
}

// factor and text of a unit such that `largest` lies above one
function scaled(units, largest) {
  const [factor, prefix] = (units && PREFIXES.find(([size]) => largest >= 0.9995 * size)) || [1, ""];
  return [factor, units ? prefix + units : ""];
}

// largest of 1, 2, 5 times a power of ten up to x
function nice(x) {
  const power = 10 ** Math.floor(Math.log10(x));
  return power * (x >= 5 * power ? 5 : x >= 2 * power ? 2 : 1);
}

class View {
  constructor(data, bytes, began) {
    this.data = data;
    this.surfaces = data.surfaces.flatMap((mesh) => data.worlds.map((_, k) => new Surface(bytes, mesh, k, data)));
    this.fields = data.fields.map((field, index) => ({ ...field, index, high: field.low + (NO_VALUE - 1) * field.step }));
    this.time = data.static ? data.times.length - 1 : 0; // frame, with its fraction; statics show the full load first
    this.world = data.worlds.length > 1 ? -1 : 0; // -1: all, on their grid
    this.scale = 1;
    this.camera = new Camera(data.up);
    [this.camera.azimuth, this.camera.elevation] = data.view;
    const context = $("picture").getContext("webgl2", { antialias: true, alpha: true, preserveDrawingBuffer: true });
    if (!context) throw new Error("This browser has no WebGL2, which the picture needs; the records below are complete.");
    this.painter = new Painter(context);
    this.fill();
    this.bind();
    this.resize();
    this.setField(data.color, data.range);
    this.fit();
    this.draw();
    this.ready = performance.now() - began;
  }

  // ---- controls

  fill() {
    const { data } = this, option = (list, text, value) => { element("option", text, $(list)).value = value; };
    if (data.worlds.length > 1) option("world", "all", -1);
    data.worlds.forEach((number, k) => option("world", String(number), k));
    $("world").parentElement.hidden = data.worlds.length < 2;
    option("field", "none", -1);
    this.fields.forEach((field) => option("field", field.title, field.index));
    Object.keys(data.maps).forEach((name) => option("map", name, name));
    for (const speed of [0.1, 0.25, 0.5, 1, 2, 4]) option("speed", `\u00d7 ${speed}`, speed);
    $("speed").value = 1;
    for (const axis of "xyz") for (const side of "+-") option("cut", `beyond ${side}${axis}`, side + axis);
    $("frame").max = data.times.length - 1;
    $("player").hidden = data.times.length < 2;
    const span = data.times.at(-1) - data.times[0];
    this.rate = span >= 2 && span <= 20 && !data.static ? 1 : span / 6; // simulated seconds per second
    const views = { front: [-90, 0], side: [0, 0], top: [-90, 89.9], oblique: data.view };
    for (const [name, angles] of Object.entries(views)) {
      const button = element("button", name, $("views"));
      button.type = "button";
      button.onclick = () => { [this.camera.azimuth, this.camera.elevation] = angles; this.fit(); this.draw(); };
    }
  }

  bind() {
    const redraw = (id, act, event = "change") => $(id).addEventListener(event, () => { act($(id)); this.draw(); });
    redraw("world", (e) => { this.world = +e.value; this.fit(); this.plot?.(); });
    redraw("field", (e) => this.setField(+e.value));
    redraw("map", () => this.setMap());
    redraw("low", () => this.readRange());
    redraw("high", () => this.readRange());
    redraw("scale", (e) => { this.scale = Number.isFinite(+e.value) ? +e.value : 1; });
    redraw("depth", () => {}, "input");
    for (const id of ["cut", "edges", "ghost", "marks"]) redraw(id, () => {});
    redraw("frame", (e) => { this.pause(); this.time = +e.value; }, "input");
    $("auto").onclick = () => { this.setField(this.field?.index ?? -1); this.draw(); };
    $("fit").onclick = () => { this.fit(); this.draw(); };
    $("play").onclick = () => (this.playing ? this.pause() : this.play());
    new ResizeObserver(() => { this.resize(); if (this.camera.look() === this.fitted) this.frame(); this.draw(); }).observe($("stage"));
    DARK.addEventListener("change", () => { this.draw(); this.plot?.(); });
    document.addEventListener("keydown", (event) => this.key(event));
    this.bindPointer($("picture"));
  }

  key(event) {
    if (event.target.matches("input:not([type=range], [type=checkbox]), select, button") || event.ctrlKey || event.metaKey) return;
    const last = this.data.times.length - 1, step = (d) => { this.pause(); this.time = clamp(Math.round(this.time) + d, 0, last); };
    const toggle = (id) => () => { $(id).checked = !$(id).checked; };
    const view = (k) => () => $("views").children[k].click();
    const act = {
      " ": () => $("play").click(), ArrowLeft: () => step(-1), ArrowRight: () => step(1), Home: () => step(-last),
      End: () => step(last), f: () => this.fit(), e: toggle("edges"), u: toggle("ghost"), m: toggle("marks"),
      1: view(0), 2: view(1), 3: view(2), 4: view(3),
    }[event.key];
    if (!act) return;
    event.preventDefault();
    act();
    this.draw();
  }

  bindPointer(canvas) {
    const held = new Map();
    const place = (event) => { const box = canvas.getBoundingClientRect(); return [event.clientX - box.left, event.clientY - box.top]; };
    canvas.addEventListener("contextmenu", (event) => event.preventDefault());
    canvas.addEventListener("pointerdown", (event) => {
      canvas.setPointerCapture(event.pointerId);
      canvas.focus({ preventScroll: true });
      held.set(event.pointerId, place(event));
      $("tip").hidden = true;
    });
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, (event) => held.delete(event.pointerId));
    canvas.addEventListener("pointerleave", () => { $("tip").hidden = true; this.spot = null; this.drawMarks(); });
    canvas.addEventListener("pointermove", (event) => {
      const now = place(event), before = held.get(event.pointerId);
      if (!before) { this.hover(...now); return; }
      const moved = [now[0] - before[0], now[1] - before[1]];
      if (held.size === 2) {
        const other = [...held].find(([id]) => id !== event.pointerId)[1];
        const apart = (p) => Math.hypot(p[0] - other[0], p[1] - other[1]) || 1;
        this.zoom(apart(before) / apart(now));
        this.pan(moved[0] / 2, moved[1] / 2);
      } else if (event.shiftKey || event.buttons & 6) this.pan(...moved);
      else {
        this.camera.azimuth -= 0.4 * moved[0];
        this.camera.elevation = clamp(this.camera.elevation + 0.4 * moved[1], -89.9, 89.9);
      }
      held.set(event.pointerId, now);
      this.draw();
    });
    canvas.addEventListener("wheel", (event) => {
      event.preventDefault();
      this.zoom(Math.exp(clamp(event.deltaY, -200, 200) * 0.0015));
      this.draw();
    }, { passive: false });
  }

  zoom(factor) { this.camera.distance = clamp(this.camera.distance * factor, 1e-3 * this.camera.size, 40 * this.camera.size); }

  pan(dx, dy) {
    const { right, up } = this.camera.axes(), per = 2 * this.camera.tangents(1)[1] * this.camera.distance / $("stage").clientHeight;
    this.camera.target = sum(sum(this.camera.target, right, -dx * per), up, dy * per);
  }

  resize() {
    const box = $("stage"), ratio = devicePixelRatio || 1;
    for (const canvas of [$("picture"), $("overlay")]) {
      canvas.width = Math.max(1, Math.round(box.clientWidth * ratio));
      canvas.height = Math.max(1, Math.round(box.clientHeight * ratio));
    }
  }

  shown() { return this.surfaces.filter((s) => this.world < 0 || s.world === this.world); }

  // shows the whole motion
  fit() {
    this.outline = outline(this.shown(), this.scale);
    this.box = this.outline.box;
    this.frame();
  }

  // shows the outline of the last `fit`; again in a window of another shape, until the camera is moved
  frame() {
    const bar = this.field ? ($("legend").offsetWidth + 20) / $("stage").clientWidth : 0.07; // beside the colour bar
    this.camera.center = [0.07 - bar, 0];
    this.camera.fit(this.outline.points, this.aspect(), [0.93 - bar, 0.86]);
    this.fitted = this.camera.look();
  }

  aspect() { return $("picture").width / $("picture").height; }

  // ---- fields and colours

  setField(index, range = null) {
    this.field = this.fields[index] ?? null;
    $("field").value = index;
    this.range = range ?? [this.field?.low ?? 0, this.field?.high ?? 0];
    $("legend").hidden = !this.field;
    for (const id of ["low", "high", "auto", "map"]) $(id).disabled = !this.field;
    if (this.field) this.setMap();
  }

  readRange() {
    const range = [+$("low").value, +$("high").value];
    if (range.every(Number.isFinite) && range[0] < range[1]) this.range = range;
    this.setMap();
  }

  setMap() {
    ["low", "high"].forEach((id, k) => { $(id).value = digits(this.range[k], 6); });
    const table = this.data.maps[$("map").value].split(" "), colors = new Uint8Array(768);
    for (let k = 0; k < 256; k++) {
      const x = k / 255 * (table.length - 1), i = Math.min(Math.floor(x), table.length - 2);
      for (let c = 0; c < 3; c++) {
        const [a, b] = [i, i + 1].map((j) => parseInt(table[j].slice(2 * c, 2 * c + 2), 16));
        colors[3 * k + c] = Math.round(a + (b - a) * (x - i));
      }
    }
    this.painter.setMap(colors);
    const ramp = $("ramp"), pen = ramp.getContext("2d");
    [ramp.width, ramp.height] = [1, 256];
    for (let k = 0; k < 256; k++) {
      pen.fillStyle = `rgb(${colors[3 * k]},${colors[3 * k + 1]},${colors[3 * k + 2]})`;
      pen.fillRect(0, 255 - k, 1, 1);
    }
    const [low, high] = this.range, largest = Math.max(Math.abs(low), Math.abs(high));
    const [factor, units] = scaled(this.field.units, largest);
    const wanted = 1 + Math.ceil(Math.log10(4 * largest / (high - low))); // for ticks to differ
    const places = high > low ? Math.min(Math.max(3, wanted), 9) : 3;
    $("legend-title").textContent = this.field.title + (units ? ` (${units})` : "");
    $("ticks").replaceChildren();
    for (let k = high > low ? 4 : 0; k >= 0; k--) element("li", digits((low + (high - low) * k / 4) / factor, places), $("ticks"));
  }

  // ---- time

  play() {
    const { times } = this.data, span = times.at(-1) - times[0];
    if (span <= 0) return;
    if (this.time >= times.length - 1) this.time = 0;
    this.playing = true;
    $("play").textContent = "\u275a\u275a";
    let before = performance.now(), time = this.seconds();
    const tick = (now) => {
      if (!this.playing) return;
      time += (now - before) / 1000 * this.rate * +$("speed").value;
      before = now;
      if (time > times.at(-1)) time = times[0]; // round and round
      let k = times.findIndex((t) => t > time) - 1;
      if (k < 0) k = times.length - 2;
      this.time = k + clamp((time - times[k]) / (times[k + 1] - times[k]), 0, 1);
      this.draw();
      requestAnimationFrame(tick);
    };
    requestAnimationFrame(tick);
  }

  pause() { this.playing = false; $("play").textContent = "\u25b6"; }

  seconds() {
    const k = Math.floor(this.time), { times } = this.data;
    return times[k] + (this.time - k) * ((times[k + 1] ?? times[k]) - times[k]);
  }

  // ---- the picture

  cutPlane() {
    const chosen = $("cut").value;
    if (!chosen) return [0, 0, 0, 1];
    const axis = "xyz".indexOf(chosen[1]), sign = chosen[0] === "+" ? 1 : -1, plane = [0, 0, 0, 0];
    const [low, high] = this.box;
    plane[axis] = sign;
    plane[3] = sign * (low[axis] + +$("depth").value * (high[axis] - low[axis]));
    return plane;
  }

  draw() {
    const k = Math.floor(this.time), part = this.time - k, shown = this.shown();
    const { width, height } = $("picture"), bodies = shown.filter((s) => s.kind === "body");
    for (const s of shown) {
      s.move(k, part, s.kind === "body" || s.kind === "points" ? this.scale : 1);
      if (s.kind === "points") continue;
      s.shape(s.points, s.vertices);
      s.color(s.kind === "body" ? this.field : null, k, part);
      this.painter.upload(s, "now", s.vertices);
    }
    const cut = this.cutPlane(), none = [0, 0, 0, 1], range = this.field ? this.range : null;
    this.painter.begin(this.camera, width, height, cut);
    for (const s of bodies) {
      this.painter.draw(s, "now", { range });
      if ($("edges").checked) this.painter.draw(s, "now", { part: "edges", line: [0.05, 0.06, 0.08, 0.55] });
    }
    this.painter.gl.uniform4fv(this.painter.at.u_cut, none);
    for (const s of shown.filter((other) => other.kind === "collider")) this.painter.draw(s, "now", { plain: COLLIDER });
    if ($("ghost").checked)
      for (const s of bodies) {
        s.ghost ??= new Float32Array(s.vertices.length);
        s.shape(s.rest, s.ghost);
        this.painter.upload(s, "rest", s.ghost);
        this.painter.draw(s, "rest", { alpha: 0.22, plain: [0.5, 0.55, 0.62] });
      }
    const grid = nice(0.2 * this.camera.size);
    for (const s of shown.filter((other) => other.kind === "plane")) this.painter.draw(s, "now", { plain: DARK.matches ? PLANE.dark : PLANE.light, grid });
    $("frame").value = this.time;
    const now = this.seconds(), { data } = this;
    $("clock").textContent = data.static ? `load ${digits(100 * now)} %` : `t = ${digits(now)} s`;
    this.drawMarks();
    this.cursor?.();
  }

  // supports, joints, loads and axes over the picture
  drawMarks() {
    const canvas = $("overlay"), pen = canvas.getContext("2d"), ratio = devicePixelRatio || 1;
    const wide = canvas.width / ratio, high = canvas.height / ratio, style = getComputedStyle(document.documentElement);
    const color = (name) => style.getPropertyValue(`--${name}`).trim();
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, wide, high);
    const at = (point) => { const [x, y] = this.camera.project(point, wide / high); return [(x + 1) / 2 * wide, (1 - y) / 2 * high]; };
    const arrow = (from, along) => {
      const [x, y] = at(from), [u, v] = at(sum(from, along)), turn = Math.atan2(v - y, u - x);
      pen.beginPath();
      pen.moveTo(x, y); pen.lineTo(u, v);
      for (const side of [2.6, -2.6]) { pen.moveTo(u, v); pen.lineTo(u + 8 * Math.cos(turn + side), v + 8 * Math.sin(turn + side)); }
      pen.stroke();
    };
    const draw = {
      support: ([x, y]) => { pen.moveTo(x, y); pen.lineTo(x - 4.5, y + 8); pen.lineTo(x + 4.5, y + 8); pen.closePath(); pen.fill(); },
      joint: ([x, y]) => { pen.arc(x, y, 6, 0, 7); pen.stroke(); pen.moveTo(x + 2, y); pen.arc(x, y, 2, 0, 7); pen.fill(); },
      spring: ([x, y]) => { pen.arc(x, y, 1.5, 0, 7); pen.fill(); },
      probe: ([x, y]) => { pen.rect(x - 3, y - 3, 6, 6); pen.stroke(); },
      load: ([x, y]) => { pen.arc(x, y, 2.5, 0, 7); pen.fill(); },
    };
    const cut = this.cutPlane();
    pen.lineWidth = 2;
    pen.globalAlpha = 0.85;
    for (const marker of $("marks").checked ? this.data.markers : []) {
      pen.fillStyle = pen.strokeStyle = color(marker.kind === "probe" ? "ink" : marker.kind);
      for (const s of this.shown().filter((other) => other.mesh === this.data.surfaces[marker.surface])) {
        if (marker.kind === "spring" && marker.points.length === 2) {
          const [a, b] = marker.points.map((p) => at(Array.from(s.points.subarray(3 * p, 3 * p + 3))));
          pen.beginPath(); pen.moveTo(...a); pen.lineTo(...b); pen.stroke();
        }
        for (const p of marker.points) {
          const point = Array.from(s.points.subarray(3 * p, 3 * p + 3));
          if (dot(point, cut) > cut[3]) continue;
          pen.beginPath();
          draw[marker.kind](at(point));
          const along = marker.vectors?.[Math.min(Math.round(this.time), marker.vectors.length - 1)];
          const length = 0.3 * this.camera.size;
          if (along && Math.hypot(...along)) arrow(point, along.map((x) => length * x));
          if (marker.normal !== undefined) {
            const v = 8 * s.mesh.sourceOf.indexOf(p) + 3, n = Array.from(s.vertices.subarray(v, v + 3));
            arrow(sum(point, n, 0.35 * length), n.map((x) => -0.35 * length * x));
          }
        }
      }
    }
    pen.globalAlpha = 1;
    if (this.spot) { const [x, y] = at(this.spot); pen.strokeStyle = color("ink"); pen.beginPath(); pen.arc(x, y, 4, 0, 7); pen.stroke(); }
    pen.font = "12px system-ui, sans-serif";
    const { right, up } = this.camera.axes();
    ["#c33", "#2a8f2a", "#36c"].forEach((shade, c) => {
      pen.strokeStyle = pen.fillStyle = shade;
      const [x, y] = [34, 40], [dx, dy] = [24 * right[c], -24 * up[c]];
      pen.beginPath(); pen.moveTo(x, y); pen.lineTo(x + dx, y + dy); pen.stroke();
      pen.fillText("xyz"[c], x + 1.35 * dx - 3, y + 1.35 * dy + 4);
    });
  }

  // nearest surface under a place of the picture (CSS pixels): its surface and the corner next to the hit
  pick(x, y) {
    const { clientWidth, clientHeight } = $("stage"), aspect = clientWidth / clientHeight;
    const eye = this.camera.eye(), ray = this.camera.ray(2 * x / clientWidth - 1, 1 - 2 * y / clientHeight, aspect);
    const cut = this.cutPlane();
    let best = { depth: Infinity };
    for (const s of this.shown()) {
      if (s.kind !== "body") continue;
      const { triangles, sourceOf } = s.mesh, v = s.vertices;
      for (let t = 0; t < triangles.length; t += 3) {
        const corner = [0, 1, 2].map((k) => 8 * triangles[t + k]);
        const [a, b, c] = corner.map((o) => [v[o], v[o + 1], v[o + 2]]);
        const e1 = sum(b, a, -1), e2 = sum(c, a, -1), h = cross(ray, e2), det = dot(e1, h);
        if (!det) continue;
        const s0 = sum(eye, a, -1), u = dot(s0, h) / det, q = cross(s0, e1), w = dot(ray, q) / det, depth = dot(e2, q) / det;
        if (u < 0 || w < 0 || u + w > 1 || depth <= 0 || depth >= best.depth) continue;
        if (dot(sum(eye, ray, depth), cut) > cut[3]) continue;
        const share = [1 - u - w, u, w], nearest = share.indexOf(Math.max(...share));
        best = { depth, surface: s, point: sourceOf[triangles[t + nearest]] };
      }
    }
    return best.surface ? best : null;
  }

  hover(x, y) {
    const hit = this.playing ? null : this.pick(x, y), tip = $("tip");
    tip.hidden = !hit;
    this.spot = null;
    if (hit) {
      const { surface: s, point: p } = hit, k = Math.floor(this.time), { origin, offsets, worlds } = this.data;
      this.spot = Array.from(s.points.subarray(3 * p, 3 * p + 3));
      s.move(k, this.time - k, 1);
      const place = [0, 1, 2].map((c) => s.points[3 * p + c] + origin[c] - offsets[s.world][c]);
      s.move(k, this.time - k, this.scale);
      const rows = [s.name + (worlds.length > 1 ? `, world ${worlds[s.world]}` : "")];
      if (s.mesh.nodes) rows[0] += `, node ${s.mesh.nodes[p]}`;
      rows.push(`(${place.map((value) => digits(value, 5)).join(", ")}) m`);
      if (this.field) {
        const value = s.value(this.field, k, this.time - k, p);
        const [factor, units] = scaled(this.field.units, Math.max(Math.abs(this.field.low), Math.abs(this.field.high)));
        const half = this.field.step / 2 / factor;
        rows.push(`${this.field.title} ${Number.isNaN(value) ? "none" : `${digits(value / factor, 5)} \u00b1 ${digits(half, 2)} ${units}`}`);
        this.hovered = { name: s.name, node: s.mesh.nodes?.[p], position: place, value, half: this.field.step / 2 };
      }
      tip.textContent = rows.join("\n");
      tip.style.left = `${Math.min(x + 14, $("stage").clientWidth - tip.offsetWidth - 4)}px`;
      tip.style.top = `${Math.max(y - tip.offsetHeight - 10, 4)}px`;
    }
    this.drawMarks();
  }
}

async function start() {
  const began = performance.now(), data = JSON.parse($("header").textContent);
  $("title").textContent = data.title;
  $("subtitle").textContent = data.subtitle ?? "";
  for (const warning of data.warnings) element("p", warning, $("notes"));
  for (const [name, text] of data.facts) {
    const row = element("tr", "", $("facts"));
    element("td", name, row);
    element("td", text, row);
  }
  let view = null;
  try {
    if (!window.DecompressionStream) throw new Error("This browser is too old for the picture (no DecompressionStream).");
    view = new View(data, await inflate($("block").textContent), began);
  } catch (error) {
    $("message").textContent = error.message;
    $("message").hidden = false;
    for (const id of ["stage", "player", "options"]) $(id).hidden = true;
  }
  const plots = new Plots(data, view);
  if (view) { view.plot = () => plots.draw(); view.cursor = () => plots.draw(); }
  plots.draw();
  window.page = { view, plots, data };
}
start();
