// Interaction: controls, pointers and keys; displayed text.

const pictures = [0, 1].map((k) => new Picture($(`picture-${k}`), k));
const images = DATA.views.map((view) => Object.assign(new Image(), { src: `data:image/jpeg;base64,${view.jpeg}` }));
const textures = [];
let waiting = false;

// Redraw at most once per screen frame, and only after a change.
function redraw() {
  if (waiting) return;
  waiting = true;
  requestAnimationFrame(() => {
    waiting = false;
    drawSpace();
    drawPictures();
    document.body.dataset.drawn = String(Number(document.body.dataset.drawn || 0) + 1);
  });
}

function drawPictures() {
  const s = shots[state.now];
  pictures.forEach((picture, k) => {
    const index = [s.view_0, s.view_1][k];
    if (index === null) return;
    picture.show(DATA.views[index], images[index].complete && images[index].naturalWidth ? images[index] : null);
    picture.draw(s, { colours: s.css, visible: visible(s), tracks: show.tracks, depth: show.depth && scales.depth, picked: state.picked });
  });
}

// ----------------------------------------------------------------------------------------------------------- text

function facts(list, entries) {
  list.replaceChildren(...Object.entries(entries).flatMap(([key, value]) => [element("dt", {}, key), element("dd", {}, String(value))]));
}

function tellPair() {
  const s = shots[state.now], [a, b] = [s.view_0, s.view_1].map((k) => (k === null ? null : DATA.views[k]));
  const when = a && a.time !== null ? `, ${a.time.toFixed(2)} s` : "";
  $("pair-name").textContent = shots.length > 1 ? `pair ${state.now + 1} of ${shots.length}: ${s.label}${when}` : `pair ${s.label}${when}`;
  $("pair").setAttribute("aria-valuetext", $("pair-name").textContent);
  [a, b].forEach((view, k) => {
    if (!view) return;
    $(`name-${k}`).textContent = k ? `source view, frame ${view.number}: tracked samples` : `reference view, frame ${view.number}: samples`;
    $(`picture-${k}`).setAttribute("aria-label", `Picture of frame ${view.number} with ${k ? "tracks" : "samples"}`);
  });
  $("gate-list").replaceChildren(...outcomes.filter((o) => shots.some((x) => x.counts[o.key])).map((o) => element("li", {}, swatch(o.colour), `${o.name} ${s.counts[o.key]}`)));
  $("pair-facts").textContent = Object.entries(s.facts).map(([key, value]) => `${key}: ${value}`).join(" · ");
  drawGates($("gates"), shots, outcomes, state.now, choosePair);
  tellSample();
}

function tellCoverage() {
  const chosen = state.all ? shots : [shots[state.now]], total = { holes: 0, answers: 0, kept: 0, swept: 0, filled: 0, stay: { swept: 0, filled: 0 } };
  const risk = { scores: [], errors: [], candidates: 0 };
  for (const s of chosen) for (let k = 0; k < s.swept.n; k++) { const name = s.swept.source[k] === 5 ? "filled" : "swept"; total[name]++; total.stay[name] += s.swept.score[k] >= state.threshold; }
  for (const s of chosen) for (let k = 0; k < s.n; k++) {
    if (s.source[k] !== 1) total.holes++;
    if (s.source[k] >= 2) { total.answers++; total.kept += s.score[k] >= state.threshold; }
    risk.candidates += s.candidate[k];
    if (Number.isFinite(s.error[k])) { risk.scores.push(s.score[k]); risk.errors.push(s.error[k]); }
  }
  const left = risk.errors.filter((_, k) => risk.scores[k] >= state.threshold);
  const share = hasViews ? `: ${percent(total.kept / total.holes)} of the ${total.holes} samples without a usable return` : "";
  const first = [total.answers ? `${total.kept.toLocaleString("en")} of ${total.answers.toLocaleString("en")} answers shown${share}.` : "", ...["swept", "filled"].map((name) => (total[name] ? `${total.stay[name].toLocaleString("en")} of ${total[name].toLocaleString("en")} ${name === "swept" ? "recovered (swept)" : name} points shown.` : ""))].filter(Boolean).join(" ") || "Nothing was recovered beyond the sensor.";
  const second = left.length ? ` Of ${risk.candidates} held-out returns ${percent(left.length / risk.candidates)} are answered, median error ${percent(quantile(left, 0.5))}.` : "";
  $("coverage").textContent = first + second;
  $("threshold-value").textContent = state.threshold.toFixed(2);
  drawRisk($("risk"), risk, state.threshold);
}

