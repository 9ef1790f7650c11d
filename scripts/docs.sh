#!/usr/bin/env bash
# Adds the packages of the documentation's site to the environment $1, unless it has them.
set -euo pipefail
cd "$(dirname "$0")/.."
python=$1/bin/python
export PIP_DISABLE_PIP_VERSION_CHECK=1
if ! "$python" -c 'import mkdocstrings, material' 2>/dev/null; then
    "$python" -m pip install --quiet --progress-bar off -c requirements.txt -r requirements-docs.txt
fi
