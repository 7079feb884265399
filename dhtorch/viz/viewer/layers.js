// Data and colours of the page, and its layers of points and lines.

const DATA = JSON.parse(document.getElementById("data").textContent);
const $ = (id) => document.getElementById(id);
const TYPES = { f4: Float32Array, u2: Uint16Array, u1: Uint8Array };

function unpack(packed) {
  const bytes = Uint8Array.from(atob(packed.base64), (c) => c.charCodeAt(0));
  return new TYPES[packed.type](bytes.buffer);
}

function cloud(packed) {
  const steps = unpack(packed.xyz), n = steps.length / 3, xyz = new Float32Array(3 * n);
  for (let k = 0; k < 3 * n; k++) xyz[k] = packed.low[k % 3] + packed.step[k % 3] * steps[k];
  return { n, xyz, rgb: unpack(packed.rgb) };
}

const shots = DATA.shots.map((s) => {
  const columns = Object.fromEntries(Object.entries(s.samples).map(([name, packed]) => [name, unpack(packed)]));
  for (const name of ["uv_0", "uv_1"]) columns[name] = Float32Array.from(columns[name], (v) => v / DATA.per_pixel - DATA.margin_px);
  columns.score = Float32Array.from(columns.score, (v) => v / 65535);
  const swept = { ...cloud(s.swept), sigma: unpack(s.swept.sigma), score: Float32Array.from(unpack(s.swept.score), (v) => v / 65535), source: unpack(s.swept.source), cause: unpack(s.swept.cause) };
  swept.depth = Float32Array.from({ length: swept.n }, (_, k) => DATA.views.length ? swept.xyz[3 * k + 2] : Math.hypot(...swept.xyz.subarray(3 * k, 3 * k + 3))); // a map's origin is no camera
  return { ...s, ...columns, n: columns.depth.length, seen: cloud(s.seen), held_out: cloud(s.held_out), swept };
});
const outcomes = DATA.outcomes, gateOf = Object.fromEntries(DATA.gates.map((g) => [g.code, g])), holeOf = Object.fromEntries(DATA.holes.map((h) => [h.code, h]));
const causeOf = Object.fromEntries(DATA.causes.map((c) => [c.code, c])), hasCauses = shots.some((s) => s.cause.some((c) => c) || s.swept.cause.some((c) => c));
const SENSOR = hex(DATA.colours.sensor), RECOVERED = hex(DATA.colours.recovered), SWEPT = hex(DATA.colours.swept), FILLED = hex(DATA.colours.filled), UNANSWERED = hex(DATA.colours.unanswered);
const PALE = hex(DATA.colours.pale), HIDDEN_RETURN = hex(DATA.colours.hidden_return), [BY_DAY, BY_NIGHT] = [0, 1].map((k) => ({ stage: hex(DATA.page.stage[k]), rim: hex(DATA.page.rim[k]) }));
const everything = (name, wanted = () => true) => shots.flatMap((s) => Array.from(s[name]).filter((_, k) => wanted(s, k)));
const answered = (s, k) => s.source[k] === 2;
const hasErrors = shots.some((s) => s.error.some(Number.isFinite));
const hasViews = DATA.views.length > 0, hasRecovered = shots.some((s) => s.source.includes(2)), [hasSwept, hasFilled] = [3, 5].map((code) => shots.some((s) => s.swept.source.includes(code)));
const depths = () => [...everything("depth", (s, k) => s.source[k] > 0), ...shots.flatMap((s) => Array.from(s.swept.depth))];

const scales = {
  depth: new Scale(depths(), "depth", { unit: "m" }),
  sigma: new Scale(shots.flatMap((s) => [...Array.from(s.sigma).map((v, k) => v / s.depth[k]).filter((_, k) => answered(s, k)), ...Array.from(s.swept.sigma, (v, k) => v / s.swept.depth[k])]), "error", { unit: "%" }),
  score: new Scale([], "score", { log: false, range: [0, 1] }),
  error: new Scale(everything("error"), "error", { unit: "%", range: [0.003, 0.3] }),
};
const MODES = [["picture", "own colour"], ["source", "source"], ["hole", "class of hole"], ["gate", "gate"], ["depth", "depth"], ["sigma", "sigma / depth"], ["score", "score"], ["cause", "largest cause of sigma"], ["error", "error against held-back returns"]]
  .filter(([key]) => (key !== "error" || hasErrors) && (key !== "cause" || hasCauses));