function tellSample() {
  const s = shots[state.now], k = state.picked;
  $("sample-hint").toggleAttribute("hidden", k !== null);
  if (k === null) return facts($("sample-facts"), {});
  const source = s.source[k], sampleFacts = { sample: k, source: ["none", "sensor", "recovered", "swept"][source] };
  if (source) sampleFacts.depth = `${short(s.depth[k])} m ± ${short(s.sigma[k])} m (${percent(s.sigma[k] / s.depth[k])})`;
  if (source && causeOf[s.cause[k]]) sampleFacts["sigma mostly from"] = causeOf[s.cause[k]].name;
  if (source) sampleFacts[source === 1 ? "confidence" : "score"] = s.score[k].toFixed(2);
  if (source === 0) sampleFacts["no answer because of"] = gateOf[s.gate[k]]?.name ?? s.gate[k];
  if (source !== 1 && holeOf[s.hole[k]]) sampleFacts["no return because of"] = holeOf[s.hole[k]].name;
  if (Number.isFinite(s.error[k])) sampleFacts["error"] = percent(s.error[k]);
  if (Number.isFinite(s.parallax_deg[k])) sampleFacts.parallax = `${short(s.parallax_deg[k])}°`;
  if (Number.isFinite(s.residual_px[k])) sampleFacts["reprojection"] = `${short(s.residual_px[k])} px`;
  facts($("sample-facts"), sampleFacts);
}

function tellColours() {
  const mode = state.mode, box = $("legend"), rows = [], scale = scales[mode];
  const key = (colour, name) => element("li", {}, swatch(colour), name);
  if (scale) {
    const bar = element("canvas", { width: 208, height: 1, "aria-hidden": "true" }), pen = bar.getContext("2d");
    for (let x = 0; x < 208; x++) { pen.fillStyle = css(along(scale.ramp, x / 207)); pen.fillRect(x, 0, 1, 1); }
    rows.push(bar, element("div", { class: "ticks" }, ...scale.ticks().map((t) => element("span", {}, t))));
  } else {
    const seen = (name, code, want) => shots.some((s) => s[name].some((v, k) => v === code && want(s.source[k])));
    const list = mode === "hole" ? [[DATA.colours.sensor, "sensor"], ...DATA.holes.filter((h) => seen("hole", h.code, (x) => x !== 1)).map((h) => [h.colour, h.name])]
      : mode === "gate" ? outcomes.filter((o) => shots.some((s) => s.counts[o.key])).map((o) => [o.colour, o.name])
      : mode === "cause" ? DATA.causes.filter((c) => shots.some((s) => s.cause.includes(c.code) || s.swept.cause.includes(c.code))).map((c) => [c.colour, c.name])
      : mode === "picture" ? []
      : [[DATA.colours.sensor, "sensor"], ...(hasRecovered ? [[DATA.colours.recovered, "recovered"]] : []), ...(hasSwept ? [[DATA.colours.swept, "recovered (swept)"]] : []), ...(hasFilled ? [[DATA.colours.filled, "filled"]] : []), ...(hasViews ? [[DATA.colours.unanswered, "no answer (in the images)"]] : [])];
    rows.push(element("ul", { class: "keys" }, ...list.map(([colour, name]) => key(colour, name))));
  }
  rows.push(element("p", { class: "grid-size" }, `grid: ${ground.metres} m`));
  box.replaceChildren(element("h2", {}, MODES.find(([k]) => k === mode)[1]), ...rows);
}

// --------------------------------------------------------------------------------------------------------- choices

function choosePair(k) {
  state.now = (k + shots.length) % shots.length;
  state.picked = null;
  $("pair").value = state.now;
  tellPair();
  tellCoverage();
  redraw();
}

function chooseColour(mode) {
  state.mode = $("colour").value = mode;
  recolour();
  tellColours();
  redraw();
}

function pick(k) {
  state.picked = k;
  tellSample();
  redraw();
}

function toggle(name, on = !show[name]) {
  show[name] = document.querySelector(`[data-show="${name}"]`).checked = on;
  if (name === "swept" || name === "filled") hideSwept();
  redraw();
}

function play() {
  if (state.playing) clearInterval(state.playing);
  state.playing = state.playing ? null : setInterval(() => choosePair(state.now + 1), 900);
  $("play").textContent = state.playing ? "❚❚" : "▶";
  $("play").setAttribute("aria-pressed", String(Boolean(state.playing)));
}

// Candidate directions of the overview: the one with the nearest camera that shows all points is used.
const OVER = [-0.55, -0.9, 0.55, 0.9].flatMap((yaw) => [9, 13, 17].map((pitch) => [yaw, pitch / 20]));

