/**
 * What is drawn around the points: rings and angles, grids in metres, the sensor and where it looks, and what the colours mean.
 *
 * All of it is in the two dimensions of a canvas, and places in the world come through `Outlook.place`; it is drawn when the view
 * changes, and not for each scan.
 */

import { colour, roundedUp, type Span, type Theme } from "./colours";
import type { Box } from "./fit";

/** The views, by what people call them. */
export const VIEWS = { polar: "Polar", top: "Top", side: "Side", orbit: "3D" };
export type View = keyof typeof VIEWS;
export type Place = [number, number];

export interface Outlook {
  view: View;
  theme: Theme;
  width: number;
  height: number;
  /** the bounds of what is fitted, in metres; the floor is at its lower end */
  box: Box;
  /** where a point of the world is on the canvas; null behind the camera */
  place: (x: number, y: number, z: number) => Place | null;
  /** where the camera stands */
  camera: [number, number, number];
}

interface Inks {
  paper: string;
  line: string;
  faint: string;
  text: string;
  strong: string;
  axes: [string, string, string];
}

export const INKS: Record<Theme, Inks> = {
  dark: { paper: "#0e1116", line: "#2b323c", faint: "#1b2028", text: "#8d98a7", strong: "#e6eaf0", axes: ["#e5645a", "#5fb968", "#5b93e6"] },
  light: { paper: "#ffffff", line: "#cfd5dd", faint: "#e9ecf0", text: "#66707d", strong: "#1b2027", axes: ["#c4362b", "#2c8a3a", "#2563c4"] },
};

const FONT = "11px system-ui, sans-serif";
const TEXT_HEIGHT = 14;
/** Pixels from a label to the edge of the canvas at least, and to the next one in its line. */
const RIM = 2;
const APART_X = 6;
/** Pixels between two lines of a grid at least, and degrees between two spokes. */
const APART = 70;
const SPOKES = 30;
/** Pieces that a line in perspective is drawn in, so that the part of it behind the camera can be left out. */
const PIECES = 32;
const EDGE = 14;

/** Draw what lies under the points. */
export function ground(context: CanvasRenderingContext2D, outlook: Outlook): void {
  const { width, height, theme } = outlook;
  context.fillStyle = INKS[theme].paper;
  context.fillRect(0, 0, width, height);
  context.lineWidth = 1;
  if (outlook.view === "polar") rings(context, outlook);
  else if (outlook.view === "orbit") floor(context, outlook);
  else grid(context, outlook);
}

/** The edges of a part of the canvas, in pixels: left, top, right, bottom. */
export type Rect = [number, number, number, number];

/** Draw what stands over the points: numbers at the lines, and the sensor; `taken`: parts of the canvas without labels. */
export function labels(context: CanvasRenderingContext2D, outlook: Outlook, taken: Rect[] = []): void {
  context.font = FONT;
  const writer = new Writer(context, outlook, taken);
  if (outlook.view === "orbit" || outlook.view === "side") axes(context, outlook, writer);
  else sensor(context, outlook, writer);
  if (outlook.view === "polar") ringLabels(writer, outlook);
  else if (outlook.view === "orbit") floorLabels(writer, outlook);
  else gridLabels(writer, outlook);
}

/** Writes labels that touch neither each other nor the edges of the canvas; those for which there is no room are left out. */
class Writer {
  readonly #taken: Rect[];

  constructor(
    readonly context: CanvasRenderingContext2D,
    readonly outlook: Outlook,
    taken: Rect[],
  ) {
    this.#taken = [...taken];
  }

  /** Write no label on a part of the canvas. */
  keepFree(rect: Rect): void {
    this.#taken.push(rect);
  }

