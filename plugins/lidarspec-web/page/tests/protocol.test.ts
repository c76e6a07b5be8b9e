import assert from "node:assert/strict";
import { test } from "node:test";
import { decoded, Pace, thinned } from "../src/protocol";

const HEADER = {
  scan: 12, position: 1.5, sent: 1e9, points: 3, of: 9, whole: true, rate_hz: null, nominal: false,
  columns: [{ name: "x", type: "f4", unit: "m" }, { name: "intensity", type: "u1", unit: "" }, { name: "index", type: "u4", unit: "" }],
}; // prettier-ignore

/** A message as the server sends it: what comes in columns begins at multiples of eight. */
function message(header: object = HEADER): Uint8Array<ArrayBuffer> {
  let text = JSON.stringify(header);
  text += " ".repeat((8 - ((4 + text.length) % 8)) % 8);
  const bytes = new Uint8Array(4 + text.length + 16 + 8 + 16);
  new DataView(bytes.buffer).setUint32(0, text.length, true);
  bytes.set(new TextEncoder().encode(text), 4);
  const begin = 4 + text.length;
  new Float32Array(bytes.buffer, begin, 3).set([1, -2, 0.5]);
  bytes.set([7, 8, 255], begin + 16);
  new Uint32Array(bytes.buffer, begin + 24, 3).set([0, 40, 70000]);
  return bytes;
}

test("the columns of a scan are views of the message", () => {
  const { buffer } = message();
  const scan = decoded(buffer);
  assert.equal(scan.scan, 12);
  assert.deepEqual([...scan.columns.get("x")!], [1, -2, 0.5]);
  assert.deepEqual(scan.columns.get("intensity"), Uint8Array.of(7, 8, 255));
  assert.deepEqual([...scan.columns.get("index")!], [0, 40, 70000]);
  assert.equal(scan.units.get("x"), "m");
  for (const column of scan.columns.values()) assert.equal(column.buffer, buffer);
});

test("a message within other bytes is read wherever it begins", () => {
  for (const offset of [1, 4, 8]) {
    const bytes = new Uint8Array(offset + message().length);
    bytes.set(message(), offset);
    const scan = decoded(new DataView(bytes.buffer, offset));
    assert.deepEqual([...scan.columns.get("x")!], [1, -2, 0.5]);
  }
});

test("what is cut off or of an unknown type is refused", () => {
  assert.throws(() => decoded(message().slice(0, -8).buffer), RangeError);
  const columns = [{ name: "x", type: "f2", unit: "m" }];
  assert.throws(() => decoded(message({ ...HEADER, columns }).buffer), /column x has the type f2/);
});

test("fewer points are asked for while pictures take long, and more again once they do not", () => {
  const pace = new Pace();
  pace.drawn(20, 40000, 80000);
  assert.ok(pace.most > 40000, "there is time for more");
  pace.drawn(160, 40000, 80000);
  assert.equal(pace.most, 30000, "halfway to what would have been in time");
  for (let time = 0; time < 10; time++) pace.drawn(1000, pace.most, 80000);
  assert.equal(pace.most, 20000, "no fewer than these");
  pace.drawn(60, 20000, 80000);
  assert.equal(pace.most, 20000, "in time, and not much time left");
  pace.drawn(10, 20000, 20000);
  assert.equal(pace.most, 20000, "all points are there");
});

test("how many points are drawn is said in words", () => {
  assert.equal(thinned(2160, 2160), "2,160 points");
  assert.equal(thinned(40000, 78750), "40,000 of 78,750 points");
});
