// The wiring: what the server says goes into one state, and the panels and plans are drawn from it.

import { get, onRefused, put, useToken } from "./access.js";
import { ArraysPanel, effectiveState } from "./arrays.js";
import { Readout } from "./estimate.js";
import { EventList, verdict } from "./events.js";
import { ago, clock, duration, number, position, utc, when, write } from "./format.js";
import { HeatFeed, paint, ramp, visibility } from "./heat.js";
import { Live, ServerClock } from "./live.js";
import { OLD_MS, Plan } from "./plan.js";

const API = new URL("api/v1/", document.baseURI);
const FIRST_EVENTS = 50;
const TRAIL = 20;
const TRACK_POINTS = 60;
/** Updates of several sounds at once are all shown, each until it has not been heard of for this long. */
const UPDATE_LIVES_MS = 1500;
/** What arrives later than this after it happened is as old as it says; below, it has just been heard. */
const LATE_MS = 3000;
const ANNOUNCE_MS = 2500;
const GAP_SHOWN_MS = 20000;
const TICK_MS = 100;

const find = (id) => document.getElementById(id);

const state = {
  site: null,
  mode: null,
  link: "down",
  arrays: [],       // { array, askedMs }: what was said, and when, by the browser's clock
  events: new Set(), // ids that came by socket since the stored ones were last asked for
  trail: [],        // { kind, id, position, bornMs }, oldest first
  current: new Map(), // event id → the last update of a sound that goes on
  last: null,       // the newest update or event as a marker
  unread: null,     // its message, until it is read out
  mark: null,       // the event that is pointed at or pinned, as a marker
  tracks: new Map(),
  latencies: { update: [], event: [] }, // messages that say how long they took, the newest last
  maps: null,       // { floor, side, bornMs, time }
  images: null,     // { floor, side, bornMs } coloured, each { canvas, bounds }
  missed: 0,
};

const serverClock = new ServerClock();
const plans = [new Plan(find("floor"), "floor"), new Plan(find("side"), "side")];
const readout = new Readout();
const arraysPanel = new ArraysPanel(find("arrays"), find("arrays-empty"), (name, enabled) => {
  const address = new URL(`arrays/${encodeURIComponent(name)}/enabled`, API);
  put(address, { enabled }).catch((error) => console.warn(`array ${name}: ${error.message}`));
});
const eventList = new EventList(find("events"), {
  empty: find("events-empty"),
  count: find("events-count"),
  onMark: (event) => {
    state.mark = event === null ? null : { ...marker(event, 0), label: when(event, serverNow()) };
    redraw();
  },
});
const heat = new HeatFeed(API, (maps) => {
  state.maps = maps;
  colourMaps();
  redraw();
});
const light = matchMedia("(prefers-color-scheme: light)");
let table;
let colours;
let announcedAt = -Infinity;
let gapTimer;
let dirty = true;
let ticking = false;

// --- what the server says -------------------------------------------------------------------------------------

