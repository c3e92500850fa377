// The arrays panel: a card per array with its state and reason, its level beside the activity threshold, and a switch.

import { stateIcon } from "./array-icons.js";
import { el, write } from "./dom.js";
import { counted, duration, number, signed } from "./format.js";
import { shownState } from "./model.js";

/** Level at the left end of the level bar, in dBFS. */
const LEAST_DBFS = -96;
const BAR_LEGEND = "Hatched: noise floor. Line: activity threshold, from which on a frame counts as sound.";
/** Clock offset, in seconds, beyond which it is shown as a problem: one frame, as the server judges it. */
const FRAME_S = 0.05;
/** The API's counters of problems, in words; their count precedes them. */
const PROBLEMS = {
  lost_frames: "lost frame",
  overflows: "overflow",
  late: "late frame",
  too_late: "late backfilled frame",
  duplicates: "duplicate",
  rejected: "rejected message",
  sequence_gaps: "sequence gap",
};

/** Codes of findings about channels, in words; others are shown as they are. */
const FAULTS = { clipping: "clips", dc: "constant", hum: "hums", noisy: "noisy", level: "level differs" };

/** A level's place on the level bar, 0 to 100. */
const place = (dbfs) => (Number.isFinite(dbfs) ? Math.min(100, Math.max(0, (1 - dbfs / LEAST_DBFS) * 100)) : 0);

export class ArraysPanel {
  /** `onSwitch(name, enabled)` is called when a user with `mayChange` enables or disables an array. */
  constructor(list, empty, onSwitch) {
    this.mayChange = false;
    this.onSwitch = onSwitch;
    this.list = list;
    this.empty = empty;
    this.cards = new Map();
  }

  /** Show arrays as described by the server: objects { array, sentMs }, see `Model.arrays`. */
  show(arrays, nowMs, link) {
    const names = new Set(arrays.map(({ array }) => array.name));
    for (const [name, card] of this.cards) {
      if (names.has(name)) continue;
      card.root.remove();
      this.cards.delete(name);
    }
    for (const { array } of arrays) {
      if (!this.cards.has(array.name)) this.#add(array.name);
      this.#fill(this.cards.get(array.name), array);
    }
    this.empty.hidden = arrays.some(({ array }) => array.age_s !== null);
    this.tick(arrays, nowMs, link);
  }

  /** Show what changes without a message: the age of the last data, and the state when the connection is lost. */
  tick(arrays, nowMs, link) {
    for (const { array, sentMs } of arrays) {
      const card = this.cards.get(array.name);
      if (!card) continue;
      const state = shownState(array, link);
      if (card.root.dataset.state !== state) {
        card.root.dataset.state = state;
        card.icon.replaceChildren(stateIcon(state));
      }
      write(card.word, state === "unknown" ? `was ${array.state}` : state);
      const age = array.age_s === null ? null : Math.max(0, array.age_s + (nowMs - sentMs) / 1000);
      write(card.age, age === null ? "no data yet" : `${age < 60 ? `${number(age, 1)} s` : duration(age)} ago`);
    }
  }

  #add(name) {
    const card = {
      icon: el("span", { className: "icon" }),
      word: el("span", { className: "word" }),
      age: el("span", { className: "age", title: "Age of the last data" }),
      reason: el("p", { className: "reason" }),
      button: el("button", { className: "switch", type: "button", "data-testid": `switch-${name}` }),
      fill: el("span", { className: "fill" }),
      noise: el("span", { className: "noise" }),
      threshold: el("span", { className: "threshold", "data-testid": `threshold-${name}` }),
      level: el("b"),
      context: el("span", { className: "context" }),
      channels: el("div", { className: "channels", role: "img" }),
      facts: el("ul", { className: "facts" }),
      bars: [],
    };
    card.bar = el("div", {
      className: "level", role: "meter", "aria-label": `level of ${name}`, "aria-valuemin": LEAST_DBFS, "aria-valuemax": 0,
    }, card.noise, card.fill, card.threshold);
    card.root = el("li", { className: "array", "data-testid": `array-${name}` },
      el("div", { className: "array-head" }, card.icon, el("h3", { text: name }), card.word, card.age, card.button),
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
    card.root.classList.toggle("active", array.active);
    write(card.reason, array.reason ?? "");
    card.reason.hidden = !array.reason;
    const action = array.enabled ? "Disable" : "Enable";
    write(card.button, action);
    card.button.setAttribute("aria-label", `${action} ${array.name}`);
    card.button.hidden = !this.mayChange;
    this.#fillLevel(card, array);
    this.#fillChannels(card, array);
    fillFacts(card.facts, [...problems(array), ...facts(array)]);
  }

