/**
 * Scans drawn in an element: points in three dimensions, from above, from the side, or around the sensor.
 *
 * It is given scans and knows nothing of where they come from. Points are drawn by the graphics card, straight from the columns of
 * a scan; what lies around them (`ground`) is two canvases, one under and one over them. The newest scan is drawn, once a frame of
 * the browser at most, and none before the last is on the screen.
 */

import {
  BufferAttribute,
  BufferGeometry,
  DataTexture,
  DynamicDrawUsage,
  OrthographicCamera,
  PerspectiveCamera,
  Points,
  RGBAFormat,
  Scene,
  ShaderMaterial,
  TOUCH,
  Vector3,
  WebGLRenderer,
} from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { scale, Span, STEPS, type Theme } from "./colours";
import { type Axes, type Box, centralPoints, fit, isFitted, type Point } from "./fit";
import { BAR, barRect, colourBar, ground, INKS, labels, mark, metres, type Outlook, type Place, type View } from "./ground";
import type { Column, Scan } from "./protocol";

export type { Theme, View };

export interface PictureOptions {
  theme?: Theme;
  /** whether all points are in one plane, which is then seen from above */
  planar?: boolean;
  /** a point of the shown scan was clicked: its place in the columns */
  picked?: (row: number, scan: Scan) => void;
  /** a scan is on the screen, milliseconds after it was begun */
  drawn?: (milliseconds: number, scan: Scan) => void;
}

const VERTEX = `
attribute float x, y, z, value;
uniform float size, low, high;
varying float share;
void main() {
  gl_Position = projectionMatrix * modelViewMatrix * vec4(x, y, z, 1.0);
  gl_PointSize = size;
  share = clamp((value - low) / (high - low), 0.0, 1.0);
}`;
const FRAGMENT = `
uniform sampler2D ramp;
uniform bool disc;
varying float share;
void main() {
  if (disc && length(gl_PointCoord - 0.5) > 0.5) discard;
  gl_FragColor = texture2D(ramp, vec2(share, 0.5));
}`;
const COLUMNS = ["x", "y", "z", "value"] as const;

/** Pixels that a mouse and a finger may be beside a point, and that they may move within a click. */
const BESIDE = 9;
const BESIDE_FINGER = 22;
const STILL = 4;
const FIELD_OF_VIEW = 45;
/** Half of the field of view, as the tangent of its angle. */
const TANGENT = Math.tan((FIELD_OF_VIEW * Math.PI) / 360);
/** From where a cloud is seen at first: behind the sensor and above it. */
const LOOK = new Vector3(-0.8, 0.14, 0.55).normalize();
/** How much more than the points is seen where a growing scan is fitted again, so that the picture does not jump with each scan. */
const HEADROOM = 1.1;
/** The points that are fitted while there are none. */
const NOTHING: Point[] = [[-1, -1, 0], [1, 1, 0]];

export class Picture {
  readonly #renderer: WebGLRenderer;
  readonly #under = document.createElement("canvas");
  readonly #over = document.createElement("canvas");
  readonly #tip = document.createElement("div");
  readonly #scene = new Scene();
  readonly #points: Points<BufferGeometry, ShaderMaterial>;
  readonly #flat = new OrthographicCamera();
  readonly #deep = new PerspectiveCamera(FIELD_OF_VIEW);
  readonly #watcher: ResizeObserver;
  readonly #span = new Span();
  #controls: OrbitControls;
  #theme: Theme;
  #by = "range";
  #size = 0;
  #view: View;
  #scan: Scan | null = null;
  #central = NOTHING;
  #box: Box = { low: [-1, -1, 0], high: [1, 1, 0] };
  #fitted = false;
  #moved = false;
  #dirty = false;
  #fresh = false;
  #due = 0;
  #begun = 0;
  #fence: WebGLSync | null = null;
  #hovered: number | null = null;
  #marked: number | null = null;
  #pointer: Place | null = null;
  #pointed = false;
  #around = "";
  #within = "";

