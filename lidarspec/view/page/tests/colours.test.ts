import assert from "node:assert/strict";
import { test } from "node:test";
import { colour, quantiles, roundedUp, type Rgb, scale, Span, STEPS } from "../src/colours";

/** Where a colour is in OKLab, in which distances are as the eye sees them. */
function lab(rgb: Rgb): number[] {
  const [r, g, b] = rgb.map((part) => (part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4)) as Rgb;
  const l = Math.cbrt(0.4122214708 * r + 0.5363325363 * g + 0.0514459929 * b);
  const m = Math.cbrt(0.2119034982 * r + 0.6806995451 * g + 0.1073969566 * b);
  const s = Math.cbrt(0.0883024619 * r + 0.2817188376 * g + 0.6299787005 * b);
  return [
    0.2104542553 * l + 0.793617785 * m - 0.0040720468 * s,
    1.9779984951 * l - 2.428592205 * m + 0.4505937099 * s,
    0.0259040371 * l + 0.7827717662 * m - 0.808675766 * s,
  ];
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