  #fillLevel(card, { level_dbfs: level, noise_floor_dbfs: noise, activity_threshold_dbfs: threshold }) {
    card.fill.style.width = `${place(level)}%`;
    card.noise.style.width = `${place(noise)}%`;
    card.threshold.style.left = `${place(threshold)}%`;
    card.threshold.hidden = threshold === null;
    card.threshold.dataset.dbfs = threshold ?? "";
    const text = level === null ? "no level" : `${number(level, 1)} dBFS`;
    card.bar.setAttribute("aria-valuenow", level === null ? LEAST_DBFS : level.toFixed(1));
    card.bar.setAttribute("aria-valuetext", text);
    card.bar.title = threshold === null ? "" : BAR_LEGEND;
    write(card.level, text);
    write(card.context, threshold === null ? "" : `noise ${number(noise, 0)}, threshold ${number(threshold, 0)}`);
  }

  #fillChannels(card, { name, channel_levels_dbfs: levels, channels: reports = [] }) {
    while (card.bars.length < levels.length) {
      const fill = el("span", { className: "fill" });
      const peak = el("span", { className: "peak" });
      const bar = el("span", { className: "channel", "data-testid": `channel-${name}-${card.bars.length + 1}` }, fill, peak);
      card.bars.push({ bar, fill, peak });
      card.channels.append(bar);
    }
    while (card.bars.length > levels.length) card.bars.pop().bar.remove();
    levels.forEach((level, index) => {
      const { bar, fill, peak } = card.bars[index];
      const report = reports[index];
      fill.style.height = `${place(level)}%`;
      peak.hidden = typeof report?.peak_dbfs !== "number";
      peak.style.bottom = `${place(report?.peak_dbfs)}%`;
      bar.classList.toggle("silent", level === null);
      bar.classList.toggle("faulty", Boolean(report?.faults.length));
      bar.title = channelText(index, level, report);
    });
    const faulty = reports.flatMap(({ faults }, index) => faults.map((fault) => `channel ${index + 1}: ${fault}`));
    card.channels.setAttribute("aria-label", [`levels of ${levels.length} channels`, ...faulty].join("; "));
    card.channels.hidden = levels.length === 0;
  }
}

/** A channel in words, a line for each: its level in the array's band, then what its node reports of the whole band. */
function channelText(index, level, report) {
  const lines = [`channel ${index + 1}: ${level === null ? "digital silence" : `${number(level, 1)} dBFS in the band`}`];
  if (!report) return lines[0];
  const add = (text, value, digits = 1) => value !== null && lines.push(`${text} ${number(value, digits)} dBFS`);
  add("peak", report.peak_dbfs);
  add("RMS", report.rms_dbfs);
  add("noise floor", report.noise_dbfs);
  if (report.hum_hz !== null) add(`hum at ${number(report.hum_hz, 0)} Hz`, report.hum_dbfs);
  if (report.mean !== null) lines.push(`DC ${signed(100 * report.mean, 2)} %`);
  lines.push(`${report.clipped} clipped samples`);
  if (report.faults.length) lines.push(`faults: ${report.faults.join(", ")}`);
  return lines.join("\n");
}