// At most 400 items, evenly spaced.
function everyFew(many) {
  const step = Math.max(1, Math.ceil(many.length / 400));
  return many.filter((_, k) => k % step === 0);
}

// View along the reference camera, rotated, from a distance at which nearly all points and the camera are visible.
function lookFrom(name) {
  const s = shots[state.now], l = layers[state.now], T = s.T_world_from_0, o = centre(T), ahead = axis(T, 2);
  if (!l) return;
  eye.fov = 0.9;
  eye.yaw = Math.atan2(dot(ahead, eye.right), dot(ahead, eye.ahead));
  eye.pitch = Math.asin(Math.max(-1, Math.min(1, dot(ahead, eye.down))));
  if (name === "camera" && s.view_0 !== null) {
    const v = DATA.views[s.view_0], box = space.canvas;
    const tall = Math.max(v.hw[0], (v.hw[1] * box.clientHeight) / Math.max(box.clientWidth, 1));
    eye.fov = 2 * Math.atan((0.5 * tall) / v.f[1]);
    eye.distance = size.depth;
    eye.target = add(o, ahead, size.depth);
    return redraw();
  }
  const points = everyFew([...Array(s.n).keys()].filter((k) => s.source[k])).map((k) => l.world.subarray(3 * k, 3 * k + 3));
  for (const k of everyFew([...Array(s.swept.n).keys()])) points.push(place(s.T_world_from_0, ...s.swept.xyz.subarray(3 * k, 3 * k + 3)));
  const aspect = space.canvas.clientWidth / Math.max(space.canvas.clientHeight, 1), { yaw, pitch } = eye;
  const ways = { over: OVER, above: [[0, 1.5 - pitch]], side: [[-1.3, 0.15]], camera: [[0, 0]] }[name];
  const from = (turn) => { Object.assign(eye, { yaw, pitch }); eye.turn(...turn); eye.fit([...points, o], aspect, 0.07 * size.depth); return eye.distance; };
  const near = ways.map(from);
  from(ways[near.indexOf(Math.min(...near))]);
  redraw();
}

// -------------------------------------------------------------------------------------------------- pointers and keys

function nearestInSpace(x, y) {
  const s = shots[state.now], l = layers[state.now], shown = visible(s);
  let best = 16 ** 2, found = null;
  for (let k = 0; k < s.n; k++) {
    if (!s.source[k] || !shown(k)) continue;
    const at = space.onScreen(l.world.subarray(3 * k, 3 * k + 3));
    const d = at ? (at[0] - x) ** 2 + (at[1] - y) ** 2 : Infinity;
    if (d < best) { best = d; found = k; }
  }
  return found;
}

function listenInSpace(canvas) {
  const down = new Map();
  let moved = 0;
  const spread = () => { const [a, b] = [...down.values()]; return { x: (a.x + b.x) / 2, y: (a.y + b.y) / 2, d: Math.hypot(a.x - b.x, a.y - b.y) || 1 }; };
  canvas.addEventListener("pointerdown", (e) => { canvas.setPointerCapture(e.pointerId); down.set(e.pointerId, { x: e.clientX, y: e.clientY }); moved = 0; });
  canvas.addEventListener("pointermove", (e) => {
    const last = down.get(e.pointerId);
    if (!last) return;
    const before = down.size === 2 ? spread() : last, h = canvas.clientHeight;
    down.set(e.pointerId, { x: e.clientX, y: e.clientY });
    const after = down.size === 2 ? spread() : { x: e.clientX, y: e.clientY };
    const [dx, dy] = [(after.x - before.x) / h, (after.y - before.y) / h];
    moved += Math.abs(dx) + Math.abs(dy);
    if (down.size === 2) { eye.zoom(before.d / after.d); eye.shift(dx, dy); }
    else if (e.shiftKey || e.buttons & 6) eye.shift(dx, dy);
    else eye.turn(-3 * dx, 3 * dy);
    redraw();
  });
  canvas.addEventListener("pointerup", (e) => {
    const box = canvas.getBoundingClientRect();
    if (moved < 0.01 && down.size === 1) pick(nearestInSpace(e.clientX - box.left, e.clientY - box.top));
    down.delete(e.pointerId);
  });
  canvas.addEventListener("pointercancel", (e) => down.delete(e.pointerId));
  canvas.addEventListener("contextmenu", (e) => e.preventDefault());
  canvas.addEventListener("wheel", (e) => { e.preventDefault(); eye.zoom(Math.exp(Math.max(-100, Math.min(100, e.deltaY)) * 0.002)); redraw(); }, { passive: false });
  canvas.addEventListener("dblclick", () => { if (state.picked !== null) { eye.target = [...layers[state.now].world.subarray(3 * state.picked, 3 * state.picked + 3)]; redraw(); } });
  canvas.addEventListener("keydown", (e) => {
    const [dx, dy] = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key] || [0, 0];
    if (!dx && !dy) return;
    e.preventDefault();
    if (e.shiftKey) eye.shift(-0.05 * dx, -0.05 * dy);
    else eye.turn(0.1 * dx, 0.1 * dy);
    redraw();
  });
}

