// Power maps: fetched as raw float32, kept at most as fresh as the sound, and coloured by lightness.

import { utc } from "./format.js";

/** Not sooner than this after the last fetch: five times a second. */
const MIN_INTERVAL_MS = 200;
const TIMEOUT_MS = 4000;
const FULL_MS = 1000;
const GONE_MS = 9000;

/** Anchors [place, lightness, chroma, hue in degrees] in OKLCh: lightness runs evenly from the paper to its opposite. */
const RAMPS = {
  dark: [[0, 0.175, 0.014, 258], [0.25, 0.31, 0.1, 290], [0.5, 0.47, 0.165, 352], [0.75, 0.69, 0.165, 405], [1, 0.95, 0.085, 458]],
  light: [[0, 0.985, 0.004, 95], [0.25, 0.9, 0.07, 88], [0.5, 0.75, 0.14, 58], [0.75, 0.55, 0.18, 18], [1, 0.3, 0.12, -45]],
};

const gamma = (c) => (c <= 0.0031308 ? 12.92 * c : 1.055 * c ** (1 / 2.4) - 0.055);

function srgb(lightness, chroma, hueDeg) {
  const hue = (hueDeg * Math.PI) / 180;
  const a = chroma * Math.cos(hue);
  const b = chroma * Math.sin(hue);
  const l = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (lightness - 0.0894841775 * a - 1.291485548 * b) ** 3;
  return [
    4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
    -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
    -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s,
  ].map((c) => Math.round(255 * gamma(Math.min(1, Math.max(0, c)))));
}

/** 256 colours (r, g, b) from the median's to the maximum's, for the "dark" or "light" theme. */
export function ramp(theme) {
  const anchors = RAMPS[theme];
  const table = new Uint8ClampedArray(256 * 3);
  for (let i = 0; i < 256; i += 1) {
    const t = i / 255;
    const upper = Math.max(1, anchors.findIndex(([place]) => place >= t));
    const [from, to] = [anchors[upper - 1], anchors[upper]];
    const u = (t - from[0]) / (to[0] - from[0]);
    table.set(srgb(...[1, 2, 3].map((k) => from[k] + u * (to[k] - from[k]))), i * 3);
  }
  return table;
}

/** The median of what is finite, and the maximum. */
export function contrast(values) {
  const sorted = values.filter(Number.isFinite).sort();
  return sorted.length ? { low: sorted[sorted.length >> 1], high: sorted[sorted.length - 1] } : { low: 0, high: 0 };
}

/** A canvas of one pixel a node, first row at the bottom: the median and all below it transparent. */
export function paint({ values, rows, columns }, table) {
  const canvas = document.createElement("canvas");
  canvas.width = columns;
  canvas.height = rows;
  const context = canvas.getContext("2d");
  const image = context.createImageData(columns, rows);
  const { low, high } = contrast(values);
  const scale = high > low ? 255 / (high - low) : 0;
  for (let row = 0; row < rows; row += 1) {
    for (let column = 0; column < columns; column += 1) {
      const value = values[row * columns + column];
      const level = Number.isFinite(value) ? Math.min(255, Math.max(0, Math.round((value - low) * scale))) : 0;
      const at = ((rows - 1 - row) * columns + column) * 4;
      image.data[at] = table[level * 3];
      image.data[at + 1] = table[level * 3 + 1];
      image.data[at + 2] = table[level * 3 + 2];
      image.data[at + 3] = Math.min(255, level * 8);
    }
  }
  context.putImageData(image, 0, 0);
  return canvas;
}

/** How visible a map of this age is, 1 to 0. */
export function visibility(ageMs) {
  return Math.min(1, Math.max(0, (GONE_MS - ageMs) / (GONE_MS - FULL_MS)));
}

/** Fetches the floor's and the side's map of the chosen array when asked to, never more often than it may. */
export class HeatFeed {
  constructor(base, onMaps) {
    this.base = base;
    this.onMaps = onMaps;
    this.choice = "fused";
    this.wanted = false;
    this.busy = false;
    this.fetchedAt = -Infinity;
    document.addEventListener("visibilitychange", () => this.#pump());
  }

  /** There may be a newer map. */
  want() {
    this.wanted = true;
    this.#pump();
  }

  /** Show another map: "fused" or an array's name. */
  choose(name) {
    this.choice = name;
    this.onMaps(null);
    this.want();
  }

  async #pump() {
    if (!this.wanted || this.busy || document.hidden) return;
    const wait = this.fetchedAt + MIN_INTERVAL_MS - performance.now();
    this.busy = true;
    if (wait > 0) await new Promise((done) => setTimeout(done, wait));
    this.wanted = false;
    this.fetchedAt = performance.now();
    const choice = this.choice;
    try {
      const [floor, side] = await Promise.all(["floor", "side"].map((view) => this.#fetch(choice, view)));
      if (choice === this.choice) this.onMaps(floor && side ? { floor, side, bornMs: floor.bornMs, time: floor.time } : null);
    } catch (error) {
      if (!(error instanceof TypeError) && error.name !== "TimeoutError") console.warn("livessl: map:", error.message);
    } finally {
      this.busy = false;
    }
    if (this.wanted) this.#pump();
  }

  async #fetch(choice, view) {
    const url = new URL("map", this.base);
    url.search = new URLSearchParams({ array: choice, view, format: "float32" });
    const response = await fetch(url, { cache: "no-store", signal: AbortSignal.timeout(TIMEOUT_MS) });
    if (response.status === 204 || response.status === 404) return null;
    if (!response.ok) throw new Error(`${view} map: the server answered ${response.status}`);
    const bytes = await response.arrayBuffer();
    const [rows, columns] = (response.headers.get("X-Map-Shape") ?? "").split(",").map(Number);
    if (!(rows * columns * 4 === bytes.byteLength)) {
      throw new Error(`${view} map: expected ${rows} x ${columns} float32, got ${bytes.byteLength} bytes`);
    }
    const time = response.headers.get("X-Map-Time-Utc");
    const age = Number(response.headers.get("X-Map-Age-S"));
    return { values: littleEndian(bytes), rows, columns, time: utc(time) === null ? null : time, bornMs: Date.now() - 1000 * (Number.isFinite(age) ? age : 0) };
  }
}

function littleEndian(bytes) {
  if (new Uint8Array(new Uint16Array([1]).buffer)[0] === 1) return new Float32Array(bytes);
  const view = new DataView(bytes);
  return Float32Array.from({ length: bytes.byteLength / 4 }, (_, i) => view.getFloat32(4 * i, true));
}
