// The arrays panel: one card an array with its state, its levels against the gate, and how long it has been silent.

import { duration, el, number, signed, write } from "./format.js";

const FLOOR_DBFS = -96;
const AMBER_S = 1;
const LOST_S = 2;
const FRAME_S = 0.05;
/** Sound is taken for active at four times the noise floor's power (fusion's default) where the server names no gate. */
const GATE_ABOVE_FLOOR_DB = 10 * Math.log10(4);
const TROUBLES = {
  lost_frames: "lost frames",
  overflows: "overflows",
  late: "late",
  too_late: "too late",
  duplicates: "duplicates",
  rejected: "rejected",
  sequence_gaps: "sequence gaps",
};
const SVG = "http://www.w3.org/2000/svg";
/** A state is told by shape as well as by colour and word: the plans draw the same shapes. */
const SHAPES = {
  healthy: ["circle", { cx: 8, cy: 8, r: 6 }, "M5.2 8.2l2 2 3.6-4"],
  degraded: ["path", { d: "M8 1.8L15 14H1z" }, "M8 6v4M8 11.6v.8"],
  lost: ["rect", { x: 2, y: 2, width: 12, height: 12 }, "M5.2 5.2l5.6 5.6M10.8 5.2l-5.6 5.6"],
  quiet: ["path", { d: "M8 1.8L15 14H1z" }, "M5.8 11h4.4"],
  disabled: ["circle", { cx: 8, cy: 8, r: 6 }, "M4 12L12 4"],
  starting: ["circle", { cx: 8, cy: 8, r: 6, "stroke-dasharray": "2.5 2.2" }, ""],
  unknown: ["circle", { cx: 8, cy: 8, r: 6, "stroke-dasharray": "2.5 2.2" }, "M8 8.5v.8M6.3 6.4a1.7 1.7 0 1 1 1.7 1.7"],
};

/** Where a level stands on the bar, 0 to 100. */
const place = (dbfs) => (Number.isFinite(dbfs) ? Math.min(100, Math.max(0, (1 - dbfs / FLOOR_DBFS) * 100)) : 0);

function svg(tag, attributes) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  return element;
}

function icon(state) {
  const [tag, attributes, sign] = SHAPES[state] ?? SHAPES.unknown;
  const picture = svg("svg", { viewBox: "0 0 16 16", class: "state-icon", "aria-hidden": "true" });
  picture.append(svg(tag, attributes));
  if (sign) picture.append(svg("path", { d: sign }));
  return picture;
}

/** Seconds since anything was last heard from an array, at `nowMs`, or null where it never was. */
export function ageS({ array, askedMs }, nowMs) {
  return array.age_s === null || array.age_s === undefined ? null : Math.max(0, array.age_s + (nowMs - askedMs) / 1000);
}

/** The state to show: the server's word, unless time has passed since it spoke. */
export function effectiveState(held, nowMs, link) {
  if (link !== "live") return "unknown";
  const age = ageS(held, nowMs);
  const { state } = held.array;
  if (state === "disabled") return state;
  return age !== null && age > LOST_S && state !== "starting" && state !== "quiet" ? "lost" : state;
}

/** How far its clock is off, by the sounds that it and others heard; more than a frame is trouble. */
function offset({ offset_s: off, std_s: std, sounds, reference }) {
  const told = std === 0 ? "others are timed by its clock" : `${signed(1000 * off, 0)} ± ${number(1000 * std, 0)} ms to ${reference}, by ${sounds} sounds`;
  return [told, Math.abs(off) > FRAME_S ? "trouble" : ""];
}

export class ArraysPanel {
  /** `onSwitch(name, enabled)` is called when someone who `mayChange` wants an array used, or not. */
  constructor(list, empty, onSwitch) {
    this.mayChange = false;
    this.onSwitch = onSwitch;
    this.list = list;
    this.empty = empty;
    this.cards = new Map();
  }

  /** Show what was said of the arrays; `held` is a list of { array, askedMs }. */
  show(held, nowMs, link) {
    const names = new Set(held.map(({ array }) => array.name));
    for (const [name, card] of this.cards) {
      if (names.has(name)) continue;
      card.root.remove();
      this.cards.delete(name);
    }
    for (const each of held) {
      if (!this.cards.has(each.array.name)) this.#add(each.array.name);
      this.#fill(this.cards.get(each.array.name), each.array);
    }
    this.empty.hidden = held.some(({ array }) => array.age_s !== null && array.age_s !== undefined);
    this.tick(held, nowMs, link);
  }

  /** Let time pass: ages grow and states turn without a message. */
  tick(held, nowMs, link) {
    for (const each of held) {
      const card = this.cards.get(each.array.name);
      if (!card) continue;
      const state = effectiveState(each, nowMs, link);
      if (card.root.dataset.state !== state) {
        card.root.dataset.state = state;
        card.icon.replaceChildren(icon(state));
      }
      write(card.word, state === "unknown" ? `was ${each.array.state}` : state);
      const age = ageS(each, nowMs);
      card.age.dataset.tone = age === null ? "none" : age > LOST_S ? "bad" : age > AMBER_S ? "warn" : "fine";
      write(card.age, age === null ? "never heard" : age < 60 ? `heard ${number(age, 1)} s ago` : `heard ${duration(age)} ago`);
    }
  }

