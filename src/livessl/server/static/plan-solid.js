// Layers that only the 3-D view has: the edges and axes of the room, lines down to the floor, and ellipsoids. It is loaded
// when that view is chosen for the first time.

import { number } from "./format.js";
import { ORDER } from "./plan-labels.js";
import { axisScales, LABEL_GAP, niceStep } from "./plan-room.js";
import { SMALL } from "./plan-style.js";
import { corners, dot } from "./projection.js";

export { room3d, start } from "./camera.js";

/** Points of a drawn circle. */
const CIRCLE = 48;
/** Shortest axis, in pixels, that has labels, and their distance from it. */
const LEAST_AXIS = 40;
const LABEL_OFF = 13;
const NAME_OFF = 30;
/** Further distance of a name beside an axis, where numbers are wider than high. */
const NAME_BESIDE = 12;
/** Radius, in pixels, of the mark where a line down to the floor ends. */
const FOOT = 2.5;

/** The edges of the room as [corner, corner, near]; near ones would hide something behind them. */
function edges({ projection, size }) {
  const points = corners(size);
  const isBack = (index) => projection.faces(size).map(({ axis, value }) => (
    (index >> axis) & 1 ? value > 0 : value === 0
  ));
  const found = [];
  points.forEach((point, index) => {
    [1, 2, 4].filter((bit) => !(index & bit)).forEach((bit) => {
      const [a, b] = [isBack(index), isBack(index | bit)];
      found.push([point, points[index | bit], !a.some((back, face) => back && b[face])]);
    });
  });
  return found;
}

export function drawBackEdges(plan) {
  strokeEdges(plan, false, plan.colours.wall, 1.5, []);
}

/** The edges in front of everything are faint, so that the room reads as a box and nothing is hidden. */
export function drawNearEdges(plan) {
  plan.g.globalAlpha = 0.5;
  strokeEdges(plan, true, plan.colours.wall, 1, [3, 4]);
  plan.g.globalAlpha = 1;
}

function strokeEdges(plan, near, colour, width, dash) {
  const { g } = plan;
  g.strokeStyle = colour;
  g.lineWidth = width;
  g.setLineDash(dash);
  g.beginPath();
  for (const [from, to, isNear] of edges(plan)) {
    if (isNear !== near) continue;
    g.moveTo(...plan.at(from));
    g.lineTo(...plan.at(to));
  }
  g.stroke();
  g.setLineDash([]);
}

/** Where each axis is labelled: on the floor's edges towards the viewer, and on the room's leftmost upright edge. */
export function axisEdges({ projection, size }) {
  const near = size.map((length, axis) => (projection.toward[axis] > 0 ? length : 0));
  const upright = corners(size).slice(0, 4).sort((a, b) => projection.at(a)[0] - projection.at(b)[0])[0];
  return [
    (x) => [x, near[1], 0],
    (y) => [near[0], y, 0],
    (z) => [upright[0], upright[1], z],
  ];
}

/** Ticks and labels in metres along the three labelled edges, on the outside of the room. */
export function drawAxes(plan) {
  const { size, colours } = plan;
  const middle = plan.at(size.map((c) => c / 2));
  axisEdges(plan).forEach((edge, axis) => {
    const pixelsPerMetre = axisScales(plan)[axis];
    if (pixelsPerMetre * size[axis] < LEAST_AXIS) return;
    const step = niceStep(pixelsPerMetre, LABEL_GAP);
    const out = outwards(plan.at(edge(0)), plan.at(edge(size[axis])), middle);
    const label = (text, [x, y], off) => plan.labels.add({
      order: ORDER.axis,
      font: SMALL,
      lines: [{ text, colour: colours.muted }],
      spots: [{ x: x + out[0] * off, y: y + out[1] * off, align: "center" }],
    });
    label(`${"xyz"[axis]} (m)`, plan.at(edge(size[axis] / 2)), NAME_OFF + NAME_BESIDE * Math.abs(out[0]));
    plan.g.strokeStyle = colours.wall;
    plan.g.lineWidth = 1;
    plan.g.beginPath();
    for (let c = 0; c <= size[axis] + 1e-6; c += step) {
      const [x, y] = plan.at(edge(c));
      plan.g.moveTo(x, y);
      plan.g.lineTo(x + 5 * out[0], y + 5 * out[1]);
      label(number(c, step < 1 ? 1 : 0), [x, y], LABEL_OFF);
    }
    plan.g.stroke();
  });
}

/** The unit vector, in pixels, at right angles to an edge and away from the middle of the room. */
function outwards([x, y], [u, v], [mx, my]) {
  const length = Math.hypot(u - x, v - y);
  const [across, down] = [(v - y) / length, (x - u) / length];
  const away = ((x + u) / 2 - mx) * across + ((y + v) / 2 - my) * down;
  return away < 0 ? [-across, -down] : [across, down];
}

