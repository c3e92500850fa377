// The hub's page: reads sites and events again and again, and shows what has changed.

import { get, onTokenNeeded, refusal, useToken } from "./site/access.js";
import { el, find, write } from "./site/dom.js";
import { ago, percent, position, when } from "./site/format.js";

const API = new URL("api/v1/", document.baseURI);
/** Interval between two looks, in milliseconds. */
const LOOK_MS = 1000;
/** Events shown. */
const EVENTS = 50;
const SVG = "http://www.w3.org/2000/svg";

let shown = "";

/** An answer of the API, or an error with what the server says of it. */
async function read(path) {
  const response = await get(new URL(path, API));
  if (!response.ok) throw new Error(await refusal(response));
  return response.json();
}

/** Show the sites: a row for each, a point for each that says where it is, and a choice for the list of events. */
function showSites(sites) {
  find("no-sites").hidden = sites.length > 0;
  find("sites").replaceChildren(...sites.map((site) => {
    const states = Object.values(site.arrays);
    const healthy = states.filter((state) => state === "healthy").length;
    const newest = site.newest_event_utc ? ago(Date.now() - Date.parse(site.newest_event_utc)) : "–";
    return el("tr", { "data-site": site.site, "data-status": site.status },
      el("th", { text: site.site, scope: "row" }),
      el("td", { text: site.status, className: "status" }),
      el("td", { text: ago(1000 * site.age_s) }),
      el("td", { text: `${healthy} of ${states.length} healthy` }),
      el("td", { text: newest }));
  }));
  const placed = sites.filter((site) => site.location_deg);
  find("map").toggleAttribute("hidden", placed.length === 0);
  find("map").replaceChildren(...placed.map(point));
  const select = find("site");
  const names = ["", ...sites.map((site) => site.site)];
  if (names.join("\n") !== [...select.options].map((option) => option.value).join("\n")) {
    const chosen = select.value;
    select.replaceChildren(...names.map((name) => el("option", { value: name, text: name || "all" })));
    select.value = names.includes(chosen) ? chosen : "";
  }
}

/** A site on the map: east to the right, north upwards. */
function point({ site, status, location_deg: [latitude, longitude] }) {
  const circle = document.createElementNS(SVG, "circle");
  const attributes = { cx: longitude, cy: -latitude, r: 2.5, "data-status": status };
  for (const [name, value] of Object.entries(attributes)) circle.setAttribute(name, value);
  const title = document.createElementNS(SVG, "title");
  title.textContent = `${site}: ${status}`;
  circle.append(title);
  return circle;
}

function showEvents(events) {
  const text = JSON.stringify(events.map(({ site, id, copies }) => [site, id, copies]));
  if (text === shown) return;
  shown = text;
  find("events").replaceChildren(...events.map((event) => el("tr", { "data-id": event.id },
    el("td", { text: when(event, Date.now()) }),
    el("td", { text: [event.site, ...(event.copies ?? []).map((copy) => `also ${copy.site}`)].join(", ") }),
    el("td", { text: event.position_m ? position(event.position_m) : "–" }),
    el("td", { text: percent(event.confidence) }),
    el("td", { text: event.status.replace("-", " "), title: event.reason ?? undefined }))));
}

async function look() {
  try {
    const site = find("site").value;
    const chosen = site ? `&site=${encodeURIComponent(site)}` : "";
    const [sites, page] = await Promise.all([read("sites"), read(`events?limit=${EVENTS}${chosen}`)]);
    showSites(sites.sites);
    showEvents(page.events);
    find("banner").hidden = true;
  } catch (error) {
    write(find("banner"), `The hub does not answer: ${error.message}`);
    find("banner").hidden = false;
  }
}

async function keepLooking() {
  for (;;) {
    await look();
    await new Promise((resolve) => setTimeout(resolve, LOOK_MS));
  }
}

onTokenNeeded((sent) => {
  write(find("token-why"), sent ? "This token is not valid. Check it and try again." : "Enter your access token.");
  if (!find("token-dialog").open) find("token-dialog").showModal();
});
find("token-form").addEventListener("submit", () => {
  useToken(find("token").value.trim());
  find("token").value = "";
  look();
});
find("site").addEventListener("change", look);
keepLooking();
