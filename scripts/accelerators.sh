#!/usr/bin/env bash
# Makes the environment $1/accelerators: all that is in the environment $1, and XLA's compilers for GPUs and TPUs, which
# need neither. Does nothing where that is already done.
set -euo pipefail
cd "$(dirname "$0")/.."
base=$(realpath "$1")
venv=$base/accelerators
python=$venv/bin/python
export PIP_DISABLE_PIP_VERSION_CHECK=1
unset PYTHONHOME PYTHONPATH PIP_TARGET PIP_PREFIX PIP_USER PIP_REQUIRE_VIRTUALENV

stop() {
    echo "error: $*" >&2
    exit 2
}

# What the environment depends on; where it stands too, since an environment that was moved is broken.
key() {
    {
        echo "$venv"
        cat requirements-accelerators.txt scripts/accelerators.sh
    } | sha256sum
}

stamp=$venv/.rsjax-accelerators
if [ -x "$python" ] && [ "$(cat "$stamp" 2>/dev/null)" = "$(key)" ]; then
    echo "accelerators: $venv is ready"
    exit 0
fi
rm -f "$stamp"
"$base/bin/python" -m venv --without-pip --clear "$venv" || stop "could not make $venv; see the lines above"
"$base/bin/python" - >"$("$python" -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/base.pth" <<'PYTHON'
import sysconfig

print("import site; site.addsitedir(%r)" % sysconfig.get_path("purelib"))
PYTHON
echo "accelerators: installing jax's CUDA packages (4.4 GB) and libtpu (0.7 GB)"
"$base/bin/python" -m pip --python "$python" install --quiet --progress-bar off --no-deps -r requirements-accelerators.txt ||
    stop "pip could not install requirements-accelerators.txt, which needs a package index and 5.1 GB of disk; see its lines above"
key >"$stamp"
echo "accelerators: $venv is ready; python -m experiments.compile uses it"
