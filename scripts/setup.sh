#!/usr/bin/env bash
# Makes the environment $1 with the pinned packages and this project in it. Does nothing where that is already done.
set -euo pipefail
cd "$(dirname "$0")/.."
venv=$1
export PIP_DISABLE_PIP_VERSION_CHECK=1
unset PYTHONHOME PYTHONPATH PIP_TARGET PIP_PREFIX PIP_USER PIP_REQUIRE_VIRTUALENV

stop() {
    echo "error: $*" >&2
    exit 2
}

runs() { # whether the interpreter $1 is one that the pinned packages support
    "$1" -c 'import sys; sys.exit(sys.version_info[:2] not in ((3, 11), (3, 12)))' >/dev/null 2>&1
}

find_python() {
    if [ -n "${PYTHON:-}" ]; then
        runs "$PYTHON" || stop "PYTHON=$PYTHON is not a Python 3.11 or 3.12; name one that is"
        echo "$PYTHON"
        return
    fi
    for candidate in python3.12 python3.11 python3 python; do
        if runs "$candidate"; then
            command -v "$candidate"
            return
        fi
    done
    stop "no Python 3.11 or 3.12 found; install one (Debian 12: apt-get install python3 python3-venv; elsewhere:" \
        "uv python install 3.12), then: make setup PYTHON=/path/to/python3.12"
}

make_venv() {
    local python version
    python=$(find_python)
    version=$("$python" -c 'import sys; print("%d.%d" % sys.version_info[:2])')
    if ! "$python" -c 'import ensurepip, venv' >/dev/null 2>&1; then
        echo "setup: installing python$version-venv, without which Python makes no environments"
        scripts/apt.sh "python$version-venv" ||
            stop "$python lacks its venv module; install it: apt-get install python$version-venv"
    fi
    echo "setup: making $venv with Python $version"
    "$python" -m venv --clear "$venv" || stop "could not make $venv; see the lines above"
}

# What the environment depends on; where it stands too, since an environment that was moved is broken.
key() {
    {
        realpath -m "$venv"
        cat requirements.txt requirements-nodeps.txt setup.cfg pyproject.toml scripts/setup.sh
    } | sha256sum
}

stamp=$venv/.rsjax-setup
python=$venv/bin/python
if runs "$python" && [ "$(cat "$stamp" 2>/dev/null)" = "$(key)" ]; then
    exit 0
fi
rm -f "$stamp"
if ! runs "$python" || ! "$python" -m pip --version >/dev/null 2>&1; then
    make_venv
fi
echo "setup: installing the packages of requirements.txt (the first time about 2 GB and a few minutes)"
pip=("$python" -m pip install --quiet --progress-bar off)
"${pip[@]}" -r requirements.txt || stop "pip could not install requirements.txt; see its lines above, then run it again"
"${pip[@]}" --no-deps -r requirements-nodeps.txt || stop "pip could not install requirements-nodeps.txt; see above"
"${pip[@]}" --no-deps --no-build-isolation -e . || stop "pip could not install rsjax itself; see above"
key >"$stamp"
echo "setup: $venv is ready"
