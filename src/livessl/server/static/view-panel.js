// The panel beside the floor plan: chooses side elevation, front elevation or 3-D view, which the browser keeps.

import { find, write } from "./dom.js";
import { number } from "./format.js";
import { Plan } from "./plan.js";

const STORAGE_KEY = "livessl-view";
/** Width over height of the 3-D view's frame, where the page is narrow. */
const ASPECT_3D = 1.25;
/** Where the page is wide, the buttons of the 3-D view stand on it and cover this many pixels: see plan-views.css. */
const WIDE = matchMedia("(min-width: 1201px)");
const COVERED = 92;
const KEYS_3D = "Arrow keys turn it, with Shift they move it, plus and minus zoom, Home resets it";
/** The views: title, text for screen readers, power maps that they show, and width over height of a room. */
const VIEWS = {
  side: {
    title: "Side elevation",
    label: "Side elevation of the room, seen along the x axis",
    maps: ["side"],
    aspect: ([, y, z]) => y / z,
  },
  front: {
    title: "Front elevation",
    label: "Front elevation of the room, seen along the y axis",
    maps: ["front"],
    aspect: ([x, , z]) => x / z,
  },
  "3d": {
    title: "3-D view",
    label: `The room in 3-D. ${KEYS_3D}`,
    maps: ["side", "front"],
    aspect: () => ASPECT_3D,
  },
};

export class ViewPanel {
  /** `onView(maps)` is called with the power maps of the view that is chosen; `onTurn()` when the 3-D view has turned. */
  constructor({ onView, onTurn }) {
    this.onView = onView;
    this.canvas = find("side");
    this.frame = find("side-frame");
    this.pointer = find("side-pointer");
    this.radios = [...find("view-choice").querySelectorAll("input")];
    this.size = null;
    this.plan = new Plan(this.canvas, "side", this.pointer);
    this.onTurn = onTurn;
    /** What turns the 3-D view, or null before that view is loaded. */
    this.turning = null;
    /** The view that was chosen last; it is shown as soon as it is loaded. */
    this.chosen = "side";
    find("view-choice").addEventListener("change", ({ target }) => this.#choose(target.value));
    for (const button of find("turn").querySelectorAll("button")) {
      button.addEventListener("click", () => this.turning.step(button.dataset.step));
    }
    addEventListener("hashchange", () => this.#follow());
    WIDE.addEventListener("change", () => this.#fitFrame());
  }

  /** Show the view that the page's address names, `#view=3d`, or else the one that was chosen last. */
  start() {
    if (!this.#follow()) this.#show(kept());
  }

  /** Take the size of the room, in metres. */
  showRoom(size) {
    this.size = size;
    this.#fitFrame();
  }

  #follow() {
    const view = new URLSearchParams(location.hash.slice(1)).get("view");
    if (!Object.hasOwn(VIEWS, view)) return false;
    this.#show(view);
    return true;
  }

  #choose(view) {
    try {
      localStorage.setItem(STORAGE_KEY, view);
    } catch (error) { // a browser that keeps nothing, or is told to
      console.warn("livessl: the view is not kept:", error.message);
    }
    this.#show(view);
  }

  /** Show a view; the code of the 3-D view is loaded when it is needed, and the view before it stays until then. */
  async #show(view) {
    this.chosen = view;
    for (const radio of this.radios) radio.checked = radio.value === view;
    if (view !== "3d") return this.#put(view, null);
    try {
      const [solid, { Turning }] = await Promise.all([import("./plan-solid.js"), import("./plan-turn.js")]);
      this.turning ??= new Turning(this.plan, () => {
        if (!this.plan.flat) this.#say(); // a step may end after another view was chosen
        this.onTurn();
      });
      if (this.chosen === view) this.#put(view, solid);
    } catch (error) {
      console.warn("livessl: the 3-D view did not load:", error.message);
      if (this.chosen === view) await this.#show(this.plan.view);
      write(this.pointer, "The 3-D view did not load; load the page again");
    }
  }

  #put(view, solid) {
    const { title, label, maps } = VIEWS[view];
    const is3d = solid !== null;
    write(find("side-title"), title);
    write(this.pointer, "");
    find("side-panel").dataset.view = view;
    find("turn").hidden = !is3d;
    this.canvas.setAttribute("aria-label", label);
    this.canvas.setAttribute("role", is3d ? "application" : "img"); // so that a screen reader leaves the keys to it
    if (is3d) this.canvas.tabIndex = 0;
    else this.canvas.removeAttribute("tabindex");
    this.plan.look(view, solid);
    this.#fitFrame();
    this.onView(maps);
  }

  #fitFrame() {
    this.plan.covered = WIDE.matches ? COVERED : 0;
    if (this.size === null) return;
    this.frame.style.setProperty("--aspect", String(VIEWS[this.plan.view].aspect(this.size)));
  }

  /** Write where the room is looked at from. */
  #say() {
    const { azimuthDeg, elevationDeg, zoom } = this.plan.camera;
    write(this.pointer, `azimuth ${number(azimuthDeg, 0)}°  elevation ${number(elevationDeg, 0)}°  zoom ${number(zoom, 1)}`);
  }
}

/** The view that was chosen last in this browser. */
function kept() {
  try {
    const view = localStorage.getItem(STORAGE_KEY);
    return Object.hasOwn(VIEWS, view) ? view : "side";
  } catch { // a browser that keeps nothing
    return "side";
  }
}
