"use strict";
// Pixels are half floats: exposure is a table of 65536 codes, and painting is a look-up.
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
const NOT_A_NUMBER = [255, 0, 255]; // magenta, in images and maps
const linear = (v) => (v <= 0.04045 ? v / 12.92 : ((v + 0.055) / 1.055) ** 2.4);
const unit = (v) => Math.min(Math.max(v, 0), 1);
// Two tables of tones: for images of linear light, and for images of sRGB codes.
const tones = { light: new Uint8ClampedArray(65536), code: new Uint8ClampedArray(65536) };
const expose = (ev) => halves.forEach((v, code) => {
  tones.light[code] = sRGB(unit(v * 2 ** ev));
  tones.code[code] = sRGB(unit(linear(unit(v)) * 2 ** ev));
});

// The inflated text of an element, as a Response.
function inflated(id) {
  const deflated = Uint8Array.from(atob(document.getElementById(id).textContent), (c) => c.charCodeAt(0));
  return new Response(new Blob([deflated]).stream().pipeThrough(new DecompressionStream("deflate")));
}

const images = {};
async function load(id) {
  const { dataset } = document.getElementById(id);
  const planes = new Uint8Array(await inflated(id).arrayBuffer());
  const codes = new Uint16Array(planes.length / 2);
  for (let i = 0, low = codes.length; i < codes.length; i++) codes[i] = (planes[i] << 8) | planes[low + i];
  images[id] = { codes, channels: +dataset.channels, scale: +dataset.scale };
}
const imageOf = (canvas) => images[canvas.dataset.pixels];

function paint(canvas, colour) {
  const { codes, channels } = imageOf(canvas), green = channels > 2 ? 1 : 0, blue = 2 * green;
  const context = canvas.getContext("2d"), image = context.createImageData(canvas.width, canvas.height), out = image.data;
  for (let i = 0, o = 0; i < codes.length; i += channels, o += 4) {
    const r = codes[i], g = codes[i + green], b = codes[i + blue];
    if (halves[r] !== halves[r] || halves[g] !== halves[g] || halves[b] !== halves[b]) out.set(NOT_A_NUMBER, o);
    else colour(r, g, b, out, o);
    out[o + 3] = 255;
  }
  context.putImageData(image, 0, 0);
}

const light = (tone) => (r, g, b, out, o) => {
  out[o] = tone[r];
  out[o + 1] = tone[g];
  out[o + 2] = tone[b];
};

// A pixel shows the channel that differs most, because in a mean errors could cancel.
function strongest(r, g, b) {
  let v = halves[r];
  if (Math.abs(halves[g]) > Math.abs(v)) v = halves[g];
  return Math.abs(halves[b]) > Math.abs(v) ? halves[b] : v;
}
const BLUE = [33, 102, 172], RED = [178, 24, 43], EQUAL = 247;
function deviation(gain, signed) {
  return (r, g, b, out, o) => {
    const v = strongest(r, g, b), size = Math.min(Math.abs(v) * gain, 1), end = v < 0 ? BLUE : RED;
    for (let c = 0; c < 3; c++) out[o + c] = signed ? EQUAL + (end[c] - EQUAL) * size : 255 * size;
  };
}
// Black, violet, orange, pale yellow: lightness increases with the value, also in print.
const HEAT = [[0, 0, 4], [81, 18, 124], [183, 55, 121], [252, 137, 97], [252, 253, 191]];
function heat(gain) {
  return (r, g, b, out, o) => {
    const place = 4 * unit(strongest(r, g, b) * gain), step = Math.min(Math.floor(place), 3), part = place - step;
    for (let c = 0; c < 3; c++) out[o + c] = HEAT[step][c] + (HEAT[step + 1][c] - HEAT[step][c]) * part;
  };
}

const paneOf = (canvas) => canvas.closest(".pane");
const isMap = (canvas) => paneOf(canvas).querySelector(".gain") !== null;
function paintMap(canvas) {
  const slider = paneOf(canvas).querySelector(".gain"), gain = 10 ** slider.value, { scale } = imageOf(canvas);
  slider.nextElementSibling.value = "full at " + shown(scale / gain);
  paint(canvas, paneOf(canvas).dataset.paint === "heat" ? heat(gain) : deviation(gain, root.dataset.sign === "signed"));
}
function paintAll(which = () => true) {
  for (const canvas of all(".pane canvas").filter(which)) isMap(canvas) ? paintMap(canvas) : paint(canvas, light(tones[paneOf(canvas).dataset.paint]));
}

