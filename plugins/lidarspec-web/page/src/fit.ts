/**
 * Fits a camera to a scan.
 *
 * The central 98 % of the points have to be on the canvas; a few far beyond the others do not shrink the picture. The direction of
 * the camera is given, its place follows: in the camera's own axes, a point at depth d is on the canvas if it is at most k (d + D)
 * beside the middle, where D is the distance of the camera and k follows from its lens and from the padding. The outermost points
 * on both sides give D and the middle, without iterating. An orthographic camera is the case in which all depths are 0.
 */

import type { Scan } from "./protocol";
import { sampleRows } from "./sampling";

export type Point = [number, number, number];
export interface Box {
  low: Point;
  high: Point;
}

/** The unit vectors of a camera in the world. */
export interface Axes {
  right: Point;
  up: Point;
  forward: Point;
}

export interface Lens {
  axes: Axes;
  /** tangent of half the field of view, from the middle up; 0 if the camera is orthographic */
  tangent: number;
}

export interface Canvas {
  width: number;
  height: number;
  /** pixels at the lower edge that points leave free if there is room elsewhere */
  footer: number;
}

export interface Fit {
  /** the point that is in the middle of the canvas */
  target: Point;
  /** metres from the camera to the target; half the height of the canvas in metres if the camera is orthographic */
  distance: number;
  /** the bounds of the points, and of the sensor if it is on the canvas as well */
  box: Box;
}

/** Share of the points that is fitted. */
export const CENTRAL = 0.98;
/** Share of the values of an axis at each end that does not count for its scale, by which distant points are found. */
const TAIL = 0.05;
/** Pixels between the points and the edges; flat views have their labels along the edges. */
const PADDING = 16;
const PADDING_FLAT = 22;
/** Least share of their size that points keep when the sensor and the corners of the floor are taken in as well. */
const WORTH = 0.97;
const MIN_DISTANCE = 0.1;
/** A picture whose points span less than this share of it is fitted again. */
const MIN_SPAN = 0.45;

/** Return the central points of a scan; those of a sample if the scan is long. */
export function centralPoints(scan: Scan): Point[] {
  const columns = ["x", "y", "z"].map((name) => scan.columns.get(name)!);
  const points = sampleRows(scan.points)
    .map((row) => columns.map((column) => column[row]!) as Point)
    .filter((point) => point.every(Number.isFinite));
  const ends = [0, 1, 2].map((axis) => {
    const values = points.map((point) => point[axis]!).sort((a, b) => a - b);
    return [TAIL, 1 - TAIL].map((share) => values[Math.round(share * (values.length - 1))] ?? 0) as [number, number];
  });
  const widest = Math.max(...ends.map(([low, high]) => high - low));
  const beyond = (point: Point): number =>
    Math.max(...ends.map(([low, high], axis) => Math.max(low - point[axis]!, point[axis]! - high) / Math.max(high - low, TAIL * widest, 1e-3)));
  const scores = points.map(beyond);
  const last = [...scores].sort((a, b) => a - b)[Math.ceil(CENTRAL * scores.length) - 1] ?? 0;
  return points.filter((_, number) => scores[number]! <= last);
}

export function boxOf(points: Point[]): Box {
  const box: Box = { low: [Infinity, Infinity, Infinity], high: [-Infinity, -Infinity, -Infinity] };
  for (const point of points) {
    for (const axis of [0, 1, 2] as const) {
      box.low[axis] = Math.min(box.low[axis], point[axis]);
      box.high[axis] = Math.max(box.high[axis], point[axis]);
    }
  }
  return box;
}

