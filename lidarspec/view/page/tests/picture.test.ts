import assert from "node:assert/strict";
import { test } from "node:test";
import { around, described } from "../src/picture";
import type { Scan } from "../src/protocol";

function scan(x: number[], y: number[], z: number[]): Scan {
  const columns = new Map(Object.entries({ x, y, z }).map(([name, column]) => [name, Float32Array.from(column)]));
  columns.set("range", Float32Array.from(x, (ahead, row) => Math.hypot(ahead, y[row]!, z[row]!)));
  return { scan: 0, position: 0, sent: 0, points: x.length, of: x.length, whole: true, rate_hz: 10, nominal: false, columns, units: new Map() };
}

test("a sensor that looks all around is in the middle, and one that looks forward at the edge", () => {
  const round = around(scan([-4, 6], [-5, 3], [0, 0]));
  assert.deepEqual([round.low, round.high], [[-6, -5, 0], [6, 5, 0]]);
  const ahead = around(scan([1, 5.5], [-4, 3], [-1, 2]));
  assert.deepEqual([ahead.low[0], ahead.high[0], ahead.low[2]], [-0, 6, -1]);
});

test("a point is said in words", () => {
  assert.equal(described(scan([0, 3], [2, 4], [0, 0]), 1, true), "range 5 m   azimuth 53.13°\nx 3.000  y 4.000 m");
});