const HEARD = {
  hello(message) {
    serverClock.reset();
    setSite(message.site, message.mode);
    arraysPanel.mayChange = message.role !== "viewer";
    HEARD.arrays(message);
    state.tracks.clear();
    loadSite();
    loadEvents();
    heat.watch();
  },
  arrays(message) {
    if (message.mode && message.mode !== state.mode) changeMode(message.mode);
    const sentMs = utc(message.now_utc);
    const now = Date.now();
    if (sentMs !== null) serverClock.learn(sentMs, now);
    // A message that was long under way is as old as its stamp says.
    const askedMs = sentMs === null ? now : now - Math.max(0, serverClock.at(now) - sentMs);
    state.arrays = message.arrays.map((array) => ({ array, askedMs }));
    arraysPanel.show(state.arrays, now, "live");
    fillMapChoice();
  },
  update(message) {
    const bornMs = born(message, 0, true);
    const shown = marker(message, bornMs);
    state.current.set(message.event_id, shown);
    setOthers(message, bornMs);
    if (shown.position) leaveTrail(shown);
    learnLatency("update", message);
    newest(message, shown);
  },
  event({ v, seq, ...message }) { // what is left is the event as it is stored
    const bornMs = born(message, message.duration_s, true);
    const shown = marker(message, bornMs);
    state.current.delete(message.id);
    setOthers({ event_id: message.id }, bornMs);
    state.events.add(message.id);
    eventList.add(message, serverNow());
    if (shown.position && shown.status === "located") leaveTrail(shown);
    learnLatency("event", message);
    newest(message, shown);
    announce(message);
  },
  track(message) {
    const track = (message.state !== "new" && state.tracks.get(message.id)) || { points: [] };
    if (message.position_m) track.points = [...track.points, message.position_m].slice(-TRACK_POINTS);
    state.tracks.set(message.id, { ...track, velocity: message.velocity_m_s, ended: message.state === "end", heardMs: Date.now() });
  },
  gap(message) {
    state.missed += message.missed;
    write(find("gap-text"), `this page missed ${state.missed} message${state.missed === 1 ? "" : "s"}${message.reason ? ` (${message.reason})` : ""}; events are loaded again`);
    find("gap").hidden = false;
    clearTimeout(gapTimer);
    gapTimer = setTimeout(closeGap, GAP_SHOWN_MS);
    loadEvents();
  },
};

const live = new Live(socketUrl(), {
  onMessage(message) {
    HEARD[message.kind]?.(message);
    redraw();
  },
  onState: showLink,
  onUnopened: () => getJson("site").catch(() => {}), // where a token is missing, this asks for it
});


function socketUrl() {
  const url = new URL("live?kinds=update,event,track,arrays", API);
  url.protocol = url.protocol === "https:" ? "wss:" : "ws:";
  return url;
}

async function getJson(path) {
  const response = await get(new URL(path, API));
  if (!response.ok) throw new Error(`${path}: the server answered ${response.status}`);
  return response.json();
}

async function loadSite(tries = 0) {
  try {
    state.site = await getJson("site");
    setSite(state.site.site, state.site.mode);
    const [x, y, z] = state.site.room.size_m;
    find("floor-frame").style.setProperty("--aspect", String(x / y));
    find("side-frame").style.setProperty("--aspect", String(y / z));
    find("floor-empty").hidden = true;
    showPrivacy(state.site.privacy);
    redraw();
  } catch (error) {
    console.warn("livessl: site:", error.message);
    if (tries < 5) setTimeout(() => loadSite(tries + 1), 1500);
  }
}

async function loadEvents(tries = 0) {
  state.events.clear();
  try {
    const { events } = await getJson(`events?limit=${FIRST_EVENTS}`);
    eventList.load(events, state.events, serverNow());
    const known = new Set(state.trail.filter(({ kind }) => kind === "event").map(({ id }) => id));
    const stored = events.filter(({ id }) => !known.has(id)).map((event) => marker(event, born(event, event.duration_s, false)));
    state.trail = [...stored.reverse().filter((one) => one.position && one.status === "located"), ...state.trail]
      .sort(byAge).slice(-TRAIL);
    if (events.length > 0 && (state.last === null || born(events[0], events[0].duration_s, false) > state.last.bornMs + LATE_MS)) {
      newest(events[0], marker(events[0], born(events[0], events[0].duration_s, false)));
    }
    for (const event of events.slice(0, TRAIL).reverse()) if (state.latencies.event.length < TRAIL) learnLatency("event", event);
    redraw();
  } catch (error) {
    console.warn("livessl: events:", error.message);
    if (tries < 5) setTimeout(() => loadEvents(tries + 1), 1500);
  }
}

// --- from messages to what is shown ---------------------------------------------------------------------------

function serverNow() {
  return serverClock.at(Date.now());
}