/** An array's problems, as facts: see `fillFacts`. */
function problems({ counters: { frames, marks, backfilled, asked, helped, ...others }, channels = [], host }) {
  const found = Object.entries(others).filter(([, count]) => count > 0)
    .map(([key, count]) => ({ text: counted(count, PROBLEMS[key] ?? key.replaceAll("_", " ")), problem: true }));
  channels.forEach(({ faults }, index) => faults.forEach((fault) => {
    found.push({ text: `channel ${index + 1}: ${FAULTS[fault] ?? fault}`, title: "The findings have the cure", problem: true });
  }));
  if (host?.lost_blocks) {
    const title = "Blocks of sound that its node's machine was too busy to read";
    found.push({ text: counted(host.lost_blocks, "block") + " not read in time", title, problem: true });
  }
  return found;
}

/** An array's properties and statistics, as facts: see `fillFacts`. */
function facts(array) {
  const { drift_ppm: drift, clock, clock_offset: offset, sample_rate_hz: rate, node, agreement, counters, host } = array;
  const { frames, marks, backfilled, asked, helped } = counters;
  const { agreed, disagreed } = agreement;
  const found = [];
  const add = (text, title, problem = false) => found.push({ text, title, problem });
  if (drift !== null) add(driftText(drift, array.drift), "Speed of the device's clock relative to the server's time");
  if (clock !== null) add(`clock ${clock}`, "State of the device's clock against the server's time", clock === "stepped");
  if (offset !== null) add(offsetText(offset), "Clock offset measured from events", Math.abs(offset.offset_s) > FRAME_S);
  if (rate !== null) add(`${number(rate / 1000, 2)} kHz`, "Sample rate of the device");
  if (host?.synchronized != null) add(hostText(host), "Whether the clock of the node's machine follows another one");
  if (node !== null) add(`node ${node}`, "The capture node that sends this array's sound");
  if (agreed + disagreed > 0) {
    const text = `consistent in ${agreed} of ${agreed + disagreed} events`;
    add(text, "Agreement with the other arrays in the last events of three or more arrays", disagreed > agreed);
  }
  add(counted(frames, "frame"), "Messages that carry 50 ms of sound");
  add(counted(marks, "mark"), "Messages that report a quiet interval without its sound");
  if (backfilled > 0) add(counted(backfilled, "frame") + " backfilled", "Frames that the node had kept and sent later");
  if (asked > 0) {
    const text = `${counted(asked, "backfill request")}, ${helped} used`;
    add(text, "Requests for frames of events that this array did not detect itself");
  }
  return found;
}

function driftText(drift, state) {
  if (state === "unmeasurable") return "drift not measurable through a sound server";
  return state === "settling" ? "drift settling" : `drift ${signed(drift, 1)} ppm`;
}

function hostText({ synchronized, service, reference, error_s: error }) {
  if (!synchronized) return "machine's clock not synchronized";
  const from = [service === "kernel" ? "" : service, reference].filter(Boolean).join(" ");
  const within = error === null ? "" : `, ± ${number(1000 * error, error < 0.01 ? 1 : 0)} ms`;
  return `machine's clock synchronized${from ? ` by ${from}` : ""}${within}`;
}

function offsetText({ offset_s: offset, std_s: std, sounds, reference }) {
  if (std === 0) return "reference clock";
  const ms = `${signed(1000 * offset, 0)} ± ${number(1000 * std, 0)} ms`;
  return `${ms} relative to ${reference} (${counted(sounds, "event")})`;
}

/** Show facts, objects { text, title, problem }, in a list. */
function fillFacts(list, facts) {
  while (list.children.length < facts.length) list.append(el("li"));
  while (list.children.length > facts.length) list.lastElementChild.remove();
  facts.forEach(({ text, title, problem }, index) => {
    const item = list.children[index];
    write(item, text);
    item.title = title ?? "";
    item.className = problem ? "problem" : "";
  });
}
