// tests/protocol.test.ts
import assert from "node:assert/strict";
import { test } from "node:test";

// src/protocol.ts
var TYPES = {
  f4: Float32Array,
  f8: Float64Array,
  u1: Uint8Array,
  u2: Uint16Array,
  u4: Uint32Array
};
var STEP = 8;
function decoded(data) {
  const [buffer, begin] = located(data);
  const length = new DataView(buffer, begin, 4).getUint32(0, true);
  const text = new TextDecoder().decode(new Uint8Array(buffer, begin + 4, length));
  const { columns: described, ...head } = JSON.parse(text);
  const columns = /* @__PURE__ */ new Map();
  let offset = begin + 4 + length;
  for (const { name, type } of described) {
    const Kind = TYPES[type];
    if (Kind === void 0) throw new TypeError(`column ${name} has the type ${type}, which this page does not know`);
    const column = new Kind(buffer, offset, head.points);
    columns.set(name, column);
    offset += Math.ceil(column.byteLength / STEP) * STEP;
  }
  return { ...head, columns, units: new Map(described.map(({ name, unit }) => [name, unit])) };
}
function located(data) {
  if (data instanceof ArrayBuffer) return [data, 0];
  if (data.buffer instanceof ArrayBuffer && data.byteOffset % STEP === 0) return [data.buffer, data.byteOffset];
  return [new Uint8Array(data.buffer, data.byteOffset, data.byteLength).slice().buffer, 0];
}
var BUDGET = 80;
var FIRST = 4e4;
var LEAST = 2e4;
var MOST = 1e6;
var Pace = class {
  most = FIRST;
  /** Take in how long a picture of so many points, of a scan of so many, has taken. */
  drawn(milliseconds, points, of) {
    const fitting = points * BUDGET / Math.max(milliseconds, 1);
    if (milliseconds > BUDGET) this.most = Math.max(Math.round(0.5 * (points + fitting)), LEAST);
    else if (points < of && milliseconds < BUDGET / 2) this.most = Math.min(Math.round(this.most * 1.25), MOST);
  }
};
var NUMBERS = new Intl.NumberFormat("en-US");
function thinned(points, of) {
  return `${points < of ? `${NUMBERS.format(points)} of ` : ""}${NUMBERS.format(of)} points`;
}

// tests/protocol.test.ts
var HEADER = {
  scan: 12,
  position: 1.5,
  sent: 1e9,
  points: 3,
  of: 9,
  whole: true,
  rate_hz: null,
  nominal: false,
  columns: [{ name: "x", type: "f4", unit: "m" }, { name: "intensity", type: "u1", unit: "" }, { name: "index", type: "u4", unit: "" }]
};
function message(header = HEADER) {
  let text = JSON.stringify(header);
  text += " ".repeat((8 - (4 + text.length) % 8) % 8);
  const bytes = new Uint8Array(4 + text.length + 16 + 8 + 16);
  new DataView(bytes.buffer).setUint32(0, text.length, true);
  bytes.set(new TextEncoder().encode(text), 4);
  const begin = 4 + text.length;
  new Float32Array(bytes.buffer, begin, 3).set([1, -2, 0.5]);
  bytes.set([7, 8, 255], begin + 16);
  new Uint32Array(bytes.buffer, begin + 24, 3).set([0, 40, 7e4]);
  return bytes;
}
test("the columns of a scan are views of the message", () => {
  const { buffer } = message();
  const scan = decoded(buffer);
  assert.equal(scan.scan, 12);
  assert.deepEqual([...scan.columns.get("x")], [1, -2, 0.5]);
  assert.deepEqual(scan.columns.get("intensity"), Uint8Array.of(7, 8, 255));
  assert.deepEqual([...scan.columns.get("index")], [0, 40, 7e4]);
  assert.equal(scan.units.get("x"), "m");
  for (const column of scan.columns.values()) assert.equal(column.buffer, buffer);
});
test("a message within other bytes is read wherever it begins", () => {
  for (const offset of [1, 4, 8]) {
    const bytes = new Uint8Array(offset + message().length);
    bytes.set(message(), offset);
    const scan = decoded(new DataView(bytes.buffer, offset));
    assert.deepEqual([...scan.columns.get("x")], [1, -2, 0.5]);
  }
});
test("what is cut off or of an unknown type is refused", () => {
  assert.throws(() => decoded(message().slice(0, -8).buffer), RangeError);
  const columns = [{ name: "x", type: "f2", unit: "m" }];
  assert.throws(() => decoded(message({ ...HEADER, columns }).buffer), /column x has the type f2/);
});
test("fewer points are asked for while pictures take long, and more again once they do not", () => {
  const pace = new Pace();
  pace.drawn(20, 4e4, 8e4);
  assert.ok(pace.most > 4e4, "there is time for more");
  pace.drawn(160, 4e4, 8e4);
  assert.equal(pace.most, 3e4, "halfway to what would have been in time");
  for (let time = 0; time < 10; time++) pace.drawn(1e3, pace.most, 8e4);
  assert.equal(pace.most, 2e4, "no fewer than these");
  pace.drawn(60, 2e4, 8e4);
  assert.equal(pace.most, 2e4, "in time, and not much time left");
  pace.drawn(10, 2e4, 2e4);
  assert.equal(pace.most, 2e4, "all points are there");
});
test("how many points are drawn is said in words", () => {
  assert.equal(thinned(2160, 2160), "2,160 points");
  assert.equal(thinned(4e4, 78750), "40,000 of 78,750 points");
});
