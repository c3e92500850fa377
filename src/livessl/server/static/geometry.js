// Shapes of uncertainty and direction, computed from numbers alone.

/** 95 % quantile of the chi-square distribution with two degrees of freedom: -2 ln 0.05. */
const CHI2_95 = 5.991;

/** The eigenvalues, larger first, of [[a, b], [b, d]], and the angle of the larger one's axis in radians. */
function eigen2(a, b, d) {
  const mean = (a + d) / 2;
  const spread = Math.hypot((a - d) / 2, b);
  return { major: mean + spread, minor: mean - spread, angle: 0.5 * Math.atan2(2 * b, a - d) };
}

/** Half axes in metres and angle of the 95 % ellipse in the plane of two axes, or null without a covariance. */
export function ellipse95(covariance, [i, k]) {
  if (!covariance) return null;
  const { major, minor, angle } = eigen2(covariance[i][i], covariance[i][k], covariance[k][k]);
  if (!Number.isFinite(major) || major <= 0) return null;
  return { a: Math.sqrt(CHI2_95 * major), b: Math.sqrt(CHI2_95 * Math.max(minor, 0)), angle };
}

/** Standard deviation in metres along the longest axis of a 3 x 3 covariance, by power iteration; null without one. */
export function largestSigma(covariance) {
  if (!covariance) return null;
  let v = [0.61, 0.55, 0.57];
  let value = 0;
  for (let step = 0; step < 60; step += 1) {
    const w = covariance.map((row) => row[0] * v[0] + row[1] * v[1] + row[2] * v[2]);
    value = Math.hypot(...w);
    if (!(value > 0)) break;
    v = w.map((c) => c / value);
  }
  return Number.isFinite(value) ? Math.sqrt(value) : null;
}

/** Unit vector of a direction: azimuth counter-clockwise from +x, elevation upwards from the horizontal. */
export function direction(azimuthDeg, elevationDeg) {
  const azimuth = (azimuthDeg * Math.PI) / 180;
  const elevation = (elevationDeg * Math.PI) / 180;
  return [Math.cos(elevation) * Math.cos(azimuth), Math.cos(elevation) * Math.sin(azimuth), Math.sin(elevation)];
}

/** Where a ray from `origin` leaves the room; from an origin outside, the point one room diagonal away. */
export function rayEnd(origin, unit, size) {
  let reach = Math.hypot(...size);
  const inside = origin.every((c, axis) => c >= 0 && c <= size[axis]);
  if (inside) {
    for (let axis = 0; axis < 3; axis += 1) {
      if (unit[axis] > 1e-9) reach = Math.min(reach, (size[axis] - origin[axis]) / unit[axis]);
      if (unit[axis] < -1e-9) reach = Math.min(reach, -origin[axis] / unit[axis]);
    }
  }
  return origin.map((c, axis) => c + unit[axis] * reach);
}
