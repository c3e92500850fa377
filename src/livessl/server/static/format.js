// How values become words, and how words become elements: text only ever goes in as text.

const MINUS = "\u2212";

/** A number with a true minus sign, or an en dash where there is none. */
export function number(value, digits = 2) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const text = Math.abs(value).toFixed(digits);
  return value < 0 && Number(text) !== 0 ? MINUS + text : text;
}

/** A number with its sign always shown. */
export function signed(value, digits = 1) {
  return Number.isFinite(value) && value > 0 ? `+${number(value, digits)}` : number(value, digits);
}

/** How long ago, from milliseconds, as short as it can be said. */
export function ago(ms) {
  if (!Number.isFinite(ms)) return "long ago";
  const s = Math.max(0, ms / 1000);
  if (s < 1) return "now";
  return `${duration(s)} ago`;
}

/** A whole length of time from seconds: 42 s, 5 min, 3 h, 2 d. */
export function duration(s) {
  if (s < 90) return `${Math.floor(s)} s`;
  if (s < 5400) return `${Math.round(s / 60)} min`;
  if (s < 129600) return `${Math.round(s / 3600)} h`;
  return `${Math.round(s / 86400)} d`;
}

const two = (n) => String(n).padStart(2, "0");

/** The hour, minute, second and tenth of a moment in the browser's time zone. */
export function clock(ms, tenths = true) {
  const t = new Date(ms);
  const text = `${two(t.getHours())}:${two(t.getMinutes())}:${two(t.getSeconds())}`;
  return tenths ? `${text}.${Math.floor(t.getMilliseconds() / 100)}` : text;
}

/** When an event began: clock time, with the date if it is not today's, or seconds into the recording. */
export function when(event, nowMs) {
  const ms = utc(event.time_utc);
  if (ms === null) return `${number(event.start_s, 2)} s`;
  const day = new Date(ms);
  const today = new Date(nowMs).toDateString() === day.toDateString();
  return today ? clock(ms) : `${day.getFullYear()}-${two(day.getMonth() + 1)}-${two(day.getDate())} ${clock(ms)}`;
}

/** Milliseconds since the epoch of an RFC 3339 text, or null. */
export function utc(text) {
  const ms = text ? Date.parse(text) : NaN;
  return Number.isFinite(ms) ? ms : null;
}

/** "x 3.21 y 4.56 z 1.20 m" */
export function position([x, y, z]) {
  return `x ${number(x)} y ${number(y)} z ${number(z)} m`;
}

/** An element with its class, text, attributes (data-… and aria-… too) and children. */
export function el(tag, { className, text, ...attributes } = {}, ...children) {
  const element = document.createElement(tag);
  if (className) element.className = className;
  if (text !== undefined) element.textContent = text;
  for (const [name, value] of Object.entries(attributes)) {
    if (value !== null && value !== undefined && value !== false) element.setAttribute(name, value === true ? "" : value);
  }
  element.append(...children.filter((child) => child !== null && child !== undefined));
  return element;
}

/** Change an element's text only where it differs, so that the browser has nothing to do most of the time. */
export function write(element, text) {
  if (element.textContent !== text) element.textContent = text;
}
