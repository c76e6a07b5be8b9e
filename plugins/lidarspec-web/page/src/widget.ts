/**
 * A sensor in a cell of a notebook, as anywidget asks for it: the picture of the page, and a line of controls above and of words below.
 *
 * What goes to and fro is what page and server say to each other, over the notebook's own connection; the scans are its buffers.
 */

import { VIEWS } from "./ground";
import { Picture } from "./picture";
import { type Ask, decoded, type Hello, Pace, type State, thinned } from "./protocol";

interface Model {
  get(name: string): unknown;
  send(content: Ask | { do: "hello" | "close" }): void;
  on(event: "msg:custom", heard: Heard): void;
  off(event: "msg:custom", heard: Heard): void;
}
type Said = Hello | State | { is: "scan" } | { is: "ended"; text: string };
type Heard = (said: Said, buffers: DataView[]) => void;

/** The number of widgets that are shown, by their model: the last one that goes closes the source. */
const SHOWN = new WeakMap<Model, number>();

function render({ model, el }: { model: Model; el: HTMLElement }): () => void {
  const head = document.createElement("div");
  const body = document.createElement("div");
  const foot = document.createElement("div");
  Object.assign(head.style, { display: "flex", gap: "12px", alignItems: "center", padding: "4px 2px" });
  Object.assign(foot.style, { padding: "4px 2px", fontSize: "90%", minHeight: "1.4em", fontVariantNumeric: "tabular-nums" });
  el.replaceChildren(head, body, foot);
  foot.textContent = "opening";

  const pace = new Pace();
  let picture: Picture | null = null;
  let colours: HTMLElement | null = null;
  let [paused, seen, waiting, ended] = [false, true, false, ""];
  let words = "";
  const next = (): void => {
    if (waiting || paused || !seen || !picture) return;
    waiting = true;
    model.send({ do: "next", most: pace.most });
  };
  const tell = (): void => {
    const scan = picture?.scan;
    const points = scan ? thinned(scan.points, scan.of) : "";
    const speed = scan?.rate_hz ? `${scan.rate_hz.toFixed(1)} Hz` : "";
    foot.textContent = ended || [words, points, speed].filter(Boolean).join(" · ");
  };

  const begin = (hello: Hello): void => {
    picture?.close();
    body.style.height = `${String(model.get("height"))}px`;
    picture = new Picture(body, {
      planar: hello.planar,
      theme: isDark(el) ? "dark" : "light",
      drawn: (milliseconds, scan) => {
        pace.drawn(milliseconds, scan.points, scan.of);
        tell();
        next();
      },
    });
    const title = document.createElement("b");
    title.textContent = hello.title;
    const source = document.createElement("span");
    source.textContent = hello.source;
    Object.assign(source.style, { opacity: "0.7", flex: "1", overflow: "hidden", textOverflow: "ellipsis", whiteSpace: "nowrap" });
    const shown = picture;
    const views = hello.planar ? (["polar", "top"] as const) : (["orbit", "top", "side", "polar"] as const);
    const pause = document.createElement("button");
    pause.textContent = "pause";
    pause.onclick = () => {
      paused = !paused;
      pause.textContent = paused ? "play" : "pause";
      if (!hello.live) model.send({ do: paused ? "pause" : "play" });
      next();
    };
    colours = document.createElement("span");
    head.replaceChildren(title, source, colours, choice("view", [...views], (name) => VIEWS[name], (name) => shown.view(name)), pause);
    next();
  };

  const heard: Heard = (said, buffers) => {
    if (said.is === "hello") begin(said);
    else if (said.is === "scan" && buffers[0]) {
      waiting = false;
      if (paused || !picture) return;
      picture.show(decoded(buffers[0]));
      const by = picture; // what colours can show is known from the first scan on
      if (colours && !colours.firstChild) colours.append(choice("colour", by.colours, String, (name) => by.colour(name)));
    } else if (said.is === "state") words = [said.state, ...said.warnings].join(" · ");
    else if (said.is === "ended") ended = said.text;
    tell();
  };
  const watcher = new IntersectionObserver(([entry]) => {
    seen = entry?.isIntersecting ?? true;
    next();
  });

  SHOWN.set(model, (SHOWN.get(model) ?? 0) + 1);
  model.on("msg:custom", heard);
  watcher.observe(el);
  model.send({ do: "hello" });
  return () => {
    model.off("msg:custom", heard);
    watcher.disconnect();
    picture?.close();
    const left = (SHOWN.get(model) ?? 1) - 1;
    SHOWN.set(model, left);
    if (left === 0) model.send({ do: "close" });
  };
}

function choice<Name extends string>(what: string, names: Name[], said: (name: Name) => string, chosen: (name: Name) => void): HTMLElement {
  const select = document.createElement("select");
  select.title = what;
  select.append(...names.map((name) => new Option(said(name), name)));
  select.onchange = () => chosen(select.value as Name);
  return select;
}

/** Whether letters are lighter than what they stand on, as far as their own colour says it. */
function isDark(el: HTMLElement): boolean {
  const [red, green, blue] = (getComputedStyle(el).color.match(/[\d.]+/g) ?? []).map(Number) as [number, number, number];
  return 0.3 * red + 0.59 * green + 0.11 * blue > 128;
}

export default { render };
