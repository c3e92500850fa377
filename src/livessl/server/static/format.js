// Words numbers, times (in the browser's time zone), durations, positions, bearings and latency stages.

const MINUS = "\u2212";
const NARROW_SPACE = "\u202f";
/** The API's latency stages, in words. */
const STAGES = {
  waited: "silence after the sound", sent: "capture node", received: "network", located: "localization",
};

/** A number with a true minus sign, or an en dash for a missing value. */
export function number(value, digits = 2) {
  if (value === null || value === undefined || !Number.isFinite(value)) return "–";
  const text = Math.abs(value).toFixed(digits);
  return value < 0 && Number(text) !== 0 ? MINUS + text : text;
}

/** A number that always shows its sign. */
export function signed(value, digits = 1) {
  return Number.isFinite(value) && value > 0 ? `+${number(value, digits)}` : number(value, digits);
}

/** A count with its unit, which takes an s in the plural: 1 frame, 12 345 frames. */
export function counted(count, unit) {
  return `${count.toLocaleString("en").replaceAll(",", NARROW_SPACE)} ${unit}${count === 1 ? "" : "s"}`;
}

/** A fraction in per cent, or an en dash for a missing value. */
export function percent(fraction) {
  return Number.isFinite(fraction) ? `${Math.round(100 * fraction)} %` : "–";
}

/** A fraction as the CSS width of a bar, limited to 0 to 100 %. */
export function width(fraction) {
  return `${Math.round(100 * Math.min(1, Math.max(0, fraction ?? 0)))}%`;
}

/** A time in seconds as whole milliseconds. */
export function milliseconds(seconds) {
  return `${number(1000 * seconds, 0)} ms`;
}

/** A result's latency stages as text: name and time of each. */
export function stageText(stages) {
  const each = Object.entries(stages).map(([stage, seconds]) => `${STAGES[stage] ?? stage} ${milliseconds(seconds)}`);
  return each.join(", ");
}

/** A short form of a time span in milliseconds before now. */
export function ago(ms) {
  if (!Number.isFinite(ms)) return "long ago";
  const s = Math.max(0, ms / 1000);
  return s < 1 ? "now" : `${duration(s)} ago`;
}

/** A time span in seconds, rounded to one unit: 42 s, 5 min, 3 h, 2 d. */
export function duration(s) {
  if (s < 90) return `${Math.floor(s)} s`;
  if (s < 5400) return `${Math.round(s / 60)} min`;
  if (s < 129600) return `${Math.round(s / 3600)} h`;
  return `${Math.round(s / 86400)} d`;
}

const twoDigits = (n) => String(n).padStart(2, "0");

/** Time of day in the browser's time zone, to the tenth of a second or to the second. */
export function clock(ms, tenths = true) {
  const t = new Date(ms);
  const text = `${twoDigits(t.getHours())}:${twoDigits(t.getMinutes())}:${twoDigits(t.getSeconds())}`;
  return tenths ? `${text}.${Math.floor(t.getMilliseconds() / 100)}` : text;
}

/**
 * When an event began: the time of day, with the date if it is not today's.
 *
 * In a recording without a date it is the number of seconds from the recording's start.
 */
export function when(event, nowMs) {
  const ms = utc(event.time_utc);
  if (ms === null) return `${number(event.start_s, 2)} s`;
  const day = new Date(ms);
  const today = new Date(nowMs).toDateString() === day.toDateString();
  const date = [day.getFullYear(), twoDigits(day.getMonth() + 1), twoDigits(day.getDate())].join("-");
  return today ? clock(ms) : `${date} ${clock(ms)}`;
}

/** Milliseconds since the epoch of an RFC 3339 text, or null. */
export function utc(text) {
  const ms = text ? Date.parse(text) : NaN;
  return Number.isFinite(ms) ? ms : null;
}

/** A position in metres: "x 3.21 y 4.56 z 1.20 m". */
export function position([x, y, z]) {
  return `x ${number(x)} y ${number(y)} z ${number(z)} m`;
}

/** The direction of a contribution, seen from its array. */
export function bearing({ array, azimuth_deg: azimuth, elevation_deg: elevation }) {
  return `azimuth ${number(azimuth, 0)}°, elevation ${number(elevation, 0)}° from array ${array}`;
}

/** An event's status and reason in words, or null for a plain position. */
export function verdict({ status, reason }) {
  if (status === "located" && !reason) return null;
  return [status === "located" ? null : status.replace("-", " "), reason].filter(Boolean).join(": ");
}
