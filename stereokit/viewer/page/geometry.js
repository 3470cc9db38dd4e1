"use strict";
// What the cameras' calibration makes of disparity. The same equations as stereokit.cameras.depth and .cloud.

class Geometry {
  /** calibration: fx, fy, cx0, cx1, cy, baseline; null where there is none, and no metres then. */
  constructor(calibration, width, height, middleDisparity) {
    this.metric = calibration !== null;
    this.assumesRow = this.metric && calibration.cy === null;
    // without one: a camera of a field of view of 53 degrees, and the middle disparity at distance 1
    const c = calibration || {fx: width, fy: width, cx0: width / 2, cx1: width / 2, cy: null, baseline: Math.max(middleDisparity, 1e-3) / width};
    this.fx = c.fx;
    this.fy = c.fy;
    this.cx = c.cx0;
    this.cy = c.cy === null ? (height - 1) / 2 : c.cy;
    this.offset = c.cx1 - c.cx0;
    this.product = c.baseline * c.fx;
  }

  /** Along the optical axis; NaN where unknown. */
  depth(disparity) {
    const shift = disparity + this.offset;
    return shift > 0 ? this.product / shift : NaN;
  }

  /** To first order: Z^2 / (baseline fx) times that of disparity. */
  standardError(disparity, error) {
    const z = this.depth(disparity);
    return z * z / this.product * error;
  }

  /** Of pixel (x, y): X to the right, Y down, Z forward. */
  point(x, y, disparity) {
    const z = this.depth(disparity);
    return [(x - this.cx) * z / this.fx, (y - this.cy) * z / this.fy, z];
  }
}

/** Pixels on a ramp: disparity rises, or falls, by more than a pixel both to them and from them. */
function flyingPixels(disparity, width, height) {
  const result = new Uint8Array(disparity.length);
  for (let y = 0, i = 0; y < height; y++)
    for (let x = 0; x < width; x++, i++) {
      const d = disparity[i];
      if (x > 0 && x < width - 1) {
        const before = d - disparity[i - 1], after = disparity[i + 1] - d;
        if ((before > 1 && after > 1) || (before < -1 && after < -1)) result[i] = 1;
      }
      if (y > 0 && y < height - 1) {
        const before = d - disparity[i - width], after = disparity[i + width] - d;
        if ((before > 1 && after > 1) || (before < -1 && after < -1)) result[i] = 1;
      }
    }
  return result;
}

/** The 1st, 50th and 99th percentile of the finite values, of some thousands of them. */
function spread(values) {
  const step = Math.max(1, Math.floor(values.length / 20011)), all = new Float32Array(Math.ceil(values.length / step));
  let count = 0;
  for (let i = 0; i < values.length; i += step) if (Number.isFinite(values[i])) all[count++] = values[i];
  if (!count) return [0, 0.5, 1];
  const some = all.subarray(0, count).sort();
  const at = share => some[Math.round(share * (some.length - 1))];
  return [at(0.01), at(0.5), at(0.99)];
}

/** A number with about three digits. */
function shown(value) {
  const size = Math.abs(value);
  return value.toFixed(size >= 100 ? 0 : size >= 10 ? 1 : size >= 1 ? 2 : 3);
}
