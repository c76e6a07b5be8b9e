import assert from "node:assert/strict";
import { test } from "node:test";
import { colour, roundedUp, type Rgb, scale, Span, STEPS } from "../src/colours";
import { INKS } from "../src/ground";
import { quantiles } from "../src/sampling";
import ramp from "./ramp.json";

/** Where a colour is in OKLab, in which distances are as the eye sees them. */
function lab(rgb: Rgb): number[] {
  const [r, g, b] = linear(rgb);
  const l = Math.cbrt(0.4122214708 * r + 0.5363325363 * g + 0.0514459929 * b);
  const m = Math.cbrt(0.2119034982 * r + 0.6806995451 * g + 0.1073969566 * b);
  const s = Math.cbrt(0.0883024619 * r + 0.2817188376 * g + 0.6299787005 * b);
  return [
    0.2104542553 * l + 0.793617785 * m - 0.0040720468 * s,
    1.9779984951 * l - 2.428592205 * m + 0.4505937099 * s,
    0.0259040371 * l + 0.7827717662 * m - 0.808675766 * s,
  ];
}

function linear(rgb: Rgb): Rgb {
  return rgb.map((part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4)) as Rgb;
}

function luminance(rgb: Rgb): number {
  const [red, green, blue] = linear(rgb);
  return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
}

/** The colour as it is seen by people who lack one kind of cones (Machado, Oliveira and Fernandes, 2009, severity 1). */
const SEEN = {
  protanopia: [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]],
  deuteranopia: [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
  tritanopia: [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.3039]],
};

function hex(rgb: Rgb): string {
  return "#" + rgb.map((part) => Math.round(255 * part).toString(16).padStart(2, "0")).join("");
}

for (const theme of ["dark", "light"] as const) {
  test(`equal steps of the ${theme} scale look equal, and go from dark to bright`, () => {
    const places = Array.from({ length: 33 }, (_, step) => lab(colour(step / 32, theme)));
    const steps = places.slice(1).map((place, step) => Math.hypot(...place.map((part, axis) => part - places[step]![axis]!)));
    assert.ok(Math.max(...steps) < 1.6 * Math.min(...steps), `${Math.min(...steps)} to ${Math.max(...steps)}`);
    assert.ok(places.slice(1).every((place, step) => place[0]! > places[step]![0]!));
    assert.equal(scale(theme).length, 4 * STEPS);
  });
}

for (const theme of ["dark", "light"] as const) {
  const shares = Array.from({ length: 33 }, (_, step) => step / 32);

  test(`each colour of the ${theme} scale has a contrast of 3:1 with the paper`, () => {
    const paper = INKS[theme].paper.match(/[0-9a-f]{2}/g)!.map((part) => parseInt(part, 16) / 255) as Rgb;
    for (const share of shares) {
      const [darker, lighter] = [luminance(paper), luminance(colour(share, theme))].sort((a, b) => a - b) as [number, number];
      assert.ok((lighter + 0.05) / (darker + 0.05) >= 3, `${share}: ${((lighter + 0.05) / (darker + 0.05)).toFixed(2)}`);
    }
  });

  test(`the ${theme} scale is in order for colour-blind readers`, () => {
    for (const [name, matrix] of Object.entries(SEEN)) {
      const lightness = shares.map((share) => {
        const rgb = linear(colour(share, theme));
        const seen = matrix.map((row) => Math.min(Math.max(row[0]! * rgb[0] + row[1]! * rgb[1] + row[2]! * rgb[2], 0), 1));
        return lab(seen.map((part) => (part <= 0.0031308 ? 12.92 * part : 1.055 * part ** (1 / 2.4) - 0.055)) as Rgb)[0]!;
      });
      assert.ok(lightness.slice(1).every((value, step) => value > lightness[step]!), name);
    }
  });

  test(`the ${theme} scale is that of the terminal and of plot`, () => {
    assert.deepEqual(ramp[theme].map((_, step) => hex(colour(step / (ramp[theme].length - 1), theme))), ramp[theme]);
  });
}

test("ends are round numbers, and values beyond the ends are few", () => {
  assert.deepEqual([0.93, 1, 1.1, 4.2, 61, 250].map((value) => roundedUp(value)), [1, 1, 1.2, 5, 80, 250]);
  assert.deepEqual(quantiles([3, NaN, 1, 2, Infinity], [0, 0.5, 1]), [1, 2, 3]);
  assert.deepEqual(quantiles([], [0.5]), [0]);
});

test("the span stays while values fit, so that colours do not flicker", () => {
  const span = new Span();
  assert.ok(span.fit([0.5, 4.2]));
  assert.deepEqual([span.low, span.high], [0, 5]);
  assert.ok(!span.fit([0.5, 3.9]), "a little less is no reason");
  assert.ok(span.fit([0.5, 5.3]), "more than fits is one");
  assert.ok(span.fit([0.5, 1.9]), "and so is much less");
  assert.ok(span.fit([-1.7, 0.4]), "heights go below zero");
  assert.deepEqual([span.low, span.high], [-2, 0.4]);
});
