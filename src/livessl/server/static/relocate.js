// Has the server locate an event again from its recordings; shows both answers beside each other and on the plans.

import { postLong, refusal } from "./access.js";
import { el, write } from "./dom.js";
import { number, percent, position } from "./format.js";

/** The choices of poses, by the values of the request; the first one is chosen at the start. */
const SET_UPS = { then: "as set up then", now: "as set up now" };

export class Relocate {
  /** `onAnswer(id, answer)` is called with every answer of the server. */
  constructor(api, onAnswer) {
    this.api = api;
    this.onAnswer = onAnswer;
  }

  /** The form for an event with recordings; null where these are of an earlier release. */
  form({ event_id: id, methods }) {
    if (!methods?.length) return null;
    const method = choice("Method", Object.fromEntries(methods.map((name) => [name, name])));
    const setUp = choice("Poses of the arrays", SET_UPS);
    method.value = methods.find((name) => name !== methods[0]) ?? methods[0]; // the first one is usually the event's own
    const button = el("button", { className: "switch", type: "submit", text: "Locate" });
    const note = el("p", { className: "clip-note", role: "status" });
    const answers = el("div", { "data-testid": "relocated" });
    const form = el("form", { className: "relocate", "data-testid": "relocate", "aria-label": "Locate again" },
      el("label", {}, "Locate again with ", method), setUp, button, note, answers);
    form.addEventListener("submit", async (submitted) => {
      submitted.preventDefault();
      if (button.ariaBusy === "true") return;
      button.ariaBusy = "true"; // a disabled button would lose the keyboard's focus
      write(note, "Locating…");
      answers.replaceChildren();
      try {
        const found = await this.#ask(id, { method: method.value, set_up: setUp.value });
        write(note, summary(found));
        answers.replaceChildren(table(found));
        this.onAnswer(id, found.again);
      } catch (error) {
        write(note, `Not located: ${error.message}`);
        this.onAnswer(id, null);
      }
      button.ariaBusy = "false";
    });
    return form;
  }

  async #ask(id, wanted) {
    const response = await postLong(new URL(`events/${encodeURIComponent(id)}/relocate`, this.api), wanted);
    if (response.ok) return response.json();
    throw new Error(await refusal(response));
  }
}

function choice(label, names) {
  const options = Object.entries(names).map(([value, text]) => el("option", { value, text }));
  return el("select", { "aria-label": label }, ...options);
}

/** What the two answers differ by, in words. */
function summary({ distance_m: distance, moved_arrays: moved, other_sources: others, again, stored }) {
  const parts = [
    distance === null ? "One of the answers is no position." : `The positions are ${number(distance)} m apart.`,
    again.status === stored.status ? null : `The status was ${stored.status} and is ${again.status}.`,
    moved.length ? `Moved since then: ${moved.join(", ")}.` : null,
    others.length ? `Another source at ${others.map((other) => position(other.position_m)).join("; ")}.` : null,
  ];
  return parts.filter(Boolean).join(" ");
}

function table({ stored, again }) {
  const rows = [
    ["method", ({ method }) => method],
    ["status", ({ status }) => status.replace("-", " ")],
    ["reason", ({ reason }) => reason ?? ""],
    ["position", ({ position_m: place }) => (place ? position(place) : "–")],
    ["error (1 σ)", ({ std_m: std }) => (std === null ? "–" : `± ${number(std)} m`)],
    ["confidence", ({ confidence, method }) => `${percent(confidence)}${method === "onset" ? "" : " (no probability)"}`],
    ["used", ({ arrays }) => arrays.join(", ") || "–"],
  ];
  const shown = rows.filter(([, text]) => text(stored) || text(again));
  return el("table", {},
    el("thead", {}, el("tr", {}, ...["", "stored", "again"].map((text) => el("th", { text, scope: "col" })))),
    el("tbody", {}, ...shown.map(([name, text]) => el("tr", {},
      el("th", { text: name, scope: "row" }), el("td", { text: text(stored) }), el("td", { text: text(again) })))));
}
