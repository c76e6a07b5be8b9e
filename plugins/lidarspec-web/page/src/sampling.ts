/** Samples of long columns, so that looking at a scan costs the same however many points it has. */

const SAMPLED = 4000;
const GOLDEN = (Math.sqrt(5) - 1) / 2;

/** Return rows that are spread evenly over a column; their distances share no period with rings or channels. */
export function sampleRows(count: number, most = SAMPLED): number[] {
  if (count <= most) return Array.from({ length: count }, (_, row) => row);
  return Array.from({ length: most }, (_, number) => Math.floor(((number * GOLDEN) % 1) * count));
}

/** The values at shares of the way through a column in order; a sample of a long one. */
export function quantiles(column: ArrayLike<number>, shares: number[]): number[] {
  const sample = sampleRows(column.length)
    .map((row) => column[row]!)
    .filter(Number.isFinite)
    .sort((a, b) => a - b);
  return shares.map((share) => sample[Math.round(share * (sample.length - 1))] ?? 0);
}
