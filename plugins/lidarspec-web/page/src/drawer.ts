/** The drawer below the picture: tabs with a panel for each, and a button that hides it. Narrow windows show it full-screen. */

import { isNarrow, made, named, narrowness } from "./dom";

/** Pixels of the window's height from which on the drawer is open at first. */
const ROOMY = 800;
/** Pixels of the drawer at least, pixels that it leaves to the picture, and pixels of a key press. */
const LOWEST = 90;
const LEFT = 200;
const RESIZED = 40;
const TABS = { bytes: "Bytes", damaged: "Damaged", commands: "Commands" };
export type Tab = keyof typeof TABS;
const NAMES = Object.keys(TABS) as Tab[];

export class Drawer {
  readonly #element = named("drawer");
  readonly #fold = named<HTMLButtonElement>("fold");
  readonly #buttons = NAMES.map((tab) =>
    made("button", { id: `tab-${tab}`, role: "tab", data: { value: tab }, onclick: () => this.show(tab) }, TABS[tab], made("b")),
  );
  #open: Tab | null = null;
  #last: Tab = "bytes";

  /** `changed` is called when another panel is seen, or none. */
  constructor(readonly changed: () => void) {
    for (const button of this.#buttons) button.setAttribute("aria-controls", button.dataset.value!);
    named("tabs").append(...this.#buttons);
    named("tabs").onkeydown = (event) => this.#move(event);
    this.#fold.onclick = () => this.#toggle();
    narrowness().onchange = () => this.#arrange();
    this.#split();
    this.#open = innerHeight >= ROOMY && !isNarrow() ? "bytes" : null;
    this.#arrange();
  }

  /** The panel that is seen; null if none is. */
  get open(): Tab | null {
    return this.#open;
  }

  /** Open a panel, or hide all of them. */
  show(tab: Tab | null): void {
    if (tab === this.#open) return;
    this.#open = tab;
    this.#last = tab ?? this.#last;
    this.#arrange();
    this.changed();
  }

  /** Write a number beside the name of a tab; none for 0. */
  count(tab: Tab, number: number): void {
    this.#buttons[NAMES.indexOf(tab)]!.querySelector("b")!.textContent = number ? String(number) : "";
  }

  #toggle(): void {
    this.show(this.#open === null ? this.#last : null);
    if (this.#open === null) this.#buttons[NAMES.indexOf(this.#last)]!.focus();
  }

  #arrange(): void {
    const isOpen = this.#open !== null;
    for (const button of this.#buttons) {
      button.setAttribute("aria-selected", String(button.dataset.value === this.#open));
      button.tabIndex = button.dataset.value === this.#last ? 0 : -1;
    }
    for (const name of NAMES) named(name).hidden = name !== this.#open;
    this.#element.classList.toggle("open", isOpen);
    this.#fold.textContent = isOpen ? "Hide" : "Show";
    this.#fold.setAttribute("aria-expanded", String(isOpen));
    named("splitter").hidden = !isOpen;
    named("splitter").ariaValueNow = String(this.#element.clientHeight);
    const covers = isOpen && isNarrow();
    for (const covered of document.querySelectorAll<HTMLElement>("header, main")) covered.inert = covers;
  }

  /** Arrow keys, Home and End go from tab to tab. */
  #move(event: KeyboardEvent): void {
    const now = NAMES.indexOf(this.#open ?? this.#last);
    const last = NAMES.length - 1;
    const places: Record<string, number> = { ArrowRight: now === last ? 0 : now + 1, ArrowLeft: now === 0 ? last : now - 1, Home: 0, End: last };
    const place = places[event.key];
    if (place === undefined) return;
    event.preventDefault();
    event.stopPropagation();
    this.show(NAMES[place]!);
    this.#buttons[place]!.focus();
  }

  #split(): void {
    const splitter = named("splitter");
    const resize = (height: number): void => {
      const limited = Math.min(Math.max(height, LOWEST), innerHeight - LEFT);
      this.#element.style.height = `${limited}px`;
      splitter.ariaValueNow = String(Math.round(limited));
    };
    splitter.onpointerdown = (event) => splitter.setPointerCapture(event.pointerId);
    splitter.onpointermove = (event) => {
      if (splitter.hasPointerCapture(event.pointerId)) resize(innerHeight - event.clientY);
    };
    splitter.onkeydown = (event) => {
      const by = { ArrowUp: RESIZED, ArrowDown: -RESIZED }[event.key];
      if (by === undefined) return;
      event.preventDefault();
      event.stopPropagation();
      resize(this.#element.clientHeight + by);
    };
  }
}
