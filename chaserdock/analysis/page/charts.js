/* SPDX-License-Identifier: Apache-2.0 */
// Curves and bars of figures as uPlot charts that zoom; those over time share a cursor with the replay.
(function () {
  "use strict";
  const data = JSON.parse(document.getElementById("chart-data").textContent);
  const replay = document.getElementById("replay");
  const arrays = new Map();
  let now = 0;

  function bytes(k) { return Uint8Array.from(atob(data.arrays[k]), (c) => c.charCodeAt(0)); }
  function numbers(k) {  // little-endian float32, base64
    if (!arrays.has(k)) arrays.set(k, Array.from(new Float32Array(bytes(k).buffer), (v) => (Number.isNaN(v) ? null : v)));
    return arrays.get(k);
  }
  function css(colour) {  // a variable of the page, or a colour
    if (!colour.startsWith("--")) return colour;
    return getComputedStyle(document.documentElement).getPropertyValue(colour).trim();
  }
  function tell(name, time) { document.dispatchEvent(new CustomEvent(name, { detail: time })); }
  function seek(time) { tell(replay ? "replay-seek" : "replay-time", time); }

  function unsorted(curve) { return numbers(curve.x).some((x, k, all) => k > 0 && x < all[k - 1]); }
  function inOrder(curve) {  // uPlot sorts by x; a curve that turns back is drawn in the order of its points
    const x = numbers(curve.x), y = numbers(curve.y);
    return (u) => {
      const stroke = new Path2D();
      let open = false;
      x.forEach((v, k) => {
        if (v === null || y[k] === null) { open = false; return; }
        const at = [u.valToPos(v, "x", true), u.valToPos(y[k], "y", true)];
        if (open) stroke.lineTo(...at); else stroke.moveTo(...at);
        open = true;
      });
      return { stroke, fill: null, clip: null, flags: 1 };
    };
  }
  function drawBars(u, rows) {
    for (const row of rows) {
      const from = numbers(row.from), to = numbers(row.to), opacity = bytes(row.opacity);
      const [a, b] = row.y.map((y) => u.valToPos(y, "y", true));
      u.ctx.fillStyle = css(row.colour);
      from.forEach((begin, k) => {
        const x = u.valToPos(begin, "x", true);
        u.ctx.globalAlpha = opacity[k] / 255;
        u.ctx.fillRect(x, Math.min(a, b), u.valToPos(to[k], "x", true) - x, Math.abs(b - a));
      });
      u.ctx.globalAlpha = 1;
    }
  }
  function drawLimits(u, limits) {
    const c = u.ctx;
    for (const limit of limits) {
      const y = u.valToPos(limit.y, "y", true);
      const [from, to] = limit.x ? limit.x.map((x) => u.valToPos(x, "x", true)) : [u.bbox.left, u.bbox.left + u.bbox.width];
      c.strokeStyle = c.fillStyle = css(limit.colour); c.setLineDash(limit.x ? [] : [6, 4]);
      if (from === to) c.fillRect(from - 4, y - 4, 8, 8);  // a value at one place
      else { c.beginPath(); c.moveTo(from, y); c.lineTo(to, y); c.stroke(); }
    }
    c.setLineDash([]);
  }

  class ZoomedFigure {  // the charts of a figure: one range for all with the same x axis
    constructor(box, panels) {
      this.box = box; this.panels = panels; this.charts = [];
      this.ends = new Map(panels.map((panel) => [panel.over, panel.x.ends]));
      this.ranges = new Map(this.ends);
      this.make();
    }
    make() {
      this.charts.forEach((chart) => chart.destroy());
      this.charts = this.panels.map((panel) => this.chart(panel));
    }
    chart(panel) {
      const figure = this;
      const grid = { stroke: css("--grid"), width: 1 };
      const axis = { stroke: css("--faint"), grid, ticks: { show: false } };
      const series = panel.curves.map((c) => ({
        label: c.label, stroke: css(c.colour), width: 1.2, dash: c.dashed ? [5, 3] : [],
        points: { show: c.dots, size: 3 },
        paths: c.dots ? () => null : c.steps ? uPlot.paths.stepped({ align: 1 }) : unsorted(c) ? inOrder(c) : undefined,
        value: (u, v) => (v === null || v === undefined ? "–" : v.toPrecision(4)),
      }));
      // Beside the powers of ten: a range may hold none.
      const few = { filter: (u, at) => at.map((x) => (/^[125]e/.test(x.toExponential()) ? x : null)) };
      const names = new Map(panel.y.names);
      const named = names.size ? { splits: () => [...names.keys()], values: (u, at) => at.map((y) => names.get(y)) } : {};
      const options = {
        title: panel.label, width: this.box.clientWidth, height: 220,
        scales: {
          x: { time: false, distr: panel.x.scale, dir: panel.x.direction, range: () => figure.ranges.get(panel.over) },
          y: {
            distr: panel.y.scale, dir: panel.y.direction,
            range: (u, low, high) => {  // of the figure, until zoomed: then of what is shown
              if (low === null || figure.ranges.get(panel.over) === figure.ends.get(panel.over)) return panel.y.ends;
              return panel.y.scale === 3 ? uPlot.rangeLog(low, high, 10, true) : uPlot.rangeNum(low, high, 0.1, true);
            },
          },
        },
        axes: [panel.time ? { ...axis, size: 32 } : { ...axis, ...(panel.x.scale === 3 ? few : {}), size: 28, label: panel.over, labelSize: 20 }, { ...axis, size: 60, ...named }],
        series: [{ label: panel.over, value: (u, v) => (v === null ? "–" : panel.time ? v.toFixed(2) : v.toPrecision(4)) }, ...series],
        legend: { show: panel.curves.length > 0 },
        cursor: { sync: { key: panel.over }, drag: { x: true, y: false, setScale: false } },
        hooks: {
          setSelect: [(u) => {
            if (u.select.width < 6) return;
            const ends = [0, u.select.width].map((x) => u.posToVal(u.select.left + x, "x"));
            figure.zoom(panel.over, ...ends.sort((a, b) => a - b));
            u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
          }],
          draw: [(u) => {
            const c = u.ctx, top = u.bbox.top, low = top + u.bbox.height;
            c.save();
            c.beginPath(); c.rect(u.bbox.left, top, u.bbox.width, u.bbox.height); c.clip();
            drawBars(u, panel.bars); drawLimits(u, panel.limits);
            if (!panel.time) { c.restore(); return; }
            const x = u.valToPos(now, "x", true);
            c.strokeStyle = css("--ink");
            c.beginPath(); c.moveTo(x, top); c.lineTo(x, low); c.stroke();
            c.restore();
          }],
        },
      };
      const tables = panel.curves.map((c) => [numbers(c.x), numbers(c.y)]);
      if (!tables.length) { tables.push([panel.x.ends, [null, null]]); options.series.push({}); }
      const chart = new uPlot(options, uPlot.join(tables), this.box);
      let pressed = 0;
      chart.over.addEventListener("mousedown", (e) => { pressed = e.clientX; });
      chart.over.addEventListener("click", (e) => {
        if (panel.time && Math.abs(e.clientX - pressed) < 4) seek(chart.posToVal(e.clientX - chart.over.getBoundingClientRect().left, "x"));
      });
      chart.over.addEventListener("dblclick", () => this.whole());
      return chart;
    }
    zoom(over, from, to) {
      const [first, last] = this.ends.get(over);
      this.set(over, [Math.max(first, from), Math.min(last, to)]);
    }
    whole() { this.ends.forEach((ends, over) => this.set(over, ends)); }
    set(over, range) {
      this.ranges.set(over, range);
      this.charts.forEach((chart, k) => {
        if (this.panels[k].over === over) chart.setScale("x", { min: range[0], max: range[1] });
      });
    }
    scaled(factor) {  // about the cursor, or the middle if it is not shown
      for (const panel of this.panels) {
        if (this.panels.find((p) => p.over === panel.over) !== panel) continue;
        const log = panel.x.scale === 3, even = (v) => (log ? Math.log(v) : v), back = (v) => (log ? Math.exp(v) : v);
        const [from, to] = this.ranges.get(panel.over).map(even), half = (to - from) * factor / 2;
        const middle = panel.time && now > from && now < to ? now : (from + to) / 2;
        this.zoom(panel.over, back(middle - half), back(middle + half));
      }
    }
    resize() { this.charts.forEach((chart) => chart.setSize({ width: this.box.clientWidth, height: 220 })); }
    redraw() {  // and show the values at this time
      this.charts.forEach((chart, k) => {
        if (!this.panels[k].time) return;
        chart.redraw(false);
        chart.setCursor({ left: chart.valToPos(now, "x"), top: 1 }, false);
      });
    }
  }

  const open = new Map(), cursors = [];
  for (const [name, panels] of Object.entries(data.figures)) {
    const figure = document.getElementById("plot-" + name);
    const still = figure.querySelector(".still"), charts = figure.querySelector(".charts");
    for (const panel of panels.filter((p) => p.time)) {
      const [from, to] = panel.x.ends;
      const [left, top, width, height] = panel.box;
      const area = document.createElement("div"), line = document.createElement("i");
      area.className = "panel";
      Object.assign(area.style, { left: left + "%", top: top + "%", width: width + "%", height: height + "%" });
      area.append(line);
      still.append(area);
      area.addEventListener("click", (e) => {
        const r = area.getBoundingClientRect();
        seek(from + (to - from) * (e.clientX - r.left) / r.width);
      });
      cursors.push([line, panel.x.ends]);
    }
    const bar = document.createElement("div");
    bar.className = "zoom";
    const add = (text, title, act) => {
      const button = document.createElement("button");
      button.type = "button"; button.textContent = text; button.title = title;
      button.addEventListener("click", act);
      bar.append(button);
      return button;
    };
    const toggle = add("zoom", "show the curves as charts that zoom", () => {
      const zoomed = !open.has(name);
      still.hidden = zoomed; charts.hidden = !zoomed;
      more.hidden = less.hidden = all.hidden = !zoomed;
      toggle.textContent = zoomed ? "figure" : "zoom";
      if (zoomed) {
        open.set(name, new ZoomedFigure(charts, panels));
        queueMicrotask(() => open.get(name)?.redraw());  // uPlot has no scales before
        return;
      }
      open.get(name).charts.forEach((chart) => chart.destroy());
      open.delete(name);
    });
    const more = add("+", "closer, about the cursor", () => open.get(name).scaled(0.5));
    const less = add("−", "wider", () => open.get(name).scaled(2));
    const all = add("whole", "whole figure", () => open.get(name).whole());
    more.hidden = less.hidden = all.hidden = true;
    figure.prepend(bar);
  }
  document.addEventListener("replay-time", (e) => {
    now = e.detail;
    for (const [line, [from, to]] of cursors) {
      line.hidden = now < from || now > to;
      line.style.left = 100 * (now - from) / (to - from) + "%";
    }
    open.forEach((figure) => figure.redraw());
  });
  window.addEventListener("resize", () => open.forEach((figure) => figure.resize()));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => open.forEach((figure) => figure.make()));
  if (!replay) tell("replay-time", 0);
})();
