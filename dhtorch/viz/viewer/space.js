// 3D view: small matrices, shaders, and one object that draws layers of points, lines and images with WebGL.
// Matrices are column-major arrays of 16; a pose is a row-major 3×4 that maps camera coordinates to the world.

const POINT_VERTEX = `
attribute vec3 position; attribute vec3 colour; attribute float score;
uniform mat4 matrix; uniform float size, smallest, threshold; varying vec3 tint;
void main() {
  gl_Position = matrix * vec4(position, 1.0);
  gl_PointSize = clamp(size / gl_Position.w, smallest, 40.0);
  if (score < threshold) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  tint = colour;
}`;
const POINT_FRAGMENT = `
precision mediump float; varying vec3 tint; uniform vec3 rim; uniform float rimmed;
void main() {
  vec2 d = gl_PointCoord * 2.0 - 1.0; float r = dot(d, d);
  if (r > 1.0) discard;
  gl_FragColor = vec4(mix(tint, rim, rimmed * smoothstep(0.55, 0.95, r)), 1.0);
}`;
const SURFACE_VERTEX = `
attribute vec3 position; attribute vec3 colour; attribute float score; attribute float opacity;
uniform mat4 matrix; uniform float threshold; varying vec3 tint; varying float dense;
void main() {
  gl_Position = matrix * vec4(position, 1.0);
  tint = colour;
  dense = score < threshold ? -1.0 : opacity;
}`;
// Opacity by drawing a fraction of the pixels: triangles need no sorting.
const SURFACE_FRAGMENT = `
precision mediump float; varying vec3 tint; varying float dense;
void main() {
  vec2 p = mod(floor(gl_FragCoord.xy), 4.0);
  float rank = mod(p.x + p.y, 2.0) * 0.5 + mod(floor(p.x / 2.0) + floor(p.y / 2.0), 2.0) * 0.25 + mod(p.y, 2.0) * 0.125;
  if (dense <= rank) discard;
  gl_FragColor = vec4(tint, 1.0);
}`;
const LINE_VERTEX = `
attribute vec3 position; attribute vec3 colour; attribute float score;
uniform mat4 matrix; uniform float threshold; varying vec3 tint;
void main() {
  gl_Position = matrix * vec4(position, 1.0);
  if (score < threshold) gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
  tint = colour;
}`;
const LINE_FRAGMENT = "precision mediump float; varying vec3 tint; uniform float alpha; void main() { gl_FragColor = vec4(tint, alpha); }";
const PICTURE_VERTEX = `
attribute vec3 position; attribute vec2 corner; uniform mat4 matrix; varying vec2 at;
void main() { gl_Position = matrix * vec4(position, 1.0); at = corner; }`;
const PICTURE_FRAGMENT = "precision mediump float; varying vec2 at; uniform sampler2D picture; uniform float alpha; void main() { gl_FragColor = vec4(texture2D(picture, at).rgb, alpha); }";

