// Words an event: the line of its row that sums it up, and the details that open below it.

import { el } from "./dom.js";
import { milliseconds, number, percent, position, stageText, verdict, when, width } from "./format.js";
import { largestSigma } from "./geometry.js";

/** The elements of an event's summary. */
export function summary(event, nowMs) {
  const sigma = largestSigma(event.covariance_m2);
  const located = event.status === "located" && Boolean(event.position_m);
  const meter = el("span");
  meter.style.width = width(event.confidence);
  const text = verdict(event);
  const facts = [
    event.source > 1 ? "second of two sources" : null,
    usedArrays(event).map((name) => withRequest(name, event)).join(" + "),
    `${number(event.duration_s, 2)} s long`,
    `${number(event.level_dbfs, 0)} dBFS`,
    `latency ${milliseconds(event.latency_s)}`,
  ];
  return [
    el("span", { className: "when", text: when(event, nowMs) }),
    where(event, located),
    el("span", {
      className: "sigma",
      text: located && sigma !== null ? `± ${number(sigma)} m` : "",
      title: "Standard deviation along the axis of largest uncertainty",
    }),
    el("span", { className: "trust", title: "Confidence: how reliable the position is" },
      el("span", { className: "meter", "aria-hidden": "true" }, meter),
      el("span", { className: "percent", text: percent(event.confidence) })),
    el("span", { className: "facts" }, ...facts.filter(Boolean).map((fact) => el("span", { text: fact }))),
    zonesText(event) ? el("span", { className: "zones", text: zonesText(event) }) : null,
    text ? el("span", { className: "verdict", text }) : null,
  ].filter(Boolean);
}

function where({ position_m: place, status, contributions }, located) {
  if (located) {
    const coordinates = ["x", "y", "z"].flatMap((axis, i) => [el("i", { text: axis }), ` ${number(place[i])} `]);
    return el("span", { className: "where" }, ...coordinates, el("i", { text: "m" }));
  }
  const first = contributions?.[0];
  const directed = status === "direction-only" && first;
  const text = directed ? `azimuth ${number(first.azimuth_deg, 0)}° from ${first.array}` : "no position";
  return el("span", { className: "where without", text });
}

/** The arrays that an event was located from; for one that was not located, those that detected it. */
function usedArrays({ arrays, heard_by: detectedBy }) {
  return arrays?.length ? arrays : detectedBy ?? [];
}

/** An array's name, marked if the array did not detect the event itself and its frames were requested. */
function withRequest(name, { contributions }) {
  return contributions?.some(({ array, asked }) => asked && array === name) ? `${name} (on request)` : name;
}

/** The elements of an event's details. */
export function details(event) {
  const sigma = (row, axis) => number(Math.sqrt(Math.max(0, row[axis])));
  const sigmas = event.covariance_m2?.map((row, axis) => `${"xyz"[axis]} ${sigma(row, axis)}`).join("  ");
  const list = el("dl", {},
    entry("position", event.position_m && position(event.position_m), "wide"),
    entry("candidates", event.candidates?.map(candidate).join("; "), "wide"),
    entry("error (1 σ)", sigmas && `${sigmas} m`, "wide"),
    entry("detected by", event.heard_by?.join(", ")),
    entry("used", event.arrays?.map((name) => withRequest(name, event)).join(", ")),
    entry("zones", zonesText(event)),
    entry("start", event.time_utc ?? `${number(event.start_s, 3)} s into the recording`, "wide"),
    entry("duration", `${number(event.duration_s, 2)} s`),
    entry("latency", latency(event), "wide"),
    entry("late frames", event.late_frames ? String(event.late_frames) : null),
    entry("method", event.method),
    entry("id", event.id, "wide"));
  return event.contributions?.length ? [list, contributionTable(event)] : [list];
}

/** One of several places that explain a sound about as well. */
function candidate({ position_m: place, probability }) {
  return `${position(place)} (${percent(probability)})`;
}

function entry(name, value, className) {
  return value ? el("div", { className }, el("dt", { text: name }), el("dd", { text: value })) : null;
}

function latency({ latency_s: total, latency_stages_s: stages }) {
  return stages ? `${milliseconds(total)}: ${stageText(stages)}` : milliseconds(total);
}

function contributionTable(event) {
  const heads = ["array", "used (s)", "dBFS", "azimuth", "elevation", "distance"];
  const rows = event.contributions.map((c) => {
    const outlier = c.agrees === false ? ` (outlier by ${number(c.off_deg, 0)}°)` : "";
    const values = [
      number(c.active_s),
      number(c.level_dbfs, 1),
      `${number(c.azimuth_deg, 1)}°`,
      `${number(c.elevation_deg, 1)}°`,
      `${number(c.distance_m)} m`,
    ];
    return el("tr", {},
      el("th", { text: withRequest(c.array, event) + outlier, scope: "row" }),
      ...values.map((text) => el("td", { text })));
  });
  return el("table", {},
    el("caption", { text: "Contribution of each array" }),
    el("thead", {}, el("tr", {}, ...heads.map((text) => el("th", { text, scope: "col" })))),
    el("tbody", {}, ...rows));
}

/** The zones that hold an event; it is excluded by some, which need not hold it, if they probably do. */
function zonesText({ zones = [], excluded_by: excludedBy = [] }) {
  const others = zones.filter((name) => !excludedBy.includes(name));
  return [...others, ...excludedBy.map((name) => `${name} (excluded)`)].join(", ");
}
