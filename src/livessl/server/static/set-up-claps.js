// Claps at measured places: where livessl found them, what explains the errors, and the poses that they say.

import { el, find, write } from "./dom.js";
import { number } from "./format.js";
import { findingItem } from "./set-up-findings.js";

/** How often, in milliseconds, the server is asked for the clap. */
const POLL_MS = 300;
/** Wait, in milliseconds, after which the page says that no sound came. */
const LONG_MS = 15000;
/** Claps from which on the cause of an error is told, and poses are measured. */
const ENOUGH = 4;
/** Claps that are usual for measuring poses. */
const USUAL = 8;
/** Sharpness below which no array received a sound clearly. */
const LEAST_SHARPNESS = 3.5;
const AXES = ["x", "y", "z"];

export class ClapTest {
  /** `onProposal(proposal)` is called with the poses that the claps say, and null where they say none any more. */
  constructor({ load, send, plan, isOpen, onProposal, redraw }) {
    this.load = load;
    this.send = send;
    this.plan = plan;
    this.onProposal = onProposal;
    this.redraw = redraw;
    /** The place that is proposed for the next clap, or null. */
    this.next = null;
    /** Whether the page proposes each place and measures the poses. */
    this.guided = false;
    this.may = false;
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
    find("clap-again").addEventListener("click", () => this.restart());
    find("clap-use").addEventListener("click", () => this.#use());
    find("clap-measure").addEventListener("click", () => this.#guide());
    this.marks = el("div", { className: "clap-marks", "aria-hidden": "true" });
    plan.canvas.after(this.marks);
  }

  set mayChange(may) {
    this.may = may;
    find("clap-button").disabled = !may;
    find("clap-role").hidden = may;
    this.#showGuide();
  }

  /** Propose a place for the next clap, or none. */
  suggest(place) {
    this.next = place;
    const line = find("clap-suggest");
    line.hidden = place === null;
    if (place !== null) write(find("clap-suggest-where"), `Next place that helps most: ${words(place)}`);
    if (this.guided && this.#isEmpty()) this.#use();
    this.redraw();
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

  #isEmpty() {
    return ["x", "y"].every((axis) => find(`clap-${axis}`).value === "");
  }

  /** Fill in the proposed place. */
  #use() {
    if (this.next === null) return;
    AXES.forEach((axis, index) => { find(`clap-${axis}`).value = Number(this.next[index].toFixed(2)); });
    this.place();
  }

  /** Begin to measure the poses: with the claps so far, and with each one from now on. */
  async #guide() {
    this.guided = true;
    this.#showGuide();
    if (this.#isEmpty()) this.#use();
    if (this.claps.length < ENOUGH) this.#say("Go to the place that is filled in, or type another one; then press Clap here.");
    else await this.#measure(this.waits);
  }

  /** Have the server measure the poses by the claps so far; nothing is applied. */
  async #measure(wait) {
    const stdM = find("clap-std").valueAsNumber / 100;
    this.#say("Measuring…");
    try {
      const proposal = await this.send("set-up/measure", {
        ...this.#request(), ...(stdM > 0 ? { place_std_m: stdM } : {}),
      });
      if (wait !== this.waits) return;
      this.onProposal(proposal);
      this.suggest(proposal.next_place_m);
      this.#say("");
    } catch (error) {
      if (wait === this.waits) this.#say(error.told ?? `The server did not answer (${error.message}). Try again.`);
    }
  }

  #request() {
    return { claps: this.claps.map(({ sound, place }) => ({ number: sound, place_m: place })) };
  }

  #showGuide() {
    const more = ENOUGH - this.claps.length;
    const button = find("clap-measure");
    button.hidden = this.guided && more > 0;
    button.disabled = !this.may;
    write(button, this.claps.length < ENOUGH ? "Guide me to measure the poses" : "Measure the poses with these claps");
    const told = more > 0 ? `${more} more for a first result` : `${Math.max(0, USUAL - this.claps.length)} more are usual`;
    write(find("clap-progress"), this.guided && this.claps.length < USUAL ? `${this.claps.length} of ${USUAL} claps: ${told}.` : "");
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
    this.#showGuide();
    this.place();
  }

  async #judge(wait) {
    const answer = await this.send("set-up/verify", this.#request());
    if (wait !== this.waits) return;
    find("claps").replaceChildren(...answer.claps.map(clapItem));
    find("clap-findings").replaceChildren(...answer.findings.map(findingItem));
    find("clap-again").hidden = false;
    const verdict = find("clap-verdict");
    verdict.hidden = false;
    verdict.dataset.verdict = answer.verdict;
    write(verdict, verdictText(answer));
    this.#end("");
    this.#showGuide();
    this.suggest(answer.next_place_m);
    if (this.guided && this.claps.length >= ENOUGH) await this.#measure(this.waits);
  }

  #end(text) {
    this.waits += 1;
    this.waiting = false;
    write(find("clap-button"), "Clap here");
    this.#say(text);
    this.place();
  }

  /** Forget the claps: they were for other poses. */
  restart() {
    this.cancel();
    this.claps = [];
    this.guided = false;
    for (const axis of ["x", "y"]) find(`clap-${axis}`).value = "";
    find("claps").replaceChildren();
    find("clap-findings").replaceChildren();
    find("clap-verdict").hidden = true;
    find("clap-again").hidden = true;
    this.onProposal(null);
    this.#showGuide();
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
