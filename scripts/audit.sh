#!/usr/bin/env bash
# Compares the pinned packages with the known vulnerabilities on PyPI, by pip-audit in the environment $1/audit.
# Fails if a package has one, and also if the service does not know a package: then nothing was learnt about it.
set -euo pipefail
cd "$(dirname "$0")/.."
venv=$1/audit
version=2.10.1
export PIP_DISABLE_PIP_VERSION_CHECK=1
unset PYTHONHOME PYTHONPATH PIP_TARGET PIP_PREFIX PIP_USER PIP_REQUIRE_VIRTUALENV

if [ "$("$venv/bin/pip-audit" --version 2>/dev/null)" != "pip-audit $version" ]; then
    "$1/bin/python" -m venv --clear "$venv"
    "$venv/bin/python" -m pip install --quiet --progress-bar off "pip-audit==$version"
fi
failed=()
for file in requirements*.txt; do
    echo "audit: $file"
    # The pins are complete, needs of needs included, so that pip has nothing to resolve.
    "$venv/bin/pip-audit" --strict --disable-pip --no-deps --progress-spinner off -r "$file" || failed+=("$file")
done
if [ ${#failed[@]} -gt 0 ]; then
    echo "error: see the lines above on ${failed[*]}: raise the pin of a vulnerable package; where one was not found, this" \
        "machine's index has no advisories, so run it where pypi.org can be reached" >&2
    exit 2
fi
