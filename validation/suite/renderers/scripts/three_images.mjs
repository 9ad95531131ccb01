// Render scene.glb, and the sky sky.exr if it exists, by three-gpu-pathtracer or three in a headless browser, with WebGL2
// on the CPU:
//   node three_images.mjs NPM_FOLDER CHROMIUM SCENE_FOLDER OUT_FOLDER WIDTH HEIGHT SPP MODE SEED…
// Writes one seedN.f32 per seed: rows from the top, three float32 per pixel. MODE: mis (with multiple importance
// sampling of the sky, the path tracer's default), none (without), or raster (three's rasteriser; seeds do not matter).
import { createServer } from "node:http";
import { existsSync } from "node:fs";
import { readFile, writeFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { extname, join, resolve } from "node:path";

const [npm, chromium, scene, out, width, height, spp, mode, ...seeds] = process.argv.slice(2);
const puppeteer = createRequire(join(resolve(npm), "package.json"))("puppeteer-core");
const TIMEOUT = 3_600_000; // ms: enough on a busy machine
const page = new URL("three_images.html", import.meta.url);
const types = { ".js": "text/javascript", ".html": "text/html", ".json": "application/json" };
const roots = { "/modules/": join(npm, "node_modules"), "/scene/": scene };

const server = createServer(async (request, response) => {
  const path = decodeURIComponent(new URL(request.url, "http://localhost").pathname);
  const root = Object.keys(roots).find((prefix) => path.startsWith(prefix));
  try {
    const data = await readFile(root ? join(roots[root], path.slice(root.length)) : page);
    response.writeHead(200, { "Content-Type": root ? types[extname(path)] ?? "application/octet-stream" : "text/html" });
    response.end(data);
  } catch {
    response.writeHead(404).end();
  }
});
await new Promise((done) => server.listen(0, "127.0.0.1", done));

const browser = await puppeteer.launch({
  executablePath: chromium,
  args: ["--no-sandbox", "--use-gl=angle", "--use-angle=gl-egl", "--ignore-gpu-blocklist"],
  env: { ...process.env, LIBGL_ALWAYS_SOFTWARE: "1" },
  timeout: TIMEOUT,
  protocolTimeout: TIMEOUT,
});
try {
  const tab = await browser.newPage();
  tab.setDefaultTimeout(TIMEOUT);
  tab.on("console", (message) => console.error(message.text()));
  tab.on("pageerror", (error) => console.error(error.message));
  await tab.goto(`http://127.0.0.1:${server.address().port}/`);
  if (!(await tab.evaluate(() => document.createElement("canvas").getContext("webgl2") !== null))) {
    console.error("no WebGL2 in this browser; Debian: libegl1 libgl1-mesa-dri");
    process.exitCode = 77;
    throw undefined;
  }
  await tab.waitForFunction("window.prepare");
  const size = [Number(width), Number(height)];
  const prepare = (...words) => window.prepare(...words);
  await tab.evaluate(prepare, size, mode, existsSync(join(scene, "sky.exr")));
  for (const seed of seeds) {
    const pixels = await tab.evaluate((spp, seed) => window.render(spp, seed), Number(spp), Number(seed));
    await writeFile(join(out, `seed${seed}.f32`), Buffer.from(pixels, "base64"));
    console.log(join(out, `seed${seed}.f32`));
  }
} catch (error) {
  if (process.exitCode !== 77) console.error(error.message);
  process.exitCode ??= 1;
} finally {
  await browser.close();
  server.close();
}
