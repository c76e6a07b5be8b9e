// tests/colours.test.ts
import assert from "node:assert/strict";
import { test } from "node:test";

// src/sampling.ts
var SAMPLED = 4e3;
var GOLDEN = (Math.sqrt(5) - 1) / 2;
function sampleRows(count, most = SAMPLED) {
  if (count <= most) return Array.from({ length: count }, (_, row) => row);
  return Array.from({ length: most }, (_, number) => Math.floor(number * GOLDEN % 1 * count));
}
function quantiles(column, shares) {
  const sample = sampleRows(column.length).map((row) => column[row]).filter(Number.isFinite).sort((a, b) => a - b);
  return shares.map((share) => sample[Math.round(share * (sample.length - 1))] ?? 0);
}

// src/colours.ts
var SCALES = {
  dark: { lightness: [0.52, 0.92], hue: [285, 100], chroma: 0.125 },
  light: { lightness: [0.34, 0.66], hue: [285, 100], chroma: 0.11 }
};
var STEPS = 256;
function colour(share, theme) {
  const { lightness, hue, chroma } = SCALES[theme];
  const turn = between(hue, share) * Math.PI / 180;
  return srgb(between(lightness, share), chroma * Math.cos(turn), chroma * Math.sin(turn));
}
function scale(theme) {
  const bytes = new Uint8Array(4 * STEPS).fill(255);
  for (let step = 0; step < STEPS; step++) {
    bytes.set(
      colour(step / (STEPS - 1), theme).map((part) => Math.round(255 * part)),
      4 * step
    );
  }
  return bytes;
}
function between([from, to], share) {
  return from + (to - from) * share;
}
function srgb(lightness, a, b) {
  const l = (lightness + 0.3963377774 * a + 0.2158037573 * b) ** 3;
  const m = (lightness - 0.1055613458 * a - 0.0638541728 * b) ** 3;
  const s = (lightness - 0.0894841775 * a - 1.291485548 * b) ** 3;
  const linear2 = [
    4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s,
    -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s,
    -0.0041960863 * l - 0.7034186147 * m + 1.707614701 * s
  ];
  return linear2.map((part) => {
    const held = Math.min(Math.max(part, 0), 1);
    return held <= 31308e-7 ? 12.92 * held : 1.055 * held ** (1 / 2.4) - 0.055;
  });
}
function roundedUp(value, steps = [1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10]) {
  if (!(value > 0)) return 0;
  const power = 10 ** Math.floor(Math.log10(value));
  return Number(((steps.find((step) => step * power >= value * 0.999) ?? 10) * power).toPrecision(3));
}
var BEYOND = 0.01;
var ROOMY = 0.5;
var Span = class {
  low = 0;
  high = 0;
  /** Whether the ends have changed. */
  fit(column) {
    const [least, greatest] = quantiles(column, [BEYOND, 1 - BEYOND]);
    const low = least < 0 ? -roundedUp(-least) : 0;
    const high = greatest < 0 ? 0 : roundedUp(Math.max(greatest, 1e-3));
    const fits = this.low <= least && greatest <= this.high * 1.001 && high - low >= ROOMY * (this.high - this.low);
    if (fits) return false;
    const changed = this.low !== low || this.high !== high;
    [this.low, this.high] = [low, high];
    return changed;
  }
  forget() {
    this.low = this.high = 0;
  }
};

// src/ground.ts
var INKS = {
  dark: { paper: "#0e1116", line: "#2b323c", faint: "#1b2028", text: "#8d98a7", strong: "#e6eaf0", axes: ["#e5645a", "#5fb968", "#5b93e6"] },
  light: { paper: "#ffffff", line: "#cfd5dd", faint: "#e9ecf0", text: "#66707d", strong: "#1b2027", axes: ["#c4362b", "#2c8a3a", "#2563c4"] }
};

