// The 3-D view turned, zoomed and moved by pointer, wheel and keys.

import { between, moved, start, turned, zoomed } from "./camera.js";

/** Degrees that a pixel of dragging turns, and that a key or button does. */
const DRAG_DEG = 0.4;
const STEP_DEG = 15;
/** Enlargement by a key or button, and by a pixel of the wheel. */
const STEP_ZOOM = 1.3;
const WHEEL_ZOOM = 1.0015;
/** Pixels that a key moves the view. */
const STEP_PX = 40;
/** Pixels of a line and of a page, in which some wheels count. */
const WHEEL_UNITS_PX = [1, 16, 400];
/** Time, in milliseconds, that a step of a key or button takes, where the reader has not asked for less motion. */
const STEP_MS = 180;
/** Pause, in milliseconds, after which the wheel no longer belongs to scrolling the page. */
const SCROLL_MS = 250;

/** The steps of keys and buttons: what each makes of a camera in a room of a size, at pixels per metre. */
const STEPS = {
  left: (camera) => turned(camera, -STEP_DEG, 0),
  right: (camera) => turned(camera, STEP_DEG, 0),
  up: (camera) => turned(camera, 0, STEP_DEG),
  down: (camera) => turned(camera, 0, -STEP_DEG),
  in: (camera, size) => zoomed(camera, STEP_ZOOM, size),
  out: (camera, size) => zoomed(camera, 1 / STEP_ZOOM, size),
  "move-left": (camera, size, scale) => moved(camera, -STEP_PX / scale, 0, size),
  "move-right": (camera, size, scale) => moved(camera, STEP_PX / scale, 0, size),
  "move-up": (camera, size, scale) => moved(camera, 0, STEP_PX / scale, size),
  "move-down": (camera, size, scale) => moved(camera, 0, -STEP_PX / scale, size),
  reset: (camera, size) => start(size),
};
const KEYS = { ArrowLeft: "left", ArrowRight: "right", ArrowUp: "up", ArrowDown: "down", "+": "in", "=": "in", "-": "out", Home: "reset" };

export class Turning {
  /** `plan` is turned while it shows the 3-D view; `onTurn()` has it drawn in the next frame. */
  constructor(plan, onTurn) {
    this.plan = plan;
    this.onTurn = onTurn;
    /** Where each pointer that is down was last, by its id. */
    this.pointers = new Map();
    /** The camera at the end of the step under way. */
    this.goal = null;
    this.scrolledAt = -Infinity;
    const { canvas } = plan;
    canvas.addEventListener("pointerdown", (event) => this.#press(event));
    canvas.addEventListener("pointermove", (event) => this.#drag(event));
    for (const name of ["pointerup", "pointercancel"]) {
      canvas.addEventListener(name, ({ pointerId }) => this.pointers.delete(pointerId));
    }
    canvas.addEventListener("wheel", (event) => this.#roll(event), { passive: false });
    canvas.addEventListener("keydown", (event) => this.#key(event));
    addEventListener("scroll", () => { this.scrolledAt = performance.now(); }, { passive: true });
  }

  get #isOpen() {
    return !this.plan.flat && this.plan.size !== null;
  }

  /** Take a step, by its name: see `STEPS`. */
  step(name) {
    if (!this.#isOpen) return;
    const { size, camera, scale } = this.plan;
    const from = camera;
    const goal = STEPS[name](this.goal ?? camera, size, scale);
    this.goal = goal;
    if (matchMedia("(prefers-reduced-motion: reduce)").matches) {
      this.#aim(goal);
      return;
    }
    const began = performance.now();
    const move = () => {
      if (this.goal !== goal) return; // another step or a hand has taken over
      const share = Math.min(1, (performance.now() - began) / STEP_MS);
      if (share === 1) this.#aim(goal);
      else {
        this.#turn(between(from, goal, 1 - (1 - share) ** 3));
        requestAnimationFrame(move);
      }
    };
    requestAnimationFrame(move);
  }

  /** Look by a camera from now on, whatever step was under way. */
  #aim(camera) {
    this.goal = null;
    this.#turn(camera);
  }

  #turn(camera) {
    this.plan.aim(camera);
    this.onTurn();
  }

  #press(event) {
    if (!this.#isOpen || event.button !== 0) return;
    this.pointers.set(event.pointerId, [event.offsetX, event.offsetY]);
    this.plan.canvas.setPointerCapture(event.pointerId);
  }

  /** One pointer turns the room under it, or moves it with the Shift key; two pointers move and zoom. */
  #drag({ pointerId, offsetX, offsetY, shiftKey }) {
    const before = this.pointers.get(pointerId);
    if (!this.#isOpen || before === undefined) return;
    const [across, down] = [offsetX - before[0], offsetY - before[1]];
    const other = [...this.pointers].find(([id]) => id !== pointerId)?.[1];
    this.pointers.set(pointerId, [offsetX, offsetY]);
    const { camera, scale, size } = this.plan;
    if (other) {
      const distance = ([x, y]) => Math.max(1, Math.hypot(x - other[0], y - other[1]));
      const factor = distance([offsetX, offsetY]) / distance(before);
      const shifted = moved(camera, -across / 2 / scale, down / 2 / scale, size);
      this.#aim(zoomed(shifted, factor, size, this.#fromMiddle((offsetX + other[0]) / 2, (offsetY + other[1]) / 2)));
    } else if (shiftKey) this.#aim(moved(camera, -across / scale, down / scale, size));
    else this.#aim(turned(camera, -across * DRAG_DEG, down * DRAG_DEG));
  }

  /** Zoom about the pointer; a wheel that is scrolling the page goes on with that, and so does one at the end of zooming. */
  #roll(event) {
    if (!this.#isOpen || performance.now() - this.scrolledAt < SCROLL_MS) return;
    const pixels = event.deltaY * (WHEEL_UNITS_PX[event.deltaMode] ?? 1);
    const { camera, size } = this.plan;
    const next = zoomed(camera, WHEEL_ZOOM ** -pixels, size, this.#fromMiddle(event.offsetX, event.offsetY));
    if (next.zoom === camera.zoom) return;
    event.preventDefault();
    this.#aim(next);
  }

  #key(event) {
    const name = KEYS[event.key];
    if (!this.#isOpen || name === undefined || event.ctrlKey || event.metaKey || event.altKey) return;
    event.preventDefault();
    const moves = event.shiftKey && event.key.startsWith("Arrow");
    this.step(moves ? `move-${name}` : name);
  }

  /** Metres to the right and up in the view from what is looked at to a pixel. */
  #fromMiddle(x, y) {
    const { plan } = this;
    const [u, v] = plan.at(plan.camera.target);
    return [(x - u) / plan.scale, (v - y) / plan.scale];
  }
}
