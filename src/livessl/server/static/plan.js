// One view of the room on a canvas, drawn to scale: the projection from metres to pixels, and the order of the layers.

import { write } from "./dom.js";
import { number } from "./format.js";
import { OLD_MS } from "./model.js";
import { drawArray } from "./plan-arrays.js";
import { drawEstimate, drawTracks, drawTrail } from "./plan-estimates.js";
import { drawAxes, drawFloor, drawGrid, drawMap, drawWalls } from "./plan-room.js";
import { drawDraft, drawFloorPicture, drawZones } from "./plan-zones.js";

/** Space around the room for axes and labels, in pixels. */
const MARGIN = { left: 44, right: 18, top: 26, bottom: 40 };
/** Both views share one scale unless that would leave one of them smaller than this share of its space. */
const LEAST_SHARED = 0.85;
/** The views: the axes that point right and up, and their names. */
const VIEWS = {
  floor: { axes: [0, 1], names: ["x", "y"] },
  side: { axes: [1, 2], names: ["y", "z"] },
};

export class Plan {
  /** `view` is "floor" or "side"; the coordinates under the pointer are written to `pointer`. */
  constructor(canvas, view, pointer) {
    this.canvas = canvas;
    this.view = view;
    this.axes = VIEWS[view].axes;
    this.axisNames = VIEWS[view].names;
    this.size = null;
    canvas.addEventListener("pointermove", ({ offsetX, offsetY }) => {
      const metres = this.metresAt(offsetX, offsetY);
      const words = metres?.map((value, index) => `${this.axisNames[index]} ${number(value)}`);
      write(pointer, words?.join("  ") ?? "");
    });
    canvas.addEventListener("pointerleave", () => write(pointer, ""));
  }

  /** Pixels per metre at which the whole room fits. */
  fit(size) {
    const [i, k] = this.axes;
    const { clientWidth, clientHeight } = this.canvas;
    return Math.max(1, Math.min(
      (clientWidth - MARGIN.left - MARGIN.right) / size[i],
      (clientHeight - MARGIN.top - MARGIN.bottom) / size[k],
    ));
  }

  /** Set the scale, centre the room, and match the canvas to the screen's pixels. */
  layout(size, scale) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const [i, k] = this.axes;
    const inner = [width - MARGIN.left - MARGIN.right, height - MARGIN.top - MARGIN.bottom];
    this.pixelRatio = window.devicePixelRatio || 1;
    for (const [name, pixels] of [["width", width], ["height", height]]) {
      const wanted = Math.round(pixels * this.pixelRatio);
      if (this.canvas[name] !== wanted) this.canvas[name] = wanted;
    }
    this.size = size;
    this.scale = scale;
    this.left = MARGIN.left + (inner[0] - size[i] * scale) / 2;
    this.bottom = MARGIN.top + inner[1] - (inner[1] - size[k] * scale) / 2;
    this.right = this.left + size[i] * scale;
    this.top = this.bottom - size[k] * scale;
  }

  /** Draw all layers of a scene: see `Model.scene`. */
  draw(scene, colours) {
    const g = this.canvas.getContext("2d");
    this.g = g;
    this.colours = colours;
    this.called = this.#called(scene);
    g.setTransform(this.pixelRatio, 0, 0, this.pixelRatio, 0, 0);
    g.clearRect(0, 0, this.canvas.clientWidth, this.canvas.clientHeight);
    g.lineJoin = "round";
    drawFloor(this);
    this.clip(() => {
      drawFloorPicture(this, scene.floorPlan);
      drawMap(this, scene);
      drawGrid(this);
      drawZones(this, scene.zones);
    });
    drawWalls(this);
    drawAxes(this);
    this.clip(() => {
      drawTracks(this, scene);
      drawTrail(this, scene);
      drawDraft(this, scene.draft);
    });
    for (const array of scene.arrays) drawArray(this, array);
    const { highlight, again } = scene;
    const others = scene.estimates.filter(({ id }) => id !== highlight?.id);
    for (const estimate of others) drawEstimate(this, estimate, scene, false);
    if (highlight) drawEstimate(this, highlight, scene, true);
    if (again) drawEstimate(this, again, scene, false);
  }

  /** The one estimate whose coordinates are marked on the axes: the highlighted one, or else the newest. */
  #called({ highlight, estimates, now }) {
    const called = highlight ?? estimates.find(({ newest, bornMs }) => newest && now - bornMs <= OLD_MS);
    return called?.position && called.status !== "direction-only" ? called : null;
  }

  /** Metres at a pixel of the canvas, or null outside the room. */
  metresAt(px, py) {
    if (this.size === null || px < this.left || px > this.right || py < this.top || py > this.bottom) return null;
    return [(px - this.left) / this.scale, (this.bottom - py) / this.scale];
  }

  // What the layers draw with.

  /** Pixels of a position in metres. */
  at(position) {
    const [i, k] = this.axes;
    return [this.left + position[i] * this.scale, this.bottom - position[k] * this.scale];
  }

  /** Left, top, width and height in pixels of the box between two corners in metres. */
  box(low, high) {
    const [x0, y0] = this.at(low);
    const [x1, y1] = this.at(high);
    return [x0, y1, x1 - x0, y0 - y1];
  }

  /** Left, top, width and height of the room in pixels. */
  get room() {
    return [this.left, this.top, this.right - this.left, this.bottom - this.top];
  }

  /** Paint with everything outside the room cut off. */
  clip(paint) {
    const { g } = this;
    g.save();
    g.beginPath();
    g.rect(...this.room);
    g.clip();
    paint();
    g.restore();
  }

  /** Stroke the path in the background's colour, so that the line drawn next stands out. */
  halo(width) {
    this.g.strokeStyle = this.colours.halo;
    this.g.lineWidth = width;
    this.g.stroke();
  }

  text(text, x, y, colour) {
    const { g } = this;
    g.lineWidth = 3.5;
    g.strokeStyle = this.colours.halo;
    g.strokeText(text, x, y);
    g.fillStyle = colour;
    g.fillText(text, x, y);
  }
}

/** Draw a scene on both plans, at one scale if that wastes no view's space, so that they read as one drawing. */
export function drawTogether(plans, size, scene, colours) {
  const fits = plans.map((plan) => plan.fit(size));
  const common = Math.min(...fits);
  const shared = common > LEAST_SHARED * Math.max(...fits);
  plans.forEach((plan, index) => {
    plan.layout(size, shared ? common : fits[index]);
    plan.draw(scene, colours);
  });
}