// tests/ramp.json
var ramp_default = {
  dark: [
    "#635cad",
    "#4d75c1",
    "#288fc9",
    "#00a7c6",
    "#00bdb9",
    "#50cea7",
    "#8dda93",
    "#c4e283",
    "#f8e780"
  ],
  light: [
    "#342b6d",
    "#1f3f7c",
    "#005382",
    "#00667e",
    "#007674",
    "#008364",
    "#4b8c52",
    "#7a9141",
    "#a2933b"
  ]
};

// tests/colours.test.ts
function lab(rgb) {
  const [r, g, b] = linear(rgb);
  const l = Math.cbrt(0.4122214708 * r + 0.5363325363 * g + 0.0514459929 * b);
  const m = Math.cbrt(0.2119034982 * r + 0.6806995451 * g + 0.1073969566 * b);
  const s = Math.cbrt(0.0883024619 * r + 0.2817188376 * g + 0.6299787005 * b);
  return [
    0.2104542553 * l + 0.793617785 * m - 0.0040720468 * s,
    1.9779984951 * l - 2.428592205 * m + 0.4505937099 * s,
    0.0259040371 * l + 0.7827717662 * m - 0.808675766 * s
  ];
}
function linear(rgb) {
  return rgb.map((part) => part <= 0.04045 ? part / 12.92 : ((part + 0.055) / 1.055) ** 2.4);
}
function luminance(rgb) {
  const [red, green, blue] = linear(rgb);
  return 0.2126 * red + 0.7152 * green + 0.0722 * blue;
}
var SEEN = {
  protanopia: [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-3882e-6, -0.048116, 1.051998]],
  deuteranopia: [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.01182, 0.04294, 0.968881]],
  tritanopia: [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [4733e-6, 0.691367, 0.3039]]
};
function hex(rgb) {
  return "#" + rgb.map((part) => Math.round(255 * part).toString(16).padStart(2, "0")).join("");
}
for (const theme of ["dark", "light"]) {
  test(`equal steps of the ${theme} scale look equal, and go from dark to bright`, () => {
    const places = Array.from({ length: 33 }, (_, step) => lab(colour(step / 32, theme)));
    const steps = places.slice(1).map((place, step) => Math.hypot(...place.map((part, axis) => part - places[step][axis])));
    assert.ok(Math.max(...steps) < 1.6 * Math.min(...steps), `${Math.min(...steps)} to ${Math.max(...steps)}`);
    assert.ok(places.slice(1).every((place, step) => place[0] > places[step][0]));
    assert.equal(scale(theme).length, 4 * STEPS);
  });
}
for (const theme of ["dark", "light"]) {
  const shares = Array.from({ length: 33 }, (_, step) => step / 32);
  test(`each colour of the ${theme} scale has a contrast of 3:1 with the paper`, () => {
    const paper = INKS[theme].paper.match(/[0-9a-f]{2}/g).map((part) => parseInt(part, 16) / 255);
    for (const share of shares) {
      const [darker, lighter] = [luminance(paper), luminance(colour(share, theme))].sort((a, b) => a - b);
      assert.ok((lighter + 0.05) / (darker + 0.05) >= 3, `${share}: ${((lighter + 0.05) / (darker + 0.05)).toFixed(2)}`);
    }
  });
  test(`the ${theme} scale is in order for colour-blind readers`, () => {
    for (const [name, matrix] of Object.entries(SEEN)) {
      const lightness = shares.map((share) => {
        const rgb = linear(colour(share, theme));
        const seen = matrix.map((row) => Math.min(Math.max(row[0] * rgb[0] + row[1] * rgb[1] + row[2] * rgb[2], 0), 1));
        return lab(seen.map((part) => part <= 31308e-7 ? 12.92 * part : 1.055 * part ** (1 / 2.4) - 0.055))[0];
      });
      assert.ok(lightness.slice(1).every((value, step) => value > lightness[step]), name);
    }
  });
  test(`the ${theme} scale is that of the terminal and of plot`, () => {
    assert.deepEqual(ramp_default[theme].map((_, step) => hex(colour(step / (ramp_default[theme].length - 1), theme))), ramp_default[theme]);
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
