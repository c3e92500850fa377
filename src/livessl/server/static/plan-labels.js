// The text on a plan: collected while the layers are drawn, then written where no label covers another one.

import { placed } from "./labels.js";
import { LABEL, SMALL } from "./plan-style.js";

/** Height in pixels of a line of text by its font, and space around a tag's text. */
const LINE = { [LABEL]: 15, [SMALL]: 13 };
const TAG = { across: 4, height: 18 };
/** Space in pixels between the canvas's edge and text. */
const EDGE = 1;

/** Which labels choose their places first. */
export const ORDER = { call: 0, axis: 1, array: 2, estimate: 3, zone: 4, microphone: 5 };

export class Labels {
  constructor(plan) {
    this.plan = plan;
    this.wanted = [];
    /** Boxes of text with fixed places, and of drawn things that labels should not cover. */
    this.taken = [];
    this.avoid = [];
    /** What was written: objects { text, left, top, width, height }, in pixels. */
    this.written = [];
  }

  /**
   * Want a label: `lines` are objects { text, colour }.
   *
   * It stands around `anchor`, outside of `gap` pixels, or at one of `spots`, objects { x, y, align } with align "left",
   * "center" or "right" and y in the middle of its height. One that is `far` is joined to its anchor by a line. It stays
   * on the canvas, or in the room of a fixed view if it is `inRoom`.
   */
  add({ order, lines, font = LABEL, anchor, gap = 0, spots = null, far = false, inRoom = false }) {
    const { g } = this.plan;
    g.font = font;
    const width = Math.max(...lines.map(({ text }) => g.measureText(text).width));
    const height = LINE[font] * lines.length;
    const places = spots?.map(({ x, y, align }) => [
      align === "left" ? x : align === "right" ? x - width : x - width / 2, y - height / 2,
    ]);
    const [left, top, across, down] = this.plan.room;
    const within = inRoom && this.plan.flat ? { left, top, width: across, height: down } : null;
    this.wanted.push({ order, lines, font, width, height, anchor, gap, spots: places, far, within, alpha: g.globalAlpha });
  }

  /** Keep labels away from what is drawn within a radius of a point. */
  keepOff([x, y], radius) {
    this.avoid.push({ left: x - radius, top: y - radius, width: 2 * radius, height: 2 * radius });
  }

  /** Write a text on a filled ground at once, at a fixed place; labels that are placed later make way for it. */
  tag(text, x, y, colour, align) {
    const { g, colours, canvas } = this.plan;
    g.font = LABEL;
    const width = g.measureText(text).width + 2 * TAG.across;
    const wished = align === "right" ? x - width : x - width / 2;
    const left = Math.min(Math.max(wished, 0), canvas.clientWidth - width);
    g.fillStyle = colours.panel;
    g.fillRect(left - 1, y - TAG.height / 2, width + 2, TAG.height);
    g.fillStyle = colour;
    g.textAlign = "center";
    g.textBaseline = "middle";
    g.fillText(text, left + width / 2, y + 0.5);
    const box = { left, top: y - TAG.height / 2, width, height: TAG.height };
    this.taken.push(box);
    this.written.push({ text, ...box });
  }

  /** Write all labels that have found a place. */
  draw() {
    const { canvas: { clientWidth, clientHeight }, flat, covered } = this.plan;
    const width = clientWidth - 2 * EDGE - (flat ? 0 : covered);
    const bounds = { left: EDGE, top: EDGE, width, height: clientHeight - 2 * EDGE };
    const wanted = this.wanted.sort((a, b) => a.order - b.order);
    const boxes = placed(wanted, bounds, this);
    boxes.forEach((box, index) => {
      if (box?.away) this.#lead(wanted[index], box);
    });
    boxes.forEach((box, index) => {
      if (box) this.#write(wanted[index], box);
    });
  }

  /** Draw a thin line from what a label names to the label. */
  #lead({ anchor: [x, y], gap, lines, alpha }, { left, top, width, height }) {
    const { g } = this.plan;
    const end = [Math.min(Math.max(x, left), left + width), Math.min(Math.max(y, top), top + height)];
    const length = Math.hypot(end[0] - x, end[1] - y);
    if (length <= gap) return;
    g.globalAlpha = alpha;
    g.beginPath();
    g.moveTo(x + ((end[0] - x) * gap) / length, y + ((end[1] - y) * gap) / length);
    g.lineTo(...end);
    this.plan.halo(3);
    g.strokeStyle = lines[0].colour;
    g.lineWidth = 1;
    g.stroke();
    g.globalAlpha = 1;
  }

  #write({ lines, font, alpha }, { left, top, width, height }) {
    const { g, colours } = this.plan;
    g.globalAlpha = alpha;
    g.font = font;
    g.textAlign = "center";
    g.textBaseline = "middle";
    lines.forEach(({ text, colour }, index) => {
      const [x, y] = [left + width / 2, top + LINE[font] * (index + 0.5) + 0.5];
      g.lineWidth = 3.5;
      g.strokeStyle = colours.halo;
      g.strokeText(text, x, y);
      g.fillStyle = colour;
      g.fillText(text, x, y);
    });
    g.globalAlpha = 1;
    this.written.push({ text: lines.map(({ text }) => text).join("\n"), left, top, width, height });
  }
}
