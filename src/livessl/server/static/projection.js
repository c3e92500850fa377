// Where points of the room are on a drawing: parallel projection along any direction. It knows numbers, and no element.

/**
 * The fixed views, as [azimuth, elevation] of the viewer in degrees, seen from the room: azimuth counter-clockwise from
 * +x, elevation upwards from the horizontal. The plan is seen from above, the side along the x axis, the front along y.
 */
export const FIXED = { floor: [-90, 90], side: [0, 0], front: [-90, 0] };

/** The view that leaves out an axis, by that axis: what is seen on a face of the room on which x, y or z is constant. */
const VIEW_OF_FACE = ["side", "front", "floor"];
/** Least cosine between a face's normal and the direction to the viewer for the face to be drawn. */
const EDGE_ON = 0.02;

export const dot = (a, b) => a[0] * b[0] + a[1] * b[1] + a[2] * b[2];

/** Cosine and sine of an angle in degrees, exact for right angles. */
function cosSin(degrees) {
  const radians = (degrees * Math.PI) / 180;
  return [Math.cos(radians), Math.sin(radians)].map((c) => (Math.abs(c) < 1e-12 ? 0 : c));
}

/**
 * A parallel projection: equal lengths in one direction stay equal, and an ellipsoid becomes an exact ellipse.
 *
 * `right`, `up` and `toward` (the viewer) are unit vectors of the room; `at` gives pixels, with y downwards.
 */
export class Projection {
  /** `scale` is in pixels per metre, `origin` is where the room's corner at x = y = z = 0 is, in pixels. */
  constructor(azimuthDeg, elevationDeg, scale = 1, origin = [0, 0]) {
    const [ca, sa] = cosSin(azimuthDeg);
    const [ce, se] = cosSin(elevationDeg);
    this.azimuthDeg = azimuthDeg;
    this.elevationDeg = elevationDeg;
    this.right = [-sa, ca, 0];
    this.up = [-se * ca, -se * sa, ce];
    this.toward = [ce * ca, ce * sa, se];
    this.scale = scale;
    this.origin = origin;
  }

  /** The same direction at another scale, with a point of the room at a pixel. */
  placed(scale, point, [x, y]) {
    const origin = [x - dot(this.right, point) * scale, y + dot(this.up, point) * scale];
    return new Projection(this.azimuthDeg, this.elevationDeg, scale, origin);
  }

  /** The axes that point right and up, as indices, or null in a view that is turned. */
  get axes() {
    const axes = [this.right.indexOf(1), this.up.indexOf(1)];
    return axes.includes(-1) ? null : axes;
  }

  /** Pixels of a position in metres. */
  at(position) {
    return [
      this.origin[0] + dot(this.right, position) * this.scale,
      this.origin[1] - dot(this.up, position) * this.scale,
    ];
  }

  /** How far a position is towards the viewer, in metres: of two points at one pixel, the larger one hides the other. */
  depth(position) {
    return dot(this.toward, position);
  }

  /** Width and height, in metres, of a box of this size in the view. */
  extent(size) {
    return [this.right, this.up].map((unit) => unit.reduce((sum, c, axis) => sum + Math.abs(c) * size[axis], 0));
  }

  /** The 2 x 2 covariance, in the view's plane, of a 3 x 3 one: [[a, b], [b, d]]. */
  shadow(covariance) {
    const times = (vector) => covariance.map((row) => dot(row, vector));
    const [right, up] = [times(this.right), times(this.up)];
    const mixed = dot(this.up, right);
    return [[dot(this.right, right), mixed], [mixed, dot(this.up, up)]];
  }

  /**
   * The faces of the room behind everything in it: the one plane of a fixed view, or the floor and two walls.
   *
   * Each is { axis, value, along, view }: the coordinate that is constant on it, the axes along it, and the fixed view
   * that shows it from the front.
   */
  faces(size) {
    return [2, 0, 1].filter((axis) => Math.abs(this.toward[axis]) > EDGE_ON).map((axis) => ({
      axis,
      value: this.toward[axis] > 0 ? 0 : size[axis],
      along: [0, 1, 2].filter((other) => other !== axis),
      view: VIEW_OF_FACE[axis],
    }));
  }
}

/** A point of a face: see `Projection.faces`. */
export function onFace({ axis, value, along }, u, v) {
  const point = [0, 0, 0];
  point[axis] = value;
  point[along[0]] = u;
  point[along[1]] = v;
  return point;
}

/** The corners of the room in an order in which neighbours in bits are neighbours in the room: bit 0 is x, 1 y, 2 z. */
export function corners(size) {
  return Array.from({ length: 8 }, (_, index) => size.map((length, axis) => (index >> axis) & 1 ? length : 0));
}
