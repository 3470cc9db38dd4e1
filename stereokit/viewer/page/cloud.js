"use strict";
// The point cloud in WebGL 2. The graphics card makes the points of disparity; a frame sends disparity and colours alone.

const HIDDEN = -1e9;

const VERTEX = `#version 300 es
in float disparity;
in vec4 color;
uniform int columns;
uniform int step;         // one pixel of so many is drawn
uniform vec4 camera;      // fx, fy, cx, cy
uniform vec2 stereo;      // baseline fx, cx1 - cx0
uniform mat3 turn;
uniform vec3 pivot;
uniform float away;
uniform vec2 focal;       // of the screen, in dots
uniform vec2 centre;
uniform vec2 screen;
out vec3 tint;
void main() {
  tint = color.rgb;
  float shift = disparity + stereo.y;
  if (disparity < -1e8 || shift <= 0.0 || color.a == 0.0) {
    gl_Position = vec4(2.0, 2.0, 2.0, 1.0);
    gl_PointSize = 0.0;
    return;
  }
  float z = stereo.x / shift;
  int index = gl_VertexID * step;
  vec2 pixel = vec2(float(index % columns), float(index / columns));
  vec3 seen = turn * (vec3((pixel - camera.zw) * z / camera.xy, z) - pivot) + vec3(0.0, 0.0, away);
  vec2 place = (focal * seen.xy + centre * seen.z) * 2.0 / screen;
  float near = away * 0.01, far = away * 400.0;
  gl_Position = vec4(place.x, -place.y, ((far + near) * seen.z - 2.0 * far * near) / (far - near), seen.z);
  gl_PointSize = clamp(1.2 * sqrt(float(step)) * focal.x * z / camera.x / max(seen.z, near), 1.0, 48.0);
}`;

const FRAGMENT = `#version 300 es
precision mediump float;
in vec3 tint;
out vec4 result;
void main() { result = vec4(tint, 1.0); }`;

class Cloud {
  /** on: picked(pixel), key(event), turned() */
  constructor(canvas, marks, on) {
    this.canvas = canvas;
    this.marks = marks;
    this.on = on;
    this.geometry = null;
    this.ends = [];       // pixels that are measured between
    this.pixel = null;    // under the pointer in the pictures
    this.pressed = null;
    this.gl = canvas.getContext("webgl2", {antialias: false, alpha: false, preserveDrawingBuffer: false});
    if (!this.gl) return;
    this.prepare();
    canvas.addEventListener("webglcontextlost", event => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { this.prepare(); this.upload(); on.turned(); });
    canvas.addEventListener("pointerdown", event => this.down(event));
    canvas.addEventListener("pointermove", event => this.moved(event));
    canvas.addEventListener("pointerup", event => this.up(event));
    canvas.addEventListener("pointercancel", () => { this.pressed = null; });
    canvas.addEventListener("contextmenu", event => event.preventDefault());
    canvas.addEventListener("keydown", event => on.key(event));
    canvas.addEventListener("wheel", event => {
      event.preventDefault();
      this.nearer(Math.exp(event.deltaY / 500));
    }, {passive: false});
  }

  prepare() {
    const {gl} = this, program = gl.createProgram();
    for (const [kind, text] of [[gl.VERTEX_SHADER, VERTEX], [gl.FRAGMENT_SHADER, FRAGMENT]]) {
      const shader = gl.createShader(kind);
      gl.shaderSource(shader, text);
      gl.compileShader(shader);
      gl.attachShader(program, shader);
    }
    gl.linkProgram(program);
    if (!gl.getProgramParameter(program, gl.LINK_STATUS)) throw new Error(gl.getProgramInfoLog(program));
    gl.useProgram(program);
    gl.enable(gl.DEPTH_TEST);
    const uniform = name => gl.getUniformLocation(program, name);
    this.uniforms = Object.fromEntries(["columns", "step", "camera", "stereo", "turn", "pivot", "away", "focal", "centre", "screen"].map(name => [name, uniform(name)]));
    this.buffers = [gl.createBuffer(), gl.createBuffer()];
    this.places = ["disparity", "color"].map(name => gl.getAttribLocation(program, name));
    this.places.forEach(place => gl.enableVertexAttribArray(place));
    this.step = 1;
  }

