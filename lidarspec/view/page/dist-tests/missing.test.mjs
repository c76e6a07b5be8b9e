// tests/missing.test.ts
import assert from "node:assert/strict";
import { test } from "node:test";

// src/missing.ts
function missing({ error_rate: damaged, loss_rate: lost }) {
  if (damaged == null) return null;
  if (lost == null) return { total: 100 * damaged, damaged: 100 * damaged, absent: null };
  const total = Math.max(damaged, lost);
  return { total: 100 * total, damaged: 100 * damaged, absent: 100 * (total - damaged) };
}
function split({ damaged, absent }) {
  const words = [`damaged ${damaged.toFixed(2)} %`];
  if (absent !== null) words.push(`not arrived ${absent.toFixed(2)} %`);
  return words.join(" \xB7 ");
}

// tests/missing.test.ts
test("damaged packets, which the counter misses too, are counted once", () => {
  const found = missing({ at: 0, error_rate: 0.57, loss_rate: 0.57 });
  assert.deepEqual([found.total, found.damaged, found.absent].map((share) => Math.round(share)), [57, 57, 0]);
  assert.equal(split(found), "damaged 57.00 % \xB7 not arrived 0.00 %");
});
test("packets that did not arrive are the rest", () => {
  assert.equal(split(missing({ at: 0, error_rate: 0.01, loss_rate: 0.05 })), "damaged 1.00 % \xB7 not arrived 4.00 %");
});
test("a sensor without a counter has damaged packets alone", () => {
  const found = missing({ at: 0, error_rate: 0.25, loss_rate: null });
  assert.equal(found.total, 25);
  assert.equal(split(found), "damaged 25.00 %");
  assert.equal(missing({ at: 0 }), null);
});