  constructor(
    readonly element: HTMLElement,
    readonly options: PictureOptions = {},
  ) {
    this.#theme = options.theme ?? "dark";
    this.#view = options.planar === true ? "polar" : "orbit";
    this.#renderer = new WebGLRenderer({ alpha: true, antialias: false, powerPreference: "high-performance" });
    this.#renderer.setClearAlpha(0);
    this.#points = points(this.#theme);
    this.#scene.add(this.#points);
    this.#compose();
    this.#controls = this.#controlled();
    this.#watcher = new ResizeObserver(() => this.#resize());
    this.#watcher.observe(element);
    this.#resize();
  }

  /** Draw a scan in place of the last. */
  show(scan: Scan): void {
    this.#scan = scan;
    this.#fresh = true;
    this.#hovered = this.#marked = null;
    this.#ask();
  }

  /** What is shown. */
  get scan(): Scan | null {
    return this.#scan;
  }

  /** What colours can show. */
  get colours(): string[] {
    const has = (name: string): boolean => this.#scan?.columns.has(name) ?? false;
    return ["range", ...(has("intensity") ? ["intensity"] : []), ...(has("ring") ? ["ring"] : []), ...(this.options.planar ? [] : ["height"])];
  }

  /** Colour points by range, intensity, ring or height. */
  colour(by: string): void {
    this.#by = by;
    this.#span.forget();
    this.#fresh = this.#scan !== null;
    this.#ask();
  }

  theme(theme: Theme): void {
    this.#theme = theme;
    this.#points.material.uniforms.ramp!.value = texture(theme);
    this.#compose();
    this.#ask();
  }

  /** The size of points in pixels; 0 leaves it to their number. */
  size(pixels: number): void {
    this.#size = pixels;
    this.#ask();
  }

  /** From above with range rings, from above, from the right, or from where one likes; all of it is seen. */
  view(view: View): void {
    this.#view = view;
    this.#controls.dispose();
    this.#controls = this.#controlled();
    this.reset();
  }

