/**
 * What colours mean: a scale that is even to the eye, and the span of values that it stands for.
 *
 * The scale is a helix in the space OKLab, in which equal steps look equal: lightness and hue go on evenly while chroma stays.
 */

import { quantiles } from "./sampling";

export type Theme = "dark" | "light";
export type Rgb = [number, number, number];

/**
 * Where the scale begins and ends: lightness from 0 to 1, hue in degrees. Hue goes from blue to yellow, and lightness rises all the
 * way, so that readers who confuse red and green, or blue and yellow, still see the order. Every colour has a contrast of 3:1 with
 * the paper of its theme, for which light paper takes darker colours. `lidarspec.points.colours` has the same scale.
 */
const SCALES: Record<Theme, { lightness: [number, number]; hue: [number, number]; chroma: number }> = {
  dark: { lightness: [0.52, 0.92], hue: [285, 100], chroma: 0.125 },
  light: { lightness: [0.34, 0.66], hue: [285, 100], chroma: 0.11 },
};
export const STEPS = 256;

/** The colour a share of the way along the scale, each part from 0 to 1. */
export function colour(share: number, theme: Theme): Rgb {
  const { lightness, hue, chroma } = SCALES[theme];
  const turn = (between(hue, share) * Math.PI) / 180;
  return srgb(between(lightness, share), chroma * Math.cos(turn), chroma * Math.sin(turn));
}

/** The scale as bytes, red green blue alpha for each of its steps. */
export function scale(theme: Theme): Uint8Array {
  const bytes = new Uint8Array(4 * STEPS).fill(255);
  for (let step = 0; step < STEPS; step++) {
    bytes.set(
      colour(step / (STEPS - 1), theme).map((part) => Math.round(255 * part)),
      4 * step,
    );
  }
  return bytes;
}

function between([from, to]: [number, number], share: number): number {
  return from + (to - from) * share;
}

/** A colour of OKLab in sRGB, held to what a screen can show. */
function srgb(lightness: number, a: number, b: number): Rgb {
  const l = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (lightness - 0.0894841775 * a - 1.291485548 * b) ** 3;
  const linear: Rgb = [
    4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
    -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
    -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s,
  ];
  return linear.map((part) => {
    const held = Math.min(Math.max(part, 0), 1);
    return held <= 0.0031308 ? 12.92 * held : 1.055 * held ** (1 / 2.4) - 0.055;
  }) as Rgb;
}

/** The next of a few round numbers, by default 1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8 or 10 times a power of ten. */
export function roundedUp(value: number, steps = [1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10]): number {
  if (!(value > 0)) return 0;
  const power = 10 ** Math.floor(Math.log10(value));
  return Number(((steps.find((step) => step * power >= value * 0.999) ?? 10) * power).toPrecision(3));
}

/** Share of the values at each end that is beyond the span. */
const BEYOND = 0.01;

/** A span that needs less than this share of the one that is kept takes its place. */
const ROOMY = 0.5;

/** The values at the ends of the scale, which stay while they fit, so that colours do not flicker from scan to scan. */
export class Span {
  low = 0;
  high = 0;

  /** Whether the ends have changed. */
  fit(column: ArrayLike<number>): boolean {
    const [least, greatest] = quantiles(column, [BEYOND, 1 - BEYOND]) as [number, number];
    const low = least < 0 ? -roundedUp(-least) : 0;
    const high = greatest < 0 ? 0 : roundedUp(Math.max(greatest, 1e-3));
    const fits = this.low <= least && greatest <= this.high * 1.001 && high - low >= ROOMY * (this.high - this.low);
    if (fits) return false;
    const changed = this.low !== low || this.high !== high;
    [this.low, this.high] = [low, high];
    return changed;
  }

  forget(): void {
    this.low = this.high = 0;
  }
}
