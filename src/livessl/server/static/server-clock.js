// Estimates the server's time from the browser's clock and the time stamps of messages.

/** Time span, in milliseconds, of the stamps in use: some message in it was not delayed, and clocks drift little in it. */
const WINDOW_MS = 60000;
/** Most time stamps used: a minute of the two messages a second that carry one. */
const MOST_STAMPS = 120;

/**
 * The server's clock.
 *
 * A message arrives some time after its stamp, never before. So the largest of the observed differences between stamp
 * and arrival belongs to the least delayed message and is the best estimate of the offset between the two clocks.
 */
export class ServerClock {
  #offsets = [];
  #frozenMs = null;

  reset() {
    this.#offsets = [];
    this.#frozenMs = null;
  }

  /** Use a message stamped `serverMs` that arrived at the browser's `localMs`. */
  learn(serverMs, localMs) {
    this.#offsets.push([localMs, serverMs - localMs]);
    this.#offsets = this.#offsets.filter(([at]) => Math.abs(localMs - at) < WINDOW_MS).slice(-MOST_STAMPS);
  }

  /** Stand still at `serverMs` until the next call: a replay's time may run at any speed, and stops at its end. */
  freeze(serverMs) {
    this.#frozenMs = serverMs;
  }

  /** Server time in milliseconds at the browser's `localMs`; the browser's own time before the first stamp. */
  at(localMs) {
    if (this.#frozenMs !== null) return this.#frozenMs;
    return this.#offsets.length ? localMs + Math.max(...this.#offsets.map(([, offset]) => offset)) : localMs;
  }
}
