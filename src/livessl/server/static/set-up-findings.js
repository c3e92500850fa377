// The findings of the doctor as items of lists: what is wrong, at which input, and the cure.

import { el } from "./dom.js";

/** A finding as an item of a list: what is wrong, at which input, and what cures it. */
export function findingItem({ fault, severity, message, cure, input, confidence }) {
  const where = input === null ? "" : ` (input ${input})`;
  return el("li", { className: "finding", "data-severity": severity, "data-fault": fault },
    el("p", { className: "finding-what" }, el("b", { text: severity }), ` ${message}${where}`),
    el("p", { className: "finding-cure", text: `${cure}. ${Math.round(100 * confidence)} % sure.` }));
}

/** What the last sounds cannot show about poses, and what would show it, as an item of a list. */
export function blindSpotItem({ fault, message, cure }) {
  return el("li", { className: "finding", "data-severity": "note", "data-fault": fault },
    el("p", { className: "finding-what" }, el("b", { text: "note" }), ` ${message}`),
    el("p", { className: "finding-cure", text: `${cure}.` }));
}
