// Draws the zones on a plan, the one that is being drawn, and the picture of the floor plan.

import { ORDER } from "./plan-labels.js";
import { SMALL } from "./plan-style.js";

/** Distance in pixels between the hatching lines of excluded zones. */
const HATCH_GAP = 9;
/** Radius in pixels of the corners that can be moved, and distance within which the pointer takes one. */
const HANDLE = 5;
export const REACH = 12;
/** Least share of its height at which the picture of the floor plan is still drawn in a view. */
const LEAST_TILT = 0.1;

/** The zones of GET zones, as objects { name, low, high, corners, exclude }; `corners` is null for a box. */
export function zonesOf(described) {
  return Object.entries(described ?? {}).map(([name, { bounds_m: bounds, polygon_m: corners, exclude }]) => ({
    name,
    low: bounds.map(([from]) => from),
    high: bounds.map(([, to]) => to),
    corners,
    exclude,
  }));
}

/** Draw the picture on the floor, where a view shows it: `floorPlan` is { image, bounds } or null. */
export function drawFloorPicture(plan, floorPlan) {
  if (!floorPlan || plan.projection.toward[2] < LEAST_TILT) return;
  const [[left, right], [bottom, top]] = floorPlan.bounds;
  plan.g.globalAlpha = 0.55;
  plan.picture(floorPlan.image, [left, bottom, 0], [right, bottom, 0], [left, top, 0]);
  plan.g.globalAlpha = 1;
}

/** Draw the zones: their outlines from above, boxes from the side and the front, and prisms in 3-D. */
export function drawZones(plan, zones) {
  const { g } = plan;
  const colour = plan.colours.zone;
  for (const zone of zones) {
    const { base, faces, lines } = shapeOf(plan, zone);
    g.fillStyle = colour;
    g.globalAlpha = plan.flat ? 0.07 : 0.045;
    for (const face of faces) {
      plan.trace(face, true);
      g.fill();
    }
    g.globalAlpha = 0.75;
    g.strokeStyle = colour;
    g.lineWidth = 1;
    if (zone.exclude) hatch(plan, base);
    g.setLineDash([5, 4]);
    for (const line of lines) {
      plan.trace(line, line.length > 2);
      g.stroke();
    }
    g.setLineDash([]);
    g.globalAlpha = 1;
    wantName(plan, zone, base, colour);
  }
}

/** Draw the zone that is being edited: its corners, the edges between them, and the one that closes it. */
export function drawDraft(plan, draft) {
  if (!draft || plan.view !== "floor" || draft.length === 0) return;
  const { g } = plan;
  const points = draft.map(([x, y]) => plan.at([x, y, 0]));
  g.strokeStyle = plan.colours.marked;
  g.lineWidth = 2;
  g.beginPath();
  for (const point of points) g.lineTo(...point);
  g.stroke();
  g.setLineDash([4, 4]);
  g.beginPath();
  g.moveTo(...points[points.length - 1]);
  g.lineTo(...points[0]);
  g.stroke();
  g.setLineDash([]);
  g.fillStyle = plan.colours.marked;
  for (const [x, y] of points) {
    g.beginPath();
    g.arc(x, y, HANDLE, 0, 2 * Math.PI);
    plan.halo(3);
    g.fill();
  }
}

/**
 * What to draw of a zone, as lists of positions in metres: its base, which is hatched if it is excluded, its faces, and
 * the lines around them.
 *
 * From above the only face is the zone's own outline, from the side it is the box around it; a prism has all its faces.
 */
function shapeOf(plan, zone) {
  const { low, high } = zone;
  const outline = zone.corners ?? [[low[0], low[1]], [high[0], low[1]], [high[0], high[1]], [low[0], high[1]]];
  const at = (z) => outline.map(([x, y]) => [x, y, z]);
  if (plan.flat) {
    const [i, k] = plan.axes;
    const corner = (a, b) => low.map((c, axis) => (axis === i ? a : axis === k ? b : c));
    const box = [corner(low[i], low[k]), corner(high[i], low[k]), corner(high[i], high[k]), corner(low[i], high[k])];
    const base = plan.view === "floor" ? at(0) : box;
    return { base, faces: [base], lines: [base] };
  }
  const [base, top] = [at(low[2]), at(high[2])];
  const next = (index) => (index + 1) % base.length;
  const sides = base.map((corner, index) => [corner, base[next(index)], top[next(index)], top[index]]);
  return { base, faces: [base, top, ...sides], lines: [base, top, ...base.map((corner, index) => [corner, top[index]])] };
}

function hatch(plan, ring) {
  const { g } = plan;
  const [x, y, width, height] = plan.box(...ring);
  g.save();
  plan.trace(ring, true);
  g.clip();
  g.beginPath();
  for (let offset = -height; offset < width; offset += HATCH_GAP) {
    g.moveTo(x + offset, y + height);
    g.lineTo(x + offset + height, y);
  }
  g.stroke();
  g.restore();
}

/** A box is named in a corner, a polygon and a prism in the middle of their corners, or beside it. */
function wantName(plan, { name, corners, exclude }, ring, colour) {
  const text = exclude ? `${name} (excluded)` : name;
  const [left, top, width, height] = plan.box(...ring);
  const points = ring.map((corner) => plan.at(corner));
  const [x, y] = [0, 1].map((axis) => points.reduce((sum, point) => sum + point[axis], 0) / points.length);
  const inCorners = [top + 13, top + height - 13].flatMap((middle) => [
    { x: left + 6, y: middle, align: "left" }, { x: left + width - 6, y: middle, align: "right" },
  ]);
  const inMiddle = [0, -16, 16, -32, 32].map((off) => ({ x, y: y + off, align: "center" }));
  const isBox = plan.flat && !(corners && plan.view === "floor");
  plan.labels.add({
    order: ORDER.zone,
    font: SMALL,
    lines: [{ text, colour }],
    spots: isBox ? [...inCorners, ...inMiddle] : [...inMiddle, ...inCorners],
    inRoom: true,
  });
}
