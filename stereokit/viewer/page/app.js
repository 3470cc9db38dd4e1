"use strict";
// What happens when.

const $ = id => document.getElementById(id);
const TITLES = {disparity: "Disparity", depth: "Depth", confidence: "Confidence", occlusion: "Occlusion"};

class App {
  constructor() {
    const embedded = $("embedded");
    this.source = embedded ? new EmbeddedSource(JSON.parse(embedded.textContent)) : new ServedSource();
    this.frame = null;
    this.map = "disparity";
    this.pixel = null;
    this.pinned = null;       // whose distribution is shown
    this.paused = false;
    this.ranges = {};         // of a map, if it was moved
    this.ranged = {};         // the last range that was not
    this.window = new Window();
    const on = {
      hover: (x, y) => this.hover(x, y),
      leave: () => this.hover(null),
      click: (x, y) => this.pin(x, y),
      wipe: share => this.setWipe(share),
      changed: () => this.redraw(),
      key: event => this.pictureKey(event),
    };
    this.left = new Picture($("left"), this.window, on);
    this.mapped = new Picture($("map"), this.window, on);
    this.right = new Picture($("right"), this.window, {...on, hover: (x, y) => this.hoverRight(y), click: () => {}});
    this.mapped.wipe = 0;
    this.cloud = new Cloud($("cloud"), $("marks"), {
      picked: pixel => { this.hover(pixel.x, pixel.y); this.measure(pixel); },
      turned: () => this.turned(),
      key: event => this.cloudKey(event),
    });
    this.listen();
  }

  async start() {
    try {
      this.about = await this.source.facts();
    } catch (error) {
      return this.say(error.message);
    }
    this.tables = Object.fromEntries(Object.entries(this.about.colors).map(([name, hex]) => [name, colorTable(hex)]));
    $("error").value = this.about.disparity_error;
    $("save-frame").hidden = Boolean(this.about.embedded);
    const {entries} = this.about;
    if (entries) {
      $("album").hidden = entries.length < 2;
      entries.forEach((name, index) => $("entries").append(new Option(name, index)));
      await this.open(0);
    } else {
      $("stream").hidden = false;
      this.play();
    }
  }

  // frames

  async open(index) {
    const wanted = this.wanted = Symbol();
    $("entries").value = index;
    $("previous").disabled = index <= 0;
    $("next").disabled = index >= this.about.entries.length - 1;
    this.busy(true);
    try {
      const loaded = await this.source.load(await this.source.entry(index));
      if (this.wanted === wanted) { this.say(""); this.show(loaded); }
    } catch (error) {
      if (this.wanted === wanted) this.say(error.message);
    }
    if (this.wanted === wanted) this.busy(false);
  }

  async play() {
    let after = -1, count = 0, since = performance.now();
    if (this.playing) return;
    this.playing = true;
    try {
      let coming = this.source.next(this.frame ? this.frame.number : after);
      while (!this.paused) {
        const loaded = await coming;
        if (loaded.ended) { this.say("That was the last frame."); this.pause(true); break; }
        after = loaded.number;
        // the next one is matched while this one is drawn; no more than that one is on its way
        coming = this.paused ? null : this.source.next(after);
        if (coming) coming.catch(() => {});
        this.show(loaded);
        await new Promise(requestAnimationFrame);
        count++;
        const now = performance.now();
        if (now - since > 1000) { $("rate").textContent = `${(count * 1000 / (now - since)).toFixed(1)} frames/s`; [count, since] = [0, now]; }
      }
    } catch (error) {
      this.say(error.message);
      this.pause(true);
    }
    this.playing = false;
    this.redraw();
  }

  pause(paused) {
    this.paused = paused;
    $("pause").textContent = paused ? "Go on" : "Pause";
    $("pause").setAttribute("aria-pressed", paused);
    if (paused) $("rate").textContent = "";
    else { this.say(""); this.play(); }
  }

