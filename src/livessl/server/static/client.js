// A client of the server's API in one file, for pages of any origin that the site file permits, and for Node.js 22.
//
//   import { follow } from "http://127.0.0.1:8000/static/client.js";
//   const stop = follow("http://127.0.0.1:8000", { kinds: ["event"], onMessage: (event) => console.log(event) });
//
// Node.js imports it from a file: curl -o client.mjs http://127.0.0.1:8000/static/client.js
//
// It always connects again and resumes: every event that the server stores arrives, and no answer twice. After each
// connection it reads the server's log of stored events besides the WebSocket; what it knows is a copy. client.d.ts has
// the types.

/** Waits before the attempts to connect again, in milliseconds; the last one repeats. */
const BACK_OFF_MS = [100, 300, 800, 2000, 5000];
/** Most events that are remembered to recognize copies: more than a server holds that it has not stored yet. */
const REMEMBERED = 20000;
/** Events after which the log is read although no connection was lost. */
const COMPARED = 1000;
/** Milliseconds after which the log is read again if the server could not answer, or has not stored all events. */
const RETRY_MS = 2000;
/** Longest wait for an answer of the log, in milliseconds. */
const ANSWER_MS = 30000;
/** A connection that lasted so many milliseconds has worked, whatever became of the log. */
const PROVEN_MS = 5000;
/** Statuses below 500 that may be gone at the next attempt. */
const TEMPORARY = [408, 425, 429];
/** Code of a connection that the server closes because of the request: another attempt would not help. */
const POLICY_VIOLATION = 1008;

/**
 * Follow the live messages of a server.
 *
 * @param {string} url address of the server, such as `http://127.0.0.1:8000`
 * @param {import("./client.js").Options} options
 * @returns {() => void} a function that ends it
 */
export function follow(url, options) {
  const follower = new Follower(url.replace(/\/+$/, ""), options);
  follower.open();
  return () => follower.stop();
}

class Follower {
  constructor(url, options) {
    this.url = url;
    this.options = options;
    this.known = new Map(); // by the id of an event: the answers that were delivered, and whether one is of the log
    this.lastSeq = null;
    this.position = null;
    this.unread = 0;
    this.failures = 0;
    this.socket = null;
    this.queue = Promise.resolve(); // messages wait while the log is read
    this.openedMs = null;
    this.nextReadMs = 0;
    this.timer = null;
    this.stopped = false;
  }

  get hasEvents() {
    const { kinds } = this.options;
    return kinds === undefined || kinds.includes("event");
  }

  open() {
    const query = new URLSearchParams();
    const { kinds, zone, minConfidence, track, maxRateHz, token } = this.options;
    const given = { kinds: kinds?.join(","), zone, min_confidence: minConfidence, track, max_rate_hz: maxRateHz };
    for (const [name, value] of Object.entries(given)) if (value !== undefined) query.set(name, value);
    if (this.lastSeq !== null) query.set("since_seq", this.lastSeq);
    if (globalThis.WebSocket === undefined)
      throw new Error("expected a browser or Node.js 22 or newer, which have WebSocket, got an older one");
    const protocols = token === undefined ? [] : ["livessl", `livessl.token.${token}`];
    const socket = new WebSocket(`${this.url.replace(/^http/, "ws")}/api/v1/live?${query}`, protocols);
    this.socket = socket;
    this.queue = Promise.resolve();
    this.openedMs = null;
    this.nextReadMs = 0;
    socket.onmessage = ({ data }) => this.then(socket, () => this.take(JSON.parse(data)));
    let hasEnded = false;
    const end = ({ code, reason }) => {
      if (socket !== this.socket || hasEnded) return;
      hasEnded = true;
      if (code === POLICY_VIOLATION) this.refuse(reason);
      else if (this.openedMs === null) this.explain(socket);
      else this.drop(socket, new Error("the connection was lost"));
    };
    socket.onclose = end;
    socket.onerror = () => setTimeout(end, 0, {}); // before the close in browsers; some versions of Node.js close nothing
  }

  /** Carry a step out after those before, unless the connection is another one by then. */
  then(socket, step) {
    const current = () => socket === this.socket && step();
    this.queue = this.queue.then(current).catch((error) => this.drop(socket, error));
  }

  async take(message) {
    if (message.kind === "hello") {
      this.openedMs = performance.now();
      this.lastSeq ??= message.last_seq;
      this.tell("live");
      if (this.options.kinds === undefined) this.deliver(message);
      await this.readLog();
      return;
    }
    if (message.kind === "gap") {
      if (this.options.kinds?.join() !== "event") this.deliver(message);
      await this.readLog();
      return;
    }
    this.lastSeq = message.seq;
    if (message.kind !== "event") this.deliver(message);
    else if (this.isNews(message, false)) {
      this.deliver(message);
      if (this.unread >= COMPARED) await this.readLog();
    } else if (this.isOutdated(message)) await this.readLog();
  }

