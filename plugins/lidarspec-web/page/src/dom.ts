/** Elements of the page, made and found; text goes in as text alone. */

type Properties<K extends keyof HTMLElementTagNameMap> = Partial<Omit<HTMLElementTagNameMap[K], "style" | "dataset">> & {
  data?: Record<string, string>;
};

/** An element with its properties and what is in it. */
export function made<K extends keyof HTMLElementTagNameMap>(tag: K, properties: Properties<K> = {}, ...inside: (Node | string)[]): HTMLElementTagNameMap[K] {
  const { data, ...others } = properties;
  const element = Object.assign(document.createElement(tag), others);
  Object.assign(element.dataset, data);
  element.append(...inside);
  return element;
}

/** The element of the page with an id. */
// eslint-disable-next-line @typescript-eslint/no-unnecessary-type-parameters -- whoever names it knows what it is
export function named<T extends HTMLElement = HTMLElement>(id: string): T {
  const element = document.getElementById(id);
  if (element === null) throw new Error(`the page has no ${id}`);
  return element as T;
}

/** Whether the window is as narrow as a phone, as `style.css` has it. */
export function narrowness(): MediaQueryList {
  return matchMedia("(max-width: 699px)");
}

export function isNarrow(): boolean {
  return narrowness().matches;
}

/** Choose one of some buttons, or none. */
export function chosen(buttons: Iterable<HTMLElement>, value: string): void {
  for (const button of buttons) button.setAttribute("aria-pressed", String(button.dataset.value === value));
}

/** Rows beyond what is seen that are there as well, so that scrolling does not show gaps. */
const SPARE = 6;

/** Rows of one height in an element that scrolls, of which only those are made that are seen. */
export class Rows {
  readonly #inside = made("div", { className: "rows" });
  readonly #made = new Map<number, HTMLElement>();
  #count = 0;

  constructor(
    readonly element: HTMLElement,
    public height: number,
    readonly row: (number: number) => HTMLElement,
  ) {
    element.append(this.#inside);
    element.addEventListener("scroll", () => this.#fill());
    new ResizeObserver(() => this.#fill()).observe(element);
  }

  /** Make all rows anew. */
  show(count: number): void {
    this.#count = count;
    this.#made.clear();
    this.#inside.replaceChildren();
    this.#inside.style.height = `${count * this.height}px`;
    this.#fill();
  }

  /** Scroll so that a row is seen, as little as is needed. */
  reveal(number: number): void {
    const { scrollTop, clientHeight } = this.element;
    const top = number * this.height;
    if (top < scrollTop || top + this.height > scrollTop + clientHeight) this.element.scrollTop = top - clientHeight / 3;
    this.#fill();
  }

  #fill(): void {
    const { scrollTop, clientHeight } = this.element;
    const first = Math.max(Math.floor(scrollTop / this.height) - SPARE, 0);
    const last = Math.min(Math.ceil((scrollTop + clientHeight) / this.height) + SPARE, this.#count);
    for (const [number, row] of this.#made) {
      if (number >= first && number < last) continue;
      row.remove();
      this.#made.delete(number);
    }
    for (let number = first; number < last; number++) {
      if (this.#made.has(number)) continue;
      const row = this.row(number);
      row.style.top = `${number * this.height}px`;
      this.#made.set(number, row);
      this.#inside.append(row);
    }
  }
}
