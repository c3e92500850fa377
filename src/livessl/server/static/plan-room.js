// Draws the room on a plan: its faces, power maps and grid, and the walls and axes of the fixed views.

import { number } from "./format.js";
import { opacity } from "./colour-map.js";
import { ORDER } from "./plan-labels.js";
import { SMALL } from "./plan-style.js";
import { onFace } from "./projection.js";

/** Least distance in pixels between lines of the grid, and between labels of an axis. */
const GRID_GAP = 18;
export const LABEL_GAP = 46;

/** A step in metres, 1, 2 or 5 times a power of ten, that is at least `gap` pixels wide. */
export function niceStep(pixelsPerMetre, gap) {
  const least = gap / pixelsPerMetre;
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((k) => k * power).find((step) => step >= least * 0.999);
}

/** Pixels per metre along each axis of the room, which a turned view shortens. */
export function axisScales({ projection: { right, up, scale } }) {
  return right.map((c, axis) => Math.hypot(c, up[axis]) * scale);
}

/** Place a line one pixel wide on the screen's pixels, so that it is sharp. */
const sharp = (pixels) => Math.round(pixels) + 0.5;

/** The floor of a turned view has the colour of paper, and its walls are a little darker. */
export function drawFaces(plan) {
  for (const face of plan.projection.faces(plan.size)) {
    const [width, height] = face.along.map((axis) => plan.size[axis]);
    plan.trace([[0, 0], [width, 0], [width, height], [0, height]].map(([u, v]) => onFace(face, u, v)), true);
    plan.g.fillStyle = plan.flat || face.axis === 2 ? plan.colours.paper : plan.colours.shade;
    plan.g.fill();
  }
}

/** Each face shows the map of its own view. A map of one plane is drawn as high as one cell of the search grid. */
export function drawMap(plan, { images, cellM, now }) {
  const alpha = images ? opacity(now - images.bornMs) : 0;
  if (alpha <= 0) return;
  plan.g.globalAlpha = alpha;
  for (const face of plan.projection.faces(plan.size)) {
    const image = images[face.view];
    if (!image) continue;
    const { left, right, bottom, top } = image.bounds;
    const [u, v] = [right > left ? 0 : cellM / 2, top > bottom ? 0 : cellM / 2];
    const at = (across, up) => onFace(face, across, up);
    plan.picture(image.canvas, at(left - u, bottom - v), at(right + u, bottom - v), at(left - u, top + v));
  }
  plan.g.globalAlpha = 1;
}

export function drawGrid(plan) {
  const { g, size } = plan;
  const place = ([x, y]) => (plan.flat ? [sharp(x), sharp(y)] : [x, y]);
  const scales = axisScales(plan);
  g.strokeStyle = plan.colours.grid;
  g.lineWidth = 1;
  g.beginPath();
  for (const face of plan.projection.faces(size)) {
    face.along.forEach((axis, index) => {
      const end = size[face.along[1 - index]];
      const step = niceStep(plan.flat ? scales[axis] : Math.min(...face.along.map((each) => scales[each])), GRID_GAP);
      for (let a = step; a < size[axis] - 1e-6; a += step) {
        const at = (b) => place(plan.at(index === 0 ? onFace(face, a, b) : onFace(face, b, a)));
        g.moveTo(...at(0));
        g.lineTo(...at(end));
      }
    });
  }
  g.stroke();
}

export function drawWalls(plan) {
  const [x, y, width, height] = plan.room;
  plan.g.strokeStyle = plan.colours.wall;
  plan.g.lineWidth = 2;
  plan.g.strokeRect(x - 1, y - 1, width + 2, height + 2);
}

/** Ticks and labels in metres; a label gives way to the coordinate of an estimate that is marked there. */
export function drawAxes(plan) {
  const { g, size, scale, left, bottom } = plan;
  const [i, k] = plan.axes;
  const colour = plan.colours.muted;
  const step = niceStep(scale, LABEL_GAP);
  const digits = step < 1 ? 1 : 0;
  const label = (text, x, y, align) => plan.labels.add({
    order: ORDER.axis, font: SMALL, lines: [{ text, colour }], spots: [{ x, y, align }],
  });
  g.strokeStyle = plan.colours.wall;
  g.lineWidth = 1;
  g.beginPath();
  for (let a = 0; a <= size[i] + 1e-6; a += step) {
    const x = sharp(left + a * scale);
    g.moveTo(x, bottom + 1);
    g.lineTo(x, bottom + 6);
    label(number(a, digits), x, bottom + 16, "center");
  }
  for (let b = 0; b <= size[k] + 1e-6; b += step) {
    const y = sharp(bottom - b * scale);
    g.moveTo(left - 1, y);
    g.lineTo(left - 6, y);
    label(number(b, digits), left - 9, y, "right");
  }
  g.stroke();
  const [rightName, upName] = plan.axisNames;
  label(`${rightName} (m)`, (left + plan.right) / 2, bottom + 32, "center");
  label(`${upName} (m)`, left - 3, plan.top - 18, "right");
}