const state = { now: 0, all: false, mode: "picture", threshold: 0, picked: null, playing: null };
const show = Object.fromEntries([...document.querySelectorAll("[data-show]")].map((box) => [box.dataset.show, box.checked]));

// Colour of sample k: of its code, or of its value on a scale; unanswered samples are pale.
function sampleColour(s, k) {
  const mode = state.mode, source = s.source[k];
  if (mode === "hole") return holeOf[s.hole[k]] ? hex(holeOf[s.hole[k]].colour) : SENSOR;
  if (mode === "cause") return source && causeOf[s.cause[k]] ? hex(causeOf[s.cause[k]].colour) : UNANSWERED;
  if (mode === "gate") return source === 1 ? SENSOR : source === 2 ? RECOVERED : hex(gateOf[s.gate[k]]?.colour || DATA.colours.unanswered);
  if (mode === "source" || mode === "picture") return [UNANSWERED, SENSOR, RECOVERED][source];
  if (source === 0 || (source === 1 && mode !== "depth")) return source ? PALE : UNANSWERED;
  const value = mode === "sigma" ? s.sigma[k] / s.depth[k] : s[mode][k];
  return Number.isFinite(value) ? scales[mode].colour(value) : UNANSWERED;
}

// Colour of a return of a depth map: that of the image, tinted in modes that distinguish sources.
function returnColour(cloud, k, heldOut) {
  const rgb = [0, 1, 2].map((c) => cloud.rgb[3 * k + c] / 255), grey = luma(rgb);
  if (state.mode === "picture") return rgb;
  if (state.mode === "depth") return scales.depth.colour(cloud.xyz[3 * k + 2]).map((v) => v * (0.5 + 0.6 * grey));
  if (scales[state.mode] || state.mode === "cause") return PALE.map((v) => 0.67 * v + 0.45 * grey);
  if (heldOut) return HIDDEN_RETURN.map((v) => v * (0.5 + grey));
  return SENSOR.map((v, c) => 0.75 * v * (0.35 + 1.3 * grey) + 0.25 * rgb[c]);
}

// Colour of a swept or filled pixel: of its value on a scale, else that of the image in the tint of its source.
function sweptColour(cloud, k) {
  const rgb = [0, 1, 2].map((c) => cloud.rgb[3 * k + c] / 255), grey = luma(rgb), mode = state.mode;
  if (mode === "picture") return rgb;
  if (mode === "cause" && causeOf[cloud.cause[k]]) return hex(causeOf[cloud.cause[k]].colour).map((v) => v * (0.5 + 0.6 * grey));
  const value = { depth: cloud.depth[k], sigma: cloud.sigma[k] / cloud.depth[k], score: cloud.score[k] }[mode];
  if (value !== undefined) return scales[mode].colour(value).map((v) => v * (0.5 + 0.6 * grey));
  if (scales[mode]) return PALE.map((v) => 0.67 * v + 0.45 * grey);
  return (cloud.source[k] === 5 ? FILLED : SWEPT).map((v, c) => 0.75 * v * (0.35 + 1.3 * grey) + 0.25 * rgb[c]);
}

function colours(n, colour) {
  const out = new Float32Array(3 * n);
  for (let k = 0; k < n; k++) out.set(colour(k), 3 * k);
  return out;
}

// ------------------------------------------------------------------------------------------------- layers in space

const space = new Space($("space"));
const eye = new Eye(shots[0].T_world_from_0);

function transformed(T, xyz) {
  const out = new Float32Array(xyz.length);
  for (let k = 0; k < xyz.length; k += 3) out.set(place(T, xyz[k], xyz[k + 1], xyz[k + 2]), k);
  return out;
}

