// What the set-up view draws over the floor plan: proposed poses, the array that is being moved, and the next place.

import { draftMicrophones, handleOf } from "./set-up-move.js";

const SVG = "http://www.w3.org/2000/svg";
/** Radius of a microphone, and least radius of an array's outline with its distance from the microphones, in pixels. */
const MICROPHONE_PX = 3;
const LEAST_PX = 11;
const GAP_PX = 6;

export class PoseOverlay {
  constructor(plan) {
    this.plan = plan;
    this.root = shape("svg", { class: "pose-overlay", "aria-hidden": "true" });
    plan.canvas.after(this.root);
  }

  /** Draw a proposal or null, a draft of `ArrayMover` or null with the arrays in force, and the next place or null. */
  draw(proposal, draft, arrays, next) {
    if (this.plan.size === null) return;
    const parts = [];
    if (next !== null) parts.push(...this.#next(next));
    for (const { array, before, after } of proposal?.arrays ?? []) {
      parts.push(this.#line(before.position_m, after.position_m, "pose-way"), ...this.#array(after.position_m, after.microphones_m, array));
    }
    if (draft !== null && draft.name in arrays) {
      const from = arrays[draft.name];
      const [x, y] = this.plan.at(draft.position);
      const [u, v] = handleOf(x, y, draft.turnDeg);
      parts.push(
        this.#line(from.position_m, draft.position, "pose-way"),
        shape("line", { x1: x, y1: y, x2: u, y2: v, class: "pose-arm" }),
        shape("circle", { cx: u, cy: v, r: 8, class: "pose-handle", "data-testid": "turn-handle" }),
        ...this.#array(draft.position, draftMicrophones(draft, from), draft.name),
      );
    }
    this.root.replaceChildren(...parts);
  }

  #next(place) {
    const [cx, cy] = this.plan.at(place);
    return [shape("circle", { cx, cy, r: 10, class: "next-place" }), shape("circle", { cx, cy, r: 2, class: "next-place" })];
  }

  #line(from, to, className) {
    const [[x1, y1], [x2, y2]] = [this.plan.at(from), this.plan.at(to)];
    return shape("line", { x1, y1, x2, y2, class: className });
  }

  #array(position, microphones, name) {
    const [cx, cy] = this.plan.at(position);
    const dots = microphones.map((microphone) => this.plan.at(microphone));
    const reach = Math.max(...dots.map(([x, y]) => Math.hypot(x - cx, y - cy)));
    const radius = Math.max(LEAST_PX, reach + GAP_PX);
    const label = shape("text", { x: cx, y: cy - radius - 6, class: "pose-label" });
    label.textContent = name;
    return [
      shape("circle", { cx, cy, r: radius, class: "pose-outline" }),
      ...dots.map(([x, y]) => shape("circle", { cx: x, cy: y, r: MICROPHONE_PX, class: "pose-microphone" })),
      label,
    ];
  }
}

function shape(tag, attributes) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  return element;
}
