"use strict";
// Pixels stay half floats: exposure is one table of 65536 codes, and painting is a look-up.
const root = document.documentElement;
addEventListener("error", (e) => (root.dataset.error = e.message));
addEventListener("unhandledrejection", (e) => (root.dataset.error = String(e.reason)));
const all = (selector, from = document) => [...from.querySelectorAll(selector)];

const halves = Float32Array.from({ length: 65536 }, (_, code) => {
  const sign = code & 0x8000 ? -1 : 1, exponent = (code >> 10) & 31, fraction = code & 1023;
  if (exponent === 31) return fraction ? NaN : sign * Infinity;
  return sign * (exponent ? 2 ** (exponent - 15) * (1 + fraction / 1024) : 2 ** -24 * fraction);
});
const sRGB = (v) => 255 * (v <= 0.0031308 ? 12.92 * v : 1.055 * v ** (1 / 2.4) - 0.055);
const NOT_A_NUMBER = [255, 0, 255]; // magenta, wherever it is
const tone = new Uint8ClampedArray(65536);
const expose = (ev) => halves.forEach((v, code) => (tone[code] = sRGB(Math.min(Math.max(v * 2 ** ev, 0), 1))));

const pictures = {};
async function load(id) {
  const deflated = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
  const stream = new Blob([deflated]).stream().pipeThrough(new DecompressionStream("deflate"));
  const planes = new Uint8Array(await new Response(stream).arrayBuffer());
  const half = planes.length / 2;
  pictures[id] = Uint16Array.from({ length: half }, (_, i) => (planes[i] << 8) | planes[half + i]);
}

function paint(canvas, colour) {
  const codes = pictures[canvas.dataset.pixels], context = canvas.getContext("2d");
  const image = context.createImageData(canvas.width, canvas.height), out = image.data;
  for (let i = 0, o = 0; i < codes.length; i += 3, o += 4) {
    const r = codes[i], g = codes[i + 1], b = codes[i + 2];
    if (halves[r] !== halves[r] || halves[g] !== halves[g] || halves[b] !== halves[b]) out.set(NOT_A_NUMBER, o);
    else colour(r, g, b, out, o);
    out[o + 3] = 255;
  }
  context.putImageData(image, 0, 0);
}

function light(r, g, b, out, o) {
  out[o] = tone[r];
  out[o + 1] = tone[g];
  out[o + 2] = tone[b];
}

// The channel that differs most speaks for the pixel: a mean would let two errors cancel.
const BLUE = [33, 102, 172], RED = [178, 24, 43], EQUAL = 247;
function deviation(gain, signed) {
  return (r, g, b, out, o) => {
    let v = halves[r];
    if (Math.abs(halves[g]) > Math.abs(v)) v = halves[g];
    if (Math.abs(halves[b]) > Math.abs(v)) v = halves[b];
    const size = Math.min(Math.abs(v) * gain, 1), end = v < 0 ? BLUE : RED;
    for (let c = 0; c < 3; c++) out[o + c] = signed ? EQUAL + (end[c] - EQUAL) * size : 255 * size;
  };
}

const isDifference = (canvas) => canvas.closest(".pane").dataset.role === "difference";
function paintDifference(canvas) {
  const slider = canvas.closest(".pane").querySelector(".gain"), gain = 10 ** slider.value;
  slider.nextElementSibling.value = "×" + (gain < 1e4 ? Math.round(gain * 10) / 10 : "1e" + slider.value);
  paint(canvas, deviation(gain, root.dataset.sign === "signed"));
}
function paintAll(which = () => true) {
  for (const canvas of all("canvas").filter(which)) isDifference(canvas) ? paintDifference(canvas) : paint(canvas, light);
}

// Every study has the same bar; they move together.
let exposure = 0;
function setExposure(ev) {
  exposure = Math.min(Math.max(ev, -8), 8);
  for (const slider of all("input[name=exposure]")) {
    slider.value = exposure;
    slider.nextElementSibling.value = (exposure > 0 ? "+" : "") + exposure + " EV";
  }
  expose(exposure);
  paintAll((canvas) => !isDifference(canvas));
}
function setSign(sign) {
  root.dataset.sign = sign;
  for (const select of all("select[name=sign]")) select.value = sign;
  paintAll(isDifference);
}
const still = matchMedia("(prefers-reduced-motion: reduce)");
let timer = 0;
function blink() {
  root.toggleAttribute("data-blink");
}
function setMode(mode) {
  root.dataset.mode = mode;
  root.removeAttribute("data-blink");
  for (const radio of all("input[name=mode]")) radio.checked = radio.value === mode;
  clearInterval(timer);
  if (mode === "flicker" && !still.matches) timer = setInterval(blink, 700);
}
const toggleMode = (mode) => setMode(root.dataset.mode === mode ? "side" : mode);

