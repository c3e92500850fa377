// The page's start: connects the messages of the server to the model, and the model to the panels and plans.

import { get, getStream, onTokenNeeded, postLong, put, refusal, useToken } from "./access.js";
import { AlertsPanel } from "./alerts.js";
import { ArraysPanel } from "./arrays.js";
import { Clips } from "./clips.js";
import { find, write } from "./dom.js";
import { Readout } from "./estimate.js";
import { EventList } from "./events.js";
import { position, verdict, when } from "./format.js";
import { Header } from "./header.js";
import { Live } from "./live.js";
import { MapPanel } from "./map-panel.js";
import { Model, OLD_MS } from "./model.js";
import { drawTogether, Plan } from "./plan.js";
import { ZoneEditor } from "./plan-zones-editor.js";
import { Relocate } from "./relocate.js";
import { SetUp } from "./set-up.js";
import { readColours } from "./plan-style.js";
import { ViewPanel } from "./view-panel.js";

const API = new URL("api/v1/", document.baseURI);
/** Events that are loaded from the store when the page connects. */
const FIRST_EVENTS = 50;
/** Alerts that the panel lists. */
const LAST_ALERTS = 5;
/** How often, in milliseconds, the alerts are loaded again, for changes that no message reports. */
const ALERTS_MS = 10000;
/** Attempts to load a resource, and the wait between them in milliseconds. */
const ATTEMPTS = 6;
const RETRY_MS = 1500;
/** Attempts to open the WebSocket, while requests are answered, before the page blames the proxy. */
const SURE_FAILURES = 2;
const NO_WEBSOCKET = "requests are answered, but the WebSocket is not; a reverse proxy must pass on Upgrade and Connection";
/** Least time, in milliseconds, between two events that a screen reader announces. */
const ANNOUNCE_MS = 2500;
/** How often, in milliseconds, everything that depends on time is shown anew. */
const TICK_MS = 100;

const model = new Model();
const header = new Header();
const readout = new Readout();
const viewPanel = new ViewPanel({
  onView(maps) {
    mapPanel.need(["floor", ...maps]);
    redraw();
  },
  onTurn() {
    turnFrame ??= requestAnimationFrame(() => {
      turnFrame = null;
      if (model.site !== null) drawTogether([viewPanel.plan], model.site.room.size_m, scene(Date.now()), colours);
    });
  },
});
const plans = [new Plan(find("floor"), "floor", find("floor-pointer")), viewPanel.plan];
const arraysPanel = new ArraysPanel(find("arrays"), find("arrays-empty"), (name, enabled) => {
  const address = new URL(`arrays/${encodeURIComponent(name)}/enabled`, API);
  put(address, { enabled }).catch((error) => console.warn(`livessl: array ${name}:`, error.message));
});
const clips = new Clips(API, new Relocate(API, (id, answer) => {
  model.setAgain(id, answer);
  redraw();
}));
const eventList = new EventList(find("events"), {
  empty: find("events-empty"),
  count: find("events-count"),
  onOpen: (event, details) => clips.show(event, details),
  onMark: (event) => {
    model.setHighlight(event, event && when(event, model.serverNow()));
    redraw();
  },
});
const alertsPanel = new AlertsPanel(find("alerts-panel"), {
  rules: find("alert-rules"),
  latest: find("alerts"),
  count: find("alerts-count"),
  onArm: (name, armed) => {
    const address = new URL(`alerts/rules/${encodeURIComponent(name)}/armed`, API);
    put(address, { armed }).catch((error) => console.warn(`livessl: rule ${name}:`, error.message)).finally(loadAlerts);
  },
});
const zoneEditor = new ZoneEditor(API, plans[0], redraw);
const mapPanel = new MapPanel(API, plans, redraw);
const light = matchMedia("(prefers-color-scheme: light)");

let colours;
/** Ids of the events that arrived by WebSocket since the stored ones were requested. */
const arrivedIds = new Set();
let shownResult = null;
let announcedAt = -Infinity;
/** The part of the page's address whose event was selected last. */
let linkedHash = "";
let dirty = true;
let frameRequested = false;
/** The request of a frame in which the 3-D view alone is drawn because it has turned, or null. */
let turnFrame = null;

// --- messages -------------------------------------------------------------------------------------------------