/** When a sound was last heard, by the browser's clock: as its stamp says, or just now where the stamp is no help. */
function born(message, lastedS, bySocket) {
  const now = Date.now();
  const ms = utc(message.time_utc);
  if (ms === null || state.mode === "replay") return bySocket ? now : -Infinity;
  const age = Math.max(0, serverNow() - (ms + 1000 * (lastedS ?? 0)));
  return bySocket && age < LATE_MS ? now : now - age;
}

function marker(message, bornMs) {
  return {
    kind: message.kind ?? "event",
    id: message.kind === "update" ? message.event_id : message.id,
    status: message.status ?? "located",
    position: message.position_m,
    covariance: message.covariance_m2,
    rays: (message.contributions ?? []).map((c) => ({ array: c.array, azimuth: c.azimuth_deg, elevation: c.elevation_deg })),
    bornMs,
  };
}

/** Oldest first; what is infinitely old has no order among itself. */
function byAge(a, b) {
  return a.bornMs === b.bornMs ? 0 : a.bornMs < b.bornMs ? -1 : 1;
}

/** Further sources of a sound that goes on, each a marker of its own; they end with it. */
function setOthers({ event_id: id, others = [] }, bornMs) {
  for (const key of [...state.current.keys()]) if (key.startsWith(`${id}/`)) state.current.delete(key);
  others.forEach((other, index) => {
    const key = `${id}/${index + 2}`;
    const shown = marker({ ...other, kind: "update", event_id: key }, bornMs);
    state.current.set(key, shown);
    leaveTrail(shown);
  });
}

function leaveTrail(shown) {
  state.trail = [...state.trail, shown].slice(-TRAIL);
}

function newest(message, shown) {
  state.last = shown;
  state.unread = { kind: "event", ...message }; // read out with the next tick, so that numbers and plans agree
}

function median(values) {
  return values.sort((a, b) => a - b)[values.length >> 1];
}

function milliseconds(seconds) {
  return `${number(1000 * seconds, 0)} ms`;
}

/** The middle one of the last answers: while a sound lasts, and after it has ended; where the time goes, on pointing. */
function learnLatency(kind, message) {
  if (!Number.isFinite(message.latency_s)) return;
  state.latencies[kind] = [...state.latencies[kind], message].slice(-TRAIL);
  const { update, event } = state.latencies;
  const told = Object.entries({ live: update, event }).filter(([, heard]) => heard.length > 0);
  write(find("vital-latency"), told.map(([name, heard]) => `${name} ${milliseconds(median(heard.map((one) => one.latency_s)))}`).join(" · "));
  const parts = told.map(([name, heard]) => [name, heard.map((one) => one.latency_stages_s).filter(Boolean)]).filter(([, stages]) => stages.length > 0);
  find("vital-latency").title = parts.map(([name, stages]) => {
    const each = Object.keys(stages[0]).map((stage) => `${stage} ${milliseconds(median(stages.map((one) => one[stage])))}`);
    return `${name}: ${each.join(", ")}`;
  }).join("\n");
}

function announce(event) {
  if (performance.now() - announcedAt < ANNOUNCE_MS) return;
  announcedAt = performance.now();
  const told = verdict(event);
  const placed = event.status === "located" && event.position_m;
  write(find("announce"), `Event at ${when(event, serverNow())}: ${placed ? position(event.position_m) : told}`);
}

/** From live to a replay or back: another time, in which nothing that is on the page happened. */
function changeMode(mode) {
  const first = state.mode === null;
  setSite(state.site?.site, mode);
  if (first) return;
  serverClock.reset();
  state.tracks.clear();
  state.current.clear();
  state.trail = [];
  state.last = state.maps = state.images = null;
  loadEvents();
}

function setSite(name, mode) {
  state.mode = mode ?? state.mode;
  write(find("site-name"), name ?? "");
  document.title = name ? `${name} · livessl` : "livessl";
  find("mode").hidden = !state.mode;
  find("mode").dataset.mode = state.mode ?? "";
  write(find("mode"), state.mode ?? "");
}

