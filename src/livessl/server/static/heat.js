// Power maps: sent by the server while the page can be seen, as fresh as the sound, and coloured by lightness.

import { protocols } from "./access.js";

const RETRY_MS = 2000;
const MAGIC = 0x50414d4c; // "LMAP", little-endian
const VIEWS = ["floor", "side", "front"];
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

/** The median and the maximum of some levels. */
export function contrast(levels) {
  const sorted = levels.slice().sort();
  return { low: sorted[sorted.length >> 1], high: sorted[sorted.length - 1] };
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
      const level = Math.max(0, Math.round((value - low) * scale));
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

/** A picture from its bytes: see docs/api.md for the header. */
export function unpack(bytes) {
  const view = new DataView(bytes);
  if (view.getUint32(0, true) !== MAGIC) throw new Error("expected a picture of a map");
  const header = view.getUint16(6, true);
  const [rows, columns] = [44, 46].map((at) => view.getUint16(at, true));
  if (bytes.byteLength !== header + rows * columns) throw new Error(`expected ${rows} x ${columns} levels`);
  const [bottom, top, left, right] = [28, 32, 36, 40].map((at) => view.getFloat32(at, true));
  return {
    view: VIEWS[view.getUint8(5)],
    values: new Uint8Array(bytes, header),
    rows,
    columns,
    bounds: { left, right, bottom, top },
    stamp: view.getBigInt64(8, true),
    bornMs: Date.now() - 1000 * view.getFloat32(16, true),
  };
}

/** Watches the floor's and the side's map of the chosen array for as long as the page can be seen. */
export class HeatFeed {
  constructor(base, onMaps) {
    this.url = new URL("map", base);
    this.url.protocol = this.url.protocol === "https:" ? "wss:" : "ws:";
    this.onMaps = onMaps;
    this.choice = "fused";
    this.socket = null;
    this.floor = null;
    this.retry = null;
    document.addEventListener("visibilitychange", () => this.watch());
  }

  /** Show another map: "fused" or an array's name. */
  choose(name) {
    this.choice = name;
    this.onMaps(null);
    this.#leave();
    this.watch();
  }

  /** Be connected while the page can be seen. */
  watch() {
    if (document.hidden) this.#leave();
    else if (this.socket === null) this.#open();
  }

  #leave() {
    clearTimeout(this.retry);
    const socket = this.socket;
    this.socket = null;
    if (socket !== null) socket.close();
  }

  #open() {
    this.url.search = new URLSearchParams({ array: this.choice, views: "floor,side" });
    const socket = new WebSocket(this.url, protocols());
    socket.binaryType = "arraybuffer";
    this.socket = socket;
    socket.onmessage = ({ data }) => {
      if (socket === this.socket) this.#take(unpack(data));
    };
    socket.onclose = () => {
      if (socket !== this.socket) return;
      this.socket = null;
      this.retry = setTimeout(() => this.watch(), RETRY_MS);
    };
  }

  /** Both views of a window make its map. */
  #take(picture) {
    if (picture.view === "floor") this.floor = picture;
    else if (this.floor !== null && this.floor.stamp === picture.stamp) {
      const time = new Date(Number(picture.stamp / 1000000n)).toISOString();
      this.onMaps({ floor: this.floor, side: picture, bornMs: picture.bornMs, time });
    }
  }
}
