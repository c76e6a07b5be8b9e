/**
 * The bytes of a frame beside the tree of its names: pointing at one marks the other.
 *
 * Only the rows that are seen are made, so that a large frame costs no more than a small one.
 */

import { Anatomy, bitPicture, hexed, type Part } from "./anatomy";
import { isNarrow, made, narrowness, Rows } from "./dom";
import type { Ask, Frame } from "./protocol";

/** Bytes in a row, and pixels of a row of bytes and of the tree: those of a phone are touched. */
const WIDE = { across: 16, line: 19, branch: 22 };
const NARROW = { across: 8, line: 32, branch: 44 };
/** Colours of fields, which begin again after so many. */
const KINDS = 8;
const COUNTS = new Intl.NumberFormat("en-US");

export class Bytes {
  readonly #live = made("button", { className: "live", textContent: "Live", title: "Follow the newest frame, or hold this one" });
  readonly #held = made("span", { className: "badge held", textContent: "held" });
  readonly #title = made("span", { className: "caption" });
  readonly #verdict = made("span", { className: "verdict" });
  readonly #said = made("p", { className: "said" });
  readonly #dump: Rows;
  readonly #tree: Rows;
  readonly #cells = new Map<number, HTMLElement[]>();
  readonly #branches = new Map<string, HTMLElement>();
  #anatomy: Anatomy | null = null;
  #frame: Frame | null = null;
  #seen: Part[] = [];
  #unfolded = new Set<string>();
  #pointed: Part | null = null;
  #kept: Part | null = null;
  #watching = true;
  #sizes = isNarrow() ? NARROW : WIDE;

