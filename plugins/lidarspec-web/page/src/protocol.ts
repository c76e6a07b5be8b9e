/**
 * What page and server say to each other over the one socket: JSON in text frames, scans in binary ones.
 *
 * The page asks for each scan when it has drawn the last, so that a slow or hidden page is never sent more than it can draw.
 */

export type Column = Float32Array | Float64Array | Uint8Array | Uint16Array | Uint32Array;

const TYPES: Record<string, new (buffer: ArrayBuffer, offset: number, length: number) => Column> = {
  f4: Float32Array,
  f8: Float64Array,
  u1: Uint8Array,
  u2: Uint16Array,
  u4: Uint32Array,
};

interface ScanHeader {
  scan: number;
  /** seconds from the first packet of the source */
  position: number;
  /** seconds of the server's clock when the last packet of the scan had arrived */
  sent: number;
  /** points that are in the columns, of those of the scan that have a return */
  points: number;
  of: number;
  whole: boolean;
  rate_hz: number | null;
  nominal: boolean;
  columns: { name: string; type: string; unit: string }[];
}

export interface Scan extends Omit<ScanHeader, "columns"> {
  /** by name: x, y, z, range, index, and intensity and ring where the sensor has them; views of what was received */
  columns: Map<string, Column>;
  units: Map<string, string>;
}

export interface Value {
  path: string;
  raw: number | string | null;
  value?: number | null;
  unit?: string;
  label?: string;
  bits?: string;
  docs?: string;
  text?: string;
  /** where its bytes begin, and which bits of each are its own, as hexadecimal text */
  start: number;
  masks: string;
}

export interface Row {
  offset: number;
  hex: string;
  path: string;
  meaning: string;
  right: boolean;
  remarks: string[];
  values: Value[];
}

export interface Explanation {
  sensor: string;
  frame: string;
  size: number;
  fault: { reason: string; offset: number; path: string } | null;
  notes: string[];
  rows: Row[];
}

export interface Argument {
  name: string;
  text: string;
  unit: string;
  low: number | null;
  high: number | null;
  /** values that have a name; none where any in the range will do */
  choices: { value: string; text: string }[];
  default: string | number | null;
}

export interface Command {
  name: string;
  group: "ask" | "set" | "switch";
  /** whether it is answered only while the sensor sends no data */
  only_stopped: boolean;
  text: string;
  arguments: Argument[];
}

/** By name, and `at`: seconds of the server's clock. */
export type Figures = Record<string, number | null | undefined> & { at: number };

export interface Hello {
  is: "hello";
  sensor: string;
  title: string;
  source: string;
  live: boolean;
  planar: boolean;
  duration: number | null;
  control: boolean;
  why_no_control: string;
  commands: Command[];
  /** the commands that stop the data and start it again */
  restart: { stop: string; start: string } | null;
  saves: string[];
  records: boolean;
  /** the figures of the last minute */
  history: Figures[];
  version: string;
}

export interface Damage {
  number: number;
  position: number | null;
  size: number;
  verdict: string;
}

export interface State {
  is: "state";
  at: number;
  position: number;
  state: string;
  paused: boolean;
  speed: number;
  figures: Figures | null;
  warnings: string[];
  info: Record<string, string>;
  /** the sensor's clock in words; empty if the sensor sends no time */
  clock: string;
  recording: { name: string; bytes: number } | null;
  damaged: { total: number; newest: Damage[] };
}

export interface Frame {
  is: "frame";
  /** among all frames, or among the damaged pieces where it is one; none where it is not kept any more but in its scan */
  number: number | null;
  position: number | null;
  hex: string;
  why: "last" | "point" | "damaged" | "number";
  value: string | null;
  explanation: Explanation;
}

export interface Composed {
  is: "composed";
  command: string;
  hex: string;
  explanation: Explanation | null;
}

export interface Replied {
  is: "replied";
  command: string;
  text: string;
  hex: string;
}

export interface Refused {
  is: "refused";
  of: string;
  command?: string;
  text: string;
  next?: string;
}

export type Message =
  | Hello
  | State
  | Frame
  | Composed
  | Replied
  | Refused
  | { is: "gone"; what: string }
  | { is: "ended"; text: string };

export type Ask =
  | { do: "next"; most: number }
  | { do: "pause" | "play" | "step" }
  | { do: "record"; on: boolean }
  | { do: "seek"; to: number }
  | { do: "speed"; times: number }
  | { do: "watch"; frames: boolean }
  | { do: "frame"; point: { scan: number; index: number } }
  | { do: "frame"; damaged: number }
  | { do: "frame"; number: number }
  | { do: "compose" | "send"; command: string; arguments: Record<string, string> };

