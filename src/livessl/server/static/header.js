// The bar at the top: site, mode, privacy, latency, array count, server time and connection; and the notices below it.

import { find, write } from "./dom.js";
import { clock, duration, milliseconds, stageText } from "./format.js";
import { shownState } from "./model.js";

/** How long, in milliseconds, the notice of skipped messages stays. */
const NOTICE_MS = 20000;
/** Time, in milliseconds, that the first connection may take before the page reports a problem. */
const FIRST_CONTACT_MS = 1000;
const LINK_WORDS = { live: "connected", stale: "stale", down: "disconnected" };

export class Header {
  constructor() {
    this.skipped = 0;
    this.noticeTimer = null;
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
    const positionsOnly = mode === "positions-only";
    const chip = find("privacy");
    chip.hidden = !positionsOnly && days === null;
    write(chip, [positionsOnly ? "positions only" : null, days === null ? null : `kept ${days} d`].filter(Boolean).join(" · "));
    const sound = positionsOnly ? "No sound is stored" : "Sound may be recorded";
    chip.title = `${sound}. Events are ${days === null ? "never deleted" : `deleted after ${days} days`}.`;
  }

  /** Show the median latency of each kind of result; a tooltip splits it into stages. */
  showLatency({ update, event }) {
    const kinds = Object.entries({ live: update, event }).filter(([, results]) => results.length > 0);
    const each = kinds.map(([name, results]) => `${name} ${milliseconds(median(results.map((one) => one.latency_s)))}`);
    write(find("vital-latency"), each.join(" · ") || "–");
    find("vital-latency").title = kinds.map(([name, results]) => {
      const stages = results.map((one) => one.latency_stages_s).filter(Boolean);
      if (stages.length === 0) return "";
      return `${name}: ${stageText(Object.fromEntries(Object.keys(stages[0]).map((stage) => [stage, median(stages.map((one) => one[stage]))])))}`;
    }).filter(Boolean).join("\n");
  }

  showLink(link, silentMs) {
    document.body.dataset.link = link;
    find("connection").dataset.state = link;
    write(find("connection-word"), link === "down" && silentMs === null ? "connecting" : LINK_WORDS[link]);
    find("banner").hidden = link === "live" || (silentMs === null && performance.now() < FIRST_CONTACT_MS);
    write(find("banner-text"), link === "stale" ? "No message from the server" : "Server unreachable; reconnecting");
    write(find("banner-for"), silentMs === null ? "" : link === "stale" ? ` for ${duration(silentMs / 1000)}` : ` (last contact ${duration(silentMs / 1000)} ago)`);
  }

  /** Report that messages were skipped; `missed` is null where the server does not know how many. */
  showGap({ missed, reason }) {
    this.skipped = missed === null || this.skipped === null ? null : this.skipped + missed;
    const what = this.skipped === null ? "Some messages were" : this.skipped === 1 ? "1 message was" : `${this.skipped} messages were`;
    write(find("gap-text"), `${what} skipped${reason ? ` (${reason})` : ""}. The event list has been reloaded.`);
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