  /** Write a text at the first place where there is room. */
  write(text: string, places: [Place, CanvasTextAlign][], ink?: string): void {
    const width = this.context.measureText(text).width;
    for (const [place, align] of places) {
      const left = place[0] - width * (align === "left" ? 0 : align === "right" ? 1 : 0.5);
      const rect: Rect = [left, place[1] - TEXT_HEIGHT / 2, left + width, place[1] + TEXT_HEIGHT / 2];
      if (!this.#isFree(rect)) continue;
      this.keepFree(rect);
      written(this.context, text, place, this.outlook.theme, align, ink);
      return;
    }
  }

  #isFree([left, top, right, bottom]: Rect): boolean {
    const { width, height } = this.outlook;
    if (left < RIM || top < RIM || right > width - RIM || bottom > height - RIM) return false;
    return this.#taken.every((other) => left > other[2] + APART_X || other[0] > right + APART_X || top > other[3] || other[1] > bottom);
  }
}

/** A flat view: pixels for a metre, where the sensor is, and which of x y z go right and up. */
interface Flat {
  scale: number;
  home: Place;
  across: { name: string; sign: number };
  up: { name: string; sign: number };
}

function flat(outlook: Outlook): Flat {
  const home = outlook.place(0, 0, 0)!;
  const ahead = outlook.place(1, 0, 0)!;
  const isSide = outlook.view === "side";
  return {
    scale: isSide ? ahead[0] - home[0] : home[1] - ahead[1],
    home,
    across: isSide ? { name: "x", sign: 1 } : { name: "y", sign: -1 },
    up: isSide ? { name: "z", sign: 1 } : { name: "x", sign: 1 },
  };
}

/** Metres from line to line: 1, 2 or 5 times a power of ten. */
function step(scale: number, apart = APART): number {
  return roundedUp(apart / scale, [1, 2, 5, 10]);
}

export function metres(value: number): string {
  return `${Number(value.toPrecision(6))} m`;
}

function radii({ width, height }: Outlook, { scale, home }: Flat): number[] {
  const farthest = Math.hypot(Math.max(home[0], width - home[0]), Math.max(home[1], height - home[1])) / scale;
  const nearest = Math.max(-home[0], home[0] - width, -home[1], home[1] - height, 0) / scale;
  const apart = step(scale);
  const first = Math.max(Math.floor(nearest / apart), 1);
  return Array.from({ length: Math.max(Math.ceil(farthest / apart) - first + 1, 0) }, (_, number) => (first + number) * apart);
}

function rings(context: CanvasRenderingContext2D, outlook: Outlook): void {
  const seen = flat(outlook);
  const { home, scale } = seen;
  const inks = INKS[outlook.theme];
  const reach = Math.hypot(outlook.width, outlook.height) + Math.hypot(...home);
  for (let angle = 0; angle < 360; angle += SPOKES) {
    const [right, down] = direction(angle);
    line(context, home, [home[0] + right * reach, home[1] + down * reach], angle % 90 === 0 ? inks.line : inks.faint);
  }
  context.strokeStyle = inks.line;
  for (const radius of radii(outlook, seen)) {
    context.beginPath();
    context.arc(home[0], home[1], radius * scale, 0, 2 * Math.PI);
    context.stroke();
  }
}

/** Right and down of an azimuth, counter-clockwise from straight up. */
function direction(degrees: number): Place {
  const turn = (degrees * Math.PI) / 180;
  return [-Math.sin(turn), -Math.cos(turn)];
}

/** The order in which azimuths are written: the axes first. */
const AZIMUTHS = [0, 180, 90, -90, 30, -30, 150, -150, 60, -60, 120, -120];

