/** Packets that are missing, as one figure with its split: the sensor's counter misses a damaged packet as well. */

import type { Figures } from "./protocol";

/** Per cent of the packets: all that are missing, and of these the damaged ones and those that did not arrive. */
export interface Missing {
  total: number;
  damaged: number;
  /** null if the sensor neither numbers nor dates its packets */
  absent: number | null;
}

/** Return the packets that are missing; null if nothing was counted. */
export function missing({ error_rate: damaged, loss_rate: lost }: Figures): Missing | null {
  if (damaged == null) return null;
  if (lost == null) return { total: 100 * damaged, damaged: 100 * damaged, absent: null };
  const total = Math.max(damaged, lost);
  return { total: 100 * total, damaged: 100 * damaged, absent: 100 * (total - damaged) };
}

/** Return the split in words. */
export function split({ damaged, absent }: Missing): string {
  const words = [`damaged ${damaged.toFixed(2)} %`];
  if (absent !== null) words.push(`lost ${absent.toFixed(2)} %`);
  return words.join(" · ");
}
