// Arrays moved by hand: dragged and turned on the floor plan, or typed. The server proposes it, and a person accepts.

import { el, find, write } from "./dom.js";

/** Positions are dragged on a raster of this many metres, turns on one of this many degrees. */
const RASTER_M = 0.01;
const RASTER_DEG = 1;
/** Distance of the handle that turns an array from its centre, and distance within which the pointer takes it, in pixels. */
export const HANDLE_PX = 44;
const REACH_PX = 22;
const FIELDS = ["x", "y", "z", "turn"];

export class ArrayMover {
  /** `propose(request)` asks the server for a proposal; `redraw()` has the plan drawn again. */
  constructor({ plan, propose, redraw }) {
    this.plan = plan;
    this.propose = propose;
    this.redraw = redraw;
    this.arrays = {};
    /** What is being moved: { name, position, turnDeg } or null. */
    this.draft = null;
    this.held = null;
    this.choice = find("move-array");
    this.choice.addEventListener("change", () => this.#begin(this.choice.value));
    find("move-form").addEventListener("input", ({ target }) => {
      if (target !== this.choice) this.#read();
    });
    find("move-form").addEventListener("submit", (event) => {
      event.preventDefault();
      this.#submit();
    });
    find("move-cancel").addEventListener("click", () => this.cancel());
    const { canvas } = plan;
    canvas.addEventListener("pointerdown", (event) => this.#press(event));
    canvas.addEventListener("pointermove", (event) => this.#drag(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { this.held = null; });
  }

  set mayChange(may) {
    this.choice.disabled = !may;
    if (!may) this.cancel();
  }

  /** Take the arrays that are in force: objects { position_m, microphones_m } by name. */
  show(arrays) {
    this.arrays = arrays;
    const names = Object.keys(arrays);
    const listed = [...this.choice.options].slice(1).map(({ value }) => value);
    if (names.join("\n") !== listed.join("\n")) {
      this.choice.replaceChildren(...["", ...names].map((name) => el("option", { value: name, text: name || "choose an array" })));
      this.choice.value = this.draft?.name ?? "";
    }
    if (this.draft !== null && !(this.draft.name in arrays)) this.cancel();
  }

  /** Stop moving; nothing has changed. */
  cancel() {
    this.#begin("");
  }

  #begin(name) {
    this.choice.value = name;
    const array = this.arrays[name];
    this.draft = array ? { name, position: [...array.position_m], turnDeg: 0 } : null;
    this.held = null;
    this.plan.canvas.style.touchAction = array ? "none" : ""; // a finger moves the array and does not scroll
    find("move-fields").hidden = !array;
    write(find("move-fault"), "");
    this.#write();
    this.redraw();
  }

  #write() {
    if (this.draft === null) return;
    const { position, turnDeg } = this.draft;
    [...position, turnDeg].forEach((value, index) => {
      find(`move-${FIELDS[index]}`).value = Number(value.toFixed(3));
    });
  }

  #read() {
    const values = FIELDS.map((field) => find(`move-${field}`).valueAsNumber);
    if (this.draft === null || !values.every(Number.isFinite)) return;
    this.draft = { ...this.draft, position: values.slice(0, 3), turnDeg: values[3] };
    this.redraw();
  }

  async #submit() {
    this.#read();
    const { name, position, turnDeg } = this.draft;
    write(find("move-fault"), "");
    try {
      await this.propose({ arrays: { [name]: { position_m: position, turn_deg: [0, 0, turnDeg] } } });
      this.cancel();
    } catch (error) {
      write(find("move-fault"), error.told ?? `The server did not answer (${error.message}). Try again.`);
    }
  }

  #press({ offsetX, offsetY, pointerId }) {
    if (this.draft === null || this.plan.size === null) return;
    const [x, y] = this.plan.at(this.draft.position);
    const [u, v] = handleOf(x, y, this.draft.turnDeg);
    if (Math.hypot(offsetX - u, offsetY - v) <= REACH_PX) this.held = "turn";
    else if (Math.hypot(offsetX - x, offsetY - y) <= REACH_PX) this.held = "place";
    else return;
    this.plan.canvas.setPointerCapture(pointerId);
  }

  #drag({ offsetX, offsetY }) {
    if (this.draft === null || this.held === null) return;
    if (this.held === "turn") {
      const [x, y] = this.plan.at(this.draft.position);
      const turned = (Math.atan2(y - offsetY, offsetX - x) * 180) / Math.PI;
      this.draft = { ...this.draft, turnDeg: Math.round(turned / RASTER_DEG) * RASTER_DEG };
    } else {
      const metres = this.plan.metresAt(offsetX, offsetY);
      if (metres === null) return;
      const [x, y] = metres.map((value) => Math.round(value / RASTER_M) * RASTER_M);
      this.draft = { ...this.draft, position: [x, y, this.draft.position[2]] };
    }
    this.#write();
    this.redraw();
  }
}

/** Pixels of the handle that turns an array at (x, y): it points to +x while the array is as it was. */
export function handleOf(x, y, turnDeg) {
  const angle = (turnDeg * Math.PI) / 180;
  return [x + HANDLE_PX * Math.cos(angle), y - HANDLE_PX * Math.sin(angle)];
}

/** The microphones of a draft, in metres. */
export function draftMicrophones({ position, turnDeg }, { position_m: centre, microphones_m: microphones }) {
  const [cos, sin] = [Math.cos((turnDeg * Math.PI) / 180), Math.sin((turnDeg * Math.PI) / 180)];
  return microphones.map(([x, y, z]) => {
    const [u, v] = [x - centre[0], y - centre[1]];
    return [position[0] + cos * u - sin * v, position[1] + sin * u + cos * v, position[2] + z - centre[2]];
  });
}
