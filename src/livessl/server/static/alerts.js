// The alerts panel: each rule with its state, a button to arm or disarm it, and the last alerts.

import { el, write } from "./dom.js";
import { counted, when } from "./format.js";

export class AlertsPanel {
  /** `onArm(name, armed)` is called when a user with `mayChange` arms or disarms a rule. */
  constructor(panel, { rules, latest, count, onArm }) {
    this.mayChange = false;
    this.panel = panel;
    this.rules = rules;
    this.latest = latest;
    this.count = count;
    this.onArm = onArm;
  }

  /** Show the rules as GET alerts/rules describes them; without any, there is no panel. */
  showRules(rules) {
    this.panel.hidden = rules.length === 0;
    const disarmed = rules.filter(({ armed }) => !armed).length;
    write(this.count, disarmed > 0 ? `${disarmed} disarmed` : "all armed");
    const focused = this.rules.contains(document.activeElement) ? document.activeElement.dataset.rule : null;
    const items = rules.map((rule) => this.#rule(rule));
    this.rules.replaceChildren(...items.map(({ item }) => item));
    items.find(({ button }) => button.dataset.rule === focused)?.button.focus();
  }

  /** Show the last alerts as GET alerts lists them, newest first. */
  showLatest(alerts, nowMs) {
    this.latest.replaceChildren(...alerts.map((alert) => alertItem(alert, nowMs)));
  }

  /** The list's item of a rule, and the button in it. */
  #rule({ name, armed, open_now: open, alerts, ongoing }) {
    const state = !armed ? "disarmed" : open ? "armed" : "off schedule";
    const detail = ongoing.length > 0 ? `now: ${ongoing.join(", ")}` : counted(alerts, "alert");
    const action = armed ? "Disarm" : "Arm";
    const label = `${action} ${name}`;
    const button = el("button", { className: "switch", type: "button", text: action, "aria-label": label, "data-rule": name });
    button.hidden = !this.mayChange;
    button.addEventListener("click", () => {
      if (button.ariaBusy === "true") return;
      if (armed && !confirm(`Disarm "${name}"? It alerts nobody until it is armed again.`)) return;
      button.ariaBusy = "true"; // a disabled button would lose the keyboard's focus
      this.onArm(name, !armed);
    });
    const item = el("li", { className: "rule", "data-testid": `rule-${name}`, "data-state": state },
      el("b", { className: "rule-name", text: name }),
      el("span", { className: "rule-state", text: state }),
      el("span", { className: "rule-detail", text: detail }),
      button);
    return { item, button };
  }
}

/** An alert as an item of the list: when, which rule, and what. */
function alertItem(alert, nowMs) {
  const { time_utc: begin, rule, text, deliveries } = alert;
  const failed = deliveries.filter(({ state }) => state === "dead");
  const waiting = deliveries.filter(({ state, attempts }) => state === "waiting" && attempts > 0);
  const troubled = [
    ...failed.map(({ action }) => `not delivered by ${action}`),
    ...waiting.map(({ action }) => `${action} is tried again`),
  ];
  return el("li", { className: "alert" },
    el("p", {}, el("span", { className: "when", text: begin === null ? "" : when(alert, nowMs) }), " ", el("b", { text: rule })),
    el("p", { className: "alert-text", text }),
    troubled.length > 0 ? el("p", { className: "alert-trouble", text: troubled.join(", ") }) : null);
}
