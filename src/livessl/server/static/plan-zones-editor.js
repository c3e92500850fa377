// The form in which operators draw, change and delete zones; corners are set on the floor plan or typed.

import { put, refusal, remove } from "./access.js";
import { el, find, write } from "./dom.js";
import { REACH } from "./plan-zones.js";

/** Corners are set on a raster of this many metres, so that walls are straight. */
const RASTER_M = 0.05;
const NAME = "[A-Za-z0-9._\\-]{1,64}";

export class ZoneEditor {
  /** `plan` is the floor plan; `redraw()` is called when `draft` changes, and the server is asked at `api`. */
  constructor(api, plan, redraw) {
    this.api = api;
    this.plan = plan;
    this.redraw = redraw;
    this.mayChange = false;
    /** Corners [x, y] of the zone that is being edited, or null while none is. */
    this.draft = null;
    this.zones = {};
    this.held = null;
    this.button = find("zones-edit");
    this.form = find("zone-editor");
    this.#build();
    this.button.addEventListener("click", () => (this.draft === null ? this.#open() : this.#close()));
    const { canvas } = plan;
    canvas.addEventListener("pointerdown", (event) => this.#press(event));
    canvas.addEventListener("pointermove", (event) => this.#drag(event));
    for (const name of ["pointerup", "pointercancel"]) canvas.addEventListener(name, () => { this.held = null; });
  }

  /** Take the zones that are in force, and whether the server has a file for drawn ones. */
  show(zones, canDraw) {
    this.zones = zones;
    this.button.hidden = !(canDraw && this.mayChange);
    if (this.draft !== null) this.#list(this.choice.value);
  }

  #build() {
    const field = (label, input) => el("label", {}, label, input);
    const number = (id, label) => field(label, el("input", { id, type: "number", step: "any", inputmode: "decimal" }));
    this.choice = el("select", { id: "zone-choice", "aria-label": "Zone" });
    this.name = el("input", { id: "zone-name", required: true, pattern: NAME, title: "Letters, digits, '.', '_' and '-'", autocomplete: "off" });
    this.corners = el("textarea", { id: "zone-corners", rows: "5", spellcheck: "false", "aria-describedby": "zone-help" });
    this.exclude = el("input", { id: "zone-exclude", type: "checkbox" });
    this.fault = el("p", { id: "zone-fault", role: "alert", className: "zone-fault" });
    this.erase = el("button", { id: "zone-delete", className: "switch", type: "button", text: "Delete" });
    const undo = el("button", { className: "switch", type: "button", text: "Remove last corner" });
    const cancel = el("button", { className: "switch", type: "button", text: "Close" });
    this.form.append(
      el("p", { id: "zone-help", className: "zone-help", text: "Click on the floor plan to set corners, drag to move them, or type x, y in metres, one corner a line." }),
      field("Zone", this.choice), field("Name", this.name), field("Corners", this.corners),
      number("zone-low", "From z (m)"), number("zone-high", "To z (m)"), number("zone-loiter", "Loitering after (s)"),
      el("label", { className: "zone-check" }, this.exclude, "excluded: events here never alert"),
      this.fault,
      el("p", { className: "zone-buttons" }, el("button", { className: "switch", text: "Save" }), undo, this.erase, cancel),
    );
    this.choice.addEventListener("change", () => this.#load(this.choice.value));
    this.corners.addEventListener("input", () => this.#set(parse(this.corners.value) ?? this.draft, false));
    undo.addEventListener("click", () => this.#set(this.draft.slice(0, -1)));
    this.erase.addEventListener("click", () => this.#delete());
    cancel.addEventListener("click", () => this.#close());
    this.form.addEventListener("keydown", ({ key }) => {
      if (key === "Escape") this.#close();
    });
    this.form.addEventListener("submit", (event) => {
      event.preventDefault();
      this.#save();
    });
  }

  #open() {
    this.form.hidden = false;
    this.plan.canvas.style.touchAction = "none"; // a finger draws and does not scroll
    this.button.setAttribute("aria-expanded", "true");
    this.#list("");
    this.#load("");
    this.name.focus();
  }

  #close() {
    this.form.hidden = true;
    this.plan.canvas.style.touchAction = "";
    this.button.setAttribute("aria-expanded", "false");
    this.draft = null;
    this.redraw();
    this.button.focus();
  }

  /** Offer a new zone and the drawn ones; those of the site file are changed there. */
  #list(chosen) {
    const drawn = Object.keys(this.zones).filter((name) => this.zones[name].owner === "drawn");
    const options = ["", ...drawn].map((name) => el("option", { value: name, text: name || "new zone" }));
    this.choice.replaceChildren(...options);
    this.choice.value = drawn.includes(chosen) ? chosen : "";
    this.erase.hidden = this.choice.value === "";
  }

  #load(name) {
    const zone = this.zones[name];
    this.name.value = name;
    this.name.readOnly = name !== "";
    this.erase.hidden = name === "";
    this.exclude.checked = zone?.exclude ?? false;
    find("zone-low").value = zone?.z_m?.[0] ?? "";
    find("zone-high").value = zone?.z_m?.[1] ?? "";
    find("zone-loiter").value = zone?.loiter_s ?? "";
    write(this.fault, "");
    this.#set(zone?.polygon_m ?? []);
  }

  #set(draft, typed = true) {
    this.draft = draft;
    if (typed) this.corners.value = draft.map(([x, y]) => `${x}, ${y}`).join("\n");
    this.redraw();
  }

  #press(event) {
    const metres = this.draft === null ? null : this.plan.metresAt(event.offsetX, event.offsetY);
    if (!metres) return;
    const away = this.draft.map(([x, y]) => {
      const [u, v] = this.plan.at([x, y, 0]);
      return Math.hypot(u - event.offsetX, v - event.offsetY);
    });
    const nearest = away.indexOf(Math.min(...away));
    if (nearest >= 0 && away[nearest] <= REACH) this.held = nearest;
    else {
      this.held = this.draft.length;
      this.#set([...this.draft, metres.map(onRaster)]);
    }
    this.plan.canvas.setPointerCapture(event.pointerId);
  }

  #drag(event) {
    if (this.draft === null || this.held === null) return;
    const metres = this.plan.metresAt(event.offsetX, event.offsetY);
    if (metres) this.#set(this.draft.map((corner, index) => (index === this.held ? metres.map(onRaster) : corner)));
  }

  async #save() {
    const corners = parse(this.corners.value);
    if (corners === null) {
      write(this.fault, "Corners: expected two numbers a line, such as 1.5, 2");
      return;
    }
    const [low, high, loiter] = ["zone-low", "zone-high", "zone-loiter"].map((id) => find(id).value);
    if ((low === "") !== (high === "")) {
      write(this.fault, "Heights: expected both ends, or none for all heights");
      return;
    }
    const zone = { polygon_m: corners, exclude: this.exclude.checked };
    if (low !== "") zone.z_m = [Number(low), Number(high)];
    if (loiter !== "") zone.loiter_s = Number(loiter);
    const name = this.name.value;
    if (this.choice.value === "" && name in this.zones) {
      write(this.fault, `There is a zone "${name}" already; choose another name`);
      return;
    }
    await this.#ask(put(this.#address(name), zone));
  }

  async #delete() {
    const name = this.choice.value;
    if (name === "" || !confirm(`Delete zone "${name}"? Events keep its name.`)) return;
    await this.#ask(remove(this.#address(name)));
  }

  #address(name) {
    return new URL(`zones/${encodeURIComponent(name)}`, this.api);
  }

  /** Close the form once the server has accepted a change, or show why it has not. */
  async #ask(asking) {
    try {
      const response = await asking;
      if (response.ok) this.#close();
      else write(this.fault, await refusal(response));
    } catch (error) {
      write(this.fault, `The server does not answer: ${error.message}`);
    }
  }
}

/** Corners [x, y] that a text has, or null if it has anything else. */
function parse(text) {
  const lines = text.split("\n").filter((line) => line.trim() !== "");
  const corners = lines.map((line) => line.trim().split(/[\s,;]+/).map(Number));
  return corners.every((corner) => corner.length === 2 && corner.every(Number.isFinite)) ? corners : null;
}

function onRaster(metres) {
  return Number((Math.round(metres / RASTER_M) * RASTER_M).toFixed(2));
}
