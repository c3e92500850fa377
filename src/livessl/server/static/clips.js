// The recordings of an event, at the end of its details: to listen to, to save, to keep for ever and to delete.

import { get, getStream, put, refusal, remove } from "./access.js";
import { el } from "./dom.js";
import { number } from "./format.js";

/** How often, in milliseconds, and how many times the page asks again for recordings that are being made. */
const RETRY_MS = 1000;
const ATTEMPTS = 60;
/** Most recordings that the page holds in memory. */
const MOST_HELD = 8;

export class Clips {
  /** `relocate` makes the form by which an event is located again. */
  constructor(api, relocate) {
    this.api = api;
    this.relocate = relocate;
    /** Whether the user may listen, keep and delete. */
    this.mayListen = false;
    this.held = [];
  }

  /** Append the recordings of an event to its details; nothing where it has none. */
  show(event, details) {
    const section = el("section", { className: "clips", "data-testid": "clips", "aria-label": "Recordings" });
    details.append(section);
    section.dataset.status = event.status;
    this.#load(event.id, section, ATTEMPTS);
  }

  async #load(id, section, attempts) {
    let found = null;
    try {
      const response = await get(this.#url(id));
      if (response.ok) found = await response.json();
      else if (response.status === 404) found = { state: "none" }; // the history does not have the event any more
    } catch (error) {
      console.warn("livessl: clips:", error.message);
    }
    section.dataset.state = found?.state ?? "unknown";
    if (found?.state === "stored") this.#fill(found, section);
    else if (found?.state === "waiting") section.replaceChildren(el("p", { className: "clip-note", text: "Recordings are being made…" }));
    else if (found?.state === "unreadable") this.#explain(found, section);
    else if (found?.problem) this.#sayNone(found, section);
    else section.replaceChildren();
    const again = found === null || found.state === "waiting";
    if (again && attempts > 1) setTimeout(() => section.isConnected && this.#load(id, section, attempts - 1), RETRY_MS);
  }

  #fill(found, section) {
    const { event_id: id, files } = found;
    section.replaceChildren(
      el("h3", { text: "Recordings" }),
      el("ul", {}, ...files.map((file) => this.#item(id, file, section.dataset.status))),
      found.no_enhanced ? el("p", { className: "clip-note", text: `No enhanced signal: ${found.no_enhanced}.` }) : "",
      this.mayListen
        ? this.#tools(found, section)
        : el("p", { className: "clip-note", text: "Sign in as an operator to listen." }));
    const form = this.mayListen ? this.relocate.form(found) : null;
    if (form !== null) section.append(form);
  }

  /** Why the recordings cannot be read; operators can delete them. */
  #explain({ event_id: id, problem }, section) {
    section.replaceChildren(
      el("h3", { text: "Recordings" }),
      el("p", { className: "clip-note", "data-testid": "clip-problem", text: `The recordings cannot be read. ${problem}.` }),
      this.mayListen ? el("p", { className: "clip-tools" }, this.#deletion(id, section)) : "");
  }

  /** Why there are no recordings. */
  #sayNone({ problem }, section) {
    section.replaceChildren(
      el("h3", { text: "Recordings" }),
      el("p", { className: "clip-note", "data-testid": "clip-missing", text: `There are no recordings: ${problem}.` }));
  }

  #item(id, file, status) {
    const where = status === "direction-only" ? "in the direction found" : "at the place found";
    const title = file.kind === "enhanced" ? `Enhanced, ${where}` : `Array ${file.array}`;
    const parts = [
      `${number(file.duration_s, 1)} s`,
      file.channels > 1 ? `${file.channels} channels` : null,
      file.gain_db >= 0.1 ? `+${number(file.gain_db, 0)} dB` : null,
      missing(file),
    ];
    const sound = el("div", { className: "clip-sound" });
    const item = el("li", { className: "clip", "data-testid": `clip-${file.name}` },
      el("span", { className: "clip-title", text: title }),
      el("span", { className: "clip-facts", text: parts.filter(Boolean).join(", ") }));
    if (this.mayListen) {
      item.append(el("span", { className: "clip-buttons" },
        this.#button("Listen", `Listen: ${title}`, async () => this.#listen(await this.#address(id, file), sound, title)),
        this.#button("Save", `Save: ${title}`, async () => save(await this.#address(id, file), `${id}-${file.name}`))));
    }
    item.append(sound);
    return item;
  }

  #tools({ event_id: id, keep }, section) {
    const reload = () => this.#load(id, section, 1);
    const kept = this.#button(keep ? "Kept for ever" : "Keep for ever", keep ? "Keep no longer" : "Keep for ever", async () => {
      await check(await put(new URL(`${this.#url(id)}/keep`), { keep: !keep }));
      reload();
    });
    kept.setAttribute("aria-pressed", String(keep));
    return el("p", { className: "clip-tools" }, kept, this.#deletion(id, section));
  }

  #deletion(id, section) {
    return this.#button("Delete", "Delete the recordings", async () => {
      if (!confirm("Delete the recordings of this event? The event itself stays.")) return;
      await check(await remove(this.#url(id)));
      this.#load(id, section, 1);
    });
  }

  /** A button that does something that takes time; while it does, and after it has failed, the button says so. */
  #button(text, label, act) {
    const button = el("button", { className: "switch", type: "button", text, "aria-label": label });
    button.addEventListener("click", async () => {
      if (button.ariaBusy === "true") return;
      button.ariaBusy = "true"; // a disabled button would lose the keyboard's focus
      try {
        await act();
        button.title = "";
      } catch (error) {
        button.title = error.message;
        button.textContent = `${text} (failed)`;
      }
      button.ariaBusy = "false";
    });
    return button;
  }

  #listen(address, sound, title) {
    const audio = el("audio", { controls: true, src: address, "aria-label": title, "data-testid": "clip-audio" });
    sound.replaceChildren(audio);
    audio.play().catch(() => {}); // a browser that plays nothing by itself still shows the controls
  }

  /** A recording as an address of this page: an element cannot send an access token with a request. */
  async #address(id, file) {
    const response = await check(await getStream(new URL(`${this.#url(id)}/${encodeURIComponent(file.name)}`)));
    const address = URL.createObjectURL(await response.blob());
    this.held.push(address);
    while (this.held.length > MOST_HELD) URL.revokeObjectURL(this.held.shift());
    return address;
  }

  #url(id) {
    return new URL(`events/${encodeURIComponent(id)}/clips`, this.api);
  }
}

/** What a recording lacks, in words. */
function missing({ gaps_s: gaps }) {
  const gone = gaps.reduce((sum, [begin, end]) => sum + end - begin, 0);
  return gone > 0 ? `${number(gone, 2)} s missing` : null;
}

async function check(response) {
  if (!response.ok) throw new Error(await refusal(response));
  return response;
}

function save(address, name) {
  el("a", { href: address, download: name }).click();
}