function showPrivacy({ mode, retention_days: days }) {
  const chip = find("privacy");
  chip.hidden = mode !== "positions-only" && days === null;
  write(chip, [mode === "positions-only" ? "positions only" : null, days === null ? null : `kept ${days} d`].filter(Boolean).join(" · "));
  chip.title = `${mode === "positions-only" ? "No sound is stored" : "Sound may be recorded"}; events are kept ${days === null ? "for ever" : `for ${days} days`}`;
}

function askForToken(known) {
  write(find("token-why"), known ? "The server does not know this token." : "This server tells only those who have a token.");
  if (!find("token-dialog").open) find("token-dialog").showModal();
}

function fillMapChoice() {
  const select = find("map-choice");
  const names = ["fused", ...state.arrays.map(({ array }) => array.name)];
  if (names.join("\n") === [...select.options].map(({ value }) => value).join("\n")) return;
  const chosen = names.includes(select.value) ? select.value : "fused";
  select.replaceChildren(...names.map((name) => new Option(name === "fused" ? "fused" : `${name} alone`, name)));
  select.value = chosen;
  if (heat.choice !== chosen) heat.choose(chosen);
}

function closeGap() {
  state.missed = 0;
  find("gap").hidden = true;
}

// --- time passes ----------------------------------------------------------------------------------------------

function showLink(link, silentMs) {
  const changed = link !== state.link;
  state.link = link;
  document.body.dataset.link = link;
  find("connection").dataset.state = link;
  write(find("connection-word"), { live: "connected", stale: "stale", down: silentMs === null ? "connecting" : "no contact" }[link]);
  const banner = find("banner");
  banner.hidden = link === "live" || (silentMs === null && performance.now() < 1000);
  write(find("banner-for"), silentMs === null ? " yet" : ` for ${duration(silentMs / 1000)}`);
  if (changed) arraysPanel.tick(state.arrays, Date.now(), link);
  if (changed) redraw();
}

/** Ten times a second while the page can be seen: one frame is asked for, never a second one before it came. */
function nextTick() {
  if (ticking) return;
  ticking = true;
  requestAnimationFrame(() => {
    ticking = false;
    tick();
  });
}

/** Everything that ages, ages, whether or not anything is heard. */
function tick() {
  const now = Date.now();
  for (const [id, { bornMs }] of state.current) if (now - bornMs > UPDATE_LIVES_MS) state.current.delete(id);
  for (const [id, { heardMs }] of state.tracks) if (now - heardMs > OLD_MS) state.tracks.delete(id);
  arraysPanel.tick(state.arrays, now, state.link);
  if (state.unread) readout.show(state.unread, state.last.bornMs, now, state.link);
  else readout.tick(now, state.link);
  if (state.unread) redraw();
  state.unread = null;
  showMapAge(now);
  const states = state.arrays.map((held) => effectiveState(held, now, state.link));
  const healthy = states.filter((each) => each === "healthy").length;
  write(find("vital-arrays"), states.length && state.link === "live" ? `${healthy} of ${states.length} healthy` : "–");
  find("vital-arrays").dataset.tone = state.link === "live" && healthy < states.length ? "warn" : "fine";
  write(find("vital-clock"), state.link === "live" ? clock(serverNow(), false) : "–");
  const moving = state.last !== null && now - state.last.bornMs < OLD_MS + 500;
  const fading = state.images !== null && visibility(now - state.images.bornMs) > 0;
  if (dirty || moving || fading || state.tracks.size > 0) draw(now);
}

function showMapAge(now) {
  const label = find("map-age");
  const age = state.maps ? now - state.maps.bornMs : null;
  label.dataset.tone = age !== null && age > LATE_MS ? "old" : "fine";
  write(label, age === null ? "map: none yet" : age < 1500 ? "map: now" : `map: ${ago(age)}`);
  for (const plan of plans) {
    plan.canvas.dataset.mapTime = state.maps?.time ?? "";
    plan.canvas.dataset.mapAge = age === null ? "" : (age / 1000).toFixed(2);
    plan.canvas.dataset.map = heat.choice;
  }
}