// Every study has an exposure slider; they move together.
let exposure = 0;
function setExposure(ev) {
  exposure = Math.min(Math.max(ev, -8), 8);
  for (const slider of all("input[name=exposure]")) {
    slider.value = exposure;
    slider.nextElementSibling.value = (exposure > 0 ? "+" : "") + exposure + " EV";
  }
  expose(exposure);
  paintAll((canvas) => !isMap(canvas));
}
function setSign(sign) {
  root.dataset.sign = sign;
  for (const select of all("select[name=sign]")) select.value = sign;
  paintAll(isMap);
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

// The next or previous failure or image below the fixed bars.
function go(step) {
  const places = all(".failure, .compare:not(.failure *)").filter((place) => !place.hidden), top = 120;
  const offset = (place) => place.getBoundingClientRect().top - top;
  const next = step > 0 ? places.find((p) => offset(p) > 2) : places.findLast((p) => offset(p) < -2);
  if (next) scrollBy({ top: offset(next), behavior: still.matches ? "auto" : "smooth" });
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
  j: () => go(1),
  k: () => go(-1),
  ArrowLeft: () => root.dataset.mode === "slider" && setSplit(split - 2),
  ArrowRight: () => root.dataset.mode === "slider" && setSplit(split + 2),
};

const shown = (v) => (Number.isFinite(v) && v !== 0 && Math.abs(v) < 1e-3 ? v.toExponential(2) : Number.isFinite(v) ? +v.toPrecision(4) + "" : String(v));
const LARGEST = 0x7bff; // this value or any larger one
const reading = (code, scale) => ((code & 0x7fff) !== LARGEST ? "" : code > LARGEST ? "≤ " : "≥ ") + shown(halves[code] * scale);
function probe(figure, x, y) {
  figure.toggleAttribute("data-probed", x !== undefined);
  figure.style.setProperty("--x", x * 100 + "%");
  figure.style.setProperty("--y", y * 100 + "%");
  for (const pane of all(".pane", figure)) {
    const canvas = pane.querySelector("canvas"), { codes, channels, scale } = imageOf(canvas);
    const column = Math.min(Math.floor(x * canvas.width), canvas.width - 1);
    const line = Math.min(Math.floor(y * canvas.height), canvas.height - 1);
    const at = channels * (line * canvas.width + column);
    const values = x === undefined ? [] : [...codes.subarray(at, at + channels)];
    pane.querySelector(".pixel").value = values.map((code) => reading(code, scale)).join("  ");
    pane.querySelector(".place").value = x === undefined || isMap(canvas) ? "" : `${column}, ${line}`;
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
  for (const slider of all(".gain")) slider.addEventListener("input", () => paintMap(paneOf(slider).querySelector("canvas")));
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
    if (e.target.matches("input[type=search]")) return;
    const editing = e.target.matches("input[type=range], select") && e.key.startsWith("Arrow");
    const pressing = e.target.matches("summary, select, input, a") && e.key === " ";
    if (e.ctrlKey || e.metaKey || e.altKey || editing || pressing || !(e.key in KEYS) || !all(".viewer").length) return;
    if (KEYS[e.key]() !== false) e.preventDefault();
  });
}

// Marks the sides on which a table can be scrolled further.
function markScroll(box) {
  const right = box.scrollWidth - box.clientWidth - box.scrollLeft > 2;
  box.dataset.more = [box.scrollLeft > 2 && "left", right && "right"].filter(Boolean).join(" ");
}
function watchScrolls() {
  const seen = new ResizeObserver((entries) => entries.forEach((entry) => markScroll(entry.target)));
  for (const box of all(".scroll")) {
    seen.observe(box);
    box.addEventListener("scroll", () => markScroll(box), { passive: true });
  }
}

// The rows of a section, from this page; if that fails, the link leads to rows.json beside it.
async function save(link) {
  const made = document.createElement("a");
  made.href = URL.createObjectURL(new Blob([await inflated(link.dataset.rows).blob()], { type: "application/json" }));
  made.download = link.download;
  made.click();
  URL.revokeObjectURL(made.href);
}
function offerRows() {
  for (const link of all("a[data-rows]")) link.addEventListener("click", (e) => {
    e.preventDefault();
    save(link);
  });
}

async function start() {
  watchScrolls();
  offerRows();
  await Promise.all([...new Set(all("canvas").map((canvas) => canvas.dataset.pixels))].map(load));
  setExposure(0);
  setSign("signed");
  setMode("side");
  listen();
  root.dispatchEvent(new Event("painted"));
  root.dataset.ready = "1";
}
start();