function ringLabels(writer: Writer, outlook: Outlook): void {
  const seen = flat(outlook);
  const { width, height } = outlook;
  const { home, scale } = seen;
  for (const angle of AZIMUTHS) {
    const place = exit(home, direction(angle), outlook);
    if (!place) continue;
    writer.write(angle === 0 ? "0° forward" : `${angle}°`, [[place, "center"], [place, place[0] < width / 2 ? "left" : "right"]]);
  }
  // Metres are written along the axis of which most is seen, else along another one.
  const room = { 0: home[1], 180: height - home[1], 90: home[0], "-90": width - home[0] };
  const ways = Object.entries(room).sort((a, b) => b[1] - a[1]).map(([angle]) => Number(angle));
  const inward = (Math.atan2(home[0] - width / 2, home[1] - height / 2) * 180) / Math.PI;
  for (const radius of radii(outlook, seen)) {
    const places = [...ways, inward].flatMap((angle): [Place, CanvasTextAlign][] => {
      const [right, down] = direction(angle);
      const [across, along]: Place = [home[0] + right * radius * scale, home[1] + down * radius * scale];
      const isAcross = Math.abs(right) > Math.abs(down);
      return isAcross ? [[[across, along - 9], "center"]] : [[[across + 4, along - 7], "left"], [[across + 4, along + 9], "left"]];
    });
    writer.write(metres(radius), places);
  }
}

/** Where a ray leaves the canvas, a little inside of its edge; null if it does not cross it. */
function exit(home: Place, [right, down]: Place, { width, height }: Outlook): Place | null {
  const ways = [
    right > 1e-9 ? (width - 1.6 * EDGE - home[0]) / right : right < -1e-9 ? (1.6 * EDGE - home[0]) / right : Infinity,
    down > 1e-9 ? (height - EDGE - home[1]) / down : down < -1e-9 ? (EDGE - home[1]) / down : Infinity,
  ];
  const way = Math.min(...ways);
  const place: Place = [home[0] + right * way, home[1] + down * way];
  return way > 2 * EDGE && inside(place, { width, height }, EDGE - 1) ? place : null;
}

function inside([across, down]: Place, { width, height }: { width: number; height: number }, edge: number): boolean {
  return across >= edge && across <= width - edge && down >= edge && down <= height - edge;
}

/** The values of the lines of a flat grid: those that go up and down, and those that go across. */
function lines({ width, height }: Outlook, { scale, home }: Flat): [number[], number[]] {
  const apart = step(scale);
  return [multiples(-home[0] / scale, (width - home[0]) / scale, apart), multiples((home[1] - height) / scale, home[1] / scale, apart)];
}

function multiples(low: number, high: number, apart: number): number[] {
  const first = Math.ceil(low / apart);
  return Array.from({ length: Math.max(Math.floor(high / apart) - first + 1, 0) }, (_, number) => (first + number) * apart);
}

function grid(context: CanvasRenderingContext2D, outlook: Outlook): void {
  const seen = flat(outlook);
  const { home, scale } = seen;
  const inks = INKS[outlook.theme];
  const [across, up] = lines(outlook, seen);
  for (const value of across) {
    const at = home[0] + value * scale;
    line(context, [at, 0], [at, outlook.height], value === 0 ? inks.line : inks.faint);
  }
  for (const value of up) {
    const at = home[1] - value * scale;
    line(context, [0, at], [outlook.width, at], value === 0 ? inks.line : inks.faint);
  }
}

function gridLabels(writer: Writer, outlook: Outlook): void {
  const seen = flat(outlook);
  const { home, scale, across, up } = seen;
  const [columns, rows] = lines(outlook, seen);
  for (const value of columns) {
    writer.write(`${across.name} ${metres(value * across.sign || 0)}`, [[[home[0] + value * scale, outlook.height - EDGE], "center"]]);
  }
  for (const value of rows) writer.write(`${up.name} ${metres(value)}`, [[[6, home[1] - value * scale - 8], "left"]]);
}

/** The lines of the floor: its height, the values of x and of y that have one, and where they begin and end. */
function tiles({ box }: Outlook): { z: number; x: number[]; y: number[]; low: Place; high: Place } {
  const [low, high]: [Place, Place] = [[box.low[0], box.low[1]], [box.high[0], box.high[1]]];
  const apart = roundedUp(Math.max(high[0] - low[0], high[1] - low[1]) / 10, [1, 2, 5, 10]);
  return { z: box.low[2], x: multiples(low[0], high[0], apart), y: multiples(low[1], high[1], apart), low, high };
}

