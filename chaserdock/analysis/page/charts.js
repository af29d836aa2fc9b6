/* SPDX-License-Identifier: Apache-2.0 */
// Figures over time: a cursor shared with the replay, and their curves as uPlot charts that zoom.
(function () {
  "use strict";
  const data = JSON.parse(document.getElementById("chart-data").textContent);
  const replay = document.getElementById("replay");
  const arrays = new Map();
  let now = 0;

  function numbers(k) {  // little-endian float32, base64
    if (!arrays.has(k)) {
      const bytes = Uint8Array.from(atob(data.arrays[k]), (c) => c.charCodeAt(0));
      arrays.set(k, Array.from(new Float32Array(bytes.buffer), (v) => (Number.isNaN(v) ? null : v)));
    }
    return arrays.get(k);
  }
  function css(colour) {  // a variable of the page, or a colour
    if (!colour.startsWith("--")) return colour;
    return getComputedStyle(document.documentElement).getPropertyValue(colour).trim();
  }
  function tell(name, time) { document.dispatchEvent(new CustomEvent(name, { detail: time })); }
  function seek(time) { tell(replay ? "replay-seek" : "replay-time", time); }

  class ZoomedFigure {  // the charts of a figure: one x range for all
    constructor(box, panels) {
      this.box = box; this.panels = panels; this.range = panels[0].x; this.charts = [];
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
        points: { show: c.dots, size: 3 }, paths: c.dots ? () => null : c.steps ? uPlot.paths.stepped({ align: 1 }) : undefined,
        value: (u, v) => (v === null || v === undefined ? "–" : v.toPrecision(4)),
      }));
      const options = {
        title: panel.label, width: this.box.clientWidth, height: 220,
        scales: {
          x: { time: false, range: () => figure.range },
          y: {
            distr: panel.log ? 3 : 1,
            range: (u, low, high) => {  // of the figure, until zoomed: then of what is shown
              if (low === null || (figure.range[0] === panel.x[0] && figure.range[1] === panel.x[1])) return panel.y;
              return panel.log ? uPlot.rangeLog(low, high, 10, true) : uPlot.rangeNum(low, high, 0.1, true);
            },
          },
        },
        axes: [axis, { ...axis, size: 60 }],
        series: [{ label: "time / s", value: (u, v) => (v === null ? "–" : v.toFixed(2)) }, ...series],
        cursor: { sync: { key: "time" }, drag: { x: true, y: false, setScale: false } },
        hooks: {
          setSelect: [(u) => {
            if (u.select.width < 6) return;
            figure.zoom(u.posToVal(u.select.left, "x"), u.posToVal(u.select.left + u.select.width, "x"));
            u.setSelect({ left: 0, width: 0, top: 0, height: 0 }, false);
          }],
          draw: [(u) => {
            const c = u.ctx, top = u.bbox.top, low = top + u.bbox.height;
            c.save();
            c.beginPath(); c.rect(u.bbox.left, top, u.bbox.width, u.bbox.height); c.clip();
            for (const limit of panel.limits) {
              const y = u.valToPos(limit.y, "y", true);
              c.strokeStyle = css(limit.colour); c.setLineDash([6, 4]);
              c.beginPath(); c.moveTo(u.bbox.left, y); c.lineTo(u.bbox.left + u.bbox.width, y); c.stroke();
            }
            const x = u.valToPos(now, "x", true);
            c.strokeStyle = css("--ink"); c.setLineDash([]);
            c.beginPath(); c.moveTo(x, top); c.lineTo(x, low); c.stroke();
            c.restore();
          }],
        },
      };
      const tables = panel.curves.map((c) => [numbers(c.x), numbers(c.y)]);
      const chart = new uPlot(options, uPlot.join(tables), this.box);
      let pressed = 0;
      chart.over.addEventListener("mousedown", (e) => { pressed = e.clientX; });
      chart.over.addEventListener("click", (e) => {
        if (Math.abs(e.clientX - pressed) < 4) seek(chart.posToVal(e.clientX - chart.over.getBoundingClientRect().left, "x"));
      });
      chart.over.addEventListener("dblclick", () => this.zoom(...panel.x));
      return chart;
    }
    zoom(from, to) {
      const [first, last] = this.panels[0].x;
      this.range = [Math.max(first, from), Math.min(last, to)];
      this.charts.forEach((chart) => chart.setScale("x", { min: this.range[0], max: this.range[1] }));
    }
    scaled(factor) {  // about the cursor, or the middle if it is not shown
      const [from, to] = this.range, half = (to - from) * factor / 2;
      const middle = now > from && now < to ? now : (from + to) / 2;
      this.zoom(middle - half, middle + half);
    }
    resize() { this.charts.forEach((chart) => chart.setSize({ width: this.box.clientWidth, height: 220 })); }
    redraw() {  // and show the values at this time
      this.charts.forEach((chart) => {
        chart.redraw(false);
        chart.setCursor({ left: chart.valToPos(now, "x"), top: 1 }, false);
      });
    }
  }

  const open = new Map(), cursors = [];
  for (const [name, panels] of Object.entries(data.figures)) {
    const figure = document.getElementById("plot-" + name);
    const still = figure.querySelector(".still"), charts = figure.querySelector(".charts");
    for (const panel of panels) {
      const [left, top, width, height] = panel.box;
      const area = document.createElement("div"), line = document.createElement("i");
      area.className = "panel";
      Object.assign(area.style, { left: left + "%", top: top + "%", width: width + "%", height: height + "%" });
      area.append(line);
      still.append(area);
      area.addEventListener("click", (e) => {
        const r = area.getBoundingClientRect();
        seek(panel.x[0] + (panel.x[1] - panel.x[0]) * (e.clientX - r.left) / r.width);
      });
      cursors.push([line, panel.x]);
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
        open.get(name).redraw();
        return;
      }
      open.get(name).charts.forEach((chart) => chart.destroy());
      open.delete(name);
    });
    const more = add("+", "closer, about the cursor", () => open.get(name).scaled(0.5));
    const less = add("−", "wider", () => open.get(name).scaled(2));
    const all = add("whole", "whole flight", () => open.get(name).zoom(...panels[0].x));
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
