"use strict";
// Lists of images that are not equal: a filter, and tick boxes that build the command which accepts them.
const search = document.querySelector("input[type=search]");
const visible = (element) => !element.hidden;

// All words must occur in a name, its verdict or its cause. A folded list with a match is unfolded.
function filter(text) {
  const words = text.toLowerCase().split(/\s+/).filter(Boolean);
  for (const each of all("[data-text]")) each.hidden = !words.every((word) => each.dataset.text.includes(word));
  for (const list of all("main details")) {
    list.dataset.before ??= String(list.open);
    list.open = words.length ? all("tr[data-text]", list).some(visible) : list.dataset.before === "true";
  }
  const entries = all("main [data-text]"), left = entries.filter(visible).length;
  document.querySelector(".shown-count").value = words.length ? `${left} of ${entries.length}` : "";
  for (const button of all("[data-filter]")) {
    button.setAttribute("aria-pressed", search.value === button.dataset.filter);
  }
}
function setFilter(text) {
  search.value = text;
  filter(text);
}

// The command. Its words are already quoted for a shell; after -- no word is an option.
const form = document.querySelector(".accepting");
function build() {
  const words = all(".tick input:checked").map((box) => box.dataset.word);
  form.hidden = !words.length;
  form.querySelector(".ticked").textContent = `${words.length} ticked`;
  const dashes = words.some((word) => /^'?-/.test(word)) ? ["--"] : [];
  form.querySelector(".built").textContent = [form.dataset.command, ...dashes, ...words].join(" ");
}
async function copy() {
  const built = form.querySelector(".built"), button = form.querySelector(".copy");
  try {
    await navigator.clipboard.writeText(built.textContent);
  } catch {
    getSelection().selectAllChildren(built);
    document.execCommand("copy");
  }
  button.textContent = "Copied";
  setTimeout(() => (button.textContent = "Copy"), 1500);
}
function tickShown() {
  for (const box of all(".tick input")) box.checked ||= visible(box.closest("[data-text]"));
  build();
}
function clear() {
  for (const box of all(".tick input:checked")) box.checked = false;
  build();
}

// Each name in the navigation bar gets a small copy of its image.
root.addEventListener("painted", () => {
  for (const link of all("nav a[data-text]")) {
    const panes = document.querySelector(link.hash), source = panes.querySelector("[data-role=test] canvas") ?? panes.querySelector("canvas");
    if (!source) continue;
    const small = document.createElement("canvas");
    small.height = Math.min(64, source.height);
    small.width = Math.max(1, Math.round(source.width * small.height / source.height));
    small.getContext("2d").drawImage(source, 0, 0, small.width, small.height);
    link.prepend(small);
  }
});

// Keys: x ticks the failure below the navigation bar.
function tick() {
  const under = (article) => article.getBoundingClientRect().bottom > 130;
  all(".failure").filter(visible).find(under)?.querySelector(".tick input")?.click();
}
const LIST_KEYS = { "/": () => search?.focus(), x: tick };

addEventListener("keydown", (e) => {
  if (e.target === search) {
    if (e.key === "Escape") setFilter("");
    if (e.key === "Escape" || e.key === "Enter") search.blur();
  } else if (e.key in LIST_KEYS && !(e.ctrlKey || e.metaKey || e.altKey)) {
    LIST_KEYS[e.key]();
    e.preventDefault();
  }
});
search?.addEventListener("input", () => filter(search.value));
for (const button of all("[data-filter]")) {
  button.addEventListener("click", () => setFilter(search.value === button.dataset.filter ? "" : button.dataset.filter));
}
if (form) {
  form.addEventListener("submit", (e) => e.preventDefault());
  form.querySelector(".copy").addEventListener("click", copy);
  form.querySelector(".clear").addEventListener("click", clear);
  for (const button of all(".tick-shown")) button.addEventListener("click", tickShown);
  for (const box of all(".tick input")) box.addEventListener("input", build);
  build();
}
