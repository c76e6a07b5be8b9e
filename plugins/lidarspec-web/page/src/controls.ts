/** What one does to the picture and to the source: views, colours, playing, recording, saving; with the mouse and with keys. */

import { chosen, made, named } from "./dom";
import { type View, VIEWS } from "./ground";
import type { Picture } from "./picture";
import type { Ask, Hello, State } from "./protocol";

const SIZES = ["auto", "1", "2", "3", "4", "6", "8"];
const SPEEDS = [0.1, 0.25, 0.5, 1, 2, 4, 8];
/** What a key zooms by, and the share of the picture that it moves. */
const ZOOM = 1.25;
const MOVE = 0.2;
const MOVES: Record<string, [number, number]> = { ArrowUp: [0, MOVE], ArrowDown: [0, -MOVE], ArrowLeft: [-MOVE, 0], ArrowRight: [MOVE, 0] };
/** Milliseconds from one place that is sought to the next while the bar is dragged. */
const SOUGHT = 150;
/** Milliseconds from one press of Record to the next that counts: the second click of a double click does not. */
const RECORD_AGAIN = 500;
const KEYS = [
  ["space", "pause and continue"],
  [".", "next scan, while paused"],
  ["c", "switch colours"],
  ["+ -", "zoom in and out"],
  ["arrows", "move the view"],
  ["enter", "frame of the point in the middle, if the picture has the focus"],
  ["0", "show all points"],
  ["1 2 3 4", "polar, top, side, 3D"],
  ["r", "start and stop recording to a file"],
  ["?", "this list"],
];

export class Controls {
  readonly #views = named("views");
  readonly #colour = named<HTMLSelectElement>("colour");
  readonly #play = named<HTMLButtonElement>("play");
  readonly #step = named<HTMLButtonElement>("step");
  readonly #seek = named<HTMLInputElement>("seek");
  readonly #speed = named<HTMLSelectElement>("speed");
  readonly #record = named<HTMLButtonElement>("record");
  readonly #keys = named<HTMLDialogElement>("keys");
  #paused = false;
  #duration: number | null = null;
  #sought = 0;
  #isRecording = false;
  #recordPressed = -RECORD_AGAIN;

