import assert from "node:assert/strict";
import { test } from "node:test";
import { describeAge, isStale, reason, shorten } from "../src/staleness";

test("a scan is stale after three seconds or ten scan times, whichever is later", () => {
  assert.deepEqual([1, 2.9, 3.1].map((age) => isStale(age, 10)), [false, false, true]);
  assert.deepEqual([3.1, 19, 21].map((age) => isStale(age, 0.5)), [false, false, true]);
  assert.ok(isStale(4, null));
});

test("ages and reasons are short", () => {
  assert.deepEqual([describeAge(4.4), describeAge(119), describeAge(300)], ["4 s old", "119 s old", "5 min old"]);
  assert.equal(reason("streaming"), "");
  assert.match(reason("disconnected"), /disconnected/);
});

test("the path of the source is not repeated", () => {
  const source = "/dev/serial/by-id/usb-Silicon_Labs_CP2102_USB_to_UART_Bridge_Controller_0001-if00-port0";
  assert.equal(shorten(`${source}: the device is disconnected`, source), "the device is disconnected");
  assert.equal(shorten("/tmp/a/drive.lsr has ended", "/tmp/a/drive.lsr"), "drive.lsr has ended");
});