  show(frame) {
    const {width, height} = frame, before = this.frame;
    this.frame = frame;
    frame.spread = spread(frame.disparity);
    this.occluded = null;
    this.geometry = new Geometry(this.about.calibration, width, height, frame.spread[1]);
    if (!before || before.width !== width || before.height !== height) {
      this.window.reset();
      this.pixel = null;
    }
    if (!this.about.stream || !before) { this.clearChart(); this.cloud.ends = []; this.cloud.geometry = before && before.width === width && before.height === height && this.about.stream ? this.cloud.geometry : null; }
    this.pinned = null;
    this.left.image = frame.left;
    this.right.image = frame.right;
    if (!this.dots || this.dots.width !== width || this.dots.height !== height) {
      this.photo = new OffscreenCanvas(width, height).getContext("2d", {willReadFrequently: true});
      this.dots = new ImageData(width, height);
      this.canvas = new OffscreenCanvas(width, height);
      this.points = new Float32Array(width * height);
    }
    this.photo.drawImage(frame.left, 0, 0);
    this.photoDots = this.photo.getImageData(0, 0, width, height).data;
    this.flying = null;
    this.describe();
    this.setMap(this.map);
  }

  describe() {
    const {frame, about} = this, facts = [`${frame.width} × ${frame.height} px`];
    if (about.network) facts.push(about.network);
    if (frame.seconds !== null) facts.push(`${frame.seconds.toFixed(2)} s`);
    if (frame.confidence !== null) facts.push(`mean confidence ${(spreadMean(frame.confidence) * 100).toFixed(0)} %`);
    $("facts").textContent = (this.about.entries && this.about.entries.length > 1 ? "" : `${frame.name}: `) + facts.join(" · ");
    const note = !this.geometry.metric ? "No calibration: the shape is not to scale" : this.geometry.assumesRow ? "The calibration has no cy: its row is taken to be the middle one" : "";
    $("cloud-note").textContent = note;
    for (const input of document.querySelectorAll("#maps input")) {
      const lacking = {depth: !this.geometry.metric, confidence: frame.confidence === null, occlusion: !about.matching && !about.embedded}[input.value] ?? false;
      input.disabled = lacking;
      input.parentElement.title = !lacking ? "" : {depth: "needs --calibration", confidence: "this result has none", occlusion: "a saved result does not say"}[input.value];
      if (lacking && this.map === input.value) this.map = "disparity";
    }
    document.querySelector(`#maps input[value=${this.map}]`).checked = true;
    $("least-row").hidden = frame.confidence === null;
    $("error-row").hidden = !this.geometry.metric;
  }

  // the map

  async setMap(map) {
    this.map = map;
    const {frame} = this;
    $("map-title").textContent = TITLES[map];
    $("range").hidden = map === "occlusion";
    $("legend").hidden = map !== "occlusion";
    if (map === "occlusion" && !this.occluded) {
      $("legend").textContent = "Matching the right view…";
      this.occluded = null;
      this.compose();
      try {
        const found = await this.source.occlusion(frame.held || frame);
        if (this.frame !== frame) return;
        this.occluded = found;
      } catch (error) {
        if (this.frame !== frame) return;
        $("legend").textContent = error.message;
        return this.compose();
      }
    }
    if (map === "occlusion") {
      const share = this.occluded.reduce((sum, v) => sum + v, 0) / this.occluded.length;
      $("legend").innerHTML = `<i class="swatch"></i>Seen by the left camera alone, or the views disagree: ${(share * 100).toFixed(1)} % of the pixels`;
    }
    this.compose();
  }

  values() {
    const {frame, map, geometry} = this;
    if (map === "confidence") return frame.confidence;
    if (map !== "depth") return frame.disparity;
    if (frame.depths === undefined) frame.depths = mapped(frame.disparity, d => geometry.depth(d));
    return frame.depths;
  }

