// The WebSocket that delivers power maps, and their binary form; it is open only while the page is visible.

import { protocols } from "./access.js";

const RETRY_MS = 2000;
const MAGIC = 0x50414d4c; // "LMAP", little-endian
const VIEWS = ["floor", "side", "front"];

/** A map of one view from its binary message; docs/api.md describes the header. */
function unpack(bytes) {
  const view = new DataView(bytes);
  if (view.getUint32(0, true) !== MAGIC) throw new Error("map message: expected the magic number LMAP");
  const headerLength = view.getUint16(6, true);
  const [rows, columns] = [44, 46].map((at) => view.getUint16(at, true));
  const expected = headerLength + rows * columns;
  if (bytes.byteLength !== expected) {
    throw new Error(`map message: expected ${expected} bytes, got ${bytes.byteLength}`);
  }
  const [bottom, top, left, right] = [28, 32, 36, 40].map((at) => view.getFloat32(at, true));
  return {
    view: VIEWS[view.getUint8(5)],
    values: new Uint8Array(bytes, headerLength),
    rows,
    columns,
    bounds: { left, right, bottom, top },
    timeNs: view.getBigInt64(8, true),
    bornMs: Date.now() - 1000 * view.getFloat32(16, true),
  };
}

/** Receives the maps of some views, of one array or of all arrays fused. */
export class MapFeed {
  /** `onMaps({ views, bornMs, time })` gets the maps of one window, by view. */
  constructor(base, onMaps) {
    this.url = new URL("map", base);
    this.url.protocol = this.url.protocol === "https:" ? "wss:" : "ws:";
    this.onMaps = onMaps;
    this.choice = "fused";
    this.socket = null;
    this.views = ["floor", "side"];
    /** The maps of the newest window so far, by view. */
    this.window = { timeNs: null, views: {} };
    this.retry = null;
    document.addEventListener("visibilitychange", () => this.watch());
  }

  /** Receive other maps: "fused" or an array's name. */
  choose(name) {
    this.choice = name;
    this.#close();
    this.watch();
  }

  /** Receive the maps of other views. */
  need(views) {
    if (views.join() === this.views.join()) return;
    this.views = views;
    if (this.socket === null) return;
    this.#close();
    this.watch();
  }

  /** Connect while the page is visible; disconnect while it is not. */
  watch() {
    if (document.hidden) this.#close();
    else if (this.socket === null) this.#open();
  }

  #close() {
    clearTimeout(this.retry);
    const socket = this.socket;
    this.socket = null;
    if (socket !== null) socket.close();
  }

  #open() {
    this.url.search = new URLSearchParams({ array: this.choice, views: this.views.join() });
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

  /** Keep a map until those of all views of the same window have arrived. */
  #take(map) {
    if (map.timeNs !== this.window.timeNs) this.window = { timeNs: map.timeNs, views: {} };
    const { views } = this.window;
    views[map.view] = map;
    if (!this.views.every((view) => view in views)) return;
    const time = new Date(Number(map.timeNs / 1000000n)).toISOString();
    this.onMaps({ views: { ...views }, bornMs: map.bornMs, time });
  }
}