  constructor(
    readonly element: HTMLElement,
    readonly ask: (words: Ask) => void,
  ) {
    const step = (by: number) => () => this.#step(by);
    const bar = made(
      "div",
      { className: "bar" },
      made("button", { textContent: "‹", title: "Previous frame", ariaLabel: "Previous frame", onclick: step(-1) }),
      made("button", { textContent: "›", title: "Next frame", ariaLabel: "Next frame", onclick: step(1) }),
      this.#live,
      this.#held,
      this.#title,
      this.#verdict,
    );
    const dump = made("div", { className: "dump scroll", tabIndex: 0, role: "group", ariaLabel: "Bytes" });
    const tree = made("div", { className: "tree scroll", tabIndex: 0, role: "tree", ariaLabel: "Fields" });
    const heading = made("div", { className: "heading branch" }, ...["Field", "Raw", "Value", "Meaning"].map((name) => made("span", {}, name)));
    element.append(bar, made("div", { className: "beside" }, made("div", { className: "column" }, dump, this.#said), made("div", { className: "column" }, heading, tree)));
    this.#dump = new Rows(dump, this.#sizes.line, (number) => this.#line(number));
    this.#tree = new Rows(tree, this.#sizes.branch, (number) => this.#branch(this.#seen[number]!));
    narrowness().addEventListener("change", () => this.#resize());
    this.#live.onclick = () => this.watch(!this.#watching);
    this.#listen(dump, tree);
    tree.onkeydown = (event) => this.#walk(event);
    this.#tell();
    this.#say(null, null);
  }

  /** Show the newest frame again and again, or hold the one that is shown. */
  watch(frames: boolean): void {
    this.#watching = frames;
    this.#tell();
    this.ask({ do: "watch", frames });
  }

  /** Say whether the frame is held. */
  #tell(): void {
    this.#live.setAttribute("aria-pressed", String(this.#watching));
    this.#held.hidden = this.#watching;
  }

  /** Whether the newest frame is shown again and again. */
  get watching(): boolean {
    return this.#watching;
  }

  /** Ask for one frame, and hold it. */
  #hold(words: Ask): void {
    this.watch(false);
    this.ask(words);
  }

  #step(by: number): void {
    if (!this.#frame) return;
    if (this.#frame.number === null) return this.gone("The neighbouring frames are no longer available.");
    const number = this.#frame.number + by;
    this.#hold(this.#frame.why === "damaged" ? { do: "frame", damaged: number } : { do: "frame", number });
  }

  /** The frame that a point came from. */
  ofPoint(scan: number, index: number): void {
    this.#hold({ do: "frame", point: { scan, index } });
  }

  /** A damaged frame by its number. */
  ofDamaged(damaged: number): void {
    this.#hold({ do: "frame", damaged });
  }

  /** Say that a frame is not kept any more. */
  gone(what: string): void {
    this.#verdict.textContent = what;
    this.#verdict.className = "verdict bad";
  }

  show(frame: Frame): void {
    if (frame.why === "last" && !this.#watching) return; // it was on its way when another was held
    const before = this.#anatomy?.explanation.frame;
    this.#frame = frame;
    this.#anatomy = new Anatomy(frame.hex, frame.explanation);
    if (before !== frame.explanation.frame) this.#unfolded = this.#anatomy.unfolded();
    this.#pointed = this.#same(this.#pointed);
    this.#kept = frame.value === null ? (frame.why === "last" ? this.#same(this.#kept) : null) : (this.#anatomy.nodes.get(frame.value) ?? null);
    this.#head(frame);
    this.#fill();
    this.#fold();
    if (frame.value !== null && this.#kept) this.#reveal(this.#kept);
    const fault = frame.explanation.fault;
    if (frame.why === "damaged" && fault) this.#dump.reveal(this.#lineOf(Math.min(fault.offset, this.#anatomy.bytes.length - 1)));
    this.#mark();
  }

  #fill(): void {
    this.#cells.clear();
    this.#dump.show(Math.ceil((this.#anatomy?.bytes.length ?? 0) / this.#sizes.across));
  }

  /** Make all rows anew in a window that has become narrow or wide. */
  #resize(): void {
    this.#sizes = isNarrow() ? NARROW : WIDE;
    this.#dump.height = this.#sizes.line;
    this.#tree.height = this.#sizes.branch;
    this.#fill();
    this.#fold();
  }

  /** The row of bytes that has an offset. */
  #lineOf(offset: number): number {
    return Math.floor(offset / this.#sizes.across);
  }

  #same(node: Part | null): Part | null {
    return node && (this.#anatomy?.nodes.get(node.path) ?? null);
  }

  #head({ number, position, explanation, why }: Frame): void {
    const { frame, size, fault, notes } = explanation;
    const time = position === null ? "" : ` · at ${position.toFixed(3)} s`;
    const which = number === null ? "" : ` · ${why === "damaged" ? "damaged" : "number"} ${COUNTS.format(number)}`;
    this.#title.textContent = `${frame || "no frame"}${which} · ${COUNTS.format(size)} bytes${time}`;
    this.#verdict.textContent = [fault?.reason ?? "valid", ...notes].join(" · ");
    this.#verdict.title = this.#verdict.textContent;
    this.#verdict.className = fault ? "verdict bad" : "verdict good";
  }

  #fold(): void {
    this.#seen = this.#anatomy?.seen(this.#unfolded) ?? [];
    this.#branches.clear();
    this.#tree.show(this.#seen.length);
  }

  /** Unfold what is around a node, and scroll both sides to it. */
  #reveal(node: Part): void {
    this.#anatomy!.around(node.path).forEach((path) => this.#unfolded.add(path));
    this.#fold();
    this.#tree.reveal(this.#seen.indexOf(node));
    this.#dump.reveal(this.#lineOf(node.start));
  }

