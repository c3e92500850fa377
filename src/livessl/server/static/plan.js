// One view of the room on a canvas, drawn to scale: where it lies on the canvas, and the order of the layers.

import { write } from "./dom.js";
import { number } from "./format.js";
import { OLD_MS } from "./model.js";
import { drawArrays } from "./plan-arrays.js";
import { drawEstimate, drawTracks, drawTrail } from "./plan-estimates.js";
import { Labels } from "./plan-labels.js";
import { drawAxes, drawFaces, drawGrid, drawMap, drawWalls } from "./plan-room.js";
import { drawDraft, drawFloorPicture, drawZones } from "./plan-zones.js";
import { FIXED, Projection } from "./projection.js";

/** Space around the room for axes and labels, in pixels: of the fixed views and of the 3-D view. */
const MARGIN = { left: 44, right: 18, top: 26, bottom: 40 };
const MARGIN_3D = { left: 40, right: 40, top: 14, bottom: 36 };
/** Fixed views share one scale unless that would leave one of them smaller than this share of its space. */
const LEAST_SHARED = 0.85;
const AXIS_NAMES = ["x", "y", "z"];

/** The plan of each canvas that has one: see `Plan.of`. */
const plans = new WeakMap();

export class Plan {
  /** `view` is a fixed one: "floor", "side" or "front"; the coordinates under the pointer are written to `pointer`. */
  constructor(canvas, view, pointer) {
    this.canvas = canvas;
    this.size = null;
    /** Where the 3-D view is looked at from, or null before it was shown: see camera.js. */
    this.camera = null;
    /** Pixels at the right of the 3-D view that its buttons cover. */
    this.covered = 0;
    this.look(view);
    plans.set(canvas, this);
    canvas.addEventListener("pointermove", ({ offsetX, offsetY }) => {
      if (!this.flat) return;
      const metres = this.metresAt(offsetX, offsetY);
      const words = metres?.map((value, index) => `${this.axisNames[index]} ${number(value)}`);
      write(pointer, words?.join("  ") ?? "");
    });
    canvas.addEventListener("pointerleave", () => {
      if (this.flat) write(pointer, "");
    });
  }

  /** The plan that draws on a canvas. */
  static of(canvas) {
    return plans.get(canvas);
  }

  /** Show another view at the next drawing: a fixed one, or "3d" with the layers of plan-solid.js. */
  look(view, solid = null) {
    this.view = view;
    this.solid = solid;
    this.flat = solid === null;
    if (this.flat) this.projection = new Projection(...FIXED[view]);
    else this.aim(this.camera);
    this.axes = this.flat ? this.projection.axes : null;
    this.axisNames = this.axes?.map((axis) => AXIS_NAMES[axis]);
    /** The labels of the last drawing of this view, or null before it. */
    this.labels = null;
  }

  /** Look at the 3-D view by another camera, or none as long as the room is not known, at the next drawing. */
  aim(camera) {
    this.camera = camera;
    if (!this.flat) this.projection = new Projection(camera?.azimuthDeg ?? 0, camera?.elevationDeg ?? 0);
  }

  get margin() {
    return this.flat ? MARGIN : { ...MARGIN_3D, right: MARGIN_3D.right + this.covered };
  }

  /** Pixels per metre at which the whole room fits. */
  fit(size) {
    if (!this.flat && this.camera === null) this.aim(this.solid.start(size));
    const { left, right, top, bottom } = this.margin;
    const { clientWidth, clientHeight } = this.canvas;
    const [across, up] = this.flat ? this.projection.extent(size) : this.solid.room3d(this.camera, size);
    return Math.max(1, Math.min((clientWidth - left - right) / across, (clientHeight - top - bottom) / up));
  }

