// Bundles viewer.js with the parts of three.js it uses into the package's assets: npm ci && npm run build

import { readFileSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

const assets = new URL("../../jaxsmw/report/assets/", import.meta.url);
const license = readFileSync(new URL("node_modules/three/LICENSE", import.meta.url), "utf8");

await build({
  entryPoints: ["viewer.js"],
  outfile: new URL("viewer.js", assets).pathname,
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  charset: "ascii",
  legalComments: "none",
  // Every page carries a copy of three.js, and so its licence.
  banner: { js: `/* Contains three.js:\n\n${license.trim()}\n*/` },
});
writeFileSync(new URL("THREE-LICENSE", assets), license);