  /** Whether an event is to be delivered, because its answer is neither known nor perhaps outdated; remember it. */
  isNews(event, logged) {
    const known = this.known.get(event.id);
    const answer = answerOf(event);
    if (known?.answers.has(answer) || (known?.logged && !logged)) return false;
    this.known.delete(event.id); // so that it is the newest of the map
    this.known.set(event.id, { answers: new Set([...(known?.answers ?? []), answer]), logged });
    if (this.known.size > REMEMBERED) this.known.delete(this.known.keys().next().value);
    this.unread += 1;
    return true;
  }

  /** Whether a live event has an unknown answer, and another one came from the log: only the log knows which is newer. */
  isOutdated(event) {
    return !this.known.get(event.id).answers.has(answerOf(event));
  }

  /** Deliver the stored events that did not come live; without an answer, try again later. */
  async readLog() {
    if (!this.hasEvents || performance.now() < this.nextReadMs) return; // the timer reads it
    const { socket } = this;
    clearTimeout(this.timer);
    let page = { more: true };
    while (page.more) {
      page = await this.ask();
      if (socket !== this.socket) return;
      if (page === null) break;
      if (!page.complete) {
        const reason = "the server does not have all events since the connection was lost";
        this.deliver({ v: 1, kind: "gap", missed: null, reason });
      }
      for (const event of page.events) if (this.isNews(event, true)) this.deliver(event);
      this.position = page.position;
    }
    if (page !== null) {
      this.unread = 0;
      this.failures = 0;
      if (page.unsaved === 0) return;
    }
    this.nextReadMs = performance.now() + RETRY_MS;
    this.timer = setTimeout(() => {
      this.nextReadMs = 0;
      this.then(socket, () => this.readLog());
    }, RETRY_MS);
  }

  /** Return a page of the log, or null if the server cannot answer now; the connection may work all the same. */
  async ask() {
    const query = new URLSearchParams({ limit: 500 });
    const { zone, minConfidence } = this.options;
    if (this.position !== null) query.set("after", this.position);
    if (zone !== undefined) query.set("zone", zone);
    if (minConfidence !== undefined) query.set("min_confidence", minConfidence);
    try {
      const answer = await this.get(`event-log?${query}`);
      if (answer.ok) return await answer.json();
      if (isFinal(answer.status)) this.refuse(`event-log: the server answered ${answer.status}`);
    } catch {
      return null; // no connection, no answer in time, or one that is no JSON
    }
    return null;
  }

  get(path) {
    const { token } = this.options;
    const headers = token === undefined ? {} : { Authorization: `Bearer ${token}` };
    const signal = AbortSignal.timeout(ANSWER_MS);
    return fetch(`${this.url}/api/v1/${path}`, { headers, signal, cache: "no-store", redirect: "error" });
  }

  /** Find out why a connection did not open, which a WebSocket does not say: a token that is refused stays refused. */
  async explain(socket) {
    let status = null;
    try {
      ({ status } = await this.get("tracks"));
    } catch {
      // nobody answers
    }
    if (socket !== this.socket) return;
    if (status === 401 || status === 403) this.refuse(`the server answered ${status}; give a token that is valid`);
    else this.drop(socket, new Error("no connection"));
  }

  /** Hand a message to the page, whose errors are its own: they are reported and change nothing here. */
  deliver(message) {
    if (!this.stopped) this.call(this.options.onMessage, message);
  }

  tell(state, error) {
    if (this.options.onState !== undefined) this.call(this.options.onState, state, error);
  }

  call(callback, ...given) {
    try {
      callback(...given);
    } catch (error) {
      queueMicrotask(() => {
        throw error;
      });
    }
  }

  /** Close a connection and try again after a wait. */
  drop(socket, error) {
    if (socket !== this.socket) return;
    this.socket = null;
    if (socket !== null) socket.close();
    if (this.stopped) return;
    if (this.openedMs !== null && performance.now() - this.openedMs >= PROVEN_MS) this.failures = 0;
    this.tell("down", error);
    clearTimeout(this.timer);
    const wait = BACK_OFF_MS[Math.min(this.failures, BACK_OFF_MS.length - 1)];
    this.failures += 1;
    this.timer = setTimeout(() => this.open(), wait * (0.5 + Math.random() / 2));
  }

  refuse(reason) {
    this.stop();
    this.tell("refused", new Error(reason));
  }

  stop() {
    this.stopped = true;
    this.drop(this.socket, null);
    clearTimeout(this.timer);
  }
}

/** Whether a request that was answered with this status would fail again. */
const isFinal = (status) => status >= 400 && status < 500 && !TEMPORARY.includes(status);

/** What an event says about the sound, as a text that is equal for copies only. */
const answerOf = (event) => {
  const { time_utc, start_s, duration_s, position_m, covariance_m2, confidence, arrays, status, replaces } = event;
  const when = time_utc ?? start_s;
  return JSON.stringify([when, duration_s, position_m, covariance_m2, confidence, arrays, status, replaces]);
};
