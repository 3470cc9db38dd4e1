"use strict";
// Where the page has its frames from: the server, or itself.

async function checked(response) {
  if (!response.ok) throw new Error(await response.text());
  return response;
}

/** Values to floats; Float32Array.from takes ten times as long. */
function mapped(values, change) {
  const result = new Float32Array(values.length);
  for (let i = 0; i < result.length; i++) result[i] = change(values[i]);
  return result;
}

/** An error of the server's own words, or that it is not there. */
async function ask(path) {
  let response;
  try {
    response = await fetch(path);
  } catch {
    throw new Error("The viewer does not answer. Is stereokit view still running?");
  }
  return checked(response);
}

class ServedSource {
  async facts() { return (await ask("facts")).json(); }
  async entry(index) { return (await ask(`entry?index=${index}`)).json(); }

  /** The next frame of a stream, all of it in one answer; see Shot.packed. */
  async next(after) {
    const buffer = await (await ask(`next?after=${after}`)).arrayBuffer(), size = new DataView(buffer).getUint32(0, true);
    const facts = JSON.parse(new TextDecoder().decode(new Uint8Array(buffer, 4, size)));
    if (facts.ended) return facts;
    let at = 4 + size;
    const part = (name, type) => { const found = new type(buffer, at, facts.parts[name] / type.BYTES_PER_ELEMENT); at += facts.parts[name]; return found; };
    const codes = part("disparity", Uint16Array), levels = facts.parts.confidence ? part("confidence", Uint8Array) : null;
    const [left, right] = ["left", "right"].map(name => createImageBitmap(new Blob([part(name, Uint8Array)], {type: "image/jpeg"})));
    const {steps} = facts, disparity = new Float32Array(codes.length);
    for (let i = 0; i < codes.length; i++) disparity[i] = codes[i] === 0 ? NaN : (codes[i] - 1) / steps;
    return {...facts, disparity, confidence: levels && mapped(levels, v => v / 255), left: await left, right: await right};
  }

  /** Images and arrays of a frame, all at once. */
  async load(frame) {
    const at = `shot/${frame.number}/`;
    const image = async view => createImageBitmap(await (await ask(at + view)).blob());
    const array = async (name, type) => new type(await (await ask(at + name)).arrayBuffer());
    const [left, right, disparity, confidence] = await Promise.all([
      image("left"), image("right"), array("disparity", Float32Array),
      frame.confidence === null ? null : array("confidence", Uint16Array),
    ]);
    return {...frame, left, right, disparity, confidence: confidence && mapped(confidence, v => v / 65535)};
  }

  async occlusion(frame) { return new Uint8Array(await (await ask(`shot/${frame.number}/occluded`)).arrayBuffer()); }

  async distribution(frame, x, y) {
    const values = new Float32Array(await (await ask(`shot/${frame.number}/distribution?x=${x}&y=${y}`)).arrayBuffer());
    const candidates = [];
    for (let i = 2; i < values.length; i += 3) candidates.push({disparity: values[i], probability: values[i + 1], kept: values[i + 2] > 0});
    return {x, y, expectation: values[0], spread: values[1], candidates};
  }

  archive(frame) { return `shot/${frame.number}/archive`; }
}

class EmbeddedSource {
  constructor(held) { this.held = held; this.grids = new Map(); }
  async facts() { return {...this.held, embedded: true}; }
  async entry(index) { return this.held.shots[index]; }

  async load(frame) {
    const image = async uri => createImageBitmap(await bytesOf(uri.slice(uri.indexOf(",") + 1)).then(b => new Blob([b], {type: "image/jpeg"})));
    const {width, height} = frame;
    const [left, right, codes, levels] = await Promise.all([
      image(frame.left), image(frame.right), unpackMap(frame.disparity, width, height),
      frame.levels === null ? null : unpackMap(frame.levels, width, height),
    ]);
    const disparity = mapped(codes, code => code === 0 ? NaN : (code - 1) / frame.steps);
    return {...frame, left, right, disparity, held: frame, confidence: levels && mapped(levels, v => v / 255)};
  }

  async occlusion(frame) {
    if (frame.occluded === null) throw new Error("This page holds a saved result, of which occlusion is not known.");
    const bits = await inflated(frame.occluded), result = new Uint8Array(frame.width * frame.height);
    for (let i = 0; i < result.length; i++) result[i] = bits[i >> 3] >> (7 - (i & 7)) & 1;
    return result;
  }

  /** Of the nearest pixel that the page holds. */
  async distribution(frame, x, y) {
    const held = frame.distributions;
    if (!held) throw new Error("This page holds no distributions.");
    if (!this.grids.has(frame.number)) {
      const array = async (name, type) => new type((await inflated(held[name])).buffer);
      this.grids.set(frame.number, Object.fromEntries(await Promise.all([
        ["disparities", Float32Array], ["probabilities", Uint16Array], ["peaks", Float32Array],
        ["kept", Uint8Array], ["expectations", Float32Array], ["spreads", Float32Array],
      ].map(async ([name, type]) => [name, await array(name, type)]))));
    }
    const grid = this.grids.get(frame.number), n = held.candidates;
    const nearest = (v, count) => Math.min(count - 1, Math.max(0, Math.round((v - held.first) / held.step)));
    const column = nearest(x, held.columns), row = nearest(y, held.rows), cell = row * held.columns + column;
    const base = grid.disparities.length === n ? 0 : cell * n, candidates = [];
    for (let i = 0; i < n; i++) candidates.push({
      disparity: grid.disparities[base + i], kept: grid.kept[cell * n + i] > 0,
      probability: grid.probabilities[cell * n + i] / 65535 * grid.peaks[cell],
    });
    return {x: held.first + column * held.step, y: held.first + row * held.step, step: held.step,
            expectation: grid.expectations[cell], spread: grid.spreads[cell], candidates};
  }
}

async function bytesOf(text) {
  const binary = atob(text), bytes = new Uint8Array(binary.length);
  for (let i = 0; i < binary.length; i++) bytes[i] = binary.charCodeAt(i);
  return bytes;
}

async function inflated(text) {
  const stream = new Blob([await bytesOf(text)]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}

/** The inverse of stereokit.viewer.packing.pack_map. */
async function unpackMap(text, width, height) {
  const planes = await inflated(text), size = width * height, codes = new Uint16Array(size);
  for (let y = 0, i = 0; y < height; y++)
    for (let x = 0; x < width; x++, i++) {
      const before = x > 0 ? codes[i - 1] : y > 0 ? codes[i - width] : 0;
      codes[i] = before + planes[i] + (planes[size + i] << 8);
    }
  return codes;
}
