// One view of the room, drawn to scale on a canvas: what is known, and how old it is; it decides nothing.

import { direction, ellipse95, rayEnd } from "./geometry.js";
import { number } from "./format.js";
import { visibility } from "./heat.js";

/** Older than this, an estimate is a hollow grey ghost. */
export const OLD_MS = 10000;
const FRESH_MS = 1200;
const MARGIN = { left: 44, right: 18, top: 26, bottom: 40 };
const LABEL = '600 12px "Segoe UI", Roboto, "Noto Sans", "Helvetica Neue", "Liberation Sans", Arial, sans-serif';
const SMALL = '11px "Segoe UI", Roboto, "Noto Sans", "Helvetica Neue", "Liberation Sans", Arial, sans-serif';

/** The two views: which axis runs right, which up, and which map lies behind. */
export const VIEWS = {
  floor: { axes: [0, 1], names: ["x", "y"] },
  side: { axes: [1, 2], names: ["y", "z"] },
};

/** The step of the grid, 1, 2 or 5 times a power of ten metres, at least `gap` pixels wide. */
function niceStep(pixelsPerMetre, gap) {
  const least = gap / pixelsPerMetre;
  const power = 10 ** Math.floor(Math.log10(least));
  return [1, 2, 5, 10].map((k) => k * power).find((step) => step >= least * 0.999);
}

export class Plan {
  constructor(canvas, view) {
    this.canvas = canvas;
    this.view = VIEWS[view];
    this.name = view;
    this.scale = 1;
  }

  /** Pixels a metre at which the whole room fits. */
  fit(size) {
    const [i, k] = this.view.axes;
    const { clientWidth, clientHeight } = this.canvas;
    return Math.max(1, Math.min(
      (clientWidth - MARGIN.left - MARGIN.right) / size[i],
      (clientHeight - MARGIN.top - MARGIN.bottom) / size[k],
    ));
  }

  /** Settle the scale and match the canvas to the screen's pixels. */
  layout(size, scale) {
    const { clientWidth: width, clientHeight: height } = this.canvas;
    const ratio = window.devicePixelRatio || 1;
    for (const [name, pixels] of [["width", width], ["height", height]]) {
      if (this.canvas[name] !== Math.round(pixels * ratio)) this.canvas[name] = Math.round(pixels * ratio);
    }
    const [i, k] = this.view.axes;
    const inner = [width - MARGIN.left - MARGIN.right, height - MARGIN.top - MARGIN.bottom];
    this.ratio = ratio;
    this.scale = scale;
    this.left = MARGIN.left + (inner[0] - size[i] * scale) / 2;
    this.bottom = MARGIN.top + inner[1] - (inner[1] - size[k] * scale) / 2;
    this.size = size;
  }

  /** Pixels of a position in metres. */
  at(position) {
    const [i, k] = this.view.axes;
    return [this.left + position[i] * this.scale, this.bottom - position[k] * this.scale];
  }

  /** Metres under a pixel, or null outside the room. */
  under(px, py) {
    const [i, k] = this.view.axes;
    const a = (px - this.left) / this.scale;
    const b = (this.bottom - py) / this.scale;
    return this.size && a >= 0 && b >= 0 && a <= this.size[i] && b <= this.size[k] ? [a, b] : null;
  }

