// The history's page: filters, pages of events, heat map and exports.

import { get, getStream, onTokenNeeded, refusal, useToken } from "./access.js";
import { colourScale, paintScale } from "./colour-map.js";
import { el, find, write } from "./dom.js";
import { EventList } from "./events.js";
import { counted, when } from "./format.js";
import { Model } from "./model.js";
import { Plan } from "./plan.js";
import { readColours } from "./plan-style.js";

const API = new URL("api/v1/", document.baseURI);
/** Events on a page. */
const PAGE = 50;
/** Least width or height of the heat map's picture, in pixels. */
const SHARP_PIXELS = 1000;
/** Pause after typing, in milliseconds, before the text is searched. */
const TYPING_MS = 300;
const FILTERS = ["since", "until", "zone", "array", "status", "min_confidence", "min_level_dbfs", "text"];

const form = find("filters");
const model = new Model();
const plan = new Plan(find("floor"), "floor", find("floor-pointer"));
const light = matchMedia("(prefers-color-scheme: light)");

let colours;
let scale;
/** The last answer of GET history/heat-map, or null. */
let heat = null;
let heatImage = null;
let pages = { older: null, newer: null };
/** Counts searches, so that an answer that has been overtaken is not shown. */
let asked = 0;

// --- filters --------------------------------------------------------------------------------------------------

/** The filters as the API's parameters. */
function filters() {
  const found = new URLSearchParams();
  for (const name of FILTERS) {
    const { value } = form.elements[name];
    if (value === "") continue;
    found.set(name, name === "since" || name === "until" ? new Date(value).toISOString() : value);
  }
  return found;
}

/** Write the page's address into the filters; it holds them as the API's parameters. */
function readAddress() {
  const given = new URLSearchParams(location.search);
  for (const name of FILTERS) {
    const value = given.get(name) ?? "";
    const control = form.elements[name];
    control.value = value !== "" && control.type === "datetime-local" ? localTime(Date.parse(value)) : value;
  }
}

/** A time as a control for local date and time has it. */
function localTime(ms) {
  return new Date(ms - 60000 * new Date(ms).getTimezoneOffset()).toISOString().slice(0, 19);
}

function writeAddress(parameters) {
  const address = new URL(location.href);
  address.search = parameters.toString();
  history.replaceState(null, "", address);
}

// --- loading --------------------------------------------------------------------------------------------------

async function getJson(path) {
  const response = await get(new URL(path, API));
  if (response.ok) return response.json();
  throw new Error(await refusal(response));
}

/** Search anew, from the newest event on, or from a cursor: { cursor } or { after }. */
async function search(place = {}) {
  if (!form.checkValidity()) return;
  const mine = ++asked;
  const parameters = filters();
  writeAddress(parameters);
  const paged = new URLSearchParams({ ...Object.fromEntries(parameters), ...place, limit: PAGE });
  try {
    const page = await getJson(`events?${paged}`);
    if (mine !== asked) return;
    if (place.after && page.events.length < PAGE) return await search(); // the newest page, filled up
    showEvents(page, place);
    if (!place.cursor && !place.after) await loadHeat(parameters, mine);
    report(null);
  } catch (error) {
    if (mine === asked) report(error);
  }
}

async function loadHeat(parameters, mine) {
  const found = await getJson(`history/heat-map?${new URLSearchParams({ ...Object.fromEntries(parameters), spacing_m: find("spacing").value })}`);
  if (mine !== asked) return;
  heat = found;
  paintHeat();
}

function report(error) {
  find("banner").hidden = error === null;
  if (error !== null) write(find("banner"), `The history could not be read: ${error.message}`);
}

// --- showing --------------------------------------------------------------------------------------------------

function showEvents({ events, next_cursor: older, previous_cursor: newer }, place) {
  pages = { older, newer };
  const list = el("ol", { id: "events", "data-testid": "events" });
  find("events-frame").replaceChildren(list);
  find("events-frame").scrollTop = 0;
  const rows = new EventList(list, {
    empty: find("events-empty"),
    count: el("p"),
    onOpen: ({ id }, details) => {
      const href = `./#event=${encodeURIComponent(id)}`;
      details.append(el("a", { className: "elsewhere", href, text: "Open on the live page, with its recordings" }));
    },
    onMark: (event) => {
      model.setHighlight(event, event && when(event, Date.now()));
      draw();
    },
  });
  rows.load(events, new Set(), Date.now());
  write(find("events-empty"), "No event matches these filters");
  find("older").disabled = older === null;
  find("newer").disabled = !place.cursor && !place.after;
  const span = events.length ? `${when(events.at(-1), Date.now())} – ${when(events[0], Date.now())}` : "";
  write(find("events-count"), span);
  const linked = new URLSearchParams(location.hash.slice(1)).get("event");
  const event = events.find(({ id }) => id === linked);
  if (event) rows.reveal(event, Date.now());
  else model.setHighlight(null);
  draw();
}