function floor(context: CanvasRenderingContext2D, outlook: Outlook): void {
  const { z, x, y, low, high } = tiles(outlook);
  const inks = INKS[outlook.theme];
  const ink = (value: number): string => (value === 0 ? inks.text : inks.line);
  for (const value of new Set([low[0], ...x, high[0]])) inSpace(context, outlook, [value, low[1], z], [value, high[1], z], ink(value));
  for (const value of new Set([low[1], ...y, high[1]])) inSpace(context, outlook, [low[0], value, z], [high[0], value, z], ink(value));
}

/** Write x and y along the edges of the floor that are nearer to the camera: outside of the floor, else on it. */
function floorLabels(writer: Writer, outlook: Outlook): void {
  const { z, x, y, low, high } = tiles(outlook);
  const { camera, place } = outlook;
  const nearer = (axis: 0 | 1): number => (Math.abs(camera[axis] - low[axis]) < Math.abs(camera[axis] - high[axis]) ? low[axis] : high[axis]);
  const middle = place((low[0] + high[0]) / 2, (low[1] + high[1]) / 2, z);
  const [besideX, besideY] = [nearer(1), nearer(0)];
  const every = (values: number[]): number[] => (values.length < 9 ? values : values.filter((value) => Math.round(value / (values[1]! - values[0]!)) % 2 === 0));
  for (const value of every(x)) at(place(value, besideX, z), `x ${metres(value)}`);
  for (const value of every(y)) at(place(besideY, value, z), `y ${metres(value)}`);

  function at(spot: Place | null, text: string): void {
    if (!spot || !middle) return;
    const [across, down] = spot;
    const [outward, inward]: [CanvasTextAlign, CanvasTextAlign] = across < middle[0] ? ["right", "left"] : ["left", "right"];
    const apart = outward === "right" ? -6 : 6;
    writer.write(text, [
      [[across, down + 9], "center"],
      [[across + apart, down], outward],
      [[across - apart, down], inward],
      [[across, down - 9], "center"],
    ]);
  }
}

/** A line between two points of the world; what is behind the camera is left out. */
function inSpace(context: CanvasRenderingContext2D, { place }: Outlook, from: number[], to: number[], ink: string): void {
  context.strokeStyle = ink;
  context.beginPath();
  let before: Place | null = null;
  for (let piece = 0; piece <= PIECES; piece++) {
    const [x, y, z] = from.map((start, axis) => start + ((to[axis]! - start) * piece) / PIECES) as [number, number, number];
    const spot = place(x, y, z);
    if (spot && before) context.lineTo(...spot);
    else if (spot) context.moveTo(...spot);
    before = spot;
  }
  context.stroke();
}

/** The sensor's axes, x forward, y left, z up: the longest of them as many pixels. */
const AXIS = 36;

function axes(context: CanvasRenderingContext2D, outlook: Outlook, writer: Writer): void {
  const home = outlook.place(0, 0, 0);
  const extent = Math.max(...outlook.box.low.map((low, axis) => outlook.box.high[axis]! - low));
  const inks = INKS[outlook.theme];
  if (!home) return;
  const ways = [[1, 0, 0], [0, 1, 0], [0, 0, 1]].map((way) => {
    const [x, y, z] = way.map((part) => part * extent * 0.01) as [number, number, number];
    const end = outlook.place(x, y, z) ?? home;
    return [end[0] - home[0], end[1] - home[1]] as Place;
  });
  const longest = Math.max(...ways.map((way) => Math.hypot(...way)));
  ways.forEach((way, axis) => {
    const [right, down] = way.map((part) => (part * AXIS) / longest) as Place;
    if (!(Math.hypot(right, down) >= 4)) return;
    context.lineWidth = 2;
    line(context, home, [home[0] + right, home[1] + down], inks.axes[axis]!);
    context.lineWidth = 1;
    const beyond = 1 + 8 / Math.hypot(right, down);
    writer.write("xyz"[axis]!, [[[home[0] + right * beyond, home[1] + down * beyond], "center"]], inks.axes[axis]);
  });
}