  /** The ends of the slider, and of the colours. */
  range() {
    if (this.map === "confidence") { const [low, high] = this.ranges.confidence || [0, 1]; return {least: 0, most: 1, low, high}; }
    const [a, b] = this.seenRange(), pad = Math.max(1e-6, (b - a) * 0.5);
    const [low, high] = this.ranges[this.map] || (b > a ? [a, b] : [a - 0.5, b + 0.5]);
    return {least: Math.min(low, Math.max(0, a - pad)), most: Math.max(high, b + pad), low, high};
  }

  /** Of the map's values; of a stream it follows them, fast where it widens and slowly where it narrows, so that colours do not flicker. */
  seenRange() {
    const {frame, map, about} = this;
    if (this.ranged.map === map && this.ranged.frame === frame) return this.ranged.ends;
    const [a, , b] = map === "depth" ? spread(this.values()) : frame.spread;
    const before = about.stream && this.ranged.map === map ? this.ranged.ends : [a, b];
    const ends = [before[0] + (a < before[0] ? 0.5 : 0.02) * (a - before[0]), before[1] + (b > before[1] ? 0.5 : 0.02) * (b - before[1])];
    this.ranged = {map, frame, ends};
    return ends;
  }

  setRange(low, high) {
    this.ranges[this.map] = [low, high];
    this.compose();
  }

  kept() {
    const {frame} = this, least = $("least").value / 100;
    if (least === 0 || frame.confidence === null) return null;
    const result = new Uint8Array(frame.confidence.length);
    for (let i = 0; i < result.length; i++) result[i] = frame.confidence[i] >= least ? 1 : 0;
    return result;
  }

  /** Colours the map, and gives the cloud its points. */
  compose() {
    const {frame, dots, map} = this, pixels = new Uint32Array(dots.data.buffer), kept = this.kept();
    if (map === "occlusion") {
      for (let i = 0; i < pixels.length; i++) pixels[i] = this.occluded && this.occluded[i] ? 0xff1f6fff : 0x99000000;
    } else {
      const table = this.tables[map === "confidence" ? "viridis" : "turbo"], {least, most, low, high} = this.range();
      colorInto(pixels, this.values(), kept, low, high, table);
      this.drawScale(table, {least, most, low, high});
    }
    this.canvas.getContext("2d").putImageData(dots, 0, 0);
    this.mapped.over = this.canvas;
    this.mapped.image = frame.left;
    const hide = $("flying").checked;
    if (hide && !this.flying) this.flying = flyingPixels(frame.disparity, frame.width, frame.height);
    const {points} = this, {disparity} = frame, {flying} = this;
    for (let i = 0; i < points.length; i++) {
      const d = disparity[i];
      points[i] = d !== d || (kept && !kept[i]) || (hide && flying[i]) ? HIDDEN : d;
    }
    this.cloud.show(this.geometry, frame.width, frame.height, points, $("by-map").checked && map !== "occlusion" ? dots.data : this.photoDots);
    this.hover(this.pixel && this.pixel.x, this.pixel && this.pixel.y);
  }

  drawScale(table, {least, most, low, high}) {
    const context = $("scale").getContext("2d"), line = new ImageData(256, 1), dots = new Uint32Array(line.data.buffer);
    for (let i = 0; i < 256; i++) {
      const level = ((least + i / 255 * (most - least)) - low) / (high - low);
      dots[i] = table[Math.round(255 * Math.min(1, Math.max(0, level)))];
    }
    context.putImageData(line, 0, 0);
    this.span = {least, most};
    for (const [id, value] of [["low", low], ["high", high]]) {
      $(id).value = 1000 * (value - least) / (most - least);
      const text = this.map === "confidence" ? `${(value * 100).toFixed(0)} %` : `${shown(value)} ${this.map === "depth" ? "m" : "px"}`;
      $(`${id}-text`).textContent = text;
      $(id).setAttribute("aria-valuetext", text);
    }
  }