  /** Draws every so many'th pixel. */
  drawPoints(step) {
    const {gl} = this;
    gl.uniform1i(this.uniforms.step, step);
    [[1, gl.FLOAT, false], [4, gl.UNSIGNED_BYTE, true]].forEach(([size, type, normalised], i) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[i]);
      gl.vertexAttribPointer(this.places[i], size, type, normalised, 4 * step, 0);
    });
    gl.drawArrays(gl.POINTS, 0, Math.floor(this.disparity.length / step));
  }

  /** disparity: HIDDEN where there is no point; colors: RGBA, alpha 0 where there is none either. */
  show(geometry, width, height, disparity, colors) {
    const first = this.geometry === null || this.width !== width || this.height !== height;
    Object.assign(this, {geometry, width, height, disparity, colors});
    if (first) this.home();
    this.upload();
  }

  upload() {
    const {gl} = this;
    if (!gl || !this.geometry) return;
    for (const [buffer, data] of [[this.buffers[0], this.disparity], [this.buffers[1], this.colors]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    }
  }

  /** From beside the camera, where the cloud looks as deep as it is. */
  home() {
    const [, middle] = spread(this.disparity), z = this.geometry.depth(middle);
    this.away = Number.isFinite(z) ? z : 1;
    this.pivot = [0, 0, this.away];
    [this.yaw, this.pitch] = [0.3, -0.15];
  }

  rotate(yaw, pitch) {
    this.yaw += yaw;
    this.pitch = Math.min(1.5, Math.max(-1.5, this.pitch + pitch));
    this.on.turned();
  }

  nearer(factor) {
    if (!this.geometry) return;
    this.away = Math.min(1e6, Math.max(1e-3, this.away * factor));
    this.on.turned();
  }

  /** Rows of the rotation: about the vertical, then the horizontal axis. */
  rotation() {
    const [a, b, c, d] = [Math.cos(this.yaw), Math.sin(this.yaw), Math.cos(this.pitch), Math.sin(this.pitch)];
    return [a, 0, b, d * b, c, -d * a, -c * b, d, c * a];
  }

  /** What the screen shows of the camera's image when it looks from there: all of it. */
  lens() {
    const {geometry: g, canvas, width, height} = this, scale = Math.min(canvas.width / width, canvas.height / height);
    return {focal: [scale * g.fx, scale * g.fy], centre: [(g.cx + 0.5 - width / 2) * scale, (g.cy + 0.5 - height / 2) * scale]};
  }

  /** A function from a pixel's place and disparity to a dot of the screen and its distance; null behind the viewer. */
  projector() {
    const r = this.rotation(), {focal, centre} = this.lens(), {canvas, pivot, away, geometry: g} = this;
    const [halfWidth, halfHeight] = [canvas.width / 2, canvas.height / 2], out = [0, 0, 0];
    return (x, y, disparity) => {
      const shift = disparity + g.offset;
      if (!(shift > 0)) return null;
      const z = g.product / shift;
      const px = (x - g.cx) * z / g.fx - pivot[0], py = (y - g.cy) * z / g.fy - pivot[1], pz = z - pivot[2];
      const depth = r[6] * px + r[7] * py + r[8] * pz + away;
      if (depth <= away * 0.01) return null;
      out[0] = halfWidth + centre[0] + focal[0] * (r[0] * px + r[1] * py + r[2] * pz) / depth;
      out[1] = halfHeight + centre[1] + focal[1] * (r[3] * px + r[4] * py + r[5] * pz) / depth;
      out[2] = depth;
      return out;
    };
  }

  /** The pixel whose point is nearest to the viewer, of those near the pointer; null where there is none. */
  pick(event) {
    if (!this.geometry) return null;
    const box = this.canvas.getBoundingClientRect(), dots = this.canvas.width / box.width;
    const at = [(event.clientX - box.left) * dots, (event.clientY - box.top) * dots], project = this.projector();
    let best = null, least = Infinity;
    const reach = 7 * dots;
    for (let y = 0, i = 0; y < this.height; y++)
      for (let x = 0; x < this.width; x++, i++) {
        if (this.colors[4 * i + 3] === 0) continue;
        const dot = project(x, y, this.disparity[i]);
        if (dot === null) continue;
        const far = Math.hypot(dot[0] - at[0], dot[1] - at[1]);
        if (far > reach) continue;
        // what lies behind others is not meant
        const cost = dot[2] * (1 + 0.02 * far / dots);
        if (cost < least) [least, best] = [cost, {x, y}];
      }
    return best;
  }

  down(event) {
    if (!this.geometry || event.button === 1) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.pressed = {x: event.clientX, y: event.clientY, far: false, moves: event.shiftKey || event.button === 2};
  }

  moved(event) {
    const held = this.pressed;
    if (!held) return;
    const dx = event.clientX - held.x, dy = event.clientY - held.y;
    held.far = held.far || Math.hypot(dx, dy) > 4;
    if (!held.far) return;
    [held.x, held.y] = [event.clientX, event.clientY];
    held.moves ? this.move(dx, dy) : this.rotate(-dx / 200, dy / 200);
  }

  move(dx, dy) {
    const r = this.rotation(), {focal} = this.lens(), dots = devicePixelRatio || 1;
    const [right, down] = [dx * dots * this.away / focal[0], dy * dots * this.away / focal[1]];
    this.pivot = this.pivot.map((value, i) => value - right * r[i] - down * r[3 + i]);
    this.on.turned();
  }

  up(event) {
    const held = this.pressed;
    this.pressed = null;
    if (!held || held.far || held.moves) return;
    const pixel = this.pick(event);
    if (pixel) this.on.picked(pixel);
  }

  /** Begins, ends or begins anew a measurement at a pixel. */
  measureAt(pixel) {
    this.ends = this.ends.length === 1 ? [...this.ends, pixel] : [pixel];
  }

  /** Metres between the two points; null where there are not two. */
  distance() {
    if (this.ends.length < 2 || !this.geometry) return null;
    const [a, b] = this.ends.map(({x, y}) => this.geometry.point(x, y, this.disparity[y * this.width + x]));
    return Math.hypot(a[0] - b[0], a[1] - b[1], a[2] - b[2]);
  }

  /** moving: fewer points will do where all of them take long, so that turning stays fluent. */
  draw(background, moving = false) {
    fitToScreen(this.canvas);
    fitToScreen(this.marks);
    const {gl, canvas} = this;
    if (!gl) return;
    gl.viewport(0, 0, canvas.width, canvas.height);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
    if (!this.geometry) return;
    const g = this.geometry, u = this.uniforms, {focal, centre} = this.lens();
    gl.uniform1i(u.columns, this.width);
    gl.uniform4f(u.camera, g.fx, g.fy, g.cx, g.cy);
    gl.uniform2f(u.stereo, g.product, g.offset);
    gl.uniformMatrix3fv(u.turn, true, this.rotation());
    gl.uniform3fv(u.pivot, this.pivot);
    gl.uniform1f(u.away, this.away);
    gl.uniform2fv(u.focal, focal);
    gl.uniform2fv(u.centre, centre);
    gl.uniform2f(u.screen, canvas.width, canvas.height);
    this.drawPoints(moving ? this.step : 1);
    this.drawMarks();
    if (!moving) return;
    // the next frame comes when the card is done
    const start = performance.now();
    requestAnimationFrame(() => {
      const took = performance.now() - start;
      if (took > 60) this.step = Math.min(7, this.step + 2);
      else if (took < 25) this.step = Math.max(1, this.step - 2);
    });
  }

  drawMarks() {
    const context = this.marks.getContext("2d"), dots = devicePixelRatio || 1, project = this.projector();
    context.clearRect(0, 0, this.marks.width, this.marks.height);
    const place = pixel => {
      const dot = project(pixel.x, pixel.y, this.disparity[pixel.y * this.width + pixel.x]);
      return dot && [dot[0], dot[1]];
    };
    const ring = (at, color) => {
      for (const [style, wide] of [["rgba(0, 0, 0, 0.75)", 4], [color, 2]]) {
        context.strokeStyle = style;
        context.lineWidth = wide * dots;
        context.beginPath();
        context.arc(at[0], at[1], 6 * dots, 0, 2 * Math.PI);
        context.stroke();
      }
    };
    const ends = this.ends.map(place).filter(Boolean);
    if (ends.length === 2)
      for (const [style, wide] of [["rgba(0, 0, 0, 0.75)", 5], ["#ffd23f", 2.5]]) {
        context.strokeStyle = style;
        context.lineWidth = wide * dots;
        context.beginPath();
        context.moveTo(...ends[0]);
        context.lineTo(...ends[1]);
        context.stroke();
      }
    ends.forEach(at => ring(at, "#ffd23f"));
    const at = this.pixel && place(this.pixel);
    if (at) ring(at, "#fff");
  }
}