const add = (a, b, s = 1) => [a[0] + s * b[0], a[1] + s * b[1], a[2] + s * b[2]];
const sub = (a, b) => [a[0] - b[0], a[1] - b[1], a[2] - b[2]];
const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
const cross = (a, b) => [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
const unit = (a) => { const n = Math.hypot(...a) || 1; return [a[0] / n, a[1] / n, a[2] / n]; };
const place = (T, x, y, z) => [
  T[0] * x + T[1] * y + T[2] * z + T[3], T[4] * x + T[5] * y + T[6] * z + T[7], T[8] * x + T[9] * y + T[10] * z + T[11]];
const centre = (T) => [T[3], T[7], T[11]];
const axis = (T, k) => [T[k], T[4 + k], T[8 + k]];

function product(a, b) {
  const out = new Float32Array(16);
  for (let c = 0; c < 4; c++) for (let r = 0; r < 4; r++) {
    let sum = 0;
    for (let k = 0; k < 4; k++) sum += a[4 * k + r] * b[4 * c + k];
    out[4 * c + r] = sum;
  }
  return out;
}

function perspective(fov, aspect, near, far) {
  const f = 1 / Math.tan(fov / 2), d = 1 / (near - far);
  return [f / aspect, 0, 0, 0, 0, f, 0, 0, 0, 0, (far + near) * d, -1, 0, 0, 2 * far * near * d, 0];
}

function lookingFrom(eye, ahead, up) {
  const z = unit([-ahead[0], -ahead[1], -ahead[2]]), x = unit(cross(up, z)), y = cross(z, x);
  return [x[0], y[0], z[0], 0, x[1], y[1], z[1], 0, x[2], y[2], z[2], 0, -dot(x, eye), -dot(y, eye), -dot(z, eye), 1];
}

// Orbit camera around a target; yaw 0 and pitch 0 look along the first camera.
class Eye {
  constructor(T) {
    [this.right, this.down, this.ahead] = [0, 1, 2].map((k) => axis(T, k));
    Object.assign(this, { target: centre(T), yaw: 0, pitch: 0, distance: 1, fov: 0.9 });
  }

  get direction() {
    const c = Math.cos(this.pitch), s = Math.sin(this.pitch);
    return [0, 1, 2].map((k) => c * (Math.cos(this.yaw) * this.ahead[k] + Math.sin(this.yaw) * this.right[k]) + s * this.down[k]);
  }

  get position() { return add(this.target, this.direction, -this.distance); }

  turn(dx, dy) {
    this.yaw += dx;
    this.pitch = Math.max(-1.55, Math.min(1.55, this.pitch + dy));
  }

  // Moves the target across the view, in fractions of its height.
  shift(dx, dy) {
    const x = unit(cross(this.direction, this.down.map((v) => -v))), y = cross(x, this.direction);
    const reach = 2 * this.distance * Math.tan(this.fov / 2);
    this.target = add(add(this.target, x, -dx * reach), y, dy * reach);
  }

  zoom(factor) { this.distance = Math.max(1e-3, Math.min(1e5, this.distance * factor)); }

  // Moves target and distance until nearly all points fill the view, with a margin around the last one.
  fit(points, aspect, room) {
    const d = this.direction, x = unit(cross(d, this.down.map((v) => -v))), y = cross(x, d), t = Math.tan(this.fov / 2) * 0.92;
    const own = points[points.length - 1], span = (at, mine, r) => [Math.min(quantile(at, 0.01), mine - r), Math.max(quantile(at, 0.99), mine + r)];
    this.target = [0, 1, 2].map((k) => quantile(points.map((p) => p[k]), 0.5));
    this.distance = quantile(points.map((p) => Math.hypot(...sub(p, this.target))), 0.98) / t;
    for (let turn = 0; turn < 30; turn++) { // near points move more on the screen than far ones: iterate
      const eye = this.position, seen = points.map((p) => sub(p, eye)).map((p) => [dot(p, x), dot(p, y), Math.max(dot(p, d), 0.05 * this.distance)]);
      const [ox, oy, oz] = seen[seen.length - 1], margin = room / oz;
      const [left, right] = span(seen.map(([a, , c]) => a / c), ox / oz, margin), [low, high] = span(seen.map(([, b, c]) => b / c), oy / oz, margin);
      this.target = add(add(this.target, x, ((left + right) / 2) * this.distance), y, ((low + high) / 2) * this.distance);
      this.distance = Math.max(1e-3, this.distance * Math.max((right - left) / (2 * t * aspect), (high - low) / (2 * t)) ** 0.6);
    }
  }

  matrix(aspect) {
    const up = this.down.map((v) => -v);
    const far = this.distance * 60 + 200;
    return product(perspective(this.fov, aspect, this.distance * 0.01 + 0.002, far), lookingFrom(this.position, this.direction, up));
  }
}

class Space {
  constructor(canvas) {
    this.canvas = canvas;
    this.gl = canvas.getContext("webgl", { antialias: true, alpha: true, premultipliedAlpha: false, preserveDrawingBuffer: true });
    if (!this.gl) return;
    const gl = this.gl;
    this.programs = {
      points: this.program(POINT_VERTEX, POINT_FRAGMENT),
      surface: this.program(SURFACE_VERTEX, SURFACE_FRAGMENT),
      lines: this.program(LINE_VERTEX, LINE_FRAGMENT),
      picture: this.program(PICTURE_VERTEX, PICTURE_FRAGMENT),
    };
    gl.enable(gl.DEPTH_TEST);
    gl.blendFunc(gl.SRC_ALPHA, gl.ONE_MINUS_SRC_ALPHA);
  }

  program(vertex, fragment) {
    const gl = this.gl, made = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, vertex], [gl.FRAGMENT_SHADER, fragment]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      if (!gl.getShaderParameter(shader, gl.COMPILE_STATUS)) throw new Error(gl.getShaderInfoLog(shader));
      gl.attachShader(made, shader);
    }
    gl.linkProgram(made);
    if (!gl.getProgramParameter(made, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(made));
    return made;
  }

  buffer(data) {
    const gl = this.gl, made = gl.createBuffer();
    gl.bindBuffer(gl.ARRAY_BUFFER, made);
    gl.bufferData(gl.ARRAY_BUFFER, data, gl.STATIC_DRAW);
    return made;
  }

  // {position, colour, score} → buffers; without scores no threshold applies.
  triangles(index, opacity) {
    const gl = this.gl, made = gl.createBuffer();
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, made);
    gl.bufferData(gl.ELEMENT_ARRAY_BUFFER, index, gl.STATIC_DRAW);
    return { n: index.length, index: made, opacity: this.buffer(opacity) };
  }

  layer({ position, colour, score }) {
    const n = position.length / 3;
    if (!this.gl || !n) return null;
    return { n, position: this.buffer(position), colour: this.buffer(colour), score: this.buffer(score || new Float32Array(n).fill(2)) };
  }

  refill(layer, name, data) {
    if (!layer) return;
    this.gl.bindBuffer(this.gl.ARRAY_BUFFER, layer[name]);
    this.gl.bufferData(this.gl.ARRAY_BUFFER, data, this.gl.STATIC_DRAW);
  }

  texture(image) {
    const gl = this.gl, made = gl.createTexture();
    gl.bindTexture(gl.TEXTURE_2D, made);
    gl.texImage2D(gl.TEXTURE_2D, 0, gl.RGB, gl.RGB, gl.UNSIGNED_BYTE, image);
    for (const wrap of [gl.TEXTURE_WRAP_S, gl.TEXTURE_WRAP_T]) gl.texParameteri(gl.TEXTURE_2D, wrap, gl.CLAMP_TO_EDGE);
    gl.texParameteri(gl.TEXTURE_2D, gl.TEXTURE_MIN_FILTER, gl.LINEAR);
    return made;
  }

  begin(eye, ground) {
    const gl = this.gl, ratio = window.devicePixelRatio || 1, box = this.canvas.getBoundingClientRect();
    const [w, h] = [Math.max(1, Math.round(box.width * ratio)), Math.max(1, Math.round(box.height * ratio))];
    if (this.canvas.width !== w || this.canvas.height !== h) Object.assign(this.canvas, { width: w, height: h });
    gl.viewport(0, 0, w, h);
    gl.clearColor(...ground, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    this.matrix = eye.matrix(w / h);
    this.scale = h / (2 * Math.tan(eye.fov / 2));
    this.ratio = ratio;
  }

  use(name, attributes, uniforms) {
    const gl = this.gl, program = this.programs[name];
    gl.useProgram(program);
    gl.uniformMatrix4fv(gl.getUniformLocation(program, "matrix"), false, this.matrix);
    for (const [key, value] of Object.entries(uniforms)) {
      const at = gl.getUniformLocation(program, key);
      if (Array.isArray(value)) gl.uniform3f(at, ...value);
      else gl.uniform1f(at, value);
    }
    for (let k = 0; k < 4; k++) gl.disableVertexAttribArray(k);
    for (const [key, [buffer, size]] of Object.entries(attributes)) {
      const at = gl.getAttribLocation(program, key);
      if (at < 0) continue;
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.enableVertexAttribArray(at);
      gl.vertexAttribPointer(at, size, gl.FLOAT, false, 0, 0);
    }
  }

  points(layer, { size, smallest, threshold = 0, rim = [0, 0, 0], rimmed = 0 }) {
    if (!layer) return;
    const { position, colour, score, n } = layer, gl = this.gl;
    const uniforms = { size: size * this.scale, smallest: smallest * this.ratio, threshold, rim, rimmed };
    this.use("points", { position: [position, 3], colour: [colour, 3], score: [score, 1] }, uniforms);
    gl.disable(gl.BLEND);
    gl.drawArrays(gl.POINTS, 0, n);
  }

  // Triangles between the points of a layer: {n, index, opacity}.
  surface(layer, triangles, { threshold = 0 }) {
    if (!layer || !triangles) return;
    const { position, colour, score } = layer, gl = this.gl;
    this.use("surface", { position: [position, 3], colour: [colour, 3], score: [score, 1], opacity: [triangles.opacity, 1] }, { threshold });
    gl.disable(gl.BLEND);
    gl.bindBuffer(gl.ELEMENT_ARRAY_BUFFER, triangles.index);
    gl.drawElements(gl.TRIANGLES, triangles.n, gl.UNSIGNED_SHORT, 0);
  }

  lines(layer, { alpha = 1, threshold = 0 } = {}) {
    if (!layer) return;
    const { position, colour, score, n } = layer, gl = this.gl;
    this.use("lines", { position: [position, 3], colour: [colour, 3], score: [score, 1] }, { alpha, threshold });
    gl.enable(gl.BLEND);
    gl.depthMask(alpha === 1);
    gl.drawArrays(gl.LINES, 0, n);
    gl.depthMask(true);
  }

  picture(quad, texture, alpha) {
    const gl = this.gl;
    gl.bindTexture(gl.TEXTURE_2D, texture);
    this.use("picture", { position: [quad.position, 3], corner: [quad.corner, 2] }, { alpha });
    gl.enable(gl.BLEND);
    gl.drawArrays(gl.TRIANGLES, 0, 6);
  }

  // World point → position on the canvas, CSS pixels; null behind the camera.
  onScreen(p) {
    const m = this.matrix, w = m[3] * p[0] + m[7] * p[1] + m[11] * p[2] + m[15];
    if (w <= 0) return null;
    const x = (m[0] * p[0] + m[4] * p[1] + m[8] * p[2] + m[12]) / w, y = (m[1] * p[0] + m[5] * p[1] + m[9] * p[2] + m[13]) / w;
    return [(x + 1) / 2 * this.canvas.clientWidth, (1 - y) / 2 * this.canvas.clientHeight, w];
  }
}
