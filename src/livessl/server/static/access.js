// The token, where the server wants one: kept as long as the tab, sent with every request, asked for when it is refused.

const KEY = "livessl-token";
const TIMEOUT_MS = 8000;

let whenRefused = () => {};

/** Have `listener(known)` called whenever the server wants a token; `known` tells whether one was sent in vain. */
export function onRefused(listener) {
  whenRefused = listener;
}

/** Send this token from now on. */
export function useToken(token) {
  sessionStorage.setItem(KEY, token);
}

/** What a WebSocket is opened with: browsers let it send no headers, but name protocols. */
export function protocols() {
  const token = sessionStorage.getItem(KEY);
  return token === null ? [] : ["livessl", `livessl.token.${token}`];
}

/** Fetch, with the token if there is one. */
export const get = (url) => ask(url, {});

/** Change what is there, with the token if there is one. */
export const put = (url, value) =>
  ask(url, { method: "PUT", body: JSON.stringify(value), headers: { "Content-Type": "application/json" } });

async function ask(url, { headers: others, ...options }) {
  const token = sessionStorage.getItem(KEY);
  const headers = token === null ? { ...others } : { ...others, Authorization: `Bearer ${token}` };
  const response = await fetch(url, { ...options, cache: "no-store", headers, signal: AbortSignal.timeout(TIMEOUT_MS) });
  if (response.status === 401) whenRefused(token !== null);
  return response;
}
