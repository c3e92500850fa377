// The readout of the latest estimate: position, uncertainty, confidence, arrays, and how old it is.

import { find, write } from "./dom.js";
import { ago, bearing, number, percent, position, width } from "./format.js";
import { largestSigma } from "./geometry.js";
import { OLD_MS } from "./model.js";

/** Age, in milliseconds, below which an update means that its sound is still in progress. */
const IN_PROGRESS_MS = 1000;
const AXES = ["x", "y", "z"];

export class Readout {
  constructor() {
    this.root = find("estimate");
    this.head = find("estimate-head");
    this.where = find("estimate-where");
    this.instead = find("estimate-instead");
    this.numbers = AXES.map((axis) => find(`estimate-${axis}`));
    this.shown = null;
  }

  /** Show an update or event message; the element's data attributes hold its numbers unrounded. */
  show({ message, marker }, nowMs, link) {
    this.shown = { message, bornMs: marker.bornMs };
    const event = message.kind === "event";
    const placed = Boolean(message.position_m) && !["direction-only", "refused"].includes(message.status);
    const sigma = placed ? largestSigma(message.covariance_m2) : null;
    const arrays = message.arrays?.length ? message.arrays : message.heard_by ?? [];
    this.#fill({
      kind: message.kind,
      eventId: event ? message.id : message.event_id,
      status: event ? message.status : "",
      positionM: message.position_m,
      sigma: sigma === null ? "–" : `± ${number(sigma)} m`,
      confidence: message.confidence,
      level: Number.isFinite(message.level_dbfs) ? `${number(message.level_dbfs, 1)} dBFS` : "–",
      arrays: arrays.join(" + ") || "none",
    });
    this.where.hidden = !placed;
    this.instead.hidden = placed;
    if (!placed) write(this.instead, insteadOfPosition(message));
    this.tick(nowMs, link);
  }

  /** Show nothing, as before the first sound. */
  clear(link) {
    this.shown = null;
    this.#fill({
      kind: "", eventId: "", status: "", positionM: null, sigma: "–", confidence: null, level: "–", arrays: "–",
    });
    this.where.hidden = false;
    this.instead.hidden = true;
    this.root.dataset.state = "waiting";
    this.tick(0, link);
  }

  /** Show the age. */
  tick(nowMs, link) {
    if (this.shown === null) {
      write(this.head, link === "live" ? "Waiting for the first sound" : "Not connected to the server");
      return;
    }
    const { message, bornMs } = this.shown;
    const age = nowMs - bornMs;
    const update = message.kind === "update";
    const inProgress = update && age < IN_PROGRESS_MS && link === "live";
    this.root.dataset.state = inProgress ? "sounding" : age > OLD_MS || link !== "live" ? "old" : "fresh";
    const status = update || message.status === "located" ? "" : ` (${message.status.replace("-", " ")})`;
    write(this.head, inProgress ? "Sound in progress" : `Last ${update ? "update" : `event${status}`}: ${ago(age)}`);
  }

  #fill({ kind, eventId, status, positionM, sigma, confidence, level, arrays }) {
    Object.assign(this.root.dataset, { kind, eventId, status });
    AXES.forEach((axis, i) => {
      this.root.dataset[axis] = positionM ? String(positionM[i]) : "";
      write(this.numbers[i], positionM ? number(positionM[i]) : "–");
    });
    write(find("estimate-sigma"), sigma);
    find("estimate-meter").style.width = width(confidence);
    write(find("estimate-confidence"), percent(confidence));
    write(find("estimate-level"), level);
    write(find("estimate-arrays"), arrays);
  }
}

/** What to show of a result that has no reliable position. */
function insteadOfPosition(message) {
  const first = message.contributions?.[0];
  if (message.status === "direction-only" && first) {
    return message.reason ? `${bearing(first)} (${message.reason})` : bearing(first);
  }
  return message.reason ?? (message.position_m ? position(message.position_m) : "no position");
}
