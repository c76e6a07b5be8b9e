/** How old the picture of a live source is, and why it stands. */

/** Seconds and scan times after which a picture is stale. */
const STALE_S = 3;
const STALE_SCANS = 10;

/** The states in which nothing is seen of the sensor, in words. */
const REASONS: Record<string, string> = {
  disconnected: "The sensor is disconnected. Waiting for it.",
  silent: "No data from the sensor.",
  "no frames": "Bytes received, but no frame of the sensor.",
};

/** Whether a scan is too old to pass for the present, `age` seconds after it arrived; `rate`: scans a second. */
export function isStale(age: number, rate: number | null): boolean {
  const scans = rate !== null && rate > 0 ? STALE_SCANS / rate : 0;
  return age > Math.max(STALE_S, scans);
}

/** Return why nothing is seen, "" if something is. */
export function reason(state: string): string {
  return REASONS[state] ?? "";
}

/** Return an age in words. */
export function describeAge(seconds: number): string {
  if (seconds < 120) return `${Math.round(seconds)} s old`;
  return `${Math.round(seconds / 60)} min old`;
}

/** Return a message without the path of the source, which stands above it; its last part stays where the text needs a name. */
export function shorten(text: string, source: string): string {
  if (!source) return text;
  return text.replaceAll(`${source}: `, "").replaceAll(source, source.split("/").at(-1)!);
}