/** Place a camera so that all points are on the canvas, and the sensor and the floor below them if that costs little. */
export function fit(points: Point[], lens: Lens, canvas: Canvas): Fit {
  const bare = fitAll(points, lens, canvas);
  const least = WORTH * spanOf(points, bare, lens, canvas);
  const isWorth = (other: Fit): boolean => spanOf(points, other, lens, canvas) >= least;
  const withSensor: Point[] = [...points, [0, 0, 0]];
  let best = bare;
  let seen = points;
  const sensorFit = fitAll(withSensor, lens, canvas);
  if (isWorth(sensorFit)) {
    best = sensorFit;
    seen = withSensor;
  }
  const { low, high } = best.box;
  const floor = [low[0], high[0]].flatMap((x) => [low[1], high[1]].map((y): Point => [x, y, low[2]]));
  const floorFit = fitAll([...seen, ...floor], lens, canvas);
  return isWorth(floorFit) ? floorFit : best;
}

/** Return the share of the width or of the height of the canvas that points span, whichever is more. */
function spanOf(points: Point[], { target, distance }: Fit, { axes, tangent }: Lens, { width, height }: Canvas): number {
  let [left, right, bottom, top] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const point of points) {
    const away = point.map((value, axis) => value - target[axis]!) as Point;
    const half = tangent ? tangent * (distance + dot(away, axes.forward)) : distance;
    const [x, y] = [dot(away, axes.right) / half, dot(away, axes.up) / half];
    [left, right] = [Math.min(left, x), Math.max(right, x)];
    [bottom, top] = [Math.min(bottom, y), Math.max(top, y)];
  }
  return Math.max(((right - left) * height) / (2 * width), (top - bottom) / 2);
}

function fitAll(points: Point[], { axes, tangent }: Lens, { width, height, footer }: Canvas): Fit {
  const box = boxOf(points);
  const middle = box.low.map((low, axis) => (low + box.high[axis]!) / 2) as Point;
  const slope = tangent || 1;
  const padding = tangent ? PADDING : PADDING_FLAT;
  const across = (slope * Math.max(width - 2 * padding, 1)) / height;
  const upward = (slope * Math.max(height - 2 * padding, 1)) / height;
  const aboveFooter = (slope * (height - 2 * (padding + footer))) / height;
  let [left, right, bottom, top, lowest] = [Infinity, -Infinity, Infinity, -Infinity, Infinity];
  for (const point of points) {
    const away = point.map((value, axis) => value - middle[axis]!) as Point;
    const [x, y] = [dot(away, axes.right), dot(away, axes.up)];
    const depth = tangent ? dot(away, axes.forward) : 0;
    left = Math.min(left, x + across * depth);
    right = Math.max(right, x - across * depth);
    bottom = Math.min(bottom, y + upward * depth);
    top = Math.max(top, y - upward * depth);
    lowest = Math.min(lowest, y + aboveFooter * depth);
  }
  const distance = Math.max((right - left) / (2 * across), (top - bottom) / (2 * upward), MIN_DISTANCE);
  const beside = (left + right) / 2;
  // A lower camera shows the points farther up: above the footer, as far as they stay below the upper edge.
  const above = Math.max(top - upward * distance, Math.min((bottom + top) / 2, lowest + aboveFooter * distance));
  const target = middle.map((value, axis) => value + beside * axes.right[axis]! + above * axes.up[axis]!) as Point;
  return { target, distance, box };
}

/** Return whether points at these places are all on the canvas, and span enough of it. */
export function isFitted(places: ([number, number] | null)[], width: number, height: number): boolean {
  let [left, right, top, bottom] = [Infinity, -Infinity, Infinity, -Infinity];
  for (const place of places) {
    if (place === null) return false;
    left = Math.min(left, place[0]);
    right = Math.max(right, place[0]);
    top = Math.min(top, place[1]);
    bottom = Math.max(bottom, place[1]);
  }
  const isInside = left >= 0 && right <= width && top >= 0 && bottom <= height;
  return isInside && Math.max((right - left) / width, (bottom - top) / height) >= MIN_SPAN;
}

function dot(one: Point, other: Point): number {
  return one[0] * other[0] + one[1] * other[1] + one[2] * other[2];
}
