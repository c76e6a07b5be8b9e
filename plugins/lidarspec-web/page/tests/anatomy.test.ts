import assert from "node:assert/strict";
import { test } from "node:test";
import { Anatomy, bitPicture, octets } from "../src/anatomy";
import type { Explanation, Row, Value } from "../src/protocol";

function value(path: string, start: number, masks: string, raw: number): Value {
  return { path, raw, value: raw, text: String(raw), start, masks };
}

function row(offset: number, hex: string, path: string, values: Value[], others: Partial<Row> = {}): Row {
  return { offset, hex, path, meaning: "", right: true, remarks: [], values, ...others };
}

/** A head, two fields in one byte, an array of two elements, a byte of no field, and a checksum that is wrong. */
function explained(elements = 2): Explanation {
  const points = Array.from({ length: elements }, (_, index) => {
    const [path, at] = [`points[${index}]`, 2 + 3 * index];
    return row(at, "e8 03 07", path, [value(`${path}.distance`, at, "ff ff", 1000), value(`${path}.intensity`, at + 2, "ff", 7)], { meaning: "1.000 m" });
  });
  const end = 2 + 3 * elements;
  const rows = [
    row(0, "54", "header", [value("header", 0, "ff", 84)]),
    row(1, "a5", "flags", [value("flags.mode", 1, "f0", 10), value("flags.kind", 1, "0f", 5)]),
    ...points,
    row(end, "0d", "", []),
    row(end + 1, "99", "crc", [value("crc", end + 1, "ff", 0x99)], { right: false, remarks: ["0x99 is not 0x1f"] }),
  ];
  return { sensor: "x", frame: "data", size: end + 2, fault: null, notes: [], rows };
}

function anatomy(elements = 2): Anatomy {
  return new Anatomy(`54a5${"e80307".repeat(elements)}0d99`, explained(elements));
}

test("each byte has its fields, and each field its bits", () => {
  const frame = anatomy();
  assert.equal(frame.at(3)?.path, "points[0].distance");
  assert.equal(frame.at(7)?.path, "points[1].intensity");
  assert.deepEqual(frame.owners(1).map((owner) => frame.values[owner]!.path), ["flags.mode", "flags.kind"]);
  assert.deepEqual([...frame.bits(frame.nodes.get("flags.kind")!)], [[1, 0x0f]]);
  assert.deepEqual([...frame.bits(frame.nodes.get("flags")!)], [[1, 0xff]]);
  assert.deepEqual([...frame.bits(frame.nodes.get("points[1]")!).keys()], [5, 6, 7]);
  assert.deepEqual(frame.owners(8), []);
  assert.deepEqual([...frame.bits(frame.at(8)!)], [[8, 0xff]], "a byte of no field is pointed at as well");
});

test("a field has one colour in all elements of an array", () => {
  const frame = anatomy();
  assert.equal(frame.kind(2), frame.kind(5));
  assert.notEqual(frame.kind(2), frame.kind(4));
  assert.equal(frame.kind(8), null);
});

test("what is wrong, and what is to be said, stands at its node", () => {
  const frame = anatomy();
  assert.ok(frame.wrong(9) && !frame.wrong(8));
  assert.deepEqual([frame.nodes.get("crc")!.right, frame.nodes.get("crc")!.meaning], [false, "0x99 is not 0x1f"]);
  assert.equal(frame.nodes.get("points[1]")!.meaning, "1.000 m");
});

test("a small frame is unfolded, and of a large one the arrays are not", () => {
  const paths = (frame: Anatomy): string[] => frame.seen(frame.unfolded()).map(({ path }) => path);
  assert.ok(paths(anatomy()).includes("points[1].distance"));
  const large = anatomy(400);
  assert.deepEqual(paths(large), ["header", "flags", "flags.mode", "flags.kind", "points", large.at(1202)!.path, "crc"]);
  assert.deepEqual(large.around("points[7].distance"), ["points", "points[7]"]);
});

test("bytes and bits are read and drawn", () => {
  assert.deepEqual(octets("54 a5"), Uint8Array.of(0x54, 0xa5));
  assert.equal(bitPicture(0xa5, 0xf0), "1010····");
});
