// The embedded map: walls, zones and arrays as the server describes them, and the last sounds as they come.

import { follow } from "./client.js";

/** Events that stay on the map. */
const SHOWN = 20;
const NEEDS_TOKEN = "This map needs a valid token: /embed#token=TOKEN";
/** Radii in metres. */
const RADIUS = { array: 0.12, event: 0.15, update: 0.22 };

const server = new URL(".", location.href).href.replace(/\/$/, "");
const token = new URLSearchParams(location.hash.slice(1)).get("token") ?? undefined;
const query = new URLSearchParams(location.search);
// a frame's address can be read by extensions and stay in the history: the token does not stay in it
history.replaceState(null, "", location.pathname + location.search);

const map = document.getElementById("map");
const notice = document.getElementById("notice");
const room = layer(map, "g");
const sounds = layer(map, "g");
const current = layer(map, "g");

function layer(parent, name, attributes = {}) {
  const element = document.createElementNS("http://www.w3.org/2000/svg", name);
  for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
  parent.append(element);
  return element;
}

function dot(parent, kind, [x, y], attributes = {}) {
  return layer(parent, "circle", { class: kind, cx: x, cy: y, r: RADIUS[kind], ...attributes });
}

function show(state, text) {
  document.body.dataset.state = state;
  notice.textContent = text;
}

async function drawRoom() {
  const headers = token === undefined ? {} : { Authorization: `Bearer ${token}` };
  const answer = await fetch(`${server}/api/v1/site`, { headers, cache: "no-store" });
  if (answer.status === 401) return show("refused", NEEDS_TOKEN);
  const site = await answer.json();
  const [width, height] = site.room.size_m;
  const margin = 0.03 * Math.max(width, height);
  map.setAttribute("viewBox", [-margin, -margin, width + 2 * margin, height + 2 * margin].join(" "));
  for (const group of [room, sounds, current]) group.setAttribute("transform", `translate(0 ${height}) scale(1 -1)`);
  room.replaceChildren();
  layer(room, "rect", { class: "wall", x: 0, y: 0, width, height });
  for (const zone of Object.values(site.zones)) {
    const [[x0, x1], [y0, y1]] = zone.bounds_m;
    const corners = zone.polygon_m ?? [[x0, y0], [x1, y0], [x1, y1], [x0, y1]];
    layer(room, "polygon", { class: "zone", points: corners.map((corner) => corner.join(",")).join(" ") });
  }
  for (const [name, { position_m: place }] of Object.entries(site.arrays)) {
    layer(dot(room, "array", place, { "data-array": name }), "title").textContent = name;
  }
  return show("live", "");
}

function take(message) {
  if (message.kind === "update" && message.position_m !== null) {
    current.replaceChildren();
    dot(current, "update", message.position_m);
  } else if (message.kind === "event") {
    current.replaceChildren();
    for (const old of [message.id, ...message.replaces]) sounds.querySelector(`[data-event="${CSS.escape(old)}"]`)?.remove();
    if (message.position_m === null) return;
    const mark = dot(sounds, "event", message.position_m, { "data-event": message.id });
    layer(mark, "title").textContent = `${message.time_utc ?? ""} ${message.status}, confidence ${message.confidence}`;
    while (sounds.childElementCount > SHOWN) sounds.firstElementChild.remove();
  }
}

const confidence = query.get("min_confidence");
follow(server, {
  kinds: ["event", "update", "poses", "zones"],
  zone: query.get("zone") ?? undefined,
  minConfidence: confidence === null ? undefined : Number(confidence),
  maxRateHz: 10,
  token,
  onMessage: (message) => (["poses", "zones"].includes(message.kind) ? drawRoom() : take(message)),
  onState: (state, error) => {
    if (state === "live") drawRoom().catch((reason) => show("down", String(reason)));
    else if (state === "down") show(state, "Server unreachable; reconnecting");
    else show(state, /token/.test(error.message) ? NEEDS_TOKEN : error.message);
  },
});
