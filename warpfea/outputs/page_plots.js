// Line plots with a cursor at the time shown; a click sets the time.
class Plots {
  constructor(data, view) {
    this.data = data;
    this.view = view;
    this.figures = data.plots.map((plot) => {
      const figure = element("figure", "", $("plots")), caption = element("figcaption", "", figure);
      element("b", plot.title + (plot.units ? ` (${plot.units})` : ""), caption);
      const marks = plot.names.map((name) => element("span", name, caption)), canvas = element("canvas", "", figure);
      const set = (event) => { if (event.buttons || event.type === "pointerdown") this.setTime(plot, canvas, event); };
      canvas.addEventListener("pointerdown", set);
      canvas.addEventListener("pointermove", set);
      return { plot, marks, canvas };
    });
    new ResizeObserver(() => this.draw()).observe($("plots"));
  }

  get world() { return Math.max(this.view?.world ?? 0, 0); }

  span(plot) { const times = plot.times[this.world]; return [times[0], times.at(-1)]; }

  setTime(plot, canvas, event) {
    if (!this.view) return;
    const { times } = this.data, [low, high] = this.span(plot), box = canvas.getBoundingClientRect();
    const time = low + (high - low) * clamp((event.clientX - box.left - 46) / (box.width - 52), 0, 1);
    let k = times.findIndex((t) => t > time) - 1;
    if (k < 0) k = time < times[0] ? 0 : times.length - 1;
    this.view.pause();
    this.view.time = k + (k + 1 < times.length ? clamp((time - times[k]) / (times[k + 1] - times[k]), 0, 1) : 0);
    this.view.draw();
  }

  draw() {
    const style = getComputedStyle(document.documentElement), color = (name) => style.getPropertyValue(`--${name}`).trim();
    const shades = color("series").split(/\s+/), ratio = devicePixelRatio || 1;
    for (const { plot, marks, canvas } of this.figures) {
      marks.forEach((mark, k) => { mark.style.color = shades[k % shades.length]; });
      const wide = canvas.clientWidth, high = canvas.clientHeight, pen = canvas.getContext("2d");
      [canvas.width, canvas.height] = [wide * ratio, high * ratio];
      pen.setTransform(ratio, 0, 0, ratio, 0, 0);
      const values = plot.values[this.world], times = plot.times[this.world], flat = values.flat().filter((x) => x !== null);
      let low = Math.min(...flat), top = Math.max(...flat);
      if (!(top > low)) { const around = Math.abs(low) || 1; low -= 0.5 * around; top += 0.5 * around; }
      if (!flat.length) [low, top] = [0, 1];
      const [start, end] = this.span(plot);
      const x = (t) => 46 + (wide - 52) * (end > start ? (t - start) / (end - start) : 0.5);
      const y = (v) => 6 + (high - 26) * (top - v) / (top - low);
      pen.font = "11px system-ui, sans-serif";
      pen.fillStyle = color("faint");
      pen.strokeStyle = color("line");
      pen.lineWidth = 1;
      const step = nice((top - low) / 3);
      for (let v = Math.ceil(low / step) * step; v <= top; v += step) {
        pen.beginPath(); pen.moveTo(46, y(v)); pen.lineTo(wide - 6, y(v)); pen.stroke();
        pen.textAlign = "right";
        pen.fillText(digits(Math.round(v / step) * step, 3), 42, y(v) + 4);
      }
      pen.textAlign = "left";
      pen.fillText(digits(start, 3), 46, high - 4);
      pen.textAlign = "right";
      pen.fillText(digits(end, 3) + (this.data.static ? "" : " s"), wide - 6, high - 4);
      pen.lineWidth = 1.5;
      values.forEach((row, k) => {
        pen.strokeStyle = shades[k % shades.length];
        pen.beginPath();
        let gap = true;
        row.forEach((v, i) => {
          if (v === null) gap = true;
          else { pen[gap ? "moveTo" : "lineTo"](x(times[i]), y(v)); gap = false; }
        });
        pen.stroke();
      });
      if (this.view) {
        pen.strokeStyle = color("ink");
        pen.lineWidth = 1;
        const at = x(clamp(this.view.seconds(), start, end));
        pen.beginPath(); pen.moveTo(at, 4); pen.lineTo(at, high - 20); pen.stroke();
      }
    }
  }
}

