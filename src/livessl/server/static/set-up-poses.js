// Proposed poses: measured by claps, by sounds, or typed; what they change, and the buttons that accept and undo.

import { el, find, write } from "./dom.js";
import { counted, number, signed } from "./format.js";

/** How a proposal came about, in words. */
const METHODS = { poses: "by claps", refine: "by sounds", typed: "by hand" };

export class PosesPanel {
  /** `load(path)` reads JSON of the API, `send(path, value)` posts it, and `redraw()` has the plan drawn again. */
  constructor({ load, send, redraw }) {
    this.load = load;
    this.send = send;
    this.redraw = redraw;
    /** The proposal that is shown, as the server describes it, or null. */
    this.proposal = null;
    /** The set-up in force: see GET set-up. */
    this.setUp = null;
    this.busy = false;
    this.may = false;
    find("proposal-accept").addEventListener("click", () => this.#accept());
    find("proposal-discard").addEventListener("click", () => this.show(null));
    find("calibration-undo").addEventListener("click", () => this.#undo());
    find("refinement-show").addEventListener("click", () => this.show(this.setUp.refinement.proposal));
  }

  set mayChange(may) {
    this.may = may;
    this.#enable();
  }

  /** Load what is in force. */
  async refresh() {
    this.setUp = await this.load("set-up");
    this.#showInForce(this.setUp.calibration);
    this.#showRefinement(this.setUp.refinement);
    this.#enable();
  }

  /** Show a proposal of the server; null removes what is shown. */
  show(proposal) {
    this.proposal = proposal;
    find("proposal").hidden = proposal === null;
    if (proposal !== null) {
      write(find("proposal-how"), proposal.sounds ? `${METHODS[proposal.method]}, ${counted(proposal.sounds, "sound")}` : METHODS[proposal.method]);
      find("proposal-arrays").replaceChildren(...proposal.arrays.map(poseItem));
      find("proposal-claps").replaceChildren(...proposal.claps.map(clapRow));
      find("proposal-claps-table").hidden = proposal.claps.length === 0;
      write(find("proposal-speed"), speedText(proposal.speed));
      const refusal = find("proposal-refusal");
      refusal.hidden = proposal.refusal === null;
      write(refusal, proposal.refusal === null ? "" : `These poses cannot be accepted: ${proposal.refusal}.`);
      this.say(proposal.enough ? "Good enough: the poses of all arrays are known as well as is useful." : "");
    }
    this.#enable();
    this.redraw();
  }

  /** Say something about the proposal, or about what has been done. */
  say(text) {
    write(find("poses-say"), text);
  }

  async #accept() {
    const { id, arrays } = this.proposal;
    const names = arrays.map(({ array }) => array).join(", ");
    if (!confirm(`Locate with the new poses of ${names} from now on? You can undo it.`)) return;
    await this.#change("set-up/accept", { id }, "The new poses are in force.");
  }

  async #undo() {
    if (!confirm("Go back to the poses before the last change?")) return;
    await this.#change("set-up/undo", {}, "The poses before are in force again.");
  }

  async #change(path, request, done) {
    this.busy = true;
    this.#enable();
    this.say("The server computes its tables…");
    try {
      await this.send(path, request);
      this.show(null);
      this.say(done);
      await this.refresh();
    } catch (error) {
      this.say(error.told ?? `The server did not answer (${error.message}). Try again.`);
    } finally {
      this.busy = false;
      this.#enable();
    }
  }

  #enable() {
    const free = this.may && !this.busy;
    find("proposal-accept").disabled = !free || this.proposal === null || this.proposal.refusal !== null;
    find("calibration-undo").disabled = !free || !this.setUp?.calibration.can_undo;
  }

  #showInForce({ file, arrays, method, measured_utc: when, problem }) {
    const how = method === null ? "" : `, changed ${METHODS[method] ?? method} on ${new Date(when).toLocaleString()}`;
    const text = arrays.length === 0
      ? "The poses of the site file are in force; nothing is calibrated."
      : `${arrays.join(", ")}: from ${file}${how}. All others: from the site file.`;
    write(find("calibration-in-force"), problem === null ? text : `${text} The file cannot be read: ${problem}`);
  }

  #showRefinement({ sounds, needed, agrees, proposal }) {
    let text = `${sounds} of ${needed} sounds that two arrays received: further sounds will check the poses.`;
    if (agrees === true) text = `The last ${counted(sounds, "sound")} agree with the poses in force.`;
    else if (proposal !== null) {
      text = `The last ${counted(sounds, "sound")} say other poses: ${proposal.arrays.map(poseText).join("; ")}; ${proposal.known.join(", ")} is taken to be right.`;
    } else if (sounds >= needed) text = `The last ${counted(sounds, "sound")} leave the poses open: make some all over the room.`;
    write(find("refinement"), text);
    find("refinement-show").hidden = proposal === null;
  }
}

/** Distance and angle of a change, with their standard deviations where these are known. */
function poseText({ array, shift_m: shift, turn_deg: turn, position_std_m: off, orientation_std_deg: offDeg }) {
  const [metres, degrees] = [Math.hypot(...shift), Math.hypot(...turn)];
  const known = off === null ? ["", ""] : [` ± ${number(off, 3)}`, ` ± ${number(offDeg, 1)}`];
  return `${array} moved by ${number(metres, 3)}${known[0]} m and turned by ${number(degrees, 1)}${known[1]}°`;
}

function poseItem(pose) {
  const { array, before, after, shift_m: shift, turn_deg: turn, misfit_us: misfit, determined } = pose;
  return el("li", { className: "pose", "data-testid": `pose-${array}`, "data-determined": String(determined) },
    el("p", { text: poseText(pose) }),
    el("p", { className: "pose-detail", text: `from ${place(before.position_m)} to ${place(after.position_m)} (${shift.map((d) => signed(d, 3)).join(", ")} m), about x, y, z by ${turn.map((d) => signed(d, 1)).join(", ")}°` }),
    misfit === null ? null : el("p", { className: "pose-detail", text: `unexplained of its delays: ${number(misfit[0], 0)} µs before, ${number(misfit[1], 0)} µs after` }),
    determined === false ? el("p", { className: "pose-open", text: "not determined yet: clap at more places, on all its sides, near and far, high and low" }) : null);
}

function clapRow({ place_m: at, before_m: before, after_m: after, agrees }, index) {
  return el("tr", { "data-agrees": String(agrees) },
    ...[`${index + 1}`, place(at), distance(before), distance(after)].map((text) => el("td", { text })));
}

function speedText(speed) {
  if (speed === null) return "";
  const { speed_of_sound_m_s: measured, std_m_s: off, in_force_m_s: used } = speed;
  return `Speed of sound: ${number(measured, 1)} ± ${number(off, 1)} m/s (in force: ${number(used, 1)}).`;
}

export function place(position) {
  return position.map((value) => number(value)).join(", ");
}

function distance(metres) {
  return metres === null ? "–" : `${number(metres)} m`;
}
