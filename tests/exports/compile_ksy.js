// Compiles Kaitai specs to Python: node compile_ksy.js OUT_FOLDER SPEC.ksy...
const fs = require("fs");
const path = require("path");
const compiler = require("kaitai-struct-compiler");
const yaml = require("js-yaml");

const compile = typeof compiler === "function" ? new compiler().compile.bind(new compiler()) : compiler.compile;
const [folder, ...specs] = process.argv.slice(2);

(async () => {
  for (const spec of specs) {
    const files = await compile("python", yaml.load(fs.readFileSync(spec, "utf8")), null, false);
    for (const [name, text] of Object.entries(files)) fs.writeFileSync(path.join(folder, name), text);
  }
})().catch((error) => {
  console.error(String((error && error.message) || error));
  process.exit(1);
});
