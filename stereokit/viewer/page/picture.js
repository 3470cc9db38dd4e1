"use strict";
// Pictures that zoom and move together, with row lines and marks.

/** The part of the image that all pictures show. */
class Window {
  constructor() { this.zoom = 1; this.x = 0.5; this.y = 0.5; }
  reset() { this.zoom = 1; this.x = this.y = 0.5; }

  /** Scale and position on a canvas of an image, in its pixels. */
  fit(canvas, width, height) {
    const scale = Math.min(canvas.width / width, canvas.height / height) * this.zoom;
    const place = (length, size, centre) => {
      const whole = size * scale;
      // what fits is in the middle, and no border comes into view of what does not
      return whole <= length ? (length - whole) / 2 : Math.min(0, Math.max(length - whole, length / 2 - centre * whole));
    };
    return {scale, left: place(canvas.width, width, this.x), top: place(canvas.height, height, this.y)};
  }

  /** Zooms so that a point of the image, in parts of its size, stays where it is. */
  zoomAt(factor, x, y) {
    const zoom = Math.min(40, Math.max(1, this.zoom * factor)), share = this.zoom / zoom;
    this.x = Math.min(1, Math.max(0, x + (this.x - x) * share));
    this.y = Math.min(1, Math.max(0, y + (this.y - y) * share));
    this.zoom = zoom;
  }
}

class Picture {
  /** on: hover(x, y), leave(), click(x, y), wipe(share), changed(), key(event) */
  constructor(canvas, window, on) {
    this.canvas = canvas;
    this.window = window;
    this.on = on;
    this.image = null;
    this.over = null;       // drawn to the right of the wipe
    this.wipe = null;
    this.lines = false;
    this.marks = [];        // {x, y, color}
    this.row = null;
    this.context = canvas.getContext("2d");
    this.pressed = null;
    canvas.addEventListener("pointermove", event => this.moved(event));
    canvas.addEventListener("pointerleave", () => { if (!this.pressed) on.leave(); });
    canvas.addEventListener("pointerdown", event => this.down(event));
    canvas.addEventListener("pointerup", event => this.up(event));
    canvas.addEventListener("pointercancel", () => { this.pressed = null; });
    canvas.addEventListener("keydown", event => on.key(event));
    canvas.addEventListener("wheel", event => {
      if (!this.image) return;
      event.preventDefault();
      const at = this.place(event);
      window.zoomAt(Math.exp(-event.deltaY / 400), at.x / this.image.width, at.y / this.image.height);
      on.changed();
    }, {passive: false});
  }

  get size() { return [this.image.width, this.image.height]; }

  /** Of the pointer, in pixels of the image whose centres lie at whole numbers. */
  place(event) {
    const box = this.canvas.getBoundingClientRect(), dots = this.canvas.width / box.width;
    const {scale, left, top} = this.window.fit(this.canvas, ...this.size);
    const x = ((event.clientX - box.left) * dots - left) / scale - 0.5, y = ((event.clientY - box.top) * dots - top) / scale - 0.5;
    return {x, y, inside: x >= -0.5 && y >= -0.5 && x < this.image.width - 0.5 && y < this.image.height - 0.5};
  }

  nearWipe(event) {
    if (this.wipe === null || !this.image) return false;
    const box = this.canvas.getBoundingClientRect(), dots = this.canvas.width / box.width;
    const {scale, left} = this.window.fit(this.canvas, ...this.size);
    return Math.abs((event.clientX - box.left) * dots - (left + this.wipe * this.image.width * scale)) < 9 * dots;
  }

  down(event) {
    if (!this.image || event.button !== 0) return;
    this.canvas.setPointerCapture(event.pointerId);
    this.pressed = {x: event.clientX, y: event.clientY, wiping: this.nearWipe(event), far: false};
  }

  moved(event) {
    if (!this.image) return;
    const held = this.pressed;
    if (!held) {
      this.canvas.style.cursor = this.nearWipe(event) ? "ew-resize" : "crosshair";
      const at = this.place(event);
      at.inside ? this.on.hover(Math.round(at.x), Math.round(at.y)) : this.on.leave();
      return;
    }
    if (held.wiping) {
      this.on.wipe(Math.min(1, Math.max(0, (this.place(event).x + 0.5) / this.image.width)));
      return;
    }
    const dx = event.clientX - held.x, dy = event.clientY - held.y;
    held.far = held.far || Math.hypot(dx, dy) > 4;
    if (!held.far) return;
    const box = this.canvas.getBoundingClientRect(), {scale} = this.window.fit(this.canvas, ...this.size), dots = this.canvas.width / box.width;
    this.window.x = Math.min(1, Math.max(0, this.window.x - dx * dots / scale / this.image.width));
    this.window.y = Math.min(1, Math.max(0, this.window.y - dy * dots / scale / this.image.height));
    [held.x, held.y] = [event.clientX, event.clientY];
    this.on.changed();
  }

