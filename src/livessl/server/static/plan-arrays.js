// The layer of a plan that shows an array: its microphones, its name, its state, and whether it receives sound.

import { LABEL } from "./plan-style.js";

/** Least radius of an array's outline, and its distance from the outermost microphone, in pixels. */
const LEAST_RADIUS = 11;
const OUTLINE_GAP = 6;

export function drawArray(plan, { name, position, microphones, state, active }) {
  const { g, colours } = plan;
  const colour = colours.states[state] ?? colours.muted;
  const [x, y] = plan.at(position);
  const reach = Math.max(0, ...microphones.map((microphone) => {
    const [u, v] = plan.at(microphone);
    return Math.hypot(u - x, v - y);
  }));
  const radius = Math.max(LEAST_RADIUS, reach + OUTLINE_GAP);
  if (active) drawGlow(g, x, y, radius, colour);
  drawOutline(plan, x, y, radius, colour, state, active);
  g.fillStyle = state === "lost" ? colours.muted : colour;
  for (const microphone of microphones) {
    g.beginPath();
    g.arc(...plan.at(microphone), 2.1, 0, 2 * Math.PI);
    g.fill();
  }
  const healthy = state === "healthy";
  const label = healthy ? name : `${name} · ${state}`;
  g.font = LABEL;
  g.textAlign = "center";
  g.textBaseline = "top";
  const half = g.measureText(label).width / 2 + 4;
  const middle = Math.min(Math.max(x, plan.left + half), plan.right - half);
  plan.text(label, middle, y + radius + 5, healthy ? colours.text : colour);
}

function drawGlow(g, x, y, radius, colour) {
  const glow = g.createRadialGradient(x, y, radius * 0.6, x, y, radius * 2.4);
  glow.addColorStop(0, colour);
  glow.addColorStop(1, `${colour}00`); // the same colour: "transparent" would pass through grey
  g.globalAlpha = 0.38;
  g.fillStyle = glow;
  g.beginPath();
  g.arc(x, y, radius * 2.4, 0, 2 * Math.PI);
  g.fill();
  g.globalAlpha = 1;
}

function drawOutline({ g, colours }, x, y, radius, colour, state, active) {
  g.beginPath();
  traceShape(g, x, y, radius, state);
  g.fillStyle = colours.paper;
  g.globalAlpha = 0.72;
  g.fill();
  g.globalAlpha = 1;
  g.strokeStyle = colour;
  g.lineWidth = active ? 2 : 1.5;
  if (state === "starting" || state === "unknown") g.setLineDash([3, 3]);
  g.stroke();
  g.setLineDash([]);
  if (state !== "lost") return;
  const d = radius * 0.55;
  g.beginPath();
  g.moveTo(x - d, y - d);
  g.lineTo(x + d, y + d);
  g.moveTo(x - d, y + d);
  g.lineTo(x + d, y - d);
  g.stroke();
}

/** A shape for each state, the same as in the arrays panel: circle, triangle or square. */
function traceShape(g, x, y, radius, state) {
  if (state === "degraded" || state === "quiet") {
    const r = radius * 1.3;
    g.moveTo(x, y - r);
    g.lineTo(x + r * 0.95, y + r * 0.62);
    g.lineTo(x - r * 0.95, y + r * 0.62);
    g.closePath();
  } else if (state === "lost") g.rect(x - radius, y - radius, 2 * radius, 2 * radius);
  else g.arc(x, y, radius, 0, 2 * Math.PI);
}
