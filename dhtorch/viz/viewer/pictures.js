// Colours, the two images with their samples, the timeline of gates, the risk-coverage curve.

const hex = (text) => [1, 3, 5].map((k) => parseInt(text.slice(k, k + 2), 16) / 255);
const css = (c) => `rgb(${c.map((v) => Math.round(255 * Math.max(0, Math.min(1, v)))).join(" ")})`;
const luma = (c) => 0.299 * c[0] + 0.587 * c[1] + 0.114 * c[2];

function along(ramp, share) {
  const x = Math.max(0, Math.min(1, share)) * (ramp.length - 1), k = Math.min(ramp.length - 2, Math.floor(x)), t = x - k;
  return ramp[k].map((v, i) => v + t * (ramp[k + 1][i] - v));
}

function quantile(values, q) {
  const sorted = Float64Array.from(values).filter(Number.isFinite).sort();
  return sorted.length ? sorted[Math.min(sorted.length - 1, Math.floor(q * sorted.length))] : NaN;
}

const short = (v) => (!Number.isFinite(v) ? "–" : Math.abs(v) >= 100 ? v.toFixed(0) : Math.abs(v) >= 1 ? v.toFixed(2) : String(Number(v.toPrecision(2))));
const percent = (v) => (Number.isFinite(v) ? `${(100 * v).toFixed(100 * v < 9.95 ? 1 : 0)} %` : "–");

// Logarithmic or linear scale from values to a colour ramp.
class Scale {
  constructor(values, ramp, { log = true, range = null, unit = "" } = {}) {
    [this.low, this.high] = range || [quantile(values, 0.02), quantile(values, 0.98)];
    if (!(this.high > this.low)) [this.low, this.high] = Number.isFinite(this.low) ? [this.low * 0.9, this.low * 1.1 + 1e-6] : [0.1, 1];
    this.log = log && this.low > 0;
    Object.assign(this, { ramp: DATA.ramps[ramp].map(hex), unit });
  }

  colour(v) {
    const f = this.log ? Math.log : (x) => x;
    return along(this.ramp, (f(Math.max(v, this.log ? 1e-9 : v)) - f(this.low)) / (f(this.high) - f(this.low)));
  }

  ticks() {
    return [0, 0.5, 1].map((t) => (this.log ? this.low * (this.high / this.low) ** t : this.low + t * (this.high - this.low)))
      .map((v) => (this.unit === "%" ? percent(v) : `${short(v)}${this.unit && " " + this.unit}`));
  }
}

// One of the two images of a pair, with the outcome of its samples.
class Picture {
  constructor(canvas, which) {
    Object.assign(this, { canvas, which, image: null });
    this.context = canvas.getContext("2d");
  }

  show(view, image) { Object.assign(this, { view, image }); }

  // Image pixels → canvas pixels; integer image coordinates are pixel centres.
  at(u, v) { return [(u + 0.5) * this.scale, (v + 0.5) * this.scale]; }

  draw(shot, { colours, visible, tracks, depth, picked }) {
    const { canvas, context: pen, view, image } = this;
    if (!view) return;
    const ratio = window.devicePixelRatio || 1, [H, W] = view.hw, wide = Math.max(1, Math.round(canvas.clientWidth * ratio));
    const tall = Math.round((wide * H) / W);
    canvas.style.aspectRatio = `${W} / ${H}`;
    if (canvas.width !== wide || canvas.height !== tall) Object.assign(canvas, { width: wide, height: tall });
    this.scale = wide / W;
    pen.globalAlpha = 1;
    pen.clearRect(0, 0, wide, tall);
    pen.globalAlpha = 0.72;
    if (image) pen.drawImage(image, 0, 0, wide, tall);
    pen.globalAlpha = 1;
    if (depth && this.which === 0) this.drawDepth(shot, depth);
    const uv = this.which ? shot.uv_1 : shot.uv_0, r = Math.max(1.3 * ratio, wide / 260);
    for (let k = 0; k < shot.n; k++) {
      if (!visible(k) || (this.which && !shot.tracked[k])) continue;
      const [x, y] = this.at(uv[2 * k], uv[2 * k + 1]), answered = shot.source[k] === 2;
      pen.strokeStyle = pen.fillStyle = colours[k];
      if (this.which && tracks) {
        pen.globalAlpha = answered ? 0.8 : 0.35;
        pen.lineWidth = ratio * 0.8;
        pen.beginPath();
        pen.moveTo(...this.at(shot.uv_0[2 * k], shot.uv_0[2 * k + 1]));
        pen.lineTo(x, y);
        pen.stroke();
        pen.globalAlpha = 1;
      }
      if (shot.source[k] === 0) this.cross(x, y, 0.8 * r, ratio);
      else this.dot(x, y, answered ? r : 0.65 * r, answered ? 0.6 * ratio : 0);
    }
    if (picked !== null && (!this.which || shot.tracked[picked])) this.ring(...this.at(uv[2 * picked], uv[2 * picked + 1]), 4 * r, ratio);
  }

  dot(x, y, r, edge) {
    const pen = this.context;
    pen.beginPath();
    pen.arc(x, y, r, 0, 7);
    pen.fill();
    if (edge) { pen.strokeStyle = DATA.colours.white; pen.lineWidth = edge; pen.stroke(); }
  }

