// Layers of a plan that show the zones, the one that is being drawn, and the picture of the floor plan.

import { SMALL } from "./plan-style.js";

/** Distance in pixels between the hatching lines of excluded zones. */
const HATCH_GAP = 9;
/** Radius in pixels of the corners that can be moved, and distance within which the pointer takes one. */
const HANDLE = 5;
export const REACH = 12;

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

/** Draw the picture under the floor plan: `floorPlan` is { image, bounds } or null. */
export function drawFloorPicture(plan, floorPlan) {
  if (!floorPlan || plan.view !== "floor") return;
  const [[left, right], [bottom, top]] = floorPlan.bounds;
  plan.g.globalAlpha = 0.55;
  plan.g.imageSmoothingEnabled = true;
  plan.g.drawImage(floorPlan.image, ...plan.box([left, bottom, 0], [right, top, 0]));
  plan.g.globalAlpha = 1;
}

export function drawZones(plan, zones) {
  const { g } = plan;
  const colour = plan.colours.zone;
  g.font = SMALL;
  for (const zone of zones) {
    g.fillStyle = colour;
    g.globalAlpha = 0.07;
    traceZone(plan, zone);
    g.fill();
    g.globalAlpha = 0.75;
    g.strokeStyle = colour;
    g.lineWidth = 1;
    if (zone.exclude) hatch(plan, zone);
    g.setLineDash([5, 4]);
    traceZone(plan, zone);
    g.stroke();
    g.setLineDash([]);
    g.globalAlpha = 1;
    drawName(plan, zone, colour);
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

function traceZone(plan, { low, high, corners }) {
  const { g } = plan;
  g.beginPath();
  if (corners && plan.view === "floor") {
    for (const [x, y] of corners) g.lineTo(...plan.at([x, y, 0]));
    g.closePath();
  } else {
    const [x, y, width, height] = plan.box(low, high);
    g.rect(x + 0.5, y + 0.5, width - 1, height - 1);
  }
}

function hatch(plan, zone) {
  const { g } = plan;
  const [x, y, width, height] = plan.box(zone.low, zone.high);
  g.save();
  traceZone(plan, zone);
  g.clip();
  g.beginPath();
  for (let offset = -height; offset < width; offset += HATCH_GAP) {
    g.moveTo(x + offset, y + height);
    g.lineTo(x + offset + height, y);
  }
  g.stroke();
  g.restore();
}

/** A box is named in its corner, a polygon in the middle of its corners, which the box around it need not hold. */
function drawName(plan, { name, low, high, corners, exclude }, colour) {
  const { g } = plan;
  const text = exclude ? `${name} (excluded)` : name;
  if (corners && plan.view === "floor") {
    const middle = [0, 1].map((axis) => corners.reduce((sum, corner) => sum + corner[axis], 0) / corners.length);
    g.textAlign = "center";
    g.textBaseline = "middle";
    plan.text(text, ...plan.at([...middle, 0]), colour);
    return;
  }
  const [x, y] = plan.box(low, high);
  g.textAlign = "left";
  g.textBaseline = "top";
  plan.text(text, x + 6, y + 6, colour);
}
