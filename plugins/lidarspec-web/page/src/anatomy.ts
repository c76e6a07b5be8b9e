/** What a frame is made of: its bytes, whose they are, and its names as a tree. */

import type { Explanation, Row, Value } from "./protocol";

export interface Part {
  /** "distance", "[3]", or what stands for bytes without a field */
  name: string;
  path: string;
  depth: number;
  inside: Part[];
  /** its number among the values, for a leaf */
  value: number | null;
  /** where it begins and ends in the frame */
  start: number;
  end: number;
  /** what else is to be said of it */
  meaning: string;
  right: boolean;
}

/** Nodes up to which all of a tree is unfolded at first. */
const SMALL = 80;
const NOWHERE = "no field";

export class Anatomy {
  readonly bytes: Uint8Array;
  readonly values: Value[] = [];
  readonly roots: Part[] = [];
  /** by path */
  readonly nodes = new Map<string, Part>();
  /** paths without indices, in order: a field has one colour in all elements of an array */
  readonly kinds = new Map<string, number>();
  readonly #masks: Uint8Array[] = [];
  readonly #owners: number[][];
  readonly #wrong: boolean[];

  constructor(
    hex: string,
    readonly explanation: Explanation,
  ) {
    this.bytes = octets(hex);
    this.#owners = Array.from(this.bytes, () => []);
    this.#wrong = Array.from(this.bytes, () => false);
    for (const row of explanation.rows) this.#add(row);
  }

  /** The numbers of the values that have bits in a byte. */
  owners(offset: number): number[] {
    return this.#owners[offset] ?? [];
  }

  /** Whether a byte is not what the spec asks for. */
  wrong(offset: number): boolean {
    return this.#wrong[offset] ?? false;
  }

  /** The colour of a byte: the number of its first field among those of other names; null where it has none. */
  kind(offset: number): number | null {
    const owner = this.#owners[offset]?.[0];
    return owner === undefined ? null : this.kinds.get(plain(this.values[owner]!.path))!;
  }

  /** The node of a byte; of one with several, that of the highest bits. */
  at(offset: number): Part | null {
    const owner = this.#owners[offset]?.[0];
    if (owner !== undefined) return this.nodes.get(this.values[owner]!.path)!;
    return [...this.nodes.values()].find((node) => node.value === null && !node.inside.length && node.start <= offset && offset < node.end) ?? null;
  }

  /** Which bits of which bytes are a node's own, by offset. */
  bits(node: Part): Map<number, number> {
    const found = new Map<number, number>();
    if (node.value === null && !node.inside.length) for (let offset = node.start; offset < node.end; offset++) found.set(offset, 0xff);
    if (node.value !== null) {
      const { start } = this.values[node.value]!;
      this.#masks[node.value]!.forEach((mask, place) => mask && found.set(start + place, (found.get(start + place) ?? 0) | mask));
    }
    for (const child of node.inside) for (const [offset, mask] of this.bits(child)) found.set(offset, (found.get(offset) ?? 0) | mask);
    return found;
  }

  /** The nodes that are seen where these are unfolded, in the order of the wire. */
  seen(unfolded: ReadonlySet<string>, nodes: Part[] = this.roots): Part[] {
    return nodes.flatMap((node) => (unfolded.has(node.path) ? [node, ...this.seen(unfolded, node.inside)] : [node]));
  }

  /** What is unfolded at first: all of a small frame, of a large one what is in no array. */
  unfolded(): Set<string> {
    const folders = [...this.nodes.values()].filter((node) => node.inside.length);
    const isArray = (node: Part): boolean => node.inside.length > 1 && node.inside[0]!.name.startsWith("[");
    return new Set(folders.filter((node) => this.nodes.size <= SMALL || !isArray(node)).map((node) => node.path));
  }

  /** The paths of the nodes around one, which have to be unfolded for it to be seen. */
  around(path: string): string[] {
    const parts = split(path);
    return parts.slice(1).map((_, number) => joined(parts.slice(0, number + 1)));
  }

  #add(row: Row): void {
    const end = row.offset + octets(row.hex).length;
    for (let offset = row.offset; offset < end; offset++) this.#wrong[offset] = !row.right;
    for (const value of row.values) this.#own(value, row);
    if (!row.values.length) this.#leaf(row.path || `${NOWHERE} at ${row.offset}`, row.offset, end).name ||= NOWHERE;
    const path = row.values.length === 1 ? row.values[0]!.path : row.path;
    const node = this.nodes.get(path) ?? this.nodes.get(row.values[0]?.path ?? `${NOWHERE} at ${row.offset}`);
    if (!node) return;
    node.right = row.right;
    const isAlone = node.value !== null || !row.values.length;
    node.meaning = isAlone ? [...new Set([...row.remarks, row.values[0]?.docs ?? "", row.values.length ? "" : row.meaning])].filter(Boolean).join("; ") : row.meaning;
  }

  #own(value: Value, row: Row): void {
    const number = this.values.push(value) - 1;
    const masks = octets(value.masks);
    const kind = plain(value.path);
    if (!this.kinds.has(kind)) this.kinds.set(kind, this.kinds.size);
    this.#masks.push(masks);
    masks.forEach((mask, place) => mask && this.#owners[value.start + place]?.push(number));
    const node = this.#leaf(value.path, value.start, value.start + masks.length);
    node.value = number;
    node.right = row.right;
    node.meaning = value.docs ?? "";
  }

  /** The node of a path, and those around it, which it makes larger. */
  #leaf(path: string, start: number, end: number): Part {
    const parts = path.startsWith(NOWHERE) ? [path] : split(path);
    let level = this.roots;
    let node!: Part;
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
}

/** The bytes of hexadecimal text, with or without spaces. */
export function octets(hex: string): Uint8Array {
  const digits = hex.replaceAll(" ", "");
  return Uint8Array.from({ length: digits.length / 2 }, (_, place) => parseInt(digits.slice(2 * place, 2 * place + 2), 16));
}

/** Bytes as hexadecimal text. */
export function hexed(bytes: Iterable<number>): string {
  return Array.from(bytes, (byte) => byte.toString(16).padStart(2, "0")).join(" ");
}

/** A path without indices: "points[].distance". */
export function plain(path: string): string {
  return path.replace(/\[\d+\]/g, "[]");
}

/** The parts of a path: "points", "[1]", "distance". */
function split(path: string): string[] {
  return path.split(/\.|(?=\[)/);
}

function joined(parts: string[]): string {
  return parts.reduce((path, part) => (part.startsWith("[") || !path ? path + part : `${path}.${part}`), "");
}

/** The bits of a byte, those of a mask as digits and the others as dots. */
export function bitPicture(byte: number, mask: number): string {
  return Array.from({ length: 8 }, (_, place) => 7 - place)
    .map((bit) => ((mask >> bit) & 1 ? String((byte >> bit) & 1) : "·"))
    .join("");
}
