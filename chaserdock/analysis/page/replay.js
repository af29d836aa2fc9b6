/* SPDX-License-Identifier: Apache-2.0 */
// 3-D replay: flat faces on a 2-D canvas in order of depth (painter's algorithm), without library or request.
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

  function css(name) { return getComputedStyle(document.documentElement).getPropertyValue(name).trim(); }
  function rgb(hex) { return [1, 3, 5].map((k) => parseInt(hex.slice(k, k + 2), 16)); }

  function draw() {
    const ratio = window.devicePixelRatio || 1;
    const width = canvas.clientWidth, height = canvas.clientHeight;
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
    const reach = 3.1 * data.reach_m / zoom, focal = 1.25 * Math.min(width, height * 1.35);
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
    function polygon(points, colour) {
      if (points.some((p) => p[2] < 0.02)) return;
      context.fillStyle = colour; context.strokeStyle = colour; context.lineWidth = 0.5;
      context.beginPath();
      points.forEach((p, k) => (k ? context.lineTo(p[0], p[1]) : context.moveTo(p[0], p[1])));
      context.closePath(); context.fill(); context.stroke();
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

    const faces = [];
    function add(body, list, tint) {
      for (const face of list) {
        const normal = apply(body.m, face.n);
        const corners = [0, 3, 6, 9].map((k) => sum(apply(body.m, face.c.slice(k, k + 3)), body.p));
        const middle = corners.reduce(sum, [0, 0, 0]).map((v) => v / 4);
        const from = apply(turn, minus(middle, centre));
        const toEye = [eye[0] * reach - from[0], eye[1] * reach - from[1], eye[2] * reach - from[2]];
        if (dot(apply(turn, normal), toEye) <= 0) continue;
        const lit = 0.5 + 0.5 * Math.max(0, dot(normal, light));
        faces.push({ depth: Math.hypot(...toEye) - face.l, body, face, corners, lit, tint });
      }
    }
    const poses = data.chasers.map((c) => pose(c, time));
    add(target, data.scene.target, null);
    data.chasers.forEach((c, k) => add(poses[k], data.scene.chaser, rgb(css("--series-" + (c.id % 8)))));
    faces.sort((a, b) => b.depth - a.depth);
    function shade(grey, lit, tint) {
      const g = grey * lit;
      return tint ? `rgb(${tint.map((v) => Math.round(Math.min(255, v * (0.3 + 0.75 * lit * grey / 110) + 18))).join()})` : `rgb(${g},${g},${g})`;
    }
    for (const f of faces) {
      polygon(f.corners.map(see), shade(f.face.g, f.lit, f.tint));
      for (const [quad, grey] of f.face.d) {
        polygon([0, 3, 6, 9].map((k) => see(sum(apply(f.body.m, quad.slice(k, k + 3)), f.body.p))), shade(grey, f.lit, null));
      }
    }

    // Camera frustums, bright while the image is used.
    data.chasers.forEach((c, k) => {
      const colour = css("--series-" + (c.id % 8));
      const origin = see(sum(apply(poses[k].m, data.scene.camera_origin), poses[k].p));
      const far = [0, 3, 6, 9].map((n) => see(sum(apply(poses[k].m, data.scene.camera_corners.slice(n, n + 3)), poses[k].p)));
      context.globalAlpha = at(c.outcome, time) === "used" ? 0.9 : 0.25;
      far.forEach((corner) => line([origin, corner], colour, 0.8));
      line([...far, far[0]], colour, 0.8);
      context.globalAlpha = 1;
      context.fillStyle = css("--ink"); context.font = "600 12px system-ui, sans-serif";
      const label = see(sum(poses[k].p, [0, 0, 0]));
      context.strokeStyle = css("--panel"); context.lineWidth = 3;
      context.strokeText(String(c.id), label[0] + 26, label[1] - 22);
      context.fillText(String(c.id), label[0] + 26, label[1] - 22);
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
