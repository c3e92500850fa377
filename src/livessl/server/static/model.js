// The page's state, collected from the server's messages: arrays, estimates, tracks, events. It touches no element.

import { utc } from "./format.js";
import { zonesOf } from "./plan-zones.js";
import { ServerClock } from "./server-clock.js";

/** Age, in milliseconds, beyond which an estimate is drawn as old. */
export const OLD_MS = 10000;
/** Delay, in milliseconds, up to which a result counts as new: transport and errors of the clock explain as much. */
export const LATE_MS = 3000;
/** How long, in milliseconds, the marker of a sound in progress stays without a further update. */
const UPDATE_SHOWN_MS = 1500;
/** Most past estimates drawn as a trail. */
const TRAIL_LENGTH = 20;
/** Most points drawn of a track. */
const TRACK_POINTS = 60;
/** Results of each kind that the shown latency is the median of. */
const LATENCIES = 20;

export class Model {
  constructor() {
    /** The answer of GET site, or null before it. */
    this.site = null;
    /** The picture under the floor plan, as { image, bounds }, or null. */
    this.floorPlan = null;
    /** "live" or "replay", or null before the first message. */
    this.mode = null;
    /** State of the connection: "live", "stale" or "down". */
    this.link = "down";
    /** Objects { array, sentMs }: an array as the server described it, and when, by the browser's clock. */
    this.arrays = [];
    /** The newest update or event, as { message, marker }. */
    this.newest = null;
    /** Markers of the sounds in progress, by event id. */
    this.current = new Map();
    /** Markers of past estimates, oldest first. */
    this.trail = [];
    /** Objects { points, velocity, ended, updatedMs }, by track id. */
    this.tracks = new Map();
    /** The event that is pointed at or selected in the list, as a marker, or null. */
    this.highlight = null;
    /** The answer for the event that was located again last, as a marker with its id, or null. */
    this.again = null;
    /** The last messages that report a latency, newest last. */
    this.latencies = { update: [], event: [] };
    this.serverClock = new ServerClock();
  }

  serverNow() {
    return this.serverClock.at(Date.now());
  }

  /** Start anew after a connection was made. */
  greet({ mode }) {
    this.serverClock.reset();
    this.tracks.clear();
    this.mode = mode;
  }

  /** Forget all results, and the server's time. */
  forgetResults() {
    this.serverClock.reset();
    this.tracks.clear();
    this.current.clear();
    this.trail = [];
    this.newest = null;
  }

  /** Take the arrays' states, and the server's time with them. */
  takeArrays(message) {
    const now = Date.now();
    const stampMs = utc(message.now_utc);
    let delayMs = 0;
    if (stampMs !== null && this.mode === "replay") this.serverClock.freeze(stampMs);
    else if (stampMs !== null) {
      this.serverClock.learn(stampMs, now);
      delayMs = Math.max(0, this.serverClock.at(now) - stampMs);
    }
    this.arrays = message.arrays.map((array) => ({ array, sentMs: now - delayMs }));
  }

  /** Take where a sound in progress seems to be. */
  takeUpdate(message) {
    const bornMs = this.#born(message, 0, true);
    const shown = marker(message, bornMs);
    this.current.set(message.event_id, shown);
    this.#setOthers(message.event_id, message.others ?? [], bornMs);
    if (shown.position) this.#leaveTrail(shown);
    this.#learnLatency("update", message);
    this.newest = { message, marker: shown };
  }

