// `refract3` of @thi.ng/vectors, for arrays of double precision:  node thi_ng_rays.mjs NPM_FOLDER < rays > answers
// The columns are those of table.py.
import { readFileSync } from "node:fs";
import { join, resolve } from "node:path";
import { pathToFileURL } from "node:url";

const modules = join(resolve(process.argv[2]), "node_modules", "@thi.ng", "vectors");
const { refract3 } = await import(pathToFileURL(join(modules, "index.js")));
const { version } = JSON.parse(readFileSync(join(modules, "package.json")));
const [names, ...rows] = readFileSync(0, "utf8").split("\n").filter((line) => line.trim() && !line.startsWith("#"))
  .map((line) => line.split(",").map((cell) => cell.trim()));
const column = Object.fromEntries(names.map((name, i) => [name, i]));
const answers = rows.map((row) => {
  const number = (name) => Number(row[column[name]]);
  const a = ["ax", "ay", "az"].map(number);
  let n = ["nx", "ny", "nz"].map(number);
  if (a[0] * n[0] + a[1] * n[1] + a[2] * n[2] > 0) n = n.map((x) => -x);
  return [row[column.id], ...refract3([], a, n, number("n_from") / number("n_to"))].join(",");
});
console.log([`# system: @thi.ng/vectors ${version}, node ${process.version}`, "id,bx,by,bz", ...answers].join("\n"));
