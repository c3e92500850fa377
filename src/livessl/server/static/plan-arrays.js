// Draws the arrays on a plan: microphones, names, states, and which ones receive sound.

import { together } from "./labels.js";
import { ORDER } from "./plan-labels.js";
import { SMALL } from "./plan-style.js";

/** Least radius of an array's outline, and its distance from the outermost microphone, in pixels. */
const LEAST_RADIUS = 11;
const OUTLINE_GAP = 6;

/** Arrays nearer to each other than this, in pixels, share one label: they cannot be told apart. */
const JOIN = 9;
/** Most names in a line of a shared label. */
const NAMES_A_LINE = 3;
/** Reach of an array, in pixels, from which on its microphones are joined by lines, and numbered. */
const FRAME_REACH = 26;
const NUMBER_REACH = 44;

/** Draw the arrays, the farthest first, and name them: those that coincide in this view by one label with all names. */
export function drawArrays(plan, arrays) {
  const { projection } = plan;
  const drawn = [...arrays].sort((a, b) => projection.depth(a.position) - projection.depth(b.position));
  const radii = new Map(drawn.map((array) => [array.name, drawArray(plan, array)]));
  const points = arrays.map(({ position }) => plan.at(position));
  arrays.forEach(({ name }, index) => plan.labels.keepOff(points[index], radii.get(name)));
  for (const set of together(points, JOIN)) {
    const members = set.map((index) => arrays[index]);
    plan.labels.add({
      order: ORDER.array,
      lines: labelLines(members, plan.colours),
      anchor: points[set[0]],
      gap: Math.max(...members.map(({ name }) => radii.get(name))) + 4,
      far: set.length > 1,
    });
  }
}

/** The names of the arrays in each state, some in a line; the last line of each state but "healthy" says it. */
function labelLines(arrays, colours) {
  return [...new Set(arrays.map(({ state }) => state))].flatMap((state) => {
    const names = arrays.filter((array) => array.state === state).map(({ name }) => name);
    const healthy = state === "healthy";
    const colour = healthy ? colours.text : colours.states[state] ?? colours.muted;
    const rows = Array.from({ length: Math.ceil(names.length / NAMES_A_LINE) }, (_, row) => (
      names.slice(row * NAMES_A_LINE, (row + 1) * NAMES_A_LINE).join(", ")
    ));
    return rows.map((text, row) => {
      const end = row < rows.length - 1 ? "," : healthy ? "" : ` · ${state}`;
      return { text: text + end, colour };
    });
  });
}

/** Draw an array, and return the radius of its outline in pixels. */
function drawArray(plan, { position, microphones, state, active }) {
  const { g, colours } = plan;
  const colour = colours.states[state] ?? colours.muted;
  const [x, y] = plan.at(position);
  const points = microphones.map((microphone) => plan.at(microphone));
  const reach = Math.max(0, ...points.map(([u, v]) => Math.hypot(u - x, v - y)));
  const radius = Math.max(LEAST_RADIUS, reach + OUTLINE_GAP);
  plan.solid?.drawStem(plan, position, colour, 0.5);
  if (active) drawGlow(g, x, y, radius, colour);
  drawOutline(plan, x, y, radius, colour, state, active);
  const ink = state === "lost" ? colours.muted : colour;
  if (!plan.flat && reach > FRAME_REACH) drawFrame(plan, microphones, ink);
  g.fillStyle = ink;
  points.forEach(([u, v], index) => {
    g.beginPath();
    g.arc(u, v, 2.1, 0, 2 * Math.PI);
    g.fill();
    if (!plan.flat && reach > NUMBER_REACH) {
      const lines = [{ text: String(index + 1), colour: ink }];
      plan.labels.add({ order: ORDER.microphone, font: SMALL, lines, anchor: [u, v], gap: 4 });
    }
  });
  return radius;
}

/** Lines between the microphones of an array, which show its shape. */
function drawFrame(plan, microphones, colour) {
  const { g } = plan;
  g.globalAlpha = 0.35;
  g.strokeStyle = colour;
  g.lineWidth = 1;
  microphones.forEach((from, index) => {
    for (const to of microphones.slice(index + 1)) {
      plan.trace([from, to]);
      g.stroke();
    }
  });
  g.globalAlpha = 1;
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
