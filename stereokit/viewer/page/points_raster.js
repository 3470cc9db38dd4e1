"use strict";
// The points of a cloud without a graphics card. WebGL in software takes about a microsecond a point; this takes a hundredth.

class RasterPoints {
  constructor(canvas) {
    this.canvas = canvas;
    this.context = canvas.getContext("2d", {alpha: false});
    this.image = null;
  }

  /** disparity: HIDDEN where there is no point; colors: RGBA, alpha 0 where there is none either. */
  upload(width, height, disparity, colors) {
    Object.assign(this, {width, height, disparity, colors: new Uint32Array(colors.buffer, colors.byteOffset, width * height)});
  }

  clear(background) {
    const {width, height} = this.canvas;
    if (!this.image || this.image.width !== width || this.image.height !== height) {
      this.image = new ImageData(Math.max(1, width), Math.max(1, height));
      this.dots = new Uint32Array(this.image.data.buffer);
      this.near = new Float32Array(this.dots.length);  // 1 / distance of what a dot shows
    }
    const [r, g, b] = background.map(v => Math.round(255 * v));
    this.dots.fill((255 << 24 | b << 16 | g << 8 | r) >>> 0);
    this.near.fill(0);
    this.context.putImageData(this.image, 0, 0);
  }

  /** Draws every so many'th pixel. view: see Cloud.view. */
  draw(background, view, step) {
    this.clear(background);
    const {dots, near, disparity, colors, width, height} = this, {geometry: g, rotation: r, pivot, away, focal, centre} = view;
    const across = this.canvas.width, down = this.canvas.height;
    // a pixel's point is z times its ray, whose turned direction is linear in the column
    const shift = [0, 3, 6].map(k => -(r[k] * pivot[0] + r[k + 1] * pivot[1] + r[k + 2] * pivot[2]));
    const tx = shift[0], ty = shift[1], tz = shift[2] + away, least = away * 0.01, most = away * 400;
    const ax = r[0] / g.fx, ay = r[3] / g.fx, az = r[6] / g.fx;
    const left = across / 2 + centre[0], top = down / 2 + centre[1], fx = focal[0], fy = focal[1];
    const product = g.product, offset = g.offset, size = 1.2 * Math.sqrt(step) * fx / g.fx;
    for (let y = 0; y < height; y++) {
      const v = (y - g.cy) / g.fy, first = y * width;
      const bx = r[1] * v + r[2] - g.cx * ax, by = r[4] * v + r[5] - g.cx * ay, bz = r[7] * v + r[8] - g.cx * az;
      for (let x = (step - first % step) % step; x < width; x += step) {
        const apart = disparity[first + x] + offset;
        if (!(apart > 0)) continue;
        const z = product / apart, depth = z * (bz + x * az) + tz;
        if (!(depth > least && depth < most)) continue;
        const color = colors[first + x];
        if (color >>> 24 === 0) continue;
        const near1 = 1 / depth, side = size * z * near1;
        const u = left + fx * (z * (bx + x * ax) + tx) * near1, w = top + fy * (z * (by + x * ay) + ty) * near1;
        if (side < 1.5) {
          if (!(u >= 0 && w >= 0 && u < across && w < down)) continue;
          const at = (w | 0) * across + (u | 0);
          if (near1 > near[at]) { near[at] = near1; dots[at] = color; }
          continue;
        }
        const half = Math.min(48, side) / 2;
        const x0 = Math.max(0, Math.ceil(u - half - 0.5)), x1 = Math.min(across - 1, Math.ceil(u + half - 0.5) - 1);
        const y0 = Math.max(0, Math.ceil(w - half - 0.5)), y1 = Math.min(down - 1, Math.ceil(w + half - 0.5) - 1);
        for (let row = y0; row <= y1; row++)
          for (let at = row * across + x0, end = row * across + x1; at <= end; at++)
            if (near1 > near[at]) { near[at] = near1; dots[at] = color; }
      }
    }
    this.context.putImageData(this.image, 0, 0);
  }
}
