// Draws results on a plan: estimates with their ellipses, directions, tracks and past estimates.

import { number } from "./format.js";
import { direction, ellipse, ellipse95, ellipsoid95, rayEnd } from "./geometry.js";
import { OLD_MS } from "./model.js";
import { ORDER } from "./plan-labels.js";

/** Age, in milliseconds, at which an estimate begins to fade. */
const FRESH_MS = 1200;
/** How long, in milliseconds, a track that has ended takes to fade. */
const ENDED_TRACK_MS = 4000;
/** Slowest speed, in metres per second, that is drawn as an arrow: estimates of a source at rest scatter as much. */
const LEAST_SPEED = 0.15;
/** The arrow of a velocity ends where the source would be after this many seconds. */
const ARROW_S = 0.7;

export function drawEstimate(plan, estimate, scene, highlighted) {
  const { g, colours } = plan;
  const age = scene.now - estimate.bornMs;
  const old = age > OLD_MS && !highlighted;
  const colour = highlighted ? colours.marked : old ? colours.old : colours.estimate;
  g.globalAlpha = highlighted || old ? 1 : Math.max(0.4, 1 - Math.max(0, age - FRESH_MS) / OLD_MS);
  if (estimate.status === "direction-only") drawDirections(plan, estimate, scene, colour, old);
  else if (estimate.position) drawMarker(plan, estimate, colour, old);
  g.globalAlpha = 1;
}

function drawMarker(plan, estimate, colour, old) {
  const { g } = plan;
  const { position, covariance, kind, label, labelBelow } = estimate;
  const [x, y] = plan.at(position);
  if (plan.flat) drawEllipse(plan, x, y, covariance && ellipse95(plan.projection.shadow(covariance)), colour, old);
  else drawEllipsoid(plan, position, covariance, colour, old);
  if (estimate === plan.called) (plan.solid?.drawCallout ?? drawCallout)(plan, position, colour);
  g.beginPath();
  g.arc(x, y, 7.5, 0, 2 * Math.PI);
  plan.halo(6);
  g.strokeStyle = colour;
  g.lineWidth = old ? 1.5 : 2.5;
  g.stroke();
  if (!old) {
    g.beginPath();
    g.arc(x, y, kind === "update" ? 3.4 : 2.2, 0, 2 * Math.PI);
    g.fillStyle = colour;
    g.fill();
  }
  if (!label) return;
  const heights = labelBelow ? [y + 17, y - 16] : [y - 16, y + 17];
  const spots = heights.flatMap((middle) => [
    { x: x + 14, y: middle, align: "left" }, { x: x - 14, y: middle, align: "right" }, { x, y: middle, align: "center" },
  ]);
  plan.labels.add({ order: ORDER.estimate, lines: [{ text: label, colour }], spots });
}

/** An ellipsoid with its sections, its shadow on the floor, and a line down to it. */
function drawEllipsoid(plan, position, covariance, colour, old) {
  const axes = ellipsoid95(covariance, Math.hypot(...plan.size));
  if (axes && !old) plan.solid.fillFloorShadow(plan, position, axes, colour);
  plan.solid.drawStem(plan, position, colour, 0.7, old ? [3, 4] : []);
  if (!axes) return;
  const [x, y] = plan.at(position);
  const spread = [0, 1, 2].map((i) => [0, 1, 2].map((k) => axes.reduce((sum, axis) => sum + axis[i] * axis[k], 0)));
  drawEllipse(plan, x, y, ellipse(plan.projection.shadow(spread), 1), colour, old);
  if (!old) plan.solid.strokeSections(plan, position, axes, colour);
}

function drawEllipse(plan, x, y, shape, colour, old) {
  if (!shape) return;
  const { g } = plan;
  const longest = Math.hypot(...plan.size);
  const [a, b] = [shape.a, shape.b].map((metres) => Math.min(metres, longest) * plan.scale);
  plan.clip(() => {
    g.beginPath();
    g.ellipse(x, y, a, b, -shape.angle, 0, 2 * Math.PI);
    if (!old) {
      const before = g.globalAlpha;
      g.globalAlpha = before * 0.14;
      g.fillStyle = colour;
      g.fill();
      g.globalAlpha = before;
    }
    plan.halo(3.5);
    g.strokeStyle = colour;
    g.lineWidth = 1.5;
    if (old) g.setLineDash([4, 4]);
    g.stroke();
    g.setLineDash([]);
  });
}

