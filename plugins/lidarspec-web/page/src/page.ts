/** The page: what the server says goes to the picture, the figures, the bytes and the lists; what one does goes back. */

import "./style.css";
import { Bytes } from "./bytes";
import { Charts } from "./charts";
import { Commands } from "./commands";
import { Controls } from "./controls";
import { Damaged } from "./damaged";
import { made, named } from "./dom";
import { Drawer } from "./drawer";
import { Picture, type Theme } from "./picture";
import { describeAge, isStale, reason, shorten } from "./staleness";
import { type Ask, Connection, type Hello, type Message, Pace, type Refused, type Scan, type State, thinned } from "./protocol";

/** Milliseconds from one look at the age of the picture to the next. */
const AGED = 500;
/** Milliseconds that a refusal is shown, and of the stretch that pictures a second are counted over. */
const TOLD = 8000;
const COUNTED = 3000;

class Page {
  readonly #pace = new Pace();
  readonly #connection: Connection;
  readonly #charts = new Charts(named("charts"), named("figures"));
  readonly #bytes = new Bytes(named("bytes"), (words) => this.#ask(words));
  readonly #damaged = new Damaged(named("damaged"), (number) => {
    this.#drawer.show("bytes");
    this.#bytes.ofDamaged(number);
  });
  readonly #commands = new Commands(named("commands"), (words) => this.#ask(words));
  readonly #drawer = new Drawer(() => this.#watch());
  readonly #dark = matchMedia("(prefers-color-scheme: dark)");
  readonly #pictures: number[] = [];
  #picture: Picture | null = null;
  #controls: Controls | null = null;
  #hello: Hello | null = null;
  #theme: Theme = "dark";
  #ended = "";
  #refused = "";
  #reason = "";
  #shown = "";
  #dismissed = "";
  /** the last state that the server has told, and when: milliseconds of this page */
  #state: State | null = null;
  #stateAt = 0;
  #refusals = 0;
  #open = false;
  #refusesLink = false;
  #latency = 0;

  constructor() {
    const url = new URL(`socket${location.search}`, location.href);
    url.protocol = url.protocol.replace("http", "ws");
    this.#dress(this.#dark.matches ? "dark" : "light");
    this.#dark.onchange = () => this.#dress(this.#dark.matches ? "dark" : "light");
    named("dismiss").onclick = () => this.#dismiss();
    setInterval(() => this.#age(), AGED);
    named("theme").onclick = () => this.#dress(this.#theme === "dark" ? "light" : "dark");
    document.addEventListener("visibilitychange", () => this.#watch());
    this.#connection = new Connection(url.href, {
      scan: (scan) => this.#picture?.show(scan),
      said: (message) => this.#said(message),
      connected: (open) => this.#connected(open),
    });
  }

  /** What the picture shows, for the console and for tests. */
  get picture(): Picture | null {
    return this.#picture;
  }

  /** Milliseconds from the last packet of the newest scan to when it was on the screen, and pictures a second. */
  get figures(): { latency: number; rate: number } {
    return { latency: this.#latency, rate: this.#rate() };
  }

  get #watched(): boolean {
    return this.#bytes.watching && this.#drawer.open === "bytes" && !document.hidden;
  }

  /** Ask for the newest frame twice a second while it is seen. */
  #watch(): void {
    if (this.#open) this.#ask({ do: "watch", frames: this.#watched });
  }

  #ask(words: Ask): void {
    if (!this.#connection.ask(words)) this.#notice();
  }

  #connected(open: boolean): void {
    this.#open = open;
    this.#ended = "";
    if (open) this.#refusesLink = false;
    else void this.#checkLink();
    this.#notice();
    if (open) this.#connection.next(this.#pace.most);
  }

  /** Find out whether a server is there that does not accept the token of this page: it was started again. */
  async #checkLink(): Promise<void> {
    try {
      const answer = await fetch(location.href, { method: "HEAD" });
      this.#refusesLink = answer.status === 403;
    } catch {
      this.#refusesLink = false; // no server
    }
    this.#notice();
  }

  #said(message: Message): void {
    switch (message.is) {
      case "hello":
        return this.#greet(message);
      case "state":
        return this.#tell(message);
      case "frame":
        return this.#bytes.show(message);
      case "gone":
        return this.#bytes.gone(message.what);
      case "composed":
        return this.#commands.composed(message);
      case "replied":
        return this.#commands.replied(message);
      case "refused":
        return this.#refuse(message);
      case "ended":
        this.#ended = message.text;
        return this.#notice();
    }
  }

  /** The first word of a server: what there is to see. */
  #greet(hello: Hello): void {
    const isSame = this.#hello?.sensor === hello.sensor && this.#hello.source === hello.source;
    this.#hello = hello;
    document.title = `${hello.title} · lidarspec`;
    named("title").textContent = hello.title;
    named("title").title = hello.sensor;
    named("source").textContent = hello.source;
    if (!isSame || !this.#picture) this.#begin(hello);
    this.#damaged.clear();
    this.#charts.clear();
    for (const figures of hello.history) this.#charts.add(figures);
    this.#commands.show(hello);
    if (this.#watched) this.#watch();
  }

  #begin(hello: Hello): void {
    this.#picture?.close();
    const element = named("picture");
    try {
      this.#picture = new Picture(element, {
        theme: this.#theme,
        planar: hello.planar,
        picked: (row, scan) => this.#picked(row, scan),
        drawn: (milliseconds, scan) => this.#drawn(milliseconds, scan),
      });
    } catch (error) {
      element.replaceChildren(made("p", { className: "empty", textContent: `This browser does not support WebGL: ${String(error)}` }));
      return;
    }
    this.#controls = new Controls(this.#picture, hello, (words) => this.#ask(words), (as) => void this.#save(as));
  }

  #picked(row: number, scan: Scan): void {
    this.#picture?.mark(row);
    this.#drawer.show("bytes");
    this.#bytes.ofPoint(scan.scan, scan.columns.get("index")![row]!);
  }

  #drawn(milliseconds: number, scan: Scan): void {
    this.#pace.drawn(milliseconds, scan.points, scan.of);
    this.#latency = Date.now() - 1000 * scan.sent;
    this.#pictures.push(performance.now());
    while (this.#pictures[0]! < performance.now() - COUNTED) this.#pictures.shift();
    named("amount").textContent = [thinned(scan.points, scan.of), scan.whole ? "" : "incomplete scan", scan.nominal ? "nominal calibration" : ""].filter(Boolean).join(" · ");
    this.#controls?.scanned(scan.position);
    this.#connection.next(this.#pace.most);
  }

  #rate(): number {
    return (1000 * this.#pictures.filter((time) => time > performance.now() - COUNTED).length) / COUNTED;
  }

  #tell(state: State): void {
    this.#state = state;
    this.#stateAt = performance.now();
    const status = named("status");
    status.textContent = state.paused ? "paused" : state.state;
    status.className = `badge ${state.paused ? "" : ["streaming", "playing"].includes(state.state) ? "good" : state.state === "ended" ? "" : "bad"}`;
    if (state.state !== "ended") this.#ended = "";
    this.#reason = state.paused ? "" : reason(state.state);
    this.#notice();
    this.#age();
    const isLive = this.#hello?.live === true && !state.paused;
    if (state.figures) this.#charts.add(state.figures);
    this.#charts.tell(state.figures, [...(state.clock ? [["Clock", state.clock] as [string, string]] : []), ["Drawing rate", `${this.#rate().toFixed(1)} /s`], ...(isLive && this.#latency ? [["Latency", `${this.#latency.toFixed(0)} ms`] as [string, string]] : [])]);
    const { source } = this.#hello ?? { source: "" };
    named("warnings").replaceChildren(...state.warnings.map((text) => made("p", { textContent: text.replace(`${source}: `, "") })));
    named("info").replaceChildren(...Object.entries(state.info).flatMap(([name, text]) => [made("dt", { textContent: name }), made("dd", { textContent: text })]));
    this.#damaged.add(state.damaged.newest);
    this.#drawer.count("damaged", state.damaged.total);
    this.#controls?.state(state);
    this.#commands.state(state.state);
  }

  #refuse(refused: Refused): void {
    if (refused.of === "compose" || refused.of === "send") return this.#commands.refused(refused);
    this.#refused = [refused.text, refused.next ? `next: ${refused.next}` : ""].filter(Boolean).join(" · ");
    clearTimeout(this.#refusals);
    this.#refusals = window.setTimeout(() => {
      this.#refused = "";
      this.#notice();
    }, TOLD);
    this.#notice();
  }

  /** The one line that says what is wrong: the connection before the source, and that before what was refused. */
  #notice(): void {
    let lost = this.#hello ? "Connection lost. Reconnecting." : "Connecting.";
    if (this.#refusesLink) lost = "The server was restarted with another token. Open the link that it printed.";
    const text = this.#open ? this.#ended || this.#refused || this.#reason : lost;
    if (text !== this.#shown) {
      this.#shown = text;
      this.#dismissed = "";
      named("reason").textContent = shorten(text, this.#hello?.source ?? "");
    }
    const notice = named("notice");
    notice.hidden = !text || text === this.#dismissed;
    notice.className = this.#open && this.#ended ? "" : "bad";
    if (!this.#open) [named("status").textContent, named("status").className] = ["no server", "badge bad"];
  }

  #dismiss(): void {
    this.#dismissed = this.#shown;
    this.#notice();
  }

  /** Dim a picture of a live source that is not the present any more, and say how old it is. */
  #age(): void {
    const state = this.#state;
    const scan = this.#picture?.scan;
    if (!state || !scan || !this.#hello) return;
    const age = state.at + (performance.now() - this.#stateAt) / 1000 - scan.sent;
    const stands = this.#hello.live && !(this.#open && state.paused);
    const stale = stands && isStale(age, scan.rate_hz);
    named("stage").classList.toggle("stale", stale);
    named("age").hidden = !stale;
    named("age").textContent = stale ? describeAge(age) : "";
  }

  async #save(as: string): Promise<void> {
    const scan = this.#picture?.scan;
    if (!this.#picture || !scan) return;
    try {
      const name = `${this.#hello!.sensor}-${scan.position.toFixed(3)}s.${as}`;
      download(as === "png" ? await this.#picture.image() : await fetched(`save/${scan.scan}.${as}${location.search}`), name);
    } catch (error) {
      this.#refuse({ is: "refused", of: "save", text: error instanceof Error ? error.message : String(error) });
    }
  }

  #dress(theme: Theme): void {
    this.#theme = theme;
    document.documentElement.dataset.theme = theme;
    this.#picture?.theme(theme);
    this.#charts.theme();
  }
}

async function fetched(path: string): Promise<Blob> {
  const answer = await fetch(path);
  if (!answer.ok) throw new Error((await answer.text()) || `the scan was not saved: ${answer.status}`);
  return answer.blob();
}

function download(blob: Blob, name: string): void {
  const href = URL.createObjectURL(blob);
  made("a", { href, download: name }).click();
  setTimeout(() => URL.revokeObjectURL(href), TOLD);
}

Object.assign(window, { lidarspec: new Page() });
