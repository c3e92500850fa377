// How the 3-D view is looked at: turned, zoomed and moved. It knows numbers, and no element.

import { Projection } from "./projection.js";

/** Where the view begins, in degrees: x to the right, y away from the viewer, and the floor seen from above. */
const START_AZIMUTH_DEG = -62;
const START_ELEVATION_DEG = 24;
/** Least and greatest enlargement. */
const LEAST_ZOOM = 0.6;
const MOST_ZOOM = 24;

const limited = (value, least, most) => Math.min(most, Math.max(least, value));

/** Look at the middle of a room of this size. A camera is { azimuthDeg, elevationDeg, zoom, target }. */
export function start(size) {
  return { azimuthDeg: START_AZIMUTH_DEG, elevationDeg: START_ELEVATION_DEG, zoom: 1, target: size.map((c) => c / 2) };
}

/** Move the viewer around the room: to the right and upwards, in degrees; never below the floor. */
export function turned(camera, rightDeg, upDeg) {
  return {
    ...camera,
    azimuthDeg: wrapped(camera.azimuthDeg + rightDeg),
    elevationDeg: limited(camera.elevationDeg + upDeg, 0, 90),
  };
}

/** Enlarge by a factor; what is `right` and `up` metres from the middle of the view stays where it is. */
export function zoomed(camera, factor, size, [right, up] = [0, 0]) {
  const zoom = limited(camera.zoom * factor, LEAST_ZOOM, MOST_ZOOM);
  const share = 1 - camera.zoom / zoom;
  return { ...moved(camera, right * share, up * share, size), zoom };
}

/** Look at a place that is this many metres to the right and up in the view; the place stays in the room. */
export function moved(camera, right, up, size) {
  const { right: unitRight, up: unitUp } = new Projection(camera.azimuthDeg, camera.elevationDeg);
  const target = camera.target.map((c, axis) => limited(c + right * unitRight[axis] + up * unitUp[axis], 0, size[axis]));
  return { ...camera, target };
}

/** The camera on the way from one to another, the shorter way round; `share` is from 0 to 1. */
export function between(from, to, share) {
  const mixed = (a, b) => a + (b - a) * share;
  return {
    azimuthDeg: wrapped(from.azimuthDeg + wrapped(to.azimuthDeg - from.azimuthDeg) * share),
    elevationDeg: mixed(from.elevationDeg, to.elevationDeg),
    zoom: from.zoom * (to.zoom / from.zoom) ** share,
    target: from.target.map((c, axis) => mixed(c, to.target[axis])),
  };
}

/** Width and height, in metres, that hold a room of this size whichever way it is turned about the vertical. */
export function room3d({ elevationDeg }, size) {
  const [, up] = new Projection(0, elevationDeg).extent([Math.hypot(size[0], size[1]), 0, size[2]]);
  return [Math.hypot(size[0], size[1]), up];
}

/** An angle in degrees from -180, inclusive, to 180. */
function wrapped(degrees) {
  return ((((degrees + 180) % 360) + 360) % 360) - 180;
}
