// Builds ../page from src and static; the built scripts carry the hash of their sources, which a test compares.
import { createHash } from "node:crypto";
import { copyFileSync, readdirSync, readFileSync } from "node:fs";
import { build } from "esbuild";

const out = process.argv[2] ?? "../page";
const hash = createHash("sha256");
for (const folder of ["src", "static"]) {
  for (const name of readdirSync(folder).sort()) {
    const text = readFileSync(`${folder}/${name}`, "utf8").replaceAll("\r\n", "\n");
    hash.update(`${folder}/${name}\0${text}\0`);
  }
}

await build({
  entryPoints: { viewfinder: "src/main.ts", camera: "src/camera.ts", studio: "src/studio.ts" },
  bundle: true,
  format: "iife",
  target: ["chrome100", "safari15.4", "firefox100"],
  charset: "utf8",
  outdir: out,
  banner: { js: `// Built from viewfinder/page_source by \`npm run build\`; do not edit. sources: ${hash.digest("hex")}` },
});
for (const name of readdirSync("static")) copyFileSync(`static/${name}`, `${out}/${name}`);
