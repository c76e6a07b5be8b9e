import assert from "node:assert/strict";
import { test } from "node:test";
import { described } from "../src/picture";
import type { Scan } from "../src/protocol";

function scan(x: number[], y: number[], z: number[]): Scan {
  const columns = new Map(Object.entries({ x, y, z }).map(([name, column]) => [name, Float32Array.from(column)]));
  columns.set("range", Float32Array.from(x, (ahead, row) => Math.hypot(ahead, y[row]!, z[row]!)));
  return { scan: 0, position: 0, sent: 0, points: x.length, of: x.length, whole: true, rate_hz: 10, nominal: false, columns, units: new Map() };
}

test("a point is said in words", () => {
  assert.equal(described(scan([0, 3], [2, 4], [0, 0]), 1, true), "range 5 m   azimuth 53.13°\nx 3.000  y 4.000 m");
});