/** A line from a position down to the floor, which shows where in the room it is. */
export function drawStem(plan, position, colour, alpha, dash = []) {
  const { g } = plan;
  const before = g.globalAlpha;
  const foot = [position[0], position[1], 0];
  g.globalAlpha = before * alpha;
  g.strokeStyle = colour;
  g.lineWidth = 1;
  g.setLineDash(dash);
  plan.trace([position, foot]);
  g.stroke();
  g.setLineDash([]);
  traceRing(plan, foot, [FOOT / plan.scale, 0, 0], [0, FOOT / plan.scale, 0]);
  g.fillStyle = colour;
  g.fill();
  g.globalAlpha = before;
}

/** Lines on the floor from below an estimate to the two axes, with its coordinates where they end. */
export function drawCallout(plan, position, colour) {
  const { g } = plan;
  const before = g.globalAlpha;
  const foot = [position[0], position[1], 0];
  const middle = plan.at(plan.size.map((c) => c / 2));
  g.strokeStyle = colour;
  g.lineWidth = 1;
  g.globalAlpha = before * 0.6;
  g.setLineDash([2, 4]);
  const ends = axisEdges(plan).slice(0, 2).map((edge, axis) => edge(position[axis]));
  for (const end of ends) {
    plan.trace([foot, end]);
    g.stroke();
  }
  g.setLineDash([]);
  g.globalAlpha = before;
  axisEdges(plan).slice(0, 2).forEach((edge, axis) => {
    const out = outwards(plan.at(edge(0)), plan.at(edge(plan.size[axis])), middle);
    const [x, y] = plan.at(ends[axis]);
    plan.labels.add({
      order: ORDER.call, lines: [{ text: number(position[axis]), colour }],
      spots: [{ x: x + out[0] * LABEL_OFF, y: y + out[1] * LABEL_OFF, align: "center" }],
    });
  });
  const spots = [0.5, 0.25, 0.75, 0.1].flatMap((share) => {
    const [x, y] = plan.at([position[0], position[1], position[2] * share]);
    return [{ x: x + 6, y, align: "left" }, { x: x - 6, y, align: "right" }];
  });
  plan.labels.add({ order: ORDER.estimate, lines: [{ text: `z ${number(position[2])}`, colour }], spots });
}

/** The shadow of an ellipsoid on the floor, by its half axes in metres: see `ellipsoid95`. */
export function fillFloorShadow(plan, [x, y], axes, colour) {
  const { g } = plan;
  const spread = [0, 1].map((i) => [0, 1].map((k) => axes.reduce((sum, axis) => sum + axis[i] * axis[k], 0)));
  const width = Math.sqrt(spread[0][0]);
  if (!(width > 0)) return;
  const slope = spread[0][1] / width; // the columns of a Cholesky factor are conjugate half axes of the shadow
  const rest = Math.sqrt(Math.max(0, spread[1][1] - slope * slope));
  const before = g.globalAlpha;
  traceRing(plan, [x, y, 0], [width, slope, 0], [0, rest, 0]);
  g.globalAlpha = before * 0.16;
  g.fillStyle = colour;
  g.fill();
  g.globalAlpha = before;
}

/** The three sections of an ellipsoid between its half axes; what is behind is fainter. */
export function strokeSections(plan, centre, axes, colour) {
  const { g } = plan;
  const before = g.globalAlpha;
  const lengths = axes.map((axis) => Math.hypot(...axis));
  g.strokeStyle = colour;
  g.lineWidth = 1;
  for (const [i, k] of [[0, 1], [0, 2], [1, 2]]) {
    if (Math.min(lengths[i], lengths[k]) * plan.scale < 2) continue;
    const slopes = [i, k].map((axis) => dot(plan.projection.toward, axes[axis]) / lengths[axis] ** 2);
    const turn = Math.atan2(slopes[1], slopes[0]); // the middle of the half in front
    for (const [from, alpha] of [[turn - Math.PI / 2, 0.75], [turn + Math.PI / 2, 0.22]]) {
      g.globalAlpha = before * alpha;
      plan.trace(ring(centre, axes[i], axes[k], from, Math.PI));
      g.stroke();
    }
  }
  g.globalAlpha = before;
}

function traceRing(plan, centre, a, b) {
  plan.trace(ring(centre, a, b, 0, 2 * Math.PI), true);
}

/** Points around a centre, between two half axes, over an angle. */
function ring(centre, a, b, from, angle) {
  return Array.from({ length: CIRCLE + 1 }, (_, index) => {
    const turn = from + (angle * index) / CIRCLE;
    return centre.map((c, axis) => c + a[axis] * Math.cos(turn) + b[axis] * Math.sin(turn));
  });
}
