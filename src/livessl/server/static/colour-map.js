// The colours of power maps (their scale for light and dark), and how maps fade with age.

/** Anchors [place, lightness, chroma, hue in degrees] in OKLCh, a colour space in which equal steps look equal. */
const SCALES = {
  dark: [
    [0, 0.175, 0.014, 258], [0.25, 0.31, 0.1, 290], [0.5, 0.47, 0.165, 352], [0.75, 0.69, 0.165, 405], [1, 0.95, 0.085, 458],
  ],
  light: [
    [0, 0.985, 0.004, 95], [0.25, 0.9, 0.07, 88], [0.5, 0.75, 0.14, 58], [0.75, 0.55, 0.18, 18], [1, 0.3, 0.12, -45],
  ],
};
/** Ages, in milliseconds, at which a map begins to fade and at which it is gone. */
const FADE_FROM_MS = 1000;
const FADE_TO_MS = 9000;
/** Steps of the colour scale, as many as levels in a map message. */
const STEPS = 256;
/** Opacity, of 255, gained per step of the scale, so that the lowest levels fade into the background. */
const OPACITY_PER_STEP = 8;

const gamma = (c) => (c <= 0.0031308 ? 12.92 * c : 1.055 * c ** (1 / 2.4) - 0.055);

/** A colour in OKLCh as [r, g, b], each 0 to 255. */
function srgb(lightness, chroma, hueDeg) {
  const hue = (hueDeg * Math.PI) / 180;
  const a = chroma * Math.cos(hue);
  const b = chroma * Math.sin(hue);
  const l = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (lightness - 0.0894841775 * a - 1.291485548 * b) ** 3;
  return [
    4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
    -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
    -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s,
  ].map((c) => Math.round(255 * gamma(Math.min(1, Math.max(0, c)))));
}

/** The colour scale of the "dark" or "light" theme: 256 times r, g, b. */
export function colourScale(theme) {
  const anchors = SCALES[theme];
  const scale = new Uint8ClampedArray(STEPS * 3);
  for (let i = 0; i < STEPS; i += 1) {
    const t = i / (STEPS - 1);
    const upper = Math.max(1, anchors.findIndex(([place]) => place >= t));
    const [from, to] = [anchors[upper - 1], anchors[upper]];
    const u = (t - from[0]) / (to[0] - from[0]);
    scale.set(srgb(...[1, 2, 3].map((k) => from[k] + u * (to[k] - from[k]))), i * 3);
  }
  return scale;
}

/** Draw the whole colour scale across a canvas. */
export function paintScale(canvas, scale) {
  const context = canvas.getContext("2d");
  const image = context.createImageData(canvas.width, canvas.height);
  for (let i = 0; i < canvas.width * canvas.height; i += 1) {
    const step = Math.floor(((i % canvas.width) * STEPS) / canvas.width) * 3;
    image.data.set([...scale.subarray(step, step + 3), 255], i * 4);
  }
  context.putImageData(image, 0, 0);
}

/** A canvas with one pixel per grid point, first row at the bottom; levels up to the median are transparent. */
export function paintMap({ values, rows, columns }, scale) {
  const canvas = document.createElement("canvas");
  canvas.width = columns;
  canvas.height = rows;
  const context = canvas.getContext("2d");
  const image = context.createImageData(columns, rows);
  const sorted = values.slice().sort();
  const [median, maximum] = [sorted[sorted.length >> 1], sorted[sorted.length - 1]];
  const gain = maximum > median ? (STEPS - 1) / (maximum - median) : 0;
  for (let row = 0; row < rows; row += 1) {
    for (let column = 0; column < columns; column += 1) {
      const step = Math.max(0, Math.round((values[row * columns + column] - median) * gain));
      const at = ((rows - 1 - row) * columns + column) * 4;
      image.data[at] = scale[step * 3];
      image.data[at + 1] = scale[step * 3 + 1];
      image.data[at + 2] = scale[step * 3 + 2];
      image.data[at + 3] = Math.min(255, step * OPACITY_PER_STEP);
    }
  }
  context.putImageData(image, 0, 0);
  return canvas;
}

/** The opacity of a map of this age, 1 to 0. */
export function opacity(ageMs) {
  return Math.min(1, Math.max(0, (FADE_TO_MS - ageMs) / (FADE_TO_MS - FADE_FROM_MS)));
}
