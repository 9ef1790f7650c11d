#!/usr/bin/env bash
# Makes the environment $1/extras: all that is in the environment $1, and the packages of requirements-extras.txt.
# Does nothing where that is already done.
set -euo pipefail
cd "$(dirname "$0")/.."
base=$(realpath "$1")
venv=$base/extras
python=$venv/bin/python
cpu_builds=https://download.pytorch.org/whl/cpu
export PIP_DISABLE_PIP_VERSION_CHECK=1
unset PYTHONHOME PYTHONPATH PIP_TARGET PIP_PREFIX PIP_USER PIP_REQUIRE_VIRTUALENV

stop() {
    echo "error: $*" >&2
    exit 2
}

key() {
    {
        cat "$base/.rsjax-setup" requirements-extras.txt scripts/extras.sh
    } | sha256sum
}

stamp=$venv/.rsjax-extras
if [ -x "$python" ] && [ "$(cat "$stamp" 2>/dev/null)" = "$(key)" ]; then
    exit 0
fi
rm -f "$stamp"
"$base/bin/python" -m venv --without-pip --clear "$venv" || stop "could not make $venv; see the lines above"
"$base/bin/python" - >"$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/base.pth" <<'PYTHON'
import sysconfig

print("import site; site.addsitedir(%r)" % sysconfig.get_path("purelib"))
PYTHON

index=()
if "$base/bin/python" -c 'import sys, urllib.request as u; u.urlopen(sys.argv[1] + "/torch/", timeout=10)' \
    "$cpu_builds" 2>/dev/null; then
    index=(--extra-index-url "$cpu_builds")
else
    echo "extras: $cpu_builds cannot be reached; where pip finds no build of PyTorch without CUDA, it takes 5 GB more"
fi
echo "extras: installing the packages of requirements-extras.txt (about 1.7 GB)"
"$base/bin/python" -m pip --python "$python" install --quiet --progress-bar off "${index[@]}" -r requirements-extras.txt ||
    stop "pip could not install requirements-extras.txt, which needs a package index and 1.7 GB of disk; see its lines above"
if ! "$python" -c 'import torchvision' >/dev/null 2>&1; then
    # Then transformers does not import either. It does without torchvision; only the annotators RAFT and InternVL need that.
    echo "extras: torchvision does not fit this build of PyTorch and is removed; the tests that need it are skipped"
    "$base/bin/python" -m pip --python "$python" uninstall --quiet --yes torchvision
fi
if ! command -v chromium >/dev/null; then
    echo "extras: installing Chromium for the tests of pages"
    scripts/apt.sh chromium ||
        echo "extras: without Chromium the tests of pages are skipped; install it: apt-get install chromium" >&2
fi
key >"$stamp"
echo "extras: $venv is ready"
