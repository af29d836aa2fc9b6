/* SPDX-License-Identifier: Apache-2.0 */
// 3-D replay: triangles with a depth buffer on a 2-D canvas, without library, request or graphics processor.
(function () {
  "use strict";
  const data = JSON.parse(document.getElementById("replay-data").textContent);
  const canvas = document.getElementById("replay");
  const context = canvas.getContext("2d");
  const by = (id) => document.getElementById(id);
  const slider = by("replay-time"), button = by("replay-play"), clock = by("replay-clock");
  const speed = by("replay-speed"), ride = by("replay-ride"), views = by("replay-views");
  const light = unit(data.sun);
  const end = data.times[data.times.length - 1];
  let time = 0, playing = false, before = null, azimuth = -0.9, elevation = 0.45, zoom = 1;

  function unit(v) { const n = Math.hypot(v[0], v[1], v[2]) || 1; return [v[0] / n, v[1] / n, v[2] / n]; }
  function dot(a, b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
  function matrix(q) {
    const [w, x, y, z] = q;
    return [
      [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
      [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
      [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ];
  }
  function apply(m, v) { return [dot(m[0], v), dot(m[1], v), dot(m[2], v)]; }
  function transposed(m) { return [0, 1, 2].map((k) => [m[0][k], m[1][k], m[2][k]]); }
  function sum(a, b) { return [a[0] + b[0], a[1] + b[1], a[2] + b[2]]; }
  function minus(a, b) { return [a[0] - b[0], a[1] - b[1], a[2] - b[2]]; }

  // Interpolation of a flat track: position linear, attitude linear and normalized (samples are close).
  function place(t) {
    let low = 0, high = data.times.length - 1;
    while (high - low > 1) { const mid = (low + high) >> 1; if (data.times[mid] <= t) low = mid; else high = mid; }
    const span = data.times[high] - data.times[low];
    return [low, high, span > 0 ? Math.min(1, Math.max(0, (t - data.times[low]) / span)) : 0];
  }
  function row(list, width, k) { return list.slice(width * k, width * k + width); }
  function pose(body, t) {
    const last = body.p.length / 3 - 1;
    let [a, b, f] = place(t);
    a = Math.min(a, last); b = Math.min(b, last);
    const p = row(body.p, 3, a), r = row(body.p, 3, b), q = row(body.q, 4, a), s = row(body.q, 4, b);
    const sign = q[0] * s[0] + q[1] * s[1] + q[2] * s[2] + q[3] * s[3] < 0 ? -1 : 1;
    const mixed = q.map((v, k) => v * (1 - f) + sign * s[k] * f);
    const n = Math.hypot(...mixed);
    return { p: p.map((v, k) => v * (1 - f) + r[k] * f), m: matrix(mixed.map((v) => v / n)) };
  }
  function at(list, t) {
    let last = null;
    for (const item of list) { if (item[0] > t + 1e-9) break; last = item[1]; }
    return last;
  }

  // Bodies: for each triangle its corners (9 numbers, m), its normal and its coat.
  function shape(body) {
    const corners = [], normals = [], coats = [];
    for (const coat of body.coats) {
      const bytes = Uint8Array.from(atob(data.arrays[coat.corners]), (c) => c.charCodeAt(0));
      const own = Array.from(new Int16Array(bytes.buffer), (v) => v * body.unit_m);
      for (let k = 0; k < own.length; k += 9) {
        const c = own.slice(k, k + 9);
        const a = [c[3] - c[0], c[4] - c[1], c[5] - c[2]], b = [c[6] - c[0], c[7] - c[1], c[8] - c[2]];
        corners.push(...c); coats.push(coat);
        normals.push(unit([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]));
      }
    }
    return { corners, normals, coats };
  }
  const shapes = [data.target, ...data.chasers].map((b) => shape(b.body));
  const display = Array.from({ length: 1024 }, (_, k) => Math.round(255 * (k / 1023) ** data.gamma));

  class Raster {  // pixels with the inverse of their depth, twice as fine as the canvas: smooth edges
    constructor() { this.canvas = document.createElement("canvas"); this.width = this.top = this.low = 0; }
    begin(width, height) {
      if (this.width !== width || this.height !== height) {
        this.width = this.canvas.width = width; this.height = this.canvas.height = height;
        this.context = this.canvas.getContext("2d");
        this.image = new ImageData(width, height);
        this.pixels = new Uint32Array(this.image.data.buffer);
        this.near = new Float32Array(width * height);
      }
      for (const buffer of [this.pixels, this.near]) buffer.fill(0, this.top * width, this.low * width);
      this.top = height; this.low = 0;  // rows from and before which something is drawn
    }
    triangle(p, q, r, colour) {  // x, y and inverse of the depth of each corner
      const area = (q[0] - p[0]) * (r[1] - p[1]) - (r[0] - p[0]) * (q[1] - p[1]);
      if (area >= 0) return;  // seen from behind: y points down
      const dx = ((q[2] - p[2]) * (r[1] - p[1]) - (r[2] - p[2]) * (q[1] - p[1])) / area;
      const dy = ((r[2] - p[2]) * (q[0] - p[0]) - (q[2] - p[2]) * (r[0] - p[0])) / area;
      const edges = [[p, q], [q, r], [r, p]].map(([a, b]) => [b[1] - a[1], a[0] - b[0], a[1] * b[0] - a[0] * b[1]]);
      const top = Math.max(0, Math.ceil(Math.min(p[1], q[1], r[1]) - 0.5));
      const low = Math.min(this.height - 1, Math.floor(Math.max(p[1], q[1], r[1]) - 0.5));
      this.top = Math.min(this.top, top); this.low = Math.max(this.low, low + 1);
      for (let y = top; y <= low; y += 1) {
        let from = 0, to = this.width - 1;
        for (const [a, b, c] of edges) {
          const rest = b * (y + 0.5) + c;
          if (a > 0) from = Math.max(from, Math.ceil(-rest / a - 0.5));
          else if (a < 0) to = Math.min(to, Math.floor(-rest / a - 0.5));
          else if (rest < 0) to = -1;
        }
        let near = p[2] + dx * (from + 0.5 - p[0]) + dy * (y + 0.5 - p[1]);
        for (let k = y * this.width + from; k <= y * this.width + to; k += 1, near += dx) {
          if (near > this.near[k]) { this.near[k] = near; this.pixels[k] = colour; }
        }
      }
    }
    end(context, width, height) {  // draw on a canvas of this size
      const rows = this.low - this.top, scale = height / this.height;
      if (rows <= 0) return;
      this.context.putImageData(this.image, 0, 0, 0, this.top, this.width, rows);
      context.drawImage(this.canvas, 0, this.top, this.width, rows, 0, this.top * scale, width, rows * scale);
    }
  }
  const raster = new Raster();

  function css(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }

  function draw() {
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
    if (!width || !height) return;  // not laid out yet
    if (canvas.width !== Math.round(width * ratio) || canvas.height !== Math.round(height * ratio)) {
      canvas.width = Math.round(width * ratio); canvas.height = Math.round(height * ratio);
    }
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    context.clearRect(0, 0, width, height);
    const target = pose(data.target, time);
    const turn = ride.checked ? transposed(target.m) : [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
    const eye = [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
    const right = unit([-eye[1], eye[0], 0]);
    const up = [eye[1] * right[2] - eye[2] * right[1], eye[2] * right[0] - eye[0] * right[2], eye[0] * right[1] - eye[1] * right[0]];
    const poses = data.chasers.map((c) => pose(c, time));
    const nearest = Math.min(...poses.map((p) => Math.hypot(...minus(p.p, target.p))));  // from afar one is in the picture
    const reach = 3.1 * Math.max(data.reach_m, nearest) / zoom, focal = 1.25 * Math.min(width, height * 1.35);
    const centre = target.p;
    function see(world) {  // image x and y, and depth
      const v = apply(turn, minus(world, centre));
      const depth = reach - dot(v, eye);
      return [width / 2 + focal * dot(v, right) / depth, height / 2 - focal * dot(v, up) / depth, depth];
    }
    function line(points, colour, thick, dashes) {
      context.strokeStyle = colour; context.lineWidth = thick; context.setLineDash(dashes || []);
      context.beginPath();
      let open = false;
      for (const p of points) {
        if (p[2] < 0.02) { open = false; continue; }
        if (open) context.lineTo(p[0], p[1]); else context.moveTo(p[0], p[1]);
        open = true;
      }
      context.stroke(); context.setLineDash([]);
    }

    // Paths: past strong, future faint. In the target frame they are relative to the target.
    const now = place(time)[0];
    function path(body, colour) {
      const past = [], coming = [];
      for (let k = 0; k < body.p.length / 3; k += 1) {
        let p = row(body.p, 3, k);
        if (ride.checked) {
          const then = matrix(row(data.target.q, 4, Math.min(k, data.target.q.length / 4 - 1)));
          const back = apply(transposed(then), minus(p, row(data.target.p, 3, Math.min(k, data.target.p.length / 3 - 1))));
          p = sum(apply(target.m, back), target.p);
        }
        const s = see(p);
        if (k <= now) past.push(s);
        if (k >= now) coming.push(s);
      }
      context.globalAlpha = 0.3; line(coming, colour, 1, [3, 4]);
      context.globalAlpha = 0.85; line(past, colour, 1.4);
      context.globalAlpha = 1;
    }
    if (!ride.checked) path(data.target, css("--faint"));
    data.chasers.forEach((c) => path(c, css("--series-" + (c.id % 8))));

    const fine = Math.max(2, ratio), toEye = apply(transposed(turn), eye), half = unit(sum(light, toEye));
    raster.begin(Math.round(fine * width), Math.round(fine * height));
    function lit(coat, normal) {  // colour as a pixel: sun, ambient light and Blinn's highlight
      const sun = (1 - data.ambient) * Math.max(0, dot(normal, light));
      const shine = sun > 0 ? (1 - data.ambient) * Math.max(0, dot(normal, half)) ** coat.exponent : 0;
      const [r, g, b] = coat.rgb.map((v, k) => {
        const level = v * (data.ambient + sun) + coat.specular[k] * shine;
        return display[Math.round(1023 * Math.min(1, level))];
      });
      return (255 << 24 | b << 16 | g << 8 | r) >>> 0;
    }
    function add(body, own) {
      const { corners, normals, coats } = own, back = transposed(body.m);
      const view = [right, up, eye].map((axis) => apply(back, apply(transposed(turn), axis)));  // in body axes
      const shift = apply(turn, minus(body.p, centre));
      const [across, along, towards] = [right, up, eye].map((axis) => dot(axis, shift));
      const viewer = apply(back, sum(toEye.map((v) => v * reach), minus(centre, body.p)));
      const pixel = (k) => {
        const c = [corners[k], corners[k + 1], corners[k + 2]], depth = reach - towards - dot(view[2], c);
        if (depth < 0.02) return null;
        const scale = fine * focal / depth;
        return [fine * width / 2 + scale * (across + dot(view[0], c)), fine * height / 2 - scale * (along + dot(view[1], c)), 1 / depth];
      };
      coats.forEach((coat, k) => {
        const n = normals[k], first = 9 * k;
        if (dot(n, viewer) <= n[0] * corners[first] + n[1] * corners[first + 1] + n[2] * corners[first + 2]) return;
        const p = pixel(first), q = pixel(first + 3), r = pixel(first + 6);
        if (p && q && r) raster.triangle(p, q, r, lit(coat, apply(body.m, n)));
      });
    }
    [target, ...poses].forEach((body, k) => add(body, shapes[k]));
    raster.end(context, width, height);

    function label(text, [x, y]) {
      context.fillStyle = css("--ink"); context.font = "600 12px system-ui, sans-serif";
      context.strokeStyle = css("--panel"); context.lineWidth = 3;
      context.strokeText(text, x + 26, y - 22);
      context.fillText(text, x + 26, y - 22);
    }
    if (nearest > data.reach_m) label("target", see(target.p));  // a dot from so far away
    // Camera frustums, bright while the image is used.
    data.chasers.forEach((c, k) => {
      const colour = css("--series-" + (c.id % 8));
      const origin = see(sum(apply(poses[k].m, data.camera_origin), poses[k].p));
      const far = [0, 3, 6, 9].map((n) => see(sum(apply(poses[k].m, data.camera_corners.slice(n, n + 3)), poses[k].p)));
      context.globalAlpha = at(c.outcome, time) === "used" ? 0.9 : 0.25;
      far.forEach((corner) => line([origin, corner], colour, 0.8));
      line([...far, far[0]], colour, 0.8);
      context.globalAlpha = 1;
      label(String(c.id), see(poses[k].p));
    });

    clock.textContent = time.toFixed(1) + " s";
    document.dispatchEvent(new CustomEvent("replay-time", { detail: time }));
    slider.value = String(time);
    data.chasers.forEach((c, k) => {
      const [a] = place(time);
      by("replay-row-" + c.id).replaceChildren(...[
        "chaser " + c.id, at(c.phase, time) || "–", Math.hypot(...minus(poses[k].p, target.p)).toFixed(3) + " m",
        a < c.error_mm.length ? c.error_mm[a].toFixed(c.error_mm[a] < 10 ? 2 : 0) + " mm" : "–", at(c.outcome, time) || "–",
      ].map((text, n) => {
        const cell = document.createElement(n ? "td" : "th");
        cell.textContent = text;
        if (!n) cell.style.color = css("--series-" + (c.id % 8));
        return cell;
      }));
    });
    const shot = at(data.images.times.map((t, k) => [t, k]), time);
    if (shot !== null) {
      for (const image of views.querySelectorAll("img")) {
        const source = data.images.chasers[image.dataset.chaser][shot];
        if (source && image.getAttribute("src") !== source) image.setAttribute("src", source);
      }
    }
  }

  function step(stamp) {
    if (!playing) return;
    if (before !== null) time += (stamp - before) / 1000 * Number(speed.value);
    before = stamp;
    if (time >= end) { time = end; play(false); }
    draw();
    if (playing) requestAnimationFrame(step);
  }
  function play(on) {
    playing = on; before = null;
    button.textContent = on ? "Pause" : "Play";
    if (on) { if (time >= end) time = 0; requestAnimationFrame(step); }
  }
  button.addEventListener("click", () => play(!playing));
  slider.addEventListener("input", () => { time = Number(slider.value); draw(); });
  ride.addEventListener("change", draw);
  for (const jump of document.querySelectorAll("button[data-time]")) {
    jump.addEventListener("click", () => { time = Math.min(end, Number(jump.dataset.time)); play(false); draw(); canvas.scrollIntoView({ block: "center" }); });
  }
  document.addEventListener("replay-seek", (e) => { time = Math.min(end, Math.max(0, e.detail)); play(false); draw(); });
  let held = null;
  canvas.addEventListener("pointerdown", (e) => { held = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointerup", () => { held = null; });
  canvas.addEventListener("pointermove", (e) => {
    if (!held) return;
    azimuth -= (e.clientX - held[0]) * 0.008;
    elevation = Math.max(-1.5, Math.min(1.5, elevation + (e.clientY - held[1]) * 0.008));
    held = [e.clientX, e.clientY]; draw();
  });
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); zoom = Math.max(0.3, Math.min(8, zoom * Math.exp(-e.deltaY * 0.001))); draw(); }, { passive: false });
  canvas.addEventListener("keydown", (e) => {
    const turns = { ArrowLeft: [-0.1, 0], ArrowRight: [0.1, 0], ArrowUp: [0, 0.1], ArrowDown: [0, -0.1] }[e.key];
    if (turns) { azimuth += turns[0]; elevation = Math.max(-1.5, Math.min(1.5, elevation + turns[1])); }
    else if (e.key === " ") play(!playing);
    else if (e.key === "+") zoom = Math.min(8, zoom * 1.2);
    else if (e.key === "-") zoom = Math.max(0.3, zoom / 1.2);
    else return;
    e.preventDefault(); draw();
  });
  window.addEventListener("resize", draw);
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  draw();
})();
