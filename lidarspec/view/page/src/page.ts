import "./style.css";
import { Picture } from "./picture";
import { Connection, Pace } from "./protocol";
const pace = new Pace();
let picture: Picture;
const url = new URL("socket", location.href.replace(/^http/, "ws"));
const c = new Connection(url.href, { scan: (s) => picture.show(s), connected: () => {}, said: (m) => { if (m.is === "hello") {
  picture = new Picture(document.getElementById("picture")!, { planar: m.planar, theme: matchMedia("(prefers-color-scheme: dark)").matches ? "dark" : "light", drawn: (ms, s) => { pace.drawn(ms, s.points, s.of); (window as any).log = [ms, s.points, Date.now()/1000 - s.sent]; c.next(pace.most); } });
  (window as any).picture = picture; c.next(pace.most); } } });