/** What binary frames hold is in steps of so many bytes, so that columns can be read where they stand. */
const STEP = 8;

/**
 * The scan in a binary frame; its columns are views of the bytes, which are copied only where they begin at an odd place.
 *
 * @throws RangeError for what is cut off, TypeError for a column of an unknown type.
 */
export function decoded(data: ArrayBuffer | ArrayBufferView): Scan {
  const [buffer, begin] = located(data);
  const length = new DataView(buffer, begin, 4).getUint32(0, true);
  const text = new TextDecoder().decode(new Uint8Array(buffer, begin + 4, length));
  const { columns: described, ...head } = JSON.parse(text) as ScanHeader;
  const columns = new Map<string, Column>();
  let offset = begin + 4 + length;
  for (const { name, type } of described) {
    const Kind = TYPES[type];
    if (Kind === undefined) throw new TypeError(`column ${name} has the type ${type}, which this page does not support`);
    const column = new Kind(buffer, offset, head.points);
    columns.set(name, column);
    offset += Math.ceil(column.byteLength / STEP) * STEP;
  }
  return { ...head, columns, units: new Map(described.map(({ name, unit }) => [name, unit])) };
}

function located(data: ArrayBuffer | ArrayBufferView): [ArrayBuffer, number] {
  if (data instanceof ArrayBuffer) return [data, 0];
  if (data.buffer instanceof ArrayBuffer && data.byteOffset % STEP === 0) return [data.buffer, data.byteOffset];
  return [new Uint8Array(data.buffer, data.byteOffset, data.byteLength).slice().buffer, 0];
}

/** Milliseconds that a picture may take, so that there are ten a second, and how many points are asked for at first, at least and at most. */
const BUDGET = 80;
const FIRST = 40_000;
const LEAST = 20_000;
const MOST = 1_000_000;

/** How many points are asked for: as many as are drawn in time; below the least of them other work is what takes long. */
export class Pace {
  most = FIRST;

  /** Take in how long a picture of so many points, of a scan of so many, has taken. */
  drawn(milliseconds: number, points: number, of: number): void {
    const fitting = (points * BUDGET) / Math.max(milliseconds, 1);
    if (milliseconds > BUDGET) this.most = Math.max(Math.round(0.5 * (points + fitting)), LEAST);
    else if (points < of && milliseconds < BUDGET / 2) this.most = Math.min(Math.round(this.most * 1.25), MOST);
  }
}

const NUMBERS = new Intl.NumberFormat("en-US");

/** How many points are drawn of how many, in words: "40,000 of 78,750 points". */
export function thinned(points: number, of: number): string {
  return `${points < of ? `${NUMBERS.format(points)} of ` : ""}${NUMBERS.format(of)} points`;
}

/** Milliseconds until the socket is tried again: the first time, and at most. */
const RETRY = [500, 1000, 2000, 4000];

export interface Listener {
  scan(scan: Scan): void;
  said(message: Message): void;
  /** the socket is open, or it is not and is tried again */
  connected(open: boolean): void;
}

/** The socket, opened again whenever it closes, with one scan at most under way. */
export class Connection {
  #socket: WebSocket | null = null;
  #waiting = false;
  #tries = 0;
  #timer: number | undefined;

  constructor(
    readonly url: string,
    readonly listener: Listener,
  ) {
    this.#open();
  }

  /** Whether a scan has been asked for and has not come yet. */
  get waiting(): boolean {
    return this.#waiting;
  }

  /** Whether it was sent: not while the connection is lost. */
  ask(words: Ask): boolean {
    if (this.#socket?.readyState !== WebSocket.OPEN) return false;
    this.#socket.send(JSON.stringify(words));
    return true;
  }

  /** Ask for the newest scan, unless one is under way. */
  next(most: number): void {
    if (!this.#waiting) this.#waiting = this.ask({ do: "next", most });
  }

  close(): void {
    clearTimeout(this.#timer);
    const socket = this.#socket;
    this.#socket = null;
    socket?.close();
  }

  #open(): void {
    const socket = new WebSocket(this.url);
    socket.binaryType = "arraybuffer";
    socket.onopen = () => {
      this.#tries = 0;
      this.listener.connected(true);
    };
    socket.onmessage = ({ data }: MessageEvent<string | ArrayBuffer>) => {
      if (typeof data === "string") this.listener.said(JSON.parse(data) as Message);
      else {
        this.#waiting = false;
        this.listener.scan(decoded(data));
      }
    };
    socket.onclose = () => {
      if (this.#socket !== socket) return;
      this.#waiting = false;
      this.listener.connected(false);
      this.#timer = window.setTimeout(() => this.#open(), RETRY[Math.min(this.#tries++, RETRY.length - 1)]);
    };
    this.#socket = socket;
  }
}
