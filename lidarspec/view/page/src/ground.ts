/**
 * What is drawn around the points: rings and angles, grids in metres, the sensor and where it looks, and what the colours mean.
 *
 * All of it is in the two dimensions of a canvas, and places in the world come through `Outlook.place`; it is drawn when the view
 * changes, and not for each scan.
 */

import { colour, roundedUp, type Span, type Theme } from "./colours";

/** The views, by what people call them. */
export const VIEWS = { polar: "Polar", top: "Top", side: "Side", orbit: "3D" };
export type View = keyof typeof VIEWS;
export type Place = [number, number];

/** The bounds of what is seen, in metres, and the height of the floor under it. */
export interface Box {
  low: [number, number, number];
  high: [number, number, number];
}

export interface Outlook {
  view: View;
  theme: Theme;
  width: number;
  height: number;
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

/** Draw what stands over the points: numbers at the lines, and the sensor. */
export function labels(context: CanvasRenderingContext2D, outlook: Outlook): void {
  context.font = FONT;
  if (outlook.view === "polar") ringLabels(context, outlook);
  else if (outlook.view === "orbit") floorLabels(context, outlook);
  else gridLabels(context, outlook);
  if (outlook.view === "orbit" || outlook.view === "side") axes(context, outlook);
  else sensor(context, outlook);
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

function ringLabels(context: CanvasRenderingContext2D, outlook: Outlook): void {
  const seen = flat(outlook);
  const { width, height } = outlook;
  const { home, scale } = seen;
  // Metres stand along the axis of which most is seen.
  const room = { 0: home[1], 180: height - home[1], 90: home[0], "-90": width - home[0] };
  const along = Number(Object.entries(room).sort((a, b) => b[1] - a[1])[0]![0]);
  const [right, down] = direction(along);
  for (const radius of radii(outlook, seen)) {
    const place: Place = [home[0] + right * radius * scale + (right ? 0 : 4), home[1] + down * radius * scale + (down ? -7 : -9)];
    if (inside(place, outlook, 3.4 * EDGE)) written(context, metres(radius), place, outlook.theme, right ? "center" : "left");
  }
  for (let angle = -150; angle <= 180; angle += SPOKES) {
    const place = exit(home, direction(angle), outlook);
    if (place) written(context, angle === 0 ? "0° forward" : `${angle}°`, place, outlook.theme, "center");
  }
}

/** Where a ray leaves the canvas, a little inside of its edge; null where it does not cross it. */
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

function gridLabels(context: CanvasRenderingContext2D, outlook: Outlook): void {
  const seen = flat(outlook);
  const { home, scale, across, up } = seen;
  const [columns, rows] = lines(outlook, seen);
  for (const value of columns) {
    const place: Place = [home[0] + value * scale, outlook.height - EDGE];
    if (inside(place, outlook, EDGE)) written(context, `${across.name} ${metres(value * across.sign || 0)}`, place, outlook.theme, "center");
  }
  for (const value of rows) {
    const place: Place = [6, home[1] - value * scale - 7];
    if (place[1] > EDGE && place[1] < outlook.height - 2 * EDGE) written(context, `${up.name} ${metres(value)}`, place, outlook.theme, "left");
  }
}

/** The lines of the floor: its height, and the values of x and of y that have one. */
function tiles({ box }: Outlook): { z: number; x: number[]; y: number[] } {
  const extent = Math.max(box.high[0] - box.low[0], box.high[1] - box.low[1]);
  const apart = roundedUp(extent / 10, [1, 2, 5, 10]);
  const ends = (axis: 0 | 1): number[] => {
    const [low, high] = [Math.floor(box.low[axis] / apart) * apart, Math.ceil(box.high[axis] / apart) * apart];
    return multiples(low, high + apart / 2, apart);
  };
  return { z: box.low[2], x: ends(0), y: ends(1) };
}

function floor(context: CanvasRenderingContext2D, outlook: Outlook): void {
  const { z, x, y } = tiles(outlook);
  const inks = INKS[outlook.theme];
  const ink = (value: number): string => (value === 0 ? inks.text : inks.line);
  for (const value of x) inSpace(context, outlook, [value, y[0]!, z], [value, y.at(-1)!, z], ink(value));
  for (const value of y) inSpace(context, outlook, [x[0]!, value, z], [x.at(-1)!, value, z], ink(value));
}

function floorLabels(context: CanvasRenderingContext2D, outlook: Outlook): void {
  const { z, x, y } = tiles(outlook);
  const { camera, theme, place } = outlook;
  const nearer = (axis: 0 | 1, values: number[]): number =>
    Math.abs(camera[axis] - values[0]!) < Math.abs(camera[axis] - values.at(-1)!) ? values[0]! : values.at(-1)!;
  const [besideX, besideY] = [nearer(1, y), nearer(0, x)];
  const every = (values: number[]): number[] => values.filter((_, number) => values.length < 9 || number % 2 === 0);
  for (const value of every(x)) at(place(value, besideX, z), `x ${metres(value)}`);
  for (const value of every(y)) at(place(besideY, value, z), `y ${metres(value)}`);

  function at(spot: Place | null, text: string): void {
    if (spot && inside(spot, outlook, 0)) written(context, text, [spot[0], spot[1] + 9], theme, "center");
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

/** The sensor's axes, x forward, y left, z up, where it stands. */
function axes(context: CanvasRenderingContext2D, outlook: Outlook): void {
  const home = outlook.place(0, 0, 0);
  const extent = Math.max(outlook.box.high[0] - outlook.box.low[0], outlook.box.high[1] - outlook.box.low[1]);
  const long = outlook.view === "side" ? 40 / flat(outlook).scale : extent / 14;
  const ends = [outlook.place(long, 0, 0), outlook.place(0, long, 0), outlook.place(0, 0, long)];
  const inks = INKS[outlook.theme];
  ends.forEach((end, axis) => {
    if (!home || !end || Math.hypot(end[0] - home[0], end[1] - home[1]) < 4) return;
    context.lineWidth = 2;
    line(context, home, end, inks.axes[axis]!);
    context.lineWidth = 1;
    written(context, "xyz"[axis]!, [end[0] + (end[0] - home[0]) * 0.15, end[1] + (end[1] - home[1]) * 0.15], outlook.theme, "center", inks.axes[axis]);
  });
}

/** The sensor from above, as an arrow head that points forward. */
function sensor(context: CanvasRenderingContext2D, outlook: Outlook): void {
  const [across, down] = outlook.place(0, 0, 0)!;
  const inks = INKS[outlook.theme];
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

const BAR = { width: 180, height: 8, edge: 16 };

/** The bar that says what colours mean, with the values at its ends. */
export function colourBar(context: CanvasRenderingContext2D, outlook: Outlook, name: string, unit: string, span: Span): void {
  const { width, height, theme } = outlook;
  const [left, top] = [width - BAR.width - BAR.edge, height - BAR.edge - 30];
  const ramp = context.createLinearGradient(left, 0, left + BAR.width, 0);
  for (let stop = 0; stop <= 16; stop++) {
    const parts = colour(stop / 16, theme).map((part) => Math.round(255 * part));
    ramp.addColorStop(stop / 16, `rgb(${parts.join(" ")})`);
  }
  context.font = FONT;
  context.fillStyle = INKS[theme].paper;
  context.globalAlpha = 0.85;
  context.fillRect(left - 8, top - 20, BAR.width + 16, 46);
  context.globalAlpha = 1;
  context.fillStyle = ramp;
  context.fillRect(left, top, BAR.width, BAR.height);
  const end = `${Number(span.high.toPrecision(4))} ${unit}`.trim();
  written(context, name, [left, top - 9], theme, "left", INKS[theme].strong);
  written(context, `${Number(span.low.toPrecision(4))}`, [left, top + 17], theme, "left");
  written(context, end, [left + BAR.width, top + 17], theme, "right");
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
