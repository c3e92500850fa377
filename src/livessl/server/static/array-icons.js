// Icons of the array states: each state has its own shape, besides its colour and word; the plans draw the same shapes.

const SVG = "http://www.w3.org/2000/svg";
/** By state: the outline's element and attributes, and the path of the sign inside. */
const ICONS = {
  healthy: ["circle", { cx: 8, cy: 8, r: 6 }, "M5.2 8.2l2 2 3.6-4"],
  degraded: ["path", { d: "M8 1.8L15 14H1z" }, "M8 6v4M8 11.6v.8"],
  lost: ["rect", { x: 2, y: 2, width: 12, height: 12 }, "M5.2 5.2l5.6 5.6M10.8 5.2l-5.6 5.6"],
  quiet: ["path", { d: "M8 1.8L15 14H1z" }, "M5.8 11h4.4"],
  disabled: ["circle", { cx: 8, cy: 8, r: 6 }, "M4 12L12 4"],
  starting: ["circle", { cx: 8, cy: 8, r: 6, "stroke-dasharray": "2.5 2.2" }, ""],
  unknown: ["circle", { cx: 8, cy: 8, r: 6, "stroke-dasharray": "2.5 2.2" }, "M8 8.5v.8M6.3 6.4a1.7 1.7 0 1 1 1.7 1.7"],
};

/** A new icon of a state. */
export function stateIcon(state) {
  const [tag, attributes, sign] = ICONS[state] ?? ICONS.unknown;
  const icon = svg("svg", { viewBox: "0 0 16 16", class: "state-icon", "aria-hidden": "true" });
  icon.append(svg(tag, attributes));
  if (sign) icon.append(svg("path", { d: sign }));
  return icon;
}

function svg(tag, attributes) {
  const element = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) element.setAttribute(name, value);
  return element;
}
