// Runs the search of the site of documents in a hidden frame where its pages are opened as files.
// Browsers start no worker for such pages. The page and the frame have one origin, so that each can call the other.
"use strict";

if (location.protocol === "file:") {
  window.Worker = class extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      frame.srcdoc = "<!doctype html><title>search</title><body></body>";
      this.loaded = new Promise((resolve, reject) => {
        frame.addEventListener("load", () => {
          const inside = frame.contentWindow;
          inside.postMessage = (data) => this.dispatchEvent(new MessageEvent("message", { data }));
          const script = inside.document.createElement("script");
          script.addEventListener("load", () => resolve(inside));
          script.addEventListener("error", () => reject(new Error(`expected the script of the search at ${script.src}`)));
          script.src = new URL(url, location.href).href;
          inside.document.body.append(script);
        }, { once: true });
      });
      document.body.append(frame);
    }

    async postMessage(data) {
      const inside = await this.loaded; // messages wait for the script, in their order
      inside.dispatchEvent(new MessageEvent("message", { data }));
    }
  };
}
