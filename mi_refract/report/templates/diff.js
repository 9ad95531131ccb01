"use strict";
// Lists of images that are not equal: a filter, an order, and tick boxes that build the command which accepts them.
const search = document.querySelector("input[type=search]");
const items = all(".item");
const visible = (element) => !element.hidden;

// All words must be in a name, its verdict or its cause. What the filter finds in a folded list unfolds it.
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
  headings();
}
function setFilter(text) {
  search.value = text;
  filter(text);
}

// Verdicts are in the order of the page as it was written.
const beyond = (item) => (item.dataset.excess === "" ? -1 : Number(item.dataset.excess));
const byName = (a, b) => (a.dataset.name < b.dataset.name ? -1 : Number(a.dataset.name > b.dataset.name));
const ORDERS = { verdict: () => 0, name: byName, excess: (a, b) => (beyond(b) > beyond(a)) - (beyond(b) < beyond(a)) };
const folderOf = (item) => item.dataset.folder;
function arrange() {
  const sorted = [...items].sort(ORDERS[document.querySelector("[name=sort]").value]);
  if (document.querySelector("[name=group]").checked) {
    sorted.sort((a, b) => (folderOf(a) < folderOf(b) ? -1 : Number(folderOf(a) > folderOf(b))));
  }
  document.getElementById("list").append(...sorted);
  headings();
}
function headings() {
  for (const old of all("h2.folder")) old.remove();
  if (!document.querySelector("[name=group]")?.checked) return;
  const shown = all(".item").filter(visible);
  shown.forEach((item, at) => {
    if (at && folderOf(item) === folderOf(shown[at - 1])) return;
    const heading = document.createElement("h2"), count = document.createElement("small");
    heading.className = "folder";
    heading.textContent = folderOf(item) || "(no folder)";
    count.textContent = shown.filter((other) => folderOf(other) === folderOf(item)).length;
    heading.append(count);
    item.before(heading);
  });
}

// The command. Words are quoted for a shell already; after -- none is an option.
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

// Keys: in a list of rows j and k move, x ticks. On the page of a pair j and k are the next one and the one before.
const current = () => document.activeElement?.closest(".item") ?? null;
function step(by) {
  const rows = all(".item").filter(visible), at = rows.indexOf(current());
  const next = rows[at < 0 ? 0 : Math.min(Math.max(at + by, 0), rows.length - 1)];
  next?.querySelector(".open").focus();
}
function tick() {
  const under = (article) => article.getBoundingClientRect().bottom > 130;
  const box = (current() ?? all(".failure").filter(visible).find(under))?.querySelector(".tick input");
  box?.click();
}
function turn(rel) {
  const link = document.querySelector(`[rel=${rel}][href]`);
  if (link) location.href = link.href;
}
const LIST_KEYS = { "/": () => search?.focus(), x: tick };
if (items.length) Object.assign(LIST_KEYS, { j: () => step(1), k: () => step(-1) });
function showPages(pages) {
  const here = pages.findIndex(([page]) => location.pathname.endsWith("/" + page));
  for (const [rel, at] of [["prev", here - 1], ["next", here + 1]]) {
    const link = document.querySelector(`[rel=${rel}]`);
    if (here < 0 || !pages[at]) continue;
    link.href = pages[at][0].split("/").pop();
    link.querySelector("span").textContent = pages[at][1];
    link.hidden = false;
  }
  document.querySelector(".place").value = here < 0 ? "" : `${here + 1} of ${pages.length}`;
  Object.assign(LIST_KEYS, { j: () => turn("next"), k: () => turn("prev") });
  for (const key of ["j", "k"]) delete KEYS[key];
}

addEventListener("keydown", (e) => {
  if (e.target === search) {
    if (e.key === "Escape") setFilter("");
    if (e.key === "Escape" || e.key === "Enter") search.blur();
  } else if (e.key in LIST_KEYS && !(e.ctrlKey || e.metaKey || e.altKey) && !e.target.matches("select")) {
    LIST_KEYS[e.key]();
    e.preventDefault();
  }
});
search?.addEventListener("input", () => filter(search.value));
for (const button of all("[data-filter]")) {
  button.addEventListener("click", () => setFilter(search.value === button.dataset.filter ? "" : button.dataset.filter));
}
for (const control of all("[name=sort], [name=group]")) control.addEventListener("input", arrange);
if (form) {
  form.addEventListener("submit", (e) => e.preventDefault());
  form.querySelector(".copy").addEventListener("click", copy);
  form.querySelector(".clear").addEventListener("click", clear);
  for (const button of all(".tick-shown")) button.addEventListener("click", tickShown);
  for (const box of all(".tick input")) box.addEventListener("input", build);
  build();
}
if (typeof PAGES !== "undefined") showPages(PAGES);
