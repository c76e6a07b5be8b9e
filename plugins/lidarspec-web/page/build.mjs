// Build the page and the notebook widget into the Python package, as files that are tracked in git.
//
//   --check   build into a temporary folder and fail if the tracked files differ
//   --watch   build again after each change, not minified
//   --tests   build dist-tests/ for the test runner of Node.js
//
// The output depends only on the sources and on package-lock.json: it contains no dates and no paths.

import { build, context } from "esbuild";
import { copyFileSync, existsSync, readdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";

const tests = process.argv.includes("--tests");
const watch = process.argv.includes("--watch");
const check = process.argv.includes("--check");

const tracked = "../lidarspec_web/page";
let folder = tracked;
if (tests) folder = "dist-tests";
if (check) folder = "dist-check";

rmSync(folder, { recursive: true, force: true });
const entries = tests ? readdirSync("tests").filter((name) => name.endsWith(".ts")).map((name) => `tests/${name}`) : ["src/page.ts", "src/widget.ts"];

const options = {
  entryPoints: entries,
  outdir: folder,
  bundle: true,
  format: "esm",
  target: tests ? "node20" : "es2023",
  platform: tests ? "node" : "browser",
  minify: !tests && !watch,
  sourcemap: watch ? "linked" : false,
  legalComments: "none", // LICENSES.txt contains the complete licences
  logLevel: "warning",
  outExtension: tests ? { ".js": ".mjs" } : {},
};

if (watch) {
  const running = await context(options);
  await running.watch();
  console.log(`watching; builds ${folder}/ again after each change; run make page before you commit`);
} else {
  await build(options);
}
if (!tests) {
  const bundled = Object.keys(JSON.parse(readFileSync("package.json", "utf8")).dependencies);
  const licences = bundled.map((name) => `${name}\n\n${readFileSync(`node_modules/${name}/LICENSE`, "utf8")}`);
  copyFileSync("src/index.html", `${folder}/index.html`);
  writeFileSync(`${folder}/LICENSES.txt`, licences.join(`\n${"-".repeat(80)}\n\n`));
}
if (check) {
  const names = [...new Set([...readdirSync(tracked), ...readdirSync(folder)])];
  const stale = names.filter((name) => !isEqual(`${tracked}/${name}`, `${folder}/${name}`));
  rmSync(folder, { recursive: true });
  if (stale.length > 0) {
    console.error(`${tracked} differs from a fresh build in ${stale.join(", ")}: run make page and commit the result`);
    process.exitCode = 1;
  }
}

function isEqual(path, other) {
  return existsSync(path) && existsSync(other) && readFileSync(path).equals(readFileSync(other));
}