// --- drawing --------------------------------------------------------------------------------------------------

function readTheme() {
  const style = getComputedStyle(document.documentElement);
  const read = (name) => style.getPropertyValue(`--${name}`).trim();
  const names = ["paper", "panel", "grid", "wall", "zone", "text", "muted", "estimate", "marked", "old", "halo"];
  colours = Object.fromEntries(names.map((name) => [name, read(name)]));
  Object.assign(colours, { healthy: read("ok"), degraded: read("warn"), quiet: read("warn"), lost: read("bad"), disabled: read("muted"), starting: read("muted"), unknown: read("muted") });
  table = ramp(light.matches ? "light" : "dark");
  const g = find("ramp").getContext("2d");
  const image = g.createImageData(256, 8);
  for (let i = 0; i < 256 * 8; i += 1) image.data.set([...table.subarray((i % 256) * 3, (i % 256) * 3 + 3), 255], i * 4);
  g.putImageData(image, 0, 0);
  colourMaps();
  redraw();
}

function colourMaps() {
  const painted = (picture) => ({ canvas: paint(picture, table), bounds: picture.bounds });
  state.images = state.maps && { floor: painted(state.maps.floor), side: painted(state.maps.side), bornMs: state.maps.bornMs };
}

/** Something to draw has changed: it is drawn with the next tick, however many messages come until then. */
function redraw() {
  dirty = true;
}

function scene(now) {
  const { site } = state;
  const held = new Map(state.arrays.map((each) => [each.array.name, each]));
  const estimates = [...state.current.values()].filter(({ id }) => id !== state.last?.id);
  if (state.last !== null && state.last.status !== "refused") estimates.push({ ...state.last, newest: true });
  return {
    now,
    map: state.images,
    thickness: site.grid.spacing_m,
    zones: Object.entries(site.zones ?? {}).map(([name, { bounds_m: bounds }]) => [name, bounds.map(([a]) => a), bounds.map(([, b]) => b)]),
    arrays: Object.entries(site.arrays).map(([name, array]) => ({
      name,
      position: array.position_m,
      microphones: array.microphones_m,
      state: held.has(name) ? effectiveState(held.get(name), now, state.link) : "unknown",
      active: state.link === "live" && Boolean(held.get(name)?.array.active),
    })),
    trail: state.trail,
    tracks: [...state.tracks.values()],
    estimates,
    highlight: state.mark,
  };
}

function draw(now) {
  if (!state.site) return;
  dirty = false;
  const size = state.site.room.size_m;
  const fits = plans.map((plan) => plan.fit(size));
  // One scale for both views, so that they read as one drawing, unless that would waste a view's space.
  const common = Math.min(...fits);
  const shared = common > 0.85 * Math.max(...fits);
  const shown = scene(now);
  plans.forEach((plan, index) => {
    plan.layout(size, shared ? common : fits[index]);
    plan.draw(shown, colours);
  });
}

function followPointer(plan, output) {
  plan.canvas.addEventListener("pointermove", ({ offsetX, offsetY }) => {
    const metres = plan.under(offsetX, offsetY);
    write(output, metres ? metres.map((value, index) => `${plan.view.names[index]} ${number(value)}`).join("  ") : "");
  });
  plan.canvas.addEventListener("pointerleave", () => write(output, ""));
}

// --- begin ----------------------------------------------------------------------------------------------------

readTheme();
light.addEventListener("change", readTheme);
const sizes = new ResizeObserver(redraw);
for (const plan of plans) sizes.observe(plan.canvas);
followPointer(plans[0], find("floor-pointer"));
followPointer(plans[1], find("side-pointer"));
find("map-choice").addEventListener("change", ({ target }) => heat.choose(target.value));
find("gap-close").addEventListener("click", closeGap);
onRefused(askForToken);
find("token-form").addEventListener("submit", () => {
  useToken(find("token").value.trim());
  find("token").value = "";
  live.hurry();
});
setInterval(nextTick, TICK_MS);
live.start();
