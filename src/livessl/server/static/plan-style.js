// The plans' fonts, and their colours as base.css gives them for light and dark, so that canvases and page share them.

const NAMES = ["paper", "shade", "panel", "grid", "wall", "zone", "text", "muted", "estimate", "marked", "old", "halo"];
const FACE = '"Segoe UI", Roboto, "Noto Sans", "Helvetica Neue", "Liberation Sans", Arial, sans-serif';
export const LABEL = `600 12px ${FACE}`;
export const SMALL = `11px ${FACE}`;

/** Each array state's variable of the style sheet. */
const STATE_NAMES = {
  healthy: "ok", degraded: "warn", quiet: "warn", lost: "bad", disabled: "muted", starting: "muted", unknown: "muted",
};

/** Colours by name, and `states`: colours by array state. */
export function readColours() {
  const style = getComputedStyle(document.documentElement);
  const read = (name) => style.getPropertyValue(`--${name}`).trim();
  const states = Object.entries(STATE_NAMES).map(([state, name]) => [state, read(name)]);
  return { ...Object.fromEntries(NAMES.map((name) => [name, read(name)])), states: Object.fromEntries(states) };
}
