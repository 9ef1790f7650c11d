#!/usr/bin/env bash
# Uses rsjax as a newcomer does: builds the wheel, installs it alone into an empty environment, leaves the checkout, and
# runs scripts/newcomer.py there. PYTHON: the interpreter, 3.11 or later; by default that of .venv, or python3. Packages
# come from pip's cache where it has them.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${PYTHON:-python3}
if [ -z "${PYTHON:-}" ] && [ -x .venv/bin/python ]; then
    python=.venv/bin/python
fi
python=$(command -v "$python")
export PIP_DISABLE_PIP_VERSION_CHECK=1
unset PYTHONHOME PYTHONPATH PIP_TARGET PIP_PREFIX PIP_USER PIP_REQUIRE_VIRTUALENV
room=$(mktemp -d)
trap 'rm -rf "$room"' EXIT

mkdir "$room/source" "$room/elsewhere"
# Only what git knows or may come to know, so that nothing of an earlier build gets into the wheel.
git ls-files -co --exclude-standard -z | xargs -0 cp --parents -t "$room/source"
"$python" -m pip wheel --quiet --no-deps --wheel-dir "$room/dist" "$room/source"
wheel=$(echo "$room"/dist/*.whl)
echo "wheel: $(stat -c %s "$wheel") bytes, $(basename "$wheel")"
if [ "$(stat -c %s "$wheel")" -gt 30000000 ]; then
    echo "error: the wheel is larger than 30 MB" >&2
    exit 1
fi

began=$SECONDS
"$python" -m venv "$room/venv"
"$room/venv/bin/python" -m pip install --quiet --progress-bar off "$wheel"
echo "installation: $((SECONDS - began)) s with $("$room/venv/bin/python" --version)"
cp scripts/newcomer.py "$room/elsewhere"
cd "$room/elsewhere"
# A home of its own, without caches of compiled programs.
HOME=$room/home XDG_CACHE_HOME=$room/home/.cache PATH="$room/venv/bin:$PATH" "$room/venv/bin/python" newcomer.py