  /** All of it again. */
  reset(): void {
    this.#moved = false;
    if (this.#scan) this.#take(centralPoints(this.#scan));
    this.#aim();
  }

  zoom(times: number): void {
    this.#moved = true;
    if (this.#camera === this.#flat) this.#flat.zoom *= times;
    else this.#deep.position.lerp(this.#controls.target, 1 - 1 / times);
    this.#turned();
  }

  /** Move what is seen by shares of the picture. */
  move(right: number, up: number): void {
    this.#moved = true;
    const camera = this.#camera;
    const reach = camera === this.#flat ? (this.#flat.top - this.#flat.bottom) / this.#flat.zoom : this.#deep.position.distanceTo(this.#controls.target);
    const by = new Vector3(right * reach, up * reach, 0).applyQuaternion(camera.quaternion);
    camera.position.add(by);
    this.#controls.target.add(by);
    this.#turned();
  }

  /** The point at a place of the element, in its pixels: its place in the columns, null where there is none. */
  pick(across: number, down: number, beside = BESIDE): number | null {
    const columns = this.#columns();
    if (!columns) return null;
    const [x, y, z] = columns;
    const place = this.#placer();
    let [nearest, best] = [-1, beside ** 2];
    for (let row = 0; row < x.length; row++) {
      const spot = place(x[row]!, y[row]!, z[row]!);
      const away = spot === null ? Infinity : (spot[0] - across) ** 2 + (spot[1] - down) ** 2;
      if (away < best) [nearest, best] = [row, away];
    }
    return nearest < 0 ? null : nearest;
  }

  /** Mark a point of the shown scan until the next scan is shown. */
  mark(row: number | null): void {
    this.#marked = row;
    this.#ask();
  }

  /** Where a point of the world is in the element, in its pixels; null behind the camera. */
  place(x: number, y: number, z: number): Place | null {
    return this.#placer()(x, y, z);
  }

  /** The picture as a PNG. */
  async image(): Promise<Blob> {
    const whole = document.createElement("canvas");
    [whole.width, whole.height] = [this.#under.width, this.#under.height];
    const context = whole.getContext("2d")!;
    this.#draw();
    for (const layer of [this.#under, this.#renderer.domElement, this.#over]) context.drawImage(layer, 0, 0, whole.width, whole.height);
    return new Promise((resolve, reject) => whole.toBlob((blob) => (blob ? resolve(blob) : reject(new Error("the picture is empty"))), "image/png"));
  }

  close(): void {
    cancelAnimationFrame(this.#due);
    this.#watcher.disconnect();
    this.#controls.dispose();
    this.#points.geometry.dispose();
    this.#points.material.dispose();
    this.#renderer.dispose();
    this.#renderer.forceContextLoss();
    this.element.replaceChildren();
  }

  get #camera(): OrthographicCamera | PerspectiveCamera {
    return this.#view === "orbit" ? this.#deep : this.#flat;
  }

  /** The canvases, one over the other, and what is said beside the pointer. */
  #compose(): void {
    const inks = INKS[this.#theme];
    const canvas = this.#renderer.domElement;
    for (const layer of [this.#under, canvas, this.#over]) Object.assign(layer.style, { position: "absolute", inset: "0", width: "100%", height: "100%" });
    this.#over.style.pointerEvents = "none";
    Object.assign(this.#tip.style, {
      position: "absolute",
      pointerEvents: "none",
      display: "none",
      whiteSpace: "pre",
      padding: "5px 8px",
      font: "12px/1.4 system-ui, sans-serif",
      borderRadius: "4px",
      background: inks.faint,
      color: inks.strong,
      border: `1px solid ${inks.line}`,
    });
    if (canvas.parentElement === this.element) return;
    this.element.style.position ||= "relative";
    this.element.replaceChildren(this.#under, canvas, this.#over, this.#tip);
    this.#listen(canvas);
  }

  #listen(canvas: HTMLCanvasElement): void {
    let pressed: Place = [0, 0];
    const at = (event: MouseEvent): Place => [event.offsetX, event.offsetY];
    canvas.addEventListener("pointerdown", (event) => (pressed = at(event)));
    canvas.addEventListener("pointermove", (event) => {
      this.#pointer = event.buttons ? null : at(event);
      this.#wake();
    });
    canvas.addEventListener("pointerleave", () => {
      this.#pointer = null;
      this.#wake();
    });
    canvas.addEventListener("click", (event) => {
      if (Math.hypot(event.offsetX - pressed[0], event.offsetY - pressed[1]) > STILL || !this.#scan) return;
      // the one that is marked: a click comes in whole pixels
      this.#choose(this.#pointer ?? at(event), event.pointerType === "touch" ? BESIDE_FINGER : BESIDE);
    });
    this.element.addEventListener("keydown", (event) => {
      const { clientWidth, clientHeight } = this.element;
      if (event.key === "Enter") this.#choose([clientWidth / 2, clientHeight / 2], Infinity);
    });
  }

  #choose([across, down]: Place, beside: number): void {
    const row = this.pick(across, down, beside);
    if (row !== null) this.options.picked?.(row, this.#scan!);
  }

  #controlled(): OrbitControls {
    const above = this.#view === "polar" || this.#view === "top";
    this.#camera.up.set(above ? 1 : 0, 0, above ? 0 : 1);
    const controls = new OrbitControls(this.#camera, this.#renderer.domElement);
    controls.enableRotate = this.#view === "orbit";
    controls.zoomToCursor = true;
    if (!controls.enableRotate) {
      controls.mouseButtons.LEFT = controls.mouseButtons.RIGHT;
      controls.touches.ONE = TOUCH.PAN;
    }
    controls.addEventListener("start", () => (this.#moved = true));
    controls.addEventListener("change", () => this.#ask());
    return controls;
  }

  #resize(): void {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (!width || !height) return;
    const ratio = window.devicePixelRatio;
    this.#renderer.setPixelRatio(ratio);
    this.#renderer.setSize(width, height, false);
    for (const layer of [this.#under, this.#over]) {
      [layer.width, layer.height] = [Math.round(width * ratio), Math.round(height * ratio)];
      layer.getContext("2d")!.setTransform(ratio, 0, 0, ratio, 0, 0);
    }
    this.#around = this.#within = "";
    if (this.#moved) {
      const before = (this.#flat.right - this.#flat.left) / (this.#flat.top - this.#flat.bottom);
      this.#flat.left *= width / height / before;
      this.#flat.right *= width / height / before;
      this.#deep.aspect = width / height;
      this.#turned();
    } else this.#aim();
  }

  #take(central: Point[]): void {
    this.#central = central.length > 0 ? central : NOTHING;
  }

  /** Point the camera so that the central points fill the canvas; it sees `headroom` times as much. */
  #aim(headroom = 1): void {
    const { clientWidth: width, clientHeight: height } = this.element;
    if (!width || !height) return;
    const axes = axesOf(this.#view);
    const isDeep = this.#view === "orbit";
    const found = fit(this.#central, { axes, tangent: isDeep ? TANGENT : 0 }, { width, height, footer: BAR.room });
    const distance = found.distance * headroom;
    const aspect = width / height;
    this.#box = found.box;
    this.#controls.target.set(...found.target);
    const backward = new Vector3(...axes.forward).negate();
    if (isDeep) {
      this.#deep.aspect = aspect;
      [this.#deep.near, this.#deep.far] = [distance / 500, distance * 50];
      this.#deep.position.copy(this.#controls.target).addScaledVector(backward, distance);
    } else {
      const far = 4 * Math.hypot(...found.box.low.map((low, axis) => found.box.high[axis]! - low)) + 10;
      Object.assign(this.#flat, { left: -distance * aspect, right: distance * aspect, top: distance, bottom: -distance, near: 0, far: 2 * far, zoom: 1 });
      this.#flat.position.copy(this.#controls.target).addScaledVector(backward, far);
    }
    this.#turned();
  }

  #turned(): void {
    this.#camera.updateProjectionMatrix();
    this.#controls.update();
    this.#ask();
  }

  /** Have all drawn that has changed, with the next frame of the browser. */
  #ask(): void {
    this.#dirty = true;
    this.#wake();
  }

  #wake(): void {
    this.#due ||= requestAnimationFrame(() => {
      this.#due = 0;
      this.#frame();
    });
  }

  /** One frame of the browser: nothing is begun while the graphics card is at the last scan. */
  #frame(): void {
    const gl = this.#renderer.getContext() as WebGL2RenderingContext;
    if (this.#fence) {
      const isDone = gl.isContextLost() || gl.getSyncParameter(this.#fence, gl.SYNC_STATUS) === gl.SIGNALED;
      if (!isDone) return this.#wake();
      gl.deleteSync(this.#fence);
      this.#fence = null;
      this.options.drawn?.(performance.now() - this.#begun, this.#scan!);
    }
    if (!this.#dirty) return this.#surround();
    const isFresh = this.#fresh;
    this.#dirty = this.#fresh = false;
    if (isFresh) {
      this.#begun = performance.now();
      this.#fill(this.#scan!);
    }
    this.#draw();
    if (isFresh) {
      this.#fence = gl.fenceSync(gl.SYNC_GPU_COMMANDS_COMPLETE, 0);
      gl.flush();
      this.#wake();
    }
  }

  /** Hand the columns of a scan to the graphics card; the room for them grows and stays. */
  #fill(scan: Scan): void {
    this.#refit(scan);
    const values = this.#values(scan);
    this.#span.fit(values);
    const { geometry, material } = this.#points;
    if (((geometry.getAttribute("x") as BufferAttribute | undefined)?.count ?? 0) < scan.points) this.#grow(scan.points);
    COLUMNS.forEach((name) => {
      const attribute = geometry.getAttribute(name) as BufferAttribute;
      (attribute.array as Float32Array).set(name === "value" ? values : scan.columns.get(name)!);
      attribute.clearUpdateRanges();
      attribute.addUpdateRange(0, scan.points);
      attribute.needsUpdate = true;
    });
    geometry.setDrawRange(0, scan.points);
    material.uniforms.low!.value = this.#span.low;
    material.uniforms.high!.value = this.#span.high;
  }

  #grow(needed: number): void {
    const room = 2 ** Math.ceil(Math.log2(Math.max(needed, 1024)));
    this.#points.geometry.dispose();
    for (const name of COLUMNS) {
      this.#points.geometry.setAttribute(name, new BufferAttribute(new Float32Array(room), 1).setUsage(DynamicDrawUsage));
    }
  }

  /** Fit the first whole scan, and one that leaves the canvas or needs much less of it, unless the camera was moved by hand. */
  #refit(scan: Scan): void {
    if (this.#moved || !scan.points) return;
    const central = centralPoints(scan);
    const { clientWidth, clientHeight } = this.element;
    const place = this.#placer();
    const places = central.map((point) => place(...point));
    if (this.#fitted && isFitted(places, clientWidth, clientHeight)) return;
    this.#take(central);
    this.#aim(this.#fitted ? HEADROOM : 1);
    this.#fitted ||= scan.whole;
  }

  #values(scan: Scan): Column {
    return scan.columns.get(this.#by === "height" ? "z" : this.#by) ?? scan.columns.get("range")!;
  }

  #draw(): void {
    const { uniforms } = this.#points.material;
    const size = this.#size || ((this.#scan?.points ?? 0) > 5000 ? 2 : 4);
    uniforms.size!.value = size * window.devicePixelRatio;
    uniforms.disc!.value = size > 2;
    this.#renderer.render(this.#scene, this.#camera);
    this.#surround();
  }

  /** Draw what lies around the points, where it has changed. */
  #surround(): void {
    const outlook = this.#outlook();
    this.#hovered = this.#pointer ? this.pick(...this.#pointer) : null;
    const camera = [...this.#camera.projectionMatrix.elements, ...this.#camera.matrixWorld.elements];
    const around = JSON.stringify([outlook, camera]);
    const within = JSON.stringify([around, this.#by, this.#span, this.#scan !== null]);
    if (around !== this.#around) ground(this.#under.getContext("2d")!, outlook);
    if (within !== this.#within || this.#hovered !== null || this.#marked !== null || this.#pointed) this.#label(outlook);
    [this.#around, this.#within] = [around, within];
  }

  /** What stands over the points. */
  #label(outlook: Outlook): void {
    const over = this.#over.getContext("2d")!;
    over.clearRect(0, 0, outlook.width, outlook.height);
    labels(over, outlook, this.#scan ? [barRect(outlook)] : []);
    if (!this.#scan) return;
    const by = this.#by === "height" ? "z" : this.#by;
    colourBar(over, outlook, this.#by, this.#scan.units.get(by) ?? "", this.#span);
    this.#point(over, outlook);
  }

  /** Mark the point that was picked and the one under the pointer, and say where that is. */
  #point(over: CanvasRenderingContext2D, outlook: Outlook): void {
    this.#pointed = this.#hovered !== null || this.#marked !== null;
    const columns = this.#columns();
    for (const row of [this.#marked, this.#hovered]) {
      const spot = row === null || !columns ? null : outlook.place(columns[0][row]!, columns[1][row]!, columns[2][row]!);
      if (spot) mark(over, spot, this.#theme, row === this.#marked ? 8 : 6);
    }
    this.#renderer.domElement.style.cursor = this.#hovered === null ? "" : "pointer";
    this.#tip.style.display = this.#hovered === null ? "none" : "block";
    if (this.#hovered === null || !this.#pointer) return;
    this.#tip.textContent = described(this.#scan!, this.#hovered, this.options.planar === true);
    const [across, down] = this.#pointer;
    this.#tip.style.left = `${Math.min(across + 14, outlook.width - this.#tip.offsetWidth - 4)}px`;
    this.#tip.style.top = `${Math.min(down + 14, outlook.height - this.#tip.offsetHeight - 4)}px`;
  }

  #columns(): [Column, Column, Column] | null {
    const columns = this.#scan?.columns;
    return columns ? [columns.get("x")!, columns.get("y")!, columns.get("z")!] : null;
  }

  #outlook(): Outlook {
    const { clientWidth: width, clientHeight: height } = this.element;
    return { view: this.#view, theme: this.#theme, width, height, box: this.#box, camera: this.#camera.position.toArray(), place: this.#placer() };
  }

  /** What turns a point of the world into pixels, as the camera stands now. */
  #placer(): (x: number, y: number, z: number) => Place | null {
    const { clientWidth: width, clientHeight: height } = this.element;
    const camera = this.#camera;
    camera.updateMatrixWorld();
    const m = camera.projectionMatrix.clone().multiply(camera.matrixWorldInverse).elements;
    return (x, y, z) => {
      const w = m[3] * x + m[7] * y + m[11] * z + m[15];
      if (w <= 1e-6) return null;
      const across = (m[0] * x + m[4] * y + m[8] * z + m[12]) / w;
      const up = (m[1] * x + m[5] * y + m[9] * z + m[13]) / w;
      return [((across + 1) / 2) * width, ((1 - up) / 2) * height];
    };
  }
}

function points(theme: Theme): Points<BufferGeometry, ShaderMaterial> {
  const uniforms = { size: { value: 2 }, low: { value: 0 }, high: { value: 1 }, disc: { value: false }, ramp: { value: texture(theme) } };
  const cloud = new Points(new BufferGeometry(), new ShaderMaterial({ uniforms, vertexShader: VERTEX, fragmentShader: FRAGMENT }));
  cloud.frustumCulled = false;
  return cloud;
}

function texture(theme: Theme): DataTexture {
  const made = new DataTexture(scale(theme), STEPS, 1, RGBAFormat);
  made.needsUpdate = true;
  return made;
}

/** Return the axes of the camera of a view: from above with forward up, from the right, or from behind and above. */
export function axesOf(view: View): Axes {
  if (view === "side") return { right: [1, 0, 0], up: [0, 0, 1], forward: [0, 1, 0] };
  if (view !== "orbit") return { right: [0, -1, 0], up: [1, 0, 0], forward: [0, 0, -1] };
  const forward = LOOK.clone().negate();
  const right = forward.clone().cross(new Vector3(0, 0, 1)).normalize();
  const up = right.clone().cross(forward);
  return { right: right.toArray(), up: up.toArray(), forward: forward.toArray() };
}

/** A point in words: range and angle of a planar scan, x y z of others, and what else is known of it. */
export function described(scan: Scan, row: number, planar: boolean): string {
  const at = (name: string): number => scan.columns.get(name)?.[row] ?? NaN;
  const [x, y, z] = [at("x"), at("y"), at("z")];
  const range = `range ${metres(Number(at("range").toFixed(3)))}`;
  const azimuth = `azimuth ${((Math.atan2(y, x) * 180) / Math.PI).toFixed(2)}°`;
  const place = planar ? `x ${x.toFixed(3)}  y ${y.toFixed(3)} m` : `x ${x.toFixed(3)}  y ${y.toFixed(3)}  z ${z.toFixed(3)} m`;
  const more = ["intensity", "ring"].filter((name) => scan.columns.has(name)).map((name) => `${name} ${Number(at(name).toPrecision(6))}`);
  return [`${range}   ${azimuth}`, place, ...(more.length ? [more.join("   ")] : [])].join("\n");
}