let split = 50;
function setSplit(percent) {
  split = Math.min(Math.max(percent, 0), 100);
  root.style.setProperty("--split", split + "%");
}

const KEYS = {
  "[": () => setExposure(exposure - 0.5),
  "]": () => setExposure(exposure + 0.5),
  e: () => setExposure(exposure + 0.5),
  E: () => setExposure(exposure - 0.5),
  0: () => setExposure(0),
  f: () => toggleMode("flicker"),
  s: () => toggleMode("slider"),
  " ": () => root.dataset.mode === "flicker" && (clearInterval(timer), blink()),
  ArrowLeft: () => root.dataset.mode === "slider" && setSplit(split - 2),
  ArrowRight: () => root.dataset.mode === "slider" && setSplit(split + 2),
};

const shown = (v) => (Number.isFinite(v) && v !== 0 && Math.abs(v) < 1e-3 ? v.toExponential(2) : Number.isFinite(v) ? +v.toPrecision(4) + "" : String(v));
function probe(figure, x, y) {
  figure.toggleAttribute("data-probed", x !== undefined);
  figure.style.setProperty("--x", x * 100 + "%");
  figure.style.setProperty("--y", y * 100 + "%");
  for (const pane of all(".pane", figure)) {
    const canvas = pane.querySelector("canvas"), codes = pictures[canvas.dataset.pixels];
    const column = Math.min(Math.floor(x * canvas.width), canvas.width - 1);
    const line = Math.min(Math.floor(y * canvas.height), canvas.height - 1);
    const at = 3 * (line * canvas.width + column);
    const text = x === undefined ? "" : [0, 1, 2].map((c) => shown(halves[codes[at + c]])).join("  ");
    pane.querySelector(".pixel").value = text;
    canvas.title = x === undefined ? "" : `${column}, ${line}`;
  }
}

function listen() {
  for (const form of all(".viewer")) {
    form.addEventListener("submit", (e) => e.preventDefault());
    form.addEventListener("input", ({ target }) => {
      if (target.name === "exposure") setExposure(+target.value);
      if (target.name === "mode") setMode(target.value);
      if (target.name === "sign") setSign(target.value);
    });
  }
  for (const slider of all(".gain")) slider.addEventListener("input", () => paintDifference(slider.closest(".pane").querySelector("canvas")));
  for (const figure of all(".compare")) {
    const track = (e) => {
      const frame = e.target.closest(".frame");
      if (!frame) return;
      const box = frame.getBoundingClientRect();
      const x = Math.min(Math.max((e.clientX - box.left) / box.width, 0), 1);
      const y = Math.min(Math.max((e.clientY - box.top) / box.height, 0), 1);
      if (e.buttons && root.dataset.mode === "slider") setSplit(100 * x);
      probe(figure, x, y);
    };
    figure.addEventListener("pointerdown", (e) => {
      if (root.dataset.mode === "slider" && e.target.closest(".frame")) e.target.setPointerCapture(e.pointerId);
      track(e);
    });
    figure.addEventListener("pointermove", track);
    figure.addEventListener("pointerleave", () => probe(figure));
  }
  addEventListener("keydown", (e) => {
    const editing = e.target.matches("input[type=range], select") && e.key.startsWith("Arrow");
    const pressing = e.target.matches("summary, select, input, a") && e.key === " ";
    if (e.ctrlKey || e.metaKey || e.altKey || editing || pressing || !(e.key in KEYS) || !all(".viewer").length) return;
    if (KEYS[e.key]() !== false) e.preventDefault();
  });
}

async function start() {
  await Promise.all([...new Set(all("canvas").map((canvas) => canvas.dataset.pixels))].map(load));
  setExposure(0);
  setSign("signed");
  setMode("side");
  listen();
  root.dataset.ready = "1";
}
start();