  /** Set the scale, centre the room, and match the canvas to the screen's pixels. */
  layout(size, scale) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    this.pixelRatio = window.devicePixelRatio || 1;
    for (const [name, pixels] of [["width", width], ["height", height]]) {
      const wanted = Math.round(pixels * this.pixelRatio);
      if (this.canvas[name] !== wanted) this.canvas[name] = wanted;
    }
    this.size = size;
    const margin = this.margin;
    const middle = [(margin.left + width - margin.right) / 2, (margin.top + height - margin.bottom) / 2];
    const [target, zoom] = this.flat ? [size.map((c) => c / 2), 1] : [this.camera.target, this.camera.zoom];
    this.projection = this.projection.placed(scale * zoom, target, middle);
    this.scale = this.projection.scale;
    const across = this.flat ? this.projection.extent(size).map((metres) => (metres * scale) / 2) : middle;
    this.left = middle[0] - across[0];
    this.right = this.flat ? middle[0] + across[0] : width;
    this.top = middle[1] - across[1];
    this.bottom = this.flat ? middle[1] + across[1] : height;
  }

  /** Draw all layers of a scene: see `Model.scene`. */
  draw(scene, colours) {
    const g = this.canvas.getContext("2d");
    this.g = g;
    this.colours = colours;
    this.called = this.#called(scene);
    this.labels = new Labels(this);
    g.setTransform(this.pixelRatio, 0, 0, this.pixelRatio, 0, 0);
    g.clearRect(0, 0, this.canvas.clientWidth, this.canvas.clientHeight);
    g.lineJoin = "round";
    drawFaces(this);
    this.clip(() => {
      drawFloorPicture(this, scene.floorPlan);
      drawMap(this, scene);
      drawGrid(this);
      this.solid?.drawBackEdges(this);
      drawZones(this, scene.zones);
    });
    if (this.flat) {
      drawWalls(this);
      drawAxes(this);
    } else this.solid.drawAxes(this);
    this.clip(() => {
      drawTracks(this, scene);
      drawTrail(this, scene);
      drawDraft(this, scene.draft);
    });
    drawArrays(this, scene.arrays);
    const { highlight, again } = scene;
    const others = scene.estimates.filter(({ id }) => id !== highlight?.id);
    for (const estimate of others) drawEstimate(this, estimate, scene, false);
    if (highlight) drawEstimate(this, highlight, scene, true);
    if (again) drawEstimate(this, again, scene, false);
    this.solid?.drawNearEdges(this);
    this.labels.draw();
  }

  /** The one estimate whose coordinates are marked on the axes: the highlighted one, or else the newest. */
  #called({ highlight, estimates, now }) {
    const called = highlight ?? estimates.find(({ newest, bornMs }) => newest && now - bornMs <= OLD_MS);
    return called?.position && called.status !== "direction-only" ? called : null;
  }

  /** Metres along the axes of a fixed view at a pixel of the canvas, or null outside the room. */
  metresAt(px, py) {
    if (this.size === null || px < this.left || px > this.right || py < this.top || py > this.bottom) return null;
    return [(px - this.left) / this.scale, (this.bottom - py) / this.scale];
  }

  // What the layers draw with.

  /** Pixels of a position in metres. */
  at(position) {
    return this.projection.at(position);
  }

  /** Left, top, width and height in pixels of the box around positions in metres. */
  box(...positions) {
    const points = positions.map((position) => this.at(position));
    const [xs, ys] = [0, 1].map((axis) => points.map((point) => point[axis]));
    const [left, top] = [Math.min(...xs), Math.min(...ys)];
    return [left, top, Math.max(...xs) - left, Math.max(...ys) - top];
  }

  /** Left, top, width and height in pixels of the room in a fixed view, or of the whole 3-D view. */
  get room() {
    return [this.left, this.top, this.right - this.left, this.bottom - this.top];
  }

  /** Begin a path through positions in metres. */
  trace(positions, closed = false) {
    this.g.beginPath();
    for (const position of positions) this.g.lineTo(...this.at(position));
    if (closed) this.g.closePath();
  }

  /** Draw a picture on a plane: its left bottom corner, and those beside and above it, are at positions in metres. */
  picture(image, corner, beside, above) {
    const { g } = this;
    const [[x, y], [u, v], [p, q]] = [corner, beside, above].map((position) => this.at(position));
    g.save();
    g.imageSmoothingEnabled = true;
    g.imageSmoothingQuality = "low";
    g.transform((u - x) / image.width, (v - y) / image.width, (x - p) / image.height, (y - q) / image.height, p, q);
    g.drawImage(image, 0, 0);
    g.restore();
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
}

/** Draw a scene on the plans that are shown, the fixed views at one scale if that wastes no view's space. */
export function drawTogether(plans, size, scene, colours) {
  const shown = plans.filter(({ canvas }) => canvas.clientWidth > 0);
  const fits = shown.map((plan) => plan.fit(size));
  const common = Math.min(...fits);
  const shared = shown.every(({ flat }) => flat) && common > LEAST_SHARED * Math.max(...fits);
  shown.forEach((plan, index) => {
    plan.layout(size, shared ? common : fits[index]);
    plan.draw(scene, colours);
  });
}