  #add(name) {
    const card = {
      icon: el("span", { className: "icon" }),
      word: el("span", { className: "word" }),
      age: el("span", { className: "age" }),
      reason: el("p", { className: "reason" }),
      button: el("button", { className: "switch", type: "button", "data-testid": `switch-${name}` }),
      fill: el("span", { className: "fill" }),
      floor: el("span", { className: "noise" }),
      gate: el("span", { className: "gate" }),
      level: el("b"),
      context: el("span", { className: "context" }),
      channels: el("div", { className: "channels" }),
      facts: el("ul", { className: "facts" }),
      bars: [],
    };
    card.bar = el("div", { className: "level", role: "meter", "aria-label": `level of ${name}`, "aria-valuemin": FLOOR_DBFS, "aria-valuemax": 0 },
      card.floor, card.fill, card.gate);
    card.root = el("li", { className: "array", "data-testid": `array-${name}` },
      el("div", { className: "array-head" }, card.icon, el("h3", { text: name }), card.word, card.button, card.age),
      card.reason,
      el("div", { className: "array-body" },
        el("div", { className: "gauge" }, card.bar, el("p", { className: "level-text" }, card.level, card.context)),
        card.channels),
      card.facts);
    card.button.addEventListener("click", () => this.onSwitch(name, card.root.dataset.state === "disabled"));
    this.cards.set(name, card);
    this.list.append(card.root);
  }

  #fill(card, array) {
    card.root.classList.toggle("active", Boolean(array.active));
    write(card.reason, array.reason ?? "");
    card.reason.hidden = !array.reason;
    write(card.button, array.enabled ? "Disable" : "Enable");
    card.button.setAttribute("aria-label", `${array.enabled ? "Disable" : "Enable"} ${array.name}`);
    card.button.hidden = !this.mayChange;

    const gate = array.threshold_dbfs ?? (Number.isFinite(array.noise_floor_dbfs) ? array.noise_floor_dbfs + GATE_ABOVE_FLOOR_DB : null);
    card.fill.style.width = `${place(array.level_dbfs)}%`;
    card.floor.style.width = `${place(array.noise_floor_dbfs)}%`;
    card.gate.style.left = `${place(gate)}%`;
    card.gate.hidden = gate === null;
    const known = Number.isFinite(array.level_dbfs);
    card.bar.setAttribute("aria-valuenow", known ? array.level_dbfs.toFixed(1) : FLOOR_DBFS);
    card.bar.setAttribute("aria-valuetext", known ? `${number(array.level_dbfs, 1)} dBFS` : "no level yet");
    write(card.level, known ? `${number(array.level_dbfs, 1)} dBFS` : "no level yet");
    write(card.context, gate === null ? "" : `floor ${number(array.noise_floor_dbfs, 0)}, active from ${number(gate, 0)}`);

    this.#channels(card, array);
    this.#facts(card, array);
  }

  #channels(card, array) {
    const levels = array.channel_levels_dbfs ?? [];
    while (card.bars.length < levels.length) {
      const fill = el("span", { className: "fill" });
      const bar = el("span", { className: "channel" }, fill);
      card.bars.push({ bar, fill });
      card.channels.append(bar);
    }
    while (card.bars.length > levels.length) card.bars.pop().bar.remove();
    levels.forEach((level, index) => {
      const { bar, fill } = card.bars[index];
      fill.style.height = `${place(level)}%`;
      bar.classList.toggle("silent", level === null);
      bar.title = `channel ${index + 1}: ${level === null ? "no level" : `${number(level, 1)} dBFS`}`;
    });
    card.channels.setAttribute("aria-label", `levels of ${levels.length} channels`);
    card.channels.setAttribute("role", "img");
    card.channels.hidden = levels.length === 0;
  }

  #facts(card, array) {
    const { frames = 0, marks = 0, backfilled = 0, asked = 0, helped = 0, ...others } = array.counters ?? {};
    const facts = [];
    if (Number.isFinite(array.drift_ppm)) facts.push([`drift ${signed(array.drift_ppm, 1)} ppm`, ""]);
    if (array.clock) facts.push([`clock ${array.clock}`, array.clock === "stepped" ? "trouble" : ""]);
    if (array.clock_offset) facts.push(offset(array.clock_offset));
    if (Number.isFinite(array.sample_rate_hz)) facts.push([`${number(array.sample_rate_hz / 1000, 2)} kHz`, ""]);
    if (array.node) facts.push([`node ${array.node}`, ""]);
    const { agreed = 0, disagreed = 0 } = array.agreement ?? {};
    if (agreed + disagreed > 0) facts.push([`agrees in ${agreed} of ${agreed + disagreed} sounds`, disagreed > agreed ? "trouble" : ""]);
    facts.push([`${frames.toLocaleString("en").replaceAll(",", "\u202f")} frames`, ""]);
    facts.push([`${marks.toLocaleString("en").replaceAll(",", "\u202f")} marks`, ""]);
    if (backfilled > 0) facts.push([`${backfilled} kept and sent later`, ""]);
    if (asked > 0) facts.push([`asked for ${asked} sounds it had not found, helped with ${helped}`, ""]);
    for (const [key, count] of Object.entries(others)) {
      if (count > 0) facts.unshift([`${TROUBLES[key] ?? key.replaceAll("_", " ")} ${count}`, "trouble"]);
    }
    while (card.facts.children.length < facts.length) card.facts.append(el("li"));
    while (card.facts.children.length > facts.length) card.facts.lastElementChild.remove();
    facts.forEach(([text, tone], index) => {
      const item = card.facts.children[index];
      write(item, text);
      item.className = tone;
    });
  }
}
