// The power maps behind the plans: which one is chosen, how old it is, and its images in the theme's colours.

import { colourScale, opacity, paintMap, paintScale } from "./colour-map.js";
import { find, write } from "./dom.js";
import { ago } from "./format.js";
import { MapFeed } from "./map-feed.js";
import { LATE_MS } from "./model.js";

/** Age, in milliseconds, below which a map is labelled as current. */
const CURRENT_MS = 1500;

export class MapPanel {
  /** `onChange()` is called when there are other images to draw on the `plans`. */
  constructor(base, plans, onChange) {
    this.plans = plans;
    this.onChange = onChange;
    this.scale = null;
    this.maps = null;
    /** Each view as { canvas, bounds }, and bornMs; or null without a map. */
    this.images = null;
    this.select = find("map-choice");
    this.label = find("map-age");
    this.feed = new MapFeed(base, (maps) => this.#show(maps));
    this.select.addEventListener("change", () => this.#choose(this.select.value));
  }

  watch() {
    this.feed.watch();
  }

  /** Receive the maps of these views, "floor", "side" and "front". */
  need(views) {
    this.feed.need(views);
  }

  clear() {
    this.#show(null);
  }

  setTheme(theme) {
    this.scale = colourScale(theme);
    paintScale(find("ramp"), this.scale);
    this.#show(this.maps);
  }

  /** Offer the fused map and each array's own for selection. */
  offer(names) {
    const values = ["fused", ...names];
    if (values.join("\n") === [...this.select.options].map(({ value }) => value).join("\n")) return;
    const chosen = values.includes(this.select.value) ? this.select.value : "fused";
    const label = (name) => (name === "fused" ? "all arrays" : `${name} only`);
    this.select.replaceChildren(...values.map((name) => new Option(label(name), name)));
    this.select.value = chosen;
    if (this.feed.choice !== chosen) this.#choose(chosen);
  }

  isFading(now) {
    return this.images !== null && opacity(now - this.images.bornMs) > 0;
  }

  tick(now) {
    const age = this.maps ? now - this.maps.bornMs : null;
    this.label.dataset.tone = age !== null && age > LATE_MS ? "old" : "fine";
    write(this.label, age === null ? "no map yet" : age < CURRENT_MS ? "updated now" : `updated ${ago(age)}`);
    for (const { canvas } of this.plans) {
      canvas.dataset.mapTime = this.maps?.time ?? "";
      canvas.dataset.mapAge = age === null ? "" : (age / 1000).toFixed(2);
      canvas.dataset.map = this.feed.choice;
    }
  }

  #choose(name) {
    this.clear();
    this.feed.choose(name);
  }

  #show(maps) {
    const painted = ([view, map]) => [view, { canvas: paintMap(map, this.scale), bounds: map.bounds }];
    this.maps = maps;
    this.images = maps && { ...Object.fromEntries(Object.entries(maps.views).map(painted)), bornMs: maps.bornMs };
    this.onChange();
  }
}
