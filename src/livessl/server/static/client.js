// A client of the server's API in one file, for pages of any origin that the site file permits, and for Node.js 22.
//
//   import { follow } from "http://127.0.0.1:8000/static/client.js";
//   const stop = follow("http://127.0.0.1:8000", { kinds: ["event"], onMessage: (event) => console.log(event) });
//
// It connects again for ever and resumes: every event that the server stores arrives, and no answer twice. After each
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
    const protocols = token === undefined ? [] : ["livessl", `livessl.token.${token}`];
    const socket = new WebSocket(`${this.url.replace(/^http/, "ws")}/api/v1/live?${query}`, protocols);
    this.socket = socket;
    let queue = Promise.resolve(); // messages wait while the log is read
    socket.onmessage = ({ data }) => {
      queue = queue.then(() => socket === this.socket && this.take(JSON.parse(data))).catch((error) => this.drop(error));
    };
    socket.onclose = ({ code, reason }) => {
      if (socket !== this.socket) return;
      if (code === POLICY_VIOLATION) this.refuse(reason);
      else this.drop(new Error("the connection was lost"));
    };
  }

  async take(message) {
    if (message.kind === "hello") {
      this.failures = 0;
      this.lastSeq ??= message.last_seq;
      this.options.onState?.("live");
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

  async readLog() {
    if (!this.hasEvents) return;
    clearTimeout(this.timer);
    let page = { more: true };
    while (page.more) {
      page = await this.ask();
      if (page === null) break; // the server's database is away
      if (!page.complete) {
        const reason = "the server does not have all events since the connection was lost";
        this.deliver({ v: 1, kind: "gap", missed: null, reason });
      }
      for (const event of page.events) if (this.isNews(event, true)) this.deliver(event);
      this.position = page.position;
    }
    this.unread = 0;
    if (page === null || page.unsaved > 0) this.timer = setTimeout(() => this.readLog().catch((e) => this.drop(e)), RETRY_MS);
  }

  async ask() {
    const query = new URLSearchParams({ limit: 500 });
    const { zone, minConfidence, token } = this.options;
    if (this.position !== null) query.set("after", this.position);
    if (zone !== undefined) query.set("zone", zone);
    if (minConfidence !== undefined) query.set("min_confidence", minConfidence);
    const headers = token === undefined ? {} : { Authorization: `Bearer ${token}` };
    const signal = AbortSignal.timeout(ANSWER_MS);
    const answer = await fetch(`${this.url}/api/v1/event-log?${query}`, { headers, signal, cache: "no-store" });
    if (answer.status === 503) return null;
    if (!answer.ok) throw new Error(`event-log: the server answered ${answer.status}`);
    return answer.json();
  }

  deliver(message) {
    if (!this.stopped) this.options.onMessage(message);
  }

  /** Close the connection and try again after a wait. */
  drop(error) {
    const { socket } = this;
    this.socket = null;
    if (socket !== null) socket.close();
    if (this.stopped) return;
    this.options.onState?.("down", error);
    clearTimeout(this.timer);
    const wait = BACK_OFF_MS[Math.min(this.failures, BACK_OFF_MS.length - 1)];
    this.failures += 1;
    this.timer = setTimeout(() => this.open(), wait * (0.5 + Math.random() / 2));
  }

  refuse(reason) {
    this.stop();
    this.options.onState?.("refused", new Error(reason));
  }

  stop() {
    this.stopped = true;
    this.drop(null);
    clearTimeout(this.timer);
  }
}

/** What an event says about the sound, as a text that is equal for copies only. */
const answerOf = ({ time_utc, start_s, duration_s, position_m, covariance_m2, confidence, arrays, status }) =>
  JSON.stringify([time_utc ?? start_s, duration_s, position_m, covariance_m2, confidence, arrays, status]);