  up(event) {
    const held = this.pressed;
    this.pressed = null;
    if (!held || held.far || held.wiping) return;
    const at = this.place(event);
    if (at.inside) this.on.click(Math.round(at.x), Math.round(at.y));
  }

  draw() {
    fitToScreen(this.canvas);
    const {context, canvas} = this;
    context.setTransform(1, 0, 0, 1, 0, 0);
    context.clearRect(0, 0, canvas.width, canvas.height);
    if (!this.image) return;
    const [width, height] = this.size, {scale, left, top} = this.window.fit(canvas, width, height), dots = devicePixelRatio || 1;
    context.imageSmoothingEnabled = scale < 2;
    // of the finer kinds a picture takes tens of milliseconds, without a graphics card
    context.imageSmoothingQuality = this.quick ? "low" : "high";
    context.drawImage(this.image, left, top, width * scale, height * scale);
    if (this.over) {
      const from = left + (this.wipe ?? 0) * width * scale;
      context.save();
      context.beginPath();
      context.rect(from, top, left + width * scale - from, height * scale);
      context.clip();
      context.drawImage(this.over, left, top, width * scale, height * scale);
      context.restore();
      if (this.wipe > 0 && this.wipe < 1) this.handle(from, top, Math.min(canvas.height, height * scale), dots);
    }
    if (this.lines) {
      // about 24 screen pixels apart, at the same rows in both views
      const step = Math.max(1, Math.round(24 * dots / scale));
      context.strokeStyle = "rgba(255, 255, 255, 0.35)";
      context.lineWidth = dots;
      context.beginPath();
      for (let y = step; y < height; y += step) this.line(left, Math.round(top + y * scale) + 0.5, width * scale);
      context.stroke();
    }
    if (this.row !== null) {
      context.strokeStyle = "#ffd23f";
      context.lineWidth = 1.5 * dots;
      context.beginPath();
      this.line(left, top + (this.row + 0.5) * scale, width * scale);
      context.stroke();
    }
    for (const mark of this.marks) {
      const x = left + (mark.x + 0.5) * scale, y = top + (mark.y + 0.5) * scale, size = Math.max(6 * dots, scale * 0.75);
      for (const [color, wide] of [["rgba(0, 0, 0, 0.75)", 4], [mark.color, 2]]) {
        context.strokeStyle = color;
        context.lineWidth = wide * dots;
        context.beginPath();
        context.arc(x, y, size, 0, 2 * Math.PI);
        context.stroke();
      }
    }
  }

  line(x, y, length) {
    this.context.moveTo(x, y);
    this.context.lineTo(x + length, y);
  }

  handle(x, top, height, dots) {
    const {context} = this, middle = top + height / 2;
    context.fillStyle = "#fff";
    context.shadowColor = "rgba(0, 0, 0, 0.6)";
    context.shadowBlur = 4 * dots;
    context.fillRect(x - dots, top, 2 * dots, height);
    context.beginPath();
    context.arc(x, middle, 10 * dots, 0, 2 * Math.PI);
    context.fill();
    context.shadowBlur = 0;
    context.strokeStyle = "#333";
    context.lineWidth = 1.5 * dots;
    context.beginPath();
    for (const side of [-1, 1]) {
      context.moveTo(x + side * 3 * dots, middle - 3 * dots);
      context.lineTo(x + side * 6 * dots, middle);
      context.lineTo(x + side * 3 * dots, middle + 3 * dots);
    }
    context.stroke();
  }
}

/** Gives a canvas as many dots as the screen has under it. */
function fitToScreen(canvas) {
  const dots = devicePixelRatio || 1, width = Math.round(canvas.clientWidth * dots), height = Math.round(canvas.clientHeight * dots);
  if (canvas.width !== width || canvas.height !== height) [canvas.width, canvas.height] = [width, height];
}

/** 256 colours as one number each, in the byte order of ImageData. */
function colorTable(hex) {
  const table = new Uint32Array(256);
  for (let i = 0; i < 256; i++) {
    const [r, g, b] = [0, 2, 4].map(k => parseInt(hex.slice(6 * i + k, 6 * i + k + 2), 16));
    table[i] = (255 << 24 | b << 16 | g << 8 | r) >>> 0;
  }
  return table;
}

/** Values in colours, written into the dots of an ImageData. Unknown, or not kept: transparent. */
function colorInto(dots, values, kept, low, high, table) {
  const factor = 255 / (high - low);
  for (let i = 0; i < values.length; i++) {
    const value = values[i];
    if (value !== value || (kept && !kept[i])) { dots[i] = 0; continue; }
    const level = (value - low) * factor + 0.5;
    dots[i] = table[level < 0 ? 0 : level > 255 ? 255 : level | 0];
  }
}