  /** Take a finished event. */
  takeEvent(event) {
    const shown = marker(event, this.#born(event, event.duration_s, true));
    this.current.delete(event.id);
    this.#setOthers(event.id, [], 0);
    if (isPlaced(shown)) this.#leaveTrail(shown);
    this.#learnLatency("event", event);
    this.newest = { message: event, marker: shown };
  }

  /** Take events from the server's store, newest first. */
  takeStored(events) {
    const markers = events.map((event) => marker(event, this.#born(event, event.duration_s, false)));
    const known = new Set(this.trail.filter(({ kind }) => kind === "event").map(({ id }) => id));
    const missing = markers.filter((each) => isPlaced(each) && !known.has(each.id)).reverse();
    this.trail = [...missing, ...this.trail].sort(byAge).slice(-TRAIL_LENGTH);
    if (events.length > 0 && (this.newest === null || markers[0].bornMs > this.newest.marker.bornMs + LATE_MS)) {
      this.newest = { message: { kind: "event", ...events[0] }, marker: markers[0] };
    }
    for (const event of events.slice(0, LATENCIES).reverse()) {
      if (this.latencies.event.length < LATENCIES) this.#learnLatency("event", event);
    }
  }

  /** Take a track's newest state. */
  takeTrack({ id, state, position_m: position, velocity_m_s: velocity }) {
    const points = state === "new" ? [] : this.tracks.get(id)?.points ?? [];
    this.tracks.set(id, {
      points: (position ? [...points, position] : points).slice(-TRACK_POINTS),
      velocity,
      ended: state === "end",
      updatedMs: Date.now(),
    });
  }

  /** Mark an event on the plans, or none. */
  setHighlight(event, label) {
    this.highlight = event === null ? null : { ...marker(event, 0), label };
  }

  /** While an event is highlighted, mark also where it was when it was located again; null for nowhere. */
  setAgain(id, answer) {
    const label = `again: ${answer?.method}`;
    this.again = answer === null ? null : { ...marker({ ...answer, id }, 0), label, labelBelow: true };
  }

  /** Remove what has not been updated for too long. */
  expire(now) {
    for (const [id, { bornMs }] of this.current) if (now - bornMs > UPDATE_SHOWN_MS) this.current.delete(id);
    for (const [id, { updatedMs }] of this.tracks) if (now - updatedMs > OLD_MS) this.tracks.delete(id);
  }

  /** Everything that the plans draw, at the browser's time `now`; `images` are the coloured power maps, or null; `draft` is a zone. */
  scene(now, images, draft = null) {
    const { site } = this;
    const reported = new Map(this.arrays.map(({ array }) => [array.name, array]));
    const newest = this.newest?.marker;
    const estimates = [...this.current.values()].filter(({ id }) => id !== newest?.id);
    if (newest && newest.status !== "refused") estimates.push({ ...newest, newest: true });
    return {
      now,
      images,
      cellM: site.grid.spacing_m,
      zones: zonesOf(site.zones),
      floorPlan: this.floorPlan,
      draft,
      arrays: Object.entries(site.arrays).map(([name, { position_m: position, microphones_m: microphones }]) => ({
        name,
        position,
        microphones,
        state: shownState(reported.get(name), this.link),
        active: this.link === "live" && Boolean(reported.get(name)?.active),
      })),
      trail: this.trail,
      tracks: [...this.tracks.values()],
      estimates,
      highlight: this.highlight,
      again: this.again !== null && this.again.id === this.highlight?.id ? { ...this.again, bornMs: now } : null,
    };
  }

  /**
   * When a result's sound ended, in milliseconds of the browser's clock.
   *
   * A new message that is hardly older than transport takes counts from its arrival, so that small errors of the clock
   * estimate do not show. In a replay the time stamps are those of the recording and give no age.
   */
  #born(message, durationS, isNew) {
    const now = Date.now();
    const ms = utc(message.time_utc);
    if (ms === null || this.mode === "replay") return isNew ? now : -Infinity;
    const age = Math.max(0, this.serverNow() - (ms + 1000 * (durationS ?? 0)));
    return isNew && age < LATE_MS ? now : now - age;
  }

  /** Replace the markers of further sources of a sound in progress. */
  #setOthers(id, others, bornMs) {
    for (const key of [...this.current.keys()]) if (key.startsWith(`${id}/`)) this.current.delete(key);
    others.forEach((other, index) => {
      const key = `${id}/${index + 2}`;
      const shown = marker({ ...other, kind: "update", event_id: key }, bornMs);
      this.current.set(key, shown);
      this.#leaveTrail(shown);
    });
  }

  #leaveTrail(shown) {
    this.trail = [...this.trail, shown].slice(-TRAIL_LENGTH);
  }

  #learnLatency(kind, message) {
    if (Number.isFinite(message.latency_s)) this.latencies[kind] = [...this.latencies[kind], message].slice(-LATENCIES);
  }
}

/** The state to show of an array: the server's word while the connection is live, "unknown" otherwise. */
export function shownState(array, link) {
  return link === "live" && array ? array.state : "unknown";
}

function marker(message, bornMs) {
  return {
    kind: message.kind ?? "event",
    id: message.kind === "update" ? message.event_id : message.id,
    status: message.status ?? "located",
    position: message.position_m,
    covariance: message.covariance_m2,
    rays: (message.contributions ?? []).map(({ array, azimuth_deg: azimuth, elevation_deg: elevation }) => (
      { array, azimuth, elevation }
    )),
    bornMs,
  };
}

function isPlaced({ position, status }) {
  return Boolean(position) && status === "located";
}

/** Oldest first; markers of unknown age, at minus infinity, keep their order. */
function byAge(a, b) {
  return a.bornMs === b.bornMs ? 0 : a.bornMs - b.bornMs;
}
