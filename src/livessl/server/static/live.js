// The socket to the server: kept open for ever, its silence measured, and the server's clock told from the browser's.

import { protocols } from "./access.js";

/** The server speaks twice a second at least, so this much silence means that something is wrong. */
const STALE_MS = 2000;
/** After this much silence the socket is given up and opened anew. */
const DEAD_MS = 5000;
const BACK_OFF_MS = [500, 800, 1300, 2100, 3400, 5000];

/**
 * The clock of the server as seen from here.
 *
 * A message takes some time to arrive, never less than none: of many differences, the greatest is the nearest.
 */
export class ServerClock {
  #samples = [];

  reset() {
    this.#samples = [];
  }

  /** Learn from a message stamped `serverMs` that arrived at `localMs`. */
  learn(serverMs, localMs) {
    this.#samples.push([localMs, serverMs - localMs]);
    this.#samples = this.#samples.filter(([at]) => Math.abs(localMs - at) < 60000).slice(-120);
  }

  /** Server time in milliseconds at the browser's `localMs`; the browser's own until anything is known. */
  at(localMs) {
    return this.#samples.length ? localMs + Math.max(...this.#samples.map(([, offset]) => offset)) : localMs;
  }
}

/**
 * One WebSocket that reconnects for ever.
 *
 * `onMessage(message)` gets each parsed object, `onState(state, silentMs)` is called on every change and every tick;
 * state is "live", "stale" (open, but silent) or "down"; silentMs is null before the first contact ever.
 * `onUnopened()` is called when the server did not let us in, for a reason that browsers do not tell.
 */

export class Live {
  constructor(url, { onMessage, onState, onUnopened }) {
    this.url = url;
    this.onMessage = onMessage;
    this.onState = onState;
    this.onUnopened = onUnopened;
    this.state = "down";
    this.socket = null;
    this.heardAt = null;
    this.openedAt = 0;
    this.failures = 0;
    this.retry = null;
  }

  start() {
    this.#open();
    setInterval(() => this.tick(), 250);
    for (const name of ["online", "pageshow"]) addEventListener(name, () => this.hurry());

    document.addEventListener("visibilitychange", () => {
      this.tick();
      if (!document.hidden) this.hurry();
    });
  }

  /** Milliseconds since anything came, or null before the first contact. */
  get silentMs() {
    return this.heardAt === null ? null : performance.now() - this.heardAt;
  }

  tick() {
    const since = performance.now() - Math.max(this.openedAt, this.heardAt ?? 0);
    if (this.socket !== null && since > DEAD_MS) {
      this.#abandon();
      return;
    }
    const open = this.socket !== null && this.socket.readyState === WebSocket.OPEN;
    const heard = open && this.heardAt !== null && this.heardAt >= this.openedAt;
    const answered = open && this.heardAt !== null && this.heardAt >= this.openedAt;
    if (!answered) this.state = "down";
    else this.state = this.silentMs < STALE_MS ? "live" : "stale";
    this.onState(this.state, this.silentMs);
  }

  #open() {
    clearTimeout(this.retry);
    this.retry = null;
    this.openedAt = performance.now();
    const socket = new WebSocket(this.url, protocols());
    this.socket = socket;
    socket.onmessage = ({ data }) => {
      if (socket !== this.socket) return;
      this.heardAt = performance.now();
      this.failures = 0;
      let message;
      try {
        message = JSON.parse(data);
      } catch {
        console.warn("livessl: a message that is not JSON was ignored");
        return;
      }
      if (this.state !== "live") this.tick();
      this.onMessage(message);
    };
    socket.onclose = () => {
      if (socket !== this.socket) return;
      if (!(this.heardAt >= this.openedAt)) this.onUnopened();
      this.#abandon();
    };
  }

  #abandon() {
    const socket = this.socket;
    this.socket = null;
    if (socket !== null) socket.close();
    const wait = BACK_OFF_MS[Math.min(this.failures, BACK_OFF_MS.length - 1)];
    this.failures += 1;
    clearTimeout(this.retry);
    this.retry = setTimeout(() => this.#open(), wait);
    this.tick();
  }

  /** Try now, rather than after the wait. */
  hurry() {
    if (this.socket === null) this.#open();
  }
}