const HANDLERS = {
  hello(message) {
    if (model.mode !== null && message.mode !== model.mode) forgetResults();
    model.greet(message);
    header.showSite(message.site, message.mode);
    arraysPanel.mayChange = message.role !== "viewer";
    alertsPanel.mayChange = message.role !== "viewer";
    zoneEditor.mayChange = message.role !== "viewer";
    setUp.mayChange = message.role !== "viewer";
    clips.mayListen = message.role !== "viewer";
    HANDLERS.arrays(message);
    loadSite();
    loadEvents();
    loadAlerts();
    mapPanel.watch();
  },
  arrays(message) {
    if (message.mode !== model.mode) changeMode(message.mode);
    model.takeArrays(message);
    header.showOverload(message.overload);
    arraysPanel.show(model.arrays, Date.now(), "live");
    mapPanel.offer(model.arrays.map(({ array }) => array.name));
    setUp.showArrays(model.arrays, "live");
  },
  update(message) {
    model.takeUpdate(message);
    header.showLatency(model.latencies);
  },
  event({ v, seq, ...event }) { // what remains is the event as GET events returns it
    model.takeEvent(event);
    arrivedIds.add(event.id);
    eventList.add(event, model.serverNow());
    header.showLatency(model.latencies);
    announce(event);
  },
  track(message) {
    model.takeTrack(message);
  },
  alert() {
    loadAlerts();
  },
  zones({ by_name: zones }) {
    if (model.site === null) return; // it is loaded with the zones
    model.site.zones = zones;
    zoneEditor.show(zones, model.site.can_draw);
  },
  poses({ arrays }) {
    if (model.site !== null) model.site.arrays = arrays; // else it is loaded with them
    setUp.posesChanged();
  },
  gap(message) {
    header.showGap(message);
    loadAlerts();
    loadEvents();
  },
};

const live = new Live(liveUrl(), {
  onMessage(message) {
    HANDLERS[message.kind]?.(message);
    redraw();
  },
  onState: showLink,
  onRejected: explain,
});

function liveUrl() {
  const url = new URL("live?kinds=update,event,track,arrays,alert,zones,poses", API);
  url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
  return url;
}

/**
 * Find out why the WebSocket does not open, for the banner. `reason` is the server's, empty if it refused the
 * handshake, which browsers hide from the page; a request then shows the cause, and opens the dialog for the token.
 */
async function explain(reason, failures) {
  if (reason) {
    header.cause = reason;
    return;
  }
  try {
    const response = await get(new URL("site", API));
    if (response.ok) header.cause = failures < SURE_FAILURES ? null : NO_WEBSOCKET;
    else header.cause = response.status === 401 ? "access token needed" : await refusal(response);
  } catch {
    header.cause = null;
  }
}

async function getJson(path) {
  const response = await get(new URL(path, API));
  if (!response.ok) throw new Error(`${path}: the server answered ${response.status}`);
  return response.json();
}

/** Send `value` for an answer that may take long; the error's `told` is what the server says is in its way. */
async function postJson(path, value) {
  const response = await postLong(new URL(path, API), value);
  if (response.ok) return response.json();
  const error = new Error(`${path}: the server answered ${response.status}`);
  const isJson = response.headers.get("Content-Type")?.startsWith("application/json") ?? false;
  if (isJson && response.status !== 401) error.told = await refusal(response);
  throw error;
}

/** Run `load`; if it fails, try again a few times. */
async function retrying(load, attempts = ATTEMPTS) {
  try {
    await load();
    redraw();
  } catch (error) {
    console.warn("livessl:", error.message);
    if (attempts > 1) setTimeout(() => retrying(load, attempts - 1), RETRY_MS);
  }
}

function loadSite() {
  retrying(async () => {
    const site = await getJson("site");
    model.site = site;
    header.showSite(site.site, model.mode);
    header.showPrivacy(site.privacy);
    zoneEditor.show(site.zones, site.can_draw);
    if (site.floor_plan !== null) loadFloorPlan(site.floor_plan);
    const [x, y] = site.room.size_m;
    find("floor-frame").style.setProperty("--aspect", String(x / y));
    viewPanel.showRoom(site.room.size_m);
    find("floor-empty").hidden = true;
  });
}

/** Load the picture under the floor plan; as data in its address, for an element's request would have no token. */
function loadFloorPlan({ bounds_m: bounds }) {
  retrying(async () => {
    const response = await getStream(new URL("floor-plan", API));
    if (!response.ok) throw new Error(`floor-plan: the server answered ${response.status}`);
    const reader = new FileReader();
    reader.readAsDataURL(await response.blob());
    await new Promise((resolve, reject) => Object.assign(reader, { onload: resolve, onerror: reject }));
    const image = new Image();
    image.src = reader.result;
    await image.decode();
    model.floorPlan = { image, bounds };
  });
}