/** The sensor from above, as an arrow head that points forward; labels do not cover it. */
function sensor(context: CanvasRenderingContext2D, outlook: Outlook, writer: Writer): void {
  const [across, down] = outlook.place(0, 0, 0)!;
  const inks = INKS[outlook.theme];
  writer.keepFree([across - 6, down - 9, across + 6, down + 6]);
  context.beginPath();
  context.moveTo(across, down - 9);
  context.lineTo(across + 6, down + 6);
  context.lineTo(across, down + 3);
  context.lineTo(across - 6, down + 6);
  context.closePath();
  context.fillStyle = inks.strong;
  context.strokeStyle = inks.paper;
  context.fill();
  context.stroke();
}

/** A mark around a point. */
export function mark(context: CanvasRenderingContext2D, [across, down]: Place, theme: Theme, size: number): void {
  for (const [ink, width] of [[INKS[theme].paper, 4] as const, [INKS[theme].strong, 1.5] as const]) {
    context.beginPath();
    context.arc(across, down, size, 0, 2 * Math.PI);
    context.lineWidth = width;
    context.strokeStyle = ink;
    context.stroke();
  }
  context.lineWidth = 1;
}

/** Pixels of the bar of colours: its own, to the edges of the canvas, and from the lower edge up to its upper end. */
export const BAR = { width: 180, height: 8, edge: 16, room: 66 };
/** Share of the canvas that the bar takes at most. */
const BAR_SHARE = 0.4;

/** The part of the canvas that the bar of colours covers. */
export function barRect({ width, height }: Outlook): Rect {
  const left = width - Math.min(BAR.width, BAR_SHARE * width) - BAR.edge;
  return [left - 8, height - BAR.room, width - BAR.edge + 8, height - BAR.room + 46];
}

/** The bar that says what colours mean, with the values at its ends. */
export function colourBar(context: CanvasRenderingContext2D, outlook: Outlook, name: string, unit: string, span: Span): void {
  const { theme } = outlook;
  const rect = barRect(outlook);
  const [left, top, right] = [rect[0] + 8, rect[1] + 20, rect[2] - 8];
  const ramp = context.createLinearGradient(left, 0, right, 0);
  for (let stop = 0; stop <= 16; stop++) {
    const parts = colour(stop / 16, theme).map((part) => Math.round(255 * part));
    ramp.addColorStop(stop / 16, `rgb(${parts.join(" ")})`);
  }
  context.font = FONT;
  context.fillStyle = ramp;
  context.fillRect(left, top, right - left, BAR.height);
  const end = `${Number(span.high.toPrecision(4))} ${unit}`.trim();
  written(context, name, [left, top - 9], theme, "left", INKS[theme].strong);
  written(context, `${Number(span.low.toPrecision(4))}`, [left, top + 17], theme, "left");
  written(context, end, [right, top + 17], theme, "right");
}

function line(context: CanvasRenderingContext2D, from: Place, to: Place, ink: string): void {
  context.strokeStyle = ink;
  context.beginPath();
  context.moveTo(...from);
  context.lineTo(...to);
  context.stroke();
}

/** Text with a rim of paper, so that it is read over points. */
function written(
  context: CanvasRenderingContext2D,
  text: string,
  [across, down]: Place,
  theme: Theme,
  align: CanvasTextAlign,
  ink: string = INKS[theme].text,
): void {
  context.textAlign = align;
  context.textBaseline = "middle";
  context.lineJoin = "round";
  context.lineWidth = 3;
  context.strokeStyle = INKS[theme].paper;
  context.strokeText(text, across, down);
  context.lineWidth = 1;
  context.fillStyle = ink;
  context.fillText(text, across, down);
}
