// The bar at the top: site, mode, latency, time, and the words of the connection and its loss; the notices below it.

import { find, write } from "./dom.js";
import { clock, counted, duration, milliseconds, stageText } from "./format.js";
import { shownState } from "./model.js";

/** How long, in milliseconds, the notice of skipped messages stays. */
const NOTICE_MS = 20000;
/** Time, in milliseconds, that the first connection may take before the page reports a problem. */
const FIRST_CONTACT_MS = 1000;
/** What a privacy mode means: on the bar, and in its tooltip. */
const PRIVACY = {
  "positions-only": ["positions only", "No sound is stored"],
  "no-speech": ["no speech", "Recordings in which speech is detected are not stored, and live listening is refused"],
};
const LINK_WORDS = { live: "connected", stale: "stale", down: "offline" };

export class Header {
  constructor() {
    this.skipped = 0;
    this.noticeTimer = null;
    /** Why there is no connection, if that is known. */
    this.cause = null;
    find("gap-close").addEventListener("click", () => this.#closeNotice());
  }

  showSite(name, mode) {
    write(find("site-name"), name ?? "");
    document.title = name ? `${name} · livessl` : "livessl";
    const chip = find("mode");
    chip.hidden = !mode;
    chip.dataset.mode = mode ?? "";
    write(chip, mode ?? "");
    write(find("vital-clock-label"), mode === "replay" ? "recording time" : "server time");
  }

  showPrivacy({ mode, retention_days: days }) {
    const [word, sound] = PRIVACY[mode] ?? [null, "Sound may be recorded"];
    const chip = find("privacy");
    chip.hidden = word === null && days === null;
    const words = [word, days === null ? null : `kept ${days} d`];
    write(chip, words.filter(Boolean).join(" · "));
    chip.title = `${sound}. Events are ${days === null ? "never deleted" : `deleted after ${days} days`}.`;
  }

  /** Show the median latency of each kind of result; a tooltip splits it into stages. */
  showLatency({ update, event }) {
    const kinds = Object.entries({ live: update, event }).filter(([, results]) => results.length > 0);
    const each = kinds.map(([name, results]) => `${name} ${milliseconds(median(results.map((one) => one.latency_s)))}`);
    write(find("vital-latency"), each.join(" · ") || "–");
    find("vital-latency").title = kinds.map(([name, results]) => {
      const all = results.map((one) => one.latency_stages_s).filter(Boolean);
      const medians = Object.keys(all[0] ?? {}).map((stage) => [stage, median(all.map((stages) => stages[stage]))]);
      return medians.length > 0 ? `${name}: ${stageText(Object.fromEntries(medians))}` : "";
    }).filter(Boolean).join("\n");
  }

  showLink(link, silentMs) {
    if (link === "live") this.cause = null;
    document.body.dataset.link = link;
    find("connection").dataset.state = link;
    write(find("connection-word"), link === "down" && silentMs === null ? "connecting" : LINK_WORDS[link]);
    find("banner").hidden = link === "live" || (silentMs === null && performance.now() < FIRST_CONTACT_MS);
    const unreachable = this.cause === null ? "Server unreachable; reconnecting" : `No connection: ${this.cause}`;
    write(find("banner-text"), link === "stale" ? "No message from the server" : unreachable);
    const silence = silentMs === null ? null : duration(silentMs / 1000);
    const suffix = link === "stale" ? ` for ${silence}` : ` (last contact ${silence} ago)`;
    write(find("banner-for"), silence === null ? "" : suffix);
  }

  /** Show what the server sheds because it is overloaded; `message` is null while it keeps up. */
  showOverload(message) {
    write(find("overload"), message ? `Server ${message}` : "");
    find("overload").hidden = !message;
  }

  /** Report that messages were skipped; `missed` is null where the server does not know how many. */
  showGap({ missed, reason }) {
    this.skipped = missed === null || this.skipped === null ? null : this.skipped + missed;
    const what = this.skipped === null ? "Some messages" : counted(this.skipped, "message");
    write(find("gap-text"), `${what} skipped${reason ? ` (${reason})` : ""}; event list reloaded`);
    find("gap").hidden = false;
    clearTimeout(this.noticeTimer);
    this.noticeTimer = setTimeout(() => this.#closeNotice(), NOTICE_MS);
  }

  #closeNotice() {
    this.skipped = 0;
    find("gap").hidden = true;
  }

  /** Show what changes with time. */
  tick({ arrays, link }, serverNowMs) {
    const live = link === "live";
    const healthy = arrays.filter(({ array }) => shownState(array, link) === "healthy").length;
    const vital = find("vital-arrays");
    write(vital, live && arrays.length > 0 ? `${healthy} of ${arrays.length} healthy` : "–");
    vital.dataset.tone = live && healthy < arrays.length ? "warn" : "fine";
    write(find("vital-clock"), live ? clock(serverNowMs, false) : "–");
  }
}

function median(values) {
  return values.sort((a, b) => a - b)[values.length >> 1];
}
