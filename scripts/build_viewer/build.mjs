// Bundles viewer.js and the modules that it imports, with the parts of three.js that they use, into
// the package's assets. Run `npm ci && npm run build` in this directory.

import { createHash } from "node:crypto";
import { readdirSync, readFileSync, writeFileSync } from "node:fs";
import { build } from "esbuild";

const assets = new URL("../../jaxsmw/report/assets/", import.meta.url);
const hash = createHash("sha256");
for (const name of readdirSync(".").filter((name) => name.endsWith(".js")).sort()) hash.update(readFileSync(name));
const digest = hash.digest("hex");
const license = readFileSync(new URL("node_modules/three/LICENSE", import.meta.url), "utf8");

await build({
  entryPoints: ["viewer.js"],
  outdir: assets.pathname,
  bundle: true,
  minify: true,
  format: "iife",
  target: "es2022",
  charset: "ascii",
  legalComments: "none",
  // Every page contains a copy of three.js, so it must also contain the licence of three.js.
  // tests/test_page.py compares this digest with the digest of all .js files of this directory, in the order of names.
  banner: { js: `/* Built from the viewer's sources with SHA-256 ${digest}.\nContains three.js:\n\n${license.trim()}\n*/` },
});
writeFileSync(new URL("THREE-LICENSE", assets), license);