/** Thin lines from a marker to the axes, and its coordinates where they end. */
function drawCallout(plan, position, colour) {
  const { g } = plan;
  const [i, k] = plan.axes;
  const [x, y] = plan.at(position);
  const before = g.globalAlpha;
  g.globalAlpha = before * 0.6;
  g.strokeStyle = colour;
  g.lineWidth = 1;
  g.setLineDash([2, 4]);
  g.beginPath();
  g.moveTo(x, y + 11);
  g.lineTo(x, plan.bottom);
  g.moveTo(x - 11, y);
  g.lineTo(plan.left, y);
  g.stroke();
  g.setLineDash([]);
  g.globalAlpha = before;
  plan.labels.tag(number(position[i]), x, plan.bottom + 14, colour, "center");
  plan.labels.tag(number(position[k]), plan.left - 5, y, colour, "right");
}

/** Arrows from the arrays along their estimated directions, to the walls. */
function drawDirections(plan, { rays, label, newest }, { arrays }, colour, old) {
  const { g } = plan;
  for (const { array: name, azimuth, elevation } of rays) {
    const array = arrays.find((each) => each.name === name);
    if (!array || !Number.isFinite(azimuth) || !Number.isFinite(elevation)) continue;
    const end = rayEnd(array.position, direction(azimuth, elevation), plan.size);
    const [x, y] = plan.at(array.position);
    const [u, v] = plan.at(end);
    plan.solid?.drawStem(plan, end, colour, 0.5, [3, 4]);
    const heading = Math.atan2(v - y, u - x);
    g.beginPath();
    g.moveTo(x + 14 * Math.cos(heading), y + 14 * Math.sin(heading));
    g.lineTo(u, v);
    traceArrowhead(g, u, v, heading, 11);
    plan.halo(6);
    g.strokeStyle = colour;
    g.lineWidth = old ? 1.5 : 2.5;
    g.setLineDash([10, 5]);
    g.stroke();
    g.setLineDash([]);
    if (label || (newest && plan.view !== "side" && plan.view !== "front")) {
      const spots = [0.7, 0.5, 0.85].flatMap((share) => [-14, 14].map((off) => (
        { x: x + share * (u - x), y: y + share * (v - y) + off, align: "center" }
      )));
      plan.labels.add({ order: ORDER.estimate, lines: [{ text: label ?? "direction only", colour }], spots });
    }
  }
}

function traceArrowhead(g, x, y, heading, length) {
  for (const turn of [2.65, -2.65]) {
    g.moveTo(x, y);
    g.lineTo(x + length * Math.cos(heading + turn), y + length * Math.sin(heading + turn));
  }
}

export function drawTracks(plan, { tracks, now }) {
  const { g } = plan;
  for (const { points, velocity, ended, updatedMs } of tracks) {
    const alpha = Math.max(0, 1 - (now - updatedMs) / (ended ? ENDED_TRACK_MS : OLD_MS));
    if (alpha <= 0 || points.length === 0) continue;
    g.globalAlpha = 0.55 * alpha;
    g.strokeStyle = plan.colours.estimate;
    g.lineWidth = 1.5;
    g.beginPath();
    for (const point of points) g.lineTo(...plan.at(point));
    g.stroke();
    if (velocity && !ended) drawVelocity(plan, points[points.length - 1], velocity);
    g.globalAlpha = 1;
  }
}

function drawVelocity(plan, position, velocity) {
  const { g } = plan;
  const [x, y] = plan.at(position);
  const [u, v] = plan.at(position.map((c, axis) => c + velocity[axis] * ARROW_S));
  if (Math.hypot(u - x, v - y) < LEAST_SPEED * ARROW_S * plan.scale) return;
  g.beginPath();
  g.moveTo(x, y);
  g.lineTo(u, v);
  traceArrowhead(g, u, v, Math.atan2(v - y, u - x), 7);
  g.stroke();
}

/** Past estimates as dots that fade with age and rank; old ones are hollow. */
export function drawTrail(plan, { trail, now }) {
  const { g, colours } = plan;
  trail.forEach(({ position, kind, bornMs }, index) => {
    const age = now - bornMs;
    const rank = (index + 1) / trail.length;
    const old = age > OLD_MS;
    g.globalAlpha = old ? 0.25 + 0.4 * rank : (0.25 + 0.6 * rank) * Math.max(0.3, 1 - age / OLD_MS);
    g.beginPath();
    g.arc(...plan.at(position), kind === "event" ? 4 : 2.5, 0, 2 * Math.PI);
    if (old) {
      g.strokeStyle = colours.old;
      g.lineWidth = 1.2;
      g.stroke();
    } else {
      plan.halo(2);
      g.fillStyle = colours.estimate;
      g.fill();
    }
    g.globalAlpha = 1;
  });
}