  /** Draw everything: see app.js for what a scene holds. */
  draw(scene, colours) {
    const g = this.canvas.getContext("2d");
    this.g = g;
    this.c = colours;
    g.setTransform(this.ratio, 0, 0, this.ratio, 0, 0);
    g.clearRect(0, 0, this.canvas.clientWidth, this.canvas.clientHeight);
    g.lineJoin = "round";
    this.#room();
    this.#clip(() => {
      this.#heat(scene);
      this.#grid();
      this.#zones(scene.zones);
    });
    this.#outline();
    const marked = scene.highlight;
    const called = marked ?? scene.estimates.find(({ newest, bornMs }) => newest && scene.now - bornMs <= OLD_MS);
    this.called = called?.position && called.status !== "direction-only" ? called : null;
    this.#axes();
    this.#clip(() => {
      this.#tracks(scene.tracks, scene.now);
      this.#trail(scene);
    });
    for (const array of scene.arrays) this.#array(array);
    for (const estimate of scene.estimates) {
      if (!marked || marked.id !== estimate.id) this.#estimate(estimate, scene, false);
    }
    if (marked) this.#estimate(marked, scene, true);
  }

  #clip(paint) {
    const { g } = this;
    g.save();
    g.beginPath();
    g.rect(...this.#box([0, 0, 0], this.size));
    g.clip();
    paint();
    g.restore();
  }

  /** Left, top, width, height in pixels of the box between two corners. */
  #box(low, high) {
    const [x0, y0] = this.at(low);
    const [x1, y1] = this.at(high);
    return [x0, y1, x1 - x0, y0 - y1];
  }

  #room() {
    this.g.fillStyle = this.c.paper;
    this.g.fillRect(...this.#box([0, 0, 0], this.size));
  }

  /** A map of a plane is drawn as thick as a cell of the grid that is searched. */
  #heat({ map, thickness, now }) {
    const image = map?.[this.name];
    const alpha = map ? visibility(now - map.bornMs) : 0;
    if (!image || alpha <= 0) return;
    const { left, right, bottom, top } = image.bounds;
    const [low, high] = [[0, 0, 0], [0, 0, 0]];
    [[left, right], [bottom, top]].forEach(([from, to], index) => {
      const flat = to > from ? 0 : thickness / 2;
      low[this.view.axes[index]] = from - flat;
      high[this.view.axes[index]] = to + flat;
    });
    this.g.globalAlpha = alpha;
    this.g.imageSmoothingEnabled = true;
    this.g.imageSmoothingQuality = "low";
    this.g.drawImage(image.canvas, ...this.#box(low, high));
    this.g.globalAlpha = 1;
  }

  #grid() {
    const { g } = this;
    const [i, k] = this.view.axes;
    const [left, top, width, height] = this.#box([0, 0, 0], this.size);
    const step = niceStep(this.scale, 18);
    g.strokeStyle = this.c.grid;
    g.lineWidth = 1;
    g.beginPath();
    for (let a = step; a < this.size[i] - 1e-6; a += step) {
      const x = Math.round(left + a * this.scale) + 0.5;
      g.moveTo(x, top);
      g.lineTo(x, top + height);
    }
    for (let b = step; b < this.size[k] - 1e-6; b += step) {
      const y = Math.round(this.bottom - b * this.scale) + 0.5;
      g.moveTo(left, y);
      g.lineTo(left + width, y);
    }
    g.stroke();
  }

  #zones(zones) {
    const { g } = this;
    g.font = SMALL;
    g.textAlign = "left";
    g.textBaseline = "top";
    for (const [name, low, high] of zones) {
      const [x, y, width, height] = this.#box(low, high);
      g.fillStyle = this.c.zone;
      g.globalAlpha = 0.07;
      g.fillRect(x, y, width, height);
      g.globalAlpha = 0.75;
      g.strokeStyle = this.c.zone;
      g.lineWidth = 1;
      g.setLineDash([5, 4]);
      g.strokeRect(x + 0.5, y + 0.5, width - 1, height - 1);
      g.setLineDash([]);
      g.globalAlpha = 1;
      this.#text(name, x + 6, y + 6, this.c.zone);
    }
  }

  #outline() {
    const [x, y, width, height] = this.#box([0, 0, 0], this.size);
    this.g.strokeStyle = this.c.wall;
    this.g.lineWidth = 2;
    this.g.strokeRect(x - 1, y - 1, width + 2, height + 2);
  }

  #axes() {
    const { g } = this;
    const [i, k] = this.view.axes;
    const [x0, y0] = [this.left, this.bottom];
    const step = niceStep(this.scale, 46);
    g.font = SMALL;
    g.fillStyle = this.c.muted;
    g.strokeStyle = this.c.wall;
    g.lineWidth = 1;
    g.beginPath();
    g.textAlign = "center";
    g.textBaseline = "top";
    for (let a = 0; a <= this.size[i] + 1e-6; a += step) {
      const x = Math.round(x0 + a * this.scale) + 0.5;
      g.moveTo(x, y0 + 1);
      g.lineTo(x, y0 + 6);
      if (!this.called || Math.abs(this.at(this.called.position)[0] - x) > 24) g.fillText(number(a, step < 1 ? 1 : 0), x, y0 + 9);
    }
    g.textAlign = "right";
    g.textBaseline = "middle";
    for (let b = 0; b <= this.size[k] + 1e-6; b += step) {
      const y = Math.round(y0 - b * this.scale) + 0.5;
      g.moveTo(x0 - 1, y);
      g.lineTo(x0 - 6, y);
      if (!this.called || Math.abs(this.at(this.called.position)[1] - y) > 13) g.fillText(number(b, step < 1 ? 1 : 0), x0 - 9, y);
    }
    g.stroke();
    const [right, up] = this.view.names;
    g.textAlign = "center";
    g.textBaseline = "top";
    g.fillText(`${right} (m)`, x0 + (this.size[i] * this.scale) / 2, y0 + 24);
    g.textAlign = "right";
    g.textBaseline = "bottom";
    g.fillText(`${up} (m)`, x0 - 3, y0 - this.size[k] * this.scale - 9);
  }

  #tracks(tracks, now) {
    const { g } = this;
    for (const { points, velocity, ended, heardMs } of tracks) {
      const alpha = Math.max(0, 1 - (now - heardMs) / (ended ? 4000 : OLD_MS));
      if (alpha <= 0 || points.length === 0) continue;
      g.globalAlpha = 0.55 * alpha;
      g.strokeStyle = this.c.estimate;
      g.lineWidth = 1.5;
      g.beginPath();
      for (const point of points) g.lineTo(...this.at(point));
      g.stroke();
      const last = points[points.length - 1];
      const speed = velocity ? Math.hypot(...this.view.axes.map((axis) => velocity[axis])) : 0;
      if (!ended && speed > 0.15) {
        const [x, y] = this.at(last);
        const [u, v] = this.at(last.map((c, axis) => c + velocity[axis] * 0.7));
        const heading = Math.atan2(v - y, u - x);
        g.beginPath();
        g.moveTo(x, y);
        g.lineTo(u, v);
        for (const turn of [2.6, -2.6]) {
          g.moveTo(u, v);
          g.lineTo(u + 7 * Math.cos(heading + turn), v + 7 * Math.sin(heading + turn));
        }
        g.stroke();
      }
      g.globalAlpha = 1;
    }
  }

  #trail({ trail, now }) {
    const { g } = this;
    trail.forEach((item, index) => {
      const age = now - item.bornMs;
      const rank = (index + 1) / trail.length;
      const [x, y] = this.at(item.position);
      const old = age > OLD_MS;
      g.globalAlpha = old ? 0.25 + 0.4 * rank : (0.25 + 0.6 * rank) * Math.max(0.3, 1 - age / OLD_MS);
      g.beginPath();
      g.arc(x, y, item.kind === "event" ? 4 : 2.5, 0, 2 * Math.PI);
      if (old) {
        g.strokeStyle = this.c.old;
        g.lineWidth = 1.2;
        g.stroke();
      } else {
        this.#halo(2);
        g.fillStyle = this.c.estimate;
        g.fill();
      }
      g.globalAlpha = 1;
    });
  }

  #array({ name, position, microphones, state, active }) {
    const { g } = this;
    const colour = this.c[state] ?? this.c.muted;
    const [x, y] = this.at(position);
    const reach = Math.max(...microphones.map((m) => {
      const [u, v] = this.at(m);
      return Math.hypot(u - x, v - y);
    }), 0);
    const radius = Math.max(11, reach + 6);
    if (active) {
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
    g.beginPath();
    this.#shape(x, y, radius, state);
    g.fillStyle = this.c.paper;
    g.globalAlpha = 0.72;
    g.fill();
    g.globalAlpha = 1;
    g.strokeStyle = colour;
    g.lineWidth = active ? 2 : 1.5;
    if (state === "starting" || state === "unknown") g.setLineDash([3, 3]);
    g.stroke();
    g.setLineDash([]);
    if (state === "lost") {
      const d = radius * 0.55;
      g.beginPath();
      g.moveTo(x - d, y - d);
      g.lineTo(x + d, y + d);
      g.moveTo(x - d, y + d);
      g.lineTo(x + d, y - d);
      g.stroke();
    }
    g.fillStyle = state === "lost" ? this.c.muted : colour;
    for (const microphone of microphones) {
      g.beginPath();
      g.arc(...this.at(microphone), 2.1, 0, 2 * Math.PI);
      g.fill();
    }
    g.font = LABEL;
    g.textAlign = "center";
    g.textBaseline = "top";
    const word = state === "healthy" ? name : `${name} · ${state}`;
    const half = g.measureText(word).width / 2 + 4;
    const [left, , width] = this.#box([0, 0, 0], this.size);
    this.#text(word, Math.min(Math.max(x, left + half), left + width - half), y + radius + 5, state === "healthy" ? this.c.text : colour);
  }

  /** The same shapes as in the arrays panel: circle, triangle, square. */
  #shape(x, y, radius, state) {
    const { g } = this;
    if (state === "degraded" || state === "quiet") {
      const r = radius * 1.3;
      g.moveTo(x, y - r);
      g.lineTo(x + r * 0.95, y + r * 0.62);
      g.lineTo(x - r * 0.95, y + r * 0.62);
      g.closePath();
    } else if (state === "lost") {
      g.rect(x - radius, y - radius, 2 * radius, 2 * radius);
    } else {
      g.arc(x, y, radius, 0, 2 * Math.PI);
    }
  }

  #estimate(estimate, scene, marked) {
    const age = scene.now - estimate.bornMs;
    const old = age > OLD_MS && !marked;
    const colour = marked ? this.c.marked : old ? this.c.old : this.c.estimate;
    this.g.globalAlpha = marked || old ? 1 : Math.max(0.4, 1 - Math.max(0, age - FRESH_MS) / OLD_MS);
    if (estimate.status === "direction-only") this.#rays(estimate, scene, colour, old);
    else if (estimate.position) this.#marker(estimate, colour, old);
    this.g.globalAlpha = 1;
  }

  #marker(estimate, colour, old) {
    const { g } = this;
    const { position, covariance, kind, label } = estimate;
    const [x, y] = this.at(position);
    const shape = ellipse95(covariance, this.view.axes);
    if (shape) {
      const limit = Math.hypot(...this.size);
      this.#clip(() => {
        g.beginPath();
        g.ellipse(x, y, Math.min(shape.a, limit) * this.scale, Math.min(shape.b, limit) * this.scale, -shape.angle, 0, 2 * Math.PI);
        if (!old) {
          const before = g.globalAlpha;
          g.globalAlpha = before * 0.14;
          g.fillStyle = colour;
          g.fill();
          g.globalAlpha = before;
        }
        this.#halo(3.5);
        g.strokeStyle = colour;
        g.lineWidth = 1.5;
        if (old) g.setLineDash([4, 4]);
        g.stroke();
        g.setLineDash([]);
      });
    }
    if (estimate === this.called) this.#callout(position, x, y, colour);
    g.beginPath();
    g.arc(x, y, 7.5, 0, 2 * Math.PI);
    this.#halo(6);
    g.strokeStyle = colour;
    g.lineWidth = old ? 1.5 : 2.5;
    g.stroke();
    if (!old) {
      g.beginPath();
      g.arc(x, y, kind === "update" ? 3.4 : 2.2, 0, 2 * Math.PI);
      g.fillStyle = colour;
      g.fill();
    }
    if (label) {
      g.font = LABEL;
      g.textAlign = "left";
      g.textBaseline = "bottom";
      const width = g.measureText(label).width;
      const right = this.left + this.size[this.view.axes[0]] * this.scale;
      this.#text(label, x + 14 + width > right ? x - 14 - width : x + 14, y - 8, colour);
    }
  }

  /** Thin lines from the marker to the axes, and the values where they meet them. */
  #callout(position, x, y, colour) {
    const { g } = this;
    const [i, k] = this.view.axes;
    const before = g.globalAlpha;
    g.globalAlpha = before * 0.6;
    g.strokeStyle = colour;
    g.lineWidth = 1;
    g.setLineDash([2, 4]);
    g.beginPath();
    g.moveTo(x, y + 11);
    g.lineTo(x, this.bottom);
    g.moveTo(x - 11, y);
    g.lineTo(this.left, y);
    g.stroke();
    g.setLineDash([]);
    g.globalAlpha = before;
    g.font = LABEL;
    this.#tag(number(position[i]), x, this.bottom + 14, colour, "center");
    this.#tag(number(position[k]), this.left - 5, y, colour, "right");
  }

  #tag(text, x, y, colour, align) {
    const { g } = this;
    const width = g.measureText(text).width + 8;
    const left = align === "right" ? x - width : x - width / 2;
    g.fillStyle = this.c.panel;
    g.fillRect(left - 1, y - 9, width + 2, 18);
    g.fillStyle = colour;
    g.textAlign = "center";
    g.textBaseline = "middle";
    g.fillText(text, left + width / 2, y + 0.5);
  }

  #rays({ rays, label, newest }, { arrays }, colour, old) {
    const { g } = this;
    for (const { array: name, azimuth, elevation } of rays) {
      const array = arrays.find((each) => each.name === name);
      if (!array || !Number.isFinite(azimuth) || !Number.isFinite(elevation)) continue;
      const [x, y] = this.at(array.position);
      const [u, v] = this.at(rayEnd(array.position, direction(azimuth, elevation), this.size));
      const heading = Math.atan2(v - y, u - x);
      g.beginPath();
      g.moveTo(x + 14 * Math.cos(heading), y + 14 * Math.sin(heading));
      g.lineTo(u, v);
      for (const turn of [2.7, -2.7]) {
        g.moveTo(u, v);
        g.lineTo(u + 11 * Math.cos(heading + turn), v + 11 * Math.sin(heading + turn));
      }
      this.#halo(6);
      g.strokeStyle = colour;
      g.lineWidth = 2.5;
      if (old) g.lineWidth = 1.5;
      g.setLineDash([10, 5]);
      g.stroke();
      g.setLineDash([]);
      if ((newest && this.name === "floor") || label) {
        g.font = LABEL;
        g.textAlign = "center";
        g.textBaseline = "middle";
        this.#text(label ?? "direction only", x + 0.7 * (u - x), y + 0.7 * (v - y) - 14, colour);
      }
    }
  }

  #halo(width) {
    this.g.strokeStyle = this.c.halo;
    this.g.lineWidth = width;
    this.g.stroke();
  }

  #text(text, x, y, colour) {
    const { g } = this;
    g.lineWidth = 3.5;
    g.strokeStyle = this.c.halo;
    g.strokeText(text, x, y);
    g.fillStyle = colour;
    g.fillText(text, x, y);
  }
}
