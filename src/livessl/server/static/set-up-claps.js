// The guided verification: a place on the plan, a clap there, where it was found, and what explains the error.

import { el, find, write } from "./dom.js";
import { number } from "./format.js";
import { findingItem } from "./set-up-findings.js";

/** How often, in milliseconds, the server is asked for the clap. */
const POLL_MS = 300;
/** Wait, in milliseconds, after which the page says that no sound came. */
const LONG_MS = 15000;
/** Claps from which on the cause of an error is told. */
const ENOUGH = 4;
/** Sharpness below which no array received a sound clearly. */
const LEAST_SHARPNESS = 3.5;
const AXES = ["x", "y", "z"];

export class ClapTest {
  constructor({ load, send, plan, isOpen }) {
    this.load = load;
    this.send = send;
    this.plan = plan;
    /** Objects { number, place, found }: the claps so far. */
    this.claps = [];
    /** Counts the waits, so that an answer to one that was cancelled is ignored. */
    this.waits = 0;
    this.waiting = false;
    plan.canvas.addEventListener("click", ({ offsetX, offsetY }) => {
      const metres = isOpen() ? plan.metresAt(offsetX, offsetY) : null;
      if (metres !== null) this.#choose(metres);
    });
    find("clap-form").addEventListener("submit", (event) => {
      event.preventDefault();
      if (this.waiting) this.cancel();
      else this.#wait();
    });
    find("clap-form").addEventListener("input", () => this.place());
    find("clap-again").addEventListener("click", () => this.#restart());
    this.marks = el("div", { className: "clap-marks", "aria-hidden": "true" });
    plan.canvas.after(this.marks);
  }

  set mayChange(may) {
    find("clap-button").disabled = !may;
    find("clap-role").hidden = may;
  }

  /** Stop waiting for a clap. */
  cancel() {
    if (!this.waiting) return;
    this.#end("");
  }

  /** Draw the marks where the plan shows their places. */
  place() {
    const items = this.claps.flatMap(({ place, found }, index) => [
      { at: place, text: String(index + 1), kind: "place" }, ...(found ? [{ at: found, text: "", kind: "found" }] : []),
    ]);
    const chosen = this.#chosen();
    if (chosen !== null) items.push({ at: chosen, text: String(this.claps.length + 1), kind: "chosen" });
    while (this.marks.children.length > items.length) this.marks.lastElementChild.remove();
    while (this.marks.children.length < items.length) this.marks.append(el("span"));
    items.forEach(({ at, text, kind }, index) => {
      const mark = this.marks.children[index];
      mark.className = `clap-mark clap-${kind}`;
      write(mark, text);
      mark.hidden = this.plan.size === null;
      if (mark.hidden) return;
      const [left, top] = this.plan.at(at);
      mark.style.left = `${left}px`;
      mark.style.top = `${top}px`;
    });
  }

  #choose([x, y]) {
    find("clap-x").value = x.toFixed(2);
    find("clap-y").value = y.toFixed(2);
    this.place();
  }

  /** The place that is typed or clicked, or null. */
  #chosen() {
    const place = AXES.map((axis) => find(`clap-${axis}`).valueAsNumber);
    return place.every(Number.isFinite) ? place : null;
  }

  async #wait() {
    const place = this.#chosen();
    if (place === null) return;
    const wait = ++this.waits;
    this.waiting = true;
    write(find("clap-button"), "Cancel");
    this.#say(`Clap once at ${words(place)}`);
    const began = performance.now();
    try {
      let { last, now_utc: asked } = await this.load(`sounds?after=${Number.MAX_SAFE_INTEGER}`);
      while (wait === this.waits) {
        await new Promise((done) => setTimeout(done, POLL_MS));
        if (wait !== this.waits) return;
        const answer = await this.load(`sounds?after=${last}`);
        if (wait !== this.waits) return;
        last = answer.last;
        const clap = answer.sounds.find(({ time_utc: begin, observations }) => (
          begin >= asked && observations.some(({ sharpness }) => sharpness >= LEAST_SHARPNESS)
        ));
        if (clap) {
          this.#take(clap, place);
          await this.#judge(wait);
          return;
        }
        if (performance.now() - began > LONG_MS) this.#say("No sound yet. Clap louder, and look at the levels.");
      }
    } catch (error) {
      if (wait === this.waits) this.#end(error.told ?? `The server did not answer (${error.message}). Try again.`);
    }
  }

  #take({ number: sound, position_m: found }, place) {
    this.claps.push({ sound, place, found });
    for (const axis of ["x", "y"]) find(`clap-${axis}`).value = "";
    this.#say("Comparing…");
    this.place();
  }

  async #judge(wait) {
    const request = { claps: this.claps.map(({ sound, place }) => ({ number: sound, place_m: place })) };
    const answer = await this.send("set-up/verify", request);
    if (wait !== this.waits) return;
    find("claps").replaceChildren(...answer.claps.map(clapItem));
    find("clap-findings").replaceChildren(...answer.findings.map(findingItem));
    find("clap-again").hidden = false;
    const verdict = find("clap-verdict");
    verdict.hidden = false;
    verdict.dataset.verdict = answer.verdict;
    write(verdict, verdictText(answer));
    this.#end("");
  }

  #end(text) {
    this.waits += 1;
    this.waiting = false;
    write(find("clap-button"), "Clap here");
    this.#say(text);
    this.place();
  }

  #restart() {
    this.cancel();
    this.claps = [];
    find("claps").replaceChildren();
    find("clap-findings").replaceChildren();
    find("clap-verdict").hidden = true;
    find("clap-again").hidden = true;
    this.place();
  }

  #say(text) {
    write(find("clap-say"), text);
  }
}

function words(place) {
  return place.map((value, index) => `${AXES[index]} ${number(value)}`).join("  ");
}

function clapItem({ place_m: place, position_m: found, error_m: error, reason }, index) {
  const off = error === null ? "not located" : `found ${number(error)} m away`;
  return el("li", { className: "clap", title: reason, "data-testid": `clap-${index + 1}`, "data-error": error ?? "" },
    el("b", { text: `${index + 1}` }), ` ${words(place)}: ${off}`,
    found ? el("span", { className: "clap-at", text: ` at ${words(found)}` }) : null);
}

function verdictText({ verdict, claps }) {
  const more = ENOUGH - claps.length;
  const further = more > 0 ? ` Clap at ${more} more place${more === 1 ? "" : "s"}, on all sides.` : "";
  if (verdict === "ok") return `Right: livessl found every clap near its place.${further}`;
  if (verdict === "wrong") return `Something is wrong.${further}`;
  const cause = more > 0 ? "" : " Check that places and arrays are measured from the same corner.";
  return `livessl did not find the claps where they were made, and nothing explains it yet.${cause}${further}`;
}