const KEYS = {
  "[": () => choosePair(state.now - 1), "]": () => choosePair(state.now + 1), " ": play,
  c: () => chooseColour(MODES[(MODES.findIndex(([k]) => k === state.mode) + 1) % MODES.length][0]),
  "+": () => { eye.zoom(0.9); redraw(); }, "=": () => { eye.zoom(0.9); redraw(); }, "-": () => { eye.zoom(1 / 0.9); redraw(); },
  o: () => lookFrom("over"), v: () => lookFrom("camera"), a: () => lookFrom("above"), d: () => lookFrom("side"),
  s: () => toggle("sensor"), r: () => toggle("recovered"), h: () => toggle("held_out"), w: () => toggle("swept"), i: () => toggle("filled"), u: () => toggle("sigma"), f: () => toggle("frustums"), t: () => toggle("tracks"), g: () => toggle("grid"),
};

function listen() {
  listenInSpace($("space"));
  document.addEventListener("keydown", (e) => {
    const typing = /^(INPUT|SELECT|BUTTON|SUMMARY)$/.test(e.target.tagName) && (e.key === " " || e.target.tagName === "SELECT");
    const act = KEYS[e.key.toLowerCase()];
    if (act && !typing && !e.ctrlKey && !e.metaKey && !e.altKey) { e.preventDefault(); act(); }
  });
  for (const button of document.querySelectorAll("[data-place]")) button.addEventListener("click", () => lookFrom(button.dataset.place));
  for (const box of document.querySelectorAll("[data-show]")) box.addEventListener("change", () => toggle(box.dataset.show, box.checked));
  $("colour").addEventListener("change", (e) => chooseColour(e.target.value));
  $("threshold").addEventListener("input", (e) => { state.threshold = Number(e.target.value); tellCoverage(); redraw(); });
  $("pair").addEventListener("input", (e) => choosePair(Number(e.target.value)));
  $("all").addEventListener("change", (e) => { state.all = e.target.checked; tellCoverage(); redraw(); });
  $("play").addEventListener("click", play);
  pictures.forEach((picture) => {
    for (const kind of ["pointermove", "pointerdown"]) picture.canvas.addEventListener(kind, (e) => { if (picture.view) pick(picture.nearest(e, shots[state.now], visible(shots[state.now])) ?? state.picked); });
  });
  images.forEach((image, k) => image.addEventListener("load", () => { if (space.gl) textures[k] = space.texture(image); redraw(); }));
  new ResizeObserver(redraw).observe($("stage"));
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", redraw);
}

function begin() {
  $("facts").textContent = DATA.about;
  facts($("about-facts"), DATA.facts);
  $("colour").append(...MODES.map(([value, name]) => element("option", { value }, name)));
  $("pair").max = shots.length - 1;
  for (const id of ["play", "pair"]) $(id).toggleAttribute("hidden", shots.length < 2);
  $("all-row").toggleAttribute("hidden", shots.length < 2 || !DATA.placed);
  $("pictures").toggleAttribute("hidden", !hasViews);
  $("time").toggleAttribute("hidden", !hasViews);
  document.querySelector('[data-place="camera"]').toggleAttribute("hidden", !hasViews);
  $("no-gl").toggleAttribute("hidden", Boolean(space.gl));
  $("space").setAttribute("aria-label", `Points of ${DATA.title} in space: arrow keys turn, plus and minus zoom`);
  for (const [name, has] of [["held_out", shots.some((s) => s.held_out.n)], ["recovered", hasRecovered], ["swept", hasSwept], ["filled", hasFilled], ["unanswered", hasViews], ["tracks", hasViews], ["depth", hasViews], ["frustums", hasViews]]) {
    document.querySelector(`[data-show="${name}"]`).closest("label").toggleAttribute("hidden", !has);
  }
  listen();
  choosePair(0);
  chooseColour(state.mode);
  lookFrom("over");
}

begin();
