// The WebSocket to the server: it always reconnects, and measures how long the server has been silent.
// header.js words the state of the connection on the dashboard; embed.js uses client.js, and words it itself.

import { protocols } from "./access.js";

/** Silence, in milliseconds, after which the page counts as stale: the server sends at least two messages a second. */
const STALE_MS = 2000;
/** Silence, in milliseconds, after which the connection is closed and opened again. */
const DEAD_MS = 5000;
/** How often, in milliseconds, the silence is checked. */
const TICK_MS = 250;
/** Waits before the attempts to reconnect, in milliseconds; the last one repeats. */
const BACK_OFF_MS = [500, 800, 1300, 2100, 3400, 5000];

/**
 * One WebSocket that always reconnects.
 *
 * `onMessage(message)` gets each parsed message. `onState(state, silentMs)` is called at every tick and change; `state`
 * is "live", "stale" (open, but silent) or "down", and `silentMs` is null before the first message ever.
 * `onRejected(reason, failures)` is called when a connection closes before its first message, with the reason that the
 * server gave, empty if it refused the handshake, and the number of such attempts in a row.
 */
export class Live {
  constructor(url, { onMessage, onState, onRejected }) {
    this.url = url;
    this.onMessage = onMessage;
    this.onState = onState;
    this.onRejected = onRejected;
    this.socket = null;
    this.state = "down";
    this.openedAt = 0;
    this.lastMessageAt = null;
    this.failures = 0;
    this.retry = null;
  }

  start() {
    this.#open();
    setInterval(() => this.#tick(), TICK_MS);
    for (const name of ["online", "pageshow"]) addEventListener(name, () => this.reconnectNow());
    document.addEventListener("visibilitychange", () => {
      this.#tick();
      if (!document.hidden) this.reconnectNow();
    });
  }

  /** Connect at once if there is no connection, without the rest of the wait. */
  reconnectNow() {
    if (this.socket === null) this.#open();
  }

  /** Whether a message has arrived on the current connection. */
  get #answered() {
    return this.lastMessageAt !== null && this.lastMessageAt >= this.openedAt;
  }

  #tick() {
    const now = performance.now();
    if (this.socket !== null && now - Math.max(this.openedAt, this.lastMessageAt ?? 0) > DEAD_MS) {
      this.#drop();
      return;
    }
    const silentMs = this.lastMessageAt === null ? null : now - this.lastMessageAt;
    const open = this.socket?.readyState === WebSocket.OPEN;
    if (!open || !this.#answered) this.state = "down";
    else this.state = silentMs < STALE_MS ? "live" : "stale";
    this.onState(this.state, silentMs);
  }

  #open() {
    clearTimeout(this.retry);
    this.retry = null;
    this.openedAt = performance.now();
    const socket = new WebSocket(this.url, protocols());
    this.socket = socket;
    socket.onmessage = ({ data }) => {
      if (socket === this.socket) this.#take(data);
    };
    socket.onclose = ({ reason }) => {
      if (socket !== this.socket) return;
      if (!this.#answered) this.onRejected(reason, this.failures + 1);
      this.#drop();
    };
  }

  #take(text) {
    this.lastMessageAt = performance.now();
    this.failures = 0;
    let message;
    try {
      message = JSON.parse(text);
    } catch {
      console.warn("livessl: ignored a message that is not JSON");
      return;
    }
    if (this.state !== "live") this.#tick();
    this.onMessage(message);
  }

  /** Close the connection and try again after a wait. */
  #drop() {
    const socket = this.socket;
    this.socket = null;
    if (socket !== null) socket.close();
    const wait = BACK_OFF_MS[Math.min(this.failures, BACK_OFF_MS.length - 1)];
    this.failures += 1;
    clearTimeout(this.retry);
    this.retry = setTimeout(() => this.#open(), wait);
    this.#tick();
  }
}