  setWipe(share) {
    this.mapped.wipe = share;
    $("wipe").value = share * 100;
    this.redraw();
  }

  // pixels

  hover(x, y) {
    const {frame} = this;
    if (!frame) return;
    if (x === null || x === undefined) {
      // what was clicked stays
      this.pixel = this.pinned && {...this.pinned};
    } else {
      this.pixel = {x: Math.min(frame.width - 1, Math.max(0, x)), y: Math.min(frame.height - 1, Math.max(0, y))};
    }
    const at = this.pixel, write = (id, text) => { $(id).textContent = text; };
    this.left.marks = this.mapped.marks = at ? [{...at, color: "#ffd23f"}] : [];
    this.right.marks = [];
    for (const picture of [this.left, this.right]) picture.row = at && $("lines").checked ? at.y : null;
    this.cloud.pixel = at;
    if (!at) {
      for (const id of ["at", "disparity", "depth", "confidence", "match"]) write(id, "–");
      return this.redraw();
    }
    const i = at.y * frame.width + at.x, d = frame.disparity[i];
    write("at", `${at.x}, ${at.y}`);
    write("disparity", Number.isFinite(d) ? `${d.toFixed(2)} px` : "unknown");
    if (!this.geometry.metric) write("depth", "needs a calibration");
    else {
      const z = this.geometry.depth(d), error = this.geometry.standardError(d, Number($("error").value));
      // as many digits as the error leaves
      const digits = Math.min(4, Math.max(0, 1 - Math.floor(Math.log10(error))));
      write("depth", Number.isFinite(z) ? `${z.toFixed(digits)} m ± ${error.toFixed(digits)} m` : "unknown");
    }
    write("confidence", frame.confidence === null ? "none" : `${(frame.confidence[i] * 100).toFixed(0)} %`);
    const match = at.x - d, inside = match >= -0.5 && match < frame.width - 0.5;
    write("match", !Number.isFinite(d) ? "unknown" : inside ? `x = ${match.toFixed(1)}${this.occluded ? this.occluded[i] ? ", occluded" : ", seen" : ""}` : "outside");
    if (Number.isFinite(d) && inside) this.right.marks = [{x: match, y: at.y, color: "#ffd23f"}];
    this.redraw();
  }

  hoverRight(y) {
    for (const picture of [this.left, this.right]) picture.row = y;
    this.redraw();
  }

  async pin(x, y) {
    const {frame, about} = this;
    if (!frame) return;
    if (about.stream && !this.paused) this.pause(true);
    this.pinned = {x, y};
    this.hover(x, y);
    $("chart-at").textContent = `at ${x}, ${y}`;
    if (!about.matching && !about.embedded) {
      $("chart-note").textContent = "A saved result has no distribution; view the pair without --disparity.";
      return;
    }
    $("chart-note").textContent = "Asking the network…";
    try {
      const found = await this.source.distribution(frame.held || frame, x, y);
      if (this.frame !== frame || !this.pinned || this.pinned.x !== x || this.pinned.y !== y) return;
      const near = found.step && (found.x !== x || found.y !== y);
      if (found.step) $("chart-at").textContent = `at ${found.x}, ${found.y}`;
      const estimate = frame.disparity[found.y * frame.width + found.x], said = drawChart($("chart"), found, estimate);
      $("chart-note").textContent = said + (near ? ` This page holds every ${found.step}th pixel of each row and column; this is the nearest.` : "");
    } catch (error) {
      $("chart").textContent = "";
      $("chart-note").textContent = error.message;
    }
  }

  clearChart() {
    $("chart").textContent = "";
    $("chart-at").textContent = "";
    $("chart-note").textContent = "Click a pixel: what the network says about all candidates there.";
  }

  measure(pixel) {
    if (pixel && Number.isFinite(this.frame.disparity[pixel.y * this.frame.width + pixel.x])) this.cloud.measureAt(pixel);
    this.redraw();
  }