// Rows of the given samples of a pair, with the ends of their ± sigma bars along the ray.
function buildShot(s) {
  const T = s.T_world_from_0, o = centre(T), pick = (wanted) => [...Array(s.n).keys()].filter((k) => s.source[k] === wanted);
  const groups = { sensor: pick(1), recovered: pick(2) }, world = transformed(T, s.xyz), at = (k) => world.subarray(3 * k, 3 * k + 3);
  const rows = (ks) => Float32Array.from(ks.flatMap((k) => [...at(k)]));
  const bars = groups.recovered.flatMap((k) => [-1, 1].flatMap((sign) => add(at(k), sub(at(k), o), Math.max(-0.9, (sign * s.sigma[k]) / s.depth[k]))));
  const step = Math.ceil(groups.recovered.length / 90), some = groups.recovered.filter((_, k) => k % step === 0);
  const ends = [o, ...(s.T_world_from_1 ? [centre(s.T_world_from_1)] : [])];
  const rays = some.flatMap((k) => ends.flatMap((end) => [...end, ...at(k)]));
  const twice = (ks, n) => Float32Array.from(ks.flatMap((k) => Array(n).fill(s.score[k])));
  const tone = (n) => new Float32Array(3 * n);
  return {
    groups, world,
    sensor: space.layer({ position: rows(groups.sensor), colour: tone(groups.sensor.length) }),
    recovered: space.layer({ position: rows(groups.recovered), colour: tone(groups.recovered.length), score: twice(groups.recovered, 1) }),
    bars: space.layer({ position: Float32Array.from(bars), colour: tone(2 * groups.recovered.length), score: twice(groups.recovered, 2) }),
    rays: space.layer({ position: Float32Array.from(rays), colour: colours(rays.length / 3, () => RECOVERED), score: twice(some, 2 * ends.length) }),
    seen: space.layer({ position: transformed(T, s.seen.xyz), colour: tone(s.seen.n) }),
    held_out: space.layer({ position: transformed(T, s.held_out.xyz), colour: tone(s.held_out.n) }),
    ...sweptLayers(s, T),
    frustums: frustums(s),
  };
}

// Swept pixels: triangles between neighbours on one surface, opacity by score, and points elsewhere.
const [SURE, UNSURE, FAINTEST, JUMP] = [0.02, 0.15, 0.25, 1.08];
function sweptLayers(s, T) {
  const cloud = s.swept, { n, depth, sigma, step_px: step } = cloud, made = { swept: space.layer({ position: transformed(T, cloud.xyz), colour: new Float32Array(3 * n), score: cloud.score }) };
  const view = DATA.views[s.view_0];
  if (!space.gl || !n || n > 65535 || !step || !view) return made;
  const at = new Map(), place = [], wide = 1 + Math.ceil(view.hw[1] / step), used = new Uint8Array(n), index = [];
  for (let k = 0; k < n; k++) {
    const [u, v] = [0, 1].map((c) => Math.round(((cloud.xyz[3 * k + c] / depth[k]) * view.f[c] + view.c[c]) / step));
    at.set(v * wide + u, k);
    place.push(v * wide + u);
  }
  const joined = (...ks) => { const z = ks.map((k) => depth[k]); if (ks.includes(undefined) || Math.max(...z) > JUMP * Math.min(...z)) return; index.push(...ks); for (const k of ks) used[k] = 1; };
  for (let k = 0; k < n; k++) {
    const [a, b, c] = [1, wide, wide + 1].map((d) => at.get(place[k] + d));
    joined(k, a, b);
    joined(a, c, b);
  }
  const opacity = Float32Array.from({ length: n }, (_, k) => 1 - (1 - FAINTEST) * Math.max(0, Math.min(1, (sigma[k] / depth[k] - SURE) / (UNSURE - SURE))));
  const loose = [...Array(n).keys()].filter((k) => !used[k]), rows = made.swept && transformed(T, cloud.xyz);
  made.surface = index.length ? space.triangles(Uint16Array.from(index), opacity) : null;
  made.loose = loose;
  made.grains = space.layer({ position: Float32Array.from(loose.flatMap((k) => [...rows.subarray(3 * k, 3 * k + 3)])), colour: new Float32Array(3 * loose.length), score: Float32Array.from(loose, (k) => cloud.score[k]) });
  return made;
}

