"use strict";
// The distribution over the candidates at a pixel: all of them, those kept, and the estimate.

function drawChart(box, found, estimate) {
  const width = 300, height = 170, left = 40, right = 8, top = 18, bottom = 30;
  const {candidates} = found, last = candidates.length - 1;
  const values = candidates.map(c => c.disparity), gaps = values.slice(1).map((v, i) => v - values[i]).filter(gap => gap > 0);
  const gap = gaps.length ? Math.min(...gaps) : 1, low = Math.min(...values) - gap / 2, high = Math.max(...values) + gap / 2;
  const peak = Math.max(...candidates.map(c => c.probability));
  const ceiling = [0.05, 0.1, 0.2, 0.4, 0.6, 0.8, 1].find(level => peak <= level) || 1;
  const x = value => left + (value - low) / (high - low) * (width - left - right);
  const y = share => height - bottom - share / ceiling * (height - top - bottom);
  const parts = [];
  const add = (name, attributes, text = "") => {
    const listed = Object.entries(attributes).map(([key, value]) => `${key}="${typeof value === "number" ? +value.toFixed(2) : value}"`);
    parts.push(`<${name} ${listed.join(" ")}>${text}</${name}>`);
  };
  for (const share of [0, ceiling / 2, ceiling]) {
    add("line", {class: "grid", x1: left, x2: width - right, y1: y(share), y2: y(share)});
    add("text", {class: "tick", x: left - 5, y: y(share) + 3.5, "text-anchor": "end"}, `${+(share * 100).toFixed(1)} %`);
  }
  const step = niceStep((high - low) / 5);
  for (let tick = Math.ceil(low / step) * step; tick <= high; tick += step)
    add("text", {class: "tick", x: x(tick), y: height - bottom + 14, "text-anchor": "middle"}, String(+tick.toFixed(2)));
  add("text", {class: "tick", x: (left + width - right) / 2, y: height - 3, "text-anchor": "middle"}, "disparity, px");
  const wide = Math.max(1.2, Math.min(14, 0.8 * gap / (high - low) * (width - left - right)));
  for (const kept of [false, true])
    for (const c of candidates) {
      if (c.kept !== kept) continue;
      const tall = Math.max(kept ? 1 : 0, y(0) - y(c.probability));
      add("rect", {class: kept && keptCount(candidates) <= last ? "bar kept" : "bar", x: x(c.disparity) - wide / 2, y: y(0) - tall, width: wide, height: tall},
        `<title>${shown(c.disparity)} px: ${(c.probability * 100).toFixed(1)} %</title>`);
    }
  if (Number.isFinite(estimate)) {
    const at = Math.min(width - right, Math.max(left, x(estimate)));
    add("line", {class: "estimate", x1: at, x2: at, y1: top - 4, y2: height - bottom});
    add("text", {class: "estimate-text", x: Math.min(width - 40, Math.max(left + 30, at)), y: top - 8, "text-anchor": "middle"}, `${shown(estimate)} px`);
  }
  const few = candidates.filter(c => c.kept).sort((a, b) => b.probability - a.probability);
  const best = few.slice(0, 3).map(c => `${shown(c.disparity)} px ${(c.probability * 100).toFixed(0)} %`).join(", ");
  const label = `Distribution over ${candidates.length} candidates. Likeliest: ${best}.`;
  box.innerHTML = `<svg viewBox="0 0 ${width} ${height}" role="img" aria-label="${label}">${parts.join("")}</svg>`;
  const keeps = few.length === candidates.length ? `all ${candidates.length} candidates kept` : `${few.length} of ${candidates.length} candidates kept, with ${(100 * few.reduce((sum, c) => sum + c.probability, 0)).toFixed(0)} % of the probability`;
  return `${keeps[0].toUpperCase()}${keeps.slice(1)}. Likeliest: ${best}. They give ${shown(found.expectation)} px at their own resolution; standard deviation of all: ${shown(found.spread)} px.`;
}

function keptCount(candidates) { return candidates.reduce((count, c) => count + c.kept, 0); }

/** 1, 2 or 5 times a power of ten, at least `least`. */
function niceStep(least) {
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map(n => n * power).find(step => step >= least);
}
