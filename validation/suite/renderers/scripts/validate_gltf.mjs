// Run Khronos' gltf-validator on glTF files:  node validate_gltf.mjs NPM_FOLDER < PATHS, one per line
// Prints a line per file: the numbers of errors and warnings, and the first message.
import { readFileSync } from "node:fs";
import { readFile } from "node:fs/promises";
import { createRequire } from "node:module";
import { dirname, join, resolve } from "node:path";

const validator = createRequire(join(resolve(process.argv[2]), "package.json"))("gltf-validator");
for (const path of readFileSync(0, "utf8").split("\n").filter(Boolean)) {
  const { issues } = await validator.validateBytes(new Uint8Array(await readFile(path)), {
    externalResourceFunction: async (uri) => new Uint8Array(await readFile(join(dirname(path), uri))),
  });
  const [first] = issues.messages.filter(({ severity }) => severity < 2);
  console.log(issues.numErrors, issues.numWarnings, first ? `${first.code} ${first.pointer}` : "");
}