  describeMeasured() {
    const {cloud} = this, box = $("measured"), metres = cloud.distance();
    box.hidden = !cloud.ends.length;
    if (!cloud.ends.length) return;
    const text = !this.geometry.metric ? "No calibration, so no metres"
      : metres === null ? "Click another point to measure" : Number.isFinite(metres) ? `Distance ${metres.toFixed(3)} m` : "One of the points is unknown";
    if (box.textContent !== text) box.textContent = text;
  }

  // keys, controls

  pictureKey(event) {
    const {frame} = this;
    if (!frame || event.ctrlKey || event.metaKey || event.altKey) return;
    const by = event.shiftKey ? 10 : 1, steps = {ArrowLeft: [-by, 0], ArrowRight: [by, 0], ArrowUp: [0, -by], ArrowDown: [0, by]};
    const at = this.pixel || {x: frame.width >> 1, y: frame.height >> 1};
    if (event.key in steps) {
      this.hover(at.x + steps[event.key][0], at.y + steps[event.key][1]);
      const {x, y} = this.pixel;
      $("spoken").textContent = `x ${x}, y ${y}: disparity ${$("disparity").textContent}, depth ${$("depth").textContent}`;
    } else if (event.key === "Enter") this.pin(at.x, at.y);
    else if (event.key === "m" || event.key === "M") this.measure(at);
    else if (event.key === "Escape") this.forget();
    else if (event.key === "+" || event.key === "=") this.zoom(1.25, at);
    else if (event.key === "-") this.zoom(0.8, at);
    else if (event.key === "0") { this.window.reset(); this.redraw(); }
    else return;
    event.preventDefault();
  }

  zoom(factor, at) {
    this.window.zoomAt(factor, (at.x + 0.5) / this.frame.width, (at.y + 0.5) / this.frame.height);
    this.redraw();
  }

  cloudKey(event) {
    if (event.ctrlKey || event.metaKey || event.altKey || !this.cloud.geometry) return;
    const turns = {ArrowLeft: [0.06, 0], ArrowRight: [-0.06, 0], ArrowUp: [0, -0.06], ArrowDown: [0, 0.06]};
    if (event.key in turns) this.cloud.rotate(...turns[event.key]);
    else if (event.key === "+" || event.key === "=") this.cloud.nearer(0.9);
    else if (event.key === "-") this.cloud.nearer(1.1);
    else if (event.key === "0") { this.cloud.home(); this.redraw(); }
    else if (event.key === "Escape") this.forget();
    else return;
    event.preventDefault();
  }

  forget() {
    this.pinned = null;
    this.cloud.ends = [];
    this.clearChart();
    this.hover(null);
  }