  /** Go through the tree by arrow keys, as in other trees: left and right fold and unfold. */
  #walk(event: KeyboardEvent): void {
    const place = this.#kept ? this.#seen.indexOf(this.#kept) : -1;
    const node = this.#seen[place];
    const last = this.#seen.length - 1;
    const isOpen = node !== undefined && this.#unfolded.has(node.path);
    let next = place;
    if (event.key === "ArrowDown") next = Math.min(place + 1, last);
    else if (event.key === "ArrowUp") next = Math.max(place - 1, 0);
    else if (event.key === "Home") next = 0;
    else if (event.key === "End") next = last;
    else if (event.key === "ArrowRight" && node?.inside.length && !isOpen) this.#unfolded.add(node.path);
    else if (event.key === "ArrowLeft" && isOpen) this.#unfolded.delete(node.path);
    else return;
    event.preventDefault();
    this.#kept = this.#seen[next] ?? null;
    if (this.#kept) {
      this.#fold();
      this.#tree.reveal(this.#seen.indexOf(this.#kept));
      this.#dump.reveal(this.#lineOf(this.#kept.start));
    }
    this.#mark();
  }

  #listen(dump: HTMLElement, tree: HTMLElement): void {
    const target = (event: Event, key: "offset" | "path"): string | undefined => (event.target as Element).closest<HTMLElement>(`[data-${key}]`)?.dataset[key];
    const byte = (event: Event): number | null => {
      const offset = target(event, "offset");
      return offset === undefined ? null : Number(offset);
    };
    const point = (node: Part | null, offset: number | null = null): void => {
      this.#pointed = node;
      this.#mark(offset);
    };
    dump.addEventListener("mouseover", (event) => {
      const offset = byte(event);
      point(offset === null ? null : this.#anatomy!.at(offset), offset);
    });
    tree.addEventListener("mouseover", (event) => point(this.#anatomy?.nodes.get(target(event, "path") ?? "") ?? null));
    for (const side of [dump, tree]) side.addEventListener("mouseleave", () => point(null));
    dump.addEventListener("click", (event) => {
      const offset = byte(event);
      this.#kept = offset === null ? null : this.#anatomy!.at(offset);
      if (this.#kept) this.#reveal(this.#kept);
      this.#mark(offset);
    });
    tree.addEventListener("click", (event) => {
      const node = this.#anatomy?.nodes.get(target(event, "path") ?? "");
      if (!node) return;
      this.#kept = node;
      if (node.inside.length) {
        if (!this.#unfolded.delete(node.path)) this.#unfolded.add(node.path);
        this.#fold();
      }
      this.#dump.reveal(this.#lineOf(node.start));
      this.#mark();
    });
  }

  /** Mark the bytes of what is pointed at and of what was clicked, and say what it is. */
  #mark(offset: number | null = null): void {
    const anatomy = this.#anatomy;
    if (!anatomy) return;
    const marked = [this.#kept, this.#pointed].map((node) => (node ? anatomy.bits(node) : new Map<number, number>()));
    this.#cells.forEach((cells, place) => marks(cells, marked[0]!.get(place) ?? 0, marked[1]!.get(place) ?? 0));
    this.#branches.forEach((branch, path) => {
      keep(branch, path === this.#kept?.path);
      branch.classList.toggle("pointed", this.#pointed !== null && (path === this.#pointed.path || this.#isFolded(path, this.#pointed)));
    });
    const owners = offset === null ? [] : anatomy.owners(offset);
    this.#say(this.#pointed ?? this.#kept, owners.length > 1 ? offset : null);
  }

  /** Whether a node is inside of what is seen folded at a path. */
  #isFolded(path: string, node: Part): boolean {
    return !this.#unfolded.has(path) && (node.path.startsWith(`${path}.`) || node.path.startsWith(`${path}[`));
  }

  /** Name what is pointed at below the bytes; of a byte that several fields share, each with its bits. */
  #say(node: Part | null, shared: number | null): void {
    const anatomy = this.#anatomy;
    this.#said.replaceChildren();
    if (!node || !anatomy) return this.#said.append("Point at a byte or a field; click to keep it marked.");
    const nodes = shared === null ? [node] : anatomy.owners(shared).map((owner) => anatomy.nodes.get(anatomy.values[owner]!.path)!);
    for (const [number, part] of nodes.entries()) this.#said.append(...(number ? [made("br")] : []), ...this.#words(part, anatomy));
  }

  #words(node: Part, anatomy: Anatomy): (HTMLElement | string)[] {
    const value = node.value === null ? null : anatomy.values[node.value]!;
    const bytes = [...anatomy.bits(node)];
    const size = node.end - node.start;
    const hex = hexed(anatomy.bytes.slice(node.start, node.start + Math.min(size, 8))) + (size > 8 ? " …" : "");
    const drawn = value?.bits ? bytes.slice(0, 4).map(([offset, mask]) => bitPicture(anatomy.bytes[offset]!, mask)).join(" ") : hex;
    const where = `0x${node.start.toString(16).padStart(4, "0")}`;
    const text = value ? [value.text ?? "", value.bits ?? ""].filter(Boolean).join(", ") : `${COUNTS.format(size)} bytes`;
    return [made("code", {}, `${where}  ${drawn}`), " ", made("b", {}, node.path), ` ${text}`, node.meaning ? ` · ${node.meaning}` : ""];
  }

  /** A row of bytes: where they are, in hexadecimal, and as text. */
  #line(number: number): HTMLElement {
    const { bytes } = this.#anatomy!;
    const first = number * this.#sizes.across;
    const row = made("div", { className: "line" }, made("span", { className: "offset" }, first.toString(16).padStart(4, "0")));
    const [left, right] = [made("span", { className: "hex" }), made("span", { className: "text" })];
    for (let offset = first; offset < Math.min(first + this.#sizes.across, bytes.length); offset++) {
      const byte = bytes[offset]!;
      const cells = [hexed([byte]), byte > 31 && byte < 127 ? String.fromCharCode(byte) : "·"].map((text) => this.#cell(offset, text));
      left.append(cells[0]!);
      right.append(cells[1]!);
      this.#cells.set(offset, cells);
      marks(cells, this.#kept ? (this.#anatomy!.bits(this.#kept).get(offset) ?? 0) : 0, 0);
    }
    row.append(left, right);
    return row;
  }

  #cell(offset: number, text: string): HTMLElement {
    const anatomy = this.#anatomy!;
    const kind = anatomy.kind(offset);
    const colours = anatomy.wrong(offset) ? "wrong" : kind === null ? "" : `kind${kind % KINDS}`;
    return made("i", { className: colours, textContent: text, data: { offset: String(offset) } });
  }

  #branch(node: Part): HTMLElement {
    const value = node.value === null ? null : this.#anatomy!.values[node.value]!;
    const isFolder = node.inside.length > 0;
    const fold = isFolder ? (this.#unfolded.has(node.path) ? "▾" : "▸") : "";
    const name = made("span", { className: "name" }, made("i", { className: "fold", textContent: fold }), node.name);
    const kind = this.#anatomy!.kind(node.start);
    if (!isFolder && kind !== null) name.classList.add(`kind${kind % KINDS}`);
    name.style.paddingLeft = `${6 + 14 * node.depth}px`;
    const raw = isFolder ? folded(node) : String(value?.raw ?? "");
    const cells = [raw, value?.text ?? "", node.meaning].map((text) => made("span", { textContent: text, title: text }));
    const row = made("div", { className: node.right ? "branch" : "branch wrong", data: { path: node.path } }, name, ...cells);
    this.#branches.set(node.path, row);
    row.role = "treeitem";
    row.ariaLevel = String(node.depth + 1);
    if (isFolder) row.ariaExpanded = String(this.#unfolded.has(node.path));
    keep(row, node.path === this.#kept?.path);
    return row;
  }
}

/** Show that a row of the tree is kept, or that it is not. */
function keep(row: HTMLElement, isKept: boolean): void {
  row.classList.toggle("kept", isKept);
  row.ariaSelected = String(isKept);
}

/** What a folded node holds, in words. */
function folded(node: Part): string {
  const isArray = node.inside[0]!.name.startsWith("[");
  return isArray ? `${COUNTS.format(node.inside.length)} ×` : "";
}

/** Mark a byte in both its places: all of it, or some of its bits. */
function marks(cells: HTMLElement[], kept: number, pointed: number): void {
  for (const cell of cells) {
    cell.classList.toggle("kept", kept !== 0);
    cell.classList.toggle("pointed", pointed !== 0);
    cell.classList.toggle("some", (kept | pointed) !== 0 && (kept | pointed) !== 0xff);
  }
}
