// Computes ellipses and ellipsoids of 95 % uncertainty, and rays of direction, from numbers alone.

/** 95 % quantiles of the chi-square distribution with two degrees of freedom, -2 ln 0.05, and with three. */
const CHI2_95 = 5.991;
const CHI2_95_OF_3 = 7.815;
/** Sweeps of Jacobi's method for a 3 x 3 matrix: it converges quadratically. */
const SWEEPS = 8;

/** The eigenvalues, larger first, of [[a, b], [b, d]], and the angle of the larger one's axis in radians. */
function eigen2(a, b, d) {
  const mean = (a + d) / 2;
  const spread = Math.hypot((a - d) / 2, b);
  return { major: mean + spread, minor: mean - spread, angle: 0.5 * Math.atan2(2 * b, a - d) };
}

/** Half axes in metres and angle of the ellipse at which a 2 x 2 quadratic form, in m², is `square`; or null. */
export function ellipse([[a, b], [, d]], square) {
  const { major, minor, angle } = eigen2(a, b, d);
  if (!Number.isFinite(major) || major <= 0) return null;
  return { a: Math.sqrt(square * major), b: Math.sqrt(square * Math.max(minor, 0)), angle };
}

/** The ellipse that holds 95 % of a 2 x 2 covariance: see `ellipse`. */
export const ellipse95 = (covariance) => ellipse(covariance, CHI2_95);

/** The three half axes, vectors in metres, of the ellipsoid that holds 95 % of a 3 x 3 covariance; or null. */
export function ellipsoid95(covariance, longest) {
  if (!covariance?.flat().every(Number.isFinite)) return null;
  const { values, vectors } = eigen3(covariance);
  return values.map((value, index) => {
    const length = Math.min(longest, Math.sqrt(CHI2_95_OF_3 * Math.max(value, 0)));
    return vectors.map((row) => row[index] * length);
  });
}

/** The eigenvalues of a symmetric 3 x 3 matrix, and their unit vectors as columns, by Jacobi's method. */
export function eigen3(matrix) {
  const a = matrix.map((row) => [...row]);
  const vectors = [[1, 0, 0], [0, 1, 0], [0, 0, 1]];
  for (let sweep = 0; sweep < SWEEPS; sweep += 1) {
    for (const [i, k] of [[0, 1], [0, 2], [1, 2]]) {
      if (a[i][k] === 0) continue;
      const turn = 0.5 * Math.atan2(2 * a[i][k], a[i][i] - a[k][k]);
      const [cos, sin] = [Math.cos(turn), Math.sin(turn)];
      for (const row of [...a, ...vectors]) [row[i], row[k]] = [cos * row[i] + sin * row[k], cos * row[k] - sin * row[i]];
      [a[i], a[k]] = [a[i].map((c, n) => cos * c + sin * a[k][n]), a[k].map((c, n) => cos * c - sin * a[i][n])];
    }
  }
  return { values: [0, 1, 2].map((i) => a[i][i]), vectors };
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