/** One pixel for each cell, first row at the top; a cell without events is transparent, and steps are logarithmic. */
function paintHeat() {
  const [columns, rows] = heat.shape;
  const most = Math.max(1, ...heat.counts.map((column) => Math.max(...column)));
  const canvas = el("canvas", { width: columns, height: rows });
  const context = canvas.getContext("2d");
  const image = context.createImageData(columns, rows);
  for (let i = 0; i < columns; i += 1) {
    for (let k = 0; k < rows; k += 1) {
      const count = heat.counts[i][k];
      const step = Math.round(255 * (0.25 + 0.75 * Math.log1p(count) / Math.log1p(most)));
      const at = ((rows - 1 - k) * columns + i) * 4;
      image.data.set([...scale.subarray(3 * step, 3 * step + 3), count === 0 ? 0 : 235], at);
    }
  }
  context.putImageData(image, 0, 0);
  heatImage = enlarged(canvas);
  write(find("ramp-text"), `events: 1 → ${most}`);
  const elsewhere = heat.elsewhere ? `, ${heat.elsewhere} without a place here` : "";
  write(find("heat-text"), counted(heat.events, "event") + elsewhere);
  draw();
}

/** The picture with sharp cells: a plan smooths what it enlarges. */
function enlarged(canvas) {
  const factor = Math.max(1, Math.round(SHARP_PIXELS / Math.max(canvas.width, canvas.height)));
  const large = el("canvas", { width: factor * canvas.width, height: factor * canvas.height });
  const context = large.getContext("2d");
  context.imageSmoothingEnabled = false;
  context.drawImage(canvas, 0, 0, large.width, large.height);
  return large;
}

function draw() {
  if (model.site === null) return;
  const now = Date.now();
  let images = null;
  if (heatImage !== null) {
    const [[left], [bottom]] = heat.bounds_m;
    const [right, top] = [left + heat.shape[0] * heat.spacing_m, bottom + heat.shape[1] * heat.spacing_m];
    images = { floor: { canvas: heatImage, bounds: { left, right, bottom, top } }, bornMs: now };
  }
  plan.layout(model.site.room.size_m, plan.fit(model.site.room.size_m));
  plan.draw(model.scene(now, images), colours);
}

function applyTheme() {
  colours = readColours();
  scale = colourScale(light.matches ? "light" : "dark");
  paintScale(find("ramp"), scale);
  if (heat !== null) paintHeat();
}

// --- exports --------------------------------------------------------------------------------------------------

/** Save all events that the filters admit as a file; a link could not carry an access token. */
async function save(format) {
  try {
    const response = await getStream(new URL(`events.${format}?${filters()}`, API));
    if (!response.ok) throw new Error(await refusal(response));
    const address = URL.createObjectURL(await response.blob());
    el("a", { href: address, download: `${model.site?.site ?? "livessl"}-events.${format}` }).click();
    setTimeout(() => URL.revokeObjectURL(address), 60000);
  } catch (error) {
    report(error);
  }
}

// --- start ----------------------------------------------------------------------------------------------------

async function start() {
  try {
    const [site, { arrays }] = await Promise.all([getJson("site"), getJson("arrays")]);
    model.site = site;
    model.arrays = arrays.map((array) => ({ array, sentMs: Date.now() }));
    model.link = "live";
    write(find("site-name"), site.site);
    const [x, y] = site.room.size_m;
    find("floor-frame").style.setProperty("--aspect", String(x / y));
    for (const [name, names] of [["zone", Object.keys(site.zones)], ["array", Object.keys(site.arrays)]]) {
      const [any] = form.elements[name].options;
      form.elements[name].replaceChildren(any, ...names.map((text) => el("option", { text })));
    }
    readAddress();
    await search();
  } catch (error) {
    report(error);
  }
}

let typing = null;
form.addEventListener("input", ({ target }) => {
  clearTimeout(typing);
  typing = setTimeout(search, target.type === "search" || target.type === "number" ? TYPING_MS : 0);
});
form.addEventListener("submit", (event) => {
  event.preventDefault();
  search();
});
form.addEventListener("reset", () => setTimeout(search)); // the controls are reset after this event
for (const button of form.querySelectorAll("[data-hours]")) {
  button.addEventListener("click", () => {
    form.elements.since.value = localTime(Date.now() - 3600000 * Number(button.dataset.hours));
    form.elements.until.value = "";
    search();
  });
}
find("spacing").addEventListener("change", () => search());
find("older").addEventListener("click", () => search({ cursor: pages.older }));
find("newer").addEventListener("click", () => search({ after: pages.newer }));
for (const button of document.querySelectorAll("[data-format]")) {
  button.addEventListener("click", () => save(button.dataset.format));
}
onTokenNeeded((sent) => {
  write(find("token-why"), sent ? "This token is not valid. Check it and try again." : "Enter your access token.");
  if (!find("token-dialog").open) find("token-dialog").showModal();
});
find("token-form").addEventListener("submit", () => {
  useToken(find("token").value.trim());
  find("token").value = "";
  start();
});
applyTheme();
light.addEventListener("change", applyTheme);
new ResizeObserver(draw).observe(plan.canvas);
start();