  listen() {
    $("entries").addEventListener("change", () => this.open(Number($("entries").value)));
    $("previous").addEventListener("click", () => this.open(Number($("entries").value) - 1));
    $("next").addEventListener("click", () => this.open(Number($("entries").value) + 1));
    $("pause").addEventListener("click", () => this.pause(!this.paused));
    $("maps").addEventListener("change", event => this.frame && this.setMap(event.target.value));
    for (const id of ["low", "high"])
      $(id).addEventListener("input", () => {
        const {least, most} = this.span, value = v => least + Number($(v).value) / 1000 * (most - least), gap = (most - least) / 200;
        const low = value("low"), high = value("high");
        id === "low" ? this.setRange(Math.min(low, high - gap), high) : this.setRange(low, Math.max(high, low + gap));
      });
    $("fit").addEventListener("click", () => { delete this.ranges[this.map]; this.compose(); });
    $("least").addEventListener("input", () => { $("least-text").textContent = `${$("least").value} %`; this.compose(); });
    $("error").addEventListener("input", () => this.hover(this.pixel && this.pixel.x, this.pixel && this.pixel.y));
    $("lines").addEventListener("change", () => this.hover(this.pixel && this.pixel.x, this.pixel && this.pixel.y));
    $("wipe").addEventListener("input", () => this.setWipe($("wipe").value / 100));
    for (const id of ["flying", "by-map"]) $(id).addEventListener("change", () => this.frame && this.compose());
    $("home").addEventListener("click", () => { if (this.cloud.geometry) this.cloud.home(); this.redraw(); });
    $("save-picture").addEventListener("click", () => this.savePicture());
    $("save-frame").addEventListener("click", () => this.frame && download(this.source.archive(this.frame), ""));
    $("help-button").addEventListener("click", () => this.help());
    addEventListener("resize", () => this.redraw());
    new ResizeObserver(() => this.redraw()).observe($("cloud"));
    matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => this.redraw());
    addEventListener("keydown", event => {
      if (event.target.matches("input[type=number], select") || event.ctrlKey || event.metaKey || event.altKey) return;
      const map = ["disparity", "depth", "confidence", "occlusion"][Number(event.key) - 1];
      const input = map && document.querySelector(`#maps input[value=${map}]`);
      if (input && !input.disabled && this.frame) { input.checked = true; this.setMap(map); }
      else if (event.key === "[" && !$("previous").disabled) $("previous").click();
      else if (event.key === "]" && !$("next").disabled) $("next").click();
      else if (event.key === " " && !$("stream").hidden && !event.target.matches("button, input")) { event.preventDefault(); $("pause").click(); }
      else if (event.key === "?") this.help();
    });
  }

  help() {
    $("help").hidden = !$("help").hidden;
    $("help-button").setAttribute("aria-expanded", !$("help").hidden);
    this.redraw();
  }

  /** The map over the left view as it is shown, at the size of the image. */
  async savePicture() {
    if (!this.frame) return;
    const {width, height} = this.frame, canvas = new OffscreenCanvas(width, height), context = canvas.getContext("2d");
    const from = this.mapped.wipe * width;
    context.drawImage(this.frame.left, 0, 0);
    context.beginPath();
    context.rect(from, 0, width - from, height);
    context.clip();
    context.drawImage(this.canvas, 0, 0);
    const address = URL.createObjectURL(await canvas.convertToBlob({type: "image/png"}));
    download(address, `${this.frame.name.replace(/[^\w.-]+/g, "_")}_${this.map}.png`);
    setTimeout(() => URL.revokeObjectURL(address), 10000);
  }

  say(text) {
    $("message").textContent = text;
    $("message").hidden = !text;
    this.redraw();
  }

  /** While the cloud moves, a slow graphics card draws fewer points; all of them when it stands still. */
  turned() {
    this.movingUntil = performance.now() + 150;
    clearTimeout(this.still);
    this.still = setTimeout(() => this.redraw(), 200);
    this.redraw();
  }

  busy(busy) { document.body.classList.toggle("busy", busy); }

  redraw() {
    if (this.drawing) return;
    this.drawing = requestAnimationFrame(() => {
      this.drawing = null;
      this.right.lines = this.left.lines = $("lines").checked;
      for (const picture of [this.left, this.right, this.mapped]) {
        picture.quick = this.playing;
        picture.draw();
      }
      const color = getComputedStyle($("cloud")).backgroundColor.match(/[\d.]+/g).slice(0, 3).map(v => v / 255);
      this.cloud.draw(color, this.playing || performance.now() < this.movingUntil);
      if (this.frame) this.describeMeasured();
      document.body.dataset.drawn = Number(document.body.dataset.drawn || 0) + 1;
    });
  }
}

function spreadMean(values) {
  let sum = 0;
  for (let i = 0; i < values.length; i++) sum += values[i];
  return sum / values.length;
}

function download(address, name) {
  const link = document.createElement("a");
  link.href = address;
  link.download = name;
  link.click();
}

window.app = new App();
window.app.start();
