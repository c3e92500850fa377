// Loads the page again if one of its scripts or style sheets did not arrive; without them it would not work.

/** Wait, in milliseconds, before the page is loaded again. */
const RELOAD_MS = 2000;

function reloadLater({ target }) {
  if (!(target instanceof HTMLScriptElement || target instanceof HTMLLinkElement)) return;
  setTimeout(() => location.reload(), RELOAD_MS);
  const report = () => { document.getElementById("incomplete").hidden = false; };
  if (document.readyState === "loading") addEventListener("DOMContentLoaded", report);
  else report();
}

addEventListener("error", reloadLater, true); // these events do not bubble
