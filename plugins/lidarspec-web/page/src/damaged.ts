/** The frames that were damaged, the newest first, each with what is wrong with it. */

import { isNarrow, made, narrowness, Rows } from "./dom";
import type { Damage } from "./protocol";

/** Pixels of a row; those of a phone are touched. */
const LINE = { wide: 24, narrow: 44 };
/** Damaged frames that are kept in the list. */
const KEPT = 1000;

export class Damaged {
  readonly #list: Rows;
  readonly #empty = made("p", { className: "empty", textContent: "No damaged frame so far." });
  #frames: Damage[] = [];
  #chosen = -1;

  constructor(
    element: HTMLElement,
    readonly open: (number: number) => void,
  ) {
    const heading = made("div", { className: "heading damage" }, ...["Number", "Time", "Size", "Verdict"].map((name) => made("span", {}, name)));
    const list = made("div", { className: "scroll", tabIndex: 0, role: "group", ariaLabel: "Damaged frames" });
    element.append(heading, this.#empty, list);
    this.#list = new Rows(list, isNarrow() ? LINE.narrow : LINE.wide, (number) => this.#row(this.#frames[number]!));
    narrowness().addEventListener("change", () => {
      this.#list.height = isNarrow() ? LINE.narrow : LINE.wide;
      this.#list.show(this.#frames.length);
    });
  }

  /** Add those that have come since. */
  add(newest: Damage[]): void {
    if (!newest.length) return;
    this.#frames = [...newest.toReversed(), ...this.#frames].slice(0, KEPT);
    this.#empty.hidden = true;
    this.#list.show(this.#frames.length);
  }

  clear(): void {
    this.#frames = [];
    this.#empty.hidden = false;
    this.#list.show(0);
  }

  #row({ number, position, size, verdict }: Damage): HTMLElement {
    const cells = [String(number), position === null ? "" : `${position.toFixed(3)} s`, `${size} bytes`, verdict].map((text) => made("span", { textContent: text, title: text }));
    const choose = (): void => {
      this.#chosen = number;
      this.#list.show(this.#frames.length);
      this.open(number);
    };
    return made("button", { className: number === this.#chosen ? "damage kept" : "damage", onclick: choose, data: { number: String(number) } }, ...cells);
  }
}