// Ground grid of 1 m (0.1 m or 10 m by scene size), below nearly all points, level with the first camera.
const ground = (() => {
  const rows = shots.flatMap((s) => [s.xyz, s.swept.xyz].flatMap((xyz) => { const out = [], step = 3 * Math.max(1, Math.ceil(xyz.length / 6000)); for (let k = 0; k + 2 < xyz.length; k += step) if (Number.isFinite(xyz[k])) out.push(place(s.T_world_from_0, xyz[k], xyz[k + 1], xyz[k + 2])); return out; }));
  if (!rows.length) return { metres: 1, layer: null };
  const span = (a, low, high) => [low, high].map((q) => quantile(rows.map((p) => dot(p, a)), q));
  const [across, along] = [eye.right, eye.ahead].map((a) => span(a, 0.02, 0.98)), floor = span(eye.down, 0.02, 0.98)[1];
  const extent = Math.max(across[1] - across[0], along[1] - along[0]), metres = extent > 25 ? 10 : extent > 1.5 ? 1 : 0.1;
  const whole = ([low, high]) => { const first = Math.floor(low / metres), last = Math.ceil(high / metres); return Array.from({ length: Math.min(last - first, 60) + 1 }, (_, k) => (first + k) * metres); };
  const [us, vs] = [whole(across), whole(along)], at = (u, v) => add(add(add([0, 0, 0], eye.right, u), eye.ahead, v), eye.down, floor);
  const lines = [...us.flatMap((u) => [at(u, vs[0]), at(u, vs.at(-1))]), ...vs.flatMap((v) => [at(us[0], v), at(us.at(-1), v)])].flat();
  return { metres, layer: space.layer({ position: Float32Array.from(lines), colour: colours(lines.length / 3, () => UNANSWERED) }) };
})();

// Cameras as pyramids with a height of a tenth of the typical depth.
function frustums(s) {
  const made = [];
  for (const [T, index, colour] of [[s.T_world_from_0, s.view_0, SENSOR], [s.T_world_from_1, s.view_1, RECOVERED]]) {
    if (!T || index === null) continue;
    const v = DATA.views[index], z = 0.12 * size.depth, tip = centre(T);
    const corner = (x, y) => place(T, ((x - v.c[0]) / v.f[0]) * z, ((y - v.c[1]) / v.f[1]) * z, z);
    const [a, b, c, d] = [corner(-0.5, -0.5), corner(v.hw[1] - 0.5, -0.5), corner(v.hw[1] - 0.5, v.hw[0] - 0.5), corner(-0.5, v.hw[0] - 0.5)];
    const position = Float32Array.from([tip, a, tip, b, tip, c, tip, d, a, b, b, c, c, d, d, a].flat());
    made.push({
      index, tip, lines: space.layer({ position, colour: colours(16, () => colour) }),
      quad: space.gl && { position: space.buffer(Float32Array.from([a, b, c, a, c, d].flat())), corner: space.buffer(Float32Array.from([0, 0, 1, 0, 1, 1, 0, 0, 1, 1, 0, 1])) },
    });
  }
  return made;
}

const size = { depth: quantile(depths(), 0.5) || 1 };
const layers = space.gl ? shots.map(buildShot) : [];
const path = space.gl && DATA.path ? (() => {
  const p = unpack(DATA.path), rows = [];
  for (let k = 3; k < p.length; k += 3) rows.push(...p.subarray(k - 3, k + 3));
  return space.layer({ position: Float32Array.from(rows), colour: colours(rows.length / 3, () => PALE) });
})() : null;

function recolour() {
  shots.forEach((s, n) => {
    const l = layers[n];
    if (!l) return;
    const own = (k) => (state.mode === "picture" ? [0, 1, 2].map((c) => s.rgb[3 * k + c] / 255) : sampleColour(s, k));
    for (const name of ["sensor", "recovered"]) space.refill(l[name], "colour", colours(l.groups[name].length, (k) => own(l.groups[name][k])));
    space.refill(l.bars, "colour", colours(2 * l.groups.recovered.length, (k) => own(l.groups.recovered[k >> 1])));
    for (const name of ["seen", "held_out"]) space.refill(l[name], "colour", colours(s[name].n, (k) => returnColour(s[name], k, name === "held_out")));
    space.refill(l.swept, "colour", colours(s.swept.n, (k) => sweptColour(s.swept, k)));
    if (l.grains) space.refill(l.grains, "colour", colours(l.loose.length, (k) => sweptColour(s.swept, l.loose[k])));
    s.css = Array.from({ length: s.n }, (_, k) => css(sampleColour(s, k)));
  });
  if (!layers.length) shots.forEach((s) => { s.css = Array.from({ length: s.n }, (_, k) => css(sampleColour(s, k))); });
}

