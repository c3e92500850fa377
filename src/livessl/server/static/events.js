// The list of events, newest first: how many rows it keeps, and their selection by mouse and keyboard.

import { el } from "./dom.js";
import { details, summary } from "./event-text.js";

/** Most rows in the list, so that a page that stays open for days remains fast. */
const MOST_ROWS = 200;

export class EventList {
  /**
   * `onMark(event | null)` is called when an event is pointed at, focused or selected, and with null when none is;
   * `onOpen(event, details)` when its details are opened first.
   */
  constructor(list, { empty, count, onMark, onOpen }) {
    this.list = list;
    this.empty = empty;
    this.count = count;
    this.onMark = onMark;
    this.onOpen = onOpen;
    this.rows = new Map();
    this.selected = null;
    list.addEventListener("keydown", (event) => this.#walk(event));
  }

  /** Insert stored events, newest first, below those in `arrivedIds`, which arrived after the request for them. */
  load(events, arrivedIds, nowMs) {
    const stored = new Set(events.map(({ id }) => id));
    const others = [...this.rows.values()].filter((row) => !stored.has(row.event.id));
    const newer = others.filter((row) => arrivedIds.has(row.event.id));
    const older = others.filter((row) => !arrivedIds.has(row.event.id));
    const middle = events.map((event) => this.#row(event, nowMs));
    this.rows = new Map([...newer, ...middle, ...older].map((row) => [row.event.id, row]));
    this.list.replaceChildren(...[...this.rows.values()].map(({ root }) => root));
    this.#trim();
  }

  /**
   * Insert an event: at the top or, if it is late, by its time.
   *
   * It takes the place of its earlier version, if there is one; the events that it replaces are removed.
   */
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
      const earlier = rows.findIndex(([, { event: other }]) => other.time_utc <= event.time_utc);
      this.#insert(row, event.late && earlier >= 0 ? earlier : 0);
    }
    this.#trim();
  }

  /** Select an event; one that is older than the list is inserted by its time. */
  reveal(event, nowMs) {
    if (!this.rows.has(event.id)) {
      const earlier = [...this.rows.values()].findIndex(({ event: other }) => other.time_utc <= event.time_utc);
      this.#insert(this.#row(event, nowMs), earlier < 0 ? this.rows.size : earlier);
      this.empty.hidden = true;
    }
    this.#select(event.id);
  }

  #insert(row, place) {
    const rows = [...this.rows];
    rows.splice(place, 0, [row.event.id, row]);
    this.list.insertBefore(row.root, rows[place + 1]?.[1].root ?? null);
    this.rows = new Map(rows);
  }

  #remove(id) {
    this.rows.get(id)?.root.remove();
    this.rows.delete(id);
    if (this.selected === id) this.#select(null);
  }

  #trim() {
    for (const [id] of [...this.rows].slice(MOST_ROWS)) this.#remove(id);
    this.empty.hidden = this.rows.size > 0;
    const full = this.rows.size === MOST_ROWS;
    this.count.textContent = full ? `last ${MOST_ROWS}` : String(this.rows.size || "");
  }

  #row(event, nowMs) {
    const known = this.rows.get(event.id);
    if (known && JSON.stringify(known.event) === JSON.stringify(event)) return known;
    const [x, y, z] = event.position_m ?? [null, null, null];
    const opened = el("div", { className: "details", hidden: true, id: `details-${event.id}` });
    const button = el("button", {
      className: "summary", type: "button", "aria-expanded": "false", "aria-controls": opened.id,
    }, ...summary(event, nowMs));
    const root = el("li", {
      className: "event", "data-event-id": event.id, "data-status": event.status, "data-testid": "event",
      "data-x": x, "data-y": y, "data-z": z,
    }, button, opened);
    const row = { event, root, button, opened };
    root.addEventListener("mouseenter", () => this.onMark(event));
    root.addEventListener("mouseleave", () => this.#markSelected());
    button.addEventListener("focus", () => this.onMark(event));
    button.addEventListener("blur", () => this.#markSelected());
    button.addEventListener("click", () => this.#select(this.selected === event.id ? null : event.id));
    if (this.selected === event.id) this.#open(row, true);
    return row;
  }

  #markSelected() {
    this.onMark(this.rows.get(this.selected)?.event ?? null);
  }

  #select(id) {
    for (const each of [this.selected, id]) {
      const row = this.rows.get(each);
      if (row) this.#open(row, each === id);
    }
    this.selected = id;
    this.rows.get(id)?.root.scrollIntoView({ block: "nearest" });
    this.#markSelected();
  }

  #open({ event, root, button, opened }, open) {
    button.setAttribute("aria-expanded", String(open));
    root.classList.toggle("selected", open);
    if (open && !opened.hasChildNodes()) {
      opened.append(...details(event));
      this.onOpen(event, opened);
    }
    opened.hidden = !open;
  }

  /** Arrow keys move from row to row, Home and End to the first and last; Escape closes the selected one. */
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
    } else if (event.key === "Escape" && this.selected !== null) this.#select(null);
  }
}
