"use strict";
// The points of a cloud by the graphics card, which makes them of disparity; a frame sends disparity and colours alone.

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

class WebGlPoints {
  /** gl: a WebGL 2 context. */
  constructor(gl) {
    this.gl = gl;
    this.prepare();
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
  }

  /** disparity: HIDDEN where there is no point; colors: RGBA, alpha 0 where there is none either. */
  upload(width, height, disparity, colors) {
    const {gl} = this;
    this.width = width;
    this.count = width * height;
    for (const [buffer, data] of [[this.buffers[0], disparity], [this.buffers[1], colors]]) {
      gl.bindBuffer(gl.ARRAY_BUFFER, buffer);
      gl.bufferData(gl.ARRAY_BUFFER, data, gl.DYNAMIC_DRAW);
    }
  }

  clear(background) {
    const {gl} = this;
    gl.viewport(0, 0, gl.canvas.width, gl.canvas.height);
    gl.clearColor(...background, 1);
    gl.clear(gl.COLOR_BUFFER_BIT | gl.DEPTH_BUFFER_BIT);
  }

  /** Draws every so many'th pixel. view: see Cloud.view. */
  draw(background, view, step) {
    const {gl, uniforms: u} = this, {geometry: g, rotation, pivot, away, focal, centre} = view;
    this.clear(background);
    gl.uniform1i(u.columns, this.width);
    gl.uniform4f(u.camera, g.fx, g.fy, g.cx, g.cy);
    gl.uniform2f(u.stereo, g.product, g.offset);
    gl.uniformMatrix3fv(u.turn, true, rotation);
    gl.uniform3fv(u.pivot, pivot);
    gl.uniform1f(u.away, away);
    gl.uniform2fv(u.focal, focal);
    gl.uniform2fv(u.centre, centre);
    gl.uniform2f(u.screen, gl.canvas.width, gl.canvas.height);
    gl.uniform1i(u.step, step);
    [[1, gl.FLOAT, false], [4, gl.UNSIGNED_BYTE, true]].forEach(([size, type, normalised], i) => {
      gl.bindBuffer(gl.ARRAY_BUFFER, this.buffers[i]);
      gl.vertexAttribPointer(this.places[i], size, type, normalised, 4 * step, 0);
    });
    gl.drawArrays(gl.POINTS, 0, Math.floor(this.count / step));
  }
}
