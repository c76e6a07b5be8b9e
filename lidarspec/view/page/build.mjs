// Bundles the page, and the notebook's widget, into dist/; `--watch` goes on doing so, `--tests` makes dist-tests/ for node's test runner.

import { build, context } from "esbuild";
import { copyFileSync, readdirSync, readFileSync, rmSync, writeFileSync } from "node:fs";

const tests = process.argv.includes("--tests");
const watch = process.argv.includes("--watch");
const folder = tests ? "dist-tests" : "dist";

rmSync(folder, { recursive: true, force: true });
const entries = tests ? readdirSync("tests").map((name) => `tests/${name}`) : ["src/page.ts", "src/widget.ts"];

const options = {
  entryPoints: entries,
  outdir: folder,
  bundle: true,
  format: "esm",
  target: tests ? "node20" : "es2023",
  platform: tests ? "node" : "browser",
  minify: !tests && !watch,
  sourcemap: watch ? "linked" : false,
  legalComments: "none", // the licences stand whole in LICENSES.txt
  logLevel: "warning",
  outExtension: tests ? { ".js": ".mjs" } : {},
};

if (watch) {
  const running = await context(options);
  await running.watch();
  console.log(`watching; ${folder}/ is made anew after each change`);
} else {
  await build(options);
}
if (!tests) {
  const bundled = Object.keys(JSON.parse(readFileSync("package.json", "utf8")).dependencies);
  const licences = bundled.map((name) => `${name}\n\n${readFileSync(`node_modules/${name}/LICENSE`, "utf8")}`);
  copyFileSync("src/index.html", `${folder}/index.html`);
  writeFileSync(`${folder}/LICENSES.txt`, licences.join(`\n${"-".repeat(80)}\n\n`));
}
