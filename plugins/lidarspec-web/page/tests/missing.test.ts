import assert from "node:assert/strict";
import { test } from "node:test";
import { missing, split } from "../src/missing";

test("damaged packets, which the counter misses too, are counted once", () => {
  const found = missing({ at: 0, error_rate: 0.57, loss_rate: 0.57 })!;
  assert.deepEqual([found.total, found.damaged, found.absent].map((share) => Math.round(share!)), [57, 57, 0]);
  assert.equal(split(found), "damaged 57.00 % · lost 0.00 %");
});

test("packets that did not arrive are the rest", () => {
  assert.equal(split(missing({ at: 0, error_rate: 0.01, loss_rate: 0.05 })!), "damaged 1.00 % · lost 4.00 %");
});

test("a sensor without a counter has damaged packets alone", () => {
  const found = missing({ at: 0, error_rate: 0.25, loss_rate: null })!;
  assert.equal(found.total, 25);
  assert.equal(split(found), "damaged 25.00 %");
  assert.equal(missing({ at: 0 }), null);
});
