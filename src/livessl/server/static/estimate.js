// The readout of the newest estimate: where, how sure, from whom, and how old that is.

import { percent } from "./events.js";
import { ago, number, position, write } from "./format.js";
import { largestSigma } from "./geometry.js";
import { OLD_MS } from "./plan.js";

/** An update this young means that the sound is still going on. */
const SOUNDING_MS = 1000;

const find = (id) => document.getElementById(id);

export class Readout {
  constructor() {
    this.root = find("estimate");
    this.head = find("estimate-head");
    this.where = find("estimate-where");
    this.instead = find("estimate-instead");
    this.numbers = ["x", "y", "z"].map((axis) => find(`estimate-${axis}`));
    this.sigma = find("estimate-sigma");
    this.meter = find("estimate-meter");
    this.confidence = find("estimate-confidence");
    this.level = find("estimate-level");
    this.arrays = find("estimate-arrays");
    this.shown = null;
  }

  /** Show an update or an event message that was heard; the hooks carry its numbers unrounded. */
  show(message, bornMs, nowMs, link) {
    this.shown = { message, bornMs };
    const event = message.kind === "event";
    const placed = message.position_m && message.status !== "direction-only" && message.status !== "refused";
    const { dataset } = this.root;
    dataset.kind = message.kind;
    dataset.eventId = event ? message.id : message.event_id;
    dataset.status = event ? message.status : "";
    ["x", "y", "z"].forEach((axis, i) => {
      dataset[axis] = message.position_m ? String(message.position_m[i]) : "";
      write(this.numbers[i], message.position_m ? number(message.position_m[i]) : "–");
    });
    this.where.hidden = !placed;
    this.instead.hidden = Boolean(placed);
    if (!placed) write(this.instead, instead(message));
    const sigma = placed ? largestSigma(message.covariance_m2) : null;
    write(this.sigma, sigma === null ? "–" : `± ${number(sigma)} m`);
    this.meter.style.width = `${Math.round(100 * Math.min(1, Math.max(0, message.confidence ?? 0)))}%`;
    write(this.confidence, percent(message.confidence));
    write(this.level, Number.isFinite(message.level_dbfs) ? `${number(message.level_dbfs, 1)} dBFS` : "–");
    write(this.arrays, (message.arrays?.length ? message.arrays : message.heard_by ?? []).join(" + ") || "none");
    this.tick(nowMs, link);
  }

  tick(nowMs, link) {
    if (!this.shown) {
      write(this.head, link === "live" ? "waiting for the first sound" : "no contact with the server");
      return;
    }
    const { message, bornMs } = this.shown;
    const age = nowMs - bornMs;
    const sounding = message.kind === "update" && age < SOUNDING_MS && link === "live";
    this.root.dataset.state = sounding ? "sounding" : age > OLD_MS || link !== "live" ? "old" : "fresh";
    const what = message.kind === "update" ? "last heard" : message.status === "located" ? "event" : message.status.replace("-", " ");
    write(this.head, sounding ? "sounding now" : `${what}, ${ago(age)}`);
  }
}

function instead(message) {
  const bearing = message.contributions?.[0];
  if (message.status === "direction-only" && bearing) {
    const where = `azimuth ${number(bearing.azimuth_deg, 0)}°, elevation ${number(bearing.elevation_deg, 0)}° seen from array ${bearing.array}`;
    return message.reason ? `${where} (${message.reason})` : where;
  }
  return message.reason ?? (message.position_m ? position(message.position_m) : "no position");
}