// Scores of swept and filled pixels, below every threshold where their source is not shown.
function hideSwept() {
  shots.forEach((s, n) => {
    const l = layers[n], score = (k) => (show[s.swept.source[k] === 5 ? "filled" : "swept"] ? s.swept.score[k] : -1);
    if (!l) return;
    space.refill(l.swept, "score", Float32Array.from({ length: s.swept.n }, (_, k) => score(k)));
    if (l.grains) space.refill(l.grains, "score", Float32Array.from(l.loose, score));
  });
}

const visible = (s) => (k) => {
  const source = s.source[k];
  if (source === 2) return show.recovered && s.score[k] >= state.threshold;
  return source === 1 ? show.sensor : show.unanswered;
};

function drawSpace() {
  if (!space.gl) return;
  const dark = matchMedia("(prefers-color-scheme: dark)").matches;
  space.begin(eye, (dark ? BY_NIGHT : BY_DAY).stage);
  const grain = 0.006 * size.depth, threshold = state.threshold;
  layers.forEach((l, n) => {
    if (!state.all && n !== state.now) return;
    if (show.sensor) {
      space.points(l.seen, { size: grain, smallest: 1.4 });
      space.points(l.sensor, { size: 1.3 * grain, smallest: l.seen ? 1.6 : 2.5 });
    }
    if (show.held_out) space.points(l.held_out, { size: grain, smallest: 1.4 });
    if (l.surface) space.surface(l.swept, l.surface, { threshold });
    space.points(l.surface ? l.grains : l.swept, { size: grain, smallest: 1.4, threshold });
    if (show.recovered && l.recovered) {
      const large = 1 + 1.8 * Math.min(1, 3000 / l.recovered.n); // few points are drawn large, a dense cloud is not
      space.points(l.recovered, { size: large * grain, smallest: 1.4 * large, threshold, rim: (dark ? BY_NIGHT : BY_DAY).rim, rimmed: 0.75 });
      if (show.sigma) space.lines(l.bars, { threshold });
    }
    if (hasViews && show.tracks && show.recovered && n === state.now) space.lines(l.rays, { alpha: 0.1, threshold });
    if (show.frustums) for (const f of l.frustums) {
      if (Math.hypot(...sub(f.tip, eye.position)) < 0.4 * size.depth) continue; // it would cover everything else
      space.lines(f.lines);
      if (n === state.now && textures[f.index]) space.picture(f.quad, textures[f.index], 0.85);
    }
  });
  if (show.frustums && DATA.placed) space.lines(path);
  if (show.grid) space.lines(ground.layer, { alpha: 0.45 });
  mark();
}

// Ring around the selected sample with its depth: elements over the canvas, never hidden by 3D points.
function mark() {
  const k = state.picked, p = k === null ? [NaN] : layers[state.now].world.subarray(3 * k, 3 * k + 3);
  const at = Number.isFinite(p[0]) ? space.onScreen(p) : null, box = space.canvas;
  for (const id of ["mark", "read-out"]) $(id).toggleAttribute("hidden", !at);
  if (!at) return;
  $("mark").style.transform = `translate(${at[0]}px, ${at[1]}px)`;
  const s = shots[state.now], name = s.source[k] === 1 ? "sensor" : "recovered";
  $("read-out").replaceChildren(element("b", {}, `${short(s.depth[k])} m ± ${short(s.sigma[k])} m`), ` ${name}${s.source[k] === 2 ? `, score ${s.score[k].toFixed(2)}` : ""}`);
  const left = Math.max(4, Math.min(at[0] + 14, box.clientWidth - $("read-out").offsetWidth - 4)), top = Math.max(4, Math.min(at[1] - 14, box.clientHeight - 34));
  $("read-out").style.transform = `translate(${left}px, ${top}px)`;
}
