// tests/anatomy.test.ts
import assert from "node:assert/strict";
import { test } from "node:test";

// src/anatomy.ts
var SMALL = 80;
var NOWHERE = "no field";
var Anatomy = class {
  constructor(hex, explanation) {
    this.explanation = explanation;
    this.bytes = octets(hex);
    this.#owners = Array.from(this.bytes, () => []);
    this.#wrong = Array.from(this.bytes, () => false);
    for (const row2 of explanation.rows) this.#add(row2);
  }
  explanation;
  bytes;
  values = [];
  roots = [];
  /** by path */
  nodes = /* @__PURE__ */ new Map();
  /** paths without indices, in order: a field has one colour in all elements of an array */
  kinds = /* @__PURE__ */ new Map();
  #masks = [];
  #owners;
  #wrong;
  /** The numbers of the values that have bits in a byte. */
  owners(offset) {
    return this.#owners[offset] ?? [];
  }
  /** Whether a byte is not what the spec asks for. */
  wrong(offset) {
    return this.#wrong[offset] ?? false;
  }
  /** The colour of a byte: the number of its first field among those of other names; null where it has none. */
  kind(offset) {
    const owner = this.#owners[offset]?.[0];
    return owner === void 0 ? null : this.kinds.get(plain(this.values[owner].path));
  }
  /** The node of a byte; of one with several, that of the highest bits. */
  at(offset) {
    const owner = this.#owners[offset]?.[0];
    if (owner !== void 0) return this.nodes.get(this.values[owner].path);
    return [...this.nodes.values()].find((node) => node.value === null && !node.inside.length && node.start <= offset && offset < node.end) ?? null;
  }
  /** Which bits of which bytes are a node's own, by offset. */
  bits(node) {
    const found = /* @__PURE__ */ new Map();
    if (node.value === null && !node.inside.length) for (let offset = node.start; offset < node.end; offset++) found.set(offset, 255);
    if (node.value !== null) {
      const { start } = this.values[node.value];
      this.#masks[node.value].forEach((mask, place) => mask && found.set(start + place, (found.get(start + place) ?? 0) | mask));
    }
    for (const child of node.inside) for (const [offset, mask] of this.bits(child)) found.set(offset, (found.get(offset) ?? 0) | mask);
    return found;
  }
  /** The nodes that are seen where these are unfolded, in the order of the wire. */
  seen(unfolded, nodes = this.roots) {
    return nodes.flatMap((node) => unfolded.has(node.path) ? [node, ...this.seen(unfolded, node.inside)] : [node]);
  }
  /** What is unfolded at first: all of a small frame, of a large one what is in no array. */
  unfolded() {
    const folders = [...this.nodes.values()].filter((node) => node.inside.length);
    const isArray = (node) => node.inside.length > 1 && node.inside[0].name.startsWith("[");
    return new Set(folders.filter((node) => this.nodes.size <= SMALL || !isArray(node)).map((node) => node.path));
  }
  /** The paths of the nodes around one, which have to be unfolded for it to be seen. */
  around(path) {
    const parts = split(path);
    return parts.slice(1).map((_, number) => joined(parts.slice(0, number + 1)));
  }
  #add(row2) {
    const end = row2.offset + octets(row2.hex).length;
    for (let offset = row2.offset; offset < end; offset++) this.#wrong[offset] = !row2.right;
    for (const value2 of row2.values) this.#own(value2, row2);
    if (!row2.values.length) this.#leaf(row2.path || `${NOWHERE} at ${row2.offset}`, row2.offset, end).name ||= NOWHERE;
    const path = row2.values.length === 1 ? row2.values[0].path : row2.path;
    const node = this.nodes.get(path) ?? this.nodes.get(row2.values[0]?.path ?? `${NOWHERE} at ${row2.offset}`);
    if (!node) return;
    node.right = row2.right;
    const isAlone = node.value !== null || !row2.values.length;
    node.meaning = isAlone ? [.../* @__PURE__ */ new Set([...row2.remarks, row2.values[0]?.docs ?? "", row2.values.length ? "" : row2.meaning])].filter(Boolean).join("; ") : row2.meaning;
  }
  #own(value2, row2) {
    const number = this.values.push(value2) - 1;
    const masks = octets(value2.masks);
    const kind = plain(value2.path);
    if (!this.kinds.has(kind)) this.kinds.set(kind, this.kinds.size);
    this.#masks.push(masks);
    masks.forEach((mask, place) => mask && this.#owners[value2.start + place]?.push(number));
    const node = this.#leaf(value2.path, value2.start, value2.start + masks.length);
    node.value = number;
    node.right = row2.right;
    node.meaning = value2.docs ?? "";
  }
  /** The node of a path, and those around it, which it makes larger. */
  #leaf(path, start, end) {
    const parts = path.startsWith(NOWHERE) ? [path] : split(path);
    let level = this.roots;
    let node;
    parts.forEach((name, depth) => {
      const own = joined(parts.slice(0, depth + 1));
      node = this.nodes.get(own) ?? { name, path: own, depth, inside: [], value: null, start, end, meaning: "", right: true };
      if (!this.nodes.has(own)) {
        this.nodes.set(own, node);
        level.push(node);
      }
      [node.start, node.end] = [Math.min(node.start, start), Math.max(node.end, end)];
      level = node.inside;
    });
    return node;
  }
};
function octets(hex) {
  const digits = hex.replaceAll(" ", "");
  return Uint8Array.from({ length: digits.length / 2 }, (_, place) => parseInt(digits.slice(2 * place, 2 * place + 2), 16));
}
function plain(path) {
  return path.replace(/\[\d+\]/g, "[]");
}
function split(path) {
  return path.split(/\.|(?=\[)/);
}
function joined(parts) {
  return parts.reduce((path, part) => part.startsWith("[") || !path ? path + part : `${path}.${part}`, "");
}
function bitPicture(byte, mask) {
  return Array.from({ length: 8 }, (_, place) => 7 - place).map((bit) => mask >> bit & 1 ? String(byte >> bit & 1) : "\xB7").join("");
}

// tests/anatomy.test.ts
function value(path, start, masks, raw) {
  return { path, raw, value: raw, text: String(raw), start, masks };
}
function row(offset, hex, path, values, others = {}) {
  return { offset, hex, path, meaning: "", right: true, remarks: [], values, ...others };
}
function explained(elements = 2) {
  const points = Array.from({ length: elements }, (_, index) => {
    const [path, at] = [`points[${index}]`, 2 + 3 * index];
    return row(at, "e8 03 07", path, [value(`${path}.distance`, at, "ff ff", 1e3), value(`${path}.intensity`, at + 2, "ff", 7)], { meaning: "1.000 m" });
  });
  const end = 2 + 3 * elements;
  const rows = [
    row(0, "54", "header", [value("header", 0, "ff", 84)]),
    row(1, "a5", "flags", [value("flags.mode", 1, "f0", 10), value("flags.kind", 1, "0f", 5)]),
    ...points,
    row(end, "0d", "", []),
    row(end + 1, "99", "crc", [value("crc", end + 1, "ff", 153)], { right: false, remarks: ["0x99 is not 0x1f"] })
  ];
  return { sensor: "x", frame: "data", size: end + 2, fault: null, notes: [], rows };
}
function anatomy(elements = 2) {
  return new Anatomy(`54a5${"e80307".repeat(elements)}0d99`, explained(elements));
}
test("each byte has its fields, and each field its bits", () => {
  const frame = anatomy();
  assert.equal(frame.at(3)?.path, "points[0].distance");
  assert.equal(frame.at(7)?.path, "points[1].intensity");
  assert.deepEqual(frame.owners(1).map((owner) => frame.values[owner].path), ["flags.mode", "flags.kind"]);
  assert.deepEqual([...frame.bits(frame.nodes.get("flags.kind"))], [[1, 15]]);
  assert.deepEqual([...frame.bits(frame.nodes.get("flags"))], [[1, 255]]);
  assert.deepEqual([...frame.bits(frame.nodes.get("points[1]")).keys()], [5, 6, 7]);
  assert.deepEqual(frame.owners(8), []);
  assert.deepEqual([...frame.bits(frame.at(8))], [[8, 255]], "a byte of no field is pointed at as well");
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
  assert.deepEqual([frame.nodes.get("crc").right, frame.nodes.get("crc").meaning], [false, "0x99 is not 0x1f"]);
  assert.equal(frame.nodes.get("points[1]").meaning, "1.000 m");
});
test("a small frame is unfolded, and of a large one the arrays are not", () => {
  const paths = (frame) => frame.seen(frame.unfolded()).map(({ path }) => path);
  assert.ok(paths(anatomy()).includes("points[1].distance"));
  const large = anatomy(400);
  assert.deepEqual(paths(large), ["header", "flags", "flags.mode", "flags.kind", "points", large.at(1202).path, "crc"]);
  assert.deepEqual(large.around("points[7].distance"), ["points", "points[7]"]);
});
test("bytes and bits are read and drawn", () => {
  assert.deepEqual(octets("54 a5"), Uint8Array.of(84, 165));
  assert.equal(bitPicture(165, 240), "1010\xB7\xB7\xB7\xB7");
});
