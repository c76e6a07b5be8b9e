/** The figures of the source: the last minute as small charts, and all of them as they are now. */

import uPlot from "uplot";
import "uplot/dist/uPlot.min.css";
import { made } from "./dom";
import { missing, split } from "./missing";
import type { Figures } from "./protocol";

/** Seconds that charts show. */
const SHOWN = 60;
const TALL = 62;

interface Chart {
  title: string;
  unit: string;
  digits: number;
  of: (figures: Figures) => number | null;
  /** from what value on it is an alarm */
  alarming?: number;
  /** what the value is made of, in words */
  split?: (figures: Figures) => string;
}

const CHARTS: Chart[] = [
  { title: "Scan rate", unit: "Hz", digits: 2, of: ({ speed_hz }) => speed_hz ?? null },
  {
    title: "Packets missing",
    unit: "%",
    digits: 2,
    of: (figures) => missing(figures)?.total ?? null,
    alarming: 1,
    split: (figures) => {
      const found = missing(figures);
      return found === null ? "" : split(found);
    },
  },
  { title: "Jitter", unit: "ms", digits: 3, of: ({ jitter_s }) => (jitter_s == null ? null : 1e3 * jitter_s) },
  { title: "Clock offset", unit: "ms", digits: 2, of: ({ clock_offset_s: offset }) => (offset == null ? null : 1e3 * offset) },
];

const whole = new Intl.NumberFormat("en-US", { maximumFractionDigits: 0 });
const FIGURES: [string, (figures: Figures) => string | null][] = [
  ["Packets", ({ packet_rate_hz: rate }) => (rate == null ? null : `${whole.format(rate)} /s`)],
  ["Input", ({ bytes_per_s: rate }) => (rate == null ? null : rate < 1e6 ? `${(rate / 1e3).toFixed(1)} kB/s` : `${(rate / 1e6).toFixed(2)} MB/s`)],
  ["Points per scan", ({ points }) => (points == null ? null : whole.format(points))],
  ["Valid points", ({ points, valid }) => (!points || valid == null ? null : `${((100 * valid) / points).toFixed(1)} %`)],
  ["Bytes skipped", ({ skipped_rate }) => (skipped_rate == null ? null : `${(100 * skipped_rate).toFixed(2)} %`)],
  ["Packets lost", ({ lost }) => (lost == null ? null : whole.format(lost))],
  ["Incomplete returns", ({ incomplete_returns: groups }) => (groups ? whole.format(groups) : null)],
  ["Longest gap", ({ longest_gap_s: gap }) => (gap == null ? null : `${(1e3 * gap).toFixed(1)} ms`)],
  ["Disconnects", ({ disconnects }) => (disconnects ? whole.format(disconnects) : null)],
];

export class Charts {
  #times: number[] = [];
  readonly #series: (number | null)[][] = CHARTS.map(() => []);
  readonly #plots: uPlot[] = [];
  readonly #values = CHARTS.map(() => made("b"));
  readonly #splits = CHARTS.map(({ split: words }) => (words ? [made("p", { className: "split" })] : []));
  readonly #boxes: HTMLElement[];
  readonly #watcher: ResizeObserver;

  constructor(
    readonly element: HTMLElement,
    readonly list: HTMLElement,
  ) {
    this.#boxes = CHARTS.map(({ title }, number) =>
      made("div", { className: "chart" }, made("h2", {}, title, made("span", { className: "grow" }), this.#values[number]!), ...this.#splits[number]!, made("div", { className: "plot" })),
    );
    element.replaceChildren(...this.#boxes);
    this.#watcher = new ResizeObserver(() => this.#plots.forEach((plot) => plot.setSize({ width: this.#width, height: TALL })));
    this.theme();
    this.#watcher.observe(element);
  }

  /** Take in the figures of a moment. */
  add(figures: Figures): void {
    const { at } = figures;
    if (at === this.#times.at(-1)) return;
    this.#times.push(at);
    this.#series.forEach((series, number) => series.push(CHARTS[number]!.of(figures)));
    this.#splits.forEach((lines, number) => lines.forEach((line) => (line.textContent = CHARTS[number]!.split!(figures))));
    const old = this.#times.findIndex((time) => time >= at - SHOWN);
    for (const series of [this.#times, ...this.#series]) series.splice(0, old);
    this.#draw();
  }

  /** Write all figures down, with those that the page adds. */
  tell(figures: Figures | null, more: [string, string][]): void {
    const told = FIGURES.map(([name, text]): [string, string | null] => [name, figures && text(figures)]).filter((pair): pair is [string, string] => pair[1] !== null);
    this.list.replaceChildren(...[...told, ...more].flatMap(([name, text]) => [made("dt", {}, name), made("dd", { textContent: text })]));
  }

  clear(): void {
    for (const series of [this.#times, ...this.#series]) series.length = 0;
  }

  /** Draw anew in the colours of the page. */
  theme(): void {
    this.#plots.splice(0).forEach((plot) => plot.destroy());
    this.#boxes.forEach((box, number) => this.#plots.push(this.#plot(CHARTS[number]!, box.querySelector<HTMLElement>(".plot")!)));
    this.#draw();
  }

  get #width(): number {
    return Math.max(this.element.clientWidth - 24, 60);
  }

  #draw(): void {
    const now = this.#times.at(-1);
    const ago = this.#times.map((time) => time - (now ?? 0));
    this.#plots.forEach((plot, number) => {
      const series = this.#series[number]!;
      const { unit, digits, alarming } = CHARTS[number]!;
      const value = series.at(-1) ?? null;
      plot.setData([ago, series]);
      this.#values[number]!.textContent = value === null ? "–" : `${value.toFixed(digits)} ${unit}`;
      this.#values[number]!.className = alarming !== undefined && (value ?? 0) >= alarming ? "bad" : "";
      this.#boxes[number]!.hidden = !series.some((one) => one !== null);
    });
  }

  #plot({ digits }: Chart, box: HTMLElement): uPlot {
    const ink = (name: string): string => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
    const [line, text] = [ink("--line"), ink("--dim")];
    const font = "10px system-ui, sans-serif";
    return new uPlot(
      {
        width: this.#width,
        height: TALL,
        padding: [7, 4, 9, 0],
        cursor: { show: false },
        legend: { show: false },
        scales: { x: { time: false, range: [-SHOWN, 0] }, y: { range: (_, low, high) => spread(low, high) } },
        axes: [
          { show: false },
          {
            size: 40,
            font,
            stroke: text,
            gap: 4,
            ticks: { show: false },
            grid: { stroke: line, width: 1 },
            splits: (_, __, low, high) => [low, high],
            values: (_, ends) => ends.map((end) => (Math.abs(end) >= 100 ? end.toFixed(0) : end.toFixed(Math.min(digits, 2)))),
          },
        ],
        series: [{}, { stroke: ink("--accent"), width: 1.5, points: { show: false }, spanGaps: false }],
      },
      [[], []],
      box,
    );
  }
}

/** The ends of a chart: from zero, unless values stay close together far from it. */
function spread(low: number | null, high: number | null): [number, number] {
  if (low === null || high === null) return [0, 1];
  if (low < 0) {
    const around = Math.max(0.1 * (high - low), 0.1);
    return [low - around, high + around];
  }
  if (low > 0 && high - low < 0.5 * high) {
    const around = Math.max(high - low, 0.02 * high);
    return [low - around, high + around];
  }
  return [0, Math.max(high * 1.1, 0.1)];
}