  cross(x, y, r, ratio) {
    const pen = this.context;
    pen.lineWidth = ratio;
    pen.beginPath();
    pen.moveTo(x - r, y - r); pen.lineTo(x + r, y + r);
    pen.moveTo(x + r, y - r); pen.lineTo(x - r, y + r);
    pen.stroke();
  }

  ring(x, y, r, ratio) {
    const pen = this.context;
    for (const [colour, width] of [[DATA.colours.black, 4], [DATA.colours.white, 2]]) {
      pen.strokeStyle = colour; pen.lineWidth = width * ratio;
      pen.beginPath(); pen.arc(x, y, r, 0, 7); pen.stroke();
    }
  }

  // Input returns, coloured by depth, each as large as its part of the image.
  drawDepth(shot, scale) {
    const { view, context: pen } = this, size = this.scale * Math.sqrt((view.hw[0] * view.hw[1]) / Math.max(shot.seen.n, 4000)) * 1.1;
    for (let k = 0; k < shot.seen.n; k++) {
      const [x, y, z] = shot.seen.xyz.subarray(3 * k, 3 * k + 3);
      const [u, v] = this.at((x / z) * view.f[0] + view.c[0], (y / z) * view.f[1] + view.c[1]);
      pen.fillStyle = css(scale.colour(z));
      pen.fillRect(u - size / 2, v - size / 2, size, size);
    }
  }

  // The sample under the pointer, or null.
  nearest(event, shot, visible) {
    const box = this.canvas.getBoundingClientRect(), f = this.view.hw[1] / box.width, uv = this.which ? shot.uv_1 : shot.uv_0;
    const [x, y] = [(event.clientX - box.left) * f - 0.5, (event.clientY - box.top) * f - 0.5];
    let best = (18 * f) ** 2, found = null;
    for (let k = 0; k < shot.n; k++) {
      const d = (uv[2 * k] - x) ** 2 + (uv[2 * k + 1] - y) ** 2;
      if (d < best && visible(k) && (!this.which || shot.tracked[k])) { best = d; found = k; }
    }
    return found;
  }
}

function element(name, attributes = {}, ...children) {
  const svg = ["svg", "rect", "path", "line", "circle", "text", "g", "title"].includes(name);
  const made = svg ? document.createElementNS("http://www.w3.org/2000/svg", name) : document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...children);
  return made;
}

const swatch = (colour) => { const i = element("i"); i.style.background = colour; return i; };

// Stacked columns, one per pair: outcomes of its samples.
function drawGates(svg, shots, outcomes, now, choose) {
  const wide = 100 / shots.length;
  svg.setAttribute("viewBox", "0 0 100 40");
  svg.replaceChildren();
  shots.forEach((shot, k) => {
    const column = element("g", { class: "column" }), total = outcomes.reduce((sum, o) => sum + shot.counts[o.key], 0) || 1;
    column.append(element("title", {}, `${shot.label}: ` + outcomes.filter((o) => shot.counts[o.key]).map((o) => `${shot.counts[o.key]} ${o.name}`).join(", ")));
    let y = 40;
    for (const o of outcomes) {
      const h = (40 * shot.counts[o.key]) / total;
      y -= h;
      if (h) column.append(element("rect", { x: k * wide + 0.08 * Math.min(wide, 4), y, width: wide - 0.16 * Math.min(wide, 4), height: h, fill: o.colour }));
    }
    column.addEventListener("click", () => choose(k));
    svg.append(column);
  });
  if (shots.length > 1) svg.append(element("rect", { class: "now", x: now * wide, y: 0, width: wide, height: 40 }));
}

// Mean error of the answers of highest score against the answered fraction of the candidates; the dot is the threshold.
function drawRisk(svg, { scores, errors, candidates }, threshold) {
  const order = scores.map((_, k) => k).sort((a, b) => scores[b] - scores[a]);
  svg.toggleAttribute("hidden", order.length < 10);
  if (order.length < 10) return;
  const points = [];
  let sum = 0, kept = 0, at = null;
  order.forEach((k, n) => {
    sum += Math.min(errors[k], 1);
    if (scores[k] >= threshold) kept = n + 1;
    if (n >= 9) points.push([(n + 1) / candidates, sum / (n + 1)]);
    if (kept === n + 1 && n >= 9) at = points[points.length - 1];
  });
  const top = points.reduce((most, p) => Math.max(most, p[1]), 0.05) * 1.15, X = (v) => 30 + 280 * v, Y = (v) => 78 - (68 * v) / top;
  const path = points.map((p, k) => `${k ? "L" : "M"}${X(p[0]).toFixed(1)} ${Y(p[1]).toFixed(1)}`).join("");
  const line = (x1, y1, x2, y2) => element("line", { x1, y1, x2, y2 });
  svg.replaceChildren(
    line(X(0), Y(0), X(1), Y(0)), line(X(0), Y(0), X(0), Y(top)),
    element("text", { x: 2, y: 16 }, percent(top / 1.15)), element("text", { x: 2, y: 82 }, "0"),
    element("text", { x: X(1), y: 92, "text-anchor": "end" }, "answered fraction of the candidates → 100 %"),
    element("text", { x: X(0) + 6, y: 16 }, "mean error"), element("path", { d: path }),
    ...(at ? [element("circle", { cx: X(at[0]), cy: Y(at[1]), r: 4.5 })] : []));
  svg.setAttribute("aria-label", at ? `Mean error ${percent(at[1])} where ${percent(at[0])} of the candidates are answered` : "Fewer than ten answers stay");
}
