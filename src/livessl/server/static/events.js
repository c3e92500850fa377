// The list of events, newest first: a row each, its details on demand, never more rows than a page can carry.

import { el, number, position, when } from "./format.js";
import { largestSigma } from "./geometry.js";

const MOST_ROWS = 200;

export class EventList {
  /** `onMark(event | null)` is called when an event is pointed at, focused or pinned, and when it no longer is. */
  constructor(list, { empty, count, onMark }) {
    this.list = list;
    this.empty = empty;
    this.count = count;
    this.onMark = onMark;
    this.rows = new Map();
    this.pinned = null;
    list.addEventListener("keydown", (event) => this.#walk(event));
  }

  /** Put the stored events (newest first) under what came by socket since they were asked for. */
  load(events, since, nowMs) {
    const stored = new Set(events.map(({ id }) => id));
    const newer = [...this.rows.values()].filter((row) => since.has(row.event.id) && !stored.has(row.event.id));
    const older = [...this.rows.values()].filter((row) => !since.has(row.event.id) && !stored.has(row.event.id));
    const middle = events.map((event) => this.#row(event, nowMs));
    this.rows = new Map([...newer, ...middle, ...older].map((row) => [row.event.id, row]));
    this.list.replaceChildren(...[...this.rows.values()].map(({ root }) => root));
    this.#trim();
  }

  /** One more in its place by time, mostly on top; or the same one anew, where it was. What it replaces goes. */
  add(event, nowMs) {
    for (const id of event.replaces ?? []) this.#remove(id);
    const before = this.rows.get(event.id);
    const row = this.#row(event, nowMs);
    if (before) {
      before.root.replaceWith(row.root);
      this.rows.set(event.id, row);
    } else {
      row.root.classList.add("fresh");
      const rows = [...this.rows];
      const at = rows.findIndex(([, { event: other }]) => other.time_utc <= event.time_utc);
      const place = event.late && at >= 0 ? at : 0;
      rows.splice(place, 0, [event.id, row]);
      this.list.insertBefore(row.root, rows[place + 1]?.[1].root ?? null);
      this.rows = new Map(rows);
    }
    this.#trim();
  }

  #remove(id) {
    this.rows.get(id)?.root.remove();
    this.rows.delete(id);
    if (this.pinned === id) this.#pin(null);
  }

  #trim() {
    for (const [id] of [...this.rows].slice(MOST_ROWS)) this.#remove(id);
    this.empty.hidden = this.rows.size > 0;
    this.count.textContent = this.rows.size === MOST_ROWS ? `the last ${MOST_ROWS}` : this.rows.size ? String(this.rows.size) : "";
  }

  #row(event, nowMs) {
    const known = this.rows.get(event.id);
    if (known && JSON.stringify(known.event) === JSON.stringify(event)) return known;
    const [x, y, z] = event.position_m ?? [null, null, null];
    const details = el("div", { className: "details", hidden: true, id: `details-${event.id}` });
    const button = el("button", { className: "summary", type: "button", "aria-expanded": "false", "aria-controls": details.id }, ...summary(event, nowMs));
    const root = el("li", {
      className: "event", "data-event-id": event.id, "data-status": event.status, "data-testid": "event",
      "data-x": x, "data-y": y, "data-z": z,
    }, button, details);
    const row = { event, root, button, details };
    root.addEventListener("mouseenter", () => this.onMark(event));
    root.addEventListener("mouseleave", () => this.#unmark());
    button.addEventListener("focus", () => this.onMark(event));
    button.addEventListener("blur", () => this.#unmark());
    button.addEventListener("click", () => this.#pin(this.pinned === event.id ? null : event.id));
    if (this.pinned === event.id) this.#open(row, true);
    return row;
  }

  #unmark() {
    this.onMark(this.rows.get(this.pinned)?.event ?? null);
  }

  #pin(id) {
    for (const pick of [this.pinned, id]) {
      const row = this.rows.get(pick);
      if (row) this.#open(row, pick === id);
    }
    this.pinned = id;
    this.rows.get(id)?.root.scrollIntoView({ block: "nearest" });
    this.#unmark();
  }

  #open({ event, root, button, details: place }, open) {
    button.setAttribute("aria-expanded", String(open));
    root.classList.toggle("pinned", open);
    if (open && !place.hasChildNodes()) place.append(...details(event));
    place.hidden = !open;
  }

  /** Up and down go from row to row, Home and End to the ends, Escape lets go of the pinned one. */
  #walk(event) {
    const row = event.target.closest("li.event");
    if (!row) return;
    const target = {
      ArrowDown: row.nextElementSibling,
      ArrowUp: row.previousElementSibling,
      Home: this.list.firstElementChild,
      End: this.list.lastElementChild,
    }[event.key];
    if (target) {
      event.preventDefault();
      target.querySelector("button").focus();
    } else if (event.key === "Escape" && this.pinned !== null) {
      this.#pin(null);
    }
  }
}

