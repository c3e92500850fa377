// The set-up view: levels of the inputs, findings with cures, claps, proposed poses, and arrays that are moved by hand.

import { el, find, write } from "./dom.js";
import { counted, number } from "./format.js";
import { shownState } from "./model.js";
import { ClapTest } from "./set-up-claps.js";
import { blindSpotItem, findingItem } from "./set-up-findings.js";
import { ArrayMover } from "./set-up-move.js";
import { PoseOverlay } from "./set-up-overlay.js";
import { PosesPanel } from "./set-up-poses.js";

/** The part of the page's address that opens the view. */
export const SET_UP = "#set-up";
/** How often, in milliseconds, findings and the set-up in force are loaded while the view is open. */
const FINDINGS_MS = 3000;
/** Level at the left end of the level bars, in dBFS. */
const LEAST_DBFS = -96;

export class SetUp {
  /**
   * `load(path)` reads JSON of the API, `send(path, value)` posts it, `plan` is the floor plan, and `redraw()` has it
   * drawn again.
   */
  constructor({ load, send, plan, redraw }) {
    this.load = load;
    this.redraw = redraw;
    this.overlay = new PoseOverlay(plan);
    this.poses = new PosesPanel({ load, send, redraw });
    this.mover = new ArrayMover({
      plan, redraw: () => this.place(), propose: async (request) => this.poses.show(await send("set-up/move", request)),
    });
    this.claps = new ClapTest({
      load, send, plan, redraw,
      isOpen: () => this.open && this.mover.draft === null,
      onProposal: (proposal) => this.poses.show(proposal),
    });
    this.rows = new Map();
    this.timer = null;
    addEventListener("hashchange", () => this.#show());
    this.#show();
  }

  get open() {
    return location.hash === SET_UP;
  }

  /** Whether the user may run the verification: it takes the server's time. */
  set mayChange(may) {
    this.claps.mayChange = may;
    this.poses.mayChange = may;
    this.mover.mayChange = may;
  }

  /** Other poses have come into force, by this page or by anybody else: claps and drafts were for those before. */
  posesChanged() {
    this.claps.restart();
    this.mover.cancel();
    if (this.open) this.#loadSetUp();
  }

  /** Show arrays as described by the server: objects { array }, see `Model.arrays`. */
  showArrays(arrays, link) {
    if (!this.open) return;
    const names = new Set(arrays.map(({ array }) => array.name));
    for (const [name, row] of this.rows) {
      if (names.has(name)) continue;
      row.root.remove();
      this.rows.delete(name);
    }
    for (const { array } of arrays) this.#fill(array, shownState(array, link));
  }

  /** Move the marks of the claps to where the plan shows their places now. */
  place() {
    if (!this.open) return;
    this.claps.place();
    this.overlay.draw(this.poses.proposal, this.mover.draft, this.mover.arrays, this.claps.next);
  }

  #show() {
    document.body.dataset.view = this.open ? "set-up" : "live";
    find("set-up").hidden = !this.open;
    find("view-live").ariaCurrent = this.open ? null : "page";
    find("view-set-up").ariaCurrent = this.open ? "page" : null;
    clearInterval(this.timer);
    if (this.open) {
      this.#load();
      this.timer = setInterval(() => this.#load(), FINDINGS_MS);
    } else {
      this.claps.cancel();
      this.mover.cancel();
    }
    this.redraw();
  }

  #load() {
    if (document.hidden) return;
    this.#loadFindings();
    this.#loadSetUp();
  }

  async #loadSetUp() {
    try {
      await this.poses.refresh();
      this.mover.show(this.poses.setUp.arrays);
      if (this.claps.claps.length === 0) this.claps.suggest(this.poses.setUp.next_place_m);
    } catch (error) {
      console.warn("livessl:", error.message);
    }
  }

  async #loadFindings() {
    try {
      const { sounds, least_sounds: least, findings, blind_spots: blindSpots } = await this.load("findings");
      write(find("set-up-sounds"), sounds === 0 ? "no sound yet" : `from the last ${counted(sounds, "sound")}`);
      find("set-up-findings").replaceChildren(...findings.map(findingItem));
      const none = find("set-up-no-finding");
      none.hidden = findings.length > 0;
      write(none, sounds < least ? `Clap ${least} times or more, at different places in the room` : "Nothing wrong was found");
      find("set-up-blind-spots").replaceChildren(...blindSpots.map(blindSpotItem));
    } catch (error) {
      console.warn("livessl:", error.message);
    }
  }

  #fill(array, state) {
    if (!this.rows.has(array.name)) {
      const row = {
        state: el("span", { className: "set-up-state" }),
        reason: el("p", { className: "set-up-reason" }),
        inputs: el("ol", { className: "set-up-inputs" }),
      };
      row.root = el("li", { className: "set-up-array", "data-testid": `set-up-${array.name}` },
        el("p", {}, el("b", { text: array.name }), " ", row.state), row.reason, row.inputs);
      this.rows.set(array.name, row);
      find("set-up-arrays").append(row.root);
    }
    const row = this.rows.get(array.name);
    row.root.dataset.state = state;
    write(row.state, state);
    write(row.reason, array.reason ?? "");
    row.reason.hidden = !array.reason;
    const levels = inputsOf(array);
    while (row.inputs.children.length > levels.length) row.inputs.lastElementChild.remove();
    while (row.inputs.children.length < levels.length) row.inputs.append(inputItem());
    levels.forEach((level, index) => fillInput(row.inputs.children[index], index, level));
  }
}

/** The level of each channel, and what is said about it: of the whole band where its node reports that. */
function inputsOf({ channels, channel_levels_dbfs: inBand }) {
  if (!channels?.length) return inBand.map((dbfs) => ({ dbfs, notes: [] }));
  return channels.map(({ rms_dbfs: dbfs, peak_dbfs: peak, noise_dbfs: noise, clipped, hum_hz: hum, faults }) => ({
    dbfs,
    title: `peak ${number(peak, 0)} dBFS, noise ${number(noise, 0)} dBFS`,
    notes: [clipped > 0 ? `${clipped} clipped` : null, hum ? `hum ${hum} Hz` : null, ...(faults ?? [])].filter(Boolean),
  }));
}

function inputItem() {
  return el("li", { className: "set-up-input" },
    el("span", { className: "set-up-channel" }),
    el("span", { className: "set-up-bar", "aria-hidden": "true" }, el("span", { className: "set-up-fill" })),
    el("span", { className: "set-up-dbfs" }),
    el("span", { className: "set-up-notes" }));
}

function fillInput(item, index, { dbfs, title, notes }) {
  const [channel, bar, text, said] = item.children;
  write(channel, `channel ${index + 1}`);
  const share = dbfs === null ? 0 : Math.min(1, Math.max(0, 1 - dbfs / LEAST_DBFS));
  bar.firstElementChild.style.width = `${(100 * share).toFixed(1)}%`;
  write(text, dbfs === null ? "silent" : `${number(dbfs, 0)} dBFS`);
  write(said, notes.join(", "));
  item.title = title ?? "";
  item.classList.toggle("silent", dbfs === null);
}