function loadEvents() {
  retrying(async () => {
    arrivedIds.clear();
    const { events } = await getJson(`events?limit=${FIRST_EVENTS}`);
    eventList.load(events, arrivedIds, model.serverNow());
    model.takeStored(events);
    header.showLatency(model.latencies);
    await showLinked();
  });
}

/** Select the event that the page's address names, `#event=ID`, as the links in alerts do; once for each address. */
async function showLinked() {
  const { hash } = location;
  const id = new URLSearchParams(hash.slice(1)).get("event");
  if (id === null || hash === linkedHash) return;
  linkedHash = hash;
  const response = await get(new URL(`events/${encodeURIComponent(id)}`, API));
  if (!response.ok) return; // it was deleted
  const { v, ...event } = await response.json();
  eventList.reveal(event, model.serverNow());
}

function loadAlerts() {
  retrying(async () => {
    const { rules } = await getJson("alerts/rules");
    alertsPanel.showRules(rules);
    if (rules.length === 0) return;
    const { alerts } = await getJson(`alerts?limit=${LAST_ALERTS}`);
    alertsPanel.showLatest(alerts, model.serverNow());
  });
}

function changeMode(mode) {
  forgetResults();
  model.mode = mode;
  header.showSite(model.site?.site, mode);
  loadEvents();
}

/** Remove the results of live sound before a replay's, and the other way round: the two have separate times. */
function forgetResults() {
  model.forgetResults();
  readout.clear(model.link);
  mapPanel.clear();
}

/** Have a screen reader announce an event, unless it is still busy with the one before. */
function announce(event) {
  if (performance.now() - announcedAt < ANNOUNCE_MS) return;
  announcedAt = performance.now();
  const what = event.status === "located" && event.position_m ? position(event.position_m) : verdict(event);
  write(find("announce"), `Event at ${when(event, model.serverNow())}: ${what}`);
}

function askForToken(sent) {
  write(find("token-why"), sent ? "This token is not valid. Check it and try again." : "Enter your access token.");
  if (!find("token-dialog").open) find("token-dialog").showModal();
}

// --- time -----------------------------------------------------------------------------------------------------

function showLink(link, silentMs) {
  const changed = link !== model.link;
  model.link = link;
  header.showLink(link, silentMs);
  if (!changed) return;
  arraysPanel.tick(model.arrays, Date.now(), link);
  redraw();
}

/** Request one animation frame, and none while one is pending; the browser grants none while the page is hidden. */
function requestTick() {
  if (frameRequested) return;
  frameRequested = true;
  requestAnimationFrame(() => {
    frameRequested = false;
    tick();
  });
}

/** Show everything that depends on time, whether or not a message has arrived. */
function tick() {
  const now = Date.now();
  model.expire(now);
  header.tick(model, model.serverNow());
  arraysPanel.tick(model.arrays, now, model.link);
  mapPanel.tick(now);
  if (model.newest !== null && model.newest !== shownResult) {
    readout.show(model.newest, now, model.link);
    redraw(); // in the same frame as the numbers, so that plans and numbers always agree
  } else readout.tick(now, model.link);
  shownResult = model.newest;
  const ageing = model.newest !== null && now - model.newest.marker.bornMs < OLD_MS + 500;
  if (dirty || ageing || mapPanel.isFading(now) || model.tracks.size > 0) draw(now);
}

/** Have the plans drawn at the next tick, however many messages arrive before it. */
function redraw() {
  dirty = true;
}

function draw(now) {
  if (model.site === null) return;
  dirty = false;
  drawTogether(plans, model.site.room.size_m, scene(now), colours);
  setUp.place();
}

function scene(now) {
  return model.scene(now, mapPanel.images, zoneEditor.draft);
}

function applyTheme() {
  colours = readColours();
  mapPanel.setTheme(light.matches ? "light" : "dark");
  redraw();
}

// --- start ----------------------------------------------------------------------------------------------------

const setUp = new SetUp({ load: getJson, send: postJson, plan: plans[0], redraw });
applyTheme();
viewPanel.start();
light.addEventListener("change", applyTheme);
const sizes = new ResizeObserver(redraw);
for (const plan of plans) sizes.observe(plan.canvas);
addEventListener("hashchange", () => retrying(showLinked));
onTokenNeeded(askForToken);
find("token-form").addEventListener("submit", () => {
  useToken(find("token").value.trim());
  find("token").value = "";
  live.reconnectNow();
});
setInterval(requestTick, TICK_MS);
setInterval(() => {
  if (!find("alerts-panel").hidden && model.link === "live" && !document.hidden) loadAlerts();
}, ALERTS_MS);
live.start();