  constructor(
    readonly picture: Picture,
    readonly hello: Hello,
    readonly ask: (words: Ask) => void,
    readonly save: (as: string) => void,
  ) {
    const seekable = hello.duration !== null && !hello.live;
    this.#duration = seekable ? hello.duration : null;
    this.#views.replaceChildren(...Object.entries(VIEWS).map(([view, text]) => made("button", { textContent: text, data: { value: view }, onclick: () => this.#view(view as View) })));
    chosen(this.#views.querySelectorAll("button"), hello.planar ? "polar" : "orbit");
    this.#colour.onchange = () => picture.colour(this.#colour.value);
    const size = named<HTMLSelectElement>("size");
    size.replaceChildren(...SIZES.map((pixels) => made("option", { value: pixels, textContent: pixels === "auto" ? pixels : `${pixels} px` })));
    size.onchange = () => picture.size(Number(size.value) || 0);
    named("reset").onclick = () => picture.reset();
    this.#play.onclick = () => this.#toggle();
    this.#step.onclick = () => this.ask({ do: "step" });
    this.#step.hidden = this.#seek.hidden = this.#speed.parentElement!.hidden = hello.live;
    this.#seek.max = String(this.#duration ?? 0);
    this.#seek.disabled = this.#duration === null;
    this.#seek.oninput = () => this.#seekTo(Number(this.#seek.value), SOUGHT);
    this.#seek.onchange = () => this.#seekTo(Number(this.#seek.value), 0);
    this.#speed.replaceChildren(...SPEEDS.map((times) => made("option", { value: String(times), textContent: `${times}×`, selected: times === 1 })));
    this.#speed.onchange = () => this.ask({ do: "speed", times: Number(this.#speed.value) });
    this.#record.hidden = !hello.records;
    this.#record.onclick = () => this.#switchRecording();
    const saves = [...hello.saves, "png"].map((as) => made("button", { textContent: as === "png" ? "picture .png" : `scan .${as}`, data: { value: as }, onclick: () => this.#saved(as) }));
    named("saves").replaceChildren(...saves);
    this.#keys.replaceChildren(made("h2", {}, "Keys"), made("dl", {}, ...KEYS.flatMap(([key, text]) => [made("dt", { textContent: key! }), made("dd", { textContent: text! })])));
    named("help").onclick = () => this.#keys.showModal();
    this.#keys.onclick = () => this.#keys.close();
    document.onkeydown = (event) => this.#pressed(event);
  }

  /** What colours can show is known with the first scan. */
  scanned(position: number): void {
    const names = this.picture.colours;
    if (this.#colour.options.length !== names.length) this.#colour.replaceChildren(...names.map((name) => made("option", { value: name, textContent: name })));
    this.#placed(position);
  }

  state({ state, paused, speed, position, recording }: State): void {
    this.#paused = paused || state === "ended";
    this.#play.textContent = this.#paused ? "▶ Play" : "❚❚ Pause";
    this.#step.disabled = !paused;
    this.#isRecording = recording !== null;
    this.#record.classList.toggle("on", this.#isRecording);
    named("recording").textContent = recording ? `${recording.name} · ${(recording.bytes / 1e6).toFixed(1)} MB` : "Record";
    const known = [...this.#speed.options].find(({ value }) => Number(value) === speed);
    if (known && document.activeElement !== this.#speed) known.selected = true;
    if (!this.picture.scan) this.#placed(position);
  }

  #placed(position: number): void {
    const isDragged = performance.now() - this.#sought < 4 * SOUGHT;
    if (!isDragged) this.#seek.value = String(position);
    named("position").textContent = clock(position) + (this.#duration === null ? "" : ` / ${clock(this.#duration)}`);
  }

  #seekTo(to: number, apart: number): void {
    if (performance.now() - this.#sought < apart) return;
    this.#sought = performance.now();
    this.ask({ do: "seek", to });
  }

  #toggle(): void {
    this.ask({ do: this.#paused ? "play" : "pause" });
  }

  /** Ask for the state that the button offers, so that two pages that are pressed at once agree. */
  #switchRecording(): void {
    if (performance.now() - this.#recordPressed < RECORD_AGAIN) return;
    this.#recordPressed = performance.now();
    this.ask({ do: "record", on: !this.#isRecording });
  }

  #view(view: View): void {
    this.picture.view(view);
    chosen(this.#views.querySelectorAll("button"), view);
  }

  #saved(as: string): void {
    named<HTMLDetailsElement>("save").open = false;
    this.save(as);
  }

  #pressed(event: KeyboardEvent): void {
    const target = event.target as Element;
    const isTyped = target.matches("input:not([type=range]), select, textarea") || (event.key === " " && target.matches("button, summary"));
    if (isTyped || event.ctrlKey || event.metaKey || event.altKey || (event.key.startsWith("Arrow") && target.matches("input, .scroll, #side"))) return;
    const views = Object.keys(VIEWS) as View[];
    const by = MOVES[event.key];
    if (by) this.picture.move(...by);
    else if (event.key === " ") this.#toggle();
    else if (event.key === "." && this.#paused && !this.hello.live) this.ask({ do: "step" });
    else if (event.key === "c") this.#nextColour();
    else if (event.key === "+" || event.key === "=") this.picture.zoom(ZOOM);
    else if (event.key === "-") this.picture.zoom(1 / ZOOM);
    else if (event.key === "0") this.picture.reset();
    else if (event.key === "r" && this.hello.records) this.#switchRecording();
    else if (event.key === "?") this.#keys.showModal();
    else if (views[Number(event.key) - 1]) this.#view(views[Number(event.key) - 1]!);
    else return;
    event.preventDefault();
  }

  #nextColour(): void {
    this.#colour.selectedIndex = (this.#colour.selectedIndex + 1) % Math.max(this.#colour.options.length, 1);
    this.picture.colour(this.#colour.value);
  }
}

/** Seconds as minutes and seconds: "1:02.3". */
function clock(seconds: number): string {
  const minutes = Math.floor(seconds / 60);
  return `${minutes}:${(seconds - 60 * minutes).toFixed(1).padStart(4, "0")}`;
}