/** What an event's status means to a reader, and why; null for a plain position. */
export function verdict({ status, reason }) {
  if (status === "located" && !reason) return null;
  return [status === "located" ? null : status.replace("-", " "), reason].filter(Boolean).join(": ");
}

function summary(event, nowMs) {
  const sigma = largestSigma(event.covariance_m2);
  const [x, y, z] = event.position_m ?? [null, null, null];
  const coordinate = (name, value) => [el("i", { text: name }), ` ${number(value)} `];
  const located = event.status === "located" && event.position_m;
  const bearing = event.contributions?.[0];
  const where = located
    ? el("span", { className: "where" }, ...coordinate("x", x), ...coordinate("y", y), ...coordinate("z", z), el("i", { text: "m" }))
    : el("span", { className: "where without", text: event.status === "direction-only" && bearing
      ? `azimuth ${number(bearing.azimuth_deg, 0)}° seen from ${bearing.array}` : "no position" });
  const fill = el("span");
  fill.style.width = `${Math.round(100 * Math.min(1, Math.max(0, event.confidence ?? 0)))}%`;
  const told = verdict(event);
  const facts = [
    event.source > 1 ? "second of two sources" : "",
    (event.arrays?.length ? event.arrays : event.heard_by ?? []).map((name) => named(name, event)).join(" + "),
    `${number(event.duration_s, 2)} s long`,
    `${number(event.level_dbfs, 0)} dBFS`,
    `latency ${number(event.latency_s, 2)} s`,
  ];
  return [
    el("span", { className: "when", text: when(event, nowMs) }),
    where,
    el("span", { className: "sigma", text: located && sigma !== null ? `± ${number(sigma)}` : "", title: "1 sigma along the widest axis, metres" }),
    el("span", { className: "trust", title: "confidence" },
      el("span", { className: "meter", "aria-hidden": "true" }, fill),
      el("span", { className: "percent", text: percent(event.confidence) })),
    el("span", { className: "facts", text: facts.filter(Boolean).map((fact) => fact.replaceAll(" ", "\u00a0")).join(" \u00a0·\u00a0 ") }),
    ...(event.zones?.length ? [el("span", { className: "zones", text: event.zones.join(", ") })] : []),
    ...(told ? [el("span", { className: "verdict", text: told })] : []),
  ];
}

/** An array's name, and whether it took part only because it was asked. */
function named(name, { contributions }) {
  return contributions?.some(({ array, asked }) => asked && array === name) ? `${name} (asked)` : name;
}

/** A fraction in per cent, or a dash. */
export function percent(fraction) {
  return Number.isFinite(fraction) ? `${Math.round(100 * fraction)} %` : "–";
}

/** How long the answer took after the sound, and where that went. */
function latency({ latency_s: total, latency_stages_s: stages }) {
  const each = stages ? Object.entries(stages).map(([stage, seconds]) => `${stage} ${number(seconds, 3)}`).join(" + ") : "";
  return `${number(total, 3)} s${each && ` = ${each}`}`;
}

function details(event) {
  const pair = (name, value, className) => (value ? el("div", { className }, el("dt", { text: name }), el("dd", { text: value })) : null);
  const sigmas = event.covariance_m2?.map((row, axis) => `${"xyz"[axis]} ${number(Math.sqrt(Math.max(0, row[axis])))}`).join("  ");
  const list = el("dl", {},
    pair("position", event.position_m && position(event.position_m), "wide"),
    pair("1 σ by axis", sigmas && `${sigmas} m`, "wide"),
    pair("heard by", event.heard_by?.join(", ")),
    pair("used", event.arrays?.map((name) => named(name, event)).join(", ")),
    pair("zones", event.zones?.join(", ")),
    pair("began", event.time_utc ?? `${number(event.start_s, 3)} s into the recording`, "wide"),
    pair("lasted", `${number(event.duration_s, 2)} s`),
    pair("latency", latency(event), "wide"),
    pair("late frames", event.late_frames ? String(event.late_frames) : null),
    pair("method", event.method),
    pair("id", event.id, "wide"));
  if (!event.contributions?.length) return [list];
  const heads = ["array", "used s", "dBFS", "azimuth", "elevation", "distance"];
  const rows = event.contributions.map((c) => el("tr", {},
    el("th", { text: named(c.array, event) + (c.agrees === false ? ` (outvoted, ${number(c.off_deg, 0)}° off)` : ""), scope: "row" }),
    ...[number(c.active_s), number(c.level_dbfs, 1), `${number(c.azimuth_deg, 1)}°`, `${number(c.elevation_deg, 1)}°`, `${number(c.distance_m)} m`].map((text) => el("td", { text }))));
  return [list, el("table", {},
    el("caption", { text: "What each array brought" }),
    el("thead", {}, el("tr", {}, ...heads.map((text) => el("th", { text, scope: "col" })))),
    el("tbody", {}, ...rows))];
}
