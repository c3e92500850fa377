// Layers of a plan that show the room: floor, power map, grid, walls and axes.

import { number } from "./format.js";
import { opacity } from "./colour-map.js";
import { SMALL } from "./plan-style.js";

/** Least distance in pixels between lines of the grid, and between labels of an axis. */
const GRID_GAP = 18;
const LABEL_GAP = 46;

/** A step in metres, 1, 2 or 5 times a power of ten, that is at least `gap` pixels wide. */
function niceStep(pixelsPerMetre, gap) {
  const least = gap / pixelsPerMetre;
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((k) => k * power).find((step) => step >= least * 0.999);
}

/** Place a line one pixel wide on the screen's pixels, so that it is sharp. */
const sharp = (pixels) => Math.round(pixels) + 0.5;

export function drawFloor(plan) {
  plan.g.fillStyle = plan.colours.paper;
  plan.g.fillRect(...plan.room);
}

/** A map of one plane has no height, so it is drawn as high as one cell of the search grid. */
export function drawMap(plan, { images, cellM, now }) {
  const { g } = plan;
  const image = images?.[plan.view];
  const alpha = images ? opacity(now - images.bornMs) : 0;
  if (!image || alpha <= 0) return;
  const { left, right, bottom, top } = image.bounds;
  const [low, high] = [[0, 0, 0], [0, 0, 0]];
  [[left, right], [bottom, top]].forEach(([from, to], index) => {
    const margin = to > from ? 0 : cellM / 2;
    low[plan.axes[index]] = from - margin;
    high[plan.axes[index]] = to + margin;
  });
  g.globalAlpha = alpha;
  g.imageSmoothingEnabled = true;
  g.imageSmoothingQuality = "low";
  g.drawImage(image.canvas, ...plan.box(low, high));
  g.globalAlpha = 1;
}

export function drawGrid(plan) {
  const { g, size, scale } = plan;
  const [i, k] = plan.axes;
  const step = niceStep(scale, GRID_GAP);
  g.strokeStyle = plan.colours.grid;
  g.lineWidth = 1;
  g.beginPath();
  for (let a = step; a < size[i] - 1e-6; a += step) {
    const x = sharp(plan.left + a * scale);
    g.moveTo(x, plan.top);
    g.lineTo(x, plan.bottom);
  }
  for (let b = step; b < size[k] - 1e-6; b += step) {
    const y = sharp(plan.bottom - b * scale);
    g.moveTo(plan.left, y);
    g.lineTo(plan.right, y);
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
  const [calledX, calledY] = plan.called ? plan.at(plan.called.position) : [-Infinity, -Infinity];
  const step = niceStep(scale, LABEL_GAP);
  const digits = step < 1 ? 1 : 0;
  g.font = SMALL;
  g.fillStyle = plan.colours.muted;
  g.strokeStyle = plan.colours.wall;
  g.lineWidth = 1;
  g.beginPath();
  g.textAlign = "center";
  g.textBaseline = "top";
  for (let a = 0; a <= size[i] + 1e-6; a += step) {
    const x = sharp(left + a * scale);
    g.moveTo(x, bottom + 1);
    g.lineTo(x, bottom + 6);
    if (Math.abs(calledX - x) > 24) g.fillText(number(a, digits), x, bottom + 9);
  }
  g.textAlign = "right";
  g.textBaseline = "middle";
  for (let b = 0; b <= size[k] + 1e-6; b += step) {
    const y = sharp(bottom - b * scale);
    g.moveTo(left - 1, y);
    g.lineTo(left - 6, y);
    if (Math.abs(calledY - y) > 13) g.fillText(number(b, digits), left - 9, y);
  }
  g.stroke();
  const [rightName, upName] = plan.axisNames;
  g.textAlign = "center";
  g.textBaseline = "top";
  g.fillText(`${rightName} (m)`, (left + plan.right) / 2, bottom + 24);
  g.textAlign = "right";
  g.textBaseline = "bottom";
  g.fillText(`${upName} (m)`, left - 3, plan.top - 9);
}
