// tests/staleness.test.ts
import assert from "node:assert/strict";
import { test } from "node:test";

// src/staleness.ts
var STALE_S = 3;
var STALE_SCANS = 10;
var REASONS = {
  disconnected: "The sensor is gone. It is read on when it is back.",
  silent: "Nothing arrives from the sensor.",
  "no frames": "Bytes arrive, but no frame of the sensor."
};
function isStale(age, rate) {
  const scans = rate !== null && rate > 0 ? STALE_SCANS / rate : 0;
  return age > Math.max(STALE_S, scans);
}
function reason(state) {
  return REASONS[state] ?? "";
}
function describeAge(seconds) {
  if (seconds < 120) return `${Math.round(seconds)} s old`;
  return `${Math.round(seconds / 60)} min old`;
}
function shorten(text, source) {
  if (!source) return text;
  return text.replaceAll(`${source}: `, "").replaceAll(source, source.split("/").at(-1));
}

// tests/staleness.test.ts
test("a scan is stale after three seconds or ten scan times, whichever is later", () => {
  assert.deepEqual([1, 2.9, 3.1].map((age) => isStale(age, 10)), [false, false, true]);
  assert.deepEqual([3.1, 19, 21].map((age) => isStale(age, 0.5)), [false, false, true]);
  assert.ok(isStale(4, null));
});
test("ages and reasons are short", () => {
  assert.deepEqual([describeAge(4.4), describeAge(119), describeAge(300)], ["4 s old", "119 s old", "5 min old"]);
  assert.equal(reason("streaming"), "");
  assert.match(reason("disconnected"), /gone/);
});
test("the path of the source is not repeated", () => {
  const source = "/dev/serial/by-id/usb-Silicon_Labs_CP2102_USB_to_UART_Bridge_Controller_0001-if00-port0";
  assert.equal(shorten(`${source}: the device is gone`, source), "the device is gone");
  assert.equal(shorten("/tmp/a/drive.lsr has ended", "/tmp/a/drive.lsr"), "drive.lsr has ended");
});
