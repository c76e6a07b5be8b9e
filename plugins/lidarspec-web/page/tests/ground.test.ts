import assert from "node:assert/strict";
import { test } from "node:test";
import { PerspectiveCamera, Vector3 } from "three";
import { labels, type Outlook, type Place, type View } from "../src/ground";

interface Written {
  text: string;
  left: number;
  right: number;
  down: number;
}

const nothing = (): undefined => undefined;

/** A canvas that notes the texts that are written on it; each character is 6 pixels wide. */
class Paper {
  readonly written: Written[] = [];
  textAlign = "left";
  measureText(text: string): { width: number } {
    return { width: 6 * text.length };
  }
  fillText(text: string, across: number, down: number): void {
    const width = 6 * text.length;
    const left = across - width * (this.textAlign === "left" ? 0 : this.textAlign === "right" ? 1 : 0.5);
    this.written.push({ text, left, right: left + width, down });
  }
  readonly strokeText = nothing;
  readonly beginPath = nothing;
  readonly moveTo = nothing;
  readonly lineTo = nothing;
  readonly closePath = nothing;
  readonly fill = nothing;
  readonly stroke = nothing;
}

/** A view with the sensor at a place, and so many pixels for a metre; `away`: of the camera in 3D. */
function outlook(view: View, width: number, height: number, home: Place, scale: number, away = 12): Outlook {
  const box = { low: [-4, -2.6, -1] as [number, number, number], high: [4.2, 2.4, 1.2] as [number, number, number] };
  const flat = (x: number, y: number, z: number): Place => (view === "side" ? [home[0] + x * scale, home[1] - z * scale] : [home[0] - y * scale, home[1] - x * scale]);
  const camera = new PerspectiveCamera(45, width / height);
  camera.up.set(0, 0, 1);
  camera.position.copy(new Vector3(-0.8, 0.14, 0.55).normalize().multiplyScalar(away));
  camera.lookAt(0, 0, 0);
  camera.updateMatrixWorld();
  const deep = (x: number, y: number, z: number): Place => {
    const spot = new Vector3(x, y, z).project(camera);
    return [((spot.x + 1) / 2) * width, ((1 - spot.y) / 2) * height];
  };
  return { view, theme: "dark", width, height, box, camera: camera.position.toArray(), place: view === "orbit" ? deep : flat };
}

function texts(seen: Outlook): Written[] {
  const paper = new Paper();
  labels(paper as unknown as CanvasRenderingContext2D, seen, [[seen.width - 200, seen.height - 66, seen.width - 8, seen.height - 20]]);
  return paper.written;
}

const SIZES = [[1176, 435], [390, 464], [200, 120]] as const;
for (const view of ["polar", "top", "side", "orbit"] as const) {
  test(`labels of the ${view} view are written once, whole, and touch neither each other nor the bar of colours`, () => {
    for (const [width, height] of SIZES) {
      for (const home of [[width / 2, height / 2], [width / 2, height + 300], [40, height - 30], [-700, 60]] as Place[]) {
        for (const scale of [4, 45, 400]) {
          const found = texts(outlook(view, width, height, home, scale, 600 / scale));
          const name = `${view} ${width}x${height} at ${home.join(" ")} by ${scale}`;
          assert.equal(new Set(found.map(({ text }) => text)).size, found.length, `${name}: one is written twice`);
          found.forEach((one, number) => {
            assert.ok(one.left >= 0 && one.right <= width && one.down >= 6 && one.down <= height - 6, `${name}: ${one.text} is cut`);
            const isOnBar = one.right > width - 200 && one.left < width - 8 && one.down > height - 66 && one.down < height - 20;
            assert.ok(!isOnBar, `${name}: ${one.text} is on the bar`);
            for (const other of found.slice(number + 1)) {
              const isApart = one.right < other.left || other.right < one.left || Math.abs(one.down - other.down) >= 12;
              assert.ok(isApart, `${name}: ${one.text} is on ${other.text}`);
            }
          });
        }
      }
    }
  });
}

test("rings that cross the canvas are labelled, also with the sensor beside it", () => {
  const metres = (home: Place): string[] => texts(outlook("polar", 390, 464, home, 40)).map(({ text }) => text).filter((text) => text.endsWith(" m"));
  assert.deepEqual(metres([195, 232]), ["2 m", "4 m"]);
  assert.deepEqual(metres([195, 800]), ["12 m", "14 m", "16 m", "18 m"], "the one of 10 m is behind the bar");
});
