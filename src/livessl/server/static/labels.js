// Decides where labels stand on a plan, so that none covers another: computed from boxes alone.

/** Directions from an anchor to its label, as [right, down], the best first. */
const AROUND = [[0, 1], [0, -1], [1, 0], [-1, 0], [1, 1], [-1, 1], [1, -1], [-1, -1]];
/** Distances in pixels that a label is moved away from its anchor, where it has no place beside it. */
const AWAY = [16, 34, 56, 84, 120];
/** Least distance of two labels in pixels. */
const CLEAR = 2;

/**
 * Find a place for each label: { left, top, width, height, away }, or null where there is none.
 *
 * Labels are { width, height } with either `spots`, the only places [left, top] for it, or `anchor`, the point [x, y]
 * that it names, and `gap`, the radius in pixels of what is drawn there. One that is `far` is never beside its anchor.
 * The first labels choose first. None leaves `bounds`, or its own box `within`, and none covers a `taken` box. They cover
 * boxes to `avoid`, where other things are drawn, only if there is no other place. Boxes are { left, top, width, height }.
 */
export function placed(labels, bounds, { taken = [], avoid = [] } = {}) {
  const used = [...taken];
  return labels.map((label) => {
    const found = firstFree(label, bounds, used, avoid);
    if (found) used.push(found);
    return found;
  });
}

export function overlap(a, b, clear = 0) {
  return a.left < b.left + b.width + clear && b.left < a.left + a.width + clear
    && a.top < b.top + b.height + clear && b.top < a.top + a.height + clear;
}

/** Sets of the indices of points [x, y] of which each is within `reach` of another one of its set. */
export function together(points, reach) {
  const sets = [];
  points.forEach(([x, y], index) => {
    const near = sets.filter((set) => set.some((other) => Math.hypot(points[other][0] - x, points[other][1] - y) < reach));
    for (const set of near) sets.splice(sets.indexOf(set), 1);
    sets.push([...near.flat(), index]);
  });
  return sets.map((set) => set.sort((a, b) => a - b)).sort((a, b) => a[0] - b[0]);
}

function firstFree(label, bounds, used, avoid) {
  const places = label.spots ? label.spots.map(([left, top]) => boxAt(label, left, top, false)) : around(label);
  const within = label.within ?? bounds;
  const free = places.filter((box) => inside(box, within) && !used.some((other) => overlap(box, other, CLEAR)));
  return free.find((box) => !avoid.some((other) => overlap(box, other))) ?? free[0] ?? null;
}

/** Places around an anchor, the nearest first. */
function around(label) {
  const { anchor: [x, y], width, height, gap, far } = label;
  return (far ? AWAY : [0, ...AWAY]).flatMap((away) => AROUND.map(([right, down]) => {
    const reach = (gap + away) * (right && down ? Math.SQRT1_2 : 1);
    return boxAt(label, x + right * reach + ((right - 1) * width) / 2, y + down * reach + ((down - 1) * height) / 2, away > 0);
  }));
}

function boxAt({ width, height }, left, top, away) {
  return { left, top, width, height, away };
}

function inside({ left, top, width, height }, bounds) {
  return left >= bounds.left && top >= bounds.top
    && left + width <= bounds.left + bounds.width && top + height <= bounds.top + bounds.height;
}
