import assert from "node:assert/strict";
import { test } from "node:test";
import { OrthographicCamera, PerspectiveCamera, Vector3 } from "three";
import { boxOf, CENTRAL, centralPoints, fit, isFitted, type Point } from "../src/fit";
import { axesOf } from "../src/picture";
import type { Scan } from "../src/protocol";
import { sampleRows } from "../src/sampling";

const SIZES = [
  [1176, 435],
  [390, 464],
] as const;
const TANGENT = Math.tan(Math.PI / 8);

function scan(points: Point[]): Scan {
  const columns = new Map(["x", "y", "z"].map((name, axis) => [name, Float32Array.from(points, (point) => point[axis]!)]));
  const count = points.length;
  return { scan: 0, position: 0, sent: 0, points: count, of: count, whole: true, rate_hz: 10, nominal: false, columns, units: new Map() };
}

/** The walls of a room, the middle of which is somewhere, and a share of points far beyond it. */
function room(middle: Point, size: Point, outliers: number): Point[] {
  const count = 3000;
  return Array.from({ length: count }, (_, number) => {
    if (number < outliers * count) return [200, 150, 40];
    const turn = (number / count) * 2 * Math.PI;
    const [x, y] = [Math.cos(turn), Math.sin(turn)].map((part) => part / Math.max(Math.abs(Math.cos(turn)), Math.abs(Math.sin(turn)))) as [number, number];
    return [x, y, ((number * 7) % 16) / 8 - 1].map((part, axis) => middle[axis]! + (part * size[axis]!) / 2) as Point;
  });
}

/** The share of the width and of the height of the canvas that points span, through a camera of three.js. */
function spans(points: Point[], view: "orbit" | "top" | "side", width: number, height: number): [number, number] {
  const central = centralPoints(scan(points));
  const axes = axesOf(view);
  const isDeep = view === "orbit";
  const found = fit(central, { axes, tangent: isDeep ? TANGENT : 0 }, { width, height, footer: 60 });
  const half = found.distance;
  const aspect = width / height;
  const camera = isDeep ? new PerspectiveCamera(45, aspect, half / 500, half * 50) : new OrthographicCamera(-half * aspect, half * aspect, half, -half, 0, 1000);
  camera.up.set(...axes.up);
  camera.position.set(...found.target).addScaledVector(new Vector3(...axes.forward), isDeep ? -half : -500);
  camera.lookAt(...found.target);
  camera.updateMatrixWorld();
  camera.updateProjectionMatrix();
  const places = central.map((point) => new Vector3(...point).project(camera));
  assert.ok(places.every(({ x, y }) => Math.abs(x) <= 1 && Math.abs(y) <= 1), "a central point is not on the canvas");
  return (["x", "y"] as const).map((name) => (Math.max(...places.map((place) => place[name])) - Math.min(...places.map((place) => place[name]))) / 2) as [number, number];
}

for (const view of ["orbit", "top", "side"] as const) {
  test(`points fill the canvas of the ${view} view, whatever a few far ones do`, () => {
    for (const [width, height] of SIZES) {
      for (const middle of [[0, 0, 0], [30, -4, 1]] as Point[]) {
        for (const outliers of [0, 0.015]) {
          const [across, down] = spans(room(middle, [8, 5, 2.4], outliers), view, width, height);
          assert.ok(Math.max(across, down) > 0.88, `${middle.join(" ")} ${width}x${height}: ${across.toFixed(2)} and ${down.toFixed(2)}`);
        }
      }
    }
  });
}

test("the central points are 98 % of all, without those far away", () => {
  const central = centralPoints(scan(room([0, 0, 0], [8, 5, 2], 0.02)));
  assert.equal(central.length, CENTRAL * 3000);
  assert.deepEqual(boxOf(central), { low: [-4, -2.5, -1], high: [4, 2.5, 0.875] });
  assert.equal(centralPoints(scan([])).length, 0);
  assert.deepEqual(centralPoints(scan([[1, 2, NaN], [3, 4, 0]])), [[3, 4, 0]]);
});

test("the sensor is on the canvas if it costs little", () => {
  const box = (points: Point[]) => fit(points, { axes: axesOf("top"), tangent: 0 }, { width: 400, height: 400, footer: 0 }).box;
  assert.equal(box([[0.1, -3, 0], [6, 3, 0]]).low[0], 0);
  assert.equal(box([[14, -3, 0], [16, 3, 0]]).low[0], 14);
});

test("points leave the lower edge to the bar of colours if there is room above", () => {
  const lowest = (footer: number): number => {
    const found = fit([[-1, -2, 0], [1, 2, 0]], { axes: axesOf("top"), tangent: 0 }, { width: 400, height: 500, footer });
    return 250 * (1 + (1 + found.target[0]) / found.distance);
  };
  assert.ok(lowest(60) < 500 - 60, String(lowest(60)));
  assert.ok(lowest(0) > 330);
});

test("a picture stays until points leave it or need less than half of it", () => {
  assert.ok(isFitted([[10, 10], [390, 300]], 400, 400));
  assert.ok(isFitted([[100, 100], [290, 290]], 400, 400));
  assert.ok(!isFitted([[10, 10], [401, 300]], 400, 400));
  assert.ok(!isFitted([[10, 10], null], 400, 400));
  assert.ok(!isFitted([[100, 100], [250, 250]], 400, 400));
});

test("samples of a column are of all its rings", () => {
  const rings = sampleRows(131072).map((row) => row % 64);
  assert.equal(rings.length, 4000);
  assert.equal(new Set(rings).size, 64);
  assert.deepEqual(sampleRows(3), [0, 1, 2]);
});
