#!/usr/bin/env bash
# Make viz/page/library.min.js, what the page of `gvtools export --format html` draws with, and the
# licences beside it. Needs node and npm; users need neither. Versions are those of
# package-lock.json: `npm install --package-lock-only NAME@VERSION` here, then this script.
set -euo pipefail

here=$(cd "$(dirname "$0")" && pwd)
out=$here/../../viz/page
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT
cp "$here"/{package.json,package-lock.json,entry.js} "$work"
cd "$work"
npm ci --no-audit --no-fund --ignore-scripts
node_modules/.bin/esbuild entry.js --bundle --minify --format=iife --global-name=library \
    --target=es2022 --legal-comments=none --metafile=meta.json --outfile=library.min.js
# In a page a script ends where it says so, and must not open a comment.
if grep -qiE '</script|<!--' library.min.js; then
    echo "the bundle has what ends a script in a page" >&2
    exit 1
fi

# The licence of each package that the bundle has parts of.
node -e '
const fs = require("fs"), inputs = Object.keys(require("./meta.json").inputs);
const name = /^node_modules\/((?:@[^/]+\/)?[^/]+)/;
const packages = [...new Set(inputs.map((path) => path.match(name)?.[1]).filter(Boolean))];
// Spark is published with it built in.
packages.push("fflate");
console.log(packages.sort().map((each) => {
  const { version, license } = require(`./node_modules/${each}/package.json`);
  const text = fs.readFileSync(`node_modules/${each}/LICENSE`, "utf8").trim();
  return `${each} ${version} (${license})\n\n${text}\n`;
}).join(`\n${"-".repeat(72)}\n\n`));
' >library.LICENSE.txt
mkdir -p "$out"
cp library.min.js library.LICENSE.txt "$out"
ls -l "$out"
