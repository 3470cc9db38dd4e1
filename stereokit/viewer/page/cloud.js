"use strict";
// The point cloud: how it is looked at, turned and measured in.

const HIDDEN = -1e9;

/** Whether WebGL 2 is there and is not run in software. */
function hasGraphicsCard() {
  const gl = new OffscreenCanvas(1, 1).getContext("webgl2", {failIfMajorPerformanceCaveat: true});
  if (!gl) return false;
  const told = gl.getExtension("WEBGL_debug_renderer_info");
  const name = String(gl.getParameter(told ? told.UNMASKED_RENDERER_WEBGL : gl.RENDERER));
  gl.getExtension("WEBGL_lose_context")?.loseContext();
  return !/swiftshader|llvmpipe|softpipe|software|basic render/i.test(name);
}

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
    this.step = 1;
    this.uploads = 0;
    this.seen = null;     // how the points were drawn last
    this.gl = hasGraphicsCard() ? canvas.getContext("webgl2", {antialias: false, alpha: false}) : null;
    this.points = this.gl ? new WebGlPoints(this.gl) : new RasterPoints(canvas);
    canvas.addEventListener("webglcontextlost", event => event.preventDefault());
    canvas.addEventListener("webglcontextrestored", () => { this.points.prepare(); this.upload(); on.turned(); });
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

  /** disparity: HIDDEN where there is no point; colors: RGBA, alpha 0 where there is none either. */
  show(geometry, width, height, disparity, colors) {
    const first = this.geometry === null || this.width !== width || this.height !== height;
    Object.assign(this, {geometry, width, height, disparity, colors});
    if (first) this.home();
    this.upload();
  }

  upload() {
    if (!this.geometry) return;
    this.points.upload(this.width, this.height, this.disparity, this.colors);
    this.uploads++;
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

  /** From where the points are seen. */
  get view() {
    const {geometry, pivot, away} = this;
    return {geometry, rotation: this.rotation(), pivot, away, ...this.lens()};
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
    if (!this.geometry) { this.seen = null; return this.points.clear(background); }
    const start = performance.now(), {view} = this, step = moving ? this.step : 1;
    const seen = [this.uploads, step, this.canvas.width, this.canvas.height, ...background, ...view.rotation, ...view.pivot, view.away].join();
    if (seen !== this.seen) this.points.draw(background, view, step);
    const drawn = seen !== this.seen;
    this.seen = seen;
    this.drawMarks();
    if (!moving || !drawn) return;
    const adapt = () => {
      const took = performance.now() - start;
      if (took > 60) this.step = Math.min(7, this.step + 2);
      else if (took < 25) this.step = Math.max(1, this.step - 2);
    };
    // the next frame comes when the card is done
    this.gl ? requestAnimationFrame(adapt) : adapt();
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
