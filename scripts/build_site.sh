#!/usr/bin/env bash
# Builds the site from docs/ into a folder (build/site/html by default), warnings as errors, and checks its links.
# Reads no network, and neither does the site. Needs: pip install '.[docs]', or the .venv of `make site`.
set -euo pipefail
cd "$(dirname "$0")/.."
python="${PYTHON:-.venv/bin/python}"
[ -x "$python" ] || python="$(command -v python3)"
out="${1:-build/site/html}"
source="$(mktemp -d)"
trap 'rm -rf "$source"' EXIT

[ ! -e "$out/objects.inv" ] || rm -rf "$out" # an older site, with pages that are gone
"$python" scripts/stage_site.py "$source"
"$python" -m sphinx -W --keep-going --quiet --fresh-env --doctree-dir "$source/.doctrees" "$source" "$out"
touch "$out/.nojekyll" # GitHub Pages leaves out folders such as _static without it
"$python" scripts/check_site.py "$out"
