// Requests to the server with an access token, their time-outs, and the words of a refusal; the tab keeps the token.

const STORAGE_KEY = "livessl-token";
/** Longest wait for an answer, in milliseconds. */
const TIMEOUT_MS = 8000;
/** Longest wait, in milliseconds, for an answer that the server has to compute. */
const LONG_TIMEOUT_MS = 60000;

let tokenNeeded = () => {};

/** Call `listener(sent)` whenever the server rejects a request for lack of a valid token; `sent`: a token was sent. */
export function onTokenNeeded(listener) {
  tokenNeeded = listener;
}

/** Send this token with every request from now on. */
export function useToken(token) {
  sessionStorage.setItem(STORAGE_KEY, token);
}

/** The protocols to open a WebSocket with: one carries the token, because browsers add no headers to a WebSocket. */
export function protocols() {
  const token = sessionStorage.getItem(STORAGE_KEY);
  return token === null ? [] : ["livessl", `livessl.token.${token}`];
}

/** Read a resource. */
export const get = (url) => request(url, {});

/** Replace a resource by `value`, sent as JSON. */
export const put = (url, value) => send("PUT", url, value);

/** Delete a resource. */
export const remove = (url) => request(url, { method: "DELETE" });

/** Send `value` as JSON, for an answer that may take long. */
export const postLong = (url, value) => send("POST", url, value, { signal: AbortSignal.timeout(LONG_TIMEOUT_MS) });

/** Read a resource whose answer may take long. */
export const getStream = (url) => request(url, { signal: null });

/** What a server or proxy says when it refuses a request: a sentence, or one for each fault of the request. */
export async function refusal(response) {
  const type = response.headers.get("Content-Type") ?? "";
  const body = type.startsWith("application/json") ? await response.json().catch(() => null) : null;
  const detail = body?.detail ?? "";
  const text = type.startsWith("text/plain") ? (await response.text()).trim() : "";
  const faults = Array.isArray(detail) ? detail.map(({ msg }) => msg?.replace(/^Value error, /, "")) : [detail];
  return text || faults.filter((fault) => typeof fault === "string" && fault).join("; ") || `the server answered ${response.status}`;
}

const send = (method, url, value, options = {}) =>
  request(url, { method, body: JSON.stringify(value), headers: { "Content-Type": "application/json" }, ...options });

async function request(url, { headers: others, ...options }) {
  const token = sessionStorage.getItem(STORAGE_KEY);
  const headers = token === null ? { ...others } : { ...others, Authorization: `Bearer ${token}` };
  const signal = AbortSignal.timeout(TIMEOUT_MS);
  const response = await fetch(url, { signal, ...options, cache: "no-store", headers });
  const isCurrent = token === sessionStorage.getItem(STORAGE_KEY); // it may have been entered since the request was sent
  if (response.status === 401 && isCurrent) tokenNeeded(token !== null);
  return response;
}
